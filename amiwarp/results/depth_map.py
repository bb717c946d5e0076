"""Maps of depth: inverse depth of what each pixel sees with its uncertainty, as files of arrays and of points."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.io.array_maps import ArrayMap
from amiwarp.io.output_formats import check_ending
from amiwarp.io.outputs import NewFile
from amiwarp.optics.camera import LARGEST_SIZE
from amiwarp.schema.calls import guarded
from amiwarp.validation import array

FILL_PX = 12.0
"""Standard deviation of the distances from which unknown depths are filled [px]. Events of a desk at pixels of unknown
depth missed their places by 0.53 px rms with it, by 0.85 px with 6 px, and by 1.26 px with the nearest depth."""
ARRAYS = ("inverse_depth", "std", "points")
"""Names of the arrays of a map in a file."""
PLY_HEADER = """ply
format binary_little_endian 1.0
element vertex {count}
property float x
property float y
property float z
property uchar red
property uchar green
property uchar blue
property uchar alpha
end_header
"""
"""Start of a file of points with colours; a row for each point follows."""


@guarded
@dataclass(frozen=True, eq=False)
class DepthMap(ArrayMap):
    """Inverse depth of what each pixel sees through a rotating tilted plate, from the camera's resting centre.

    Raises
    ------
    AmiwarpError
        If the arrays have different shapes, or a value is out of range.

    Examples
    --------
    >>> import numpy as np
    >>> unknown = np.array([[2.0, np.nan]], np.float32)
    >>> depth = amiwarp.DepthMap(unknown, 0.1 * unknown, np.zeros((1, 2, 3), np.float32))
    >>> depth.known
    array([[ True, False]])
    """

    _WHAT = "depth map"
    _COMMAND = "amiwarp depth"
    _KINDS: ClassVar = dict.fromkeys(ARRAYS, "f")
    _AXES: ClassVar = {"points": 3}
    inverse_depth: NDArray[np.float32]
    """Inverse depth [1/m], shape (height, width); NaN where it is unknown."""
    std: NDArray[np.float32]
    """Standard deviation of :attr:`inverse_depth` [1/m], shape (height, width); NaN where it is unknown."""
    points: NDArray[np.float32]
    """Point in the camera's frame that each pixel sees [m], shape (height, width, 3); NaN where it is unknown
    or infinitely far."""

    def __post_init__(self) -> None:
        shape = np.shape(self.inverse_depth)
        is_image = len(shape) == 2 and all(1 <= side <= LARGEST_SIZE for side in shape)
        for name in ARRAYS:
            values = array(getattr(self, name), f"depth map's {name}")
            expected = (*shape, 3) if name == "points" else shape
            if not is_image or values.shape != expected:
                raise AmiwarpError(
                    f"depth map's {name} has shape {values.shape}; expected (height, width), points x 3"
                )
            if np.isinf(values).any() or (name != "points" and (values < 0.0).any()):
                bounds = "" if name == "points" else " of 0 or above"
                raise AmiwarpError(
                    f"depth map's {name} has a negative or infinite value; expected finite values{bounds}, or NaN"
                )
            object.__setattr__(self, name, values.astype(np.float32, copy=False))
        if np.isnan(self.std[self.known]).any():
            raise AmiwarpError(
                "depth map's std is NaN at a pixel whose depth is known; make both NaN, or none"
            )
        # A point at infinity, whose inverse depth is 0, has no finite coordinates.
        if np.isnan(self.points[self.inverse_depth > 0.0]).any():
            raise AmiwarpError(
                "depth map's points are NaN at a pixel whose depth is known; make both NaN, or none"
            )

    def __repr__(self) -> str:
        height, width = self.inverse_depth.shape
        return f"DepthMap({width} x {height} px, {int(self.known.sum())} known)"

    @property
    def known(self) -> NDArray[np.bool_]:
        """Whether the depth of a pixel is known, shape (height, width)."""
        return np.isfinite(self.inverse_depth)

    def filled(self) -> NDArray[np.float32]:
        """Return the inverse depth of each pixel, where it is unknown as a mean of known ones about it.

        They are weighted by their inverse variances and, with a Gaussian function of 12 px, by their distances. The
        nearest known depth alone would often be wrong: depths at the border of a known part are uncertain.

        Returns
        -------
        ndarray
            Inverse depth [1/m], shape (height, width).

        Raises
        ------
        AmiwarpError
            If no depth is known.
        """
        from scipy.ndimage import distance_transform_edt, gaussian_filter

        known = self.known
        if not known.any():
            raise AmiwarpError(
                "the depth map knows no depth; record a scene with more texture",
                ErrorCode.CONTENT_MISSING,
            )
        # Where no known depth is near enough for the mean, the nearest one stays.
        nearest = distance_transform_edt(~known, return_distances=False, return_indices=True)
        of_nearest = self.inverse_depth[tuple(nearest)]
        filled = np.where(known, self.inverse_depth, of_nearest).astype(np.float64)

        least = max(1e-3 * float(np.nanmax(self.inverse_depth)), 1e-12)  # a deviation may be 0
        weight = np.where(known, np.maximum(self.std, least), np.inf) ** -2.0
        weights = gaussian_filter(weight, FILL_PX)
        near = ~known & (weights > 1e-9 * weights.max())
        filled[near] = gaussian_filter(weight * filled, FILL_PX)[near] / weights[near]
        return filled.astype(np.float32)

    def save_points(self, path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
        """Write the known points to a PLY file, coloured from near (yellow) to far (violet).

        Parameters
        ----------
        path : str or Path
            The file, which ends in ``.ply``.
        overwrite : bool, default False
            Whether to replace an existing file.

        Raises
        ------
        AmiwarpError
            If the file has another extension, exists and ``overwrite`` is False, or cannot be written, or no depth is
            known.
        """
        import matplotlib as mpl

        path = Path(path)
        check_ending(path, "points are written", [".ply"])
        if not self.known.any():
            raise AmiwarpError(
                "the depth map knows no depth, so there are no points; record a scene with more texture",
                ErrorCode.CONTENT_MISSING,
            )
        values = self.inverse_depth[self.known]
        low, high = np.percentile(values, [2, 98])
        share = np.clip((values - low) / max(high - low, 1e-9), 0.0, 1.0)
        colours = mpl.colormaps["viridis"](share, bytes=True)
        rows = np.empty(len(values), [("place", "<f4", 3), ("colour", "u1", 4)])
        rows["place"] = self.points[self.known]
        rows["colour"] = colours
        with NewFile(path, overwrite=overwrite) as new, open(new.part, "wb") as file:
            file.write(PLY_HEADER.format(count=len(rows)).encode("ascii"))
            file.write(rows.tobytes())
