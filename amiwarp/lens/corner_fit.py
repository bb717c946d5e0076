"""Fit of a lens and of the poses of a board to the corners that were seen: bundle adjustment with robust weights."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.lens.board import Board, Corners
from amiwarp.lens.projection import (
    INTRINSICS,
    Projection,
    Vector,
    first_pose,
    lens_values,
    parameter_names,
    tilt_of,
    with_lens_values,
)
from amiwarp.optics.camera import Camera
from amiwarp.optics.distortion import Fisheye, RadialTangential
from amiwarp.optics.models.comparison import rms

RATIONAL = ("k4", "k5", "k6")
"""Coefficients that only the rational model of a lens has."""
GROUPS = {
    RadialTangential: (("k1",), ("k2",), ("p1", "p2"), ("k3",), RATIONAL),
    Fisheye: (("k1",), ("k2",), ("k3",), ("k4",)),
}
"""Coefficients of each kind of lens, in the order in which they are tried."""
LARGEST_CHANCE = 0.001
"""Probability, by the F-test, that noise alone gives as large a gain: coefficients whose gain is likelier are left
out."""
LARGEST_FOCAL_DEVIATION = 0.005
"""Largest relative standard deviation of the focal length of an answer."""
UNDETERMINED = "the poses do not determine the focal length"
TILT = "tilt it by 20 to 40 deg in different directions"
STEEP = math.radians(15.0)
"""Tilt of a board that tells focal length from distance [rad]."""
SMALL = 0.3
FULL = 0.8
"""Shares of the image's width or height: a board is small that spans less, and can hardly be held so as to span more.
"""
GAIN_OF_NEARNESS = 0.8
"""Exponent of the distance by which the deviation of the focal length grows: measured with boards that span 14 to 40 %
of the image."""
ENOUGH_TO_LEAVE_ONE = 8
"""Least number of poses with which the lens is determined without any one of them, so that their scatter tells its
deviation; with fewer, the scatter of the corners does."""
HUBER = 2.0
"""Residual above which a corner gets less weight [standard deviations]."""
ROUNDS = 3
MOST_STEPS = 60
"""Number of rounds of robust weights of the answer, and the largest number of evaluations in each. Fits that only give
a start have one round."""
LENS_STEP_PX = 10.0
"""Largest move of pixels by each parameter of a lens in a step that tells what follows the lens [px rms]."""


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
    """Number of coordinates of corners minus number of parameters."""
    left_out: tuple[str, ...] = ()
    """Coefficients that the corners do not determine."""

    @property
    def deviations(self) -> dict[str, float]:
        """Standard deviations of the free parameters of the lens, by name."""
        deviations = np.sqrt(np.diag(self.covariance))
        return dict(zip(self.names, deviations.tolist(), strict=True))

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
        # Axes of the correlation, as steps of one deviation.
        deviations = list(self.deviations.values())
        spread = np.maximum(deviations, 1e-12)
        correlation = self.covariance / np.outer(spread, spread)
        shares, axes = np.linalg.eigh(correlation)
        lengths_of_axes = np.sqrt(np.maximum(shares, 0.0))
        whole = (spread[:, None] * axes * lengths_of_axes).T

        moves = self._moves_of_pixels(xy)
        most_px = np.maximum(np.abs(whole) * moves, 1e-12).max(axis=1)
        lengths = np.minimum(1.0, LENS_STEP_PX / most_px)
        return lengths[:, None] * whole, lengths

    def _moves_of_pixels(self, xy: NDArray[Any]) -> Vector:
        """Return by how much each free parameter moves pixels [px rms per unit]."""
        rays = np.asarray(self.camera.pixels_to_rays(xy.astype(np.float64)), np.float64)
        valid = rays[np.isfinite(rays).all(axis=1)]
        _, by_all = Projection(self.camera).of(np.zeros(6), valid)
        squares = (by_all**2).sum(axis=1).mean(axis=0)
        known = parameter_names(self.camera)
        free = [known.index(name) for name in self.names]
        return np.asarray(np.sqrt(squares)[free])


def fit_lens(camera: Camera, board: Board, seen: Sequence[Corners]) -> Fit:
    """Return the lens with as many coefficients as the corners determine, and the poses of the board.

    ``camera`` is the start. A lens without distortion starts as a radial-tangential one. Raises :class:`AmiwarpError`
    if the poses do not determine the focal length.
    """
    lens = type(camera.distortion or RadialTangential())
    rough = replace(camera, distortion=lens())
    # A wrong focal length can turn over a pose that is nearly frontal: with a better one the poses are found again.
    for _ in range(2):
        poses = np.array([first_pose(rough, board, corners) for corners in seen])
        best = _fit(rough, poses, board, seen, INTRINSICS, rounds=1)
        rough = best.camera
    best = _fit(best.camera, best.poses, board, seen, INTRINSICS)

    # Coefficients are freed group by group, as far as the corners tell.
    names = INTRINSICS
    left_out: list[str] = []
    for group in GROUPS[lens]:
        is_rational = group == RATIONAL
        if is_rational and "k3" not in names:
            # The rational model is for lenses that a third coefficient does not describe.
            left_out += group
            continue
        more = _fit(best.camera, best.poses, board, seen, (*names, *group))
        if _gain_is_real(best, more, len(group)) and _is_seen_through(more.camera, seen):
            best = more
            names = (*names, *group)
        else:
            left_out += group
    _check_focal_length(best, seen)
    return replace(best, left_out=tuple(left_out))


def _check_focal_length(best: Fit, seen: Sequence[Corners]) -> None:
    """Raise :class:`AmiwarpError` if the poses do not determine the focal length, with what would."""
    off = best.deviations["fx"] / best.camera.fx
    if off <= LARGEST_FOCAL_DEVIATION:  # False for NaN
        return
    tilts = np.degrees([tilt_of(pose) for pose in best.poses])
    image = [best.camera.width, best.camera.height]
    spans = []
    for corners in seen:
        extent = np.ptp(corners.xy, axis=0)
        spans.append(np.max(extent / image))
    span = float(np.median(spans))
    excess = off / LARGEST_FOCAL_DEVIATION
    tilt = math.radians(np.median(tilts))
    remedy = _what_determines_it(excess, tilt, span)
    raise AmiwarpError(
        f"{UNDETERMINED} ({100.0 * off:.1f} % standard deviation): the board is tilted by {min(tilts):.0f} to "
        f"{max(tilts):.0f} deg and spans {100.0 * span:.0f} % of the image; {remedy}"
    )


def _what_determines_it(excess: float, tilt: float, span: float) -> str:
    """Return what to do about a focal length whose deviation is ``excess`` times the largest of an answer.

    ``tilt``: median of the poses [rad]; ``span``: share of the image's width or height that their boards span.
    """
    if tilt < STEEP:
        if span < SMALL:
            return f"{TILT}, and hold it nearer"
        return TILT
    nearer = min(excess ** (1.0 / GAIN_OF_NEARNESS), FULL / span)
    if nearer < 1.1:
        return "record more poses"
    return f"hold it {nearer:.1f} times nearer, where it spans {100.0 * nearer * span:.0f} %, or record more poses"


def _gain_is_real(less: Fit, more: Fit, count: int) -> bool:
    """Return whether ``count`` more parameters explain more than noise alone would: F-test."""
    from scipy.stats import f

    if more.freedom <= 0 or more.cost <= 0.0:
        return False
    gain = (less.cost - more.cost) / count
    noise = more.cost / more.freedom
    ratio = gain / noise
    chance = f.sf(max(ratio, 0.0), count, more.freedom)
    return bool(chance < LARGEST_CHANCE)


def _is_seen_through(camera: Camera, seen: Sequence[Corners]) -> bool:
    """Return whether all corners lie where the lens does not fold. A rational one can have a pole between them."""
    xy = np.concatenate([corners.xy for corners in seen])
    rays = np.asarray(camera.pixels_to_rays(xy))
    return bool(np.isfinite(rays).all())


class _Residuals:
    """Residuals of all corners, and their derivatives, by a vector of the free parameters of the lens and all poses."""

    def __init__(
        self,
        camera: Camera,
        board: Board,
        seen: Sequence[Corners],
        names: tuple[str, ...],
    ) -> None:
        """Set up the problem. ``camera``: values of the parameters that stay; ``names``: parameters that are free."""
        self._camera = camera
        self._names = names
        self._all_names = parameter_names(camera)
        self._points = [board.points[corners.ids] for corners in seen]
        self._xy = np.concatenate([corners.xy for corners in seen])
        self.ends = [0]
        """Rows at which the poses begin and end."""
        for points in self._points:
            self.ends.append(self.ends[-1] + 2 * len(points))
        # Residuals and their derivatives are asked for at the same place in turn.
        self._projected = lru_cache(maxsize=1)(self._project)

    def vector_of(self, poses: Vector) -> Vector:
        """Return the vector of the camera and of poses, shape (poses, 6)."""
        lens = lens_values(self._camera, self._names)
        return np.concatenate([list(lens.values()), poses.ravel()])

    def lens_of(self, vector: Vector) -> Camera:
        """Return the camera of a vector."""
        free = vector[: len(self._names)].tolist()
        values = dict(zip(self._names, free, strict=True))
        return with_lens_values(self._camera, values)

    def poses_of(self, vector: Vector) -> Vector:
        """Return the poses of a vector, shape (poses, 6)."""
        return vector[len(self._names) :].reshape(-1, 6)

    def residuals(self, vector: Vector) -> Vector:
        """Return predicted minus seen coordinates, shape (rows,)."""
        of_poses = self._projected(vector.tobytes())
        predicted = np.concatenate([xy for xy, _ in of_poses])
        return np.asarray((predicted - self._xy).ravel())

    def jacobian(self, vector: Vector) -> Vector:
        """Return the derivatives of the residuals, shape (rows, parameters)."""
        count = len(self._names)
        free = [self._all_names.index(name) for name in self._names]
        jacobian = np.zeros((self.ends[-1], len(vector)))
        for k, (_, by) in enumerate(self._projected(vector.tobytes())):
            rows = slice(self.ends[k], self.ends[k + 1])
            first = count + 6 * k
            of_pose = slice(first, first + 6)
            by_all = by.reshape(-1, by.shape[2])
            jacobian[rows, :count] = by_all[:, free]
            jacobian[rows, of_pose] = by_all[:, len(self._all_names) :]
        return jacobian

    def _project(self, vector: bytes) -> list[tuple[Vector, Vector]]:
        """Return pixels and derivatives of the corners of each pose."""
        values = np.frombuffer(vector)
        lens = Projection(self.lens_of(values))
        poses = self.poses_of(values)
        return [lens.of(pose, points) for pose, points in zip(poses, self._points, strict=True)]


def _fit(
    camera: Camera,
    poses: Vector,
    board: Board,
    seen: Sequence[Corners],
    names: tuple[str, ...],
    rounds: int = ROUNDS,
) -> Fit:
    """Return the fit of the parameters ``names`` of the lens, and of all poses, from a start."""
    problem = _Residuals(camera, board, seen, names)

    # Robust weights by the residuals of the round before.
    vector = problem.vector_of(poses)
    weight = np.ones(problem.ends[-1])
    for _ in range(rounds):
        vector = _weighted_fit(problem, vector, np.sqrt(weight))
        residuals = problem.residuals(vector)
        magnitudes = np.abs(residuals)
        deviation = 1.4826 * float(np.median(magnitudes))
        limit = HUBER * max(deviation, 1e-6)
        weight = np.minimum(1.0, limit / np.maximum(magnitudes, 1e-12))

    root = np.sqrt(weight)
    jacobian = problem.jacobian(vector) * root[:, None]
    freedom = len(residuals) - len(vector)
    cost = float((weight * residuals**2).sum())
    count = len(names)
    if len(seen) < ENOUGH_TO_LEAVE_ONE:
        inverse = np.linalg.pinv(jacobian.T @ jacobian)
        covariance = inverse[:count, :count] * cost / max(freedom, 1)
    else:
        covariance = _jackknife(jacobian, root * residuals, count, problem.ends)
    starts_of_poses = [end // 2 for end in problem.ends[1:-1]]
    of_poses = np.split(residuals.reshape(-1, 2), starts_of_poses)
    return Fit(
        camera=problem.lens_of(vector),
        poses=problem.poses_of(vector),
        names=names,
        covariance=covariance,
        residuals=tuple(of_poses),
        cost=cost,
        freedom=freedom,
    )


def _weighted_fit(problem: _Residuals, start: Vector, root: Vector) -> Vector:
    """Return the vector of lens and poses that minimises the residuals times ``root``, from a start."""
    from scipy.optimize import least_squares

    def weighted(vector: Vector) -> Vector:
        return root * problem.residuals(vector)

    def weighted_jacobian(vector: Vector) -> Vector:
        return root[:, None] * problem.jacobian(vector)

    try:
        found = least_squares(
            weighted,
            start,
            weighted_jacobian,
            method="lm",
            x_scale="jac",
            ftol=1e-7,
            max_nfev=MOST_STEPS,
        )
    except AmiwarpError as error:  # a lens that cannot be
        raise AmiwarpError(
            f"{UNDETERMINED}: the fit runs away; {TILT}, and hold it near"
        ) from error
    return np.asarray(found.x)


def _jackknife(jacobian: Vector, residuals: Vector, count: int, ends: list[int]) -> Vector:
    """Return the covariance of the first ``count`` parameters, of the lens: the jackknife over the poses, linearised.

    The errors of the corners of a pose are correlated, so the scatter of the residuals alone would give too small
    deviations. ``ends`` are the rows at which the poses begin and end.
    """
    hessians: list[Vector] = []
    gradients: list[Vector] = []
    for k, (start, end) in enumerate(pairwise(ends)):
        first = count + 6 * k
        by_lens = jacobian[start:end, :count]
        by_pose = jacobian[start:end, first : first + 6]
        # What the pose can explain, tells nothing of the lens.
        explained, *_ = np.linalg.lstsq(by_pose, by_lens, rcond=None)
        by_lens = by_lens - by_pose @ explained
        hessians.append(by_lens.T @ by_lens)
        gradients.append(by_lens.T @ residuals[start:end])

    # How far the lens moves without each of the poses.
    poses = len(hessians)
    total = np.sum(hessians, axis=0)
    moves = []
    for hessian, gradient in zip(hessians, gradients, strict=True):
        inverse = np.linalg.pinv(total - hessian)
        moves.append(inverse @ gradient)
    moved = np.stack(moves)
    return np.asarray((poses - 1) * np.cov(moved.T, bias=True))
