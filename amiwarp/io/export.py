"""Writing of events in formats other than the native one, in constant memory and completely or not at all."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TypeAlias

import numpy as np

from amiwarp.errors import AmiwarpError
from amiwarp.events.events import Events, EventSource
from amiwarp.io.atomic_output import NewFile
from amiwarp.io.chunks import Codec
from amiwarp.io.input_files import errors_name
from amiwarp.io.output_formats import LIMITS, Limits, Outline, OutputFormat
from amiwarp.progress import Progress

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
) -> None:
    """Write the events of a source. Raises :class:`AmiwarpError` for events that the format cannot hold."""
    path, count = Path(path), len(source)
    ends = (source.t_first, source.t_last) if count else (0, 0)
    outline = Outline(path, *size, count, *ends, codec)
    _check_limits(outline, LIMITS[chosen])
    write = _writer(chosen)
    with NewFile(path, overwrite=overwrite) as new, errors_name(path, lambda: f"writing {LIMITS[chosen].label}"):
        write(new.part, _blocks(source, LIMITS[chosen], progress), outline)


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


def _blocks(source: EventSource, limits: Limits, progress: Progress | None) -> Iterator[Events]:
    """Yield the events in blocks, after a check that their pixels are whole numbers."""
    done = 0
    for block in source.blocks():
        if not np.issubdtype(block.x.dtype, np.integer):
            raise AmiwarpError(
                f"events are compensated and have fractional pixels, {limits.label} holds whole pixels; "
                "write a native recording (.h5)"
            )
        yield block
        done += len(block)
        if progress is not None:
            progress("writing events", done / len(source))


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
