"""The pixels of a simulated event camera."""

from __future__ import annotations

from dataclasses import dataclass

from amiwarp.validation import real


@dataclass(frozen=True, slots=True)
class SensorModel:
    """Pixels of an event camera. The defaults are those of a good sensor in good light, with fast biases.

    Examples
    --------
    >>> amiwarp.SensorModel(contrast_on=0.2).contrast_off
    0.25
    """

    contrast_on: float = 0.25
    """ON threshold: rise of log intensity that causes an ON event."""
    contrast_off: float = 0.25
    """OFF threshold: fall of log intensity that causes an OFF event."""
    mismatch: float = 0.03
    """Relative standard deviation of both thresholds between pixels."""
    refractory_us: float = 100.0
    """Refractory period: time after an event in which the pixel is blind [us].

    Its reference is the level at the end of it.
    """
    latency_us: float = 100.0
    """Mean time from a change to its time stamp [us]."""
    latency_jitter_us: float = 30.0
    """Standard deviation of the latency [us]. The time stamps of one pixel stay in order."""
    leak_hz: float = 0.1
    """Rate of ON events of a pixel without any change, caused by the drift of its reference [1/s]."""
    shot_noise_hz: float = 1.0
    """Rate of random events per pixel, half of them ON [1/s]. Each resets the reference to the level."""
    hot_fraction: float = 0.0002
    """Fraction of hot pixels."""
    hot_hz: float = 100.0
    """Additional rate of random events of a hot pixel [1/s]."""

    def __post_init__(self) -> None:
        limits = {"mismatch": 0.5, "refractory_us": 1e6, "latency_us": 1e4, "latency_jitter_us": 1e3, "leak_hz": 1e3,
                  "shot_noise_hz": 1e5, "hot_fraction": 1.0, "hot_hz": 1e5}  # fmt: skip
        for name, limit in limits.items():
            object.__setattr__(self, name, real(getattr(self, name), f"sensor {name}", 0.0, limit))
        for name in ("contrast_on", "contrast_off"):
            value = real(getattr(self, name), f"sensor {name}", 0.01, 10.0, " (log intensity)")
            object.__setattr__(self, name, value)

    @classmethod
    def ideal(cls, contrast: float = 0.25) -> SensorModel:
        """Return a sensor with equal thresholds and without noise, mismatch, latency and refractory period.

        Parameters
        ----------
        contrast : float, optional
            Both thresholds [log intensity].

        Returns
        -------
        SensorModel
            The sensor.
        """
        return cls(contrast, contrast, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
