"""Building blocks of the built-in worlds: shapes, textures, furniture, and trajectories of the camera."""

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from amiwarp.simulation.worlds.world import Body, Material, Mesh, Trajectory, looking_at

# Generated textures for the built-in worlds: linear reflectances from 0.03 to 0.95.

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


# Meshes of simple shapes for the built-in worlds: panels, boxes and surfaces of revolution.

BOX_SIDES = (
    ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    ((-1, 0, 0), (0, -1, 0), (0, 0, 1)),
    ((0, 1, 0), (-1, 0, 0), (0, 0, 1)),
    ((0, -1, 0), (1, 0, 0), (0, 0, 1)),
    ((0, 0, 1), (1, 0, 0), (0, 1, 0)),
    ((0, 0, -1), (1, 0, 0), (0, -1, 0)),
)
"""Sides of a box: outward normal, and directions to the right and up as seen from outside."""


def panel(corner: ArrayLike, right: ArrayLike, up: ArrayLike, *, tile_m: float | None = None) -> Mesh:
    """Return a parallelogram, given its lower left corner and two sides [m]. Its normal is ``right`` x ``up``.

    ``tile_m``: width and height of the texture on the panel [m]; None to show the whole texture once.
    """
    c, r, u = (np.asarray(value, np.float64) for value in (corner, right, up))
    scale = (1.0, 1.0) if tile_m is None else (np.linalg.norm(r) / tile_m, np.linalg.norm(u) / tile_m)
    uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * scale
    return Mesh(np.array([c, c + r, c + r + u, c + u]), np.array([[0, 1, 2], [0, 2, 3]]), uv)


def box(size: ArrayLike, centre: ArrayLike = (0.0, 0.0, 0.0), *, tile_m: float | None = None) -> Mesh:
    """Return a box of ``size`` (x, y, z) [m] about ``centre`` [m]. Each side is a :func:`panel`."""
    s = np.asarray(size, np.float64)
    sides = []
    for normal, right, up in BOX_SIDES:
        n, r, u = (np.array(direction) * s for direction in (normal, right, up))
        sides.append(panel(np.asarray(centre) + (n - r - u) / 2.0, r, u, tile_m=tile_m))
    return merged(sides)


def standing_box(size: ArrayLike, foot: ArrayLike = (0.0, 0.0, 0.0), *, tile_m: float | None = None) -> Mesh:
    """Return a box of ``size`` (x, y, z) [m] whose lower side has the centre ``foot`` [m]."""
    return box(size, np.asarray(foot, np.float64) + np.asarray(size) * (0.0, 0.0, 0.5), tile_m=tile_m)


def lathe(profile: ArrayLike, *, sides: int = 24, tile_m: float | None = None) -> Mesh:
    """Return the surface of revolution about z of a polyline (radius, height) [m], from bottom to top.

    ``tile_m``: width and height of the texture [m]. The width is rounded so that the texture closes around the shape.
    None: show the texture once around.
    """
    line = np.asarray(profile, np.float64)
    angle = np.linspace(0.0, 2.0 * np.pi, sides + 1)
    ring = np.column_stack([np.cos(angle), np.sin(angle)])
    points = np.concatenate(
        [line[:, None, :1] * ring, np.broadcast_to(line[:, None, 1:], (len(line), sides + 1, 1))], axis=2
    )
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    around = max(1, round(2.0 * np.pi * line[:, 0].max() / tile_m)) if tile_m else 1
    v = along / (tile_m or max(along[-1], 1e-9))
    uv = np.stack(np.meshgrid(around * np.linspace(0.0, 1.0, sides + 1), v), axis=-1)
    return Mesh(points.reshape(-1, 3), _grid_faces(len(line), sides + 1), uv.reshape(-1, 2))


def _grid_faces(rows: int, columns: int) -> NDArray[np.int32]:
    """Return the triangles between the points of a grid, which are numbered row by row."""
    at = np.arange(rows * columns, dtype=np.int32).reshape(rows, columns)
    a, b, c, d = (part.ravel() for part in (at[:-1, :-1], at[:-1, 1:], at[1:, 1:], at[1:, :-1]))
    return np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])


