"""The image of warped events (IWE): events voted into pixels, with or without motion compensation."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, overload

import numpy as np
import warp as wp

from amiwarp.choices import Vote
from amiwarp.errors import AmiwarpError
from amiwarp.events.device_events import DeviceEvents, cast, check_order, device_for, wait
from amiwarp.imaging.votes import CanvasShape, Image, PixelVotes, UploadedEvents, WordVotes, upload_events
from amiwarp.optics.camera import CameraRotation, pinhole_params
from amiwarp.optics.models import model_camera
from amiwarp.validation import guarded

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.events.encoder import Encoder
    from amiwarp.events.events import Events
    from amiwarp.optics.models import Model


PIECE = 1 << 22
"""Number of events that are copied to the device at a time."""


class Votes:
    """Buffers in which events are voted into the image of a canvas, allocated once.

    No vote is lost, even if very many events fall on one pixel. On CUDA, do not change the events before :meth:`take`.
    """

    def __init__(self, canvas: CanvasShape, device: Any) -> None:
        self.canvas = canvas
        self.device = wp.get_device(device)
        self._params = canvas.params()
        self._image = Image(canvas, 1, self.device)
        self._buffers: PixelVotes | WordVotes = (
            PixelVotes(self._params, canvas.layers)
            if self.device.is_cpu
            else WordVotes(self._params, canvas.layers, self.device)
        )

    def clear(self) -> None:
        """Discard all votes, so that the image is empty."""
        self._buffers.clear()

    def add_events(
        self, model: Model, events: UploadedEvents, *, drift: float = 0.0, camera_rotation: CameraRotation | None = None
    ) -> None:
        """Compensate events on the same device by ``model`` and vote them.

        ``drift``: value of the drifting parameter. ``camera_rotation`` is compensated if the events have times.
        """
        if events.slope is not None:
            events.drift(drift)
        kernel, rotation, camera = self._buffers.EVENTS, [], pinhole_params(model.camera)
        if camera_rotation is not None and events.arrays.time.shape[0]:
            kernel, rotation, camera = self._buffers.EVENTS_OF_ROTATING_CAMERA, [camera_rotation.params()], None
        inputs = [model.params(self.device), camera or model_camera(model, self.device), events.arrays, self._params]
        self._buffers.vote(kernel, [*inputs, *rotation], events.count, events.total)

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
        x, y = (wp.array(v.astype(np.float32), dtype=float, device=self.device) for v in (events.x, events.y))
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


@overload
def iwe(
    events: Events, width: int, height: int, *, model: Model | None = ..., encoder: Encoder | None = ...,
    camera_rotation: CameraRotation | None = ..., pad: int = ..., per_polarity: bool = ..., vote: Vote = ...,
    device: Any = ...,
) -> NDArray[np.float32]: ...  # fmt: skip
@overload
def iwe(
    events: DeviceEvents, width: int, height: int, *, model: Model | None = ..., encoder: Encoder | None = ...,
    camera_rotation: CameraRotation | None = ..., pad: int = ..., per_polarity: bool = ..., vote: Vote = ...,
    device: Any = ...,
) -> wp.array: ...  # fmt: skip
@guarded
def iwe(
    events: Events | DeviceEvents,
    width: int,
    height: int,
    *,
    model: Model | None = None,
    encoder: Encoder | None = None,
    camera_rotation: CameraRotation | None = None,
    pad: int = 0,
    per_polarity: bool = False,
    vote: Vote = Vote.BILINEAR,
    device: Any = None,
) -> NDArray[np.float32] | wp.array:
    """Compute the image of warped events (IWE).

    With ``model`` and ``encoder``, the events are compensated first. Without them, they are voted at their coordinates.

    Parameters
    ----------
    events : Events or DeviceEvents
        Events to vote, sorted by time.
    width, height : int
        Sensor size [px].
    model : Model, optional
        Optical model of the prism. Requires ``encoder``.
    encoder : Encoder, optional
        Encoder that covers the events. Requires ``model``.
    camera_rotation : CameraRotation, optional
        The camera's own rotation, compensated together with the prism.
    pad : int, optional
        Border added on each side [px].
    per_polarity : bool, optional
        Return separate images for OFF and ON.
    vote : Vote, optional
        How a vote is shared among pixels.
    device : str or warp.Device, optional
        Device to compute on, by default the CPU. Events on a device are voted there, without a copy.

    Returns
    -------
    ndarray or warp.array
        Events per pixel, float32, shape ``(height + 2 * pad, width + 2 * pad)``. With ``per_polarity``, shape
        ``(2, height + 2 * pad, width + 2 * pad)``: OFF, then ON. A Warp array on the same device for
        :class:`DeviceEvents`.

    Raises
    ------
    AmiwarpError
        If only one of ``model`` and ``encoder`` is given, the encoder does not cover the events, their times decrease,
        or they are on another device than ``device``.

    Examples
    --------
    >>> events = amiwarp.Events.from_arrays([1, 1, 2], [0, 0, 1], [0, 10, 20], [0, 1, 1])
    >>> amiwarp.iwe(events, 4, 2)
    array([[0., 2., 0., 0.],
           [0., 0., 1., 0.]], dtype=float32)
    """
    if (model is None) != (encoder is None):
        raise AmiwarpError("only one of model and encoder is given; give both a model and an encoder, or neither")
    device = device_for(events, device)
    check_order(events)
    votes = Votes(CanvasShape(width, height, pad, 1.0, per_polarity, vote), device)
    for start in range(0, len(events), PIECE):
        piece = events[start : start + PIECE]
        if model is not None and encoder is not None:
            middle = None if camera_rotation is None else camera_rotation.middle_us
            arrays = upload_events(piece, encoder, device, middle_us=middle)
            votes.add_events(model, arrays, camera_rotation=camera_rotation)
        else:
            votes.add_unmoved(piece)
    image = votes.take_on_device() if isinstance(events, DeviceEvents) else votes.take()
    wait(device)
    return image if per_polarity else image[0]
