"""Reader of mesh files (glTF, GLB, OBJ with MTL, PLY, STL) that uses trimesh.

Colours become luminance, and red, green and blue relative to it.

A file of a few bytes may declare a mesh of many gigabytes, so trimesh runs in the reading process, which has limits
of memory and processor time (:mod:`amiwarp.io.reading_process`).
"""

from __future__ import annotations

import importlib.util
import io
import urllib.parse
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.io.inputs import errors_name, note_input, open_input
from amiwarp.io.reading_process import Allowance, borrow, give_back
from amiwarp.simulation.picture_light import (
    BAND,
    LUMINANCE,
    MOST_PIXELS,
    PICTURE_FORMATS,
    srgb_to_linear,
)
from amiwarp.simulation.worlds.animated_trajectory import NodeMotion
from amiwarp.simulation.worlds.bodies import Material, Mesh
from amiwarp.simulation.worlds.colours import (
    MOST_COLOURED,
    colours_of_pixels,
    has_no_colour,
    is_grey,
    split_colours,
)
from amiwarp.simulation.worlds.gltf_parts import AnimatedScene, received_nodes
from amiwarp.validation import one_of, real

if TYPE_CHECKING:
    from trimesh import Trimesh

FORMATS = ("glb", "gltf", "obj", "ply", "stl")
"""Supported suffixes of mesh files."""
Y_UP = ("glb", "gltf")
"""Suffixes of the formats in which, by specification, the y axis points up and colours are linear."""
PICTURES = (
    ".png",
    ".jpg",
    ".jpeg",
    ".bmp",
    ".tif",
    ".tiff",
    ".webp",
    ".ppm",
    ".gif",
    ".tga",
    ".dds",
    ".ktx2",
    ".exr",
)
"""Suffixes of picture files that a mesh file may use as textures."""
TO_Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""Rotation matrix from a frame in which y points up to a frame in which z points up."""
MESH_SECONDS = 15.0
"""Processor time that a mesh file of at most :data:`~amiwarp.io.reading_process.SMALL_BYTES` may take [s].

A small file may refer to a texture of 67 million pixels, which takes 2.5 s to decode and convert on an idle core.
"""
GREY_MODES = ("1", "L", "LA", "La", "I", "I;16", "F")
"""Pillow's names of the kinds of pictures without colour."""
DEFAULT_REFLECTANCE = 0.5
"""Reflectance of meshes whose file gives neither colours nor a material."""

Arrays = tuple[NDArray[Any] | None, ...]
"""Vertices, faces, texture coordinates, light and its colour, texture and its pixels in colour, and relative colour of
the material of a part; None for an array that it has not."""


class LoadedMesh(NamedTuple):
    """One mesh of a mesh file, with its material."""

    mesh: Mesh
    """Triangles in the frame of the file, turned so that z points up [m]; of a part that an animation moves, in the
    frame of its node at the time 0 of the animation, with the axes of the file."""
    material: Material
    """Reflectance, texture and colour that the file gives the mesh."""
    name: str
    """Name of the mesh's node in the file."""
    motion: NodeMotion | None = None
    """Motion of the node by the chosen animation; None for a part at rest."""


