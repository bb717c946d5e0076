"""Prophesee's DAT files, of 8 bytes for each event, are read and written."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.recording import Events, Recording
from amiwarp.io.file_scan import FileEvents, Packet, last_word, read_words, unwrapped
from amiwarp.io.files import errors_name, open_input
from amiwarp.io.formats import LONGEST_DAT_US, Outline, origin_of
from amiwarp.io.prophesee import read_header, stated_origin

if TYPE_CHECKING:
    from amiwarp.kernels.dat import Layout

PIECE_EVENTS = 1 << 20
"""Number of events that are decoded at once."""
BLOCK_EVENTS = 1 << 15
"""Number of events that one thread decodes."""


def open_dat(path: Path) -> Recording:
    """Open a DAT file of 2D or CD events, version 1 or 2.

    Its 32-bit times, which wrap after 71 min, are unwrapped.
    """
    fields, offset = read_header(path)
    with errors_name(path, lambda: "reading the header"), open_input(path) as file:
        file.seek(offset)
        kind = file.read(2)
    # 0x00: 2D events; 0x0c: CD events. Both have 8 bytes.
    if len(kind) < 2 or kind[0] not in (0x00, 0x0C) or kind[1] != 8:
        raise AmiwarpError(
            f"{path}: byte {offset}: {kind.hex() or 'nothing'} is not a DAT event type; expected 0008 or 0c08"
        )
    version = fields.get("version", "2")
    if version not in ("1", "2"):
        raise AmiwarpError(f"{path}: DAT version is '{version[:40]}'; expected 1 or 2")
    width, height = fields.get("width", ""), fields.get("height", "")
    size = (int(width), int(height)) if width.isdecimal() and height.isdecimal() else None
    origin = stated_origin(path, fields)
    read = partial(_packets, path, offset + 2, version, origin)
    last = partial(_last_time, path, offset + 2, origin)
    events = FileEvents(path, read, size=size, last_time=last)
    return Recording(events=events, metadata={"format": f"dat{version}", **events.metadata}, name=path.stem)


def _last_time(path: Path, offset: int, origin: int, estimate: int) -> int | None:
    """Return the time of the last event [us]."""
    last = last_word(path, offset, "<u4", estimate - origin)
    return None if last is None else last + origin


def _layout(version: str) -> Layout:
    """Return the bits of the second word, according to Prophesee's documentation of the format."""
    from amiwarp.kernels.dat import Layout

    layout = Layout()
    if version == "1":
        layout.x_mask = 0x1FF
        layout.y_mask = 0xFF
        layout.y_shift = 9
        layout.p_shift = 17
    else:
        layout.x_mask = 0x3FFF
        layout.y_mask = 0x3FFF
        layout.y_shift = 14
        layout.p_shift = 28
    return layout


def _packets(path: Path, offset: int, version: str, origin: int, notes: dict[str, int]) -> Iterator[Packet]:
    """Yield the events."""
    layout = _layout(version)
    last: int | None = None
    for words in read_words(path, offset, "<u4", PIECE_EVENTS, notes):
        if not len(words):
            return
        events, wrapped = _decoded(words, layout, last)
        if wrapped:
            events.t[:] = unwrapped(words[:, 0].astype(np.int64), 32, last)
        last = int(events.t[-1])
        if origin:
            np.add(events.t, origin, out=events.t)
        yield events


def _decoded(words: NDArray[np.uint32], layout: Layout, last: int | None) -> tuple[Events, bool]:
    """Return the events of some records, and whether a time wraps in them, after ``last`` [us].

    Then the times after it are wrong.
    """
    import warp as wp

    from amiwarp.events.device_events import DeviceEvents
    from amiwarp.kernels.dat import decode_dat
    from amiwarp.kernels.evt import new_event_arrays
    from amiwarp.kernels.launch import launch, start_once

    start_once()
    count = len(words)
    arrays = new_event_arrays(count, "cpu")
    before = int(words[0, 0]) if last is None else last
    blocks = -(-count // BLOCK_EVENTS)
    wrapped = wp.empty(blocks, dtype=int, device="cpu")
    flat = wp.array(words.ravel(), dtype=wp.uint32, device="cpu", copy=False)
    launch(decode_dat, blocks, [flat, BLOCK_EVENTS, layout, before], [arrays, wrapped], device="cpu", smallest=1)
    events = DeviceEvents(arrays.x, arrays.y, arrays.t, arrays.p).to_host()
    return events, bool(wrapped.numpy().any())


# Writer of DAT files, version 2, of CD events: a header, then 8 bytes for each event.

DAT_KIND = bytes([0x0C, 8])
"""Type of the events, CD, and their size [bytes], between the header and the events."""


def write_dat(part: Path, blocks: Iterable[Events], about: Outline) -> None:
    """Write all events into a DAT file."""
    origin = origin_of(about, LONGEST_DAT_US)
    header = [
        "Data file containing CD events.",
        "Version 2",
        f"Height {about.height}",
        f"Width {about.width}",
        *([f"T0 {origin}"] if origin else []),
    ]
    with part.open("xb") as file:
        file.write("".join(f"% {line}\n" for line in header).encode())
        file.write(DAT_KIND)
        for events in blocks:
            words = np.empty((len(events), 2), "<u4")
            words[:, 0] = events.t - origin
            words[:, 1] = events.x | events.y.astype(np.uint32) << 14 | events.p.astype(np.uint32) << 28
            file.write(words.data)
