"""Small orbits and thresholds: the brightness map is fine enough, and its damping does not bias the orbit."""

import math

import numpy as np
import pytest

from amiwarp import (
    Camera,
    FlatSide,
    PhotometricSettings,
    Prism,
    Recording,
    SensorModel,
    calibrate,
    model_error,
    simulate,
    truth_model,
)
from amiwarp.brightness.tiles import Tiles

CAMERA = Camera.from_fov(200, 150, math.radians(50.0))


def small_orbit(picture: np.ndarray) -> Recording:
    """Orbit with a radius of 1 px: apex 0.5 deg, 0.25 s at 720 rpm, with noise."""
    return simulate(picture, CAMERA, Prism(math.radians(0.5), 1.52), duration_s=0.25, seed=4)


def error_px(recording: Recording, **photometric: float) -> float:
    found = calibrate(recording, model="exact", photometric=PhotometricSettings(**photometric))  # type: ignore[arg-type]
    assert recording.truth is not None
    return model_error(found.model, truth_model(CAMERA, recording.truth, FlatSide.SCENE)).rms


def test_small_orbits_are_not_too_large(texture: np.ndarray) -> None:
    assert error_px(small_orbit(texture)) < 0.01


@pytest.mark.slow
def test_small_thresholds_do_not_change_the_orbit(texture: np.ndarray) -> None:
    """In units of a small threshold the map is large, so that the damping of ordinary maps would flatten it."""
    sensor = SensorModel(contrast_on=0.05, contrast_off=0.05)
    recording = simulate(
        texture, CAMERA, Prism(math.radians(2.0), 1.52), duration_s=0.25, sensor=sensor, seed=4
    )
    assert error_px(recording) < 0.01


@pytest.mark.parametrize("density", [1.0, 1.5, 3.0])
def test_tiles_of_another_density_cover_the_same_place(density: float) -> None:
    tiles = Tiles(np.array([[-3.0, 29.0]], np.float32), rows=78, columns=62, density=2.0)
    other = tiles.at_density(density)
    assert other.density == density
    assert np.array_equal(other.origin, tiles.origin)
    for found, given in ((other.rows, tiles.rows), (other.columns, tiles.columns)):
        assert (given - 1) / 2.0 <= (found - 1) / density < (given - 1) / 2.0 + 1.0 / density
