"""Compensation of streams: packets of events and encoder samples in, compensated events and a running image out."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from amiwarp.errors import AmiwarpError
from amiwarp.events import Events
from amiwarp.iwe import CanvasShape, Votes

if TYPE_CHECKING:
    from concurrent.futures import Future

    from numpy.typing import NDArray

    from amiwarp.encoder import Encoder, EncoderStream
    from amiwarp.optics import Model

OUTSIDE, EXTRAPOLATED, NO_ANGLE = 1, 2, 4
"""Flags of an event: its place lies outside the image; no encoder sample came in time, so its angle goes on at constant
speed; there is no angle at all, and so no place (NaN)."""
AHEAD_US = 100_000
"""Of encoder samples that are put on the device at once, where there are so many [us]."""
ROUNDS = 4
"""Batches that the buffers hold: those before may still be voted."""
VOTED = 1 << 15
"""Events that are voted into the image at a time."""
SLICE = 4096
"""Blocks that are worth more threads than one."""
PIECE = 1 << 16
"""Events that a thread copies: of more, several threads do."""


@dataclass(frozen=True, slots=True, eq=False)
class Compensated:
    """Events as they come out: a packet, or several that were ready together."""

    events: Events
    """Places without the prism, float32 [px], NaN where there is none; times and polarities as they were put."""
    flags: NDArray[np.uint8]
    """Shape ``(n,)``: sum of :data:`OUTSIDE`, :data:`EXTRAPOLATED`, :data:`NO_ANGLE`."""
    put_us: int = 0
    """When the first of them was put, by the caller's clock [us]."""


