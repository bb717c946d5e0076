"""Writing the native HDF5 recording of docs/recording-format.md: streamed, in constant memory, all or nothing."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.encoder import Encoder
from amiwarp.events.events import Events, check_events
from amiwarp.events.recording import MetadataValue, Recording
from amiwarp.io.attributes import camera_attributes, prism_attributes
from amiwarp.io.chunks import CHUNK, append_chunk, encode, in_order
from amiwarp.io.files import errors_name
from amiwarp.io.output import NewFile
from amiwarp.optics.camera import Camera
from amiwarp.progress import Progress

if TYPE_CHECKING:
    from amiwarp.optics.prism import NominalPrism

FORMAT = "amiwarp-recording"
FORMAT_VERSION = 1

"""Called with the number of events done and of all, or None where that is not known."""

Columns: TypeAlias = dict[str, NDArray[Any]]
"""Events as the file has them, by the dataset's name."""

Marked: TypeAlias = tuple[Events, NDArray[np.uint8]]
"""Compensated events and, shape ``(n,)``, 1 where one lies on the picture."""

MAX_MS = 100_000_000
"""Longest recording [ms], 28 h: beyond it a timestamp is damaged, and the index would swell with it."""


class RecordingWriter:
    """Streams a recording into a file that appears, whole, when the ``with`` block ends without an exception.

    Raises :class:`AmiwarpError` for a path that cannot be written, is being read, or exists (unless ``overwrite``), and
    for events that are unsorted or out of the frame; then nothing is left behind.
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
        metadata: Mapping[str, MetadataValue] | None = None,
        overwrite: bool = False,
    ) -> None:
        self.path, self._overwrite = Path(path), overwrite
        check_frame(self.path, width, height, camera)
        self._size = (int(width), int(height))
        self._camera, self._prism, self._encoder = camera, prism, encoder
        self._truth_parameters = truth_parameters
        self._metadata = dict(metadata or {})
        self._file: Any = None
        self._datasets: dict[str, Any] = {}
        self._new: NewFile | None = None
        self._pending: list[Columns] = []
        self._pending_count = 0
        self._written = 0
        self._columns: dict[str, np.dtype[Any]] | None = None
        self._t_offset = 0
        self._t_last: int | None = None
        self._next_ms = 0
        self._ms: list[NDArray[np.int64]] = []
        self._ms_count = 0

    def __len__(self) -> int:
        return self._written + self._pending_count

    def __enter__(self) -> RecordingWriter:
        import h5py

        self._new = NewFile(self.path, overwrite=self._overwrite)
        try:
            with errors_name(self.path, lambda: "making the file"):
                # Since HDF5 1.10 the file's structure carries checksums: damage is noticed, not followed.
                self._file = h5py.File(self._new.part, "x", libver=("v110", "v110"))
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
                self._file.close()
                self._new.commit()
        except BaseException:
            self._discard()
            raise

    def append(
        self,
        events: Events,
        *,
        truth_points: ArrayLike | None = None,
        inside: ArrayLike | None = None,
        extrapolated: ArrayLike | None = None,
    ) -> None:
        """Add events, with their scene points ``(n, 2)`` [px] and their flags ``(n,)`` where the first call had them.

        ``inside`` tells of compensated (float32) events whether they still lie on the picture; NaN needs it.
        ``extrapolated`` tells whether the prism's angle was one beyond the encoder's samples.
        """
        if self._file is None:
            raise AmiwarpError(f"{self.path}: append outside the writer's with block")
        check_events(
            events,
            *self._size,
            where=str(self.path),
            first_index=len(self),
            allow_nan=inside is not None,
            after_t=self._t_last,
        )
        if not len(events):
            return
        with errors_name(self.path, lambda: f"after {len(self)} events"):
            columns = self._as_columns(events, truth_points, {"inside": inside, "extrapolated": extrapolated})
            self._index(events.t)
            columns["events/t"] = events.t - self._t_offset
            self._pending.append(columns)
            self._pending_count += len(events)
            self._flush(whole=self._pending_count - self._pending_count % CHUNK)

    def fill(
        self, pieces: Iterable[Callable[[], Marked]], *, t_first: int, done: Callable[[Events, NDArray[np.uint8]], None]
    ) -> None:
        """Write a whole recording, the first event at ``t_first`` [us], piece by piece, made on all cores.

        Threads call the pieces, each of whole chunks (the last one may end within), and encode what they return.
        ``done`` sees it, once it is written, in order and in the calling thread.
        """
        if self._file is None or len(self):
            raise AmiwarpError(f"{self.path}: fill outside the writer's with block or after other events")
        self._t_offset = t_first
        with contextlib.closing(in_order(partial(self._made, piece) for piece in pieces)) as made:
            for events, inside, columns, encoded in made:
                with errors_name(self.path, lambda: f"after {len(self)} events"):
                    if self._written % CHUNK:
                        raise AmiwarpError("a piece that is not the last ends within a chunk")
                    check_events(events, *self._size, where=str(self.path), first_index=len(self), allow_nan=True,
                                 after_t=self._t_last)  # fmt: skip
                    self._index(events.t)
                    self._store(columns, encoded)
                    self._written += len(events)
                done(events, inside)

    def _made(self, piece: Callable[[], Marked]) -> tuple[Events, NDArray[np.uint8], Columns, list[bytes]]:
        """All that can be done of a piece on a thread of its own."""
        events, inside = piece()
        columns = {"events/x": events.x, "events/y": events.y, "events/t": events.t - self._t_offset}
        columns |= {"events/p": events.p, "events/inside": inside}
        return events, inside, columns, [encode(part) for part in chunks_of(columns)]

    def set_encoder(self, encoder: Encoder) -> None:
        """Set or replace the encoder that is written at the end."""
        self._encoder = encoder

    def _as_columns(
        self, events: Events, truth_points: ArrayLike | None, flags: Mapping[str, ArrayLike | None]
    ) -> Columns:
        columns: Columns = {"events/x": events.x, "events/y": events.y, "events/p": events.p}
        for name, flag in flags.items():
            if flag is not None:
                columns[f"events/{name}"] = np.asarray(flag).astype(np.uint8)
        if truth_points is not None:
            points = np.asarray(truth_points, np.float32)
            if points.shape != (len(events), 2):
                raise AmiwarpError(f"truth points have shape {points.shape}; expected ({len(events)}, 2)")
            columns["truth/x"], columns["truth/y"] = points[:, 0], points[:, 1]
        check_lengths(columns, len(events))
        dtypes = {name: column.dtype for name, column in columns.items()}
        if self._columns is None:
            self._columns = dtypes
            self._t_offset = int(events.t[0])
        elif dtypes != self._columns:
            raise AmiwarpError(f"events come with {_listed(dtypes)}, those before with {_listed(self._columns)}")
        return columns

    def _index(self, t: NDArray[np.int64]) -> None:
        """Extend ms_to_idx: entry m is the first event at or after m milliseconds."""
        for entries in ms_entries(t, self._t_offset, self._next_ms, len(self)):
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
        """Write the first ``whole`` pending events; whole chunks are compressed once only."""
        if not whole:
            return
        joined = {name: np.concatenate([part[name] for part in self._pending]) for name in self._pending[0]}
        begun = {name: column[:whole] for name, column in joined.items()}
        with contextlib.closing(in_order(partial(encode, part) for part in chunks_of(begun))) as encoded:
            self._store(begun, encoded)
        self._written += whole
        self._pending_count -= whole
        self._pending = [{name: column[whole:] for name, column in joined.items()}] if self._pending_count else []

    def _store(self, columns: Columns, encoded: Iterable[bytes]) -> None:
        """Write columns from their encoded chunks, which follow what was written before."""
        stored = iter(encoded)
        for name, column in columns.items():
            dataset = self._dataset(name, column.dtype)
            for at in range(0, column.size, CHUNK):
                append_chunk(dataset, self._written + at, next(stored), min(CHUNK, column.size - at))

    def _extend(self, name: str, values: NDArray[Any]) -> None:
        """Add to a dataset through HDF5: for those that are small or grow by parts of chunks."""
        dataset = self._dataset(name, values.dtype)
        start = dataset.shape[0]
        dataset.resize(start + values.size, axis=0)
        dataset[start:] = values

    def _dataset(self, name: str, dtype: np.dtype[Any]) -> Any:
        if name not in self._datasets:
            self._datasets[name] = make_dataset(self._file, name, dtype)
        return self._datasets[name]

    def _write_header(self) -> None:
        write_header(self._file, self._size, self._camera, self._prism, self._metadata)
        if self._truth_parameters is not None:
            group = self._file.create_group("truth")
            for name, value in self._truth_parameters.items():
                group.attrs[name] = float(value)

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

    def _discard(self) -> None:
        if self._file is not None:
            # A full disk makes closing fail as well; the file goes either way.
            with contextlib.suppress(Exception):
                self._file.close()
        if self._new is not None:
            self._new.discard()


def check_frame(path: Path, width: int, height: int, camera: Camera | None) -> None:
    """Raises :class:`AmiwarpError` for a size that no sensor has, or that is not the camera's."""
    if not (1 <= width <= 65536 and 1 <= height <= 65536):
        raise AmiwarpError(f"{path}: size {width}x{height}; expected 1 .. 65536 pixels each way")
    if camera is not None and (camera.width, camera.height) != (width, height):
        given = f"camera is {camera.width}x{camera.height}, the recording {width}x{height}"
        raise AmiwarpError(f"{path}: {given}; give both one size")