def load_mesh(
    path: str | Path,
    *,
    up: str | None = None,
    scale: float = 1.0,
    animation: str | None = None,
) -> list[LoadedMesh]:
    """Read the meshes of a glTF, GLB, OBJ, PLY or STL file.

    Needs trimesh: ``pip install "amiwarp[worlds]"``.

    Parameters
    ----------
    path : str or Path
        Mesh file. Files that an OBJ or glTF file refers to (materials, textures, buffers) are read as well.
    up : str, optional
        Axis of the file that points up, ``"y"`` or ``"z"``. None means y in glTF and GLB files, and z in other files.
    scale : float
        Length of the file's unit [m].
    animation : str, optional
        Name of the animation of a glTF or GLB file that moves its nodes; by default the first one.

    Returns
    -------
    list of LoadedMesh
        Mesh, material, name and motion of each part. The meshes are in the frame of the file, with z up.

    Raises
    ------
    AmiwarpError
        If the file does not exist, has an unknown format or no faces, or refers to a file that is missing; if an
        animation is damaged, or meshes change their shape.
    """
    path = Path(path)
    kind = path.suffix.lower().removeprefix(".")
    if kind not in FORMATS:
        raise AmiwarpError(
            f"{path}: has an unknown mesh format {path.suffix!r}; give one of {', '.join(FORMATS)}",
            ErrorCode.FORMAT_UNKNOWN,
        )
    default_up = "y" if kind in Y_UP else "z"
    up = one_of(up or default_up, ("y", "z"), "axis that points up")
    rotation = TO_Z_UP if up == "y" else np.eye(3)
    turn = real(scale, "mesh scale", 1e-9, 1e9) * rotation
    _check_trimesh(path)
    with errors_name(path, lambda: "cannot be read as a mesh"):
        answer, arrays = _called(path, kind, turn, animation)
        parts = [_received(about, arrays) for about in answer["parts"]]
        nodes = received_nodes(answer["nodes"], arrays)
        for k, about in enumerate(answer["parts"]):
            if about["chain"] is not None:
                chain = [nodes[number] for number in about["chain"]]
                others = tuple(answer["others"])
                motion = NodeMotion(answer["animation"], others, answer["end"], chain, turn)
                parts[k] = parts[k]._replace(motion=motion)
    if not parts:
        raise AmiwarpError(
            f"{path}: holds no faces; give a file with triangles, not points or lines alone",
            ErrorCode.FORMAT_UNKNOWN,
        )
    return parts


def mesh_files(path: Path) -> list[Path]:
    """Return the files that a mesh file refers to; none for a file that cannot be read as a mesh."""
    kind = path.suffix.lower().removeprefix(".")
    if kind not in FORMATS:
        return []
    _check_trimesh(path)
    try:
        with errors_name(path, lambda: "cannot be read as a mesh"):
            answer, _ = _called(path, kind, np.eye(3), None)
    except AmiwarpError:
        return []
    return [Path(file) for file in answer["files"]]


def _check_trimesh(path: Path) -> None:
    """Raise :class:`AmiwarpError` if trimesh is not installed."""
    if importlib.util.find_spec("trimesh") is None:
        raise AmiwarpError(
            f"{path}: mesh files need trimesh; run: pip install 'amiwarp[worlds]'",
            ErrorCode.PACKAGE_MISSING,
        )


def _called(
    path: Path, kind: str, turn: NDArray[np.float64], animation: str | None
) -> tuple[dict[str, Any], list[NDArray[Any]]]:
    """Return what :func:`read_parts` returns, and register the files as inputs."""
    # a glTF file has its arrays in files next to it
    sized = (path, path.parent) if kind == "gltf" else (path,)
    allowance = Allowance(*sized, small_s=MESH_SECONDS)
    process = borrow()
    try:
        answer, arrays = process.call(
            f"{__name__}:read_parts", path, kind, turn.tolist(), animation, allowance=allowance
        )
    finally:
        give_back(process)
    for file in answer["files"]:
        note_input(Path(file))
    return answer, arrays


def _received(about: dict[str, Any], arrays: list[NDArray[Any]]) -> LoadedMesh:
    """Return a part that :func:`read_parts` described, and remove its arrays from the front of the list."""
    values: list[Any] = [
        None if shape is None else arrays.pop(0).reshape(shape) for shape in about["shapes"]
    ]
    vertices, faces, uv, light, light_colour, texture, pixels, colour = values
    mesh = Mesh(vertices, faces, uv, light, light_colour)
    if pixels is not None and not has_no_colour(pixels):
        colour = colours_of_pixels(pixels, colour)
    material = Material(about["reflectance"], texture, colour=colour)
    return LoadedMesh(mesh, material, about["name"])


