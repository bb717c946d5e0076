"""Prophesee's files and words: RAW (EVT 2.0, 2.1, 3.0) is read and written; DAT files are read."""

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.recording import DEFAULT_BLOCK, Events, Recording
from amiwarp.io.evt_decoder import WORD_TYPES, EventColumns, EvtDecoder, Triggers
from amiwarp.io.file_scan import FileEvents, Packet, last_word, nearest, read_pieces, read_words, unwrapped
from amiwarp.io.files import errors_name, open_input
from amiwarp.io.formats import LONGEST_US, Outline
from amiwarp.validation import TIME_LIMIT

# Decoders of Prophesee's EVT words with NumPy: EVT 2.0, 2.1 and 3.0, for streams that arrive in pieces.
#
# The words are those of Prophesee's documentation of the formats. Messages of ROS are decoded with these, in the
# process that reads the bag; files with :class:`EvtDecoder`.

Columns: TypeAlias = tuple[NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any]]
"""Arrays x, y [px], t [us], p of events; or channel, 0, t [us] and 1 for a rising edge, of triggers."""

TIME_HIGH, TRIGGER = 0x8, 0xA
"""Types of words that all versions share."""


def words_of(data: bytes | NDArray[np.uint8], version: str) -> NDArray[Any]:
    """Return the whole words of some bytes: uint16 for EVT 3.0, uint32 for 2.0, uint64 for 2.1."""
    dtype = np.dtype({"3": "<u2", "2": "<u4"}.get(version, "<u8"))
    count = len(data) // dtype.itemsize
    return np.frombuffer(data, dtype, count)


