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

from amiwarp.camera import Camera, Fisheye, RadialTangential
from amiwarp.encoder import Encoder
from amiwarp.errors import AmiwarpError
from amiwarp.events import Events, MetadataValue, Recording, check_events
from amiwarp.io.chunks import CHUNK, append_chunk, encode, in_order
from amiwarp.io.files import errors_name, part_path, refuse_overwriting, same_file

if TYPE_CHECKING:
    from amiwarp.optics import Prism

FORMAT = "amiwarp-recording"
FORMAT_VERSION = 1

Progress: TypeAlias = Callable[[int, int | None], None]
"""Called with the number of events done and of all, or None where that is not known."""

Columns: TypeAlias = dict[str, NDArray[Any]]
"""Events as the file has them, by the dataset's name."""

Marked: TypeAlias = tuple[Events, NDArray[np.uint8]]
"""Compensated events and, shape ``(n,)``, 1 where one lies on the picture."""

MAX_MS = 100_000_000
"""Longest recording [ms], 28 h: beyond it a timestamp is damaged, and the index would swell with it."""


class RecordingWriter:
    """Streams a recording into a file that appears, whole, when the ``with`` block ends without an exception.

    Raises :class:`AmiwarpError` for a path that cannot be written or is being read, and for events that are unsorted or
    out of the frame; then nothing is left behind.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        width: int,
        height: int,
        camera: Camera | None = None,
        prism: Prism | None = None,
        encoder: Encoder | None = None,
        truth_parameters: Mapping[str, float] | None = None,
        metadata: Mapping[str, MetadataValue] | None = None,
    ) -> None:
        self.path = Path(path)
        if not (1 <= width <= 65536 and 1 <= height <= 65536):
            raise AmiwarpError(f"{self.path}: size {width}x{height}; expected 1 .. 65536 pixels each way")
        if camera is not None and (camera.width, camera.height) != (width, height):
            given = f"camera is {camera.width}x{camera.height}, the recording {width}x{height}"
            raise AmiwarpError(f"{self.path}: {given}; give both one size")
        self._size = (int(width), int(height))
        self._camera, self._prism, self._encoder = camera, prism, encoder
        self._truth_parameters = truth_parameters
        self._metadata = dict(metadata or {})
        self._file: Any = None
        self._datasets: dict[str, Any] = {}
        self._part = self.path
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

        refuse_overwriting(self.path)
        self._part = part_path(self.path)
        try:
            with errors_name(self.path, lambda: "making the file"):
                # Since HDF5 1.10 the file's structure carries checksums: damage is noticed, not followed.
                self._file = h5py.File(self._part, "x", libver=("v110", "v110"))
                self._write_header()
        except BaseException:
            self._discard()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is not None:
            self._discard()
            return
        try:
            with errors_name(self.path, lambda: f"finishing after {len(self)} events"):
                self._finish()
                self._file.close()
                os.replace(self._part, self.path)
        except BaseException:
            self._discard()
            raise

    def append(self, events: Events, *, truth_points: ArrayLike | None = None, inside: ArrayLike | None = None) -> None:
        """Add events, with their scene points ``(n, 2)`` [px] and their flags ``(n,)`` where the first call had them.

        ``inside`` tells of compensated (float32) events whether they still lie on the picture; NaN needs it.
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
            columns = self._as_columns(events, truth_points, inside)
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
        return events, inside, columns, [encode(part) for part in _chunks(columns)]

    def set_encoder(self, encoder: Encoder) -> None:
        """Set or replace the encoder that is written at the end."""
        self._encoder = encoder

    def _as_columns(
        self, events: Events, truth_points: ArrayLike | None, inside: ArrayLike | None
    ) -> dict[str, NDArray[Any]]:
        columns: dict[str, NDArray[Any]] = {"events/x": events.x, "events/y": events.y, "events/p": events.p}
        if inside is not None:
            columns["events/inside"] = np.asarray(inside).astype(np.uint8)
        if truth_points is not None:
            points = np.asarray(truth_points, np.float32)
            if points.shape != (len(events), 2):
                raise AmiwarpError(f"truth points have shape {points.shape}; expected ({len(events)}, 2)")
            columns["truth/x"], columns["truth/y"] = points[:, 0], points[:, 1]
        for name, column in columns.items():
            if column.shape != (len(events),):
                raise AmiwarpError(f"{name} has shape {column.shape}; expected ({len(events)},)")
        dtypes = {name: column.dtype for name, column in columns.items()}
        if self._columns is None:
            self._columns = dtypes
            self._t_offset = int(events.t[0])
        elif dtypes != self._columns:
            raise AmiwarpError(f"events come with {_listed(dtypes)}, those before with {_listed(self._columns)}")
        return columns

    def _index(self, t: NDArray[np.int64]) -> None:
        """Extend ms_to_idx: entry m is the first event at or after m milliseconds."""
        last_ms = (int(t[-1]) - self._t_offset) // 1000
        if last_ms > MAX_MS:
            span = f"{self._t_offset} .. {int(t[-1])} us"
            raise AmiwarpError(f"events span {span}, beyond {MAX_MS // 3_600_000} h; a timestamp is damaged")
        relative = t - self._t_offset
        for first in range(self._next_ms, last_ms + 1, 1 << 20):
            ms = np.arange(first, min(first + (1 << 20), last_ms + 1), dtype=np.int64)
            self._ms.append(np.searchsorted(relative, ms * 1000) + len(self))
            self._ms_count += ms.size
            self._write_index(CHUNK)
        self._next_ms, self._t_last = last_ms + 1, int(t[-1])

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
        with contextlib.closing(in_order(partial(encode, part) for part in _chunks(begun))) as encoded:
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
            self._datasets[name] = _make(self._file, name, dtype)
        return self._datasets[name]

    def _write_header(self) -> None:
        file = self._file
        file.attrs["format"] = FORMAT
        file.attrs["format_version"] = FORMAT_VERSION
        file.attrs["width"], file.attrs["height"] = self._size
        if self._camera is not None:
            _write_camera(file.create_group("camera"), self._camera)
        if self._prism is not None:
            group = file.create_group("prism")
            group.attrs["apex"], group.attrs["index"] = float(self._prism.apex), float(self._prism.index)
            group.attrs["flat_side"] = self._prism.flat_side.value
        if self._truth_parameters is not None:
            group = file.create_group("truth")
            for name, value in self._truth_parameters.items():
                group.attrs[name] = float(value)
        group = file.create_group("metadata")
        for name, item in self._metadata.items():
            group.attrs[name] = item

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
        with contextlib.suppress(OSError):
            self._part.unlink()


