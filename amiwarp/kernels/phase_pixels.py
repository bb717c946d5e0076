"""Sums of each pixel's events in phase with the optic, from events ordered by pixels; for GPUs.

The sums equal the sums of :mod:`amiwarp.kernels.phase`, bit for bit. A thread adds up three harmonics of one pixel, in
its registers. Nothing waits for the host: the table of what an event adds is weighted on the device, too.
"""

import warp as wp

from amiwarp.kernels.events_with_angles import EventsWithAngles, theta_u16_at
from amiwarp.kernels.phase import complex_sum, table_row
from amiwarp.kernels.prism_angle import EncoderParams

wp.set_module_options({"enable_backward": False})

ON = wp.constant(0)
"""Place of the number of ON events among the marks."""
FULL = wp.constant(1)
"""Place of the mark that a pixel has too many events."""
MARKS = 2
"""Number of marks."""
AT_ONCE = 3
"""Number of harmonics of a thread that sums: it reads the events once for all of them."""


@wp.kernel
def count_on(
    polarity: wp.array(dtype=wp.uint8),
    first: int,
    threads: int,
    count: int,
    start: int,
    marks: wp.array(dtype=int),
):
    """Add the number of ON events to its mark, of ``count`` from ``first`` on. Runs over ``threads`` threads, on a CPU
    one."""
    total = int(0)
    for i in range(wp.tid() + start, count, threads):
        total += int(polarity[first + i])
    wp.atomic_add(marks, ON, total)


@wp.kernel
def weigh_table(
    pairs: wp.array2d(dtype=wp.vec2d),
    marks: wp.array(dtype=int),
    count: int,
    given: wp.float64,
    least: wp.float64,
    extreme: wp.float64,
    start: int,
    table: wp.array2d(dtype=wp.vec2i),
    ratio: wp.array(dtype=wp.float64),
):
    """Write what an event of one polarity and bin adds to one harmonic of its pixel, and its further row.

    ``pairs`` are cosine and sine of each harmonic and bin, in units of the integers. ``table`` has the shape
    (harmonics, 4 bins): rows of OFF and ON events, then again for their further rows. ``ratio`` becomes the OFF
    threshold divided by the ON threshold: ``given``, or if that is 0 the number of ON events divided by the number of
    OFF events.
    """
    i = wp.tid() + start
    bins = pairs.shape[1]
    k = i / (2 * bins)
    row = i % (2 * bins)
    off_ratio = given
    if given == wp.float64(0.0):
        off_ratio = ratio_of_counts(marks[ON], count - marks[ON], least)
    weight = wp.float64(1.0)
    if row < bins:
        weight = -off_ratio
    pair = weight * pairs[k, row % bins]
    cosine = wp.rint(pair[0])
    sine = wp.rint(pair[1])
    table[k, row] = wp.vec2i(int(cosine), int(sine))
    further = wp.vec2i(int(wp.rint(extreme * cosine)), int(wp.rint(extreme * sine)))
    table[k, 2 * bins + row] = further
    if i == 0:
        ratio[0] = off_ratio


@wp.func
def ratio_of_counts(on: int, off: int, least: wp.float64) -> wp.float64:
    """Return the number of ON events divided by the number of OFF events, within limits; 1 without either."""
    if on == 0 or off == 0:
        return wp.float64(1.0)
    return wp.clamp(wp.float64(on) / wp.float64(off), least, wp.float64(1.0) / least)


@wp.kernel
def pixel_words(
    events: EventsWithAngles,
    width: int,
    bins: int,
    start: int,
    pixels: wp.array(dtype=int),
    rows: wp.array(dtype=int),
):
    """Write the pixel of an event, and its row of the table."""
    i = wp.tid() + start
    pixels[i] = int(events.y[i]) * width + int(events.x[i])
    rows[i] = table_row(events.layer[i], events.turn[i], bins)


