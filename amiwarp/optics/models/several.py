"""Pixels compensated by several models at once."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.kernels.launch import RecordedLaunch
from amiwarp.kernels.refraction import compensate_points
from amiwarp.optics.models.base import Model, model_camera


def compensate_by_each(
    models: Sequence[Model],
    xy: NDArray[Any],
    theta: NDArray[Any],
) -> NDArray[np.float64]:
    """Return the same pixels compensated by each of several models, on the CPU [px], shape (models, n, 2).

    ``xy`` holds the pixels, shape (n, 2). ``theta`` holds the angles of the first prism, wrapped to a turn [rad], shape
    (n,), or (models, n) if each model has its own. One call takes a fraction of the time of a call for each model.
    Successive places of one model share a launch.
    """
    count = len(xy)
    repeated = np.tile(xy.astype(np.float32), (len(models), 1))
    pixels = wp.array(repeated, dtype=wp.vec2, device="cpu", copy=False)
    all_angles = _all_angles(models, theta, count)
    angles = wp.array(all_angles.ravel(), dtype=float, device="cpu", copy=False)

    out = wp.empty_like(pixels)
    launches: dict[type, tuple[RecordedLaunch, Any]] = {}  # each with the camera of its last model
    for _, group in groupby(range(len(models)), key=lambda k: id(models[k])):
        places = list(group)  # successive places of one model
        first = places[0]
        model = models[first]
        params = model.params("cpu")
        camera = model_camera(model, "cpu")
        compensate, last_camera = launches.get(type(model), (None, None))
        if compensate is None:
            inputs = [params, camera, pixels, angles, 0]
            compensate = RecordedLaunch(compensate_points, inputs, [out], device="cpu")
        else:
            compensate.set(0, params)
            if camera is not last_camera:
                compensate.set(1, camera)
        launches[type(model)] = compensate, camera
        compensate(first * count, len(places) * count)
    moved = out.numpy().reshape(len(models), count, 2)
    return moved.astype(np.float64)


def _all_angles(models: Sequence[Model], theta: NDArray[Any], count: int) -> NDArray[np.float32]:
    """Return the angles for each model at each pixel, with both angles of a pair."""
    angles = np.empty((len(models), count), np.float32)
    angles[:] = theta
    if not models or models[0].ANGLES == 1:
        return angles
    both = []  # a pair is compared with pairs only
    for model, first in zip(models, angles, strict=True):
        both.append(model.all_angles(first))
    return np.stack(both).astype(np.float32)
