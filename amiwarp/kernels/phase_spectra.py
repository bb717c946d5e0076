"""How a tile's scene makes the spectra of its sums in phase, and the scene that explains them best.

For a wave k of the scene L and an orbit a exp(iθ) + b exp(-iθ), the sum of harmonic m has the spectrum H_m(k) L(k),
with H_m = i m (i exp(i arg c))^m J_m(size of c) and c = conj(k) a + k conj(b).
"""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.struct
class Response:
    """Response of the sums in phase to one spatial wave: (i exp(i arg c))^m i m J_m(size of c)."""

    step: wp.vec2
    """i exp(i arg c), by which the harmonics differ."""
    left: int
    """Column of the table of Bessel functions below the size of c."""
    share: float
    """Share of the next column."""


@wp.func
def response_at(
    row: int, column: int, side: int, a: wp.vec2, b: wp.vec2, per_unit: float, columns: int
) -> Response:
    """Return the response of a tile with the orbit a exp(iθ) + b exp(-iθ) [px] at an element of its spectrum."""
    kx = frequency(column, side)
    ky = frequency(row, side)

    # k·u = Re(c exp(iθ)), with c = conj(k) a + k conj(b)
    c = wp.vec2(
        kx * a[0] + ky * a[1] + kx * b[0] + ky * b[1],
        kx * a[1] - ky * a[0] + ky * b[0] - kx * b[1],
    )
    size = wp.length(c)
    turned = wp.vec2(1.0, 0.0)
    if size > 0.0:
        turned = c / size

    found = Response()
    found.step = wp.vec2(-turned[1], turned[0])
    place = size * per_unit
    found.left = wp.min(int(place), columns - 2)
    found.share = wp.min(place - float(found.left), 1.0)
    return found


@wp.func
def strength_of(response: Response, bessel: wp.array2d(dtype=float), k: int) -> float:
    """Return the size m J_m of the response of harmonic m = k + 1, with its sign."""
    low = bessel[k, response.left]
    high = bessel[k, response.left + 1]
    return float(k + 1) * (low + response.share * (high - low))


@wp.kernel
def response_tables(
    orbits: wp.array2d(dtype=wp.vec2),
    bessel: wp.array2d(dtype=float),
    per_unit: float,
    damping: float,
    start: int,
    steps: wp.array3d(dtype=wp.vec2),
    strengths: wp.array4d(dtype=float),
):
    """Write the responses of the tiles to one wave each, for :func:`scene_spectrum`.

    ``orbits`` has the motion of each tile's middle over a turn, a exp(iθ) + b exp(-iθ) [px], as (a, b). ``bessel``
    holds the functions J_1, J_2, ... in steps of 1 / ``per_unit``. ``steps``, shape (tiles, side, side / 2 + 1), are
    the factors by which the harmonics differ; ``strengths``, shape (tiles, harmonics, side, side / 2 + 1), the sizes of
    the responses over the sum of their squares.
    """
    i = wp.tid() + start
    side = steps.shape[1]
    half = steps.shape[2]
    column = i % half
    row = (i / half) % side
    tile = i / (half * side)
    response = response_at(
        row, column, side, orbits[tile, 0], orbits[tile, 1], per_unit, bessel.shape[1]
    )
    weight = float(damping)
    for k in range(bessel.shape[0]):
        h = strength_of(response, bessel, k)
        # A scene is real: harmonics m and -m respond equally.
        weight += 2.0 * h * h
    steps[tile, row, column] = response.step
    for k in range(bessel.shape[0]):
        strengths[tile, k, row, column] = strength_of(response, bessel, k) / weight


# Columns lie side by side in memory, so that compilers vectorise the loops over them. The sums at the opposite waves
# come in the opposite order, and are turned around first.
@wp.func_native("""
    const float* __restrict__ sums = (const float*)spectra.data;
    const float* __restrict__ step = (const float*)steps.data + 2 * ((int64_t)tile * side + row) * half;
    float* __restrict__ to = (float*)out.data + 2 * (int64_t)row * half;
    const int opposite = (side - row) % side;
    float step_x[256], step_y[256], power_x[256], power_y[256], total_x[256], total_y[256];
    float there_x[256], there_y[256];
    for (int c = 0; c < half; ++c) {
        step_x[c] = step[2 * c] * turn[0] - step[2 * c + 1] * turn[1];
        step_y[c] = step[2 * c] * turn[1] + step[2 * c + 1] * turn[0];
        power_x[c] = 0.0f;
        power_y[c] = 1.0f;
        total_x[c] = 0.0f;
        total_y[c] = 0.0f;
    }
    float sign = 1.0f;
    for (int k = 0; k < harmonics; ++k) {
        const float* __restrict__ here = sums + 2 * ((int64_t)k * side + row) * side;
        const float* __restrict__ behind = sums + 2 * ((int64_t)k * side + opposite) * side;
        const float* __restrict__ strength =
            (const float*)strengths.data + (((int64_t)tile * harmonics + k) * side + row) * half;
        there_x[0] = behind[0];
        there_y[0] = behind[1];
        for (int c = 1; c < half; ++c) {
            there_x[c] = behind[2 * (side - c)];
            there_y[c] = behind[2 * (side - c) + 1];
        }
        sign = -sign;
        for (int c = 0; c < half; ++c) {
            const float x = power_x[c] * step_x[c] - power_y[c] * step_y[c];
            const float y = power_x[c] * step_y[c] + power_y[c] * step_x[c];
            power_x[c] = x;
            power_y[c] = y;
            // (conjugate of the power) times (here), and (power) times (conjugate of there)
            const float here_x = x * here[2 * c] + y * here[2 * c + 1];
            const float here_y = x * here[2 * c + 1] - y * here[2 * c];
            const float back_x = x * there_x[c] + y * there_y[c];
            const float back_y = y * there_x[c] - x * there_y[c];
            total_x[c] += strength[c] * (here_x + sign * back_x);
            total_y[c] += strength[c] * (here_y + sign * back_y);
        }
    }
    for (int c = 0; c < half; ++c) {
        to[2 * c] = total_x[c];
        to[2 * c + 1] = total_y[c];
    }
""")
def scene_of_row(
    spectra: wp.array3d(dtype=wp.vec2),
    steps: wp.array3d(dtype=wp.vec2),
    strengths: wp.array4d(dtype=float),
    tile: int,
    turn: wp.vec2,
    row: int,
    harmonics: int,
    side: int,
    half: int,
    out: wp.array2d(dtype=wp.vec2),
):
    """Write a row of the spectrum of the scene."""


