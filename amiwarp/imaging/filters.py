"""Filters of events: part of the time and the image, polarity, hot pixels, noise, refractory period, and rate."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.device_events import check_sensor
from amiwarp.events.other_sensors import ImageStore, ImuSamples
from amiwarp.events.recording import (
    Events,
    EventSource,
    MetadataValue,
    Recording,
    check_events,
)
from amiwarp.events.truth import EventTruth
from amiwarp.io import output_formats
from amiwarp.io.conversion import convert
from amiwarp.io.file_scan import RECORDS
from amiwarp.io.native.copying import copy_frames, copy_sensors_and_truth
from amiwarp.io.native.writer import RecordingWriter
from amiwarp.io.output_formats import OutputFormat
from amiwarp.io.outputs import check_output
from amiwarp.io.unfinished import scratch_folder
from amiwarp.kernels import event_filter as kernels
from amiwarp.kernels.background_activity import NEVER, mark_hot_pixels
from amiwarp.kernels.event_arrays import new_event_arrays
from amiwarp.kernels.launch import RecordedLaunch, launch
from amiwarp.kernels.quiet_start import start_once
from amiwarp.optics.camera import LARGEST_SIZE
from amiwarp.schema.calls import guarded
from amiwarp.tasks import Progress
from amiwarp.validation import TIME_LIMIT, real, vector, whole

CREDIT_S = 1e-3
"""Time without events that allows a burst, with a limited rate [s]."""


@guarded
@dataclass(frozen=True)
class EventFilter:
    """Choice of events. Its parts are applied in the order of the fields; each that is not given keeps all events.

    Raises
    ------
    AmiwarpError
        If a value is out of its range.

    Examples
    --------
    >>> events = amiwarp.Events.from_arrays(x=[3, 4, 9], y=[3, 3, 9], t=[0, 500, 900], p=[1, 1, 0])
    >>> kept = amiwarp.EventFilter(polarity=1).apply(events, (16, 16))
    >>> kept.x.tolist()
    [3, 4]
    """

    window: tuple[int, int] | None = None
    """Start and end of the kept time, on the events' clock [us]. The end is exclusive."""
    region: tuple[int, int, int, int] | None = None
    """Left, top, right and bottom of the kept part of the image [px]. Right and bottom are exclusive."""
    polarity: int | None = None
    """The kept polarity: 1 for ON, 0 for OFF."""
    hot_pixels: NDArray[np.bool_] | None = field(default=None, compare=False)
    """Pixels whose events are removed, shape ``(height, width)``, as :func:`find_hot_pixels` returns them."""
    refractory_us: int = 0
    """Time after a kept event in which further events of its pixel are removed [us], at most 1000 s."""
    background_us: int = 0
    """Events are removed as noise if none of the eight neighbours of their pixel fired within this time before [us], at
    most 1000 s. 0 keeps all. See :func:`find_background_activity`."""
    most_per_s: float = 0.0
    """Largest rate [events/s]: each kept event costs a credit that grows with time, up to a millisecond's. 0 keeps
    all."""
    every: int = 1
    """Of the events that are left, every n-th is kept, from the first one on."""

    def __post_init__(self) -> None:
        if self.window is not None:
            window = vector(self.window, 2, "window", _time)
            if not window[0] < window[1]:
                raise AmiwarpError(
                    f"window is {self.window}; give start and end [us], the end after the start"
                )
            object.__setattr__(self, "window", window)
        if self.region is not None:
            left, top, right, bottom = region = vector(self.region, 4, "region", _pixel)
            if not (left < right and top < bottom):
                raise AmiwarpError(
                    f"region is {self.region}; give left, top, right and bottom [px] of a part"
                )
            object.__setattr__(self, "region", region)
        if self.polarity is not None:
            object.__setattr__(self, "polarity", whole(self.polarity, "polarity", 0, 1))
        for name in ("refractory_us", "background_us"):
            time_us = whole(getattr(self, name), name, 0, kernels.LONGEST_US, " us")
            object.__setattr__(self, name, time_us)
        rate = real(self.most_per_s, "most_per_s", 0.0, 1e12, " events/s")
        object.__setattr__(self, "most_per_s", rate)
        object.__setattr__(self, "every", whole(self.every, "every", 1, 1 << 31))

    def apply(self, events: Events, size: tuple[int, int]) -> Events:
        """Return the events that are kept.

        Parameters
        ----------
        events : Events
            Events from a sensor, sorted by time.
        size : tuple of int
            Sensor size (width, height) [px].

        Returns
        -------
        Events
            The kept events, in new arrays.

        Raises
        ------
        AmiwarpError
            If the events are compensated, out of order or outside the sensor, or the size does not fit the filter.
        """
        return RunningFilter(self, size).kept(events)


