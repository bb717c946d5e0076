"""What is free in a calibration: parameters by name, their bounds and units, and the vector that NLopt moves.

The vector is in pixels: one unit of any entry moves events by about one pixel (rms over image and turn), so that one
tolerance and one first step serve all. Size and phase together become Cartesian (size·cos, size·sin) where the phase
is free over the full turn: no wrap-around, no second optimum at (−size, phase + π), even resolution.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, cast

import numpy as np

from amiwarp.errors import AmiwarpError
from amiwarp.optics.camera_rotation import CameraRotation
from amiwarp.optics.models import MODELS, CircleModel, EllipseModel, ExactModel, RadialCircleModel, deflection_from_apex
from amiwarp.optics.prism import Prism, UnsizedPrism
from amiwarp.validation import instance, one_of, real, shown, vector

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.optics.camera import Camera
    from amiwarp.optics.models import Model
    from amiwarp.optics.prism import NominalPrism

NOMINAL_APEX = math.radians(2.0)
"""What is assumed where a recording does not say its prism's apex: the apex is sought up to twice this."""
UNITS = {
    "apex": "rad",
    "deflection": "rad",
    "phase": "rad",
    "clock_offset": "us",
    "rpm": "1/min",
    "tilt_x": "rad",
    "tilt_y": "rad",
    "index": "1",
    "focal_length": "px",
    "rate_x": "rad/s",
    "rate_y": "rad/s",
    "rate_z": "rad/s",
    "change_x": "rad/s2",
    "change_y": "rad/s2",
    "change_z": "rad/s2",
}
"""Every parameter that can be free, with its unit. ``clock_offset`` is added to the encoder's (see Encoder);
``focal_length`` is the camera's fx, fy keeping its ratio; ``rate`` and ``change`` are the camera's :class:`Turning`."""

DRIFTS = ("clock_offset", "rpm")
RATES = ("rate_x", "rate_y", "rate_z")
CHANGES = ("change_x", "change_y", "change_z")
MOTION = (*RATES, *CHANGES)
LATE = ("index", "focal_length")
"""They and the apex make nearly the same motion: sharpness is not asked where the photometric stage can be."""
_EXACT_ONLY = ("tilt_x", "tilt_y", "index")
_DEFAULT_RANGE = {
    "tilt_x": math.radians(5.0), "tilt_y": math.radians(5.0), "clock_offset": 5000.0, "index": 0.2,
    **dict.fromkeys(RATES, 5.0), **dict.fromkeys(CHANGES, 50.0),
}  # fmt: skip
"""Half width of the default bounds about the start."""
TURN = (-math.pi, math.pi)


