"""Writer of a whole recording or none."""

from __future__ import annotations

import contextlib
import itertools
import os
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
from types import TracebackType
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events import other_sensors, poses
from amiwarp.events import recording as checks
from amiwarp.events.encoder import Encoder
from amiwarp.events.other_sensors import ImuSamples
from amiwarp.events.poses import Poses
from amiwarp.events.recording import Events, MetadataValue
from amiwarp.events.truth import MAPS, EventTruth, FrameTruth, WorldLabels
from amiwarp.io.hdf5.chunk_file import ChunkFile, EncodedChunk
from amiwarp.io.hdf5.chunks import CHUNK, encode_parts
from amiwarp.io.inputs import errors_name
from amiwarp.io.native.layout import EVENTS, POSE_TABLES, Columns
from amiwarp.io.native.parts import (
    check_frame,
    encoder_columns,
    event_columns,
    filled,
    ms_entries,
    write_header,
)
from amiwarp.io.native.records import Datasets, Records
from amiwarp.io.output_formats import Codec, check_native
from amiwarp.io.outputs import NewFile
from amiwarp.optics.camera import Camera
from amiwarp.optics.prism import NominalPrism
from amiwarp.schema.calls import guarded
from amiwarp.tasks import Result, in_order
from amiwarp.validation import choice, shown

FlaggedEvents: TypeAlias = tuple[Events, NDArray[np.uint8], Mapping[str, Sequence[bytes]]]
"""Compensated events with flags of shape ``(n,)``: 1 if the event lies inside the image; and chunks of their columns
that are encoded already, by the name of the dataset."""