def read_parts(
    path: str, kind: str, turn: list[list[float]], animation: str | None
) -> tuple[dict[str, Any], list[NDArray[Any]]]:
    """Read the parts of a mesh file, in the reading process.

    ``kind``: suffix of the file; ``turn``: matrix (3, 3) by which vertices are multiplied; ``animation``: name of an
    animation, or None. The first value holds the files that the mesh file refers to, and of each part the name, the
    reflectance, the nodes that move it and the shapes of its arrays, which :data:`Arrays` lists. A shape is None if
    the part has no such array.
    """
    scene, files, animated = _open(Path(path), kind, animation)
    parts: list[dict[str, Any]] = []
    arrays: list[NDArray[Any]] = []
    for node in animated.sorted_nodes(scene.graph.nodes_geometry):
        placed, geometry = scene.graph[node]
        part = scene.geometry[geometry]
        if len(getattr(part, "faces", ())):
            matrix = np.array(turn) @ animated.place(node, placed[:3])
            values, reflectance = _part(part, matrix[:, :3], matrix[:, 3], kind)
            shapes = [None if value is None else value.shape for value in values]
            about = {"name": animated.name_of(node), "chain": animated.chain_of(node)}
            parts.append({**about, "reflectance": reflectance, "shapes": shapes})
            arrays += [value.ravel() for value in values if value is not None]
    nodes, of_nodes = animated.nodes()
    answer = {"files": files, "parts": parts, "nodes": nodes, **animated.clip}
    return answer, [*arrays, *of_nodes]


def _open(path: Path, kind: str, animation: str | None) -> tuple[Any, list[str], AnimatedScene]:
    """Return the file as a trimesh scene, the files that it refers to, and what moves its nodes."""
    import trimesh

    files = _named_files(path)
    with open_input(path) as opened:
        try:
            animated = AnimatedScene(opened, kind, files.get, animation)
            file = animated.source
            scene = trimesh.load(file, file_type=kind, resolver=files, force="scene", process=False)
        except Exception:
            if files.missing is None:
                raise
        if files.missing is not None:
            raise AmiwarpError(
                f"refers to the file {files.missing}; put a valid file next to the mesh file"
            )
    return scene, files.read, animated


def _named_files(path: Path) -> Any:
    """Return a resolver of referenced files that records the first failure, because trimesh ignores failures."""
    from trimesh.resolvers import FilePathResolver

    class NamedFiles(FilePathResolver):
        """Resolver of the files that a mesh file refers to."""

        missing: str | None = None
        """First file that cannot be read, with the reason, for a message."""

        def __init__(self) -> None:
            super().__init__(str(path))
            self.read: list[str] = []

        def get(self, name: str) -> bytes:
            """Return the content of a file; its name is relative to the folder of the mesh file."""
            file = path.parent / name.replace("\\", "/")
            if not file.exists():
                file = path.parent / urllib.parse.unquote(name)
            try:
                with open_input(file) as opened:
                    data = opened.read()
                if file.suffix.lower() in PICTURES:
                    _check_picture(data)
            except Exception as error:
                if self.missing is None:
                    missing = isinstance(error, AmiwarpError)
                    what = "is missing" if missing else f"cannot be read ({error})"
                    self.missing = f"{name!r}, which {what}"
                raise
            self.read.append(str(file))
            return data

    return NamedFiles()


def _check_picture(data: bytes) -> None:
    """Raise an exception if the bytes are no picture in a supported format."""
    from PIL import Image

    with Image.open(io.BytesIO(data), formats=PICTURE_FORMATS) as image:
        image.verify()


