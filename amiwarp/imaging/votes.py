"""Votes of events into one image, on any device."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.device_columns import cast
from amiwarp.events.device_events import DeviceEvents
from amiwarp.events.recording import Events
from amiwarp.imaging.canvas import CanvasShape, Image
from amiwarp.imaging.cpu_votes import PixelVotes
from amiwarp.imaging.cuda_votes import WordVotes
from amiwarp.imaging.uploaded_events import UploadedEvents
from amiwarp.kernels.camera import pinhole_params
from amiwarp.optics.camera_rotation import CameraRotation
from amiwarp.optics.models.base import Model, model_camera


class Votes:
    """Buffers in which events are voted into the image of a canvas, allocated once.

    No vote is lost, even if very many events fall on one pixel. On CUDA, do not change the events before :meth:`take`.
    """

    def __init__(self, canvas: CanvasShape, device: Any) -> None:
        self.canvas = canvas
        self.device = wp.get_device(device)
        self._params = canvas.params()
        self._image = Image(canvas, 1, self.device)
        self._buffers: PixelVotes | WordVotes
        if self.device.is_cpu:
            self._buffers = PixelVotes(self._params, canvas.layers)
        else:
            self._buffers = WordVotes(self._params, canvas.layers, self.device)

    def clear(self) -> None:
        """Discard all votes, so that the image is empty."""
        self._buffers.clear()

    def add_events(
        self,
        model: Model,
        events: UploadedEvents,
        *,
        drift: float = 0.0,
        camera_rotation: CameraRotation | None = None,
    ) -> None:
        """Compensate events on the same device by ``model`` and vote them.

        ``drift``: value of the drifting parameter. ``camera_rotation`` is compensated if the events have times.
        """
        angles = 2 if events.arrays.second.shape[0] > 0 else 1
        if events.count and angles != model.ANGLES:
            raise AmiwarpError(
                f"the events have the angles of {angles} prisms, the model {model.ANGLES}"
            )
        if events.slope is not None:
            events.drift(drift)
        params = model.params(self.device)
        if camera_rotation is not None and events.arrays.time.shape[0]:
            kernel = self._buffers.EVENTS_OF_ROTATING_CAMERA
            camera = model_camera(model, self.device)
            inputs = [
                params,
                camera,
                events.arrays,
                self._params,
                camera_rotation.params(self.device),
            ]
        else:
            kernel = self._buffers.EVENTS
            camera = pinhole_params(model.camera) or model_camera(model, self.device)
            inputs = [params, camera, events.arrays, self._params]
        self._buffers.vote(kernel, inputs, events.count, events.total)

    def add_points(self, x: Any, y: Any, layer: Any, count: int | None = None) -> None:
        """Vote points at their coordinates, without compensation.

        ``x``, ``y``: Warp arrays of float [px]. ``layer``: Warp array of uint8, the index of each point's layer.
        ``count``: number of points to vote; None for all.
        """
        count = len(x) if count is None else count
        self._buffers.vote(self._buffers.POINTS, [x, y, layer, self._params], count, count)

    def range_voter(self, x: Any, y: Any, layer: Any) -> Callable[[int, int], None]:
        """Return a function that votes ``count`` of the points from index ``first`` on, for arrays that stay allocated.

        On a CPU, indices count blocks of 64 points, and one thread votes.
        """
        return self._buffers.range_voter(x, y, layer)

    def add_unmoved(self, events: Events | DeviceEvents) -> None:
        """Vote events at their coordinates, raw or already compensated. Events with NaN coordinates are not voted."""
        if isinstance(events, DeviceEvents):
            self.add_points(cast(events.x, wp.float32), cast(events.y, wp.float32), events.p)
            return
        x = wp.array(events.x.astype(np.float32), dtype=float, device=self.device)
        y = wp.array(events.y.astype(np.float32), dtype=float, device=self.device)
        self.add_points(x, y, wp.array(events.p, dtype=wp.uint8, device=self.device))

    def read(self, image: Image) -> None:
        """Write the current image [events] to ``image``; the votes are kept."""
        self._buffers.read(image)

    def take(self) -> NDArray[np.float32]:
        """Return the current image [events], shape (layers, rows, columns), and clear the votes."""
        self.read(self._image)
        self.clear()
        return self._image.numpy()

    def take_on_device(self) -> Any:
        """Return the current image as a new Warp array, see :meth:`take`."""
        self.read(self._image)
        self.clear()
        return self._image.on_device()
