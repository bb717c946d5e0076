"""Writer of native HDF5 recordings: streams events in constant memory, and writes a whole file or none.

The format is described in ``docs/reference/recording-format.md``.
"""

from __future__ import annotations

import contextlib
import io
import itertools
import os
import threading
from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.encoder import Encoder
from amiwarp.events.events import Events, check_coordinates, check_events, inside_image, regroup
from amiwarp.events.recording import MetadataValue
from amiwarp.events.sensors import ImuSamples, check_image
from amiwarp.events.truth import EventTruth, FrameTruth, Poses, WorldLabels
from amiwarp.io.atomic_output import NewFile, interrupts_later
from amiwarp.io.chunks import CHUNK, Codec, append_chunk, encode, encode_parts, in_order
from amiwarp.io.input_files import errors_name
from amiwarp.io.native_layout import (
    ROWS,
    Columns,
    RowWriter,
    check_frame,
    check_lengths,
    describe_columns,
    make_dataset,
    ms_entries,
    write_header,
)
from amiwarp.io.native_truth import TruthWriter, event_columns
from amiwarp.io.output_formats import Outline, check_native
from amiwarp.optics.camera import Camera
from amiwarp.validation import choice, guarded, shown

if TYPE_CHECKING:
    from amiwarp.events.recording import Recording, Truth
    from amiwarp.optics.prism import NominalPrism
    from amiwarp.progress import Progress


# Writer of the IMU samples and frames of a native recording.
#
# ``docs/reference/recording-format.md`` describes the format.


class SensorWriter(RowWriter):
    """Writer of IMU samples and frames into an open HDF5 file."""

    def append_imu(self, samples: ImuSamples) -> None:
        """Append samples, which must not be earlier than those before."""
        if len(samples):
            self._check_later("imu/t", int(samples.t[0]), equal=True)
        for name in ("t", "angular_velocity", "acceleration"):
            self._append(f"imu/{name}", getattr(samples, name), ROWS)

    def append_image(self, t_us: int, image: NDArray[Any]) -> None:
        """Append a frame, which must not be earlier than the frame before."""
        stored = self._datasets.get("frames/image")
        shape, dtype = (image.shape, image.dtype) if stored is None else (stored.shape[1:], stored.dtype)
        try:
            check_image(image, shape, dtype)
        except AmiwarpError as error:
            raise AmiwarpError(f"{self._path}: {error}") from error
        self._check_later("frames/t", t_us, equal=True)
        self._append("frames/t", np.array([t_us], np.int64), ROWS)
        self._append("frames/image", image[None], 1)


# Methods of the writer of native recordings that append anything other than events.


class RecordAppender:
    """Base of :class:`amiwarp.RecordingWriter`: appends ground truth, IMU samples and frames."""

    path: Path
    _chunks: Any = None
    _truth: TruthWriter | None = None
    _sensors: SensorWriter | None = None

    def append_frame(self, frame: FrameTruth) -> None:
        """Append the ground truth of an instant.

        Parameters
        ----------
        frame : FrameTruth
            Ground truth of all pixels, at a later time than the frame before.
        """
        with self._appending(lambda: f"truth of the instant {frame.t_us} us"):
            self._open_truth().append_frame(frame)

    def append_known(self, t_us: int, mask: NDArray[np.bool_]) -> None:
        """Append a mask of the pixels whose scene is known.

        Parameters
        ----------
        t_us : int
            Time from which the mask holds [us], later than that of the mask before.
        mask : numpy.ndarray
            Whether the scene at each pixel without the prism is known, shape ``(height, width)``.
        """
        with self._appending(lambda: f"mask at {t_us} us"):
            self._open_truth().append_known(t_us, mask)

    def append_poses(self, poses: Poses) -> None:
        """Append true poses of camera, bodies and joints.

        Parameters
        ----------
        poses : Poses
            Poses at later times than those before.
        """
        with self._appending(lambda: "true poses"):
            self._open_truth().append_poses(poses)

    def append_imu(self, samples: ImuSamples) -> None:
        """Append samples of an inertial measurement unit.

        Parameters
        ----------
        samples : ImuSamples
            Samples, not earlier than those before.
        """
        with self._appending(lambda: "IMU samples"):
            self._open_sensors().append_imu(samples)

    def append_image(self, t_us: int, image: NDArray[Any]) -> None:
        """Append a frame.

        Parameters
        ----------
        t_us : int
            Time of the frame [us], not earlier than that of the frame before.
        image : numpy.ndarray
            Grey levels, uint8 or uint16, shape ``(height, width)``, as those of the frames before.
        """
        with self._appending(lambda: f"frame at {t_us} us"):
            self._open_sensors().append_image(t_us, image)

    @contextlib.contextmanager
    def _appending(self, place: Callable[[], str]) -> Iterator[None]:
        """Name the file and the place in errors, and raise the error of a full disk."""
        with errors_name(self.path, place):
            yield
            if self._chunks is not None:
                self._chunks.check()

    def _open_records(self, file: Any, size: tuple[int, int], codec: Codec) -> None:
        """Set up the writers of an open file. ``size``: width and height of the sensor [px]."""
        self._truth = TruthWriter(file, self.path, size, codec)
        self._sensors = SensorWriter(file, self.path, codec)

    def _open_truth(self) -> TruthWriter:
        if self._truth is None:
            raise AmiwarpError(f"{self.path}: append outside the writer's with block; call it inside")
        return self._truth

    def _open_sensors(self) -> SensorWriter:
        if self._sensors is None:
            raise AmiwarpError(f"{self.path}: append outside the writer's with block; call it inside")
        return self._sensors


