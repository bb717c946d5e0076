"""Sums in phase with optics whose motion is no orbit: vibrations, mirrors, pairs of prisms; and the scene from them.

The motion over a period is any closed path u(θ), given as samples at even steps of the angle. A wave k of the scene L
makes the sums A_m(k) = H_m(k) L(k), H_m(k) = i m times the Fourier coefficient of exp(i k·u(θ)). Where a path is a
line, waves along it are seen, and waves across it are not: these stay 0.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import lru_cache, partial

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.imaging.phase import PhaseSums
from amiwarp.imaging.phase_costs import DAMPING, LONGEST_WAVES
from amiwarp.kernels.phase_grid import SIDE
from amiwarp.optics.models.base import Model
from amiwarp.optics.orbit import LockedAngles, image_grid, orbits_of, paths_of
from amiwarp.optics.prism import Prism
from amiwarp.reconstruction.phase_lag import FINEST, lag_of_costs
from amiwarp.reconstruction.phase_tiles import (
    Mosaic,
    cut_out,
    places_and_window,
    tile_middles,
)
from amiwarp.tasks import in_order

COARSE_ANGLES = 128
"""Number of angles at which the extent of paths is found."""
MOST_REST_PX = 0.1
"""Largest rms of further harmonics of a motion that counts as an orbit [px]. Motions of a prism always do."""
LEAST_WIDTH = 0.05
"""Smallest difference of the two rotations of an orbit, relative to the larger one; less is a line."""
LEAST_REACH_PX = 0.05
"""Smallest distance of a path from its middle that counts as motion [px]."""
MOST_KEPT_BYTES = 1 << 28
"""Largest size of the responses of all tiles that are kept."""
LAG_TILES = 4
"""Number of tiles from which the lag is found: the strongest ones."""
LAGS = np.radians(np.arange(-72.0, 75.0, 3.0))
"""Lags that are tried [rad of the angle]. A vibration of 100 Hz goes on by 36 deg in 1 ms."""


@dataclass(frozen=True)
class PathPlan:
    """What the pictures through one optic have in common."""

    places: list[tuple[int, int]]
    """First row and column of each tile, which may lie outside of the image [px]."""
    window: NDArray[np.float32]
    """Weights of a tile."""
    paths: NDArray[np.complex64]
    """Motion of each tile's middle over a period [px], shape (tiles, angles)."""
    reach: float
    """Size of the motion [px]: the radius of circles, and the amplitude of motions along a line."""
    turns: int
    """Number of turns of the first angle in a period."""
    harmonics: int
    """Number of harmonics of the sums."""
    _kept: dict[int, NDArray[np.complex64]] = field(default_factory=dict, repr=False)

    def responses(self, tile: int) -> NDArray[np.complex64]:
        """Return :func:`responses_of` the path of a tile, which takes most time: small ones are kept."""
        found = self._kept.get(tile)
        if found is None:
            found = responses_of(self.paths[tile], self.harmonics)
            if len(self.places) * found.nbytes <= MOST_KEPT_BYTES:
                self._kept[tile] = found
        return found


def is_orbit(model: Model) -> bool:
    """Return whether an optic moves each point on an ellipse, so that :mod:`phase_tiles` has the closed form."""
    return model.ANGLES == 1 and _is_orbit(model)


@lru_cache(maxsize=8)
def _is_orbit(model: Model) -> bool:
    """Return the same for an optic with one angle."""
    if model.GLASS is Prism and model.PRISM:
        return True
    found = orbits_of(model, image_grid(model.camera, 5, 5))
    larger = np.maximum(np.abs(found.forward), np.abs(found.backward))
    smaller = np.minimum(np.abs(found.forward), np.abs(found.backward))
    wide = bool((larger - smaller > LEAST_WIDTH * larger).all())
    return wide and float(found.rest.max()) <= MOST_REST_PX


def radius_of_paths(model: Model, locked: LockedAngles | None) -> float:
    """Return the radius of a circle whose sums have as many harmonics as the paths of an optic [px]."""
    paths = _centred(paths_of(model, image_grid(model.camera, 5, 5), COARSE_ANGLES, locked))
    length = np.abs(np.diff(paths, axis=1, append=paths[:, :1])).sum(axis=1)
    return float(np.maximum(length / math.tau, np.abs(paths).max(axis=1)).mean())


