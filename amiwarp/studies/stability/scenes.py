"""Scenes of the stability study, drawn from a seed: from a dense texture to a blank wall."""

import enum
import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

DARK = 0.2
BRIGHT = 1.0
"""Smallest and largest luminance of the scenes, relative to white."""


class SceneKind(enum.StrEnum):
    """Kind of scene of the stability study."""

    TEXTURE = "dense texture"
    EDGES = "sparse edges"
    ONE_DIRECTION = "one edge direction"
    REPEATING = "repeating texture"
    PRINT = "print"
    LINES = "few thin lines"
    BLANK = "blank wall"


def draw(
    kind: SceneKind, width: int, height: int, *, period: float, seed: int
) -> NDArray[np.float32]:
    """Draw a scene of a kind, and return its linear luminance, shape ``(height, width)``.

    ``period`` is the period of the repeating texture [texels].
    """
    rng = np.random.default_rng([seed, 0x5CE7E])
    if kind is SceneKind.TEXTURE:
        return leaves(rng, width, height)
    if kind is SceneKind.EDGES:
        return polygons(rng, width, height)
    if kind is SceneKind.PRINT:
        return printed(rng, width, height)
    if kind is SceneKind.LINES:
        return thin_lines(rng, width, height)
    if kind is SceneKind.BLANK:
        return np.full((height, width), 0.5, np.float32)
    if kind is SceneKind.REPEATING:
        return repeating(width, height, period)
    return one_direction(rng, width, height)


def repeating(width: int, height: int, period: float) -> NDArray[np.float32]:
    """Return waves along both axes, with a period [texels]."""
    rows, columns = np.mgrid[:height, :width].astype(np.float64)
    across = np.cos(2.0 * np.pi * columns / period)
    down = np.cos(2.0 * np.pi * rows / period)
    return _levels(0.5 + 0.25 * (across + down))