@wp.kernel
def timed_words(
    x: wp.array(dtype=wp.uint16),
    y: wp.array(dtype=wp.uint16),
    t: wp.array(dtype=wp.int64),
    polarity: wp.array(dtype=wp.uint8),
    encoder: EncoderParams,
    first: int,
    size: wp.vec2i,
    start: int,
    pixels: wp.array(dtype=int),
    rows: wp.array(dtype=int),
):
    """Write the pixel of an event, and its row of the table by its time. ``size`` are width and number of bins.

    The events begin at ``first``: a part of a recording needs no arrays of its own.
    """
    i = wp.tid() + start
    event = first + i
    pixels[i] = int(y[event]) * size[0] + int(x[event])
    rows[i] = table_row(polarity[event], theta_u16_at(encoder, t[event]), size[1])


@wp.kernel
def first_words(pixels: wp.array(dtype=int), count: int, start: int, starts: wp.array(dtype=int)):
    """Write the first of the ordered events of a pixel. After the last pixel, it is their number."""
    pixel = wp.tid() + start
    low = int(0)
    high = int(count)
    while low < high:
        middle = (low + high) / 2
        if pixels[middle] < pixel:
            low = middle + 1
        else:
            high = middle
    starts[pixel] = low


@wp.kernel
def sum_pixels(
    rows: wp.array(dtype=int),
    starts: wp.array(dtype=int),
    table: wp.array2d(dtype=wp.vec2i),
    scales: wp.array(dtype=float),
    start: int,
    counts: wp.array2d(dtype=int),
    values: wp.array2d(dtype=wp.vec2),
):
    """Write the sums of ``AT_ONCE`` harmonics of one pixel, and with the first ones the numbers of its events.

    ``rows`` are rows of the table, in each pixel in the order of time, ``starts`` the first of each pixel. ``counts``
    has shape (3, pixels): OFF events, ON events, changes of polarity.
    """
    i = wp.tid() + start
    pixels = counts.shape[1]
    bins = table.shape[1] / 4
    k = i / pixels * AT_ONCE
    pixel = i % pixels
    # Beyond the last harmonic the last one is summed again
    second = wp.min(k + 1, values.shape[0] - 1)
    third = wp.min(k + 2, values.shape[0] - 1)
    first = starts[pixel]
    stop = starts[pixel + 1]
    total = wp.vec2i(0, 0)
    of_second = wp.vec2i(0, 0)
    of_third = wp.vec2i(0, 0)
    on = int(0)
    changes = int(0)
    before = int(0)
    if first < stop:
        before = rows[stop - 1]  # the first event of a turn follows the last one
    for at in range(first, stop):
        row = rows[at]
        total += table[k, row]
        of_second += table[second, row]
        of_third += table[third, row]
        if (before < bins) != (row < bins):
            total += table[k, 2 * bins + before] + table[k, 2 * bins + row]
            of_second += table[second, 2 * bins + before] + table[second, 2 * bins + row]
            of_third += table[third, 2 * bins + before] + table[third, 2 * bins + row]
            changes += 1
        if row >= bins:
            on += 1
        before = row
    values[k, pixel] = complex_sum(total[0], total[1], scales[k])
    if k + 1 < values.shape[0]:
        values[second, pixel] = complex_sum(of_second[0], of_second[1], scales[second])
    if k + 2 < values.shape[0]:
        values[third, pixel] = complex_sum(of_third[0], of_third[1], scales[third])
    if k == 0:
        counts[0, pixel] = stop - first - on
        counts[1, pixel] = on
        counts[2, pixel] = changes


@wp.kernel
def known_pixels(
    counts: wp.array2d(dtype=int),
    ratio: wp.array(dtype=wp.float64),
    most: int,
    start: int,
    known: wp.array(dtype=wp.uint8),
    marks: wp.array(dtype=int),
):
    """Write whether a pixel has events, and mark if it has more than ``most``, of which OFF events count ``ratio``."""
    pixel = wp.tid() + start
    off = counts[0, pixel]
    on = counts[1, pixel]
    known[pixel] = wp.uint8(wp.where(on + off > 0, 1, 0))
    if on + int(wp.ceil(ratio[0] * wp.float64(off))) > most:
        marks[FULL] = 1  # all threads write the same
