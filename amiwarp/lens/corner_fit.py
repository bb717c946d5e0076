"""Fit of a lens and of the poses of a board to the corners that were seen: bundle adjustment with robust weights."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.lens.board import MARKER_SHARE, Board, Corners, opencv
from amiwarp.optics.camera import Camera, Fisheye, RadialTangential, coefficients
from amiwarp.optics.models import rms

Vector = NDArray[np.float64]

INTRINSICS = ("fx", "fy", "cx", "cy")
"""Names of the intrinsics, in the order of a fit's vector, which the distortion's coefficients follow."""
GROUPS = {
    RadialTangential: (("k1",), ("k2",), ("p1", "p2"), ("k3",), ("k4", "k5", "k6")),
    Fisheye: (("k1",), ("k2",), ("k3",), ("k4",)),
}
"""Coefficients of each kind of lens, in the order in which they are tried."""
LEAST_CHANCE = 0.001
"""Probability, by the F-test, that noise alone gives as large a gain: coefficients whose gain is likelier are left
out."""
LARGEST_FOCAL_DEVIATION = 0.005
"""Largest relative standard deviation of the focal length of an answer."""
UNDETERMINED, TILT = "the poses do not determine the focal length", "tilt it by 20 to 40 deg in different directions"
STEEP = math.radians(15.0)
"""Tilt of a board that tells focal length from distance [rad]."""
SMALL, FULL = 0.3, 0.8
"""Shares of the image's width or height: a board is small that spans less, and can hardly be held so as to span more.
"""
GAIN_OF_NEARNESS = 0.8
"""Exponent of the distance by which the deviation of the focal length grows: measured with boards that span 14 to 40 %
of the image."""
ENOUGH_TO_LEAVE_ONE = 8
"""Number of poses from which on the lens is determined without any one of them, so that their scatter tells its
deviation; with fewer, the scatter of the corners does."""
HUBER = 2.0
"""Residual from which on a corner gets less weight [standard deviations]."""
ROUNDS, MOST_STEPS = 3, 60
"""Number of rounds of robust weights of the answer, and the largest number of evaluations in each. Fits that only give
a start have one round."""
LENS_STEP_PX = 10.0
"""Largest move of pixels by each parameter of a lens in a step that tells what follows the lens [px rms]."""
PATCH, SAMPLES = 0.42, 25
"""Half side of the patch around a corner [squares], and the number of its samples along a side."""
STRIP = (1.0 - MARKER_SHARE) / 2.0
"""Samples farther than this from both lines through the corner are left out [squares]: markers lie there."""
MATCHES, FARTHEST = 3, 0.1
"""Number of times that corners are matched with their mean patch, and the largest move that is believed [squares]."""


@dataclass(frozen=True, eq=False)
class Fit:
    """Lens and poses that explain the corners best."""

    camera: Camera
    """Camera of the fit."""
    poses: Vector
    """Rotation vector and translation [m] from the board's frame to the camera's, per pose, shape ``(poses, 6)``."""
    names: tuple[str, ...]
    """Free parameters of the lens."""
    covariance: Vector
    """Covariance of the free parameters of the lens, in px for :data:`INTRINSICS`, shape ``(names, names)``."""
    residuals: tuple[Vector, ...]
    """Predicted minus seen position of every corner per pose [px], shape ``(n, 2)`` each."""
    cost: float
    """Weighted sum of squares [px²]."""
    freedom: int
    """Number of coordinates of corners minus that of parameters."""
    left_out: tuple[str, ...] = ()
    """Coefficients that the corners do not determine."""

    @property
    def deviations(self) -> dict[str, float]:
        """Standard deviations of the free parameters of the lens, by name."""
        return dict(zip(self.names, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))

    @property
    def rms(self) -> float:
        """Distance of predicted and seen corners [px rms]."""
        return rms(np.concatenate(self.residuals))

    def axes(self, xy: NDArray[Any]) -> tuple[Vector, Vector]:
        """Return steps of the free parameters along the axes of their covariance, and their lengths [deviations].

        A step is a row of shape (names,). Coefficients of a rational lens trade against each other: one alone, moved by
        its deviation, gives a lens that cannot be. A step moves the pixels ``xy`` by at most :data:`LENS_STEP_PX` for
        each of the parameters; they cancel mostly.
        """
        spread = np.maximum([*self.deviations.values()], 1e-12)
        shares, axes = np.linalg.eigh(self.covariance / np.outer(spread, spread))
        whole = (spread[:, None] * axes * np.sqrt(np.maximum(shares, 0.0))).T
        rays = np.asarray(self.camera.pixels_to_rays(xy.astype(np.float64)), np.float64)
        by = Projection(self.camera).of(np.zeros(6), rays[np.isfinite(rays).all(axis=1)])[1]
        known = parameter_names(self.camera)
        moves = np.sqrt((by**2).sum(axis=1).mean(axis=0))[[known.index(name) for name in self.names]]
        lengths = np.minimum(1.0, LENS_STEP_PX / np.maximum(np.abs(whole) * moves, 1e-12).max(axis=1))
        return lengths[:, None] * whole, lengths


def lens_values(camera: Camera, names: Iterable[str]) -> dict[str, float]:
    """Return intrinsics and coefficients of a camera by name, in the order of ``names``."""
    return {n: getattr(camera if n in INTRINSICS else camera.distortion, n) for n in names}


def parameter_names(camera: Camera) -> tuple[str, ...]:
    """Return the names of all parameters of a camera that has a distortion, in the order of :class:`Projection`."""
    return *INTRINSICS, *(field.name for field in fields(type(camera.distortion)))  # type: ignore[arg-type]


def with_lens_values(camera: Camera, values: Mapping[str, float]) -> Camera:
    """Return the camera, which has a distortion, with other intrinsics and coefficients."""
    bends = {n: x for n, x in values.items() if n not in INTRINSICS}
    lengths = {n: x for n, x in values.items() if n in INTRINSICS}
    return replace(camera, **lengths, distortion=replace(camera.distortion, **bends))  # type: ignore[type-var, arg-type]


class Projection:
    """Projection of points of a board by a lens, with its derivatives: OpenCV's formulas."""

    def __init__(self, camera: Camera) -> None:
        self._matrix = camera.to_opencv()[0]
        given = np.array([*coefficients(camera.distortion or RadialTangential()).values()])
        self._fisheye = isinstance(camera.distortion, Fisheye)
        self._given = given if self._fisheye else np.concatenate([given, np.zeros(8 - len(given))])

    def of(self, pose: Vector, points: Vector) -> tuple[Vector, Vector]:
        """Return the pixels of points, shape (n, 2), and their derivatives, shape (n, 2, 4 + coefficients + 6).

        ``pose``: rotation vector and translation [m]; ``points``: places in the board's frame [m], shape (n, 3). The
        derivatives are those by the intrinsics, the coefficients in the lens's order, and the pose.
        """
        cv2, turn, shift = opencv(), pose[:3].reshape(3, 1), pose[3:].reshape(3, 1)
        if self._fisheye:
            xy, by = cv2.fisheye.projectPoints(points.reshape(-1, 1, 3), turn, shift, self._matrix, self._given)
            by = by[:, :14]
        else:
            xy, by = cv2.projectPoints(points, turn, shift, self._matrix, self._given)
            by = np.roll(by, -6, axis=1)
        return xy.reshape(-1, 2), np.asarray(by).reshape(len(points), 2, -1)


