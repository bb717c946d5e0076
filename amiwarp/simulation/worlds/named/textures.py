"""Generated textures of the built-in worlds: linear reflectances from 0.03 to 0.95."""

import itertools
from typing import Any

import numpy as np
from numpy.typing import NDArray

DARKEST = 0.03
BRIGHTEST = 0.95
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


def fractal(
    rng: np.random.Generator, height: int, width: int, *, slope: float = 1.2
) -> NDArray[np.float64]:
    """Return periodic noise of mean 0 and standard deviation 1, whose amplitude spectrum is frequency ** -``slope``."""
    fy = np.fft.fftfreq(height)[:, None] * height
    fx = np.fft.rfftfreq(width) * width
    frequency = np.hypot(fy, fx)
    frequency[0, 0] = np.inf  # no mean
    white = rng.standard_normal((height, width))
    spectrum = np.fft.rfft2(white) / frequency**slope
    noise = np.fft.irfft2(spectrum, s=(height, width))
    return np.asarray(noise / noise.std())


def plaster(
    rng: np.random.Generator, mean: float = 0.5, contrast: float = 0.35, size: int = 512
) -> Texture:
    """Return fractal noise about ``mean``. ``contrast``: standard deviation of the natural log reflectance."""
    noise = fractal(rng, size, size)
    return clipped(mean * np.exp(contrast * noise))


def weathered(rng: np.random.Generator, values: NDArray[Any], contrast: float = 0.15) -> Texture:
    """Return reflectances multiplied by fractal noise, so that no area is blank.

    ``contrast``: standard deviation of the natural log of the noise.
    """
    noise = fractal(rng, *values.shape, slope=1.0)
    return clipped(values * np.exp(contrast * noise))


def checkerboard(
    squares: int, *, size: int = 256, dark: float = 0.05, bright: float = 0.9
) -> Texture:
    """Return a checkerboard with ``squares`` squares along each side. With an even number the
    texture repeats without a seam."""
    square = np.arange(size) * squares // size
    is_dark = (square[:, None] + square) % 2
    return clipped(np.where(is_dark, dark, bright))


def grating(
    angle_deg: float,
    cycles: float = 12.0,
    *,
    size: int = 256,
    dark: float = 0.05,
    bright: float = 0.9,
) -> Texture:
    """Return a grating of ``cycles`` dark and bright stripes in a white frame.

    The brightness varies along the direction ``angle_deg``, counter-clockwise from the right.
    """
    v, u = np.mgrid[size:0:-1, 0:size] / size
    angle = np.radians(angle_deg)
    across = np.cos(angle) * u + np.sin(angle) * v
    stripes = np.clip(3.0 * np.sin(2.0 * np.pi * cycles * across), -1.0, 1.0)
    values = dark + (bright - dark) * (stripes + 1.0) / 2.0
    rim = size // 24
    values[:rim] = bright
    values[-rim:] = bright
    values[:, :rim] = bright
    values[:, -rim:] = bright
    return clipped(values)


def star(spokes: int = 24, *, size: int = 384, dark: float = 0.05, bright: float = 0.9) -> Texture:
    """Return a Siemens star, which has edges of all directions and scales."""
    v, u = (np.mgrid[0:size, 0:size] + 0.5) / size - 0.5
    radius = np.hypot(u, v)
    azimuth = np.arctan2(v, u)
    # The edges of the spokes are about equally sharp at all radii.
    wave = np.clip(0.15 * size * radius * np.sin(spokes * azimuth), -1.0, 1.0)
    disc = dark + (bright - dark) * (wave + 1.0) / 2.0
    return clipped(np.where(radius < 0.47, disc, bright))


def text_page(
    rng: np.random.Generator,
    *,
    width: int = 384,
    height: int = 512,
    letter: int = 18,
    ink: float = 0.05,
) -> Texture:
    """Return a printed page: a heading and lines of random words. ``letter``: font size [texels]."""
    from PIL import Image, ImageDraw, ImageFont

    page = Image.new("F", (width, height), 0.88)
    words = TEXT.split()
    draw = ImageDraw.Draw(page)
    margin = width // 14
    y = margin
    size = 2 * letter
    while y < height - margin - letter:
        font = ImageFont.load_default(size)
        line = str(rng.choice(words))
        longer = f"{line} {rng.choice(words)}"
        while draw.textlength(longer, font=font) < width - 2 * margin:
            line = longer
            longer = f"{line} {rng.choice(words)}"
        # A few lines are left blank, but never the heading.
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
        largest = 0.3 if k < 10 else 0.12  # large shapes lie below small ones
        reach = float(rng.uniform(0.03, largest) * size)
        turn = rng.uniform(0, 2 * np.pi)
        kind = k % 3
        if kind == 0:
            draw.ellipse((x - reach, y - reach, x + reach, y + reach), fill=shade)
            continue
        # Directions from the middle to the corners
        triangle = np.arange(3) * 2.094
        bar = np.array([0.2, 2.94, 3.34, 6.08])
        directions = turn + (triangle if kind == 1 else bar)
        corners = [(x + reach * np.cos(a), y + reach * np.sin(a)) for a in directions]
        draw.polygon(corners, fill=shade)
    return weathered(rng, np.asarray(page), 0.1)


