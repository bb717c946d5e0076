"""Parameters of the prism and selection of events under which the inspector shows a recording."""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from amiwarp.optics.prism import apex_from_deflection
from amiwarp.viewer.imager import Region

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from amiwarp.calib.result import Calibration
    from amiwarp.events.recording import Recording


class Source(enum.StrEnum):
    """Where the value of a parameter comes from. The value of a member is the text that the page shows."""

    ASSUMED = "assumed"
    ESTIMATED = "estimated"
    FILE = "from the file"
    CALIBRATED = "calibrated"
    HAND = "set by hand"
    TRUTH = "known truth"


@dataclass(frozen=True)
class Knobs:
    """Parameters of the prism that the page's sliders set."""

    model: str = "exact"
    """Name of the optical model."""
    apex: float = 0.0
    """Apex angle of the prism [rad]."""
    phase: float = 0.0
    """Phase θ_b of the prism [rad]."""
    clock_offset: float = 0.0
    """Offset between the clocks of encoder and camera, as in :class:`Encoder` [us]."""
    tilt_x: float = 0.0
    """Tilt of the axis of rotation, x component [rad]."""
    tilt_y: float = 0.0
    """Tilt of the axis of rotation, y component [rad]."""
    rpm: float = 0.0
    """Speed of the prism if the recording has no encoder [1/min]."""
    index: float | None = None
    """Refractive index, if a calibration or the known truth gave it; None: that of the nominal prism."""
    focal_length: float | None = None
    """Calibrated focal length [px]; None: that of the camera."""

    @property
    def calibrated_only(self) -> dict[str, float]:
        """Parameters by name that the page cannot change, and that a calibration or the known truth gave."""
        found = {"index": self.index, "focal_length": self.focal_length}
        return {name: value for name, value in found.items() if value is not None}


CURVE_HALF_WIDTH = {
    "apex": math.radians(0.4), "phase": math.radians(30.0), "clock_offset": 5000.0, "tilt_x": math.radians(5.0),
    "tilt_y": math.radians(5.0), "rpm": 6.0,
}  # fmt: skip
"""Half width of the range of each parameter over which its sharpness curve is drawn, in the parameter's unit."""


@dataclass(frozen=True)
class Selection:
    """Conditions for the events that are shown."""

    polarity: int | None = None
    """Polarity of the shown events: 1 for only ON, 0 for only OFF, None for both."""
    region: Region | None = None
    """Region of the image: left, top, right and bottom [px], right and bottom exclusive. None: the whole image."""
    hide_hot: bool = False
    """Whether the events of hot pixels are left out."""
    noise_us: int | None = None
    """Time within which an earlier event at a neighbouring pixel must support an event [us]; None: no noise filter."""


def first_sources(recording: Recording) -> dict[str, Source]:
    """Return the sources of a recording's camera and of the parameters that the page shows, without a calibration."""
    apex = getattr(recording.prism, "apex", None)
    return {
        "camera": Source.ASSUMED if recording.camera is None else Source.FILE,
        "apex": Source.ASSUMED if apex is None else Source.FILE,
        **dict.fromkeys(("model", "phase", "tilt_x", "tilt_y"), Source.ASSUMED),
        **({"rpm": Source.ASSUMED} if recording.encoder is None else {"clock_offset": Source.FILE}),
    }


def true_knobs(recording: Recording, *, rpm: float) -> Knobs | None:
    """Return the known parameters of a simulated recording; None without ground truth of its prism.

    ``rpm``: the speed, which ground truth does not hold [1/min].
    """
    p = {} if recording.truth is None else recording.truth.parameters
    if not {"apex", "phase"} <= set(p):
        return None
    recorded_us = 0.0 if recording.encoder is None else recording.encoder.clock_offset_us
    tilts = p.get("tilt_x", 0.0), p.get("tilt_y", 0.0)
    return Knobs("exact", p["apex"], p["phase"], p.get("clock_offset_us", recorded_us), *tilts, rpm, p.get("index"))


def calibrated_knobs(calibration: Calibration, *, offset_us: float, zero_us: int) -> Knobs:
    """Return the parameters of a calibration.

    ``offset_us``: clock offset if the calibration has none [us]. ``zero_us``: time at which the angle of a
    prism without encoder is 0 [us]; the phase is converted to it.
    """
    p, prism = calibration.parameters, calibration.prism
    apex = p["apex"] if "apex" in p else apex_from_deflection(p["deflection"], prism.index, prism.flat_side)
    offset, tilts = p.get("clock_offset", offset_us), (p.get("tilt_x", 0.0), p.get("tilt_y", 0.0))
    rpm, phase = p.get("rpm", 0.0), p["phase"]
    if calibration.zero_us is not None:
        phase += rpm * math.tau / 60e6 * (zero_us - calibration.zero_us)
    return Knobs(calibration.model_name, apex, phase, offset, *tilts, rpm, p.get("index"), p.get("focal_length"))


def calibrated_sources(calibration: Calibration, known: Iterable[str]) -> dict[str, Source]:
    """Return the sources of those ``known`` parameters that a calibration has."""

    def named(names: Iterable[str]) -> set[str]:
        return {"apex" if name == "deflection" else name for name in names} & set(known)

    given = dict.fromkeys(named(calibration.parameters), Source.FILE)
    return given | dict.fromkeys(("model", *named(calibration.free)), Source.CALIBRATED)


def kept_values(knobs: Knobs, values: Mapping[str, float], *, has_encoder: bool) -> dict[str, float]:
    """Return the parameters that a calibration file of a model keeps, of the ``values`` for all models."""
    size = ("deflection",) if knobs.model in ("circle", "radial") else ("apex", "tilt_x", "tilt_y")
    time = {"clock_offset": knobs.clock_offset} if has_encoder else {"rpm": knobs.rpm}
    return {name: values[name] for name in (*size, "phase", *knobs.calibrated_only)} | time
