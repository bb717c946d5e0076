"""Trajectory of a body that an animation of a glTF file moves."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.simulation.worlds.node_motion import (
    Node,
    channels_of,
    key_times,
    placed,
    sampled_times,
)
from amiwarp.simulation.worlds.trajectory import Trajectory, checked_times

Array = NDArray[np.float64]

SHORTEST_S = 1e-3
"""Shortest period of an animation that is repeated [s]."""
BESIDE_JUMP_S = 1e-6
"""Time between a jump and the moments to both sides of it that are rendered [s]."""
MOST_CHANGES = 5_000_000
"""Largest number of keys in a recording."""
SAME_PLACE = 1e-9
"""Largest difference of the poses at both ends of an animation that is repeated without a jump."""


@dataclass(frozen=True, eq=False)
class NodeMotion:
    """Motion of a node of a glTF file."""

    animation: str
    """Name of the animation."""
    others: tuple[str, ...]
    """Names of the other animations of the file."""
    end: float
    """Time of the last key of the animation, whichever node it moves [s]."""
    chain: Sequence[Node]
    """Nodes from the root to the node."""
    turn: Array
    """Matrix that turns and scales the file's frame to a frame with z up and metres, shape (3, 3)."""


class AnimatedTrajectory(Trajectory):
    """Exact motion of a node of a glTF file: its keys, their interpolation, and the nodes above it."""

    def __init__(
        self, motion: NodeMotion, *, loop: bool, speed: float, carrier: Trajectory | None
    ) -> None:
        """Follow an animation.

        ``loop``: whether it is repeated after its last key, instead of resting there; ``speed``: seconds of the
        animation per second; ``carrier``: pose of the file's frame in the world, by default the world's frame.
        """
        self_set = object.__setattr__
        scale = float(np.cbrt(np.abs(np.linalg.det(motion.turn))))
        keys = key_times(motion.chain)
        self_set(self, "motion", motion)
        self_set(self, "_axes", motion.turn / scale)
        self_set(self, "_speed", speed)
        self_set(self, "_loop", loop and motion.end > 0.0)
        self_set(self, "_end", motion.end)
        self_set(self, "_keys", keys)
        self_set(self, "_carrier", carrier)
        (shape,), _ = placed(motion.chain, np.zeros(1), np.zeros(1))
        self_set(self, "_unshape", np.linalg.inv(shape))
        if self._loop and motion.end < SHORTEST_S * speed:
            raise AmiwarpError(
                f"animation {motion.animation!r} would be repeated after {motion.end / speed:.3g} s; give "
                "animation_loop = false"
            )
        from scipy.spatial.transform import Rotation

        self_set(self, "_jump_keys", self._all_jumps())
        t = np.unique(sampled_times(motion.chain) / speed)
        rotation, position = self._poses_near(t, t)
        super().__init__(t, position, Rotation.from_matrix(rotation).as_quat())

    motion: NodeMotion
    """The animation and its nodes."""
    _axes: Array
    _speed: float
    _loop: bool
    _end: float
    _keys: Array
    _jump_keys: Array
    _carrier: Trajectory | None
    _unshape: Array

    @property
    def moves(self) -> bool:
        """Whether the animation moves the node, or its frame moves."""
        return super().moves or (self._carrier is not None and self._carrier.moves)

    def poses(self, t: ArrayLike) -> tuple[Array, Array]:
        """Return the orientations and positions at times [s], as :meth:`amiwarp.Trajectory.poses`."""
        given = checked_times(t)
        return self._poses_near(given, given)

    def _poses_near(self, t: Array, later: Array) -> tuple[Array, Array]:
        """Return the poses at times ``later``, as if the motion at the times ``t`` went on without a key."""
        from scipy.spatial.transform import Rotation

        near = np.maximum(t, 0.0) * self._speed
        if self._loop:
            near = near % self._end
        at = near + (np.maximum(later, 0.0) - np.maximum(t, 0.0)) * self._speed
        linear, translation = placed(self.motion.chain, at, near)
        turned = self._axes @ linear @ self._unshape @ self._axes.T
        # Removes what 32-bit numbers of the file lack to a rotation.
        rotation = Rotation.from_matrix(turned).as_matrix()
        position = translation @ self.motion.turn.T
        if self._carrier is None:
            return rotation, position
        carried, place = self._carrier.poses(later)
        position = np.einsum("nij,nj->ni", carried, position) + place
        return carried @ rotation, position

    def _check_jumps(self) -> None:
        """Raise :class:`AmiwarpError` if the body is too fast between two keys. Jumps at keys are allowed."""
        t = np.asarray(self.t, np.float64)
        if t.size < 2:
            return
        step = np.diff(t)
        rotation, position = self._poses_near(t[:-1], t[:-1])
        later_rotation, later_position = self._poses_near(t[:-1], t[1:])
        speed = np.linalg.norm(later_position - position, axis=1) / step
        cosine = (np.einsum("nij,nij->n", rotation, later_rotation) - 1.0) / 2.0
        rate = np.arccos(np.clip(cosine, -1.0, 1.0)) / step
        self._check_speeds(speed, rate)

    def _all_jumps(self) -> Array:
        """Return the times in the animation at which the body jumps [s]."""
        jumps = [channel.jumps() for channel in channels_of(self.motion.chain)]
        if self._loop:
            ends = np.array([0.0, self._end])
            linear, translation = placed(self.motion.chain, ends, ends)
            size = max(1.0, float(np.abs(translation).max()))
            apart = max(
                np.abs(np.diff(linear, axis=0)).max(),
                np.abs(np.diff(translation, axis=0)).max() / size,
            )
            if apart > SAME_PLACE:
                jumps.append(np.array([self._end]))
        return np.unique(np.concatenate(jumps))

    def _changes(self, stop: float) -> Array:
        """Return the times from 0 to ``stop`` [s] at which the motion may change abruptly, increasing."""
        beside = [
            self._jump_keys - BESIDE_JUMP_S * self._speed,
            self._jump_keys + BESIDE_JUMP_S * self._speed,
        ]
        marks = np.concatenate([self._keys, *beside]) / self._speed
        if self._loop:
            period = self._end / self._speed
            starts = period * np.arange(math.floor(stop / period) + 1)
            if starts.size * marks.size > MOST_CHANGES:
                raise AmiwarpError(
                    f"animation {self.motion.animation!r} has {marks.size} keys in {period:.3g} s and is repeated "
                    f"{starts.size} times; export fewer keys, at a lower rate"
                )
            marks = (starts[:, None] + marks).ravel()
        return np.unique(marks[(marks >= 0.0) & (marks <= stop)])

    def _derivatives(self, t: Array) -> tuple[Array, Array, Array]:
        """Raise :class:`AmiwarpError`: an animation has no acceleration at its keys."""
        raise AmiwarpError(
            "a trajectory of an animation has no acceleration at its keys; sample it with Trajectory.from_function"
        )
