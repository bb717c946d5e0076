"""Pictures: read files, convert pixel values to light, and make the maps of log intensity for the simulator."""

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.io.files import input_path

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

LARGEST_MAP = 8192
"""Largest number of texels along a side of a map; a wider scene is resampled more coarsely."""


def read_picture(path: str | Path) -> NDArray[np.float32]:
    """Return the linear luminance of a picture file, shape (height, width); white is 1.

    Raises :class:`AmiwarpError` if the file cannot be read.
    """
    from PIL import Image

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about Pillow's own, larger limits, and about damage that it tolerates
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
        raise AmiwarpError(f"{path} cannot be read as a picture ({what}); give a JPEG, PNG, TIFF ...") from error
    if pixels.dtype.kind == "i":  # Pillow returns 16-bit pictures as int32
        pixels = pixels.astype(np.uint16)
    return linear_luminance(pixels, name=str(path))


def linear_luminance(pixels: NDArray[Any], *, name: str = "picture") -> NDArray[np.float32]:
    """Return the linear luminance of pixel values, shape (height, width) or (height, width, 3 or 4).

    uint8 and uint16 values are sRGB-encoded, as in files. Floating values are linear intensities, with white at 1.
    Raises :class:`AmiwarpError` for other shapes and types, and for values that are negative or not finite.
    """
    pixels = np.asarray(pixels)
    colours = pixels.shape[2] if pixels.ndim == 3 else 0
    if pixels.ndim not in (2, 3) or colours not in (0, 1, 3, 4) or min(pixels.shape[:2]) < 2:
        raise AmiwarpError(f"{name} has shape {pixels.shape}; expected (height, width) or (height, width, 3)")
    if pixels.dtype in (np.uint8, np.uint16):
        top = np.iinfo(pixels.dtype).max
        table = srgb_to_linear(np.arange(top + 1, dtype=np.float32) / top)
    elif pixels.dtype.kind == "f":
        table = None
    else:
        raise AmiwarpError(f"{name} is of type {pixels.dtype}; expected uint8, uint16 (sRGB) or float (linear)")
    light = np.empty(pixels.shape[:2], np.float32)
    rows = max(1, BAND // pixels[0].size)
    for start in range(0, len(pixels), rows):
        part = pixels[start : start + rows]
        values = part.astype(np.float32) if table is None else table[part]
        if colours in (3, 4):
            values = values[..., :3] @ np.array(LUMINANCE, np.float32)
        light[start : start + rows] = values[..., 0] if colours == 1 else values
    if not (np.isfinite(light).all() and light.min() >= 0.0):
        raise AmiwarpError(f"{name} has intensities that are negative or not finite; expected 0 .. 1")
    return light


def srgb_to_linear(value: NDArray[Any]) -> NDArray[np.float32]:
    """Convert sRGB values 0 .. 1 to linear intensity (IEC 61966-2-1)."""
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4).astype(np.float32)


@dataclass(frozen=True, slots=True)
class Placement:
    """Placement of a picture map on the picture plane, which is at z = 1 in front of the camera."""

    width: int
    """Number of texels of the map along x."""
    height: int
    """Number of texels of the map along y."""
    box: tuple[float, float, float, float]
    """Part of the picture that the map shows: left, top, right and bottom edge [picture px]."""
    left: float
    """Coordinate x of the map's left edge on the picture plane."""
    top: float
    """Coordinate y of the map's top edge on the picture plane."""
    pitch: tuple[float, float]
    """Texels per unit of the picture plane, along x and along y."""

    def to_texel(self) -> NDArray[np.float64]:
        """Return the matrix (3, 3) from coordinates on the picture plane to texel coordinates.

        Texel centres have whole coordinates.
        """
        (px, py), left, top = self.pitch, self.left, self.top
        return np.array([[px, 0.0, -left * px - 0.5], [0.0, py, -top * py - 0.5], [0.0, 0.0, 1.0]])


def place_picture(
    size: tuple[int, int],
    view: tuple[float, float, float, float],
    pitch: float,
    *,
    fov: float | None = None,
) -> Placement:
    """Place a picture so that it covers a rectangle of the picture plane.

    ``size`` is the picture's (width, height); ``view`` is the rectangle (left, top, right, bottom) on the plane. The
    picture's aspect ratio is kept, and parts that are never seen are cut off. With ``fov`` [rad], its horizontal
    extent, the picture is centred on the optical axis instead, and mirrored at its edges if the view extends beyond.
    ``pitch``: texels per unit of the plane.
    """
    width, height = size
    left, top, right, bottom = view
    if fov is None:
        scale = max((right - left) / width, (bottom - top) / height)  # plane units per picture pixel
        x0, y0 = (left + right - width * scale) / 2.0, (top + bottom - height * scale) / 2.0
    else:
        scale = 2.0 * np.tan(fov / 2.0) / width
        x0, y0 = -width * scale / 2.0, -height * scale / 2.0
    box = (
        max((left - x0) / scale, 0.0),
        max((top - y0) / scale, 0.0),
        min((right - x0) / scale, float(width)),
        min((bottom - y0) / scale, float(height)),
    )
    if box[2] - box[0] < 1.0 or box[3] - box[1] < 1.0:
        box = (0.0, 0.0, float(width), float(height))  # only mirror images of the picture are seen
    texels = [int(np.clip(round(n * scale * pitch), 2, LARGEST_MAP)) for n in (box[2] - box[0], box[3] - box[1])]
    pitches = (texels[0] / ((box[2] - box[0]) * scale), texels[1] / ((box[3] - box[1]) * scale))
    return Placement(texels[0], texels[1], box, x0 + box[0] * scale, y0 + box[1] * scale, pitches)


def log_map(light: NDArray[np.float32], placement: Placement, blur: float) -> NDArray[np.float32]:
    """Return the log intensity of a picture resampled to a map, shape (height, width).

    Resampling is cubic, with a low-pass filter if the picture is finer than the map. A Gaussian blur of ``blur``
    [texels] follows.
    """
    from PIL import Image
    from scipy.ndimage import gaussian_filter

    size = (placement.width, placement.height)
    image = Image.fromarray(light).resize(size, Image.Resampling.BICUBIC, box=placement.box)
    texels = np.maximum(np.asarray(image, np.float32), 0.0)  # cubic interpolation overshoots at edges
    if blur > 0.0:
        texels = gaussian_filter(texels, blur, mode="mirror", truncate=3.0)
    return np.log(texels + np.float32(DARK))
