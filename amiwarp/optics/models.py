"""The prism and the ladder of models that take its motion out: from two numbers to the exact trace."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, TypeVar, cast

import numpy as np
import warp as wp

from amiwarp.errors import AmiwarpError
from amiwarp.kernels import optics as kernels
from amiwarp.kernels.launch import launch
from amiwarp.kernels.optics import CircleParams, EllipseParams, ExactParams, RadialCircleParams, fit_harmonics
from amiwarp.optics.camera import Camera
from amiwarp.optics.device_camera import camera_params
from amiwarp.optics.prism import (
    FlatSide,
    Prism,
    apex_from_deflection,
    check_index,
    check_phase,
    check_tilt,
    deflection_from_apex,
)
from amiwarp.validation import array, choice, instance, real

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = [
    "MODELS", "CircleModel", "EllipseModel", "ExactModel", "FlatSide", "Model", "ModelError", "Prism",
    "RadialCircleModel", "apex_from_deflection", "axis_rotation", "deflection_from_apex", "model_camera",
    "predicted_error", "wrap_angle",
]  # fmt: skip

Points = TypeVar("Points")
"""A NumPy array of shape (n, 2) or a Warp array of vec2, shape (n,): the same kind comes out as goes in."""

UPRIGHT = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)


def _check_circle(model: CircleModel | RadialCircleModel) -> None:
    """Check and convert what both circles have."""
    instance(model.camera, Camera, "camera")
    below = math.nextafter(math.pi / 2.0, 0.0)
    hint = " rad; where it is negative, add pi to the phase instead"
    object.__setattr__(model, "deflection", real(model.deflection, "deflection", 0.0, below, hint))
    object.__setattr__(model, "phase", check_phase(model.phase))
    object.__setattr__(model, "flat_side", choice(FlatSide, model.flat_side, "flat_side"))


class _Model(Protocol):
    @property
    def camera(self) -> Camera: ...

    def params(self, device: Any) -> Any: ...


class _OnDevice:
    """What the models share: running their device functions over arrays."""

    def compensate_points(self: _Model, xy: Points, theta: Points) -> Points:
        """Observed pixel to the pixel that the same scene ray would hit with no prism.

        ``xy`` [px] has shape (n, 2), ``theta`` [rad], the encoder's angle, shape (n,): both NumPy arrays, or both
        Warp arrays (vec2, float32) of one device, where the work is then done. Rows without a ray (total internal
        reflection, behind the image) come out as NaN. Raises :class:`AmiwarpError` for other shapes.
        """
        return _run("compensate_points", self, xy, theta)

    def deflect_points(self: _Model, xy: Points, theta: Points) -> Points:
        """The reverse of :meth:`compensate_points`: pixel without the prism to the observed pixel."""
        return _run("deflect_points", self, xy, theta)


def _run(kernel_name: str, model: _Model, xy: Any, theta: Any) -> Any:
    kernel = getattr(kernels, kernel_name)
    if isinstance(xy, wp.array):
        if not isinstance(theta, wp.array) or theta.device != xy.device or theta.dtype is not wp.float32:
            raise AmiwarpError(f"xy is a Warp array on {xy.device}; give theta as a float32 Warp array there too")
        if xy.dtype is not wp.vec2 or xy.ndim != 1 or xy.shape != theta.shape:
            raise AmiwarpError(f"xy has type {xy.dtype}, shape {xy.shape}, theta {theta.shape}; give vec2, both (n,)")
        out = wp.empty_like(xy)
        launch(kernel, len(xy), [model.params(xy.device), model_camera(model, xy.device), xy, theta], [out],
               device=xy.device)  # fmt: skip
        return out
    xy, theta = array(xy, "xy"), array(theta, "theta")
    if xy.ndim != 2 or xy.shape[1] != 2 or theta.shape != xy.shape[:1]:
        raise AmiwarpError(f"xy has shape {xy.shape} and theta {theta.shape}; give (n, 2) and (n,)")
    wrapped = wrap_angle(theta).astype(np.float32)
    result = _run(
        kernel_name,
        model,
        wp.array(xy.astype(np.float32), dtype=wp.vec2, device="cpu"),
        wp.array(wrapped, dtype=float, device="cpu"),
    )
    return result.numpy().astype(xy.dtype if np.issubdtype(xy.dtype, np.floating) else np.float32, copy=False)


def wrap_angle(angle: NDArray[np.float64]) -> NDArray[np.float64]:
    """Angle [rad] to [-pi, pi), in float64, before anything is rounded to float32."""
    return (np.asarray(angle, dtype=np.float64) + np.pi) % (2.0 * np.pi) - np.pi


def model_camera(model: _Model, device: Any) -> Any:
    """The camera's struct on ``device``, made once for each camera."""
    return camera_params(model.camera, str(device))


