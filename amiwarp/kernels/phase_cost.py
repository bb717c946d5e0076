"""Cost of an orbit: what the scene that fits sums in phase best leaves of them, tile by tile."""

import warp as wp

from amiwarp.kernels.phase_spectra import frequency, response_at, strength_of, times

wp.set_module_options({"enable_backward": False})


@wp.kernel
def tile_costs(
    spectra: wp.array4d(dtype=wp.vec2),
    orbits: wp.array3d(dtype=wp.vec2),
    bessel: wp.array2d(dtype=float),
    per_unit: float,
    damping: float,
    coarsest: float,
    finest: float,
    start: int,
    out: wp.array2d(dtype=wp.vec2d),
):
    """Write the squares that the best scene of a tile leaves of its sums at one orbit, and the squares of the sums.

    ``spectra`` are the Fourier transforms of the sums in phase, shape (tiles, harmonics, side, side), of which waves
    from ``coarsest`` to ``finest`` count [rad/px]. ``orbits`` has the motion of each tile's middle over a turn for each
    candidate, a exp(iθ) + b exp(-iθ) [px], as (a, b), shape (candidates, tiles, 2). ``out`` has shape (candidates,
    tiles). Each thread sums in a fixed order.
    """
    i = wp.tid() + start
    tiles = spectra.shape[0]
    side = spectra.shape[2]
    candidate = i / tiles
    tile = i % tiles
    a = orbits[candidate, tile, 0]
    b = orbits[candidate, tile, 1]
    reach = reach_of(finest, side)
    left = wp.float64(0.0)
    total = wp.float64(0.0)
    # The scene is real, and so are the events: half of the waves say all.
    for column in range(reach + 1):
        for line in range(-reach, reach + 1):
            if counts(line, column, side, coarsest, finest):
                row = (line + side) % side
                squares = wave_cost(spectra, tile, row, column, a, b, bessel, per_unit, damping)
                left += wp.float64(squares[0])
                total += wp.float64(squares[1])
    out[candidate, tile] = wp.vec2d(left, total)


@wp.func
def reach_of(finest: float, side: int) -> int:
    """Return the largest row and column of the waves that count."""
    return wp.min(int(finest * float(side) / (2.0 * wp.pi)), (side - 1) / 2)


@wp.func
def counts(line: int, column: int, side: int, coarsest: float, finest: float) -> bool:
    """Return whether a wave counts: its size is within bounds [rad/px], and its opposite does not count already."""
    kx = frequency(column, side)
    ky = frequency((line + side) % side, side)
    size = wp.sqrt(kx * kx + ky * ky)
    twin = column == 0 and line <= 0
    return not twin and size >= coarsest and size <= finest


@wp.func
def wave_cost(
    spectra: wp.array4d(dtype=wp.vec2),
    tile: int,
    row: int,
    column: int,
    a: wp.vec2,
    b: wp.vec2,
    bessel: wp.array2d(dtype=float),
    per_unit: float,
    damping: float,
) -> wp.vec2:
    """Return what the best scene leaves of the sums at one wave and its opposite, and their squares.

    With the responses H, the sums A and the scene L = H* A / (H* H + d), the rest is |A|² - (H* H + 2 d) |L|².
    """
    side = spectra.shape[2]
    response = response_at(row, column, side, a, b, per_unit, bessel.shape[1])
    opposite_row = (side - row) % side
    opposite_column = (side - column) % side
    squares = float(0.0)
    strength = float(damping)
    total = wp.vec2(0.0, 0.0)
    power = wp.vec2(0.0, 1.0)
    for k in range(bessel.shape[0]):
        power = times(power, response.step)
        h = strength_of(response, bessel, k)
        here = spectra[tile, k, row, column]
        there = spectra[tile, k, opposite_row, opposite_column]
        squares += wp.dot(here, here) + wp.dot(there, there)
        strength += 2.0 * h * h
        total += h * times(wp.vec2(power[0], -power[1]), here)
        # The response to the opposite wave has the opposite step; the scene there is the conjugate.
        sign = 1.0 - 2.0 * float((k + 1) % 2)
        turned = times(wp.vec2(power[0], -power[1]), there)
        total += sign * h * wp.vec2(turned[0], -turned[1])
    scene = total / strength
    return wp.vec2(squares - (strength + damping) * wp.dot(scene, scene), squares)