def check_lengths(columns: Columns, count: int) -> None:
    """Raises :class:`AmiwarpError` for a column that has not one element per event."""
    for name, column in columns.items():
        if column.shape != (count,):
            raise AmiwarpError(f"{name} has shape {column.shape}; expected ({count},)")


def ms_entries(t: NDArray[np.int64], t_offset: int, first_ms: int, before: int) -> Iterator[NDArray[np.int64]]:
    """Entries of ms_to_idx, from ``first_ms`` on, that events at ``t`` [us] tell, which follow ``before`` others."""
    last_ms = (int(t[-1]) - t_offset) // 1000
    if last_ms > MAX_MS:
        span = f"{t_offset} .. {int(t[-1])} us"
        raise AmiwarpError(f"events span {span}, beyond {MAX_MS // 3_600_000} h; a timestamp is damaged")
    for first in range(first_ms, last_ms + 1, 1 << 20):
        ms = np.arange(first, min(first + (1 << 20), last_ms + 1), dtype=np.int64)
        yield np.searchsorted(t, ms * 1000 + t_offset) + before


def chunks_of(columns: Columns) -> Iterator[NDArray[Any]]:
    """All chunks of the first column, then of the next."""
    for column in columns.values():
        for at in range(0, column.size, CHUNK):
            yield column[at : at + CHUNK]


