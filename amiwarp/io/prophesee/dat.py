"""Reader of Prophesee's DAT files, of 8 bytes for each event."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events.recording import Recording
from amiwarp.io.event_packets import Packet
from amiwarp.io.file_pieces import last_word, read_words
from amiwarp.io.file_scan import FileEvents
from amiwarp.io.inputs import errors_name, open_input
from amiwarp.io.prophesee.dat_decoder import DatDecoder
from amiwarp.io.prophesee.raw import read_header, stated_origin

PIECE_EVENTS = 1 << 20
"""Number of events that are decoded at once."""


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
            f"{path}: byte {offset}: {kind.hex() or 'nothing'} is not a DAT event type; expected 0008 or 0c08",
            ErrorCode.FORMAT_UNKNOWN,
        )
    version = fields.get("version", "2")
    if version not in ("1", "2"):
        raise AmiwarpError(
            f"{path}: DAT version is '{version[:40]}'; expected 1 or 2", ErrorCode.FORMAT_UNKNOWN
        )
    width = fields.get("width", "")
    height = fields.get("height", "")
    size = None
    if width.isdecimal() and height.isdecimal():
        size = (int(width), int(height))
    origin = stated_origin(path, fields)
    read = partial(_packets, path, offset + 2, version, origin)
    last = partial(_last_time, path, offset + 2, origin)
    events = FileEvents(path, read, size=size, last_time=last)
    metadata = {"format": f"dat{version}", **events.metadata}
    return Recording(events=events, metadata=metadata, name=path.stem)


def _last_time(path: Path, offset: int, origin: int, estimate: int) -> int | None:
    """Return the time of the last event [us]."""
    last = last_word(path, offset, "<u4", estimate - origin)
    return None if last is None else last + origin


def _packets(
    path: Path, offset: int, version: str, origin: int, notes: dict[str, int]
) -> Iterator[Packet]:
    """Yield the events."""
    import warp as wp

    from amiwarp.kernels.quiet_start import start_once

    start_once()
    decoder = DatDecoder(version, "cpu")
    for records in read_words(path, offset, "<u4", PIECE_EVENTS, notes):
        words = wp.array(records.ravel(), dtype=wp.uint32, device="cpu", copy=False)
        events = decoder.decode(words).to_host()
        if origin:
            np.add(events.t, origin, out=events.t)
        yield events
