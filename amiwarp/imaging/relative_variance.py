"""Variance of the density of events, freed from what counting them at random places gives."""

from __future__ import annotations

import numpy as np

from amiwarp.imaging.sharpness import gaussian


def random_variance(smoothing: float) -> float:
    """Return the variance over mean of an image of random events: bilinear votes at dithered places, then smoothed.

    ``smoothing``: standard deviation of the Gaussian [px].
    """
    weights = gaussian(smoothing).astype(np.float64)
    both_sides = np.concatenate([weights[:0:-1], weights])
    square = float(both_sides @ both_sides)
    of_neighbours = float(both_sides[1:] @ both_sides[:-1])
    # Bilinear votes share an event by 1 - u and u, with u from 0 to 1: 2/3 is the mean of (1 - u)² + u².
    along_an_axis = (2.0 * square + of_neighbours) / 3.0
    return along_an_axis**2


def relative_variance(variance: float, mean: float, smoothing: float) -> float:
    """Return the variance of the density of events over the square of its mean, which more events do not change.

    It is 0 for events at random places, whatever their number: the variance that counting gives them is subtracted.

    Parameters
    ----------
    variance : float
        Variance over mean of an image of bilinear votes of dithered events, from :class:`SharpnessMeter`.
    mean : float
        Mean of that image [events per pixel], above 0.
    smoothing : float
        Standard deviation of the Gaussian that smoothed the image [px].

    Returns
    -------
    float
        The relative variance. It is negative only by noise.
    """
    return (variance - random_variance(smoothing)) / mean
