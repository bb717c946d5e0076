"""Sharpness as a function of the free parameters, computed on the device, and its derivatives.

All buffers are allocated once.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.choices import Sharpness
from amiwarp.imaging.canvas import CanvasShape, Image
from amiwarp.imaging.sharpness import SharpnessMeter
from amiwarp.imaging.tile_votes import TileVotes
from amiwarp.imaging.uploaded_events import UploadedEvents
from amiwarp.imaging.votes import Votes
from amiwarp.optics.camera import Camera, border
from amiwarp.optics.models.base import Model
from amiwarp.optics.models.registry import MODELS, build_model
from amiwarp.optics.models.structs import points_on_host
from amiwarp.results.parameters import MOTION, ParameterSpace

Vector = NDArray[np.float64]

ROTATION_MARGIN_PX = 16.0
"""Extra border of the image of events if the camera's rotation is free [px]."""


class Objective:
    """Sharpness of the IWE of a set of events as a function of the free parameters. Counts its evaluations.

    On CUDA the events are sorted into tiles once, and one captured graph is launched per evaluation.
    """

    def __init__(
        self,
        space: ParameterSpace,
        events: UploadedEvents,
        *,
        kind: Sharpness,
        smoothing: float,
        pad: int,
        scale: float = 1.0,
        per_polarity: bool = False,
        parts: int = 1,
        device: Any = "cpu",
    ) -> None:
        """Allocate the buffers and copy the parameters of the image of events to the device.

        Parameters
        ----------
        space : ParameterSpace
            The free parameters.
        events : UploadedEvents
            The events on the device, with slopes for a free clock offset or rpm, and times for a camera rotation.
        kind : Sharpness
            Measure of sharpness.
        smoothing : float
            Standard deviation of the Gaussian that smooths the image [sensor px].
        pad : int
            Border of the image [px], see :func:`padding`.
        scale : float
            Canvas pixels per sensor pixel.
        per_polarity : bool
            Whether ON and OFF events form separate images.
        parts : int
            Number of disjoint parts of the events that :meth:`each` measures separately.
        device : str or warp.context.Device
            The device.
        """
        self.space = space
        self._moving = space.moving
        self.evaluations = 0
        camera = space.camera
        # the paper's J is computed as published, without dithering
        dither = kind is not Sharpness.PAPER_J
        canvas = CanvasShape(
            camera.width, camera.height, pad, scale, per_polarity, parts=parts, dither=dither
        )
        if parts > 1:
            events = events.in_parts(parts, per_polarity=per_polarity)
        self._meter = SharpnessMeter(canvas, kind, smoothing=smoothing * scale, device=device)
        self._graph: Any = None
        self._votes: Votes | TileVotes
        # tiles are prepared for one camera, so a free focal length excludes them, and for one prism
        if (
            self._meter.device.is_cuda
            and "focal_length" not in space.names
            and MODELS[space.model].ANGLES == 1
        ):
            self._votes = TileVotes(self._meter.image, canvas, events, self._model(space.start))
        else:
            self._votes = Votes(canvas, self._meter.device)
            self._events = events

    def _model(self, values: Mapping[str, float]) -> Model:
        """Return the model to evaluate, without tables: they would have to be computed at every point."""
        kind = MODELS[self.space.model].closed_form()
        return build_model(kind.NAME, self.space.camera, self.space.prism, values)

    def measure(self, values: Mapping[str, float]) -> list[float]:
        """Return the sharpness of each part at parameter values, in their units."""
        self.evaluations += 1
        votes = self._votes
        model = self._model(values)
        drift = self.space.drift(values)
        rotation = self.space.camera_rotation(values) if self._moving else None
        if isinstance(votes, TileVotes):
            votes.set(0, model, drift=drift, camera_rotation=rotation)
            if self._graph is None:
                with wp.ScopedCapture(self._meter.device) as capture:
                    votes.launch()
                    if self._meter.takes_votes:
                        self._meter.launch(votes.votes[0])
                    else:
                        votes.read(0, self._meter.image)
                        self._meter.launch()
                self._graph = capture.graph
            wp.capture_launch(self._graph)
        else:
            votes.clear()
            votes.add_events(model, self._events, drift=drift, camera_rotation=rotation)
            votes.read(self._meter.image)
            self._meter.launch()
        return self._meter.results()

    def values(self, values: Mapping[str, float]) -> float:
        """Return the sharpness of the image of warped events at parameter values, in their units."""
        return self.measure(values)[0]

    def __call__(self, v: NDArray[np.float64]) -> float:
        """Return the sharpness at a search vector [px]."""
        return self.values(self.space.to_values(v))

    def of_parts(self, values: Mapping[str, float]) -> NDArray[np.float64]:
        """Return the sharpness of each part at parameter values, shape (parts,)."""
        return np.array(self.measure(values))

    def image(self, values: Mapping[str, float]) -> Image:
        """Return the IWE at parameter values, with the border outside the sensor, until the next evaluation."""
        self.measure(values)
        if isinstance(self._votes, TileVotes) and self._meter.takes_votes:
            self._votes.read(0, self._meter.image)
        return self._meter.image


