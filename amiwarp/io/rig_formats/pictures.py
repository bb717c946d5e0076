"""Frames as pictures of other programs: PNG files, and grey levels of 8 bits."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.io.truth_files import encode_png16


def png_bytes(image: NDArray[Any]) -> bytes:
    """Encode a grey or RGB image of 8 or 16 bits as PNG."""
    if image.ndim == 3 and image.dtype == np.uint16:
        return encode_png16(image)
    from PIL import Image

    # Pillow does not write to the file itself, because it may not notice a full disk.
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, format="PNG")
    return buffer.getvalue()


def eight_bits(image: NDArray[Any]) -> NDArray[np.uint8]:
    """Return an image with 8 bits: of 16 bits, the upper ones."""
    if image.dtype == np.uint16:
        return (image >> 8).astype(np.uint8)
    return image


def grey(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the luma of an RGB image of 8 bits (ITU-R BT.601); grey images are returned as they are."""
    if image.ndim == 2:
        return image
    from PIL import Image

    return np.asarray(Image.fromarray(image).convert("L"))