# New HDF5 file whose encoded chunks several threads write at the same time.
#
# HDF5 uses one thread at a time, and h5py holds Python's lock while HDF5 writes. Here HDF5 only finds the place of a
# chunk in the file; the thread that encoded the chunk writes it there.
#
# HDF5 crashes the process, at the latest when the process ends, if it cannot write a file that it closes. So HDF5 never
# learns of a full disk: :class:`ChunkFile` notes the error and raises it outside HDF5.


class EncodedChunk(NamedTuple):
    """Chunk of a column."""

    name: str
    """Name of the column."""
    start: int
    """Index of its first element."""
    values: NDArray[Any]
    """Its values."""
    parts: Sequence[bytes]
    """Its encoded bytes, in one or several parts."""


def chunks_of(name: str, start: int, column: NDArray[Any], parts: Iterable[Sequence[bytes]]) -> list[EncodedChunk]:
    """Return the chunks of a column whose first element is element ``start``, and whose encoded bytes are ``parts``."""
    return [
        EncodedChunk(name, start + k * CHUNK, column[k * CHUNK : (k + 1) * CHUNK], part) for k, part in enumerate(parts)
    ]


class ChunkFile:
    """HDF5 file that is being written. Threads write chunks of its datasets at places that they get in turn.

    Data that HDF5 could not write wait in memory. Call :meth:`check` regularly, so that they stay few.
    """

    def __init__(self, path: Path, libver: tuple[str, str] | None = ("v110", "v110")) -> None:
        """Create the file. ``libver`` are h5py's bounds of the format. Raises OSError if the file exists."""
        import h5py

        self._columns: dict[str, ChunkedColumn] = {}
        self._turns = threading.Condition()
        self._turn = 0
        self._stopped = False
        with contextlib.ExitStack() as undo:
            with interrupts_later():
                self.output = _Output(path)
                undo.callback(self.output.close)
                # From HDF5 1.10 on, the file's structure has checksums, so that damage is detected.
                self.hdf5 = h5py.File(self.output, "w", libver=libver)
                """The file as h5py gives it."""
                undo.callback(self.hdf5.close)
            undo.pop_all()

    @contextlib.contextmanager
    def turn(self, number: int) -> Iterator[None]:
        """Wait until all lower numbers, from 0 on, had their turn, and keep out other turns.

        Chunks get their places in turn, so the bytes of a file do not depend on the speed of the threads. Raises
        :class:`AmiwarpError` if another thread failed.
        """
        with self._turns:
            self._turns.wait_for(lambda: self._turn == number or self._stopped)
            if self._stopped:
                raise AmiwarpError("another thread could not write its part")
            yield
            self._turn += 1
            self._turns.notify_all()

    @contextlib.contextmanager
    def stopping(self) -> Iterator[None]:
        """If the work of a thread in the ``with`` block fails, end the waiting of the others."""
        try:
            yield
        except BaseException:
            with self._turns:
                self._stopped = True
                self._turns.notify_all()
            raise

    def write(
        self, turn: int, chunks: Sequence[EncodedChunk], dataset_of: Callable[[EncodedChunk], Any],
        before: Callable[[], None] = lambda: None,
    ) -> None:  # fmt: skip
        """Write encoded chunks at places that they get in turn.

        ``dataset_of`` makes the dataset of a column's first chunk. ``before`` is called first in turn.
        """
        rows = {chunk.name: chunk.start + len(chunk.values) for chunk in chunks}
        placed = []
        with self.turn(turn):
            before()
            for chunk in chunks:
                if chunk.name not in self._columns:
                    self._columns[chunk.name] = ChunkedColumn(self, dataset_of(chunk))
                column = self._columns[chunk.name]
                placed.append((column.place(chunk.start, chunk.parts, rows[chunk.name]), chunk.parts))
        for at, parts in placed:
            if at is not None:
                self.output.write_at(parts, at)
        self.check()

    def check(self) -> None:
        """Raise the error of the first write of HDF5 that failed, such as OSError for a full disk."""
        if self.output.failure is not None:
            raise self.output.failure

    def close(self) -> None:
        """Close the file, after all threads have written their chunks. Raises an error as :meth:`check` does."""
        try:
            self.hdf5.close()
        finally:
            self.output.close()
        self.check()


