"""Sums in phase of some tiles of the image, from which orbits are judged without the events.

The events of whole turns about the middle of the recording are summed once. Large images are shrunk first: the waves
that tell the orbit are long. See ``docs/explanation/phase.md``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from amiwarp.events.encoder import Encoder
from amiwarp.events.recording import Events
from amiwarp.imaging.phase import phase_sums
from amiwarp.imaging.phase_costs import orbit_costs
from amiwarp.tasks import cpu_threads

SIDE = 64
"""Side of a tile [shrunk px]."""
LARGEST_PX = 400
"""Largest width of the image in shrunk pixels."""
LARGEST_RADIUS = 14.0
"""Largest radius of an orbit [shrunk px]: tiles must hold waves that are longer than it."""
HARMONICS = 6
"""Number of harmonics of the angle."""
FINEST = 2.0
"""Spatial frequency of the finest waves that count [rad/shrunk px]."""


@dataclass(frozen=True, eq=False)
class PhaseTiles:
    """Spectra of the sums in phase of some tiles, and the cost of an orbit that they give."""

    spectra: NDArray[np.complex64]
    """Fourier transforms of the windowed sums, shape (tiles, harmonics, side, side)."""
    middles: NDArray[np.float64]
    """Middle of each tile [px], shape (tiles, 2)."""
    shrink: int
    """Side of the squares of pixels that were joined [px]."""

    @classmethod
    def of(
        cls, events: Events, encoder: Encoder, width: int, height: int, radius: float
    ) -> PhaseTiles:
        """Return the tiles of the events of whole turns. ``radius`` is the radius of the largest orbit [px]."""
        shrink = max(1, -(-width // LARGEST_PX), math.ceil(radius / LARGEST_RADIUS))
        small_width = -(-width // shrink)
        small_height = -(-height // shrink)
        if shrink > 1:
            divisor = np.uint16(shrink)
            events = Events(events.x // divisor, events.y // divisor, events.t, events.p)
        # Events are thinned, so that extremes between two successive ones are not known.
        sums = phase_sums(
            events,
            encoder,
            small_width,
            small_height,
            turns=1.0,
            harmonics=HARMONICS,
            extremes=False,
        ).values

        padding = max(0, SIDE - small_height), max(0, SIDE - small_width)
        sums = np.pad(sums, ((0, 0), (0, padding[0]), (0, padding[1])))
        _, rows, columns = sums.shape
        tops = np.linspace(0, rows - SIDE, max(1, rows // SIDE)).astype(int)
        lefts = np.linspace(0, columns - SIDE, max(1, columns // SIDE)).astype(int)
        line = np.hanning(SIDE + 2)[1:-1]
        window = np.outer(line, line).astype(np.float32)
        corners = [(top, left) for top in tops for left in lefts]
        parts = np.stack([window * sums[:, r : r + SIDE, c : c + SIDE] for r, c in corners])
        spectra = scipy.fft.fft2(parts, axes=(2, 3), workers=cpu_threads(), overwrite_x=True)
        middles = np.array([(c + (SIDE - 1) / 2, r + (SIDE - 1) / 2) for r, c in corners])
        middles = shrink * middles + (shrink - 1) / 2
        single = spectra.astype(np.complex64, copy=False)
        return cls(single, np.minimum(middles, (width - 1.0, height - 1.0)), shrink)

    def costs(self, orbits: NDArray[np.complex128], finest: float = FINEST) -> NDArray[np.float64]:
        """Return the cost of some candidates, 0 to 1, shape (candidates,).

        ``orbits`` has the rotations of each tile's middle with and against the angle [px], shape (candidates, tiles,
        2). ``finest`` is the spatial frequency of the finest waves that count [rad/shrunk px].
        """
        shrunk = np.ascontiguousarray(orbits / self.shrink, dtype=np.complex64)
        return orbit_costs(self.spectra, shrunk, finest)
