"""The scenes of all tiles together, from the spectra of their sums in phase."""

import warp as wp

from amiwarp.kernels.phase_lag import turned_back, turned_on
from amiwarp.kernels.phase_spectra import conjugate, scene_wave

wp.set_module_options({"enable_backward": False})


@wp.kernel
def write_scenes(
    spectra: wp.array4d(dtype=wp.vec2),
    orbits: wp.array2d(dtype=wp.vec2),
    turn: wp.array(dtype=wp.vec2),
    bessel: wp.array2d(dtype=float),
    per_unit: float,
    damping: float,
    start: int,
    out: wp.array3d(dtype=wp.vec2),
):
    """Write the spectrum of a tile's scene at one wave and at the opposite one, by least squares over the harmonics.

    ``spectra`` have the shape (tiles, harmonics, side, side), ``out`` (tiles, side, side). There is a thread for each
    of the columns up to side / 2: the scene is real, so that the others are conjugates. ``turn`` holds cosine and sine
    of the lag of events.
    """
    i = wp.tid() + start
    side = out.shape[1]
    half = side / 2
    column = i % (half + 1)
    row = i / (half + 1) % side
    tile = i / ((half + 1) * side)
    a = turned_back(orbits[tile, 0], turn[0])
    b = turned_on(orbits[tile, 1], turn[0])
    wave = scene_wave(spectra[tile], row, column, a, b, bessel, per_unit, damping)
    out[tile, row, column] = wave
    if column > 0 and column < half:
        out[tile, (side - row) % side, side - column] = conjugate(wave)
