"""Motion of the nodes of a glTF scene: keys that are interpolated as appendix C of glTF 2.0 says, and the hierarchy."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

STEP = "STEP"
LINEAR = "LINEAR"
CUBIC = "CUBICSPLINE"
TINY = 1e-300
"""Divisor instead of 0."""
NEARLY_EQUAL = 1e-12
"""Length of the difference of two quaternions below which they are interpolated linearly."""


@dataclass(frozen=True, eq=False)
class Channel:
    """Translation, rotation or scale of a node over time."""

    interpolation: str
    """``STEP``, ``LINEAR`` or ``CUBICSPLINE``."""
    t: Array
    """Times of the keys [s], increasing, shape ``(k,)``."""
    keys: Array
    """Values at the keys, shape ``(k, n)``: 3 numbers, or unit quaternions (x, y, z, w)."""
    tangents: Array | None = None
    """Incoming and outgoing tangents at the keys of a cubic spline [1/s], shape ``(2, k, n)``."""

    def at(self, t: Array, near: Array) -> Array:
        """Return the values at times ``t`` [s], by the keys around the times ``near`` [s], shape (m, n).

        With ``t = near`` this is the animation; otherwise the piece of it around ``near`` goes on until ``t``.
        """
        number = np.searchsorted(self.t, near, side="right") - 1
        values = self.keys[np.clip(number, 0, len(self.t) - 1)]
        between = (number >= 0) & (number < len(self.t) - 1)
        if self.interpolation != STEP and between.any():
            start = number[between]
            length = (self.t[start + 1] - self.t[start])[:, None]
            share = (t[between] - self.t[start])[:, None] / length
            values[between] = self._between(start, share, length)
        return values

    def _between(self, start: NDArray[np.int64], share: Array, length: Array) -> Array:
        """Return the values at a ``share`` of the time from each key ``start`` to the next, ``length`` [s] later."""
        before = self.keys[start]
        after = self.keys[start + 1]
        is_rotation = before.shape[1] == 4
        if self.tangents is None:
            if is_rotation:
                return slerp(before, after, share)
            return before + share * (after - before)
        incoming, outgoing = self.tangents
        s2 = share * share
        s3 = s2 * share
        value = (2.0 * s3 - 3.0 * s2 + 1.0) * before
        value += length * (s3 - 2.0 * s2 + share) * outgoing[start]
        value += (3.0 * s2 - 2.0 * s3) * after
        value += length * (s3 - s2) * incoming[start + 1]
        if is_rotation:
            size = np.linalg.norm(value, axis=1, keepdims=True)
            # A spline may pass through 0 for an instant, at which it gives no rotation.
            value = np.where(size > 0.0, value / np.maximum(size, TINY), before)
        return np.asarray(value)

    def jumps(self) -> Array:
        """Return the times at which the value jumps [s]."""
        if self.interpolation != STEP:
            return np.empty(0)
        differs = (self.keys[1:] != self.keys[:-1]).any(axis=1)
        return np.asarray(self.t[1:][differs])


def slerp(before: Array, after: Array, share: Array) -> Array:
    """Return unit quaternions on the shorter way between two, shape (n, 4); ``share`` of the way, shape (n, 1)."""
    cosine = np.sum(before * after, axis=1, keepdims=True)
    after = np.where(cosine < 0.0, -after, after)
    apart = np.linalg.norm(after - before, axis=1, keepdims=True)
    angle = 2.0 * np.arctan2(apart, np.linalg.norm(after + before, axis=1, keepdims=True))
    close = apart < NEARLY_EQUAL
    sine = np.where(close, 1.0, np.sin(angle))
    of_before = np.where(close, 1.0 - share, np.sin((1.0 - share) * angle) / sine)
    of_after = np.where(close, share, np.sin(share * angle) / sine)
    return np.asarray(of_before * before + of_after * after)


@dataclass(frozen=True, eq=False)
class Node:
    """Node of a scene: its place relative to its parent, of which channels may change a part."""

    name: str
    """Name in messages."""
    translation: Array
    """Shape (3,)."""
    rotation: Array
    """Unit quaternion (x, y, z, w), shape (4,)."""
    scale: Array
    """Shape (3,)."""
    matrix: Array | None = None
    """Transformation instead of the three above, shape (4, 4)."""
    channels: Mapping[str, Channel] = field(default_factory=dict)
    """Channels by the names ``translation``, ``rotation`` and ``scale``."""

    def placed(self, t: Array, near: Array) -> tuple[Array, Array]:
        """Return the linear parts (m, 3, 3) and the translations (m, 3) relative to the parent, as :func:`placed`."""
        if not self.channels:
            return self._at_rest
        return self._placed(t, near)

    @cached_property
    def _at_rest(self) -> tuple[Array, Array]:
        """Linear part (1, 3, 3) and translation (1, 3) of a node without channels."""
        if self.matrix is not None:
            return self.matrix[None, :3, :3], self.matrix[None, :3, 3]
        return self._placed(np.zeros(1), np.zeros(1))

    def _placed(self, t: Array, near: Array) -> tuple[Array, Array]:
        """Return what :meth:`placed` returns, of a node without a matrix."""
        now = {}
        for path in ("translation", "rotation", "scale"):
            channel = self.channels.get(path)
            constant = np.asarray(getattr(self, path))[None]
            now[path] = constant if channel is None else channel.at(t, near)
        linear = rotation_matrices(now["rotation"]) * now["scale"][:, None, :]
        return linear, now["translation"]


def rotation_matrices(quaternions: Array) -> Array:
    """Return the matrices of unit quaternions (x, y, z, w), shape (n, 3, 3)."""
    x, y, z, w = quaternions.T
    rows = [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)],
        [2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)],
        [2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def placed(chain: Sequence[Node], t: Array, near: Array) -> tuple[Array, Array]:
    """Return where a node is in the scene at times [s]: linear parts (m, 3, 3) and translations (m, 3).

    ``chain``: the nodes from the root to the node; ``t``, ``near``: as in :meth:`Channel.at`.
    """
    linear = np.tile(np.eye(3), (len(t), 1, 1))
    translation = np.zeros((len(t), 3))
    for node in chain:
        own_linear, own_translation = node.placed(t, near)
        translation = translation + np.einsum(
            "nij,nj->ni", linear, np.broadcast_to(own_translation, translation.shape)
        )
        linear = linear @ own_linear
    return linear, translation


def channels_of(chain: Sequence[Node]) -> list[Channel]:
    """Return the channels that move a node."""
    return [channel for node in chain for channel in node.channels.values()]


def key_times(chain: Sequence[Node]) -> Array:
    """Return the times of all keys that move a node [s], increasing, with 0."""
    return np.unique(np.concatenate([[0.0], *(channel.t for channel in channels_of(chain))]))


def sampled_times(chain: Sequence[Node]) -> Array:
    """Return the times of all keys that move a node, and two between each two of them [s], increasing."""
    keys = key_times(chain)
    step = np.diff(keys)
    between = [keys[:-1] + step / 3.0, keys[:-1] + step * (2.0 / 3.0)]
    return np.unique(np.concatenate([keys, *between]))
