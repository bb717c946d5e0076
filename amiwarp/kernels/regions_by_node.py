"""Size of connected regions of a mask, on CUDA: each node follows its own region (CPU: :mod:`.regions`)."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.func_native("""
    const uint8_t* in = (const uint8_t*)mask.data;
    const int rows = mask.shape[0], columns = mask.shape[1];
    const int steps[4] = {-columns, columns, -1, 1};
    int found[16];
    int count = 1;
    found[0] = first;
    for (int seen = 0; seen < count && count < least; ++seen) {
        const int row = found[seen] / columns, column = found[seen] % columns;
        const bool has[4] = {row > 0, row < rows - 1, column > 0, column < columns - 1};
        for (int k = 0; k < 4 && count < least; ++k) {
            const int next = found[seen] + steps[k];
            if (!has[k] || in[next] != in[first]) continue;
            bool is_new = true;
            for (int j = 0; j < count; ++j) is_new = is_new && found[j] != next;
            if (is_new) found[count++] = next;
        }
    }
    return count >= least;
""")
def is_large(mask: wp.array2d(dtype=wp.uint8), least: int, first: int) -> bool:
    """Return whether the region of equal values around element ``first`` has at least ``least`` elements, 2 to 16."""


@wp.kernel
def drop_small_regions(
    mask: wp.array2d(dtype=wp.uint8), value: int, least: int, start: int, out: wp.array2d(dtype=wp.uint8)
):
    """Copy a mask, but without the regions of ``value``, 0 or 1, that have fewer than ``least`` elements, 2 to 16."""
    i = start + wp.tid()
    row = i / mask.shape[1]
    column = i % mask.shape[1]
    given = int(mask[row, column])
    if given == value and not is_large(mask, least, i):
        given = 1 - given
    out[row, column] = wp.uint8(given)