@dataclass(frozen=True)
class ParameterSpace:
    """Free parameters of one model of one camera: names, bounds, start, and the way to the vector and back."""

    model: str
    camera: Camera
    prism: Prism
    names: tuple[str, ...]
    low: Mapping[str, float]
    high: Mapping[str, float]
    start: Mapping[str, float]
    """All parameters of the model, the free ones' start included."""
    pixels: Mapping[str, float]
    """Motion of events [px rms] per unit of each free parameter."""
    middle_us: int
    """Time to which a turning camera is turned back."""
    duration_us: float
    undrifted: Mapping[str, float]
    """Values of the drifting parameters under which events have the angles that they were given."""

    @property
    def size_name(self) -> str:
        return size_name(self.model)

    @property
    def cartesian(self) -> bool:
        """Whether the first two entries are (size·cos phase, size·sin phase)."""
        full = self.high.get("phase", 0.0) - self.low.get("phase", 0.0) >= 2.0 * math.pi - 1e-9
        return self.names[:2] == (self.size_name, "phase") and full

    @property
    def sized(self) -> bool:
        """Whether a prism is sought, and not only the camera's motion."""
        return self.size_name in self.names

    @property
    def moving(self) -> bool:
        """Whether the camera's motion is sought or given."""
        return any(self.start.get(n) or n in self.names for n in MOTION)

    def without(self, names: tuple[str, ...]) -> ParameterSpace:
        """The space in which ``names`` are held at their start."""
        return replace(self, names=tuple(n for n in self.names if n not in names))

    def holding(self, values: Mapping[str, float]) -> ParameterSpace:
        """The same with another start."""
        return replace(self, start={**self.start, **values})

    def bounds(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Lower and upper corner of the box in which the vector moves [px]."""
        low = np.array([self.low[n] * self.pixels[n] for n in self.names])
        high = np.array([self.high[n] * self.pixels[n] for n in self.names])
        if self.cartesian:
            high[1] = high[0]
            low[:2] = -high[:2]
        return low, high

    def to_vector(self, values: Mapping[str, float]) -> NDArray[np.float64]:
        v = np.array([values[n] * self.pixels[n] for n in self.names])
        if self.cartesian:
            v[:2] = v[0] * math.cos(values["phase"]), v[0] * math.sin(values["phase"])
        return v

    def to_values(self, v: NDArray[np.float64]) -> dict[str, float]:
        """All parameters of the model at ``v``; a size outside its bounds is held at the nearer one."""
        values = dict(self.start)
        for name, entry in zip(self.names, v, strict=True):
            values[name] = float(entry) / self.pixels[name]
        if self.cartesian:
            values[self.size_name] = math.hypot(v[0], v[1]) / self.pixels[self.size_name]
            values["phase"] = math.atan2(v[1], v[0])
        for name in self.names:
            values[name] = min(max(values[name], self.low[name]), self.high[name])
        return values

    def deviations(self, v: NDArray[np.float64], covariance: NDArray[np.float64]) -> dict[str, float]:
        """Standard deviations of the free parameters at ``v`` from the vector's covariance [px²]."""
        jacobian = np.empty((len(self.names), len(self.names)))
        for k in range(len(self.names)):
            h = np.zeros(len(self.names))
            h[k] = 1e-3
            up, down = self.to_values(v + h), self.to_values(v - h)
            jacobian[:, k] = [_difference(n, up[n], down[n]) / 2e-3 for n in self.names]
        variances = np.diag(jacobian @ covariance @ jacobian.T)
        return {n: float(math.sqrt(max(s, 0.0))) for n, s in zip(self.names, variances, strict=True)}

    def build(self, values: Mapping[str, float]) -> Model:
        return build_model(self.model, self.camera, self.prism, values)

    def camera_rotation(self, values: Mapping[str, float]) -> CameraRotation:
        return turning_of(values, self.middle_us)

    def drift(self, values: Mapping[str, float]) -> float:
        """Distance of the drifting parameter, free or held, from where the events' angles belong to it."""
        return float(sum((values if n in self.names else self.start)[n] - x for n, x in self.undrifted.items()))


def check_names(
    free: tuple[str, ...] | None, start: Mapping[str, float], bounds: Mapping[str, tuple[float, float]]
) -> None:
    """Raise :class:`AmiwarpError` where the names are no texts or their values no finite numbers."""
    for name in free or ():
        instance(name, str, "free parameter")
    for given, what in ((start, "start"), (bounds, "bounds")):
        if not isinstance(given, Mapping) or not all(isinstance(name, str) for name in given):
            raise AmiwarpError(f"{what} is {shown(given)}; expected values by parameter name")
    for name, value in start.items():
        real(value, f"start of {name}")
    for name, pair in bounds.items():
        vector(pair, 2, f"bounds of {name}", real)


def nominal(prism: NominalPrism | None) -> Prism:
    """Return the prism to start from: what a recording says, and of its apex :data:`NOMINAL_APEX` if it is unknown."""
    return prism if isinstance(prism, Prism) else (prism or UnsizedPrism()).with_apex(NOMINAL_APEX)


def _difference(name: str, a: float, b: float) -> float:
    return math.remainder(a - b, 2.0 * math.pi) if name == "phase" else a - b


def size_name(model: str) -> str:
    """The name of the parameter that sizes the orbit in ``model``: its apex, or its deflection."""
    return "apex" if model in ("exact", "ellipse") else "deflection"


def turning_of(values: Mapping[str, float], middle_us: int) -> CameraRotation:
    """The camera's motion among parameter values; none where they do not name it."""
    x, y, z = (values.get(n, 0.0) for n in RATES)
    a, b, c = (values.get(n, 0.0) for n in CHANGES)
    return CameraRotation((x, y, z), (a, b, c), middle_us)


def build_model(model: str, camera: Camera, prism: Prism, values: Mapping[str, float]) -> Model:
    """A model of the ladder from parameter values; what they do not name comes from ``camera`` and ``prism``."""
    one_of(model, MODELS, "model")
    if "focal_length" in values:
        scale = values["focal_length"] / camera.fx
        camera = replace(camera, fx=values["focal_length"], fy=camera.fy * scale)
    if model == "circle":
        return CircleModel(camera, values["deflection"], values["phase"], prism.flat_side)
    if model == "radial":
        return RadialCircleModel(camera, values["deflection"], values["phase"], prism.index, prism.flat_side)
    wedge = replace(prism, apex=values["apex"], index=values.get("index", prism.index))
    exact = ExactModel(camera, wedge, values["phase"], (values.get("tilt_x", 0.0), values.get("tilt_y", 0.0)))
    return EllipseModel.from_model(exact) if model == "ellipse" else exact


def make_space(
    model: str,
    camera: Camera,
    prism: Prism,
    *,
    free: tuple[str, ...] | None,
    start: Mapping[str, float],
    bounds: Mapping[str, tuple[float, float]],
    rad_per_us: float,
    duration_us: float,
    middle_us: int = 0,
) -> ParameterSpace:
    """Checks names and bounds and measures how far each parameter moves events.

    ``prism`` is the nominal one: the size may go from 0 to twice its apex unless ``bounds`` say otherwise.
    ``rad_per_us``: mean speed of the prism; ``duration_us``: of the events, about ``middle_us``.

    Raises :class:`AmiwarpError` for unknown,
    unfit or contradicting names.
    """
    size = size_name(model)
    names = _order(model, (size, "phase") if free is None else free)
    _check_given(model, names, start, bounds)
    nominal = {
        "apex": prism.apex, "deflection": prism.deflection, "phase": 0.0, "index": prism.index,
        "focal_length": camera.fx,
    }  # fmt: skip
    values = {n: start.get(n, nominal.get(n, 0.0)) for n in (size, "phase", *names, *start)}
    low, high = {}, {}
    for name in names:
        low[name], high[name] = bounds.get(name) or _default_bounds(name, values[name], prism)
        if not low[name] < high[name]:
            raise AmiwarpError(f"bounds of {name} are {low[name]:.6g} .. {high[name]:.6g}; give the lower first")
        values[name] = min(max(values[name], low[name]), high[name])
    shifts = _pixels_per_unit(model, camera, prism, names, values, rad_per_us, duration_us)
    undrifted = {n: x for n, x in values.items() if n in DRIFTS}
    return ParameterSpace(model, camera, prism, names, low, high, values, shifts, middle_us, duration_us, undrifted)


def _order(model: str, free: tuple[str, ...]) -> tuple[str, ...]:
    size = size_name(model)
    wanted = {size if n in ("apex", "deflection") else n for n in free if n != "motion"}
    wanted |= set(RATES if "motion" in free else ())
    unknown = wanted - set(UNITS)
    if unknown:
        raise AmiwarpError(f"free parameter {sorted(unknown)[0]!r} is unknown; choose among {', '.join(UNITS)}")
    if not wanted:
        raise AmiwarpError("no parameter is free; name at least one")
    if model in ("circle", "radial") and wanted & set(_EXACT_ONLY):
        raise AmiwarpError(f"the {model} model has no {sorted(wanted & set(_EXACT_ONLY))[0]}; use model 'exact'")
    if set(DRIFTS) <= wanted:
        raise AmiwarpError("clock_offset and rpm cannot both be free: rpm is for recordings without an encoder")
    return tuple(n for n in (size, "phase", *DRIFTS, *_EXACT_ONLY, "focal_length", *MOTION) if n in wanted)


def _check_given(
    model: str, names: tuple[str, ...], start: Mapping[str, float], bounds: Mapping[str, tuple[float, float]]
) -> None:
    """Nothing that is given is left out without a word."""
    exact = () if model in ("circle", "radial") else _EXACT_ONLY
    known = (size_name(model), "phase", *DRIFTS, *exact, "focal_length", *MOTION)
    for name in start:
        if name not in known:
            raise AmiwarpError(f"start gives {name}, which the {model} model has not; it has {', '.join(known)}")
    for name in bounds:
        if name not in names:
            raise AmiwarpError(f"bounds of {name} are given, which is not free; name it in free too")


def _default_bounds(name: str, value: float, prism: Prism) -> tuple[float, float]:
    if name == "apex":
        return 0.0, 2.0 * prism.apex
    if name == "deflection":
        return 0.0, deflection_from_apex(2.0 * prism.apex, prism.index, prism.flat_side)
    if name == "phase":
        return TURN
    share = {"rpm": 0.02, "focal_length": 0.2}
    half = share[name] * abs(value) if name in share else _DEFAULT_RANGE[name]
    return value - half, value + half


def _pixels_per_unit(
    model: str,
    camera: Camera,
    prism: Prism,
    names: tuple[str, ...],
    values: Mapping[str, float],
    rad_per_us: float,
    duration_us: float,
) -> dict[str, float]:
    """Finite differences of the displacement over a grid of pixels and angles, at the nominal size."""
    nominal = {**values, "apex": prism.apex, "deflection": prism.deflection}
    x, y, theta = (
        m.ravel()
        for m in np.meshgrid(
            np.linspace(0, camera.width - 1, 8), np.linspace(0, camera.height - 1, 6), np.arange(8) * (np.pi / 4),
            indexing="ij",
        )
    )  # fmt: skip
    xy = np.stack([x, y], axis=1)
    kind = "exact" if model == "ellipse" else model  # its tables follow the exact model

    def at(name: str, step: float) -> NDArray[np.float64]:
        built = build_model(kind, camera, prism, {**nominal, name: nominal[name] + step})
        return cast("NDArray[np.float64]", built.compensate_points(xy, theta))

    def rms(name: str, step: float) -> float:
        moved = (at(name, step) - at(name, -step)) / (2.0 * step)
        moved = moved[np.isfinite(moved).all(axis=1)]
        return float(np.sqrt(np.mean(np.sum(moved**2, axis=1))))

    size = size_name(model)
    steps = {size: 0.25 * nominal[size], "phase": 0.05, **dict.fromkeys(_EXACT_ONLY, 0.02)}
    shifts = {name: rms(name, step) for name, step in steps.items() if name in names}
    if set(DRIFTS) & set(names):
        phase = rms("phase", 0.05)
        shifts["clock_offset"] = phase * abs(rad_per_us)
        shifts["rpm"] = phase * 2.0 * math.pi / 60e6 * duration_us / math.sqrt(12.0)
    seconds = duration_us * 1e-6
    radius = math.sqrt((camera.width**2 + camera.height**2) / 12.0)
    for name, lever in zip(MOTION, (camera.fy, camera.fx, radius) * 2, strict=True):
        # standard deviation of τ, and of τ²/2, over a window
        shifts[name] = (
            lever * seconds * (seconds * math.sqrt(1.0 / 720.0) if name in CHANGES else math.sqrt(1.0 / 12.0))
        )
    # what a camera that turns at half a radian a second would show of it
    if "focal_length" in names:
        shifts["focal_length"] = max(rms("focal_length", 0.01 * camera.fx), 0.5 * seconds / math.sqrt(12.0))
    if not all(math.isfinite(shifts[n]) and shifts[n] > 0.0 for n in names):
        raise AmiwarpError("the nominal prism moves no event; give its nominal apex (above 0) and the encoder's speed")
    return {n: shifts[n] for n in names}
