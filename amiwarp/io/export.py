"""Writing of recordings in formats other than the native one, conversion, and export of ground truth."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TypeAlias

import numpy as np

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events.recording import SENSOR_DTYPE, Events, EventSource, check_coordinates
from amiwarp.io.formats import io_function
from amiwarp.io.inputs import errors_name
from amiwarp.io.output_formats import (
    EXTENSIONS,
    LIMITS,
    WRITERS,
    Bag,
    Codec,
    Limits,
    Outline,
    OutputFormat,
    Rounding,
)
from amiwarp.io.outputs import NewFile
from amiwarp.io.text.size import TextSize, may_replace_size, size_file, write_size
from amiwarp.tasks import Progress
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
    ``seed`` apply to compensated events. Text has its size in a second file, :func:`size_file`. Raises
    :class:`AmiwarpError` for events that the format cannot hold.
    """
    path = Path(path)
    limits = LIMITS[chosen]
    outline = Outline(
        path=path,
        width=size[0],
        height=size[1],
        t_first=source.t_first if len(source) else 0,
        t_last=source.t_last if len(source) else 0,
        codec=codec,
        bag=bag,
    )
    check_limits(outline, limits)
    pixels = Pixels(limits, size, rounding, seed)
    write: Writer = io_function(WRITERS[chosen])
    foreign: list[Exception] = []
    written = _written(
        source.blocks() if blocks is None else blocks,
        pixels,
        outline,
        len(source),
        progress,
        foreign,
    )
    # The file and the size beside it both appear at the end, or neither.
    with contextlib.ExitStack() as files:
        new = files.enter_context(NewFile(path, overwrite=overwrite))
        beside = None
        if limits.text_unit is not None:
            may_replace = may_replace_size(path) or overwrite
            beside = files.enter_context(NewFile(size_file(path), overwrite=may_replace))
        try:
            write(new.part, written, outline)
            if beside is not None and limits.text_unit is not None:
                stated = TextSize(size, limits.text_unit, pixels.fractional)
                write_size(beside.part, new.part, stated)
        except BaseException as error:
            if error in foreign:
                raise
            with errors_name(path, lambda: f"writing {limits.label}"):
                raise
    return pixels.dropped


def check_limits(about: Outline, limits: Limits) -> None:
    """Raise :class:`AmiwarpError` if the size or the times lie beyond what a format can hold."""
    remedy = "write a native recording (.h5)"
    if max(about.width, about.height) > limits.side:
        largest = f"{limits.side}x{limits.side}"
        raise AmiwarpError(
            f"{about.path}: the sensor is {about.width}x{about.height}, {limits.label} holds up to {largest}; {remedy}"
        )
    beyond_us = None
    if about.t_first < limits.t_first:
        beyond_us = about.t_first
    elif about.t_last > limits.t_last:
        beyond_us = about.t_last
    if beyond_us is not None:
        allowed = f"{limits.t_first} .. {limits.t_last} us"
        raise AmiwarpError(
            f"{about.path}: an event is at {beyond_us} us, {limits.label} holds {allowed}; {remedy}"
        )
    span = about.t_last - about.t_first
    if span > limits.span:
        raise AmiwarpError(
            f"{about.path}: the events span {span} us, {limits.label} holds up to {limits.span} us; {remedy}"
        )


def _written(
    blocks: Iterable[Events],
    pixels: Pixels,
    about: Outline,
    count: int,
    progress: Progress | None,
    foreign: list[Exception],
) -> Iterator[Events]:
    """Yield the events as the format holds them, in blocks of at least one. ``count`` is the number of all events.

    An exception that is not amiwarp's, of a caller's function or source, is noted in ``foreign``.
    """
    done = 0
    try:
        for block in blocks:
            events = pixels(block)
            if len(events):
                if events.whole_pixels:
                    check_coordinates(
                        events, about.width, about.height, where=str(about.path), first_index=done
                    )
                yield events
            done += len(block)
            if progress is not None:
                progress("writing events", done / count)
    except AmiwarpError:
        raise
    except Exception as error:
        foreign.append(error)
        raise


class Pixels:
    """Conversion of coordinates to those that a format holds.

    Rounded events outside the image, and events without coordinates (NaN), are dropped and counted. Random numbers are
    drawn for each event in turn, so that the result does not depend on the blocks.
    """

    def __init__(
        self, limits: Limits, size: tuple[int, int], rounding: Rounding | None, seed: int
    ) -> None:
        """Take the limits of the format and the size of the sensor [px]."""
        self._limits = limits
        self._size = size
        self._rounding = rounding
        self._random = np.random.default_rng(whole(seed, "seed", 0, 2**63 - 1))
        self.dropped = 0
        self.fractional = False
        """Whether events with fractional pixels, which are compensated, were kept so far."""

    def __call__(self, events: Events) -> Events:
        """Return events as the format holds them. Raises :class:`AmiwarpError` if they need rounding, or must not."""
        if events.whole_pixels:
            if self._rounding is None:
                return events
            raise AmiwarpError(
                "events have whole pixels and are not rounded; leave --round (rounding= in Python) out",
                ErrorCode.OPTIONS,
            )
        if self._rounding is not None:
            return self._rounded(events, self._rounding)
        if self._limits.fractional:
            self.fractional = True
            return events
        names = " or ".join(Rounding)
        exact = [end for end, one in EXTENSIONS.items() if one in LIMITS and LIMITS[one].fractional]
        raise AmiwarpError(
            f"events are compensated and have fractional pixels, {self._limits.label} holds whole pixels; "
            f"give --round (rounding= in Python) {names}, or write .h5, {', '.join(exact[:-1])} or {exact[-1]}",
            ErrorCode.OPTIONS,
        )

    def _rounded(self, events: Events, rounding: Rounding) -> Events:
        """Return the events that are inside the image after rounding."""
        if rounding is Rounding.NEAREST:
            x_shift, y_shift = np.full((2, 1), 0.5)
        else:
            x_shift, y_shift = self._random.random((len(events), 2)).T
        with np.errstate(invalid="ignore"):
            x = np.floor(events.x + x_shift)
            y = np.floor(events.y + y_shift)
        width, height = self._size
        inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
        kept = Events(
            x[inside].astype(SENSOR_DTYPE),
            y[inside].astype(SENSOR_DTYPE),
            events.t[inside],
            events.p[inside],
        )
        self.dropped += len(events) - len(kept)
        return kept
