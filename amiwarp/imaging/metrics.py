"""How good a compensation or a picture is: blur across edges, contrast, entropy, error against the truth."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy import ndimage

from amiwarp.errors import AmiwarpError
from amiwarp.events.events import Events
from amiwarp.imaging.choices import Sharpness
from amiwarp.imaging.sharpness_costs import sharpness
from amiwarp.imaging.warped_image import iwe
from amiwarp.optics.models import ExactModel, ModelError, predicted_error
from amiwarp.optics.prism import Prism

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.events.recording import Truth
    from amiwarp.optics.camera import Camera
    from amiwarp.optics.models import Model
    from amiwarp.optics.prism import FlatSide

ACROSS = 3.0
"""Half width of the strip about an edge whose events are counted to it [px]."""
RIDGE_SCALE = 1.0
"""Standard deviation of the derivatives that find edges [px]."""
WEAKEST = 0.3
"""Edges weaker than this share of the strong ones (the 95th percentile) are left out: noise has ridges too."""
RANGE = (0.5, 99.5)
"""Percentiles of a true picture between which its range lies, to which PSNR is relative."""


@dataclass(frozen=True, slots=True)
class Edges:
    """Sub-pixel edge points of an IWE: its ridges."""

    xy: NDArray[np.float64]
    """Places [px], shape (n, 2)."""
    normal: NDArray[np.float64]
    """Unit vectors across the edge, shape (n, 2)."""
    label: NDArray[np.int64]
    """For each pixel the index of the nearest edge point, shape (height, width)."""


def find_edges(image: NDArray[np.float32]) -> Edges:
    """Ridges of an image of events: where the second derivative across is most negative and the first one vanishes.

    Steger, "An unbiased detector of curvilinear structures", PAMI 1998. Those under :data:`WEAKEST` are left out.
    Raises :class:`AmiwarpError` where the image has none.
    """

    def derivative(y: int, x: int) -> NDArray[np.float64]:
        return np.asarray(ndimage.gaussian_filter(image.astype(np.float64), RIDGE_SCALE, order=(y, x)))

    gx, gy = derivative(0, 1), derivative(1, 0)
    hxx, hxy, hyy = derivative(0, 2), derivative(1, 1), derivative(2, 0)
    half = 0.5 * (hxx - hyy)
    root = np.hypot(half, hxy)
    across = 0.5 * (hxx + hyy) - root  # the smaller eigenvalue
    along = across + 2.0 * root
    angle = 0.5 * np.arctan2(hxy, half) + np.pi / 2  # of its eigenvector
    nx, ny = np.cos(angle), np.sin(angle)
    with np.errstate(divide="ignore", invalid="ignore"):
        offset = -(gx * nx + gy * ny) / across
    ridge = (across < 0.0) & (np.abs(offset) <= 0.6) & (np.abs(along) < 0.5 * np.abs(across))
    if not ridge.any():
        raise AmiwarpError("the image of events has no edges to measure blur at")
    ridge &= across <= WEAKEST * np.quantile(across[ridge], 0.05)
    rows, cols = np.nonzero(ridge)
    points = np.stack([cols + offset[ridge] * nx[ridge], rows + offset[ridge] * ny[ridge]], axis=1)
    nearest = ndimage.distance_transform_edt(~ridge, return_distances=False, return_indices=True)
    index = np.zeros(image.shape, dtype=np.int64)
    index[rows, cols] = np.arange(len(rows))
    return Edges(points, np.stack([nx[ridge], ny[ridge]], axis=1), index[nearest[0], nearest[1]])


def edge_blur(
    sharp_xy: NDArray[np.float32], width: int, height: int, *, of: NDArray[np.float32] | None = None
) -> float:
    """Standard deviation of events across edges [px], the paper's compensation error.

    Edges are found in the IWE of ``sharp_xy`` (n, 2), and each event within :data:`ACROSS` px of one belongs to it,
    with the probability that it is not of the even background that noise and neighbouring texture lay over the edge.
    Measured are the same events at ``of`` (n, 2), by default at ``sharp_xy`` itself: give the raw places there to
    learn the blur before compensation. Pixel quantisation alone leaves 0.29 px.
    Raises :class:`AmiwarpError` where there are no edges.
    """
    none = np.zeros(len(sharp_xy), np.uint8)
    edges = find_edges(iwe(Events(sharp_xy[:, 0], sharp_xy[:, 1], none.astype(np.int64), none), width, height))
    with np.errstate(invalid="ignore"):
        pixel = np.rint(sharp_xy)
        inside = ((pixel >= 0) & (pixel < (width, height))).all(axis=1)
    sharp = sharp_xy[inside].astype(np.float64)
    cols, rows = pixel[inside].astype(np.int64).T
    label = edges.label[rows, cols]
    normal = edges.normal[label]
    away = sharp - edges.xy[label]
    across = np.sum(away * normal, axis=1)
    along = away[:, 0] * normal[:, 1] - away[:, 1] * normal[:, 0]
    near = (np.abs(across) < ACROSS) & (np.abs(along) <= 1.0)
    moved = across if of is None else np.sum((np.asarray(of, np.float64)[inside] - edges.xy[label]) * normal, axis=1)
    near &= np.isfinite(moved)
    weight = _belonging(across[near])
    if not weight.sum() > 0.0:
        raise AmiwarpError("no event lies near an edge")
    mean = np.average(moved[near], weights=weight)
    return float(np.sqrt(np.average((moved[near] - mean) ** 2, weights=weight)))


def _belonging(across: NDArray[np.float64]) -> NDArray[np.float64]:
    """Probability of each event, by its distance across the edge, not to be of the even background.

    The density over all edges is counted in bins of 0.1 px; the background is its level in the outermost sixth.
    """
    bins = np.clip(((across + ACROSS) * 10.0).astype(np.int64), 0, round(20 * ACROSS) - 1)
    density = np.bincount(bins, minlength=round(20 * ACROSS)).astype(np.float64)
    margin = len(density) // 12
    background = np.concatenate([density[:margin], density[-margin:]]).mean()
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.where(density > 0.0, np.maximum(0.0, 1.0 - background / density), 0.0)
    return np.asarray(share[bins])


def contrast(image: NDArray[np.float32]) -> float:
    """Variance over mean of an IWE (height, width): 1 for events strewn at random, more the sharper it is."""
    return sharpness(image, Sharpness.VARIANCE)


def entropy(image: NDArray[np.float32]) -> float:
    """Entropy of the events' distribution over the pixels of an IWE (height, width) [nat]: less the sharper it is."""
    return -sharpness(image, Sharpness.ENTROPY)


