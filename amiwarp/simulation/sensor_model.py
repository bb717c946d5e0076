"""Model of the sensor: an event camera's pixels and readout."""

from __future__ import annotations

import math
from dataclasses import dataclass

from amiwarp.schema.calls import guarded
from amiwarp.validation import one_of, real


@guarded
@dataclass(frozen=True, slots=True)
class SensorModel:
    """Model of an event camera's pixels and readout.

    The default values describe a good sensor in good light, with fast biases. By default, the photoreceptors have
    unlimited bandwidth, noise does not depend on light, and every event is read out at once.

    Notes
    -----
    Photoreceptor, leak and shot noise follow v2e (Y. Hu, S.-C. Liu and T. Delbruck, "v2e: From Video Frames to
    Realistic DVS Events", CVPR Workshops 2021).

    Examples
    --------
    >>> amiwarp.SensorModel(contrast_on=0.2).contrast_off
    0.25
    """

    contrast_on: float = 0.25
    """ON threshold: increase of natural log intensity that causes an ON event."""
    contrast_off: float = 0.25
    """OFF threshold: decrease of natural log intensity that causes an OFF event."""
    mismatch: float = 0.03
    """Relative standard deviation of the ON and OFF thresholds between pixels."""
    refractory_us: float = 100.0
    """Refractory period: time after an event in which the pixel is blind [us].

    The new reference of the pixel is the brightness at the end of this period.
    """
    latency_us: float = 100.0
    """Mean time from a brightness change to the time stamp of its event [us]."""
    latency_jitter_us: float = 30.0
    """Standard deviation of the latency [us]. The time stamps of one pixel stay in order."""
    leak_hz: float = 0.1
    """Rate of leak events [1/s]: ON events in constant light, caused by the drift of the pixel's reference."""
    shot_noise_hz: float = 1.0
    """Rate of random events per pixel due to shot noise [1/s]. Half of these events are ON.

    Each random event sets the pixel's reference to the present brightness.
    """
    hot_fraction: float = 0.0002
    """Fraction of the pixels that are hot: they fire additional random events."""
    hot_hz: float = 100.0
    """Additional rate of random events of a hot pixel [1/s]."""
    cutoff_hz: float | None = 0.0
    """Bandwidth of the photoreceptor at white [Hz], proportional to the light; 0 or None for unlimited bandwidth.

    The photoreceptor is a first-order low-pass filter of the log intensity, with the time constant
    ``1 / (2 pi cutoff)``. Its cut-off frequency is proportional to the luminance plus 0.02, the stray light and dark
    current that the simulator adds to every picture.
    """
    shot_noise_dark: float = 1.0
    """Rate of random events in the dark, relative to that at white, 1 to 1000; v2e uses 4.

    The rate falls linearly with luminance from the dark to white.
    """
    leak_jitter_fraction: float = 0.0
    """Relative standard deviation of a pixel's leak rate, 0 to 0.3.

    The rate is drawn anew after each event of the pixel, and is never below a tenth of its mean. At 0.1, the times
    between leak events deviate as much, and 1 % fewer leak events occur. At 0.3, these times deviate by half of their
    mean, and 12 % fewer occur.
    """
    noise_rate_cov_decades: float = 0.0
    """Standard deviation of the decimal logarithm of the rates of leak and random events between pixels.

    The rates have a log-normal distribution whose medians are ``leak_hz`` and ``shot_noise_hz``.
    """
    row_us: float = 0.0
    """Time to read out a row [us]; 0 if every event is read out at once.

    The rows are read one after the other, from the first to the last and then from the first again, without a pause.
    The events of a row share the time stamp of their readout. If a pixel fires several times between two readouts, only
    the first event is kept. A scan of all rows must not take longer than 10 ms.
    """
    bus_rate_mev_s: float = 0.0
    """Largest rate of events that the bus transmits [million events/s]; 0 for unlimited.

    Events wait in a queue. The time stamp of an event is the time at which the bus transmits the event.
    """
    bus_queue: float = 4096.0
    """Largest number of events that wait in the queue of the bus. Further events are lost."""

    def __post_init__(self) -> None:
        limits = {"mismatch": 0.5, "refractory_us": 1e6, "latency_us": 1e4, "latency_jitter_us": 1e3, "leak_hz": 1e3,
                  "shot_noise_hz": 1e5, "hot_fraction": 1.0, "hot_hz": 1e5, "leak_jitter_fraction": 0.3,
                  "noise_rate_cov_decades": 1.0, "row_us": 1e4, "bus_queue": 1e9}  # fmt: skip
        for name, limit in limits.items():
            object.__setattr__(self, name, real(getattr(self, name), f"sensor {name}", 0.0, limit))
        for name, least, limit in (("cutoff_hz", 0.01, 1e7), ("bus_rate_mev_s", 1e-3, 1e5)):
            object.__setattr__(
                self, name, _real_or_none(getattr(self, name), f"sensor {name}", least, limit)
            )
        object.__setattr__(
            self, "shot_noise_dark", real(self.shot_noise_dark, "sensor shot_noise_dark", 1.0, 1e3)
        )
        for name in ("contrast_on", "contrast_off"):
            value = real(getattr(self, name), f"sensor {name}", 0.01, 10.0, " (log intensity)")
            object.__setattr__(self, name, value)

    @classmethod
    def ideal(cls, contrast: float = 0.25) -> SensorModel:
        """Return a sensor with equal thresholds and without noise, mismatch, latency and refractory period.

        Parameters
        ----------
        contrast : float, optional
            ON and OFF threshold [log intensity].

        Returns
        -------
        SensorModel
            The sensor model.
        """
        return cls(contrast, contrast, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)

    @classmethod
    def preset(cls, name: str) -> SensorModel:
        """Return the model of a known event camera at the manufacturer's biases in good light.

        Parameters
        ----------
        name : str
            Camera: ``dvxplorer``, ``davis346`` or ``gen4``.

        Returns
        -------
        SensorModel
            The sensor model.

        Raises
        ------
        AmiwarpError
            If the name of the preset is unknown.

        Notes
        -----
        Contrast thresholds C are published as relative changes of light, (maximum - minimum) / minimum (Prophesee,
        "Event-based vision sensor characteristics"). The model uses ln(1 + C) for both polarities.

        ``dvxplorer``: iniVation DVXplorer, 640x480, 9 um pixels. Its data come from the manufacturer
        (docs.inivation.com, DVXplorer):

        - thresholds 13 %: at this contrast half of the pixels respond
        - mismatch 0.32: 99.9 % of the pixels respond at 27.5 %, which is 3.09 standard deviations of ln(1 + C) away
        - latency 200 us: published as "below 1 ms"; the number is a typical value, no source
        - row_us 0.4: a scan of 480 rows takes the published time resolution of 200 us; the chip scans columns
        - bus rate: 165 million events/s
        - cutoff_hz 1000, refractory_us 200, jitter, queue, leak and shot noise: typical values, no source

        ``davis346``: iniVation DAVIS346, 346x260, 18.5 um pixels.

        - thresholds 14.3 % ON and 22.5 % OFF, at which half of the pixels respond: G. Gallego et al., "Event-based
          Vision: A Survey", IEEE TPAMI 2022, table 1
        - latency 20 us, the smallest; bus rate 12 million events/s: data sheet (inivation.com, DAVIS346.pdf)
        - mismatch 0.15, refractory_us 500 and cutoff_hz 300: defaults of v2e (standard deviation 0.03 of thresholds of
          0.2); the standard deviation of 2.1 % contrast that P. Lichtsteiner et al. measured on an earlier chip (IEEE
          JSSC 43(2), 2008) is 0.16 of the ON threshold
        - leak_hz 0.1: v2e's parameters for a noisy sensor
        - jitter, queue, shot noise: typical values, no source

        ``gen4``: Prophesee Gen4 and Sony IMX636, 1280x720, 4.86 um pixels.

        - thresholds 25 %, nominal: data of the camera EVK4 (Prophesee); the smallest threshold is lower
        - latency 100 us: published as "below 100 us at 1000 lux" (Prophesee, EVK4); its manual states 220 us as
          typical at 25 % contrast
        - bus rate 1066 million events/s: T. Finateu et al., "A 1280x720 Back-Illuminated Stacked Temporal Contrast
          Event-Based Vision Sensor with 4.86 um Pixels, 1.066 GEPS Readout", ISSCC 2020; cameras with USB
          transmit less
        - cutoff_hz 2000, refractory_us 100, mismatch, jitter, queue, leak and shot noise: typical values, no source

        In all three, shot noise is four times as strong in the dark, and the jitter of the leak and the spread of the
        noise rates are 0.1, as in v2e. Hot pixels have the default: typical values, no source.

        Examples
        --------
        >>> amiwarp.SensorModel.preset("davis346").bus_rate_mev_s
        12.0
        """
        return cls(**_PRESETS[one_of(name, _PRESETS, "sensor preset")])


