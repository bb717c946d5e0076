"""Decoders of Prophesee's EVT 3.0. The passes and what they share with EVT 2.0: :mod:`amiwarp.kernels.evt`.

A word has 16 bits: a type, and a part of the state or an event. A vector has one bit for each of 12 or 8 pixels, and
moves the base behind them. Most words are events, so the first pass does not follow the state word by word: it counts
words and searches for the last one of each type, in loops that CPU compilers vectorise.
"""

import warp as wp

from amiwarp import evt_types
from amiwarp.kernels.event_arrays import EventArrays, store_event
from amiwarp.kernels.evt import (
    LARGEST,
    NONE,
    TIME_HIGH,
    TRIGGER,
    Change,
    Place,
    State,
    TriggerArrays,
    lowest_bit,
    step_of,
    unchanged,
)
from amiwarp.kernels.native_code import load_uint16

wp.set_module_options({"enable_backward": False})

ROW = wp.constant(evt_types.ROW)
SINGLE = wp.constant(evt_types.SINGLE)
VECTOR_BASE = wp.constant(evt_types.VECTOR_BASE)
VECTOR_12 = wp.constant(evt_types.VECTOR_12)
VECTOR_8 = wp.constant(evt_types.VECTOR_8)
TIME_LOW = wp.constant(evt_types.TIME_LOW)

# Counts of 16 bits, in parts of so few words that they do not overflow: CPU compilers make the widest vectors of them.


@wp.func_native("""
    const uint16_t* word = (const uint16_t*)words.data;
    int count = 0;
    for (int first = start; first < stop; first += 4096) {
        const int end = first + 4096 < stop ? first + 4096 : stop;
        uint16_t part = 0;
        for (int i = first; i < end; ++i) {
            const uint16_t type = word[i] >> 12;
            const uint16_t pixels = type == 4 ? word[i] & 0xFFF : type == 5 ? word[i] & 0xFF : type == 2;
            const uint16_t pairs = pixels - ((pixels >> 1) & 0x5555);
            const uint16_t fours = (pairs & 0x3333) + ((pairs >> 2) & 0x3333);
            part += (fours & 0xF) + (fours >> 4 & 0xF) + (fours >> 8);
        }
        count += part;
    }
    return count;
""")
def count_events(words: wp.array(dtype=wp.uint16), start: int, stop: int) -> int:
    """Return the number of events in the words from ``start`` to before ``stop``."""


@wp.func_native("""
    const uint16_t* word = (const uint16_t*)words.data;
    const uint16_t wanted = kind;
    int count = 0;
    for (int first = start; first < stop; first += 32768) {
        const int end = first + 32768 < stop ? first + 32768 : stop;
        uint16_t part = 0;
        for (int i = first; i < end; ++i) part += (uint16_t)(word[i] >> 12) == wanted;
        count += part;
    }
    return count;
""")
def count_words(words: wp.array(dtype=wp.uint16), kind: int, start: int, stop: int) -> int:
    """Return the number of words of a kind from ``start`` to before ``stop``."""


@wp.func_native("""
    const uint16_t* word = (const uint16_t*)words.data;
    int count = 0;
    for (int first = start; first < stop; first += 32768) {
        const int end = first + 32768 < stop ? first + 32768 : stop;
        uint16_t part = 0;
        for (int i = first; i < end; ++i) {
            const uint16_t type = word[i] >> 12;
            part += (uint16_t)(((type & 7) == 1) | ((uint16_t)(type - 0xB) < 3));
        }
        count += part;
    }
    return count;
""")
def count_unknown(words: wp.array(dtype=wp.uint16), start: int, stop: int) -> int:
    """Return the number of words of the types 0x1, 0x9, 0xB, 0xC and 0xD, which EVT 3.0 does not define."""


@wp.func_native("""
    const uint16_t* word = (const uint16_t*)words.data;
    int i = start;
    for (; i + 64 <= stop; i += 64) {
        int found = 0;
        for (int k = 0; k < 64; ++k) found |= word[i + k] >> 12 == kind;
        if (found) break;
    }
    while (i < stop && word[i] >> 12 != kind) ++i;
    return i;
""")
def next_of(words: wp.array(dtype=wp.uint16), kind: int, start: int, stop: int) -> int:
    """Return the index of the first word of a kind from ``start`` on, or ``stop``. CPU compilers vectorise it."""


@wp.func_native("""
    const uint16_t* word = (const uint16_t*)words.data;
    int i = stop;
    for (; i - 64 >= start; i -= 64) {
        int found = 0;
        for (int k = 1; k <= 64; ++k) found |= word[i - k] >> 12 == kind;
        if (found) break;
    }
    for (--i; i >= start && word[i] >> 12 != kind; --i) {}
    return i < start ? -1 : i;
""")
def last_of(words: wp.array(dtype=wp.uint16), kind: int, start: int, stop: int) -> int:
    """Return the index of the last word of a kind from ``start`` to before ``stop``, or :data:`NONE`."""


