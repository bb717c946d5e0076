"""How much the edges in an image run in one direction."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import warp as wp

from amiwarp.imaging.sharpness_costs import gaussian, smoothing_steps
from amiwarp.kernels.edge_directions import SEGMENT, find_largest, sum_directions
from amiwarp.kernels.launch import launch

if TYPE_CHECKING:
    from amiwarp.imaging.device_image import Image

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