def cylinder(radius: float, height: float, *, sides: int = 20, tile_m: float | None = None) -> Mesh:
    """Return a closed cylinder about the z axis that stands on z = 0; lengths in metres."""
    return lathe([(0, 0), (radius, 0), (radius, height), (0, height)], sides=sides, tile_m=tile_m)


def ellipsoid(radii: ArrayLike, *, sides: int = 24, rings: int = 12, tile_m: float | None = None) -> Mesh:
    """Return an ellipsoid about the origin with radii along x, y and z [m]."""
    polar = np.linspace(-np.pi / 2.0, np.pi / 2.0, rings + 1)
    scale = np.asarray(radii, np.float64)
    line = np.column_stack([np.cos(polar).clip(0.0), np.sin(polar)]) * scale.max()
    ball = lathe(line, sides=sides, tile_m=tile_m)
    return Mesh(np.asarray(ball.vertices) * scale / scale.max(), ball.faces, ball.uv)


def capsule(radius: float, length: float, *, sides: int = 20, rings: int = 6, tile_m: float | None = None) -> Mesh:
    """Return a cylinder with round ends from the origin down to z = ``-length`` [m]."""
    low, high = np.linspace(-np.pi / 2.0, 0.0, rings), np.linspace(0.0, np.pi / 2.0, rings)
    ends = [
        np.column_stack([radius * np.cos(a).clip(0.0), radius * np.sin(a) + z]) for a, z in ((low, -length), (high, 0))
    ]
    return lathe(np.concatenate(ends), sides=sides, tile_m=tile_m)


def gable_roof(size: ArrayLike, foot: ArrayLike = (0.0, 0.0, 0.0), *, tile_m: float | None = None) -> Mesh:
    """Return a gable roof of ``size`` (x, y, height) [m] with its ridge along x.

    ``foot``: centre of its lower side [m].
    """
    x, y, z = np.asarray(size, np.float64) / (2.0, 2.0, 1.0)
    slopes = [
        panel((-x, -y, 0), (2 * x, 0, 0), (0, y, z), tile_m=tile_m),
        panel((x, y, 0), (-2 * x, 0, 0), (0, -y, z), tile_m=tile_m),
    ]
    scale = tile_m or 2 * y
    ends = []
    for side in (1.0, -1.0):
        corners = np.array([(side * x, -side * y, 0), (side * x, side * y, 0), (side * x, 0, z)])
        ends.append(Mesh(corners, [[0, 1, 2]], corners[:, 1:] * (side, 1.0) / scale))
    return moved(merged([*slopes, *ends]), foot)


def merged(meshes: Iterable[Mesh]) -> Mesh:
    """Return one mesh that consists of several meshes."""
    parts = list(meshes)
    starts = np.cumsum([0, *(len(np.asarray(part.vertices)) for part in parts)])
    return Mesh(
        np.concatenate([np.asarray(part.vertices) for part in parts]),
        np.concatenate([np.asarray(part.faces) + start for part, start in zip(parts, starts, strict=False)]),
        np.concatenate([np.asarray(part.uv) for part in parts]),
    )


def moved(mesh: Mesh, position: ArrayLike, *, turn_deg: float = 0.0, axis: ArrayLike = (0.0, 0.0, 1.0)) -> Mesh:
    """Return a mesh rotated by ``turn_deg`` [deg] about an axis through the origin, then moved by ``position`` [m]."""
    from scipy.spatial.transform import Rotation

    rotation: Any = Rotation.from_rotvec(np.radians(turn_deg) * np.asarray(axis, np.float64))
    return Mesh(rotation.apply(np.asarray(mesh.vertices)) + np.asarray(position, np.float64), mesh.faces, mesh.uv)


