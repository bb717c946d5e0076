"""Corner tests on surfaces of active events, and the pass over events in their order.

A surface of active events holds the time of the latest event of each polarity and pixel. An event is a corner if, on
two circles around it, the newest pixels form an arc of a certain length.

CPUs pass over the events in their order and keep the surfaces up to date. GPUs test all events at once: events are
sorted into lists, one for each polarity and pixel, in which each event finds the latest events before it. Both ways
give the same corners.
"""

from typing import Any

import warp as wp

from amiwarp.kernels.event_arrays import EventArrays

wp.set_module_options({"enable_backward": False})

SMALL_CIRCLE = (
    (0, 3), (1, 3), (2, 2), (3, 1), (3, 0), (3, -1), (2, -2), (1, -3),
    (0, -3), (-1, -3), (-2, -2), (-3, -1), (-3, 0), (-3, 1), (-2, 2), (-1, 3),
)  # fmt: skip
LARGE_CIRCLE = (
    (0, 4), (1, 4), (2, 3), (3, 2), (4, 1), (4, 0), (4, -1), (3, -2), (2, -3), (1, -4),
    (0, -4), (-1, -4), (-2, -3), (-3, -2), (-4, -1), (-4, 0), (-4, 1), (-3, 2), (-2, 3), (-1, 4),
)  # fmt: skip
SMALL, LARGE = wp.constant(len(SMALL_CIRCLE)), wp.constant(len(LARGE_CIRCLE))
SmallColumns = wp.types.vector(len(SMALL_CIRCLE), int)
LargeColumns = wp.types.vector(len(LARGE_CIRCLE), int)
SmallTimes = wp.types.vector(len(SMALL_CIRCLE), wp.int64)
LargeTimes = wp.types.vector(len(LARGE_CIRCLE), wp.int64)
SMALL_X, SMALL_Y = (
    wp.constant(SmallColumns(*values)) for values in zip(*SMALL_CIRCLE, strict=True)
)
LARGE_X, LARGE_Y = (
    wp.constant(LargeColumns(*values)) for values in zip(*LARGE_CIRCLE, strict=True)
)

# Radius of the larger circle [px]; events closer to the border are no corners
REACH = wp.constant(4)
# Length of the newest arc of a corner [px]
SMALL_LEAST = wp.constant(3)
SMALL_MOST = wp.constant(6)
LARGE_LEAST, LARGE_MOST = wp.constant(4), wp.constant(8)
AHEAD = wp.constant(12)  # events between the request for memory and its use
NEVER = wp.constant(wp.int64(-(2**63)))  # time of a pixel without events
NO_POLARITY = wp.constant(2)  # polarity of a pixel without events


@wp.struct
class Surface:
    """Surfaces of active events. Pixel ``i`` of polarity ``p`` is at ``p * pixels + i``, row by row."""

    time: wp.array(dtype=wp.int64)  # latest event that is not redundant [us]
    last: wp.array(dtype=wp.int64)  # latest event of any polarity [us]; unused without a filter
    polarity: wp.array(dtype=wp.uint8)  # polarity of that event
    pixels: int  # number of pixels of a surface, including the rows that bands share
    width: int  # size of the sensor [px]
    height: int
    band_bits: int  # a band has 2 ** band_bits rows


@wp.struct
class Rule:
    """What a corner is."""

    complement: int  # 1 if all pixels but an arc may also be the newest
    # An event is redundant if the one before at its pixel has its polarity and is so recent
    redundant_us: wp.int64


@wp.struct
class Lists:
    """Indices of events in lists: one for each polarity and pixel, in the order of the events."""

    order: wp.array(dtype=int)  # the lists, one after the other
    first: wp.array(dtype=int)  # start of each list, then the end of the last


@wp.struct
class Past:
    """Surfaces as one event sees them: those before a block of events, and the events of the block before it."""

    surface: Surface
    t: wp.array(dtype=wp.int64)
    lists: Lists
    event: int


@wp.func
def newest_arc(times: Any, n: int, least: int, most: int) -> int:
    """Return the length of the shortest arc of ``least`` to ``most`` pixels that is newer than the rest of the circle.

    Starts at the newest pixel and adds the newer of both neighbours: any such arc consists of the pixels added first.
    Returns ``n`` if there is none.
    """
    at, newest = int(0), wp.int64(times[0])
    for j in range(1, n):
        at = wp.where(times[j] > newest, j, at)
        newest = wp.max(times[j], newest)
    oldest, seen = wp.int64(newest), wp.int64(newest)  # of the arc, and of all pixels added so far
    left = at + n - 1
    right = at + 1
    size = int(1)
    for count in range(2, most + 1):
        before = times[left - wp.where(left >= n, n, 0)]
        after = times[right - wp.where(right >= n, n, 0)]
        newer = wp.max(before, after)
        seen = wp.min(seen, newer)
        in_arc = count <= least or newer >= oldest
        size, oldest = wp.where(in_arc, count, size), wp.where(in_arc, seen, oldest)
        step = wp.where(after > before, 1, 0)
        right, left = right + step, left - 1 + step
    for j in range(right, left + 1):
        size = wp.where(times[j - wp.where(j >= n, n, 0)] >= oldest, n, size)
    return size


