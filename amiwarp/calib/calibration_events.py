"""Events of a calibration: thinned, with the encoder that gives their angles, and uploaded to a device."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import wait
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from types import TracebackType
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.calib.parameters import MOTION
from amiwarp.calib.settings import Settings
from amiwarp.events.device_events import NAMES, DeviceEvents
from amiwarp.events.encoder import Encoder
from amiwarp.events.recording import Events, MemoryEvents, Recording
from amiwarp.imaging.iwe import UploadedEvents, upload_events
from amiwarp.kernels.launch import pool
from amiwarp.tasks import no_garbage_collection

SlopeOf = Callable[[NDArray[np.int64]], NDArray[np.float64]]


# Events of a calibration with the encoder that gives their prism angles.


@dataclass(frozen=True)
class CalibrationEvents:
    """Events with their encoder, uploaded to a device on first use."""

    events: Events
    """The events in the order of time."""
    encoder: Encoder
    """The encoder that gives their prism angles."""
    slope_of: SlopeOf | None
    """Function that returns the change of the prism angle at given times [us] per unit of a free clock offset or rpm;
    None if neither is free."""
    fold: int = 0
    """Number of angle bins per turn into which a pixel's events are merged; 0: events are not merged."""
    every_of: tuple[CalibrationEvents, int] | None = None
    """Events of which these are every n-th, and n; None if these are all events."""
    _uploaded: dict[tuple[str, int | None], UploadedEvents] = field(default_factory=dict, repr=False, init=False)

    def on(self, device: Any, middle_us: int | None) -> UploadedEvents:
        """Return the events on a device, uploaded once; with times relative to ``middle_us`` if it is given."""
        key = str(device), middle_us
        if key not in self._uploaded:
            self._uploaded[key] = self._every_uploaded(key) or self._upload(device, middle_us)
        return self._uploaded[key]

    def _every_uploaded(self, key: tuple[str, int | None]) -> UploadedEvents | None:
        """Return these events from the ones on the device of which they are a part; None if they are not there."""
        if self.every_of is None or self.fold:
            return None
        all_events, step = self.every_of
        return all_events._uploaded[key].every(step) if key in all_events._uploaded else None

    def _upload(self, device: Any, middle_us: int | None) -> UploadedEvents:
        slope = None if self.slope_of is None else self.slope_of(self.events.t)
        return upload_events(self.events, self.encoder, device, slope=slope, middle_us=middle_us, fold=self.fold)

    def every(self, step: int) -> CalibrationEvents:
        """Return every ``step``-th event, with the same encoder."""
        return self if step == 1 else replace(self._cut(slice(0, None, step)), every_of=(self, step))

    def central(self, share: float) -> CalibrationEvents:
        """Return the events in the central ``share`` of the duration."""
        t = self.events.t
        middle, half = (int(t[0]) + int(t[-1])) / 2.0, share * (int(t[-1]) - int(t[0])) / 2.0
        first, last = np.searchsorted(t, [middle - half, middle + half])
        return self._cut(slice(int(first), int(last) + 1))

    def _cut(self, cut: slice) -> CalibrationEvents:
        return CalibrationEvents(self.events[cut], self.encoder, self.slope_of, self.fold)


# Choice of the events of a recording: a window about its middle, and even thinning.

ROTATION_WINDOW_TURNS, ROTATION_WINDOW_US = 2.1, 100_000.0
"""Length of the part of a recording that is used if the camera's rotation is free: in turns, or without a prism in
microseconds."""
RUN = 8
"""Number of consecutive events that thinning keeps together: their times fill one cache line."""


def middle_time(recording: Recording) -> int:
    """Return the middle time of the recording [us], about which a change of speed changes the phase least."""
    return (recording.events.t_first + recording.events.t_last) // 2


def rotation_window(recording: Recording, settings: Settings) -> Recording:
    """Return two turns from the recording's middle if the camera's rotation is free, else the recording itself.

    The rotation model holds for a short time only.
    """
    if not settings.free or not {"motion", *MOTION} & set(settings.free):
        return recording
    encoder, events = recording.encoder, recording.events
    rpm = settings.start.get("rpm", 0.0) if encoder is None else encoder.rpm
    length = ROTATION_WINDOW_TURNS * 60e6 / abs(rpm) if abs(rpm) > 1e-3 else ROTATION_WINDOW_US
    middle = middle_time(recording)
    cut = events.between(round(middle - length / 2), round(middle + length / 2))
    return replace(recording, events=MemoryEvents(cut, *events.size))


