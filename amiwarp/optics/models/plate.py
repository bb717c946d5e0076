"""Plate model: the camera sees from a centre that moves on a circle."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Self

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.kernels import plate as plate_kernels
from amiwarp.kernels.launch import launch
from amiwarp.optics.camera import Camera
from amiwarp.optics.models.base import Model, model_camera
from amiwarp.optics.models.parameter import PHASE, Parameter
from amiwarp.optics.models.several import compensate_by_each
from amiwarp.optics.models.structs import phase_values, points_on_host, struct_of
from amiwarp.optics.prism import Plate, Prism, check_angles, check_phase
from amiwarp.schema.calls import guarded
from amiwarp.validation import array, instance, one_of, real

NOMINAL_INVERSE_DEPTH = 2.0
"""Inverse depth with which a search starts [1/m]."""
LARGEST_INVERSE_DEPTH = 20.0
"""Upper limit of inverse depths [1/m]."""
FACTOR_COLUMNS = 13
FACTOR_ROWS = 10
FACTOR_ANGLES = 8
"""Numbers of columns and rows of pixels, and of angles of a turn, at which orbits through two lenses are compared."""
LARGEST_WEDGE = math.radians(0.5)
"""Default bound of the angle between a plate's faces [rad]. Stock windows have 1 arcmin or less."""


