"""Reader of the animations of a glTF file, which moves its nodes as rigid bodies; runs in the reading process."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.simulation.worlds.gltf_file import GltfFile, damaged
from amiwarp.simulation.worlds.node_motion import (
    CUBIC,
    LINEAR,
    STEP,
    Channel,
    Node,
    channels_of,
    placed,
    sampled_times,
)
from amiwarp.validation import shown

Array = NDArray[np.float64]

PATHS = {"translation": "VEC3", "rotation": "VEC4", "scale": "VEC3"}
"""What a channel may animate, and the type of its values."""
REST: dict[str, tuple[float, ...]] = {
    "translation": (0.0, 0.0, 0.0),
    "rotation": (0.0, 0.0, 0.0, 1.0),
    "scale": (1.0, 1.0, 1.0),
}
"""Place of a node whose document gives none."""
UNIT = 0.02
"""Largest deviation of the length of a quaternion from 1. Quaternions of 8-bit integers deviate by 0.007."""
RIGID = 1e-4
"""Largest relative change of lengths in a body that counts as rigid; numbers of 32 bits change them by 1e-6."""
MOST_KEYS = 100_000
"""Largest number of times of keys that move a body: 28 minutes at 60 Hz."""
FLATTEST = 1e-6
"""Least ratio of the smallest to the largest scale of a node."""


class Animation:
    """Chosen animation of a glTF file, and the nodes that it moves."""

    def __init__(self, file: GltfFile, wanted: str | None) -> None:
        """Choose the animation with the name ``wanted``, or the first. Refuse meshes that change their shape."""
        self._file = file
        self._nodes = file.entries("nodes")
        self.names = [
            _name(entry, k, "animation") for k, entry in enumerate(file.entries("animations"))
        ]
        """Names of all animations of the file."""
        self.name: str | None = None
        """Name of the chosen animation; None if the file has none."""
        chosen = self._choice(wanted)
        self._channels: dict[int, dict[str, Channel]] = {}
        if chosen is not None:
            self.name = self.names[chosen]
            self._read(file.entries("animations")[chosen])
        self._refuse_changing_shapes()
        self._parents = self._hierarchy() if self._channels else {}
        self._checked: dict[int, Array] = {}

    def _choice(self, wanted: str | None) -> int | None:
        """Return the index of the chosen animation; None if the file has none and none is wanted."""
        if wanted is None:
            return 0 if self.names else None
        if wanted not in self.names:
            choices = ", ".join(self.names)
            has = f"choose among {choices}" if choices else "it has none; remove the field"
            raise AmiwarpError(f"has no animation {shown(wanted)}; {has}", ErrorCode.FIELD)
        return self.names.index(wanted)

    def node_name(self, index: int) -> str:
        """Return the name of a node; its index if it has no name."""
        name = self._nodes[index].get("name")
        return name if isinstance(name, str) and name else str(index)

    def _read(self, entry: dict[str, Any]) -> None:
        """Read the channels of an animation."""
        samplers = entry.get("samplers", [])
        channels = entry.get("channels", [])
        owner = f"animation {self.name!r}"
        if not isinstance(samplers, list) or not isinstance(channels, list):
            raise damaged(f"{owner} has no lists of samplers and channels")
        for channel in channels:
            target = channel.get("target", {})
            path = target.get("path")
            index = target.get("node")
            if index is None and path != "pointer":
                continue  # by the specification, to be ignored
            if path == "weights":
                continue  # see _refuse_changing_shapes
            if path not in PATHS:
                raise AmiwarpError(
                    f"{owner} animates {shown(path)}, which is not read; bake it into translation, rotation and scale "
                    "of nodes",
                    ErrorCode.FORMAT_UNKNOWN,
                )
            node = self._file.entry("nodes", index, owner)
            what = f"{owner}, {path} of node {self.node_name(index)!r}"
            if "matrix" in node:
                raise damaged(f"{what}: the node has a matrix, which cannot be animated")
            number = channel.get("sampler")
            if type(number) is not int or not 0 <= number < len(samplers):
                raise damaged(f"{what} refers to a sampler that does not exist")
            of_node = self._channels.setdefault(index, {})
            if path in of_node:
                raise damaged(f"{what} is animated twice")
            of_node[path] = self._channel(samplers[number], path, what)

    def _channel(self, sampler: dict[str, Any], path: str, what: str) -> Channel:
        """Return the channel that a sampler describes."""
        interpolation = sampler.get("interpolation", LINEAR)
        if interpolation not in (STEP, LINEAR, CUBIC):
            raise damaged(f"{what} has the unknown interpolation {shown(interpolation)}")
        t = self._file.array(sampler.get("input"), "SCALAR", f"{what}: times")[:, 0]
        values = self._file.array(sampler.get("output"), PATHS[path], what)
        if t[0] < 0.0 or not (np.diff(t) > 0.0).all():
            raise damaged(f"{what} has times that do not increase from 0")
        each = 3 if interpolation == CUBIC else 1
        if len(values) != each * len(t):
            raise damaged(f"{what} has {len(t)} times, but {len(values)} values")
        tangents = None
        keys = values
        if interpolation == CUBIC:
            # In the file, each key has its incoming tangent, its value and its outgoing tangent.
            incoming, keys, outgoing = np.moveaxis(values.reshape(len(t), 3, -1), 1, 0)
            tangents = np.stack([incoming, outgoing])
        if path == "rotation":
            keys = unit_quaternions(keys, what)
        return Channel(interpolation, t, np.ascontiguousarray(keys), tangents)

    def _refuse_changing_shapes(self) -> None:
        """Raise :class:`AmiwarpError` if a mesh follows a skin or morph targets."""
        for index, node in enumerate(self._nodes):
            if "mesh" not in node:
                continue
            name = self.node_name(index)
            if "skin" in node:
                raise AmiwarpError(
                    f"node {name!r} has a skin, but bodies are rigid; bake it into one mesh of a single pose, or split "
                    "it into rigid parts whose nodes are animated",
                    ErrorCode.FORMAT_UNKNOWN,
                )
            if self._morphs(index, node):
                raise AmiwarpError(
                    f"node {name!r} has morph targets, but bodies are rigid; apply them to the mesh and export it "
                    "without them",
                    ErrorCode.FORMAT_UNKNOWN,
                )

    def _morphs(self, index: int, node: dict[str, Any]) -> bool:
        """Return whether morph targets change the mesh of a node. Targets of weight 0 do not."""
        mesh = self._file.entry("meshes", node["mesh"], f"node {self.node_name(index)!r}")
        primitives = mesh.get("primitives", [])
        if not any(primitive.get("targets") for primitive in primitives):
            return False
        weights = node.get("weights", mesh.get("weights", []))
        return any(weights) or self._animates_weights(index)

    def _animates_weights(self, index: int) -> bool:
        """Return whether the chosen animation changes the weights of morph targets of a node."""
        if self.name is None:
            return False
        entry = self._file.entries("animations")[self.names.index(self.name)]
        targets = [channel.get("target", {}) for channel in entry.get("channels", [])]
        return any(
            target.get("path") == "weights" and target.get("node") == index for target in targets
        )

    def _hierarchy(self) -> dict[int, int]:
        """Return the parent of each node that has one."""
        parents: dict[int, int] = {}
        for index, node in enumerate(self._nodes):
            name = self.node_name(index)
            for child in node.get("children", []):
                self._file.entry("nodes", child, f"node {name!r}")
                if child in parents:
                    raise damaged(f"node {self.node_name(child)!r} is a child of two nodes")
                parents[child] = index
        for index in range(len(self._nodes)):
            above = parents.get(index)
            steps = 0
            while above is not None:
                steps += 1
                if above == index or steps > len(self._nodes):
                    raise damaged(f"node {self.node_name(index)!r} is its own ancestor")
                above = parents.get(above)
        return parents

    def chain(self, index: int) -> list[int] | None:
        """Return the numbers of the nodes from the root to a node; None if the animation moves none of them."""
        found = [index]
        while found[-1] in self._parents:
            found.append(self._parents[found[-1]])
        return found[::-1] if any(number in self._channels for number in found) else None

    @property
    def moves(self) -> bool:
        """Whether the animation has channels."""
        return bool(self._channels)

    @property
    def end(self) -> float:
        """Time of the last key of all channels [s]."""
        ends = [channel.t[-1] for of in self._channels.values() for channel in of.values()]
        return float(max(ends))

    def nodes(self) -> list[Node]:
        """Return all nodes of the file."""
        return [self.node(index) for index in range(len(self._nodes))]

    def node(self, index: int) -> Node:
        """Return a node with its place at rest and its channels."""
        given = self._nodes[index]
        name = self.node_name(index)
        what = f"node {name!r}"
        place = {
            path: _numbers(given.get(path, REST[path]), len(REST[path]), what) for path in REST
        }
        (rotation,) = unit_quaternions(place["rotation"][None], what)
        matrix = None
        if "matrix" in given:
            matrix = _numbers(given["matrix"], 16, what).reshape(4, 4).T
        channels = self._channels.get(index, {})
        return Node(name, place["translation"], rotation, place["scale"], matrix, channels)

    def shape(self, index: int) -> Array:
        """Return the linear part, shape (3, 3), that gives a moving node's mesh its shape: its place at time 0.

        Raises :class:`AmiwarpError` if the animation changes the shape.
        """
        if index not in self._checked:
            self._checked[index] = self._rigid_shape(index)
        return self._checked[index]

    def _rigid_shape(self, index: int) -> Array:
        chain = [self.node(number) for number in self.chain(index) or ()]
        what = f"animation {self.name!r} moves node {self.node_name(index)!r}"
        if sum(len(channel.t) for channel in channels_of(chain)) > MOST_KEYS:
            raise AmiwarpError(f"{what} by over {MOST_KEYS} keys; export fewer, at a lower rate")
        t = sampled_times(chain)
        with np.errstate(all="ignore"):  # refused below
            linear, translation = placed(chain, t, t)
        if not (np.isfinite(linear).all() and np.isfinite(translation).all()):
            raise damaged(f"{what} to a place that is not finite")
        first = np.asarray(linear[0])
        smallest, largest = np.linalg.svd(first, compute_uv=False)[[2, 0]]
        if not smallest > FLATTEST * largest:
            raise AmiwarpError(
                f"{what}, which has a scale of 0 in a direction; remove the node or its scale",
                ErrorCode.FORMAT_UNKNOWN,
            )
        turned = linear @ np.linalg.inv(first)
        change = np.abs(np.swapaxes(turned, 1, 2) @ turned - np.eye(3)).max(axis=(1, 2))
        if change.max() > 2.0 * RIGID:
            raise AmiwarpError(
                f"{what} and changes its scale at {float(t[np.argmax(change)]):.6g} s, but bodies are rigid; remove "
                "the changing scale from it and the nodes above it, or apply the scale to the mesh",
                ErrorCode.FORMAT_UNKNOWN,
            )
        return first


def unit_quaternions(values: Array, what: str) -> Array:
    """Return quaternions, shape (n, 4), at exactly unit length; ``what``: their owner in messages."""
    length = np.linalg.norm(values, axis=1, keepdims=True)
    deviation = np.abs(length - 1.0)
    if not (deviation <= UNIT).all():
        worst = int(np.argmax(deviation))
        raise damaged(
            f"{what} has a quaternion of length {float(length[worst, 0]):.3g} at key {worst}, not 1"
        )
    return np.asarray(values / length)


def _numbers(value: Any, count: int, what: str) -> Array:
    """Return finite numbers that a node gives."""
    try:
        found = np.array(value, np.float64)
    except (TypeError, ValueError, OverflowError):
        found = np.empty(0)
    if found.shape != (count,) or not np.isfinite(found).all():
        raise damaged(f"{what} has the place {shown(value)}; expected {count} numbers")
    return found


def _name(entry: dict[str, Any], index: int, kind: str) -> str:
    """Return the name of an animation; its kind and number if it has none."""
    name = entry.get("name")
    return name if isinstance(name, str) and name else f"{kind} {index}"
