"""Writing a native recording that grows: readable at any moment, and all but its last second whatever ends its writer.

HDF5's single-writer mode orders what reaches the file so that it is sound after every write. The last chunk, which is
not full, is written anew with each flush, to another place: what a reader, or the file left by a crash, refers to
stays. HDF5 does not survive a full disk: room to finish the file is taken before any event is.
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
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.encoder import Encoder
from amiwarp.events.events import Events, as_times, check_events
from amiwarp.events.recording import MetadataValue
from amiwarp.io.chunks import CHUNK, append_chunk, encode, in_order
from amiwarp.io.files import errors_name
from amiwarp.io.native import open_native
from amiwarp.io.native_writer import (
    Columns,
    check_frame,
    check_lengths,
    make_dataset,
    ms_entries,
    save_recording,
    write_header,
)
from amiwarp.io.output import allocate, check_output, put_in_place
from amiwarp.optics.camera import Camera

if TYPE_CHECKING:
    from amiwarp.optics.prism import NominalPrism

SMALL_CHUNK = 4096
"""Elements of a chunk of the small datasets: stored plain, so that they grow in place."""

END_AT = 28
"""Where the beginning of an HDF5 file of this kind tells its end: what is beyond was taken and not used."""

SPARE = 1 << 19
"""Bytes that finishing a file takes beyond its data: for HDF5's own use, and for chunks that are not full."""

MOST_WAITING = 1 << 24
"""Bytes of encoder samples that wait for the next flush; more of them are written at once."""

MOST_PULSES = 1 << 16
"""Index pulses that wait for the encoder's samples; of more the last ones are kept."""

WASTE = 1 << 24
"""Bytes of chunks written anew that are left in a finished file in any case; a copy without them would gain little."""