def thin(recording: Recording, most: int) -> Events:
    """Return about ``most`` events of a recording, evenly thinned. Files are read in blocks.

    All events of a recording in memory are not copied.
    """
    source = recording.events
    if isinstance(source, MemoryEvents):
        return thin_events(source.slice(0, len(source)), most)
    step = _step(len(source), most)
    if step == 1:
        return Events.concatenate(list(source.blocks()))
    # a block holds a whole number of steps, so that only the last run of the recording can be cut
    blocks = source.blocks(count=step * RUN * max(1, (1 << 20) // (step * RUN)))
    return Events.concatenate([_every_run(block, step) for block in blocks])


def thin_events(events: Events, most: int) -> Events:
    """Return about ``most`` of the events, evenly thinned: every k-th run of :data:`RUN` events; all are not copied."""
    step = _step(len(events), most)
    return events if step == 1 else _every_run(events, step)


def _step(count: int, most: int) -> int:
    """Return k such that every k-th run of ``count`` events holds about ``most`` of them."""
    return max(1, -(-count // most))


def _every_run(block: Events, step: int) -> Events:
    """Return a copy of every ``step``-th run of :data:`RUN` events, so that the block's memory can be freed."""
    whole = len(block) // (step * RUN) * step * RUN

    def pick(values: NDArray[Any]) -> NDArray[Any]:
        runs, rest = values[:whole].reshape(-1, step * RUN)[:, :RUN], values[whole : whole + RUN]
        out = np.empty(runs.size + rest.size, values.dtype)
        out[: runs.size].reshape(runs.shape)[:] = runs
        out[runs.size :] = rest
        return out

    return Events(*pool().map(pick, (block.x, block.y, block.t, block.p)))


# Events of time spans, copied to a GPU in the background while the sharpness stage runs.

TYPES = (wp.uint16, wp.uint16, wp.int64, wp.uint8)


class EventsAhead:
    """Events of the first of some time spans, which a thread copies to a GPU. Closed by ``with``."""

    def __init__(self, source: MemoryEvents, spans: list[tuple[int, int]], most: int, device: Any) -> None:
        """Start to copy the events of the first of ``spans`` [us], at most ``most`` events in all."""
        self._device = wp.get_device(device)
        self._parts: list[Events] = []
        self._first = [0]
        for part in (source.between(*span) for span in spans):
            if self._first[-1] + len(part) > most:
                break
            self._parts.append(part)
            self._first.append(self._first[-1] + len(part))
        self._spans, n = spans[: len(self._parts)], self._first[-1]
        self._events = DeviceEvents(*(wp.empty(n, dtype=dtype, device=self._device) for dtype in TYPES))
        self._stream = wp.Stream(self._device)  # Warp's own one may be recording a graph
        self._stream.wait_stream(self._device.stream)  # which allocated the arrays
        # Warp's recording of a graph fails if another thread frees memory of the GPU, which a collector may do there
        self._copying = ExitStack()
        self._copying.enter_context(no_garbage_collection())
        self._copied = pool().submit(self._copy)

    def _copy(self) -> None:
        for name in NAMES:
            out = getattr(self._events, name)
            for first, part in zip(self._first, self._parts, strict=False):
                values = np.ascontiguousarray(getattr(part, name))
                if len(values):
                    host = wp.array(values, dtype=out.dtype, device="cpu", copy=False)
                    wp.copy(out, host, dest_offset=first, stream=self._stream)

    def take(self, spans: list[tuple[int, int]]) -> DeviceEvents | None:
        """Return the events of successive ``spans``, joined; None if not all of them were copied."""
        if not {*spans} <= {*self._spans}:
            return None
        self._wait()
        if self._copied.exception() is not None:
            return None
        first = self._spans.index(spans[0])
        return self._events[self._first[first] : self._first[first + len(spans)]]

    def _wait(self) -> None:
        wait([self._copied])
        self._copying.close()
        self._device.stream.wait_stream(self._stream)

    def __enter__(self) -> EventsAhead:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._wait()  # the memory must not be freed before