class Compensator:
    """Compensates a stream: put packets and encoder samples as they come, take what is ready.

    A packet waits until the encoder covers it, at most ``wait_us`` by the caller's clock, or ``start_us`` while the
    encoder has given no two samples yet; past that, or while more than ``most_waiting`` events wait, its angles are
    guessed and marked. Everything comes out once, in the order it was put. ``encoder``: the caller appends its samples.

    Buffers are allocated once, for ``batch`` events: what is ready is worked through so many at a time. For one thread.
    """

    def __init__(
        self,
        model: Model,
        encoder: EncoderStream,
        *,
        wait_us: int = 10_000,
        start_us: int = 5_000_000,
        most_waiting: int = 1 << 24,
        batch: int | None = None,
        device: Any = "cpu",
    ) -> None:
        import warp as wp

        self.encoder = encoder
        self.wait_us, self.start_us, self.most_waiting = wait_us, start_us, most_waiting
        self._device = wp.get_device(device)
        self.batch = batch or (1 << 16 if self._device.is_cpu else 1 << 20)
        self._work = _Work(model, self.batch, self._device)
        self._queue: deque[tuple[Events, int]] = deque()
        self.waiting = 0
        """Events put and not taken yet."""
        self._t_last = -(2**62)
        self._covered: tuple[int, int] | None = None

    def put(self, events: Events, now_us: int) -> None:
        """A packet that came at ``now_us``: uint16 pixels, sorted, not before the last one; kept, not copied.

        Raises :class:`AmiwarpError` for other pixels or a packet that begins before the last; nothing was put then.
        """
        if events.x.dtype != np.uint16:
            raise AmiwarpError(
                f"event coordinates are {events.x.dtype}, already compensated; give events from a sensor (uint16)"
            )
        if not len(events):
            return
        if events.t[0] < self._t_last:
            raise AmiwarpError(f"a packet from {events.t[0]} us comes after one to {self._t_last} us; sort it first")
        self._t_last = int(events.t[-1])
        self.waiting += len(events)
        for start in range(0, len(events), self.batch):
            self._queue.append((events[start : start + self.batch], now_us))

    def take(self, now_us: int) -> list[Compensated]:
        """What is ready at ``now_us``, in the order it was put, packets that are ready together joined to a batch.

        Raises :class:`AmiwarpError` for a packet that is not sorted; what was ready with it is lost.
        """
        out: list[Compensated] = []
        begun: _Begun | None = None
        while packets := self._ready(now_us):  # a GPU works on one batch while the next is put together
            following = self._begin(packets)
            if begun is not None:
                out.append(self._end(begun))
            begun = following
        return out if begun is None else [*out, self._end(begun)]

    def flush(self) -> list[Compensated]:
        """All that still waits, its angles guessed where they must be: at the end of a stream."""
        return self.take(2**62)

    def image(self) -> NDArray[np.float32]:
        """Image of the events taken since the last call, shape (height, width)."""
        return self._work.image()

    def _ready(self, now_us: int) -> list[tuple[Events, int]]:
        packets: list[tuple[Events, int]] = []
        count, last = 0, self.encoder.last
        patience = self.start_us if last is None else self.wait_us
        while self._queue:
            events, put_us = self._queue[0]
            covered = last is not None and events.t[-1] <= last
            overdue = now_us - put_us >= patience or self.waiting > self.most_waiting
            if count + len(events) > self.batch or not (covered or overdue):
                break
            packets.append(self._queue.popleft())
            count += len(events)
            self.waiting -= len(events)
        return packets

    def _begin(self, packets: list[tuple[Events, int]]) -> _Begun:
        parts = [events for events, _ in packets]
        n, first, last = sum(map(len, parts)), int(parts[0].t[0]), int(parts[-1].t[-1])
        begins, ends = self.encoder.first, self.encoder.last
        if begins is None or ends is None:
            unknown = n
        else:
            unknown = 0 if first >= begins else sum(int(np.searchsorted(part.t, begins)) for part in parts)
        if unknown < n:
            self._cover(max(first, begins or first), last, ends or last)
        return self._work.begin(parts, n, unknown, packets[0][1])

    def _end(self, begun: _Begun) -> Compensated:
        x, y, flags = self._work.end(begun)
        if not self.encoder.knows(int(begun.t[0]), int(begun.t[-1])):
            flags[self.encoder.guessed(begun.t)] |= EXTRAPOLATED
        flags[: begun.unknown] = OUTSIDE | NO_ANGLE
        return Compensated(Events(x, y, begun.t, begun.p), flags, begun.put_us)

    def _cover(self, first: int, last: int, ends: int) -> None:
        """Puts the encoder over a span of event times [us] on the device, where it is not there yet."""
        if self._covered is None or first < self._covered[0] or last > self._covered[1]:
            until = max(last, min(ends, last + AHEAD_US))
            self._work.set_encoder(self.encoder.over(first, until), first, until)
            # what was guessed for the end of it may be known the next time
            self._covered = (first, until) if until <= ends else None


@dataclass(frozen=True, slots=True, eq=False)
class _Begun:
    """A batch that a device works on: from ``at`` to ``end`` of the buffers."""

    at: int
    end: int
    t: NDArray[np.int64]
    p: NDArray[np.uint8]
    unknown: int
    """Events at its beginning that have no angle."""
    put_us: int
    done: Any
    """A ``wp.Event`` on CUDA."""


