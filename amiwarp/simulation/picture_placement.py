"""Place of a picture in front of the camera, and its log intensity on a grid of texels there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from amiwarp.simulation.picture_light import DARK

LARGEST_MAP = 8192
"""Largest number of texels along a side of a map; a wider scene is resampled more coarsely."""


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
        px, py = self.pitch
        return np.array(
            [
                [px, 0.0, -self.left * px - 0.5],
                [0.0, py, -self.top * py - 0.5],
                [0.0, 0.0, 1.0],
            ]
        )


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
        # Plane units per picture pixel
        scale = max((right - left) / width, (bottom - top) / height)
        x0 = (left + right - width * scale) / 2.0
        y0 = (top + bottom - height * scale) / 2.0
    else:
        scale = 2.0 * np.tan(fov / 2.0) / width
        x0 = -width * scale / 2.0
        y0 = -height * scale / 2.0

    # The part of the picture that is seen [picture px]
    first_x = max((left - x0) / scale, 0.0)
    first_y = max((top - y0) / scale, 0.0)
    last_x = min((right - x0) / scale, float(width))
    last_y = min((bottom - y0) / scale, float(height))
    if last_x - first_x < 1.0 or last_y - first_y < 1.0:
        # Only mirror images of the picture are seen: take all of it.
        first_x = 0.0
        first_y = 0.0
        last_x = float(width)
        last_y = float(height)

    # Its size on the picture plane, and the number of texels
    across = (last_x - first_x) * scale
    down = (last_y - first_y) * scale
    columns = int(np.clip(round(across * pitch), 2, LARGEST_MAP))
    rows = int(np.clip(round(down * pitch), 2, LARGEST_MAP))
    return Placement(
        columns,
        rows,
        box=(first_x, first_y, last_x, last_y),
        left=x0 + first_x * scale,
        top=y0 + first_y * scale,
        pitch=(columns / across, rows / down),
    )


def log_map(light: NDArray[np.float32], placement: Placement, blur: float) -> NDArray[np.float32]:
    """Return the log intensity of a picture resampled to a map, shape (height, width).

    Resampling is cubic, with a low-pass filter if the picture is finer than the map. A Gaussian blur of ``blur``
    [texels] follows.
    """
    from PIL import Image
    from scipy.ndimage import gaussian_filter

    size = (placement.width, placement.height)
    image = Image.fromarray(light).resize(size, Image.Resampling.BICUBIC, box=placement.box)
    # Cubic interpolation overshoots at edges
    texels = np.maximum(np.asarray(image, np.float32), 0.0)
    if blur > 0.0:
        texels = gaussian_filter(texels, blur, mode="mirror", truncate=3.0)
    return np.log(texels + np.float32(DARK))
