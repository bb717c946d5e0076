"""True images of warped events: float64 NumPy, with angles from event times and positions by independent formulas.

The positions come from the oracle in ``reference/optics.py``.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter

from amiwarp import Vote
from benchmarks.scenes import MARGIN, PHASE, Array, EventScene, in_chunks
from reference import optics as oracle

Floats = NDArray[np.floating[Any]]

HARMONIC_ANGLES = 16
"""Number of angles for the least-squares fit of the ellipses."""


def places(scene: EventScene, model: str, xy: Array, theta: Array) -> Array:
    """Return the true compensated positions of events [px], shape ``(n, 2)``."""
    if model == "plane circle":
        return xy - scene.radius * np.stack([np.cos(theta), np.sin(theta)], axis=1)
    if model == "ellipse":
        table = scene.keep("ellipse", lambda: _ellipses(scene))[
            xy[:, 1].astype(int), xy[:, 0].astype(int)
        ]
        return (
            xy
            + table[:, 0]
            + table[:, 1] * np.cos(theta + PHASE)[:, None]
            + table[:, 2] * np.sin(theta + PHASE)[:, None]
        )
    return oracle.place(model, scene.camera, scene.prism, xy, theta, phase=PHASE)


def _ellipses(scene: EventScene) -> Array:
    """Return mean and first harmonic of each pixel's exact displacement [px], shape ``(height, width, 3, 2)``."""
    width, height = scene.camera.width, scene.camera.height
    xy = (
        np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1)
        .reshape(-1, 2)
        .astype(np.float64)
    )

    def moments(k: int) -> Array:
        phi = 2.0 * np.pi * k / HARMONIC_ANGLES
        d = places(scene, "exact", xy, np.full(len(xy), phi - PHASE)) - xy
        return np.stack([d, 2.0 * np.cos(phi) * d, 2.0 * np.sin(phi) * d], axis=1) / HARMONIC_ANGLES

    return np.sum([moments(k) for k in range(HARMONIC_ANGLES)], axis=0).reshape(height, width, 3, 2)


def votes(xy: Array, width: int, height: int) -> dict[Vote, Array]:
    """Return images with both kinds of vote (nearest, bilinear) [events per pixel].

    Parts of a vote outside the image are dropped.
    """
    columns, rows = width + 2 * MARGIN, height + 2 * MARGIN
    inner = (slice(MARGIN, -MARGIN), slice(MARGIN, -MARGIN))
    u, v = (xy + MARGIN).T

    def count(i: Array, j: Array, weights: Array | None = None) -> Any:
        return np.bincount(j.astype(np.intp) * columns + i.astype(np.intp), weights, rows * columns)

    i, j = np.floor(u), np.floor(v)
    fx, fy = u - i, v - j
    bilinear = count(i, j, (1.0 - fx) * (1.0 - fy)) + count(i + 1, j, fx * (1.0 - fy))
    bilinear += count(i, j + 1, (1.0 - fx) * fy) + count(i + 1, j + 1, fx * fy)
    nearest = count(np.floor(u + 0.5), np.floor(v + 0.5))
    return {
        Vote.BILINEAR: bilinear.reshape(rows, columns)[inner],
        Vote.NEAREST: nearest.reshape(rows, columns)[inner].astype(np.float64),
    }


def images(scene: EventScene, model: str) -> dict[Vote, Array]:
    """Return the true images of all events, one for each kind of vote."""
    camera, e = scene.camera, scene.events

    def part(start: int, stop: int) -> dict[Vote, Array]:
        xy = np.stack([e.x[start:stop], e.y[start:stop]], axis=1).astype(np.float64)
        return votes(places(scene, model, xy, scene.theta[start:stop]), camera.width, camera.height)

    def total() -> dict[Vote, Array]:
        if model == "ellipse":
            scene.keep("ellipse", lambda: _ellipses(scene))  # once, before the threads start
        parts = in_chunks(part, len(e))
        return {vote: np.sum([p[vote] for p in parts], axis=0) for vote in Vote}

    return scene.keep(("images", model), total)


def iwe_errors(
    scene: EventScene, model: str, vote: Vote, image: Floats, found: Floats
) -> dict[str, float]:
    """Return the errors of an image, and of the positions ``found`` of the scene's sample.

    ``rms_events``, ``max_events``: difference between a pixel and the true image [events]. ``misplaced``: share of all
    votes that went to a wrong pixel. ``local``: largest ratio of a difference to the largest true value in its
    neighbourhood plus 10 events. ``exact_px``: rms distance of ``found`` to the positions of the exact model [px].
    """
    away = found - places(scene, "exact", *scene.sample())
    errors = image_errors(images(scene, model)[vote], image)
    return errors | {"exact_px": float(np.sqrt(np.mean(np.sum(away**2, axis=1))))}


def image_errors(true: Array, image: Floats) -> dict[str, float]:
    """Return the errors of an image; see :func:`iwe_errors`."""
    difference = np.abs(image.astype(np.float64) - true)
    return {
        "rms_events": float(np.sqrt(np.mean(difference**2))),
        "max_events": float(difference.max()),
        "misplaced": float(difference.sum() / (2.0 * true.sum())),
        "local": float((difference / (10.0 + maximum_filter(true, 3))).max()),
    }
