"""The scenes of tiles on CPUs: Fourier transforms of planes of 128 x 128 numbers, eight lines at a time.

With 128 = 16 · 8 places, n = 8 a + b and k = a' + 16 b', a line has a transform of 16 over a, a turn of each number,
and a transform of 8 over b. Eight lines lie side by side in vectors: columns as they are in memory, rows turned around
in squares of 8 x 8. A tile's numbers stay in the cache of the core that transforms them.
"""

import warp as wp

from amiwarp.kernels.phase import first_of
from amiwarp.kernels.phase_grid import SIDE
from amiwarp.kernels.phase_spectra import scene_of_row

wp.set_module_options({"enable_backward": False})

PITCH = 136
"""Distance of the lines of a plane: by 128 the numbers of a column would share few places of the cache."""
PLANE = SIDE * PITCH + 40
"""Numbers of a plane. Real parts and imaginary parts have one each."""


@wp.struct
class TileTables:
    """What the tiles of the pictures through one optic have in common."""

    places: wp.array(dtype=wp.vec2i)
    """First row and column of each tile, which may lie outside of the image [px]."""
    window: wp.array2d(dtype=float)
    """Weights of a tile."""
    turns: wp.array(dtype=wp.vec2)
    """The numbers exp(-2πi n / SIDE)."""
    steps: wp.array3d(dtype=wp.vec2)
    """As :func:`amiwarp.kernels.phase_spectra.response_tables` writes them."""
    strengths: wp.array4d(dtype=float)
    """As :func:`amiwarp.kernels.phase_spectra.response_tables` writes them."""


ROOM = f"""
    float* __restrict__ real = (float*)room.data + at;
    float* __restrict__ imaginary = real + {PLANE};
"""


@wp.func_native(f"""{ROOM}
    const float* __restrict__ from = (const float*)values.data;
    const float* __restrict__ weights = (const float*)window.data;
    const int first = left < 0 ? -left : 0;
    const int stop = width - left < {SIDE} ? width - left : {SIDE};
    for (int row = 0; row < {SIDE}; ++row) {{
        float* __restrict__ x = real + row * {PITCH};
        float* __restrict__ y = imaginary + row * {PITCH};
        const int line = top + row;
        for (int c = 0; c < {SIDE}; ++c) {{ x[c] = 0.0f; y[c] = 0.0f; }}
        if (line < 0 || line >= height) continue;
        const float* __restrict__ weight = weights + row * {SIDE};
        const float* __restrict__ pairs = from + 2 * (((int64_t)k * height + line) * width + left);
        for (int c = first; c < stop; ++c) {{
            x[c] = weight[c] * pairs[2 * c];
            y[c] = weight[c] * pairs[2 * c + 1];
        }}
    }}
""")
def cut_plane(
    values: wp.array3d(dtype=wp.vec2),
    k: int,
    height: int,
    width: int,
    window: wp.array2d(dtype=float),
    top: int,
    left: int,
    room: wp.array2d(dtype=float),
    at: int,
):
    """Begin with the weighted numbers of a tile, which are 0 outside of the image."""


