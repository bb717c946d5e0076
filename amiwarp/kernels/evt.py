"""Decoders of Prophesee's EVT 2.0, 2.1 and 3.0: a first pass finds the state at the start of each block of words.

An EVT word changes the decoder's state (time, row, column of the next vector) or is an event. So that all blocks can be
decoded at the same time, :func:`survey_evt2` and :func:`survey_evt3` note what each block changes, whatever the state
before it. Then the changes are followed: :func:`merge_blocks` finds what groups of blocks change, :func:`link_groups`
follows the groups with one thread, and :func:`link_blocks` the blocks of each group. :func:`decode_evt2` and
:func:`decode_evt3` decode each block from the state at its start. One thread reads one block.

The words are described at https://docs.prophesee.ai/stable/data/encoding_formats/index.html.
"""

from typing import Any

import warp as wp

from amiwarp.kernels.native_code import load_uint16

wp.set_module_options({"enable_backward": False})

NONE = wp.constant(-1)
"""Stands for what no word of a block has set."""
LARGEST = wp.constant(65535)
"""Largest coordinate that can be stored [px]."""

# Types of EVT 2.0 and 2.1 words, in their upper four bits.
ON = wp.constant(0x1)
"""Change detection ON. OFF is 0."""
TIME_HIGH = wp.constant(0x8)
"""Upper bits of the time, in all versions."""
TRIGGER = wp.constant(0xA)
"""Edge of an external trigger, in all versions."""

# Types of EVT 3.0 words, in their upper four bits.
ROW = wp.constant(0x0)
SINGLE = wp.constant(0x2)
VECTOR_BASE = wp.constant(0x3)
VECTOR_12 = wp.constant(0x4)
VECTOR_8 = wp.constant(0x5)
TIME_LOW = wp.constant(0x6)


@wp.struct
class State:
    """What the words so far determine for those that follow."""

    timed: int
    """Whether a TIME_HIGH word has come. Events before it have no time and are dropped."""
    high: wp.int64
    """Last TIME_HIGH, without its wraps [64 us, or 4096 us in EVT 3.0]."""
    low: int
    """Time after TIME_HIGH, of EVT 3.0 [us]."""
    row: int
    """Row of the next events, of EVT 3.0 [px]."""
    base: int
    """Column of the next vector, of EVT 3.0 [px]."""
    polarity: int
    """Polarity of the next vectors, of EVT 3.0."""


@wp.struct
class Change:
    """What a block of words changes, and what it holds. What no word sets is :data:`NONE`."""

    first_high: int
    """First TIME_HIGH of the block, as stored."""
    rise: wp.int64
    """Last TIME_HIGH of the block after its first one, without wraps."""
    low_before: int
    """Last TIME_LOW before the first TIME_HIGH."""
    low_after: int
    """Last TIME_LOW after the first TIME_HIGH; 0 if a TIME_HIGH with another value followed."""
    row: int
    base: int
    """Last VECTOR_BASE, without the vectors behind it."""
    moved: int
    """Width of the vectors after VECTOR_BASE, or of all vectors of the block without it [px]."""
    polarity: int
    events: int
    """Number of events."""
    triggers: int
    """Number of edges of triggers."""
    early_events: int
    """Number of events before the first TIME_HIGH."""
    early_triggers: int
    """Number of edges before the first TIME_HIGH."""


@wp.struct
class Place:
    """Where the output of a block begins, and how many events and edges before it came before the first TIME_HIGH."""

    event: int
    trigger: int
    untimed: int


@wp.struct
class EventArrays:
    """Decoded events."""

    x: wp.array(dtype=wp.uint16)
    """Columns [px]."""
    y: wp.array(dtype=wp.uint16)
    """Rows [px]."""
    t: wp.array(dtype=wp.int64)
    """Times [us]."""
    p: wp.array(dtype=wp.uint8)
    """Polarities: 1 is ON."""