def swap_halves(words: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Swap the 32-bit halves of EVT 2.1 words, as the IMX636 sends them (``endianness=legacy``)."""
    return (words >> np.uint64(32)) | (words << np.uint64(32))


def _latest(mask: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return for each element the index of the last true element up to it, or -1."""
    return np.maximum.accumulate(np.where(mask, np.arange(mask.size), -1))


@dataclass(slots=True)
class Evt2Decoder:
    """Decoder of EVT 2.0 and 2.1. Events before the first time word have no time and are dropped."""

    vectors: bool
    """Whether the words are those of EVT 2.1, with 32 pixels each."""
    high: int | None = None
    """Last time word, unwrapped [64 us], or None."""

    def decode(self, words: NDArray[Any]) -> tuple[Columns, Columns]:
        """Return the events and the triggers of the words that follow those of the last call."""
        head = (words >> np.uint64(32)).astype(np.int64) if self.vectors else words.astype(np.int64)
        kind = head >> 28
        is_high = kind == TIME_HIGH
        highs = unwrapped(head[is_high] & 0xFFFFFFF, 28, self.high)
        times = np.concatenate([[self.high or 0], highs])[np.cumsum(is_high)]
        known = np.cumsum(is_high) > 0 if self.high is None else np.ones(head.size, np.bool_)
        t = (times << 6) | (head >> 22) & 0x3F
        if highs.size:
            self.high = int(highs[-1])
        events = known & (kind <= 1)
        trigger = known & (kind == TRIGGER)
        edges = head[trigger]
        triggers = edges >> 8 & 0x1F, np.zeros(edges.size, np.int64), t[trigger], edges & 1
        x, y, p = head[events] >> 11 & 0x7FF, head[events] & 0x7FF, kind[events]
        if not self.vectors:
            return (x, y, t[events], p), triggers
        valid = (words[events] & np.uint64(0xFFFFFFFF)).astype("<u4").view(np.uint8)
        which, bit = np.nonzero(np.unpackbits(valid, bitorder="little").reshape(-1, 32))
        return (x[which] + bit, y[which], t[events][which], p[which]), triggers


@dataclass(slots=True)
class Evt3Decoder:
    """Decoder of EVT 3.0, whose words change a state. Events before the first time word are dropped."""

    high: int | None = None
    """Last TIME_HIGH, unwrapped [4096 us], or None."""
    state: dict[str, int] = field(default_factory=lambda: {"low": 0, "y": 0, "base": 0, "p": 0})
    """Last time within TIME_HIGH [us], row, column of the next vector [px], and polarity of vectors."""

    def decode(self, words: NDArray[np.uint16]) -> tuple[Columns, Columns]:
        """Return the events and the triggers of the words that follow those of the last call."""
        kind, load = (words >> 12).astype(np.int8), (words & 0xFFF).astype(np.int64)
        t, known = self._times(kind, load)
        y = self._filled("y", kind == 0x0, load & 0x7FF)
        triggers = known & (kind == TRIGGER)
        at = np.flatnonzero(triggers)
        edges = load[at] >> 8, np.zeros(at.size, np.int64), t[at], load[at] & 1
        vector = (kind == 0x4) | (kind == 0x5)
        base, polarity = self._bases(kind, load, vector)
        vectors = np.flatnonzero(vector & known)
        mask = np.where(kind[vectors] == 0x4, load[vectors], load[vectors] & 0xFF).astype("<u2")
        row, bit = np.nonzero(np.unpackbits(mask.view(np.uint8), bitorder="little").reshape(-1, 16))
        count = (known & (kind == 0x2)).astype(np.int64)
        count[vectors] = np.bincount(row, minlength=vectors.size)
        which = np.repeat(np.arange(kind.size), count)
        x, p = load[which] & 0x7FF, load[which] >> 11
        of_vector = vector[which]
        x[of_vector], p[of_vector] = base[vectors][row] + bit, polarity[vectors][row]
        return (x, y[which], t[which], p), edges

    def _times(self, kind: NDArray[Any], load: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Return the time of each word [us], and whether it is known."""
        is_high = kind == TIME_HIGH
        highs = unwrapped(load[is_high], 12, self.high)
        before = highs[0] if self.high is None and highs.size else self.high or 0
        all_highs = np.concatenate([[before], highs])
        known = np.cumsum(is_high) > 0 if self.high is None else np.ones(kind.size, np.bool_)
        # A new TIME_HIGH starts at its beginning, until the next TIME_LOW.
        is_low = kind == 0x6
        is_low[np.flatnonzero(is_high)[np.diff(all_highs) != 0]] = True
        low = self._filled("low", is_low, np.where(is_high, 0, load))
        if highs.size:
            self.high = int(highs[-1])
        return (all_highs[np.cumsum(is_high)] << 12) | low, known

    def _filled(self, name: str, mask: NDArray[np.bool_], values: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the last masked value up to each word, starting from the state, and update the state."""
        filled = np.concatenate([values, [self.state[name]]])[_latest(mask)]
        if filled.size:
            self.state[name] = int(filled[-1])
        return filled

    def _bases(
        self, kind: NDArray[Any], load: NDArray[np.int64], vector: NDArray[np.bool_]
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the column of the first pixel and the polarity of each vector. A vector moves the base behind it."""
        is_base = kind == 0x3
        polarity = self._filled("p", is_base, load >> 11)
        width = np.where(kind == 0x4, 12, 8) * vector
        moved = np.cumsum(width) - width
        start, latest = self.state["base"], _latest(is_base)
        base = np.where(latest < 0, start + moved, (load & 0x7FF)[latest] + moved - moved[latest])
        if base.size:
            self.state["base"] = int(base[-1] + width[-1])
        return base, polarity


# Readers of Prophesee's files: RAW with the decoder in Warp, DAT with NumPy.

EVT_BYTES = 1 << 21
"""Number of bytes of EVT words that are decoded at once. They hold at most 13 million events."""

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


@dataclass(frozen=True, slots=True)
class EvtFile:
    """Header of a RAW file."""

    path: Path
    fields: dict[str, str]
    """Values by lower-case key."""
    version: str
    """Version of EVT, as the header names it."""
    offset: int
    """Position of the first word [bytes]."""
    word: int
    """Size of a word [bytes]."""
    swapped: bool
    """Whether the 32-bit halves of the words are swapped, see :func:`swap_halves`."""
    origin: int
    """Time that is added to those of the words [us]: ``t0`` of the header, which amiwarp and faery write."""

    def words(self, data: bytes) -> NDArray[Any]:
        """Return the whole words of some bytes of the file, with halves as they are stored."""
        return np.frombuffer(data, WORD_TYPES[VERSION_OF[self.word]], len(data) // self.word)

    def decoder(self) -> EvtDecoder:
        """Return a new decoder of the file's words."""
        return EvtDecoder(VERSION_OF[self.word], swapped=self.swapped)


def open_evt(path: Path) -> Recording:
    """Open a RAW file."""
    about = _read_evt_header(path)
    last = None if about.word == 2 else partial(_last_evt_time, about)
    events = FileEvents(path, partial(_evt_events, about), size=_evt_size(about.fields), last_time=last)
    truncated = (path.stat().st_size - about.offset) % about.word
    noted = {"truncated_bytes": truncated} if truncated else {}
    return Recording(
        events=events, metadata={"format": f"evt{about.version}", **noted, **events.metadata}, name=path.stem
    )


def _read_evt_header(path: Path) -> EvtFile:
    fields, offset = _read_header(path)
    version = fields.get("evt") or fields.get("format", "").removeprefix("EVT").partition(";")[0]
    word = {"2.0": 4, "2": 4, "2.1": 8, "21": 8, "3.0": 2, "3": 2}.get(version)
    if word is None:
        raise AmiwarpError(f"{path}: EVT version in the header is '{version[:40]}'; expected 2.0, 2.1 or 3.0")
    origin = fields.get("t0", "0")
    if not re.fullmatch(r"[0-9]{1,19}", origin) or int(origin) > TIME_LIMIT:
        raise AmiwarpError(f"{path}: t0 in the header is '{origin[:40]}'; expected a time of 0 to {TIME_LIMIT} us")
    swapped = word == 8 and _is_swapped(path, offset, fields.get("format", ""))
    return EvtFile(path, fields, "2.1" if word == 8 else version, offset, word, swapped, int(origin))


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
    about = _read_evt_header(path)
    for _, edges in _decoded(about, {}):
        yield edges.channel, np.zeros_like(edges.channel), edges.t + about.origin, edges.rising


def _decoded(about: EvtFile, notes: dict[str, int]) -> Iterator[tuple[EventColumns, Triggers]]:
    """Yield the events and the triggers of a RAW file, and note what was counted."""
    decoder = about.decoder()
    for data in read_pieces(about.path, about.offset, EVT_BYTES, notes):
        events, edges = decoder.decode(about.words(data))
        notes["triggers"] = notes.get("triggers", 0) + len(edges.t)
        notes["dropped_untimed_events"] = decoder.untimed
        yield events, edges


def _evt_events(about: EvtFile, notes: dict[str, int]) -> Iterator[Packet]:
    """Yield the events of a RAW file."""
    for events, _ in _decoded(about, notes):
        if about.origin:
            np.add(events.t, about.origin, out=events.t)
        yield Events(*events)


def _last_evt_time(about: EvtFile, estimate: int) -> int | None:
    """Return the time of the last event of a file of EVT 2.0 or 2.1 [us]. Times of EVT 3.0 wrap after 17 s."""
    count = (about.path.stat().st_size - about.offset) // about.word
    with open_input(about.path) as file:
        file.seek(about.offset + max(count - EVT_BYTES // about.word, 0) * about.word)
        words = about.words(file.read(EVT_BYTES))
    t = about.decoder().decode(words)[0].t
    return nearest(int(t[-1]) + about.origin, 34, estimate) if t.size else None


def _is_swapped(path: Path, offset: int, layout: str) -> bool:
    """Return whether a file of EVT 2.1 has swapped halves, according to its header's ``layout`` or its first words."""
    if "endianness=" in layout:
        return "endianness=legacy" in layout
    with open_input(path) as file:
        file.seek(offset)
        return _halves_are_swapped(words_of(file.read(EVT_BYTES), "2.1"))


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
    for words in read_words(path, offset, "<u4", DEFAULT_BLOCK, notes):
        rest = words[:, 1]
        if not rest.size:
            return
        t = unwrapped(words[:, 0].astype(np.int64), 32, last)
        last = int(t[-1])
        x = rest & ((1 << bits[0]) - 1)
        y = (rest >> y_shift) & ((1 << bits[1]) - 1)
        yield x, y, t, (rest >> p_shift) & 1


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


def origin_of(about: Outline) -> int:
    """Return the time at which the clock of EVT 3.0 starts [us]: 0, or the first event if that is very late."""
    return 0 if about.t_last <= LONGEST_US else about.t_first


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


def write_evt3(part: Path, blocks: Iterable[Events], about: Outline) -> None:
    """Write all events into a RAW file. Its header has the lines that Prophesee's own programs need."""
    size = f"height={about.height};width={about.width}"
    origin = origin_of(about)
    header = [
        "camera_integrator_name Prophesee",
        "evt 3.0",
        f"format EVT3;{size}",
        f"geometry {about.width}x{about.height}",
        "plugin_integrator_name Prophesee",
        "plugin_name hal_plugin_prophesee",
        *([f"t0 {origin}"] if origin else []),
        "end",
    ]
    encoder = Evt3Encoder(origin)
    with part.open("xb") as file:
        file.write("".join(f"% {line}\n" for line in header).encode())
        for events in blocks:
            file.write(encoder.encode(events).astype("<u2").data)
