"""Sharpness measures against NumPy. Each is higher for sharper images."""

import numpy as np
import pytest
import warp as wp
from scipy import ndimage

from amiwarp import AmiwarpError, Sharpness, sharpness
from amiwarp.imaging import CanvasShape, SharpnessMeter
from amiwarp.imaging.sharpness import PAPER_ETA, gaussian


@pytest.fixture
def image() -> np.ndarray:
    return np.random.default_rng(0).poisson(3.0, (40, 150)).astype(np.float32)


def reference(image: np.ndarray, kind: Sharpness) -> float:
    h = image.astype(np.float64)
    total = h.sum()
    wide = np.pad(h, 1)
    if kind is Sharpness.VARIANCE:
        return h.var() / h.mean()
    if kind is Sharpness.GRADIENT:
        gx, gy = (wide[1:-1, 2:] - wide[1:-1, :-2]) / 2, (wide[2:, 1:-1] - wide[:-2, 1:-1]) / 2
        return (gx**2 + gy**2).sum() / total
    if kind is Sharpness.LAPLACIAN:
        lap = wide[1:-1, 2:] + wide[1:-1, :-2] + wide[2:, 1:-1] + wide[:-2, 1:-1] - 4 * h
        return (lap**2).sum() / total
    if kind is Sharpness.PAPER_J:
        return -(1 / (1 + np.exp(h[h > 0] / PAPER_ETA))).sum()
    p = h[h > 0] / total
    return (p * np.log(p)).sum()


@pytest.mark.parametrize("kind", list(Sharpness))
def test_against_numpy(kind: Sharpness, image: np.ndarray, device: str) -> None:
    assert sharpness(image, kind, device=device) == pytest.approx(reference(image, kind), rel=1e-5)


@pytest.mark.parametrize("kind", list(Sharpness))
def test_smoothed_against_scipy(kind: Sharpness, image: np.ndarray, device: str) -> None:
    smooth = ndimage.gaussian_filter(image.astype(np.float64), 1.0, mode="constant", truncate=3.0)
    assert sharpness(image, kind, smoothing=1.0, device=device) == pytest.approx(
        reference(smooth, kind), rel=1e-4
    )


def test_votes_are_measured_as_their_image(image: np.ndarray) -> None:
    if not wp.is_cuda_available():
        pytest.skip("no CUDA device")
    canvas = CanvasShape(image.shape[1], image.shape[0])
    meter = SharpnessMeter(canvas, Sharpness.VARIANCE, smoothing=1.5, device="cuda:0")
    meter.image.write(np.round(95.0 * image)[None].astype(np.float32) / 256.0)
    of_image = meter.measure()
    votes = wp.array(np.rint(256.0 * meter.image.pixels.numpy()).astype(np.int64), device="cuda:0")
    meter.image.pixels.zero_()
    meter.launch(votes)
    assert meter.results() == [of_image]
    assert of_image > 0.0


@pytest.mark.parametrize("kind", list(Sharpness))
def test_sharper_is_higher(kind: Sharpness) -> None:
    line = np.zeros((40, 50), dtype=np.float32)
    line[:, 25] = 64.0
    blurred = np.round(ndimage.gaussian_filter1d(line, 2.0, axis=1) * 256) / 256
    assert sharpness(line, kind) > sharpness(blurred, kind)


def test_two_layers_are_measured_together(image: np.ndarray) -> None:
    stack = np.stack([image, image])
    assert sharpness(stack, Sharpness.GRADIENT) == pytest.approx(
        sharpness(image, Sharpness.GRADIENT), rel=1e-6
    )


def test_events_strewn_at_random_have_variance_one() -> None:
    image = np.random.default_rng(1).poisson(2.0, (300, 400)).astype(np.float32)
    assert sharpness(image) == pytest.approx(1.0, abs=0.02)


def test_gaussian_sums_to_one() -> None:
    weights = gaussian(1.7)
    assert weights[0] + 2 * weights[1:].sum() == pytest.approx(1.0, abs=1e-6)
    assert len(gaussian(0.0)) == 1


@pytest.mark.parametrize("sigma", [-1.0, float("nan"), float("inf")])
def test_bad_smoothing_is_refused(sigma: float) -> None:
    with pytest.raises(AmiwarpError, match="standard deviation"):
        gaussian(sigma)


def test_bad_images_are_refused(image: np.ndarray) -> None:
    with pytest.raises(AmiwarpError, match="finite"):
        sharpness(np.full((4, 4), np.nan, dtype=np.float32))
    with pytest.raises(AmiwarpError, match=r"shape \(3, 4, 4\); expected"):
        sharpness(np.zeros((3, 4, 4), dtype=np.float32))


@pytest.mark.parametrize("where", [(0, 0), (17, 93), (39, 149)])
def test_a_difference_of_polarities_is_refused(
    image: np.ndarray, where: tuple[int, int], device: str
) -> None:
    """Its sum may be 0, and the score says nothing."""
    image[where] = -2.5
    for given in (image, wp.array(image, device=device), wp.array([image, image], device=device)):
        with pytest.raises(AmiwarpError, match=r"holds the negative value -2\.5; give numbers of"):
            sharpness(given)


def test_an_empty_image_has_no_sharpness() -> None:
    assert sharpness(np.zeros((10, 10), dtype=np.float32)) == 0.0
