"""Linear luminance of pictures: pixel values as light, and picture files."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.io.inputs import input_path
from amiwarp.simulation.radiance_pictures import read_radiance

LUMINANCE = (0.2126, 0.7152, 0.0722)
"""Weights of linear red, green and blue in the luminance (ITU-R BT.709)."""

DARK = 0.02
"""Intensity added to every picture before the logarithm, relative to white.

It stands for stray light and dark current, and limits the contrast of shadows.
"""

MOST_PIXELS = 1 << 26
"""Largest picture that is read [px]: 67 megapixels. A small file may unpack to a huge picture."""

BAND = 1 << 24
"""Number of pixel values that are converted to light at a time."""

PICTURE_FORMATS = ("PNG", "JPEG", "BMP", "TIFF", "WEBP", "PPM", "GIF")
"""Formats of picture files that are read, by Pillow's names. Others are excluded because some of them run external
programs."""


def read_picture(path: str | Path) -> NDArray[np.float32]:
    """Return the linear luminance of a picture file, shape (height, width); white is 1.

    Raises :class:`AmiwarpError` if the file cannot be read.
    """
    return linear_luminance(read_pixels(path), name=str(path))


def read_pixels(path: str | Path) -> NDArray[Any]:
    """Return the pixel values of a picture file, as :func:`linear_luminance` takes them.

    Files that end in ``.hdr`` hold linear values of any size. Raises :class:`AmiwarpError` if the file cannot be read.
    """
    if Path(path).suffix.lower() == ".hdr":
        return read_radiance(Path(path), MOST_PIXELS)
    from PIL import Image

    try:
        with warnings.catch_warnings():
            # About Pillow's own, larger limits, and about damage that it tolerates
            warnings.simplefilter("ignore")
            with Image.open(input_path(path), formats=PICTURE_FORMATS) as image:
                if image.width * image.height > MOST_PIXELS:
                    raise ValueError(
                        f"{image.width}x{image.height} is over {MOST_PIXELS} pixels; make the picture smaller"
                    )
                wide = image.mode.startswith(("I", "F"))
                pixels = np.asarray(image if wide else image.convert("RGB"))
    except AmiwarpError:
        raise
    except Exception as error:  # Pillow raises errors of many types for damaged files
        what = " ".join(str(error).split()) or type(error).__name__
        raise AmiwarpError(
            f"{path} cannot be read as a picture ({what}); give a JPEG, PNG, TIFF ...",
            ErrorCode.FORMAT_UNKNOWN,
        ) from error
    if pixels.dtype.kind == "i":  # Pillow returns 16-bit pictures as int32
        if pixels.min() < 0 or pixels.max() > 0xFFFF:
            raise AmiwarpError(
                f"{path} has values from {pixels.min()} to {pixels.max()}; save it with 16 bits, 0 to 65535"
            )
        pixels = pixels.astype(np.uint16)
    return pixels


def linear_luminance(pixels: NDArray[Any], *, name: str = "picture") -> NDArray[np.float32]:
    """Return the linear luminance of pixel values, shape (height, width) or (height, width, 3 or 4).

    uint8 and uint16 values are sRGB-encoded, as in files. Floating values are linear intensities, with white at 1.
    Raises :class:`AmiwarpError` for other shapes and types, and for values that are negative or not finite.
    """
    pixels = np.asarray(pixels)
    pixels = pixels.astype(pixels.dtype.newbyteorder("="), copy=False)
    colours = pixels.shape[2] if pixels.ndim == 3 else 0
    if pixels.ndim not in (2, 3) or colours not in (0, 1, 3, 4) or min(pixels.shape[:2]) < 2:
        raise AmiwarpError(
            f"{name} has shape {pixels.shape}; expected (height, width) or (height, width, 3)"
        )
    if pixels.dtype in (np.uint8, np.uint16):
        top = np.iinfo(pixels.dtype).max
        table = srgb_to_linear(np.arange(top + 1, dtype=np.float32) / top)
    elif pixels.dtype.kind == "f":
        table = None
    else:
        raise AmiwarpError(
            f"{name} is of type {pixels.dtype}; expected uint8, uint16 (sRGB) or float (linear)"
        )
    light = np.empty(pixels.shape[:2], np.float32)
    rows = max(1, BAND // pixels[0].size)
    for start in range(0, len(pixels), rows):
        part = pixels[start : start + rows]
        values = part.astype(np.float32) if table is None else table[part]
        if colours in (3, 4):
            values = values[..., :3] @ np.array(LUMINANCE, np.float32)
        light[start : start + rows] = values[..., 0] if colours == 1 else values
    if not (np.isfinite(light).all() and light.min() >= 0.0):
        raise AmiwarpError(
            f"{name} has intensities that are negative or not finite; expected 0 .. 1"
        )
    return light


def srgb_to_linear(value: NDArray[Any]) -> NDArray[np.float32]:
    """Convert sRGB values 0 .. 1 to linear intensity (IEC 61966-2-1)."""
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4).astype(
        np.float32
    )


def linear_to_srgb(light: NDArray[np.float64]) -> NDArray[np.float64]:
    """Convert linear intensity 0 .. 1 to sRGB values 0 .. 1 (IEC 61966-2-1)."""
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1.0 / 2.4) - 0.055)
