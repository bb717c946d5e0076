"""Small glTF and GLB files with animations, written by hand with ``struct`` and ``json``."""

import base64
import json
import struct
from pathlib import Path
from typing import Any

CORNERS = [(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)]
"""A tetrahedron, whose four corners tell every transformation."""
FACES = [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)]
Channel = tuple[int, str, str, Any, Any]
"""Number of the node, path, interpolation, times, values at the keys."""


class Maker:
    """A glTF document and its buffer."""

    def __init__(
        self, nodes: list[dict[str, Any]], corners: Any = CORNERS, faces: Any = FACES
    ) -> None:
        self.data = b""
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []
        position = self.add(corners, "VEC3")
        self.accessors[position]["min"] = [min(axis) for axis in zip(*corners, strict=True)]
        self.accessors[position]["max"] = [max(axis) for axis in zip(*corners, strict=True)]
        indices = self.add([(k,) for face in faces for k in face], "SCALAR", "H", 5123)
        children = {child for node in nodes for child in node.get("children", [])}
        self.document: dict[str, Any] = {
            "asset": {"version": "2.0"},
            "scene": 0,
            "scenes": [{"nodes": [k for k in range(len(nodes)) if k not in children]}],
            "nodes": nodes,
            "meshes": [
                {"primitives": [{"attributes": {"POSITION": position}, "indices": indices}]}
            ],
        }

    def add(self, rows: Any, kind: str, code: str = "f", component: int = 5126, **more: Any) -> int:
        """Append an array of rows, and return the number of its accessor."""
        self.data += bytes(-len(self.data) % 4)
        packed = b"".join(struct.pack(f"<{len(row)}{code}", *row) for row in rows)
        self.views.append({"buffer": 0, "byteOffset": len(self.data), "byteLength": len(packed)})
        self.data += packed
        accessor = {
            "bufferView": len(self.views) - 1,
            "componentType": component,
            "count": len(rows),
            "type": kind,
        }
        self.accessors.append({**accessor, **more})
        return len(self.accessors) - 1

    def animate(self, name: str | None, channels: list[Channel]) -> None:
        """Append an animation."""
        samplers = []
        targets = []
        for node, path, interpolation, times, values in channels:
            if interpolation == "CUBICSPLINE":
                values = [part for key in values for part in key]
            kind = "VEC4" if path == "rotation" else "VEC3"
            sampler = {
                "input": self.add([(t,) for t in times], "SCALAR"),
                "output": self.add(values, kind),
            }
            if interpolation != "LINEAR":
                sampler["interpolation"] = interpolation
            samplers.append(sampler)
            targets.append({"sampler": len(samplers) - 1, "target": {"node": node, "path": path}})
        animation = {"samplers": samplers, "channels": targets}
        if name is not None:
            animation["name"] = name
        self.document.setdefault("animations", []).append(animation)

    def write(self, path: Path, *, embedded: bool = False) -> Path:
        """Write the file; a glTF file with its buffer in the file or in ``path`` with the suffix .bin."""
        buffer: dict[str, Any] = {"byteLength": len(self.data)}
        document = {
            **self.document,
            "bufferViews": self.views,
            "accessors": self.accessors,
            "buffers": [buffer],
        }
        if path.suffix == ".gltf":
            buffer["uri"] = path.with_suffix(".bin").name
            if embedded:
                buffer["uri"] = (
                    "data:application/octet-stream;base64," + base64.b64encode(self.data).decode()
                )
            else:
                path.with_suffix(".bin").write_bytes(self.data)
            path.write_text(json.dumps(document))
            return path
        text = json.dumps(document).encode()
        text += b" " * (-len(text) % 4)
        data = self.data + bytes(-len(self.data) % 4)
        chunks = (
            struct.pack("<I4s", len(text), b"JSON")
            + text
            + struct.pack("<I4s", len(data), b"BIN\0")
            + data
        )
        path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)
        return path
