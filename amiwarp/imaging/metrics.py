"""Metrics of images: sharpness of an IWE, directions of its edges, blur, contrast, error against ground truth."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.choices import Sharpness
from amiwarp.errors import AmiwarpError
from amiwarp.events.device_events import cast, import_array
from amiwarp.events.recording import Events
from amiwarp.events.truth import Truth
from amiwarp.imaging.iwe import CanvasShape, Image, iwe
from amiwarp.kernels import iwe as kernels
from amiwarp.kernels.iwe import SEGMENT, STRIP, find_largest, gather_sums, smooth_and_add, smooth_votes, sum_directions
from amiwarp.kernels.launch import BLOCK_DIM, Program, launch, page_locked
from amiwarp.optics.camera import Camera
from amiwarp.optics.models import ExactModel, Model, ModelError, predicted_error
from amiwarp.optics.prism import FlatSide, Prism
from amiwarp.validation import array, choice, guarded, on_gpu, real

# Sharpness of an image of warped events: five measures with one signature. For all of them, higher is sharper.

_Step = tuple[Any, int, list[Any], Any, int]
"""Kernel with its number of threads, its inputs, its output, and the fewest threads of a CPU slice."""
PAPER_ETA = 1.0
"""Parameter η of the paper's sharpness cost J [events]; He et al. do not state the value that they used."""
LARGEST_SMOOTHING = 1000.0
"""Largest accepted standard deviation of the smoothing Gaussian [px]."""
LEAST_PADDING = 6
"""Smallest padding of a meter's image [px]; :mod:`amiwarp.imaging.metrics` smooths it, too."""