def first_pose(camera: Camera, board: Board, corners: Corners) -> Vector:
    """Return the pose of a board from its corners and a known camera: rotation vector and translation [m]."""
    cv2, points = opencv(), board.points[corners.ids]
    rays = np.asarray(camera.pixels_to_rays(corners.xy), np.float64)
    flat = rays[:, :2] / np.maximum(rays[:, 2:], 1e-3)
    flags = cv2.SOLVEPNP_IPPE
    _, turns, shifts, _ = cv2.solvePnPGeneric(points, flat, np.eye(3), None, flags=flags)
    found = [np.concatenate([a.ravel(), b.ravel()]) for a, b in zip(turns, shifts, strict=True)]
    lens = Projection(camera)
    return min(found, key=lambda pose: float(((lens.of(pose, points)[0] - corners.xy) ** 2).sum()))


def match_corners(picture: NDArray[np.uint8], board: Board, corners: Corners, camera: Camera, pose: Vector) -> Corners:
    """Return corners that fit the mean patch of all corners of their picture best.

    ``camera`` and ``pose`` are known roughly; through them the patches are sampled in the board's frame, where all
    corners look alike, every second one in a mirror. The mean patch is made symmetric about its middle. Least squares
    give the shift, contrast and brightness of each patch. Compared with the gradients near a corner
    (``cornerSubPix``), the error is a third: all of the edges counts, and no blur need be known.
    """
    from scipy.ndimage import map_coordinates, spline_filter

    side = np.linspace(-PATCH, PATCH, SAMPLES)
    v, u = (grid.ravel() for grid in np.meshgrid(side, side, indexing="ij"))
    near = np.minimum(np.abs(u), np.abs(v)) < STRIP
    middle, step = SAMPLES * SAMPLES // 2, 2.0 * (side[1] - side[0])
    offsets = board.square_m * np.stack([u, v, np.zeros_like(u)], axis=1)
    points = (board.points[corners.ids][:, None] + offsets).reshape(-1, 3)
    patches = Projection(camera).of(pose, points)[0].reshape(len(corners.ids), -1, 2)
    patches = patches - patches[:, middle : middle + 1]
    by_u = (patches[:, middle + 1] - patches[:, middle - 1]) / step
    by_v = (patches[:, middle + SAMPLES] - patches[:, middle - SAMPLES]) / step
    mirrored = (corners.ids % board.columns + corners.ids // board.columns) % 2 == 1
    smooth, xy = spline_filter(picture.astype(np.float64)), corners.xy
    for _ in range(MATCHES):
        x, y = np.moveaxis(patches + xy[:, None], 2, 0)
        seen = map_coordinates(smooth, [y, x], mode="nearest", prefilter=False).reshape(-1, SAMPLES, SAMPLES)
        seen[mirrored] = seen[mirrored, :, ::-1]
        level, contrast = seen.mean(axis=(1, 2), keepdims=True), seen.std(axis=(1, 2), keepdims=True)
        mean = ((seen - level) / np.maximum(contrast, 1.0)).mean(axis=0)
        mean = (mean + mean[::-1, ::-1]) / 2.0
        down, along = np.gradient(mean, side, side)
        columns = np.stack([along.ravel(), down.ravel(), mean.ravel(), np.ones_like(u)], axis=1)[near]
        a = np.linalg.lstsq(columns, seen.reshape(len(xy), -1)[:, near].T, rcond=None)[0]
        move = -a[:2] / np.maximum(a[2], 1e-3)
        move[0, mirrored] *= -1.0
        move = np.where(np.abs(move).max(axis=0) < FARTHEST, move, 0.0)[:, :, None]
        xy = xy + move[0] * by_u + move[1] * by_v
    return Corners(corners.ids, xy)


def fit_lens(camera: Camera, board: Board, seen: Sequence[Corners]) -> Fit:
    """Return the lens with as many coefficients as the corners determine, and the poses of the board.

    ``camera`` is the start. A lens without distortion starts as a radial-tangential one. Raises :class:`AmiwarpError`
    if the poses do not determine the focal length.
    """
    lens = type(camera.distortion or RadialTangential())
    rough = replace(camera, distortion=lens())
    # a wrong focal length can turn over a pose that is nearly frontal: with a better one the poses are found again
    for _ in range(2):
        poses = np.array([first_pose(rough, board, corners) for corners in seen])
        best = _fit(rough, poses, board, seen, INTRINSICS, rounds=1)
        rough = best.camera
    best = _fit(best.camera, best.poses, board, seen, INTRINSICS)
    names, left_out = INTRINSICS, list[str]()
    for group in GROUPS[lens]:
        if group[0] == "k4" and len(group) > 1 and "k3" not in names:
            left_out += group  # the rational model is for lenses that a third coefficient does not describe
            continue
        more = _fit(best.camera, best.poses, board, seen, (*names, *group))
        if _gain_is_real(best, more, len(group)) and _is_seen_through(more.camera, seen):
            best, names = more, (*names, *group)
        else:
            left_out += group
    off = best.deviations["fx"] / best.camera.fx
    if not off <= LARGEST_FOCAL_DEVIATION:
        tilts = np.degrees([tilt_of(pose) for pose in best.poses])
        span = float(
            np.median([np.max(np.ptp(corners.xy, axis=0) / [camera.width, camera.height]) for corners in seen])
        )
        raise AmiwarpError(
            f"{UNDETERMINED} ({100.0 * off:.1f} % standard deviation): the board is tilted by {min(tilts):.0f} to "
            f"{max(tilts):.0f} deg and spans {100.0 * span:.0f} % of the image; "
            f"{_what_determines_it(off / LARGEST_FOCAL_DEVIATION, math.radians(np.median(tilts)), span)}"
        )
    return replace(best, left_out=tuple(left_out))


def _what_determines_it(excess: float, tilt: float, span: float) -> str:
    """Return what to do about a focal length whose deviation is ``excess`` times the largest of an answer.

    ``tilt``: of half of the poses [rad]; ``span``: share of the image's width or height that their boards span.
    """
    if tilt < STEEP:
        return TILT + (", and hold it nearer" if span < SMALL else "")
    nearer = min(excess ** (1.0 / GAIN_OF_NEARNESS), FULL / span)
    if nearer < 1.1:
        return "record more poses"
    return f"hold it {nearer:.1f} times nearer, where it spans {100.0 * nearer * span:.0f} %, or record more poses"


def _gain_is_real(less: Fit, more: Fit, count: int) -> bool:
    """Return whether ``count`` more parameters explain more than noise alone would: F-test."""
    from scipy.stats import f

    if more.freedom <= 0 or more.cost <= 0.0:
        return False
    ratio = (less.cost - more.cost) / count / (more.cost / more.freedom)
    return bool(f.sf(max(ratio, 0.0), count, more.freedom) < LEAST_CHANCE)


def _is_seen_through(camera: Camera, seen: Sequence[Corners]) -> bool:
    """Return whether all corners lie where the lens does not fold. A rational one can have a pole between them."""
    xy = np.concatenate([corners.xy for corners in seen])
    return bool(np.isfinite(np.asarray(camera.pixels_to_rays(xy))).all())


def _fit(
    camera: Camera,
    poses: Vector,
    board: Board,
    seen: Sequence[Corners],
    names: tuple[str, ...],
    rounds: int = ROUNDS,
) -> Fit:
    """Return the fit of the parameters ``names`` of the lens, and of all poses, from a start."""
    from scipy.optimize import least_squares

    all_names = parameter_names(camera)
    free, count = [all_names.index(n) for n in names], len(names)
    points, xy = [board.points[c.ids] for c in seen], np.concatenate([c.xy for c in seen])
    ends = np.cumsum([2 * len(p) for p in points]).tolist()

    def lens_of(v: Vector) -> Camera:
        return with_lens_values(camera, dict(zip(names, v[:count].tolist(), strict=True)))

    @lru_cache(maxsize=1)  # residuals and their derivatives are asked for at the same place in turn
    def projected(v: bytes) -> list[tuple[Vector, Vector]]:
        at = np.frombuffer(v)
        lens = Projection(lens_of(at))
        return [lens.of(pose, p) for pose, p in zip(at[count:].reshape(-1, 6), points, strict=True)]

    def residuals(v: Vector) -> Vector:
        return np.asarray((np.concatenate([found for found, _ in projected(v.tobytes())]) - xy).ravel())

    def jacobian(v: Vector) -> Vector:
        out = np.zeros((ends[-1], len(v)))
        for k, (_, by) in enumerate(projected(v.tobytes())):
            rows, columns = slice(([0, *ends])[k], ends[k]), slice(count + 6 * k, count + 6 * k + 6)
            flat = by.reshape(-1, by.shape[2])
            out[rows, :count], out[rows, columns] = flat[:, free], flat[:, len(all_names) :]
        return out

    def weighted(v: Vector, root: Vector) -> Vector:
        return root * residuals(v)

    def weighted_jacobian(v: Vector, root: Vector) -> Vector:
        return root[:, None] * jacobian(v)

    v = np.concatenate([[*lens_values(camera, names).values()], poses.ravel()])
    weight = np.ones(2 * len(xy))
    for _ in range(rounds):
        try:
            v = least_squares(
                weighted, v, weighted_jacobian, args=(np.sqrt(weight),), method="lm", x_scale="jac", ftol=1e-7,
                max_nfev=MOST_STEPS,
            ).x  # fmt: skip
        except AmiwarpError as error:  # a lens that cannot be
            raise AmiwarpError(f"{UNDETERMINED}: the fit runs away; {TILT}, and hold it near") from error
        r = residuals(v)
        limit = HUBER * max(1.4826 * float(np.median(np.abs(r))), 1e-6)
        weight = np.minimum(1.0, limit / np.maximum(np.abs(r), 1e-12))
    j = jacobian(v) * np.sqrt(weight)[:, None]
    freedom, cost = len(r) - len(v), float((weight * r**2).sum())
    if len(seen) < ENOUGH_TO_LEAVE_ONE:
        covariance = np.linalg.pinv(j.T @ j)[:count, :count] * cost / max(freedom, 1)
    else:
        covariance = _jackknife(j, np.sqrt(weight) * r, count, [0, *ends])
    return Fit(
        lens_of(v), v[count:].reshape(-1, 6), names, covariance,
        tuple(np.split(r.reshape(-1, 2), [end // 2 for end in ends[:-1]])), cost, freedom,
    )  # fmt: skip


def _jackknife(jacobian: Vector, residuals: Vector, count: int, ends: list[int]) -> Vector:
    """Return the covariance of the first ``count`` parameters, of the lens: the jackknife over the poses, linearised.

    The errors of the corners of a pose are correlated, so the scatter of the residuals alone would give too small
    deviations. ``ends`` are the rows at which the poses begin and end.
    """
    parts = list[tuple[Vector, Vector]]()
    for k, (a, b) in enumerate(pairwise(ends)):
        lens, pose = jacobian[a:b, :count], jacobian[a:b, count + 6 * k : count + 6 * k + 6]
        lens = lens - pose @ np.linalg.lstsq(pose, lens, rcond=None)[0]
        parts.append((lens.T @ lens, lens.T @ residuals[a:b]))
    total = np.sum([hessian for hessian, _ in parts], axis=0)
    moved = np.stack([np.linalg.pinv(total - hessian) @ gradient for hessian, gradient in parts])
    return np.asarray((len(parts) - 1) * np.cov(moved.T, bias=True))


def tilt_of(pose: Vector) -> float:
    """Return the angle between a board's normal and the optical axis [rad]."""
    from scipy.spatial.transform import Rotation

    normal: Any = Rotation.from_rotvec(pose[:3]).apply([0.0, 0.0, 1.0])
    return float(np.arccos(np.clip(abs(normal[2]), 0.0, 1.0)))