def _set_phase(params: Any, phase: float) -> None:
    params.phase, params.phase_cos, params.phase_sin = phase, math.cos(phase), math.sin(phase)


@dataclass(frozen=True)
class CircleModel(_OnDevice):
    """A rotation of the bearing by one constant angle about z × w(θ): two numbers for the whole image."""

    FREE: ClassVar[tuple[str, ...]] = ("deflection", "phase")
    camera: Camera
    deflection: float
    """Angle of the rotation [rad], positive."""
    phase: float = 0.0
    """θ_b, added to the encoder's angle [rad]."""
    flat_side: FlatSide = FlatSide.SCENE

    def __post_init__(self) -> None:
        _check_circle(self)

    @classmethod
    def from_prism(cls, camera: Camera, prism: Prism, phase: float = 0.0) -> CircleModel:
        """The circle that is right on the optical axis."""
        return cls(camera, prism.deflection, phase, prism.flat_side)

    def params(self, device: Any) -> Any:
        p = CircleParams()
        p.sine = math.sin(self.deflection if self.flat_side is FlatSide.SCENE else -self.deflection)
        p.versine = 2.0 * math.sin(self.deflection / 2.0) ** 2
        _set_phase(p, self.phase)
        return p


@dataclass(frozen=True)
class RadialCircleModel(_OnDevice):
    """A rotation by an angle that grows off the axis: δ(φ) = δ₀ (√(n² − sin²φ)/cos φ − 1)/(n − 1).

    φ is the off-axis angle of the bearing on the side of the tilted face: the observed one with the flat face to the
    scene, the scene's with the flat face to the camera. Only so is it right to almost second order in the apex.
    """

    FREE: ClassVar[tuple[str, ...]] = ("deflection", "phase")
    camera: Camera
    deflection: float
    """Angle on the axis [rad], positive."""
    phase: float = 0.0
    """θ_b, added to the encoder's angle [rad]."""
    index: float = 1.5168
    flat_side: FlatSide = FlatSide.SCENE

    def __post_init__(self) -> None:
        _check_circle(self)
        object.__setattr__(self, "index", check_index(self.index, "index"))

    @classmethod
    def from_prism(cls, camera: Camera, prism: Prism, phase: float = 0.0) -> RadialCircleModel:
        return cls(camera, prism.deflection, phase, prism.index, prism.flat_side)

    def params(self, device: Any) -> Any:
        p = RadialCircleParams()
        p.deflection = self.deflection if self.flat_side is FlatSide.SCENE else -self.deflection
        _set_phase(p, self.phase)
        p.index = self.index
        return p


@dataclass(frozen=True)
class ExactModel(_OnDevice):
    """Refraction at both faces in closed form; source: ``docs/optics.md``."""

    FREE: ClassVar[tuple[str, ...]] = ("apex", "phase", "index", "tilt_x", "tilt_y")
    camera: Camera
    prism: Prism
    phase: float = 0.0
    """θ_b, added to the encoder's angle [rad]."""
    tilt: tuple[float, float] = (0.0, 0.0)
    """Rotation of the prism's axis of rotation about the camera's x and y [rad]: first x, then y."""

    def __post_init__(self) -> None:
        instance(self.camera, Camera, "camera")
        instance(self.prism, Prism, "prism")
        object.__setattr__(self, "phase", check_phase(self.phase))
        object.__setattr__(self, "tilt", check_tilt(self.tilt))

    @classmethod
    def from_prism(cls, camera: Camera, prism: Prism, phase: float = 0.0) -> ExactModel:
        return cls(camera, prism, phase)

    def params(self, device: Any) -> Any:
        p = ExactParams()
        p.sin_apex = math.sin(self.prism.apex)
        p.cos_apex = math.cos(self.prism.apex)
        p.index2 = self.prism.index**2
        _set_phase(p, self.phase)
        p.flat_to_scene = int(self.prism.flat_side is FlatSide.SCENE)
        p.tilted = int(any(self.tilt))
        p.axis = wp.mat33(*(axis_rotation(*self.tilt).ravel().tolist() if p.tilted else UPRIGHT))
        return p


