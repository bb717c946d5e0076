"""The lag of sums in phase, found on a device without its host: the tiles that tell most, their costs, the best lag.

A cost is summed by the threads of one block, in fixed order. On a CPU a block is one thread.
"""

import warp as wp

from amiwarp.kernels.phase_cost import counts, reach_of, wave_cost
from amiwarp.kernels.phase_spectra import times

THREADS = 256
"""Threads of a block."""
wp.set_module_options({"enable_backward": False, "block_dim": THREADS})


@wp.kernel
def tile_strengths(spectra: wp.array4d(dtype=wp.vec2), out: wp.array(dtype=float)):
    """Write the sum of the squared spectrum of a tile's first sum, in one block for each tile."""
    tile, thread = wp.tid()
    side = spectra.shape[2]
    total = float(0.0)
    for i in range(thread, side * side, wp.block_dim()):
        wave = spectra[tile, 0, i / side, i % side]
        total += wp.dot(wave, wave)
    whole = wp.tile_sum(wp.tile(total))
    if thread == 0:
        out[tile] = whole[0]


@wp.kernel
def choose_tiles(
    strengths: wp.array(dtype=float),
    orbits: wp.array2d(dtype=wp.vec2),
    reach: float,
    chosen: wp.array(dtype=int),
    finest: wp.array(dtype=float),
):
    """Write the strongest tiles, and the spatial frequency of the finest waves that count [rad/px].

    This is ``reach`` [rad] divided by the radius of the largest of their orbits. One thread of one block does it all.
    """
    _, thread = wp.tid()
    if thread > 0:
        return
    radius = float(0.0)
    for place in range(chosen.shape[0]):
        best = int(-1)
        for tile in range(strengths.shape[0]):
            free = bool(True)
            for before in range(place):
                if chosen[before] == tile:
                    free = False
            if free and (best < 0 or strengths[tile] >= strengths[best]):
                best = tile
        chosen[place] = best
        a = wp.length(orbits[best, 0])
        b = wp.length(orbits[best, 1])
        radius = wp.max(radius, wp.max(a, b))
    finest[0] = wp.min(reach / radius, wp.pi)


@wp.kernel
def lag_costs(
    spectra: wp.array4d(dtype=wp.vec2),
    orbits: wp.array2d(dtype=wp.vec2),
    turns: wp.array(dtype=wp.vec2),
    chosen: wp.array(dtype=int),
    finest: wp.array(dtype=float),
    bessel: wp.array2d(dtype=float),
    per_unit: float,
    damping: float,
    coarsest: float,
    out: wp.array2d(dtype=wp.vec2d),
):
    """Write what :func:`amiwarp.kernels.phase_cost.tile_costs` does for each lag and chosen tile, in one block each.

    ``turns`` hold cosine and sine of each lag. ``out`` has shape (lags, chosen tiles).
    """
    lag, place, thread = wp.tid()
    tile = chosen[place]
    a = turned_back(orbits[tile, 0], turns[lag])
    b = turned_on(orbits[tile, 1], turns[lag])
    side = spectra.shape[2]
    reach = reach_of(finest[0], side)
    lines = 2 * reach + 1
    left = wp.float64(0.0)
    total = wp.float64(0.0)
    for i in range(thread, (reach + 1) * lines, wp.block_dim()):
        column = i / lines
        line = i % lines - reach
        if counts(line, column, side, coarsest, finest[0]):
            row = (line + side) % side
            squares = wave_cost(spectra, tile, row, column, a, b, bessel, per_unit, damping)
            left += wp.float64(squares[0])
            total += wp.float64(squares[1])
    both = wp.tile_sum(wp.tile(wp.vec2d(left, total), preserve_type=True))
    if thread == 0:
        out[lag, place] = both[0]


@wp.kernel
def best_lag(
    costs: wp.array2d(dtype=wp.vec2d),
    lags: wp.array(dtype=wp.float64),
    zero: int,
    least_gain: wp.float64,
    lag: wp.array(dtype=wp.float64),
    turn: wp.array(dtype=wp.vec2),
):
    """Write the lag that explains the sums best [rad], and its cosine and sine.

    It is 0 if it explains no more than ``least_gain`` beyond no lag, which is number ``zero`` of the ``lags``. One
    thread of one block does it all.
    """
    _, thread = wp.tid()
    if thread > 0:
        return
    last = costs.shape[0] - 1
    best = int(0)
    for k in range(last + 1):
        if cost_of(costs, k) < cost_of(costs, best):
            best = k
    here = cost_of(costs, best)
    found = lags[best]
    if cost_of(costs, zero) - here < least_gain:
        found = wp.float64(0.0)
    elif best > 0 and best < last:
        # Vertex of the parabola through the best lag and its neighbours
        before = cost_of(costs, best - 1)
        after = cost_of(costs, best + 1)
        shift = wp.float64(0.5) * (before - after) / (before - wp.float64(2.0) * here + after)
        found += shift * (lags[1] - lags[0])
    lag[0] = found
    turn[0] = wp.vec2(float(wp.cos(found)), float(wp.sin(found)))


@wp.func
def cost_of(costs: wp.array2d(dtype=wp.vec2d), k: int) -> wp.float64:
    """Return what the best scene leaves of the sums at a lag, relative to the sums."""
    both = wp.vec2d(wp.float64(0.0), wp.float64(0.0))
    for place in range(costs.shape[1]):
        both += costs[k, place]
    return both[0] / wp.max(both[1], wp.float64(1.0e-30))


@wp.func
def turned_back(forward: wp.vec2, turn: wp.vec2) -> wp.vec2:
    """Return the rotation with the angle of an orbit that is behind by a lag: times exp(-i lag)."""
    return times(forward, wp.vec2(turn[0], -turn[1]))


@wp.func
def turned_on(backward: wp.vec2, turn: wp.vec2) -> wp.vec2:
    """Return the rotation against the angle of an orbit that is behind by a lag: times exp(i lag)."""
    return times(backward, turn)