def legs(size: Sequence[float], height: float, radius: float) -> Mesh:
    """Return four round legs at the corners of a rectangle of ``size`` (x, y) [m] about the origin."""
    x, y = size[0] / 2.0 - 2.0 * radius, size[1] / 2.0 - 2.0 * radius
    leg = cylinder(radius, height, sides=12, tile_m=0.3)
    return merged(moved(leg, (a * x, b * y, 0.0)) for a in (-1, 1) for b in (-1, 1))


def tapered(mesh: Mesh, share: float) -> Mesh:
    """Return a mesh whose horizontal size shrinks linearly with height, to the fraction ``share`` at the top."""
    points = np.array(mesh.vertices, np.float64)
    low, high = points[:, 2].min(), points[:, 2].max()
    middle = (points[:, :2].min(axis=0) + points[:, :2].max(axis=0)) / 2.0
    factor = 1.0 - (1.0 - share) * (points[:, 2:] - low) / (high - low)
    points[:, :2] = middle + factor * (points[:, :2] - middle)
    return Mesh(points, mesh.faces, mesh.uv)


# Bodies that several built-in worlds contain: walls, tables, chairs, pictures, vessels and gratings.


def solid(
    name: str, mesh: Mesh, texture: Texture | None, category: str, *, instance: str | None = None,
    trajectory: Trajectory | None = None, emission: float = 0.0,
) -> Body:  # fmt: skip
    """Return a body whose reflectance is given by a texture. Without a texture the reflectance is 0.5."""
    material = Material(1.0 if texture is not None else 0.5, texture, emission)
    return Body(name, mesh, material, trajectory, category, instance)


def hall(size: Sequence[float], walls: Sequence[Texture], floor: Texture, ceiling: Texture) -> list[Body]:
    """Return the floor, ceiling, four walls and skirting board of a hall of ``size`` (x, y, z) [m].

    The hall is centred on the z axis and stands on z = 0.
    """
    x, y, z = size[0] / 2.0, size[1] / 2.0, size[2]
    sides = {
        "north": ((-x, y, 0), (2 * x, 0, 0)),
        "east": ((x, y, 0), (0, -2 * y, 0)),
        "south": ((x, -y, 0), (-2 * x, 0, 0)),
        "west": ((-x, -y, 0), (0, 2 * y, 0)),
    }
    bodies = [
        solid("floor", panel((-x, -y, 0), (2 * x, 0, 0), (0, 2 * y, 0), tile_m=2.0), floor, "floor"),
        solid("ceiling", panel((-x, y, z), (2 * x, 0, 0), (0, -2 * y, 0), tile_m=2.4), ceiling, "ceiling"),
    ]
    for k, (name, (corner, along)) in enumerate(sides.items()):
        mesh = panel(corner, along, (0, 0, z), tile_m=2.0)
        bodies.append(solid(f"{name} wall", mesh, walls[k % len(walls)], "wall"))
    boards = []
    for corner, along in sides.values():
        size = (2 * x, 0.02, 0.1) if along[0] else (0.02, 2 * y, 0.1)
        boards.append(standing_box(size, np.array(corner) + np.array(along) / 2.0, tile_m=1.0))
    skirting = merged(boards)
    bodies.append(solid("skirting", skirting, clipped(0.8 * np.ones((2, 2))), "wall"))
    return bodies


def picture(
    name: str, centre: Sequence[float], right: Sequence[float], texture: Texture, width: float, height: float
) -> list[Body]:
    """Return a picture of ``width`` x ``height`` [m] on a wall, and its frame.

    ``centre``: centre of the picture [m]; ``right``: unit vector along the wall, to the right as seen by a viewer.
    """
    r = np.asarray(right, np.float64)
    out = np.cross(r, (0.0, 0.0, 1.0))
    middle = np.asarray(centre, np.float64)
    corner = middle + 0.012 * out - r * width / 2.0 - np.array((0, 0, height / 2.0))
    bars = []
    for side in (-1.0, 1.0):
        bars.append(_bar(r, out, (0.03, 0.03, height + 0.06), middle + side * (width / 2.0 + 0.015) * r))
        bars.append(_bar(r, out, (width, 0.03, 0.03), middle + np.array((0, 0, side * (height / 2.0 + 0.015)))))
    frame = clipped(0.12 * np.ones((2, 2)))
    return [
        solid(name, panel(corner, r * width, (0, 0, height)), texture, "picture"),
        solid(f"{name} frame", merged(bars), frame, "picture", instance=name),
    ]


