"""Colours of a world, beside the luminance that event cameras see: red, green and blue relative to the luminance."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.simulation.picture_light import (
    BAND,
    LUMINANCE,
    linear_luminance,
    read_pixels,
    srgb_to_linear,
)
from amiwarp.validation import array

MOST_COLOURED = 1 << 24
"""Largest picture whose colours are kept [px]. They take three times the memory of its luminance."""
LARGEST_DEVIATION = 1e-3
"""Largest deviation of the luminance of a relative colour from 1."""


def split_colours(colours: NDArray[Any]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the luminance of linear red, green and blue, shape (..., 3), and the colours relative to it.

    The relative colour of black is white.
    """
    light = colours @ np.array(LUMINANCE)
    is_black = light <= 0.0
    relative = colours / np.where(is_black, 1.0, light)[..., None]
    relative = np.where(is_black[..., None], 1.0, relative)
    return light.astype(np.float32), relative.astype(np.float32)


def read_colours(path: Path) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
    """Return the linear luminance of a picture file, and its colours relative to it.

    The colours are None for a grey picture, and for one of more than :data:`MOST_COLOURED` pixels.
    Raises :class:`AmiwarpError` if the file cannot be read.
    """
    pixels = read_pixels(path)
    light = linear_luminance(pixels, name=str(path))
    if pixels.ndim == 2 or light.size > MOST_COLOURED:
        return light, None
    if pixels.dtype == np.float32:
        _, relative = split_colours(pixels)
        return light, None if is_grey(relative) else relative
    if pixels.dtype != np.uint8:
        return light, None
    if has_no_colour(pixels):
        return light, None
    return light, colours_of_pixels(pixels)


def has_no_colour(pixels: NDArray[np.uint8]) -> bool:
    """Return whether red, green and blue of all pixels are equal. Their shape is (height, width, 3)."""
    red = pixels[..., 0]
    return np.array_equal(red, pixels[..., 1]) and np.array_equal(red, pixels[..., 2])


def colours_of_pixels(
    pixels: NDArray[np.uint8], tint: NDArray[np.float32] | None = None
) -> NDArray[np.float32]:
    """Return the relative colours of sRGB values, shape (height, width, 3), multiplied by a relative colour, (3,)."""
    table = srgb_to_linear(np.arange(256, dtype=np.float32) / 255.0)
    colour = np.empty(pixels.shape, np.float32)
    rows = max(1, BAND // pixels[0].size)
    # In bands, because a large picture as a whole would need several times its memory
    for start in range(0, len(pixels), rows):
        linear = table[pixels[start : start + rows]]
        if tint is not None:
            linear = linear * tint
        _, colour[start : start + rows] = split_colours(linear)
    return colour


def relative_colour(colour: tuple[float, float, float], what: str) -> NDArray[np.float32]:
    """Return linear red, green and blue of any brightness relative to their luminance, shape (3,).

    Raises :class:`AmiwarpError` for black and for negative values.
    """
    values = np.array(colour)
    if values.min() < 0.0 or not values.max() > 0.0:
        raise AmiwarpError(
            f"{what} is {list(colour)}; give linear red, green and blue, at least one of them above 0"
        )
    _, relative = split_colours(values)
    return relative


def is_grey(relative: NDArray[np.float32]) -> bool:
    """Return whether relative colours are all grey."""
    return bool(np.abs(relative - 1.0).max() < LARGEST_DEVIATION)


def checked_colour(
    colour: ArrayLike, shapes: tuple[tuple[int, ...], ...], what: str
) -> NDArray[np.float32]:
    """Return relative colours of one of the allowed ``shapes`` as float32.

    Raises :class:`AmiwarpError` for other shapes, and for colours whose luminance is not 1.
    """
    with np.errstate(over="ignore"):  # infinity is refused
        values = array(colour, what).astype(np.float32)
    if values.shape not in shapes or not (np.isfinite(values).all() and values.min() >= 0.0):
        allowed = " or ".join(str(shape) for shape in shapes)
        raise AmiwarpError(f"{what} has shape {values.shape}; give values >= 0, {allowed}")
    light = values @ np.array(LUMINANCE, np.float32)
    worst = float(np.abs(light - 1.0).max())
    if worst > LARGEST_DEVIATION:
        raise AmiwarpError(
            f"{what} has a luminance that differs from 1 by {worst:.3g}; divide red, green and blue by "
            f"{' + '.join(f'{w:g} {c}' for w, c in zip(LUMINANCE, 'RGB', strict=True))}"
        )
    return values


def in_channel(values: NDArray[Any], colour: Any, channel: int | None) -> NDArray[Any]:
    """Return luminances in a colour channel (0, 1, 2: red, green, blue); for None as they are.

    ``colour``: relative colours, shape (3,), or the shape of ``values`` with a last axis of 3; None for grey.
    """
    if channel is None or colour is None:
        return values
    return np.asarray(values * np.asarray(colour)[..., channel])