# A struct for eight complex numbers; transforms of four of them; and of a line of 128
@wp.func_native(f"""{ROOM}
#if !defined(__CUDA_ARCH__)
    {{
#pragma clang fp contract(fast)
    typedef float Eight __attribute__((vector_size(32)));
    typedef float Loose __attribute__((vector_size(32), aligned(4), may_alias));
    struct Number {{ Eight x, y; }};
    const float* turn = (const float*)turns.data;
    auto turned = [turn](const Number& a, int n) {{
        const float x = turn[2 * n];
        const float y = turn[2 * n + 1];
        return Number{{a.x * x - a.y * y, a.x * y + a.y * x}};
    }};
    auto four = [](Number& a, Number& b, Number& c, Number& d) {{
        const Number even = {{a.x + c.x, a.y + c.y}};
        const Number differs = {{a.x - c.x, a.y - c.y}};
        const Number odd = {{b.x + d.x, b.y + d.y}};
        const Number back = {{b.y - d.y, d.x - b.x}};  // -i (b - d)
        a = {{even.x + odd.x, even.y + odd.y}};
        b = {{differs.x + back.x, differs.y + back.y}};
        c = {{even.x - odd.x, even.y - odd.y}};
        d = {{differs.x - back.x, differs.y - back.y}};
    }};
    auto line = [&](auto&& from, auto&& to) {{
        Number middle[{SIDE}];
        for (int b = 0; b < 8; ++b) {{
            Number x[16];
#pragma unroll
            for (int a = 0; a < 16; ++a)
                x[a] = from(8 * a + b);
#pragma unroll
            for (int k = 0; k < 4; ++k) {{
                four(x[k], x[4 + k], x[8 + k], x[12 + k]);
#pragma unroll
                for (int wave = 1; wave < 4; ++wave)
                    if (k) x[4 * wave + k] = turned(x[4 * wave + k], 8 * wave * k);
            }}
#pragma unroll
            for (int wave = 0; wave < 4; ++wave) {{
                Number* own = x + 4 * wave;
                four(own[0], own[1], own[2], own[3]);
#pragma unroll
                for (int k = 0; k < 4; ++k)
                    middle[8 * (wave + 4 * k) + b] = turned(own[k], (wave + 4 * k) * b);
            }}
        }}
        for (int a = 0; a < 16; ++a) {{
            const Number* own = middle + 8 * a;
            Number even[4];
            Number odd[4];
#pragma unroll
            for (int k = 0; k < 4; ++k) {{
                even[k] = {{own[k].x + own[4 + k].x, own[k].y + own[4 + k].y}};
                const Number differs = {{own[k].x - own[4 + k].x, own[k].y - own[4 + k].y}};
                odd[k] = turned(differs, 16 * k);
            }}
            four(even[0], even[1], even[2], even[3]);
            four(odd[0], odd[1], odd[2], odd[3]);
#pragma unroll
            for (int k = 0; k < 4; ++k) {{
                to(a + 32 * k, even[k]);
                to(a + 32 * k + 16, odd[k]);
            }}
        }}
    }};
    auto turn_around = [](Eight* rows) {{
#pragma unroll
        for (int step = 0; step < 3; ++step) {{
            Eight found[8];
#pragma unroll
            for (int k = 0; k < 4; ++k) {{
                const Eight a = rows[k];
                const Eight b = rows[k + 4];
                found[2 * k] = __builtin_shufflevector(a, b, 0, 8, 1, 9, 2, 10, 3, 11);
                found[2 * k + 1] = __builtin_shufflevector(a, b, 4, 12, 5, 13, 6, 14, 7, 15);
            }}
#pragma unroll
            for (int k = 0; k < 8; ++k)
                rows[k] = found[k];
        }}
    }};
    for (int column = 0; column < {SIDE}; column += 8)
        line(
            [&](int n) {{
                const int place = n * {PITCH} + column;
                return Number{{*(const Loose*)(real + place), *(const Loose*)(imaginary + place)}};
            }},
            [&](int n, const Number& value) {{
                const int place = n * {PITCH} + column;
                *(Loose*)(real + place) = value.x;
                *(Loose*)(imaginary + place) = value.y;
            }});
    for (int row = 0; row < {SIDE}; row += 8) {{
        Number own[{SIDE}];
        for (int column = 0; column < {SIDE}; column += 8) {{
            Eight x[8];
            Eight y[8];
#pragma unroll
            for (int k = 0; k < 8; ++k) {{
                const int place = (row + k) * {PITCH} + column;
                x[k] = *(const Loose*)(real + place);
                y[k] = *(const Loose*)(imaginary + place);
            }}
            turn_around(x);
            turn_around(y);
#pragma unroll
            for (int k = 0; k < 8; ++k)
                own[column + k] = {{x[k], y[k]}};
        }}
        line([&](int n) {{ return own[n]; }}, [&](int n, const Number& value) {{ own[n] = value; }});
        for (int column = 0; column < {SIDE}; column += 8) {{
            Eight x[8];
            Eight y[8];
#pragma unroll
            for (int k = 0; k < 8; ++k) {{
                x[k] = own[column + k].x;
                y[k] = own[column + k].y;
            }}
            turn_around(x);
            turn_around(y);
#pragma unroll
            for (int k = 0; k < 8; ++k) {{
                const int place = (row + k) * {PITCH} + column;
                *(Loose*)(real + place) = x[k];
                *(Loose*)(imaginary + place) = y[k];
            }}
        }}
    }}
    }}
#endif
""")
def transform_plane(turns: wp.array(dtype=wp.vec2), room: wp.array2d(dtype=float), at: int):
    """Transform a plane: its columns, then its rows."""


