"""Free parameters of a calibration: their names, bounds and units, and the vector that the optimiser moves.

The vector is in pixels: one unit of any entry moves events by about one pixel (rms over image and turn). One tolerance
and one first step then fit every parameter. If the phase is free over the full turn, size and phase become Cartesian,
(size·cos phase, size·sin phase): no wrap-around, no second optimum at (−size, phase + π), even resolution.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.recording import Recording
from amiwarp.optics import mirror, models, vibration  # noqa: F401  # models in files of their own, which enter themselves in MODELS
from amiwarp.optics.camera import LENS, Camera, CameraRotation, given_lens
from amiwarp.optics.prism import NominalPrism, Plate, Prism, UnsizedPrism, as_wedge
from amiwarp.validation import finite, guarded, instance, one_of, real, shown, vector

NOMINAL_APEX = math.radians(2.0)
"""Apex angle assumed if a recording does not give it [rad]. The search goes up to twice this value."""
DRIFTS = ("clock_offset", "rpm")
"""Parameters that shift the prism angle of each event by an amount that depends on the event's time."""
RATES = ("rate_x", "rate_y", "rate_z")
"""Angular velocity of the camera about its x, y and z axes: names of the parameters."""
CHANGES = ("change_x", "change_y", "change_z")
"""Angular acceleration of the camera about its x, y and z axes: names of the parameters."""
GROWTH = "growth"
"""Growth of the image of a camera that moves forward: name of the parameter."""
MOTION = (*RATES, *CHANGES, GROWTH)
"""Names of all parameters of the camera's motion."""
LINEAR_UNKNOWNS = ("off_ratio", "leak")
"""Free parameters that only the photometric stage has: unknowns of its linear equations."""
_UNITS = {
    "clock_offset": "us",
    "rpm": "1/min",
    "focal_length": "px",
    **dict.fromkeys(RATES, "rad/s"),
    **dict.fromkeys(CHANGES, "rad/s2"),
    GROWTH: "1/s",
}
"""Unit of every parameter that can be free and is not one of an optical model.

``clock_offset`` is the encoder's clock offset (see :class:`amiwarp.Encoder`). ``focal_length`` is the camera's fx; fy
keeps its ratio to fx. ``rate_*``, ``change_*`` and ``growth`` describe the camera's motion
(:class:`amiwarp.CameraRotation`).
"""


def optical_parameters() -> dict[str, models.Parameter]:
    """Return the parameters of all optical models by name: sizes, phase, then others."""
    found = {parameter.name: parameter for model in models.MODELS.values() for parameter in model.PARAMETERS}
    return {name: found[name] for name in (*sorted(models.size_names()), models.PHASE.name, *found)}


def units() -> dict[str, str]:
    """Return the unit of every parameter that can be free, by name."""
    return {name: parameter.unit for name, parameter in optical_parameters().items()} | _UNITS


def of_orbit(space: ParameterSpace, k: int, at: Mapping[str, float]) -> ParameterSpace:
    """Return the space of the ``k``-th prism's size and phase.

    Prisms before it have the values ``at``, later ones the size 0 if theirs is free.
    """
    kind = models.MODELS[space.model]
    later = {size: 0.0 for size, _ in kind.ORBITS[k + 1 :] if size in space.names}
    return space.holding({**at, **later}).without(tuple({*space.names} - {*kind.TOGETHER[k]}))


def phase_names() -> set[str]:
    """Return the names of the parameters that are the phase of a prism."""
    return {phase for model in models.MODELS.values() for _, phase in model.ORBITS}


def orbit_names(kind: type[models.Model]) -> tuple[str, ...]:
    """Return the names of size and phase of each prism."""
    return tuple(name for orbit in kind.ORBITS for name in orbit)


def like_size(names: Iterable[str]) -> tuple[str, ...]:
    """Return those parameters that in sharpness are nearly degenerate with the size: of the lens, and some of a model.

    The sharpness stage does not search them if the photometric stage follows.
    """
    known = optical_parameters()
    return tuple(n for n in names if n in LENS or (n in known and known[n].like_size))


