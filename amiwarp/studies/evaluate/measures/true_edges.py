"""True edges of a world: those of its grey picture by Canny, and those of its geometry."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

import numpy as np

from amiwarp.errors import AmiwarpError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.events.truth import FrameTruth

CANNY_SIGMA = 2.0
"""Standard deviation of Canny's Gaussian [px]. At 1 px the texture of walls fills a quarter of the image with edges."""
GAMMA = 1.0 / 2.2
"""Exponent from luminance to the grey values of a picture."""
DEPTH_STEP = 0.05
"""Smallest relative step of depth at a geometric edge. A slanted surface has smaller steps."""
CREASE_COS = 0.94
"""Cosine of the smallest angle between the normals at a geometric edge, 20 deg."""


def skimage(name: str) -> Any:
    """Return a module of scikit-image. Raises :class:`AmiwarpError` if it is not installed."""
    try:
        return importlib.import_module(f"skimage.{name}")
    except ModuleNotFoundError as error:
        raise AmiwarpError("'amiwarp evaluate' needs scikit-image; run: pip install 'amiwarp[evaluate]'") from error


def grey_picture(intensity: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return grey values 0 .. 1 of a picture of luminance, of which the brightest half percent is white."""
    top = float(np.percentile(intensity, 99.5)) or 1.0
    return np.asarray(np.clip(intensity / top, 0.0, 1.0) ** GAMMA, np.float64)


def canny_edges(intensity: NDArray[np.floating], sigma: float = CANNY_SIGMA) -> NDArray[np.bool_]:
    """Return the Canny edges of a picture of luminance, smoothed by a Gaussian of ``sigma`` [px]."""
    return np.asarray(skimage("feature").canny(grey_picture(intensity), sigma=sigma), np.bool_)


def geometric_edges(frame: FrameTruth) -> NDArray[np.bool_]:
    """Return the pixels where instance, depth or normal change to the right or lower neighbour."""
    edges = np.zeros(frame.depth.shape, np.bool_)
    for here, there in (((slice(None), slice(-1)), (slice(None), slice(1, None))), ((slice(-1),), (slice(1, None),))):
        edges[here] |= _differ(frame, here, there)
    return np.asarray(skimage("morphology").skeletonize(edges), np.bool_)


def _differ(frame: FrameTruth, here: Any, there: Any) -> NDArray[np.bool_]:
    """Return where neighbouring pixels see different surfaces."""
    near, far = frame.depth[here].astype(np.float64), frame.depth[there].astype(np.float64)
    with np.errstate(invalid="ignore"):  # two pixels of the sky
        step = np.abs(near - far) > DEPTH_STEP * np.minimum(near, far)
    crease = np.sum(frame.normal[here] * frame.normal[there], axis=-1) < CREASE_COS
    sky = (frame.instance[here] == 0) & (frame.instance[there] == 0)
    return np.asarray((frame.instance[here] != frame.instance[there]) | ((step | crease) & ~sky))
