"""The image of warped events (IWE): events voted into pixels, with or without motion compensation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, overload

import numpy as np
import warp as wp

from amiwarp.errors import AmiwarpError
from amiwarp.events.device_arrays import cast
from amiwarp.events.device_events import DeviceEvents, device_for, wait
from amiwarp.imaging.choices import Vote
from amiwarp.imaging.device_events import UploadedEvents, upload_events
from amiwarp.imaging.device_image import Image
from amiwarp.kernels.iwe import add_totals, empty_words, read_votes
from amiwarp.kernels.launch import RecordedLaunch, launch, launch_slices, slice_count
from amiwarp.kernels.votes import (
    BLOCK,
    TRASH,
    Canvas,
    Cells,
    vote_blocks,
    vote_events,
    vote_point_blocks,
    vote_points,
    vote_quickly,
    vote_rotating_camera,
)
from amiwarp.optics.camera import LARGEST_SIZE
from amiwarp.optics.camera_rotation import CameraRotation
from amiwarp.optics.device_camera import pinhole_params
from amiwarp.optics.displacement import model_camera
from amiwarp.validation import choice, whole

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.events.encoder import Encoder
    from amiwarp.events.events import Events
    from amiwarp.optics.models import Model

PIECE = 1 << 22
"""Number of events that are copied to the device at a time."""
FIRST_BATCH, LARGEST_BATCH = 1 << 21, 1 << 27
"""Sizes of the first and the largest batch of the fast voting kernel on CUDA [events].

The fast kernel does not check whether a 32-bit word of the image overflows; the words are added to the image and
cleared after each batch. The first batch is small. Later batches have a size that fills the fullest word to about
:data:`TARGET_FILL`. If a word overflowed, or if there are fewer events than the first batch, the exact kernel votes,
which checks every addition.
"""
TARGET_FILL = 600
"""Number of events that the fullest word of the image should receive per batch of the fast voting kernel. A word holds
up to 1,023."""


@dataclass(frozen=True, slots=True)
class CanvasShape:
    """Shape of a vote image: the sensor's image, extended by ``pad`` px on each side, then scaled."""

    width: int
    """Width of the sensor [px]."""
    height: int
    """Height of the sensor [px]."""
    pad: int = 0
    """Border on each side of the sensor's image that keeps displaced events inside the canvas [sensor px]."""
    scale: float = 1.0
    """Canvas pixels per sensor pixel, along each axis."""
    per_polarity: bool = False
    """Whether OFF and ON events get separate layers, in this order."""
    vote: Vote = Vote.BILINEAR
    """How a vote is shared among pixels."""
    parts: int = 1
    """Number of disjoint subsets of the events with separate images; event k belongs to subset ``k % parts``."""
    dither: bool = False
    """Whether each event is voted at a pseudo-random position in its pixel. At pixel centres the pixel grid would add
    sharpness."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "vote", choice(Vote, self.vote, "vote"))
        for name in ("width", "height"):
            object.__setattr__(self, name, whole(getattr(self, name), f"canvas {name}", 1, LARGEST_SIZE, " pixels"))
        object.__setattr__(self, "pad", whole(self.pad, "canvas pad", 0, LARGEST_SIZE, " pixels"))

    @property
    def layers(self) -> int:
        """Number of image layers: one per part, or two per part with separate polarities."""
        return self.parts * (2 if self.per_polarity else 1)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Shape of the image: (layers, rows, columns)."""
        rows = max(1, round((self.height + 2 * self.pad) * self.scale))
        columns = max(1, round((self.width + 2 * self.pad) * self.scale))
        return (self.layers, rows, columns)

    def params(self) -> Any:
        """Return the canvas as the struct that the kernels take."""
        c = Canvas()
        c.pad, c.scale = float(self.pad), self.scale
        c.nearest, c.dither = int(self.vote is Vote.NEAREST), float(self.dither)
        c.rows, c.columns = self.shape[1] + 2, self.shape[2] + 2
        c.layer = c.rows * c.columns if self.layers > 1 else 0
        return c


