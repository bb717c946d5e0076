"""Free parameters of a calibration: their names, bounds and units, and the vector that the optimiser moves.

The vector is in pixels: one unit of any entry moves events by about one pixel (rms over image and turn). One tolerance
and one first step then fit every parameter. If the phase is free over the full turn, size and phase become Cartesian,
(size·cos phase, size·sin phase): no wrap-around, no second optimum at (−size, phase + π), even resolution.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from amiwarp.errors import AmiwarpError
from amiwarp.optics.camera_rotation import CameraRotation
from amiwarp.optics.circle_models import CircleModel, RadialCircleModel
from amiwarp.optics.ellipse_model import EllipseModel
from amiwarp.optics.exact_model import ExactModel
from amiwarp.optics.lens import RadialTangential
from amiwarp.optics.models import MODELS
from amiwarp.optics.prism import Prism, UnsizedPrism
from amiwarp.validation import guarded, instance, one_of, real, shown, vector

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.optics.camera import Camera
    from amiwarp.optics.models import Model
    from amiwarp.optics.prism import NominalPrism

NOMINAL_APEX = math.radians(2.0)
"""Apex angle assumed if a recording does not give it [rad]. The search goes up to twice this value."""
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
"""Unit of every parameter that can be free.

``clock_offset`` is the encoder's clock offset (see :class:`amiwarp.Encoder`). ``focal_length`` is the camera's fx; fy
keeps its ratio to fx. ``rate_*`` and ``change_*`` describe the camera's rotation (:class:`amiwarp.CameraRotation`).
"""

DRIFTS = ("clock_offset", "rpm")
"""Parameters that shift the prism angle of each event by an amount that depends on the event's time."""
RATES = ("rate_x", "rate_y", "rate_z")
"""Angular velocity of the camera about its x, y and z axes: names of the parameters."""
CHANGES = ("change_x", "change_y", "change_z")
"""Angular acceleration of the camera about its x, y and z axes: names of the parameters."""
MOTION = (*RATES, *CHANGES)
"""Names of all parameters of the camera's rotation."""
EXACT_PARAMETERS = ("apex", "index", "tilt_x", "tilt_y")
"""Parameters of the exact model that the circle models do not have."""
LENS = ("focal_length", "center_x", "center_y", "k1")
"""Parameters of the camera's lens. The principal point (px) and the first radial coefficient of distortion are freed by
the photometric stage only, if the events contradict the given camera."""
DEGENERATE_WITH_APEX = ("index", *LENS)
"""Parameters that the sharpness stage does not search if the photometric stage follows: in sharpness they are nearly
degenerate with the apex."""


@guarded
@dataclass(frozen=True, kw_only=True)
class ParameterSpace:
    """Free parameters of one model: names, bounds and start, and their conversion to and from the search vector.

    The search vector has one entry per free parameter, in pixels: one unit of an entry moves events by about one pixel
    (rms over image and turn).
    """

    model: str
    """Name of the model: ``circle``, ``radial``, ``ellipse`` or ``exact``."""
    camera: Camera
    """Nominal camera. If the focal length is free, its value replaces the camera's focal length."""
    prism: Prism
    """Nominal prism. It gives the flat side, and the index if that is not free."""
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
        return size_name(self.model)

    @cached_property
    def cartesian(self) -> bool:
        """Whether the vector's first two entries are (size·cos phase, size·sin phase)."""
        full = self.high.get("phase", 0.0) - self.low.get("phase", 0.0) >= 2.0 * math.pi - 1e-9
        return self.names[:2] == (self.size_name, "phase") and full

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
        if self.cartesian:
            high[1] = high[0]
            low[:2] = -high[:2]
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
        _check_given(values, self.names)
        v = np.array([values[n] * self.pixels[n] for n in self.names])
        if self.cartesian:
            v[:2] = v[0] * math.cos(values["phase"]), v[0] * math.sin(values["phase"])
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
        values, entries = dict(self.start), v.tolist()
        for name, entry in zip(self.names, entries, strict=True):
            values[name] = entry / self.pixels[name]
        if self.cartesian:
            x, y, size = entries[0], entries[1], self.names[0]
            values[size], values["phase"] = math.hypot(x, y) / self.pixels[size], math.atan2(y, x)
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
        jacobian = np.empty((len(self.names), len(self.names)))
        for k in range(len(self.names)):
            h = np.zeros(len(self.names))
            h[k] = 1e-3
            up, down = self.to_values(v + h), self.to_values(v - h)
            jacobian[:, k] = [_difference(n, up[n], down[n]) / 2e-3 for n in self.names]
        variances = np.diag(jacobian @ covariance @ jacobian.T)
        return {n: float(math.sqrt(max(s, 0.0))) for n, s in zip(self.names, variances, strict=True)}

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
        return build_model(self.model, self.camera, self.prism, values)

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


