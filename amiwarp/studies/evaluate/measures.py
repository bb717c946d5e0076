"""Quality of pictures, and what several evaluations use: optional libraries, and Gaussian smoothing."""

import importlib
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, special

from amiwarp.errors import AmiwarpError
from amiwarp.imaging.metrics import TRUTH_PERCENTILES, picture_quality

# Optional libraries of the evaluations.


def library(name: str) -> Any:
    """Return a module of an optional library. Raises :class:`AmiwarpError` if it is not installed."""
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        what = name.partition(".")[0]
        raise AmiwarpError(f"'amiwarp evaluate' needs {what}; run: pip install 'amiwarp[evaluate]'") from error


# Gaussian smoothing of images.


def smoothed(image: NDArray[Any], sigma: float, *, truncate: float = 4.0, mirrored: bool = True) -> NDArray[np.float32]:
    """Return an image smoothed by a Gaussian of standard deviation ``sigma`` [px]; OpenCV is the fastest on one core.

    ``truncate``: radius at which the Gaussian ends [standard deviations]. Outside, the image is ``mirrored``, or zero.
    """
    plain, cv2 = np.ascontiguousarray(image, np.float32), library("cv2")
    if sigma <= 0.0:
        return plain
    side = 2 * int(truncate * sigma + 0.5) + 1
    border = cv2.BORDER_REFLECT if mirrored else cv2.BORDER_CONSTANT
    return np.asarray(cv2.GaussianBlur(plain, (side, side), sigma, borderType=border), np.float32)


# Natural image quality evaluator (NIQE): distance of a picture's statistics from those of natural pictures.
#
# Source: A. Mittal, R. Soundararajan and A. C. Bovik, "Making a 'Completely Blind' Image Quality Analyzer", IEEE Signal
# Processing Letters 2013. This is an independent implementation. Its natural pictures are :data:`PICTURES`, not those
# of the authors, so values are comparable with each other, but not with published ones.

BLOCK = 96
"""Side of a block of pixels [px]."""
SCALES = 2
"""Number of scales; the second has half the resolution."""
FEATURES = 36
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
        raise AmiwarpError(f"picture has shape {picture.shape}; NIQE needs two blocks of {BLOCK} x {BLOCK} px")
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
        raise AmiwarpError(f"NIQE's statistics have {len(table)} sharp blocks; give pictures with over {FEATURES}")
    return NaturalPictures(table.mean(axis=0), np.cov(table, rowvar=False))


@cache
def shipped_pictures() -> NaturalPictures:
    """Return the statistics of :data:`PICTURES`, each in its size and scaled to three quarters and to half."""
    data, colour = library("skimage.data"), library("skimage.color")
    resize = library("skimage.transform").rescale
    grey = []
    for name in PICTURES:
        picture = getattr(data, name)()
        picture = 255.0 * colour.rgb2gray(picture) if picture.ndim == 3 else picture.astype(np.float64)
        grey += [picture, *(resize(picture, scale, anti_aliasing=True, preserve_range=True) for scale in (0.75, 0.5))]
    return fit(grey)


