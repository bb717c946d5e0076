"""Blur of edges with known spread, and model error of models with known distance."""

import math

import numpy as np
import pytest

from amiwarp import AmiwarpError, Camera, ExactModel, Prism, edge_blur, model_error
from amiwarp.imaging import picture_quality
from amiwarp.imaging.metrics import find_edges


def circle_events(sigma: float, noise: int = 0, seed: int = 0) -> np.ndarray:
    """Events about a circle of radius 40 px, with a normal distribution across it."""
    rng = np.random.default_rng(seed)
    n = 200_000
    angle, radius = rng.uniform(0, math.tau, n), 40 + rng.normal(0, sigma, n)
    xy = np.stack([64 + radius * np.cos(angle), 64 + radius * np.sin(angle)], axis=1)
    return np.concatenate([xy, rng.uniform(0, 128, (noise, 2))]).astype(np.float32)


@pytest.mark.parametrize("sigma", [0.3, 0.6, 0.9])
def test_blur_is_the_spread_across_the_edge(sigma: float) -> None:
    assert edge_blur(circle_events(sigma), 128, 128) == pytest.approx(sigma, abs=0.06)


def test_an_even_background_does_not_count() -> None:
    """In the strip along the edge, there are 40 % as many noise events as events of the edge."""
    noisy = edge_blur(circle_events(0.6, noise=800_000), 128, 128)
    assert noisy == pytest.approx(0.6, abs=0.12)


def test_blur_of_other_places_of_the_same_events() -> None:
    sharp = circle_events(0.4)
    direction = np.random.default_rng(1).uniform(0, math.tau, len(sharp))
    orbit = np.stack([np.cos(direction), np.sin(direction)], axis=1)
    raw = sharp + 5.0 * orbit.astype(np.float32)
    expected = math.hypot(0.4, 5.0 / math.sqrt(2.0))
    assert edge_blur(sharp, 128, 128, of=raw) == pytest.approx(expected, abs=0.1)


def test_nan_and_outside_are_left_out() -> None:
    sharp = circle_events(0.4)
    marked = np.concatenate(
        [sharp, np.full((50, 2), np.nan, np.float32), np.full((50, 2), -9.0, np.float32)]
    )
    assert edge_blur(marked, 128, 128) == pytest.approx(edge_blur(sharp, 128, 128), abs=1e-6)


def test_edges_are_sub_pixel_and_normal() -> None:
    rows, columns = np.mgrid[:60, :80]
    line = (columns - 40.3) * math.cos(0.5) + (rows - 30) * math.sin(0.5)
    edges = find_edges((100 * np.exp(-(line**2) / 2)).astype(np.float32))
    inner = ((edges.xy > 8) & (edges.xy < (72, 52))).all(axis=1)
    away = (edges.xy[inner, 0] - 40.3) * math.cos(0.5) + (edges.xy[inner, 1] - 30) * math.sin(0.5)
    # Px: a parabola approximates the ridge's profile
    np.testing.assert_allclose(away, 0.0, rtol=0, atol=0.1)
    cosine = np.abs(edges.normal[inner] @ (math.cos(0.5), math.sin(0.5)))
    np.testing.assert_allclose(cosine, 1.0, rtol=0, atol=0.01)


def test_no_edges_is_an_error() -> None:
    with pytest.raises(AmiwarpError, match="no edges"):
        find_edges(np.zeros((20, 20), dtype=np.float32))


def test_model_error_takes_the_lag_off() -> None:
    camera = Camera.from_fov(320, 240, math.radians(60))
    truth = ExactModel(camera, Prism(math.radians(2)), 0.5)
    lagging = ExactModel(camera, Prism(math.radians(2)), 0.62)
    error = model_error(lagging, truth)
    assert error.rms < 2e-3
    assert error.lag == pytest.approx(0.12, abs=1e-3)


def test_model_error_is_the_difference_in_radius() -> None:
    camera = Camera.from_fov(320, 240, math.radians(20))
    truth, larger = (ExactModel(camera, Prism(math.radians(a))) for a in (2.0, 2.2))
    xy = np.array([[159.5, 119.5]])
    radius = [np.linalg.norm(m.compensate_points(xy, np.zeros(1)) - xy) for m in (truth, larger)]
    assert model_error(larger, truth).rms == pytest.approx(radius[1] - radius[0], rel=0.03)


RAMP = np.linspace(-1.0, 1.0, 1001).reshape(7, 143)
"""Range from the 0.5th to the 99.5th percentile: 1.98."""


def test_gain_and_offset_do_not_count() -> None:
    quality = picture_quality((RAMP - 0.3) / 0.25, RAMP)
    assert quality.gain == pytest.approx(0.25, abs=1e-12)
    assert quality.offset == pytest.approx(0.3, abs=1e-12)
    assert quality.correlation == pytest.approx(1.0, abs=1e-12)
    assert quality.psnr_db > 200.0


def test_an_exact_picture_has_no_error() -> None:
    ends = np.array([[0.0, 1.0], [1.0, 0.0]])
    quality = picture_quality(ends, ends)
    assert (quality.correlation, quality.psnr_db, quality.gain, quality.offset) == (
        1.0,
        math.inf,
        1.0,
        0.0,
    )


def test_psnr_of_a_known_error() -> None:
    """The error, 0.1, is uncorrelated with the picture, so the fit keeps it: variance 1, error² 0.01, range 2.2."""
    picture = np.array([[-1.0, -1.0, 1.0, 1.0]] * 100)
    truth = picture + np.array([[-0.1, 0.1, -0.1, 0.1]] * 100)
    quality = picture_quality(picture, truth)
    assert quality.psnr_db == pytest.approx(20.0 * math.log10(2.2 / 0.1), abs=1e-9)
    assert quality.correlation == pytest.approx(1.0 / math.sqrt(1.01), abs=1e-12)
    assert quality.gain == pytest.approx(1.0, abs=1e-12)


def test_an_inverted_picture_is_told_by_its_signs() -> None:
    quality = picture_quality(-2.0 * RAMP, RAMP)
    assert quality.correlation == pytest.approx(-1.0, abs=1e-12)
    assert quality.gain == pytest.approx(-0.5, abs=1e-12)


def test_only_the_pixels_asked_for_are_judged() -> None:
    """The range is that of the whole truth. Errors and NaN elsewhere are ignored."""
    where = np.zeros(RAMP.shape, np.bool_)
    where[0, :4] = True
    truth, picture = RAMP.copy(), np.full(RAMP.shape, np.nan)
    truth[0, :4], picture[0, :4] = (-0.6, -0.4, 0.4, 0.6), (-0.5, -0.5, 0.5, 0.5)
    span = float(np.ptp(np.percentile(truth, [0.5, 99.5])))
    assert picture_quality(picture, truth, where).psnr_db == pytest.approx(
        20.0 * math.log10(span / 0.1), abs=1e-9
    )


@pytest.mark.parametrize(
    ("log", "truth", "says"),
    [
        (RAMP[:3], RAMP, "shapes"),
        (np.zeros_like(RAMP), RAMP, "constant"),
        (RAMP, np.ones_like(RAMP), "constant"),
        (np.where(RAMP > 0.9, np.nan, RAMP), RAMP, "not finite"),
    ],
)
def test_pictures_that_cannot_be_judged(log: np.ndarray, truth: np.ndarray, says: str) -> None:
    with pytest.raises(AmiwarpError, match=says):
        picture_quality(log, truth)
