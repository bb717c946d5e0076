"""True edges of a world: by Canny in its grey picture, and by its geometry."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from amiwarp.events.truth import FrameTruth
from amiwarp.studies.evaluate.libraries import library
from amiwarp.studies.evaluate.streams import GAMMA

CANNY_SIGMA = 2.0
"""Standard deviation of Canny's Gaussian [px]. At 1 px the texture of walls fills a quarter of the image with edges."""
DEPTH_STEP = 0.05
"""Smallest relative step of depth at a geometric edge. A slanted surface has smaller steps."""
CREASE_COS = 0.94
"""Cosine of the smallest angle between the normals at a geometric edge, 20 deg."""


def grey_picture(intensity: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return grey values 0 .. 1 of a picture of luminance, of which the brightest half percent is white."""
    white = float(np.percentile(intensity, 99.5)) or 1.0
    luminance = np.clip(intensity / white, 0.0, 1.0)
    return np.asarray(luminance**GAMMA, np.float64)


def canny_edges(intensity: NDArray[np.floating], sigma: float = CANNY_SIGMA) -> NDArray[np.bool_]:
    """Return the Canny edges of a picture of luminance, smoothed by a Gaussian of ``sigma`` [px]."""
    feature = library("skimage.feature")
    return np.asarray(feature.canny(grey_picture(intensity), sigma=sigma), np.bool_)


def edge_strength(grey: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Return the gradient of a frame at the maxima that Canny's method keeps, and 0 elsewhere."""
    picture = grey / 255.0
    feature = library("skimage.feature")
    ridges = feature.canny(picture, CANNY_SIGMA, low_threshold=0.0, high_threshold=0.0)
    gradient = ndimage.gaussian_gradient_magnitude(picture, CANNY_SIGMA)
    return np.asarray(np.where(ridges, gradient, 0.0))


def geometric_edges(frame: FrameTruth) -> NDArray[np.bool_]:
    """Return the pixels where instance, depth or normal change to the right or lower neighbour."""
    edges = np.zeros(frame.depth.shape, np.bool_)
    edges[:, :-1] |= _differ(frame, np.s_[:, :-1], np.s_[:, 1:])
    edges[:-1] |= _differ(frame, np.s_[:-1], np.s_[1:])
    return np.asarray(library("skimage.morphology").skeletonize(edges), np.bool_)


def _differ(frame: FrameTruth, here: Any, there: Any) -> NDArray[np.bool_]:
    """Return where neighbouring pixels see different surfaces."""
    near = frame.depth[here].astype(np.float64)
    far = frame.depth[there].astype(np.float64)
    # Two pixels of the sky are infinitely far.
    with np.errstate(invalid="ignore"):
        is_step = np.abs(near - far) > DEPTH_STEP * np.minimum(near, far)
    cos_of_normals = np.sum(frame.normal[here] * frame.normal[there], axis=-1)
    is_crease = cos_of_normals < CREASE_COS
    instance = frame.instance[here]
    next_instance = frame.instance[there]
    both_sky = (instance == 0) & (next_instance == 0)
    return np.asarray((instance != next_instance) | ((is_step | is_crease) & ~both_sky))
