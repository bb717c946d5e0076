"""Colours of the built-in worlds. They change no luminance, and so no event."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from amiwarp.simulation.worlds.colours import relative_colour, split_colours

TINTS = {
    "floor": (0.62, 0.46, 0.30),
    "ceiling": (0.97, 0.96, 0.92),
    "wall": (0.78, 0.74, 0.62),
    "table": (0.55, 0.38, 0.22),
    "desk": (0.55, 0.38, 0.22),
    "chair": (0.50, 0.33, 0.20),
    "bookcase": (0.58, 0.42, 0.26),
    "sofa": (0.30, 0.42, 0.68),
    "cushion": (0.75, 0.35, 0.25),
    "rug": (0.62, 0.28, 0.26),
    "plant": (0.22, 0.50, 0.16),
    "tree": (0.22, 0.48, 0.16),
    "vessel": (0.66, 0.44, 0.32),
    "globe": (0.25, 0.45, 0.72),
    "lamp": (0.95, 0.80, 0.55),
    "box": (0.80, 0.62, 0.20),
    "ball": (0.85, 0.36, 0.14),
    "person": (0.72, 0.48, 0.36),
    "house": (0.70, 0.46, 0.36),
    "roof": (0.62, 0.26, 0.18),
    "door": (0.30, 0.48, 0.36),
    "car": (0.70, 0.16, 0.14),
    "page": (0.96, 0.95, 0.90),
}
"""Linear red, green and blue of bodies by category. Others are grey."""
MANY_COLOURED = ("book", "poster")
"""Categories or names of bodies whose shades have different colours."""
SKY = (0.50, 0.68, 1.0)
"""Linear red, green and blue of a clear sky."""


def colour_of(
    name: str, category: str, texture: NDArray[np.float32] | None
) -> NDArray[np.float32] | None:
    """Return the relative colour of a body, as :attr:`amiwarp.Material.colour`; None for grey."""
    if texture is not None and (category in MANY_COLOURED or name in MANY_COLOURED):
        return by_shade(texture)
    tint = TINTS.get(category)
    return None if tint is None else relative_colour(tint, f"colour of {category}")


def by_shade(texture: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return relative colours of a texture whose shades each have a hue, and black and white none.

    The shape is (height, width, 3).
    """
    # Three turns of the hue from the darkest to the brightest shade
    hue = 3.0 * 2.0 * np.pi * np.log(texture / 0.03) / np.log(0.95 / 0.03)
    saturation = (
        0.55 * np.clip((texture - 0.05) / 0.1, 0.0, 1.0) * np.clip((0.85 - texture) / 0.1, 0.0, 1.0)
    )
    thirds = 2.0 * np.pi / 3.0 * np.arange(3)
    colours = 1.0 + saturation[..., None] * np.cos(hue[..., None] - thirds)
    _, relative = split_colours(colours)
    return relative
