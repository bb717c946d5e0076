"""Natural image quality evaluator (NIQE): distance of a picture's statistics from natural pictures' statistics.

Source: A. Mittal, R. Soundararajan and A. C. Bovik, "Making a 'Completely Blind' Image Quality Analyzer", IEEE Signal
Processing Letters 2013. This is an independent implementation. Its natural pictures are :data:`PICTURES`, not the
authors' own, so values are comparable with each other, but not with published ones.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, special

from amiwarp.errors import AmiwarpError
from amiwarp.studies.evaluate.libraries import library

BLOCK = 96
"""Side of a block of pixels [px]."""
SCALES = 2
"""Number of scales; the second has half the resolution."""
FEATURES = 18 * SCALES
"""Number of features of a block: 18 per scale."""
WINDOW_SIGMA = 7.0 / 6.0
"""Standard deviation of the local mean's window of 7 x 7 px [px]."""
SHARP_SHARE = 0.75
"""Share of the sharpest block's mean local deviation below which a block of a natural picture is not used."""
NEIGHBOURS = ((0, 1), (1, 0), (1, 1), (1, -1))
"""Steps (rows, columns) from a pixel to the neighbours with which it is multiplied."""
PICTURES = ("astronaut", "brick", "camera", "chelsea", "coffee", "grass", "gravel", "rocket")
"""Natural pictures of ``skimage.data``, all in the public domain or under CC0, and installed with scikit-image."""
SHAPES = np.arange(0.2, 10.001, 0.001)
"""Shapes of generalised Gaussians among which the fit chooses."""


@dataclass(frozen=True, eq=False)
class NaturalPictures:
    """Statistics of the features of natural pictures."""

    mean: NDArray[np.float64]
    """Mean of the features, shape ``(36,)``."""
    covariance: NDArray[np.float64]
    """Covariance of the features, shape ``(36, 36)``."""


def niqe(picture: NDArray[Any], natural: NaturalPictures | None = None) -> float:
    """Return the NIQE of a grey picture with values from 0 to 255. Lower is more natural.

    ``natural``: statistics of natural pictures, by default :func:`shipped_pictures`. The picture needs at least two
    blocks of 96 x 96 px, else :class:`AmiwarpError` is raised.
    """
    natural = natural or shipped_pictures()
    features, _ = block_features(picture)
    if len(features) < 2:
        raise AmiwarpError(
            f"picture is {_size_text(picture)}; NIQE needs two blocks of {BLOCK} px; give at least {2 * BLOCK} x "
            f"{BLOCK} px"
        )
    distance = features.mean(axis=0) - natural.mean
    pooled = (np.cov(features, rowvar=False) + natural.covariance) / 2.0
    return float(np.sqrt(distance @ np.linalg.pinv(pooled) @ distance))


def fit(pictures: list[NDArray[Any]]) -> NaturalPictures:
    """Return the statistics of the sharp blocks of grey pictures with values from 0 to 255."""
    rows = []
    for picture in pictures:
        features, sharpness = block_features(picture)
        rows.append(features[sharpness > SHARP_SHARE * sharpness.max()])
    table = np.concatenate(rows)
    if len(table) <= FEATURES:
        raise AmiwarpError(
            f"NIQE's statistics have {len(table)} sharp blocks; give pictures with over {FEATURES}"
        )
    return NaturalPictures(table.mean(axis=0), np.cov(table, rowvar=False))


@cache
def shipped_pictures() -> NaturalPictures:
    """Return the statistics of :data:`PICTURES`, each in its size and scaled to three quarters and to half."""
    data = library("skimage.data")
    colour = library("skimage.color")
    resize = library("skimage.transform").rescale
    grey = []
    for name in PICTURES:
        picture = getattr(data, name)()
        if picture.ndim == 3:
            picture = 255.0 * colour.rgb2gray(picture)
        picture = picture.astype(np.float64)
        grey.append(picture)
        for scale in (0.75, 0.5):
            grey.append(resize(picture, scale, anti_aliasing=True, preserve_range=True))
    return fit(grey)