@wp.func
def list_end(lists: Lists, key: int, event: int) -> int:
    """Return the position after the last event of list ``key`` that comes before ``event``, by bisection."""
    low, high = int(lists.first[key]), int(lists.first[key + 1])
    while low < high:
        middle = (low + high) / 2
        if lists.order[middle] < event:
            low = middle + 1
        else:
            high = middle
    return low


@wp.func
def time_at(surface: Surface, key: int) -> wp.int64:
    """Return the time of a pixel of the surfaces [us]."""
    return surface.time[key]


@wp.func
def time_at(past: Past, key: int) -> wp.int64:
    """Return the time of a pixel of the surfaces just before an event [us]."""
    end = list_end(past.lists, key, past.event)
    if end > past.lists.first[key]:
        return past.t[past.lists.order[end - 1]]
    return past.surface.time[key]


@wp.func
def small_times(source: Any, at: int, width: int) -> SmallTimes:
    """Return the times on the smaller circle around the pixel at index ``at``."""
    times = SmallTimes()
    for j in range(SMALL):
        times[j] = time_at(source, at + SMALL_Y[j] * width + SMALL_X[j])
    return times


@wp.func
def large_times(source: Any, at: int, width: int) -> LargeTimes:
    """Return the times on the larger circle around the pixel at index ``at``."""
    times = LargeTimes()
    for j in range(LARGE):
        times[j] = time_at(source, at + LARGE_Y[j] * width + LARGE_X[j])
    return times


@wp.func
def has_corner_arc(times: Any, n: int, least: int, most: int, rule: Rule) -> bool:
    """Return whether the newest pixels of a circle form the arc of a corner."""
    longest = wp.where(rule.complement == 1, n - least, most)
    size = newest_arc(times, n, least, longest)
    return size <= most or (size >= n - most and size <= longest)


@wp.func
def is_corner(source: Any, at: int, width: int, rule: Rule) -> bool:
    """Return whether an event at index ``at`` of the surfaces is a corner."""
    if not has_corner_arc(small_times(source, at, width), SMALL, SMALL_LEAST, SMALL_MOST, rule):
        return False
    return has_corner_arc(large_times(source, at, width), LARGE, LARGE_LEAST, LARGE_MOST, rule)


@wp.func
def has_circles(surface: Surface, x: int, y: int) -> bool:
    """Return whether both circles around a pixel lie in the image."""
    inside = x >= REACH and x < surface.width - REACH
    return inside and y >= REACH and y < surface.height - REACH


@wp.func_native("""
#if !defined(__CUDA_ARCH__)
    const int64_t* at = (const int64_t*)surface.time.data + p * surface.pixels + pixel;
    for (int dy = -4; dy <= 4; ++dy) {
        __builtin_prefetch(at + dy * surface.width - 3);
        __builtin_prefetch(at + dy * surface.width + 3);
    }
    __builtin_prefetch((const int64_t*)surface.last.data + pixel);
    __builtin_prefetch((const uint8_t*)surface.polarity.data + pixel);
#endif
""")
def prefetch(surface: Surface, pixel: int, p: int):
    """Ask a CPU to load the surroundings of a pixel, which an event to come needs. A hint: any address is harmless."""


@wp.func
def prefetch_event(
    events: EventArrays, surface: Surface, owner: wp.array(dtype=int), k: int, i: int
):
    """Ask for the surroundings of event ``i`` if its band belongs to thread ``k``."""
    if i < events.t.shape[0]:
        y = int(events.y[i])
        band = y >> surface.band_bits
        if owner[band] == k:
            pixel = (y + REACH + 2 * REACH * band) * surface.width + int(events.x[i])
            prefetch(surface, pixel, int(events.p[i]))


@wp.func
def store(surface: Surface, pixel: int, t: wp.int64, p: int, rule: Rule) -> bool:
    """Store an event in the surfaces. Return whether it is not redundant."""
    if rule.redundant_us > wp.int64(0):
        repeats = int(surface.polarity[pixel]) == p and t - surface.last[pixel] <= rule.redundant_us
        surface.last[pixel] = t
        surface.polarity[pixel] = wp.uint8(p)
        if repeats:
            return False
    surface.time[p * surface.pixels + pixel] = t
    return True


