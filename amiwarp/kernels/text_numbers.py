"""Kernel that reads decimal numbers from lines of text."""

import warp as wp

wp.set_module_options({"enable_backward": False})

MOST_DIGITS = 18
"""Largest number of digits that fits 64 bits."""
EXACT = 2**53
"""Integers up to this are exact in float64, and so is their quotient with a power of ten, up to rounding."""

_NEWLINE_GAP = wp.constant(32)
_MOST_DIGITS = wp.constant(MOST_DIGITS)
_EXACT = wp.constant(wp.uint64(EXACT))


@wp.kernel
def read_numbers(
    text: wp.array(dtype=wp.uint8),
    ends: wp.array(dtype=int),
    separator: int,
    powers: wp.array(dtype=wp.float64),
    length: int,
    start: int,
    values: wp.array2d(dtype=wp.float64),
    faults: wp.array(dtype=int),
):
    """Read the numbers of each line into a column of ``values``. One thread reads ``length`` lines.

    ``ends``: positions of the ends of lines; ``separator``: character that may stand between two numbers, as spaces and
    tabs; ``powers``: powers of ten. ``faults`` is 1 for a block with a line that does not consist of as many plain
    decimal numbers as ``values`` has rows. The values are correctly rounded.
    """
    block = wp.tid() + start
    width = values.shape[0]
    faulty = int(0)
    for row in range(block * length, wp.min((block + 1) * length, ends.shape[0])):
        first = int(0)
        if row > 0:
            first = ends[row - 1] + 1
        stop = ends[row]
        field = int(0)
        number = wp.uint64(0)
        digits = int(0)
        decimals = int(-1)
        negative = int(0)
        for at in range(first, stop + 1):
            character = int(_NEWLINE_GAP)  # the end of the line ends its last number
            if at < stop:
                character = int(text[at])
            if character >= 48 and character <= 57:
                number = number * wp.uint64(10) + wp.uint64(character - 48)
                digits += 1
                if decimals >= 0:
                    decimals += 1
            elif character == 46 and decimals < 0:
                decimals = 0
            elif character == 45 and digits == 0 and decimals < 0 and negative == 0:
                negative = 1
            elif character == 32 or character == 9 or character == 13 or character == separator:
                if digits > 0 and digits <= _MOST_DIGITS and number <= _EXACT and field < width:
                    value = wp.float64(number) / powers[wp.max(decimals, 0)]
                    if negative == 1:
                        value = -value
                    values[field, row] = value
                    field += 1
                elif digits > 0 or decimals >= 0 or negative == 1:
                    faulty = 1
                number = wp.uint64(0)
                digits = 0
                decimals = -1
                negative = 0
            else:
                faulty = 1
        if field != width:
            faulty = 1
    faults[block] = faulty
