"""Reader of Prophesee's RAW files, of words in EVT 2.0, 2.1 or 3.0, and of the header that DAT files have, too."""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events.recording import Events, MetadataValue, Recording
from amiwarp.io.event_packets import Packet
from amiwarp.io.file_pieces import nearest, read_pieces
from amiwarp.io.file_scan import FileEvents
from amiwarp.io.inputs import errors_name, open_input
from amiwarp.io.prophesee.evt_decoder import EvtDecoder, Triggers
from amiwarp.io.prophesee.evt_words import halves_of, words_of
from amiwarp.validation import TIME_LIMIT

EVT_BYTES = 1 << 22
"""Number of bytes of EVT words that are decoded at once. They hold at most 26 million events."""

VERSIONS = {"2.0": "2.0", "2": "2.0", "2.1": "2.1", "21": "2.1", "3.0": "3.0", "3": "3.0"}
"""Versions of EVT, by what a header states."""

WORD_BYTES = {"2.0": 4, "2.1": 8, "3.0": 2}
"""Sizes of the words of the versions of EVT [bytes]."""

GENERATIONS = {
    "gen3": (640, 480),
    "gen31": (640, 480),
    "gen4": (1280, 720),
    "gen41": (1280, 720),
    "imx636": (1280, 720),
    "imx646": (1280, 720),
    "genx320": (320, 320),
}
"""Sensor sizes (width, height) [px] by name of the sensor generation, for headers without a geometry."""


def read_header(path: Path) -> tuple[dict[str, str], int]:
    """Return the ``% key value`` lines with lower-case keys, and the offset of the first byte after them."""
    with errors_name(path, lambda: "reading the header"), open_input(path) as file:
        fields: dict[str, str] = {}
        offset = 0
        while True:
            line = file.readline(4096)
            if not line.startswith(b"%") or not line.endswith(b"\n"):
                break
            offset += len(line)
            text = line[1:].decode("latin-1").strip()
            if text == "end":
                break
            key, _, value = text.partition(" ")
            fields[key.lower()] = value.strip()
        return fields, offset


@dataclass(frozen=True, slots=True)
class EvtFile:
    """Header of a RAW file."""

    path: Path
    fields: dict[str, str]
    """Values by lower-case key."""
    version: str
    """Version of EVT: "2.0", "2.1" or "3.0"."""
    offset: int
    """Position of the first word [bytes]."""
    word: int
    """Size of a word [bytes]."""
    swapped: bool
    """Whether the 32-bit halves of the words are swapped, see :class:`Halves`."""
    origin: int
    """Time that is added to the times of the words [us]: ``t0`` of the header, which amiwarp and faery write."""

    def words(self, data: bytes) -> NDArray[Any]:
        """Return the whole words of some bytes of the file, with halves as they are stored."""
        return words_of(data, self.version)

    def decoder(self) -> EvtDecoder:
        """Return a new decoder of the file's words."""
        return EvtDecoder(self.version, swapped=self.swapped)


def open_evt(path: Path) -> Recording:
    """Open a RAW file."""
    about = read_evt_header(path)
    size = _evt_size(about.fields)
    # Times of EVT 3.0 wrap after 17 s, so that the last one is not known from the end of the file.
    last_time = None if about.version == "3.0" else partial(_last_evt_time, about)
    events = FileEvents(path, partial(_evt_events, about), size=size, last_time=last_time)
    metadata: dict[str, MetadataValue] = {"format": f"evt{about.version}"}
    truncated = (path.stat().st_size - about.offset) % about.word
    if truncated:
        metadata["truncated_bytes"] = truncated
    metadata |= events.metadata
    return Recording(events=events, metadata=metadata, name=path.stem)


def read_evt_header(path: Path) -> EvtFile:
    """Return the header of a RAW file. Raises :class:`AmiwarpError` for another version than 2.0, 2.1 and 3.0."""
    fields, offset = read_header(path)
    layout = fields.get("format", "")
    version_of_layout, _, _ = layout.removeprefix("EVT").partition(";")
    stated = fields.get("evt") or version_of_layout
    version = VERSIONS.get(stated)
    if version is None:
        raise AmiwarpError(
            f"{path}: EVT version in the header is '{stated[:40]}'; expected 2.0, 2.1 or 3.0",
            ErrorCode.FORMAT_UNKNOWN,
        )
    return EvtFile(
        path=path,
        fields=fields,
        version=version,
        offset=offset,
        word=WORD_BYTES[version],
        swapped=version == "2.1" and _is_swapped(path, offset, layout),
        origin=stated_origin(path, fields),
    )


