"""Sharpness on turns that were held out: what a model fitted to half of the turns makes of the other half."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from amiwarp.calib.sharpness.curvature import STEP_PX, differences
from amiwarp.calib.sharpness.objective import padding
from amiwarp.imaging.choices import Sharpness
from amiwarp.imaging.device_events import upload_events
from amiwarp.imaging.sharpness_costs import SharpnessMeter
from amiwarp.imaging.warped_image import CanvasShape, Votes

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from amiwarp.calib.parameters import ParameterSpace
    from amiwarp.calib.sharpness.search import Material
    from amiwarp.events.events import Events
    from amiwarp.optics.models import Model

    Vector = NDArray[np.float64]

FEWEST_TURNS = 2.0
SPANS = 32
"""Under two turns: alternate spans of so many are held out."""
SMOOTHING_PX = 0.6
"""Of the images: less than calibration's, since small differences between good models are to be seen."""
LONGEST_STEP_PX = 0.5
LEAST_CURVED = 1e-2
"""Of the largest curvature: along less, no step is taken."""
PARTS = 8
"""Disjoint parts of a half, whose scatter tells chance from signal."""


def halves(material: Material) -> tuple[Events, Events]:
    """Every other turn of the events, and the turns between; of under two turns every other of :data:`SPANS` spans."""
    events = material.events
    angle = material.encoder.angle_at(events.t)
    turned = np.abs(angle - angle[0])
    whole = float(turned.max())
    span = math.tau if whole >= FEWEST_TURNS * math.tau else whole / SPANS
    odd = (turned / span).astype(np.int64) % 2 == 1
    return events[np.flatnonzero(~odd)], events[np.flatnonzero(odd)]


class Half:
    """Sharpness of one half of the events, in disjoint parts, under any model."""

    def __init__(self, events: Events, material: Material, space: ParameterSpace, device: Any) -> None:
        """``space``: the largest."""
        slope = None if material.slope_of is None else material.slope_of(events.t)
        middle = space.middle_us if space.moving else None
        uploaded = upload_events(events, material.encoder, device, slope=slope, middle_us=middle)
        self._events = uploaded.in_parts(PARTS, per_polarity=False)
        camera = space.camera
        canvas = CanvasShape(camera.width, camera.height, padding(space), parts=PARTS, dither=True)
        self._votes = Votes(canvas, device)
        self._meter = SharpnessMeter(canvas, Sharpness.VARIANCE, smoothing=SMOOTHING_PX, device=device)
        self.fastest: dict[str, float] = {}
        """By kind of model, least time of an event's angle, displacement and vote [s]."""

    def each(self, space: ParameterSpace, values: Mapping[str, float], model: Model | None = None) -> Vector:
        """Sharpness of each part, shape (PARTS,); ``model``: that of the values, where it was built before."""
        model = model or space.build(values)
        device = self._meter.device
        model.params(device)  # an ellipse's tables are made once for all events
        self._votes.clear()
        wp.synchronize_device(device)
        began = time.perf_counter()
        self._votes.add_events(
            model, self._events, drift=space.drift(values), camera_rotation=space.camera_rotation(values)
        )
        wp.synchronize_device(device)
        took = (time.perf_counter() - began) / max(self._events.count, 1)
        self.fastest[space.model] = min(took, self.fastest.get(space.model, math.inf))
        self._votes.read(self._meter.image)
        self._meter.launch()
        return np.array(self._meter.results())


def slope(half: Half, space: ParameterSpace, v: Vector) -> Vector:
    """Of the sharpness at a point of a space [1/px]."""
    steps = STEP_PX * np.eye(len(v))
    rise = [half.each(space, space.to_values(v + h)) - half.each(space, space.to_values(v - h)) for h in steps]
    return np.asarray(np.mean(rise, axis=1) / (2.0 * STEP_PX))


@dataclass(frozen=True)
class Quadratic:
    """Sharpness about a point of a space along some directions, by differences over :data:`STEP_PX`."""

    slopes: Vector
    """Of each part, shape (n, parts) [1/px]."""
    hessian: Vector
    """Of their mean, shape (n, n) [1/px²]."""

    @classmethod
    def about(cls, half: Half, space: ParameterSpace, v: Vector, directions: Vector) -> Quadratic:
        """``directions``: rows of vectors that each move events by a pixel, shape (n, entries of the space)."""
        return cls(*differences(lambda shift: half.each(space, space.to_values(v + shift)), directions))

    def of(self, which: list[int]) -> Quadratic:
        return Quadratic(self.slopes[which], self.hessian[np.ix_(which, which)])

    def top(self, slope: Vector | None = None) -> Vector:
        """The way to the sharpest point [px], no longer than :data:`LONGEST_STEP_PX`; none along what is not curved.

        ``slope``: of another model of the same curvature, in place of its own.
        """
        values, vectors = np.linalg.eigh(-self.hessian)
        along = vectors.T @ (self.slopes.mean(axis=1) if slope is None else slope)
        floor = LEAST_CURVED * max(float(values.max()), 1e-12)
        step = vectors @ np.where(values > floor, along / np.maximum(values, floor), 0.0)
        return np.asarray(step * min(1.0, LONGEST_STEP_PX / max(float(np.linalg.norm(step)), 1e-12)))

    @property
    def curvature(self) -> float:
        """Mean of the curvatures [1/px²]."""
        return -float(np.trace(self.hessian)) / len(self.hessian)

    def deviations(self) -> Vector:
        """Standard deviation along each direction, the others left to follow [px]: the sandwich estimate."""
        values, vectors = np.linalg.eigh(-self.hessian)
        floor = LEAST_CURVED * max(float(values.max()), 1e-12)
        inverse = vectors @ np.diag(1.0 / np.maximum(values, floor)) @ vectors.T
        scatter = np.atleast_2d(np.cov(self.slopes)) / self.slopes.shape[1]
        return np.asarray(np.sqrt(np.diag(inverse @ scatter @ inverse)))