@guarded
class RecordingWriter:
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
        self.path = Path(path)
        self._overwrite = overwrite
        check_native(self.path)
        self._codec = choice(Codec, codec, f"{self.path}: codec")
        check_frame(self.path, width, height, camera)
        self._size = (int(width), int(height))
        self._camera = camera
        self._prism = prism
        self._encoder = encoder
        self._truth_parameters = truth_parameters
        self._truth_labels = truth_labels
        self._metadata = dict(metadata or {})
        # The file, from the beginning of the ``with`` block on.
        self._new: NewFile | None = None
        self._chunks: Any = None
        self._datasets: Any = None
        self._records: Any = None
        self._open = False
        self._tickets = itertools.count()
        self._is_filling = False
        # Events: full chunks are written, the others are pending.
        self._written = 0
        self._pending: Columns = {}
        self._pending_count = 0
        self._columns: dict[str, np.dtype[Any]] = {}
        self._t_offset = 0
        self._t_last: int | None = None
        # Entries of the millisecond index that are not written yet.
        self._next_ms = 0
        self._ms: list[NDArray[np.int64]] = []
        self._ms_count = 0

    def __len__(self) -> int:
        return self._written + self._pending_count

    def __enter__(self) -> RecordingWriter:
        self._new = NewFile(self.path, overwrite=self._overwrite)
        try:
            with errors_name(self.path, lambda: "making the file"):
                self._chunks = ChunkFile(self._new.part)
                self._datasets = Datasets(self._chunks.hdf5, self._codec)
                self._records = Records(self.path, self._datasets)
                self._open = True
                write_header(
                    self._chunks.hdf5, self._size, self._camera, self._prism, self._metadata
                )
                self._write_truth_header()
        except BaseException:
            self._discard()
            raise
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
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
            If events are unsorted or outside the frame, or the arrays differ from the arrays of the first call.
        """
        self._check_open()
        self._check_filled()
        self._check(events, len(self), allow_nan=inside is not None, after_t=self._t_last)
        if not len(events):
            return
        with errors_name(self.path, lambda: f"after {len(self)} events"):
            known = truth or EventTruth(
                points=None if truth_points is None else np.asarray(truth_points, np.float32)
            )
            columns = event_columns(events, known, inside=inside, extrapolated=extrapolated)
            dtypes = {name: column.dtype for name, column in columns.items()}
            if not len(self):
                self._columns = dtypes
                self._t_offset = int(events.t[0])
            elif dtypes != self._columns:
                given = _listed(dtypes)
                before = _listed(self._columns)
                raise AmiwarpError(
                    f"events come with {given}, those before with {before}; give the same arrays"
                )
            self._index(events.t, len(self))
            columns["events/t"] = events.t - self._t_offset
            self._store(columns, len(events))

    def fill(
        self,
        pieces: Iterable[Callable[[], FlaggedEvents]],
        *,
        count: int,
        t_first: int,
    ) -> Generator[FlaggedEvents, None, None]:
        """Return an iterator that writes a whole recording of compensated events.

        Pieces are computed and written in parallel on all cores, some ahead of the iteration. Take them all: a writer
        that is closed before fails.

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

        Returns
        -------
        generator of tuple
            Each piece after it was written, in order.

        Raises
        ------
        AmiwarpError
            If other events were written before, or events are unsorted or outside the frame.
        """
        self._check_open()
        if len(self) or count % CHUNK:
            given = f"fill() was called after {len(self)} events, for pieces of {count}"
            raise AmiwarpError(
                f"{self.path}: {given}; call it before append(), for a multiple of {CHUNK}"
            )
        self._t_offset = t_first
        self._is_filling = True
        jobs = (
            partial(self._write_piece, piece, index * count, next(self._tickets))
            for index, piece in enumerate(pieces)
        )
        return self._written_pieces(jobs, count)

    def _written_pieces(
        self, jobs: Iterable[Callable[[], FlaggedEvents]], count: int
    ) -> Generator[FlaggedEvents, None, None]:
        """Run the jobs of :meth:`fill`, and yield the pieces of ``count`` events that were written."""
        with self._results(jobs) as written:
            for piece in written:
                events, _, _ = piece
                with errors_name(self.path, lambda: f"after {len(self)} events"):
                    if self._written % count:
                        raise AmiwarpError(
                            f"a piece before the last ends within a chunk; give {count} events each"
                        )
                    self._written += len(events)
                yield piece
        self._is_filling = False

    def _check_filled(self) -> None:
        if self._is_filling:
            raise AmiwarpError(
                f"{self.path}: not all pieces of fill() were written; take all that it yields first"
            )

    def _write_piece(
        self, piece: Callable[[], FlaggedEvents], start: int, turn: int
    ) -> FlaggedEvents:
        """Compute, encode and write a piece whose first event is event ``start``. Runs in a thread."""
        with self._chunks.stopping(turn):
            if not callable(piece):
                raise AmiwarpError(f"{self.path}: a piece is {shown(piece)}; expected a function")
            events, inside, encoded = piece()
            if self._codec is not Codec.BLOSC:
                encoded = {}
            with errors_name(self.path, lambda: f"after {start} events"):
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
                events, *self._size, where=str(self.path), first_index=start, allow_nan=True
            )

    def _follow(self, events: Events, start: int) -> None:
        """Check that a piece is not earlier than the one before, and extend the index. Called in turn."""
        self._check(events[:1], start, allow_nan=True, after_t=self._t_last)
        self._index(events.t, start)

    def _check(self, events: Events, first_index: int, **how: Any) -> None:
        checks.check_events(
            events, *self._size, where=str(self.path), first_index=first_index, **how
        )

    def append_frame(self, frame: FrameTruth) -> None:
        """Append the ground truth of an instant.

        Parameters
        ----------
        frame : FrameTruth
            Ground truth of all pixels, at a later time than the frame before. All frames have the same joints.
        """
        with self._appending(lambda: f"truth of the instant {frame.t_us} us"):
            width, height = self._size
            maps: Columns = {}
            for name, (dtype, tail) in MAPS.items():
                values = np.asarray(getattr(frame, name), dtype)
                expected = (height, width, *tail)
                if values.shape != expected:
                    what = f"{name} of the instant {frame.t_us} us has shape {values.shape}"
                    raise AmiwarpError(f"{self.path}: {what}; expected {expected}")
                maps[f"truth/frames/{name}"] = values[None]
            rows = {
                "truth/frames/t": np.array([frame.t_us], np.int64),
                "truth/frames/pose": poses.as_poses(frame.rotation, frame.position)[None],
            }
            joints = {name: place[None] for name, place in frame.joints.items()}
            named = {"truth/joints/names": ("truth/frames/joints", joints)}
            self._records.append(rows, maps, named)

    def append_known(self, t_us: int, mask: NDArray[np.bool_]) -> None:
        """Append a mask of the pixels whose scene is known.

        Parameters
        ----------
        t_us : int
            Time from which the mask holds [us], later than the time of the mask before.
        mask : numpy.ndarray
            Whether the scene at each pixel without the prism is known, shape ``(height, width)``.
        """
        with self._appending(lambda: f"mask at {t_us} us"):
            if mask.shape != self._size[::-1]:
                what = f"mask at {t_us} us has shape {mask.shape}"
                raise AmiwarpError(f"{self.path}: {what}; expected {self._size[::-1]}")
            if mask.dtype != np.bool_:
                raise AmiwarpError(
                    f"{self.path}: mask at {t_us} us is {mask.dtype}; give truth values (bool)"
                )
            rows = {"truth/known/t": np.array([t_us], np.int64)}
            images = {"truth/known/mask": np.asarray(mask, np.uint8)[None]}
            self._records.append(rows, images)

    def append_poses(self, poses: Poses) -> None:
        """Append true poses of camera, bodies and joints.

        Parameters
        ----------
        poses : Poses
            Poses at later times than those before, of the same bodies and joints.
        """
        with self._appending(lambda: "true poses"):
            if not len(poses):
                return
            rows = {
                "truth/poses/t": np.asarray(poses.t, np.int64),
                "truth/poses/camera": np.asarray(poses.camera, np.float64),
            }
            named = {
                names: (values, getattr(poses, what))
                for what, (names, values, _) in POSE_TABLES.items()
            }
            self._records.append(rows, named=named)

    def append_imu(self, samples: ImuSamples) -> None:
        """Append samples of an inertial measurement unit.

        Parameters
        ----------
        samples : ImuSamples
            Samples, not earlier than those before.
        """
        with self._appending(lambda: "IMU samples"):
            rows = {
                "imu/t": samples.t,
                "imu/angular_velocity": samples.angular_velocity,
                "imu/acceleration": samples.acceleration,
            }
            self._records.append(rows)
            if samples.to_camera is not None:
                self._chunks.hdf5["imu"].attrs["to_camera"] = samples.to_camera.ravel()

    def append_image(self, t_us: int, image: NDArray[Any]) -> None:
        """Append a frame.

        Parameters
        ----------
        t_us : int
            Time of the frame [us], not earlier than the frame before.
        image : numpy.ndarray
            Grey levels, uint8 or uint16, shape ``(height, width)``, of the type and shape of the frames before.
        """
        with self._appending(lambda: f"frame at {t_us} us"):
            shape = image.shape
            dtype = image.dtype
            stored = self._datasets.find("frames/image")
            if stored is not None:
                shape = stored.shape[1:]
                dtype = stored.dtype
            try:
                other_sensors.check_image(image, shape, dtype)
            except AmiwarpError as error:
                raise AmiwarpError(f"{self.path}: {error}") from error
            rows = {"frames/t": np.array([t_us], np.int64)}
            self._records.append(rows, {"frames/image": image[None]})

    @contextlib.contextmanager
    def _appending(self, place: Callable[[], str]) -> Iterator[None]:
        """Name the file and the place in errors, also if the writer is not open or the disk is full."""
        with errors_name(self.path, place):
            self._check_open()
            yield
            self._chunks.check()

    def _write_truth_header(self) -> None:
        """Write the true parameters of a simulation, and the names of a world's instances and their classes."""
        if self._truth_parameters is not None:
            group = self._chunks.hdf5.create_group("truth")
            for name, value in self._truth_parameters.items():
                group.attrs[name] = float(value)
        if self._truth_labels is not None:
            self._chunks.hdf5.require_group("truth/world").attrs["name"] = self._truth_labels.name
            for what in ("instances", "categories"):
                names = getattr(self._truth_labels, what)
                self._datasets.write_names(f"truth/world/{what}", names)

    def _check_open(self) -> None:
        if not self._open:
            given = "the writer is used outside its 'with' block, before or after it, or after it failed"
            raise AmiwarpError(f"{self.path}: {given}; append inside the block of a new writer")

    @contextlib.contextmanager
    def _results(self, jobs: Iterable[Callable[[], Result]]) -> Iterator[Iterator[Result]]:
        """Run jobs that write chunks, and give their results in order. After an error the writer cannot go on."""
        try:
            with contextlib.closing(in_order(jobs)) as results:
                yield results
        except BaseException:
            self._open = False
            raise

    def set_encoder(self, encoder: Encoder) -> None:
        """Set or replace the encoder, which is written at the end.

        Parameters
        ----------
        encoder : Encoder
            The encoder.

        Raises
        ------
        AmiwarpError
            If the file is finished.
        """
        if self._new is not None:
            self._check_open()
        self._encoder = encoder

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
        """Write the waiting entries of the index if they are ``least`` or more."""
        if self._ms_count >= least:
            self._datasets.extend("ms_to_idx", np.concatenate(self._ms))
            self._ms = []
            self._ms_count = 0

    def _store(self, columns: Columns, count: int) -> None:
        """Write the chunks that are full with new events, and keep the other events."""
        full: list[Columns] = []
        start = 0
        while start < count:
            stop = min(start + CHUNK - self._pending_count, count)
            chunk = {name: column[start:stop] for name, column in columns.items()}
            # A whole chunk of new events is written without a copy.
            if stop - start < CHUNK:
                self._pending = filled(self._pending, self._pending_count, chunk)
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
            partial(self._write_chunk, name, start, chunk[name], next(self._tickets))
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

    def _finish(self) -> None:
        self._check_open()
        self._check_filled()
        if self._pending_count:
            count = self._pending_count
            self._write([{name: column[:count] for name, column in self._pending.items()}])
            self._pending_count = 0

        # The index ends with the number of events.
        self._ms.append(np.array([len(self)], np.int64))
        self._write_index(0)

        # Datasets of a recording without events are missing until here.
        for name, default in EVENTS.items():
            dtype = self._columns.get(f"events/{name}", np.dtype(default))
            self._datasets.extend(f"events/{name}", np.zeros(0, dtype))

        self._chunks.hdf5["t_offset"] = np.int64(self._t_offset)
        if self._encoder is not None:
            group = self._chunks.hdf5.create_group("encoder")
            group.attrs["clock_offset_us"] = float(self._encoder.clock_offset_us)
            for name, values in encoder_columns(self._encoder).items():
                self._datasets.extend(name, values)

    def _close(self) -> None:
        self._open = False
        if self._chunks is not None:
            self._chunks.close()
        self._datasets = None
        self._records = None

    def _discard(self) -> None:
        # The file is removed even if it cannot be closed.
        with contextlib.suppress(Exception):
            self._close()
        if self._new is not None:
            self._new.discard()


def _listed(dtypes: Mapping[str, np.dtype[Any]]) -> str:
    return ", ".join(f"{name} {dtype}" for name, dtype in dtypes.items())
