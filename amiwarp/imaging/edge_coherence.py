"""How much the edges of an image run in one direction."""

from __future__ import annotations

import math
from typing import Any

import warp as wp

from amiwarp.imaging.canvas import Image
from amiwarp.imaging.sharpness import gaussian, smoothing_steps
from amiwarp.kernels.edge_directions import SEGMENT, find_largest, sum_directions
from amiwarp.kernels.launch import launch

EDGE_SMOOTHING_PX = 1.5
"""Standard deviation of the Gaussian that smooths an image before its gradients are computed [px]."""
LEAST_GRADIENT_SHARE = 0.1
"""Share of the largest squared gradient above which a gradient counts."""
FEW_SEGMENTS = 512
"""Smallest number of segments for which a second CPU thread is used."""


def edge_coherence(image: Image, inset: int) -> float:
    """Return the coherence of an image's edge directions, |Σ g² e^{2iφ}| / Σ g² over gradients (g, φ), 0 to 1.

    It is 1 if all edges are parallel. The gradients are taken of the sum of all layers. Noise has no direction and
    lowers the coherence, so weak gradients are left out, and so are pixels within ``inset`` of the image's border.
    """
    device = image.device
    layers, rows, columns = image.shape
    weights = wp.array(gaussian(EDGE_SMOOTHING_PX), dtype=float, device=device)
    along_rows = wp.zeros_like(image.pixels)
    smoothed = wp.zeros_like(image.pixels)
    for step in smoothing_steps(image, weights, [along_rows, smoothed]):
        launch(
            step.kernel,
            step.threads,
            step.inputs,
            [step.output],
            device=device,
            smallest=step.smallest,
        )

    inner_rows = max(0, rows - 2 * inset)
    inner_columns = max(0, columns - 2 * inset)
    segments = inner_rows * math.ceil(inner_columns / int(SEGMENT))
    largest: Any = wp.zeros(max(1, segments), dtype=float, device=device)
    inputs = [smoothed, image.frame, layers, inset]
    launch(find_largest, segments, inputs, [largest], device=device, smallest=FEW_SEGMENTS)

    limit = LEAST_GRADIENT_SHARE * float(largest.numpy().max())
    sums: Any = wp.zeros(max(1, segments), dtype=wp.vec3d, device=device)
    inputs.append(limit)
    launch(sum_directions, segments, inputs, [sums], device=device, smallest=FEW_SEGMENTS)
    total, x, y = sums.numpy().sum(axis=0).tolist()
    if not total > 0.0:
        return 0.0
    return math.hypot(x, y) / total
