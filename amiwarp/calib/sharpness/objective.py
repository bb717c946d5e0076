"""Parameters to sharpness, on the device: buffers are allocated once, nothing per call but the result."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from amiwarp.calib.parameters import MOTION, build_model
from amiwarp.imaging.choices import Sharpness
from amiwarp.imaging.sharpness_costs import SharpnessMeter
from amiwarp.imaging.tile_votes import TileVotes
from amiwarp.imaging.warped_image import CanvasShape, Votes
from amiwarp.optics.camera_rotation import border

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from amiwarp.calib.parameters import ParameterSpace
    from amiwarp.imaging.device_events import DeviceEvents
    from amiwarp.optics.camera_rotation import CameraRotation
    from amiwarp.optics.models import Model

MOTION_ROOM_PX = 16.0


class Objective:
    """Sharpness of the IWE of a set of events as a function of the free parameters; counts its evaluations.

    On CUDA the events are sorted by tile once, and an evaluation is one captured graph.
    """

    def __init__(
        self,
        space: ParameterSpace,
        events: DeviceEvents,
        *,
        kind: Sharpness,
        smoothing: float,
        scale: float = 1.0,
        per_polarity: bool = False,
        parts: int = 1,
        device: Any = "cpu",
    ) -> None:
        """``events`` are on the device, with slopes where a parameter drifts and times where the camera turns.

        ``smoothing``: standard deviation [sensor px]; ``scale``: canvas pixels per sensor pixel. ``parts``: disjoint
        parts of the events that :meth:`each` measures apart.
        """
        self.space = space
        self.evaluations = 0
        camera = space.camera
        # the paper's J is left as it was written
        dither = kind is not Sharpness.PAPER_J
        pad = padding(space)
        canvas = CanvasShape(camera.width, camera.height, pad, scale, per_polarity, parts=parts, dither=dither)
        if parts > 1:
            events = events.in_parts(parts, per_polarity=per_polarity)
        self._meter = SharpnessMeter(canvas, kind, smoothing=smoothing * scale, device=device)
        # tiles take their camera as it is when they are prepared
        if self._meter.device.is_cuda and "focal_length" not in space.names:
            self._image: _Voted | _Captured = _Captured(canvas, events, self._meter, self._model(space.start))
        else:
            self._image = _Voted(canvas, events, self._meter)

    def _model(self, values: Mapping[str, float]) -> Model:
        """The ellipse is the exact model's first harmonic: the same optimum, without tables for every point."""
        kind = "exact" if self.space.model == "ellipse" else self.space.model
        return build_model(kind, self.space.camera, self.space.prism, values)

    def _measure(self, values: Mapping[str, float]) -> list[float]:
        self.evaluations += 1
        self._image.measure(self._model(values), self.space.drift(values), self.space.camera_rotation(values))
        return self._meter.results()

    def values(self, values: Mapping[str, float]) -> float:
        """Sharpness at parameter values."""
        return self._measure(values)[0]

    def __call__(self, v: NDArray[np.float64]) -> float:
        """Sharpness at a vector of the space [px]."""
        return self.values(self.space.to_values(v))

    def each(self, values: Mapping[str, float]) -> NDArray[np.float64]:
        """Sharpness of each part at parameter values, shape (parts,)."""
        return np.array(self._measure(values))

    def image(self, values: Mapping[str, float]) -> NDArray[np.float32]:
        """The IWE at parameter values, shape (layers, rows, columns), padding included."""
        self._measure(values)
        return self._meter.image.numpy()


class _Voted:
    """Images by one pass over the events, in their order."""

    def __init__(self, canvas: CanvasShape, events: DeviceEvents, meter: SharpnessMeter) -> None:
        self._votes, self._events, self._meter = Votes(canvas, meter.device), events, meter

    def measure(self, model: Model, drift: float, camera_rotation: CameraRotation) -> None:
        self._votes.clear()
        self._votes.add_events(model, self._events, drift=drift, camera_rotation=camera_rotation)
        self._votes.read(self._meter.image)
        self._meter.launch()


class _Captured:
    """Images by tiles, everything in one CUDA graph."""

    def __init__(self, canvas: CanvasShape, events: DeviceEvents, meter: SharpnessMeter, like: Model) -> None:
        self._tiles, self._meter = TileVotes(meter.image, canvas, events, like), meter
        self._graph: Any = None

    def measure(self, model: Model, drift: float, camera_rotation: CameraRotation) -> None:
        self._tiles.set(0, model, drift=drift, camera_rotation=camera_rotation)
        if self._graph is not None:
            wp.capture_launch(self._graph)
            return
        self._launch()  # once as it is: a capture cannot load modules
        wp.synchronize_stream(self._meter.device)
        with wp.ScopedCapture(self._meter.device) as capture:
            self._launch()
        self._graph = capture.graph

    def _launch(self) -> None:
        self._tiles.launch()
        self._tiles.read(0, self._meter.image)
        self._meter.launch()


def padding(space: ParameterSpace) -> int:
    """Border [px] that no event of the image can cross, at the largest size and any phase, or as far as it turns."""
    largest = {n: space.high[n] for n in space.names if n == space.size_name}
    # a search that goes as far as its bounds is lost anyway: twice the start's motion, and a little, is room enough
    faster = {n: 2.0 * abs(space.start.get(n, 0.0)) for n in MOTION if n in space.start}
    room = MOTION_ROOM_PX if space.moving else 0.0
    # events that go further are lost to any answer worth having
    most = max(space.camera.width, space.camera.height)
    return math.ceil(min(reach(space, {**space.start, **largest, **faster}) + room, most)) + 2


def reach(space: ParameterSpace, values: Mapping[str, float]) -> float:
    """How far events are moved at ``values``, at most [px], by the prism and by the camera's turning."""
    camera = space.camera
    kind = "exact" if space.model == "ellipse" else space.model
    at = border(camera)
    theta = np.repeat(np.arange(16) * (np.pi / 8), len(at))
    xy = np.tile(at, (16, 1))
    moved = build_model(kind, camera, space.prism, values).compensate_points(xy, theta) - xy
    radius = np.linalg.norm(moved[np.isfinite(moved).all(axis=1)], axis=1)
    turned = space.camera_rotation(values).reach(camera, space.duration_us * 0.5e-6)
    return float(radius.max(initial=0.0)) + float(np.linalg.norm(turned))