@guarded
@dataclass(frozen=True, kw_only=True)
class ParameterSpace:
    """Free parameters of one model: names, bounds and start, and their conversion to and from the search vector.

    The search vector has one entry per free parameter, in pixels: one unit of an entry moves events by about one pixel
    (rms over image and turn).
    """

    model: str
    """Name of the model, such as ``exact``."""
    camera: Camera
    """Nominal camera. If the focal length is free, its value replaces the camera's focal length."""
    prism: Prism | Plate
    """Nominal prism or plate. It gives the flat side, and the index if that is not free."""
    names: tuple[str, ...]
    """Names of the free parameters, in the order of the vector."""
    low: Mapping[str, float]
    """Lower bound of each free parameter, in its unit."""
    high: Mapping[str, float]
    """Upper bound of each free parameter, in its unit."""
    start: Mapping[str, float]
    """Values of all parameters of the model, in their units. The search starts at the values of the free parameters."""
    pixels: Mapping[str, float]
    """Displacement of events per unit of each free parameter [px rms]."""
    middle_us: int
    """Reference time of the camera's rotation [us]: events are rotated back to the camera's orientation at this time.
    """
    duration_us: float
    """Duration of the events [us]."""
    undrifted: Mapping[str, float]
    """Values of ``clock_offset`` or ``rpm``, in their units, for which the prism angles stored with the events hold."""

    @property
    def size_name(self) -> str:
        """Name of the parameter that sets the size of the orbit: ``apex`` or ``deflection``."""
        return models.MODELS[one_of(self.model, models.MODELS, "model")].SIZE

    @property
    def cartesian(self) -> bool:
        """Whether the vector's first two entries are (size·cos phase, size·sin phase)."""
        return 0 in self.orbits

    @cached_property
    def orbits(self) -> tuple[int, ...]:
        """Indices of the vector's entries that are (size·cos phase, size·sin phase), with the next entry."""
        found, orbits = [], models.MODELS[one_of(self.model, models.MODELS, "model")].ORBITS
        for size, phase in orbits:
            full = self.high.get(phase, 0.0) - self.low.get(phase, 0.0) >= 2.0 * math.pi - 1e-9
            if full and size in self.names and phase in self.names:
                found.append(self.names.index(size))
        return tuple(k for k in found if self.names[k : k + 2] in orbits)

    @property
    def sized(self) -> bool:
        """Whether the size of the prism's orbit is free."""
        return self.size_name in self.names

    @property
    def moving(self) -> bool:
        """Whether the camera's rotation is free, or given and not zero."""
        return any(self.start.get(n) or n in self.names for n in MOTION)

    def without(self, names: tuple[str, ...]) -> ParameterSpace:
        """Return the parameter space with some parameters fixed at their start values.

        Parameters
        ----------
        names : tuple of str
            Names of the parameters to fix.

        Returns
        -------
        ParameterSpace
            The space without these free parameters.
        """
        return replace(self, names=tuple(n for n in self.names if n not in names))

    def holding(self, values: Mapping[str, float]) -> ParameterSpace:
        """Return the parameter space with other start values.

        Parameters
        ----------
        values : mapping of str to float
            New start by parameter name, in the parameters' units. Other parameters keep theirs.

        Returns
        -------
        ParameterSpace
            The space with the new start.
        """
        return replace(self, start={**self.start, **values})

    def bounds(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the corners of the box in which the vector may move.

        Returns
        -------
        low : ndarray
            Lower corner [px], shape ``(n,)`` for n free parameters.
        high : ndarray
            Upper corner [px], shape ``(n,)``.
        """
        low = np.array([self.low[n] * self.pixels[n] for n in self.names])
        high = np.array([self.high[n] * self.pixels[n] for n in self.names])
        for k in self.orbits:
            high[k + 1] = high[k]
            low[k : k + 2] = -high[k : k + 2]
        return low, high

    def to_vector(self, values: Mapping[str, float]) -> NDArray[np.float64]:
        """Return the search vector of parameter values.

        Parameters
        ----------
        values : mapping of str to float
            Value of every free parameter, in its unit.

        Returns
        -------
        ndarray
            The vector [px], shape ``(n,)`` for n free parameters.
        """
        models.check_given(values, self.names)
        v = np.array([values[n] * self.pixels[n] for n in self.names])
        for k in self.orbits:
            phase = values[self.names[k + 1]]
            v[k : k + 2] = v[k] * math.cos(phase), v[k] * math.sin(phase)
        return v

    def to_values(self, v: NDArray[np.float64]) -> dict[str, float]:
        """Return the parameter values that a search vector stands for.

        Parameters
        ----------
        v : ndarray
            The vector [px], shape ``(n,)`` for n free parameters.

        Returns
        -------
        dict
            Values of all parameters of the model, in their units. A value outside its bounds is moved to the nearer
            bound.
        """
        if v.shape != (len(self.names),):
            raise AmiwarpError(f"v has shape {v.shape}; give one entry for each of {', '.join(self.names)}")
        finite(v, "entries of the search vector")
        values, entries = dict(self.start), v.tolist()
        for name, entry in zip(self.names, entries, strict=True):
            values[name] = entry / self.pixels[name]
        for k in self.orbits:
            x, y, (size, phase) = entries[k], entries[k + 1], self.names[k : k + 2]
            values[size], values[phase] = math.hypot(x, y) / self.pixels[size], math.atan2(y, x)
        for name in self.names:
            values[name] = min(max(values[name], self.low[name]), self.high[name])
        return values

    def deviations(self, v: NDArray[np.float64], covariance: NDArray[np.float64]) -> dict[str, float]:
        """Convert the covariance of the search vector to standard deviations of the free parameters.

        Parameters
        ----------
        v : ndarray
            The vector [px] at which the covariance holds, shape ``(n,)`` for n free parameters.
        covariance : ndarray
            Covariance of the vector [px²], shape ``(n, n)``.

        Returns
        -------
        dict
            Standard deviation of each free parameter, in its unit.

        Notes
        -----
        The covariance is propagated to first order, J C Jᵀ, with the Jacobian J of the values by central differences.
        """
        if covariance.shape != (len(self.names), len(self.names)):
            raise AmiwarpError(f"covariance has shape {covariance.shape}; give {(len(self.names), len(self.names))}")
        finite(covariance, "entries of the covariance")
        jacobian = np.empty((len(self.names), len(self.names)))
        for k in range(len(self.names)):
            h = np.zeros(len(self.names))
            h[k] = 1e-3
            up, down = self.to_values(v + h), self.to_values(v - h)
            jacobian[:, k] = [_difference(n, up[n], down[n]) / 2e-3 for n in self.names]
        variances = np.diag(jacobian @ covariance @ jacobian.T)
        return {n: float(math.sqrt(max(s, 0.0))) for n, s in zip(self.names, variances, strict=True)}

    def build(self, values: Mapping[str, float]) -> models.Model:
        """Build the optical model that has the given parameter values.

        Parameters
        ----------
        values : mapping of str to float
            Values of all parameters of the model, in their units.

        Returns
        -------
        Model
            The model.
        """
        return models.build_model(self.model, self.camera, self.prism, values)

    def camera_rotation(self, values: Mapping[str, float]) -> CameraRotation:
        """Return the camera rotation that the parameter values describe.

        Parameters
        ----------
        values : mapping of str to float
            Parameter values, in their units. A missing rate counts as 0.

        Returns
        -------
        CameraRotation
            The rotation about the time ``middle_us``.
        """
        return rotation_from_values(values, self.middle_us)

    def drift(self, values: Mapping[str, float]) -> float:
        """Return the change of ``clock_offset`` or ``rpm`` since the events got their prism angles.

        Parameters
        ----------
        values : mapping of str to float
            Values of the free parameters, in their units. A parameter that is not free counts at its start.

        Returns
        -------
        float
            Difference from ``undrifted``, in the parameter's unit; 0 if neither parameter is used.
        """
        return float(sum((values if n in self.names else self.start)[n] - x for n, x in self.undrifted.items()))


def check_names(
    free: tuple[str, ...] | None, start: Mapping[str, float], bounds: Mapping[str, tuple[float, float]]
) -> None:
    """Check that parameter names are strings and their values finite numbers; else raise :class:`AmiwarpError`."""
    if free is not None and not isinstance(free, tuple | list):
        raise AmiwarpError(f"free is {shown(free)}; expected a tuple of parameter names, or None")
    for name in free or ():
        instance(name, str, "free parameter")
    for given, what in ((start, "start"), (bounds, "bounds")):
        if not isinstance(given, Mapping) or not all(isinstance(name, str) for name in given):
            raise AmiwarpError(f"{what} is {shown(given)}; expected values by parameter name")
    for name, value in start.items():
        real(value, f"start of {name}")
    for name, pair in bounds.items():
        vector(pair, 2, f"bounds of {name}", real)


def nominal(prism: NominalPrism | None, kind: type[models.Model] | None = None) -> Prism | Plate:
    """Return a recording's nominal glass, with the apex :data:`NOMINAL_APEX` if the apex of its prism is unknown.

    For a ``kind`` of model without a prism, its apex is 0.
    """
    if kind is not None and not kind.PRISM:
        return Prism(0.0)
    return prism if isinstance(prism, Prism | Plate) else (prism or UnsizedPrism()).with_apex(NOMINAL_APEX)


def best_model(recording: Recording) -> str | None:
    """Return the name of the best model of a recording's optic: that of its glass, or that which its metadata names.

    A recording with two angles without either may be of two prisms or of a mirror; None then.
    """
    glass, two = recording.prism, recording.encoder is not None and recording.encoder.second is not None
    if isinstance(glass, Plate):
        return models.PlateModel.NAME
    named = models.MODELS.get(str(recording.metadata.get("optic")))
    if glass is None and named is not None and not named.PRISM and (named.ANGLES == 2) == two:
        return named.NAME
    return models.ExactModel.NAME if not two else None if glass is None else models.RisleyModel.NAME


def _difference(name: str, a: float, b: float) -> float:
    return math.remainder(a - b, 2.0 * math.pi) if name in phase_names() else a - b


def rotation_from_values(values: Mapping[str, float], middle_us: int) -> CameraRotation:
    """Return the camera rotation that the parameter values describe; a missing rate is taken as 0."""
    if values.keys().isdisjoint(MOTION):
        return CameraRotation(middle_us=middle_us)
    x, y, z = (values.get(n, 0.0) for n in RATES)
    a, b, c = (values.get(n, 0.0) for n in CHANGES)
    return CameraRotation((x, y, z), (a, b, c), middle_us, values.get(GROWTH, 0.0))


def values_of(model: str, values: Mapping[str, float]) -> dict[str, float]:
    """Return the values without those of optical parameters that ``model`` does not have."""
    foreign = optical_parameters().keys() - models.MODELS[model].FREE
    return {name: value for name, value in values.items() if name not in foreign}


def globally_searched(space: ParameterSpace) -> ParameterSpace:
    """Return the space with bounds of one period, and a margin, for the parameters that repeat."""
    low, high = dict(space.low), dict(space.high)
    for name, parameter in optical_parameters().items():
        if parameter.period and name in space.names:
            low[name] = max(low[name], space.start[name] - parameter.half_range)
            high[name] = min(high[name], space.start[name] + parameter.half_range)
    return replace(space, low=low, high=high)


def kept_by_global_search(space: ParameterSpace) -> tuple[str, ...]:
    """Return the names of the free parameters whose start values the global search keeps."""
    fine = {name for name, parameter in optical_parameters().items() if parameter.fine}
    exact_speed = () if models.MODELS[space.model].PRISM else ("rpm",)  # many turns tell it better than a coarse image
    return tuple(n for n in space.names if n in MOTION or n in fine or n in exact_speed)


# Set-up of a parameter space: checks of names and bounds, and the scale of each parameter in pixels.

MOST_TURNS_OFF = 0.25
"""Largest error of the number of turns in a recording that the frequency of a vibrating camera may start with."""
_HALF_RANGE = {"clock_offset": 5000.0, **dict.fromkeys(RATES, 5.0), **dict.fromkeys(CHANGES, 50.0), GROWTH: 5.0}
"""Half width of the default bounds of each parameter about its start value, in the parameter's unit."""


def make_space(
    model: str,
    camera: Camera,
    prism: Prism | Plate,
    *,
    free: tuple[str, ...] | None,
    start: Mapping[str, float],
    bounds: Mapping[str, tuple[float, float]],
    rad_per_us: float,
    duration_us: float,
    middle_us: int = 0,
    pixels: Mapping[str, float] | None = None,
) -> ParameterSpace:
    """Return the parameter space: check names and bounds, and measure how far each parameter moves events.

    Parameters
    ----------
    model : str
        Name of the model.
    camera : Camera
        The camera.
    prism : Prism or Plate
        The nominal glass, which gives the default bounds of the size.
    free : tuple of str, or None
        Names of the free parameters; ``motion`` stands for all three rates. None: those that the model names.
    start : mapping of str to float
        Start values, in the parameters' units, moved into the bounds. Phases are wrapped, unless they have ``bounds``.
    bounds : mapping of str to (float, float)
        Lower and upper bound by name, in the parameters' units.
    rad_per_us : float
        Mean speed of the prism [rad/us].
    duration_us : float
        Duration of the events [us].
    middle_us : int
        Time to whose camera orientation events are rotated back [us].
    pixels : mapping of str to float, optional
        Displacement of events per unit of each free parameter [px rms]. None: it is measured.

    Returns
    -------
    ParameterSpace
        The space.

    Raises
    ------
    AmiwarpError
        If a name is unknown, not part of the model or in conflict with another one, if the bounds are in the wrong
        order, or if a free parameter moves no event.
    """
    kind = models.MODELS[model]
    names = _ordered_names(kind, kind.FREED if free is None else free)
    _check_given(kind, names, start, bounds)
    nominal = {**kind.start_values(prism), "focal_length": camera.fx}
    values = {n: start.get(n, nominal.get(n, 0.0)) for n in (*orbit_names(kind), *names, *start)}
    low, high = {}, {}
    for name in names:
        default = _default_bounds(kind, name, values[name], camera, prism, duration_us)
        low[name], high[name] = bounds.get(name) or default
        if not low[name] < high[name]:
            raise AmiwarpError(f"bounds of {name} are {low[name]:.6g} .. {high[name]:.6g}; give the lower bound first")
        if name not in bounds and name in phase_names():
            values[name] = math.remainder(values[name], math.tau)
        values[name] = min(max(values[name], low[name]), high[name])
    if pixels is None:
        pixels = _pixels_per_unit(
            model, camera, prism, names=names, values=values, rad_per_us=rad_per_us, duration_us=duration_us
        )
    pixels = {n: pixels[n] for n in names}
    _check_scales(pixels)
    undrifted = {n: x for n, x in values.items() if n in DRIFTS}
    return ParameterSpace(
        model=model, camera=camera, prism=prism, names=names, low=low, high=high, start=values, pixels=pixels,
        middle_us=middle_us, duration_us=duration_us, undrifted=undrifted,
    )  # fmt: skip


def widened(space: ParameterSpace, names: tuple[str, ...]) -> ParameterSpace:
    """Return the space with more free parameters: of the lens (:data:`LENS`), or the tilt of the prism's axis.

    They start at their present values. Raises :class:`AmiwarpError` if one of them moves no event.
    """
    camera = space.camera
    given = {**given_lens(camera), "index": as_wedge(space.prism).index}
    values = {**{n: given.get(n, 0.0) for n in names}, **space.start}
    half = {"focal_length": 0.6 * values.get("focal_length", 0.0), "k1": 0.5, "fy_over_fx": 0.3}
    half |= dict.fromkeys(("center_x", "center_y"), 0.2 * camera.width)
    half |= {name: parameter.half_range for name, parameter in optical_parameters().items()}
    shifts = _pixels_per_unit(
        space.model, camera, space.prism, names=names, values=values, rad_per_us=0.0, duration_us=space.duration_us
    )
    _check_scales(shifts)
    return replace(
        space, names=(*space.names, *names), start=values, pixels={**space.pixels, **shifts},
        low={**space.low, **{n: values[n] - half[n] for n in names}},
        high={**space.high, **{n: values[n] + half[n] for n in names}},
    )  # fmt: skip


def _ordered_names(kind: type[models.Model], free: tuple[str, ...]) -> tuple[str, ...]:
    """Return the free parameters' names in the search vector's order; raise for unknown or conflicting names."""
    wanted = {kind.SIZE if n in models.size_names() else n for n in free if n != "motion"}
    wanted |= set(RATES if "motion" in free else ())
    unknown = wanted - set(units())
    if unknown:
        known = ", ".join((*units(), "motion", *LINEAR_UNKNOWNS))
        raise AmiwarpError(f"free parameter {sorted(unknown)[0]!r} is unknown; choose among {known}")
    if not wanted:
        raise AmiwarpError("no parameter is free; name at least one free parameter")
    foreign = sorted(wanted - set(_names_of(kind)))
    if foreign:
        other = next(each.NAME for each in models.MODELS.values() if foreign[0] in each.FREE)
        raise AmiwarpError(f"the {kind.NAME} model has no {foreign[0]}; use model {other!r}")
    if set(DRIFTS) <= wanted:
        raise AmiwarpError(
            "clock_offset and rpm cannot both be free; free rpm only for recordings without an encoder, else free "
            "clock_offset"
        )
    return tuple(n for n in _names_of(kind) if n in wanted)


def _names_of(kind: type[models.Model]) -> tuple[str, ...]:
    """Return the names of all parameters that can be free for a model, in the search vector's order."""
    return (*kind.FREE[:2], *DRIFTS, *kind.FREE[2:], "focal_length", *MOTION)


def _check_given(
    kind: type[models.Model],
    names: tuple[str, ...],
    start: Mapping[str, float],
    bounds: Mapping[str, tuple[float, float]],
) -> None:
    """Raise :class:`AmiwarpError` for start values that the model lacks and bounds of parameters that are not free."""
    known = _names_of(kind)
    for name in start:
        if name not in known:
            raise AmiwarpError(
                f"start names {name}, which is no parameter of the {kind.NAME} model; choose among {', '.join(known)}"
            )
    for name in bounds:
        if name not in names:
            raise AmiwarpError(f"bounds are given for {name}, which is not free; add {name} to the free parameters")


def _default_bounds(
    kind: type[models.Model], name: str, value: float, camera: Camera, prism: Prism | Plate, duration_us: float
) -> tuple[float, float]:
    if name in kind.FREE:
        return kind.default_bounds(name, value, camera, prism)
    share = {"rpm": 0.02, "focal_length": 0.2}
    half = share[name] * abs(value) if name in share else _HALF_RANGE[name]
    if name == "rpm" and not kind.PRISM:
        half = MOST_TURNS_OFF * 60e6 / max(duration_us, 1.0)
    return value - half, value + half


def _pixels_per_unit(
    model: str,
    camera: Camera,
    prism: Prism | Plate,
    *,
    names: tuple[str, ...],
    values: Mapping[str, float],
    rad_per_us: float,
    duration_us: float,
) -> dict[str, float]:
    """Return how far events move per unit of each free parameter [px rms].

    The displacement is differentiated by finite differences over a grid of pixels and prism angles, at the nominal
    size.
    """
    kind = models.MODELS[model].closed_form()
    typical = {size: kind.start_values(prism)[size] for size, _ in kind.ORBITS}
    nominal = {**values, **typical, kind.SIZE: kind.typical_size(camera, prism)}
    lens = {"center_x": 1.0, "center_y": 1.0, "k1": 0.01, "fy_over_fx": 0.01}
    steps = {**dict.fromkeys((kind.SIZE, *optical_parameters()), 0.02), **lens}
    for size, phase in kind.ORBITS:
        steps |= {size: 0.25 * nominal[size], phase: 0.05}
    steps = {n: h for n, h in steps.items() if n in names or (n == "phase" and set(DRIFTS) & set(names))}
    if "focal_length" in names:
        steps["focal_length"] = 0.01 * camera.fx
    built = [
        models.build_model(kind.NAME, camera, prism, {**nominal, n: nominal[n] + h})
        for n, x in steps.items()
        for h in (x, -x)
    ]
    moved = models.compensate_by_each(built, *_grid_points(camera.width, camera.height))
    moved = (moved[0::2] - moved[1::2]) / (2.0 * np.array([*steps.values()])[:, None, None])
    shifts = dict(zip(steps, map(models.rms, moved), strict=True))
    if set(DRIFTS) & set(names):
        shifts["clock_offset"] = shifts["phase"] * abs(rad_per_us)
        shifts["rpm"] = shifts["phase"] * 2.0 * math.pi / 60e6 * duration_us / math.sqrt(12.0)
    seconds = duration_us * 1e-6
    radius = math.sqrt((camera.width**2 + camera.height**2) / 12.0)
    for name, lever in zip(MOTION, (*(camera.fy, camera.fx, radius) * 2, radius), strict=True):
        # standard deviations of τ and τ²/2 over the recording, τ being the time from its middle
        shifts[name] = (
            lever * seconds * (seconds * math.sqrt(1.0 / 720.0) if name in CHANGES else math.sqrt(1.0 / 12.0))
        )
    # at least the effect that a camera rotation of 0.5 rad/s would make visible
    if "focal_length" in names:
        shifts["focal_length"] = max(shifts["focal_length"], 0.5 * seconds / math.sqrt(12.0))
    return {n: shifts[n] for n in names}


def _check_scales(pixels: Mapping[str, float]) -> None:
    """Raise :class:`AmiwarpError` if a parameter moves no event, or by an infinite distance."""
    if not all(math.isfinite(x) and x > 0.0 for x in pixels.values()):
        raise AmiwarpError(
            "a free parameter moves no event; give a nominal apex above 0 and an encoder whose angle changes"
        )


@lru_cache(maxsize=16)
def _grid_points(width: int, height: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return a grid of pixels [px], shape (n, 2), and of wrapped prism angles [rad], shape (n,)."""
    x, y, theta = np.meshgrid(
        np.linspace(0, width - 1, 8), np.linspace(0, height - 1, 6), np.arange(8) * (np.pi / 4), indexing="ij"
    )
    return np.stack([x.ravel(), y.ravel()], axis=1), models.wrap_angle(theta.ravel())
