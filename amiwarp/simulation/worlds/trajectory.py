"""Pose of a camera or a body of a simulated world over time."""

from __future__ import annotations

from array import array as plain_array
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.io.inputs import text_lines
from amiwarp.io.output_formats import POSE_ENDINGS, check_ending
from amiwarp.io.outputs import write_text
from amiwarp.schema.calls import guarded
from amiwarp.validation import array, real, shown

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

LARGEST_SPEED = 1e3
"""Largest speed of a body or camera [m/s]. A higher speed is refused as a jump."""

LARGEST_TURN_RATE = 1e3
"""Largest angular velocity of a body or camera [rad/s]. A higher angular velocity is refused as a jump."""
MOST_POSES = 500_000
"""Largest number of poses of a trajectory: 8 minutes at 1 kHz. Its splines take 1.7 kB for each pose."""
COLUMNS = 8
"""Number of columns of a table of poses: t, x, y, z, qx, qy, qz, qw."""
FARTHEST_M = 1e9
"""Largest coordinate of a camera that looks at a point, and of that point [m]."""


@guarded
@dataclass(frozen=True, eq=False)
class Trajectory:
    """Pose of a camera or a body over time, interpolated smoothly between given poses.

    With three or more poses the position follows a cubic spline and the orientation a spline with continuous angular
    acceleration; with two poses both change linearly. Before the first and after the last pose nothing moves. Raises
    :class:`AmiwarpError` if arrays have the wrong shape, if times do not increase, or if the trajectory jumps.

    Examples
    --------
    >>> import numpy as np
    >>> path = amiwarp.Trajectory([0.0, 1.0], [[0, 0, 0], [1, 0, 0]], [[0, 0, 0, 1], [0, 0, 0, 1]])
    >>> rotation, position = path.poses(np.array([0.25]))
    >>> position.tolist()
    [[0.25, 0.0, 0.0]]
    """

    t: ArrayLike
    """Times from the start of the recording [s], increasing, shape ``(n,)``."""
    position: ArrayLike
    """Positions in the world [m], shape ``(n, 3)``."""
    rotation: ArrayLike
    """Orientations as unit quaternions (x, y, z, w), shape ``(n, 4)``.

    A quaternion rotates from the frame of the camera or body to the world's frame.
    """

    def __post_init__(self) -> None:
        t = array(self.t, "trajectory's times").astype(np.float64)
        position = array(self.position, "trajectory's positions").astype(np.float64)
        rotation = array(self.rotation, "trajectory's orientations").astype(np.float64)
        if t.size > MOST_POSES:
            raise AmiwarpError(
                f"trajectory has {t.size} poses; give at most {MOST_POSES}, at a lower rate"
            )
        shapes_fit = position.shape == (t.size, 3) and rotation.shape == (t.size, 4)
        if t.ndim != 1 or not t.size or not shapes_fit:
            raise AmiwarpError(
                f"trajectory has times {t.shape}, positions {position.shape}, orientations {rotation.shape}; "
                "give shapes (n,), (n, 3) and (n, 4)"
            )
        is_finite = np.isfinite(np.column_stack([t, position, rotation])).all(axis=1)
        if not is_finite.all():
            first = int(np.argmin(is_finite))
            raise AmiwarpError(
                f"trajectory holds values that are not finite, first in pose {first}; remove such poses"
            )
        increases = np.diff(t) > 0
        if not increases.all():
            later = int(np.argmin(increases)) + 1
            raise AmiwarpError(
                f"trajectory's times do not increase: pose {later} at {t[later]:.6g} s follows {t[later - 1]:.6g} s; "
                "sort the poses and remove duplicates"
            )
        with np.errstate(over="ignore"):  # the length of huge values is infinite
            length = np.linalg.norm(rotation, axis=1, keepdims=True)
        deviation = np.abs(length - 1.0)
        if not (deviation < 0.01).all():
            worst = int(np.argmax(deviation))
            raise AmiwarpError(
                f"trajectory has a quaternion of length {float(length[worst, 0]):.3g} in pose {worst}; give unit "
                "quaternions"
            )
        object.__setattr__(self, "t", t)
        object.__setattr__(self, "position", position)
        object.__setattr__(self, "rotation", rotation / length)
        self._check_jumps()

    def _check_jumps(self) -> None:
        """Raise :class:`AmiwarpError` if the camera or body moves or turns too fast between two poses."""
        t, position = self._table()
        if t.size < 2:
            return
        step = np.diff(t)
        with np.errstate(over="ignore"):
            speed = np.linalg.norm(np.diff(position, axis=0), axis=1) / step
        orientation = self._orientation
        rate = (orientation[:-1].inv() * orientation[1:]).magnitude() / step
        self._check_speeds(speed, rate)

    def _check_speeds(self, speed: NDArray[np.float64], rate: NDArray[np.float64]) -> None:
        """Raise :class:`AmiwarpError` if a speed [m/s] or an angular velocity [rad/s] between two poses is too high."""
        self._check_speed("moves", speed, LARGEST_SPEED, "m/s")
        self._check_speed("turns", rate, LARGEST_TURN_RATE, "rad/s")

    def _check_speed(self, what: str, speeds: NDArray[np.float64], limit: float, unit: str) -> None:
        """Raise :class:`AmiwarpError` if any speed between two poses is above a limit."""
        if speeds.max() > limit:
            t, _ = self._table()
            fastest_s = float(t[int(np.argmax(speeds))])
            raise AmiwarpError(
                f"trajectory {what} at {speeds.max():.3g} {unit} after {fastest_s:.6g} s, "
                f"faster than {limit:g} {unit}; "
                "check the units of the times (s) and positions (m), or split the trajectory at the jump"
            )

    def _table(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return times [s] and positions [m] as arrays."""
        return np.asarray(self.t, np.float64), np.asarray(self.position, np.float64)

    @property
    def moves(self) -> bool:
        """Whether any two of the given poses differ."""
        position = np.asarray(self.position)
        rotation = np.asarray(self.rotation)
        return bool((position != position[0]).any() or (rotation != rotation[0]).any())

    @cached_property
    def _orientation(self) -> Any:
        """Orientations of all poses, as one ``Rotation``."""
        from scipy.spatial.transform import Rotation

        return Rotation.from_quat(np.asarray(self.rotation, np.float64))

    @cached_property
    def _splines(self) -> tuple[Any, Any]:
        """Splines of the orientation and of the position over time [s]."""
        from scipy.interpolate import CubicSpline
        from scipy.spatial.transform import RotationSpline

        times, position = self._table()
        return RotationSpline(times, self._orientation), CubicSpline(times, position)

    def poses(self, t: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the orientations and positions at given times.

        Parameters
        ----------
        t : array_like
            Times [s], shape ``(k,)``.

        Returns
        -------
        rotation : ndarray
            Rotation matrices from the frame of the camera or body to the world's frame, shape ``(k, 3, 3)``.
        position : ndarray
            Positions in the world [m], shape ``(k, 3)``.

        Raises
        ------
        AmiwarpError
            If the times are no one-dimensional array of numbers, or hold NaN.
        """
        from scipy.spatial.transform import Slerp

        times, position = self._table()
        given = checked_times(t)
        inside = np.clip(given, times[0], times[-1])
        if times.size == 1:
            turns = np.repeat(self._orientation.as_matrix(), inside.size, axis=0)
            places = np.repeat(position, inside.size, axis=0)
            return turns, places
        if times.size == 2:
            share = (inside - times[0]) / (times[1] - times[0])
            between = position[0] + share[:, None] * (position[1] - position[0])
            return Slerp(times, self._orientation)(inside).as_matrix(), between
        turn, place = self._splines
        return turn(inside).as_matrix(), np.asarray(place(inside))

    def _poses_near(
        self, t: NDArray[np.float64], later: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return what :func:`poses_near` returns."""
        return self.poses(later)

    def _changes(self, stop: float) -> NDArray[np.float64]:
        """Return what :func:`abrupt_changes` returns."""
        return np.empty(0)

    def _derivatives(
        self, t: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Return what :func:`derivatives_of` returns."""
        from scipy.spatial.transform import Rotation

        times = np.asarray(self.t, np.float64)
        nothing = np.zeros((len(t), 3))
        if len(times) == 1:
            return nothing, nothing.copy(), nothing.copy()
        if len(times) == 2:
            ends: Any = Rotation.from_quat(np.asarray(self.rotation, np.float64))
            rate = (ends[0].inv() * ends[1]).as_rotvec() / (times[1] - times[0])
            return nothing, np.tile(rate, (len(t), 1)), nothing.copy()
        turn, place = self._splines
        return np.asarray(place(t, 2)), turn(t, 1), turn(t, 2)

    @classmethod
    def still(
        cls,
        position: ArrayLike,
        *,
        look_at: ArrayLike | None = None,
        rotation: ArrayLike | None = None,
    ) -> Trajectory:
        """Return a trajectory that never moves.

        Parameters
        ----------
        position : array_like
            Position [m], shape ``(3,)``.
        look_at : array_like, optional
            Point in the world that the camera looks at [m], shape ``(3,)``.
        rotation : array_like, optional
            Orientation as a unit quaternion (x, y, z, w), from the frame of the camera or body to the world's frame; by
            default the world's own.

        Returns
        -------
        Trajectory
            Trajectory with one pose for all times.

        Raises
        ------
        AmiwarpError
            If both ``look_at`` and ``rotation`` are given, or one of the arguments is not usable.
        """
        if look_at is not None and rotation is not None:
            raise AmiwarpError(
                "look_at and rotation are both given; give one of them", ErrorCode.OPTIONS
            )
        quaternion: ArrayLike = (0, 0, 0, 1) if rotation is None else rotation
        if look_at is not None:
            quaternion = looking_at(position, look_at).as_quat()
        return cls([0.0], array(position, "position")[None], array(quaternion, "rotation")[None])

    @classmethod
    def from_function(
        cls,
        pose: Callable[[float], tuple[Rotation, ArrayLike]],
        duration_s: float,
        *,
        rate_hz: float = 100.0,
    ) -> Trajectory:
        """Return a trajectory sampled from a function of time.

        Parameters
        ----------
        pose : callable
            Function that returns the orientation (``scipy.spatial.transform.Rotation``) and the position [m] at a time
            [s].
        duration_s : float
            Length of the trajectory [s].
        rate_hz : float
            Number of samples per second.

        Returns
        -------
        Trajectory
            The sampled trajectory.

        Raises
        ------
        AmiwarpError
            If the function returns something else, or the trajectory has too many poses.
        """
        duration_s = real(duration_s, "duration_s", 1e-6, 1e6, " s")
        count = max(2, round(duration_s * real(rate_hz, "rate_hz", 1e-3, 1e6)) + 1)
        if count > MOST_POSES:
            raise AmiwarpError(
                f"trajectory has {count} poses; give at most {MOST_POSES}, by a smaller rate_hz"
            )
        t = np.linspace(0.0, duration_s, count)
        positions = np.empty((count, 3))
        rotations = np.empty((count, 4))
        for k, moment in enumerate(t.tolist()):
            positions[k], rotations[k] = _position_and_quaternion(pose(moment), moment)
        return cls(t, positions, rotations)

    @classmethod
    def from_file(cls, path: str | Path) -> Trajectory:
        """Read a trajectory from a TUM or CSV file of poses.

        Parameters
        ----------
        path : str or Path
            Text file with the columns t [s], x, y, z [m], qx, qy, qz, qw, separated by spaces (TUM) or commas (CSV).
            The file may begin with a header line, in which no word is a number, and contain comments after ``#``.

        Returns
        -------
        Trajectory
            The poses. Times count from the first pose.

        Raises
        ------
        AmiwarpError
            If the file cannot be read, or is not a table of poses.
        """
        path = Path(path)
        values = plain_array("d")
        has_header = False
        for number, line in text_lines(path):
            words = line.split("#")[0].replace(",", " ").split()
            if not words:
                continue
            if not values and not has_header and not any(map(_is_number, words)):
                has_header = True
                continue
            try:
                row = [float(word) for word in words]
            except ValueError as error:
                raise AmiwarpError(
                    f"{path}: line {number} is {line[:60]!r}; expected 8 numbers t x y z qx qy qz qw",
                    ErrorCode.FILE_DAMAGED,
                ) from error
            if len(row) != COLUMNS:
                raise AmiwarpError(
                    f"{path}: line {number} has {len(row)} numbers; expected 8: t x y z qx qy qz qw",
                    ErrorCode.FILE_DAMAGED,
                )
            if len(values) == COLUMNS * MOST_POSES:
                raise AmiwarpError(
                    f"{path}: has over {MOST_POSES} poses; give fewer, at a lower rate"
                )
            values.extend(row)
        if not values:
            raise AmiwarpError(
                f"{path}: holds no poses; expected lines of 8 numbers t x y z qx qy qz qw",
                ErrorCode.CONTENT_MISSING,
            )
        table = np.frombuffer(values).reshape(-1, COLUMNS)
        with np.errstate(invalid="ignore", over="ignore"):  # refused below
            t = table[:, 0] - table[0, 0]
        try:
            return cls(t, table[:, 1:4], table[:, 4:])
        except AmiwarpError as error:
            raise AmiwarpError(f"{path}: {error}") from error

    def save_tum(self, path: str | Path, *, overwrite: bool = False) -> None:
        """Write the poses to a TUM file: lines of t x y z qx qy qz qw, separated by spaces.

        Times are written as they are; :meth:`from_file` counts them from the first pose.

        Parameters
        ----------
        path : str or Path
            File to write, with the suffix .txt or .tum.
        overwrite : bool
            Whether to replace an existing file.
        """
        path = Path(path)
        check_ending(path, "poses are written", POSE_ENDINGS)
        table = np.column_stack([self.t, self.position, self.rotation])
        lines = ["# t x y z qx qy qz qw"]
        for row in table.tolist():
            lines.append(" ".join(map(repr, row)))
        write_text(path, "\n".join(lines) + "\n", overwrite=overwrite)


def checked_times(t: ArrayLike) -> NDArray[np.float64]:
    """Return times [s], shape (k,); raise :class:`AmiwarpError` if they are none, or hold NaN."""
    given = np.atleast_1d(np.asarray(array(t, "t"), np.float64))
    if given.ndim != 1 or np.isnan(given).any():
        what = "holds NaN" if given.ndim == 1 else f"has shape {given.shape}"
        raise AmiwarpError(f"t {what}; give times in seconds, shape (k,)")
    return given


def poses_near(
    trajectory: Trajectory, t: ArrayLike, later: ArrayLike
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the poses at times ``later`` [s], as if the motion at the times ``t`` went on smoothly, each shape (k,).

    Difference quotients of these poses are speeds on one side of a key at which a motion changes abruptly or jumps.
    """
    return trajectory._poses_near(checked_times(t), checked_times(later))


def abrupt_changes(trajectory: Trajectory, stop: float) -> NDArray[np.float64]:
    """Return the times from 0 to ``stop`` [s] at which a motion may change abruptly, increasing.

    There are none in a trajectory of poses, which is smooth.
    """
    return trajectory._changes(stop)


def derivatives_of(
    trajectory: Trajectory, t: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return how a trajectory moves at times [s] between its first and its last pose, each of shape ``(n, 3)``.

    They are the acceleration in the world [m/s^2], and the angular velocity [rad/s] and acceleration [rad/s^2] in the
    frame of the camera or body.
    """
    return trajectory._derivatives(t)


def looking_at(position: ArrayLike, target: ArrayLike, up: ArrayLike = (0.0, 0.0, 1.0)) -> Rotation:
    """Return the orientation of a camera at ``position`` [m] that looks at ``target`` [m].

    ``up``: direction in the world that appears upwards in the image.
    """
    from scipy.spatial.transform import Rotation

    for name, given in (("position", position), ("look_at", target)):
        point = array(given, name)
        if point.shape != (3,) or not (np.abs(point) <= FARTHEST_M).all():
            raise AmiwarpError(
                f"{name} is {shown(given)}; give 3 numbers in m, up to {FARTHEST_M:g}"
            )
    forward = np.asarray(target, np.float64) - np.asarray(position, np.float64)
    distance = float(np.linalg.norm(forward))
    if not distance > 0.0:
        raise AmiwarpError(
            f"look_at is the position {shown(position)} itself; give a target at another place"
        )
    forward /= distance
    right: Any = np.cross(forward, np.asarray(up, np.float64))
    if np.linalg.norm(right) < 1e-9:
        # The camera looks along ``up``: another direction decides.
        other = [0.0, 1.0, 0.0] if abs(forward[1]) < 0.9 else [1.0, 0.0, 0.0]
        right = np.cross(forward, other)
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    return Rotation.from_matrix(np.column_stack([right, down, forward]))


def _position_and_quaternion(result: Any, moment_s: float) -> tuple[Any, Any]:
    """Return the position [m] and the quaternion that a function of time returned for a moment [s]."""
    try:
        rotation, position = result
        numbers = np.asarray(position, np.float64)
        quaternion = np.asarray(rotation.as_quat(), np.float64)
    except (TypeError, ValueError, AttributeError):
        numbers = quaternion = np.zeros(0)
    if numbers.shape != (3,) or quaternion.shape != (4,):
        raise AmiwarpError(
            f"pose returns {shown(result)} at {moment_s:g} s; return a scipy Rotation and a position of 3 numbers in m"
        )
    return numbers, quaternion


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True
