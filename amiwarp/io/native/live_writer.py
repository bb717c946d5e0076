"""Writer of a live recording, which stays readable at any time and loses at most its last second in a crash.

HDF5's single-writer mode orders all writes so that the file is consistent after each. The last chunk is usually not
full. Every flush writes it again at another place, so that the version which a reader or a crashed file refers to
stays intact. HDF5 fails badly on a full disk, so the space to finish the file is reserved before events are accepted.
The file gets its name after that mode has begun: HDF5 cannot open a file whose creation was cut off.
"""

from __future__ import annotations

import contextlib
import dataclasses
import os
import time
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events import recording as checks
from amiwarp.events.encoder import Encoder
from amiwarp.events.recording import Events, MetadataValue
from amiwarp.events.truth import EventTruth
from amiwarp.io.columns.options import GivenLayout
from amiwarp.io.file_access import allocate
from amiwarp.io.hdf5.chunks import CHUNK, encode
from amiwarp.io.hdf5.datasets import append_chunk, make_dataset
from amiwarp.io.inputs import errors_name
from amiwarp.io.native.copying import save_recording
from amiwarp.io.native.header import check_sensor_size, write_header
from amiwarp.io.native.layout import ENCODERS, EVENTS, FLAGS, Columns
from amiwarp.io.native.ms_index import ms_entries
from amiwarp.io.native.reader import open_hdf5
from amiwarp.io.native.written_columns import copied_into_chunk, encoder_columns, event_columns
from amiwarp.io.output_formats import check_native
from amiwarp.io.outputs import NewFile, check_output, link_new, put_in_place
from amiwarp.optics.camera import Camera
from amiwarp.optics.prism import NominalPrism
from amiwarp.tasks import in_order
from amiwarp.validation import as_times

SMALL_CHUNK = 4096
"""Number of elements per chunk of the small datasets. They are not compressed, so that they grow in place."""

END_ADDRESS_OFFSET = 28
"""Offset of the end-of-file address in an HDF5 file's header [bytes]. Bytes after that address are unused."""

FINISH_BYTES = 1 << 19
"""Disk space that is reserved to finish a file in addition to its data [bytes]: for HDF5's structures and partial
chunks."""

MOST_WAITING = 1 << 24
"""Largest amount of encoder samples that wait for the next flush [bytes]. More samples are written immediately."""

MOST_PULSES = 1 << 16
"""Largest number of index pulses that wait for encoder samples. If there are more, the oldest are dropped."""

MAX_WASTE_BYTES = 1 << 24
"""Largest size of superseded chunks in a finished file [bytes]. With more, the file is copied without these chunks."""