@guarded
@dataclass(frozen=True, eq=False)
class PlateModel(Model):
    """Plate model: the camera sees each ray from a centre that the plate moves on a circle.

    The direction of a ray does not change. So a scene at infinity does not move, and the orbit of a point is
    proportional to its inverse depth: one for all pixels, or one for each (:attr:`depths`).

    Raises
    ------
    AmiwarpError
        If an inverse depth is not between 0 and 20 / m, the map of inverse depths does not have the camera's size, or
        another field has an unusable value.

    Notes
    -----
    A bearing u sees along the line from g N, where N = (sin α · w, cos α) is the normal of the faces at φ = θ + θ_b,
    and g = t (1 − c / √(n² − 1 + c²)) with c = u · N. A point of inverse depth ρ on it appears at
    u_xy + ρ g (N_xy u_z − N_z u_xy), with u_z unchanged. Faces that are not parallel change u before, by Snell's law.
    See ``docs/explanation/optics.md``.

    Examples
    --------
    >>> import math
    >>> import numpy as np
    >>> camera = amiwarp.Camera(width=640, height=480, fx=554.0, fy=554.0, cx=320.0, cy=240.0)
    >>> model = amiwarp.PlateModel(camera, amiwarp.Plate(0.01, math.radians(45.0)), inverse_depth=2.0)
    >>> model.compensate_points(np.array([[320.0, 240.0]]), np.array([0.0])).round(1)
    array([[323.7, 240. ]])
    """

    NAME = "plate"
    TEXT = "tilted plate"
    NUMBERS = "4, plate given"
    STRUCT = plate_kernels.PlateParams
    GLASS = Plate
    PARAMETERS = (
        Parameter(
            "inverse_depth",
            "1/m",
            1.0,
            limits=(0.0, LARGEST_INVERSE_DEPTH),
            label="inverse depth",
            slider=(0.0, 5.0, 0.01),
        ),
        PHASE,
        Parameter("wedge_x", "rad", LARGEST_WEDGE, fine=True),
        Parameter("wedge_y", "rad", LARGEST_WEDGE, fine=True),
    )

    camera: Camera
    """Camera intrinsics."""
    plate: Plate
    """Plate that shifts the rays."""
    phase: float = 0.0
    """Phase θ_b, added to the encoder's angle [rad]."""
    inverse_depth: float = 0.0
    """Inverse depth of the scene [1/m], as seen from the resting centre; 0: the plate moves nothing."""
    depths: NDArray[np.float32] | None = field(default=None, repr=False)
    """Inverse depth of what each pixel sees [1/m], shape ``(height, width)``, instead of :attr:`inverse_depth`."""
    wedge: tuple[float, float] = (0.0, 0.0)
    """Angle between the faces, along the tilt and across it [rad]: the normal of the face to the scene leans by it."""

    def __post_init__(self) -> None:
        instance(self.camera, Camera, "camera")
        instance(self.plate, Plate, "plate")
        object.__setattr__(self, "phase", check_phase(self.phase))
        object.__setattr__(self, "wedge", check_angles(self.wedge, "wedge"))
        largest = LARGEST_INVERSE_DEPTH
        inverse_depth = real(self.inverse_depth, "inverse_depth", 0.0, largest, " 1/m")
        object.__setattr__(self, "inverse_depth", inverse_depth)
        if self.depths is None:
            return
        table = array(self.depths, "depths")
        size = (self.camera.height, self.camera.width)
        if table.shape != size:
            raise AmiwarpError(
                f"depths has shape {table.shape}; expected {size}, the camera's rows and columns"
            )
        if not ((table >= 0.0) & (table <= largest)).all():
            raise AmiwarpError(
                f"depths has values outside 0 .. {largest:g} 1/m; give the inverse depth of each pixel"
            )
        object.__setattr__(self, "depths", table.astype(np.float32, copy=False))

    @classmethod
    def start_values(cls, prism: Prism | Plate) -> dict[str, float]:
        return {cls.SIZE: NOMINAL_INVERSE_DEPTH, PHASE.name: 0.0, "wedge_x": 0.0, "wedge_y": 0.0}

    @classmethod
    def default_bounds(
        cls, name: str, value: float, camera: Camera, prism: Prism | Plate
    ) -> tuple[float, float]:
        if one_of(name, cls.FREE, "name") == cls.SIZE:
            return 0.0, 2.0 * NOMINAL_INVERSE_DEPTH
        return super().default_bounds(name, value, camera, prism)

    @classmethod
    def _of_values(cls, camera: Camera, prism: Prism | Plate, values: Mapping[str, float]) -> Self:
        if not isinstance(prism, Plate):
            raise AmiwarpError(
                "the plate model needs the plate's thickness and tilt; give a Plate as the glass"
            )
        wedge = values.get("wedge_x", 0.0), values.get("wedge_y", 0.0)
        return cls(camera, prism, values["phase"], values["inverse_depth"], wedge=wedge)

    @classmethod
    def still_values(cls, values: Mapping[str, float]) -> dict[str, float]:
        return {**super().still_values(values), "wedge_x": 0.0, "wedge_y": 0.0}

    def with_depths(self, depths: NDArray[Any]) -> PlateModel:
        """Return this model with the inverse depth of what each pixel sees.

        Parameters
        ----------
        depths : numpy.ndarray
            Inverse depths [1/m], shape ``(height, width)``.

        Returns
        -------
        PlateModel
            The model.
        """
        return replace(self, depths=np.asarray(depths))

    def kernel_values(self) -> tuple[Any, ...]:
        sine = math.sin(self.plate.tilt)
        cosine = math.cos(self.plate.tilt)
        inside = self.plate.index**2 - 1.0
        thickness = self.plate.thickness
        wedge = np.array(self.wedge)
        phase = phase_values(self.phase)
        return *phase, thickness, inside, sine, cosine, self.inverse_depth, wedge

    def params(self, device: Any) -> Any:
        plate = self._plate_params()
        if self.depths is None:
            return plate
        name = str(device)
        if name not in self._depths_on:
            self._depths_on[name] = wp.array(self.depths, dtype=float, device=device)
        values = [*phase_values(self.phase), plate, self._depths_on[name]]
        return struct_of(plate_kernels.PlateMapParams, values)

    def _plate_params(self) -> Any:
        *numbers, wedge = self.kernel_values()
        return struct_of(plate_kernels.PlateParams, [*numbers, wp.vec2(*wedge.tolist())])

    @cached_property
    def _depths_on(self) -> dict[str, Any]:
        """The depths on each device where they were asked for."""
        return {}

    def compensate_at(
        self, xy: NDArray[Any], theta: NDArray[Any], inverse_depth: NDArray[Any]
    ) -> NDArray[np.float64]:
        """Return the pixel without the plate of points at known depths.

        Parameters
        ----------
        xy : numpy.ndarray
            Observed pixels [px], shape (n, 2).
        theta : numpy.ndarray
            Plate angle of the encoder [rad], shape (n,).
        inverse_depth : numpy.ndarray
            Inverse depth of what each pixel sees [1/m], shape (n,).

        Returns
        -------
        numpy.ndarray
            Compensated pixels [px], shape (n, 2). A row is NaN as in :meth:`compensate_points`, or if its inverse depth
            is NaN or infinite.
        """
        xy = array(xy, "xy")
        theta = array(theta, "theta")
        rho = array(inverse_depth, "inverse_depth")
        if xy.ndim != 2 or xy.shape[1] != 2 or not theta.shape == rho.shape == xy.shape[:1]:
            given = f"xy has shape {xy.shape}, theta {theta.shape} and inverse_depth {rho.shape}"
            raise AmiwarpError(f"{given}; give (n, 2), (n,) and (n,)")
        pixels, angles = points_on_host(xy, theta)
        depths = wp.array(rho.astype(np.float32), dtype=float, device="cpu")
        out = wp.empty_like(pixels)
        inputs = [self._plate_params(), model_camera(self, "cpu"), pixels, angles, depths]
        launch(plate_kernels.compensate_at_depths, len(out), inputs, [out], device="cpu")
        return np.asarray(out.numpy(), np.float64)


