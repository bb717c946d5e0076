"""Writer of native HDF5 recordings: streams events in constant memory, and writes a whole file or none.

The format is described in ``docs/reference/recording-format.md``.
"""

from __future__ import annotations

import contextlib
import itertools
import os
from collections import deque
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.checks import check_coordinates, check_events
from amiwarp.events.encoder import Encoder
from amiwarp.events.events import Events
from amiwarp.events.recording import MetadataValue
from amiwarp.events.truth import EventTruth, WorldLabels
from amiwarp.io.atomic_output import NewFile
from amiwarp.io.chunk_file import ChunkFile, EncodedChunk, chunks_of
from amiwarp.io.chunks import CHUNK, Codec, encode_parts, in_order
from amiwarp.io.input_files import errors_name
from amiwarp.io.native_layout import (
    Columns,
    check_frame,
    check_lengths,
    describe_columns,
    make_dataset,
    ms_entries,
    write_header,
)
from amiwarp.io.output_formats import check_native
from amiwarp.io.record_appender import RecordAppender
from amiwarp.io.truth_writer import event_columns
from amiwarp.optics.camera import Camera
from amiwarp.validation import choice, guarded, shown

if TYPE_CHECKING:
    from amiwarp.optics.prism import NominalPrism

FlaggedEvents: TypeAlias = tuple[Events, NDArray[np.uint8], Mapping[str, Sequence[bytes]]]
"""Compensated events with flags of shape ``(n,)``: 1 if the event lies inside the image; and chunks of their columns
that are encoded already, by the name of the dataset."""


