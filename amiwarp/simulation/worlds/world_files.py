"""Reader of world files: TOML or JSON files that list meshes, materials, trajectories, lights and a sky."""

from __future__ import annotations

import contextlib
import importlib.util
import io
import urllib.parse
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.io.files import errors_name, note_input, open_input
from amiwarp.io.json_files import at_field, build, fields_of, read_json, read_toml
from amiwarp.io.reading_process import Allowance, borrow, give_back
from amiwarp.simulation.pictures import BAND, LUMINANCE, MOST_PIXELS, PICTURE_FORMATS, read_picture, srgb_to_linear
from amiwarp.simulation.worlds.named.catalogue import named_world
from amiwarp.simulation.worlds.world import Body, Lamp, Material, Mesh, Sky, Sun, Trajectory, World, looking_at
from amiwarp.validation import guarded, one_of, real, shown

if TYPE_CHECKING:
    from trimesh import Trimesh

# Reader of mesh files (glTF, GLB, OBJ with MTL, PLY, STL) that uses trimesh. Colours become luminance.
#
# A file of a few bytes may declare a mesh of many gigabytes, so trimesh runs in the reading process, which has limits
# of memory and processor time (:mod:`amiwarp.io.reading_process`).

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

Arrays = tuple[NDArray[Any] | None, ...]
"""Vertices, faces, texture coordinates, light and texture of a part; None for an array that it has not."""


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
    _check_trimesh(path)
    with errors_name(path, lambda: "cannot be read as a mesh"):
        found, arrays = _called(path, kind, turn)
        parts = [_received(about, arrays) for about in found["parts"]]
    if not parts:
        raise AmiwarpError(f"{path}: holds no faces; give a file with triangles, not points or lines alone")
    return parts


def mesh_files(path: Path) -> list[Path]:
    """Return the files that a mesh file refers to; none for a file that cannot be read as a mesh."""
    kind = path.suffix.lower().removeprefix(".")
    if kind in FORMATS:
        _check_trimesh(path)
        with contextlib.suppress(AmiwarpError), errors_name(path, lambda: "cannot be read as a mesh"):
            return [Path(file) for file in _called(path, kind, np.eye(3))[0]["files"]]
    return []


def _check_trimesh(path: Path) -> None:
    """Raise :class:`AmiwarpError` if trimesh is not installed."""
    if importlib.util.find_spec("trimesh") is None:
        raise AmiwarpError(f"{path}: mesh files need trimesh; run: pip install 'amiwarp[worlds]'")


def _called(path: Path, kind: str, turn: NDArray[np.float64]) -> tuple[dict[str, Any], list[NDArray[Any]]]:
    """Return what :func:`read_parts` returns, and register the files as inputs."""
    # a glTF file has its arrays in files next to it
    allowance = Allowance(path, path.parent) if kind == "gltf" else Allowance(path)
    process = borrow()
    try:
        found, arrays = process.call(f"{__name__}:read_parts", path, kind, turn.tolist(), allowance=allowance)
    finally:
        give_back(process)
    for file in found["files"]:
        note_input(Path(file))
    return found, arrays


def _received(about: dict[str, Any], arrays: list[NDArray[Any]]) -> LoadedMesh:
    """Return a part that :func:`read_parts` described, and remove its arrays from the front of the list."""
    values: list[Any] = [None if shape is None else arrays.pop(0).reshape(shape) for shape in about["shapes"]]
    vertices, faces, uv, light, texture = values
    return LoadedMesh(Mesh(vertices, faces, uv, light), Material(about["reflectance"], texture), about["name"])


def read_parts(path: str, kind: str, turn: list[list[float]]) -> tuple[dict[str, Any], list[NDArray[Any]]]:
    """Read the parts of a mesh file, in the reading process.

    ``kind``: suffix of the file; ``turn``: matrix (3, 3) by which vertices are multiplied. The first value holds the
    files that the mesh file refers to, and of each part the name, the reflectance and the shapes of its arrays:
    vertices, faces, texture coordinates, light and texture. A shape is None if the part has no such array.
    """
    scene, files = _open(Path(path), kind)
    parts: list[dict[str, Any]] = []
    arrays: list[NDArray[Any]] = []
    for node in sorted(scene.graph.nodes_geometry):
        placed, geometry = scene.graph[node]
        part = scene.geometry[geometry]
        if len(getattr(part, "faces", ())):
            matrix = np.array(turn) @ placed[:3]
            values, reflectance = _part(part, matrix[:, :3], matrix[:, 3], kind)
            shapes = [None if value is None else value.shape for value in values]
            parts.append({"name": str(node), "reflectance": reflectance, "shapes": shapes})
            arrays += [value.ravel() for value in values if value is not None]
    return {"files": files, "parts": parts}, arrays