def nominal(prism: NominalPrism | None) -> Prism:
    """Return a recording's nominal prism, with the apex :data:`NOMINAL_APEX` if its apex is unknown."""
    return prism if isinstance(prism, Prism) else (prism or UnsizedPrism()).with_apex(NOMINAL_APEX)


def _difference(name: str, a: float, b: float) -> float:
    return math.remainder(a - b, 2.0 * math.pi) if name == "phase" else a - b


def _check_given(values: Mapping[str, float], names: tuple[str, ...]) -> None:
    """Raise :class:`AmiwarpError` if a parameter has no value."""
    missing = [name for name in names if name not in values]
    if missing:
        raise AmiwarpError(f"values have no {', '.join(missing)}; give the value of each parameter")


def size_name(model: str) -> str:
    """Return the name of the parameter that sets the size of the orbit in ``model``: ``apex`` or ``deflection``."""
    return "apex" if model in ("exact", "ellipse") else "deflection"


def rotation_from_values(values: Mapping[str, float], middle_us: int) -> CameraRotation:
    """Return the camera rotation that the parameter values describe; a missing rate is taken as 0."""
    if values.keys().isdisjoint(MOTION):
        return CameraRotation(middle_us=middle_us)
    x, y, z = (values.get(n, 0.0) for n in RATES)
    a, b, c = (values.get(n, 0.0) for n in CHANGES)
    return CameraRotation((x, y, z), (a, b, c), middle_us)


def with_lens(camera: Camera, values: Mapping[str, float]) -> Camera:
    """Return the camera with those of its lens parameters (:data:`LENS`) that ``values`` contain."""
    if values.keys().isdisjoint(LENS):
        return camera
    fx = values.get("focal_length", camera.fx)
    lens = camera.distortion
    if "k1" in values:
        lens = replace(lens or RadialTangential(), k1=values["k1"])
    cx, cy = values.get("center_x", camera.cx), values.get("center_y", camera.cy)
    return replace(camera, fx=fx, fy=camera.fy * (fx / camera.fx), cx=cx, cy=cy, distortion=lens)


def build_model(model: str, camera: Camera, prism: Prism, values: Mapping[str, float]) -> Model:
    """Build the optical model of the parameter values; ``camera`` and ``prism`` give all other values."""
    one_of(model, MODELS, "model")
    _check_given(values, (size_name(model), "phase"))
    camera = with_lens(camera, values)
    if model == "circle":
        return CircleModel(camera, values["deflection"], values["phase"], prism.flat_side)
    if model == "radial":
        return RadialCircleModel(camera, values["deflection"], values["phase"], prism.index, prism.flat_side)
    wedge = Prism(values["apex"], values.get("index", prism.index), prism.flat_side)
    exact = ExactModel(camera, wedge, values["phase"], (values.get("tilt_x", 0.0), values.get("tilt_y", 0.0)))
    return EllipseModel.from_model(exact) if model == "ellipse" else exact
