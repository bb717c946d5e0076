"""Printed boards, chessboard and ChArUco: their points, their picture, and their corners in a picture."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from amiwarp.errors import AmiwarpError, optional_module
from amiwarp.io.files import NewFile
from amiwarp.io.formats import check_ending
from amiwarp.simulation.worlds.world import Body, Material, Mesh, Trajectory, World
from amiwarp.validation import array, finite, guarded, instance, one_of, real, whole

MOST_SQUARES = 100
"""Largest number of squares of a board along a side."""
MARKER_SHARE = 0.75
"""Side of a ChArUco marker, as a share of a square's."""
MARGIN = 1.0
"""White margin around the squares of a printed board [squares]."""
BLACK, WHITE = 0.04, 0.9
"""Reflectance of printed ink and of paper."""
LEAST_NAMED = 5, 4
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
            object.__setattr__(self, name, whole(getattr(self, name), f"board {name}", 2, MOST_SQUARES - 1, " corners"))
        object.__setattr__(self, "square_m", real(self.square_m, "board square_m", 1e-4, 100.0, " m"))
        if self.charuco is not None:
            self._charuco()

    @property
    def points(self) -> NDArray[np.float64]:
        """Inner corners row by row [m], shape ``(rows * columns, 3)``."""
        y, x = np.mgrid[: self.rows, : self.columns] * self.square_m
        return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)

    @property
    def size_m(self) -> tuple[float, float]:
        """Width and height of the printed board with its margin [m]."""
        return tuple((n + 1 + 2.0 * MARGIN) * self.square_m for n in (self.columns, self.rows))  # type: ignore[return-value]

    def _charuco(self) -> Any:
        """Return OpenCV's ChArUco board."""
        cv2 = opencv()
        known = sorted(name for name in dir(cv2.aruco) if name.startswith("DICT_"))
        name = one_of(instance(self.charuco, str, "board charuco"), known, "board charuco")
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))
        squares, markers = (self.columns + 1, self.rows + 1), len(dictionary.bytesList)
        if squares[0] * squares[1] // 2 > markers:
            needed = squares[0] * squares[1] // 2
            raise AmiwarpError(f"board charuco {self.charuco} has {markers} markers; this board needs {needed}")
        return cv2.aruco.CharucoBoard(squares, self.square_m, MARKER_SHARE * self.square_m, dictionary)

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
        if self.charuco is None:
            y, x = np.mgrid[: (self.rows + 1), : (self.columns + 1)]
            inner = np.kron((x + y) % 2 * 255, np.ones((square_px, square_px))).astype(np.uint8)
        else:
            size = ((self.columns + 1) * square_px, (self.rows + 1) * square_px)
            board = self._charuco()
            least = math.ceil((board.getDictionary().markerSize + 1.5) / MARKER_SHARE)  # OpenCV rounds the side
            if square_px < least:
                raise AmiwarpError(f"square_px is {square_px}, too few for markers of {self.charuco}; give {least}")
            inner = np.asarray(board.generateImage(size, marginSize=0), np.uint8)
        return np.pad(inner, round(MARGIN * square_px), constant_values=255)

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
        from matplotlib.patches import Rectangle

        width, height = self.size_m
        cell = 48 if self.charuco else 1  # a multiple of the cells of every marker with its border
        picture = self.picture(cell)
        scale = self.square_m / cell
        figure = Figure(figsize=(width * 1e3 / PAGE_MM, height * 1e3 / PAGE_MM))
        axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
        axes.set(xlim=(0.0, width), ylim=(height, 0.0))
        axes.axis("off")
        for row, line in enumerate(picture):  # runs of black, as vector graphics
            edges = np.flatnonzero(np.diff(np.concatenate([[255], line, [255]]).astype(np.int16)))
            for start, stop in edges.reshape(-1, 2):
                place = (start * scale, row * scale)
                axes.add_patch(Rectangle(place, (stop - start) * scale, scale, color="black", linewidth=0.0))
        corners = f"{self.columns} x {self.rows} inner corners, squares of {self.square_m * 1e3:g} mm"
        text = corners + (f", {self.charuco}" if self.charuco else "") + "; print at 100 %"
        axes.text(width / 2.0, height - 0.4 * self.square_m, text, ha="center", va="center", fontsize=7)
        with NewFile(path, overwrite=overwrite) as new:
            figure.savefig(new.part, format=path.suffix[1:].lower(), metadata={"Creator": "amiwarp"})

    def world(self, rotation: ArrayLike, position: ArrayLike, *, wall_m: float = 2.0, seed: int = 0) -> World:
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
        rng = np.random.default_rng(whole(seed, "seed", 0, 2**63 - 1))
        coarse = np.kron(rng.uniform(0.2, 0.8, (24, 32)), np.ones((16, 16)))
        spread = np.ones(9) / 9.0
        for axis in (0, 1):  # soft patches
            coarse = np.apply_along_axis(lambda line: np.convolve(line, spread, "same"), axis, coarse)
        texture = np.where(self.picture() > 0, WHITE, BLACK).astype(np.float32)
        board = Body(
            "board", _sheet(*self.size_m), Material(1.0, texture), Trajectory.still(position, rotation=rotation)
        )
        side = 6.0 * wall_m
        wall = Body(
            "wall", _sheet(side, side, 4.0), Material(1.0, coarse.astype(np.float32)), Trajectory.still([0, 0, wall_m])
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
        return self._find_charuco(picture) if self.charuco else _find_chessboard(picture, self.columns, self.rows)

    def _find_charuco(self, picture: NDArray[np.uint8]) -> Corners | None:
        cv2 = opencv()
        found, ids, _, _ = cv2.aruco.CharucoDetector(self._charuco()).detectBoard(picture)
        if found is None or len(found) < 6:
            return None
        return Corners(np.asarray(ids, np.int64).ravel(), np.asarray(found, np.float64).reshape(-1, 2))

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
        if self.charuco and self._find_charuco(np.ascontiguousarray(picture[:, ::-1])) is not None:
            return "the board is seen in a mirror image; flip the picture of the sensor"
        wanted = f"a board of {self.columns} x {self.rows} inner corners"
        if self.charuco:
            return f"{wanted} with markers of {self.charuco} is not seen"
        cv2, given = opencv(), (self.columns, self.rows)
        found, _, seen = cv2.findChessboardCornersSBWithMeta(picture, LEAST_NAMED, cv2.CALIB_CB_LARGER)
        size = tuple(sorted(seen.shape, reverse=self.columns >= self.rows)) if found else given
        if size == given:
            return f"{wanted} is not seen"
        hint = "; count the inner corners, not the squares" if size == (self.columns - 1, self.rows - 1) else ""
        return f"a board of {size[0]} x {size[1]} inner corners is seen, not of {self.columns} x {self.rows}{hint}"

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
        cv2, picture = opencv(), _checked(picture)
        if not len(instance(corners, Corners, "corners").ids):
            raise AmiwarpError("corners are empty; give those that find returned")
        hull = cv2.convexHull(corners.xy.astype(np.float32)).reshape(-1, 2)
        middle = hull.mean(axis=0)
        reach = 1.0 + 2.2 / min(self.columns, self.rows)  # the outer squares too
        covered = np.ascontiguousarray(picture).copy()
        polygon = np.rint(middle + (hull - middle) * reach).astype(np.int32)
        cv2.fillConvexPoly(covered, polygon, int(np.median(picture)))
        if self.charuco:
            return self.find(covered) is not None
        return _find_chessboard(covered, self.columns, self.rows, thorough=False) is not None


@guarded
@dataclass(frozen=True, eq=False)
class Corners:
    """Corners of a board in a picture."""

    ids: NDArray[np.int64]
    """Number of each corner, as in :attr:`Board.points`, shape ``(n,)``."""
    xy: NDArray[np.float64]
    """Position of each corner [px], shape ``(n, 2)``."""

    def __post_init__(self) -> None:
        ids, xy = array(self.ids, "corners' ids", "iu"), array(self.xy, "corners' xy")
        if ids.ndim != 1 or xy.shape != (len(ids), 2):
            raise AmiwarpError(f"corners have ids {ids.shape} and xy {xy.shape}; give shapes (n,) and (n, 2)")
        finite(xy, "corners' xy")


def _checked(picture: object) -> NDArray[np.uint8]:
    """Return a picture; raise :class:`AmiwarpError` for another type or shape."""
    checked = array(picture, "picture")
    if checked.ndim != 2 or checked.dtype != np.uint8 or not checked.size:
        raise AmiwarpError(
            f"picture has shape {checked.shape}, {checked.dtype}; give grey values, uint8, (height, width)"
        )
    return np.ascontiguousarray(checked)


def _find_chessboard(picture: NDArray[np.uint8], columns: int, rows: int, *, thorough: bool = True) -> Corners | None:
    """Return the corners of a chessboard; a search that is not ``thorough`` ends sooner where there is none."""
    cv2 = opencv()
    flags = cv2.CALIB_CB_EXHAUSTIVE if thorough else 0
    found, corners = cv2.findChessboardCornersSB(picture, (columns, rows), flags=flags)
    if found:
        return Corners(np.arange(columns * rows), np.asarray(corners, np.float64).reshape(-1, 2))
    return _find_quadrangles(picture, columns, rows) if thorough else None


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
    ends = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-3)
    fine = cv2.cornerSubPix(picture, coarse.copy(), (reach, reach), (-1, -1), ends)
    xy = np.asarray(fine, np.float64).reshape(rows, columns, 2)
    row, column = xy[0, -1] - xy[0, 0], xy[-1, 0] - xy[0, 0]
    if row[0] * column[1] < row[1] * column[0]:  # numbered as in a mirror
        xy = xy[:, ::-1]
    return Corners(np.arange(columns * rows), xy.reshape(-1, 2))


def _sheet(width: float, height: float, repeats: float = 1.0) -> Mesh:
    """Return a flat rectangle about the origin, x to the right and y down in its texture [m]."""
    x, y = width / 2.0, height / 2.0
    corners = np.array([[-x, -y, 0.0], [x, -y, 0.0], [x, y, 0.0], [-x, y, 0.0]])
    uv = np.array([[0.0, repeats], [repeats, repeats], [repeats, 0.0], [0.0, 0.0]])
    return Mesh(corners, np.array([[0, 2, 1], [0, 3, 2]]), uv)
