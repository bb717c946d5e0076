"""What is known of a sensor's timing."""

from __future__ import annotations

from dataclasses import dataclass

from amiwarp.schema.calls import guarded


@guarded
@dataclass(frozen=True, slots=True)
class SensorTiming:
    """Known timing of the sensor [us].

    Examples
    --------
    >>> amiwarp.SensorTiming(latency_us=100.0)
    SensorTiming(latency_us=100.0, refractory_us=None)
    """

    latency_us: float = 0.0
    """Time from a brightness change at the pixel to the time stamp of its event [us]; 0 if it is not known."""
    refractory_us: float | None = None
    """Refractory period: time after an event until the pixel takes its new reference [us]; None if it is not known, 0
    if pixels are known to have none."""

    @property
    def pause_us(self) -> float:
        """The refractory period as far as it is known [us]: 0 if it is not known."""
        return 0.0 if self.refractory_us is None else self.refractory_us
