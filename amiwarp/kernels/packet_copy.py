"""Copy of the columns of many packets into contiguous arrays on a CPU, with a check of order and range.

One launch copies many packets, so that threads do not wait for Python's lock at each packet.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

SOURCES = 0
"""First of four entries of a row of the table of packets: addresses of the pointers to x, y, t and p."""
TARGETS = 4
"""First of four entries of a row: addresses to which x, y, t and p go; 0 to skip p."""
COUNT = 8
"""Entry of a row: number of events."""
ROW = 9
"""Number of entries of a row."""
FOUND = 3
"""Number of results per row of the table of packets: 1 if the times are out of order, else 0; largest x [px]; largest y
[px]."""


@wp.func_native("""
    const uint64_t* row = (const uint64_t*)table.data + 9 * i;
    const int64_t n = (int64_t)row[8];
    const uint16_t* __restrict__ x = *(const uint16_t**)row[0];
    const uint16_t* __restrict__ y = *(const uint16_t**)row[1];
    const int64_t* __restrict__ t = *(const int64_t**)row[2];
    const uint8_t* __restrict__ p = *(const uint8_t**)row[3];
    uint16_t* __restrict__ to_x = (uint16_t*)row[4];
    uint16_t* __restrict__ to_y = (uint16_t*)row[5];
    int64_t* __restrict__ to_t = (int64_t*)row[6];
    uint8_t* __restrict__ to_p = (uint8_t*)row[7];
    uint16_t most_x = 0, most_y = 0;
    for (int64_t k = 0; k < n; ++k) { to_x[k] = x[k]; most_x = x[k] > most_x ? x[k] : most_x; }
    for (int64_t k = 0; k < n; ++k) { to_y[k] = y[k]; most_y = y[k] > most_y ? y[k] : most_y; }
    int64_t back = 0;
    to_t[0] = t[0];
    for (int64_t k = 1; k < n; ++k) { to_t[k] = t[k]; back |= (int64_t)(t[k] < t[k - 1]); }
    if (to_p) for (int64_t k = 0; k < n; ++k) to_p[k] = p[k];
    int32_t* out = (int32_t*)found.data + 3 * i;
    out[0] = back != 0; out[1] = most_x; out[2] = most_y;
""")
def gather_part(table: wp.array(dtype=wp.uint64), i: int, found: wp.array(dtype=int)):
    """Copy the packet of table row ``i`` and store its results in ``found``."""


@wp.kernel
def gather_parts(table: wp.array(dtype=wp.uint64), found: wp.array(dtype=int), start: int):
    """Copy the packet of one table row per thread."""
    gather_part(table, start + wp.tid(), found)
