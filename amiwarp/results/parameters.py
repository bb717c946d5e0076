"""Free parameters of a calibration: their names, bounds and units, and the vector that the optimiser moves.

The vector is in pixels: one unit of any entry moves events by about one pixel (rms over image and turn). One tolerance
and one first step then fit every parameter. If the phase is free over the full turn, size and phase become Cartesian,
(size·cos phase, size·sin phase): no wrap-around, no second optimum at (−size, phase + π), even resolution.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.recording import Recording
from amiwarp.optics.camera import LENS, Camera
from amiwarp.optics.camera_rotation import CameraRotation
from amiwarp.optics.models.base import Model, check_given
from amiwarp.optics.models.exact import ExactModel
from amiwarp.optics.models.pair import RisleyModel
from amiwarp.optics.models.parameter import PHASE, Parameter
from amiwarp.optics.models.plate import LARGEST_INVERSE_DEPTH, PlateModel, depth_factors
from amiwarp.optics.models.registry import MODELS, build_model, size_names
from amiwarp.optics.prism import NominalPrism, Plate, Prism, UnsizedPrism
from amiwarp.optics.rotation_path import RotationPath
from amiwarp.schema.calls import guarded
from amiwarp.validation import finite, instance, one_of, real, shown, vector

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


def optical_parameters() -> dict[str, Parameter]:
    """Return the parameters of all optical models by name: sizes, phase, then others."""
    found: dict[str, Parameter] = {}
    for model in MODELS.values():
        found |= {parameter.name: parameter for parameter in model.PARAMETERS}
    return {name: found[name] for name in (*sorted(size_names()), PHASE.name, *found)}


def units() -> dict[str, str]:
    """Return the unit of every parameter that can be free, by name."""
    return {name: parameter.unit for name, parameter in optical_parameters().items()} | _UNITS


def of_orbit(space: ParameterSpace, k: int, at: Mapping[str, float]) -> ParameterSpace:
    """Return the space of the ``k``-th prism's size and phase.

    Prisms before it have the values ``at``, later ones the size 0 if theirs is free.
    """
    model = MODELS[space.model]
    later = {size: 0.0 for size, _ in model.ORBITS[k + 1 :] if size in space.names}
    others = {*space.names} - {*model.TOGETHER[k]}
    return space.holding({**at, **later}).without(tuple(others))


def phase_names() -> set[str]:
    """Return the names of the parameters that are the phase of a prism."""
    return {phase for model in MODELS.values() for _, phase in model.ORBITS}


def orbit_names(model: type[Model]) -> tuple[str, ...]:
    """Return the names of size and phase of each prism."""
    return tuple(name for orbit in model.ORBITS for name in orbit)


def like_size(names: Iterable[str]) -> tuple[str, ...]:
    """Return those parameters that in sharpness are nearly degenerate with the size: of the lens, and some of a model.

    The sharpness stage does not search them if the photometric stage follows.
    """
    like = {name for name, parameter in optical_parameters().items() if parameter.like_size}
    return tuple(name for name in names if name in LENS or name in like)


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
    path: RotationPath | None = None
    """Known part of the camera's rotation, from a gyroscope. The rates then stand for its bias."""
    depths: NDArray[np.float64] | None = field(default=None, repr=False, compare=False)
    """Inverse depth of what each pixel sees through a plate, relative to the parameter, shape ``(height, width)``; None
    for the same one everywhere. They hold for the nominal camera: with another lens, they follow the orbits."""

    @property
    def size_name(self) -> str:
        """Name of the parameter that sets the size of the orbit: ``apex`` or ``deflection``."""
        return MODELS[one_of(self.model, MODELS, "model")].SIZE

    @property
    def cartesian(self) -> bool:
        """Whether the vector's first two entries are (size·cos phase, size·sin phase)."""
        return 0 in self.orbits

    @cached_property
    def orbits(self) -> tuple[int, ...]:
        """Indices of the vector's entries that are (size·cos phase, size·sin phase), with the next entry."""
        found = []
        orbits = MODELS[one_of(self.model, MODELS, "model")].ORBITS
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
        return self.path is not None or any(self.start.get(n) or n in self.names for n in MOTION)

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
        return replace(self, names=tuple(name for name in self.names if name not in names))

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
        check_given(values, self.names)
        v = np.array([values[n] * self.pixels[n] for n in self.names])
        for k in self.orbits:
            size_px = v[k]
            phase = values[self.names[k + 1]]
            v[k] = size_px * math.cos(phase)
            v[k + 1] = size_px * math.sin(phase)
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
            raise AmiwarpError(
                f"v has shape {v.shape}; give one entry for each of {', '.join(self.names)}"
            )
        finite(v, "entries of the search vector")
        values = dict(self.start)
        entries = v.tolist()
        for name, entry in zip(self.names, entries, strict=True):
            values[name] = entry / self.pixels[name]
        for k in self.orbits:
            size, phase = self.names[k : k + 2]
            x, y = entries[k : k + 2]
            values[size] = math.hypot(x, y) / self.pixels[size]
            values[phase] = math.atan2(y, x)
        for name in self.names:
            values[name] = min(max(values[name], self.low[name]), self.high[name])
        return values

    def deviations(
        self, v: NDArray[np.float64], covariance: NDArray[np.float64]
    ) -> dict[str, float]:
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
        count = len(self.names)
        if covariance.shape != (count, count):
            raise AmiwarpError(f"covariance has shape {covariance.shape}; give {(count, count)}")
        finite(covariance, "entries of the covariance")
        jacobian = np.empty((count, count))
        for k in range(count):
            step = np.zeros(count)
            step[k] = 1e-3
            up = self.to_values(v + step)
            down = self.to_values(v - step)
            jacobian[:, k] = [_difference(name, up[name], down[name]) / 2e-3 for name in self.names]
        variances = np.diag(jacobian @ covariance @ jacobian.T)
        stds = [float(math.sqrt(max(variance, 0.0))) for variance in variances]
        return dict(zip(self.names, stds, strict=True))

    def build(self, values: Mapping[str, float]) -> Model:
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
        model = build_model(self.model, self.camera, self.prism, values)
        if self.depths is None or not isinstance(model, PlateModel):
            return model
        inverse_depths = self.depths * model.inverse_depth
        if model.camera != self.camera:
            # orbits were seen, not depths: through another lens, other depths have them
            given = replace(model, camera=self.camera)
            inverse_depths = inverse_depths * depth_factors(given, model)
        return model.with_depths(np.minimum(inverse_depths, LARGEST_INVERSE_DEPTH))

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
        return rotation_from_values(values, self.middle_us, self.path)

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
        changes = []
        for name, undrifted in self.undrifted.items():
            value = values[name] if name in self.names else self.start[name]
            changes.append(value - undrifted)
        return float(sum(changes))