class LiveWriter:
    """Streams a recording into ``NAME.part.h5`` beside ``path``, which takes the place of ``path`` at the end.

    So it does at any end: after an exception what was appended is kept as well, and when the disk is full; the error
    tells how much. ``compensated`` recordings hold float32 coordinates and flags. Every ``flush_s`` [s] all is in the
    file, if :meth:`append` or :meth:`tick` is called as often. For one thread.
    Raises :class:`AmiwarpError` for a path that cannot be written or exists (unless ``overwrite``), a part left over
    from before, and for events that are unsorted or out of the frame; the recording can go on after these.
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
        clock_offset_us: float = 0.0,
        flush_s: float = 0.5,
        overwrite: bool = False,
    ) -> None:
        """``clock_offset_us``: of the encoder that is written, see :class:`Encoder`; its samples are moved by it."""
        self.path, self._overwrite = Path(path), overwrite
        check_frame(self.path, width, height, camera)
        self.part = self.path.resolve().with_name(f"{self.path.stem}.part.h5")
        self._size = (int(width), int(height))
        self._camera, self._prism, self._metadata = camera, prism, dict(metadata or {})
        self._compensated, self._flush_s, self._clock_offset_us = compensated, flush_s, clock_offset_us
        self._file: Any = None
        self._columns: dict[str, Any] = {}
        self._small: dict[str, _Growing] = {}
        self._pending: list[Columns] = []
        self._pending_count = 0
        self._written = 0
        self._stored = 0
        self._flushed_at = 0.0
        self._reserved = 0
        self._t_offset = 0
        self._t_last: int | None = None
        self._next_ms = 0
        self._encoder_span: tuple[int, int] | None = None  # first and last sample
        self._pulses = np.zeros(0, np.int64)  # later than the last sample
        self._encoder: Encoder | None = None

    def __len__(self) -> int:
        return self._written + self._pending_count

    def __enter__(self) -> LiveWriter:
        import h5py

        check_output(self.path, overwrite=self._overwrite)
        try:
            with open(self.part, "xb") as file:
                allocate(file.fileno(), 0, self._to_finish())
        except FileExistsError as error:
            what = "is being written, or was left by a recording that was cut off; it opens like any other"
            raise AmiwarpError(f"{self.part}: {what}: rename or delete it") from error
        except OSError as error:
            self.part.unlink(missing_ok=True)
            raise AmiwarpError(f"{self.path}: cannot be begun: {error.strerror}; choose another place") from error
        try:
            with errors_name(self.path, lambda: "making the file"):
                self._file = h5py.File(self.part, "w", libver=("v110", "v110"))
                self._reserve()
                self._make()
                self._file.swmr_mode = True
        except BaseException:
            self._close()
            self.part.unlink(missing_ok=True)
            raise
        self._flushed_at = time.monotonic()
        return self

    def _make(self) -> None:
        """All there will be: in single-writer mode nothing can be added."""
        file, place = self._file, np.float32 if self._compensated else np.uint16
        write_header(file, self._size, self._camera, self._prism, self._metadata)
        dtypes = {"x": place, "y": place, "p": np.uint8, "t": np.int64}
        if self._compensated:
            dtypes |= {"inside": np.uint8, "extrapolated": np.uint8}
        self._columns = {
            f"events/{name}": make_dataset(file, f"events/{name}", dtype) for name, dtype in dtypes.items()
        }
        file["t_offset"] = np.int64(0)
        small = {"ms_to_idx": np.int64, "encoder/t": np.int64, "encoder/angle": np.float64, "encoder/index_t": np.int64}
        for name, kind in small.items():
            dataset = file.create_dataset(name, shape=(0,), maxshape=(None,), chunks=(SMALL_CHUNK,), dtype=kind)
            self._small[name] = _Growing(dataset)
        file["encoder"].attrs["clock_offset_us"] = self._clock_offset_us

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._file is None:  # it could not be written any further
            return
        self._finish(tidy=True)
        if error is not None:
            error.add_note(f"{self.path}: holds the {len(self)} events up to then")

    def append(self, events: Events, *, inside: ArrayLike | None = None, extrapolated: ArrayLike | None = None) -> None:
        """Add events; compensated ones with flags ``(n,)``: whether on the picture, by an angle beyond the samples."""
        self._check_open("append")
        with errors_name(self.path, lambda: f"after {len(self)} events"):
            columns = self._as_columns(events, inside, extrapolated)
            check_events(events, *self._size, where=str(self.path), first_index=len(self), allow_nan=self._compensated,
                         after_t=self._t_last)  # fmt: skip
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
        """Take events of one chunk, and write it if they fill it."""
        t = columns["events/t"]
        for entries in ms_entries(t, self._t_offset, self._next_ms, len(self)):
            self._small["ms_to_idx"].add(entries)
            self._next_ms += entries.size
        self._pending.append({**columns, "events/t": t - self._t_offset})
        self._pending_count += t.size
        self._t_last = int(t[-1])
        if self._pending_count == CHUNK:
            self._write()

    def append_encoder(self, t_us: ArrayLike, angle: ArrayLike, index_t_us: ArrayLike = ()) -> None:
        """Add encoder samples on the events' clock [us], angles unwrapped [rad], and times of index pulses [us].

        Pulses before the first sample are left out. Raises :class:`AmiwarpError` for samples that are not later than
        those before, or not finite.
        """
        self._check_open("append_encoder")
        late = round(self._clock_offset_us)
        t, angles = np.atleast_1d(as_times(t_us)) + late, np.atleast_1d(np.asarray(angle, np.float64))
        if t.shape != angles.shape or t.ndim != 1 or not np.isfinite(angles).all():
            shapes = f"t {t.shape}, angle {angles.shape}"
            raise AmiwarpError(f"{self.path}: encoder samples {shapes}; expected one length and finite angles")
        if t.size:
            first, last = self._encoder_span or (int(t[0]), int(t[0]) - 1)
            if t[0] <= last or (t[1:] <= t[:-1]).any():
                raise AmiwarpError(f"{self.path}: encoder samples {t[0]} .. {t[-1]} us do not follow {last} us")
            self._reserve(2 * t.nbytes)
            self._small["encoder/t"].add(t)
            self._small["encoder/angle"].add(angles)
            self._encoder_span = first, int(t[-1])
        if self._encoder_span is not None:
            first, last = self._encoder_span
            pulses = np.append(self._pulses, as_times(index_t_us) + late)
            self._small["encoder/index_t"].add(pulses[(pulses >= first) & (pulses <= last)])
            self._pulses = pulses[pulses > last][-MOST_PULSES:]
        if sum(small.waiting_bytes for small in self._small.values()) > MOST_WAITING:
            with errors_name(self.path, lambda: f"after {len(self)} events"):
                self._flush()
        self.tick()

    def set_encoder(self, encoder: Encoder) -> None:
        """The encoder that takes the place of all appended samples at the end."""
        self._encoder = encoder

    def tick(self) -> None:
        """Write what came, if it is time to: for moments in which nothing is appended."""
        if self._file is not None and time.monotonic() - self._flushed_at >= self._flush_s:
            with errors_name(self.path, lambda: f"after {len(self)} events"):
                self._flush()

    def _check_open(self, what: str) -> None:
        if self._file is None:
            raise AmiwarpError(f"{self.path}: {what} outside the writer's with block, or after it failed")

    def _as_columns(self, events: Events, inside: ArrayLike | None, extrapolated: ArrayLike | None) -> Columns:
        if len(events) and events.x.dtype != self._columns["events/x"].dtype:
            wanted = self._columns["events/x"].dtype
            raise AmiwarpError(f"{self.path}: events come with {events.x.dtype}, it was opened for {wanted}")
        if (inside is not None) != self._compensated or (extrapolated is not None and not self._compensated):
            raise AmiwarpError(f"{self.path}: compensated events come with inside, a sensor's with neither flag")
        columns: Columns = {"events/x": events.x, "events/y": events.y, "events/p": events.p}
        if self._compensated:
            columns["events/inside"] = np.asarray(inside).astype(np.uint8)
            flags = np.zeros(len(events)) if extrapolated is None else np.asarray(extrapolated)
            columns["events/extrapolated"] = flags.astype(np.uint8)
        check_lengths(columns, len(events))
        return columns

    def _to_finish(self) -> int:
        """Bytes that the file may take before it is finished: a whole chunk, and what waits."""
        event = 19 if self._compensated else 13
        return SPARE + event * CHUNK + event * CHUNK // 64 + sum(small.waiting_bytes for small in self._small.values())

    def _reserve(self, extra: int = 0) -> None:
        """Take room to finish with ``extra`` bytes more; without it the file is finished, and an error raised."""
        end = self._file.id.get_filesize() + self._to_finish() + extra
        if end <= self._reserved:
            return
        try:
            allocate(self._file.id.get_vfd_handle(), self._reserved, end - self._reserved)
        except OSError as error:
            self._finish(tidy=False)
            what = f"{error.strerror} after {len(self)} events; it holds these"
            raise AmiwarpError(f"{self.path}: {what}; make room, or write to another disk") from error
        self._reserved = end

    def _write(self) -> None:
        """Write the pending events, from their chunk's beginning; a whole chunk is done with then."""
        count = self._pending_count
        joined = {name: np.concatenate([part[name] for part in self._pending]) for name in self._pending[0]}
        with contextlib.closing(in_order(partial(encode, column[:count]) for column in joined.values())) as encoded:
            for name, stored in zip(joined, encoded, strict=True):
                append_chunk(self._columns[name], self._written, stored, count)
        # In one go: Ctrl-C comes before or after it.
        if count == CHUNK:
            self._written, self._pending, self._pending_count = self._written + count, [], 0
        self._pending = [joined] if self._pending_count else []
        self._stored = len(self)

    def _flush(self) -> None:
        if self._stored < len(self):
            self._write()
        for small in self._small.values():
            small.write()
        self._file.flush()
        self._flushed_at = time.monotonic()

    def _finish(self, *, tidy: bool) -> None:
        """Write the rest; the part becomes ``path``, or does a copy without what was written anew, if that is much."""
        with errors_name(self.path, lambda: f"finishing after {len(self)} events; {self.part} holds all but the last"):
            if tidy and self._encoder is not None:
                self._replace_encoder(self._encoder)
            self._small["ms_to_idx"].add(np.array([len(self)], np.int64))
            self._flush()
            stored = sum(int(dataset.id.get_storage_size()) for dataset in self._columns.values())
            stored += sum(small.stored_bytes for small in self._small.values())
            self._close()
            with open(self.part, "r+b") as file:
                file.seek(END_AT)
                file.truncate(int.from_bytes(file.read(8), "little"))
            if tidy and os.path.getsize(self.part) > 2 * stored + WASTE:
                with contextlib.suppress(AmiwarpError):  # of a full disk: the part will do
                    tidied = dataclasses.replace(open_native(self.part), metadata=self._metadata)
                    save_recording(self.path, tidied, overwrite=self._overwrite)
                    self.part.unlink()
                    return
            put_in_place(self.part, self.path, overwrite=self._overwrite)

    def _replace_encoder(self, encoder: Encoder) -> None:
        self._reserve(2 * (encoder.t.nbytes + encoder.angle.nbytes))
        self._file["encoder"].attrs["clock_offset_us"] = float(encoder.clock_offset_us)
        for name in ("t", "angle", "index_t"):
            values = getattr(encoder, name)
            self._small[f"encoder/{name}"].replace(np.zeros(0, np.int64) if values is None else values)

    def _close(self) -> None:
        file, self._file = self._file, None
        self._columns, self._small = {}, {}
        if file is not None:
            file.close()


class _Growing:
    """A small dataset; values wait in memory until it is written."""

    def __init__(self, dataset: Any) -> None:
        self._dataset = dataset
        self._waiting: list[NDArray[Any]] = []
        self._written = 0
        self.waiting_bytes = 0

    def add(self, values: NDArray[Any]) -> None:
        self._waiting.append(values)
        self.waiting_bytes += values.nbytes

    def replace(self, values: NDArray[Any]) -> None:
        self._dataset.resize(0, axis=0)
        self._waiting, self._written, self.waiting_bytes = [values], 0, values.nbytes

    @property
    def stored_bytes(self) -> int:
        return int(self._dataset.id.get_storage_size())

    def write(self) -> None:
        if self._waiting:
            values = np.concatenate(self._waiting)
            end = self._written + values.size
            self._dataset.resize(end, axis=0)
            self._dataset[self._written : end] = values
            self._waiting, self._written, self.waiting_bytes = [], end, 0
