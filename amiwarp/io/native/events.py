"""Events of native recordings and of files of DSEC and M3ED, whose layouts are alike."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events import recording as checks
from amiwarp.events.recording import DEFAULT_BLOCK, Events, EventSource, regroup
from amiwarp.io.assumptions import smallest_sensor
from amiwarp.io.hdf5.chunks import CHUNK
from amiwarp.io.hdf5.file import Hdf5File
from amiwarp.io.inputs import errors_name, register_reader
from amiwarp.io.native.attributes import attribute
from amiwarp.io.native.layout import EVENTS, FLAGS, FORMAT
from amiwarp.io.native.stored import dataset_of
from amiwarp.io.opening import given_size, head_limit
from amiwarp.optics.camera import LARGEST_SIZE, check_size
from amiwarp.schema.calls import guarded
from amiwarp.tasks import in_order
from amiwarp.validation import check_slice, rounded_times

DSEC_SIZE = (640, 480)
"""Size of DSEC's sensors [px], which its files do not store."""


@guarded
class NativeEvents(EventSource):
    """Events of an HDF5 recording, read on demand. Raises :class:`AmiwarpError` for a damaged file."""

    def __init__(self, path: Path, file: Hdf5File) -> None:
        """Open the events of a file. If the file is unfinished, these are the events that are complete now."""
        self.path = path
        self._file = file
        self._columns = {name: dataset_of(file, f"events/{name}") for name in ("t", "p", "x", "y")}
        for name in FLAGS:
            flags = file.columns.get(f"events/{name}")
            if flags is not None:
                self._columns[name] = flags
        lengths = {name: len(column) for name, column in self._columns.items()}
        are_alike = len(set(lengths.values())) == 1
        if not are_alike and not file.unfinished:
            raise AmiwarpError(
                f"{path}: datasets of events differ in length: {lengths}; the file is damaged",
                ErrorCode.FILE_DAMAGED,
            )
        self._count = min(lengths.values())
        offset = file.columns.get("t_offset")
        self._offset = 0 if offset is None else rounded_times(offset.read(0, 1)).item()
        # The index of an unfinished file may be incomplete. Bisection is used instead.
        self._ms_to_idx = None if file.unfinished else file.columns.get("ms_to_idx")
        stored = given_size() or self._stored_size()
        self.size_is_stored = stored is not None
        """Whether the file or the user states the sensor size."""
        self.size_is_known = self.size_is_stored
        """Whether the size is neither taken from the events, nor was in the file that the recording was made from."""
        self._size = stored or self._smallest_size()
        self._ends: list[int] = []
        """Times of the first and the last event [us]; empty without events."""
        if self._count:
            self._ends = [int(self.slice(index, index + 1).t[0]) for index in (0, self._count - 1)]
        register_reader(self, self.path)

    def _stored_size(self) -> tuple[int, int] | None:
        """Return the stored sensor size [px], or None."""
        attributes = self._file.attributes.get("/", {})
        if "width" not in attributes or "height" not in attributes:
            return None
        width: int = attribute(attributes, f"{self.path}: /", "width", int)
        height: int = attribute(attributes, f"{self.path}: /", "height", int)
        check_size(width, height, self.path)
        return width, height

    def _smallest_size(self) -> tuple[int, int]:
        """Return the smallest known sensor size that holds all events, but at least the size of DSEC's sensors [px]."""
        largest = {"x": 0, "y": 0}
        examined = min(self._count, head_limit() or self._count)
        for start in range(0, examined, DEFAULT_BLOCK):
            stop = min(start + DEFAULT_BLOCK, self._count)
            for name in largest:
                values = self._columns[name].read(start, stop)
                # Compensated events may lie far outside, or have no coordinates.
                if values.dtype.kind == "f":
                    is_possible = (values >= 0) & (values < LARGEST_SIZE)
                    values = np.rint(values[is_possible])
                largest[name] = max(largest[name], int(values.max(initial=0)))
        width, height = smallest_sensor(largest["x"], largest["y"])
        least_width, least_height = DSEC_SIZE
        return max(width, least_width), max(height, least_height)

    def __len__(self) -> int:
        return self._count

    @property
    def t_first(self) -> int:
        """Time of the first event [us]."""
        return self._end(0)

    @property
    def t_last(self) -> int:
        """Time of the last event [us]."""
        return self._end(-1)

    def _end(self, which: int) -> int:
        """Return the time of the first (0) or the last event (-1) [us]."""
        if not self._ends:
            raise AmiwarpError(
                f"{self.path}: holds no events, so it has no first or last time",
                ErrorCode.CONTENT_MISSING,
            )
        return self._ends[which]

    @property
    def size(self) -> tuple[int, int]:
        """Sensor size (width, height) [px]."""
        return self._size

    def slice(self, start: int, stop: int) -> Events:
        """Return the events with ``start <= index < stop``, and check them. Threads may call it in parallel."""
        check_slice(start, stop)
        stop = min(max(stop, start), self._count)
        with errors_name(self.path, lambda: f"events {start} .. {stop}"):
            x, y, p = (self._columns[name].read(start, stop) for name in ("x", "y", "p"))
            t = self._columns["t"].read(start, stop)
            # check_events finds times beyond the limit among sorted int64, also if adding the offset overflows.
            if t.dtype != np.int64:
                t = rounded_times(t)
            events = Events(
                checks.as_coordinate("x", x),
                checks.as_coordinate("y", y),
                self._since_zero(t),
                checks.as_polarity(p),
            )
            checks.check_events(
                events,
                *self._size,
                where=str(self.path),
                first_index=start,
                allow_nan="inside" in self._columns,
            )
        return events

    def inside(self, start: int, stop: int) -> NDArray[np.bool_] | None:
        """Return whether each compensated event lies inside the image, shape ``(n,)``; None if this is not stored."""
        return self._flags("inside", start, stop)

    def extrapolated(self, start: int, stop: int) -> NDArray[np.bool_] | None:
        """Return whether each event's angle was extrapolated, shape ``(n,)``; None if the file does not store it."""
        return self._flags("extrapolated", start, stop)

    def _flags(self, name: str, start: int, stop: int) -> NDArray[np.bool_] | None:
        """Return a flag of some events; None if it is not stored."""
        if name not in self._columns:
            return None
        with errors_name(self.path, lambda: f"events/{name} {start} .. {stop}"):
            first = max(start, 0)
            last = min(max(stop, 0), self._count)
            flags = self._columns[name].read(first, last)
            return np.asarray(flags, np.bool_)

    def find(self, t: int) -> int:
        """Return the index of the first event at or after ``t`` [us], found with the file's millisecond index."""
        if not self._count or t <= self.t_first:
            return 0
        if t > self.t_last:
            return self._count
        low, high = self._bracket(t)
        index = low + int(np.searchsorted(self._times(low, high), t))
        if 0 < index < self._count:
            t_before, t_at = self._times(index - 1, index + 1)
            if t_before < t <= t_at:
                return index
        raise AmiwarpError(
            f"{self.path}: events/t is not sorted near {t} us, or ms_to_idx disagrees with it; the file is damaged",
            ErrorCode.FILE_DAMAGED,
        )

    def between(self, t_start: int, t_end: int) -> Events:
        """Return the events with ``t_start <= t < t_end`` [us], found with the file's millisecond index."""
        checks.check_window(t_start, t_end)
        with errors_name(self.path, lambda: f"events between {t_start} and {t_end} us"):
            start = self.find(t_start)
            stop = self.find(t_end)
            return self.slice(start, stop)

    def blocks(
        self,
        *,
        count: int | None = None,
        duration_us: int | None = None,
    ) -> Iterator[Events]:
        """Return all events in blocks, as :meth:`amiwarp.EventSource.blocks`."""
        return regroup(self._pieces_in_order(), count=count, duration_us=duration_us)

    def pieces(self, count: int) -> Iterator[Callable[[], Events]]:
        """Yield functions that read ``count`` events each, in any thread. Whole chunks are read fastest."""
        for start in range(0, self._count, count):
            yield partial(self.slice, start, start + count)

    def encoded_times_and_polarities(self, start: int, stop: int) -> dict[str, list[bytes]]:
        """Return the stored chunks of times and polarities with ``start <= index < stop``, by name of the dataset.

        A recording of the same events from the first one on holds the same chunks. ``start`` begins a chunk. Empty for
        files of other formats, unfinished files, and times that do not start at the first event.
        """
        root = self._file.attributes.get("/", {})
        if root.get("format") != FORMAT or self._file.unfinished or self._offset != self.t_first:
            return {}
        chunks_by_name: dict[str, list[bytes]] = {}
        for name in ("t", "p"):
            column = self._columns[name]
            chunks = column.encoded(start, min(stop, self._count))
            if chunks is not None and column.dtype == EVENTS[name]:
                chunks_by_name[f"events/{name}"] = chunks
        return chunks_by_name

    def _pieces_in_order(self) -> Iterator[Events]:
        start = 0
        last: int | None = None
        with contextlib.closing(in_order(self.pieces(CHUNK))) as pieces:
            for piece in pieces:
                # The order within the piece is checked. Its first event is compared with the piece before.
                checks.check_events(
                    piece[:1],
                    *self._size,
                    where=str(self.path),
                    first_index=start,
                    allow_nan=True,
                    after_t=last,
                )
                start += len(piece)
                last = int(piece.t[-1])
                yield piece

    def _times(self, start: int, stop: int) -> NDArray[np.int64]:
        return self._since_zero(rounded_times(self._columns["t"].read(start, stop)))

    def _since_zero(self, t: NDArray[np.int64]) -> NDArray[np.int64]:
        """Add the file's offset to times, in the same array if it can be written."""
        if not self._offset:
            return t
        return np.add(t, self._offset, out=t if t.flags.writeable else None)

    def _bracket(self, t: int) -> tuple[int, int]:
        """Return a short range of event indices around time ``t`` [us], from the millisecond index or by bisection."""
        ms = (t - self._offset) // 1000
        if self._ms_to_idx is not None and 0 <= ms < len(self._ms_to_idx):
            # The last entry of the index has no next one.
            ends = self._ms_to_idx.read(ms, min(ms + 2, len(self._ms_to_idx))).tolist()
            low = ends[0]
            high = ends[1] if len(ends) > 1 else self._count
            return max(0, min(low, self._count)), max(0, min(high, self._count))
        low = 0
        high = self._count
        while high - low > 1024:
            middle = (low + high) // 2
            if int(self._times(middle, middle + 1)[0]) < t:
                low = middle
            else:
                high = middle
        return low, high