def _open(path: Path, kind: str) -> tuple[Any, list[str]]:
    """Return the file as a trimesh scene, and the files that it refers to."""
    import trimesh

    files = _named_files(path)
    with open_input(path) as file:
        try:
            scene = trimesh.load(file, file_type=kind, resolver=files, force="scene", process=False)
        except Exception:
            if files.missing is None:
                raise
        if files.missing is not None:
            raise AmiwarpError(f"refers to the file {files.missing}; put a valid file next to the mesh file")
    return scene, files.read


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
            self.read.append(str(file))
            return data

    return NamedFiles()


def _check_picture(data: bytes) -> None:
    """Raise an exception if the bytes are no picture in a supported format."""
    from PIL import Image

    with Image.open(io.BytesIO(data), formats=PICTURE_FORMATS) as image:
        image.verify()


def _part(part: Trimesh, matrix: NDArray[Any], offset: NDArray[Any], kind: str) -> tuple[Arrays, float]:
    """Return the arrays and the reflectance of one geometry of the file.

    ``matrix`` and ``offset``: transformation from the geometry to the world; ``kind``: suffix of the file.
    """
    vertices = np.asarray(part.vertices, np.float64) @ matrix.T + offset
    faces = np.asarray(part.faces)
    visual: Any = part.visual
    if visual.kind == "texture":
        return _textured(visual, vertices, faces, kind)
    if visual.kind == "face":  # faces of different colours cannot share vertices
        light = np.repeat(_reflectance(visual.face_colors, kind), 3)
        return (vertices[faces.ravel()], np.arange(faces.size).reshape(-1, 3), None, light, None), 1.0
    if visual.kind == "vertex":
        return (vertices, faces, None, _reflectance(visual.vertex_colors, kind), None), 1.0
    return (vertices, faces, None, None, None), DEFAULT_REFLECTANCE


def _textured(visual: Any, vertices: NDArray[Any], faces: NDArray[Any], kind: str) -> tuple[Arrays, float]:
    """Return arrays and reflectance of a geometry whose file gives a material, with or without a texture."""
    material = visual.material
    pbr = hasattr(material, "baseColorFactor")
    picture = material.baseColorTexture if pbr else material.image
    colour = material.baseColorFactor if pbr else material.diffuse
    factor = 1.0 if pbr and colour is None else float(_reflectance(np.atleast_2d(colour), kind)[0])
    shade = visual.vertex_attributes.get("color")
    light = None if shade is None else _reflectance(shade, kind)
    if picture is None or visual.uv is None:
        return (vertices, faces, None, light, None), factor
    if not pbr:
        factor = 1.0  # in OBJ files, a texture replaces the diffuse colour
    return (vertices, faces, np.asarray(visual.uv)[:, :2], light, _luminance(picture)), factor


def _luminance(picture: Any) -> NDArray[np.float32]:
    """Return the linear luminance of a Pillow picture. A single row or column is duplicated."""
    if picture.width * picture.height > MOST_PIXELS:
        raise AmiwarpError(
            f"a texture has {picture.width}x{picture.height} pixels, more than {MOST_PIXELS}; give a smaller picture"
        )
    table = srgb_to_linear(np.arange(256, dtype=np.float32) / 255)
    light = np.empty((picture.height, picture.width), np.float32)
    rows = max(1, BAND // (3 * picture.width))
    for top in range(0, picture.height, rows):  # a large picture as a whole would need four times its memory
        band = picture.crop((0, top, picture.width, min(top + rows, picture.height))).convert("RGB")
        light[top : top + rows] = table[np.asarray(band)] @ np.array(LUMINANCE, np.float32)
    light = np.repeat(light, 2, axis=0) if len(light) < 2 else light
    return np.repeat(light, 2, axis=1) if light.shape[1] < 2 else light


def _reflectance(colours: Any, kind: str) -> NDArray[np.float64]:
    """Return the luminance of colours (integers, or floats from 0 to 1), shape (n,).

    Colours are linear in glTF and GLB files, and sRGB in other files.
    """
    given = np.asarray(colours)
    values = given[:, :3].astype(np.float64) / (np.iinfo(given.dtype).max if given.dtype.kind in "iu" else 1.0)
    linear = values if kind in Y_UP else srgb_to_linear(values)
    return np.asarray(np.clip(linear @ np.array(LUMINANCE), 0.0, 1.0), np.float64)


FORMAT, VERSION = "amiwarp-world", 1
"""Expected values of the fields ``format`` and ``version`` of a world file."""

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]


