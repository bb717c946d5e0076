"""Packets' columns put one after the other on a CPU, and looked at in passing: many packets by one launch, so that
threads do not wait for Python's lock at each of them."""

import warp as wp

wp.set_module_options({"enable_backward": False})

ROW = 10
"""Numbers of a part: where the addresses of its x, y, t, p stand, addresses where they go (p: 0 for nowhere), how many
events, and 1 where the event before them in memory is the one before them in time."""
FOUND = 3
"""What is found of a part: whether it is unsorted, and the largest x and y [px]."""


@wp.func_native("""
    const uint64_t* row = (const uint64_t*)table.data + 10 * i;
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
    int64_t back = row[9] && t[0] < t[-1];
    to_t[0] = t[0];
    for (int64_t k = 1; k < n; ++k) { to_t[k] = t[k]; back |= (int64_t)(t[k] < t[k - 1]); }
    if (to_p) for (int64_t k = 0; k < n; ++k) to_p[k] = p[k];
    int32_t* out = (int32_t*)found.data + 3 * i;
    out[0] = back != 0; out[1] = most_x; out[2] = most_y;
""")
def gather_part(table: wp.array(dtype=wp.uint64), i: int, found: wp.array(dtype=int)): ...


@wp.kernel
def gather_parts(table: wp.array(dtype=wp.uint64), found: wp.array(dtype=int), start: int):
    gather_part(table, start + wp.tid(), found)
