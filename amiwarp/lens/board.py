"""Printed boards, chessboard and ChArUco: their points, their picture, and their corners in a picture."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from amiwarp.errors import AmiwarpError, optional_module
from amiwarp.io.output_formats import check_ending
from amiwarp.io.outputs import NewFile
from amiwarp.schema.calls import guarded
from amiwarp.simulation.worlds.bodies import Body, Material, Mesh
from amiwarp.simulation.worlds.trajectory import Trajectory
from amiwarp.simulation.worlds.world import World
from amiwarp.validation import array, finite, instance, one_of, real, whole

MOST_SQUARES = 100
"""Largest number of squares of a board along a side."""
MARKER_SHARE = 0.75
"""Side of a ChArUco marker, as a share of a square's."""
MARGIN = 1.0
"""White margin around the squares of a printed board [squares]."""
BLACK = 0.04
WHITE = 0.9
"""Reflectance of printed ink and of paper."""
LEAST_NAMED = (5, 4)
"""Smallest other board that is named. Walls of grey squares have boards of 4 x 3 in two of three pictures."""
PAGE_MM = 25.4
"""Millimetres per inch, the unit of Matplotlib's pages."""


def opencv() -> Any:
    """Return the module ``cv2``; raise :class:`AmiwarpError` if it is not installed."""
    return optional_module("cv2", "lens", "boards need OpenCV")


