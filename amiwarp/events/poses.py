"""Poses of a camera and of moving bodies over time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.stores import StoredRows
from amiwarp.schema.calls import guarded
from amiwarp.schema.type_names import not_called
from amiwarp.validation import check_ascending, finite, shown

Rows = NDArray[np.float64]


@guarded
@dataclass(frozen=True, eq=False)
class Poses:
    """Poses of a camera and of moving bodies, and positions of joints, at several times.

    A pose has seven numbers: the position x, y, z in the world [m], and the orientation as a unit quaternion x, y, z,
    w. The quaternion rotates from the frame of the camera or body to the world's frame. Raises :class:`AmiwarpError`
    for other shapes, times that do not increase, and values that are not finite.

    Examples
    --------
    >>> import numpy as np
    >>> poses = amiwarp.Poses(t=np.array([0, 1000]), camera=np.tile([0.0, 0, 0, 0, 0, 0, 1], (2, 1)))
    >>> poses[:1].t.tolist()
    [0]
    """

    t: NDArray[np.int64]
    """Times of the poses, on the clock of the events [us], increasing, shape ``(k,)``."""
    camera: NDArray[np.float64]
    """Poses of the camera, shape ``(k, 7)``."""
    bodies: Mapping[str, NDArray[np.float64]] = field(default_factory=dict)
    """Poses of the moving bodies by name, shape ``(k, 7)`` each."""
    joints: Mapping[str, NDArray[np.float64]] = field(default_factory=dict)
    """Positions of named points in the world, such as joints [m], shape ``(k, 3)`` each."""

    def __post_init__(self) -> None:
        if self.t.ndim != 1 or self.t.dtype != np.int64:
            raise AmiwarpError(
                f"poses have {self.t.dtype} times of shape {self.t.shape}; give int64 times [us] of shape (k,)"
            )
        check_ascending(self.t, "pose")
        self._check_rows("camera", self.camera, 7)
        for name, rows in self.bodies.items():
            self._check_rows(name, rows, 7)
        for name, rows in self.joints.items():
            self._check_rows(name, rows, 3)

    def _check_rows(self, name: str, rows: NDArray[np.float64], columns: int) -> None:
        """Raise :class:`AmiwarpError` if the poses of a body or joint have another shape, or are not finite."""
        count = self.t.size
        if rows.shape != (count, columns):
            raise AmiwarpError(
                f"poses of {shown(name)} have shape {rows.shape} for {count} times; give shape "
                f"({count}, {columns})"
            )
        finite(rows, f"poses of {shown(name)}")

    @classmethod
    def concatenate(cls, blocks: Sequence[Poses]) -> Poses:
        """Join successive tables of poses.

        Parameters
        ----------
        blocks : sequence of Poses
            At least one table. All tables have the same bodies and joints.

        Returns
        -------
        Poses
            The joined table.
        """
        if not blocks:
            raise AmiwarpError("poses are joined of no tables; give at least one")
        t = np.concatenate([block.t for block in blocks])
        camera = np.concatenate([block.camera for block in blocks])
        bodies = _joined([block.bodies for block in blocks])
        joints = _joined([block.joints for block in blocks])
        return cls(t, camera, bodies, joints)

    def __len__(self) -> int:
        return len(self.t)

    def __getitem__(self, which: slice, /) -> Poses:
        bodies = {name: rows[which] for name, rows in self.bodies.items()}
        joints = {name: rows[which] for name, rows in self.joints.items()}
        return Poses(self.t[which], self.camera[which], bodies, joints)


def _joined(tables: Sequence[Mapping[str, Rows]]) -> dict[str, Rows]:
    """Return the rows of successive tables, by name."""
    joined = {}
    for name in tables[0]:
        joined[name] = np.concatenate([table[name] for table in tables])
    return joined


def as_poses(rotation: Rows, position: Rows) -> Rows:
    """Convert rotation matrices ``(..., 3, 3)`` and positions ``(..., 3)`` [m] to poses of shape ``(..., 7)``.

    Raises :class:`AmiwarpError` for matrices that are no rotations. SciPy would replace them by the nearest rotation,
    and never returns for infinite values.
    """
    check_rotation(rotation)
    from scipy.spatial.transform import Rotation

    matrices = rotation.reshape(-1, 3, 3)
    quaternions = Rotation.from_matrix(matrices).as_quat()
    by_position = quaternions.reshape(*position.shape[:-1], 4)
    return np.concatenate([position, by_position], axis=-1)


def check_rotation(rotation: NDArray[Any]) -> None:
    """Raise :class:`AmiwarpError` if an array does not hold rotation matrices, shape ``(..., 3, 3)``."""
    if rotation.shape[-2:] != (3, 3):
        raise AmiwarpError(f"rotation has shape {rotation.shape}; expected (3, 3)")
    if not (np.abs(rotation) <= 1.0 + ROTATION_TOLERANCE).all():  # also refuses NaN
        raise AmiwarpError(
            "rotation holds a value that is not within -1 .. 1; expected a rotation matrix"
        )
    product = rotation @ np.swapaxes(rotation, -2, -1)
    orthonormal = (np.abs(product - np.eye(3)) <= ROTATION_TOLERANCE).all()
    if not orthonormal or (np.linalg.det(rotation) < 0.0).any():
        raise AmiwarpError(
            "rotation is no rotation matrix: its rows must be orthogonal, of length 1, and right-handed; "
            "amiwarp's camera looks along z, with x to the right and y down"
        )


ROTATION_TOLERANCE = 0.01
"""Largest deviation of the products of a rotation matrix's rows from the identity matrix."""


def rotation_of(pose: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rotation matrix ``(3, 3)`` of a pose of shape ``(7,)``."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_quat(pose[3:]).as_matrix())


@not_called("make poses as amiwarp.Poses(t, camera)")
class PoseStore(StoredRows[Poses], Protocol):
    """Protocol of tables of poses: :class:`amiwarp.Poses`, or a file that is read on demand."""

    def __len__(self) -> int:
        """Return the number of times."""
