"""Depth from sums in phase: sums that a closed form gives, a simulated recording, and the command."""

from __future__ import annotations

import math

import numpy as np
import pytest

import amiwarp
from amiwarp.imaging import PhaseSums
from amiwarp.reconstruction import TileDepths, depths_in_phase
from reference import optics as optics_reference
from reference import phase as reference

CAMERA = amiwarp.Camera.from_fov(128, 96, math.radians(50.0))
PLATE = amiwarp.Plate(0.02, math.radians(45.0), 1.5168)
PHASE = 0.7
HARMONICS = 11


def brightness(places: np.ndarray) -> np.ndarray:
    """Return the log intensity of a scene at places (..., 2) [px]: plane waves of random directions [thresholds]."""
    rng = np.random.default_rng(4)
    seen = np.zeros(places.shape[:-1])
    for _ in range(24):
        size = rng.uniform(0.2, 1.6)
        way = rng.uniform(0.0, math.tau)
        x, y = size * math.cos(way), size * math.sin(way)
        seen += np.sin(x * places[..., 0] + y * places[..., 1] + rng.uniform(0.0, math.tau)) / size
    return seen


def sums_at(inverse_depth: np.ndarray, *, lag: float = 0.0) -> PhaseSums:
    """Return the sums of a scene at a map of inverse depths [1/m], from traced rays. Events lag by an angle."""

    def path(pixels: np.ndarray, theta: np.ndarray) -> np.ndarray:
        return optics_reference.at_depth(
            CAMERA, PLATE, PHASE, pixels, theta - lag, inverse_depth.ravel()
        )

    places = reference.places_over_turn(path, CAMERA.width, CAMERA.height, 32)
    values = reference.sums_of_scene(brightness(places), HARMONICS).astype(np.complex64)
    events = np.full(inverse_depth.shape, 20)
    return PhaseSums(values, events, events, 1.0, 1.0)


MODEL = amiwarp.PlateModel(CAMERA, PLATE, PHASE)


@pytest.mark.parametrize("inverse_depth", [0.8, 1.7, 2.9])
def test_the_depth_of_a_plane_is_found(inverse_depth: float) -> None:
    sums = sums_at(np.full((CAMERA.height, CAMERA.width), inverse_depth))
    found = depths_in_phase(sums, MODEL, 4.0)
    known = np.isfinite(found.std)
    inside = known & (np.abs(found.middles - [63.5, 47.5]) < [36, 20]).all(axis=1)
    assert inside.sum() >= 24
    error = found.inverse_depth[inside] / inverse_depth - 1.0
    assert np.abs(np.median(error)) < 0.025
    assert np.abs(error).max() < 0.035
    assert (found.rest[inside] < 0.4).all()


def test_events_that_lag_do_not_move_the_depth() -> None:
    plane = np.full((CAMERA.height, CAMERA.width), 1.7)
    found = depths_in_phase(sums_at(plane, lag=math.radians(7.0)), MODEL, 4.0)
    known = np.isfinite(found.std)
    assert np.median(np.abs(found.inverse_depth[known] / 1.7 - 1.0)) < 0.015


def test_two_depths_are_told_apart() -> None:
    left = np.arange(CAMERA.width) < 64
    truth = np.where(left, 1.0, 2.4) * np.ones((CAMERA.height, 1))
    inverse, std = depths_in_phase(sums_at(truth), MODEL, 4.0).of_pixels(128, 96)
    assert inverse.shape == std.shape == truth.shape
    away = np.abs(np.arange(CAMERA.width) - 63.5) > 24.0
    known = (std < 0.1 * inverse) & away
    assert known[:, left].sum() > 500
    assert known[:, ~left].sum() > 500
    assert np.percentile(np.abs(inverse / truth - 1.0)[known], 90) < 0.06


def test_noise_has_no_depth() -> None:
    rng = np.random.default_rng(1)
    n = 200_000
    t = np.sort(rng.integers(0, 250_000, n))
    x = rng.integers(0, CAMERA.width, n)
    y = rng.integers(0, CAMERA.height, n)
    events = amiwarp.Events.from_arrays(x, y, t, rng.integers(0, 2, n))
    encoder = amiwarp.Encoder.constant_speed(720.0, 0, 250_000)
    sums = amiwarp.phase_sums(events, encoder, CAMERA.width, CAMERA.height, harmonics=HARMONICS)
    assert np.isinf(depths_in_phase(sums, MODEL, 4.0).std).all()


def test_a_depth_beyond_those_that_are_tried_is_unknown() -> None:
    plane = np.full((CAMERA.height, CAMERA.width), 3.6)
    found = depths_in_phase(sums_at(plane), MODEL, 1.5)
    assert np.isinf(found.std).mean() > 0.9


def test_a_pixel_takes_the_best_explained_tile_of_those_about_it() -> None:
    middles = np.array([(x, y) for y in (3.5, 11.5) for x in (3.5, 11.5, 19.5, 27.5)])
    inverse = np.arange(1.0, 9.0)
    rest = np.array([0.5, 0.1, 0.5, 0.5, 0.5, 0.5, 0.5, 0.3])
    found = TileDepths(middles, inverse, 0.1 * inverse, rest)
    of_pixels, std = found.of_pixels(32, 16)
    # The second tile is beside the first three of both rows, the last one beside the fourth ones.
    assert (of_pixels[:, :24] == 2.0).all()
    assert (of_pixels[:, 24:] == 8.0).all()
    # Where all nine are the same tile, nothing is added; here they differ.
    about_first = np.array([1, 1, 2, 1, 1, 2, 5, 5, 6], float)
    added = np.sqrt(((about_first - 2.0) ** 2).mean())
    np.testing.assert_allclose(std[0, 0], np.hypot(0.2, added), rtol=1e-6)