def _listed(columns: Mapping[str, np.dtype[Any]]) -> str:
    return ", ".join(f"{name} {dtype}" for name, dtype in columns.items())


def make_dataset(file: Any, name: str, dtype: Any) -> Any:
    """A dataset without elements yet, of the native layout."""
    import hdf5plugin

    # The checksum lies on the compressed bytes: it costs nothing measurable and LZ4 alone misses most damage.
    return file.create_dataset(
        name,
        shape=(0,),
        maxshape=(None,),
        chunks=(CHUNK,),
        dtype=dtype,
        fletcher32=True,
        compression=hdf5plugin.Blosc(cname="lz4", clevel=1, shuffle=hdf5plugin.Blosc.BITSHUFFLE),
    )


def write_header(
    file: Any,
    size: tuple[int, int],
    camera: Camera | None,
    prism: NominalPrism | None,
    metadata: Mapping[str, MetadataValue],
) -> None:
    """All that is known before the first event."""
    file.attrs["format"] = FORMAT
    file.attrs["format_version"] = FORMAT_VERSION
    file.attrs["width"], file.attrs["height"] = size
    if camera is not None:
        file.create_group("camera").attrs.update(camera_attributes(camera))
    if prism is not None:
        file.create_group("prism").attrs.update(prism_attributes(prism))
    group = file.create_group("metadata")
    for name, item in metadata.items():
        group.attrs[name] = item


def save_recording(path: str | os.PathLike[str], recording: Recording, *, overwrite: bool = False) -> None:
    """Write a recording, block by block, with all it holds. Raises :class:`AmiwarpError` as the writer does."""
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
        metadata=recording.metadata,
        overwrite=overwrite,
    ) as writer:
        copy_events(recording, writer)


def copy_events(recording: Recording, writer: RecordingWriter, progress: Progress | None = None) -> None:
    """Append all events with the points and flags that belong to them."""
    source, truth = recording.events, recording.truth
    flags = {name: getattr(source, name, None) for name in ("inside", "extrapolated")}
    start = 0
    for block in source.blocks():
        stop = start + len(block)
        points = None if truth is None else truth.points(start, stop)
        marks = {name: None if flag is None else flag(start, stop) for name, flag in flags.items()}
        writer.append(block, truth_points=points, **marks)
        start = stop
        if progress is not None:
            progress("writing events", start / len(source))