def _bar(right: Any, out: Any, size: Sequence[float], centre: Any) -> Mesh:
    """Return a bar of a picture frame: a box whose x axis lies along ``right`` and whose y axis lies along ``out``."""
    mesh = box(size)
    axes = np.stack([right, out, np.array((0.0, 0.0, 1.0))])
    return Mesh(np.asarray(mesh.vertices) @ axes + centre + 0.015 * out, mesh.faces, mesh.uv)


def table(
    name: str, size: Sequence[float], position: Sequence[float], texture: Texture, *, turn_deg: float = 0.0
) -> Body:
    """Return a table of ``size`` (x, y, height) [m], rotated about the vertical axis by ``turn_deg`` [deg]."""
    top = standing_box((size[0], size[1], 0.04), (0, 0, size[2] - 0.04), tile_m=0.8)
    apron = standing_box((size[0] - 0.1, size[1] - 0.1, 0.08), (0, 0, size[2] - 0.12), tile_m=0.8)
    mesh = merged([top, apron, legs(size[:2], size[2] - 0.04, 0.03)])
    return solid(name, moved(mesh, position, turn_deg=turn_deg), texture, "table")


def chair(name: str, position: Sequence[float], texture: Texture, *, turn_deg: float = 0.0) -> Body:
    """Return a chair that faces +x before it is rotated about the vertical axis by ``turn_deg`` [deg]."""
    seat = standing_box((0.42, 0.42, 0.04), (0, 0, 0.42), tile_m=0.5)
    posts = [moved(cylinder(0.018, 0.5, sides=12, tile_m=0.3), (-0.19, y, 0.45)) for y in (-0.18, 0.18)]
    slats = [standing_box((0.02, 0.36, 0.07), (-0.19, 0, z), tile_m=0.5) for z in (0.58, 0.71, 0.84)]
    mesh = merged([seat, *posts, *slats, legs((0.44, 0.44), 0.42, 0.02)])
    return solid(name, moved(mesh, position, turn_deg=turn_deg), texture, "chair")


def vessel(
    name: str,
    profile: Sequence[tuple[float, float]],
    position: Sequence[float],
    texture: Texture,
    *,
    tile_m: float = 0.25,
) -> Body:
    """Return a vessel: a surface of revolution whose profile (radius, height) [m] is smoothed by a spline.

    ``position``: centre of the foot [m]; ``tile_m``: width and height of the texture on the surface [m].
    """
    from scipy.interpolate import PchipInterpolator

    points = np.asarray(profile, np.float64)
    knots = np.arange(len(points))
    line = PchipInterpolator(knots, points)(np.linspace(0.0, knots[-1], 6 * len(points)))
    mesh = lathe(line.clip(0.0), sides=32, tile_m=tile_m)
    return solid(name, moved(mesh, position), texture, "vessel")


def grating_strip(
    name: str, corner: Sequence[float], right: Sequence[float], *, count: int, side: float, cycles: float
) -> list[Body]:
    """Return a row of ``count`` square gratings along a wall, with evenly spaced directions.

    ``corner``: lower left corner of the row [m]; ``right``: unit vector along the wall; ``side``: side of a square [m];
    ``cycles``: number of stripe pairs per square.
    """
    r = np.asarray(right, np.float64)
    out = 0.01 * np.cross(r, (0.0, 0.0, 1.0))
    bodies = []
    for k in range(count):
        start = np.asarray(corner, np.float64) + out + 1.1 * k * side * r
        mesh = panel(start, side * r, (0.0, 0.0, side))
        label = f"{name} {round(180 * k / count)} deg"
        bodies.append(solid(label, mesh, grating(180.0 * k / count, cycles), "grating"))
    return bodies


