"""The image of warped events (IWE): events voted into pixels after compensation, or as they are."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from amiwarp.errors import AmiwarpError
from amiwarp.imaging.choices import Vote
from amiwarp.imaging.device_events import DeviceEvents, upload_events
from amiwarp.kernels.iwe import CPU_WIDTH, Frame, add_totals, empty_words, read_votes
from amiwarp.kernels.launch import Recorded, launch, launch_slices, slice_count
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
    vote_turning,
)
from amiwarp.optics.camera import LARGEST_SIZE
from amiwarp.optics.camera_rotation import CameraRotation
from amiwarp.optics.device_camera import pinhole_params
from amiwarp.optics.models import model_camera
from amiwarp.validation import choice, whole

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.events.encoder import Encoder
    from amiwarp.events.events import Events
    from amiwarp.optics.models import Model

PIECE = 1 << 22
"""Events that are put on the device at a time."""
PROBE, BATCH = 1 << 21, 1 << 27
"""Events that are voted at a time without a look at what their words held: on CUDA the words are emptied between. At
first few; then as many as the fullest word has room for, at most :data:`BATCH`. Where some were lost, and fewer at
once, every event looks."""
FILL = 600
"""Events that the fullest word of a batch should get: it has room for 1,023."""


@dataclass(frozen=True, slots=True)
class CanvasShape:
    """Where votes go: the sensor's image grown by ``pad`` px on each side, then scaled."""

    width: int
    """Sensor width [px]."""
    height: int
    """Sensor height [px]."""
    pad: int = 0
    """Border [sensor px] so that no event leaves the image."""
    scale: float = 1.0
    """Canvas pixels per sensor pixel."""
    per_polarity: bool = False
    """Two layers, OFF then ON, in place of one."""
    vote: Vote = Vote.BILINEAR
    parts: int = 1
    """Disjoint parts of the events, every so manieth, with images of their own."""
    dither: bool = False
    """Put each event somewhere in its pixel, not at its centre: nothing is won then by events on the pixel grid."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "vote", choice(Vote, self.vote, "vote"))
        for name in ("width", "height"):
            object.__setattr__(self, name, whole(getattr(self, name), f"canvas {name}", 1, LARGEST_SIZE, " pixels"))
        object.__setattr__(self, "pad", whole(self.pad, "canvas pad", 0, LARGEST_SIZE, " pixels"))

    @property
    def layers(self) -> int:
        """Images: parts, and in each OFF and ON where these are apart."""
        return self.parts * (2 if self.per_polarity else 1)

    @property
    def shape(self) -> tuple[int, int, int]:
        """(layers, rows, columns)."""
        rows = max(1, round((self.height + 2 * self.pad) * self.scale))
        columns = max(1, round((self.width + 2 * self.pad) * self.scale))
        return (self.layers, rows, columns)

    def params(self) -> Any:
        c = Canvas()
        c.pad, c.scale = float(self.pad), self.scale
        c.nearest, c.dither = int(self.vote is Vote.NEAREST), float(self.dither)
        c.rows, c.columns = self.shape[1] + 2, self.shape[2] + 2
        c.layer = c.rows * c.columns if self.layers > 1 else 0
        return c


class Image:
    """An image of a canvas on a device, zeros around it so that kernels need not look for its border."""

    def __init__(self, canvas: CanvasShape, radius: int, device: Any) -> None:
        """``radius``: how far kernels look [px]."""
        self.shape = canvas.shape
        self.device = wp.get_device(device)
        self.width = CPU_WIDTH if self.device.is_cpu else 1
        layers, rows, columns = canvas.shape
        f = Frame()
        f.rows, f.columns, f.blocks = rows, columns, -(-columns // self.width)
        f.stride = max(f.blocks * self.width, columns + radius)
        f.layer = (rows + radius) * f.stride
        f.first = (radius + 1) * f.stride
        self.frame = f
        self.blocks = layers * rows * f.blocks
        self.pixels = wp.zeros(f.first + layers * f.layer + f.stride, dtype=float, device=device)

    def _view(self, flat: NDArray[np.float32]) -> NDArray[np.float32]:
        layers, rows, columns = self.shape
        end = self.frame.first + layers * self.frame.layer
        stacked = flat[self.frame.first : end].reshape(layers, -1, self.frame.stride)
        return np.asarray(stacked[:, :rows, :columns])

    def numpy(self) -> NDArray[np.float32]:
        """A copy, shape (layers, rows, columns)."""
        return self._view(self.pixels.numpy()).copy()

    def write(self, image: NDArray[np.float32]) -> None:
        """Sets all pixels; shape (layers, rows, columns)."""
        flat = np.zeros(len(self.pixels), np.float32)
        self._view(flat)[...] = image
        wp.copy(self.pixels, wp.array(flat, dtype=float, device="cpu"))


class Votes:
    """Vote buffers of a canvas on a device, allocated once: one image per CPU slice, one on CUDA.

    No vote is lost, however many events meet in a pixel. On CUDA events must stay as they are until :meth:`take`.
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
        self._batches: list[tuple[list[Any], int, int]] = []  # of the fast way, not settled yet
        self._quick: bool | None = None if self.device.is_cuda else False
        if self.device.is_cuda:
            self._make_fast()

    def _make_fast(self) -> None:
        self._counts = wp.zeros((64, 1024), dtype=wp.int64, device=self.device)
        self._fullest = wp.zeros(1, dtype=int, device=self.device)
        self._batch = PROBE
        fast = self._fast = Cells()
        fast.words = wp.zeros_like(self._words[0])
        fast.totals, fast.spilled = wp.zeros_like(self._totals[0]), self._spilled[0]
        self._empty = wp.launch(
            empty_words, len(fast.words), [self._params, fast, 0], [self._counts, self._fullest], device=self.device,
            record_cmd=True,
        )  # fmt: skip
        inputs = [fast.totals, self._counts.flatten()]
        n = max(len(fast.totals), self._counts.size)
        self._keep = wp.launch(add_totals, n, inputs, [self._totals[0]], device=self.device, record_cmd=True)
        self._recorded: tuple[list[Any], Any] | None = None  # what was voted last, and how to vote it again
        self._read: tuple[Image, Any] | None = None

    def clear(self) -> None:
        self._forget()
        self._words.zero_()
        if self._any_total:
            self._totals.zero_()
            self._spilled.zero_()

    @property
    def _any_total(self) -> bool:
        return bool(self.device.is_cuda or self._spilled.numpy().any())

    def add_events(
        self, model: Model, events: DeviceEvents, *, drift: float = 0.0, camera_rotation: CameraRotation | None = None
    ) -> None:
        """Votes events on the same device after compensation by ``model``.

        ``turning`` is taken back where the events were given their times.
        """
        if events.slope is not None:
            events.drift(drift)
        params, camera = model.params(self.device), pinhole_params(model.camera)
        inputs = [params, camera or model_camera(model, self.device), events.arrays, self._params]
        if camera_rotation is not None and events.arrays.time.shape[0]:
            inputs = [params, model_camera(model, self.device), *inputs[2:], camera_rotation.params()]
            self._exactly(vote_turning, inputs, events.count)
        elif self.device.is_cuda and not len(events.arrays.weight):
            self._in_batches(inputs, events.count)
        elif self.device.is_cpu and camera is not None:
            blocks = -(-events.count // int(BLOCK))
            launch_slices(vote_blocks, blocks, [*inputs, events.count], self._cells, device=self.device, smallest=512)
        else:
            self._exactly(vote_events, inputs, events.count)

    def add_points(self, x: Any, y: Any, layer: Any, count: int | None = None) -> None:
        """Votes points as they are: ``x``, ``y`` Warp arrays of float [px], ``layer`` of uint8, the image each goes to.

        ``count``: so many of them, all without.
        """
        inputs, count = [x, y, layer, self._params], len(x) if count is None else count
        blocks = count // int(BLOCK) if self.device.is_cpu else 0
        launch_slices(vote_point_blocks, blocks, inputs, self._cells, device=self.device, smallest=8192)
        self._exactly(vote_points, inputs, count - blocks * int(BLOCK), blocks * int(BLOCK))

    def stretches(self, x: Any, y: Any, layer: Any) -> Callable[[int, int], None]:
        """For points of long-lived arrays: votes some from one on, on a CPU in blocks of 64 and by one thread."""
        kernel = vote_point_blocks if self.device.is_cpu else vote_points
        return Recorded(kernel, [x, y, layer, self._params], [self._cells[0]], device=self.device)

    def add_as_they_are(self, events: Events) -> None:
        """Votes events where they are, raw or compensated before; NaN coordinates vote nowhere."""
        x, y = (wp.array(v.astype(np.float32), dtype=float, device=self.device) for v in (events.x, events.y))
        self.add_points(x, y, wp.array(events.p, dtype=wp.uint8, device=self.device))

    def _exactly(self, kernel: Any, inputs: list[Any], count: int, first: int = 0) -> None:
        """Every event looks at what its word held."""
        launch_slices(kernel, count, inputs, self._cells, device=self.device, first=first)

    def _in_batches(self, inputs: list[Any], count: int) -> None:
        """On CUDA: fast, then checked; where words overflow, and for few events, exactly at once."""
        start, vote = 0, None
        while start < count:
            batch = min(count - start, self._batch)
            if self._quick is False or batch < PROBE:
                self._exactly(vote_events, inputs, count - start, start)
                return
            vote = vote or self._recording(inputs)
            vote.set_dim(batch)
            vote.set_param_at_index(len(inputs) + 1, start)
            vote.launch()
            self._empty.set_param_at_index(2, len(self._batches))
            self._empty.launch()
            self._fast.words.zero_()
            self._batches.append((inputs, batch, start))
            if self._quick is None or len(self._batches) == len(self._counts):
                self._settle()
            start += batch

    def _recording(self, inputs: list[Any]) -> Any:
        """The launch of a batch's votes, kept: to launch again what was recorded takes a tenth of the time."""
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

    def _settle(self) -> None:
        """Keeps what was voted fast, or votes it again, exactly, where words overflowed."""
        if not self._batches:
            return
        counts = self._counts[: len(self._batches)].numpy().sum(axis=1)
        if self._quick is None:
            self._batch = min(max(PROBE * FILL // max(int(self._fullest.numpy()[0]), 1), PROBE), BATCH)
        self._quick = bool((counts == [count for _, count, _ in self._batches]).all())
        if self._quick:
            self._keep.launch()
            self._batches.clear()
            return
        for inputs, count, first in self._batches:
            self._exactly(vote_events, inputs, count, first)
        self._forget()

    def _forget(self) -> None:
        if self._batches:
            self._fast.totals.zero_()
            self._counts.zero_()
            self._batches.clear()

    def read(self, image: Image) -> None:
        """Writes the image so far [events]; the votes stay."""
        self._settle()
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
        """The image so far [events], shape (layers, rows, columns); the canvas is empty afterwards."""
        self.read(self._image)
        self.clear()
        return self._image.numpy()


def iwe(
    events: Events,
    width: int,
    height: int,
    *,
    model: Model | None = None,
    encoder: Encoder | None = None,
    camera_rotation: CameraRotation | None = None,
    pad: int = 0,
    per_polarity: bool = False,
    vote: Vote = Vote.BILINEAR,
    device: Any = "cpu",
) -> NDArray[np.float32]:
    """Image of warped events [events per pixel].

    With ``model`` and ``encoder`` the events are compensated on the way, and the camera's ``turning`` is taken back if
    it is given; without, they are voted where they are.
    Shape (height + 2 pad, width + 2 pad), or (2, …) with OFF then ON where ``per_polarity``.
    """
    if (model is None) != (encoder is None):
        raise AmiwarpError("give both a model and an encoder to compensate the events, or neither")
    votes = Votes(CanvasShape(width, height, pad, 1.0, per_polarity, vote), device)
    for start in range(0, len(events), PIECE):
        piece = events[start : start + PIECE]
        if model is not None and encoder is not None:
            middle = None if camera_rotation is None else camera_rotation.middle_us
            arrays = upload_events(piece, encoder, device, middle_us=middle)
            votes.add_events(model, arrays, camera_rotation=camera_rotation)
        else:
            votes.add_as_they_are(piece)
    image = votes.take()
    return image if per_polarity else image[0]