class Votes:
    """Buffers in which events are voted into the image of a canvas, allocated once.

    There is one image per CPU slice, or one image on CUDA. No vote is lost, even if very many events fall on one pixel.
    On CUDA, do not change the events before :meth:`take`.
    """

    def __init__(self, canvas: CanvasShape, device: Any) -> None:
        self.canvas = canvas
        self.device = wp.get_device(device)
        self._params = canvas.params()
        self._image = Image(canvas, 1, self.device)
        n, slices = canvas.shape[0] * self._params.rows * self._params.columns, slice_count(self.device)
        self._trash = n
        self._words = wp.zeros((slices, n + int(TRASH)), dtype=wp.uint64, device=self.device)
        self._totals = wp.zeros((slices, n), dtype=wp.int64, device=self.device)
        self._spilled = wp.zeros((slices, 1), dtype=wp.int32, device=self.device)
        self._cells = []
        for k in range(slices):
            cells = Cells()
            cells.words, cells.totals, cells.spilled = self._words[k], self._totals[k], self._spilled[k]
            self._cells.append(cells)
        self._batches: list[tuple[list[Any], int, int]] = []  # voted by the fast kernel, not verified yet
        self._batches_fit: bool | None = None if self.device.is_cuda else False
        if self.device.is_cuda:
            self._make_fast_buffers()

    def _make_fast_buffers(self) -> None:
        """Allocate the buffers of the fast vote on CUDA and record its launches."""
        self._counts = wp.zeros((64, 1024), dtype=wp.int64, device=self.device)
        self._fullest = wp.zeros(1, dtype=int, device=self.device)
        self._batch = FIRST_BATCH
        fast = self._fast = Cells()
        fast.words = wp.zeros_like(self._words[0])
        fast.totals, fast.spilled = wp.zeros_like(self._totals[0]), self._spilled[0]
        self._clear_words = wp.launch(
            empty_words, len(fast.words), [self._params, fast, 0], [self._counts, self._fullest], device=self.device,
            record_cmd=True,
        )  # fmt: skip
        inputs = [fast.totals, self._counts.flatten()]
        n = max(len(fast.totals), self._counts.size)
        self._add_fast_totals = wp.launch(add_totals, n, inputs, [self._totals[0]], device=self.device, record_cmd=True)
        self._recorded: tuple[list[Any], Any] | None = None  # inputs of the last fast vote, and its recorded launch
        self._read: tuple[Image, Any] | None = None

    def clear(self) -> None:
        """Discard all votes, so that the image is empty."""
        self._discard_batches()
        self._words.zero_()
        if self._any_total:
            self._totals.zero_()
            self._spilled.zero_()

    @property
    def _any_total(self) -> bool:
        """Whether a word of the image may have overflowed; always True on CUDA."""
        return bool(self.device.is_cuda or self._spilled.numpy().any())

    def add_events(
        self, model: Model, events: UploadedEvents, *, drift: float = 0.0, camera_rotation: CameraRotation | None = None
    ) -> None:
        """Compensate events on the same device by ``model`` and vote them.

        ``drift``: value of the drifting parameter. ``camera_rotation`` is compensated if the events have times.
        """
        if events.slope is not None:
            events.drift(drift)
        params, camera = model.params(self.device), pinhole_params(model.camera)
        inputs = [params, camera or model_camera(model, self.device), events.arrays, self._params]
        if camera_rotation is not None and events.arrays.time.shape[0]:
            inputs = [params, model_camera(model, self.device), *inputs[2:], camera_rotation.params()]
            self._vote_exactly(vote_rotating_camera, inputs, events.count)
        elif self.device.is_cuda and not len(events.arrays.weight):
            self._vote_in_batches(inputs, events.count)
        elif self.device.is_cpu and camera is not None:
            blocks = -(-events.count // int(BLOCK))
            launch_slices(vote_blocks, blocks, [*inputs, events.count], self._cells, device=self.device, smallest=512)
        else:
            self._vote_exactly(vote_events, inputs, events.count)

    def add_points(self, x: Any, y: Any, layer: Any, count: int | None = None) -> None:
        """Vote points at their coordinates, without compensation.

        ``x``, ``y``: Warp arrays of float [px]. ``layer``: Warp array of uint8, the index of each point's layer.
        ``count``: number of points to vote; None for all.
        """
        inputs, count = [x, y, layer, self._params], len(x) if count is None else count
        blocks = count // int(BLOCK) if self.device.is_cpu else 0
        launch_slices(vote_point_blocks, blocks, inputs, self._cells, device=self.device, smallest=8192)
        self._vote_exactly(vote_points, inputs, count - blocks * int(BLOCK), blocks * int(BLOCK))

    def range_voter(self, x: Any, y: Any, layer: Any) -> Callable[[int, int], None]:
        """Return a function that votes ``count`` of the points from index ``first`` on, for arrays that stay allocated.

        On a CPU, indices count blocks of 64 points, and one thread votes.
        """
        kernel = vote_point_blocks if self.device.is_cpu else vote_points
        return RecordedLaunch(kernel, [x, y, layer, self._params], [self._cells[0]], device=self.device)

    def add_unmoved(self, events: Events | DeviceEvents) -> None:
        """Vote events at their coordinates, raw or already compensated. Events with NaN coordinates are not voted."""
        if isinstance(events, DeviceEvents):
            self.add_points(cast(events.x, wp.float32), cast(events.y, wp.float32), events.p)
            return
        x, y = (wp.array(v.astype(np.float32), dtype=float, device=self.device) for v in (events.x, events.y))
        self.add_points(x, y, wp.array(events.p, dtype=wp.uint8, device=self.device))

    def _vote_exactly(self, kernel: Any, inputs: list[Any], count: int, first: int = 0) -> None:
        """Vote by the exact kernel, which checks for overflow at every addition."""
        launch_slices(kernel, count, inputs, self._cells, device=self.device, first=first)

    def _vote_in_batches(self, inputs: list[Any], count: int) -> None:
        """Vote on CUDA by the fast kernel, whose result is verified later; few events are voted exactly at once."""
        start, vote = 0, None
        while start < count:
            batch = min(count - start, self._batch)
            if self._batches_fit is False or batch < FIRST_BATCH:
                self._vote_exactly(vote_events, inputs, count - start, start)
                return
            vote = vote or self._recorded_vote(inputs)
            vote.set_dim(batch)
            vote.set_param_at_index(len(inputs) + 1, start)
            vote.launch()
            self._clear_words.set_param_at_index(2, len(self._batches))
            self._clear_words.launch()
            self._fast.words.zero_()
            self._batches.append((inputs, batch, start))
            if self._batches_fit is None or len(self._batches) == len(self._counts):
                self._verify_batches()
            start += batch

    def _recorded_vote(self, inputs: list[Any]) -> Any:
        """Return the recorded launch of the fast kernel, which takes a tenth of the time of a new launch."""
        if self._recorded is not None:
            before, vote = self._recorded
            if type(inputs[0]) is type(before[0]) and all(a is b for a, b in zip(inputs[1:], before[1:], strict=True)):
                vote.set_param_at_index(0, inputs[0])
                self._recorded = inputs, vote
                return vote
        given = [*inputs, self._trash, 0]
        vote = wp.launch(vote_quickly, 1, given, [self._fast], device=self.device, record_cmd=True)
        self._recorded = inputs, vote
        return vote

    def _verify_batches(self) -> None:
        """Keep the votes of the fast kernel if no word overflowed; otherwise vote their events again exactly."""
        if not self._batches:
            return
        counts = self._counts[: len(self._batches)].numpy().sum(axis=1)
        if self._batches_fit is None:
            self._batch = min(
                max(FIRST_BATCH * TARGET_FILL // max(int(self._fullest.numpy()[0]), 1), FIRST_BATCH), LARGEST_BATCH
            )
        self._batches_fit = bool((counts == [count for _, count, _ in self._batches]).all())
        if self._batches_fit:
            self._add_fast_totals.launch()
            self._batches.clear()
            return
        for inputs, count, first in self._batches:
            self._vote_exactly(vote_events, inputs, count, first)
        self._discard_batches()

    def _discard_batches(self) -> None:
        """Discard the votes of the fast kernel that are not verified yet."""
        if self._batches:
            self._fast.totals.zero_()
            self._counts.zero_()
            self._batches.clear()

    def read(self, image: Image) -> None:
        """Write the current image [events] to ``image``; the votes are kept."""
        self._verify_batches()
        kernel = read_votes(image.width)
        inputs = [self._words, self._totals, int(self._any_total), self._params, image.frame]
        if self.device.is_cpu:
            launch(kernel, image.blocks, inputs, [image.pixels], device=self.device, smallest=512)
            return
        if self._read is None or self._read[0] is not image:
            given, to = [*inputs, 0], [image.pixels]
            self._read = image, wp.launch(kernel, image.blocks, given, to, device=self.device, record_cmd=True)
        self._read[1].launch()

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
        Events to vote.
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
        If only one of ``model`` and ``encoder`` is given, the encoder does not cover the events, or the events are on
        another device than ``device``.

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
