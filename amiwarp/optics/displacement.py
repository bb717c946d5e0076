"""Displacement of points by a model, for NumPy arrays and for Warp arrays on any device."""

from __future__ import annotations

import math
from itertools import groupby
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

import numpy as np
import warp as wp

from amiwarp.errors import AmiwarpError
from amiwarp.kernels import refraction as kernels
from amiwarp.kernels.launch import RecordedLaunch, launch
from amiwarp.optics.camera import Camera, camera_params
from amiwarp.validation import array

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

Points = TypeVar("Points")
"""Type of points given to a model: NumPy array (n, 2), or Warp array of vec2 of shape (n,). Results have the same type.
"""


class HasParams(Protocol):
    """Optical model with a camera and kernel parameters (protocol)."""

    @property
    def camera(self) -> Camera: ...

    def params(self, device: Any) -> Any: ...


class PointDisplacement:
    """Base class of the models: applies their device functions to arrays of points."""

    def compensate_points(self: HasParams, xy: Points, theta: Points) -> Points:
        """Return the pixel that the same scene ray would hit without the prism.

        Parameters
        ----------
        xy : numpy.ndarray or warp.array
            Observed pixels [px], shape (n, 2), or a Warp array of vec2 of shape (n,).
        theta : numpy.ndarray or warp.array
            Prism angle of the encoder [rad], shape (n,). A float32 Warp array on the same device if ``xy`` is one.

        Returns
        -------
        numpy.ndarray or warp.array
            Compensated pixels [px], of the same shape as ``xy``. A row is NaN if it has no ray: total internal
            reflection, or a ray behind the image plane.

        Raises
        ------
        AmiwarpError
            If the arrays have other shapes, types or devices.
        """
        return _run("compensate_points", self, xy, theta)

    def deflect_points(self: HasParams, xy: Points, theta: Points) -> Points:
        """Return the observed pixel of a scene ray, given its pixel without the prism.

        Inverse of :meth:`compensate_points`.

        Parameters
        ----------
        xy : numpy.ndarray or warp.array
            Pixels without the prism [px], shape (n, 2), or a Warp array of vec2 of shape (n,).
        theta : numpy.ndarray or warp.array
            Prism angle of the encoder [rad], shape (n,). A float32 Warp array on the same device if ``xy`` is one.

        Returns
        -------
        numpy.ndarray or warp.array
            Observed pixels [px], of the same shape as ``xy``. A row is NaN if it has no ray.

        Raises
        ------
        AmiwarpError
            If the arrays have other shapes, types or devices.
        """
        return _run("deflect_points", self, xy, theta)


def _run(kernel_name: str, model: HasParams, xy: Any, theta: Any) -> Any:
    kernel = getattr(kernels, kernel_name)
    if isinstance(xy, wp.array):
        if not isinstance(theta, wp.array) or theta.device != xy.device or theta.dtype is not wp.float32:
            raise AmiwarpError(
                f"xy is a Warp array on {xy.device}; give theta as a float32 Warp array on the same device"
            )
        if xy.dtype is not wp.vec2 or xy.ndim != 1 or xy.shape != theta.shape:
            given = f"xy has type {xy.dtype} and shape {xy.shape}, theta has shape {theta.shape}"
            raise AmiwarpError(f"{given}; give vec2 for xy, and shape (n,) for both")
        out = wp.empty_like(xy)
        launch(kernel, len(xy), [model.params(xy.device), model_camera(model, xy.device), xy, theta], [out],
               device=xy.device)  # fmt: skip
        return out
    xy, theta = array(xy, "xy"), array(theta, "theta")
    if xy.ndim != 2 or xy.shape[1] != 2 or theta.shape != xy.shape[:1]:
        raise AmiwarpError(f"xy has shape {xy.shape} and theta {theta.shape}; give (n, 2) and (n,)")
    result = _run(kernel_name, model, *points_on_host(xy, theta))
    return result.numpy().astype(xy.dtype if np.issubdtype(xy.dtype, np.floating) else np.float32, copy=False)


def compensate_by_each(models: Sequence[HasParams], xy: NDArray[Any], theta: NDArray[Any]) -> NDArray[np.float64]:
    """Return the same pixels compensated by each of several models, on the CPU [px], shape (models, n, 2).

    ``xy`` holds the pixels, shape (n, 2). ``theta`` holds the prism angles, wrapped to a turn [rad], shape (n,), or
    (models, n) if each model has its own. One call takes a fraction of the time of a call for each model. Successive
    places of one model share a launch.
    """
    n = len(xy)
    pixels = wp.array(np.tile(xy.astype(np.float32), (len(models), 1)), dtype=wp.vec2, device="cpu", copy=False)
    angles = np.empty((len(models), n), np.float32)
    angles[:] = theta
    points = [pixels, wp.array(angles.ravel(), dtype=float, device="cpu", copy=False)]
    out = wp.empty_like(pixels)
    launches: dict[type, RecordedLaunch] = {}
    for _, group in groupby(range(len(models)), key=lambda k: id(models[k])):
        same = list(group)  # successive places of one model
        model = models[same[0]]
        arguments = [model.params("cpu"), model_camera(model, "cpu")]
        compensate = launches.get(type(model))
        if compensate is None:
            compensate = RecordedLaunch(kernels.compensate_points, [*arguments, *points, 0], [out], device="cpu")
            launches[type(model)] = compensate
        for index, value in enumerate(arguments):
            compensate.set(index, value)
        compensate(same[0] * n, len(same) * n)
    return out.numpy().reshape(len(models), n, 2).astype(np.float64)


def rms(moved: NDArray[np.float64]) -> float:
    """Return the root mean square length of displacements [px], shape (n, 2), without those that are not finite."""
    squares = np.sum(moved**2, axis=1)
    return float(np.sqrt(np.mean(squares[np.isfinite(squares)])))


def points_on_host(xy: NDArray[Any], theta: NDArray[Any]) -> tuple[Any, Any]:
    """Return pixels, shape (n, 2), and prism angles [rad], shape (n,), as Warp arrays on the CPU."""
    wrapped = wrap_angle(theta).astype(np.float32)
    return wp.array(xy.astype(np.float32), dtype=wp.vec2, device="cpu"), wp.array(wrapped, dtype=float, device="cpu")


def wrap_angle(angle: NDArray[np.float64]) -> NDArray[np.float64]:
    """Wrap an angle [rad] to [-pi, pi) in float64. Wrap angles before they are rounded to float32."""
    return (np.asarray(angle, dtype=np.float64) + np.pi) % (2.0 * np.pi) - np.pi


def model_camera(model: HasParams, device: Any) -> Any:
    """Return the parameters of the model's camera on ``device``, cached per camera."""
    return camera_params(model.camera, str(device))


def phase_values(phase: float) -> tuple[float, float, float]:
    """Return a phase [rad] with its cosine and sine: three fields of a model's parameters for kernels."""
    return phase, math.cos(phase), math.sin(phase)


def struct_of(kind: Any, values: Sequence[Any]) -> Any:
    """Return a Warp struct with the given values of its fields, in their order."""
    struct = kind()
    for name, value in zip(kind.vars, values, strict=True):
        setattr(struct, name, value)
    return struct