@dataclass
class RunningFilter:
    """A filter of one stream of events, which arrive in blocks. Blocks of any length give the same events."""

    chosen: EventFilter
    """What is kept."""
    size: tuple[int, int]
    """Sensor size (width, height) [px]."""
    removed: dict[str, int] = field(init=False)
    """Number of events that each part of the filter has removed so far, by its name."""
    _state: Any = field(init=False)
    """What the kernel remembers of the events before."""
    _given: list[NDArray[Any]] = field(init=False)
    """Memory for the columns x, y, t and p of a block of events."""
    _kept: list[NDArray[Any]] = field(init=False)
    """Memory for the columns of its kept events."""
    _kept_count: NDArray[Any] = field(init=False)
    """Number of its kept events, of shape ``(1,)``."""
    _removed: NDArray[Any] = field(init=False)
    """Number of events that each part has removed, at its number in the kernel."""
    _removing: NDArray[Any] = field(init=False)
    """Memory for the part that removes each of its events."""
    _launch: RecordedLaunch = field(init=False)
    """Launch of the kernel over the first events of the block. A new launch would cost more than a packet."""
    _last_t: int | None = None
    """Time of the last event [us]."""

    def __post_init__(self) -> None:
        start_once()
        width, height = vector(self.size, 2, "size of the sensor", _side)
        self.size = width, height
        hot = self.chosen.hot_pixels
        if hot is not None and (
            np.shape(hot) != (height, width) or np.asarray(hot).dtype != np.bool_
        ):
            raise AmiwarpError(
                f"hot_pixels has shape {np.shape(hot)} and type {np.asarray(hot).dtype}; expected booleans of shape "
                f"({height}, {width}), as find_hot_pixels returns them"
            )
        region = self.chosen.region
        if region is not None and (region[2] > width or region[3] > height):
            raise AmiwarpError(
                f"region is {region}; expected a part of the image of {width}x{height} px"
            )
        self.removed = {name: 0 for name in PARTS if is_given(self.chosen, name)}
        self._state = _new_state(self.chosen, self.size)
        given, self._given = _new_columns()
        kept, self._kept = _new_columns()
        kept_count = wp.zeros(1, dtype=int, device="cpu")
        removing = wp.empty(BLOCK, dtype=wp.uint8, device="cpu")
        self._kept_count = kept_count.numpy()
        self._removing = removing.numpy()
        self._removed = self._state.removed.numpy()
        parts = _part_values(self.chosen, self.size)
        inputs = [parts, self._state, given, kept, kept_count, removing, 0]
        self._launch = RecordedLaunch(kernels.filter_events, inputs, [], device="cpu")

    def keep(self, events: Events) -> NDArray[np.bool_]:
        """Return which events are kept, where the events follow the events of the last call, bool, shape ``(n,)``."""
        keep = np.empty(len(events), np.bool_)
        for start, stop in self._blocks(events):
            keep[start:stop] = self._removing[: stop - start] == 0
        return keep

    def kept(self, events: Events) -> Events:
        """Return the events that are kept, as :meth:`keep` chooses them, in new arrays."""
        columns: list[NDArray[Any]] = [np.empty(len(events), kind) for kind in NUMPY_TYPES]
        end = 0
        for _ in self._blocks(events):
            count = int(self._kept_count[0])
            for column, block in zip(columns, self._kept, strict=True):
                column[end : end + count] = block[:count]
            end += count
        # Few kept events would hold the memory of all
        few = end < len(events) // 2
        return Events(*(column[:end].copy() if few else column[:end] for column in columns))

    def _blocks(self, events: Events) -> Iterator[tuple[int, int]]:
        """Yield start and end of each block of events, while the memory holds what the kernel found of it."""
        check_sensor(events)
        check_events(events, *self.size, where="events", after_t=self._last_t)
        if len(events):
            self._last_t = int(events.t[-1])
        given: list[NDArray[Any]] = [events.x, events.y, events.t, events.p]
        for start in range(0, len(events), BLOCK):
            stop = min(start + BLOCK, len(events))
            count = stop - start
            for block, column in zip(self._given, given, strict=True):
                block[:count] = column[start:stop]
            self._launch.set(COUNT, count)
            self._launch.repeat()
            for name in self.removed:
                self.removed[name] = int(self._removed[PARTS[name]])
            yield start, stop

    def hot_counts(self) -> tuple[tuple[int, int, int], ...]:
        """Return column, row [px] and number of removed events of each hot pixel, the busiest first."""
        width, _ = self.size
        all_counts = self._state.hot_counts.numpy()
        pixels = np.flatnonzero(all_counts)
        counts = all_counts[pixels]
        busiest_first = np.argsort(-counts, kind="stable")
        hot = np.stack([pixels % width, pixels // width, counts], axis=1)[busiest_first]
        return tuple((column, row, count) for column, row, count in hot.tolist())


BLOCK = 1 << 14
"""Largest number of events that the kernel filters at a time. They stay in a core's cache."""
TILE = 4
"""Side of the tiles of the image of times [px]: one fills a line of the cache."""
LINE_BYTES = 64
"""Size of a line of the cache [bytes]."""
LARGE_BYTES = 1 << 22
"""Smallest array for which NumPy asks for large pages [bytes]."""
NUMPY_TYPES = (np.uint16, np.uint16, np.int64, np.uint8)
"""Types of the columns x, y, t, p."""
COUNT = 6
"""Place of the number of events among the arguments of the kernel."""


def _new_columns() -> tuple[Any, list[NDArray[Any]]]:
    """Return memory for a block of events: for the kernel, and its columns x, y, t and p."""
    columns = new_event_arrays(BLOCK, "cpu")
    return columns, [columns.x.numpy(), columns.y.numpy(), columns.t.numpy(), columns.p.numpy()]


def _part_values(chosen: EventFilter, size: tuple[int, int]) -> Any:
    """Return the values of a filter's parts for the kernel. Parts that are not given keep all events."""
    width, height = size
    parts = kernels.FilterParts()
    parts.columns = width
    parts.start, parts.end = chosen.window or (-(2**63), 2**63 - 1)
    parts.left, parts.top, parts.right, parts.bottom = chosen.region or (0, 0, width, height)
    parts.polarity = -1 if chosen.polarity is None else chosen.polarity
    hot = np.zeros(0, np.uint8)
    if chosen.hot_pixels is not None:
        hot = np.packbits(chosen.hot_pixels.ravel(), bitorder="little")
    parts.hot = wp.array(hot, dtype=wp.uint8, device="cpu")
    parts.refractory_us = chosen.refractory_us
    parts.background_us = chosen.background_us
    parts.rate_per_us = 1e-6 * chosen.most_per_s
    parts.most_credit = _most_credit(chosen)
    parts.every = chosen.every
    return parts


def _new_state(chosen: EventFilter, size: tuple[int, int]) -> Any:
    """Return what the kernel remembers before the first event. Parts that are not given need no memory."""
    width, height = size
    pixels = width * height
    state = kernels.FilterState()
    state.base_t = _times(-TIME_LIMIT)
    has_times = chosen.refractory_us or chosen.background_us
    if has_times:
        state.across, state.down, count = _tiled(width + 2, height + 2)
        state.passed_t = _aligned(count)
        state.passed_t.fill_(kernels.LONG_AGO)
    state.removed = wp.zeros(len(PARTS) + 1, dtype=wp.int64, device="cpu")
    has_hot = chosen.hot_pixels is not None
    state.hot_counts = wp.zeros(pixels if has_hot else 0, dtype=wp.int64, device="cpu")
    state.credit = wp.full(1, _most_credit(chosen), dtype=wp.float64, device="cpu")
    state.rate_t = _times(NEVER)
    state.reached = wp.zeros(1, dtype=wp.int64, device="cpu")
    return state


def _times(value: int) -> wp.array:
    """Return an array of one time [us]."""
    return wp.full(1, wp.int64(value), dtype=wp.int64, device="cpu")


def _tiled(columns: int, rows: int) -> tuple[wp.array, wp.array, int]:
    """Return what column and row add to a pixel's place in an image of tiles, and the number of places."""
    column = np.arange(columns)
    row = np.arange(rows)
    row_of_tiles = -(-columns // TILE) * TILE * TILE
    across = column // TILE * TILE * TILE + column % TILE
    down = row // TILE * row_of_tiles + row % TILE * TILE
    count = -(-rows // TILE) * row_of_tiles
    arrays = (wp.array(places, dtype=int, device="cpu") for places in (across, down))
    return *arrays, count


def _aligned(count: int) -> wp.array:
    """Return memory for integers of 32 bits that begins with a line of the cache.

    NumPy asks the system for large pages from 4 MiB on. With small ones, addresses are often looked up for longer than
    the times.
    """
    memory = np.empty(max(count, LARGE_BYTES // 4) + LINE_BYTES // 4, np.int32)
    first = -memory.ctypes.data % LINE_BYTES // 4
    return wp.array(memory[first : first + count], dtype=int, device="cpu", copy=False)


def _most_credit(chosen: EventFilter) -> float:
    """Return the number of events that may follow at once after a pause, with a limited rate."""
    return max(1.0, chosen.most_per_s * CREDIT_S)


PARTS = {
    "window": int(kernels.WINDOW),
    "region": int(kernels.REGION),
    "polarity": int(kernels.POLARITY),
    "hot_pixels": int(kernels.HOT_PIXELS),
    "refractory_us": int(kernels.REFRACTORY),
    "background_us": int(kernels.BACKGROUND),
    "most_per_s": int(kernels.RATE),
    "every": int(kernels.EVERY),
}
"""Numbers of a filter's parts in the kernel, by the fields of :class:`EventFilter`, in the order of the parts."""
NAMES = {
    "window": "time",
    "region": "region",
    "polarity": "polarity",
    "hot_pixels": "hot pixels",
    "refractory_us": "refractory period",
    "background_us": "background activity",
    "most_per_s": "rate",
    "every": "every n-th",
}
"""Names of the parts, for people."""


def described(chosen: EventFilter) -> str:
    """Return the parts of a filter as text, for the metadata of a recording."""
    texts = []
    for name in PARTS:
        value = getattr(chosen, name)
        if name == "hot_pixels" and value is not None:
            texts.append(f"hot_pixels {np.count_nonzero(value)}")
        elif is_given(chosen, name):
            texts.append(f"{name} {value}")
    return "; ".join(texts)


def is_given(chosen: EventFilter, name: str) -> bool:
    """Return whether a part of a filter may remove events."""
    value = getattr(chosen, name)
    if value is None:
        return False
    if name != "polarity" and isinstance(value, int | float):
        return bool(value != NOTHING[name])
    return True


NOTHING = {option.name: option.default for option in fields(EventFilter)}
"""Values with which the parts of a filter keep all events."""


def _time(value: object, what: str) -> int:
    return whole(value, what, -TIME_LIMIT, TIME_LIMIT, " us")


def _pixel(value: object, what: str) -> int:
    return whole(value, what, 0, LARGEST_SIZE, " px")


def _side(value: object, what: str) -> int:
    return whole(value, what, 1, LARGEST_SIZE, " px")


@guarded
def find_hot_pixels(events: Events | EventSource, size: tuple[int, int]) -> NDArray[np.bool_]:
    """Find pixels that fire far more often than the pixels around them.

    Parameters
    ----------
    events : Events or EventSource
        Events from a sensor, some seconds or more.
    size : tuple of int
        Sensor size (width, height) [px].

    Returns
    -------
    ndarray
        Whether each pixel is hot, bool, shape ``(height, width)``.

    Raises
    ------
    AmiwarpError
        If the events are compensated or outside the sensor.

    Notes
    -----
    A pixel with n events is hot if n > 3 m + 5 √m + 8, with m events of the second busiest of the other pixels of the
    5 x 5 around it. So a thin edge that stays at one place for long is not hot. A lamp of one or two pixels is.

    Examples
    --------
    >>> import numpy as np
    >>> events = amiwarp.Events.from_arrays(x=[5] * 50, y=[4] * 50, t=np.arange(50) * 1000, p=[1] * 50)
    >>> np.argwhere(amiwarp.find_hot_pixels(events, (16, 12))).tolist()
    [[4, 5]]
    """
    start_once()
    width, height = vector(size, 2, "size of the sensor", _side)
    count = np.zeros(height * width, np.int32)
    for block in [events] if isinstance(events, Events) else events.blocks():
        check_sensor(block)
        check_events(block, width, height, where="events")
        pixel = block.y.astype(np.int64) * width + block.x
        count += np.bincount(pixel, minlength=height * width).astype(np.int32)
    hot = wp.empty(height * width, dtype=wp.bool, device="cpu")
    counts = wp.array(count.reshape(height, width), device="cpu")
    launch(mark_hot_pixels, height * width, [counts], [hot], device="cpu")
    return np.asarray(hot.numpy().reshape(height, width), np.bool_)


@dataclass(frozen=True)
class FilterSummary:
    """What :func:`filter_recording` did."""

    events: int
    """Number of events of the input."""
    kept: int
    """Number of events of the output."""
    removed: dict[str, int]
    """Number of events that each part of the filter removed, in the order in which the parts were applied."""
    hot_pixels: tuple[tuple[int, int, int], ...]
    """Column, row [px] and number of events of each removed hot pixel, the busiest first."""
    duration_us: int
    """Time from the first to the last event of the input [us]."""
    kept_us: int
    """Time from the first to the last event of the output [us]."""
    left_out: tuple[str, ...]
    """What the format of the output cannot hold."""
    removed_records: dict[str, int]
    """Number of IMU samples and frames outside the window, by name; empty without a window."""
    subtracted_us: int = 0
    """Time that was subtracted from all events [us]: in a ROS 2 bag the first event, if the last is later than 28 h."""


@guarded
def filter_recording(
    recording: Recording,
    out_path: str | os.PathLike[str],
    chosen: EventFilter,
    *,
    format: OutputFormat | str | None = None,
    progress: Progress | None = None,
    overwrite: bool = False,
) -> FilterSummary:
    """Write the events of a recording that a filter keeps, in constant memory.

    In amiwarp's format, encoder, camera, prism, ground truth, IMU samples and frames are kept; of IMU samples and
    frames, those within the window.

    Parameters
    ----------
    recording : Recording
        The recording, in memory or opened with :func:`open_recording`.
    out_path : str or path-like
        The file to write. Its extension gives the format, see :class:`OutputFormat`.
    chosen : EventFilter
        Which events are kept.
    format : OutputFormat or str, optional
        The format to write, if not the extension's.
    progress : callable, optional
        Called with the name of the step and the finished fraction of the task, 0 to 1.
    overwrite : bool, default False
        Whether an existing output may be replaced.

    Returns
    -------
    FilterSummary
        Numbers of events before and after.

    Raises
    ------
    AmiwarpError
        If no event is kept, or the output cannot be written. Then no output remains.

    Examples
    --------
    >>> events = amiwarp.Events.from_arrays(x=[1, 2, 2], y=[0, 0, 0], t=[0, 10, 20], p=[1, 0, 1])
    >>> recording = amiwarp.Recording(amiwarp.MemoryEvents(events, width=4, height=4))
    >>> amiwarp.filter_recording(recording, "calm.h5", amiwarp.EventFilter(refractory_us=15)).removed
    {'refractory_us': 1}
    """
    out_path = Path(out_path)
    check_output(out_path, overwrite=overwrite)
    output = output_formats.output_format(out_path, format)
    if output is OutputFormat.NATIVE:
        return _write_kept(recording, out_path, chosen, progress, overwrite)
    # Other formats are converted from amiwarp's.
    with scratch_folder(out_path.parent) as folder:
        summary = _write_kept(recording, folder / "kept.h5", chosen, progress, False)
        written = convert(
            folder / "kept.h5", out_path, format=output, progress=progress, overwrite=overwrite
        )
    left_out = tuple(dict.fromkeys((*written.left_out, *summary.left_out)))
    return replace(summary, left_out=left_out, subtracted_us=written.subtracted_us)


def _write_kept(
    recording: Recording,
    path: Path,
    chosen: EventFilter,
    progress: Progress | None,
    overwrite: bool,
) -> FilterSummary:
    """Write the kept events in amiwarp's format, with everything else that the recording holds."""
    source = recording.events
    truth = recording.truth
    records = _records_within(recording, chosen.window)
    filters_before = [str(records.metadata["filter"])] if "filter" in records.metadata else []
    filters = "; then ".join([*filters_before, described(chosen)])
    running = RunningFilter(chosen, source.size)
    width, height = source.size
    with RecordingWriter(
        path,
        width=width,
        height=height,
        camera=recording.camera,
        prism=recording.prism,
        encoder=recording.encoder,
        metadata={**records.metadata, "filter": filters},
        overwrite=overwrite,
        truth_parameters=None if truth is None else truth.parameters,
        truth_labels=None if truth is None else truth.labels,
    ) as writer:
        kept_us = _write_kept_events(recording, running, writer, progress)
        copy_sensors_and_truth(replace(recording, imu=records.imu), writer)
        copy_frames(records.frames, records.depth, writer)
        kept = len(writer)
    return FilterSummary(
        events=len(source),
        kept=kept,
        removed=dict(running.removed),
        hot_pixels=running.hot_counts(),
        duration_us=source.t_last - source.t_first,
        kept_us=kept_us,
        left_out=records.left_out,
        removed_records=records.removed,
    )


def _write_kept_events(
    recording: Recording,
    running: RunningFilter,
    writer: RecordingWriter,
    progress: Progress | None,
) -> int:
    """Write the kept events with their ground truth. Return the time from the first to the last of them [us].

    Raises :class:`AmiwarpError` if there are none.
    """
    source = recording.events
    truth = recording.truth
    t_first: int | None = None
    t_last = 0
    start = 0
    for block in source.blocks():
        stop = start + len(block)
        is_kept = running.keep(block)
        kept = block[is_kept]
        if len(kept):
            of_block = None if truth is None else truth.of_events(start, stop)
            of_kept = None if of_block is None else _truth_of_kept(of_block, is_kept)
            writer.append(kept, truth=of_kept)
            t_last = int(kept.t[-1])
            if t_first is None:
                t_first = int(kept.t[0])
        start = stop
        if progress is not None:
            progress("filtering events", start / len(source))
    if t_first is None:
        raise AmiwarpError(
            f"{recording.name}: the filter keeps none of {len(source):,} events; choose less strict values"
        )
    return t_last - t_first


@dataclass(frozen=True)
class _Records:
    """Records of a recording beside its events that a filter keeps."""

    imu: ImuSamples | None
    """IMU samples."""
    frames: ImageStore | None
    """Frames."""
    depth: ImageStore | None
    """Depth maps."""
    metadata: dict[str, MetadataValue]
    """Metadata, with the numbers of the kept records."""
    removed: dict[str, int]
    """Number of removed records by name; empty without a window."""
    left_out: tuple[str, ...]
    """What is lost, because it is not known which of it lie in the window."""


def _records_within(recording: Recording, window: tuple[int, int] | None) -> _Records:
    """Return the records of a recording within a time window [us], whose end is exclusive; all without a window."""
    metadata = {name: value for name, value in recording.metadata.items() if name != "format"}
    if window is None:
        return _Records(recording.imu, recording.frames, recording.depth, metadata, {}, ())
    imu = _imu_within(recording.imu, window)
    frames = _frames_within(recording.frames, window)
    depth = _frames_within(recording.depth, window)

    # The counts in the metadata are of the whole recording. How many triggers the window has is not known.
    left_out: tuple[str, ...] = ()
    if metadata.get("triggers") and recording.encoder is None:
        left_out = ("triggers",)
    metadata = {name: value for name, value in metadata.items() if name not in RECORDS}
    removed = {}
    for name, before, kept in (
        ("imu_samples", recording.imu, imu),
        ("frames", recording.frames, frames),
        ("depth_maps", recording.depth, depth),
    ):
        if before is not None:
            removed[name] = len(before) - len(kept or ())
        if kept is not None:
            metadata[name] = len(kept)
    return _Records(imu, frames, depth, metadata, removed, left_out)


def _imu_within(imu: ImuSamples | None, window: tuple[int, int]) -> ImuSamples | None:
    """Return the IMU samples within a time window [us], whose end is exclusive; None if there are none."""
    if imu is None:
        return None
    start, stop = np.searchsorted(imu.t, window).tolist()
    if start == stop:
        return None
    return ImuSamples(
        imu.t[start:stop],
        imu.angular_velocity[start:stop],
        imu.acceleration[start:stop],
        imu.to_camera,
    )


def _frames_within(frames: ImageStore | None, window: tuple[int, int]) -> ImageStore | None:
    """Return the frames within a time window [us], whose end is exclusive; None if there are none."""
    if frames is None:
        return None
    start, stop = np.searchsorted(frames.t, window).tolist()
    if start == stop:
        return None
    # A slice of frames has a size and exposures, too.
    return cast(ImageStore, frames[start:stop])


def _truth_of_kept(truth: EventTruth, is_kept: NDArray[np.bool_]) -> EventTruth:
    """Return the ground truth of the kept events."""
    kept = {}
    for field_of_truth in fields(truth):
        values = getattr(truth, field_of_truth.name)
        kept[field_of_truth.name] = None if values is None else values[is_kept]
    return EventTruth(**kept)