def block_features(picture: NDArray[Any]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the features of each block, shape (n, 36), and the blocks' mean local deviation, shape (n,)."""
    rows, columns = (side // BLOCK for side in picture.shape)
    if not rows or not columns:
        raise AmiwarpError(f"picture has shape {picture.shape}; NIQE needs blocks of {BLOCK} x {BLOCK} px")
    image = picture[: rows * BLOCK, : columns * BLOCK].astype(np.float64)
    columns_of: list[NDArray[np.float64]] = []
    sharpness = np.zeros(0)
    for scale in range(SCALES):
        if scale:
            image = library("skimage.transform").rescale(image, 0.5, order=3, anti_aliasing=True, preserve_range=True)
        coefficients, deviation = locally_normalised(image)
        side = BLOCK >> scale
        columns_of.append(np.array([_block(part) for part in _blocks(coefficients, side)]))
        if not scale:
            sharpness = np.array([part.mean() for part in _blocks(deviation, side)])
    return np.concatenate(columns_of, axis=1), sharpness


def locally_normalised(image: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the picture less its local mean, over its local deviation plus 1, and that deviation."""
    mean = ndimage.gaussian_filter(image, WINDOW_SIGMA, radius=3, mode="nearest")
    square = ndimage.gaussian_filter(image * image, WINDOW_SIGMA, radius=3, mode="nearest")
    deviation = np.sqrt(np.abs(square - mean * mean))
    return (image - mean) / (deviation + 1.0), deviation


def _blocks(image: NDArray[np.float64], side: int) -> list[NDArray[np.float64]]:
    """Return the square blocks of an image whose sides are multiples of ``side`` [px]."""
    rows, columns = (n // side for n in image.shape)
    return [image[i * side : (i + 1) * side, j * side : (j + 1) * side] for i in range(rows) for j in range(columns)]


def _block(part: NDArray[np.float64]) -> list[float]:
    """Return the 18 features of a block of normalised pixels."""
    shape, left, right = asymmetric_gaussian(part)
    features = [shape, (left + right) / 2.0]
    for step in NEIGHBOURS:
        shape, left, right = asymmetric_gaussian(part * np.roll(part, step, axis=(0, 1)))
        mean = (right - left) * float(special.gamma(2.0 / shape) / special.gamma(1.0 / shape))
        features += [shape, mean, left, right]
    return features


def asymmetric_gaussian(values: NDArray[np.float64]) -> tuple[float, float, float]:
    """Return shape, left scale and right scale of an asymmetric generalised Gaussian, by its moments.

    Source: N.-E. Lasmar, Y. Stitou and Y. Berthoumieu, "Multiscale skewed heavy tailed model for texture analysis",
    ICIP 2009.
    """
    flat = values.ravel()
    left, right = (np.sqrt(np.mean(side**2)) if side.size else 1e-6 for side in (flat[flat < 0], flat[flat > 0]))
    left, right = max(float(left), 1e-6), max(float(right), 1e-6)
    ratio = left / right
    flatness = np.mean(np.abs(flat)) ** 2 / max(float(np.mean(flat**2)), 1e-12)
    wanted = flatness * (ratio**3 + 1.0) * (ratio + 1.0) / (ratio**2 + 1.0) ** 2
    shape = float(SHAPES[np.argmin((_flatness() - wanted) ** 2)])
    scale = float(np.sqrt(special.gamma(1.0 / shape) / special.gamma(3.0 / shape)))
    return shape, left * scale, right * scale


@cache
def _flatness() -> NDArray[np.float64]:
    """Return the squared mean absolute value over the mean square, of a generalised Gaussian of each shape."""
    one, two, three = (special.gamma(k / SHAPES) for k in (1.0, 2.0, 3.0))
    return np.asarray(two**2 / (one * three))


# Similarity of a picture to the true luminance.


@dataclass(frozen=True, slots=True)
class Similarity:
    """Similarity of a picture to the true one."""

    psnr_db: float
    """Peak signal-to-noise ratio [dB]; infinite for equal pictures."""
    ssim: float
    """Structural similarity, up to 1."""


def similarity(picture: NDArray[Any], truth: NDArray[Any]) -> Similarity:
    """Return PSNR and SSIM of two pictures with values from 0 to 1 and one shape, by scikit-image.

    SSIM has the settings of its authors: a Gaussian window of 1.5 px. Z. Wang et al., "Image Quality Assessment: From
    Error Visibility to Structural Similarity", IEEE Transactions on Image Processing 2004.
    Raises :class:`AmiwarpError` for different shapes.
    """
    if picture.shape != truth.shape:
        raise AmiwarpError(f"picture and truth have shapes {picture.shape} and {truth.shape}; give equal shapes")
    metrics = library("skimage.metrics")
    a, b = truth.astype(np.float64), picture.astype(np.float64)
    psnr = float("inf") if np.array_equal(a, b) else float(metrics.peak_signal_noise_ratio(a, b, data_range=1.0))
    ssim = metrics.structural_similarity(
        a, b, data_range=1.0, gaussian_weights=True, sigma=1.5, use_sample_covariance=False
    )
    return Similarity(psnr, float(ssim))


def fitted(picture: NDArray[Any], log_truth: NDArray[Any]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return a picture and the true log luminance, shape (height, width), in one range from 0 to 1.

    Events determine log luminance only up to gain and offset, which are fitted by least squares. A constant picture
    becomes the mean of the truth. 0 and 1 are the percentiles :data:`TRUTH_PERCENTILES` of the truth, and values
    outside are clipped. Raises :class:`AmiwarpError` for values that are not finite and a constant truth.
    """
    a, b = picture.astype(np.float64), log_truth.astype(np.float64)
    if np.ptp(a) > 0.0:
        quality = picture_quality(a, b)
        a = quality.gain * a + quality.offset
    else:
        a = np.full(b.shape, b.mean())
    low, high = np.percentile(b, TRUTH_PERCENTILES)
    if not high > low:
        raise AmiwarpError("the true luminance is constant, so a picture cannot be compared with it")
    return np.clip((a - low) / (high - low), 0.0, 1.0), np.clip((b - low) / (high - low), 0.0, 1.0)


def displayed(picture: NDArray[Any]) -> NDArray[np.float64]:
    """Return a picture in the grey values 0 to 255: its percentiles :data:`TRUTH_PERCENTILES` become 0 and 255."""
    low, high = np.percentile(picture, TRUTH_PERCENTILES)
    if not high > low:
        return np.full(picture.shape, 128.0)
    return np.clip((picture.astype(np.float64) - low) / (high - low), 0.0, 1.0) * 255.0