@wp.struct
class TriggerArrays:
    """Decoded edges of external triggers."""

    channel: wp.array(dtype=wp.uint8)
    """Numbers of the inputs."""
    t: wp.array(dtype=wp.int64)
    """Times [us]."""
    rising: wp.array(dtype=wp.uint8)
    """1 for a rising edge."""


@wp.func
def unchanged() -> Change:
    """Return the change by a block without words."""
    change = Change()
    change.first_high = NONE
    change.low_before = NONE
    change.low_after = NONE
    change.row = NONE
    change.base = NONE
    change.polarity = NONE
    return change


@wp.func
def set_bits(mask: wp.uint32) -> int:
    """Return the number of set bits."""
    pairs = mask - ((mask >> wp.uint32(1)) & wp.uint32(0x55555555))
    fours = (pairs & wp.uint32(0x33333333)) + ((pairs >> wp.uint32(2)) & wp.uint32(0x33333333))
    bytes_ = (fours + (fours >> wp.uint32(4))) & wp.uint32(0x0F0F0F0F)
    return int((bytes_ * wp.uint32(0x01010101)) >> wp.uint32(24))


@wp.func_native("""
#ifdef __CUDA_ARCH__
    return __ffs(mask) - 1;
#else
    return __builtin_ctz(mask);
#endif
""")
def lowest_bit(mask: wp.uint32) -> int:
    """Return the position of the lowest set bit of a mask that is not 0."""


@wp.func_native("""
    ((uint16_t*)events.x.data)[i] = column;
    ((uint16_t*)events.y.data)[i] = row;
    ((int64_t*)events.t.data)[i] = now;
    ((uint8_t*)events.p.data)[i] = polarity;
""")
def store_event(events: EventArrays, i: int, column: wp.uint16, row: wp.uint16, now: wp.int64, polarity: wp.uint8):
    """Store event ``i`` in contiguous arrays."""


@wp.func
def step_of(value: int, last: int, bits: int) -> int:
    """Return the step of a counter of ``bits`` bits. A step of more than half its range is a wrap, either way."""
    half = 1 << (bits - 1)
    step = value - last
    if step < -half:
        step += 2 * half
    elif step > half:
        step -= 2 * half
    return step


# EVT 2.0 and 2.1. A word of EVT 2.1 has the same upper half, and one bit for each of 32 pixels in its lower half.


@wp.func
def head_of(word: wp.uint32, swapped: int) -> wp.uint32:
    """Return type, time and place of a word."""
    return word


@wp.func
def head_of(word: wp.uint64, swapped: int) -> wp.uint32:
    """Return type, time and place of a word."""
    if swapped != 0:
        return wp.uint32(word)
    return wp.uint32(word >> wp.uint64(32))


@wp.func
def pixels_of(word: wp.uint32, swapped: int) -> wp.uint32:
    """Return which pixels from the word's place on have an event."""
    return wp.uint32(1)


@wp.func
def pixels_of(word: wp.uint64, swapped: int) -> wp.uint32:
    """Return which pixels from the word's place on have an event."""
    if swapped != 0:
        return wp.uint32(word >> wp.uint64(32))
    return wp.uint32(word)


@wp.kernel
def survey_evt2(words: wp.array(dtype=Any), length: int, swapped: int, start: int, changes: wp.array(dtype=Change)):
    """Note what each block of ``length`` words changes."""
    block = wp.tid() + start
    change = unchanged()
    last = int(NONE)
    for i in range(block * length, wp.min((block + 1) * length, words.shape[0])):
        head = head_of(words[i], swapped)
        kind = int(head >> wp.uint32(28))
        if kind <= ON:
            change.events += set_bits(pixels_of(words[i], swapped))
        elif kind == TIME_HIGH:
            high = int(head & wp.uint32(0xFFFFFFF))
            if last == NONE:
                change.first_high = high
                change.early_events = change.events
                change.early_triggers = change.triggers
            else:
                change.rise += wp.int64(step_of(high, last, 28))
            last = high
        elif kind == TRIGGER:
            change.triggers += 1
    changes[block] = change


