"""Readers of Prophesee's files: RAW (EVT 2.0 and 3.0) with faery, and DAT with NumPy."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np

from amiwarp.errors import AmiwarpError
from amiwarp.events.events import DEFAULT_BLOCK
from amiwarp.events.recording import Recording
from amiwarp.io.file_scan import FileEvents, Packet
from amiwarp.io.input_files import errors_name
from amiwarp.io.reading_process import packets
from amiwarp.io.regular_file import check_regular

WIDEST = (2048, 2048)
"""Largest width and height that EVT coordinates can represent [px]. The decoder is given this size, so that it accepts
all events."""

GENERATIONS = {
    "gen3": (640, 480),
    "gen31": (640, 480),
    "gen4": (1280, 720),
    "gen41": (1280, 720),
    "imx636": (1280, 720),
}
"""Sensor sizes (width, height) [px] by name of the sensor generation, for headers without a geometry."""


def _read_header(path: Path) -> tuple[dict[str, str], int]:
    """Return the ``% key value`` lines with lower-case keys, and the offset of the first byte after them."""
    check_regular(path)
    with errors_name(path, lambda: "reading the header"), path.open("rb") as file:
        fields: dict[str, str] = {}
        offset = 0
        while (line := file.readline(4096)).startswith(b"%") and line.endswith(b"\n"):
            offset += len(line)
            text = line[1:].decode("latin-1").strip()
            if text == "end":
                break
            key, _, value = text.partition(" ")
            fields[key.lower()] = value.strip()
        return fields, offset


def open_evt(path: Path) -> Recording:
    """Open a RAW file. The decoder raises each time to the largest so far, without reporting how often."""
    fields, offset = _read_header(path)
    version = fields.get("evt") or fields.get("format", "").removeprefix("EVT").partition(";")[0]
    word = {"2.0": 4, "2": 4, "3.0": 2, "3": 2}.get(version)
    if word is None:
        raise AmiwarpError(f"{path}: EVT version in the header is '{version[:40]}'; expected 2.0 or 3.0")
    source = partial(packets, "amiwarp.io.prophesee:read_evt_packets", os.path.abspath(path))
    events = FileEvents(path, source, size=_evt_size(fields))
    truncated = (path.stat().st_size - offset) % word
    noted = {"truncated_bytes": truncated} if truncated else {}
    return Recording(events=events, metadata={"format": f"evt{version}", **noted, **events.repairs}, name=path.stem)


def _evt_size(fields: dict[str, str]) -> tuple[int, int] | None:
    """Return the sensor size in a header [px]; None if the header has no size."""
    if match := re.fullmatch(r"(\d+)x(\d+)", fields.get("geometry", "")):
        return int(match[1]), int(match[2])
    parts = dict(part.partition("=")[::2] for part in fields.get("format", "").split(";") if "=" in part)
    if parts.get("width", "").isdecimal() and parts.get("height", "").isdecimal():
        return int(parts["width"]), int(parts["height"])
    match = re.search(
        r"gen31|gen41|gen3|gen4|imx636", f"{fields.get('plugin_name')} {fields.get('sensor_name')}".lower()
    )
    return GENERATIONS[match[0]] if match else None


def read_evt_packets(notes: dict[str, int], path: str) -> Iterator[Packet]:
    """Yield packets of events of a RAW file. Called in the reading process."""
    from faery.extension import evt

    notes["triggers"] = 0
    with evt.Decoder(path, WIDEST, "evt3") as decoder:
        for packet in decoder:
            notes["triggers"] += len(packet.get("triggers", ()))
            if "events" in packet:
                events = packet["events"]
                yield events["x"], events["y"], events["t"], events["p"]


def open_dat(path: Path) -> Recording:
    """Open a DAT file of 2D or CD events, version 1 or 2.

    Its 32-bit times, which wrap after 71 min, are unwrapped.
    """
    fields, offset = _read_header(path)
    with errors_name(path, lambda: "reading the header"), path.open("rb") as file:
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
    events = FileEvents(path, partial(_dat_packets, path, offset + 2, version), size=size)
    return Recording(events=events, metadata={"format": f"dat{version}", **events.repairs}, name=path.stem)


def _dat_packets(path: Path, offset: int, version: str, notes: dict[str, int]) -> Iterator[Packet]:
    # Bits of the second word, according to Prophesee's documentation of the format.
    bits, y_shift, p_shift = ((9, 8), 9, 17) if version == "1" else ((14, 14), 14, 28)
    wrapped, last = 0, None
    with path.open("rb") as file:
        file.seek(offset)
        while data := file.read(8 * DEFAULT_BLOCK):
            if len(data) % 8:
                notes["truncated_bytes"] = len(data) % 8
            words = np.frombuffer(data[: len(data) // 8 * 8], "<u4").reshape(-1, 2)
            low, rest = words[:, 0].astype(np.int64), words[:, 1]
            if not low.size:
                return
            # A decrease by more than half the range is a wrap of the counter. A smaller one is an event out of order.
            step = np.diff(low, prepend=low[0] if last is None else last)
            wraps = wrapped + np.cumsum((step < -(1 << 31)).astype(np.int64) - (step > 1 << 31))
            wrapped, last = int(wraps[-1]), int(low[-1])
            t = low + (wraps << 32)
            x = rest & ((1 << bits[0]) - 1)
            y = (rest >> y_shift) & ((1 << bits[1]) - 1)
            yield x, y, t, (rest >> p_shift) & 1