class SharpnessMeter:
    """Measures the sharpness of images of one canvas, after smoothing. Owns its buffers."""

    def __init__(self, canvas: CanvasShape, kind: Sharpness, *, smoothing: float, device: Any) -> None:
        """Allocate buffers. ``smoothing``: standard deviation of the Gaussian [canvas px]; 0 disables smoothing."""
        weights = gaussian(smoothing)
        self.kind = choice(Sharpness, kind, "sharpness")
        self.device = wp.get_device(device)
        self.image = Image(canvas, max(len(weights), LEAST_PADDING), self.device)
        """Image whose sharpness is measured [events per pixel]; the caller writes its pixels."""
        self._weights = wp.array(weights, dtype=float, device=device)
        layers, rows, columns = canvas.shape
        self._n = layers // canvas.parts * rows * columns
        strips = -(-rows // int(STRIP)) * self.image.frame.blocks
        unrolled = self.device.is_cuda and 1 < len(weights) <= kernels.MOST_UNROLLED
        self.takes_votes = unrolled and self.kind is Sharpness.VARIANCE
        """Whether :meth:`launch` takes votes."""
        if self.takes_votes:
            strips = -(-rows * columns // BLOCK_DIM)
        self._sums = wp.empty((layers, strips), dtype=wp.vec2d, device=device)
        self._host = self._sums
        if self.device.is_cuda:
            self._host = page_locked(self, (layers,), wp.vec2d, self.device)
            # the same memory, into which a kernel writes: a copy would take longer
            self._sum = wp.array(ptr=self._host.ptr, dtype=wp.vec2d, shape=layers, device=self.device)
            if len(weights) > 1:
                _ = self._smoothed  # a captured graph must not allocate it
        self._sums_on_host = self._host.numpy().reshape(canvas.parts, -1, 2)

    def launch(self, votes: Any = None) -> None:
        """Measure :attr:`image` on the device without waiting for the result.

        Instead of the image, its ``votes`` [1/256 event] may be given in the same memory layout.
        """
        assert votes is None or self.takes_votes
        if self.device.is_cpu:
            self._program.launch()
            return
        for kernel, n, inputs, out, _ in self._fused_steps(votes) if self.takes_votes else self._steps():
            launch(kernel, n, inputs, [out], device=self.device)
        threads = self._sum.size * BLOCK_DIM
        wp.launch(gather_sums, threads, [self._sums], [self._sum], device=self.device, block_dim=BLOCK_DIM)

    def _fused_steps(self, votes: Any) -> Iterator[_Step]:
        """Yield what :meth:`_steps` does, in fewer kernels: for the variance on CUDA."""
        taps, frame, out = len(self._weights), self.image.frame, self._smoothed[0]
        if votes is None:
            inputs = [self.image.pixels, self._weights, 1, frame]
            yield kernels.smooth_few(taps), self.image.blocks, inputs, out, 512
        else:
            yield smooth_votes(taps), self.image.blocks, [votes, self._weights, frame], out, 512
        threads = self._sums.shape[1] * BLOCK_DIM
        inputs = [out, self._weights, frame, threads]
        yield smooth_and_add(taps), self._sums.size * BLOCK_DIM, inputs, self._sums.flatten(), 512

    def _steps(self) -> Iterator[_Step]:
        """Yield each kernel with its number of threads, inputs, output, and the fewest threads of a CPU slice."""
        smoothed, frame, width = self.image.pixels, self.image.frame, self.image.width
        taps = len(self._weights)
        if self.device.is_cpu and self.kind is Sharpness.VARIANCE and 1 < taps <= kernels.MOST_UNROLLED:
            kernel, inputs = kernels.smooth_and_sum(taps), [smoothed, self._weights, frame]
            yield kernel, self._sums.size, inputs, self._sums.flatten(), 64
            return
        if taps > 1:
            yield from smoothing_steps(self.image, self._weights, self._smoothed)
            smoothed = self._smoothed[-1]
        kernel = kernels.sum_terms(width, list(Sharpness).index(self.kind))
        yield kernel, self._sums.size, [smoothed, frame, PAPER_ETA], self._sums.flatten(), 64

    @cached_property
    def _smoothed(self) -> list[Any]:
        """Buffers for the image, smoothed along rows and, if that is stored, along both axes."""
        return [wp.zeros_like(self.image.pixels) for _ in range(1 if self.takes_votes else 2)]

    @cached_property
    def _program(self) -> Program:
        """Recorded launches for a CPU, where a new launch takes about as long as the kernel."""
        program = Program(self.device)
        for kernel, n, inputs, out, smallest in self._steps():
            program.add(kernel, n, inputs, [out], smallest=smallest)
        return program

    def results(self) -> list[float]:
        """Wait, and return the sharpness of each part of the last measured image."""
        if self.device.is_cuda:
            wp.synchronize_stream(self.device)
        sums = self._sums_on_host
        few = sums[:, 0] if sums.shape[1] == 1 else sums.sum(axis=1)  # NumPy takes microseconds even for sums of one
        return [self._score(total, terms) for total, terms in few.tolist()]

    @property
    def finite(self) -> bool:
        """Whether all values of the last measured image were finite."""
        return bool(np.isfinite(self._sums_on_host[..., 0]).all())

    def measure(self) -> float:
        """Return the sharpness of :attr:`image`, which has one part."""
        self.launch()
        return self.results()[0]

    def _score(self, total: float, terms: float) -> float:
        """Return the sharpness from the sum of the image's pixels and the sum of the measure's terms."""
        if total <= 0.0:
            return 0.0
        if self.kind is Sharpness.VARIANCE:
            return terms / total - total / self._n
        if self.kind is Sharpness.PAPER_J:
            return -terms
        if self.kind is Sharpness.ENTROPY:
            return terms / total - math.log(total)
        return terms / total


def smoothing_steps(image: Image, weights: wp.array, out: list[wp.array]) -> Iterator[_Step]:
    """Yield the two steps that smooth an image along its rows and columns, as :meth:`SharpnessMeter._steps` does.

    ``out``: buffers of the layout of the image for the result of each step.
    """
    unrolled = image.device.is_cuda and len(weights) <= kernels.MOST_UNROLLED
    smooth = kernels.smooth_few(len(weights)) if unrolled else kernels.smooth(image.width)
    smoothed = image.pixels
    for step, result in zip((1, image.frame.stride), out, strict=True):
        yield smooth, image.blocks, [smoothed, weights, step, image.frame], result, 512
        smoothed = result


def gaussian(sigma: float) -> NDArray[np.float32]:
    """Return the weights of a Gaussian at 0, 1, … 3 sigma pixels; [1] for sigma 0.

    The symmetric kernel of these weights sums to 1.
    """
    sigma = real(sigma, "smoothing", 0.0, LARGEST_SMOOTHING, " px, a standard deviation")
    if sigma < 1e-6:  # the weights of the neighbours are 0 in float32
        return np.ones(1, dtype=np.float32)
    k = np.arange(math.ceil(3.0 * sigma) + 1)
    weights = np.exp(-0.5 * (k / sigma) ** 2)
    return (weights / (weights[0] + 2.0 * weights[1:].sum())).astype(np.float32)


def random_variance(smoothing: float) -> float:
    """Return the variance over mean of an image of random events: bilinear votes at dithered places, then smoothed.

    ``smoothing``: standard deviation of the Gaussian [px].
    """
    weights = gaussian(smoothing).astype(np.float64)
    both = np.concatenate([weights[:0:-1], weights])
    # Bilinear votes share an event by 1 - u and u, with u from 0 to 1: 2/3 is the mean of (1 - u)² + u².
    return ((2.0 * float(both @ both) + float(both[1:] @ both[:-1])) / 3.0) ** 2


def relative_variance(variance: float, mean: float, smoothing: float) -> float:
    """Return the variance of the density of events over the square of its mean, which more events do not change.

    It is 0 for events at random places, whatever their number: the variance that counting gives them is subtracted.

    Parameters
    ----------
    variance : float
        Variance over mean of an image of bilinear votes of dithered events, from :class:`SharpnessMeter`.
    mean : float
        Mean of that image [events per pixel], above 0.
    smoothing : float
        Standard deviation of the Gaussian that smoothed the image [px].

    Returns
    -------
    float
        The relative variance. It is negative only by noise.
    """
    return (variance - random_variance(smoothing)) / mean


@guarded
def sharpness(
    image: Any,
    kind: Sharpness = Sharpness.VARIANCE,
    *,
    smoothing: float = 0.0,
    device: Any = None,
) -> float:
    """Compute the sharpness of an image of warped events.

    Parameters
    ----------
    image : array
        Image [events per pixel], shape ``(height, width)`` or ``(2, height, width)``: an array of NumPy, Warp, PyTorch,
        CuPy, JAX or any other library with DLPack.
    kind : Sharpness, optional
        Sharpness measure.
    smoothing : float, optional
        Standard deviation of a Gaussian applied first [px]; 0 disables it.
    device : str or warp.Device, optional
        Device to compute on, by default that of the image.

    Returns
    -------
    float
        Sharpness. Higher is sharper; 0 for an image without events.

    Raises
    ------
    AmiwarpError
        If the image has another shape or holds values that are not finite.

    Examples
    --------
    >>> import numpy as np
    >>> edge = np.zeros((8, 8), np.float32)
    >>> edge[:, 3] = 8.0
    >>> even = np.ones((8, 8), np.float32)
    >>> amiwarp.sharpness(edge), amiwarp.sharpness(even)
    (7.0, 0.0)
    """
    on_device = on_gpu(image) or isinstance(image, wp.array)
    image = cast(import_array(image, "image"), wp.float32) if on_device else array(image, "image")
    if image.ndim not in (2, 3) or not image.size or (image.ndim == 3 and len(image) > 2):
        raise AmiwarpError(f"image has shape {image.shape}; expected (height, width) or (2, height, width)")
    stack = image.reshape((-1, *image.shape[-2:]))
    canvas = CanvasShape(stack.shape[2], stack.shape[1], per_polarity=len(stack) == 2)
    if not on_device and not np.all(np.isfinite(stack)):
        raise AmiwarpError(f"image of shape {image.shape} holds a value that is not finite; replace it")
    if device is None:
        device = image.device if on_device else "cpu"
    meter = SharpnessMeter(canvas, kind, smoothing=smoothing, device=device)
    meter.image.write(stack.to(meter.device) if on_device else stack)
    found = meter.measure()
    if not meter.finite:
        raise AmiwarpError(f"image of shape {image.shape} holds a value that is not finite; replace it")
    return found


# How much the edges in an image run in one direction.

EDGE_SMOOTHING_PX = 1.5
"""Standard deviation of the Gaussian that smooths an image before its gradients are computed [px]."""
STRONG = 0.1
"""Share of the largest squared gradient above which a gradient counts."""
FEW_SEGMENTS = 512
"""Smallest number of segments for which a second CPU thread is used."""


def edge_coherence(image: Image, inset: int) -> float:
    """Return the coherence of an image's edge directions, |Σ g² e^{2iφ}| / Σ g² over gradients (g, φ), 0 to 1.

    It is 1 if all edges are parallel. Gradients are those of the sum of all layers. Noise has no direction and lowers
    the coherence, so weak gradients are left out, and so are pixels within ``inset`` of the image's border.
    """
    device, (layers, rows, columns) = image.device, image.shape
    weights = wp.array(gaussian(EDGE_SMOOTHING_PX), dtype=float, device=device)
    buffers = [wp.zeros_like(image.pixels) for _ in range(2)]
    for kernel, n, inputs, out, smallest in smoothing_steps(image, weights, buffers):
        launch(kernel, n, inputs, [out], device=device, smallest=smallest)
    n = max(0, rows - 2 * inset) * max(0, -(-(columns - 2 * inset) // int(SEGMENT)))
    largest: Any = wp.zeros(max(1, n), dtype=float, device=device)
    inputs = [buffers[1], image.frame, layers, inset]
    launch(find_largest, n, inputs, [largest], device=device, smallest=FEW_SEGMENTS)
    limit = STRONG * float(largest.numpy().max())
    sums: Any = wp.zeros(max(1, n), dtype=wp.vec3d, device=device)
    launch(sum_directions, n, [*inputs, limit], [sums], device=device, smallest=FEW_SEGMENTS)
    total, x, y = sums.numpy().sum(axis=0).tolist()
    return math.hypot(x, y) / total if total > 0.0 else 0.0


# Quality of compensation and of pictures: edge blur, contrast, entropy, error against ground truth.

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

    xy: NDArray[np.float64]
    """Positions of the edge points [px], shape (n, 2)."""
    normal: NDArray[np.float64]
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

    def derivative(y: int, x: int) -> NDArray[np.float64]:
        return np.asarray(ndimage.gaussian_filter(image.astype(np.float64), RIDGE_SCALE, order=(y, x)))

    gx, gy = derivative(0, 1), derivative(1, 0)
    hxx, hxy, hyy = derivative(0, 2), derivative(1, 1), derivative(2, 0)
    half = 0.5 * (hxx - hyy)
    root = np.hypot(half, hxy)
    across = 0.5 * (hxx + hyy) - root  # the smaller eigenvalue
    along = across + 2.0 * root
    angle = 0.5 * np.arctan2(hxy, half) + np.pi / 2  # direction of its eigenvector
    nx, ny = np.cos(angle), np.sin(angle)
    with np.errstate(divide="ignore", invalid="ignore"):
        offset = -(gx * nx + gy * ny) / across
    ridge = (across < 0.0) & (np.abs(offset) <= 0.6) & (np.abs(along) < 0.5 * np.abs(across))
    if not ridge.any():
        raise AmiwarpError("the image of events has no edges, so blur cannot be measured; give more or sharper events")
    ridge &= across <= WEAKEST_EDGE * np.quantile(across[ridge], 0.05)
    rows, cols = np.nonzero(ridge)
    points = np.stack([cols + offset[ridge] * nx[ridge], rows + offset[ridge] * ny[ridge]], axis=1)
    nearest = ndimage.distance_transform_edt(~ridge, return_distances=False, return_indices=True)
    index = np.zeros(image.shape, dtype=np.int64)
    index[rows, cols] = np.arange(len(rows))
    return Edges(points, np.stack([nx[ridge], ny[ridge]], axis=1), index[nearest[0], nearest[1]])


@guarded
def edge_blur(
    sharp_xy: NDArray[np.float32], width: int, height: int, *, of: NDArray[np.float32] | None = None
) -> float:
    """Compute the standard deviation of events across edges [px], the paper's compensation error.

    Parameters
    ----------
    sharp_xy : ndarray
        Event coordinates from which edges are found [px], shape ``(n, 2)``.
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
        raise AmiwarpError(f"sharp_xy has shape {sharp_xy.shape} and of {of.shape}; give (n, 2) for both")
    return edge_blurs(sharp_xy, width, height, [of])[0]


def edge_blurs(
    sharp_xy: NDArray[np.float32], width: int, height: int, positions: Sequence[NDArray[np.float32]]
) -> list[float]:
    """Return the :func:`edge_blur` of the same events at several positions, across the same edges."""
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
    near = (np.abs(across) < STRIP_HALF_WIDTH) & (np.abs(along) <= 1.0)
    moved = (np.sum((np.asarray(of, np.float64)[inside] - edges.xy[label]) * normal, axis=1) for of in positions)
    return [_blur(across, at, near & np.isfinite(at)) for at in moved]


def _blur(across: NDArray[np.float64], moved: NDArray[np.float64], near: NDArray[np.bool_]) -> float:
    """Return the weighted standard deviation of ``moved`` [px] over the events ``near`` an edge.

    ``across`` holds the signed distances of the events from their nearest edge [px].
    """
    weight = _edge_probability(across[near])
    if not weight.sum() > 0.0:
        raise AmiwarpError("no event is near an edge, so blur cannot be measured; give more events")
    mean = np.average(moved[near], weights=weight)
    return float(np.sqrt(np.average((moved[near] - mean) ** 2, weights=weight)))


def _edge_probability(across: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the probability that each event belongs to the edge rather than to the uniform background.

    ``across`` holds the signed distances of events from their nearest edge [px]. The density over all edges is counted
    in bins of 0.1 px. The background is the mean density in the outermost sixth of the strip.
    """
    bins = np.clip(((across + STRIP_HALF_WIDTH) * 10.0).astype(np.int64), 0, round(20 * STRIP_HALF_WIDTH) - 1)
    density = np.bincount(bins, minlength=round(20 * STRIP_HALF_WIDTH)).astype(np.float64)
    margin = len(density) // 12
    background = np.concatenate([density[:margin], density[-margin:]]).mean()
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.where(density > 0.0, np.maximum(0.0, 1.0 - background / density), 0.0)
    return np.asarray(share[bins])


def contrast(image: NDArray[np.float32]) -> float:
    """Return the variance over mean of an IWE: 1 for events at random pixels, higher for sharper images."""
    return sharpness(image, Sharpness.VARIANCE)


def entropy(image: NDArray[np.float32]) -> float:
    """Return the entropy of the events' distribution over the pixels of an IWE [nat]: lower for sharper images."""
    return -sharpness(image, Sharpness.ENTROPY)


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
    p = truth.parameters
    return ExactModel.from_values(camera, Prism(p["apex"], p["index"], flat_side), p)


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
    log: NDArray[np.floating[Any]], truth: NDArray[np.floating[Any]], where: NDArray[np.bool_] | None = None
) -> PictureQuality:
    """Compute correlation and PSNR of a picture of log intensity, after a least-squares fit of gain and offset.

    ``log``: the picture in any unit, shape (height, width); may be NaN outside ``where``. ``truth``: the true natural
    log intensity, same shape. ``where``: pixels to fit and to judge, same shape, by default all. The truth's range is
    that of all its pixels, so that PSNRs over different pixels can be compared.
    Raises :class:`AmiwarpError` for different shapes, values that are not finite, and a constant picture or truth.
    """
    if where is None:
        where = np.ones(np.shape(truth), np.bool_)
    if not np.shape(log) == np.shape(truth) == where.shape:
        shapes = f"{np.shape(log)}, {np.shape(truth)} and {where.shape}"
        raise AmiwarpError(f"picture, truth and mask `where` have shapes {shapes}; expected equal shapes")
    a, b = log[where].astype(np.float64), truth[where].astype(np.float64)
    span = float(np.ptp(np.percentile(truth, TRUTH_PERCENTILES)))
    if not (np.isfinite(a).all() and np.isfinite(b).all() and math.isfinite(span)):
        raise AmiwarpError("picture or truth is not finite in some pixels; exclude these pixels with the mask `where`")
    if not (a.size and np.ptp(a) > 0.0 and np.ptp(b) > 0.0 and span > 0.0):
        raise AmiwarpError(
            f"picture or truth is constant over the {a.size} pixels of the mask `where`, so no gain can be fitted; "
            "compare pictures with contrast"
        )
    da, db = a - a.mean(), b - b.mean()
    gain = float(da @ db / (da @ da))
    error = float(np.mean((db - gain * da) ** 2))
    return PictureQuality(
        correlation=float(da @ db / math.sqrt((da @ da) * (db @ db))),
        psnr_db=10.0 * math.log10(span**2 / error) if error > 0.0 else math.inf,
        gain=gain,
        offset=float(b.mean() - gain * a.mean()),
    )
