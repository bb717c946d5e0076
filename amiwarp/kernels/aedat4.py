"""Unpacks the events of AEDAT 4 files: 16 bytes each, a time, a column, a row, a polarity and three bytes between."""

import warp as wp

from amiwarp.kernels.evt import EventArrays, store_event
from amiwarp.kernels.native_code import load_word

wp.set_module_options({"enable_backward": False})


@wp.kernel
def unpack_events(words: wp.array(dtype=wp.uint64), length: int, start: int, events: EventArrays):
    """Write the events of each block of ``length`` events, of two words each."""
    block = wp.tid() + start
    for i in range(block * length, wp.min((block + 1) * length, words.shape[0] // 2)):
        now = wp.int64(load_word(words, 2 * i))
        place = load_word(words, 2 * i + 1)
        # Negative coordinates become large ones, which lie outside the frame.
        column = wp.uint16(place & wp.uint64(0xFFFF))
        row = wp.uint16((place >> wp.uint64(16)) & wp.uint64(0xFFFF))
        is_on = ((place >> wp.uint64(32)) & wp.uint64(0xFF)) != wp.uint64(0)
        store_event(events, i, column, row, now, wp.uint8(wp.where(is_on, 1, 0)))
