"""Pictures and films of the report, and pictures as text in the values of a cell."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError


@dataclass(frozen=True)
class Picture:
    """Picture or film in the report."""

    name: str
    """Name of its file."""
    caption: str
    """What can be seen."""
    frames: list[NDArray[np.uint8]]
    """Picture, or frames of the film, shape ``(height, width)`` or ``(height, width, 3)``."""
    frame_s: float = 0.1
    """Time that a frame of a film is shown [s]."""


MOST_PIXELS = 1 << 22
"""Largest number of pixels of a picture in a cell."""


def encode_picture(picture: NDArray[np.uint8]) -> str:
    """Return a picture as text, for the values of a cell."""
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, format="PNG", optimize=True)
    return base64.b64encode(buffer.getvalue()).decode()


def decode_picture(text: str, what: str = "the picture") -> NDArray[np.uint8]:
    """Return a picture of :func:`encode_picture`. Raises :class:`AmiwarpError` for other texts."""
    from PIL import Image

    try:
        data = io.BytesIO(base64.b64decode(text, validate=True))
        with Image.open(data, formats=["PNG"]) as picture:
            if picture.width * picture.height <= MOST_PIXELS:
                return np.asarray(picture)
    except Exception as error:  # PIL raises many kinds
        raise AmiwarpError(f"{what} cannot be decoded: {error}") from error
    raise AmiwarpError(
        f"{what} has {picture.width}x{picture.height} px; expected at most {MOST_PIXELS:,} pixels"
    )


def check_pictures(texts: Sequence[str], axes: int, what: str) -> None:
    """Check that texts are pictures of 8-bit values, all of one shape of ``axes`` axes."""
    shapes = set()
    for text in texts:
        picture = decode_picture(text, what)
        shapes.add((picture.shape, picture.dtype.str))
    if len(shapes) > 1 or any(len(shape) != axes or kind != "|u1" for shape, kind in shapes):
        raise AmiwarpError(
            f"{what} has pictures of shapes and types {shapes}; expected one shape of {axes} axes, 8 bit"
        )
