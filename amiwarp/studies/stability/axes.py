"""Axes of the atlas: quantities and troubles that grow from harmless to hopeless, for the wedge and for every optic."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from amiwarp.studies.stability import optics
from amiwarp.studies.stability.condition import COMBINED, Condition
from amiwarp.studies.stability.scenes import SceneKind


@dataclass(frozen=True)
class Axis:
    """Axis of the study: values of one condition field, from harmless to hopeless."""

    name: str
    """Name of the axis in reports."""
    field: str
    """Name of the field of :class:`Condition` that the axis varies."""
    values: tuple[Any, ...]
    """Values of the field along the axis."""
    unit: str = ""
    """Unit of the values, as shown in reports."""
    also: tuple[tuple[str, Any], ...] = ()
    """Other fields of the condition, with values that differ from their defaults along the whole axis."""

    def conditions(self) -> list[Condition]:
        """Return the condition at each value of the axis."""
        common = replace(Condition(), **dict(self.also))
        return [replace(common, **{self.field: value}) for value in self.values]


SCENES = tuple(kind.value for kind in SceneKind)
"""Names of all kinds of scenes."""

WIDE = (("fov_deg", 90.0), ("apex_deg", 2.0))
"""Condition in which a wrong camera shows: a wide view and a large orbit."""

AXES = (
    Axis("events", "window_events", (0, 300_000, 100_000, 50_000, 20_000, 10_000, 5_000, 1_000)),
    Axis("events lost", "lost", (0.0, 0.1, 0.3, 0.5, 0.7, 0.9), "of all events"),
    Axis("many events", "contrast", (0.25, 0.12, 0.06, 0.03), "log intensity, 24 turns", (("turns", 24.0),)),
    Axis("time window", "turns", (24.0, 8.0, 2.0, 1.0, 0.75, 0.5, 0.25, 0.125), "turns"),
    Axis("background noise", "noise", (0.0, 0.1, 0.25, 0.5, 0.65, 0.8), "of all events"),
    Axis("hot pixels", "hot", (0.0, 0.0002, 0.001, 0.005, 0.02, 0.05), "of all pixels"),
    Axis("threshold", "contrast", (0.1, 0.15, 0.25, 0.4, 0.6, 1.0), "log intensity"),
    Axis("threshold mismatch", "mismatch", (0.0, 0.03, 0.1, 0.2, 0.3), "relative"),
    Axis("latency", "latency_us", (0.0, 100.0, 300.0, 1000.0, 3000.0), "µs"),
    Axis("refractory time", "refractory_us", (0.0, 100.0, 1000.0, 3000.0, 10_000.0), "µs"),
    Axis("readout in scans", "readout_us", (0.0, 200.0, 500.0, 1000.0, 2000.0), "µs"),
    Axis("bandwidth", "cutoff_hz", (3000.0, 1000.0, 300.0, 100.0, 30.0), "Hz at white"),
    Axis("bus rate", "bus_rate_mev_s", (10.0, 3.0, 1.0, 0.3, 0.1), "million events/s"),
    Axis("encoder resolution", "counts_per_turn", (8192, 1024, 256, 64, 16, 4), "counts a turn"),
    Axis("encoder jitter", "jitter_deg", (0.0, 0.1, 0.5, 2.0, 5.0, 20.0), "°"),
    Axis("clock offset", "clock_offset_us", (0.0, 100.0, 1000.0, 5000.0, 20_000.0), "µs", (("ripple", 0.05),)),
    Axis("encoder drop-outs", "dropouts_hz", (0.0, 3.0, 10.0, 30.0, 100.0), "of 5 ms, a second"),
    Axis("slipping index", "slip_deg", (0.0, 1.0, 5.0, 20.0, 90.0), "° a second"),
    Axis("direction", "backwards", (False, True)),
    Axis("speed", "rpm", (60.0, 180.0, 720.0, 1800.0, 3600.0, 6000.0), "rpm"),
    Axis("speed ripple", "ripple", (0.0, 0.01, 0.05, 0.2, 0.5), "relative"),
    Axis("apex", "apex_deg", (4.0, 2.0, 1.0, 0.5, 0.25), "°"),
    Axis("field of view", "fov_deg", (30.0, 45.0, 60.0, 80.0, 100.0), "°"),
    Axis("flat side", "flat_side_wrong", (False, True)),
    Axis("focal length", "focal_error", (0.0, 0.01, 0.03, 0.1, 0.3), "relative error"),
    Axis("distortion ignored", "distortion", (0.0, -0.03, -0.1, -0.2), "k1"),
    Axis("start", "start", ("none", "right", "wrong")),
    Axis("scene", "scene", SCENES),
    Axis("flickering lamp", "lamp", (0.0, 0.01, 0.05, 0.2, 0.6), "of the picture"),
    Axis("camera turning", "camera_deg_s", (0.0, 1.0, 3.0, 10.0, 30.0, 60.0), "°/s"),
    Axis("passing object", "passing", (0.0, 0.02, 0.1, 0.3, 0.6), "of the picture"),
    Axis("motion cancelled", "cancelled", (0.0, 0.3, 0.6, 0.9, 1.0), "of the prism's"),
    Axis("encoder scale", "encoder_scale", (0.0, 1e-4, 1e-3, 0.01, 0.1), "relative error"),
    Axis("principal point", "principal_px", (0.0, 2.0, 5.0, 10.0, 20.0), "px"),
    Axis("small orbit", "scene", SCENES, "apex 0.5°", (("apex_deg", 0.5),)),
    Axis("events, sparse edges", "window_events", (0, 50_000, 20_000, 10_000), "", (("scene", SceneKind.EDGES.value),)),
    Axis("thin lines and noise", "noise", (0.0, 0.1, 0.2, 0.35), "of all events",
         (("scene", SceneKind.LINES.value),)),
    Axis("focal length, wide", "focal_error", (0.0, 0.01, 0.03, 0.1, 0.3, 0.73), "relative error, 90°, apex 2°", WIDE),
    Axis("principal point, wide", "principal_px", (0.0, 2.0, 5.0, 10.0, 20.0), "px, 90°, apex 2°", WIDE),
    Axis("distortion ignored, wide", "distortion", (0.0, -0.03, -0.08, -0.15), "k1, 90°, apex 2°", WIDE),
    Axis("flat side, wide", "flat_side_wrong", (False, True), "90°, apex 2°", WIDE),
    Axis("encoder off centre", "eccentric_deg", (0.0, 0.3, 1.0, 3.0, 10.0), "°, once a turn"),
    Axis("encoder, second harmonic", "second_deg", (0.0, 0.1, 0.3, 1.0, 3.0), "°, twice a turn"),
    Axis("speed ripple, index pulse only", "turn_ripple", (0.0, 0.01, 0.03, 0.1, 0.3), "relative, once a turn",
         (("index_only", True),)),
    Axis("ramp without encoder", "ramp", (0.0, 0.1, 0.3, 0.6, 1.0), "of the speed, up to 8 turns",
         (("no_encoder", True), ("turns", 8.0))),
    Axis("cylinder power", "cylinder_deg", (0.0, 0.01, 0.03, 0.1, 0.3), "° of apex over the image"),
    Axis("wobble", "wobble_deg", (0.0, 0.1, 0.5, 2.0, 5.0), "°"),
    Axis("column skew", "column_us", (0.0, 0.3, 1.0, 5.0, 20.0), "µs from column to column"),
    Axis("row skew", "line_us", (0.0, 0.3, 1.0, 5.0, 20.0), "µs from row to row"),
    Axis("readout of row after row", "row_us", (0.0, 1.0, 4.0, 20.0), "µs a row"),
    Axis("fy / fx", "aspect_error", (0.0, 0.003, 0.01, 0.03, 0.1), "relative error"),
    Axis("refractive index, wide", "index_error", (0.0, 0.01, 0.03, 0.06, 0.2), "error, 90°, apex 2°", WIDE),
    Axis("events lost in a part of the turn", "lost_part", (0.0, 0.1, 0.2, 0.4, 0.6, 0.8), "of the turn"),
    Axis("focal length and distortion", "focal_error", (0.01, 0.03, 0.1), "relative error, k1 −0.05",
         (("distortion", -0.05),)),
    Axis("principal point and distortion", "principal_px", (2.0, 5.0, 10.0), "px, k1 −0.05", (("distortion", -0.05),)),
    Axis("focal length and flat side", "focal_error", (0.01, 0.03, 0.1), "relative error, wrong side",
         (("flat_side_wrong", True),)),
    Axis("focal length, camera turning", "camera_deg_s", (1.0, 10.0, 30.0), "°/s, focal length 3 % off",
         (("focal_error", 0.03),)),
    Axis("bandwidth and noise", "cutoff_hz", (1000.0, 300.0, 100.0), "Hz at white, 25 % noise", (("noise", 0.25),)),
    Axis("bandwidth and refractory time", "cutoff_hz", (1000.0, 300.0, 100.0), "Hz at white, 1 ms",
         (("refractory_us", 1000.0),)),
    Axis("events lost and noise", "lost", (0.1, 0.3, 0.5), "of all events, 25 % noise", (("noise", 0.25),)),
    Axis("small orbit, few events", "window_events", (100_000, 50_000, 20_000), "apex 0.5°", (("apex_deg", 0.5),)),
)  # fmt: skip
"""All axes of the stability study. The last :data:`COMBINED` combine two troubles that are likely to occur together."""

TURNING = ("wedge", "pair", "plate")
"""Optics that a motor turns, and whose angles encoders read."""

PULSES = (("index_only", True),)
"""Condition in which encoders give but an index pulse per turn."""

AT_10_HZ = (*PULSES, ("hunt_hz", 10.0))
"""Condition in which the speed may swing between index pulses, at a given frequency."""

BY_3_PERCENT = (*PULSES, ("hunt", 0.03))
"""Condition in which the speed swings between index pulses, by a given share."""


@dataclass(frozen=True)
class OpticTrouble:
    """Trouble of some optics: an axis of the study for each of them."""

    axis: Axis
    """The axis, without the optic."""
    optics: tuple[str, ...] = optics.OPTICS
    """Optics that may have the trouble."""

    def axis_of(self, optic: str) -> Axis:
        """Return the axis of an optic."""
        also = (("optic", optic), *self.axis.also)
        return replace(self.axis, name=f"{optic}: {self.axis.name}", also=also)


OPTIC_TROUBLES = (
    OpticTrouble(Axis("background noise", "noise", (0.0, 0.1, 0.25, 0.5, 0.65), "of all events")),
    OpticTrouble(Axis("events", "window_events", (0, 100_000, 50_000, 20_000, 10_000))),
    OpticTrouble(Axis("threshold", "contrast", (0.15, 0.25, 0.4, 0.6, 1.0), "log intensity")),
    OpticTrouble(Axis("field of view", "fov_deg", (30.0, 45.0, 60.0, 80.0, 100.0), "°")),
    OpticTrouble(Axis("camera turning", "camera_deg_s", (0.0, 1.0, 3.0, 10.0, 30.0), "°/s")),
    OpticTrouble(Axis("distortion ignored", "distortion", (0.0, -0.03, -0.08, -0.15), "k1")),
    OpticTrouble(
        Axis("encoder off centre", "eccentric_deg", (0.0, 0.3, 1.0, 3.0, 10.0), "°, once a turn"),
        TURNING,
    ),
    OpticTrouble(
        Axis("encoder, second harmonic", "second_deg", (0.0, 0.3, 1.0, 3.0), "°, twice a turn"),
        TURNING,
    ),
    OpticTrouble(
        Axis("encoder, third harmonic", "third_deg", (0.0, 0.2, 0.5, 1.5), "°, three times a turn"),
        TURNING,
    ),
    OpticTrouble(
        Axis("counts lost once", "lost_once_deg", (0.0, 1.0, 3.0, 9.0, 30.0), "°"), TURNING
    ),
    OpticTrouble(
        Axis("jitter of index pulses", "index_jitter_us", (0.0, 50.0, 200.0, 1000.0), "µs", PULSES),
        TURNING,
    ),
    OpticTrouble(
        Axis(
            "hunting speed, index pulses",
            "hunt",
            (0.0, 0.01, 0.03, 0.1),
            "relative, 10 Hz",
            AT_10_HZ,
        ),
        TURNING,
    ),
    OpticTrouble(
        Axis(
            "frequency of hunting, index pulses",
            "hunt_hz",
            (3.0, 10.0, 20.0, 50.0),
            "Hz, 3 %",
            BY_3_PERCENT,
        ),
        TURNING,
    ),
    OpticTrouble(Axis("encoders swapped", "swapped", (False, True)), ("pair",)),
    OpticTrouble(
        Axis("cubic command", "command_cubic", (0.0, 0.03, 0.1, 0.2), "relative"), ("mirror",)
    ),
    OpticTrouble(
        Axis("quadratic command", "command_square", (0.0, 0.02, 0.05, 0.1), "relative"), ("mirror",)
    ),
    OpticTrouble(Axis("third harmonic", "third_px", (0.0, 0.1, 0.25, 0.5), "px"), ("vibration",)),
    OpticTrouble(
        Axis("unsteady amplitude", "unsteady", (0.0, 0.05, 0.15, 0.3), "relative"), ("vibration",)
    ),
    OpticTrouble(
        Axis("faces not parallel", "plate_wedge_arcmin", (0.0, 0.5, 2.0, 5.0), "arcmin"), ("plate",)
    ),
)
"""Troubles of every optic. All conditions have the same sensible values, see :func:`sensible`."""

OPTIC_AXES = tuple(
    trouble.axis_of(optic)
    for optic in optics.OPTICS
    for trouble in OPTIC_TROUBLES
    if optic in trouble.optics
)
"""Axes of every optic."""


SLOW_AXES = ("many events", "encoder, second harmonic", "row skew", "readout of row after row")
"""Names of the axes of one trouble that a quick run leaves out."""


def quick_axes() -> tuple[Axis, ...]:
    """Return axes of one trouble with at most three values, both ends and the middle: what runs within ten minutes."""
    quick = []
    for axis in AXES[:-COMBINED]:
        if axis.name in SLOW_AXES:
            continue
        values = axis.values
        three = (values[0], values[len(values) // 2], values[-1])
        different = tuple(dict.fromkeys(three))
        quick.append(replace(axis, values=different))
    return tuple(quick)


def conditions(axes: Sequence[Axis]) -> list[Condition]:
    """Return every condition of the axes once; all axes share the condition with default values."""
    return list(dict.fromkeys(c for axis in axes for c in axis.conditions()))
