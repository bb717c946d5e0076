"""Sizes of connected regions of a mask: one thread scans it once on a CPU, and each node follows its region on CUDA."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.func_native("""
    const uint8_t* in = (const uint8_t*)mask.data;
    uint8_t* out = (uint8_t*)large.data;
    const int rows = mask.shape[0], columns = mask.shape[1];
    const int steps[4] = {-columns, columns, -1, 1};
    int found[64];
    int count = 1, seen = 0, is_large = 0;
    found[0] = first;
    out[first] = 2;
    for (; seen < count && !is_large; ++seen) {
        const int row = found[seen] / columns, column = found[seen] % columns;
        const bool has[4] = {row > 0, row < rows - 1, column > 0, column < columns - 1};
        for (int k = 0; k < 4 && !is_large; ++k) {
            const int next = found[seen] + steps[k];
            if (!has[k] || !in[next] || out[next] == 2) continue;
            is_large = out[next] || count + 1 >= least;
            found[count++] = next;
            out[next] = 2;
        }
    }
    for (int k = 0; k < count; ++k) out[found[k]] = is_large;
""")
def fill_region(
    mask: wp.array2d(dtype=wp.uint8), least: int, first: int, large: wp.array2d(dtype=wp.uint8)
):
    """Set ``large`` to 1 if the region of element ``first`` has at least ``least`` elements, 2 to 64, else to 0.

    The region is followed up to that number of elements, which are marked by 2 meanwhile, or to an element that is
    known to belong to a large region.
    """


@wp.func_native("""
    const uint8_t* in = (const uint8_t*)mask.data;
    uint8_t* out = (uint8_t*)large.data;
    const int columns = mask.shape[1], elements = mask.shape[0] * columns;
    for (int column = first % columns; first < elements; ++first, column = column + 1 < columns ? column + 1 : 0) {
        if (!in[first]) continue;
        if (column > 0 && in[first - 1]) out[first] = out[first - 1];
        else if (first >= columns && in[first - columns]) out[first] = out[first - columns];
        else return first;
    }
    return first;
""")
def copy_answers(
    mask: wp.array2d(dtype=wp.uint8), first: int, large: wp.array2d(dtype=wp.uint8)
) -> int:
    """Copy the answers of the left or upper neighbours to the elements from ``first`` on.

    Return the next element of the mask that has no such neighbour, or the number of elements.
    """


@wp.kernel
def find_large_regions(
    mask: wp.array2d(dtype=wp.uint8), least: int, large: wp.array2d(dtype=wp.uint8)
):
    """Set ``large``, 0 at first, to 1 in the regions of a mask that have at least ``least`` elements.

    ``least`` is 2 to 64.

    Neighbours in a row or a column belong to the same region, so most elements copy the answer of a neighbour.
    """
    elements = mask.shape[0] * mask.shape[1]
    element = copy_answers(mask, 0, large)
    while element < elements:
        fill_region(mask, least, element, large)
        element = copy_answers(mask, element + 1, large)


# On CUDA, each node follows its own region.


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
    mask: wp.array2d(dtype=wp.uint8),
    value: int,
    least: int,
    start: int,
    out: wp.array2d(dtype=wp.uint8),
):
    """Copy a mask, but without the regions of ``value``, 0 or 1, that have fewer than ``least`` elements, 2 to 16."""
    i = start + wp.tid()
    row = i / mask.shape[1]
    column = i % mask.shape[1]
    given = int(mask[row, column])
    if given == value and not is_large(mask, least, i):
        given = 1 - given
    out[row, column] = wp.uint8(given)