def _real_or_none(value: float | None, what: str, least: float, limit: float) -> float:
    """Return a value that must lie between ``least`` and ``limit``; return 0.0 if the value is None or 0."""
    number = 0.0 if value is None else real(value, what, 0.0, limit)
    return number if number == 0.0 else real(number, what, least, limit, " (or 0 for none)")


_PRESETS: dict[str, dict[str, float]] = {
    "dvxplorer": {
        "contrast_on": math.log(1.13),
        "contrast_off": math.log(1.13),
        "mismatch": 0.32,
        "refractory_us": 200.0,
        "latency_us": 200.0,
        "latency_jitter_us": 50.0,
        "leak_hz": 0.05,
        "shot_noise_hz": 0.5,
        "shot_noise_dark": 4.0,
        "leak_jitter_fraction": 0.1,
        "noise_rate_cov_decades": 0.1,
        "cutoff_hz": 1000.0,
        "row_us": 0.4,
        "bus_rate_mev_s": 165.0,
        "bus_queue": 16384.0,
    },
    "davis346": {
        "contrast_on": math.log(1.143),
        "contrast_off": math.log(1.225),
        "mismatch": 0.15,
        "refractory_us": 500.0,
        "latency_us": 20.0,
        "latency_jitter_us": 10.0,
        "leak_hz": 0.1,
        "shot_noise_hz": 1.0,
        "shot_noise_dark": 4.0,
        "leak_jitter_fraction": 0.1,
        "noise_rate_cov_decades": 0.1,
        "cutoff_hz": 300.0,
        "bus_rate_mev_s": 12.0,
        "bus_queue": 4096.0,
    },
    "gen4": {
        "contrast_on": math.log(1.25),
        "contrast_off": math.log(1.25),
        "mismatch": 0.03,
        "refractory_us": 100.0,
        "latency_us": 100.0,
        "latency_jitter_us": 30.0,
        "leak_hz": 0.05,
        "shot_noise_hz": 0.5,
        "shot_noise_dark": 4.0,
        "leak_jitter_fraction": 0.1,
        "noise_rate_cov_decades": 0.1,
        "cutoff_hz": 2000.0,
        "bus_rate_mev_s": 1066.0,
        "bus_queue": 65536.0,
    },
}


def named_sensor(name: str) -> SensorModel:
    """Return the sensor of a name in a file: ``default``, ``ideal``, or a preset of :class:`SensorModel`."""
    if name == "default":
        return SensorModel()
    if name == "ideal":
        return SensorModel.ideal()
    return SensorModel.preset(name)