class LiveWriter:
    """Writer that streams a live recording into ``NAME.part.h5`` next to ``path``, and renames it to ``path``.

    The file is finished and renamed in every case: after an exception and on a full disk it keeps the events appended
    so far, and the error gives their number. Only if there are neither events nor encoder samples at an exception, for
    example of a second output, no file is left. ``compensated`` recordings hold float32 coordinates and flags.
    Recordings of a pair of prisms or of a mirror have two ``encoders``. All events are in the file after ``flush_s``
    [s] at the latest, if :meth:`append` or :meth:`tick` is called that often. Use it in one thread.

    Raises :class:`AmiwarpError` for a path that does not end in .h5 or .hdf5, cannot be written or exists (unless
    ``overwrite``), for an existing part file, and for events that are unsorted or outside the frame. After bad events
    the recording can continue.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        width: int,
        height: int,
        camera: Camera | None = None,
        prism: NominalPrism | None = None,
        metadata: Mapping[str, MetadataValue] | None = None,
        compensated: bool = False,
        encoders: int = 1,
        clock_offset_us: float = 0.0,
        flush_s: float = 0.5,
        overwrite: bool = False,
    ) -> None:
        """Prepare the writer. The times of written encoder samples are shifted by ``clock_offset_us``."""
        self.path = Path(path)
        self._overwrite = overwrite
        check_native(self.path)
        check_sensor_size(self.path, width, height, camera)
        self.part = self.path.resolve().with_name(f"{self.path.stem}.part.h5")
        self._size = (int(width), int(height))
        self._camera = camera
        self._prism = prism
        self._metadata = dict(metadata or {})
        self._compensated = compensated
        self._flush_s = flush_s
        self._clock_offset_us = clock_offset_us
        self._file: Any = None
        self._columns: dict[str, Any] = {}
        self._small: dict[str, _GrowingDataset] = {}
        self._pending: Columns = {}
        self._pending_count = 0
        self._written = 0
        """Number of events in full chunks."""
        self._stored = 0
        """Number of events in the file, with the last, partial chunk."""
        self._flushed_at = 0.0
        """Time of the last flush [s], monotonic."""
        self._reserved = 0
        """Size of the file for which disk space is reserved [bytes]."""
        self._t_offset = 0
        self._t_last: int | None = None
        self._next_ms = 0
        self._names = ENCODERS[:encoders]
        self._spans: dict[str, tuple[int, int]] = {}
        """Times of the first and the last sample of each encoder [us], by the beginning of its datasets' names."""
        self._early_pulses = dict.fromkeys(self._names, np.zeros(0, np.int64))
        """Index pulses later than the last sample of each encoder [us], by the beginning of its datasets' names."""
        self._encoder: Encoder | None = None

    def __len__(self) -> int:
        return self._written + self._pending_count

    def __enter__(self) -> LiveWriter:
        import h5py

        check_output(self.path, overwrite=self._overwrite)
        if os.path.lexists(self.part):
            raise self._part_exists()
        new = NewFile(self.part)
        try:
            try:
                with open(new.part, "xb") as file:
                    allocate(file.fileno(), 0, self._to_finish())
            except OSError as error:
                what = f"cannot be created: {error.strerror}; choose another place"
                raise AmiwarpError(f"{self.path}: {what}") from error
            with errors_name(self.path, lambda: "making the file"):
                self._file = h5py.File(new.part, "w", libver=("v110", "v110"))
                self._allocate()
                self._create_datasets()
                self._file.swmr_mode = True
                self._file.flush()
                try:
                    link_new(new.part, self.part)
                except FileExistsError as error:
                    raise self._part_exists() from error
        except BaseException:
            self._close()
            raise
        finally:
            new.discard()
        self._flushed_at = time.monotonic()
        return self

    def _part_exists(self) -> AmiwarpError:
        what = "is being written, or was left by an interrupted recording; it can be opened like any recording"
        return AmiwarpError(f"{self.part}: {what}; rename or delete this file")

    def _create_datasets(self) -> None:
        """Create all datasets, because none can be added in single-writer mode."""
        file = self._file
        write_header(file, self._size, self._camera, self._prism, self._metadata)
        dtypes: dict[str, Any] = {name: EVENTS[name] for name in "xypt"}
        if self._compensated:
            dtypes |= dict.fromkeys("xy", np.float32) | dict.fromkeys(FLAGS, np.uint8)
        self._columns = {
            f"events/{name}": make_dataset(file, f"events/{name}", dtype)
            for name, dtype in dtypes.items()
        }
        file["t_offset"] = np.int64(0)
        small: dict[str, Any] = {"ms_to_idx": np.int64}
        for name in self._names:
            small |= {
                f"{name}t": np.int64,
                f"{name}angle": np.float64,
                f"{name}index_t": np.int64,
            }
        for name, kind in small.items():
            dataset = file.create_dataset(
                name, shape=(0,), maxshape=(None,), chunks=(SMALL_CHUNK,), dtype=kind
            )
            self._small[name] = _GrowingDataset(dataset)
        file["encoder"].attrs["clock_offset_us"] = self._clock_offset_us

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        # Writing failed before, and the file is finished.
        if self._file is None:
            return
        is_empty = not len(self) and not self._spans
        if error is not None and is_empty:
            self._close()
            self.part.unlink()
            return
        self._finish(tidy=True)
        if error is not None:
            error.add_note(f"{self.path}: holds the {len(self)} events before the error")

    def append(
        self,
        events: Events,
        *,
        inside: ArrayLike | None = None,
        extrapolated: ArrayLike | None = None,
    ) -> None:
        """Append events. Compensated events need the flags ``inside`` and may have ``extrapolated``, shape ``(n,)``."""
        self._check_open("append")
        with errors_name(self.path, lambda: f"after {len(self)} events"):
            columns = self._as_columns(events, inside, extrapolated)
            checks.check_events(
                events,
                *self._size,
                where=str(self.path),
                first_index=len(self),
                allow_nan=self._compensated,
                after_t=self._t_last,
            )
            if len(events) and not len(self):
                self._file["t_offset"][()] = self._t_offset = int(events.t[0])
            columns["events/t"] = events.t
            start = 0
            while start < len(events):
                self._reserve()
                stop = min(start + CHUNK - self._pending_count, len(events))
                self._accept({name: column[start:stop] for name, column in columns.items()})
                start = stop
        self.tick()

    def _accept(self, columns: Columns) -> None:
        """Add events to the current chunk, and write it if it is full."""
        t = columns["events/t"]
        for entries in ms_entries(t, self._t_offset, self._next_ms, len(self)):
            self._small["ms_to_idx"].add(entries)
            self._next_ms += entries.size
        new = {**columns, "events/t": t - self._t_offset}
        self._pending = copied_into_chunk(self._pending, self._pending_count, new)
        self._pending_count += t.size
        self._t_last = int(t[-1])
        if self._pending_count == CHUNK:
            self._write()

    def append_encoder(
        self, t_us: ArrayLike, angle: ArrayLike, index_t_us: ArrayLike = (), *, second: bool = False
    ) -> None:
        """Append encoder samples: times on the events' clock [us], unwrapped angles [rad], and index pulses [us].

        ``second``: whether they are samples of the second encoder. Pulses before the first sample are dropped. Raises
        :class:`AmiwarpError` for samples that are not later than the samples before, or not finite.
        """
        self._check_open("append_encoder")
        name = self._names[1 if second else 0]
        offset = round(self._clock_offset_us)
        t = np.atleast_1d(as_times(t_us)) + offset
        angles = np.atleast_1d(np.array(angle, np.float64))
        if t.shape != angles.shape or t.ndim != 1 or not np.isfinite(angles).all():
            shapes = f"t {t.shape}, angle {angles.shape}"
            raise AmiwarpError(
                f"{self.path}: encoder samples have shapes {shapes}; expected one length and finite angles"
            )
        if t.size:
            self._accept_samples(name, t, angles)
        if name in self._spans:
            self._accept_pulses(name, as_times(index_t_us) + offset)
        if self._waiting_bytes() > MOST_WAITING:
            with errors_name(self.path, lambda: f"after {len(self)} events"):
                self._flush()
        self.tick()

    def _accept_samples(self, name: str, t: NDArray[np.int64], angles: NDArray[np.float64]) -> None:
        """Add samples of the encoder whose datasets' names begin with ``name``."""
        first, last = self._spans.get(name, (int(t[0]), int(t[0]) - 1))
        if t[0] <= last or (t[1:] <= t[:-1]).any():
            raise AmiwarpError(
                f"{self.path}: encoder samples {t[0]} .. {t[-1]} us do not follow {last} us; append samples in order "
                "of time"
            )
        self._reserve(2 * t.nbytes)
        self._small[f"{name}t"].add(t)
        self._small[f"{name}angle"].add(angles)
        self._spans[name] = first, int(t[-1])

    def _accept_pulses(self, name: str, pulses: NDArray[np.int64]) -> None:
        """Add index pulses [us] of an encoder within the time of its samples. Later pulses wait for their samples."""
        first, last = self._spans[name]
        pulses = np.append(self._early_pulses[name], pulses)
        self._small[f"{name}index_t"].add(pulses[(pulses >= first) & (pulses <= last)])
        self._early_pulses[name] = pulses[pulses > last][-MOST_PULSES:]

    def set_encoder(self, encoder: Encoder) -> None:
        """Set the encoder data that the finished file holds instead of the appended encoder samples.

        Raises :class:`AmiwarpError` outside the ``with`` block, and for another number of encoders than the writer has.
        """
        self._check_open("set_encoder")
        given = 1 if encoder.second is None else 2
        if given != len(self._names):
            raise AmiwarpError(
                f"{self.path}: the encoder has {given} prisms; make the writer with encoders={given}"
            )
        self._encoder = encoder

    def tick(self) -> None:
        """Flush if the flush interval has passed. Call this method while no events arrive."""
        if self._file is not None and time.monotonic() - self._flushed_at >= self._flush_s:
            with errors_name(self.path, lambda: f"after {len(self)} events"):
                self._flush()

    def _check_open(self, what: str) -> None:
        if self._file is None:
            given = f"{what}() was called outside the writer's 'with' block, or after it failed"
            raise AmiwarpError(f"{self.path}: {given}; use a new writer")

    def _as_columns(
        self, events: Events, inside: ArrayLike | None, extrapolated: ArrayLike | None
    ) -> Columns:
        if len(events) and events.x.dtype != self._columns["events/x"].dtype:
            wanted = self._columns["events/x"].dtype
            raise AmiwarpError(
                f"{self.path}: events come with {events.x.dtype} coordinates; expected {wanted}"
            )
        is_complete = (inside is not None) == self._compensated
        is_too_much = extrapolated is not None and not self._compensated
        if not is_complete or is_too_much:
            raise AmiwarpError(
                f"{self.path}: compensated events need the flags inside, events from a sensor take no flags"
            )
        if self._compensated and extrapolated is None:
            extrapolated = np.zeros(len(events), np.uint8)
        return event_columns(events, EventTruth(), inside=inside, extrapolated=extrapolated)

    def _to_finish(self) -> int:
        """Return the space that finishing the file may take [bytes]: one whole chunk and the waiting samples."""
        event_bytes = 19 if self._compensated else 13
        chunk_bytes = event_bytes * CHUNK
        return FINISH_BYTES + chunk_bytes + chunk_bytes // 64 + self._waiting_bytes()

    def _waiting_bytes(self) -> int:
        return sum(small.waiting_bytes for small in self._small.values())

    def _reserve(self, extra: int = 0) -> None:
        """Reserve disk space to finish the file, and ``extra`` bytes.

        If the disk is full, finish the file and raise :class:`AmiwarpError`.
        """
        try:
            self._allocate(extra)
        except OSError as error:
            self._finish(tidy=False)
            what = f"{error.strerror} after {len(self)} events, which the file holds"
            raise AmiwarpError(
                f"{self.path}: {what}; make room, or write to another disk", ErrorCode.DISK_FULL
            ) from error

    def _allocate(self, extra: int = 0) -> None:
        """Reserve disk space to finish the file, and ``extra`` bytes. Raises OSError if the disk is full."""
        end = self._file.id.get_filesize() + self._to_finish() + extra
        if end > self._reserved:
            allocate(self._file.id.get_vfd_handle(), self._reserved, end - self._reserved)
            self._reserved = end

    def _write(self) -> None:
        """Write the pending events of the current chunk. Start a new chunk if the chunk is full."""
        count = self._pending_count
        jobs = (partial(encode, column[:count]) for column in self._pending.values())
        with contextlib.closing(in_order(jobs)) as encoded:
            for name, stored in zip(self._pending, encoded, strict=True):
                append_chunk(self._columns[name], self._written, stored, count)
        self._stored = self._written + count
        if count == CHUNK:
            # One statement, so that Ctrl-C cannot come between the two.
            self._written, self._pending_count = self._stored, 0

    def _flush(self) -> None:
        if self._stored < len(self):
            self._write()
        for small in self._small.values():
            small.write()
        self._file.flush()
        self._flushed_at = time.monotonic()

    def _finish(self, *, tidy: bool) -> None:
        """Write the remaining data and rename the part file to ``path``.

        If the part file has many superseded chunks, it is copied to ``path`` without them instead.
        """

        def place() -> str:
            return f"finishing after {len(self)} events; {self.part} holds all but the last"

        with errors_name(self.path, place):
            self._drop_single_samples()
            if tidy and self._encoder is not None:
                self._replace_encoder(self._encoder)
            # The index ends with the number of events.
            self._small["ms_to_idx"].add(np.array([len(self)], np.int64))
            self._flush()
            used_bytes = self._used_bytes()
            self._close()

            # The reserved space is given back.
            with open(self.part, "r+b") as file:
                file.seek(END_ADDRESS_OFFSET)
                file.truncate(int.from_bytes(file.read(8), "little"))

            if tidy and os.path.getsize(self.part) > 2 * used_bytes + MAX_WASTE_BYTES:
                # If the disk is full, the part itself is renamed.
                with contextlib.suppress(AmiwarpError):
                    recording = open_hdf5(self.part, None, GivenLayout())
                    tidied = dataclasses.replace(recording, metadata=self._metadata)
                    save_recording(self.path, tidied, overwrite=self._overwrite)
                    self.part.unlink()
                    return
            put_in_place(self.part, self.path, overwrite=self._overwrite)

    def _drop_single_samples(self) -> None:
        """Drop an encoder's only sample, which gives no angle, and which readers refuse."""
        for name, (first, last) in self._spans.items():
            if first == last:
                for column in ("t", "angle"):
                    self._small[name + column].replace(np.zeros(0))

    def _used_bytes(self) -> int:
        """Return the size of the chunks that are not superseded [bytes]."""
        of_events = sum(int(column.id.get_storage_size()) for column in self._columns.values())
        return of_events + sum(small.stored_bytes for small in self._small.values())

    def _replace_encoder(self, encoder: Encoder) -> None:
        no_pulses = {f"{name}index_t": np.zeros(0, np.int64) for name in self._names}
        columns = no_pulses | encoder_columns(encoder)
        self._reserve(2 * sum(values.nbytes for values in columns.values()))
        self._file["encoder"].attrs["clock_offset_us"] = float(encoder.clock_offset_us)
        for name, values in columns.items():
            self._small[name].replace(values)

    def _close(self) -> None:
        file = self._file
        self._file = None
        self._columns = {}
        self._small = {}
        if file is not None:
            file.close()


class _GrowingDataset:
    """Small dataset whose new values wait in memory until they are written."""

    def __init__(self, dataset: Any) -> None:
        self._dataset = dataset
        self._waiting: list[NDArray[Any]] = []
        self._written = 0
        self.waiting_bytes = 0

    def add(self, values: NDArray[Any]) -> None:
        self._waiting.append(values)
        self.waiting_bytes += values.nbytes

    def replace(self, values: NDArray[Any]) -> None:
        self._waiting = [values]
        self._written = 0
        self.waiting_bytes = values.nbytes

    @property
    def stored_bytes(self) -> int:
        return int(self._dataset.id.get_storage_size())

    def write(self) -> None:
        if self._waiting:
            values = np.concatenate(self._waiting)
            end = self._written + values.size
            self._dataset.resize(end, axis=0)
            self._dataset[self._written : end] = values
            self._waiting = []
            self._written = end
            self.waiting_bytes = 0
