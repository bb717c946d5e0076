"""Measures of the evaluations, as functions of arrays."""

from __future__ import annotations

import functools
import importlib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage, special

from amiwarp.errors import AmiwarpError
from amiwarp.imaging.metrics import TRUTH_PERCENTILES, picture_quality
from amiwarp.kernels import corners, launch

if TYPE_CHECKING:
    from amiwarp.events.truth import FrameTruth
    from amiwarp.optics.camera import Camera
    from amiwarp.simulation.worlds.trajectory import Trajectory


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


# Evenness of events over the image: kernel density at each event's place, and its variance.

FINENESS = 2
"""Cells of the grid per pixel, along each axis. Pixel centres are centres of cells, so those of plain events are exact.

Other places are rounded to the cell, as if the Gaussian's variance were larger by 1 / (6 FINENESS²) px²: by 4 % for a
standard deviation of 1 px, by 0.5 % for 3 px.
"""
TRUNCATE = 5.0
"""Radius at which the Gaussian kernel ends [standard deviations]."""


def event_counts(x: NDArray[Any], y: NDArray[Any], size: tuple[int, int]) -> NDArray[np.float32]:
    """Return the number of events in each cell of a grid over the image, whose outermost cells are half outside.

    ``x``, ``y``: places [px], shape (n,); those outside the image are left out. ``size``: width and height [px].
    """
    columns, rows = (FINENESS * n + 1 for n in size)
    half = FINENESS // 2
    column, row = (np.rint(FINENESS * v.astype(np.float32)).astype(np.int32) + half for v in (x, y))
    inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
    cell = (row * columns + column)[inside]
    return np.asarray(np.bincount(cell, minlength=rows * columns).reshape(rows, columns), np.float32)


def density_variance(counts: NDArray[np.float32], h_px: float) -> float:
    """Return the variance of ρ / mean ρ, where ρ is the kernel density at each event: 0 for an even distribution.

    ``counts``: events in the cells of a grid, see :func:`event_counts`. ``h_px``: standard deviation of the Gaussian
    kernel. Each event contributes to its own density, as usual for kernel density estimates. Near the border the
    density is divided by the part of the kernel that lies in the image. NaN without events. For a Poisson process of λ
    events/px² the variance is about λ / (4πh²) / (λ + 1 / (2πh²))².
    """
    number = float(counts.sum(dtype=np.float64))
    if not number:
        return float("nan")
    mass = smoothed(counts, FINENESS * h_px, truncate=TRUNCATE, mirrored=False)
    density = mass / _inside_share(counts.shape, h_px)
    mean = float(np.sum(counts * density, dtype=np.float64)) / number
    return float(np.sum(counts * (density / mean - 1.0) ** 2, dtype=np.float64)) / number


@lru_cache(maxsize=16)
def _inside_share(shape: tuple[int, int], h_px: float) -> NDArray[np.float32]:
    """Return the part of the kernel around each cell that lies in the image."""
    cells = np.ones(shape, np.float32)
    for edge in (cells[0], cells[-1], cells[:, 0], cells[:, -1]):
        edge *= 0.5
    return smoothed(cells, FINENESS * h_px, truncate=TRUNCATE, mirrored=False)


# Agreement of edge pixels with true edges: one-to-one matches within a tolerance, precision, recall and F-score.

THRESHOLDS = np.arange(1, 100) / 100.0
"""Thresholds that are swept, relative to the scale of an event image."""
SCALE_PERCENTILE = 99.0
"""Percentile of the pixels with events that is the scale of an event image."""


@dataclass(frozen=True)
class Counts:
    """Numbers of edge pixels, added up over a set of images, for each threshold, shape (n,)."""

    matched: NDArray[np.int64]
    """Number of found pixels that match a true pixel, one to one."""
    found: NDArray[np.int64]
    """Number of found pixels."""
    true: NDArray[np.int64]
    """Number of true pixels."""

    @property
    def precision(self) -> NDArray[np.float64]:
        """Part of the found pixels that match, 0 without any."""
        return self.matched / np.maximum(self.found, 1)

    @property
    def recall(self) -> NDArray[np.float64]:
        """Part of the true pixels that match, 0 without any."""
        return self.matched / np.maximum(self.true, 1)

    @property
    def f_score(self) -> NDArray[np.float64]:
        """Harmonic mean of precision and recall."""
        return 2.0 * self.matched / np.maximum(self.found + self.true, 1)