@wp.func_native(f"""{ROOM}
    float* __restrict__ to = (float*)spectra.data + 2 * (int64_t)k * {SIDE * SIDE};
    for (int row = 0; row < {SIDE}; ++row) {{
        const float* __restrict__ x = real + row * {PITCH};
        const float* __restrict__ y = imaginary + row * {PITCH};
        for (int c = 0; c < {SIDE}; ++c) {{
            to[2 * (row * {SIDE} + c)] = x[c];
            to[2 * (row * {SIDE} + c) + 1] = y[c];
        }}
    }}
""")
def keep_spectrum(
    room: wp.array2d(dtype=float), at: int, k: int, spectra: wp.array3d(dtype=wp.vec2)
):
    """Write a plane as the spectrum of a harmonic."""


# The transform of conjugates is the conjugate of the inverse one, whose real part is wanted.
@wp.func_native(f"""{ROOM}
    const float* __restrict__ waves = (const float*)scene.data;
    const int half = {SIDE // 2 + 1};
    for (int row = 0; row < {SIDE}; ++row) {{
        float* __restrict__ x = real + row * {PITCH};
        float* __restrict__ y = imaginary + row * {PITCH};
        const float* __restrict__ here = waves + 2 * row * half;
        const float* __restrict__ behind = waves + 2 * (({SIDE} - row) % {SIDE}) * half;
        for (int c = 0; c < half; ++c) {{
            x[c] = here[2 * c];
            y[c] = -here[2 * c + 1];
        }}
        for (int c = half; c < {SIDE}; ++c) {{
            x[c] = behind[2 * ({SIDE} - c)];
            y[c] = behind[2 * ({SIDE} - c) + 1];
        }}
    }}
""")
def fill_with_scene(scene: wp.array2d(dtype=wp.vec2), room: wp.array2d(dtype=float), at: int):
    """Begin with the conjugates of the spectrum of a real scene, of which half of the columns are given."""


@wp.func_native(f"""{ROOM}
    const float* __restrict__ weights = (const float*)window.data;
    float* __restrict__ to = (float*)part.data;
    for (int row = 0; row < {SIDE}; ++row) {{
        const float* __restrict__ x = real + row * {PITCH};
        for (int c = 0; c < {SIDE}; ++c)
            to[row * {SIDE} + c] = weights[row * {SIDE} + c] * (x[c] * {1.0 / SIDE**2!r}f);
    }}
""")
def keep_part(
    room: wp.array2d(dtype=float),
    at: int,
    window: wp.array2d(dtype=float),
    part: wp.array2d(dtype=float),
):
    """Write the weighted real numbers of a plane."""


@wp.kernel
def tile_scenes(
    values: wp.array3d(dtype=wp.vec2),
    tables: TileTables,
    behind: wp.vec2,
    start: int,
    room: wp.array2d(dtype=float),
    spectra: wp.array4d(dtype=wp.vec2),
    scenes: wp.array3d(dtype=wp.vec2),
    parts: wp.array3d(dtype=float),
):
    """Write the weighted scenes of a share of the tiles, by least squares over the harmonics.

    ``values`` are the sums in phase, shape (harmonics, height, width). ``behind`` is exp(-i lag). ``parts`` has the
    shape (tiles, side, side). For each share there are a plane in ``room``, shape (shares, 2 PLANE), and room for the
    ``spectra`` and the spectrum of the scene of one tile: shapes (shares, harmonics, side, side) and (shares, side,
    side / 2 + 1).
    """
    share = wp.tid() + start
    shares = room.shape[0]
    tiles = parts.shape[0]
    harmonics = values.shape[0]
    at = share * room.shape[1]
    side = parts.shape[1]
    for tile in range(first_of(share, shares, tiles), first_of(share + 1, shares, tiles)):
        place = tables.places[tile]
        for k in range(harmonics):
            cut_plane(
                values,
                k,
                values.shape[1],
                values.shape[2],
                tables.window,
                place[0],
                place[1],
                room,
                at,
            )
            transform_plane(tables.turns, room, at)
            keep_spectrum(room, at, k, spectra[share])
        for row in range(side):
            scene_of_row(
                spectra[share],
                tables.steps,
                tables.strengths,
                tile,
                behind,
                row,
                harmonics,
                side,
                scenes.shape[2],
                scenes[share],
            )
        fill_with_scene(scenes[share], room, at)
        transform_plane(tables.turns, room, at)
        keep_part(room, at, tables.window, parts[tile])