def axis_rotation(tilt_x: float, tilt_y: float) -> NDArray[np.float64]:
    """Rotation matrix (3, 3) of the tilted axis: about x by ``tilt_x``, then about y by ``tilt_y`` [rad]."""
    cx, sx, cy, sy = math.cos(tilt_x), math.sin(tilt_x), math.cos(tilt_y), math.sin(tilt_y)
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, cx, -sx], [0.0, sx, cx]])
    about_y = np.array([[cy, 0.0, sy], [0.0, 1.0, 0.0], [-sy, 0.0, cy]])
    return about_y @ about_x


@dataclass(frozen=True, eq=False)
class EllipseModel(_OnDevice):
    """Per observed pixel an offset and an oriented ellipse: the displacement's mean and first harmonic.

    d(φ) = offset + cosine · cos φ + sine · sin φ [px], each table of shape (height, width, 2), float32.
    """

    FREE: ClassVar[tuple[str, ...]] = ("apex", "phase")
    camera: Camera
    offset: NDArray[np.float32] = field(repr=False)
    cosine: NDArray[np.float32] = field(repr=False)
    sine: NDArray[np.float32] = field(repr=False)
    phase: float = 0.0
    """θ_b, added to the encoder's angle [rad]."""

    def __post_init__(self) -> None:
        instance(self.camera, Camera, "camera")
        object.__setattr__(self, "phase", check_phase(self.phase))
        for name in ("offset", "cosine", "sine"):
            table = array(getattr(self, name), name)
            shape = (self.camera.height, self.camera.width, 2)
            if table.shape != shape:
                raise AmiwarpError(f"{name} has shape {table.shape}; expected {shape}, the camera's rows and columns")
            object.__setattr__(self, name, table.astype(np.float32, copy=False))

    @classmethod
    def from_prism(cls, camera: Camera, prism: Prism, phase: float = 0.0) -> EllipseModel:
        return cls.from_model(ExactModel(camera, prism, phase))

    @classmethod
    def from_model(cls, model: CircleModel | RadialCircleModel | ExactModel, device: Any = "cpu") -> EllipseModel:
        """Tables from any other model: least squares over 16 angles a pixel; NaN where a pixel has no ray."""
        height, width = model.camera.height, model.camera.width
        table = wp.empty((height, width, 6), dtype=float, device=device)
        inputs = [replace(model, phase=0.0).params(device), model_camera(model, device)]
        launch(fit_harmonics, height * width, inputs, [table], device=device)
        offset, cosine, sine = np.split(table.numpy(), 3, axis=2)
        return cls(model.camera, offset, cosine, sine, model.phase)

    @classmethod
    def fit(
        cls,
        camera: Camera,
        xy: NDArray[np.float64],
        theta: NDArray[np.float64],
        compensated: NDArray[np.float64],
        *,
        degree: int = 4,
    ) -> EllipseModel:
        """Tables from measured pairs: each of the six fields a polynomial of the pixel, by least squares.

        ``xy`` observed and ``compensated`` [px], shape (n, 2), invalid (NaN) pairs are left out; ``theta`` [rad], shape
        (n,). The phase is part of the tables. Raises :class:`AmiwarpError` where the pairs do not determine the
        polynomials.
        """
        xy = np.asarray(xy, dtype=np.float64)
        theta = np.asarray(theta, dtype=np.float64)
        shift = np.asarray(compensated, dtype=np.float64) - xy
        valid = np.isfinite(shift).all(axis=1)
        basis = _polynomials(camera, xy[valid], degree)
        angle = theta[valid][:, None]
        design = np.hstack([basis, basis * np.cos(angle), basis * np.sin(angle)])
        solution, _, rank, _ = np.linalg.lstsq(design, shift[valid], rcond=None)
        if rank < design.shape[1]:
            raise AmiwarpError(
                f"{len(design)} pairs determine {rank} of {design.shape[1]} coefficients: "
                f"spread them over image and angle, or lower degree = {degree}"
            )
        rows, cols = np.mgrid[: camera.height, : camera.width]
        pixels = _polynomials(camera, np.stack([cols.ravel(), rows.ravel()], axis=1).astype(np.float64), degree)
        shape = (3, camera.height, camera.width, 2)
        tables = np.stack([pixels @ part for part in np.split(solution, 3)]).reshape(shape).astype(np.float32)
        return cls(camera, tables[0], tables[1], tables[2])

    @cached_property
    def _tables(self) -> dict[str, Any]:
        return {}

    def params(self, device: Any) -> Any:
        if str(device) not in self._tables:
            p = EllipseParams()
            table = np.concatenate([self.offset, self.cosine, self.sine], axis=2)
            p.table = wp.array(table, dtype=float, device=device)
            _set_phase(p, self.phase)
            self._tables[str(device)] = p
        return self._tables[str(device)]