def _part(
    part: Trimesh, matrix: NDArray[Any], offset: NDArray[Any], kind: str
) -> tuple[Arrays, float]:
    """Return the arrays and the reflectance of one geometry of the file.

    ``matrix`` and ``offset``: transformation from the geometry to the world; ``kind``: suffix of the file.
    """
    vertices = np.asarray(part.vertices, np.float64) @ matrix.T + offset
    faces = np.asarray(part.faces)
    visual: Any = part.visual
    if visual.kind == "texture":
        return _textured(visual, vertices, faces, kind)
    if visual.kind == "face":
        # Faces of different colours cannot share vertices: each face gets its own three.
        colours = np.repeat(np.asarray(visual.face_colors), 3, axis=0)
        own_vertices = vertices[faces.ravel()]
        own_faces = np.arange(faces.size).reshape(-1, 3)
        return (own_vertices, own_faces, None, *_lights(colours, kind), None, None, None), 1.0
    if visual.kind == "vertex":
        lights = _lights(visual.vertex_colors, kind)
        return (vertices, faces, None, *lights, None, None, None), 1.0
    return (vertices, faces, None, None, None, None, None, None), DEFAULT_REFLECTANCE


def _textured(
    visual: Any, vertices: NDArray[Any], faces: NDArray[Any], kind: str
) -> tuple[Arrays, float]:
    """Return arrays and reflectance of a geometry whose file gives a material, with or without a texture."""
    material = visual.material
    pbr = hasattr(material, "baseColorFactor")
    picture = material.baseColorTexture if pbr else material.image
    colour = material.baseColorFactor if pbr else material.diffuse
    factor = 1.0
    tint: NDArray[Any] | None = None
    if colour is not None or not pbr:
        factors, tints = _lights(np.atleast_2d(colour), kind)
        factor = float(factors[0])
        tint = None if tints is None else tints[0]
    shade = visual.vertex_attributes.get("color")
    lights = (None, None) if shade is None else _lights(shade, kind)
    if picture is None or visual.uv is None:
        return (vertices, faces, None, *lights, None, None, tint), factor
    if not pbr:
        # in OBJ files, a texture replaces the diffuse colour
        factor = 1.0
        tint = None
    uv = np.asarray(visual.uv)[:, :2]
    return (vertices, faces, uv, *lights, *_luminance(picture), tint), factor


def _luminance(picture: Any) -> tuple[NDArray[np.float32], NDArray[np.uint8] | None]:
    """Return the linear luminance of a Pillow picture, and its pixels, or None for a grey or a very large picture.

    A single row or column is duplicated.
    """
    if picture.width * picture.height > MOST_PIXELS:
        raise AmiwarpError(
            f"a texture has {picture.width}x{picture.height} pixels, more than {MOST_PIXELS}; give a smaller picture"
        )
    table = srgb_to_linear(np.arange(256, dtype=np.float32) / 255)
    light = np.empty((picture.height, picture.width), np.float32)
    has_colour = picture.mode not in GREY_MODES and light.size <= MOST_COLOURED
    pixels = np.empty((*light.shape, 3) if has_colour else (0, 0, 3), np.uint8)
    rows = max(1, BAND // (3 * picture.width))
    # In bands, because a large picture as a whole would need four times its memory
    for top in range(0, picture.height, rows):
        bottom = min(top + rows, picture.height)
        band = picture.crop((0, top, picture.width, bottom)).convert("RGB")
        light[top:bottom] = table[np.asarray(band)] @ np.array(LUMINANCE, np.float32)
        if has_colour:
            pixels[top:bottom] = band
    for axis in (0, 1):
        if light.shape[axis] < 2:
            light = np.repeat(light, 2, axis=axis)
            pixels = np.repeat(pixels, 2, axis=axis)
    return light, pixels if has_colour else None


def _lights(colours: Any, kind: str) -> tuple[NDArray[np.float64], NDArray[np.float32] | None]:
    """Return the luminance of colours (integers, or floats from 0 to 1), shape (n,), and the colours relative to it.

    The relative colours have the shape (n, 3); they are None for grey.

    Colours are linear in glTF and GLB files, and sRGB in other files.
    """
    given = np.asarray(colours)
    white = np.iinfo(given.dtype).max if given.dtype.kind in "iu" else 1.0
    values = given[:, :3].astype(np.float64) / white
    linear = values if kind in Y_UP else srgb_to_linear(values)
    light = np.asarray(np.clip(linear @ np.array(LUMINANCE), 0.0, 1.0), np.float64)
    _, colour = split_colours(linear)
    return light, None if is_grey(colour) else colour
