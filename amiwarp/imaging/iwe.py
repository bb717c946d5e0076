"""The image of warped events (IWE): events voted into pixels, with or without motion compensation."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, overload

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.choices import Vote
from amiwarp.errors import AmiwarpError
from amiwarp.events import device_events
from amiwarp.events.device_events import DeviceEvents, cast, device_for, wait
from amiwarp.events.encoder import Encoder, check_prisms
from amiwarp.events.recording import Events
from amiwarp.kernels import launch as launches
from amiwarp.kernels import pixel_votes
from amiwarp.kernels import tiles as kernels
from amiwarp.kernels import votes as event_kernels
from amiwarp.kernels.camera import CameraRotationParams, pinhole_params
from amiwarp.kernels.compensation import azimuths
from amiwarp.kernels.iwe import CPU_WIDTH, Frame, add_sums, add_totals, empty_words, read_sums, read_votes
from amiwarp.kernels.launch import Program, RecordedLaunch, launch, page_locked, specialised
from amiwarp.kernels.pixel_votes import BLOCK, CAPACITY
from amiwarp.kernels.prism_angle import encoder_params
from amiwarp.kernels.word_votes import TRASH, Cells, vote_events, vote_points, vote_quickly, vote_rotating_camera
from amiwarp.optics.camera import LARGEST_SIZE, CameraRotation
from amiwarp.optics.models import Model, model_camera
from amiwarp.tasks import cpu_threads
from amiwarp.validation import choice, guarded, whole


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
        if math.prod(self.shape) > 1 << 29:
            raise AmiwarpError(f"the image has shape {self.shape}, more than {1 << 29} pixels; give a smaller pad")

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
        c = event_kernels.Canvas()
        c.pad, c.scale = float(self.pad), self.scale
        c.nearest, c.dither = int(self.vote is Vote.NEAREST), float(self.dither)
        c.rows, c.columns = self.shape[1] + 2, self.shape[2] + 2
        c.layer = c.rows * c.columns if self.layers > 1 else 0
        return c


# Image of a canvas in the memory of a device.


class Image:
    """Image of a canvas on a device, padded with zeros so that kernels need not test for the border."""

    def __init__(self, canvas: CanvasShape, radius: int, device: Any) -> None:
        """Allocate the image. ``radius``: how far from a pixel kernels read [px]."""
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
        """Return the pixels inside the padding."""
        layers, rows, columns = self.shape
        end = self.frame.first + layers * self.frame.layer
        stacked = flat[self.frame.first : end].reshape(layers, -1, self.frame.stride)
        return np.asarray(stacked[:, :rows, :columns])

    def numpy(self) -> NDArray[np.float32]:
        """Return a copy, shape (layers, rows, columns)."""
        return self._view(self.pixels.numpy()).copy()

    def _device_view(self) -> Any:
        """Return the pixels inside the padding as a Warp array with gaps, shape (layers, rows, columns)."""
        f, size = self.frame, self.pixels.strides[0]
        return wp.array(
            ptr=self.pixels.ptr + f.first * size, dtype=float, shape=self.shape, device=self.device,
            strides=(f.layer * size, f.stride * size, size),
        )  # fmt: skip

    def on_device(self) -> Any:
        """Return a copy as a Warp array, shape (layers, rows, columns)."""
        out = wp.empty(self.shape, dtype=float, device=self.device)
        wp.copy(out, self._device_view())
        return out

    def write(self, image: NDArray[np.float32] | wp.array) -> None:
        """Set all pixels from an array of shape (layers, rows, columns): NumPy, or Warp on the same device."""
        if isinstance(image, wp.array):
            wp.copy(self._device_view(), image)
            return
        flat = np.zeros(len(self.pixels), np.float32)
        self._view(flat)[...] = image
        wp.copy(self.pixels, wp.array(flat, dtype=float, device="cpu"))


# Events on a device, with the prism angle of each event.

TURNS = 1 << 16
"""Number of distinct prism angles per turn. One step is 0.0055 deg.