def _cells(
    rng: np.random.Generator, rows: int, size: int, *, columns: int, joint: int, shift: bool
) -> NDArray[np.float64]:
    """Return random shades of a grid of cells, for bricks and tiles, and NaN in the joints between the cells.

    ``joint``: width of a joint [texels]; ``shift``: whether odd rows are shifted by half a cell.
    """
    y, x = np.mgrid[0:size, 0:size]
    cell_height = size // rows
    cell_width = size // columns
    row = y * rows // size
    if shift:
        is_odd = row % 2 == 1
        x = (x + np.where(is_odd, cell_width // 2, 0)) % size
    column = x * columns // size
    shade = rng.standard_normal((rows, columns))[row, column]
    in_joint = (y % cell_height < joint) | (x % cell_width < joint)
    return np.where(in_joint, np.nan, shade)


def _filled(
    shade: NDArray[np.float64], mean: float, contrast: float, joint: float
) -> NDArray[np.float64]:
    """Return the reflectances of :func:`_cells` with shades ``shade``, and of the joints between the cells."""
    cells = mean * np.exp(contrast * np.nan_to_num(shade))
    return np.where(np.isnan(shade), joint, cells)


def bricks(
    rng: np.random.Generator, *, mean: float = 0.25, joint: float = 0.55, size: int = 512
) -> Texture:
    """Return a brick wall of 16 rows with 8 bricks each. ``mean``, ``joint``: reflectance of bricks and of joints."""
    shade = _cells(rng, 16, size, columns=8, joint=3, shift=True)
    return weathered(rng, _filled(shade, mean, 0.3, joint), 0.25)


def tiles(
    rng: np.random.Generator,
    *,
    mean: float = 0.5,
    joint: float = 0.12,
    count: int = 8,
    size: int = 512,
) -> Texture:
    """Return ``count`` by ``count`` square tiles. ``mean``, ``joint``: reflectance of tiles and of joints."""
    shade = _cells(rng, count, size, columns=count, joint=4, shift=False)
    return weathered(rng, _filled(shade, mean, 0.25, joint), 0.25)


def wood(
    rng: np.random.Generator, *, mean: float = 0.3, boards: int = 8, size: int = 512
) -> Texture:
    """Return horizontal boards with grain."""
    y = np.arange(size)[:, None]
    board = y * boards // size

    # Noise that is smooth along the boards looks like fibres.
    noise = fractal(rng, size, size, slope=0.9)
    spectrum = np.fft.rfft(noise, axis=1)
    low_pass = np.exp(-((np.arange(size // 2 + 1) / 10.0) ** 2))
    grain = np.fft.irfft(spectrum * low_pass, n=size, axis=1)

    tone = rng.standard_normal(boards)[board]
    values = mean * np.exp(0.35 * grain / grain.std() + 0.25 * tone)
    in_seam = y % (size // boards) < 3
    return weathered(rng, np.where(in_seam, 0.25 * values, values), 0.12)


def plaid(rng: np.random.Generator, *, size: int = 256, stripes: int = 10) -> Texture:
    """Return a fabric of crossed stripes."""

    width = -(-size // stripes)  # rounded up

    def bands() -> NDArray[np.float64]:
        """Return the shades of parallel stripes, shape (size,)."""
        shades = rng.uniform(0.25, 1.0, stripes)
        return np.repeat(shades, width)[:size]

    down = bands()[:, None]
    across = bands()[None, :]
    return weathered(rng, 0.95 * down * across, 0.2)


def book_spines(rng: np.random.Generator, *, books: int = 16, size: int = 512) -> Texture:
    """Return a row of book spines with bands and titles."""
    values = np.empty((size, size))
    edges = np.linspace(0, size, books + 1).astype(int)
    for left, right in itertools.pairwise(edges):
        shade = float(np.exp(rng.uniform(np.log(0.05), np.log(0.85))))
        values[:, left:right] = shade
        ink = 0.85 if shade < 0.3 else 0.05

        band = size // 40
        for start in rng.uniform(0.05, 0.9, 3):
            top = int(start * size)
            values[top : top + band, left + 2 : right - 2] = ink

        # The title: rows of four texels in the middle third of the spine.
        is_letter = rng.uniform(size=size // 8) < 0.6
        rows_with_ink = np.repeat(is_letter, 4)
        top = size // 4
        third = (right - left) // 3
        title = values[top : top + len(rows_with_ink), left + third : right - third]
        title[rows_with_ink] = ink

        gap = 0.03
        values[:, left] = gap
    return weathered(rng, values, 0.12)


def sky(rng: np.random.Generator, *, height: int = 512) -> Texture:
    """Return a panorama for ``Sky``: clouds that are brighter towards the horizon, and dark below the horizon."""
    row = np.arange(height)[:, None]
    elevation = (0.5 - (row + 0.5) / height) * np.pi
    noise = fractal(rng, height, 2 * height, slope=1.35)
    clouds = np.clip(0.4 + 0.6 * noise, 0.0, 1.0)
    haze = np.exp(-np.abs(elevation) / 0.35)
    light = 0.32 + 0.2 * haze + 0.45 * clouds
    return np.where(elevation > 0.0, light, 0.25).astype(np.float32)
