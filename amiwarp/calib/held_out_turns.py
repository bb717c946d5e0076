"""Sharpness on held-out turns: models are fitted to half of the turns and measured on the other half."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.calib.calibration_events import CalibrationEvents
from amiwarp.calib.sharpness_objective import STEP_PX, finite_differences, padding
from amiwarp.choices import Sharpness
from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events.recording import Events
from amiwarp.imaging.canvas import CanvasShape
from amiwarp.imaging.sharpness import SharpnessMeter
from amiwarp.imaging.uploaded_events import upload_events
from amiwarp.imaging.votes import Votes
from amiwarp.results.parameters import ParameterSpace

Vector = NDArray[np.float64]

FEWEST_TURNS = 2.0
"""Number of turns in a recording from which whole turns are held out."""
SPANS = 32
"""Number of angle spans into which a recording of fewer than two turns is divided; every other span is held out."""
SMOOTHING_PX = 0.6
"""Standard deviation of the Gaussian that smooths the images [px]: small, to resolve differences of good models."""
LONGEST_STEP_PX = 0.5
"""Largest step towards the maximum of sharpness [px]."""
LEAST_CURVATURE_RATIO = 1e-2
"""Smallest curvature of sharpness, as a share of the largest, at which a step is taken along a direction."""
PARTS = 8
"""Number of disjoint parts of each half of the events, whose scatter measures the uncertainty."""


def split_turns(calibration_events: CalibrationEvents) -> tuple[Events, Events]:
    """Return the events of the even and of the odd turns, or of alternate spans if there are fewer than two turns."""
    events = calibration_events.events
    turned = calibration_events.encoder.angle_at(events.t)
    turned -= turned[0]  # in place: with ten million events, each array has 80 MB
    np.abs(turned, out=turned)
    total_rad = float(turned.max())
    if total_rad == 0.0:
        raise AmiwarpError(
            "the encoder stands still during the events; turn the prism",
            ErrorCode.CALIBRATION_REFUSED,
        )
    span_rad = math.tau if total_rad >= FEWEST_TURNS * math.tau else total_rad / SPANS
    turned /= span_rad
    odd = (turned.astype(np.int32) & 1).astype(np.bool_)
    del turned
    return events[np.flatnonzero(~odd)], events[np.flatnonzero(odd)]


class HalfSharpness:
    """Sharpness of one half of the events under any model, measured in disjoint parts."""

    def __init__(
        self,
        events: Events,
        calibration_events: CalibrationEvents,
        space: ParameterSpace,
        device: Any,
    ) -> None:
        """Upload the events. The canvas holds the displacements that the bounds of ``space`` allow."""
        slope_of = calibration_events.slope_of
        slope = None if slope_of is None else slope_of(events.t)
        middle = space.middle_us if space.moving else None
        uploaded = upload_events(
            events, calibration_events.encoder, device, slope=slope, middle_us=middle
        )
        self._events = uploaded.in_parts(PARTS, per_polarity=False)
        camera = space.camera
        canvas = CanvasShape(camera.width, camera.height, padding(space), parts=PARTS, dither=True)
        self._votes = Votes(canvas, device)
        self._meter = SharpnessMeter(
            canvas, Sharpness.VARIANCE, smoothing=SMOOTHING_PX, device=device
        )
        self.fastest_s: dict[str, float] = {}
        """Shortest measured time for one event's angle, displacement and vote [s], by name of the model."""

    def of_parts(self, space: ParameterSpace, values: Mapping[str, float]) -> Vector:
        """Return the sharpness of each part, shape (PARTS,), and note the time in :attr:`fastest_s`."""
        model = space.build(values)
        device = self._meter.device
        self._votes.clear()
        wp.synchronize_device(device)
        began = time.perf_counter()
        self._votes.add_events(
            model,
            self._events,
            drift=space.drift(values),
            camera_rotation=space.camera_rotation(values),
        )
        wp.synchronize_device(device)
        seconds_per_event = (time.perf_counter() - began) / max(self._events.count, 1)
        fastest_s = self.fastest_s.get(space.model, math.inf)
        self.fastest_s[space.model] = min(seconds_per_event, fastest_s)
        self._votes.read(self._meter.image)
        self._meter.launch()
        return np.array(self._meter.results())


def gradient(half: HalfSharpness, space: ParameterSpace, v: Vector) -> Vector:
    """Return the gradient of the mean sharpness at a search vector [1/px]."""
    rise = []
    for step in STEP_PX * np.eye(len(v)):
        ahead = half.of_parts(space, space.to_values(v + step))
        behind = half.of_parts(space, space.to_values(v - step))
        rise.append(ahead - behind)
    return np.asarray(np.mean(rise, axis=1) / (2.0 * STEP_PX))


@dataclass(frozen=True)
class QuadraticSharpness:
    """QuadraticSharpness approximation of sharpness about a point along n directions."""

    slopes: Vector
    """Gradient of the sharpness of each part of the events [1/px], shape ``(n, parts)``."""
    hessian: Vector
    """Hessian of the mean sharpness [1/px²], shape ``(n, n)``."""

    @classmethod
    def about(
        cls, half: HalfSharpness, space: ParameterSpace, v: Vector, directions: Vector
    ) -> QuadraticSharpness:
        """Return the approximation about a search vector.

        Each row of ``directions`` is a vector that moves events by one pixel, shape (n, entries of the vector).
        """
        of_parts = partial(half.of_parts, space)
        slopes, hessian = finite_differences(of_parts, space, v, directions)
        return cls(slopes, hessian)

    def restricted_to(self, which: list[int]) -> QuadraticSharpness:
        """Return the approximation along the directions whose numbers are in ``which``."""
        return QuadraticSharpness(self.slopes[which], self.hessian[np.ix_(which, which)])

    def _curvatures(self) -> tuple[Vector, Vector, float]:
        """Return the curvatures [1/px²], the directions in which they are, and the smallest one that counts."""
        values, vectors = np.linalg.eigh(-self.hessian)
        floor = LEAST_CURVATURE_RATIO * max(float(values.max()), 1e-12)
        return values, vectors, floor

    def step_to_maximum(self, other_gradient: Vector | None = None) -> Vector:
        """Return the step to the sharpest point [px]: 0 along flat directions, at most :data:`LONGEST_STEP_PX` long.

        ``other_gradient`` [1/px] replaces the approximation's own gradient, for another model with about the same
        Hessian.
        """
        values, vectors, floor = self._curvatures()
        own_gradient = self.slopes.mean(axis=1)
        along = vectors.T @ (own_gradient if other_gradient is None else other_gradient)
        to_maximum = along / np.maximum(values, floor)
        step = vectors @ np.where(values > floor, to_maximum, 0.0)
        length = max(float(np.linalg.norm(step)), 1e-12)
        return np.asarray(step * min(1.0, LONGEST_STEP_PX / length))

    @property
    def curvature(self) -> float:
        """Mean curvature of sharpness over the directions [1/px²], positive at a maximum."""
        return -float(np.trace(self.hessian)) / len(self.hessian)

    def deviations(self) -> Vector:
        """Return the standard deviation of the maximum along each direction [px], by the sandwich estimate."""
        values, vectors, floor = self._curvatures()
        # Flat directions count with the smallest curvature, so that their deviation is large but finite.
        inverse_values = np.diag(1.0 / np.maximum(values, floor))
        inverse = vectors @ inverse_values @ vectors.T
        parts = self.slopes.shape[1]
        scatter = np.atleast_2d(np.cov(self.slopes)) / parts
        covariance = inverse @ scatter @ inverse
        return np.asarray(np.sqrt(np.diag(covariance)))