On an orbit with a radius of 10 px, the rounding moves an event by at most 0.0005 px.
"""
ANGLES_AT_ONCE = 1 << 20
"""Number of angles that are converted at a time."""
LARGEST_FOLD = 1 << 16
"""Largest number of angle bins per turn into which a pixel's events can be merged."""
LARGEST_WEIGHT = 63
"""Largest number of events that one weighted point may represent; :mod:`amiwarp.kernels.tiles` packs the weight."""


@dataclass(frozen=True, slots=True)
class UploadedEvents:
    """Events with their prism angles on a device; made by :func:`upload_events`."""

    arrays: Any
    """Columns of the events: Warp struct ``amiwarp.kernels.votes.EventArrays``.

    Its column ``layer`` gives the image of each event: OFF goes to the first and ON to the second image, or both to the
    only one.
    """
    count: int
    """Number of entries, without padding."""
    total: int
    """Number of events that the entries stand for: ``count``, if they are not folded."""
    base: Any
    """Prism angles at drift 0 [1/65536 turn]; None if the angles do not depend on a drifting parameter."""
    slope: Any
    """Change of each prism angle per unit of the drifting parameter [1/65536 turn]; None if there is no such parameter.
    """
    second_base: Any = None
    """Angles of the second prism at drift 0 [1/65536 turn]; None for one prism."""
    ratio: float = 0.0
    """Mean speed of the second prism relative to the first."""

    def drift(self, value: float) -> None:
        """Set the prism angles for the value ``value`` of the drifting parameter."""
        moved = [(self.base, value, self.arrays.turn)]
        if self.second_base is not None:
            moved.append((self.second_base, self.ratio * value, self.arrays.second))
        for base, change, out in moved:
            launch(event_kernels.drift_turns, self.count, [base, self.slope, change], [out], device=base.device)

    def in_parts(self, parts: int, *, per_polarity: bool) -> UploadedEvents:
        """Return the same events split over ``parts`` images, or over ``parts`` pairs (OFF, ON) of images."""
        old = self.arrays.layer
        layer = wp.empty_like(old)
        launch(event_kernels.layer_events, len(old), [old, parts, int(per_polarity)], [layer], device=old.device)
        return self._with(layer=layer)

    def every(self, step: int) -> UploadedEvents:
        """Return every ``step``-th event, copied on the device. The events must not be folded."""
        a, base = self.arrays, self.base

        def cut(values: Any) -> Any:
            if values is None or not len(values):
                return values
            on_cpu = values.device.is_cpu
            part = values.numpy()[: self.count : step] if on_cpu else values[: self.count : step].contiguous()
            return _put(part, values.dtype, values.device)

        turn = cut(a.turn if base is None else base)
        columns = {name: cut(getattr(a, name)) for name in ("x", "y", "layer", "time")}
        columns["second"] = cut(a.second if self.second_base is None else self.second_base)
        few = self._with(turn=turn, **columns)
        n, base = -(-self.count // step), None if base is None else wp.clone(turn)
        second = None if self.second_base is None else wp.clone(columns["second"])
        return replace(few, count=n, total=n, base=base, slope=cut(self.slope), second_base=second)

    def at_angles(self, angles: NDArray[np.float64]) -> UploadedEvents:
        """Return the same events at other prism angles [rad], shape ``(n,)``. The other columns are not copied."""
        return self._with(turn=_put(_turns(angles), wp.uint16, self.arrays.turn.device))

    def _with(self, **columns: wp.array) -> UploadedEvents:
        """Return the same events with other columns."""
        e = event_kernels.EventArrays()
        for name in ("x", "y", "turn", "second", "azimuths", "time", "weight", "layer"):
            setattr(e, name, columns.get(name, getattr(self.arrays, name)))
        return replace(self, arrays=e)


def upload_events(
    events: Events | DeviceEvents,
    angles: Encoder | NDArray[np.float64],
    device: Any,
    *,
    slope: NDArray[np.float64] | None = None,
    middle_us: int | None = None,
    fold: int = 0,
) -> UploadedEvents:
    """Copy events to ``device`` and attach a prism angle to each. Events on the device are not copied.

    Parameters
    ----------
    events : Events or DeviceEvents
        Events with whole pixel coordinates (uint16), sorted by time.
    angles : Encoder or ndarray
        Encoder from which the angles are interpolated, or one angle per event [rad], shape ``(n,)``.
    device : str or warp.Device
        Device to copy to.
    slope : ndarray, optional
        Change of each angle [rad] per unit of a drifting parameter, shape ``(n,)``.
    middle_us : int, optional
        Reference time [us]. If it is given, the event times relative to it are stored too, so that the camera rotation
        can be compensated.
    fold : int, optional
        Number of angle bins per turn, for a still scene; 0 disables folding. All events of one pixel, polarity and bin
        become one weighted point at the middle of the bin. Cannot be combined with ``slope`` and ``middle_us``.

    Returns
    -------
    UploadedEvents
        The events on the device.

    Raises
    ------
    AmiwarpError
        If the encoder does not cover the events, or ``fold`` is out of range.
    """
    device_events.check_sensor(events)
    n, device = len(events), wp.get_device(device)
    padded = _padded(n, device)

    def put(values: Any, dtype: Any) -> Any:
        return _put(values, dtype, device)

    e = event_kernels.EventArrays()
    e.x, e.y = put(events.x, wp.uint16), put(events.y, wp.uint16)
    e.layer = put(events.p, wp.uint8)
    e.azimuths, e.time = azimuths(str(device)), wp.empty(0, dtype=float, device=device)
    e.weight, e.second = wp.empty(0, dtype=wp.uint8, device=device), wp.empty(0, dtype=wp.uint16, device=device)
    if not isinstance(angles, np.ndarray) or middle_us is not None:
        t = _times(events, device)
    if isinstance(angles, np.ndarray):
        e.turn = put(_turns(angles), wp.uint16)
    else:
        e.turn = wp.zeros(padded, dtype=wp.uint16, device=device)
        if n:
            encoder = encoder_params(angles, *device_events.time_span(events), device)
            launch(event_kernels.turn_events, n, [encoder, t], [e.turn], device=device)
            if angles.second is not None:
                e.second = wp.zeros(padded, dtype=wp.uint16, device=device)
                launch(event_kernels.turn_second, n, [encoder, t], [e.second], device=device)
    if middle_us is not None:
        e.time = wp.empty(n, dtype=float, device=device)
        launch(event_kernels.time_events, n, [t, middle_us], [e.time], device=device)
    if fold:
        keys = _fold_keys(e, n, fold)
        del e  # free arrays after their last use: with ten million events, each has tens of megabytes
        points = _split(*_runs(keys))
        del keys
        return _folded(*points, n, fold, device)
    if slope is None:
        return UploadedEvents(e, n, n, None, None)
    slopes = put((slope * (TURNS / (2.0 * np.pi))).astype(np.float32), float)
    found = UploadedEvents(e, n, n, wp.clone(e.turn), slopes)
    ratio = None if isinstance(angles, np.ndarray) else angles.ratio
    return found if ratio is None else replace(found, second_base=wp.clone(e.second), ratio=ratio)


def _padded(n: int, device: Any) -> int:
    """Return the padded length of a column of ``n`` events: CPU kernels process whole blocks."""
    return -(-n // int(BLOCK)) * int(BLOCK) if device.is_cpu else n


def _put(values: NDArray[Any] | wp.array, dtype: Any, device: Any) -> Any:
    """Copy values to the device, padded with zeros. A Warp array there that needs no padding is not copied."""
    n = len(values)
    if _padded(n, device) == n:
        return values if isinstance(values, wp.array) else wp.array(values, dtype=dtype, device=device)
    array = wp.zeros(_padded(n, device), dtype=dtype, device=device)
    array.numpy()[:n] = values.numpy() if isinstance(values, wp.array) else values  # only CPUs pad
    return array


def _times(events: Events | DeviceEvents, device: Any) -> wp.array:
    """Return the times of events on the device. On a CPU they are not copied."""
    if isinstance(events, DeviceEvents):
        return events.t
    return wp.array(events.t, dtype=wp.int64, device=device, copy=False)


def _turns(angles: NDArray[np.float64]) -> NDArray[np.uint16]:
    """Return prism angles [rad] in units of 1/65536 turn. They are converted in pieces, to need little memory."""
    turns = np.empty(len(angles), np.uint16)
    for start in range(0, len(angles), ANGLES_AT_ONCE):
        piece = slice(start, start + ANGLES_AT_ONCE)
        turns[piece] = np.rint(angles[piece] * (TURNS / (2.0 * np.pi))).astype(np.int64)
    return turns


def _fold_keys(e: Any, n: int, bins: int) -> NDArray[np.int64]:
    """Return the sorted keys of events: bin, pixel and polarity. Neighbours share an angle, as the bin comes first."""
    device = e.x.device
    if not 1 <= bins <= LARGEST_FOLD:
        raise AmiwarpError(f"fold = {bins} angles a turn; give 1 .. {LARGEST_FOLD}, or 0 to disable folding")
    room = n if device.is_cpu else 2 * n  # sorting on CUDA needs scratch memory behind the keys
    keys = wp.empty(room, dtype=wp.int64, device=device)
    launch(event_kernels.fold_keys, n, [e.x, e.y, e.layer, e.turn, bins], [keys], device=device)
    if device.is_cpu:
        values = keys.numpy()  # shares the memory of keys
        values.sort()
        return values
    wp.utils.radix_sort_pairs(keys, wp.zeros(room, dtype=int, device=device), n)
    return np.asarray(keys[:n].numpy())


def _folded(key: NDArray[np.int64], weight: NDArray[np.uint8], n: int, bins: int, device: Any) -> UploadedEvents:
    """Return weighted points on the device by their keys. They stand for ``n`` events."""
    m = len(key)
    out = event_kernels.EventArrays()
    out.x, out.y, out.turn = (wp.zeros(_padded(m, device), dtype=wp.uint16, device=device) for _ in range(3))
    out.layer = wp.zeros(_padded(m, device), dtype=wp.uint8, device=device)
    out.weight, out.azimuths = _put(weight, wp.uint8, device), azimuths(str(device))
    out.time, out.second = wp.empty(0, dtype=float, device=device), wp.empty(0, dtype=wp.uint16, device=device)
    launch(
        event_kernels.unfold_keys,
        m,
        [wp.array(key, dtype=wp.int64, device=device, copy=False), bins],
        [out],
        device=device,
    )
    return UploadedEvents(out, m, n, None, None)


def _runs(keys: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """Return each distinct value of a sorted array, and how often it occurs."""
    starts = np.ones(len(keys), dtype=bool)
    np.not_equal(keys[1:], keys[:-1], out=starts[1:])
    first = np.flatnonzero(starts).astype(np.int32)
    return keys[first], np.diff(first, append=np.int32(len(keys)))


def _split(key: NDArray[np.int64], count: NDArray[np.int32]) -> tuple[NDArray[np.int64], NDArray[np.uint8]]:
    """Return keys and weights of points; more than :data:`LARGEST_WEIGHT` events need several points."""
    if not len(count) or int(count.max()) <= LARGEST_WEIGHT:
        return key, count.astype(np.uint8)
    times = -(-count // LARGEST_WEIGHT)
    weight = np.full(int(times.sum()), LARGEST_WEIGHT, dtype=np.uint8)
    weight[np.cumsum(times) - 1] = count - (times - 1) * LARGEST_WEIGHT
    return np.repeat(key, times), weight


# Buffers of votes on a CPU: one image of 32-bit sums per slice.

SMALLEST = 512
"""Fewest blocks of a slice."""


class PixelVotes:
    """Sums of the votes of each pixel on a CPU, allocated once. Before they overflow, they move to 64-bit totals."""

    EVENTS, EVENTS_OF_ROTATING_CAMERA, POINTS = (
        pixel_votes.vote_event_blocks,
        pixel_votes.vote_rotating_camera_blocks,
        pixel_votes.vote_point_blocks,
    )
    """Kernels for :meth:`vote`."""

    def __init__(self, canvas: Any, layers: int) -> None:
        """Allocate the sums. ``canvas``: Warp struct ``amiwarp.kernels.votes.Canvas``."""
        self._canvas, self._cells = canvas, layers * canvas.rows * canvas.columns
        # votes and blocks of pixels may reach beyond the last row, with zeros
        size = self._cells + canvas.columns + 2 + CPU_WIDTH
        self._sums = wp.zeros((cpu_threads(), size), dtype=int, device="cpu")
        self._slices = [self._sums[k] for k in range(self._sums.shape[0])]
        self._totals = wp.empty(0, dtype=wp.int64, device="cpu")
        self._room = CAPACITY  # number of events that the sums can still take
        self._stale = False  # whether the sums are to be cleared before they are used
        self._reader: tuple[Image, Program] | None = None
        """Image that was read last, and the recorded launch that reads it."""

    def clear(self) -> None:
        """Discard all votes. The next vote clears the sums, each in the thread that adds to it."""
        self._stale = True
        self._totals = wp.empty(0, dtype=wp.int64, device="cpu")
        self._room = CAPACITY

    def _clear_stale(self) -> None:
        """Clear the sums if they are to be cleared, so that they can be used."""
        if self._stale:
            launches.run_together([one.zero_ for one in self._slices])
            self._stale = False

    def range_voter(self, x: Any, y: Any, layer: Any) -> Callable[[int, int], None]:
        """Return a function that votes a range of blocks of points in the calling thread."""
        inputs = [x, y, layer, self._canvas, len(x), 0]
        vote = RecordedLaunch(pixel_votes.vote_point_blocks, inputs, [self._slices[0]], device="cpu")

        def vote_range(first: int, blocks: int) -> None:
            self._reserve(blocks * int(BLOCK))
            self._clear_stale()
            vote(first, blocks)

        return vote_range

    def vote(self, kernel: Any, inputs: list[Any], count: int, total: int) -> None:
        """Vote ``count`` entries that stand for ``total`` events, in pieces that fit into the sums."""
        blocks, piece = -(-count // int(BLOCK)), CAPACITY // (int(BLOCK) * (1 if total == count else LARGEST_WEIGHT))
        if total <= CAPACITY:
            piece = max(blocks, 1)
        for first in range(0, blocks, piece):
            n = min(piece, blocks - first)
            self._reserve(total if n == blocks else CAPACITY)
            columns = [*inputs, count]
            launches.launch_slices(kernel, n, columns, self._slices, first=first, smallest=SMALLEST, clear=self._stale)
            self._stale = False

    def _reserve(self, events: int) -> None:
        """Make room for the votes of a number of events."""
        if events > self._room:
            if not len(self._totals):
                self._totals = wp.zeros(self._cells, dtype=wp.int64, device="cpu")
            launch(add_sums, self._cells, [self._sums], [self._totals], device="cpu")
            self._stale = True
            self._room = CAPACITY
        self._room -= events

    def read(self, image: Image) -> None:
        """Write the current image [events] to ``image``; the votes are kept."""
        self._clear_stale()
        inputs = [self._sums, self._totals, self._canvas, image.frame]
        if len(self._totals):
            launch(read_sums, image.blocks, inputs, [image.pixels], device="cpu", smallest=SMALLEST)
            return
        if self._reader is None or self._reader[0] is not image:
            program = Program("cpu")
            program.add(read_sums, image.blocks, inputs, [image.pixels], smallest=SMALLEST)
            self._reader = image, program
        self._reader[1].launch()


# Buffers of votes on CUDA: one image of 64-bit words, each of which holds the sums of a cell.

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


class WordVotes:
    """Words of the cells of an image on CUDA, and 64-bit totals, allocated once."""

    EVENTS, EVENTS_OF_ROTATING_CAMERA, POINTS = vote_events, vote_rotating_camera, vote_points
    """Kernels for :meth:`vote`."""

    def __init__(self, canvas: Any, layers: int, device: Any) -> None:
        """Allocate the words. ``canvas``: Warp struct ``amiwarp.kernels.votes.Canvas``."""
        self._params, self.device = canvas, device
        n = self._trash = layers * canvas.rows * canvas.columns
        self._cells, self._fast = Cells(), Cells()
        for cells in (self._cells, self._fast):
            cells.words = wp.zeros(n + int(TRASH), dtype=wp.uint64, device=device)
            cells.totals = wp.zeros(n, dtype=wp.int64, device=device)
        self._batches: list[tuple[list[Any], int, int]] = []  # voted by the fast kernel, not verified yet
        self._batches_fit: bool | None = None
        self._batch = FIRST_BATCH
        self._recorded: tuple[list[Any], RecordedLaunch] | None = None  # inputs of the last fast vote, and its launch
        self._read: tuple[Image, RecordedLaunch] | None = None
        self._record_launches()

    def _record_launches(self) -> None:
        """Record the launches that follow each batch of the fast vote."""
        self._counts = wp.zeros((64, 1024), dtype=wp.int64, device=self.device)
        self._fullest = wp.zeros(1, dtype=int, device=self.device)
        fast = self._fast
        inputs, to = [self._params, fast, 0], [self._counts, self._fullest]
        self._clear_words = RecordedLaunch(empty_words, inputs, to, device=self.device, n=len(fast.words))
        inputs, to = [fast.totals, self._counts.flatten()], [self._cells.totals]
        n = max(len(fast.totals), self._counts.size)
        self._add_fast_totals = RecordedLaunch(add_totals, inputs, to, device=self.device, n=n)

    def clear(self) -> None:
        """Discard all votes."""
        self._discard_batches()
        self._cells.words.zero_()
        self._cells.totals.zero_()

    def range_voter(self, x: Any, y: Any, layer: Any) -> Callable[[int, int], None]:
        """Return a function that votes a range of points."""
        return RecordedLaunch(vote_points, [x, y, layer, self._params, 0], [self._cells], device=self.device)

    def vote(self, kernel: Any, inputs: list[Any], count: int, total: int) -> None:
        """Vote ``count`` entries that stand for ``total`` events.

        Many events are voted by the fast kernel, whose result is verified later. ``kernel`` votes all others exactly:
        it checks for overflow at every addition.
        """
        start, vote, fast = 0, None, kernel is self.EVENTS and total == count
        while fast and self._batches_fit is not False and count - start >= FIRST_BATCH:
            batch = min(count - start, self._batch)
            vote = vote or self._recorded_vote(inputs)
            vote(start, batch)
            self._clear_words.set(2, len(self._batches))
            self._clear_words.repeat()
            self._fast.words.zero_()
            self._batches.append((inputs, batch, start))
            if self._batches_fit is None or len(self._batches) == len(self._counts):
                self._verify_batches()
            start += batch
        launch(kernel, count - start, inputs, [self._cells], device=self.device, first=start)

    def _recorded_vote(self, inputs: list[Any]) -> RecordedLaunch:
        """Return the recorded launch of the fast kernel, which takes a tenth of the time of a new launch."""
        if self._recorded is not None:
            before, vote = self._recorded
            if type(inputs[0]) is type(before[0]) and all(a is b for a, b in zip(inputs[1:], before[1:], strict=True)):
                vote.set(0, inputs[0])
                self._recorded = inputs, vote
                return vote
        vote = RecordedLaunch(vote_quickly, [*inputs, self._trash, 0], [self._fast], device=self.device)
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
            self._add_fast_totals.repeat()
            self._batches.clear()
            return
        for inputs, count, first in self._batches:
            launch(vote_events, count, inputs, [self._cells], device=self.device, first=first)
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
        if self._read is None or self._read[0] is not image:
            given, to = [self._cells, self._params, image.frame, 0], [image.pixels]
            self._read = image, RecordedLaunch(read_votes, given, to, device=self.device, n=image.blocks)
        self._read[1].repeat()


# Votes into one image, on any device.


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
        if (model.ANGLES == 2) != (events.arrays.second.shape[0] > 0) and events.count:
            raise AmiwarpError(
                f"the events have the angles of {1 + (model.ANGLES == 1)} prisms, the model {model.ANGLES}"
            )
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


# Events prepared for repeated voting on CUDA, for several candidate parameter sets per pass.


class TileVotes:
    """Events sorted by image tile, and the vote images of a few candidate parameter sets.

    Buffers are allocated once. ``launch`` only launches kernels, so it can be captured in a CUDA graph. Kernels read
    the parameters from device memory when they run.
    """

    def __init__(
        self, image: Image, canvas: CanvasShape, events: UploadedEvents, like: Model, *, candidates: int = 1
    ) -> None:
        """Sort the events. ``image`` is an image of the canvas, into which votes are read later.

        ``like`` is a model with the type and camera of the candidates.
        """
        device = self.device = image.device
        self.canvas, self.candidates = canvas, candidates
        still = len(events.arrays.time) == 0 and events.slope is None
        self._params = canvas.params()
        self._camera = (pinhole_params(like.camera) if still else None) or model_camera(like, self.device)
        self._arrays = self._sort(events)
        self.votes = wp.zeros((candidates, len(image.pixels)), dtype=wp.int64, device=device)
        """Votes of each candidate parameter set [1/256 event], in the memory layout of the image."""
        frame, self._layout = image.frame, kernels.Layout()
        self._layout.stride, self._layout.layer, self._layout.first = frame.stride, frame.layer, frame.first
        self._layout.shift = (canvas.pad + 0.5) * canvas.scale - 0.5
        dtypes = (like.STRUCT,) if still else (like.STRUCT, float, CameraRotationParams)
        self._host = [page_locked(self, (candidates,), dtype, device, written_by_host=True) for dtype in dtypes]
        self._on_device = [wp.zeros(candidates, dtype=array.dtype, device=device) for array in self._host]
        self._rows = self._host[0].numpy()
        self._drifts = None if still else self._host[1].numpy()
        self._motion: Any = kernels.Still()
        if not still:
            self._motion = kernels.Motion()
            self._motion.drift, self._motion.camera_rotation = self._on_device[1:]
        self._inputs = [self._on_device[0], self._camera, self._arrays, self._motion, self._params, self._layout]
        self._kernel = specialised(kernels.vote_tiles, self._inputs)

    def _sort(self, events: UploadedEvents) -> Any:
        """Sort the events by tile and pack each event into one word."""
        a, n, device = events.arrays, events.count, self.device
        layers = self.canvas.shape[0]
        size = min(kernels.TILE, max(1, int(kernels.TILE / self.canvas.scale)))
        across, down = -(-self.canvas.width // size), -(-self.canvas.height // size)
        keys, order = (wp.empty(2 * n, dtype=int, device=device) for _ in range(2))
        counts = wp.zeros(layers * across * down, dtype=int, device=device)
        inputs = [a.x, a.y, a.layer, layers, across, across * down, size]
        wp.launch(kernels.key_events, n, inputs, [keys, order, counts], device=device)
        wp.utils.radix_sort_pairs(keys, order, n, end_bit=(layers * across * down).bit_length())
        slope = events.slope if events.slope is not None else wp.empty(0, dtype=float, device=device)
        out = kernels.TileEvents()
        out.packed = wp.empty(n, dtype=wp.uint32, device=device)
        out.slope, out.time = (wp.empty(n if len(v) else 0, dtype=float, device=device) for v in (slope, a.time))
        turn = events.base if events.base is not None else a.turn
        wp.launch(kernels.pack_events, n, [a.x, a.y, turn, slope, a.time, a.weight, order, size], [out], device=device)
        out.chunks = wp.array(self._chunks(counts.numpy(), size, across, down), dtype=kernels.Chunk, device=device)
        return out

    def _chunks(self, counts: Any, size: int, across: int, down: int) -> Any:
        """Return runs of at most CHUNK events of one tile and layer, each with a vote window centred on the tile."""
        pieces = -(-counts // kernels.CHUNK)
        if not pieces.any():
            pieces[0] = 1  # an empty chunk, if there are no events
        key = np.repeat(np.arange(len(counts)), pieces)
        first = np.cumsum(pieces) - pieces  # number of the first chunk of each tile and layer
        struct: Any = kernels.Chunk
        chunks = np.zeros(len(key), dtype=struct.numpy_dtype())
        stop = np.cumsum(counts)[key]
        start = stop - counts[key] + (np.arange(len(key)) - first[key]) * kernels.CHUNK
        chunks["start"], chunks["stop"] = start, np.minimum(start + kernels.CHUNK, stop)
        layer, tile = np.divmod(key, across * down)
        chunks["layer"] = layer
        chunks["x"], chunks["y"] = tile % across * size, tile // across * size
        for name, origin, window in (("column", "x", kernels.COLUMNS), ("row", "y", kernels.ROWS)):
            middle = (chunks[origin] + size / 2.0 + self.canvas.pad) * self.canvas.scale
            chunks[name] = np.rint(middle - int(window) / 2)
        return chunks

    def set(self, k: int, model: Model, *, drift: float = 0.0, camera_rotation: CameraRotation | None = None) -> None:
        """Set the parameters of candidate ``k`` for the next :meth:`launch`. A previous launch must have finished.

        ``drift`` and ``camera_rotation`` move only events that have slopes or times.
        """
        self._rows[k] = model.kernel_values()
        if self._drifts is not None:
            self._drifts[k] = drift
            _write(self._host[2], k, (camera_rotation or CameraRotation()).params())

    def launch(self) -> None:
        """Compute the image of warped events of every candidate."""
        for host, there in zip(self._host, self._on_device, strict=True):
            wp.copy(there, host)
        self.votes.zero_()
        blocks = len(self._arrays.chunks) * -(-self.candidates // int(kernels.AT_ONCE))
        wp.launch(
            self._kernel, (blocks, int(kernels.THREADS)), self._inputs, [self.votes], device=self.device,
            block_dim=int(kernels.THREADS),
        )  # fmt: skip

    def read(self, k: int, image: Image) -> None:
        """Write the image of candidate ``k`` [events] to ``image``."""
        wp.launch(kernels.read_tiles, len(image.pixels), [self.votes[k], 0], [image.pixels], device=self.device)


def _write(array: Any, k: int, struct: Any) -> None:
    """Write a struct to element ``k`` of an array of structs on the host."""
    size = wp.types.type_size_in_bytes(array.dtype)
    ctypes.memmove(array.ptr + k * size, ctypes.byref(struct.__ctype__()), size)


# The image of given events.

PIECE = 1 << 22
"""Number of events that are copied to the device at a time."""


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
        Events to vote, sorted by time. Those that are compensated, here or before, and lie outside the image are left
        out.
    width, height : int
        Sensor size [px].
    model : Model, optional
        Optical model of the prism. Requires ``encoder``.
    encoder : Encoder, optional
        Encoder that covers the events. Requires ``model``.
    camera_rotation : CameraRotation, optional
        The camera's own rotation, compensated together with the prism. Requires ``model`` and ``encoder``.
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
        If only one of ``model`` and ``encoder`` is given, or ``camera_rotation`` without them; if the encoder does not
        cover the events, their times decrease, a raw event lies outside the sensor, or they are on another device than
        ``device``.

    Examples
    --------
    >>> events = amiwarp.Events.from_arrays([1, 1, 2], [0, 0, 1], [0, 10, 20], [0, 1, 1])
    >>> amiwarp.iwe(events, 4, 2)
    array([[0., 2., 0., 0.],
           [0., 0., 1., 0.]], dtype=float32)
    """
    if (model is None) != (encoder is None):
        raise AmiwarpError("only one of model and encoder is given; give both a model and an encoder, or neither")
    if model is not None and encoder is not None:
        check_prisms(encoder, model.ANGLES)
    elif camera_rotation is not None:
        raise AmiwarpError("camera_rotation is given without a model and an encoder, which it needs; give all three")
    device = device_for(events, device)
    device_events.check_order(events)
    votes = Votes(CanvasShape(width, height, pad, 1.0, per_polarity, vote), device)
    device_events.check_inside(events, width, height)
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
