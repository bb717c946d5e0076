"""Prophesee's files and words: RAW (EVT 2.0, 2.1, 3.0) and DAT are read; EVT 2.1, EVT 3.0 and DAT are written."""

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.recording import Events, Recording
from amiwarp.io.evt_decoder import WORD_TYPES, EvtDecoder, Triggers
from amiwarp.io.file_scan import FileEvents, Packet, nearest, read_pieces, unwrapped
from amiwarp.io.files import errors_name, open_input
from amiwarp.io.formats import LONGEST_EVT21_US, Outline, origin_of
from amiwarp.validation import TIME_LIMIT

# Words of the encodings.


def words_of(data: bytes | NDArray[np.uint8], version: str) -> NDArray[Any]:
    """Return the whole words of some bytes, in a version of EVT."""
    dtype = np.dtype(WORD_TYPES[version])
    return np.frombuffer(data, dtype, len(data) // dtype.itemsize)


TIME_HIGH = 0x8
"""Type of the words with the upper bits of the time."""

TYPES = (0x0, 0x1, TIME_HIGH, 0xA, 0xE, 0xF)
"""Types of EVT 2.1 words: events, time, triggers, and words for other uses."""


@dataclass(frozen=True, slots=True)
class Halves:
    """Order of the 32-bit halves of EVT 2.1 words."""

    swapped: bool
    """Whether the half with type and time comes first, as the IMX636 writes them (``endianness=legacy``)."""
    certain: bool
    """Whether only this order fits."""


def halves_of(words: NDArray[np.uint64]) -> Halves | None:
    """Return the order in which the halves of some words have known types and times that rise, or None.

    If both fit, times that stand still are less likely, then fewer times.
    """
    found = {}
    for swapped, heads in ((True, words & np.uint64(0xFFFFFFFF)), (False, words >> np.uint64(32))):
        kind = heads >> np.uint64(28)
        times = (heads[kind == TIME_HIGH] & np.uint64(0xFFFFFFF)).astype(np.int64)
        steps = np.diff(unwrapped(times, 28))
        typed = np.count_nonzero(np.isin(kind, TYPES)) * 100 >= 99 * kind.size
        if times.size and typed and np.count_nonzero(steps < 0) * 10 <= steps.size:
            found[swapped] = (bool(steps.any()), times.size)
    if not found:
        return None
    best = max(found, key=lambda swapped: found[swapped])
    others = [fit for swapped, fit in found.items() if swapped != best]
    return Halves(best, certain=not others or (found[best][0] and not others[0][0]))


# Reader of RAW files.

EVT_BYTES = 1 << 22
"""Number of bytes of EVT words that are decoded at once. They hold at most 26 million events."""

VERSION_OF = {2: "3.0", 4: "2.0", 8: "2.1"}
"""Version of EVT by the size of its words [bytes]."""

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
        while (line := file.readline(4096)).startswith(b"%") and line.endswith(b"\n"):
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
    """Time that is added to those of the words [us]: ``t0`` of the header, which amiwarp and faery write."""

    def words(self, data: bytes) -> NDArray[Any]:
        """Return the whole words of some bytes of the file, with halves as they are stored."""
        return words_of(data, self.version)

    def decoder(self) -> EvtDecoder:
        """Return a new decoder of the file's words."""
        return EvtDecoder(self.version, swapped=self.swapped)


def open_evt(path: Path) -> Recording:
    """Open a RAW file."""
    about = read_evt_header(path)
    last = None if about.word == 2 else partial(_last_evt_time, about)
    events = FileEvents(path, partial(_evt_events, about), size=_evt_size(about.fields), last_time=last)
    truncated = (path.stat().st_size - about.offset) % about.word
    noted = {"truncated_bytes": truncated} if truncated else {}
    return Recording(
        events=events, metadata={"format": f"evt{about.version}", **noted, **events.metadata}, name=path.stem
    )


def read_evt_header(path: Path) -> EvtFile:
    fields, offset = read_header(path)
    version = fields.get("evt") or fields.get("format", "").removeprefix("EVT").partition(";")[0]
    word = {"2.0": 4, "2": 4, "2.1": 8, "21": 8, "3.0": 2, "3": 2}.get(version)
    if word is None:
        raise AmiwarpError(f"{path}: EVT version in the header is '{version[:40]}'; expected 2.0, 2.1 or 3.0")
    swapped = word == 8 and _is_swapped(path, offset, fields.get("format", ""))
    return EvtFile(path, fields, VERSION_OF[word], offset, word, swapped, stated_origin(path, fields))


def stated_origin(path: Path, fields: dict[str, str]) -> int:
    """Return the time that is added to all times of a file [us]: ``t0`` of the header, or 0."""
    origin = fields.get("t0", "0")
    if not re.fullmatch(r"[0-9]{1,19}", origin) or int(origin) > TIME_LIMIT:
        raise AmiwarpError(f"{path}: t0 in the header is '{origin[:40]}'; expected a time of 0 to {TIME_LIMIT} us")
    return int(origin)


def _evt_size(fields: dict[str, str]) -> tuple[int, int] | None:
    """Return the sensor size in a header [px]; None if the header has no size."""
    if match := re.fullmatch(r"(\d+)x(\d+)", fields.get("geometry", "")):
        return int(match[1]), int(match[2])
    parts = dict(part.partition("=")[::2] for part in fields.get("format", "").split(";") if "=" in part)
    if parts.get("width", "").isdecimal() and parts.get("height", "").isdecimal():
        return int(parts["width"]), int(parts["height"])
    names = f"{fields.get('plugin_name')} {fields.get('sensor_name')} {fields.get('generation')}".lower()
    match = re.search("|".join(sorted(GENERATIONS, key=len, reverse=True)), names.replace(".", ""))
    return GENERATIONS[match[0]] if match else None


def trigger_packets(path: Path) -> Iterator[Packet]:
    """Yield the edges of the external triggers of a RAW file."""
    about = read_evt_header(path)
    for _, edges in _decoded(about, {}):
        yield edges.channel, np.zeros_like(edges.channel), edges.t + about.origin, edges.rising


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
    """Return the time of the last event of a file of EVT 2.0 or 2.1 [us]. Times of EVT 3.0 wrap after 17 s."""
    count = (about.path.stat().st_size - about.offset) // about.word
    with open_input(about.path) as file:
        file.seek(about.offset + max(count - EVT_BYTES // about.word, 0) * about.word)
        words = about.words(file.read(EVT_BYTES))
    t = about.decoder().decode(words)[0].t.numpy()
    return nearest(int(t[-1]) + about.origin, 34, estimate) if t.size else None


def _is_swapped(path: Path, offset: int, layout: str) -> bool:
    """Return whether a file of EVT 2.1 has swapped halves, according to its header's ``layout`` or its first words."""
    if "endianness=" in layout:
        return "endianness=legacy" in layout
    with open_input(path) as file:
        file.seek(offset)
        found = halves_of(words_of(file.read(EVT_BYTES), "2.1"))
        return found is None or found.swapped


# Encoder of events in Prophesee's EVT 3.0, and writer of RAW files with them.
#
# EVT 3.0 consists of 16-bit words that set the state of the decoder: upper and lower 12 bits of the time, row, and
# column with polarity. The last one is an event. A word is written if its value changes. The format is described at
# https://docs.prophesee.ai/stable/data/encoding_formats/evt3.html. faery's encoder is not used, because it loses gaps
# of more than 16.8 s, the range of the 24 bits of the time.

ADDR_Y, ADDR_X, TIME_LOW, TIME_HIGH_WORD = 0x0000, 0x2000, 0x6000, 0x8000
"""Types of the words, in their upper four bits."""

LOW_BITS = 12
"""Bits of the time in each of the two words."""

STOPS = (0x000, 0x7FF, 0xFFF)
"""Values that the upper bits of the time never skip. Decoders take other large steps for a step back or for a wrap."""


class Evt3Encoder:
    """Encoder of events that follow one another in time, from ``origin`` [us] on."""

    def __init__(self, origin: int) -> None:
        self._origin = origin
        self._last: tuple[int, int, int] | None = None  # upper bits of the time, time, row

    def encode(self, events: Events, *, self_contained: bool = False) -> NDArray[np.uint16]:
        """Return the words of some events, at least one. Self-contained words begin with time and row."""
        t = events.t - self._origin
        high, y = t >> LOW_BITS, events.y
        begins = self_contained or self._last is None
        last_high, last_t, last_y = self._last or (0, 0, 0)
        words = np.empty((len(events), 4), np.uint16)
        used = np.ones((len(events), 4), np.bool_)
        for at, values, last in ((0, high, last_high), (1, t, last_t), (2, y, last_y)):
            np.not_equal(values[1:], values[:-1], out=used[1:, at])
            used[0, at] = begins or values[0] != last
        words[:, 0] = TIME_HIGH_WORD | (high & 0xFFF)
        words[:, 1] = TIME_LOW | (t & 0xFFF)
        words[:, 2] = ADDR_Y | y
        words[:, 3] = ADDR_X | (events.p.astype(np.uint16) << 11) | events.x
        self._last = int(high[-1]), int(t[-1]), int(y[-1])
        return _with_stops(words[used], used, np.concatenate([[last_high], high]))


def _with_stops(words: NDArray[np.uint16], used: NDArray[np.bool_], high: NDArray[np.int64]) -> NDArray[np.uint16]:
    """Insert words for the stops that the upper bits of the time skip before an event."""
    steps = np.flatnonzero(np.diff(high) > 1)
    stops = [_stops_between(int(high[at]), int(high[at + 1])) for at in steps]
    skipped = [(at, values) for at, values in zip(steps.tolist(), stops, strict=True) if values.size]
    if not skipped:
        return words
    first_word = np.concatenate([[0], np.cumsum(used.sum(axis=1))])
    places = np.concatenate([np.full(values.size, first_word[at]) for at, values in skipped])
    return np.insert(words, places, np.concatenate([TIME_HIGH_WORD | values for _, values in skipped]))


def _stops_between(low: int, high: int) -> NDArray[np.uint16]:
    """Return the stops above ``low`` and below ``high``, in order, modulo 4096."""
    turns = np.arange(low >> LOW_BITS, (high >> LOW_BITS) + 1) << LOW_BITS
    stops = (turns[:, None] + np.array(STOPS)).ravel()
    return (stops[(stops > low) & (stops < high)] & 0xFFF).astype(np.uint16)


def _raw_header(about: Outline, version: str, name: str, origin: int, more: str = "") -> bytes:
    """Return the header of a RAW file, with the lines that Prophesee's own programs need."""
    lines = [
        "camera_integrator_name Prophesee",
        f"evt {version}",
        f"format {name};height={about.height};width={about.width}{more}",
        f"geometry {about.width}x{about.height}",
        "plugin_integrator_name Prophesee",
        "plugin_name hal_plugin_prophesee",
        *([f"t0 {origin}"] if origin else []),
        "end",
    ]
    return "".join(f"% {line}\n" for line in lines).encode()


def write_evt3(part: Path, blocks: Iterable[Events], about: Outline) -> None:
    """Write all events into a RAW file in EVT 3.0."""
    origin = origin_of(about)
    encoder = Evt3Encoder(origin)
    with part.open("xb") as file:
        file.write(_raw_header(about, "3.0", "EVT3", origin))
        for events in blocks:
            file.write(encoder.encode(events).astype("<u2").data)


# Writer of RAW files in EVT 2.1.
#
# EVT 2.1 consists of 64-bit words: the upper 28 bits of the time, or the lower 6 bits with row, column, polarity and
# the 32 pixels from that column on, one bit for each with an event. Successive events share a word as long as their
# columns rise, because a decoder returns them in the order of the columns: so the order of the events is kept. The
# format is described at https://docs.prophesee.ai/stable/data/encoding_formats/evt21.html.

VECTOR = 32
"""Pixels of a word."""


class Evt21Encoder:
    """Encoder of events that follow one another in time, from ``origin`` [us] on."""

    def __init__(self, origin: int) -> None:
        self._origin = origin
        self._high: int | None = None

    def encode(self, events: Events) -> NDArray[np.uint64]:
        """Return the words of some events, at least one."""
        t = (events.t - self._origin).astype(np.uint64)
        x = events.x.astype(np.uint64)
        y = events.y.astype(np.uint64)
        head = events.p.astype(np.uint64) << np.uint64(60)
        head |= (t & np.uint64(0x3F)) << np.uint64(54)
        head |= (x & ~np.uint64(VECTOR - 1)) << np.uint64(43)
        head |= y << np.uint64(32)
        high = t >> np.uint64(6)
        changes = np.empty(len(events), np.bool_)
        changes[0] = self._high != int(high[0])
        np.not_equal(high[1:], high[:-1], out=changes[1:])
        self._high = int(high[-1])
        begins = np.ones(len(events), np.bool_)
        begins[1:] = changes[1:] | (head[1:] != head[:-1]) | (x[1:] <= x[:-1])
        starts = np.flatnonzero(begins)
        bits = np.bitwise_or.reduceat(np.uint64(1) << (x & np.uint64(VECTOR - 1)), starts)
        words = head[starts] | bits
        timed = np.flatnonzero(changes[starts])
        times = np.uint64(TIME_HIGH << 60) | (high[starts[timed]] << np.uint64(32))
        return np.insert(words, timed, times)


def write_evt21(part: Path, blocks: Iterable[Events], about: Outline) -> None:
    """Write all events into a RAW file in EVT 2.1."""
    origin = origin_of(about, LONGEST_EVT21_US)
    encoder = Evt21Encoder(origin)
    with part.open("xb") as file:
        file.write(_raw_header(about, "2.1", "EVT21", origin, ";endianness=little"))
        for events in blocks:
            file.write(encoder.encode(events).astype("<u8").data)