@guarded
class RecordingWriter(RecordAppender):
    """Writer that streams a recording into a native HDF5 file.

    Use it in a ``with`` block. The file appears under its name when the block ends without an exception. After an
    exception nothing remains.

    Parameters
    ----------
    path : str or path-like
        The file to write, which ends in ``.h5`` or ``.hdf5``.
    width, height : int
        Sensor size [px].
    camera : Camera, optional
        The camera, of the same size.
    prism : Prism or UnsizedPrism, optional
        The nominal prism.
    encoder : Encoder, optional
        The encoder. :meth:`set_encoder` can replace it later.
    truth_parameters : mapping of str to float, optional
        True parameters of a synthetic recording.
    truth_labels : WorldLabels, optional
        Names in the world of a synthetic recording.
    metadata : mapping, optional
        Other information: text, numbers and truth values by name.
    overwrite : bool, default False
        Whether an existing file may be replaced.
    codec : Codec or str, default "blosc"
        Compression. Programs without HDF5's Blosc filter read ``"gzip"``.

    Raises
    ------
    AmiwarpError
        If the path has another extension, cannot be written, is being read, or exists without ``overwrite``; or if
        events are unsorted or outside the frame.

    Examples
    --------
    >>> events = amiwarp.Events.from_arrays(x=[1, 2], y=[0, 0], t=[0, 10], p=[1, 0])
    >>> with amiwarp.RecordingWriter("short.h5", width=4, height=4) as writer:
    ...     writer.append(events)
    >>> len(amiwarp.open_recording("short.h5").events)
    2
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        width: int,
        height: int,
        camera: Camera | None = None,
        prism: NominalPrism | None = None,
        encoder: Encoder | None = None,
        truth_parameters: Mapping[str, float] | None = None,
        truth_labels: WorldLabels | None = None,
        metadata: Mapping[str, MetadataValue] | None = None,
        overwrite: bool = False,
        codec: Codec | str = Codec.BLOSC,
    ) -> None:
        self.path, self._overwrite = Path(path), overwrite
        check_native(self.path)
        self._codec = choice(Codec, codec, f"{self.path}: codec")
        check_frame(self.path, width, height, camera)
        self._size = (int(width), int(height))
        self._camera, self._prism, self._encoder = camera, prism, encoder
        self._truth_parameters, self._truth_labels = truth_parameters, truth_labels
        self._metadata = dict(metadata or {})
        self._file: Any = None
        self._datasets: dict[str, Any] = {}
        self._turns = itertools.count()
        self._new: NewFile | None = None
        self._pending: list[Columns] = []
        self._written = self._pending_count = 0
        self._columns: dict[str, np.dtype[Any]] | None = None
        self._t_offset = self._next_ms = self._ms_count = 0
        self._t_last: int | None = None
        self._ms: list[NDArray[np.int64]] = []

    def __len__(self) -> int:
        return self._written + self._pending_count

    def __enter__(self) -> RecordingWriter:
        self._new = NewFile(self.path, overwrite=self._overwrite)
        try:
            with errors_name(self.path, lambda: "making the file"):
                self._chunks = ChunkFile(self._new.part)
                self._file = self._chunks.hdf5
                self._open_records(self._file, self._size, self._codec)
                self._write_header()
        except BaseException:
            self._discard()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is not None or self._new is None:
            self._discard()
            return
        try:
            with errors_name(self.path, lambda: f"finishing after {len(self)} events"):
                self._finish()
                self._close()
                self._new.commit()
        except BaseException:
            self._discard()
            raise

    def append(
        self,
        events: Events,
        *,
        truth_points: ArrayLike | None = None,
        truth: EventTruth | None = None,
        inside: ArrayLike | None = None,
        extrapolated: ArrayLike | None = None,
    ) -> None:
        """Append events. All calls must give the same optional arrays.

        Parameters
        ----------
        events : Events
            The events, not earlier than those before.
        truth_points : array_like, optional
            Pixels of the scene points without the prism [px], shape (n, 2).
        truth : EventTruth, optional
            All ground truth of the events, the scene points included; then ``truth_points`` is not used.
        inside : array_like, optional
            For compensated events: whether each lies inside the image, shape (n,). Required if coordinates are NaN.
        extrapolated : array_like, optional
            For compensated events: whether the prism angle was extrapolated beyond the encoder's samples, shape (n,).

        Raises
        ------
        AmiwarpError
            If events are unsorted or outside the frame, or the arrays differ from those of the first call.
        """
        if self._file is None:
            raise AmiwarpError(f"{self.path}: append() was called outside the writer's 'with' block; call it inside")
        self._check(events, len(self), allow_nan=inside is not None, after_t=self._t_last)
        if not len(events):
            return
        with errors_name(self.path, lambda: f"after {len(self)} events"):
            known = truth or EventTruth(points=None if truth_points is None else np.asarray(truth_points, np.float32))
            columns = self._as_columns(events, known, {"inside": inside, "extrapolated": extrapolated})
            self._index(events.t, len(self))
            columns["events/t"] = events.t - self._t_offset
            self._pending.append(columns)
            self._pending_count += len(events)
            self._flush(whole=self._pending_count - self._pending_count % CHUNK)

    def fill(
        self,
        pieces: Iterable[Callable[[], FlaggedEvents]],
        *,
        count: int,
        t_first: int,
        done: Callable[[Events, NDArray[np.uint8]], None],
    ) -> None:
        """Write a whole recording of compensated events, with pieces computed and written in parallel on all cores.

        Parameters
        ----------
        pieces : iterable of callable
            Functions that return events, their ``inside`` flags, and encoded chunks of columns by name, in order.
            Threads call them. If the codec is Blosc, encoded chunks are stored unchanged; the rest is encoded. If times
            and polarities are both encoded, they are not checked, nor are positions whose flag is 1.
        count : int
            Number of events of each piece: a whole number of chunks. Only the last piece may be shorter.
        t_first : int
            Time of the first event [us].
        done : callable
            Called with each written piece, in order and in the calling thread.

        Raises
        ------
        AmiwarpError
            If other events were written before, or events are unsorted or outside the frame.
        """
        if self._file is None or len(self) or count % CHUNK:
            given = "fill() was called outside the writer's 'with' block, after append(), or for parts of chunks"
            raise AmiwarpError(f"{self.path}: {given}; call it inside the block, before other events")
        self._t_offset = t_first
        jobs = (partial(self._write_piece, piece, k * count, next(self._turns)) for k, piece in enumerate(pieces))
        with contextlib.closing(in_order(jobs)) as written:
            for events, inside in written:
                with errors_name(self.path, lambda: f"after {len(self)} events"):
                    if self._written % count:
                        raise AmiwarpError(f"a piece before the last ends within a chunk; give {count} events each")
                    self._written += len(events)
                done(events, inside)

    def _write_piece(
        self, piece: Callable[[], FlaggedEvents], start: int, turn: int
    ) -> tuple[Events, NDArray[np.uint8]]:
        """Compute, encode and write a piece whose first event is event ``start``. Runs in a thread."""
        with self._chunks.stopping():
            if not callable(piece):
                raise AmiwarpError(f"{self.path}: a piece is {shown(piece)}; expected a function")
            events, inside, known = piece()
            known = known if self._codec is Codec.BLOSC else {}
            with errors_name(self.path, lambda: f"after {start} events"):
                self._check_piece(events, inside, start, known)
                # only the size of an encoded column counts
                t = events.t if "events/t" in known else events.t - self._t_offset
                columns = {"events/x": events.x, "events/y": events.y, "events/t": t}
                columns |= {"events/p": events.p, "events/inside": inside}
                chunks: list[EncodedChunk] = []
                for name, column in columns.items():
                    stored: Sequence[Sequence[bytes]] = [(part,) for part in known.get(name, ())]
                    if len(stored) * CHUNK < len(column):
                        stored = encode_parts(column, self._codec)
                    chunks += chunks_of(name, start, column, stored)
                self._chunks.write(turn, chunks, self._dataset_of, lambda: self._follow(events, start))
        return events, inside

    def _check_piece(self, events: Events, inside: NDArray[np.uint8], start: int, known: Collection[str]) -> None:
        """Check a piece. The reader has checked encoded times and polarities. A position whose flag is 1 is finite."""
        outside = np.flatnonzero(inside == 0)
        if not {"events/t", "events/p"}.issubset(known):
            self._check(events, start, allow_nan=True)
        elif events.whole_pixels or np.isinf(events.x[outside]).any() or np.isinf(events.y[outside]).any():
            check_coordinates(events, *self._size, where=str(self.path), first_index=start, allow_nan=True)

    def _follow(self, events: Events, start: int) -> None:
        """Check that a piece is not earlier than the one before, and extend the index. Called in turn."""
        self._check(events[:1], start, allow_nan=True, after_t=self._t_last)
        self._index(events.t, start)

    def _check(self, events: Events, first_index: int, **how: Any) -> None:
        check_events(events, *self._size, where=str(self.path), first_index=first_index, **how)

    def set_encoder(self, encoder: Encoder) -> None:
        """Set or replace the encoder, which is written at the end.

        Parameters
        ----------
        encoder : Encoder
            The encoder.
        """
        self._encoder = encoder

    def _as_columns(self, events: Events, truth: EventTruth, flags: Mapping[str, ArrayLike | None]) -> Columns:
        columns: Columns = {"events/x": events.x, "events/y": events.y, "events/p": events.p}
        for name, flag in flags.items():
            if flag is not None:
                columns[f"events/{name}"] = np.asarray(flag).astype(np.uint8)
        columns |= event_columns(truth, len(events))
        check_lengths(columns, len(events))
        dtypes = {name: column.dtype for name, column in columns.items()}
        if self._columns is None:
            self._columns = dtypes
            self._t_offset = int(events.t[0])
        elif dtypes != self._columns:
            given = f"events come with {describe_columns(dtypes)}"
            raise AmiwarpError(f"{given}, those before with {describe_columns(self._columns)}; give the same arrays")
        return columns

    def _index(self, t: NDArray[np.int64], start: int) -> None:
        """Extend the index ms_to_idx by the events from event ``start`` on.

        Its entry m is the index of the first event at or after m milliseconds.
        """
        for entries in ms_entries(t, self._t_offset, self._next_ms, start):
            self._ms.append(entries)
            self._ms_count += entries.size
            self._next_ms += entries.size
            self._write_index(CHUNK)
        self._t_last = int(t[-1])

    def _write_index(self, least: int) -> None:
        if self._ms_count >= least:
            self._extend("ms_to_idx", np.concatenate(self._ms))
            self._ms, self._ms_count = [], 0

    def _flush(self, whole: int) -> None:
        """Write the first ``whole`` pending events. Each chunk is compressed once."""
        if not whole:
            return
        joined = {name: np.concatenate([part[name] for part in self._pending]) for name in self._pending[0]}
        jobs = (
            partial(self._write_chunk, name, self._written + at, column[at : min(at + CHUNK, whole)], next(self._turns))
            for name, column in joined.items()
            for at in range(0, whole, CHUNK)
        )
        with contextlib.closing(in_order(jobs)) as written:
            deque(written, maxlen=0)
        self._written += whole
        self._pending_count -= whole
        self._pending = [{name: column[whole:] for name, column in joined.items()}] if self._pending_count else []

    def _write_chunk(self, name: str, start: int, values: NDArray[Any], turn: int) -> None:
        """Encode and write the values of a chunk that begins at element ``start``. Runs in a thread."""
        with self._chunks.stopping():
            chunks = chunks_of(name, start, values, encode_parts(values, self._codec))
            self._chunks.write(turn, chunks, self._dataset_of)

    def _dataset_of(self, chunk: EncodedChunk) -> Any:
        return self._dataset(chunk.name, chunk.values.dtype, chunk.values.shape[1:])

    def _extend(self, name: str, values: NDArray[Any]) -> None:
        """Append values to a small dataset through HDF5."""
        dataset = self._dataset(name, values.dtype)
        start = dataset.shape[0]
        dataset.resize(start + values.size, axis=0)
        dataset[start:] = values

    def _dataset(self, name: str, dtype: np.dtype[Any], row: tuple[int, ...] = ()) -> Any:
        if name not in self._datasets:
            self._datasets[name] = make_dataset(self._file, name, dtype, row, codec=self._codec)
        return self._datasets[name]

    def _write_header(self) -> None:
        write_header(self._file, self._size, self._camera, self._prism, self._metadata)
        self._open_truth().write_header(self._truth_parameters, self._truth_labels)

    def _finish(self) -> None:
        self._flush(whole=self._pending_count)
        self._ms.append(np.array([len(self)], np.int64))
        self._write_index(0)
        for name, dtype in (("x", np.uint16), ("y", np.uint16), ("t", np.int64), ("p", np.uint8)):
            self._extend(f"events/{name}", np.zeros(0, (self._columns or {}).get(f"events/{name}", np.dtype(dtype))))
        self._file["t_offset"] = np.int64(self._t_offset)
        if self._encoder is not None:
            group = self._file.create_group("encoder")
            group.attrs["clock_offset_us"] = float(self._encoder.clock_offset_us)
            for name in ("t", "angle", "index_t"):
                values = getattr(self._encoder, name)
                if values is not None:
                    self._extend(f"encoder/{name}", values)

    def _close(self) -> None:
        if self._chunks is not None:
            self._chunks.close()

    def _discard(self) -> None:
        # The file is removed even if it cannot be closed.
        with contextlib.suppress(Exception):
            self._close()
        if self._new is not None:
            self._new.discard()
