"""Ellipse model: tables of the displacement for every pixel, fitted to another model or to measured pairs of pixels."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Self, cast

import numpy as np
import warp as wp

from amiwarp.errors import AmiwarpError
from amiwarp.kernels.launch import launch
from amiwarp.kernels.refraction import EllipseParams, fit_harmonics
from amiwarp.optics.camera import Camera
from amiwarp.optics.displacement import Model, model_camera, phase_values, struct_of
from amiwarp.optics.exact_model import ExactModel
from amiwarp.optics.prism import check_phase
from amiwarp.validation import array, guarded, instance, whole

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from amiwarp.optics.prism import Prism

HARMONIC_ANGLES = 16
"""Number of angles at which a model is approximated."""


@guarded
@dataclass(frozen=True, eq=False)
class EllipseModel(Model):
    """Ellipse model: stores the mean and the first harmonic of the displacement for every observed pixel.

    Raises
    ------
    AmiwarpError
        If a table does not have the camera's size, or another field has an unusable value.

    Notes
    -----
    The displacement at φ = θ + θ_b is d(φ) = offset + cosine · cos φ + sine · sin φ [px].

    Examples
    --------
    >>> camera = amiwarp.Camera(width=32, height=24, fx=40.0, fy=40.0, cx=15.5, cy=11.5)
    >>> model = amiwarp.EllipseModel.from_prism(camera, amiwarp.Prism(apex=0.03))
    >>> model.cosine.shape
    (24, 32, 2)
    """

    NAME, TEXT, NUMBERS, STRUCT = "ellipse", "ellipse (table)", "6 a pixel", EllipseParams
    PARAMETERS = ExactModel.PARAMETERS
    SIMPLIFIES = "exact"

    camera: Camera
    """Camera intrinsics."""
    offset: NDArray[np.float32] = field(repr=False)
    """Mean displacement [px], shape ``(height, width, 2)``."""
    cosine: NDArray[np.float32] = field(repr=False)
    """Cosine term of the displacement [px], shape ``(height, width, 2)``."""
    sine: NDArray[np.float32] = field(repr=False)
    """Sine term of the displacement [px], shape ``(height, width, 2)``."""
    phase: float = 0.0
    """Phase θ_b, added to the encoder's angle [rad]."""

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
    def closed_form(cls) -> type[Model]:
        return ExactModel

    @classmethod
    def _of_values(cls, camera: Camera, prism: Prism, values: Mapping[str, float]) -> Self:
        return cls.from_model(ExactModel.from_values(camera, prism, values))

    @classmethod
    def from_model(cls, model: Model, device: Any = "cpu") -> Self:
        """Fit the tables to another model, by least squares over 16 angles for each pixel.

        Parameters
        ----------
        model : Model
            The model to approximate, which is no ellipse model.
        device : str or warp.Device, default "cpu"
            The device that does the fit.

        Returns
        -------
        EllipseModel
            The model. Its tables are NaN at pixels without a ray.
        """
        height, width = model.camera.height, model.camera.width
        table = wp.empty((height, width, 6), dtype=float, device=device)
        phi = math.tau * np.arange(HARMONIC_ANGLES) / HARMONIC_ANGLES
        angles = wp.array(np.stack([np.cos(phi), np.sin(phi)], axis=1), dtype=wp.vec2, device=device)
        inputs = [replace(cast("Any", model), phase=0.0).params(device), model_camera(model, device), angles]
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
        """Fit the tables to measured pairs of pixels, by least squares.

        Each of the six table components is a polynomial of the pixel's position. The tables include the phase, so the
        model's ``phase`` is 0.

        Parameters
        ----------
        camera : Camera
            The camera.
        xy : numpy.ndarray
            Observed pixels [px], shape (n, 2).
        theta : numpy.ndarray
            Prism angle of the encoder [rad], shape (n,).
        compensated : numpy.ndarray
            The same points without the prism [px], shape (n, 2). Pairs with NaN are left out.
        degree : int, default 4
            Total degree of the polynomials.

        Returns
        -------
        EllipseModel
            The model.

        Raises
        ------
        AmiwarpError
            If the pairs do not determine all coefficients.
        """
        xy, theta = np.asarray(xy, dtype=np.float64), np.asarray(theta, dtype=np.float64)
        compensated, degree = np.asarray(compensated, dtype=np.float64), whole(degree, "degree", 0, 20)
        if xy.ndim != 2 or xy.shape[1] != 2 or compensated.shape != xy.shape or theta.shape != xy.shape[:1]:
            given = f"xy has shape {xy.shape}, theta {theta.shape} and compensated {compensated.shape}"
            raise AmiwarpError(f"{given}; give (n, 2), (n,) and (n, 2)")
        shift = compensated - xy
        valid = np.isfinite(shift).all(axis=1)
        basis = _polynomials(camera, xy[valid], degree)
        angle = theta[valid][:, None]
        design = np.hstack([basis, basis * np.cos(angle), basis * np.sin(angle)])
        solution, _, rank, _ = np.linalg.lstsq(design, shift[valid], rcond=None)
        if rank < design.shape[1]:
            raise AmiwarpError(
                f"{len(design)} pairs determine {rank} of {design.shape[1]} coefficients; "
                f"spread them over the image and the angles, or lower degree = {degree}"
            )
        rows, cols = np.mgrid[: camera.height, : camera.width]
        pixels = _polynomials(camera, np.stack([cols.ravel(), rows.ravel()], axis=1).astype(np.float64), degree)
        shape = (3, camera.height, camera.width, 2)
        tables = np.stack([pixels @ part for part in np.split(solution, 3)]).reshape(shape).astype(np.float32)
        return cls(camera, tables[0], tables[1], tables[2])

    def kernel_values(self) -> tuple[Any, ...]:
        return *phase_values(self.phase), np.concatenate([self.offset, self.cosine, self.sine], axis=2)

    @cached_property
    def _tables(self) -> dict[str, Any]:
        return {}

    def params(self, device: Any) -> Any:
        if str(device) not in self._tables:
            *phase, table = self.kernel_values()
            on_device = wp.array(table, dtype=float, device=device)
            self._tables[str(device)] = struct_of(EllipseParams, [*phase, on_device])
        return self._tables[str(device)]


def _polynomials(camera: Camera, xy: NDArray[np.float64], degree: int) -> NDArray[np.float64]:
    """Return products of Chebyshev polynomials of total degree ≤ ``degree``, with pixels scaled to [-1, 1].

    The shape is (n, terms).
    """
    scaled = 2.0 * xy / np.maximum([camera.width - 1.0, camera.height - 1.0], 1.0) - 1.0
    full = np.polynomial.chebyshev.chebvander2d(scaled[:, 0], scaled[:, 1], [degree, degree])
    return cast("NDArray[np.float64]", full.reshape(len(xy), degree + 1, degree + 1)[:, _triangle(degree)])


def _triangle(degree: int) -> NDArray[np.bool_]:
    i = np.arange(degree + 1)
    return i[:, None] + i[None, :] <= degree
