"""Known nodes of a map: those with enough equations that hold, without small regions and holes."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def mark_known(
    hold: wp.array(dtype=float),
    everything: wp.array(dtype=float),
    least: float,
    share: float,
    start: int,
    known: wp.array(dtype=wp.uint8),
):
    """Mark nodes whose equations that hold have at least a weight of ``least``, and ``share`` of the whole weight."""
    i = start + wp.tid()
    enough = hold[i] >= least and hold[i] >= share * everything[i]
    known[i] = wp.where(enough, wp.uint8(1), wp.uint8(0))


@wp.kernel
def find_marked(mask: wp.array(dtype=wp.uint8), start: int, found: wp.array(dtype=int)):
    """Set ``found`` to 1 if any element is marked. Several threads may write it, all the same."""
    if mask[start + wp.tid()] != wp.uint8(0):
        found[0] = 1


@wp.kernel
def widen(
    mask: wp.array2d(dtype=wp.uint8),
    found: wp.array(dtype=int),
    by: int,
    start: int,
    out: wp.array(dtype=wp.uint8),
):
    """Mark elements at most ``by`` steps along rows and columns from a marked one; all if ``found`` is 0."""
    i = start + wp.tid()
    row = i / mask.shape[1]
    column = i % mask.shape[1]
    near = found[0] == 0 or mask[row, column] != wp.uint8(0)
    if not near:
        for r in range(wp.max(row - by, 0), wp.min(row + by, mask.shape[0] - 1) + 1):
            left = by - wp.abs(r - row)
            for c in range(wp.max(column - left, 0), wp.min(column + left, mask.shape[1] - 1) + 1):
                near = near or mask[r, c] != wp.uint8(0)
    out[i] = wp.where(near, wp.uint8(1), wp.uint8(0))


@wp.kernel
def exponentiate(log: wp.array2d(dtype=float), contrast: float, out: wp.array2d(dtype=float)):
    """Compute relative linear intensity from log intensity in units of the threshold ``contrast``."""
    i, j = wp.tid()
    out[i, j] = wp.exp(contrast * log[i, j])
