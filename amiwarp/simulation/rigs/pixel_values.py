"""Pixel values of a simulated camera's frames: noise, clipping, encoding and rounding of light."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.simulation.choices import FrameEncoding
from amiwarp.simulation.picture_light import linear_to_srgb
from amiwarp.simulation.rigs.cameras import RigFrameCamera


def pixel_values(
    frames: RigFrameCamera, light: NDArray[np.float32], rng: np.random.Generator
) -> NDArray[Any]:
    """Return the values of a frame as its camera gives them, uint8 or uint16, of the shape of ``light``.

    ``light``: luminance of the pixels.
    """
    share = light.astype(np.float64) / frames.white
    if frames.electrons is not None:
        # More electrons than at white are clipped below in any case.
        collected = rng.poisson(frames.electrons * np.minimum(share, 2.0))
        read = collected + frames.read_noise * rng.standard_normal(share.shape)
        share = read / frames.electrons
    share = np.clip(share, 0.0, 1.0)
    if frames.encoding is FrameEncoding.SRGB:
        share = linear_to_srgb(share)
    dtype = np.uint8 if frames.bits == 8 else np.uint16
    return np.rint(share * np.iinfo(dtype).max).astype(dtype)