def match(found: NDArray[np.bool_], true: NDArray[np.bool_], tolerances: Sequence[float]) -> list[NDArray[np.bool_]]:
    """Return for each tolerance [px] which of the true pixels match a found one, shape (height, width).

    Pixels are matched one to one, the nearest pairs first; pairs of equal distance in the order of their offsets. On
    event images they are 90 to 99 % of the largest possible number of pairs, which takes a hundred times as long.
    """
    reach = math.ceil(max(tolerances))
    free = np.pad(true, reach)
    stride = free.shape[1]
    y, x = np.nonzero(found)
    left, flat = (y + reach) * stride + x + reach, free.ravel()  # pixels without a partner; a view
    out = []
    offsets = _offsets(reach)
    for tolerance in sorted(tolerances):
        for square, dy, dx in offsets:
            if square > tolerance**2:
                break
            to = left + (dy * stride + dx)
            hit = flat[to]
            flat[to[hit]] = False
            left = left[~hit]
        offsets = [offset for offset in offsets if offset[0] > tolerance**2]
        out.append(true & ~free[reach:-reach, reach:-reach])
    return [out[sorted(tolerances).index(tolerance)] for tolerance in tolerances]


@functools.cache
def _offsets(reach: int) -> list[tuple[int, int, int]]:
    """Return the offsets (y, x) of the pixels up to ``reach`` away, after their squared distance, nearest first."""
    line = range(-reach, reach + 1)
    return sorted((dy * dy + dx * dx, dy, dx) for dy in line for dx in line if dy * dy + dx * dx <= reach * reach)