class ChunkedColumn:
    """Dataset of a :class:`ChunkFile`, whose chunks are written in any order."""

    def __init__(self, file: ChunkFile, dataset: Any) -> None:
        self._output, self._id = file.output, dataset.id
        self._rows, *self._row = dataset.shape

    def place(self, start: int, stored: Sequence[bytes], rows: int) -> int | None:
        """Return the place in the file [bytes] of an encoded chunk from element ``start`` on.

        ``stored`` are the bytes of the chunk, in one or several parts. A dataset of fewer than ``rows`` elements grows
        to this number. If the place cannot be found, the chunk is written at once and None is returned. Call this
        method in turn.
        """
        size, offset = sum(map(len, stored)), (start, *(0 for _ in self._row))
        if self._rows < rows:
            self._rows = rows
            self._id.set_extent((self._rows, *self._row))
        at = self._output.place_of(size, partial(self._id.write_direct_chunk, offset))
        if at is None:
            self._id.write_direct_chunk(offset, b"".join(stored))
        return at


class _Output(io.RawIOBase):
    """File that HDF5 writes through, which can find the place of data instead of writing them.

    HDF5's writes never fail. If one cannot be done, its data and those of all later ones stay in memory.
    """

    def __init__(self, path: Path) -> None:
        self._handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o666)
        self._position = 0
        self._token = os.urandom(16)
        self._stand_in = memoryview(self._token)
        self._sought: int | None = None
        self._found: int | None = None
        self.failure: BaseException | None = None
        """Error of the first write that failed."""
        self._unwritten: list[tuple[int, bytes]] = []
        """Data that could not be written, with their places [bytes]."""

    def place_of(self, size: int, write: Callable[[Any], Any]) -> int | None:
        """Return the place [bytes] at which ``write(data)`` writes ``size`` bytes in one piece, without writing them.

        The data are a random token and zeros. Returns None if HDF5 writes them in another way. Anything else that it
        writes meanwhile is written.
        """
        if len(self._stand_in) < size:
            self._stand_in = memoryview(self._token + bytes(size))
        self._sought, self._found = size, None
        try:
            write(self._stand_in[:size])
        finally:
            self._sought = None
        return self._found

    def write_at(self, parts: Iterable[Any], place: int) -> None:
        """Write data in several parts, one after the other, at a place [bytes]. Any thread may call it."""
        rest = [memoryview(part) for part in parts]
        while rest:
            done = os.pwritev(self._handle, rest, place)
            place += done
            while rest and done >= len(rest[0]):
                done -= len(rest.pop(0))
            if done:
                rest[0] = rest[0][done:]

    def write(self, data: Any) -> int:
        size = len(data)
        if size == self._sought and memoryview(data)[: len(self._token)] == self._token[:size]:
            self._found = self._position
        else:
            self._write_or_keep(data)
        self._position += size
        return size

    def _write_or_keep(self, data: Any) -> None:
        """Write data at the position, or keep them in memory if that or an earlier write failed."""
        if self.failure is None:
            try:
                self.write_at([data], self._position)
                return
            except BaseException as error:  # an interrupt too must not reach HDF5
                self.failure = error
        self._unwritten.append((self._position, bytes(data)))

    def readinto(self, buffer: Any) -> int:
        count = os.preadv(self._handle, [buffer], self._position)
        view = memoryview(buffer).cast("B")
        for at, data in self._unwritten:
            first, last = max(at - self._position, 0), min(at - self._position + len(data), len(view))
            if first < last:
                view[first:last] = data[first + self._position - at : last + self._position - at]
                count = max(count, last)
        return count

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        if whence == os.SEEK_END:
            offset += max(os.fstat(self._handle).st_size, *(at + len(data) for at, data in self._unwritten), 0)
        self._position = offset
        return self._position

    def tell(self) -> int:
        return self._position

    def truncate(self, size: int | None = None) -> int:
        size = self._position if size is None else size
        try:
            os.ftruncate(self._handle, size)
        except OSError as error:
            self.failure = self.failure or error
        return size

    def close(self) -> None:
        if not self.closed:
            os.close(self._handle)
        super().close()


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


# Writer of HDF5 files with the layout of DSEC: events/x, y, t, p, t_offset and ms_to_idx, and no other dataset.
#
# DSEC's files do not hold the sensor size. It is added as attributes, which DSEC's programs ignore.

COLUMNS = {"x": np.uint16, "y": np.uint16, "t": np.uint32, "p": np.uint8}
"""Types of DSEC's datasets."""


