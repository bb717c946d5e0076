"""Ellipse model: tables of the displacement for every pixel, fitted to another model or to measured pairs of pixels."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Self, cast

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.kernels.ellipse import EllipseParams, fit_harmonics
from amiwarp.kernels.launch import launch
from amiwarp.optics.camera import LARGEST_SIZE, Camera
from amiwarp.optics.models.base import Model, model_camera
from amiwarp.optics.models.exact import ExactModel
from amiwarp.optics.models.structs import phase_values, struct_of
from amiwarp.optics.prism import Plate, Prism, check_phase
from amiwarp.schema.calls import guarded
from amiwarp.validation import array, instance, whole

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

    NAME = "ellipse"
    TEXT = "ellipse (table)"
    NUMBERS = "6 a pixel"
    STRUCT = EllipseParams
    PARAMETERS = ExactModel.PARAMETERS
    SIMPLIFIES = "exact"

    camera: Camera
    """Camera intrinsics."""
    offset: NDArray[np.float32] = field(repr=False)
    """Mean displacement [px], shape ``(height, width, 2)``. In all tables, NaN marks a pixel without a ray."""
    cosine: NDArray[np.float32] = field(repr=False)
    """Cosine term of the displacement [px], shape ``(height, width, 2)``."""
    sine: NDArray[np.float32] = field(repr=False)
    """Sine term of the displacement [px], shape ``(height, width, 2)``."""
    phase: float = 0.0
    """Phase θ_b, added to the encoder's angle [rad]."""

    def __post_init__(self) -> None:
        instance(self.camera, Camera, "camera")
        object.__setattr__(self, "phase", check_phase(self.phase))
        shape = (self.camera.height, self.camera.width, 2)
        for name in ("offset", "cosine", "sine"):
            table = array(getattr(self, name), name)
            if table.shape != shape:
                raise AmiwarpError(
                    f"{name} has shape {table.shape}; expected {shape}, the camera's rows and columns"
                )
            if np.isinf(table).any():
                raise AmiwarpError(
                    f"{name} holds an infinite displacement; give NaN for a pixel without a ray"
                )
            object.__setattr__(self, name, table.astype(np.float32, copy=False))

    @classmethod
    def closed_form(cls) -> type[Model]:
        return ExactModel

    @classmethod
    def _of_values(cls, camera: Camera, prism: Prism | Plate, values: Mapping[str, float]) -> Self:
        exact = ExactModel.from_values(camera, prism, values)
        return cls.from_model(exact)

    @classmethod
    def from_model(cls, model: Model, device: Any = "cpu") -> Self:
        """Fit the tables to another model, by least squares over 16 angles for each pixel.

        Parameters
        ----------
        model : Model
            The model to approximate: one of a single prism or plate, other than the ellipse model.
        device : str or warp.Device, default "cpu"
            The device that does the fit.

        Returns
        -------
        EllipseModel
            The model. Its tables are NaN at pixels without a ray.

        Raises
        ------
        AmiwarpError
            If the model is of another optic, or an ellipse model.
        """
        if model.ANGLES != 1 or not model.PRISM or isinstance(model, EllipseModel):
            raise AmiwarpError(
                f"the {model.NAME} model cannot be fitted by ellipses; give a model of one prism"
            )
        height = model.camera.height
        width = model.camera.width
        table = wp.empty((height, width, 6), dtype=float, device=device)
        phi = math.tau * np.arange(HARMONIC_ANGLES) / HARMONIC_ANGLES
        directions = np.stack([np.cos(phi), np.sin(phi)], axis=1)
        angles = wp.array(directions, dtype=wp.vec2, device=device)
        # The tables do not contain the phase: it is added to the angle.
        in_phase = replace(cast("Any", model), phase=0.0)
        inputs = [in_phase.params(device), model_camera(model, device), angles]
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
            The same points without the prism [px], shape (n, 2). Pairs with NaN or infinity in any array are left out.
        degree : int, default 4
            Total degree of the polynomials.

        Returns
        -------
        EllipseModel
            The model.

        Raises
        ------
        AmiwarpError
            If the pairs do not determine all coefficients, or a pixel is over 65,536 px away.
        """
        degree = whole(degree, "degree", 0, 20)
        pixels, angle, shift = _finite_pairs(xy, theta, compensated)

        # The displacement is linear in the coefficients: each table's polynomial, times 1, cos and sin of the angle.
        basis = _polynomials(camera, pixels, degree)
        by_cosine = basis * np.cos(angle)[:, None]
        by_sine = basis * np.sin(angle)[:, None]
        design = np.hstack([basis, by_cosine, by_sine])
        count = design.shape[1]
        solution, _, rank, _ = np.linalg.lstsq(design, shift, rcond=None)
        if rank < count:
            raise AmiwarpError(
                f"{len(design)} pairs determine {rank} of {count} coefficients; "
                f"spread them over the image and the angles, or lower degree = {degree}"
            )

        rows, columns = np.mgrid[: camera.height, : camera.width]
        all_pixels = np.stack([columns.ravel(), rows.ravel()], axis=1).astype(np.float64)
        at_pixels = _polynomials(camera, all_pixels, degree)
        shape = (camera.height, camera.width, 2)
        tables = []
        for coefficients in np.split(solution, 3):
            table = (at_pixels @ coefficients).reshape(shape)
            tables.append(table.astype(np.float32))
        offset, cosine, sine = tables
        return cls(camera, offset, cosine, sine)

    def kernel_values(self) -> tuple[Any, ...]:
        table = np.concatenate([self.offset, self.cosine, self.sine], axis=2)
        return *phase_values(self.phase), table

    @cached_property
    def _params(self) -> dict[str, Any]:
        """Parameters for kernels on each device where they were asked for: the table is copied there once."""
        return {}

    def params(self, device: Any) -> Any:
        name = str(device)
        if name not in self._params:
            *phase, table = self.kernel_values()
            on_device = wp.array(table, dtype=float, device=device)
            self._params[name] = struct_of(EllipseParams, [*phase, on_device])
        return self._params[name]


def _finite_pairs(
    xy: ArrayLike, theta: ArrayLike, compensated: ArrayLike
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return pixels [px], shape (n, 2), angles [rad], (n,), and displacements [px], (n, 2), of the finite pairs.

    Raises :class:`AmiwarpError` for other shapes, and if there are no finite pairs, or some beyond any image.
    """
    xy = np.asarray(xy, dtype=np.float64)
    theta = np.asarray(theta, dtype=np.float64)
    compensated = np.asarray(compensated, dtype=np.float64)
    are_pairs = xy.ndim == 2 and xy.shape[1] == 2 and compensated.shape == xy.shape
    if not are_pairs or theta.shape != xy.shape[:1]:
        given = f"xy has shape {xy.shape}, theta {theta.shape} and compensated {compensated.shape}"
        raise AmiwarpError(f"{given}; give (n, 2), (n,) and (n, 2)")

    shift = compensated - xy
    finite = np.isfinite(shift).all(axis=1) & np.isfinite(theta)
    if not finite.any():
        raise AmiwarpError(f"{len(xy)} pairs hold no finite values; give measured pairs of pixels")
    farthest_seen = np.abs(xy[finite]).max()
    farthest_compensated = np.abs(compensated[finite]).max()
    farthest = float(max(farthest_seen, farthest_compensated))
    if farthest > LARGEST_SIZE:
        raise AmiwarpError(
            f"a pair of pixels lies {farthest:g} px from the origin; give pixels within {LARGEST_SIZE} px, or NaN "
            "for points outside the image"
        )
    return xy[finite], theta[finite], shift[finite]


def _polynomials(camera: Camera, xy: NDArray[np.float64], degree: int) -> NDArray[np.float64]:
    """Return products of Chebyshev polynomials of total degree ≤ ``degree``, with pixels scaled to [-1, 1].

    The shape is (n, terms).
    """
    last_pixel = np.maximum([camera.width - 1.0, camera.height - 1.0], 1.0)
    scaled = 2.0 * xy / last_pixel - 1.0
    products = np.polynomial.chebyshev.chebvander2d(scaled[:, 0], scaled[:, 1], [degree, degree])
    by_degrees = products.reshape(len(xy), degree + 1, degree + 1)
    degrees = np.arange(degree + 1)
    total = degrees[:, None] + degrees[None, :]
    return cast("NDArray[np.float64]", by_degrees[:, total <= degree])
