"""Decoders of Prophesee's EVT 2.0 and 2.1. The passes and what they share with EVT 3.0: :mod:`amiwarp.kernels.evt`.

A word of EVT 2.0 has 32 bits: type, lower bits of the time, column and row of one event. A word of EVT 2.1 has the same
upper half, and one bit for each of 32 pixels in its lower half. Some cameras send its halves swapped.
"""

from typing import Any

import warp as wp

from amiwarp import evt_types
from amiwarp.kernels.event_arrays import EventArrays, store_event
from amiwarp.kernels.evt import (
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

wp.set_module_options({"enable_backward": False})

ON = wp.constant(evt_types.ON)
TYPES = wp.constant(sum(1 << kind for kind in evt_types.EVT2))
"""Types that EVT 2.0 and 2.1 define, a bit for each."""


@wp.func
def set_bits(mask: wp.uint32) -> int:
    """Return the number of set bits."""
    pairs = mask - ((mask >> wp.uint32(1)) & wp.uint32(0x55555555))
    fours = (pairs & wp.uint32(0x33333333)) + ((pairs >> wp.uint32(2)) & wp.uint32(0x33333333))
    bytes_ = (fours + (fours >> wp.uint32(4))) & wp.uint32(0x0F0F0F0F)
    return int((bytes_ * wp.uint32(0x01010101)) >> wp.uint32(24))


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
def survey_evt2(
    words: wp.array(dtype=Any),
    length: int,
    swapped: int,
    start: int,
    changes: wp.array(dtype=Change),
):
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
        elif (TYPES >> kind) & 1 == 0:
            change.unknown += 1
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