@dataclass(frozen=True)
class BodyEntry:
    """Fields of an entry of the list ``bodies`` in a world file, except ``material`` and ``trajectory``."""

    name: str
    mesh: str
    scale: float = 1.0
    up: str | None = None
    position: Vector | None = None
    rotation: Quaternion | None = None
    category: str = ""
    instance: str | None = None


@dataclass(frozen=True)
class MaterialEntry:
    """Fields of ``material`` in a world file. None keeps the value of the mesh file."""

    reflectance: float | None = None
    texture: str | None = None
    emission: float | None = None


@dataclass(frozen=True)
class SkyEntry:
    """Fields of ``sky`` in a world file. None stands for the default."""

    luminance: float | None = None
    panorama: str | None = None


@dataclass(frozen=True)
class PoseEntry:
    """Fields of a key pose of a trajectory in a world file. At most one of ``rotation`` and ``look_at`` is given."""

    t: float
    position: Vector
    rotation: Quaternion | None = None
    look_at: Vector | None = None


@guarded
def load_world(path: str | Path) -> tuple[World, Trajectory | None]:
    """Read a world and its camera trajectory from a TOML or JSON file.

    File names in the world file are relative to its folder. Mesh files need trimesh: ``pip install "amiwarp[worlds]"``.

    Parameters
    ----------
    path : str or Path
        World file with the suffix ``.toml`` or ``.json``.

    Returns
    -------
    world : World
        The world: bodies, lights and sky.
    trajectory : Trajectory or None
        Trajectory of the camera, or None if the file gives no camera trajectory.

    Raises
    ------
    AmiwarpError
        If the file or a file named in it cannot be read, or if a field is missing, unknown or has an invalid value.
        The message names the file and the field.

    Examples
    --------
    >>> import pathlib, tempfile
    >>> folder = pathlib.Path(tempfile.mkdtemp())
    >>> _ = (folder / "tile.obj").write_text("v 0 0 0\\nv 1 0 0\\nv 0 1 0\\nf 1 2 3\\n")
    >>> _ = (folder / "world.toml").write_text('''
    ... format = "amiwarp-world"
    ... version = 1
    ... bodies = [{name = "tile", mesh = "tile.obj"}]
    ... camera = {trajectory = [{t = 0, position = [0, 0, 2], look_at = [0, 0, 0]}]}
    ... ''')
    >>> world, trajectory = amiwarp.load_world(folder / "world.toml")
    >>> world.instances
    ('tile',)
    """
    path = Path(path)
    data = _read(path)
    with errors_name(path, lambda: "is not a world file"):
        optional = ("name", "ambient", "sun", "lamps", "sky", "joints", "camera")
        given = fields_of(data, "", "format", "version", "bodies", optional=optional)
        if given["format"] != FORMAT or given["version"] != VERSION:
            raise AmiwarpError(
                f"fields format and version are {shown(given['format'])} and {shown(given['version'])}; "
                f"expected {FORMAT!r} and {VERSION}"
            )
        return _Reader(path.parent).world(given, path.stem)


def _read(path: Path) -> dict[str, Any]:
    """Return the fields of a TOML or JSON file."""
    kind = path.suffix.lower()
    if kind == ".json":
        data = read_json(path, "a world")
    elif kind == ".toml":
        data = read_toml(path, "a world")
    else:
        raise AmiwarpError(f"{path}: has the suffix {path.suffix!r}; a world file ends in .toml or .json")
    return data


