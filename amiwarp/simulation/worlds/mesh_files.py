"""Reader of mesh files (glTF, GLB, OBJ with MTL, PLY, STL) that uses trimesh. Colours become luminance."""

from __future__ import annotations

import io
import urllib.parse
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.io.input_files import errors_name, open_input
from amiwarp.simulation.pictures import LUMINANCE, MOST_PIXELS, PICTURE_FORMATS, linear_luminance, srgb_to_linear
from amiwarp.simulation.worlds.scene import Material, Mesh
from amiwarp.validation import one_of, real

if TYPE_CHECKING:
    from trimesh import Trimesh

FORMATS = ("glb", "gltf", "obj", "ply", "stl")
"""Supported suffixes of mesh files."""
Y_UP = ("glb", "gltf")
"""Suffixes of the formats in which, by specification, the y axis points up and colours are linear."""
PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".ppm", ".gif", ".tga", ".dds", ".ktx2", ".exr")
"""Suffixes of picture files that a mesh file may use as textures."""
TO_Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""Rotation matrix from a frame in which y points up to a frame in which z points up."""
DEFAULT_REFLECTANCE = 0.5
"""Reflectance of meshes whose file gives neither colours nor a material."""


class LoadedMesh(NamedTuple):
    """One mesh of a mesh file, with its material."""

    mesh: Mesh
    """Triangles in the frame of the file, turned so that z points up [m]."""
    material: Material
    """Reflectance and texture that the file gives the mesh."""
    name: str
    """Name of the mesh's node in the file."""


