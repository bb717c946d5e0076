"""Prophesee's DAT files, of 8 bytes for each event, are read and written."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.recording import Events, Recording
from amiwarp.io.decoding import BLOCK_RECORDS, sums_before
from amiwarp.io.file_scan import FileEvents, Packet, last_word, read_words
from amiwarp.io.files import errors_name, open_input
from amiwarp.io.formats import LONGEST_DAT_US, Outline, origin_of
from amiwarp.io.prophesee import read_header, stated_origin

if TYPE_CHECKING:
    from amiwarp.events.device_events import DeviceEvents
    from amiwarp.kernels.dat import Layout

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


def _packets(path: Path, offset: int, version: str, origin: int, notes: dict[str, int]) -> Iterator[Packet]:
    """Yield the events."""
    import warp as wp

    from amiwarp.kernels.launch import start_once

    start_once()
    decoder = DatDecoder(version, "cpu")
    for records in read_words(path, offset, "<u4", PIECE_EVENTS, notes):
        words = wp.array(records.ravel(), dtype=wp.uint32, device="cpu", copy=False)
        events = decoder.decode(words).to_host()
        if origin:
            np.add(events.t, origin, out=events.t)
        yield events


# Decoder of the records, on a CPU or a GPU.


class DatDecoder:
    """Decoder of the records of one file or stream, in pieces. Times run on where those of 32 bits wrap."""

    def __init__(self, version: str, device: Any) -> None:
        import warp as wp

        self._device = wp.get_device(device)
        self._layout = _layout(version)
        self._last = -1  # time of the last record as stored [us]
        self._wraps = 0

    def decode(self, words: Any) -> DeviceEvents:
        """Return the events of the records that follow the last call's. ``words``: a Warp array of uint32."""
        import warp as wp

        from amiwarp.events.device_events import DeviceEvents
        from amiwarp.kernels.dat import decode_dat
        from amiwarp.kernels.event_arrays import new_event_arrays
        from amiwarp.kernels.launch import launch

        device = self._device
        count = words.shape[0] // 2
        length = BLOCK_RECORDS[device.is_cpu]
        blocks = -(-count // length)
        arrays = new_event_arrays(count, device)
        wraps = wp.empty(blocks, dtype=int, device=device)

        def decode(turns: NDArray[np.int64]) -> NDArray[np.int64]:
            """Decode all blocks, before which the time has wrapped so often, and return how often it wraps in each."""
            inputs = [words, length, self._layout, self._last, wp.array(turns, dtype=int, device=device)]
            launch(decode_dat, blocks, inputs, [arrays, wraps], device=device, smallest=1)
            return np.asarray(wraps.numpy().astype(np.int64))

        turns = np.full(blocks, self._wraps)
        found = decode(turns)
        if found[:-1].any():  # rare, as the time wraps after 71 min: the blocks behind it were wrong
            decode(turns + sums_before(found))
        if count:
            self._wraps += int(found.sum())
            self._last = int(arrays.t[count - 1 :].numpy()[0]) % 2**32
        return DeviceEvents(arrays.x, arrays.y, arrays.t, arrays.p)


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
