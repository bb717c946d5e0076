"""Similarity of a picture to the true luminance."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.imaging.metrics import TRUTH_PERCENTILES, picture_quality
from amiwarp.studies.evaluate.libraries import library


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
        raise AmiwarpError(
            f"picture and truth have shapes {picture.shape} and {truth.shape}; give equal shapes"
        )
    metrics = library("skimage.metrics")
    expected = truth.astype(np.float64)
    values = picture.astype(np.float64)

    # scikit-image would divide by the mean square error, which is 0 for equal pictures.
    psnr = float("inf")
    if not np.array_equal(expected, values):
        psnr = float(metrics.peak_signal_noise_ratio(expected, values, data_range=1.0))
    ssim = metrics.structural_similarity(
        expected,
        values,
        data_range=1.0,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
    )
    return Similarity(psnr, float(ssim))


def fitted(
    picture: NDArray[Any], log_truth: NDArray[Any]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return a picture and the true log luminance, shape (height, width), in one range from 0 to 1.

    Events determine log luminance only up to gain and offset, which are fitted by least squares. A constant picture
    becomes the mean of the truth. 0 and 1 are the percentiles :data:`TRUTH_PERCENTILES` of the truth, and values
    outside are clipped. Raises :class:`AmiwarpError` for values that are not finite and a constant truth.
    """
    values = picture.astype(np.float64)
    truth = log_truth.astype(np.float64)
    if np.ptp(values) > 0.0:
        quality = picture_quality(values, truth)
        values = quality.gain * values + quality.offset
    else:
        values = np.full(truth.shape, truth.mean())

    low, high = np.percentile(truth, TRUTH_PERCENTILES)
    if not high > low:
        raise AmiwarpError(
            "the true luminance is constant, so a picture cannot be compared with it"
        )
    scaled_values = np.clip((values - low) / (high - low), 0.0, 1.0)
    scaled_truth = np.clip((truth - low) / (high - low), 0.0, 1.0)
    return scaled_values, scaled_truth


def displayed(picture: NDArray[Any]) -> NDArray[np.float64]:
    """Return a picture in the grey values 0 to 255: its percentiles :data:`TRUTH_PERCENTILES` become 0 and 255."""
    low, high = np.percentile(picture, TRUTH_PERCENTILES)
    if not high > low:
        return np.full(picture.shape, 128.0)
    scaled = np.clip((picture.astype(np.float64) - low) / (high - low), 0.0, 1.0)
    return scaled * 255.0
