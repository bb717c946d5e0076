"""The lag of sums in phase: the angle by which the optic has turned on before an event is seen.

A pixel fires after the sensor's latency, and only once its brightness has gone a whole threshold on. Both together turn
the sums. The lag that explains the sums best is found from some tiles.
"""

from __future__ import annotations

import math

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from amiwarp.imaging.phase import PhaseSums
from amiwarp.imaging.phase_costs import orbit_costs
from amiwarp.optics.models.base import Model
from amiwarp.reconstruction.phase_tiles import Plan, cut_out, plan_of

TILES = 4
"""Number of tiles from which the lag is found: the strongest ones."""
LAGS = np.radians(np.arange(-6.0, 25.0, 3.0))
"""Lags that are tried [rad]. At 720 rpm, 3 deg are 0.7 ms."""
FINEST = 4.0
"""Finest waves that count: this divided by the radius of the orbit is their spatial frequency [rad]."""
MOST_HARMONICS = 6
"""Largest number of harmonics that count. To these waves, whose Bessel functions end at :data:`FINEST`, others respond
by less than a tenth of the largest response."""
LEAST_GAIN = 1e-3
"""Smallest share of the sums that a lag must explain beyond no lag."""


def lag_of(sums: PhaseSums, model: Model) -> float:
    """Return the lag of sums [rad], 0 if none explains them better than no lag."""
    plan = plan_of(model, sums.harmonics)
    chosen = _strongest(sums, plan)
    values = sums.values[:MOST_HARMONICS]
    cuts = np.stack([cut_out(values, plan.places[tile], plan.window) for tile in chosen])
    spectra = scipy.fft.fft2(cuts, axes=(2, 3), workers=1, overwrite_x=True)
    return lag_of_costs(LAGS, _costs(spectra, plan, chosen))


def lag_of_costs(lags: NDArray[np.float64], costs: NDArray[np.float64]) -> float:
    """Return the lag with the lowest cost, between those tried; 0 if it hardly explains more than no lag."""
    best = int(np.argmin(costs))
    at_zero = costs[np.argmin(np.abs(lags))]
    if at_zero - costs[best] < LEAST_GAIN:
        return 0.0
    if best in (0, len(lags) - 1):
        return float(lags[best])
    # Vertex of the parabola through the best lag and its neighbours.
    before, here, after = costs[best - 1 : best + 2]
    shift = 0.5 * (before - after) / (before - 2.0 * here + after)
    return float(lags[best] + shift * (lags[1] - lags[0]))


def _strongest(sums: PhaseSums, plan: Plan) -> list[int]:
    """Return the tiles with the largest first sums."""
    whole = [
        float(np.linalg.norm(cut_out(sums.values[:1], place, plan.window))) for place in plan.places
    ]
    order = np.argsort(whole, kind="stable")[::-1]
    return [int(tile) for tile in order[:TILES]]


def _costs(spectra: NDArray[np.complex64], plan: Plan, chosen: list[int]) -> NDArray[np.float64]:
    """Return what the best scene leaves of the spectra at each lag, relative to the spectra."""
    orbits = plan.orbits[chosen]
    radius = float(np.abs(orbits).max())
    # Events that lag by δ come from an orbit whose angle is δ behind.
    late = np.exp(np.outer(LAGS, [-1j, 1j]))
    tried = np.ascontiguousarray(late[:, None, :] * orbits[None], dtype=np.complex64)
    return orbit_costs(spectra, tried, min(FINEST / radius, math.pi))