@wp.kernel
def survey_evt3(
    words: wp.array(dtype=wp.uint16), length: int, start: int, changes: wp.array(dtype=Change)
):
    """Note what each block of ``length`` words changes."""
    block = wp.tid() + start
    begin = block * length
    end = wp.min(begin + length, words.shape[0])
    change = unchanged()

    # The time's upper bits, of which there are few words.
    first = int(end)
    latest = int(NONE)
    changed = int(end)
    i = next_of(words, TIME_HIGH, begin, end)
    while i < end:
        high = int(load_uint16(words, i)) & 0xFFF
        if latest == NONE:
            first = i
            changed = i
            change.first_high = high
        elif high != latest:
            change.rise += wp.int64(step_of(high, latest, 12))
            changed = i
        latest = high
        i = next_of(words, TIME_HIGH, i + 1, end)

    change.events = count_events(words, begin, end)
    change.triggers = count_words(words, TRIGGER, begin, end)
    change.unknown = count_unknown(words, begin, end)
    low = last_of(words, TIME_LOW, begin, first)
    if low != NONE:
        change.low_before = int(load_uint16(words, low)) & 0xFFF
    if first < end:
        change.early_events = count_events(words, begin, first)
        change.early_triggers = count_words(words, TRIGGER, begin, first)
        if changed > first:
            change.low_after = 0
        low = last_of(words, TIME_LOW, changed, end)
        if low != NONE:
            change.low_after = int(load_uint16(words, low)) & 0xFFF
    at = last_of(words, ROW, begin, end)
    if at != NONE:
        change.row = int(load_uint16(words, at)) & 0x7FF
    at = last_of(words, VECTOR_BASE, begin, end)
    if at != NONE:
        word = int(load_uint16(words, at))
        change.base = word & 0x7FF
        change.polarity = (word >> 11) & 1
    at = wp.max(at, begin)
    change.moved = 12 * count_words(words, VECTOR_12, at, end) + 8 * count_words(
        words, VECTOR_8, at, end
    )
    changes[block] = change


@wp.kernel
def decode_evt3(
    words: wp.array(dtype=wp.uint16),
    length: int,
    states: wp.array(dtype=State),
    places: wp.array(dtype=Place),
    start: int,
    events: EventArrays,
    triggers: TriggerArrays,
):
    """Write the events and the edges of each block, from the state at its start."""
    block = wp.tid() + start
    timed = states[block].timed
    high = states[block].high
    now = (high << wp.int64(12)) | wp.int64(states[block].low)
    row = wp.uint16(states[block].row)
    base = states[block].base
    polarity = wp.uint8(states[block].polarity)
    event = places[block].event
    trigger = places[block].trigger
    for i in range(block * length, wp.min((block + 1) * length, words.shape[0])):
        word = int(load_uint16(words, i))
        kind = word >> 12
        load = word & 0xFFF
        if kind == SINGLE:
            if timed != 0:
                store_event(events, event, wp.uint16(load & 0x7FF), row, now, wp.uint8(load >> 11))
                event += 1
        elif kind == ROW:
            row = wp.uint16(load & 0x7FF)
        elif kind == VECTOR_12 or kind == VECTOR_8:
            pixels = wp.uint32(load)
            width = int(12)
            if kind == VECTOR_8:
                pixels = wp.uint32(load & 0xFF)
                width = int(8)
            if timed != 0:
                while pixels != wp.uint32(0):
                    at = wp.uint16(wp.min(base + lowest_bit(pixels), LARGEST))
                    store_event(events, event, at, row, now, polarity)
                    event += 1
                    pixels = pixels & (pixels - wp.uint32(1))
            base += width
        elif kind == VECTOR_BASE:
            base = load & 0x7FF
            polarity = wp.uint8(load >> 11)
        elif kind == TIME_LOW:
            now = (high << wp.int64(12)) | wp.int64(load)
        elif kind == TIME_HIGH:
            if timed == 0:
                high = wp.int64(load)
                now = (high << wp.int64(12)) | (now & wp.int64(0xFFF))
                timed = int(1)
            else:
                step = step_of(load, int(high & wp.int64(0xFFF)), 12)
                if step != 0:  # a new TIME_HIGH starts at its beginning, until the next TIME_LOW
                    high += wp.int64(step)
                    now = high << wp.int64(12)
        elif kind == TRIGGER:
            if timed != 0:
                triggers.channel[trigger] = wp.uint8(load >> 8)
                triggers.t[trigger] = now
                triggers.rising[trigger] = wp.uint8(load & 1)
                trigger += 1