def _polynomials(camera: Camera, xy: NDArray[np.float64], degree: int) -> NDArray[np.float64]:
    """Products of Chebyshev polynomials of total degree ≤ ``degree``, pixels scaled to [-1, 1]; shape (n, terms)."""
    scaled = 2.0 * xy / np.maximum([camera.width - 1.0, camera.height - 1.0], 1.0) - 1.0
    full = np.polynomial.chebyshev.chebvander2d(scaled[:, 0], scaled[:, 1], [degree, degree])
    return cast("NDArray[np.float64]", full.reshape(len(xy), degree + 1, degree + 1)[:, _triangle(degree)])


def _triangle(degree: int) -> NDArray[np.bool_]:
    i = np.arange(degree + 1)
    return i[:, None] + i[None, :] <= degree


Model = CircleModel | RadialCircleModel | EllipseModel | ExactModel
MODELS: dict[str, type[Model]] = {
    "circle": CircleModel,
    "exact": ExactModel,
    "radial": RadialCircleModel,
    "ellipse": EllipseModel,
}
"""The ladder by name, smallest first: by the numbers that a calibration finds, then by the measured cost per event."""


@dataclass(frozen=True, slots=True)
class ModelError:
    """Distance between two models over the image and one turn [px]."""

    rms: float
    worst: float
    lag: float
    """Constant angle taken off the first model before comparing [rad]; 0 unless asked for."""


def predicted_error(model: Model, exact: Model, *, remove_lag: bool = False, grid: int = 24) -> ModelError:
    """Error of ``model`` against ``exact``, on ``grid`` rows of the image (square cells) and 36 angles.

    With ``remove_lag`` the constant angle that brings the two closest is removed first. Points that either model
    marks invalid are left out; raises :class:`AmiwarpError` where none is left.
    """
    from scipy.optimize import minimize_scalar

    camera = exact.camera
    columns = max(2, round(grid * camera.width / camera.height))
    x = np.round(np.linspace(0, camera.width - 1, columns))
    y = np.round(np.linspace(0, camera.height - 1, max(2, grid)))
    theta = np.arange(36) * (2.0 * np.pi / 36)
    mesh = np.stack([m.ravel() for m in np.meshgrid(x, y, theta, indexing="ij")], axis=1)
    target = exact.compensate_points(mesh[:, :2], mesh[:, 2])

    def distance(lag: float) -> NDArray[np.float64]:
        d = np.linalg.norm(model.compensate_points(mesh[:, :2], mesh[:, 2] - lag) - target, axis=1)
        return cast("NDArray[np.float64]", d[np.isfinite(d)])

    def rms(lag: float) -> float:
        return float(np.sqrt(np.mean(distance(lag) ** 2)))

    if not len(distance(0.0)):
        raise AmiwarpError("the two models have no valid point in common")
    lag = 0.0
    if remove_lag:
        start = min(np.arange(-12, 12) * (np.pi / 12), key=rms)
        bounds = (start - 0.3, start + 0.3)
        lag = float(minimize_scalar(rms, bounds=bounds, method="bounded", options={"xatol": 1e-6}).x)
        lag = lag if rms(lag) < rms(0.0) else 0.0
    return ModelError(rms(lag), float(distance(lag).max()), lag)
