"""What all decoders of Prophesee's EVT words share: the state that words change, and how blocks of words are linked.

An EVT word changes the decoder's state (time, row, column of the next vector) or is an event. So that all blocks of
words can be decoded at the same time, a first pass notes what each block changes, whatever the state before it. Then
the changes are followed: :func:`merge_blocks` finds what groups of blocks change, :func:`link_groups` follows the
groups with one thread, and :func:`link_blocks` the blocks of each group. A second pass decodes each block from the
state at its start. One thread reads one block. Both passes are in :mod:`amiwarp.kernels.evt2`, for EVT 2.0 and 2.1,
and :mod:`amiwarp.kernels.evt3`.

The words are described at https://docs.prophesee.ai/stable/data/encoding_formats/index.html.
"""

import warp as wp

from amiwarp import evt_types

wp.set_module_options({"enable_backward": False})

NONE = wp.constant(-1)
"""Stands for what no word of a block has set."""
LARGEST = wp.constant(65535)
"""Largest coordinate that can be stored [px]."""

TIME_HIGH = wp.constant(evt_types.TIME_HIGH)
TRIGGER = wp.constant(evt_types.TRIGGER)


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
    unknown: int
    """Number of words of types that the format does not define."""


@wp.struct
class Place:
    """Where the output of a block begins, and what was passed over before it."""

    event: int
    trigger: int
    untimed: int
    """Number of events and edges before the first TIME_HIGH."""
    unknown: int
    """Number of words of unknown types."""


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


@wp.func_native("""
#ifdef __CUDA_ARCH__
    return __ffs(mask) - 1;
#else
    return __builtin_ctz(mask);
#endif
""")
def lowest_bit(mask: wp.uint32) -> int:
    """Return the position of the lowest set bit of a mask that is not 0."""


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
    both.unknown += second.unknown
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
    after.unknown = place.unknown + change.unknown
    return after


@wp.kernel
def merge_blocks(
    changes: wp.array(dtype=Change),
    size: int,
    bits: int,
    start: int,
    groups: wp.array(dtype=Change),
):
    """Find what each group of ``size`` blocks changes."""
    group = wp.tid() + start
    change = changes[group * size]
    for block in range(group * size + 1, wp.min((group + 1) * size, changes.shape[0])):
        change = merged(change, changes[block], bits)
    groups[group] = change


@wp.kernel
def link_groups(
    groups: wp.array(dtype=Change),
    bits: int,
    states: wp.array(dtype=State),
    places: wp.array(dtype=Place),
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
    """Find the state and the place at the start of each block, from its group of ``size`` blocks."""
    group = wp.tid() + start
    state = group_states[group]
    place = group_places[group]
    for block in range(group * size, wp.min((group + 1) * size, changes.shape[0])):
        change = changes[block]
        states[block] = state
        places[block] = place
        place = after_block(place, state, change)
        state = followed(state, change, bits)
