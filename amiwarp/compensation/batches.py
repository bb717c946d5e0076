"""Batches of a stream's events on their way through a device: put together, moved, fetched, voted."""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.compensation.launch_plan import Placing
from amiwarp.compensation.packet_copy import PIECE, PacketCopier, address
from amiwarp.errors import AmiwarpError
from amiwarp.events.device_encoder import encoder_pieces
from amiwarp.imaging.warped_image import CanvasShape, Votes
from amiwarp.kernels.compensation import Columns
from amiwarp.kernels.encoder import EncoderParams
from amiwarp.kernels.launch import Recorded, beside, launch

if TYPE_CHECKING:
    from concurrent.futures import Future

    from amiwarp.events.encoder import Encoder
    from amiwarp.events.events import Events
    from amiwarp.kernels.launch import Recorded
    from amiwarp.optics.models import Model

ROUNDS = 4
"""Batches that the buffers hold: those before may still be voted."""
VOTED = 1 << 16
"""Events that are voted into the image at a time."""
SLICE = 4096
"""Blocks that are worth more threads than one."""
DIRECT = 1 << 16
"""Events from which on a GPU writes to where its results are handed out."""
SPARE = 16
"""Arrays that are kept of a kind."""


OUT = ("out_x", "out_y", "inside")
"""Columns of results."""
Lent: TypeAlias = tuple[Any, NDArray[Any]]
"""An array of Warp's and the part of it that is lent."""


@dataclass(frozen=True, slots=True, eq=False)
class Started:
    """A batch that is put together at ``at`` to ``end`` of the buffers."""

    parts: list[Events]
    at: int
    end: int
    t: NDArray[np.int64]
    p: NDArray[np.uint8]
    arrived_us: int
    lent: Lent | None
    """Where its times are, if not in the buffers."""
    found: Callable[[], tuple[bool, int, int]]
    """Waits until it is together: whether any part is unsorted, and the largest x and y."""


@dataclass(frozen=True, slots=True, eq=False)
class BatchInFlight:
    """A batch that a device works on: from ``at`` to ``end`` of the buffers."""

    at: int
    end: int
    t: NDArray[np.int64]
    p: NDArray[np.uint8]
    unknown: int
    """Events at its beginning that have no angle."""
    arrived_us: int
    out: list[NDArray[Any]] | None
    """Where a GPU writes places and whether they are inside; None: into the buffers."""
    done: Any
    """A ``wp.Event`` on CUDA."""


