"""What a part of a turn shows that was not expected: its share of the brightness around each pixel; on CPUs."""

import warp as wp

wp.set_module_options({"enable_backward": False})

AROUND = 7
"""Side of the square over which the misfit of a pixel is taken [px]: single pixels have few events."""


# Sums over the lines around, and then over the pixels beside each other. Places outside of the image are those at its
# border. 192 pixels at a time stay in the cache.
@wp.func_native(f"""
    const float* __restrict__ squares = (const float*)change.data;
    const float* __restrict__ sizes = (const float*)size.data;
    const int32_t* __restrict__ ones = (const int32_t*)on.data;
    const int32_t* __restrict__ others = (const int32_t*)off.data;
    const int32_t* __restrict__ turns = (const int32_t*)changes.data;
    const float of_one = noise[0];
    const float of_other = noise[1];
    const float of_turn = noise[2];
    float* __restrict__ to = (float*)misfit.data + (int64_t)row * width;
    const int reach = {AROUND // 2};
    float all[192 + {AROUND - 1}];
    float whole[192 + {AROUND - 1}];
    for (int begin = 0; begin < width; begin += 192) {{
        const int count = width - begin < 192 ? width - begin : 192;
        const int first = begin < reach ? 0 : begin - reach;
        const int stop = begin + count + reach > width ? width : begin + count + reach;
        const int shift = reach - begin;
        for (int i = 0; i < 192 + {AROUND - 1}; ++i) {{ all[i] = 0.0f; whole[i] = 0.0f; }}
        for (int k = -reach; k <= reach; ++k) {{
            const int line = row + k < 0 ? 0 : (row + k < height ? row + k : height - 1);
            const int64_t at = (int64_t)line * width;
            for (int x = first; x < stop; ++x) {{
                const float of_events = of_one * (float)ones[at + x] + of_other * (float)others[at + x];
                const float random = of_events + of_turn * (float)turns[at + x];
                all[x + shift] += squares[at + x] - 2.0f * random;
                whole[x + shift] += sizes[at + x] - random;
            }}
        }}
        for (int i = 0; i < first + shift; ++i) {{
            all[i] = all[first + shift];
            whole[i] = whole[first + shift];
        }}
        for (int i = stop + shift; i < count + {AROUND - 1}; ++i) {{
            all[i] = all[stop + shift - 1];
            whole[i] = whole[stop + shift - 1];
        }}
        for (int x = 0; x < count; ++x) {{
            float differs = 0.0f;
            float seen = 0.0f;
            for (int k = 0; k < {AROUND}; ++k) {{ differs += all[x + k]; seen += whole[x + k]; }}
            const float share = 0.5f * differs / (seen > least ? seen : least);
            to[begin + x] = share < 0.0f ? 0.0f : (share > 1.0f ? 1.0f : share);
        }}
    }}
""")
def misfit_of_row(
    change: wp.array(dtype=float),
    size: wp.array(dtype=float),
    on: wp.array(dtype=int),
    off: wp.array(dtype=int),
    changes: wp.array(dtype=int),
    noise: wp.vec3,
    least: float,
    row: int,
    width: int,
    height: int,
    misfit: wp.array2d(dtype=float),
):
    """Write the misfits of a row."""


@wp.kernel
def write_misfit(
    change: wp.array(dtype=float),
    size: wp.array(dtype=float),
    on: wp.array(dtype=int),
    off: wp.array(dtype=int),
    changes: wp.array(dtype=int),
    noise: wp.vec3,
    least: float,
    start: int,
    misfit: wp.array2d(dtype=float),
):
    """Write the misfits of a row: half of the squared change over the squared size, over the square around each pixel.

    At random angles, an ON event, an OFF event and a change of polarity add ``noise`` to the size, and twice as much to
    the change. A size below ``least`` counts as ``least``.
    """
    row = wp.tid() + start
    misfit_of_row(
        change,
        size,
        on,
        off,
        changes,
        noise,
        least,
        row,
        misfit.shape[1],
        misfit.shape[0],
        misfit,
    )