@guarded
@dataclass(frozen=True)
class Board:
    """Flat board with a chessboard pattern of known size, with or without ChArUco markers.

    Its frame has x along the rows of corners, y along the columns, both in the board, and z into the board. The origin
    is the first inner corner.

    Raises
    ------
    AmiwarpError
        If a number is out of range, or OpenCV does not know the dictionary.

    Examples
    --------
    >>> board = amiwarp.Board(9, 6, 0.03)
    >>> board.points.shape
    (54, 3)
    """

    columns: int
    """Number of inner corners along x: squares minus 1."""
    rows: int
    """Number of inner corners along y: squares minus 1."""
    square_m: float
    """Side of a square [m]."""
    charuco: str | None = None
    """Name of OpenCV's dictionary of the markers, such as ``DICT_4X4_100``; None for a plain chessboard."""

    def __post_init__(self) -> None:
        for name in ("columns", "rows"):
            count = whole(getattr(self, name), f"board {name}", 2, MOST_SQUARES - 1, " corners")
            object.__setattr__(self, name, count)
        square_m = real(self.square_m, "board square_m", 1e-4, 100.0, " m")
        object.__setattr__(self, "square_m", square_m)
        if self.charuco is not None:
            self._charuco()

    @property
    def points(self) -> NDArray[np.float64]:
        """Inner corners row by row [m], shape ``(rows * columns, 3)``."""
        y, x = np.mgrid[: self.rows, : self.columns] * self.square_m
        z = np.zeros(x.size)
        return np.stack([x.ravel(), y.ravel(), z], axis=1)

    @property
    def size_m(self) -> tuple[float, float]:
        """Width and height of the printed board with its margin [m]."""
        width = (self.columns + 1 + 2.0 * MARGIN) * self.square_m
        height = (self.rows + 1 + 2.0 * MARGIN) * self.square_m
        return width, height

    def _charuco(self) -> Any:
        """Return OpenCV's ChArUco board."""
        cv2 = opencv()
        known = sorted(name for name in dir(cv2.aruco) if name.startswith("DICT_"))
        given = instance(self.charuco, str, "board charuco")
        name = one_of(given, known, "board charuco")
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))
        markers = len(dictionary.bytesList)
        columns = self.columns + 1
        rows = self.rows + 1
        needed = columns * rows // 2  # one in each white square
        if needed > markers:
            raise AmiwarpError(
                f"board charuco {self.charuco} has {markers} markers; this board needs {needed}"
            )
        marker_m = MARKER_SHARE * self.square_m
        return cv2.aruco.CharucoBoard((columns, rows), self.square_m, marker_m, dictionary)

    def picture(self, square_px: int = 40) -> NDArray[np.uint8]:
        """Return the board as it is printed, with its white margin.

        Parameters
        ----------
        square_px : int, optional
            Side of a square [px]; with markers, enough to show each of their cells.

        Returns
        -------
        ndarray
            0 for black and 255 for white, uint8, shape ``(height, width)``.
        """
        square_px = whole(square_px, "square_px", 1, 1000, " px")
        draw = self._plain_picture if self.charuco is None else self._charuco_picture
        inner = draw(square_px)
        margin = round(MARGIN * square_px)
        return np.pad(inner, margin, constant_values=255)

    def _plain_picture(self, square_px: int) -> NDArray[np.uint8]:
        """Return the squares of a board without markers."""
        y, x = np.mgrid[: (self.rows + 1), : (self.columns + 1)]
        squares = (x + y) % 2 * 255
        pixels = np.ones((square_px, square_px))
        return np.kron(squares, pixels).astype(np.uint8)

    def _charuco_picture(self, square_px: int) -> NDArray[np.uint8]:
        """Return the squares of a board with markers."""
        width = (self.columns + 1) * square_px
        height = (self.rows + 1) * square_px
        board = self._charuco()
        # OpenCV rounds the side.
        cells = board.getDictionary().markerSize + 1.5
        least = math.ceil(cells / MARKER_SHARE)
        if square_px < least:
            raise AmiwarpError(
                f"square_px is {square_px}, too few for markers of {self.charuco}; give {least}"
            )
        image = board.generateImage((width, height), marginSize=0)
        return np.asarray(image, np.uint8)

    def save(self, path: str | Path, *, overwrite: bool = False) -> None:
        """Write the board to print, in its true size.

        Parameters
        ----------
        path : str or Path
            File to write, with the suffix .svg or .pdf.
        overwrite : bool
            Whether to replace an existing file.

        Raises
        ------
        AmiwarpError
            If the suffix is another one, or the file exists.
        """
        path = Path(path)
        check_ending(path, "boards are written", [".svg", ".pdf"])
        from matplotlib.figure import Figure

        width, height = self.size_m
        page = (width * 1e3 / PAGE_MM, height * 1e3 / PAGE_MM)
        figure = Figure(figsize=page)
        axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
        axes.set(xlim=(0.0, width), ylim=(height, 0.0))
        axes.axis("off")
        self._draw_black(axes)
        y = height - 0.4 * self.square_m
        axes.text(width / 2.0, y, self._imprint(), ha="center", va="center", fontsize=7)
        kind = path.suffix[1:].lower()
        with NewFile(path, overwrite=overwrite) as new:
            figure.savefig(new.part, format=kind, metadata={"Creator": "amiwarp"})

    def _draw_black(self, axes: Any) -> None:
        """Draw the black of the board as rectangles: runs of each row of its picture."""
        from matplotlib.patches import Rectangle

        cell = 48 if self.charuco else 1  # a multiple of the cells of every marker with its border
        picture = self.picture(cell)
        scale = self.square_m / cell
        for row, line in enumerate(picture):
            padded = np.concatenate([[255], line, [255]]).astype(np.int16)
            edges = np.flatnonzero(np.diff(padded))
            for start, stop in edges.reshape(-1, 2):
                corner = (start * scale, row * scale)
                length = (stop - start) * scale
                run = Rectangle(corner, length, scale, color="black", linewidth=0.0)
                axes.add_patch(run)

    def _imprint(self) -> str:
        """Return what is printed in the margin of the board."""
        words = f"{self.columns} x {self.rows} inner corners, squares of {self.square_m * 1e3:g} mm"
        if self.charuco:
            words += f", {self.charuco}"
        return f"{words}; print at 100 %"

    def world(
        self,
        rotation: ArrayLike,
        position: ArrayLike,
        *,
        wall_m: float = 2.0,
        seed: int = 0,
    ) -> World:
        """Return a world with this board before a wall, to simulate recordings of it.

        Parameters
        ----------
        rotation : array_like
            Unit quaternion (x, y, z, w) from the board's frame, but with its origin in the middle of the board, to the
            world's.
        position : array_like
            Middle of the board in the world [m], shape ``(3,)``. The camera is expected near the origin, with its
            optical axis along z.
        wall_m : float, optional
            Distance of the wall from the origin along z [m].
        seed : int, optional
            Seed of the wall's random pattern.

        Returns
        -------
        World
            The world.
        """
        wall_m = real(wall_m, "wall_m", 0.01, 1e4, " m")
        pattern = _wall_pattern(whole(seed, "seed", 0, 2**63 - 1))
        is_white = self.picture() > 0
        texture = np.where(is_white, WHITE, BLACK).astype(np.float32)
        board = Body(
            "board",
            _sheet(*self.size_m),
            Material(1.0, texture),
            Trajectory.still(position, rotation=rotation),
        )
        side = 6.0 * wall_m
        wall = Body(
            "wall",
            _sheet(side, side, 4.0),
            Material(1.0, pattern),
            Trajectory.still([0, 0, wall_m]),
        )
        return World("board", (board, wall), ambient=1.0)

    # Corners in a picture.

    def find(self, picture: NDArray[np.uint8]) -> Corners | None:
        """Return the corners of the board in a picture, or None if it is not there.

        Parameters
        ----------
        picture : ndarray
            Picture, uint8, shape ``(height, width)``.

        Returns
        -------
        Corners or None
            The corners.
        """
        picture = _checked(picture)
        if self.charuco:
            return self._find_charuco(picture)
        return _find_chessboard(picture, self.columns, self.rows)

    def _find_charuco(self, picture: NDArray[np.uint8]) -> Corners | None:
        """Return the corners of a board with markers in a picture, or None."""
        cv2 = opencv()
        detector = cv2.aruco.CharucoDetector(self._charuco())
        found, ids, _, _ = detector.detectBoard(picture)
        if found is None or len(found) < 6:
            return None
        xy = np.asarray(found, np.float64).reshape(-1, 2)
        return Corners(np.asarray(ids, np.int64).ravel(), xy)

    def missing(self, picture: NDArray[np.uint8]) -> str:
        """Return in words why the board is not found in a picture, as far as that can be told.

        Parameters
        ----------
        picture : ndarray
            Picture, uint8, shape ``(height, width)``.

        Returns
        -------
        str
            The reason.
        """
        picture = _checked(picture)
        mirrored = np.ascontiguousarray(picture[:, ::-1])
        if self.charuco and self._find_charuco(mirrored) is not None:
            return "the board is seen in a mirror image; flip the picture of the sensor"
        wanted = f"a board of {self.columns} x {self.rows} inner corners"
        if self.charuco:
            return f"{wanted} with markers of {self.charuco} is not seen"

        # Another board may be seen. A picture does not tell its rows from its columns.
        cv2 = opencv()
        flags = cv2.CALIB_CB_LARGER
        found, _, seen = cv2.findChessboardCornersSBWithMeta(picture, LEAST_NAMED, flags)
        if not found:
            return f"{wanted} is not seen"
        columns, rows = sorted(seen.shape, reverse=self.columns >= self.rows)
        if columns == self.columns and rows == self.rows:
            return f"{wanted} is not seen"
        reason = f"a board of {columns} x {rows} inner corners is seen, not of {self.columns} x {self.rows}"
        if columns == self.columns - 1 and rows == self.rows - 1:
            reason += "; count the inner corners, not the squares"
        return reason

    def has_another(self, picture: NDArray[np.uint8], corners: Corners) -> bool:
        """Return whether a picture shows a second board of this kind beside the one that was found.

        Parameters
        ----------
        picture : ndarray
            Picture, uint8, shape ``(height, width)``.
        corners : Corners
            Corners of the board that was found.

        Returns
        -------
        bool
            Whether there is another board.
        """
        cv2 = opencv()
        picture = _checked(picture)
        if not len(instance(corners, Corners, "corners").ids):
            raise AmiwarpError("corners are empty; give those that find returned")

        # Cover the board that was found, with its outer squares.
        hull = cv2.convexHull(corners.xy.astype(np.float32)).reshape(-1, 2)
        middle = hull.mean(axis=0)
        reach = 1.0 + 2.2 / min(self.columns, self.rows)
        polygon = np.rint(middle + (hull - middle) * reach).astype(np.int32)
        covered = np.ascontiguousarray(picture).copy()
        grey = int(np.median(picture))
        cv2.fillConvexPoly(covered, polygon, grey)
        if self.charuco:
            return self.find(covered) is not None
        other = _find_chessboard(covered, self.columns, self.rows, thorough=False)
        return other is not None