def write_dsec(part: Path, blocks: Iterable[Events], about: Outline) -> None:
    """Write all events, one chunk of each dataset at a time."""
    with contextlib.closing(ChunkFile(part, libver=None)) as chunks:
        file = chunks.hdf5
        file.attrs["width"], file.attrs["height"] = about.width, about.height
        file["t_offset"] = np.int64(about.t_first)
        create = partial(make_dataset, file, codec=about.codec)
        datasets = {name: create(f"events/{name}", dtype) for name, dtype in COLUMNS.items()}
        index = [np.zeros(0, np.int64)]
        written = ms = 0
        for events in regroup(blocks, count=CHUNK):
            for entries in ms_entries(events.t, about.t_first, ms, written):
                index.append(entries)
                ms += entries.size
            columns = {"x": events.x, "y": events.y, "t": events.t - about.t_first, "p": events.p}
            for name, dtype in COLUMNS.items():
                _append(datasets[name], written, columns[name].astype(dtype), about.codec)
            written += len(events)
            chunks.check()
        stored = create("ms_to_idx", np.uint64)
        found = np.concatenate(index).astype(np.uint64)
        for start in range(0, ms, CHUNK):
            _append(stored, start, found[start : start + CHUNK], about.codec)


def _append(dataset: Any, start: int, values: NDArray[Any], codec: Codec) -> None:
    """Append a chunk without HDF5's buffers."""
    append_chunk(dataset, start, encode(values, codec), len(values))


# Copy of a recording into a native file.

POSE_BLOCK = 1 << 16
"""Number of poses that are copied at a time."""


def copy_events(
    recording: Recording, writer: RecordingWriter, size: tuple[int, int], progress: Progress | None = None
) -> None:
    """Append all events of a recording to a writer, with their ground truth and flags, IMU samples and frames.

    ``size`` is that of the image [px]. Flags that a source of compensated events does not have follow from it.
    """
    source, truth = recording.events, recording.truth
    flags = {name: getattr(source, name, None) for name in ("inside", "extrapolated")}
    start = 0
    for block in source.blocks():
        stop = start + len(block)
        known = None if truth is None else truth.of_events(start, stop)
        marks = {name: None if flag is None else flag(start, stop) for name, flag in flags.items()}
        if marks["inside"] is None and not block.whole_pixels:
            marks["inside"] = inside_image(block.x, block.y, *size)
        writer.append(block, truth=known, **marks)
        start = stop
        if progress is not None:
            progress("writing events", start / len(source))
    if truth is not None:
        _copy_world_truth(truth, writer)
    if recording.imu is not None:
        writer.append_imu(recording.imu)
    if recording.frames is not None:
        for index, t in enumerate(recording.frames.t.tolist()):
            writer.append_image(t, recording.frames[index])


def _copy_world_truth(truth: Truth, writer: RecordingWriter) -> None:
    """Append to a writer the ground truth of instants, the masks of known pixels, and the poses."""
    if truth.known is not None:
        for index, t in enumerate(truth.known.t.tolist()):
            writer.append_known(t, truth.known[index])
    if truth.frames is not None:
        for index in range(len(truth.frames.t)):
            writer.append_frame(truth.frames[index])
    if truth.poses is not None:
        for start in range(0, len(truth.poses), POSE_BLOCK):
            writer.append_poses(truth.poses[start : start + POSE_BLOCK])


@guarded
def save_recording(path: str | os.PathLike[str], recording: Recording, *, overwrite: bool = False) -> None:
    """Write a recording to a native HDF5 file.

    Parameters
    ----------
    path : str or path-like
        The file to write, which ends in ``.h5`` or ``.hdf5``. :func:`convert` writes other formats.
    recording : Recording
        The recording.
    overwrite : bool, default False
        Whether an existing file may be replaced.

    Raises
    ------
    AmiwarpError
        If the path has another extension, cannot be written, is being read, or exists without ``overwrite``.

    Examples
    --------
    >>> events = amiwarp.Events.from_arrays(x=[1, 2], y=[0, 0], t=[0, 10], p=[1, 0])
    >>> recording = amiwarp.Recording(amiwarp.MemoryEvents(events, width=4, height=4))
    >>> amiwarp.save_recording("short.h5", recording)
    """
    source = recording.events
    width, height = source.size
    with RecordingWriter(
        path,
        width=width,
        height=height,
        camera=recording.camera,
        prism=recording.prism,
        encoder=recording.encoder,
        truth_parameters=None if recording.truth is None else recording.truth.parameters,
        truth_labels=None if recording.truth is None else recording.truth.labels,
        metadata=recording.metadata,
        overwrite=overwrite,
    ) as writer:
        copy_events(recording, writer, source.size)