class _Reader:
    """Builder of a world from the fields of a world file. File names in the fields are relative to ``folder``."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def world(self, given: dict[str, Any], name: str) -> tuple[World, Trajectory | None]:
        """Return the world and the camera's trajectory. ``name``: name of a world file without the field ``name``."""
        options: dict[str, Any] = {"name": _text(given.get("name", name), "name")}
        if "ambient" in given:
            options["ambient"] = real(given["ambient"], "field ambient", 0.0)
        if "sun" in given:
            options["sun"] = at_field("sun", lambda: build(Sun, given["sun"], "sun"))
        if "sky" in given:
            options["sky"] = at_field("sky", lambda: self._sky(given["sky"]))
        options["lamps"] = [
            at_field(where, partial(build, Lamp, entry, where))
            for where, entry in _entries(given.get("lamps", []), "lamps")
        ]
        bodies: list[Body] = []
        for where, entry in _entries(given["bodies"], "bodies"):
            bodies += self._bodies(entry, where)
        joints = given.get("joints", {})
        joints = joints if isinstance(joints, dict) else fields_of(joints, "joints")
        options["joints"] = {key: self._trajectory(value, f"joints.{key}") for key, value in joints.items()}
        camera = None
        if "camera" in given:
            camera = self._trajectory(
                fields_of(given["camera"], "camera", "trajectory")["trajectory"], "camera.trajectory"
            )
        return World(bodies=tuple(bodies), **options), camera

    def _sky(self, data: Any) -> Sky:
        """Return the sky of the field ``sky``."""
        entry = build(SkyEntry, data, "sky")
        panorama = None if entry.panorama is None else self._picture(entry.panorama)
        luminance = entry.luminance if entry.luminance is not None else (0.6 if panorama is None else 1.0)
        return Sky(luminance, panorama)

    def _picture(self, name: str) -> Any:
        """Return the linear luminance of a picture file."""
        return read_picture(self._folder / name)

    def _bodies(self, data: Any, where: str) -> list[Body]:
        """Return the bodies of one entry of ``bodies``: one body for each part of the mesh file.

        ``where``: name of the entry in messages.
        """
        known = (*BodyEntry.__dataclass_fields__, "material", "trajectory")
        given = fields_of(data, where, "name", "mesh", optional=tuple(k for k in known if k not in ("name", "mesh")))
        plain = {key: value for key, value in given.items() if key not in ("material", "trajectory")}
        entry = build(BodyEntry, plain, where)
        if entry.up is not None:
            one_of(entry.up, ("y", "z"), f"field {where}.up")
        real(entry.scale, f"field {where}.scale", 1e-9, 1e9)
        material = build(MaterialEntry, given.get("material", {}), f"{where}.material")
        trajectory = self._body_trajectory(given, entry, where)
        parts = at_field(f"{where}.mesh", lambda: load_mesh(self._folder / entry.mesh, up=entry.up, scale=entry.scale))
        names = _part_names(entry.name, parts)
        texture = None if material.texture is None else at_field(
            f"{where}.material.texture", lambda: self._picture(str(material.texture))
        )  # fmt: skip
        return [
            Body(
                name=name,
                mesh=part.mesh,
                material=at_field(f"{where}.material", partial(_material, part, material, texture, where)),
                trajectory=trajectory,
                category=entry.category,
                instance=entry.instance or entry.name,
            )
            for name, part in zip(names, parts, strict=True)
        ]

    def _body_trajectory(self, given: Mapping[str, Any], entry: BodyEntry, where: str) -> Trajectory | None:
        """Return the trajectory of a body; None if the entry gives neither a trajectory nor a pose."""
        if "trajectory" in given:
            for name in ("position", "rotation"):
                if name in given:
                    raise AmiwarpError(
                        f"field {where}.{name} cannot be combined with a trajectory; put the pose into the trajectory"
                    )
            return self._trajectory(given["trajectory"], f"{where}.trajectory")
        if entry.position is None and entry.rotation is None:
            return None
        position, rotation = entry.position or (0.0, 0.0, 0.0), entry.rotation or (0.0, 0.0, 0.0, 1.0)
        return at_field(where, lambda: Trajectory.still(position, rotation=rotation))

    def _trajectory(self, data: Any, where: str) -> Trajectory:
        """Return a trajectory from the name of a CSV or TUM file, or from a list of key poses."""
        if isinstance(data, str):
            return at_field(where, lambda: Trajectory.from_file(self._folder / data))
        poses = [
            build(PoseEntry, entry, place) for place, entry in _entries(data, where, "the name of a file or a list")
        ]
        if not poses:
            raise AmiwarpError(f"field {where} is empty; give at least one pose")
        turns = [_rotation(pose, f"{where}[{k}]") for k, pose in enumerate(poses)]
        return at_field(where, lambda: Trajectory([pose.t for pose in poses], [pose.position for pose in poses], turns))


