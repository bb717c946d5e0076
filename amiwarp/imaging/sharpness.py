"""Sharpness of an image of warped events: five measures with one signature, for all of which higher is sharper."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.choices import Sharpness
from amiwarp.errors import AmiwarpError
from amiwarp.events.device_columns import cast, import_array
from amiwarp.imaging.canvas import CanvasShape, Image
from amiwarp.kernels.launch import BLOCK_DIM, launch
from amiwarp.kernels.lowest import lowest_value
from amiwarp.kernels.page_locked_memory import page_locked
from amiwarp.kernels.program import Program
from amiwarp.kernels.smoothing import (
    MOST_UNROLLED,
    STRIP,
    gather_sums,
    smooth,
    smooth_and_add,
    smooth_and_sum,
    smooth_few,
    smooth_votes,
    sum_terms,
)
from amiwarp.schema.calls import guarded
from amiwarp.validation import array, choice, on_gpu, real


class Step(NamedTuple):
    """Launch of a kernel whose last input is its first thread."""

    kernel: Any
    threads: int
    inputs: list[Any]
    output: Any
    smallest: int
    """Fewest threads of a CPU slice."""


SMALLEST_SLICE_BLOCKS = 512
"""Fewest threads of a CPU slice, if each smooths a block of pixels."""
SMALLEST_SLICE_STRIPS = 64
"""Fewest threads of a CPU slice, if each sums over a strip of the image: these take longer."""
PAPER_ETA = 1.0
"""Parameter η of the paper's sharpness cost J [events]; He et al. do not state the value that they used."""
LARGEST_SMOOTHING = 1000.0
"""Largest accepted standard deviation of the smoothing Gaussian [px]."""
LEAST_PADDING = 6
"""Smallest padding of a meter's image [px]; the measure of edge directions smooths it, too."""


class SharpnessMeter:
    """Measures the sharpness of images of one canvas, after smoothing. Owns its buffers."""

    def __init__(
        self,
        canvas: CanvasShape,
        kind: Sharpness,
        *,
        smoothing: float,
        device: Any,
    ) -> None:
        """Allocate buffers. ``smoothing``: standard deviation of the Gaussian [canvas px]; 0 disables smoothing."""
        weights = gaussian(smoothing)
        self.kind = choice(Sharpness, kind, "sharpness")
        self.device = wp.get_device(device)
        padding = max(len(weights), LEAST_PADDING)
        self.image = Image(canvas, padding, self.device)
        """Image whose sharpness is measured [events per pixel]; the caller writes its pixels."""
        self._weights = wp.array(weights, dtype=float, device=device)
        layers, rows, columns = canvas.shape
        layers_of_part = layers // canvas.parts
        self._n = layers_of_part * rows * columns
        unrolled = self.device.is_cuda and 1 < len(weights) <= MOST_UNROLLED
        self.takes_votes = unrolled and self.kind is Sharpness.VARIANCE
        """Whether :meth:`launch` takes votes."""

        # Each thread, or for votes each block of threads, sums over a strip of the image.
        if self.takes_votes:
            strips = math.ceil(rows * columns / BLOCK_DIM)
        else:
            strips = math.ceil(rows / int(STRIP)) * self.image.frame.blocks
        self._strip_sums = wp.empty((layers, strips), dtype=wp.vec2d, device=device)
        self._host_sums = self._strip_sums
        if self.device.is_cuda:
            self._host_sums = page_locked(self, (layers,), wp.vec2d, self.device)
            # the same memory, into which a kernel writes: a copy would take longer
            address = self._host_sums.ptr
            self._layer_sums = wp.array(
                ptr=address, dtype=wp.vec2d, shape=layers, device=self.device
            )
            if len(weights) > 1:
                _ = self._smoothed  # a captured graph must not allocate it
        self._sums_by_part = self._host_sums.numpy().reshape(canvas.parts, -1, 2)

    def launch(self, votes: Any = None) -> None:
        """Measure :attr:`image` on the device without waiting for the result.

        Instead of the image, its ``votes`` [1/256 event] may be given in the same memory layout.
        """
        assert votes is None or self.takes_votes
        if self.device.is_cpu:
            self._program.launch()
            return
        steps = self._fused_steps(votes) if self.takes_votes else self._steps()
        for kernel, n, inputs, out, _ in steps:
            launch(kernel, n, inputs, [out], device=self.device)
        wp.launch(
            gather_sums,
            self._layer_sums.size * BLOCK_DIM,
            [self._strip_sums],
            [self._layer_sums],
            device=self.device,
            block_dim=BLOCK_DIM,
        )

    def _fused_steps(self, votes: Any) -> Iterator[Step]:
        """Yield what :meth:`_steps` does, in fewer kernels: for the variance on CUDA."""
        taps = len(self._weights)
        frame = self.image.frame
        blocks = self.image.blocks
        smoothed = self._smoothed[0]
        if votes is None:
            inputs = [self.image.pixels, self._weights, 1, frame]
            yield Step(smooth_few(taps), blocks, inputs, smoothed, SMALLEST_SLICE_BLOCKS)
        else:
            inputs = [votes, self._weights, frame]
            yield Step(smooth_votes(taps), blocks, inputs, smoothed, SMALLEST_SLICE_BLOCKS)
        _, strips = self._strip_sums.shape
        inputs = [smoothed, self._weights, frame, strips * BLOCK_DIM]
        threads = self._strip_sums.size * BLOCK_DIM
        sums = self._strip_sums.flatten()
        yield Step(smooth_and_add(taps), threads, inputs, sums, SMALLEST_SLICE_BLOCKS)

    def _steps(self) -> Iterator[Step]:
        """Yield each kernel with its number of threads, inputs, output, and the fewest threads of a CPU slice."""
        pixels = self.image.pixels
        frame = self.image.frame
        taps = len(self._weights)
        threads = self._strip_sums.size
        sums = self._strip_sums.flatten()
        is_variance = self.kind is Sharpness.VARIANCE
        if self.device.is_cpu and is_variance and 1 < taps <= MOST_UNROLLED:
            inputs = [pixels, self._weights, frame]
            yield Step(smooth_and_sum(taps), threads, inputs, sums, SMALLEST_SLICE_STRIPS)
            return
        if taps > 1:
            yield from smoothing_steps(self.image, self._weights, self._smoothed)
            pixels = self._smoothed[-1]
        number = list(Sharpness).index(self.kind)
        inputs = [pixels, frame, PAPER_ETA]
        kernel = sum_terms(self.image.width, number)
        yield Step(kernel, threads, inputs, sums, SMALLEST_SLICE_STRIPS)

    @cached_property
    def _smoothed(self) -> list[Any]:
        """Buffers for the image, smoothed along rows and, if that is stored, along both axes."""
        along_rows = wp.zeros_like(self.image.pixels)
        if self.takes_votes:
            return [along_rows]
        return [along_rows, wp.zeros_like(self.image.pixels)]

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
        sums = self._sums_by_part
        # NumPy takes microseconds even for sums of one
        few = sums[:, 0] if sums.shape[1] == 1 else sums.sum(axis=1)
        return [self._score(total, terms) for total, terms in few.tolist()]

    @property
    def finite(self) -> bool:
        """Whether all values of the last measured image were finite."""
        return bool(np.isfinite(self._sums_by_part[..., 0]).all())

    def measure(self) -> float:
        """Return the sharpness of :attr:`image`, which has one part."""
        self.launch()
        return self.results()[0]

    def _score(self, total: float, terms: float) -> float:
        """Return the sharpness from the sum of the image's pixels and the sum of the measure's terms.

        Of n pixels x with the gradient g and the Laplacian l, these are: VARIANCE: Σx²/Σx - Σx/n; GRADIENT: Σg²/Σx;
        LAPLACIAN: Σl²/Σx; ENTROPY: Σ x ln x / Σx - ln Σx; PAPER_J: -Σ 1/(1 + exp(x/η)) over pixels above 0.
        """
        if total <= 0.0:
            return 0.0
        if self.kind is Sharpness.VARIANCE:
            return terms / total - total / self._n
        if self.kind is Sharpness.PAPER_J:
            return -terms
        if self.kind is Sharpness.ENTROPY:
            return terms / total - math.log(total)
        return terms / total


