"""Coherence of edge directions, against NumPy and SciPy."""

import numpy as np
import pytest
from scipy import ndimage

from amiwarp.imaging import CanvasShape, Image
from amiwarp.imaging.edge_coherence import (
    EDGE_SMOOTHING_PX,
    LEAST_GRADIENT_SHARE,
    edge_coherence,
)
from amiwarp.imaging.sharpness import LEAST_PADDING

INSET = 8


def on_device(layers: np.ndarray, device: str) -> Image:
    image = Image(
        CanvasShape(layers.shape[2], layers.shape[1], per_polarity=len(layers) == 2),
        LEAST_PADDING,
        device,
    )
    image.write(layers.astype(np.float32))
    return image


def reference(image: np.ndarray) -> float:
    smooth = ndimage.gaussian_filter(image, EDGE_SMOOTHING_PX, mode="constant", radius=5)
    gy, gx = (slope[INSET:-INSET, INSET:-INSET] for slope in np.gradient(smooth))
    energy = gx**2 + gy**2
    angle = np.arctan2(gy, gx)
    strong = energy > LEAST_GRADIENT_SHARE * energy.max()
    return float(abs((energy * np.exp(2j * angle))[strong].sum()) / energy[strong].sum())


@pytest.mark.parametrize("shape", [(1, 80, 100), (2, 61, 173), (1, 480, 640)])
def test_against_numpy(shape: tuple[int, ...], device: str) -> None:
    rng = np.random.default_rng(1)
    rows, columns = np.mgrid[: shape[1], : shape[2]]
    edges = 20.0 * np.sin(0.3 * columns + 0.1 * rows) + 12.0 * np.sin(0.3 * rows)
    layers = rng.poisson(60.0, shape) + edges
    expected = reference(layers.sum(axis=0))
    assert 0.3 < expected < 0.9
    assert edge_coherence(on_device(layers, device), INSET) == pytest.approx(expected, rel=2e-4)


def test_stripes_and_noise(device: str) -> None:
    rng = np.random.default_rng(3)
    assert edge_coherence(on_device(rng.poisson(3.0, (1, 80, 100)), device), INSET) < 0.2
    stripes = np.tile(rng.poisson(9.0, 100), (1, 80, 1))
    assert edge_coherence(on_device(stripes, device), INSET) > 0.99
    # the border of the image, beyond which there is nothing, is no edge of the scene
    assert edge_coherence(on_device(stripes, device), 0) < 0.9


def test_an_even_image_has_no_direction(device: str) -> None:
    assert edge_coherence(on_device(np.full((1, 40, 50), 7.0), device), INSET) == 0.0


@pytest.mark.parametrize("inset", [6, 50])
def test_an_image_that_is_all_border_has_no_direction(inset: int, device: str) -> None:
    image = on_device(np.random.default_rng(4).poisson(5.0, (1, 10, 12)), device)
    assert edge_coherence(image, 2) > 0.0
    assert edge_coherence(image, inset) == 0.0