def depth_factors(given: PlateModel, other: PlateModel) -> NDArray[np.float64]:
    """Return by which factor the inverse depth of each pixel differs if its orbit is as large through another lens.

    Parameters
    ----------
    given : PlateModel
        Model with the lens for which inverse depths are known, and with their mean.
    other : PlateModel
        The same model with the other lens.

    Returns
    -------
    numpy.ndarray
        The factors, shape ``(height, width)``; 1 near pixels that have no ray in one of the lenses.
    """
    # A few orbits suffice: a lens changes them smoothly over the image.
    camera = given.camera
    columns = np.linspace(0.0, camera.width - 1.0, FACTOR_COLUMNS)
    rows = np.linspace(0.0, camera.height - 1.0, FACTOR_ROWS)
    x, y = np.meshgrid(columns, rows)
    knots = np.stack([x.ravel(), y.ravel()], axis=1)
    turn = np.arange(FACTOR_ANGLES) * (math.tau / FACTOR_ANGLES)
    xy = np.repeat(knots, FACTOR_ANGLES, axis=0)
    theta = np.tile(turn, len(knots))
    planes = [replace(model, depths=None, wedge=(0.0, 0.0)) for model in (given, other)]
    moved = compensate_by_each(planes, xy, theta)
    by_knot = moved.reshape(2, len(knots), FACTOR_ANGLES, 2)
    orbits = by_knot - by_knot.mean(axis=2, keepdims=True)

    # The factor that makes the other orbit most like the given one.
    likeness, square = np.sum(orbits * orbits[1], axis=(2, 3))
    known = np.isfinite(likeness) & (square > 0.0)
    factors = np.divide(likeness, square, out=np.ones(len(knots)), where=known)
    table = factors.reshape(FACTOR_ROWS, FACTOR_COLUMNS)
    by_row = _linear_weights(camera.height, FACTOR_ROWS)
    by_column = _linear_weights(camera.width, FACTOR_COLUMNS)
    return np.asarray(by_row @ table @ by_column.T)


def _linear_weights(count: int, knots: int) -> NDArray[np.float64]:
    """Return the weights of evenly spaced knots at pixels, for linear interpolation, shape ``(count, knots)``."""
    place = np.linspace(0.0, knots - 1.0, count)
    distance = np.abs(place[:, None] - np.arange(knots))
    return np.maximum(0.0, 1.0 - distance)