# Camera trajectories of the built-in worlds: still, handheld and fast.

TRAJECTORIES = ("still", "handheld", "fast")
"""Names of the kinds of camera trajectories."""
RATE_HZ = 100.0
"""Number of poses per second."""
SHAKE_M = 0.015
"""Approximate amplitude of the handheld translation [m]."""
SHAKE_DEG = 1.5
"""Approximate amplitude of the handheld rotation [deg]."""
SWAY_HZ = (0.15, 0.55)
"""Range of frequencies of the slow part of handheld motion [Hz]."""
TREMOR_HZ = (1.5, 2.8)
"""Range of frequencies of the tremor in handheld motion [Hz]. Each tremor sine has a relative amplitude of 0.03."""
FAST_RATE, FAST_REACH = 4.0, 2.5
"""Ratios of frequency and amplitude of fast to handheld trajectories. Their product, 10, is the ratio of speeds."""


@dataclass(frozen=True)
class Viewpoint:
    """Mean pose of a camera, and the path that a moving camera walks."""

    position: tuple[float, float, float]
    """Mean position of the camera [m]."""
    target: tuple[float, float, float]
    """Point that the camera looks at [m]."""
    walk_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Vector from the mean position to one end of the path [m]. A moving camera walks the path back and forth."""
    walk_speed: float = 1.2
    """Largest walking speed [m/s]. Fast trajectories are ten times as fast."""


def camera_trajectory(view: Viewpoint, kind: str, duration_s: float, rng: np.random.Generator) -> Trajectory:
    """Return a camera trajectory about a viewpoint. ``kind``: one of :data:`TRAJECTORIES`."""
    from scipy.spatial.transform import Rotation

    base = looking_at(view.position, view.target)
    if kind == "still":
        return Trajectory.still(view.position, rotation=base.as_quat())
    t = np.linspace(0.0, duration_s, max(4, round(duration_s * RATE_HZ) + 1))
    rate, reach = (FAST_RATE, FAST_REACH) if kind == "fast" else (1.0, 1.0)
    sway, turn = (reach * shake(rate * t, rng) for _ in range(2))
    position = np.asarray(view.position) + SHAKE_M * sway + walk(view, rate * reach, t)
    rotation = base * Rotation.from_rotvec(np.radians(SHAKE_DEG) * turn)
    return Trajectory(t, position, rotation.as_quat())


def shake(t: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
    """Return smooth random motion of amplitude about 1 along three axes, shape ``(n, 3)``.

    ``t``: times [s]. The motion along each axis is a sum of six sines.
    """
    low, high = SWAY_HZ
    frequency = np.concatenate([low + (high - low) * (np.arange(4)[:, None] + rng.uniform(size=(4, 3))) / 4.0,
                                rng.uniform(*TREMOR_HZ, (2, 3))])  # fmt: skip
    amplitude = np.concatenate([0.5 * np.sqrt(low / frequency[:4]) + 0.1, np.full((2, 3), 0.03)])
    phase = rng.uniform(0.0, 2.0 * np.pi, (6, 3))
    waves = amplitude * np.sin(2.0 * np.pi * frequency * t[:, None, None] + phase)
    return np.asarray(waves.sum(axis=1))


def walk(view: Viewpoint, factor: float, t: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the displacements of a walking camera along ``view.walk_m`` [m], shape ``(n, 3)``.

    ``factor``: factor of the speed; ``t``: times [s]. The motion is a sine, so the speed is largest at time 0.
    """
    end = np.asarray(view.walk_m)
    length = float(np.linalg.norm(end))
    if not length > 0.0:
        return np.zeros((len(t), 3))
    return np.asarray(np.sin(factor * view.walk_speed * t / length)[:, None] * end)
