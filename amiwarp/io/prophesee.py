"""Readers of Prophesee's files: RAW with faery (EVT 2.0, 3.0) or NumPy (EVT 2.1), and DAT with NumPy."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.events import DEFAULT_BLOCK
from amiwarp.events.recording import Recording
from amiwarp.io.counters import last_word, nearest, unwrapped
from amiwarp.io.evt_words import TIME_HIGH, Evt2Decoder, swap_halves, words_of
from amiwarp.io.file_scan import FileEvents, Packet
from amiwarp.io.input_files import errors_name, open_input
from amiwarp.io.reading_process import packets
from amiwarp.io.reading_server import noting_progress

EVT21_BLOCK = 1 << 16
"""Number of EVT 2.1 words that are decoded at once, with up to 32 events each."""

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
    with errors_name(path, lambda: "reading the header"), open_input(path) as file:
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
    word = {"2.0": 4, "2": 4, "2.1": 8, "21": 8, "3.0": 2, "3": 2}.get(version)
    if word is None:
        raise AmiwarpError(f"{path}: EVT version in the header is '{version[:40]}'; expected 2.0, 2.1 or 3.0")
    swapped = word == 8 and _is_swapped(path, offset, fields.get("format", ""))
    source: Callable[[dict[str, int]], Iterator[Packet]]
    if word == 8:
        version, source = "2.1", partial(_evt21_packets, path, offset, swapped, False)
    else:
        source = partial(packets, "amiwarp.io.prophesee:read_evt_packets", path.absolute(), False)
    last = None if word == 2 else partial(_last_evt_time, path, offset, word, swapped)
    events = FileEvents(path, source, size=_evt_size(fields), last_time=last)
    truncated = (path.stat().st_size - offset) % word
    noted = {"truncated_bytes": truncated} if truncated else {}
    return Recording(events=events, metadata={"format": f"evt{version}", **noted, **events.metadata}, name=path.stem)


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


def read_evt_packets(notes: dict[str, int], path: str, triggers: bool) -> Iterator[Packet]:
    """Yield packets of events, or of triggers, of a RAW file. Runs in the reading process."""
    from faery.extension import evt

    notes["triggers"] = 0
    with evt.Decoder(path, WIDEST, "evt3") as decoder:
        for packet in noting_progress(decoder, path, notes):
            edges = packet.get("triggers")
            notes["triggers"] += 0 if edges is None else len(edges)
            if triggers and edges is not None:
                yield edges["source"], edges["source"] * 0, edges["t"], edges["rising"]
            elif "events" in packet and not triggers:
                events = packet["events"]
                yield events["x"], events["y"], events["t"], events["p"]


def trigger_packets(path: Path) -> Iterator[Packet]:
    """Yield the edges of the external triggers of a RAW file."""
    fields, offset = _read_header(path)
    if fields.get("evt", fields.get("format", "")).startswith(("2.1", "EVT21")):
        return _evt21_packets(path, offset, _is_swapped(path, offset, fields.get("format", "")), True, {})
    return packets("amiwarp.io.prophesee:read_evt_packets", path.absolute(), True, {})


def _evt21_packets(path: Path, offset: int, swapped: bool, triggers: bool, notes: dict[str, int]) -> Iterator[Packet]:
    """Yield the events, or the triggers, of EVT 2.1, which faery does not read."""
    decoder = Evt2Decoder(vectors=True)
    notes["total"] = path.stat().st_size
    with open_input(path) as file:
        file.seek(offset)
        while data := file.read(8 * EVT21_BLOCK):
            notes["read"] = file.tell()
            words = words_of(data, "2.1")
            events, edges = decoder.decode(swap_halves(words) if swapped else words)
            notes["triggers"] = notes.get("triggers", 0) + len(edges[0])
            yield edges if triggers else events


def _last_evt_time(path: Path, offset: int, word: int, swapped: bool, estimate: int) -> int | None:
    """Return the time of the last event of a file of EVT 2.0 or 2.1 [us]. Times of EVT 3.0 wrap after 17 s."""
    count = (path.stat().st_size - offset) // word
    with open_input(path) as file:
        file.seek(offset + max(count - EVT21_BLOCK, 0) * word)
        words = words_of(file.read(word * EVT21_BLOCK), "2" if word == 4 else "2.1")
    t = Evt2Decoder(vectors=word == 8).decode(swap_halves(words) if swapped else words)[0][2]
    return nearest(int(t[-1]), 34, estimate) if t.size else None


def _is_swapped(path: Path, offset: int, layout: str) -> bool:
    """Return whether a file of EVT 2.1 has swapped halves, according to its header's ``layout`` or its first words."""
    if "endianness=" in layout:
        return "endianness=legacy" in layout
    with open_input(path) as file:
        file.seek(offset)
        return _halves_are_swapped(words_of(file.read(8 * EVT21_BLOCK), "2.1"))


def _halves_are_swapped(words: NDArray[np.uint64]) -> bool:
    """Return whether EVT 2.1 words have their 32-bit halves swapped, as the IMX636 writes them.

    Only in the right order do the words of the time's upper bits rise.
    """

    def time_words(heads: NDArray[np.uint64]) -> tuple[bool, int]:
        times = heads[heads >> np.uint64(28) == TIME_HIGH].astype(np.int64)
        return bool((np.diff(times) >= 0).all()), times.size

    return time_words(words & np.uint64(0xFFFFFFFF)) >= time_words(words >> np.uint64(32))


def open_dat(path: Path) -> Recording:
    """Open a DAT file of 2D or CD events, version 1 or 2.

    Its 32-bit times, which wrap after 71 min, are unwrapped.
    """
    fields, offset = _read_header(path)
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
    read, last = partial(_dat_packets, path, offset + 2, version), partial(last_word, path, offset + 2, "<u4")
    events = FileEvents(path, read, size=size, last_time=last)
    return Recording(events=events, metadata={"format": f"dat{version}", **events.metadata}, name=path.stem)


def _dat_packets(path: Path, offset: int, version: str, notes: dict[str, int]) -> Iterator[Packet]:
    # Bits of the second word, according to Prophesee's documentation of the format.
    bits, y_shift, p_shift = ((9, 8), 9, 17) if version == "1" else ((14, 14), 14, 28)
    last: int | None = None
    with open_input(path) as file:
        file.seek(offset)
        notes["total"] = path.stat().st_size
        while data := file.read(8 * DEFAULT_BLOCK):
            notes["read"] = file.tell()
            if len(data) % 8:
                notes["truncated_bytes"] = len(data) % 8
            words = np.frombuffer(data[: len(data) // 8 * 8], "<u4").reshape(-1, 2)
            low, rest = words[:, 0].astype(np.int64), words[:, 1]
            if not low.size:
                return
            t = unwrapped(low, 32, last)
            last = int(t[-1])
            x = rest & ((1 << bits[0]) - 1)
            y = (rest >> y_shift) & ((1 << bits[1]) - 1)
            yield x, y, t, (rest >> p_shift) & 1