def stated_origin(path: Path, fields: dict[str, str]) -> int:
    """Return the time that is added to all times of a file [us]: ``t0`` of the header, or 0."""
    origin = fields.get("t0", "0")
    if not re.fullmatch(r"[0-9]{1,19}", origin) or int(origin) > TIME_LIMIT:
        raise AmiwarpError(
            f"{path}: t0 in the header is '{origin[:40]}'; expected a time of 0 to {TIME_LIMIT} us",
            ErrorCode.FILE_DAMAGED,
        )
    return int(origin)


def _evt_size(fields: dict[str, str]) -> tuple[int, int] | None:
    """Return the sensor size in a header [px]; None if the header has no size."""
    geometry = re.fullmatch(r"(\d+)x(\d+)", fields.get("geometry", ""))
    if geometry is not None:
        return int(geometry[1]), int(geometry[2])

    parts = {}
    for part in fields.get("format", "").split(";"):
        if "=" in part:
            name, _, value = part.partition("=")
            parts[name] = value
    width = parts.get("width", "")
    height = parts.get("height", "")
    if width.isdecimal() and height.isdecimal():
        return int(width), int(height)

    names = f"{fields.get('plugin_name')} {fields.get('sensor_name')} {fields.get('generation')}"
    without_dots = names.lower().replace(".", "")
    longest_first = sorted(GENERATIONS, key=len, reverse=True)
    generation = re.search("|".join(longest_first), without_dots)
    if generation is None:
        return None
    return GENERATIONS[generation[0]]


def trigger_packets(path: Path) -> Iterator[Packet]:
    """Yield the edges of the external triggers of a RAW file."""
    about = read_evt_header(path)
    for _, edges in _decoded(about, {}):
        zeros = np.zeros_like(edges.channel)
        t = edges.t + about.origin
        yield edges.channel, zeros, t, edges.rising


def _decoded(about: EvtFile, notes: dict[str, int]) -> Iterator[tuple[Events, Triggers]]:
    """Yield the events and the triggers of a RAW file, and note what was counted."""
    decoder = about.decoder()
    for data in read_pieces(about.path, about.offset, EVT_BYTES, notes):
        events, edges = decoder.decode(about.words(data))
        notes["triggers"] = notes.get("triggers", 0) + len(edges.t)
        notes["dropped_untimed_events"] = decoder.untimed
        notes["unknown_words"] = decoder.unknown
        yield events.to_host(), edges


def _evt_events(about: EvtFile, notes: dict[str, int]) -> Iterator[Packet]:
    """Yield the events of a RAW file."""
    for events, _ in _decoded(about, notes):
        if about.origin:
            np.add(events.t, about.origin, out=events.t)
        yield events


def _last_evt_time(about: EvtFile, estimate: int) -> int | None:
    """Return the time of the last event of a file of EVT 2.0 or 2.1 [us], from its last words."""
    count = (about.path.stat().st_size - about.offset) // about.word
    first = max(count - EVT_BYTES // about.word, 0)
    with open_input(about.path) as file:
        file.seek(about.offset + first * about.word)
        words = about.words(file.read(EVT_BYTES))
    events, _ = about.decoder().decode(words)
    t = events.t.numpy()
    if not t.size:
        return None
    last = int(t[-1]) + about.origin
    return nearest(last, 34, estimate)


def _is_swapped(path: Path, offset: int, layout: str) -> bool:
    """Return whether a file of EVT 2.1 has swapped halves, according to its header's ``layout`` or its first words."""
    if "endianness=" in layout:
        return "endianness=legacy" in layout
    with open_input(path) as file:
        file.seek(offset)
        found = halves_of(words_of(file.read(EVT_BYTES), "2.1"))
        return found is None or found.swapped
