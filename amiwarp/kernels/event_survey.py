"""What blocks of decoded events hold: their order in time, which is repaired, and their largest coordinates."""

import warp as wp

from amiwarp.kernels.native_code import load_int64, store_int64

wp.set_module_options({"enable_backward": False})


@wp.struct
class Survey:
    """What a block of events holds."""

    first: wp.int64
    """Time of its first event [us]."""
    latest: wp.int64
    """Largest time [us]."""
    decreases: int
    """Number of events that are earlier than the one before."""
    right: int
    """Largest column [px]."""
    bottom: int
    """Largest row [px]."""


# Loops in native code, one for each result: so CPU compilers vectorise them.


@wp.func_native("""
    const uint16_t* value = (const uint16_t*)values.data;
    uint16_t largest = 0;
    for (int i = start; i < stop; ++i) largest = value[i] > largest ? value[i] : largest;
    return largest;
""")
def largest_coordinate(values: wp.array(dtype=wp.uint16), start: int, stop: int) -> int:
    """Return the largest value from ``start`` to before ``stop``."""


@wp.func_native("""
    const int64_t* time = (const int64_t*)t.data;
    int64_t largest = time[start];
    for (int i = start + 1; i < stop; ++i) largest = time[i] > largest ? time[i] : largest;
    return largest;
""")
def latest_time(t: wp.array(dtype=wp.int64), start: int, stop: int) -> wp.int64:
    """Return the largest time from ``start`` to before ``stop``, of which there is at least one."""


@wp.func_native("""
    const int64_t* time = (const int64_t*)t.data;
    int64_t decreases = 0;
    for (int i = start + 1; i < stop; ++i) decreases += time[i] < time[i - 1];
    return (int)decreases;
""")
def count_decreases(t: wp.array(dtype=wp.int64), start: int, stop: int) -> int:
    """Return how many times from ``start`` to before ``stop`` are earlier than the one before."""


@wp.kernel
def survey_events(
    x: wp.array(dtype=wp.uint16),
    y: wp.array(dtype=wp.uint16),
    t: wp.array(dtype=wp.int64),
    block_events: int,
    start: int,
    surveys: wp.array(dtype=Survey),
):
    """Note what each block of ``block_events`` events holds. One thread reads one block."""
    block = wp.tid() + start
    first = block * block_events
    stop = wp.min(first + block_events, t.shape[0])
    survey = Survey()
    survey.first = load_int64(t, first)
    survey.latest = latest_time(t, first, stop)
    survey.decreases = count_decreases(t, first, stop)
    survey.right = largest_coordinate(x, first, stop)
    survey.bottom = largest_coordinate(y, first, stop)
    surveys[block] = survey


@wp.kernel
def raise_times(
    block_events: int,
    floors: wp.array(dtype=wp.int64),
    start: int,
    t: wp.array(dtype=wp.int64),
    raised: wp.array(dtype=int),
    largest_raise_us: wp.array(dtype=wp.int64),
):
    """Raise each time of a block to the largest so far, and note how many were raised, and by how much at most [us].

    ``floors``: largest time before each block [us].
    """
    block = wp.tid() + start
    latest = floors[block]
    count = int(0)
    most = wp.int64(0)
    for i in range(block * block_events, wp.min((block + 1) * block_events, t.shape[0])):
        now = load_int64(t, i)
        if now < latest:
            store_int64(t, i, latest)
            most = wp.max(most, latest - now)
            count += 1
        else:
            latest = now
    raised[block] = count
    largest_raise_us[block] = most