@wp.kernel
def detect_in_order(
    events: EventArrays,
    surface: Surface,
    rule: Rule,
    owner: wp.array(dtype=int),
    start: int,
    corner: wp.array(dtype=wp.bool),
):
    """Test the events of some bands of rows in their order. Thread ``k`` takes the bands that ``owner`` gives to ``k``.

    Each band has its own copy of its rows and of the ``REACH`` rows on each side, so threads share no row.
    """
    k = start + wp.tid()
    for i in range(events.t.shape[0]):
        prefetch_event(events, surface, owner, k, i + AHEAD)
        x = int(events.x[i])
        y = int(events.y[i])
        p = int(events.p[i])
        first = wp.max(y - REACH, 0) >> surface.band_bits
        last = wp.min(y + REACH, surface.height - 1) >> surface.band_bits
        for band in range(first, last + 1):
            if owner[band] == k:
                pixel = (y + REACH + 2 * REACH * band) * surface.width + x
                fresh = store(surface, pixel, events.t[i], p, rule)
                if band == y >> surface.band_bits:
                    corner[i] = False
                    if fresh and has_circles(surface, x, y):
                        corner[i] = is_corner(
                            surface, p * surface.pixels + pixel, surface.width, rule
                        )


@wp.kernel
def key_events(
    events: EventArrays,
    surface: Surface,
    start: int,
    keys: wp.array(dtype=int),
    order: wp.array(dtype=int),
):
    """Write the number of the list of each event, and its index."""
    i = start + wp.tid()
    keys[i] = (
        int(events.p[i]) * surface.pixels + int(events.y[i]) * surface.width + int(events.x[i])
    )
    order[i] = i


@wp.kernel
def find_lists(keys: wp.array(dtype=int), n: int, start: int, first: wp.array(dtype=int)):
    """Find the start of list ``q`` among the ``n`` sorted keys, by bisection."""
    q = start + wp.tid()
    low, high = int(0), int(n)
    while low < high:
        middle = (low + high) / 2
        if keys[middle] < q:
            low = middle + 1
        else:
            high = middle
    first[q] = low


@wp.kernel
def mark_fresh(
    events: EventArrays,
    surface: Surface,
    lists: Lists,
    rule: Rule,
    start: int,
    fresh: wp.array(dtype=int),
):
    """Write 1 for each position in the lists whose event is not redundant, else 0."""
    k = start + wp.tid()
    i = lists.order[k]
    p = int(events.p[i])
    pixel = int(events.y[i]) * surface.width + int(events.x[i])
    key, other = p * surface.pixels + pixel, (1 - p) * surface.pixels + pixel
    polarity, last = int(surface.polarity[pixel]), wp.int64(surface.last[pixel])
    before = int(-1)
    if k > lists.first[key]:
        before = int(lists.order[k - 1])
        polarity, last = int(p), wp.int64(events.t[before])
    end = list_end(lists, other, i)
    if end > lists.first[other]:
        if lists.order[end - 1] > before:
            polarity = 1 - p
    fresh[k] = wp.where(polarity == p and events.t[i] - last <= rule.redundant_us, 0, 1)


@wp.kernel
def keep_fresh(
    lists: Lists,
    fresh: wp.array(dtype=int),
    place: wp.array(dtype=int),
    start: int,
    order: wp.array(dtype=int),
):
    """Write the events that are not redundant, without gaps: ``place`` is the number of them before each position."""
    k = start + wp.tid()
    if fresh[k] == 1:
        order[place[k]] = lists.order[k]


@wp.kernel
def move_lists(lists: Lists, place: wp.array(dtype=int), start: int, first: wp.array(dtype=int)):
    """Write the start of list ``q`` after redundant events were left out."""
    q = start + wp.tid()
    first[q] = place[lists.first[q]]


@wp.kernel
def detect_in_lists(
    events: EventArrays,
    surface: Surface,
    lists: Lists,
    rule: Rule,
    start: int,
    corner: wp.array(dtype=wp.bool),
):
    """Test the event at each position in the lists; later positions than their end are skipped."""
    k = start + wp.tid()
    if k < lists.first[2 * surface.pixels]:
        past = Past()
        past.surface = surface
        past.t = events.t
        past.lists = lists
        past.event = lists.order[k]
        x = int(events.x[past.event])
        y = int(events.y[past.event])
        p = int(events.p[past.event])
        if has_circles(surface, x, y):
            at = p * surface.pixels + y * surface.width + x
            corner[past.event] = is_corner(past, at, surface.width, rule)


@wp.kernel
def store_lists(events: EventArrays, lists: Lists, start: int, surface: Surface):
    """Store the last event of list ``q`` in the surfaces."""
    q = start + wp.tid()
    end = lists.first[q + 1]
    if end > lists.first[q]:
        surface.time[q] = events.t[lists.order[end - 1]]


@wp.kernel
def store_last(events: EventArrays, lists: Lists, start: int, surface: Surface):
    """Store time and polarity of the last event of each pixel."""
    pixel = start + wp.tid()
    last = int(-1)
    for p in range(2):
        end = lists.first[p * surface.pixels + pixel + 1]
        if end > lists.first[p * surface.pixels + pixel]:
            last = wp.max(last, lists.order[end - 1])
    if last >= 0:
        surface.last[pixel] = events.t[last]
        surface.polarity[pixel] = events.p[last]
