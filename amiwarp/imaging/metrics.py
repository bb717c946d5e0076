"""Quality of compensation and of pictures: blur of edges, error against ground truth, PSNR and SSIM."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.recording import Events
from amiwarp.events.truth import Truth
from amiwarp.imaging.iwe import iwe
from amiwarp.optics.camera import Camera
from amiwarp.optics.models.base import Model
from amiwarp.optics.models.comparison import ModelError, predicted_error
from amiwarp.optics.models.exact import ExactModel
from amiwarp.optics.prism import FlatSide, Prism
from amiwarp.schema.calls import guarded

Vector = NDArray[np.float64]

STRIP_HALF_WIDTH = 3.0
"""Half width of the strip along an edge in which events count as belonging to it [px]."""
RIDGE_SCALE = 1.0
"""Standard deviation of the Gaussian derivatives that find edges [px]."""
WEAKEST_EDGE = 0.3
"""Smallest strength of an edge, relative to the 95th percentile of all edges. Weaker ridges are mostly noise."""
TRUTH_PERCENTILES = (0.5, 99.5)
"""Percentiles of a true picture between which its range is measured; PSNR is relative to this range."""


@dataclass(frozen=True, slots=True)
class Edges:
    """Sub-pixel points on the edges of an IWE, found as ridges of the image."""

    xy: Vector
    """Positions of the edge points [px], shape (n, 2)."""
    normal: Vector
    """Unit vectors across the edge, shape (n, 2)."""
    label: NDArray[np.int64]
    """Index of the nearest edge point for each pixel, shape (height, width)."""


def find_edges(image: NDArray[np.float32]) -> Edges:
    """Find the ridges of an IWE.

    On a ridge, the second derivative across it is most negative and the first derivative across it is zero. Source:
    Steger, "An unbiased detector of curvilinear structures", PAMI 1998. Ridges weaker than :data:`WEAKEST_EDGE` are
    left out. Raises :class:`AmiwarpError` if the image has no ridge.
    """
    from scipy import ndimage

    pixels = image.astype(np.float64)

    def derivative(y: int, x: int) -> Vector:
        return np.asarray(ndimage.gaussian_filter(pixels, RIDGE_SCALE, order=(y, x)))

    # Second derivatives across and along an edge: the eigenvalues of the Hessian, and the direction across it.
    hxx = derivative(0, 2)
    hxy = derivative(1, 1)
    hyy = derivative(2, 0)
    half = 0.5 * (hxx - hyy)
    root = np.hypot(half, hxy)
    across = 0.5 * (hxx + hyy) - root  # the smaller eigenvalue
    along = across + 2.0 * root
    angle = 0.5 * np.arctan2(hxy, half) + np.pi / 2  # direction of its eigenvector
    nx = np.cos(angle)
    ny = np.sin(angle)

    # Distance from a pixel's centre to where the first derivative is zero. The ridge crosses the pixel if it is short.
    gx = derivative(0, 1)
    gy = derivative(1, 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        offset = -(gx * nx + gy * ny) / across
    crosses = np.abs(offset) <= 0.6
    is_long = np.abs(along) < 0.5 * np.abs(across)
    ridge = (across < 0.0) & crosses & is_long
    if not ridge.any():
        raise AmiwarpError(
            "the image of events has no edges, so blur cannot be measured; give more or sharper events"
        )
    strong = np.quantile(across[ridge], 0.05)
    ridge &= across <= WEAKEST_EDGE * strong

    rows, columns = np.nonzero(ridge)
    offset = offset[ridge]
    nx = nx[ridge]
    ny = ny[ridge]
    x = columns + offset * nx
    y = rows + offset * ny

    # The nearest edge point of each pixel.
    nearest_row, nearest_column = ndimage.distance_transform_edt(
        ~ridge,
        return_distances=False,
        return_indices=True,
    )
    index = np.zeros(image.shape, dtype=np.int64)
    index[rows, columns] = np.arange(len(rows))
    return Edges(
        xy=np.stack([x, y], axis=1),
        normal=np.stack([nx, ny], axis=1),
        label=index[nearest_row, nearest_column],
    )


@guarded
def edge_blur(
    sharp_xy: NDArray[np.float32], width: int, height: int, *, of: NDArray[np.float32] | None = None
) -> float:
    """Compute the standard deviation of events across edges [px], the paper's compensation error.

    Parameters
    ----------
    sharp_xy : ndarray
        Event coordinates from which edges are found [px], shape ``(n, 2)``. NaN and infinite
        ones do not count.
    width, height : int
        Sensor size [px].
    of : ndarray, optional
        Coordinates of the same events at which the blur is measured [px], shape ``(n, 2)``; by default ``sharp_xy``.
        Give the raw coordinates here to measure the blur before compensation.

    Returns
    -------
    float
        Standard deviation across edges [px]. Pixel quantisation alone gives 0.29 px.

    Raises
    ------
    AmiwarpError
        If the IWE has no edges, or no event is near an edge.

    Notes
    -----
    Edges are the ridges of the IWE of ``sharp_xy`` (Steger, PAMI 1998). An event belongs to an edge if it is within
    3 px. Each event is weighted by the probability that it is not part of the uniform background, which consists of
    noise and neighbouring texture.

    Examples
    --------
    >>> import numpy as np
    >>> rng = np.random.default_rng(0)
    >>> x, y = 20.0 + rng.normal(0.0, 0.5, 20_000), rng.uniform(0.0, 39.0, 20_000)
    >>> round(amiwarp.edge_blur(np.stack([x, y], axis=1).astype(np.float32), 40, 40), 1)
    0.5
    """
    of = sharp_xy if of is None else of
    if sharp_xy.ndim != 2 or sharp_xy.shape[1] != 2 or of.shape != sharp_xy.shape:
        raise AmiwarpError(
            f"sharp_xy has shape {sharp_xy.shape} and of {of.shape}; give (n, 2) for both"
        )
    return edge_blurs(sharp_xy, width, height, [of])[0]


def edge_blurs(
    sharp_xy: NDArray[np.float32],
    width: int,
    height: int,
    positions: Sequence[NDArray[np.float32]],
) -> list[float]:
    """Return the :func:`edge_blur` of the same events at several positions, across the same edges."""
    zeros = np.zeros(len(sharp_xy), np.uint8)
    events = Events(sharp_xy[:, 0], sharp_xy[:, 1], zeros.astype(np.int64), zeros)
    edges = find_edges(iwe(events, width, height))
    with np.errstate(invalid="ignore"):
        pixel = np.rint(sharp_xy)
        inside = ((pixel >= 0) & (pixel < (width, height))).all(axis=1)
    columns, rows = pixel[inside].astype(np.int64).T
    label = edges.label[rows, columns]
    normal = edges.normal[label]
    edge_xy = edges.xy[label]

    # Events in the strip along an edge.
    away = sharp_xy[inside].astype(np.float64) - edge_xy
    across = np.sum(away * normal, axis=1)
    along = away[:, 0] * normal[:, 1] - away[:, 1] * normal[:, 0]
    near = (np.abs(across) < STRIP_HALF_WIDTH) & (np.abs(along) <= 1.0)
    blurs = []
    for xy in positions:
        moved_away = np.asarray(xy, np.float64)[inside] - edge_xy
        moved = np.sum(moved_away * normal, axis=1)
        known = near & np.isfinite(moved)
        blurs.append(_blur(across, moved, known))
    return blurs


def _blur(across: Vector, moved: Vector, near: NDArray[np.bool_]) -> float:
    """Return the weighted standard deviation of ``moved`` [px] over the events ``near`` an edge.

    ``across`` holds the signed distances of the events from their nearest edge [px].
    """
    weight = _edge_probability(across[near])
    if not weight.sum() > 0.0:
        raise AmiwarpError("no event is near an edge, so blur cannot be measured; give more events")
    moved = moved[near]
    mean = np.average(moved, weights=weight)
    variance = np.average((moved - mean) ** 2, weights=weight)
    return float(np.sqrt(variance))


def _edge_probability(across: Vector) -> Vector:
    """Return the probability that each event belongs to the edge rather than to the uniform background.

    ``across`` holds the signed distances of events from their nearest edge [px]. The density over all edges is counted
    in bins of 0.1 px. The background is the mean density in the outermost sixth of the strip.
    """
    count = round(20 * STRIP_HALF_WIDTH)
    place = (across + STRIP_HALF_WIDTH) * 10.0
    bins = np.clip(place.astype(np.int64), 0, count - 1)
    density = np.bincount(bins, minlength=count).astype(np.float64)
    margin = len(density) // 12
    outermost = np.concatenate([density[:margin], density[-margin:]])
    background = outermost.mean()
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.maximum(0.0, 1.0 - background / density)
    share = np.where(density > 0.0, share, 0.0)
    return np.asarray(share[bins])


@guarded
def truth_model(camera: Camera, truth: Truth, flat_side: FlatSide) -> ExactModel:
    """Return the optical model that generated a simulated recording.

    Parameters
    ----------
    camera : Camera
        Camera of the recording.
    truth : Truth
        Ground truth of the recording.
    flat_side : FlatSide
        Side of the prism that is perpendicular to the axis of rotation.

    Returns
    -------
    ExactModel
        The true model.

    Examples
    --------
    >>> camera = amiwarp.Camera.from_fov(64, 48, 1.0)
    >>> truth = amiwarp.Truth({"apex": 0.02, "index": 1.5, "phase": 0.3})
    >>> amiwarp.truth_model(camera, truth, amiwarp.FlatSide.CAMERA).phase
    0.3
    """
    parameters = truth.parameters
    prism = Prism(parameters["apex"], parameters["index"], flat_side)
    return ExactModel.from_values(camera, prism, parameters)


@guarded
def model_error(model: Model, truth: ExactModel) -> ModelError:
    """Compute the distance between the displacement fields of a fitted model and the true one.

    Parameters
    ----------
    model : Model
        Fitted model.
    truth : ExactModel
        Model that generated the recording, see :func:`truth_model`.

    Returns
    -------
    ModelError
        Root mean square and largest distance [px] over the image and one turn.

    Notes
    -----
    The constant lag is removed first: events lag the edges that cause them, and no model can observe that lag.

    Examples
    --------
    >>> camera = amiwarp.Camera.from_fov(64, 48, 1.0)
    >>> truth = amiwarp.ExactModel.from_prism(camera, amiwarp.Prism(0.02), 0.3)
    >>> amiwarp.model_error(truth, truth).rms < 1e-3
    True
    """
    return predicted_error(model, truth, remove_lag=True)


@dataclass(frozen=True, slots=True)
class PictureQuality:
    """Similarity of a picture to the true picture after a fit of gain and offset, which events do not determine."""

    correlation: float
    """Pearson correlation of log intensity with the true picture, -1 .. 1; negative for an inverted picture."""
    psnr_db: float
    """PSNR of log intensity after the fit [dB], relative to the true picture's range over :data:`TRUTH_PERCENTILES`.

    Infinite if there is no error.
    """
    gain: float
    """Slope of the fit: log intensity of the true picture per unit of the reconstructed picture.

    If the unit of the reconstructed picture is the ON threshold, the gain is the value of that threshold.
    """
    offset: float
    """Log intensity of the true picture where the reconstructed picture is 0."""


def picture_quality(
    log: NDArray[np.floating[Any]],
    truth: NDArray[np.floating[Any]],
    where: NDArray[np.bool_] | None = None,
) -> PictureQuality:
    """Compute correlation and PSNR of a picture of log intensity, after a least-squares fit of gain and offset.

    ``log``: the picture in any unit, shape (height, width); may be NaN outside ``where``. ``truth``: the true natural
    log intensity, same shape. ``where``: pixels to fit and to judge, same shape, by default all. The truth's range is
    taken over all its pixels, so that PSNRs over different pixels can be compared.
    Raises :class:`AmiwarpError` for different shapes, values that are not finite, and a constant picture or truth.
    """
    if where is None:
        where = np.ones(np.shape(truth), np.bool_)
    if not np.shape(log) == np.shape(truth) == where.shape:
        shapes = f"{np.shape(log)}, {np.shape(truth)} and {where.shape}"
        raise AmiwarpError(
            f"picture, truth and mask `where` have shapes {shapes}; expected equal shapes"
        )
    a = log[where].astype(np.float64)
    b = truth[where].astype(np.float64)
    span = float(np.ptp(np.percentile(truth, TRUTH_PERCENTILES)))
    are_finite = np.isfinite(a).all() and np.isfinite(b).all()
    if not are_finite:
        raise AmiwarpError(
            "picture or truth is not finite in some pixels; exclude these pixels with the mask `where`"
        )
    if not math.isfinite(span):
        raise AmiwarpError(
            "truth is not finite in some pixels outside the mask `where`, but its range over all pixels is needed; "
            "give finite values there, too"
        )
    if not (a.size and np.ptp(a) > 0.0 and np.ptp(b) > 0.0 and span > 0.0):
        raise AmiwarpError(
            f"picture or truth is constant over the {a.size} pixels of the mask `where`, so no gain can be fitted; "
            "compare pictures with contrast"
        )
    da = a - a.mean()
    db = b - b.mean()
    gain = float(da @ db / (da @ da))
    error = float(np.mean((db - gain * da) ** 2))
    psnr_db = math.inf
    if error > 0.0:
        psnr_db = 10.0 * math.log10(span**2 / error)
    return PictureQuality(
        correlation=float(da @ db / math.sqrt((da @ da) * (db @ db))),
        psnr_db=psnr_db,
        gain=gain,
        offset=float(b.mean() - gain * a.mean()),
    )
