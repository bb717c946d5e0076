"""Coverage: how far a motion of the image displaces edges across themselves."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from amiwarp.studies.orbits import LEAST_SWING

PATH_ANGLES = 97
"""Number of angles per turn at which edges are followed: a prime, so that the starts differ from the directions."""
DIRECTIONS = 180
"""Number of edge directions."""
ACROSS_EDGES = 9
"""Number of columns of the grid of pixels at which edges are followed."""
DOWN_EDGES = 7
"""Number of its rows."""


@dataclass(frozen=True, slots=True)
class Coverage:
    """How far a motion displaces edges across themselves."""

    swing: float
    """Smallest displacement across an edge within the window [px]: over directions, starts and the image."""
    complete: float
    """Shortest time in which edges of every direction are displaced by :data:`LEAST_SWING` [turns]; infinite if some
    never are."""
    left_out: float
    """Share of the edge directions that are never displaced by :data:`LEAST_SWING`, mean over the image."""
    blind: float
    """Direction in the image of the edges that are displaced least during the whole motion [rad], 0 to π from x."""


def coverage(moved: NDArray[np.float64], window: float) -> Coverage:
    """Return how far paths displace edges across themselves.

    ``moved``: closed paths of pixels, :data:`PATH_ANGLES` points a turn, shape (pixels, angles, 2); ``window``: time in
    which edges have to be displaced [turns].
    """
    from scipy.ndimage import maximum_filter1d, minimum_filter1d

    normals = np.arange(DIRECTIONS) * (np.pi / DIRECTIONS)
    across = moved @ np.stack([np.cos(normals), np.sin(normals)])
    whole = np.ptp(across, axis=1)
    count = moved.shape[1]

    def least(steps: int) -> float:
        """Return the smallest displacement across an edge within a number of steps [px]."""
        if steps >= count:
            return float(whole.min())
        high = maximum_filter1d(across, steps + 1, axis=1, mode="wrap")
        low = minimum_filter1d(across, steps + 1, axis=1, mode="wrap")
        return float((high - low).min())

    # Within the window, between whole numbers of steps
    steps = window * PATH_ANGLES
    fewer = math.floor(steps)
    swing = least(fewer) + (steps - fewer) * (least(fewer + 1) - least(fewer))

    complete = math.inf
    if whole.min() >= LEAST_SWING:
        # The displacement grows with the number of steps: the smallest number that is enough is found by halving.
        few = 0
        enough = count
        while enough - few > 1:
            middle = (few + enough) // 2
            if least(middle) >= LEAST_SWING:
                enough = middle
            else:
                few = middle
        short = least(few)
        long = least(enough)
        complete = (few + (LEAST_SWING - short) / (long - short)) / PATH_ANGLES

    left_out = float((whole < LEAST_SWING).mean())
    blind_normal = float(normals[whole.mean(axis=0).argmin()])
    blind = (blind_normal + 0.5 * math.pi) % math.pi
    return Coverage(swing, complete, left_out, blind)
