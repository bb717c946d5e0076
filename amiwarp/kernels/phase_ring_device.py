"""Counts of each pixel's events in the bins of the last turns on a GPU, their weighted sums, and what they say moved.

A word of a plane holds the events of one pixel and bin: the number of ON events times 65,536 plus the number of OFF
events. What changes from picture to picture lies in one array, ``given``, so that launches can be repeated as a graph.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

BINS = 64
"""Number of bins of a turn, as of sums in phase."""
MOST_COUNT = wp.constant(255)
"""Largest number of events of one polarity, pixel and bin, as on a CPU."""
AT_ONCE = 3
"""Number of harmonics of a thread that sums: it reads the planes once for all of them."""
RATIO = wp.constant(0)
"""Place of the OFF threshold divided by the ON threshold in ``given``."""
USED = wp.constant(1)
"""Place of the number of planes that are summed."""
NOISE = wp.constant(2)
"""Place of what an event at a random angle adds to the squares."""
LEAST = wp.constant(3)
"""Place of the least size, of the square around a pixel."""
EXTREME = wp.constant(4)
"""Place of what an extreme adds to the events before and after it."""
OF_CHANGE = wp.constant(5)
"""Place of what a change of polarity adds to the squares, relative to an event."""
EARLIER = wp.constant(6)
"""Place of the number of planes before these, which only tell the polarity of the event before."""
SLOTS = wp.constant(7)
"""First place of the numbers of the planes, in the order of time: at most 64 before, and 64."""
TABLE = wp.constant(7 + 2 * BINS)
"""First place of the table, as :func:`amiwarp.kernels.phase_ring.sum_planes` has it: rows of 64 planes, then of the
expected sums, each with a cosine and a sine for each harmonic."""


@wp.kernel
def add_words(words: wp.array(dtype=int), slot: int, start: int, planes: wp.array2d(dtype=int)):
    """Add an event to a plane. Its word is twice its pixel, and 1 more for ON. On a CPU, run it in one thread."""
    word = words[wp.tid() + start]
    one = wp.where((word & 1) == 1, 1 << 16, 1)
    wp.atomic_add(planes, slot, word >> 1, one)


@wp.func
def factor(given: wp.array(dtype=float), row: int, k: int, harmonics: int) -> wp.vec2:
    """Return what a row of the table adds to the sum of harmonic k + 1."""
    place = TABLE + 2 * (row * harmonics + k)
    return wp.vec2(given[place], given[place + 1])


@wp.func
def begins_with(on: int, off: int, before: int) -> int:
    """Return the polarity of the first event of a bin, 1 or -1, after an event of polarity ``before``; 0 without any.

    A bin with both begins as the bin before ended: so the polarity changes as seldom as it can.
    """
    if on > 0 and off > 0:
        return wp.where(before == 0, 1, before)
    return wp.where(on > 0, 1, 0) - wp.where(off > 0, 1, 0)


@wp.func
def ends_with(on: int, off: int, begins: int) -> int:
    """Return the polarity of the last event of a bin that begins with another one."""
    return wp.where(on > 0 and off > 0, -begins, begins)


@wp.func
def on_of(word: int) -> int:
    """Return the number of ON events of a word."""
    return wp.min(word >> 16, MOST_COUNT)


@wp.func
def off_of(word: int) -> int:
    """Return the number of OFF events of a word."""
    return wp.min(word & 65535, MOST_COUNT)


@wp.func
def plane_of(given: wp.array(dtype=float), place: int) -> int:
    """Return the number of a plane."""
    return int(given[SLOTS + place])


@wp.kernel
def sum_bins(
    planes: wp.array2d(dtype=int),
    given: wp.array(dtype=float),
    expected: wp.array2d(dtype=wp.vec2),
    start: int,
    values: wp.array2d(dtype=wp.vec2),
    counts: wp.array2d(dtype=int),
    known: wp.array(dtype=wp.uint8),
    squares: wp.array2d(dtype=float),
):
    """Write ``AT_ONCE`` sums of one pixel over the planes, and with the first ones the numbers of its events.

    ``counts`` are the numbers of OFF events, ON events and changes, shape (3, pixels), ``known`` is 1 for pixels with a
    sum.
    ``squares`` are for these harmonics the squares of the change from the ``expected`` sums, and of what the planes
    alone add, shape (2, groups of harmonics times pixels).
    """
    i = wp.tid() + start
    pixels = planes.shape[1]
    harmonics = values.shape[0]
    pixel = i % pixels
    k = i / pixels * AT_ONCE
    # Beyond the last harmonic the last one is summed again
    second = wp.min(k + 1, harmonics - 1)
    third = wp.min(k + 2, harmonics - 1)
    sum_of_first = wp.vec2(0.0, 0.0)
    sum_of_second = wp.vec2(0.0, 0.0)
    sum_of_third = wp.vec2(0.0, 0.0)
    used = int(given[USED])
    earlier = int(given[EARLIER])
    of_on = given[EXTREME]
    of_off = -given[RATIO] * of_on
    # Polarity of the last event, and its row if it is one of those that are summed
    polarity = int(0)
    last_row = int(-1)
    for place in range(earlier):
        word = planes[plane_of(given, place), pixel]
        begins = begins_with(on_of(word), off_of(word), polarity)
        if begins != 0:
            polarity = ends_with(on_of(word), off_of(word), begins)
    if used == BINS:
        # A whole turn is closed: its first event follows its last one
        for row in range(used):
            word = planes[plane_of(given, earlier + row), pixel]
            begins = begins_with(on_of(word), off_of(word), polarity)
            if begins != 0:
                polarity = ends_with(on_of(word), off_of(word), begins)
                last_row = row
    on = int(0)
    off = int(0)
    changes = int(0)
    for row in range(used):
        word = planes[plane_of(given, earlier + row), pixel]
        ones = on_of(word)
        others = off_of(word)
        on += ones
        off += others
        weight = float(ones) - given[RATIO] * float(others)
        begins = begins_with(ones, others, polarity)
        if begins * polarity < 0:
            changes += 1
            weight += wp.where(begins > 0, of_on, of_off)
            if last_row >= 0:
                further = wp.where(polarity > 0, of_on, of_off)
                sum_of_first += further * factor(given, last_row, k, harmonics)
                sum_of_second += further * factor(given, last_row, second, harmonics)
                sum_of_third += further * factor(given, last_row, third, harmonics)
        if ones > 0 and others > 0:
            changes += 1
            weight += of_on + of_off
        if begins != 0:
            polarity = ends_with(ones, others, begins)
            last_row = row
        sum_of_first += weight * factor(given, row, k, harmonics)
        sum_of_second += weight * factor(given, row, second, harmonics)
        sum_of_third += weight * factor(given, row, third, harmonics)
    seen = wp.dot(sum_of_first, sum_of_first)
    if k + 1 < harmonics:
        seen += wp.dot(sum_of_second, sum_of_second)
    if k + 2 < harmonics:
        seen += wp.dot(sum_of_third, sum_of_third)

    for m in range(harmonics):
        old = expected[m, pixel]
        row = BINS + 2 * m
        sum_of_first += old[0] * factor(given, row, k, harmonics)
        sum_of_first += old[1] * factor(given, row + 1, k, harmonics)
        sum_of_second += old[0] * factor(given, row, second, harmonics)
        sum_of_second += old[1] * factor(given, row + 1, second, harmonics)
        sum_of_third += old[0] * factor(given, row, third, harmonics)
        sum_of_third += old[1] * factor(given, row + 1, third, harmonics)
    values[k, pixel] = sum_of_first
    differs = wp.length_sq(sum_of_first - expected[k, pixel])
    if k + 1 < harmonics:
        values[second, pixel] = sum_of_second
        differs += wp.length_sq(sum_of_second - expected[second, pixel])
    if k + 2 < harmonics:
        values[third, pixel] = sum_of_third
        differs += wp.length_sq(sum_of_third - expected[third, pixel])
    squares[0, i] = differs
    squares[1, i] = seen
    if k == 0:
        counts[0, pixel] = off
        counts[1, pixel] = on
        counts[2, pixel] = changes
        known[pixel] = wp.uint8(wp.where(wp.length_sq(sum_of_first) > 0.0, 1, 0))


@wp.kernel
def without_noise(
    squares: wp.array2d(dtype=float),
    counts: wp.array2d(dtype=int),
    given: wp.array(dtype=float),
    start: int,
    out: wp.array(dtype=wp.vec2),
):
    """Write the squares of the change and of the size of a pixel, over all harmonics, without what noise adds."""
    pixel = wp.tid() + start
    pixels = out.shape[0]
    total = wp.vec2(0.0, 0.0)
    for group in range(squares.shape[1] / pixels):
        place = group * pixels + pixel
        total += wp.vec2(squares[0, place], squares[1, place])
    weight = given[RATIO] * given[RATIO]
    events = float(counts[1, pixel]) + weight * float(counts[0, pixel])
    random = given[NOISE] * (events + given[OF_CHANGE] * float(counts[2, pixel]))
    out[pixel] = total - wp.vec2(2.0 * random, random)


@wp.kernel
def misfit_around(
    squares: wp.array(dtype=wp.vec2),
    given: wp.array(dtype=float),
    reach: int,
    start: int,
    misfit: wp.array2d(dtype=float),
):
    """Write the misfit of a pixel, as :func:`amiwarp.kernels.phase_misfit.write_misfit` does."""
    i = wp.tid() + start
    height = misfit.shape[0]
    width = misfit.shape[1]
    y = i / width
    x = i % width
    total = wp.vec2(0.0, 0.0)
    for row in range(y - reach, y + reach + 1):
        line = wp.clamp(row, 0, height - 1)
        for column in range(x - reach, x + reach + 1):
            total += squares[line * width + wp.clamp(column, 0, width - 1)]
    misfit[y, x] = wp.clamp(0.5 * total[0] / wp.max(total[1], given[LEAST]), 0.0, 1.0)


@wp.kernel
def moved_in_line(
    misfit: wp.array2d(dtype=float),
    limit: float,
    reach: int,
    start: int,
    out: wp.array2d(dtype=wp.uint8),
):
    """Write whether the misfit is above a limit at a pixel or at most ``reach`` beside it."""
    i = wp.tid() + start
    width = out.shape[1]
    y = i / width
    x = i % width
    found = wp.uint8(0)
    for column in range(wp.max(x - reach, 0), wp.min(x + reach + 1, width)):
        if misfit[y, column] > limit:
            found = wp.uint8(1)
    out[y, x] = found


@wp.kernel
def moved_in_column(
    lines: wp.array2d(dtype=wp.uint8), reach: int, start: int, out: wp.array2d(dtype=wp.uint8)
):
    """Write whether something moved at a pixel or at most ``reach`` above or below it."""
    i = wp.tid() + start
    width = out.shape[1]
    y = i / width
    x = i % width
    found = wp.uint8(0)
    for row in range(wp.max(y - reach, 0), wp.min(y + reach + 1, out.shape[0])):
        found = wp.max(found, lines[row, x])
    out[y, x] = found


@wp.kernel
def wrong_slopes(
    before: wp.array2d(dtype=float),
    slopes: wp.array2d(dtype=wp.vec2),
    moved: wp.array2d(dtype=wp.uint8),
    start: int,
    out: wp.array2d(dtype=wp.vec2),
):
    """Write how the gradient of the picture before differs from ``slopes`` at one pixel, and 0 where nothing moved."""
    i = wp.tid() + start
    width = out.shape[1]
    y = i / width
    x = i % width
    found = wp.vec2(0.0, 0.0)
    if moved[y, x] == wp.uint8(1):
        above = wp.max(y - 1, 0)
        below = wp.min(y + 1, out.shape[0] - 1)
        left = wp.max(x - 1, 0)
        right = wp.min(x + 1, width - 1)
        along_x = (before[y, right] - before[y, left]) / float(right - left)
        along_y = (before[below, x] - before[above, x]) / float(below - above)
        found = wp.vec2(along_x, along_y) - slopes[y, x]
    out[y, x] = found


@wp.kernel
def join_ground(
    picture: wp.array2d(dtype=float),
    correction: wp.array2d(dtype=float),
    moved: wp.array2d(dtype=wp.uint8),
    start: int,
    ground: wp.array2d(dtype=float),
    shown: wp.array2d(dtype=float),
    keys: wp.array(dtype=float),
):
    """Write the ground, which is what does not move, and the picture that shows what moves before it.

    ``keys`` get the latter once more, and are sorted for its median.
    """
    i = wp.tid() + start
    y = i / shown.shape[1]
    x = i % shown.shape[1]
    value = picture[y, x] + correction[y, x]
    ground[y, x] = value
    if moved[y, x] == wp.uint8(1):
        value = picture[y, x]
    shown[y, x] = value
    keys[i] = value