@wp.kernel
def decode_evt2(
    words: wp.array(dtype=Any),
    length: int,
    swapped: int,
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
    event = places[block].event
    trigger = places[block].trigger
    for i in range(block * length, wp.min((block + 1) * length, words.shape[0])):
        head = head_of(words[i], swapped)
        kind = int(head >> wp.uint32(28))
        if kind == TIME_HIGH:
            value = int(head & wp.uint32(0xFFFFFFF))
            if timed == 0:
                high = wp.int64(value)
                timed = int(1)
            else:
                high += wp.int64(step_of(value, int(high & wp.int64(0xFFFFFFF)), 28))
        elif timed != 0:
            now = (high << wp.int64(6)) | wp.int64((head >> wp.uint32(22)) & wp.uint32(0x3F))
            if kind <= ON:
                pixels = pixels_of(words[i], swapped)
                column = int((head >> wp.uint32(11)) & wp.uint32(0x7FF))
                row = wp.uint16(head & wp.uint32(0x7FF))
                while pixels != wp.uint32(0):
                    at = wp.uint16(column + lowest_bit(pixels))
                    store_event(events, event, at, row, now, wp.uint8(kind))
                    event += 1
                    pixels = pixels & (pixels - wp.uint32(1))
            elif kind == TRIGGER:
                triggers.channel[trigger] = wp.uint8((head >> wp.uint32(8)) & wp.uint32(0x1F))
                triggers.t[trigger] = now
                triggers.rising[trigger] = wp.uint8(head & wp.uint32(1))
                trigger += 1


for _word in (wp.uint32, wp.uint64):
    wp.overload(survey_evt2, {"words": wp.array(dtype=_word)})
    wp.overload(decode_evt2, {"words": wp.array(dtype=_word)})


# EVT 3.0. A vector has one bit for each of 12 or 8 pixels, and moves the base behind them.


@wp.func_native("""
    const uint16_t* word = (const uint16_t*)words.data;
    int count = 0;
    for (int i = start; i < stop; ++i) {
        const uint16_t type = word[i] >> 12;
        const uint16_t pixels = type == 4 ? word[i] & 0xFFF : type == 5 ? word[i] & 0xFF : type == 2;
        const uint16_t pairs = pixels - ((pixels >> 1) & 0x5555);
        const uint16_t fours = (pairs & 0x3333) + ((pairs >> 2) & 0x3333);
        count += (fours & 0xF) + (fours >> 4 & 0xF) + (fours >> 8);
    }
    return count;
""")
def count_events(words: wp.array(dtype=wp.uint16), start: int, stop: int) -> int:
    """Return the number of events in the words from ``start`` to before ``stop``. CPU compilers vectorise it."""


@wp.func_native("""
    const uint16_t* word = (const uint16_t*)words.data;
    int count = 0;
    for (int i = start; i < stop; ++i) count += word[i] >> 12 == kind;
    return count;
""")
def count_words(words: wp.array(dtype=wp.uint16), kind: int, start: int, stop: int) -> int:
    """Return the number of words of a kind from ``start`` to before ``stop``. CPU compilers vectorise it."""


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
def survey_evt3(words: wp.array(dtype=wp.uint16), length: int, start: int, changes: wp.array(dtype=Change)):
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
    change.moved = 12 * count_words(words, VECTOR_12, at, end) + 8 * count_words(words, VECTOR_8, at, end)
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


# All versions.


@wp.func
def followed(state: State, change: Change, bits: int) -> State:
    """Return the state after a block. ``bits``: number of bits of TIME_HIGH."""
    after = State()
    after.timed = state.timed
    after.high = state.high
    after.low = state.low
    if change.low_before != NONE:
        after.low = change.low_before
    if change.first_high != NONE:
        if state.timed == 0:
            after.high = wp.int64(change.first_high)
        else:
            size = wp.int64(1) << wp.int64(bits)
            step = step_of(change.first_high, int(state.high & (size - wp.int64(1))), bits)
            after.high += wp.int64(step)
            if step != 0:
                after.low = 0
        after.timed = 1
        after.high += change.rise
        if change.low_after != NONE:
            after.low = change.low_after
    after.row = state.row
    if change.row != NONE:
        after.row = change.row
    after.base = state.base + change.moved
    after.polarity = state.polarity
    if change.base != NONE:
        after.base = change.base + change.moved
        after.polarity = change.polarity
    after.base = wp.min(after.base, LARGEST)
    return after


@wp.func
def merged(first: Change, second: Change, bits: int) -> Change:
    """Return the change by two blocks that follow one another. ``bits``: number of bits of TIME_HIGH."""
    both = first
    both.events += second.events
    both.triggers += second.triggers
    if first.first_high == NONE:
        both.first_high = second.first_high
        both.rise = second.rise
        both.low_after = second.low_after
        if second.low_before != NONE:
            both.low_before = second.low_before
        both.early_events = first.events + second.early_events
        both.early_triggers = first.triggers + second.early_triggers
    else:
        if second.low_before != NONE:
            both.low_after = second.low_before
        if second.first_high != NONE:
            size = wp.int64(1) << wp.int64(bits)
            last = (wp.int64(first.first_high) + first.rise) & (size - wp.int64(1))
            step = wp.int64(step_of(second.first_high, int(last), bits))
            both.rise += step + second.rise
            if step != wp.int64(0):
                both.low_after = 0
            if second.low_after != NONE:
                both.low_after = second.low_after
    if second.row != NONE:
        both.row = second.row
    if second.base != NONE:
        both.base = second.base
        both.moved = second.moved
        both.polarity = second.polarity
    else:
        both.moved += second.moved
    return both


@wp.func
def after_block(place: Place, state: State, change: Change) -> Place:
    """Return the place after a block that begins in a state."""
    events = change.events
    triggers = change.triggers
    if state.timed == 0:
        if change.first_high == NONE:
            events = 0
            triggers = 0
        else:
            events -= change.early_events
            triggers -= change.early_triggers
    after = Place()
    after.event = place.event + events
    after.trigger = place.trigger + triggers
    after.untimed = place.untimed + change.events - events + change.triggers - triggers
    return after


@wp.kernel
def merge_blocks(changes: wp.array(dtype=Change), size: int, bits: int, start: int, groups: wp.array(dtype=Change)):
    """Find what each group of ``size`` blocks changes."""
    group = wp.tid() + start
    change = changes[group * size]
    for block in range(group * size + 1, wp.min((group + 1) * size, changes.shape[0])):
        change = merged(change, changes[block], bits)
    groups[group] = change


@wp.kernel
def link_groups(
    groups: wp.array(dtype=Change), bits: int, states: wp.array(dtype=State), places: wp.array(dtype=Place)
):
    """Find the state and the place at the start of each group, and at the end of all. One thread.

    ``states[0]`` is given. Both outputs have one element more than there are groups.
    """
    # Local variables: one thread would wait for each value that it reads back from a GPU's memory.
    state = states[0]
    place = Place()
    for group in range(groups.shape[0]):
        change = groups[group]
        states[group] = state
        places[group] = place
        place = after_block(place, state, change)
        state = followed(state, change, bits)
    states[groups.shape[0]] = state
    places[groups.shape[0]] = place


@wp.kernel
def link_blocks(
    changes: wp.array(dtype=Change),
    size: int,
    bits: int,
    group_states: wp.array(dtype=State),
    group_places: wp.array(dtype=Place),
    start: int,
    states: wp.array(dtype=State),
    places: wp.array(dtype=Place),
):
    """Find the state and the place at the start of each block, from those of its group of ``size`` blocks."""
    group = wp.tid() + start
    state = group_states[group]
    place = group_places[group]
    for block in range(group * size, wp.min((group + 1) * size, changes.shape[0])):
        change = changes[block]
        states[block] = state
        places[block] = place
        place = after_block(place, state, change)
        state = followed(state, change, bits)