def _chunks(columns: Columns) -> Iterator[NDArray[Any]]:
    """All chunks of the first column, then of the next."""
    for column in columns.values():
        for at in range(0, column.size, CHUNK):
            yield column[at : at + CHUNK]


def _listed(columns: Mapping[str, np.dtype[Any]]) -> str:
    return ", ".join(f"{name} {dtype}" for name, dtype in columns.items())


def _make(file: Any, name: str, dtype: np.dtype[Any]) -> Any:
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


def _write_camera(group: Any, camera: Camera) -> None:
    for name in ("width", "height", "fx", "fy", "cx", "cy"):
        group.attrs[name] = getattr(camera, name)
    distortion = camera.distortion
    if isinstance(distortion, RadialTangential):
        group.attrs["distortion_model"] = "radial_tangential"
        coefficients = [distortion.k1, distortion.k2, distortion.p1, distortion.p2, distortion.k3]
        group.attrs["distortion"] = np.array(coefficients, np.float64)
    elif isinstance(distortion, Fisheye):
        group.attrs["distortion_model"] = "fisheye"
        group.attrs["distortion"] = np.array([distortion.k1, distortion.k2, distortion.k3, distortion.k4], np.float64)
    else:
        group.attrs["distortion_model"] = "none"


def save_recording(path: str | os.PathLike[str], recording: Recording) -> None:
    """Write a recording, block by block, with all it holds. Raises :class:`AmiwarpError` as the writer does."""
    source = recording.events
    origin = getattr(source, "path", None)
    if origin is not None and same_file(Path(origin), Path(path)):
        raise AmiwarpError(f"{path}: is the file the recording is read from; write to another file")
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
    ) as writer:
        copy_events(recording, writer)


def copy_events(recording: Recording, writer: RecordingWriter, progress: Progress | None = None) -> None:
    """Append all events with the points and flags that belong to them."""
    source, truth = recording.events, recording.truth
    flags = getattr(source, "inside", None)
    start = 0
    for block in source.blocks():
        stop = start + len(block)
        points = None if truth is None else truth.points(start, stop)
        writer.append(block, truth_points=points, inside=None if flags is None else flags(start, stop))
        start = stop
        if progress is not None:
            progress(start, len(source))
