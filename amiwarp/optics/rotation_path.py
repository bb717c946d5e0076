"""Path of a camera's orientation over time, integrated from the rates of a gyroscope."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.schema.calls import guarded
from amiwarp.validation import TIME_LIMIT, as_times, finite, vector, whole

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

STEP_US = 500
"""Time between two orientations of a path [us]. Between them, rotation vectors are interpolated: at 50 rad/s², which is
a hard shake, that leaves 2e-6 rad."""
LARGEST_LENGTH_ERROR = 1e-3
"""Largest deviation of a quaternion's length from 1."""
LONGEST_US = 10_000_000
"""Longest path [us]."""


@guarded
@dataclass(frozen=True, eq=False)
class RotationPath:
    """Orientations of a camera every 500 us, relative to the first one.

    Raises :class:`AmiwarpError` if the quaternions are no array of two unit quaternions or more.

    Examples
    --------
    >>> import numpy as np
    >>> t = np.array([0, 10_000])
    >>> path = amiwarp.RotationPath.from_rates(t, np.array([[0.0, 1.0, 0.0]] * 2), (0, 10_000))
    >>> path.vectors(0)[-1].round(4).tolist()
    [0.0, 0.01, 0.0]
    """

    start_us: int
    """Time of the first orientation [us]."""
    quaternions: NDArray[np.float64]
    """Unit quaternions (x, y, z, w) from the camera's frame at each time to that at the first, shape ``(n, 4)``."""

    def __post_init__(self) -> None:
        whole(self.start_us, "start_us", -TIME_LIMIT, TIME_LIMIT)
        q = self.quaternions
        if q.dtype != np.float64 or q.ndim != 2 or q.shape[1] != 4 or len(q) < 2:
            raise AmiwarpError(
                f"quaternions are {q.dtype} of shape {q.shape}; give float64 of shape (n, 4), n from 2"
            )
        if not (np.abs(np.linalg.norm(q, axis=1) - 1.0) < LARGEST_LENGTH_ERROR).all():
            raise AmiwarpError(
                "a quaternion of the path has another length than 1; give unit quaternions (x, y, z, w)"
            )

    @classmethod
    def from_rates(
        cls, t: NDArray[np.int64], rates: NDArray[np.float64], span: tuple[int, int]
    ) -> RotationPath:
        """Return the path over a time span, integrated from angular velocities.

        Parameters
        ----------
        t : numpy.ndarray
            Times of the angular velocities [us], int64, increasing, shape (n,).
        rates : numpy.ndarray
            Angular velocities in the camera's frame [rad/s], shape (n, 3). Between them, they are interpolated.
        span : tuple of int
            First and last time of the path [us].

        Returns
        -------
        RotationPath
            The path.

        Raises
        ------
        AmiwarpError
            If the arrays have other shapes or types, the rates do not cover the span, or it is longer than 10 s.

        Notes
        -----
        Each step rotates by the angular velocity in its middle. The rates are in the moving frame, so that each step is
        multiplied from the right.
        """
        from scipy.spatial.transform import Rotation

        if (
            t.dtype != np.int64
            or t.ndim != 1
            or rates.dtype != np.float64
            or rates.shape != (len(t), 3)
        ):
            raise AmiwarpError(
                f"times are {t.dtype} of shape {t.shape}, rates {rates.dtype} of shape {rates.shape}; give int64 of "
                "shape (n,) and float64 of shape (n, 3)"
            )
        if not np.isfinite(rates).all() or (np.diff(t) < 0).any():
            raise AmiwarpError(
                "rates are not finite, or their times decrease; give finite rates in order of time"
            )
        first, last = vector(span, 2, "span", partial(whole, low=-TIME_LIMIT, high=TIME_LIMIT))
        if not len(t) or t[0] > first or t[-1] < last:
            raise AmiwarpError(
                f"the gyroscope does not cover the time from {first} to {last} us; give a span within its times"
            )
        if not 0 < last - first <= LONGEST_US:
            raise AmiwarpError(
                f"the path of a camera lasts {(last - first) * 1e-6:g} s; expected above 0 and up to 10 s"
            )
        steps = math.ceil((last - first) / STEP_US)
        middles_us = STEP_US * (np.arange(steps) + 0.5)
        times_us = (t - first).astype(np.float64)
        rates_in_middles = [np.interp(middles_us, times_us, rate) for rate in rates.T]
        turned = np.stack(rates_in_middles, axis=1) * (STEP_US * 1e-6)

        orientation = Rotation.identity()
        orientations = [orientation]
        for step in Rotation.from_rotvec(turned):
            orientation = orientation * step
            orientations.append(orientation)
        return cls(first, np.stack([rotation.as_quat() for rotation in orientations]))

    @property
    def stop_us(self) -> int:
        """Time of the last orientation [us]."""
        return self.start_us + STEP_US * (len(self.quaternions) - 1)

    def orientations(self, t: ArrayLike) -> Rotation:
        """Return the rotations from the camera's frame at given times to that at the first time of the path.

        Parameters
        ----------
        t : array_like
            Times [us], shape (k,). Those outside the path count as its ends.

        Returns
        -------
        scipy.spatial.transform.Rotation
            The rotations.
        """
        from scipy.spatial.transform import Rotation

        times = np.atleast_1d(as_times(t, "t"))
        if times.ndim != 1:
            raise AmiwarpError(f"t has shape {times.shape}; give times of shape (k,)")
        known = Rotation.from_quat(self.quaternions)
        last = len(self.quaternions) - 1

        # Each time lies in a step, and turns by its share of the step's rotation.
        position = np.clip((times - self.start_us).astype(np.float64) / STEP_US, 0.0, last)
        before = np.minimum(position.astype(np.int64), last - 1)
        step = (known[before].inv() * known[before + 1]).as_rotvec()
        return known[before] * Rotation.from_rotvec((position - before)[:, None] * step)

    def vectors(self, middle_us: int) -> NDArray[np.float64]:
        """Return the rotation at each time of the path since a reference time.

        Parameters
        ----------
        middle_us : int
            Reference time [us].

        Returns
        -------
        numpy.ndarray
            Rotations as axis times angle [rad], shape (n, 3).
        """
        from scipy.spatial.transform import Rotation

        middle = self.orientations([middle_us])
        return np.asarray((middle.inv() * Rotation.from_quat(self.quaternions)).as_rotvec())

    def at(self, tau: NDArray[np.float64], middle_us: int) -> NDArray[np.float64]:
        """Return the rotation since a reference time at other times.

        Parameters
        ----------
        tau : numpy.ndarray
            Times after the reference time [s], shape (k,).
        middle_us : int
            Reference time [us].

        Returns
        -------
        numpy.ndarray
            Rotations as axis times angle [rad], shape (k, 3).
        """
        if tau.ndim != 1 or tau.dtype.kind not in "iuf":
            raise AmiwarpError(
                f"tau is {tau.dtype} of shape {tau.shape}; give seconds of shape (k,)"
            )
        finite(tau, "times tau")
        middle_us = whole(middle_us, "middle_us", -TIME_LIMIT, TIME_LIMIT)
        start_us = float(self.start_us - middle_us)
        known_s = (start_us + STEP_US * np.arange(len(self.quaternions))) * 1e-6
        components = self.vectors(middle_us).T
        return np.stack([np.interp(tau, known_s, values) for values in components], axis=1)


@lru_cache(maxsize=32)
def rotation_table(path: RotationPath, middle_us: int, device: str) -> Any:
    """Return :meth:`RotationPath.vectors` as a Warp array on a device."""
    import warp as wp

    return wp.array(path.vectors(middle_us).astype(np.float32), dtype=wp.vec3, device=device)