def block_features(picture: NDArray[Any]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the features of each block, shape (n, 36), and the blocks' mean local deviation, shape (n,)."""
    if picture.ndim != 2:
        raise AmiwarpError(
            f"picture has shape {picture.shape}; expected (height, width); give a grey picture"
        )
    rows, columns = (side // BLOCK for side in picture.shape)
    if not rows or not columns:
        raise AmiwarpError(
            f"picture is {_size_text(picture)}; NIQE needs blocks of {BLOCK} px; give at least {BLOCK} x {BLOCK} px"
        )
    image = picture[: rows * BLOCK, : columns * BLOCK].astype(np.float64)
    features_by_scale: list[NDArray[np.float64]] = []
    sharpness = np.zeros(0)
    for scale in range(SCALES):
        if scale > 0:
            image = library("skimage.transform").rescale(
                image, 0.5, order=3, anti_aliasing=True, preserve_range=True
            )
        coefficients, deviation = locally_normalised(image)
        side = BLOCK >> scale
        blocks = _blocks(coefficients, side)
        features_by_scale.append(np.array([_features_of_block(block) for block in blocks]))
        if scale == 0:
            sharpness = np.array([block.mean() for block in _blocks(deviation, side)])
    return np.concatenate(features_by_scale, axis=1), sharpness


def _size_text(picture: NDArray[Any]) -> str:
    height, width = picture.shape
    return f"{width} x {height} px"


def locally_normalised(
    image: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the picture less its local mean, over its local deviation plus 1, and the local deviation."""
    mean = ndimage.gaussian_filter(image, WINDOW_SIGMA, radius=3, mode="nearest")
    square = ndimage.gaussian_filter(image * image, WINDOW_SIGMA, radius=3, mode="nearest")
    deviation = np.sqrt(np.abs(square - mean * mean))
    return (image - mean) / (deviation + 1.0), deviation


def _blocks(image: NDArray[np.float64], side: int) -> list[NDArray[np.float64]]:
    """Return the square blocks of an image whose sides are multiples of ``side`` [px]."""
    height, width = image.shape
    blocks = []
    for top in range(0, height, side):
        for left in range(0, width, side):
            blocks.append(image[top : top + side, left : left + side])
    return blocks


def _features_of_block(block: NDArray[np.float64]) -> list[float]:
    """Return the 18 features of a block of normalised pixels."""
    shape, left, right = asymmetric_gaussian(block)
    features = [shape, (left + right) / 2.0]
    for step in NEIGHBOURS:
        products = block * np.roll(block, step, axis=(0, 1))
        shape, left, right = asymmetric_gaussian(products)
        mean = (right - left) * float(special.gamma(2.0 / shape) / special.gamma(1.0 / shape))
        features += [shape, mean, left, right]
    return features


def asymmetric_gaussian(values: NDArray[np.float64]) -> tuple[float, float, float]:
    """Return shape, left scale and right scale of an asymmetric generalised Gaussian, by its moments.

    Source: N.-E. Lasmar, Y. Stitou and Y. Berthoumieu, "Multiscale skewed heavy tailed model for texture analysis",
    ICIP 2009.
    """
    flat = values.ravel()
    left = _root_mean_square(flat[flat < 0])
    right = _root_mean_square(flat[flat > 0])
    ratio = left / right
    flatness = np.mean(np.abs(flat)) ** 2 / max(float(np.mean(flat**2)), 1e-12)
    wanted = flatness * (ratio**3 + 1.0) * (ratio + 1.0) / (ratio**2 + 1.0) ** 2
    shape = float(SHAPES[np.argmin((_flatness() - wanted) ** 2)])
    scale = float(np.sqrt(special.gamma(1.0 / shape) / special.gamma(3.0 / shape)))
    return shape, left * scale, right * scale


def _root_mean_square(values: NDArray[np.float64]) -> float:
    """Return the root of the mean square, at least 1e-6, also without values."""
    if not values.size:
        return 1e-6
    return max(float(np.sqrt(np.mean(values**2))), 1e-6)


@cache
def _flatness() -> NDArray[np.float64]:
    """Return the squared mean absolute value over the mean square, of a generalised Gaussian of each shape."""
    one, two, three = (special.gamma(k / SHAPES) for k in (1.0, 2.0, 3.0))
    return np.asarray(two**2 / (one * three))
