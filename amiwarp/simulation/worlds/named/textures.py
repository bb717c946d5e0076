"""Generated textures for the built-in worlds: linear reflectances from 0.03 to 0.95."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
from numpy.typing import NDArray

DARKEST, BRIGHTEST = 0.03, 0.95
"""Range of the reflectances. The natural logarithm of their ratio is 3.5."""
TEXT = (
    "each pixel reports changes of log intensity by itself and at once so a camera that rests sees only what moves a "
    "prism before the lens turns and moves the whole picture on a circle then every edge fires whatever its direction "
    "and the known angle takes the motion out again"
)
"""Words from which the printed pages are drawn at random."""

Texture = NDArray[np.float32]


def clipped(values: NDArray[Any]) -> Texture:
    """Return values clipped to the range of the reflectances."""
    return np.clip(values, DARKEST, BRIGHTEST).astype(np.float32)


def fractal(rng: np.random.Generator, height: int, width: int, *, slope: float = 1.2) -> NDArray[np.float64]:
    """Return periodic noise of mean 0 and standard deviation 1, whose amplitude spectrum is frequency ** -``slope``."""
    fy, fx = np.fft.fftfreq(height)[:, None] * height, np.fft.rfftfreq(width) * width
    radius = np.hypot(fy, fx)
    radius[0, 0] = np.inf
    spectrum = np.fft.rfft2(rng.standard_normal((height, width))) / radius**slope
    noise = np.fft.irfft2(spectrum, s=(height, width))
    return np.asarray(noise / noise.std())


def plaster(rng: np.random.Generator, mean: float = 0.5, contrast: float = 0.35, size: int = 512) -> Texture:
    """Return fractal noise about ``mean``. ``contrast``: standard deviation of the natural log reflectance."""
    return clipped(mean * np.exp(contrast * fractal(rng, size, size)))


def weathered(rng: np.random.Generator, values: NDArray[Any], contrast: float = 0.15) -> Texture:
    """Return reflectances multiplied by fractal noise, so that no area is blank.

    ``contrast``: standard deviation of the natural log of the noise.
    """
    return clipped(values * np.exp(contrast * fractal(rng, *values.shape, slope=1.0)))


def checkerboard(squares: int, *, size: int = 256, dark: float = 0.05, bright: float = 0.9) -> Texture:
    """Return a checkerboard with ``squares`` squares along each side. With an even number the
    texture repeats without a seam."""
    k = np.arange(size) * squares // size
    return clipped(np.where((k[:, None] + k) % 2, dark, bright))


def grating(
    angle_deg: float, cycles: float = 12.0, *, size: int = 256, dark: float = 0.05, bright: float = 0.9
) -> Texture:
    """Return a grating of ``cycles`` dark and bright stripes in a white frame.

    The brightness varies along the direction ``angle_deg``, counter-clockwise from the right.
    """
    v, u = np.mgrid[size:0:-1, 0:size] / size
    phase = np.cos(np.radians(angle_deg)) * u + np.sin(np.radians(angle_deg)) * v
    stripes = np.clip(3.0 * np.sin(2.0 * np.pi * cycles * phase), -1.0, 1.0)
    values = dark + (bright - dark) * (stripes + 1.0) / 2.0
    rim = size // 24
    values[:rim] = values[-rim:] = values[:, :rim] = values[:, -rim:] = bright
    return clipped(values)


def star(spokes: int = 24, *, size: int = 384, dark: float = 0.05, bright: float = 0.9) -> Texture:
    """Return a Siemens star, which has edges of all directions and scales."""
    v, u = (np.mgrid[0:size, 0:size] + 0.5) / size - 0.5
    radius = np.hypot(u, v)
    wave = np.clip(0.15 * size * radius * np.sin(spokes * np.arctan2(v, u)), -1.0, 1.0)
    return clipped(np.where(radius < 0.47, dark + (bright - dark) * (wave + 1.0) / 2.0, bright))


def text_page(
    rng: np.random.Generator, *, width: int = 384, height: int = 512, letter: int = 18, ink: float = 0.05
) -> Texture:
    """Return a printed page: a heading and lines of random words. ``letter``: font size [texels]."""
    from PIL import Image, ImageDraw, ImageFont

    page = Image.new("F", (width, height), 0.88)
    words, draw, margin = TEXT.split(), ImageDraw.Draw(page), width // 14
    y, size = margin, 2 * letter
    while y < height - margin - letter:
        font = ImageFont.load_default(size)
        line = str(rng.choice(words))
        while draw.textlength(longer := f"{line} {rng.choice(words)}", font=font) < width - 2 * margin:
            line = longer
        if rng.uniform() < 0.93 or size > letter:
            draw.text((margin, y), line, fill=ink, font=font)
        y += round(1.35 * size)
        size = letter
    return weathered(rng, np.asarray(page), 0.06)


def poster(rng: np.random.Generator, *, size: int = 384) -> Texture:
    """Return a poster of overlapping discs, triangles and bars of many shades."""
    from PIL import Image, ImageDraw

    page = Image.new("F", (size, size), float(rng.uniform(0.3, 0.9)))
    draw = ImageDraw.Draw(page)
    for k in range(36):
        shade = float(np.exp(rng.uniform(np.log(0.04), np.log(0.95))))
        x, y = rng.uniform(0, size, 2)
        reach = float(rng.uniform(0.03, 0.3 if k < 10 else 0.12) * size)
        turn = rng.uniform(0, 2 * np.pi)
        if k % 3 == 0:
            draw.ellipse((x - reach, y - reach, x + reach, y + reach), fill=shade)
        else:
            corners = turn + np.arange(3) * 2.094 if k % 3 == 1 else turn + np.array([0.2, 2.94, 3.34, 6.08])
            draw.polygon([(x + reach * np.cos(a), y + reach * np.sin(a)) for a in corners], fill=shade)
    return weathered(rng, np.asarray(page), 0.1)


def _cells(
    rng: np.random.Generator, rows: int, size: int, *, columns: int, joint: int, shift: bool
) -> NDArray[np.float64]:
    """Return random shades of a grid of cells, for bricks and tiles, and NaN in the joints between the cells.

    ``joint``: width of a joint [texels]; ``shift``: whether odd rows are shifted by half a cell.
    """
    y, x = np.mgrid[0:size, 0:size]
    row = y * rows // size
    x = (x + np.where(shift & (row % 2 == 1), size // columns // 2, 0)) % size
    shade = rng.standard_normal((rows, columns))[row, x * columns // size]
    edge = (y % (size // rows) < joint) | (x % (size // columns) < joint)
    return np.where(edge, np.nan, shade)


def bricks(rng: np.random.Generator, *, mean: float = 0.25, joint: float = 0.55, size: int = 512) -> Texture:
    """Return a brick wall of 16 rows with 8 bricks each. ``mean``, ``joint``: reflectance of bricks and of joints."""
    shade = _cells(rng, 16, size, columns=8, joint=3, shift=True)
    return weathered(rng, np.where(np.isnan(shade), joint, mean * np.exp(0.3 * np.nan_to_num(shade))), 0.25)


def tiles(
    rng: np.random.Generator, *, mean: float = 0.5, joint: float = 0.12, count: int = 8, size: int = 512
) -> Texture:
    """Return ``count`` by ``count`` square tiles. ``mean``, ``joint``: reflectance of tiles and of joints."""
    shade = _cells(rng, count, size, columns=count, joint=4, shift=False)
    return weathered(rng, np.where(np.isnan(shade), joint, mean * np.exp(0.25 * np.nan_to_num(shade))), 0.25)


def wood(rng: np.random.Generator, *, mean: float = 0.3, boards: int = 8, size: int = 512) -> Texture:
    """Return horizontal boards with grain."""
    y = np.arange(size)[:, None]
    board = y * boards // size
    fibre = fractal(rng, size, size, slope=0.9)
    smooth = np.fft.rfft(fibre, axis=1) * np.exp(-((np.arange(size // 2 + 1) / 10.0) ** 2))
    grain = np.fft.irfft(smooth, n=size, axis=1)
    tone = rng.standard_normal(boards)[board]
    values = mean * np.exp(0.35 * grain / grain.std() + 0.25 * tone)
    seam = y % (size // boards) < 3
    return weathered(rng, np.where(seam, 0.25 * values, values), 0.12)


def plaid(rng: np.random.Generator, *, size: int = 256, stripes: int = 10) -> Texture:
    """Return a fabric of crossed stripes."""

    def bands() -> NDArray[np.float64]:
        """Return the shades of parallel stripes, shape (size,)."""
        return np.repeat(rng.uniform(0.25, 1.0, stripes), -(-size // stripes))[:size]

    return weathered(rng, 0.95 * bands()[:, None] * bands()[None, :], 0.2)


def book_spines(rng: np.random.Generator, *, books: int = 16, size: int = 512) -> Texture:
    """Return a row of book spines with bands and titles."""
    values = np.empty((size, size))
    edges = np.linspace(0, size, books + 1).astype(int)
    for a, b in itertools.pairwise(edges):
        shade = float(np.exp(rng.uniform(np.log(0.05), np.log(0.85))))
        values[:, a:b] = shade
        mark = 0.85 if shade < 0.3 else 0.05
        for start in rng.uniform(0.05, 0.9, 3):
            values[int(start * size) : int(start * size) + size // 40, a + 2 : b - 2] = mark
        letters = rng.uniform(size=(size // 8, 1)) < 0.6
        low = size // 4
        middle = values[low : low + 4 * len(letters), a + (b - a) // 3 : b - (b - a) // 3]
        middle[np.repeat(letters[:, 0], 4)] = mark
        values[:, a] = 0.03
    return weathered(rng, values, 0.12)


def sky(rng: np.random.Generator, *, height: int = 512) -> Texture:
    """Return a panorama for ``Sky``: clouds that are brighter towards the horizon, and dark below the horizon."""
    elevation = (0.5 - (np.arange(height)[:, None] + 0.5) / height) * np.pi
    clouds = np.clip(0.4 + 0.6 * fractal(rng, height, 2 * height, slope=1.35), 0.0, 1.0)
    light = 0.32 + 0.2 * np.exp(-np.abs(elevation) / 0.35) + 0.45 * clouds
    return np.where(elevation > 0.0, light, 0.25).astype(np.float32)