def load_mesh(path: str | Path, *, up: str | None = None, scale: float = 1.0) -> list[LoadedMesh]:
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

    Returns
    -------
    list of LoadedMesh
        Mesh, material and name of each part. The meshes are in the frame of the file, with z up.

    Raises
    ------
    AmiwarpError
        If the file does not exist, has an unknown format or no faces, or refers to a file that is missing.
    """
    path = Path(path)
    kind = path.suffix.lower().removeprefix(".")
    if kind not in FORMATS:
        raise AmiwarpError(f"{path}: has an unknown mesh format {path.suffix!r}; give one of {', '.join(FORMATS)}")
    up = one_of(up or ("y" if kind in Y_UP else "z"), ("y", "z"), "axis that points up")
    turn = real(scale, "mesh scale", 1e-9, 1e9) * (TO_Z_UP if up == "y" else np.eye(3))
    scene = _open(path, kind)
    parts = []
    with errors_name(path, lambda: "cannot be read as a mesh"):
        for node in sorted(scene.graph.nodes_geometry):
            placed, geometry = scene.graph[node]
            part = scene.geometry[geometry]
            if len(getattr(part, "faces", ())):
                parts.append(_part(part, turn @ placed[:3, :3], turn @ placed[:3, 3], str(node), kind))
    if not parts:
        raise AmiwarpError(f"{path}: holds no faces; give a file with triangles, not points or lines alone")
    return parts


def _open(path: Path, kind: str) -> Any:
    """Return the file as a trimesh scene."""
    try:
        import trimesh
    except ImportError as error:
        raise AmiwarpError(f"{path}: mesh files need trimesh; install it by: pip install 'amiwarp[worlds]'") from error
    files = _named_files(path)
    with errors_name(path, lambda: "cannot be read as a mesh"), open_input(path) as file:
        try:
            scene = trimesh.load(file, file_type=kind, resolver=files, force="scene", process=False)
        except Exception:
            if files.missing is None:
                raise
        if files.missing is not None:
            raise AmiwarpError(f"{path}: refers to the file {files.missing}; put a valid file next to the mesh file")
    return scene


def _named_files(path: Path) -> Any:
    """Return a resolver of referenced files that records the first failure, because trimesh ignores failures."""
    from trimesh.resolvers import FilePathResolver

    class NamedFiles(FilePathResolver):
        """Resolver of the files that a mesh file refers to."""

        missing: str | None = None
        """First file that cannot be read, with the reason, for a message."""

        def get(self, name: str) -> bytes:
            """Return the content of a file; its name is relative to the folder of the mesh file."""
            file = path.parent / name.replace("\\", "/")
            file = file if file.exists() else path.parent / urllib.parse.unquote(name)
            try:
                with open_input(file) as opened:
                    data = opened.read()
                if file.suffix.lower() in PICTURES:
                    _check_picture(data)
            except Exception as error:
                what = "is missing" if isinstance(error, AmiwarpError) else f"cannot be read ({error})"
                self.missing = self.missing or f"{name!r}, which {what}"
                raise
            return data

    return NamedFiles(str(path))


def _check_picture(data: bytes) -> None:
    """Raise an exception if the bytes are no picture in a supported format."""
    from PIL import Image

    with Image.open(io.BytesIO(data), formats=PICTURE_FORMATS) as image:
        image.verify()


def _part(part: Trimesh, matrix: NDArray[np.float64], offset: NDArray[np.float64], name: str, kind: str) -> LoadedMesh:
    """Return one geometry of the file as a mesh with a material.

    ``matrix`` and ``offset``: transformation from the geometry to the world; ``kind``: suffix of the file.
    """
    vertices = np.asarray(part.vertices, np.float64) @ matrix.T + offset
    faces = np.asarray(part.faces)
    visual: Any = part.visual
    if visual.kind == "texture":
        return LoadedMesh(*_textured(visual, vertices, faces, kind), name)
    if visual.kind == "face":  # faces of different colours cannot share vertices
        light = np.repeat(_reflectance(visual.face_colors, kind), 3)
        return LoadedMesh(
            Mesh(vertices[faces.ravel()], np.arange(faces.size).reshape(-1, 3), None, light), Material(1.0), name
        )
    if visual.kind == "vertex":
        return LoadedMesh(Mesh(vertices, faces, None, _reflectance(visual.vertex_colors, kind)), Material(1.0), name)
    return LoadedMesh(Mesh(vertices, faces), Material(DEFAULT_REFLECTANCE), name)


def _textured(visual: Any, vertices: NDArray[np.float64], faces: NDArray[Any], kind: str) -> tuple[Mesh, Material]:
    """Return mesh and material of a geometry whose file gives a material, with or without a texture."""
    material = visual.material
    pbr = hasattr(material, "baseColorFactor")
    picture = material.baseColorTexture if pbr else material.image
    colour = material.baseColorFactor if pbr else material.diffuse
    factor = 1.0 if pbr and colour is None else float(_reflectance(np.atleast_2d(colour), kind)[0])
    shade = visual.vertex_attributes.get("color")
    light = None if shade is None else _reflectance(shade, kind)
    if picture is None or visual.uv is None:
        return Mesh(vertices, faces, None, light), Material(factor)
    if not pbr:
        factor = 1.0  # in OBJ files, a texture replaces the diffuse colour
    return Mesh(vertices, faces, np.asarray(visual.uv)[:, :2], light), Material(factor, _luminance(picture))


def _luminance(picture: Any) -> NDArray[np.float32]:
    """Return the linear luminance of a Pillow picture. A single row or column is duplicated."""
    if picture.width * picture.height > MOST_PIXELS:
        raise AmiwarpError(
            f"a texture has {picture.width}x{picture.height} pixels, more than {MOST_PIXELS}; give a smaller picture"
        )
    pixels = np.asarray(picture.convert("RGB"))
    pixels = np.repeat(pixels, 2, axis=0) if len(pixels) < 2 else pixels
    return linear_luminance(np.repeat(pixels, 2, axis=1) if pixels.shape[1] < 2 else pixels, name="texture")


def _reflectance(colours: Any, kind: str) -> NDArray[np.float64]:
    """Return the luminance of colours (integers, or floats from 0 to 1), shape (n,).

    Colours are linear in glTF and GLB files, and sRGB in other files.
    """
    given = np.asarray(colours)
    values = given[:, :3].astype(np.float64) / (np.iinfo(given.dtype).max if given.dtype.kind in "iu" else 1.0)
    linear = values if kind in Y_UP else srgb_to_linear(values)
    return np.asarray(np.clip(linear @ np.array(LUMINANCE), 0.0, 1.0), np.float64)
