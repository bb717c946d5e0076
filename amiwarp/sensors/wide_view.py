"""Views of renderers that take no rays: a larger picture without the optic, in which rays are looked up."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import warp as wp

from amiwarp.errors import AmiwarpError
from amiwarp.kernels import scene_rays
from amiwarp.kernels.camera import camera_params
from amiwarp.kernels.launch import launch
from amiwarp.optics.camera import Camera
from amiwarp.optics.models.base import Model
from amiwarp.sensors.rays import Rays

ANGLES = 48
"""Number of angles of a turn at which the edge of the image is looked for."""
LARGEST_TANGENT = 4.0
"""Largest tangent of a ray from the axis: beyond, a flat picture has too few pixels at its middle."""


def wide_camera(camera: Camera, optic: Model | None, supersampling: float = 2.0) -> Camera:
    """Return the pinhole camera whose picture shows what a camera sees through an optic at any angle.

    ``supersampling``: focal length of the picture relative to the camera's. Raises :class:`AmiwarpError` if the camera
    sees too far from its axis for a flat picture.
    """
    x, y = np.meshgrid(np.arange(camera.width + 1) - 0.5, np.arange(camera.height + 1) - 0.5)
    edge = np.zeros(x.shape, bool)
    edge[[0, -1]] = True
    edge[:, [0, -1]] = True
    pixels = np.stack([x[edge], y[edge]], axis=1)
    seen = [pixels]
    if optic is not None:
        for angle in np.arange(ANGLES) * (math.tau / ANGLES):
            for other in (angle, angle + 0.5 * math.pi, angle + math.pi):
                both = [angle] if optic.ANGLES == 1 else [angle, other]
                theta = np.tile(np.array(both), (len(pixels), 1))
                moved = optic.compensate_points(pixels, theta[:, 0] if optic.ANGLES == 1 else theta)
                seen.append(moved)
                if optic.ANGLES == 1:
                    break
    rays = camera.pixels_to_rays(np.concatenate(seen))
    rays = rays[np.isfinite(rays).all(axis=1)]
    with np.errstate(divide="ignore", invalid="ignore"):
        tangents = np.abs(rays[:, :2] / rays[:, 2:])
    if not len(rays) or not (rays[:, 2] > 0.0).all() or tangents.max() > LARGEST_TANGENT:
        raise AmiwarpError(
            "the camera sees further than 76 deg from its axis, for which no flat picture has enough pixels; give a "
            "camera with a smaller field of view"
        )
    focal = supersampling * max(camera.fx, camera.fy)
    half = np.ceil(tangents.max(axis=0) * focal).astype(int) + 2
    width, height = (2 * half).tolist()
    return Camera(width, height, focal, focal, half[0] - 0.5, half[1] - 0.5)


def look_up(
    pictures: wp.array, wide: Camera, rays: Rays, axes: tuple[int, int, int], factor: float = 1.0
) -> wp.array:
    """Return what rays see in pictures, averaged over the rays of each pixel: vec3, shape (cameras, height, width).

    ``pictures``: of the camera ``wide``, vec3, shape (cameras, rows, columns). Only directions count, which is exact
    for what is far away. ``factor``: linear luminance of a value of 1.
    """
    cameras = len(pictures)
    height, width = rays.values.shape[0] // rays.bundles, rays.values.shape[1]
    out = wp.empty((cameras, height, width), dtype=wp.vec3, device=pictures.device)
    params: Any = camera_params(wide, str(pictures.device))
    inputs = [
        rays.values.flatten(),
        rays.bundles,
        rays.samples,
        params,
        wp.vec3(*axes),
        factor,
        pictures,
    ]
    launch(scene_rays.look_up_rays, out.size, inputs, [out.flatten()], device=pictures.device)
    return out
