"""Result of a lens calibration: camera, prism, poses, and what would improve it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.lens.board import Corners
from amiwarp.lens.corner_fit import STEEP, Fit
from amiwarp.lens.projection import tilt_of
from amiwarp.optics.camera import Camera
from amiwarp.optics.models.comparison import rms
from amiwarp.results.calibration import Calibration
from amiwarp.schema.calls import guarded
from amiwarp.validation import array, finite, instance, real

GOOD_POSES = 12
"""Number of poses that suffices for a good calibration."""
REGIONS = (("upper", "middle", "lower"), ("left", "centre", "right"))
"""Names of the nine regions of the image in which corners are counted."""


@guarded
@dataclass(frozen=True, eq=False)
class BoardPose:
    """One pose of the board, and how well the calibrated lens explains it."""

    name: str
    """Recording, with the time span if it has several."""
    corners: Corners
    """Corners in the picture [px]."""
    residuals: NDArray[np.float64]
    """Predicted minus seen position of each corner [px], shape ``(n, 2)``."""
    rotation: NDArray[np.float64]
    """Rotation vector from the board's frame to the camera's [rad], shape ``(3,)``."""
    translation: NDArray[np.float64]
    """Position of the board's first inner corner in the camera's frame [m], shape ``(3,)``."""
    picture: NDArray[np.uint8]
    """Picture in which the corners were found, shape ``(height, width)``."""

    def __post_init__(self) -> None:
        shape = array(self.residuals, "pose's residuals").shape
        if shape != self.corners.xy.shape:
            raise AmiwarpError(
                f"pose's residuals have shape {shape}; give {self.corners.xy.shape}, as its corners"
            )
        for name in ("residuals", "rotation", "translation"):
            finite(array(getattr(self, name), f"pose's {name}"), f"pose's {name}")

    @property
    def rms(self) -> float:
        """Distance of predicted and seen corners [px rms]."""
        return rms(self.residuals)


@guarded
@dataclass(frozen=True, eq=False)
class LensCalibration:
    """Calibrated lens and prism, with the evidence."""

    camera: Camera
    """The camera."""
    uncertainty: Mapping[str, float]
    """Standard deviations of the free parameters of the camera by name: px for fx, fy, cx and cy."""
    prism: Calibration
    """Calibration of the prism with this camera, for ``compensate`` and all else."""
    poses: tuple[BoardPose, ...]
    """Poses that the lens was fitted to."""
    left_out: Mapping[str, str]
    """Reason by name of each pose that was left out."""
    notes: tuple[str, ...]
    """What the recordings do not determine, and events that were left out, one sentence each."""
    advice: tuple[str, ...]
    """What would improve the calibration most, one sentence each; the most helpful first."""
    seconds: float
    """Computing time [s]."""

    def __post_init__(self) -> None:
        if not self.poses:
            raise AmiwarpError("a lens calibration has no poses; give the poses of the fit")
        for pose in self.poses:
            instance(pose, BoardPose, "lens calibration's pose")
        real(self.seconds, "lens calibration's seconds")

    @property
    def rms(self) -> float:
        """Distance of predicted and seen corners over all poses [px rms]."""
        return rms(np.concatenate([pose.residuals for pose in self.poses]))

    @property
    def coverage(self) -> NDArray[np.int64]:
        """Number of corners in each of the nine regions of the image, shape ``(3, 3)``."""
        seen = [pose.corners for pose in self.poses]
        return coverage_of(seen, self.camera.width, self.camera.height)


def coverage_of(seen: Sequence[Corners], width: int, height: int) -> NDArray[np.int64]:
    """Return the number of corners in each third of the image's rows and columns, shape (3, 3)."""
    xy = np.concatenate([corners.xy for corners in seen])
    ranges = [[-0.5, height - 0.5], [-0.5, width - 0.5]]
    return np.histogram2d(xy[:, 1], xy[:, 0], bins=3, range=ranges)[0].astype(np.int64)


def advice_on(poses: Sequence[BoardPose], fit: Fit) -> tuple[str, ...]:
    """Return what would improve a calibration most, one sentence each."""
    tilts = [tilt_of(np.concatenate([pose.rotation, pose.translation])) for pose in poses]
    seen = [pose.corners for pose in poses]
    missing = lacking(tilts, coverage_of(seen, fit.camera.width, fit.camera.height))
    if len(poses) < GOOD_POSES:
        missing.append(
            f"record more poses: {len(poses)} were used, and {GOOD_POSES} halve the deviation of four"
        )
    return tuple(missing)


def lacking(tilts: Sequence[float], coverage: NDArray[np.int64]) -> list[str]:
    """Return what the poses lack in tilt [rad] and in coverage of the image, one sentence each."""
    lines = []
    usual = float(np.median(tilts))
    if usual < STEEP:
        lines.append(
            f"tilt the board more: half of the poses are tilted by less than {math.degrees(usual):.0f} deg"
        )
    rows, columns = REGIONS
    empty = [f"{rows[a]} {columns[b]}" for a, b in np.argwhere(coverage == 0)]
    if empty:
        lines.append(f"no corner lies in the {', '.join(empty)} of the image: hold the board there")
    return lines
