"""JSON document and arrays of a glTF 2.0 file, as far as trimesh does not give them.

trimesh reads the meshes of a file, but neither its animations nor the numbers of its nodes. All this runs in the
reading process (:mod:`amiwarp.io.reading_process`).
"""

from __future__ import annotations

import base64
import binascii
import io
import json
import struct
import urllib.parse
from collections.abc import Callable
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.validation import shown

MAGIC = b"glTF"
HEADER = struct.Struct("<4sII")
"""Beginning of a GLB file: magic number, version, length of the file."""
CHUNK = struct.Struct("<I4s")
"""Beginning of a chunk of a GLB file: length and kind."""
COMPONENTS: dict[int, Any] = {
    5120: np.int8,
    5121: np.uint8,
    5122: np.int16,
    5123: np.uint16,
    5126: np.float32,
}
"""Number types by their code in accessors. 32-bit integers do not occur in animations."""
FLOAT = 5126
WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
"""Numbers of an element by the name of its type."""
REPAIR = "export the file again"
"""What to do about a damaged file."""


class GltfFile:
    """Document of a glTF or GLB file, and the arrays that it describes."""

    def __init__(self, file: BinaryIO, kind: str, fetch: Callable[[str], bytes]) -> None:
        """Read the document of an open file.

        ``kind``: ``glb`` or ``gltf``; ``fetch`` returns the content of a file that the document names.
        """
        self._file = file
        self._kind = kind
        self._fetch = fetch
        self._buffers: dict[int, bytes] = {}
        if kind == "glb":
            text = self._chunk(HEADER.size, b"JSON")
        else:
            file.seek(0)
            text = file.read()
        document = json.loads(text.decode("utf-8-sig"))
        if not isinstance(document, dict):
            raise ValueError("it holds no JSON object")
        self.document: dict[str, Any] = document

    def entries(self, name: str) -> list[Any]:
        """Return a list of the document, such as ``nodes``; empty if the document has none."""
        found = self.document.get(name, [])
        if not isinstance(found, list) or not all(isinstance(entry, dict) for entry in found):
            raise damaged(f"its {name} are no list of objects")
        return found

    def entry(self, name: str, index: Any, what: str) -> dict[str, Any]:
        """Return an entry of a list of the document. ``what``: owner of the index in messages."""
        entries = self.entries(name)
        if type(index) is not int or not 0 <= index < len(entries):
            raise damaged(f"{what} refers to {name}[{shown(index)}], which does not exist")
        found: dict[str, Any] = entries[index]
        return found

    def array(self, index: Any, kind: str, what: str) -> NDArray[np.float64]:
        """Return the numbers of an accessor, shape (count, width).

        ``kind``: type of its elements, such as ``VEC3``; ``what``: owner of the accessor in messages.
        """
        accessor = self.entry("accessors", index, what)
        component = accessor.get("componentType")
        if accessor.get("type") != kind or component not in COMPONENTS:
            raise damaged(f"{what} has elements of {shown(accessor.get('type'))}, not {kind}")
        if "sparse" in accessor or "bufferView" not in accessor:
            raise AmiwarpError(
                f"{what} has a sparse accessor, which is not read; export without sparse accessors",
                ErrorCode.FILE_DAMAGED,
            )
        if component != FLOAT and not accessor.get("normalized"):
            raise damaged(f"{what} has integers that are not normalized")
        raw = self._elements(accessor, np.dtype(COMPONENTS[component]), WIDTHS[kind], what)
        values = raw.astype(np.float64)
        if component != FLOAT:
            values = np.maximum(values / np.iinfo(raw.dtype).max, -1.0)
        if not np.isfinite(values).all():
            raise damaged(f"{what} holds numbers that are not finite")
        return values

    def _elements(
        self, accessor: dict[str, Any], dtype: np.dtype[Any], width: int, what: str
    ) -> NDArray[Any]:
        """Return the elements of an accessor as they are stored, shape (count, width)."""
        view = self.entry("bufferViews", accessor["bufferView"], what)
        if any("meshopt" in name for name in view.get("extensions", {})):
            raise AmiwarpError(
                f"{what} is compressed by meshopt; export without compression",
                ErrorCode.FILE_DAMAGED,
            )
        size = width * dtype.itemsize
        count = _natural(accessor.get("count"), what)
        start = _natural(view.get("byteOffset", 0), what)
        length = _natural(view.get("byteLength"), what)
        offset = _natural(accessor.get("byteOffset", 0), what)
        stride = _natural(view.get("byteStride", size), what)
        data = self._buffer(view.get("buffer"), what)
        ends = offset + (count - 1) * stride + size
        if not count or stride < size or ends > length or start + length > len(data):
            raise damaged(f"{what} reaches beyond its buffer")
        little = dtype.newbyteorder("<")
        shape = (count, width)
        steps = (stride, dtype.itemsize)
        return np.ndarray(shape, little, data, start + offset, steps)

    def _buffer(self, index: Any, what: str) -> bytes:
        """Return the content of a buffer."""
        buffer = self.entry("buffers", index, what)
        if index not in self._buffers:
            self._buffers[index] = self._content(buffer.get("uri"), what)
        return self._buffers[index]

    def _content(self, uri: Any, what: str) -> bytes:
        """Return the content of a buffer by its address: a file, a data URI, or None in a GLB file."""
        if uri is None and self._kind == "glb":
            return self._chunk(self._rest, b"BIN\0")
        if not isinstance(uri, str):
            raise damaged(f"{what} has a buffer without content")
        if not uri.startswith("data:"):
            return self._fetch(uri)
        head, _, data = uri.partition(",")
        if not head.endswith(";base64"):
            return urllib.parse.unquote_to_bytes(data)
        try:
            return base64.b64decode(data, validate=True)
        except binascii.Error as error:
            raise damaged(f"{what} has a buffer that is no base64") from error

    def _chunk(self, at: int, kind: bytes) -> bytes:
        """Return the content of the chunk of a GLB file that begins at a byte, and keep where it ends."""
        self._file.seek(0)
        magic, version, _ = HEADER.unpack(self._file.read(HEADER.size))
        if magic != MAGIC or version != 2:
            raise ValueError("it is no GLB file of version 2")
        self._file.seek(at)
        length, found = CHUNK.unpack(self._file.read(CHUNK.size))
        content = self._file.read(length)
        if found != kind or len(content) != length:
            raise ValueError(f"it has no complete chunk {kind.decode().strip(chr(0))}")
        self._rest = at + CHUNK.size + length
        return content

    def with_names(self, names: list[str]) -> BinaryIO:
        """Return the file with other names of the nodes, as an open file."""
        nodes = [
            {**node, "name": name} for node, name in zip(self.entries("nodes"), names, strict=True)
        ]
        text = json.dumps({**self.document, "nodes": nodes}).encode()
        if self._kind == "gltf":
            return io.BytesIO(text)
        text += b" " * (-len(text) % 4)
        self._chunk(HEADER.size, b"JSON")  # what follows it is copied
        rest = self._file.read()
        total = HEADER.size + CHUNK.size + len(text) + len(rest)
        head = HEADER.pack(MAGIC, 2, total) + CHUNK.pack(len(text), b"JSON")
        return io.BytesIO(head + text + rest)


def damaged(says: str) -> AmiwarpError:
    """Return the error of a file that does not keep to glTF."""
    return AmiwarpError(f"{says}; {REPAIR}", ErrorCode.FILE_DAMAGED)


def _natural(value: Any, what: str) -> int:
    """Return a number of bytes or elements, which must be an integer that is not negative."""
    if type(value) is not int or value < 0:
        raise damaged(f"{what} has the size or offset {shown(value)}")
    return int(value)