@lru_cache(maxsize=8)
def path_plan_of(model: Model, locked: LockedAngles | None, harmonics: int) -> PathPlan:
    """Return the plan of pictures through an optic. Raises :class:`AmiwarpError` if it moves nothing."""
    places, window = places_and_window(model.camera)
    middles = tile_middles(model.camera, places)
    coarse = _centred(paths_of(model, middles, COARSE_ANGLES, locked))
    farthest = float(np.abs(coarse).max())
    if farthest < LEAST_REACH_PX:
        raise AmiwarpError(
            f"the {model.NAME} model moves the image by {farthest:.2g} px only, and sums in phase need a motion; give "
            "the calibration of this recording"
        )
    # So many that the waves' highest harmonics do not disturb those that are summed
    angles = 1 << math.ceil(math.log2(harmonics + 1.5 * math.pi * farthest + 8.0))
    paths = paths_of(model, middles, angles, locked)
    turns = 1 if locked is None else locked.turns
    return PathPlan(places, window, paths.astype(np.complex64), _reach(coarse), turns, harmonics)


def _centred(paths: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """Return paths about their middles."""
    return paths - paths.mean(axis=1, keepdims=True)


def _reach(centred: NDArray[np.complex128]) -> float:
    """Return the mean size of paths: √2 times their rms along the direction in which they are longest."""
    square = (np.abs(centred) ** 2).mean(axis=1)
    stretched = np.abs((centred**2).mean(axis=1))
    return float(np.sqrt(square + stretched).mean())


def responses_of(path: NDArray[np.complex64], harmonics: int) -> NDArray[np.complex64]:
    """Return how the waves of a tile make its sums: H_1, H_2, …, shape (harmonics, side, side).

    Responses below 0 are the conjugates of the responses to the opposite waves.
    """
    at = (math.tau * scipy.fft.fftfreq(SIDE)).astype(np.float32)
    along_x = np.exp(1j * np.outer(path.real, at))
    along_y = np.exp(1j * np.outer(path.imag, at))
    waves = (along_y[:, :, None] * along_x[:, None, :]).reshape(len(path), SIDE * SIDE)
    return (_by_angle(len(path), harmonics) @ waves).reshape(harmonics, SIDE, SIDE)


def _by_angle(angles: int, harmonics: int) -> NDArray[np.complex64]:
    """Return what the brightness at each angle of a period adds to the sums, shape (harmonics, angles)."""
    order = np.arange(1, harmonics + 1)[:, None]
    steps = np.exp(-1j * order * np.arange(angles) * (math.tau / angles))
    return (1j * order / angles * steps).astype(np.complex64)


def detail_of_paths(sums: PhaseSums, plan: PathPlan, lag: float) -> NDArray[np.float32]:
    """Return the scene that explains the sums best, without waves longer than a tile [thresholds].

    ``lag`` is the angle by which the optic has moved on before an event is seen [rad of the angle of the sums].
    """
    harmonics, height, width = sums.values.shape

    def scene(tile: int) -> NDArray[np.float32]:
        spectra = _spectra(sums.values, plan, tile)
        responses = plan.responses(tile) * _late(harmonics, lag)
        found = scene_of_responses(spectra, responses)
        return np.asarray(plan.window * scipy.fft.ifft2(found, workers=1).real)

    detail = Mosaic((height, width), np.dtype(np.float32))
    jobs = [partial(scene, tile) for tile in range(len(plan.places))]
    for place, part in zip(plan.places, in_order(jobs, fill_cores=True), strict=True):
        detail.add(place, part)
    return detail.values


def rest_of_picture(
    sums: PhaseSums, plan: PathPlan, lag: float, picture: NDArray[np.float32]
) -> NDArray[np.complex64]:
    """Return what a picture leaves of the sums, shape (harmonics, height, width)."""
    harmonics = sums.harmonics
    seen = picture[None].astype(np.complex64)

    def left(tile: int) -> NDArray[np.complex64]:
        spectra = _spectra(sums.values, plan, tile)
        responses = plan.responses(tile) * _late(harmonics, lag)
        rest = spectra - responses * _spectra(seen, plan, tile)
        return np.asarray(plan.window * scipy.fft.ifft2(rest, workers=1, overwrite_x=True))

    rest = Mosaic(sums.values.shape, np.dtype(np.complex64))
    jobs = [partial(left, tile) for tile in range(len(plan.places))]
    for place, part in zip(plan.places, in_order(jobs, fill_cores=True), strict=True):
        rest.add(place, part)
    return rest.values


def _spectra(values: NDArray[np.complex64], plan: PathPlan, tile: int) -> NDArray[np.complex64]:
    """Return the Fourier transforms of the weighted values of a tile."""
    cut = cut_out(values, plan.places[tile], plan.window)
    return np.asarray(scipy.fft.fft2(cut, workers=1, overwrite_x=True))


def _late(harmonics: int, lag: float) -> NDArray[np.complex64]:
    """Return the factors of sums whose events lag by an angle, shape (harmonics, 1, 1)."""
    order = np.arange(1, harmonics + 1)[:, None, None]
    return np.exp(-1j * order * lag).astype(np.complex64)


def scene_of_responses(
    spectra: NDArray[np.complex64], responses: NDArray[np.complex64]
) -> NDArray[np.complex64]:
    """Return the spectrum of the real scene that explains spectra of sums best, shape (side, side)."""
    total = (responses.conj() * spectra).sum(axis=0)
    weight = (np.abs(responses) ** 2).sum(axis=0)
    # Harmonics below 0 are the conjugates at the opposite waves.
    total = total + opposite(total).conj()
    weight = weight + opposite(weight) + DAMPING
    return np.asarray(total / weight)


def opposite(spectrum: NDArray[np.generic]) -> NDArray[np.generic]:
    """Return a spectrum with the values of -k at k."""
    return np.roll(spectrum[..., ::-1, ::-1], (1, 1), axis=(-2, -1))


def lag_of_paths(sums: PhaseSums, plan: PathPlan) -> float:
    """Return the lag of sums [rad of their angle], 0 if none explains them better than no lag."""
    harmonics = sums.harmonics
    size = [
        float(np.linalg.norm(cut_out(sums.values, place, plan.window))) for place in plan.places
    ]
    strongest = np.argsort(size, kind="stable")[::-1][:LAG_TILES]
    at = math.tau * scipy.fft.fftfreq(SIDE)
    wave = np.hypot(at[:, None], at[None, :])
    counts = (wave >= LONGEST_WAVES) & (wave <= min(FINEST / plan.reach, math.pi))
    y, x = (at[index] for index in np.nonzero(counts))
    factors = _by_angle(plan.paths.shape[1], harmonics)
    lags = LAGS / plan.turns
    turned = np.exp(1j * np.outer(lags, np.arange(1, harmonics + 1)))
    left = np.zeros(len(lags))
    whole = 0.0
    for tile in strongest.tolist():
        spectra = _spectra(sums.values, plan, tile)
        path = plan.paths[tile][:, None]
        seen = np.exp(1j * (path.real * x + path.imag * y))
        # Products this small take longer if they wait for threads.
        responses = np.einsum("ma,aw->mw", factors, seen)
        # Harmonics below 0 are the conjugates at the opposite waves.
        of_opposite = np.einsum("ma,aw->mw", factors, seen.conj())
        weight = (np.abs(responses) ** 2 + np.abs(of_opposite) ** 2).sum(axis=0) + DAMPING
        here = np.einsum("lm,mw->lw", turned, responses.conj() * spectra[:, counts])
        behind = of_opposite.conj() * opposite(spectra)[:, counts]
        there = np.einsum("lm,mw->lw", turned, behind)
        square = np.abs(here + there.conj()) ** 2
        # |A|² - (H* H + 2 d) |L|², over both halves of the waves
        left -= (square * (weight + DAMPING) / weight**2).sum(axis=1)
        whole += 2.0 * float((np.abs(spectra[:, counts]) ** 2).sum())
    return lag_of_costs(lags, 1.0 + left / max(whole, 1e-30))
