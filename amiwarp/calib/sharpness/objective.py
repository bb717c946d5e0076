"""Sharpness as a function of the free parameters, computed on the device. All buffers are allocated once."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from amiwarp.calib.parameters import MOTION, build_model
from amiwarp.imaging.choices import Sharpness
from amiwarp.imaging.sharpness_costs import SharpnessMeter
from amiwarp.imaging.tile_votes import TileVotes
from amiwarp.imaging.warped_image import CanvasShape, Votes
from amiwarp.optics.camera_rotation import border
from amiwarp.optics.displacement import points_on_host

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from amiwarp.calib.parameters import ParameterSpace
    from amiwarp.imaging.device_events import UploadedEvents
    from amiwarp.imaging.device_image import Image
    from amiwarp.optics.camera import Camera
    from amiwarp.optics.camera_rotation import CameraRotation
    from amiwarp.optics.models import Model

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
        self.space, self._moving = space, space.moving
        self.evaluations = 0
        camera = space.camera
        # the paper's J is computed as published, without dithering
        dither = kind is not Sharpness.PAPER_J
        canvas = CanvasShape(camera.width, camera.height, pad, scale, per_polarity, parts=parts, dither=dither)
        if parts > 1:
            events = events.in_parts(parts, per_polarity=per_polarity)
        self._meter = SharpnessMeter(canvas, kind, smoothing=smoothing * scale, device=device)
        # tiles are prepared for one camera, so a free focal length excludes them
        if self._meter.device.is_cuda and "focal_length" not in space.names:
            self._image: _DirectImage | _TiledImage = _TiledImage(canvas, events, self._meter, self._model(space.start))
        else:
            self._image = _DirectImage(canvas, events, self._meter)

    def _model(self, values: Mapping[str, float]) -> Model:
        """Return the model to evaluate: the exact model instead of the ellipse, which is its first harmonic.

        Both have the same optimum, but the ellipse would need new tables at every point.
        """
        kind = "exact" if self.space.model == "ellipse" else self.space.model
        return build_model(kind, self.space.camera, self.space.prism, values)

    def _measure(self, values: Mapping[str, float]) -> list[float]:
        self.evaluations += 1
        rotation = self.space.camera_rotation(values) if self._moving else None
        self._image.measure(self._model(values), self.space.drift(values), rotation)
        return self._meter.results()

    def values(self, values: Mapping[str, float]) -> float:
        """Return the sharpness of the image of warped events at parameter values, in their units."""
        return self._measure(values)[0]

    def __call__(self, v: NDArray[np.float64]) -> float:
        """Return the sharpness at a search vector [px]."""
        return self.values(self.space.to_values(v))

    def each(self, values: Mapping[str, float]) -> NDArray[np.float64]:
        """Return the sharpness of each part at parameter values, shape (parts,)."""
        return np.array(self._measure(values))

    def image(self, values: Mapping[str, float]) -> Image:
        """Return the IWE at parameter values, with the border outside the sensor, until the next evaluation."""
        self._measure(values)
        if self._meter.takes_votes:
            self._image.read()
        return self._meter.image


class _DirectImage:
    """Image of warped events that is voted in one pass over the events in the order of time."""

    def __init__(self, canvas: CanvasShape, events: UploadedEvents, meter: SharpnessMeter) -> None:
        self._votes, self._events, self._meter = Votes(canvas, meter.device), events, meter

    def measure(self, model: Model, drift: float, camera_rotation: CameraRotation | None) -> None:
        self._votes.clear()
        self._votes.add_events(model, self._events, drift=drift, camera_rotation=camera_rotation)
        self.read()
        self._meter.launch()

    def read(self) -> None:
        """Write the votes to the meter's image."""
        self._votes.read(self._meter.image)


class _TiledImage:
    """Image of warped events that is voted tile by tile, launched as one CUDA graph."""

    def __init__(self, canvas: CanvasShape, events: UploadedEvents, meter: SharpnessMeter, like: Model) -> None:
        self._tiles, self._meter = TileVotes(meter.image, canvas, events, like), meter
        self._graph: Any = None

    def measure(self, model: Model, drift: float, camera_rotation: CameraRotation | None) -> None:
        self._tiles.set(0, model, drift=drift, camera_rotation=camera_rotation)
        if self._graph is None:
            with wp.ScopedCapture(self._meter.device) as capture:
                self._launch()
            self._graph = capture.graph
        wp.capture_launch(self._graph)

    def _launch(self) -> None:
        self._tiles.launch()
        if self._meter.takes_votes:
            self._meter.launch(self._tiles.votes[0])
        else:
            self.read()
            self._meter.launch()

    def read(self) -> None:
        """Write the votes to the meter's image."""
        self._tiles.read(0, self._meter.image)


def padding(space: ParameterSpace) -> int:
    """Return the border of the canvas [px] that keeps all events inside at the largest size and at any phase.

    For the camera's rotation it allows twice the start's rates and :data:`ROTATION_MARGIN_PX`; faster answers are
    wrong anyway. It is never larger than the image.
    """
    largest = {n: space.high[n] for n in space.names if n == space.size_name}
    faster = {n: 2.0 * abs(space.start.get(n, 0.0)) for n in MOTION if n in space.start}
    margin = ROTATION_MARGIN_PX if space.moving else 0.0
    most = max(space.camera.width, space.camera.height)
    return math.ceil(min(reach(space, {**space.start, **largest, **faster}) + margin, most)) + 2


def reach(space: ParameterSpace, values: Mapping[str, float]) -> float:
    """Return the largest displacement of events at ``values`` [px], by the prism and the camera's rotation."""
    camera = space.camera
    kind = "exact" if space.model == "ellipse" else space.model
    xy, *points = _border_points(camera)
    moved = build_model(kind, camera, space.prism, values).compensate_points(*points).numpy() - xy
    radius = np.linalg.norm(moved[np.isfinite(moved).all(axis=1)], axis=1)
    turned = space.camera_rotation(values).reach(camera, space.duration_us * 0.5e-6)
    return float(radius.max(initial=0.0)) + float(np.linalg.norm(turned))


@lru_cache(maxsize=16)
def _border_points(camera: Camera) -> tuple[NDArray[np.float64], wp.array, wp.array]:
    """Return pixels of the image's border at 16 prism angles [px], shape (n, 2); and both as Warp arrays on the CPU."""
    at = border(camera)
    xy = np.tile(at, (16, 1))
    return xy, *points_on_host(xy, np.repeat(np.arange(16) * (np.pi / 8), len(at)))
