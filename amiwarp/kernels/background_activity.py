"""Search for hot pixels of a sensor, and the time of a pixel without events."""

import warp as wp

wp.set_module_options({"enable_backward": False})

NEVER = wp.constant(wp.int64(-(2**63)))  # time of a pixel without events
AFTER_NEVER = wp.constant(wp.int64(1 - 2**63))


@wp.func
def never() -> wp.int64:
    """Return :data:`NEVER`. Kernels with it as a literal make the compiler warn: C++ has no negative literals."""
    return AFTER_NEVER - wp.int64(1)


@wp.func
def hot_threshold(n: float) -> float:
    """Return the number of events that no pixel has next to one with ``n``: chance adds a few of their square roots."""
    return 3.0 * n + 5.0 * wp.sqrt(n) + 8.0


@wp.kernel
def mark_hot_pixels(count: wp.array2d(dtype=int), start: int, hot: wp.array(dtype=wp.bool)):
    """Mark pixels that fire far more than the second busiest of the other pixels of the 5 x 5 around them.

    The end of a line has two busy pixels next to it, and two hot pixels side by side have one each.
    """
    i = start + wp.tid()
    row = i / count.shape[1]
    column = i % count.shape[1]
    most = int(0)
    second = int(0)
    for other_row in range(wp.max(row - 2, 0), wp.min(row + 3, count.shape[0])):
        for other_column in range(wp.max(column - 2, 0), wp.min(column + 3, count.shape[1])):
            if other_row != row or other_column != column:
                n = count[other_row, other_column]
                second = wp.max(second, wp.min(most, n))
                most = wp.max(most, n)
    hot[i] = float(count[row, column]) > hot_threshold(float(second))