class _Work:
    """The buffers of a compensator, and what is done with them."""

    def __init__(self, model: Model, batch: int, device: Any) -> None:
        import warp as wp

        from amiwarp.kernels import compensate as kernels
        from amiwarp.kernels.structs import azimuths, camera_params, pinhole_params

        self._device, self._at, self._voted = device, 0, 0
        self._voting: deque[tuple[int, int, Future[None]]] = deque()
        self._kernel = kernels.compensate_blocks if device.is_cpu else kernels.compensate_events
        self._kernel.module.load(device, **({"block_dim": 1} if device.is_cpu else {}))
        self._block = int(kernels.BLOCK) if device.is_cpu else 1
        self._room = ROUNDS * -(-batch // self._block) * self._block
        self._size = model.camera.width, model.camera.height
        self._camera = camera_params(model.camera, str(device))
        self._pinhole = pinhole_params(model.camera) or self._camera
        self._inputs = [model.params(str(device)), None, wp.vec2(*self._size), None, azimuths(str(device)), None]
        dtypes = {"x": wp.uint16, "y": wp.uint16, "t": wp.int64, "out_x": float, "out_y": float, "inside": wp.uint8}
        columns = kernels.Columns()
        for name, dtype in dtypes.items():
            setattr(columns, name, wp.zeros(self._room, dtype=dtype, device=device))
        self._inputs[-1] = self._columns = columns
        self._ours = columns if device.is_cpu else kernels.Columns()
        if not device.is_cpu:
            for name, dtype in dtypes.items():
                setattr(self._ours, name, wp.zeros(self._room, dtype=dtype, device="cpu", pinned=True))
        self._host = {name: getattr(self._ours, name).numpy() for name in dtypes}
        self._layer = wp.zeros(self._room, dtype=wp.uint8, device=device)
        self._recorded: dict[int, Any] = {}
        self._votes = Votes(CanvasShape(*self._size), device)

    def set_encoder(self, encoder: Encoder, first: int, last: int) -> None:
        """Puts its pieces over a span of event times [us] into one bucket, where a search finds them: they are few."""
        import warp as wp

        from amiwarp.kernels.encoder import EncoderParams
        from amiwarp.kernels.structs import encoder_pieces

        origin, *pieces = encoder_pieces(encoder, first, last)
        n, p = len(pieces[0]), self._inputs[3]
        if p is None or n > len(p.start):
            p = self._inputs[3] = EncoderParams()
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
            command.set_param_at_index(3, p)

    def begin(self, parts: list[Events], n: int, unknown: int, put_us: int) -> _Begun:
        """Sends a batch on its way; the first ``unknown`` get no place."""
        import warp as wp

        padded = -(-n // self._block) * self._block
        if self._at + padded > self._room:
            self._vote()
            self._at = self._voted = 0
        at, end, host = self._at, self._at + n, self._host
        self._at += padded
        self._wait_for_votes(at, self._at)
        t, p = self._gather(parts, n, at)
        if unknown < n:
            host["t"][end : self._at] = host["t"][end - 1]
            self._launch(at // self._block, padded // self._block, self._camera_of(at, end))
        self._nowhere(at, at + unknown)
        self._nowhere(end, self._at)
        done = None
        if self._device.is_cuda:
            self._copy(self._ours, self._columns, ("out_x", "out_y", "inside"), at, end)
            done = wp.record_event(wp.Event(self._device))
        if self._at - self._voted >= VOTED:
            self._vote()
        return _Begun(at, end, t, p, unknown, put_us, done)

    def end(self, begun: _Begun) -> list[NDArray[Any]]:
        """Places x, y [px] and flags, outside the image or not."""
        import warp as wp

        if begun.done is not None:
            wp.synchronize_event(begun.done)
        n = begun.end - begun.at
        out = [np.empty(n, dtype) for dtype in (np.float32, np.float32, np.uint8)]

        def copy(span: tuple[int, int]) -> None:
            here, there = slice(*span), slice(begun.at + span[0], begun.at + span[1])
            out[0][here], out[1][here] = self._host["out_x"][there], self._host["out_y"][there]
            np.bitwise_xor(self._host["inside"][there], np.uint8(1), out=out[2][here])

        _each(copy, [(k, min(k + PIECE, n)) for k in range(0, n, PIECE)])
        return out

    def _gather(self, parts: list[Events], n: int, at: int) -> tuple[NDArray[np.int64], NDArray[np.uint8]]:
        """Puts the parts together on the device; times and polarities of the whole. Raises where they are unsorted."""
        host, several = self._host, len(parts) > 1
        t, p = (np.empty(n, np.int64), np.empty(n, np.uint8)) if several else (parts[0].t, parts[0].p)

        def copy(group: tuple[int, list[Events]]) -> bool:
            first, some = group
            here = slice(first, first + sum(map(len, some)))
            there = slice(at + here.start, at + here.stop)
            times = host["t"][there]
            if len(some) == 1:
                host["x"][there], host["y"][there], times[:] = some[0].x, some[0].y, some[0].t
            else:
                for name in ("x", "y", "t"):
                    np.concatenate([getattr(part, name) for part in some], out=host[name][there])
            if several:
                t[here] = times
                np.concatenate([part.p for part in some], out=p[here])
            return bool((times[1:] < times[:-1]).any())

        if any(_each(copy, _groups(parts) if n > PIECE else [(0, parts)])):
            raise AmiwarpError(f"events of {parts[0].t[0]} to {parts[-1].t[-1]} us are not sorted; sort each packet")
        if self._device.is_cuda:
            self._copy(self._columns, self._ours, ("t", "x", "y"), at, at + n)
        return t, p

    def _copy(self, to: Any, source: Any, names: tuple[str, ...], at: int, end: int) -> None:
        import warp as wp

        for name in names:
            columns = getattr(to, name), getattr(source, name)
            wp.copy(*columns, dest_offset=at, src_offset=at, count=end - at)

    def _camera_of(self, at: int, end: int) -> Any:
        """The quick way of placing takes an event's pixel from the image's tables without a look: not for strays."""
        width, height = self._size
        inside = self._host["x"][at:end].max() < width and self._host["y"][at:end].max() < height
        return self._pinhole if inside else self._camera

    def _launch(self, first: int, blocks: int, camera: Any) -> None:
        import warp as wp

        from amiwarp.kernels.launch import launch

        inputs = [*self._inputs[:1], camera, *self._inputs[2:]]
        if self._device.is_cpu and blocks >= SLICE:
            launch(self._kernel, blocks, inputs, [], device=self._device, first=first, smallest=SLICE // 2)
            return
        command = self._recorded.get(id(camera))
        if command is None:
            # to launch again what was recorded takes a fraction of the time
            command = wp.launch(self._kernel, 1, [*inputs, 0], device=self._device, record_cmd=True)
            self._recorded[id(camera)] = command
        command.set_dim(blocks)
        command.set_param_at_index(len(inputs), first)
        command.launch()

    def _nowhere(self, start: int, stop: int) -> None:
        if start >= stop:
            return
        for name in ("out_x", "out_y"):
            if self._device.is_cpu:
                self._host[name][start:stop] = np.nan
            else:
                getattr(self._columns, name)[start:stop].fill_(float("nan"))

    def _vote(self) -> None:
        """What was not voted yet: on CPUs by a thread beside, one for all, so that votes come one after the other."""
        from amiwarp.kernels.launch import beside

        start, stop = self._voted, self._at
        if start == stop:
            return
        columns = [column[start:stop] for column in (self._columns.out_x, self._columns.out_y, self._layer)]
        if self._device.is_cpu:
            self._voting.append((start, stop, beside().submit(self._votes.add_points, *columns)))
        else:
            self._votes.add_points(*columns)
        self._voted = stop

    def _wait_for_votes(self, start: int, stop: int) -> None:
        """Until a stretch of the buffers is free again."""
        while any(begin < stop and end > start for begin, end, _ in self._voting):
            self._voting.popleft()[2].result()

    def image(self) -> NDArray[np.float32]:
        self._vote()
        self._wait_for_votes(0, self._room)
        return self._votes.take()[0]


def _groups(parts: list[Events]) -> list[tuple[int, list[Events]]]:
    """The parts in groups of about :data:`PIECE` events, each with the place of its first."""
    groups: list[tuple[int, list[Events]]] = []
    count = held = 0
    for part in parts:
        for start in range(0, len(part), PIECE):
            piece = part if len(part) <= PIECE else part[start : start + PIECE]
            if not groups or held + len(piece) > PIECE:
                groups.append((count, []))
                held = 0
            groups[-1][1].append(piece)
            held, count = held + len(piece), count + len(piece)
    return groups


def _each(job: Callable[[Any], Any], given: list[Any]) -> list[Any]:
    """The job for each, by several threads where there are several."""
    from amiwarp.kernels.launch import pool

    return list(pool().map(job, given)) if len(given) > 1 else [job(each) for each in given]
