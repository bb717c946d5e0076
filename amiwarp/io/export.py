"""Writing of events in formats other than the native one, in constant memory and completely or not at all."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TypeAlias

import numpy as np

from amiwarp.errors import AmiwarpError
from amiwarp.events.checks import SENSOR_DTYPE
from amiwarp.events.events import Events, EventSource
from amiwarp.io.atomic_output import NewFile
from amiwarp.io.chunks import Codec
from amiwarp.io.input_files import errors_name
from amiwarp.io.output_formats import LIMITS, Bag, Limits, Outline, OutputFormat, Rounding
from amiwarp.progress import Progress
from amiwarp.validation import whole

Writer: TypeAlias = Callable[[Path, Iterable[Events], Outline], None]
"""Function that writes all events into a new file."""


def export(
    source: EventSource,
    path: str | os.PathLike[str],
    chosen: OutputFormat,
    size: tuple[int, int],
    *,
    codec: Codec,
    progress: Progress | None,
    overwrite: bool,
    blocks: Iterable[Events] | None = None,
    rounding: Rounding | None = None,
    seed: int = 0,
    bag: Bag | None = None,
) -> int:
    """Write the events of a source, and return how many were dropped because they are outside the image.

    ``blocks`` are written instead of the source's events: the same events with other coordinates. ``rounding`` and
    ``seed`` apply to compensated events. Raises :class:`AmiwarpError` for events that the format cannot hold.
    """
    path, limits = Path(path), LIMITS[chosen]
    ends = (source.t_first, source.t_last) if len(source) else (0, 0)
    outline = Outline(path, *size, *ends, codec, bag)
    _check_limits(outline, limits)
    pixels = Pixels(limits, size, rounding, seed)
    write = _writer(chosen)
    with NewFile(path, overwrite=overwrite) as new, errors_name(path, lambda: f"writing {limits.label}"):
        write(new.part, _written(source.blocks() if blocks is None else blocks, pixels, len(source), progress), outline)
    return pixels.dropped


def _check_limits(about: Outline, limits: Limits) -> None:
    """Raise :class:`AmiwarpError` if the size or the times lie beyond what a format can hold."""
    remedy = "write a native recording (.h5)"
    if max(about.width, about.height) > limits.side:
        largest = f"{limits.side}x{limits.side}"
        raise AmiwarpError(
            f"{about.path}: the sensor is {about.width}x{about.height}, {limits.label} holds up to {largest}; {remedy}"
        )
    span = about.t_last - about.t_first
    for held, t in ((limits.t_first <= about.t_first, about.t_first), (about.t_last <= limits.t_last, about.t_last)):
        if not held:
            allowed = f"{limits.t_first} .. {limits.t_last} us"
            raise AmiwarpError(f"{about.path}: an event is at {t} us, {limits.label} holds {allowed}; {remedy}")
    if span > limits.span:
        raise AmiwarpError(
            f"{about.path}: the events span {span} us, {limits.label} holds up to {limits.span} us; {remedy}"
        )


def _written(blocks: Iterable[Events], pixels: Pixels, count: int, progress: Progress | None) -> Iterator[Events]:
    """Yield the events as the format holds them, in blocks of at least one. ``count`` is the number of all events."""
    done = 0
    for block in blocks:
        events = pixels(block)
        if len(events):
            yield events
        done += len(block)
        if progress is not None:
            progress("writing events", done / count)


class Pixels:
    """Conversion of coordinates to those that a format holds.

    Rounded events outside the image, and events without coordinates (NaN), are dropped and counted. Random numbers are
    drawn for each event in turn, so that the result does not depend on the blocks.
    """

    def __init__(self, limits: Limits, size: tuple[int, int], rounding: Rounding | None, seed: int) -> None:
        """Take the limits of the format and the size of the sensor [px]."""
        self._limits, self._size, self._rounding = limits, size, rounding
        self._random = np.random.default_rng(whole(seed, "seed", 0, 2**63 - 1))
        self.dropped = 0

    def __call__(self, events: Events) -> Events:
        """Return events as the format holds them. Raises :class:`AmiwarpError` if they need rounding, or must not."""
        if events.whole_pixels and self._rounding is None:
            return events
        if events.whole_pixels:
            raise AmiwarpError("events have whole pixels and are not rounded; leave --round (rounding= in Python) out")
        if self._rounding is not None:
            return self._rounded(events, self._rounding)
        if self._limits.fractional:
            return events
        names = " or ".join(Rounding)
        raise AmiwarpError(
            f"events are compensated and have fractional pixels, {self._limits.label} holds whole pixels; "
            f"give --round (rounding= in Python) {names}, or write .h5, .npz or .txt"
        )

    def _rounded(self, events: Events, rounding: Rounding) -> Events:
        """Return the events that are inside the image after rounding."""
        shift = np.full((2, 1), 0.5) if rounding is Rounding.NEAREST else self._random.random((len(events), 2)).T
        with np.errstate(invalid="ignore"):
            places = [np.floor(values + by) for values, by in zip((events.x, events.y), shift, strict=True)]
        inside = np.logical_and.reduce([(at >= 0) & (at < side) for at, side in zip(places, self._size, strict=True)])
        x, y = (at[inside].astype(SENSOR_DTYPE) for at in places)
        self.dropped += len(events) - len(x)
        return Events(x, y, events.t[inside], events.p[inside])


def _writer(chosen: OutputFormat) -> Writer:
    """Return the function that writes a format."""
    # Each writer is imported on use, because its library takes time to load.
    if chosen is OutputFormat.DSEC:
        from amiwarp.io.dsec_writer import write_dsec as writer
    elif chosen is OutputFormat.EVT3:
        from amiwarp.io.evt3_writer import write_evt3 as writer
    elif chosen is OutputFormat.AEDAT4:
        from amiwarp.io.aedat4_writer import write_aedat4 as writer
    elif chosen is OutputFormat.NPZ:
        from amiwarp.io.npz_writer import write_npz as writer
    elif chosen is OutputFormat.TEXT:
        from amiwarp.io.text_writer import write_text as writer
    else:
        from amiwarp.io.ros2_writer import write_ros2 as writer
    return writer