def _text(value: Any, where: str) -> str:
    """Return a value that must be text; raise :class:`AmiwarpError` otherwise."""
    if not isinstance(value, str):
        raise AmiwarpError(f"field {where} is {shown(value)}; expected text")
    return value


def _entries(value: Any, where: str, expected: str = "a list") -> list[tuple[str, Any]]:
    """Return the entries of a list, each with the name of its field, such as ``bodies[0]``."""
    if not isinstance(value, list):
        raise AmiwarpError(f"field {where} is {shown(value)}; expected {expected}")
    return [(f"{where}[{k}]", entry) for k, entry in enumerate(value)]


def _rotation(pose: PoseEntry, where: str) -> Any:
    """Return the orientation of a key pose as a quaternion (x, y, z, w)."""
    if pose.look_at is None:
        return pose.rotation or (0.0, 0.0, 0.0, 1.0)
    if pose.rotation is not None:
        raise AmiwarpError(f"field {where} has both rotation and look_at; give one of them")
    return at_field(where, lambda: looking_at(pose.position, pose.look_at or ()).as_quat())


def _part_names(name: str, parts: list[LoadedMesh]) -> list[str]:
    """Return the names of an entry's bodies: ``name``, or ``name/part`` if the mesh file has several parts."""
    if len(parts) == 1:
        return [name]
    return [f"{name}/{part.name}" for part in parts]


def _material(part: LoadedMesh, entry: MaterialEntry, texture: Any, where: str) -> Material:
    """Return the material of a part; fields of the world file replace values of the mesh file.

    ``texture``: picture that the world file gives, or None.
    """
    own = part.material
    if texture is not None and part.mesh.uv is None:
        raise AmiwarpError(
            f"field {where}.material.texture needs texture coordinates, but the mesh has none; remove it"
        )
    reflectance = own.reflectance if texture is None else 1.0
    return Material(
        reflectance if entry.reflectance is None else entry.reflectance,
        own.texture if texture is None else texture,
        own.emission if entry.emission is None else entry.emission,
    )


# Worlds and camera trajectories by name: built-in worlds, or files.

WORLD_FILES = (".toml", ".json")
"""File suffixes of world files."""
POSE_FILES = (".txt", ".csv", ".tum")
"""File suffixes of files with poses."""


def open_world(name: str, trajectory: str | None, *, seed: int, duration_s: float) -> tuple[World, Trajectory]:
    """Return a world and the camera's trajectory through it.

    ``name`` is that of a built-in world or of a world file. ``trajectory`` is a kind of motion of the built-in worlds,
    or a file of poses; None is handheld motion, or the trajectory of the world file. Raises :class:`AmiwarpError` if
    one of them does not exist or they do not belong together.
    """
    is_file = trajectory is not None and trajectory.lower().endswith(POSE_FILES)
    poses = Trajectory.from_file(str(trajectory)) if is_file else None
    if not name.lower().endswith(WORLD_FILES):
        kind = "still" if poses is not None else trajectory or "handheld"
        world, own = named_world(name, kind, seed=seed, duration_s=duration_s)
        return world, poses or own
    world, stored = load_world(Path(name))
    if trajectory is not None and poses is None:
        raise AmiwarpError(f"trajectory {trajectory} applies only to named worlds; give a file of poses for {name}")
    chosen = poses or stored
    if chosen is None:
        raise AmiwarpError(f"{name}: has no camera trajectory; give a file of poses (.txt, .csv) as trajectory")
    return world, chosen
