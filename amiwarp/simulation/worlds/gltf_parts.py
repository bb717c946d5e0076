"""What moves the parts of a mesh file: from the reading process, which knows the file, to the process of the user."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.simulation.worlds.gltf_animation import Animation
from amiwarp.simulation.worlds.gltf_file import GltfFile
from amiwarp.simulation.worlds.node_motion import Channel, Node

GLTF = ("glb", "gltf")
SEPARATOR = ":"
"""Stands between the number and the name of a node in the names that trimesh is given."""


class AnimatedScene:
    """Mesh file for trimesh, whose nodes keep their numbers if an animation moves some of them."""

    def __init__(
        self, file: BinaryIO, kind: str, fetch: Callable[[str], bytes], wanted: str | None
    ) -> None:
        """Read the animation of an open file, if the file has one.

        ``kind``: suffix of the file; ``fetch`` returns the content of a file that it names; ``wanted``: name of an
        animation, or None.
        """
        self._animation: Animation | None = None
        self._nodes: list[Node] = []
        self._labels: dict[str, str] = {}
        self.source: BinaryIO = file
        """Open file to be read by trimesh."""
        if kind not in GLTF:
            if wanted is not None:
                raise AmiwarpError(
                    "has no animations, which only glTF and GLB files have; remove the field animation",
                    ErrorCode.FIELD,
                )
            return
        document = GltfFile(file, kind, fetch)
        animation = Animation(document, wanted)
        file.seek(0)
        if animation.moves:
            self._animation = animation
            self._nodes = animation.nodes()
            labels = [animation.node_name(k) for k in range(len(document.entries("nodes")))]
            names = [f"{k}{SEPARATOR}{label}" for k, label in enumerate(labels)]
            self.source = document.with_names(names)

    @property
    def clip(self) -> dict[str, Any]:
        """Names of the chosen animation and of the others, and the time of its last key [s]."""
        if self._animation is None:
            return {"animation": None, "others": [], "end": 0.0}
        others = [name for name in self._animation.names if name != self._animation.name]
        return {"animation": self._animation.name, "others": others, "end": self._animation.end}

    def sorted_nodes(self, nodes: Iterable[str]) -> list[str]:
        """Return the names of nodes in trimesh's scene, in the order of their names in the file."""
        if self._animation is None:
            return sorted(nodes)
        ordered = sorted(nodes, key=lambda node: (_label(node), _number(node)))
        known = set()
        for node in ordered:
            label = _label(node)
            if label in known:
                label = f"{label}_{_number(node)}"
            known.add(label)
            self._labels[node] = label
        return ordered

    def name_of(self, node: str) -> str:
        """Return the name of a node for users, which no other node has."""
        return self._labels.get(node, str(node))

    def chain_of(self, node: str) -> list[int] | None:
        """Return the numbers of the nodes that move a node, from the root on; None for a node at rest."""
        return None if self._animation is None else self._animation.chain(_number(node))

    def place(self, node: str, at_rest: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the transformation (3, 4) of a node's mesh: the shape of a moving node, or its place ``at_rest``."""
        if self._animation is None or self.chain_of(node) is None:
            return at_rest
        return np.column_stack([self._animation.shape(_number(node)), np.zeros(3)])

    def nodes(self) -> tuple[list[dict[str, Any]], list[NDArray[np.float64]]]:
        """Return all nodes of a file in which something moves, and their arrays, for :func:`received_nodes`."""
        found: list[dict[str, Any]] = []
        arrays: list[NDArray[np.float64]] = []
        for node in self._nodes:
            channels = {}
            for path, channel in node.channels.items():
                width = channel.keys.shape[1]
                has_tangents = channel.tangents is not None
                channels[path] = [channel.interpolation, len(channel.t), width, has_tangents]
                arrays += [channel.t, channel.keys.ravel()]
                if channel.tangents is not None:
                    arrays.append(channel.tangents.ravel())
            place = [node.translation, node.rotation, node.scale]
            about = {
                "name": node.name,
                "place": [value.tolist() for value in place],
                "matrix": None if node.matrix is None else node.matrix.tolist(),
                "channels": channels,
            }
            found.append(about)
        return found, arrays


def received_nodes(given: list[dict[str, Any]], arrays: list[NDArray[Any]]) -> list[Node]:
    """Return the nodes that :meth:`AnimatedScene.nodes` described, and remove their arrays from the list's front."""
    nodes = []
    for about in given:
        channels = {}
        for path, (interpolation, count, width, has_tangents) in about["channels"].items():
            t = arrays.pop(0)
            keys = arrays.pop(0).reshape(count, width)
            tangents = arrays.pop(0).reshape(2, count, width) if has_tangents else None
            channels[path] = Channel(interpolation, t, keys, tangents)
        translation, rotation, scale = (np.array(value) for value in about["place"])
        matrix = None if about["matrix"] is None else np.array(about["matrix"])
        nodes.append(Node(about["name"], translation, rotation, scale, matrix, channels))
    return nodes


def _number(node: str) -> int:
    """Return the number of a node by its name in trimesh's scene."""
    return int(node.partition(SEPARATOR)[0])


def _label(node: str) -> str:
    """Return the name of a node in the file by its name in trimesh's scene."""
    return node.partition(SEPARATOR)[2]