@guarded
@dataclass(frozen=True, eq=False)
class Corners:
    """Corners of a board in a picture."""

    ids: NDArray[np.int64]
    """Number of each corner, as in :attr:`Board.points`, shape ``(n,)``."""
    xy: NDArray[np.float64]
    """Position of each corner [px], shape ``(n, 2)``."""

    def __post_init__(self) -> None:
        ids = array(self.ids, "corners' ids", "iu")
        xy = array(self.xy, "corners' xy")
        if ids.ndim != 1 or xy.shape != (len(ids), 2):
            raise AmiwarpError(
                f"corners have ids {ids.shape} and xy {xy.shape}; give shapes (n,) and (n, 2)"
            )
        finite(xy, "corners' xy")


def _checked(picture: object) -> NDArray[np.uint8]:
    """Return a picture; raise :class:`AmiwarpError` for another type or shape."""
    checked = array(picture, "picture")
    if checked.ndim != 2 or checked.dtype != np.uint8 or not checked.size:
        raise AmiwarpError(
            f"picture has shape {checked.shape}, {checked.dtype}; give grey values, uint8, (height, width)"
        )
    return np.ascontiguousarray(checked)


def _wall_pattern(seed: int) -> NDArray[np.float32]:
    """Return patches of random grey, softened along both axes."""
    rng = np.random.default_rng(seed)
    patches = rng.uniform(0.2, 0.8, (24, 32))
    pattern = np.kron(patches, np.ones((16, 16)))
    spread = np.ones(9) / 9.0

    def softened(line: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.convolve(line, spread, "same")

    for axis in (0, 1):
        pattern = np.apply_along_axis(softened, axis, pattern)
    return pattern.astype(np.float32)


def _find_chessboard(
    picture: NDArray[np.uint8],
    columns: int,
    rows: int,
    *,
    thorough: bool = True,
) -> Corners | None:
    """Return the corners of a chessboard; a search that is not ``thorough`` ends sooner if there is none."""
    cv2 = opencv()
    flags = cv2.CALIB_CB_EXHAUSTIVE if thorough else 0
    found, corners = cv2.findChessboardCornersSB(picture, (columns, rows), flags=flags)
    if found:
        xy = np.asarray(corners, np.float64).reshape(-1, 2)
        return Corners(np.arange(columns * rows), xy)
    if not thorough:
        return None
    return _find_quadrangles(picture, columns, rows)


def _find_quadrangles(picture: NDArray[np.uint8], columns: int, rows: int) -> Corners | None:
    """Return the corners of a chessboard between black quadrangles.

    OpenCV's detector of corners loses some where a steep board has small squares, for example 10 px beside 30 px. The
    older detector, of quadrangles, finds them, but coarsely.
    """
    cv2 = opencv()
    flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
    found, coarse = cv2.findChessboardCorners(picture, (columns, rows), flags=flags)
    if not found:
        return None
    grid = np.asarray(coarse, np.float64).reshape(rows, columns, 2)
    along_rows = np.linalg.norm(np.diff(grid, axis=1), axis=2)
    along_columns = np.linalg.norm(np.diff(grid, axis=0), axis=2)
    nearest = min(float(along_rows.min()), float(along_columns.min()))
    reach = max(int(nearest / 3.0), 2)  # no neighbour lies in the window of a corner
    end_of_steps = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-3)
    fine = cv2.cornerSubPix(
        picture,
        coarse.copy(),
        (reach, reach),
        (-1, -1),
        end_of_steps,
    )
    xy = np.asarray(fine, np.float64).reshape(rows, columns, 2)
    row = xy[0, -1] - xy[0, 0]
    column = xy[-1, 0] - xy[0, 0]
    numbered_as_in_a_mirror = row[0] * column[1] < row[1] * column[0]
    if numbered_as_in_a_mirror:
        xy = xy[:, ::-1]
    return Corners(np.arange(columns * rows), xy.reshape(-1, 2))


def _sheet(width: float, height: float, repeats: float = 1.0) -> Mesh:
    """Return a flat rectangle about the origin, x to the right and y down in its texture [m]."""
    x = width / 2.0
    y = height / 2.0
    corners = [[-x, -y, 0.0], [x, -y, 0.0], [x, y, 0.0], [-x, y, 0.0]]
    uv = [[0.0, repeats], [repeats, repeats], [repeats, 0.0], [0.0, 0.0]]
    triangles = [[0, 2, 1], [0, 3, 2]]
    return Mesh(np.array(corners), np.array(triangles), np.array(uv))