def padding(space: ParameterSpace) -> int:
    """Return the border of the canvas [px] that keeps all events inside at the largest size and at any phase.

    For the camera's rotation it allows twice the start's rates and :data:`ROTATION_MARGIN_PX`; faster answers are
    wrong anyway. It is never larger than the image.
    """
    sizes = dict(MODELS[space.model].ORBITS)
    largest = {name: space.high[name] for name in space.names if name in sizes}
    faster = {name: 2.0 * abs(space.start[name]) for name in MOTION if name in space.start}
    far = reach(space, {**space.start, **largest, **faster})
    if space.moving:
        far += ROTATION_MARGIN_PX
    most = max(space.camera.width, space.camera.height)
    return math.ceil(min(far, most)) + 2


def reach(space: ParameterSpace, values: Mapping[str, float]) -> float:
    """Return the largest displacement of events at ``values`` [px], by the prism and the camera's rotation."""
    camera = space.camera
    kind = MODELS[space.model].closed_form()
    xy, *points = _border_points(camera)
    model = replace(space, model=kind.NAME).build(values)
    radius = 0.0
    for single in model.singles():
        moved = single.compensate_points(*points).numpy() - xy
        seen = np.isfinite(moved).all(axis=1)
        radius += float(np.linalg.norm(moved[seen], axis=1).max(initial=0.0))
    turned = space.camera_rotation(values).reach(camera, space.duration_us * 0.5e-6)
    return radius + float(np.linalg.norm(turned))


@lru_cache(maxsize=16)
def _border_points(camera: Camera) -> tuple[NDArray[np.float64], wp.array, wp.array]:
    """Return pixels of the image's border at 16 prism angles [px], shape (n, 2); and both as Warp arrays on the CPU."""
    border_pixels = border(camera)
    xy = np.tile(border_pixels, (16, 1))
    return xy, *points_on_host(xy, np.repeat(np.arange(16) * (np.pi / 8), len(border_pixels)))


STEP_PX = 0.25
"""Step of the finite differences, as displacement of events [px]."""


def finite_differences(
    sharpness_of_parts: Callable[[dict[str, float]], Vector],
    space: ParameterSpace,
    v: Vector,
    directions: Vector,
) -> tuple[Vector, Vector]:
    """Return the parts' gradients of sharpness [1/px], shape (n, parts), and the mean Hessian [1/px²], shape (n, n).

    ``each`` returns the sharpness of each part at parameter values, shape (parts,). ``v`` is the search vector about
    which they hold. Each row of ``directions`` is a shift of it that moves events by one pixel, shape (n, entries).
    """
    count = len(directions)
    steps = STEP_PX * directions
    both = [steps[i] + steps[j] for i in range(count) for j in range(i)]
    shifts = [np.zeros(directions.shape[1]), *steps, *-steps, *both, *(-step for step in both)]
    found = np.array([sharpness_of_parts(space.to_values(v + shift)) for shift in shifts])
    centre = found[0]
    up = found[1 : 1 + count]
    down = found[1 + count : 1 + 2 * count]

    # Steps along two directions at once, both ways, in the order of ``both``.
    mixed = iter(np.sum(np.split(found[1 + 2 * count :], 2), axis=0))
    hessian = np.zeros((count, count))
    for i in range(count):
        hessian[i, i] = np.mean(up[i] - 2.0 * centre + down[i]) / STEP_PX**2
        for j in range(i):
            bend = next(mixed) - up[i] - up[j] - down[i] - down[j] + 2.0 * centre
            hessian[i, j] = hessian[j, i] = np.mean(bend) / (2.0 * STEP_PX**2)
    return (up - down) / (2.0 * STEP_PX), hessian
