"""Writer of the events of a native recording: their chunks, and the index of milliseconds."""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import (
    Callable,
    Collection,
    Generator,
    Iterable,
    Iterator,
    Mapping,
    Sequence,
)
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events import recording as checks
from amiwarp.events.recording import Events
from amiwarp.events.truth import EventTruth
from amiwarp.io.hdf5.chunk_file import ChunkFile, EncodedChunk
from amiwarp.io.hdf5.chunks import CHUNK, encode_parts
from amiwarp.io.inputs import errors_name
from amiwarp.io.native.layout import EVENTS, Columns
from amiwarp.io.native.ms_index import ms_entries
from amiwarp.io.native.records import Datasets
from amiwarp.io.native.written_columns import copied_into_chunk, event_columns
from amiwarp.io.output_formats import Codec
from amiwarp.tasks import Result, in_order
from amiwarp.validation import shown

FlaggedEvents: TypeAlias = tuple[Events, NDArray[np.uint8], Mapping[str, Sequence[bytes]]]
"""Compensated events with flags of shape ``(n,)``: 1 if the event lies inside the image; and chunks of their columns
that are encoded already, by the name of the dataset."""


class EventWriter:
    """Writer of events to an HDF5 file, which get there by :meth:`append`, or all by :meth:`fill`.

    Threads encode the chunks and write them. Full chunks are written at once; the events of the last one wait until it
    is full, or until :meth:`finish`.
    """

    def __init__(
        self,
        path: Path,
        size: tuple[int, int],
        chunks: ChunkFile,
        datasets: Datasets,
        codec: Codec,
    ) -> None:
        """Write to the file ``chunks``, which gets the name ``path``. ``size`` is the size of the sensor [px]."""
        self._path = path
        self._size = size
        self._chunks = chunks
        self._datasets = datasets
        self._codec = codec
        self.failed = False
        """Whether chunks could not be written, so that the file has a hole."""
        self._is_filling = False
        self._turns = itertools.count()
        """Turns in which the jobs get places in the file."""
        self._written = 0
        """Number of events in the file."""
        self._pending: Columns = {}
        """The last chunk, which is not full."""
        self._pending_count = 0
        self._dtypes: dict[str, np.dtype[Any]] = {}
        """Types of the columns of appended events, but for the times."""
        self._t_offset = 0
        self._t_last: int | None = None
        self._next_ms = 0
        """Next entry of the index of milliseconds."""
        self._ms: list[NDArray[np.int64]] = []
        """Entries of the index that are not written yet."""
        self._ms_count = 0

    def __len__(self) -> int:
        return self._written + self._pending_count

    def append(self, events: Events, truth: EventTruth, **flags: ArrayLike | None) -> None:
        """Append events with their ground truth and ``flags``, as :meth:`RecordingWriter.append`."""
        self.check_filled()
        self._check(
            events, len(self), allow_nan=flags.get("inside") is not None, after_t=self._t_last
        )
        if not len(events):
            return
        with errors_name(self._path, lambda: f"after {len(self)} events"):
            columns = event_columns(events, truth, **flags)
            dtypes = {name: column.dtype for name, column in columns.items()}
            if not len(self):
                self._dtypes = dtypes
                self._t_offset = int(events.t[0])
            elif dtypes != self._dtypes:
                given = _listed(dtypes)
                before = _listed(self._dtypes)
                raise AmiwarpError(
                    f"events come with {given}, those before with {before}; give the same arrays"
                )
            self._index(events.t, len(self))
            columns["events/t"] = events.t - self._t_offset
            self._store(columns, len(events))

    def fill(
        self, pieces: Iterable[Callable[[], FlaggedEvents]], count: int, t_first: int
    ) -> Generator[FlaggedEvents, None, None]:
        """Write a whole recording of pieces of ``count`` events, and yield them, as :meth:`RecordingWriter.fill`."""
        if len(self) or count < 1 or count % CHUNK:
            given = f"fill() was called after {len(self)} events, for pieces of {count}"
            raise AmiwarpError(
                f"{self._path}: {given}; call it before append(), for a multiple of {CHUNK}"
            )
        self._t_offset = t_first
        self._is_filling = True
        jobs = (
            partial(self._write_piece, piece, index * count, next(self._turns))
            for index, piece in enumerate(pieces)
        )
        return self._written_pieces(jobs, count)

    def _written_pieces(
        self, jobs: Iterable[Callable[[], FlaggedEvents]], count: int
    ) -> Generator[FlaggedEvents, None, None]:
        """Run the jobs of :meth:`fill`, and yield the pieces of ``count`` events that were written."""
        with self._results(jobs) as written:
            for index, piece in enumerate(written):
                events, _, _ = piece
                with errors_name(self._path, lambda: f"after {len(self)} events"):
                    # The piece was written where it begins if all before have their number of events.
                    if self._written != index * count:
                        raise AmiwarpError(
                            f"a piece before the last ends within a chunk or is empty; give {count} events each"
                        )
                    self._written += len(events)
                yield piece
        self._is_filling = False

    def check_filled(self) -> None:
        """Raise :class:`AmiwarpError` if :meth:`fill` was begun and has not yielded all pieces."""
        if self._is_filling:
            raise AmiwarpError(
                f"{self._path}: not all pieces of fill() were written; take all that it yields first"
            )

    def finish(self) -> None:
        """Write the events that wait, the rest of the index, and what a recording without events must have, too."""
        self.check_filled()
        if self._pending_count:
            count = self._pending_count
            self._write([{name: column[:count] for name, column in self._pending.items()}])
            self._pending_count = 0

        # The index ends with the number of events.
        self._ms.append(np.array([len(self)], np.int64))
        self._write_index(0)

        # Datasets of a recording without events are missing until here.
        for name, default in EVENTS.items():
            dtype = self._dtypes.get(f"events/{name}", np.dtype(default))
            self._datasets.extend(f"events/{name}", np.zeros(0, dtype))
        self._chunks.hdf5["t_offset"] = np.int64(self._t_offset)

    def _write_piece(
        self, piece: Callable[[], FlaggedEvents], start: int, turn: int
    ) -> FlaggedEvents:
        """Compute, encode and write a piece whose first event is event ``start``. Runs in a thread."""
        with self._chunks.stopping(turn):
            if not callable(piece):
                raise AmiwarpError(f"{self._path}: a piece is {shown(piece)}; expected a function")
            events, inside, encoded = piece()
            if self._codec is not Codec.BLOSC:
                encoded = {}
            with errors_name(self._path, lambda: f"after {start} events"):
                self._check_piece(events, inside, start, encoded)
                columns = {
                    "events/x": events.x,
                    "events/y": events.y,
                    # If the times are encoded, only the number of these values counts.
                    "events/t": events.t if "events/t" in encoded else events.t - self._t_offset,
                    "events/p": events.p,
                    "events/inside": inside,
                }
                chunks: list[EncodedChunk] = []
                for name, column in columns.items():
                    stored: Sequence[Sequence[bytes]] = [(part,) for part in encoded.get(name, ())]
                    if len(stored) * CHUNK < len(column):
                        stored = encode_parts(column, self._codec)
                    chunks += EncodedChunk.of(name, start, column, stored)
                self._chunks.write(
                    turn, chunks, self._dataset_of, lambda: self._follow(events, start)
                )
        return events, inside, encoded

    def _check_piece(
        self, events: Events, inside: NDArray[np.uint8], start: int, encoded: Collection[str]
    ) -> None:
        """Check a piece, but not what is known to be good: encoded times and polarities, which the reader has checked.

        With these, positions whose flag is 1 are finite.
        """
        if not {"events/t", "events/p"}.issubset(encoded):
            self._check(events, start, allow_nan=True)
            return
        outside = np.flatnonzero(inside == 0)
        if (
            events.whole_pixels
            or np.isinf(events.x[outside]).any()
            or np.isinf(events.y[outside]).any()
        ):
            checks.check_coordinates(
                events, *self._size, where=str(self._path), first_index=start, allow_nan=True
            )

    def _follow(self, events: Events, start: int) -> None:
        """Check that a piece is not earlier than the one before, and extend the index. Called in turn."""
        if not len(events):
            return
        self._check(events[:1], start, allow_nan=True, after_t=self._t_last)
        self._index(events.t, start)

    def _check(
        self, events: Events, first_index: int, *, allow_nan: bool, after_t: int | None = None
    ) -> None:
        """Check events of which the first is event ``first_index``, as :func:`check_events`."""
        checks.check_events(
            events,
            *self._size,
            where=str(self._path),
            first_index=first_index,
            allow_nan=allow_nan,
            after_t=after_t,
        )

    def _index(self, t: NDArray[np.int64], start: int) -> None:
        """Extend the index ms_to_idx by the times [us] of the events from event ``start`` on.

        Its entry m is the index of the first event at or after m milliseconds.
        """
        for entries in ms_entries(t, self._t_offset, self._next_ms, start):
            self._ms.append(entries)
            self._ms_count += entries.size
            self._next_ms += entries.size
            self._write_index(CHUNK)
        self._t_last = int(t[-1])

    def _write_index(self, least: int) -> None:
        """Write the waiting entries of the index if they are ``least`` or more."""
        if self._ms_count >= least:
            self._datasets.extend("ms_to_idx", np.concatenate(self._ms))
            self._ms = []
            self._ms_count = 0

    def _store(self, columns: Columns, count: int) -> None:
        """Write the chunks that are full with ``count`` new events, and keep the other events."""
        full: list[Columns] = []
        start = 0
        while start < count:
            stop = min(start + CHUNK - self._pending_count, count)
            chunk = {name: column[start:stop] for name, column in columns.items()}
            # A whole chunk of new events is written without a copy.
            if stop - start < CHUNK:
                self._pending = copied_into_chunk(self._pending, self._pending_count, chunk)
                chunk = self._pending
            self._pending_count = (self._pending_count + stop - start) % CHUNK
            if self._pending_count == 0:
                full.append(chunk)
            start = stop
        if full:
            self._write(full)

    def _write(self, chunks: Sequence[Columns]) -> None:
        """Write chunks of events, of which only the last of a recording is not full. Each is compressed once."""
        starts = range(self._written, self._written + len(chunks) * CHUNK, CHUNK)
        jobs = (
            partial(self._write_chunk, name, start, chunk[name], next(self._turns))
            for name in chunks[0]
            for start, chunk in zip(starts, chunks, strict=True)
        )
        with self._results(jobs) as written:
            for _ in written:
                pass
        self._written += sum(len(chunk["events/t"]) for chunk in chunks)

    def _write_chunk(self, name: str, start: int, values: NDArray[Any], turn: int) -> None:
        """Encode and write the values of a chunk that begins at element ``start``. Runs in a thread."""
        with self._chunks.stopping(turn):
            parts = encode_parts(values, self._codec)
            chunks = EncodedChunk.of(name, start, values, parts)
            self._chunks.write(turn, chunks, self._dataset_of)

    def _dataset_of(self, chunk: EncodedChunk) -> Any:
        return self._datasets.make(chunk.name, chunk.values.dtype, chunk.values.shape[1:])

    @contextlib.contextmanager
    def _results(self, jobs: Iterable[Callable[[], Result]]) -> Iterator[Iterator[Result]]:
        """Run jobs that write chunks, and give their results in order. After an error the writer cannot go on."""
        try:
            with contextlib.closing(in_order(jobs)) as results:
                yield results
        except BaseException:
            self.failed = True
            raise


def _listed(dtypes: Mapping[str, np.dtype[Any]]) -> str:
    return ", ".join(f"{name} {dtype}" for name, dtype in dtypes.items())
