"""What the steps of the photometric stage notice, as values. Warnings and refusals are made from these alone.

:mod:`amiwarp.calib.photometric.verdicts` says it in words, and decides which of it is refused. The result of the check
that an answer holds everywhere is a finding too, see :class:`amiwarp.calib.photometric.consistency.Consistency`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from amiwarp.brightness.sensor_timing import SensorTiming
from amiwarp.calib.photometric.causes import SuspectedError
from amiwarp.optics.prism import FlatSide


@dataclass(frozen=True)
class Finding:
    """Something that was noticed."""


@dataclass(frozen=True)
class Optimum(Finding):
    """How good an optimum of the cost is."""

    cost: float
    """Remaining cost, relative to the cost without a map."""
    rise: float
    """Smallest rise of the cost for an orbit that is slightly larger, smaller or rotated either way."""
    moved_px: float
    """Distance from the answer of the sharpness stage [px]."""
    next_step_px: float
    """Length of the next Gauss-Newton step [px]."""


@dataclass(frozen=True)
class MovingParts(Finding):
    """Something moves in one part of the view while another part is still."""

    parts: tuple[tuple[bool, ...], ...]
    """Parts of the image, row by row: True where the scene is not still."""


@dataclass(frozen=True)
class AngleError(Finding):
    """The angles of the events are wrong by what repeats every turn, or by a delay of the read-out."""

    model: str
    """Name of the model."""
    harmonics: tuple[float, ...]
    """Correction of each angle, in the form of :attr:`Calibration.harmonics`; empty for none."""
    late_us: tuple[float, float]
    """Time by which events come later from column to column, and from row to row [us]."""
    late_px: float
    """How far this delay moves events [px rms]."""


@dataclass(frozen=True)
class SectorError(Finding):
    """An error is left that repeats with an angle of the model."""

    model: str
    """Name of the model."""
    angle: int
    """Number of the angle."""
    at_rad: float
    """Angle at which it is largest [rad]."""
    moved_px: float
    """How far it moves events [px rms]."""
    harmonics: tuple[float, ...] = ()
    """Correction of each angle by harmonics that explain it, in the form of :attr:`Calibration.harmonics`; empty for
    none."""


@dataclass(frozen=True)
class RefractoryPeriod(Finding):
    """Pixels pause after an event, for a time that was not given."""

    found_us: float
    """Time that was found [us]."""


@dataclass(frozen=True)
class SlowPixels(Finding):
    """Pixels are slow, and the orbit was corrected."""

    time_constant_us: float
    """Their time constant at the median brightness [us]."""
    turn_rad: float
    """Angle by which the prism turns within it [rad]."""
    moved_px: float
    """How far the correction moved the model [px rms]."""


@dataclass(frozen=True)
class UnsteadyMotion(Finding):
    """A vibration does more than its model says."""

    kind: str
    """What: ``harmonics``, ``amplitude`` or ``speed``."""
    moved_px: float
    """Motion of events by it, as far as a linearised fit finds it [px rms]."""
    std_px: float
    """Its standard deviation [px rms]."""
    significance: float
    """Distance from none [standard deviations]."""
    gain: float
    """Share of the squared residuals that it explains."""


@dataclass(frozen=True)
class UnsteadySpeed(Finding):
    """The speed of a vibration changes over the recording."""

    moved_px: float
    """How far the change moves events, by a linearised fit, which finds a share of it [px rms]."""


@dataclass(frozen=True)
class BlindTime(Finding):
    """The image moves while a pixel is blind after an event."""

    moved_px: float
    """How far it moves at most [px]."""
    sensor: SensorTiming
    """Timing of the sensor, as given or as found."""


@dataclass(frozen=True)
class RefractoryDoubt(Finding):
    """The refractory period is not known well, and the image moves fast."""

    sensor: SensorTiming
    """Timing of the sensor, as given or as found."""
    moved_px: float
    """Change of the answer by an error of one standard deviation of the period [px rms]."""


@dataclass(frozen=True)
class Shake(Finding):
    """The camera shakes with the prism."""

    amplitude_px: float
    """Least amplitude [px]."""


@dataclass(frozen=True)
class LensBeyondCorrection(Finding):
    """The given lens is wrong by more than can be corrected."""

    values: Mapping[str, float]
    """Parameters of the lens at which the search ended, by name."""


@dataclass(frozen=True)
class FlatSideCorrected(Finding):
    """The other side of the prism is flat."""

    given: FlatSide
    found: FlatSide


@dataclass(frozen=True)
class ParameterCorrected(Finding):
    """A parameter that was given was fitted too."""

    name: str
    given: float
    """Value that was given, in the parameter's unit."""
    found: float
    """Value that was found."""
    std: float
    """Its standard deviation."""


@dataclass(frozen=True)
class RivalCauses(Finding):
    """Two causes explain the events equally well."""

    taken: SuspectedError
    """The cause that was corrected."""
    rival: SuspectedError
    apart_px: float
    """Distance of their models [px rms]."""


@dataclass(frozen=True)
class StatedError(Finding):
    """Error of the answer that its covariance states."""

    error_px: float
    """The error [px rms]."""
    parts: tuple[str, ...]
    """Its large parts, of ``thresholds``, ``refractory`` and ``events``; empty if the error is not notable."""


@dataclass(frozen=True)
class MotionError(Finding):
    """What is stated of the error of the motion that the answer takes out of the events."""

    deviation_px: float
    """Its standard deviation, as far as the events determine it [px rms]."""
    hidden_px: Mapping[str, float]
    """By how much causes that were looked for may still change it [px rms], by their words."""


@dataclass(frozen=True)
class Silence(Finding):
    """No events came for some of the time."""

    share: float
    """Share of the time."""


@dataclass(frozen=True)
class MissingEvents(Finding):
    """How much the brightness changes between the two events of a pair, beyond one threshold."""

    step: float
    """Median change beyond one threshold [thresholds]."""
