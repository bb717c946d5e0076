"""Words of Prophesee's ECF codec: runs of equal values, and packed numbers. :mod:`amiwarp.kernels.ecf` decodes them."""

import warp as wp

from amiwarp.kernels.native_code import load_uint8

wp.set_module_options({"enable_backward": False})

GAP = wp.constant(15)
"""Upper half of a byte of a gap of time."""


@wp.struct
class Run:
    """A run of equal values."""

    value: int
    length: int
    next: int
    """Position behind it."""


@wp.func
def byte_at(data: wp.array(dtype=wp.uint8), at: int, stop: int) -> int:
    """Return a byte; 0 behind the chunk."""
    if at < stop:
        return int(load_uint8(data, at))
    return 0


@wp.func
def word_at(data: wp.array(dtype=wp.uint8), at: int, stop: int) -> int:
    """Return a word of 16 bits; 0 where less than one is left."""
    if at + 1 < stop:
        return int(load_uint8(data, at)) | (int(load_uint8(data, at + 1)) << 8)
    return 0


@wp.func
def long_word_at(data: wp.array(dtype=wp.uint8), at: int, stop: int) -> wp.uint32:
    """Return a word of 32 bits."""
    return wp.uint32(word_at(data, at, stop)) | (
        wp.uint32(word_at(data, at + 2, stop)) << wp.uint32(16)
    )


@wp.func
def time_run(data: wp.array(dtype=wp.uint8), at: int, stop: int) -> Run:
    """Return a byte of times, with the number of events at this time. The value of a byte of a gap is -1."""
    byte = int(load_uint8(data, at))
    run = Run()
    run.value = byte >> 4
    run.length = byte & 15
    run.next = at + 1
    if run.value == GAP:
        run.value = -1
    elif run.length == 15:
        run.length = byte_at(data, at + 1, stop) | (byte_at(data, at + 2, stop) << 8)
        run.next = at + 3
    return run


@wp.func
def row_run(data: wp.array(dtype=wp.uint8), at: int, stop: int) -> Run:
    """Return the row of a word, and how many events are in it."""
    word = word_at(data, at, stop)
    run = Run()
    run.value = word >> 5
    run.length = word & 31
    run.next = at + 2
    if run.length == 31:
        run.length = word_at(data, at + 2, stop)
        run.next = at + 4
    return run


@wp.func
def polarity_run(data: wp.array(dtype=wp.uint8), at: int, stop: int) -> Run:
    """Return the polarity of a byte, and how many events have it."""
    byte = int(load_uint8(data, at))
    run = Run()
    run.value = byte >> 7
    run.length = byte & 127
    run.next = at + 1
    if run.length == 127:
        run.length = byte_at(data, at + 1, stop) | (byte_at(data, at + 2, stop) << 8)
        run.next = at + 3
    return run


@wp.func
def events_of(mask: int) -> int:
    """Return the number of events of a word of columns: the first one, and one for each of five bits."""
    return (
        1
        + (mask & 1)
        + ((mask >> 1) & 1)
        + ((mask >> 2) & 1)
        + ((mask >> 3) & 1)
        + ((mask >> 4) & 1)
    )


@wp.func
def packed_bytes(count: int, bits: int) -> int:
    """Return the size of packed numbers [bytes]: four stand in three words of 16 or 32 bits."""
    return (count + 3) // 4 * bits // 2


@wp.func
def numbers_of(first: wp.uint32, second: wp.uint32, third: wp.uint32, part: wp.uint32) -> wp.vec4i:
    """Return the four numbers, of three times ``part`` bits, in three words of four times ``part`` bits.

    The upper bits come first, except that the second and the third number are cut: their lowest bits end the word
    before.
    """
    one = wp.uint32(1)
    two_parts = wp.uint32(2) * part
    three_parts = wp.uint32(3) * part
    second_number = (first & ((one << part) - one)) | ((second >> two_parts) << part)
    third_number = (second & ((one << two_parts) - one)) | ((third >> three_parts) << two_parts)
    return wp.vec4i(
        int(first >> part),
        int(second_number),
        int(third_number),
        int(third & ((one << three_parts) - one)),
    )