def one_direction(rng: np.random.Generator, width: int, height: int) -> NDArray[np.float32]:
    """Return parallel stripes of random widths and shades."""
    rows, columns = np.mgrid[:height, :width].astype(np.float64)
    angle = rng.uniform(0.0, np.pi)
    across = columns * math.cos(angle) + rows * math.sin(angle)
    count = max(6, (width + height) // 40)
    edges = np.sort(rng.uniform(across.min(), across.max(), count))
    shades = rng.uniform(0.0, 1.0, count + 1)
    stripe = np.searchsorted(edges, across)
    return _levels(shades[stripe])


def leaves(
    rng: np.random.Generator, width: int, height: int, count: int = 4000
) -> NDArray[np.float32]:
    """Return discs that occlude each other, with sizes by a power law: the statistics of natural images.

    Lee, Mumford, Huang, "Occlusion models for natural images", IJCV 2001.
    """
    largest = height / 4.0
    smallest = 3.0
    share = rng.uniform(size=count)
    # Density proportional to r^-3
    radii = 1.0 / np.sqrt(share * (smallest**-2 - largest**-2) + largest**-2)
    middles = rng.uniform(0.0, 1.0, (count, 2)) * (height, width)
    shades = rng.uniform(size=count)
    picture = np.full((height, width), 0.5)
    for radius, (y, x), shade in zip(radii, middles, shades, strict=True):
        _disc(picture, y, x, radius, shade)
    return _levels(picture)


def _disc(picture: NDArray[np.float64], y: float, x: float, radius: float, value: float) -> None:
    """Draw a disc of one luminance into a picture."""
    top = max(0, int(y - radius))
    bottom = int(y + radius) + 2
    left = max(0, int(x - radius))
    right = int(x + radius) + 2
    part, rows, columns = _part(picture, top, bottom, left, right)
    inside = (rows - y) ** 2 + (columns - x) ** 2 <= radius**2
    part[inside] = value


def _part(
    picture: NDArray[np.float64], top: int, bottom: int, left: int, right: int
) -> tuple[NDArray[np.float64], NDArray[np.intp], NDArray[np.intp]]:
    """Return a view of a part of a picture, which ends at its border, and the rows and columns of its pixels."""
    part = picture[top:bottom, left:right]
    height, width = part.shape
    rows, columns = np.mgrid[top : top + height, left : left + width]
    return part, rows, columns


def polygons(
    rng: np.random.Generator, width: int, height: int, count: int = 8
) -> NDArray[np.float32]:
    """Return a few triangles on a uniform background."""
    picture = np.full((height, width), 0.5)
    rows, columns = np.mgrid[:height, :width]
    for value in rng.choice([0.1, 0.9], count):
        middle = rng.uniform(0.1, 0.9, 2) * (width, height)
        radius = rng.uniform(0.1, 0.25) * height
        corners = middle + radius * _triangle(rng.uniform(0.0, 2.0 * np.pi))
        next_corners = np.roll(corners, -1, axis=0)

        # A pixel is inside if it lies on the same side of all three edges.
        inside = np.ones(picture.shape, np.bool_)
        for (x0, y0), (x1, y1) in zip(corners, next_corners, strict=True):
            inside &= (x1 - x0) * (rows - y0) - (y1 - y0) * (columns - x0) >= 0.0
        picture[inside] = value
    return _levels(picture)


def printed(rng: np.random.Generator, width: int, height: int) -> NDArray[np.float32]:
    """Return a page of print: lines of signs on white, each of two to four straight strokes."""
    page = np.ones((height, width))
    size = max(8, round(height / 30))
    for top in range(size, height - size, 2 * size):
        left = size
        while left < width - 2 * size:
            if rng.uniform() < 0.15:  # space between two words
                left += size
                continue
            strokes = rng.integers(2, 5)
            for x0, y0, x1, y1 in rng.uniform(0.0, size, (strokes, 4)):
                start = (left + 0.6 * x0, top + y0)
                end = (left + 0.6 * x1, top + y1)
                _line(page, start, end, half_width=0.1 * size, value=0.0)
            left += round(0.8 * size)
    return _levels(page)


def thin_lines(
    rng: np.random.Generator, width: int, height: int, count: int = 10
) -> NDArray[np.float32]:
    """Return short thin lines, brighter or darker than their uniform background."""
    picture = np.full((height, width), 0.5)
    for value in rng.choice([0.15, 0.85], count):
        middle = rng.uniform(0.1, 0.9, 2) * (width, height)
        angle = rng.uniform(0.0, np.pi)
        direction = np.array([math.cos(angle), math.sin(angle)])
        half = 0.5 * rng.uniform(0.1, 0.3) * height * direction
        half_width = rng.uniform(1.0, 2.5)
        _line(picture, middle - half, middle + half, half_width, value)
    return _levels(picture)


def _line(
    picture: NDArray[np.float64], start: ArrayLike, end: ArrayLike, half_width: float, value: float
) -> None:
    """Draw a straight line of one luminance into a picture; ends are ``(x, y)`` [texels]."""
    ends = np.array([start, end])
    left, top = np.maximum(np.floor(ends.min(axis=0) - half_width).astype(int), 0)
    right, bottom = np.ceil(ends.max(axis=0) + half_width).astype(int) + 1
    part, rows, columns = _part(picture, top, bottom, left, right)

    # The point of the line that is nearest to each pixel, as a share of the way from start to end
    across = columns - ends[0, 0]
    down = rows - ends[0, 1]
    along = ends[1] - ends[0]
    square = max(float(along @ along), 1e-9)
    share = np.clip((across * along[0] + down * along[1]) / square, 0.0, 1.0)

    distance = np.hypot(across - share * along[0], down - share * along[1])
    part[distance <= half_width] = value


def _triangle(angle: float) -> NDArray[np.float64]:
    """Return the corners of a unit triangle."""
    angles = angle + np.arange(3) * (2.0 * np.pi / 3)
    return np.stack([np.cos(angles), np.sin(angles)], axis=1)


def _levels(share: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return the luminance at shares 0 .. 1 of the scenes' range, on a logarithmic scale."""
    luminance = DARK * (BRIGHT / DARK) ** np.clip(share, 0.0, 1.0)
    return luminance.astype(np.float32)
