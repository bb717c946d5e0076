"""The picture from sums in phase, compared with its definition in float64 (``reference/phase.py``)."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from amiwarp import Camera, ExactModel, PhaseSums, Prism, phase_image, phase_picture
from amiwarp.reconstruction.phase_lag import lag_of
from reference import optics, phase

WIDTH = 96
HEIGHT = 72
CAMERA = Camera.from_fov(WIDTH, HEIGHT, math.radians(50.0))
PRISM = Prism(math.radians(4.0))
"""Its orbit has a radius of 3.7 px in the middle."""
PHASE = 0.7
HARMONICS = 7
ANGLES = 48
INNER = np.s_[10:-10, 10:-10]


def path(pixels: NDArray[np.float64], angles: NDArray[np.float64]) -> NDArray[np.float64]:
    return optics.move(CAMERA, PRISM, pixels, angles, to_scene=True, phase=PHASE)


def scene(places: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a log intensity of many waves of 5 to 40 px, long ones higher, at places [px]."""
    rng = np.random.default_rng(1)
    total = np.zeros(places.shape[:-1])
    for _ in range(50):
        wave_number = math.tau / math.exp(rng.uniform(math.log(5.0), math.log(40.0)))
        direction = rng.uniform(0.0, math.tau)
        along = math.cos(direction) * places[..., 0] + math.sin(direction) * places[..., 1]
        total += 0.1 / wave_number * np.cos(wave_number * along + rng.uniform(0.0, math.tau))
    return total


@pytest.fixture(scope="module")
def places() -> NDArray[np.float64]:
    return phase.places_over_turn(path, WIDTH, HEIGHT, ANGLES)


@pytest.fixture(scope="module")
def sums(places: NDArray[np.float64]) -> NDArray[np.complex128]:
    return phase.sums_of_scene(scene(places), HARMONICS)


@pytest.fixture(scope="module")
def truth() -> NDArray[np.float64]:
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    return scene(np.stack([x, y], axis=2).astype(np.float64))


def as_sums(values: NDArray[np.complex128]) -> PhaseSums:
    events = np.ones((HEIGHT, WIDTH), np.int32)
    return PhaseSums(values.astype(np.complex64), events, events, 1.0, 1.0)


def picture_of(values: NDArray[np.complex128], phase_of_model: float) -> NDArray[np.float32]:
    return phase_picture(as_sums(values), ExactModel(CAMERA, PRISM, phase_of_model), lag=0.0)


def detail(picture: NDArray[np.floating]) -> NDArray[np.floating]:
    fine = picture - gaussian_filter(picture, 6.0)
    return fine[INNER].ravel()


def correlation(a: NDArray[np.floating], b: NDArray[np.floating]) -> float:
    return float(np.corrcoef(a, b)[0, 1])


def test_the_closed_form_gives_the_scene_back(
    sums: NDArray[np.complex128], truth: NDArray[np.float64]
) -> None:
    found = picture_of(sums, PHASE)
    assert correlation(detail(found), detail(truth)) > 0.9985
    assert correlation(found[INNER].ravel(), truth[INNER].ravel()) > 0.9985
    gain = (detail(found) * detail(truth)).sum() / (detail(truth) ** 2).sum()
    assert 0.93 < gain < 1.03


def test_the_closed_form_is_as_good_as_least_squares_over_all_pixels(
    sums: NDArray[np.complex128], places: NDArray[np.float64], truth: NDArray[np.float64]
) -> None:
    found = picture_of(sums, PHASE)
    expected = phase.picture_by_least_squares(sums, places, damping=0.02, steps=25)
    assert correlation(detail(expected), detail(truth)) > 0.998
    assert correlation(detail(found), detail(expected)) > 0.996


def test_a_phase_that_is_wrong_by_twenty_degrees_is_seen(
    sums: NDArray[np.complex128], truth: NDArray[np.float64]
) -> None:
    """The comparison tells a right picture from one that is a little wrong."""
    found = picture_of(sums, PHASE + math.radians(20.0))
    assert correlation(detail(found), detail(truth)) < 0.98


@pytest.mark.parametrize("degrees", [-4.0, 0.0, 7.0, 16.0])
def test_the_lag_of_events_is_found_and_undone(
    sums: NDArray[np.complex128], degrees: float
) -> None:
    """Events that come late by an angle turn the sum of harmonic m by m times this angle."""
    order = np.arange(1, HARMONICS + 1)[:, None, None]
    late = as_sums(sums * np.exp(-1j * order * math.radians(degrees)))
    model = ExactModel(CAMERA, PRISM, PHASE)
    found = lag_of(late, model)
    assert math.degrees(found) == pytest.approx(degrees, abs=1.0)
    picture = phase_picture(late, model)
    expected = picture_of(sums, PHASE)
    assert correlation(detail(picture), detail(expected)) > 0.9995
    image = phase_image(late, model)
    assert image.lag == found
    in_time = phase_image(as_sums(sums), model)
    assert correlation(image.gradient.ravel(), in_time.gradient.ravel()) > 0.999


def test_sums_without_a_scene_have_no_lag() -> None:
    nothing = as_sums(np.zeros((HARMONICS, HEIGHT, WIDTH), complex))
    assert lag_of(nothing, ExactModel(CAMERA, PRISM, PHASE)) == 0.0