def truth_model(camera: Camera, truth: Truth, flat_side: FlatSide) -> ExactModel:
    """The generating model of a simulated recording."""
    p = truth.parameters
    prism = Prism(p["apex"], p["index"], flat_side)
    return ExactModel(camera, prism, p["phase"], (p.get("tilt_x", 0.0), p.get("tilt_y", 0.0)))


def model_error(model: Model, truth: ExactModel) -> ModelError:
    """Distance between the fitted displacement field and the generating one: rms and worst [px] over image and turn.

    The constant lag is removed first: events lag their edge, which no model can know.
    """
    return predicted_error(model, truth, remove_lag=True)


@dataclass(frozen=True, slots=True)
class PictureQuality:
    """How near a picture comes to the truth once the gain and the offset that events do not tell are fitted."""

    correlation: float
    """Pearson's, of log intensity: -1 .. 1; negative for an inverted picture."""
    psnr_db: float
    """Of log intensity after the fit [dB], relative to the truth's range over :data:`RANGE`; inf without any error."""
    gain: float
    """Log intensity of the truth per unit of the picture: the ON threshold, where it is in units of that."""
    offset: float
    """Log intensity of the truth where the picture is 0."""


def picture_quality(
    log: NDArray[np.floating[Any]], truth: NDArray[np.floating[Any]], where: NDArray[np.bool_] | None = None
) -> PictureQuality:
    """Correlation and PSNR of a picture of log intensity, gain and offset fitted first by least squares.

    ``log``: the picture in any unit, shape (height, width), may be NaN where it is not judged; ``truth``: the true
    natural log intensity, same shape; ``where``: the pixels that are fitted and judged, same shape, all by default.
    The truth's range is that of all its pixels, so that PSNRs over different pixels can be compared.
    Raises :class:`AmiwarpError` for shapes that differ, values that are not finite, and where the pixels judged, or
    the truth's range, are constant.
    """
    if where is None:
        where = np.ones(np.shape(truth), np.bool_)
    if not np.shape(log) == np.shape(truth) == where.shape:
        shapes = f"{np.shape(log)}, {np.shape(truth)} and {where.shape}"
        raise AmiwarpError(f"picture, truth and pixels to judge are of shapes {shapes}; give all of one shape")
    a, b = log[where].astype(np.float64), truth[where].astype(np.float64)
    span = float(np.ptp(np.percentile(truth, RANGE)))
    if not (np.isfinite(a).all() and np.isfinite(b).all() and math.isfinite(span)):
        raise AmiwarpError("picture or truth: not finite in some pixels; leave these out with `where`")
    if not (a.size and np.ptp(a) > 0.0 and np.ptp(b) > 0.0 and span > 0.0):
        raise AmiwarpError(f"picture or truth: constant over the {a.size} pixels judged; there is no gain to fit")
    da, db = a - a.mean(), b - b.mean()
    gain = float(da @ db / (da @ da))
    error = float(np.mean((db - gain * da) ** 2))
    return PictureQuality(
        correlation=float(da @ db / math.sqrt((da @ da) * (db @ db))),
        psnr_db=10.0 * math.log10(span**2 / error) if error > 0.0 else math.inf,
        gain=gain,
        offset=float(b.mean() - gain * a.mean()),
    )