@wp.kernel
def scene_spectrum(
    spectra: wp.array3d(dtype=wp.vec2),
    steps: wp.array3d(dtype=wp.vec2),
    strengths: wp.array4d(dtype=float),
    tile: int,
    turn: wp.vec2,
    start: int,
    out: wp.array2d(dtype=wp.vec2),
):
    """Write a row of the spectrum of the scene of a tile, by least squares over the harmonics.

    ``spectra`` are the Fourier transforms of the tile's sums in phase, shape (harmonics, side, side). ``steps`` and
    ``strengths`` are from :func:`response_tables`. ``turn`` is exp(-i lag), by which the orbit is behind. ``out`` has
    shape (side, side / 2 + 1), at most 256 columns: the scene is real, so that the other half of its spectrum are the
    conjugates.

    The sum of harmonic -m at a wave is the conjugate of the sum of m at the opposite wave, with the response (-1)^m
    times the conjugate.
    """
    row = wp.tid() + start
    scene_of_row(
        spectra,
        steps,
        strengths,
        tile,
        turn,
        row,
        strengths.shape[1],
        out.shape[0],
        out.shape[1],
        out,
    )


@wp.func
def scene_wave(
    spectra: wp.array3d(dtype=wp.vec2),
    row: int,
    column: int,
    a: wp.vec2,
    b: wp.vec2,
    bessel: wp.array2d(dtype=float),
    per_unit: float,
    damping: float,
) -> wp.vec2:
    """Return the spectrum of the scene at one wave of a tile with the orbit a exp(iθ) + b exp(-iθ) [px].

    As :func:`scene_spectrum`, for one thread a wave.
    """
    side = spectra.shape[1]
    opposite_row = (side - row) % side
    opposite_column = (side - column) % side
    response = response_at(row, column, side, a, b, per_unit, bessel.shape[1])
    total = wp.vec2(0.0, 0.0)
    weight = float(damping)
    power = wp.vec2(0.0, 1.0)
    sign = float(1.0)
    for k in range(bessel.shape[0]):
        power = times(power, response.step)
        sign = -sign
        h = strength_of(response, bessel, k)
        # The sum of harmonic -m at this wave is the conjugate of the sum of m at the opposite wave, with the response
        # (-1)^m times the conjugate.
        here = times(conjugate(power), spectra[k, row, column])
        there = times(power, conjugate(spectra[k, opposite_row, opposite_column]))
        total += h * (here + sign * there)
        weight += 2.0 * h * h
    return total / weight


@wp.kernel
def rest_spectra(
    spectra: wp.array3d(dtype=wp.vec2),
    orbits: wp.array2d(dtype=wp.vec2),
    tile: int,
    bessel: wp.array2d(dtype=float),
    per_unit: float,
    scene: wp.array2d(dtype=wp.vec2),
    start: int,
    out: wp.array3d(dtype=wp.vec2),
):
    """Write what the scene leaves of the spectra at one wave of a tile. ``scene`` is from :func:`scene_spectrum`."""
    i = wp.tid() + start
    side = spectra.shape[1]
    row = i / side
    column = i % side
    response = response_at(
        row, column, side, orbits[tile, 0], orbits[tile, 1], per_unit, bessel.shape[1]
    )
    wave = scene[row, wp.min(column, scene.shape[1] - 1)]
    if column >= scene.shape[1]:
        wave = conjugate(scene[(side - row) % side, side - column])
    power = wp.vec2(0.0, 1.0)
    for k in range(bessel.shape[0]):
        power = times(power, response.step)
        seen = strength_of(response, bessel, k) * times(power, wave)
        out[k, row, column] = spectra[k, row, column] - seen


@wp.func
def frequency(index: int, side: int) -> float:
    """Return the spatial frequency of an element of a discrete Fourier transform [rad/px]."""
    signed = index
    if index >= (side + 1) / 2:
        signed = index - side
    return 2.0 * wp.pi * float(signed) / float(side)


@wp.func
def times(a: wp.vec2, b: wp.vec2) -> wp.vec2:
    """Return the product of two complex numbers."""
    return wp.vec2(a[0] * b[0] - a[1] * b[1], a[0] * b[1] + a[1] * b[0])


@wp.func
def conjugate(a: wp.vec2) -> wp.vec2:
    """Return the conjugate of a complex number."""
    return wp.vec2(a[0], -a[1])
