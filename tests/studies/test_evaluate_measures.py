"""Measures of the evaluations, on cases with known answers."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from amiwarp import AmiwarpError
from amiwarp.studies.evaluate import flow_error, naturalness
from amiwarp.studies.evaluate.joints import (
    PROPORTIONS,
    blob_keypoints,
    box_overlap,
    detected_joints,
)
from amiwarp.studies.evaluate.libraries import library
from amiwarp.studies.evaluate.overlaps import overlap
from amiwarp.studies.evaluate.similarity import displayed, fitted, similarity


def picture(shape: tuple[int, int] = (120, 160), seed: int = 0) -> NDArray[np.float64]:
    """A smooth random picture with values from 0 to 1."""
    image = ndimage.gaussian_filter(np.random.default_rng(seed).normal(size=shape), 3.0)
    return np.asarray((image - image.min()) / np.ptp(image))


def test_overlap_of_known_masks() -> None:
    found, truth = np.zeros(100, np.bool_), np.zeros(100, np.bool_)
    found[10:50], truth[20:80] = True, True
    result = overlap(found, truth)
    assert (result.iou, result.precision, result.recall) == (30 / 70, 30 / 40, 30 / 60)
    nothing = overlap(np.zeros(100, np.bool_), truth)
    assert nothing.iou == nothing.recall == 0.0
    assert math.isnan(nothing.precision)
    with pytest.raises(AmiwarpError, match="equal shapes"):
        overlap(found, truth[:-1])


def test_overlap_of_known_boxes() -> None:
    square = np.array([[0.0, 0.0], [2.0, 2.0], [1.0, 1.5]])
    assert box_overlap(square, square + np.array([1.0, 0.0])) == pytest.approx(2.0 / 6.0)
    assert box_overlap(square, np.vstack([square, [np.nan, 9.0]])) == 1.0
    assert box_overlap(square, square + 5.0) == 0.0
    assert box_overlap(square, np.full((2, 2), np.nan)) == 0.0


def test_endpoint_error_of_a_known_shift() -> None:
    truth = np.random.default_rng(1).normal(size=(20, 30, 2))
    flow = truth + np.array([3.0, 4.0])
    where = np.ones((20, 30), np.bool_)
    flow[0, 0] = np.nan
    result = flow_error(flow, truth, where)
    assert result.epe == pytest.approx(5.0)
    assert (result.outliers, result.pixels) == (1.0, 599)
    assert flow_error(flow, truth, where, outlier=5.5).outliers == 0.0
    assert math.isnan(flow_error(flow, truth, ~where).epe)
    with pytest.raises(AmiwarpError, match="height, width, 2"):
        flow_error(flow[..., 0], truth, where)


def test_detected_joints_of_known_distances() -> None:
    truth = np.array([[0.0, 0.0], [10.0, 0.0], [0.0, 10.0], [np.nan, np.nan]])
    found = np.array([[1.9, 0.0], [10.0, 2.1], [np.nan, np.nan], [0.0, 0.0]])
    assert detected_joints(found, truth, 10.0) == pytest.approx(1.0 / 3.0)
    assert detected_joints(found, truth, 10.0, fraction=0.25) == pytest.approx(2.0 / 3.0)
    assert detected_joints(truth, truth, 10.0) == 1.0
    assert math.isnan(detected_joints(found[3:], truth[3:], 10.0))
    with pytest.raises(AmiwarpError, match="twice"):
        detected_joints(found[:2], truth, 10.0)


def test_psnr_and_ssim_have_their_definitions() -> None:
    truth = 0.1 + 0.7 * picture()
    shifted = similarity(truth + 0.1, truth)
    assert shifted.psnr_db == pytest.approx(20.0)  # an error of a tenth of the range
    assert 0.8 < shifted.ssim < 1.0
    assert similarity(truth, truth).ssim == pytest.approx(1.0)
    assert similarity(truth, truth).psnr_db == math.inf
    noise = np.random.default_rng(2).normal(0.0, 1.0, truth.shape)
    scores = [similarity(truth + s * noise, truth) for s in (0.01, 0.03, 0.1)]
    assert scores[0].ssim > scores[1].ssim > scores[2].ssim
    # DB
    np.testing.assert_allclose([s.psnr_db for s in scores], [40.0, 30.46, 20.0], rtol=0, atol=0.2)
    with pytest.raises(AmiwarpError, match="equal shapes"):
        similarity(truth[:-1], truth)


def test_gain_and_offset_do_not_count() -> None:
    truth = np.log(picture() + 0.02)
    a, b = fitted(7.0 * truth - 3.0, truth)
    np.testing.assert_allclose(a, b, rtol=0, atol=1e-9)
    assert (b.min(), b.max()) == (0.0, 1.0)
    uniform, _ = fitted(np.zeros_like(truth), truth)
    assert np.ptp(uniform) == 0.0
    with pytest.raises(AmiwarpError, match="constant"):
        fitted(np.zeros_like(truth), np.zeros_like(truth))


def test_displayed_pictures_fill_the_range_of_grey_values() -> None:
    shown = displayed(5.0 * picture() - 2.0)
    assert (shown.min(), shown.max()) == (0.0, 255.0)
    assert np.unique(displayed(np.full((8, 8), 3.0))).tolist() == [128.0]


@pytest.fixture(scope="module")
def coins() -> NDArray[np.float64]:
    """A photograph that NIQE is not fitted to, shape (303, 384)."""
    assert "coins" not in naturalness.PICTURES
    return np.asarray(library("skimage.data").coins(), np.float64)


@pytest.mark.parametrize(
    ("shape", "message"),
    [
        ((100, 100, 3), r"shape \(100, 100, 3\); expected \(height, width\); give a grey picture"),
        ((95, 400), "picture is 400 x 95 px; NIQE needs blocks of 96 px; give at least 96 x 96 px"),
        ((100, 191), "picture is 191 x 100 px; NIQE needs two blocks of 96 px; give at least 192"),
    ],
)
def test_niqe_says_which_picture_it_needs(shape: tuple[int, ...], message: str) -> None:
    picture = np.random.default_rng(0).uniform(0.0, 255.0, shape)
    known = naturalness.NaturalPictures(np.zeros(36), np.eye(36))
    with pytest.raises(AmiwarpError, match=message):
        naturalness.niqe(picture, known)


def test_niqe_rises_with_blur_and_noise(coins: NDArray[np.float64]) -> None:
    noise = np.random.default_rng(3).normal(size=coins.shape)
    blurred = [naturalness.niqe(ndimage.gaussian_filter(coins, s)) for s in (0.0, 1.0, 2.0, 4.0)]
    noisy = [
        naturalness.niqe(np.clip(coins + s * noise, 0.0, 255.0))
        for s in (0.0, 5.0, 10.0, 20.0, 40.0)
    ]
    assert (np.diff(blurred) > 1.0).all()
    assert (np.diff(noisy) > 1.0).all()


def test_niqe_is_low_for_pictures_that_it_is_fitted_to(coins: NDArray[np.float64]) -> None:
    astronaut = 255.0 * library("skimage.color").rgb2gray(library("skimage.data").astronaut())
    assert (
        naturalness.niqe(astronaut)
        < naturalness.niqe(coins)
        < naturalness.niqe(ndimage.gaussian_filter(coins, 2.0))
    )
    assert naturalness.shipped_pictures().mean.shape == (naturalness.FEATURES,)


def test_niqe_refuses_small_pictures(coins: NDArray[np.float64]) -> None:
    with pytest.raises(AmiwarpError, match="two blocks"):
        naturalness.niqe(coins[:100, :100])
    with pytest.raises(AmiwarpError, match="96 x 96"):
        naturalness.niqe(coins[:90])
    with pytest.raises(AmiwarpError, match="over 36"):
        naturalness.fit([coins])


@pytest.mark.parametrize("shape", [0.8, 1.0, 2.0, 4.0])
def test_asymmetric_gaussians_are_found(shape: float) -> None:
    """Draws of a generalised Gaussian with different scales to the left and to the right."""
    rng = np.random.default_rng(4)
    size, left, right = 400_000, 0.5, 1.5
    half = rng.gamma(1.0 / shape, 1.0, size) ** (1.0 / shape)
    to_left = rng.random(size) < left / (left + right)
    values = np.where(to_left, -left * half, right * half)
    found = naturalness.asymmetric_gaussian(values)
    np.testing.assert_allclose(found, (shape, left, right), rtol=0.03, atol=0)


def test_blob_keypoints_follow_a_silhouette() -> None:
    """Only the plumbing: a dark rectangle gives joints in fixed proportions of its box."""
    image = np.full((120, 160), 200.0)
    image[20:101, 60:91] = 20.0
    image[5, 5] = 0.0
    joints = blob_keypoints(image)
    assert set(joints) == set(PROPORTIONS)
    np.testing.assert_allclose(joints["head"], [75.0, 20.0 + 0.07 * 80.0], rtol=0, atol=1.5)  # px
    moved = blob_keypoints(np.roll(image, 7, axis=1))
    np.testing.assert_allclose(
        moved["left knee"] - joints["left knee"], [7.0, 0.0], rtol=0, atol=1e-9
    )
    assert blob_keypoints(np.full((20, 20), 5.0)) == {}


def test_a_missing_library_names_the_remedy() -> None:
    with pytest.raises(
        AmiwarpError, match=r"needs no_such_library; run: pip install 'amiwarp\[evaluate\]'"
    ):
        library("no_such_library.part")