class Batches:
    """Buffers of a stream's compensation, allocated once, and what is done with them; for one thread."""

    def __init__(self, model: Model, batch: int, device: Any) -> None:
        """``batch``: most events of one."""
        self._device, self._at = device, 0
        self._encoder: Any = None
        self._placed: list[tuple[int, int]] = []  # stretches that were not voted yet
        self._voting: deque[tuple[int, int, Future[None]]] = deque()
        self._placing = Placing(model, device)
        self._block = self._placing.block
        self._room = ROUNDS * self._placing.padded(batch)
        dtypes = {"x": wp.uint16, "y": wp.uint16, "t": wp.int64, "out_x": float, "out_y": float, "inside": wp.uint8}
        columns = self._columns = Columns()
        for name, dtype in dtypes.items():
            setattr(columns, name, wp.zeros(self._room, dtype=dtype, device=device))
        self._ours = columns if device.is_cpu else Columns()
        if not device.is_cpu:
            for name, dtype in dtypes.items():
                setattr(self._ours, name, wp.zeros(self._room, dtype=dtype, device="cpu", pinned=True))
        self._host = {name: getattr(self._ours, name).numpy() for name in dtypes}
        self._layer = wp.zeros(self._room, dtype=wp.uint8, device=device)
        self._recorded: dict[bool, Recorded] = {}
        self._spare, self._gatherers = PinnedPool(batch), [PacketCopier(), PacketCopier()]
        self._votes = Votes(CanvasShape(*self._placing.size), device)
        self._stretches = self._votes.stretches(columns.out_x, columns.out_y, self._layer)
        if device.is_cuda and batch > DIRECT:
            self._spare.fill()

    def set_encoder(self, encoder: Encoder, first: int, last: int) -> None:
        """Puts its pieces over a span of event times [us] into one bucket, where a search finds them: they are few."""
        origin, *pieces = encoder_pieces(encoder, first, last)
        n, p = len(pieces[0]), self._encoder
        if p is None or n > len(p.start):
            p = self._encoder = EncoderParams()
            p.shift, p.first = 62, wp.zeros(2, dtype=int, device=self._device)
            p.start, p.angle, p.slope = (
                wp.zeros(max(2 * n, 64), dtype=dtype, device=self._device) for dtype in (wp.int64, wp.uint64, wp.uint64)
            )
        p.origin = origin
        for to, values in zip(
            (p.first, p.start, p.angle, p.slope), (np.array([0, n - 1], np.int32), *pieces), strict=True
        ):
            if self._device.is_cpu:
                to.numpy()[: len(values)] = values
            else:
                wp.copy(to, wp.array(values, dtype=to.dtype, device="cpu", copy=False), count=len(values))
        for command in self._recorded.values():
            command.set(3, p)

    def start(self, parts: list[Events], arrived_us: int) -> Started:
        """Begins to put a batch together, by other threads where it is long."""
        n, several = sum(part.t.size for part in parts), len(parts) > 1
        padded = self._placing.padded(n)
        if self._at + padded > self._room:
            self._at = 0
        at, end = self._at, self._at + n
        self._at += padded
        self._vote(least=1 if any(begin < self._at and stop > at for begin, stop in self._placed) else VOTED)
        self._wait_for_votes(at, self._at)
        direct, p = self._device.is_cuda and n > DIRECT, parts[0].p
        lent = self._spare(n, np.int64) if direct else None
        t = self._host["t"][at:end] if lent is None else lent[1]
        if several:
            p = self._spare(n, np.uint8)[1] if direct else np.empty(n, np.uint8)
        to = [self._host["x"][at:end], self._host["y"][at:end], t, p]
        if several or n > PIECE:
            self._gatherers.reverse()
            addresses = [address(column) for column in to]
            return Started(
                parts, at, end, t, p, arrived_us, lent, self._gatherers[0](parts, n, addresses, with_p=several)
            )
        # as quickly as that goes, for a single packet
        to[0][:], to[1][:], to[2][:] = parts[0].x, parts[0].y, parts[0].t
        found = bool((t[1:] < t[:-1]).any()), int(to[0].max()), int(to[1].max())
        return Started(parts, at, end, t, p, arrived_us, lent, lambda: found)

    def begin(self, started: Started, unknown: int) -> BatchInFlight:
        """Sends a batch on its way; the first ``unknown`` get no place. Raises :class:`AmiwarpError` where unsorted."""
        s, (unsorted, x, y) = started, started.found()
        at, end, n = s.at, s.end, s.end - s.at
        if unsorted:
            raise AmiwarpError(
                f"events of {s.parts[0].t[0]} to {s.parts[-1].t[-1]} us are not sorted; sort each packet"
            )
        if self._device.is_cuda:
            self._copy(self._columns, self._ours, ("x", "y") if s.lent else ("x", "y", "t"), at, end)
            if s.lent is not None:
                wp.copy(self._columns.t, s.lent[0], dest_offset=at, count=n)
        padded = self._placing.padded(n)
        if unknown < n:
            # what fills up the last block is placed too, so that it must have a place
            for name, value in (("x", 0), ("y", 0), ("t", s.t[-1])):
                self._host[name][end : at + padded] = value
            self._launch(at // self._block, padded // self._block, self._placing.strays(x, y))
        self._nowhere(at, at + unknown)
        self._nowhere(end, at + padded)
        self._placed.append((at, at + padded))
        out, done = None, None
        if self._device.is_cuda:
            out = self._send_back(at, end, s.lent is not None)
            done = wp.record_event(wp.Event(self._device))
        self._vote(least=VOTED)
        t = s.t if s.lent else s.t.copy() if len(s.parts) > 1 else s.parts[0].t
        return BatchInFlight(at, end, t, s.p, unknown, s.arrived_us, out, done)

    def end(self, begun: BatchInFlight) -> list[NDArray[Any]]:
        """Places x, y [px] and flags, outside the image or not."""
        if begun.done is not None:
            wp.synchronize_event(begun.done)
        if begun.out is None:
            x, y, inside = (self._host[name][begun.at : begun.end].copy() for name in OUT)
        else:
            x, y, inside = begun.out
        return [x, y, np.bitwise_xor(inside, np.uint8(1), out=inside)]

    def _send_back(self, at: int, end: int, direct: bool) -> list[NDArray[Any]] | None:
        """Starts the results' way from a GPU, where there are many into arrays that are handed out."""
        if not direct:
            self._copy(self._ours, self._columns, OUT, at, end)
            return None
        lent = [self._spare(end - at, dtype) for dtype in (np.float32, np.float32, np.uint8)]
        for name, (array, _) in zip(OUT, lent, strict=True):
            wp.copy(array, getattr(self._columns, name), src_offset=at, count=end - at)
        return [view for _, view in lent]

    def _copy(self, to: Any, source: Any, names: tuple[str, ...], at: int, end: int) -> None:
        for name in names:
            columns = getattr(to, name), getattr(source, name)
            wp.copy(*columns, dest_offset=at, src_offset=at, count=end - at)

    def _launch(self, first: int, blocks: int, strays: bool) -> None:
        kernel, inputs = self._placing.kernel, self._placing.inputs(self._encoder, self._columns, strays=strays)
        if self._device.is_cpu and blocks >= SLICE:
            launch(kernel, blocks, inputs, [], device=self._device, first=first, smallest=SLICE // 2)
            return
        command = self._recorded.get(strays)
        if command is None:
            command = self._recorded[strays] = Recorded(kernel, inputs, [], device=self._device)
        command(first, blocks)

    def _nowhere(self, start: int, stop: int) -> None:
        if start >= stop:
            return
        for name in ("out_x", "out_y"):
            if self._device.is_cpu:
                self._host[name][start:stop] = np.nan
            else:
                getattr(self._columns, name)[start:stop].fill_(float("nan"))

    def _vote(self, *, least: int) -> None:
        """What was not voted yet, if it is so many events: on CPUs by a thread beside, one for all, so that votes come
        one after the other."""
        if sum(stop - start for start, stop in self._placed) < least:
            return
        for start, stop in _joined(self._placed):
            span = start // self._block, (stop - start) // self._block
            if self._device.is_cpu:
                self._voting.append((start, stop, beside().submit(self._stretches, *span)))
            else:
                self._stretches(*span)
        self._placed.clear()

    def _wait_for_votes(self, start: int, stop: int) -> None:
        """Until a stretch of the buffers is free again."""
        while any(begin < stop and end > start for begin, end, _ in self._voting):
            self._voting.popleft()[2].result()

    def image(self) -> NDArray[np.float32]:
        self._vote(least=1)
        self._wait_for_votes(0, self._room)
        return self._votes.take()[0]


class PinnedPool:
    """Arrays to hand out that a GPU writes to at full speed; again when nobody holds them, for making one is slow."""

    def __init__(self, size: int) -> None:
        """``size`` of each."""
        self._size = size
        self._kept: dict[Any, list[Lent]] = {np.int64: [], np.float32: [], np.uint8: []}

    def fill(self) -> None:
        """Makes as many as there are batches under way, and as many with who took them: each takes a millisecond."""
        for dtype, each in ((np.int64, 1), (np.float32, 2), (np.uint8, 2)):
            held = [self(1, dtype) for _ in range(2 * each * ROUNDS)]
            assert held  # so that they are different ones

    def __call__(self, n: int, dtype: Any) -> Lent:
        """One of ``n`` values of any content."""
        kept = self._kept[dtype]
        for array, view in kept:
            if sys.getrefcount(view) <= unused():
                return array, view[:n]
        if len(kept) >= SPARE:
            view = np.empty(n, dtype)
            return wp.array(view, dtype=wp.dtype_from_numpy(dtype), device="cpu", copy=False), view
        array = wp.empty(self._size, dtype=wp.dtype_from_numpy(dtype), device="cpu", pinned=True)
        kept.append((array, array.numpy()))
        return array, kept[-1][1][:n]


@cache
def unused() -> int:
    """References to an array of such a list that nobody else holds, as Python counts them inside a loop over it."""
    for _, view in [(None, np.empty(1))]:
        count = sys.getrefcount(view)
    return count


def _joined(stretches: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Those that follow one another as one."""
    out: list[tuple[int, int]] = []
    for start, stop in stretches:
        if out and out[-1][1] == start:
            out[-1] = (out[-1][0], stop)
        else:
            out.append((start, stop))
    return out