def smoothing_steps(image: Image, weights: wp.array, out: list[wp.array]) -> Iterator[Step]:
    """Yield the two steps that smooth an image along its rows and columns, as :meth:`SharpnessMeter._steps` does.

    ``out``: buffers of the layout of the image for the result of each step.
    """
    unrolled = image.device.is_cuda and len(weights) <= MOST_UNROLLED
    kernel = smooth_few(len(weights)) if unrolled else smooth(image.width)
    smoothed = image.pixels
    for step, result in zip((1, image.frame.stride), out, strict=True):
        inputs = [smoothed, weights, step, image.frame]
        yield Step(kernel, image.blocks, inputs, result, SMALLEST_SLICE_BLOCKS)
        smoothed = result


def gaussian(sigma: float) -> NDArray[np.float32]:
    """Return the weights of a Gaussian at 0, 1, … 3 sigma pixels; [1] for sigma 0.

    The symmetric kernel of these weights sums to 1.
    """
    sigma = real(sigma, "smoothing", 0.0, LARGEST_SMOOTHING, " px, a standard deviation")
    if sigma < 1e-6:  # the weights of the neighbours are 0 in float32
        return np.ones(1, dtype=np.float32)
    places = np.arange(math.ceil(3.0 * sigma) + 1)
    weights = np.exp(-0.5 * (places / sigma) ** 2)
    total = weights[0] + 2.0 * weights[1:].sum()
    return (weights / total).astype(np.float32)


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
        Image [events per pixel], 0 or above, shape ``(height, width)``, or ``(n, height, width)`` with one or two
        layers: an array of NumPy, Warp, PyTorch, CuPy, JAX or any other library with DLPack.
    kind : Sharpness, optional
        Sharpness measure.
    smoothing : float, optional
        Standard deviation of a Gaussian applied first [px]; 0 disables it.
    device : str or warp.Device, optional
        Device to compute on, by default the image's.

    Returns
    -------
    float
        Sharpness. Higher is sharper; 0 for an image without events.

    Raises
    ------
    AmiwarpError
        If the image has another shape, or holds a value that is negative or not finite.

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
        raise AmiwarpError(
            f"image has shape {image.shape}; expected (height, width) or (2, height, width)"
        )
    stack = image.reshape((-1, *image.shape[-2:]))
    canvas = CanvasShape(stack.shape[2], stack.shape[1], per_polarity=len(stack) == 2)
    if not on_device and not np.all(np.isfinite(stack)):
        raise AmiwarpError(
            f"image of shape {image.shape} holds a value that is not finite; replace it"
        )
    if device is None:
        device = image.device if on_device else "cpu"
    meter = SharpnessMeter(canvas, kind, smoothing=smoothing, device=device)
    meter.image.write(stack.to(meter.device) if on_device else stack)
    value = meter.measure()
    if not meter.finite:
        raise AmiwarpError(
            f"image of shape {image.shape} holds a value that is not finite; replace it"
        )
    lowest = lowest_value(stack) if on_device else float(stack.min())
    if lowest < 0.0:
        raise AmiwarpError(
            f"image of shape {image.shape} holds the negative value {lowest:g}; give numbers of events, for example "
            "one image for each polarity, shape (2, height, width)"
        )
    return value