def check_names(
    free: tuple[str, ...] | None,
    start: Mapping[str, float],
    bounds: Mapping[str, tuple[float, float]],
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


def nominal(prism: NominalPrism | None, model: type[Model] | None = None) -> Prism | Plate:
    """Return a recording's nominal glass, with the apex :data:`NOMINAL_APEX` if the apex of its prism is unknown.

    For a ``model`` without a prism, its apex is 0.
    """
    if model is not None and not model.PRISM:
        return Prism(0.0)
    if isinstance(prism, Prism | Plate):
        return prism
    return (prism or UnsizedPrism()).with_apex(NOMINAL_APEX)


def best_model(recording: Recording) -> str | None:
    """Return the name of the best model of a recording's optic: of its glass, or the one that its metadata names.

    A recording with two angles without either may be of two prisms, of a mirror or of a beam steerer; None then.
    """
    glass = recording.prism
    two_angles = recording.encoder is not None and recording.encoder.second is not None
    if isinstance(glass, Plate):
        return PlateModel.NAME
    named = MODELS.get(str(recording.metadata.get("optic")))
    if glass is None and named is not None and not named.PRISM:
        suits = (named.ANGLES == 2) == two_angles
        if suits:
            return named.NAME
    if not two_angles:
        return ExactModel.NAME
    return None if glass is None else RisleyModel.NAME


def _difference(name: str, a: float, b: float) -> float:
    """Return the difference of two values of a parameter; for a phase, the nearest one."""
    return math.remainder(a - b, 2.0 * math.pi) if name in phase_names() else a - b


def rotation_from_values(
    values: Mapping[str, float], middle_us: int, path: RotationPath | None = None
) -> CameraRotation:
    """Return the camera rotation that the parameter values describe; a missing rate is taken as 0.

    ``path`` is the part of the rotation that is known.
    """
    if values.keys().isdisjoint(MOTION):
        return CameraRotation(middle_us=middle_us, path=path)
    x, y, z = (values.get(name, 0.0) for name in RATES)
    change_x, change_y, change_z = (values.get(name, 0.0) for name in CHANGES)
    growth = values.get(GROWTH, 0.0)
    return CameraRotation((x, y, z), (change_x, change_y, change_z), middle_us, growth, path)


def values_of(model: str, values: Mapping[str, float]) -> dict[str, float]:
    """Return the values without the optical parameters that ``model`` does not have."""
    foreign = optical_parameters().keys() - MODELS[model].FREE
    return {name: value for name, value in values.items() if name not in foreign}


def globally_searched(space: ParameterSpace) -> ParameterSpace:
    """Return the space with bounds of one period, and a margin, for the parameters that repeat."""
    low = dict(space.low)
    high = dict(space.high)
    for name, parameter in optical_parameters().items():
        if parameter.period and name in space.names:
            low[name] = max(low[name], space.start[name] - parameter.half_range)
            high[name] = min(high[name], space.start[name] + parameter.half_range)
    return replace(space, low=low, high=high)


def kept_by_global_search(space: ParameterSpace) -> tuple[str, ...]:
    """Return the names of the free parameters whose start values the global search keeps."""
    fine = {name for name, parameter in optical_parameters().items() if parameter.fine}
    # Many turns tell it better than a coarse image
    exact_speed = () if MODELS[space.model].PRISM else ("rpm",)
    return tuple(n for n in space.names if n in MOTION or n in fine or n in exact_speed)