def normalised(image: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return an event image relative to its scale, :data:`SCALE_PERCENTILE` of the pixels with events."""
    positive = image[image > 0]
    return np.asarray(image / np.percentile(positive, SCALE_PERCENTILE) if positive.size else image, np.float64)


def best_f(counts: Counts) -> tuple[int, float]:
    """Return the index of the threshold with the highest F-score, and the score: the ODS-F of the set."""
    scores = counts.f_score
    best = int(np.argmax(scores))
    return best, float(scores[best])


def binary_entropy(mask: NDArray[np.bool_]) -> float:
    """Return the entropy of a binary image [bit/px]: 1 if half of its pixels are set, 0 if none or all are."""
    p = float(mask.mean())
    return 0.0 if p in (0.0, 1.0) else float(-p * np.log2(p) - (1 - p) * np.log2(1 - p))


# True edges of a world: those of its grey picture by Canny, and those of its geometry.

CANNY_SIGMA = 2.0
"""Standard deviation of Canny's Gaussian [px]. At 1 px the texture of walls fills a quarter of the image with edges."""
GAMMA = 1.0 / 2.2
"""Exponent from luminance to the grey values of a picture."""
DEPTH_STEP = 0.05
"""Smallest relative step of depth at a geometric edge. A slanted surface has smaller steps."""
CREASE_COS = 0.94
"""Cosine of the smallest angle between the normals at a geometric edge, 20 deg."""


def grey_picture(intensity: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return grey values 0 .. 1 of a picture of luminance, of which the brightest half percent is white."""
    top = float(np.percentile(intensity, 99.5)) or 1.0
    return np.asarray(np.clip(intensity / top, 0.0, 1.0) ** GAMMA, np.float64)


def canny_edges(intensity: NDArray[np.floating], sigma: float = CANNY_SIGMA) -> NDArray[np.bool_]:
    """Return the Canny edges of a picture of luminance, smoothed by a Gaussian of ``sigma`` [px]."""
    return np.asarray(library("skimage.feature").canny(grey_picture(intensity), sigma=sigma), np.bool_)


def geometric_edges(frame: FrameTruth) -> NDArray[np.bool_]:
    """Return the pixels where instance, depth or normal change to the right or lower neighbour."""
    edges = np.zeros(frame.depth.shape, np.bool_)
    for here, there in (((slice(None), slice(-1)), (slice(None), slice(1, None))), ((slice(-1),), (slice(1, None),))):
        edges[here] |= _differ(frame, here, there)
    return np.asarray(library("skimage.morphology").skeletonize(edges), np.bool_)


def _differ(frame: FrameTruth, here: Any, there: Any) -> NDArray[np.bool_]:
    """Return where neighbouring pixels see different surfaces."""
    near, far = frame.depth[here].astype(np.float64), frame.depth[there].astype(np.float64)
    with np.errstate(invalid="ignore"):  # two pixels of the sky
        step = np.abs(near - far) > DEPTH_STEP * np.minimum(near, far)
    crease = np.sum(frame.normal[here] * frame.normal[there], axis=-1) < CREASE_COS
    sky = (frame.instance[here] == 0) & (frame.instance[there] == 0)
    return np.asarray((frame.instance[here] != frame.instance[there]) | ((step | crease) & ~sky))


# Error of optical flow.

OUTLIER_PX = 3.0
"""Endpoint error above which a pixel is an outlier [px]."""


@dataclass(frozen=True, slots=True)
class FlowError:
    """Errors of a flow field. They are NaN if no pixel is compared."""

    epe: float
    """Mean endpoint error, in the unit of the flow."""
    outliers: float
    """Share of pixels with an endpoint error above the threshold."""
    pixels: int
    """Number of pixels compared."""


def flow_error(
    flow: NDArray[Any], truth: NDArray[Any], where: NDArray[np.bool_], *, outlier: float = OUTLIER_PX
) -> FlowError:
    """Compare a flow field with the true one, both of shape (height, width, 2), in the pixels of a mask.

    Pixels at which either flow is not finite are left out. Raises :class:`AmiwarpError` for different shapes.
    """
    if flow.shape != truth.shape or flow.shape[:2] != where.shape:
        raise AmiwarpError(f"flow, truth and mask have shapes {flow.shape}, {truth.shape}, {where.shape}; give "
                           "(height, width, 2) twice and (height, width)")  # fmt: skip
    error = np.hypot(*np.moveaxis(flow.astype(np.float64) - truth, -1, 0))[where]
    error = error[np.isfinite(error)]
    if not error.size:
        return FlowError(float("nan"), float("nan"), 0)
    return FlowError(float(error.mean()), float((error > outlier).mean()), int(error.size))


# Accuracy of detected joints.


def detected_joints(found: NDArray[Any], truth: NDArray[Any], torso_px: float, *, fraction: float = 0.2) -> float:
    """Return the percentage of detected joints (PDJ), as a share from 0 to 1.

    A joint counts as detected if it is closer to its true place than ``fraction`` of the torso's diameter. ``found``
    and ``truth``: joints in the same order [px], shape (n, 2). A joint that was not found is NaN and counts as not
    detected. True joints that are NaN, as outside the view, do not count. The result is NaN if no true joint counts.

    Source: B. Sapp and B. Taskar, "MODEC: Multimodal Decomposable Models for Human Pose Estimation", CVPR 2013; the
    diameter is the distance from the left shoulder to the right hip.
    Raises :class:`AmiwarpError` for different shapes.
    """
    if found.shape != truth.shape or truth.ndim != 2 or truth.shape[1] != 2:
        raise AmiwarpError(f"found and true joints have shapes {found.shape} and {truth.shape}; give (n, 2) twice")
    known = np.isfinite(truth).all(axis=1)
    if not known.any():
        return float("nan")
    distance = np.hypot(*(found[known] - truth[known]).T)
    return float((distance < fraction * torso_px).mean())  # a comparison with NaN is false


# Agreement of a set of events or pixels with the true set.


@dataclass(frozen=True, slots=True)
class Overlap:
    """Overlap of a found set with the true set. A ratio without a denominator is NaN."""

    iou: float
    """Intersection over union."""
    precision: float
    """Share of the found members that are true."""
    recall: float
    """Share of the true members that are found."""


def overlap(found: NDArray[np.bool_], truth: NDArray[np.bool_]) -> Overlap:
    """Return the overlap of two Boolean arrays of one shape. Raises :class:`AmiwarpError` for different shapes."""
    if found.shape != truth.shape:
        raise AmiwarpError(f"found and true masks have shapes {found.shape} and {truth.shape}; give equal shapes")
    both = int(np.count_nonzero(found & truth))
    counts = [int(np.count_nonzero(mask)) for mask in (found | truth, found, truth)]
    return Overlap(*(both / n if n else float("nan") for n in counts))


def box_overlap(a: NDArray[Any], b: NDArray[Any]) -> float:
    """Return the intersection over union of the bounding boxes of two point sets, shapes (n, 2) and (m, 2).

    Points that are not finite do not count. The result is 0 if a set has no points or a box has no area.
    """
    a, b = (points[np.isfinite(points).all(axis=1)] for points in (a, b))
    if not len(a) or not len(b):
        return 0.0
    low, high = np.stack([a.min(axis=0), b.min(axis=0)]), np.stack([a.max(axis=0), b.max(axis=0)])
    shared = float(np.prod(np.maximum(high.min(axis=0) - low.max(axis=0), 0.0)))
    union = float(np.prod(high - low, axis=1).sum()) - shared
    return shared / union if union > 0.0 else 0.0


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


# Tracks of corners: made of corner events or of images, and their lifetime, error and update rate against truth.

LIMITS_PX = tuple(float(limit) for limit in range(2, 11))
"""Distances from the truth at which a track ends, for the curves [px]."""
RADIUS_PX = 3.0
"""Largest step of a track of corner events [px]."""
GAP_US = 25_000
"""Largest time between two corner events of a track [us]: a little more than a quarter turn at 720 turns/min."""
WINDOW, LEVELS, CONSISTENT_PX = 21, 3, 1.0
"""Lucas-Kanade: side of the window [px], levels of the pyramid, largest difference between forward and back [px]."""
MOST_CORNERS, QUALITY, SPACING_PX = 200, 0.01, 10.0
"""Corners that tracks in images start from: largest number, least quality relative to the best, least distance [px]."""
OCCLUDED = 0.95
"""A point is occluded where the surface in its direction is nearer than this part of its depth."""


@dataclass(frozen=True, slots=True, eq=False)
class Tracks:
    """Points of tracks, sorted by track, then by time."""

    number: NDArray[np.int64]
    """Number of the track of each point, from 0 without gaps, shape ``(n,)``."""
    t: NDArray[np.int64]
    """Times [us], shape ``(n,)``."""
    xy: NDArray[np.float64]
    """Places [px], shape ``(n, 2)``."""
    index: NDArray[np.int64]
    """Index of the corner event or of the image of each point, shape ``(n,)``."""

    @property
    def first(self) -> NDArray[np.int64]:
        """Position of the first point of each track, shape ``(tracks,)``."""
        return np.flatnonzero(np.diff(self.number, prepend=-1))


def sorted_tracks(number: ArrayLike, t: ArrayLike, xy: ArrayLike, index: ArrayLike) -> Tracks:
    """Return the points of tracks of at least two points, sorted and numbered anew. Points are given in time order."""
    numbers = np.asarray(number, np.int64)
    counts = np.bincount(numbers, minlength=1)
    order = np.argsort(numbers, kind="stable")
    order = order[counts[numbers[order]] >= 2]
    new = np.cumsum(counts >= 2) - 1
    places = np.asarray(xy, np.float64).reshape(-1, 2)
    return Tracks(
        new[numbers[order]], np.asarray(t, np.int64)[order], places[order], np.asarray(index, np.int64)[order]
    )


def link_corners(
    t: NDArray[np.int64], xy: NDArray[np.floating], *, radius_px: float = RADIUS_PX, gap_us: int = GAP_US
) -> Tracks:
    """Join corner events to tracks: each to the track whose last point is nearest, or to a new one.

    ``t``: rising times [us]. ``xy``: places [px], shape (n, 2); NaN for corners without a place, which are left out.
    A track takes corners up to ``radius_px`` from its last point and ``gap_us`` after it.
    """
    kept = np.flatnonzero(np.isfinite(xy).all(axis=1))
    number = wp.empty(len(kept), dtype=int, device="cpu")
    chains = _chains(np.asarray(t, np.int64)[kept], np.asarray(xy, np.float64)[kept], radius_px, gap_us)
    launch.load(corners.link_events, number.device)
    wp.launch(corners.link_events, 1, [chains], [number], device="cpu")
    return sorted_tracks(number.numpy(), np.asarray(t)[kept], np.asarray(xy)[kept], kept)


def _chains(t: NDArray[np.int64], xy: NDArray[np.float64], radius_px: float, gap_us: int) -> Any:
    """Return corner events and empty lists of tracks as the struct that the kernel takes."""
    column, row = np.floor(xy / radius_px).astype(np.int64).T
    if len(t):
        column, row = column - column.min() + 1, row - row.min() + 1  # a border of empty cells
    columns, rows = (int(v.max(initial=0)) + 2 for v in (column, row))
    chains = corners.CornerChains()
    chains.x, chains.y = (wp.array(v, dtype=wp.float64, device="cpu") for v in xy.T)
    chains.t, chains.cell = wp.array(t, device="cpu"), wp.array((row * columns + column).astype(np.int32), device="cpu")
    chains.columns, chains.radius, chains.gap = columns, radius_px, gap_us
    chains.head = wp.full(columns * rows, -1, dtype=int, device="cpu")
    chains.after, chains.last = (wp.zeros(len(t), dtype=int, device="cpu") for _ in range(2))
    return chains


def follow_images(images: Sequence[NDArray[Any]], t: ArrayLike) -> Tracks:
    """Follow corners through images by Lucas-Kanade on pyramids; a track ends where forward and back disagree.

    ``images``: of equal shape, such as images of warped events. ``t``: their times [us]. New tracks start at corners
    (Shi and Tomasi) away from others. Source: J.-Y. Bouguet, "Pyramidal implementation of the Lucas Kanade feature
    tracker", 2001. Needs OpenCV.
    """
    times = np.asarray(t, np.int64)
    if len(images) != len(times):
        raise AmiwarpError(f"there are {len(images)} images and {len(times)} times; give one time for each image")
    grey = [_grey(image) for image in images]
    points, ids, tracks = np.zeros((0, 2), np.float32), np.zeros(0, np.int64), 0
    parts: list[tuple[NDArray[np.int64], NDArray[np.float32], int]] = []
    for k, image in enumerate(grey):
        if k:
            points, found = _followed(grey[k - 1], image, points)
            points, ids = points[found], ids[found]
        fresh = _fresh_corners(image, points)
        points, ids = np.concatenate([points, fresh]), np.concatenate([ids, tracks + np.arange(len(fresh))])
        tracks += len(fresh)
        parts.append((ids, points, k))
    if not parts:
        return sorted_tracks([], [], [], [])
    number, xy = np.concatenate([part[0] for part in parts]), np.concatenate([part[1] for part in parts])
    index = np.concatenate([np.full(len(part[0]), part[2]) for part in parts])
    return sorted_tracks(number, times[index], xy, index)


def _grey(image: NDArray[Any]) -> NDArray[np.uint8]:
    """Return an image in 8 bits, from 0 to its 99.5th percentile of non-zero values."""
    full = image[image > 0]
    top = float(np.percentile(full, 99.5)) if full.size else 1.0
    return np.clip(image * (255.0 / top), 0.0, 255.0).astype(np.uint8)


def _followed(
    before: NDArray[np.uint8], after: NDArray[np.uint8], points: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Return points of the image before in the image after, and which were found."""
    if not len(points):
        return points, np.zeros(0, np.bool_)
    cv2 = library("cv2")
    settings = {"winSize": (WINDOW, WINDOW), "maxLevel": LEVELS - 1}
    there, seen, _ = cv2.calcOpticalFlowPyrLK(before, after, points, None, **settings)
    back, seen_back, _ = cv2.calcOpticalFlowPyrLK(after, before, there, None, **settings)
    height, width = after.shape
    inside = ((there >= 0) & (there <= (width - 1, height - 1))).all(axis=1)
    close = np.hypot(*(back - points).T) < CONSISTENT_PX
    return there, np.asarray((seen[:, 0] == 1) & (seen_back[:, 0] == 1) & inside & close)


def _fresh_corners(image: NDArray[np.uint8], points: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return corners of an image that are away from the given points."""
    cv2 = library("cv2")
    mask = np.full(image.shape, 255, np.uint8)
    for x, y in points:
        cv2.circle(mask, (round(float(x)), round(float(y))), round(SPACING_PX), 0, -1)
    found = cv2.goodFeaturesToTrack(image, max(1, MOST_CORNERS - len(points)), QUALITY, SPACING_PX, mask=mask)
    if found is None or len(points) >= MOST_CORNERS:
        return np.zeros((0, 2), np.float32)
    return np.asarray(found, np.float32).reshape(-1, 2)


def project(
    camera: Camera, trajectory: Trajectory, places: NDArray[np.floating], t_us: ArrayLike
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return where a camera without a prism sees a resting point at each time [px], shape (n, 2), and its depth [m].

    ``places``: points in the world [m], shape (n, 3), one for each time ``t_us`` [us], shape (n,). NaN if a point lies
    behind the camera.
    """
    if not len(places):
        return np.zeros((0, 2)), np.zeros(0)
    rotation, position = trajectory.poses(np.asarray(t_us, np.float64) * 1e-6)
    rays = np.einsum("ni,nij->nj", np.asarray(places, np.float64) - position, rotation)
    return np.asarray(camera.rays_to_pixels(rays), np.float64), rays[:, 2]


def true_paths(
    tracks: Tracks,
    places: NDArray[np.floating],
    camera: Camera,
    trajectory: Trajectory,
    frames: Sequence[FrameTruth] = (),
) -> NDArray[np.float64]:
    """Return the true place of each point of the tracks [px], shape (n, 2); NaN where it cannot be seen.

    ``places``: resting point in the world that each track begins on [m], shape (tracks, 3); NaN if unknown, such as on
    a moving body. ``frames``: ground truth at some instants; a point is occluded if a surface in the nearest of them is
    in front of it.
    """
    points = np.asarray(places, np.float64)[tracks.number]
    truth, depth = project(camera, trajectory, points, tracks.t)
    if not len(frames) or not len(truth):
        return truth
    instants = np.array([frame.t_us for frame in frames])
    nearest = np.abs(tracks.t[:, None] - instants).argmin(axis=1)
    for k, frame in enumerate(frames):
        of = np.flatnonzero((nearest == k) & np.isfinite(truth).all(axis=1))
        at, _ = project(camera, trajectory, points[of], np.full(len(of), frame.t_us))
        truth[of[_farthest(frame.depth, at) < OCCLUDED * depth[of]]] = np.nan
    return truth


def _farthest(depth: NDArray[np.float32], xy: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the largest depth in the 3 x 3 pixels around places: infinite outside the image."""
    padded = np.pad(depth.astype(np.float64), 2, constant_values=np.inf)
    height, width = depth.shape
    column, row = (
        np.clip(np.rint(np.nan_to_num(v)), -1, n).astype(int) + 2 for v, n in zip(xy.T, (width, height), strict=True)
    )
    return np.max([padded[row + dy, column + dx] for dy in (-1, 0, 1) for dx in (-1, 0, 1)], axis=0)


@dataclass(frozen=True, slots=True, eq=False)
class TrackQuality:
    """Quality of tracks, for one limit."""

    limit_px: float
    """Distance from the truth at which a track ends [px]."""
    number: int
    """Number of tracks that live at least up to their second point."""
    lifetime_s: float
    """Mean time from the first point of a track to the last before it ends [s], over all tracks; NaN without tracks."""
    error_px: float
    """Mean distance from the truth until the end, over all points after the first of each track [px]."""
    update_hz: float
    """Number of points after the first of each track, by the time that tracks live [1/s]."""


def lives(tracks: Tracks, truth: NDArray[np.float64], limit_px: float) -> NDArray[np.bool_]:
    """Return which points belong to the life of their track, shape (n,).

    A track ends before its first point that is more than ``limit_px`` from the truth, or whose truth is NaN.
    """
    if truth.shape != tracks.xy.shape:
        raise AmiwarpError(f"truth has shape {truth.shape}; expected that of the tracks, {tracks.xy.shape}")
    near = np.hypot(*(tracks.xy - truth).T) <= limit_px  # false for NaN
    ended = np.cumsum(~near)
    before = ended[tracks.first] - ~near[tracks.first]
    return np.asarray(ended == before[tracks.number])


def lifetimes(tracks: Tracks, truth: NDArray[np.float64], limit_px: float) -> NDArray[np.float64]:
    """Return the lifetime of each track [s], shape (tracks,); 0 if it ends before its second point.

    :func:`lives` says when a track ends.
    """
    alive = lives(tracks, truth, limit_px)
    count = np.bincount(tracks.number[alive], minlength=len(tracks.first))
    last = tracks.first + np.maximum(count, 1) - 1
    return np.asarray((tracks.t[last] - tracks.t[tracks.first]) * 1e-6)


def track_quality(tracks: Tracks, truth: NDArray[np.float64], limit_px: float) -> TrackQuality:
    """Return the quality of tracks that end more than ``limit_px`` from the truth, or where it is NaN."""
    updates = lives(tracks, truth, limit_px)
    updates[tracks.first] = False
    life = lifetimes(tracks, truth, limit_px)
    errors = np.hypot(*(tracks.xy - truth)[updates].T)
    total = float(life.sum())
    return TrackQuality(
        limit_px,
        len(np.unique(tracks.number[updates])),
        float(life.mean()) if len(life) else float("nan"),
        float(errors.mean()) if len(errors) else float("nan"),
        len(errors) / total if total > 0.0 else float("nan"),
    )


def quality_curve(
    tracks: Tracks, truth: NDArray[np.float64], limits_px: Sequence[float] = LIMITS_PX
) -> list[TrackQuality]:
    """Return the quality of tracks for each of several limits, see :func:`track_quality`."""
    return [track_quality(tracks, truth, limit) for limit in limits_px]
