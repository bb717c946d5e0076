"""Trajectory of a camera that is fixed to a moving rig."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from amiwarp.simulation.worlds.trajectory import Trajectory, derivatives_of


class MountedTrajectory(Trajectory):
    """Trajectory of a camera that is fixed to a rig, which follows another trajectory.

    Poses and their derivatives are the rig's at the same time, composed with the place of the camera. They are not
    interpolated between composed poses, so that cameras of one rig never move relative to each other.
    """

    def __init__(self, rig: Trajectory, to_rig: NDArray[np.float64]) -> None:
        """Mount a camera.

        ``rig``: trajectory of the rig; ``to_rig``: matrix that turns points of the camera's frame into the rig's,
        shape (3, 4), its last column in m.
        """
        from scipy.spatial.transform import Rotation

        object.__setattr__(self, "_rig", rig)
        object.__setattr__(self, "_turn", to_rig[:, :3].copy())
        object.__setattr__(self, "_lever", to_rig[:, 3].copy())
        of_rig = Rotation.from_quat(np.asarray(rig.rotation, np.float64))
        rotation, position = self._composed(
            of_rig.as_matrix(), np.asarray(rig.position, np.float64)
        )
        super().__init__(rig.t, position, Rotation.from_matrix(rotation).as_quat())

    _rig: Trajectory
    _turn: NDArray[np.float64]
    _lever: NDArray[np.float64]

    def _composed(
        self, rotation: NDArray[np.float64], position: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the camera's poses at poses of the rig, shapes (k, 3, 3) and (k, 3)."""
        return rotation @ self._turn, position + rotation @ self._lever

    @property
    def moves(self) -> bool:
        """Whether the rig moves."""
        return self._rig.moves

    def poses(self, t: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the camera's orientations and positions at times [s], as :meth:`amiwarp.Trajectory.poses`."""
        return self._composed(*self._rig.poses(t))

    def _derivatives(
        self, t: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Return how the camera moves: with the rig, and around its origin."""
        acceleration, rate, rate_change = derivatives_of(self._rig, t)
        rotation, _ = self._rig.poses(t)
        tangential = np.cross(rate_change, self._lever)
        centripetal = np.cross(rate, np.cross(rate, self._lever))
        around = np.einsum("nij,nj->ni", rotation, tangential + centripetal)
        # Rows of vectors times the matrix are its transpose applied to each: from the rig's axes to the camera's.
        return acceleration + around, rate @ self._turn, rate_change @ self._turn
