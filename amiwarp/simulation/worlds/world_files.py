"""Reader of world files: TOML or JSON files that list meshes, materials, trajectories, lights and a sky."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.io.inputs import errors_name
from amiwarp.io.json_files import read_json, read_toml
from amiwarp.schema.calls import guarded
from amiwarp.schema.records import at_field, build, check_format, fields_of
from amiwarp.simulation.worlds.animated_trajectory import AnimatedTrajectory
from amiwarp.simulation.worlds.bodies import Body, Material
from amiwarp.simulation.worlds.colours import read_colours, relative_colour
from amiwarp.simulation.worlds.lights import Lamp, Sky, Sun
from amiwarp.simulation.worlds.mesh_reader import LoadedMesh, load_mesh
from amiwarp.simulation.worlds.trajectory import Trajectory, looking_at
from amiwarp.simulation.worlds.world import World
from amiwarp.validation import one_of, real, shown

if TYPE_CHECKING:
    pass

FORMAT = "amiwarp-world"
VERSION = 1
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
    animation: str | None = None
    animation_loop: bool | None = None
    animation_speed: float | None = None


@dataclass(frozen=True)
class MaterialEntry:
    """Fields of ``material`` in a world file. None keeps the value of the mesh file."""

    reflectance: float | None = None
    texture: str | None = None
    emission: float | None = None
    colour: Vector | None = None


@dataclass(frozen=True)
class SkyEntry:
    """Fields of ``sky`` in a world file. None stands for the default."""

    luminance: float | None = None
    panorama: str | None = None
    colour: Vector | None = None


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
        check_format(given, FORMAT, VERSION)
        return _Reader(path.parent).world(given, path.stem)


def _read(path: Path) -> dict[str, Any]:
    """Return the fields of a TOML or JSON file."""
    kind = path.suffix.lower()
    if kind == ".json":
        data = read_json(path, "a world")
    elif kind == ".toml":
        data = read_toml(path, "a world")
    else:
        raise AmiwarpError(
            f"{path}: has the suffix {path.suffix!r}; a world file ends in .toml or .json",
            ErrorCode.FORMAT_UNKNOWN,
        )
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
        lamps: list[Lamp] = []
        for where, entry in _entries(given.get("lamps", []), "lamps"):
            lamps.append(at_field(where, partial(build, Lamp, entry, where)))
        options["lamps"] = lamps
        bodies: list[Body] = []
        for where, entry in _entries(given["bodies"], "bodies"):
            bodies += self._bodies(entry, where)
        joints = given.get("joints", {})
        if not isinstance(joints, dict):
            fields_of(joints, "joints")  # raises the error of a field that is no table
        options["joints"] = {
            key: self._trajectory(value, f"joints.{key}") for key, value in joints.items()
        }
        camera = None
        if "camera" in given:
            fields = fields_of(given["camera"], "camera", "trajectory")
            camera = self._trajectory(fields["trajectory"], "camera.trajectory")
        return World(bodies=tuple(bodies), **options), camera

    def _sky(self, data: Any) -> Sky:
        """Return the sky of the field ``sky``."""
        entry = build(SkyEntry, data, "sky")
        panorama = None
        colour: Any = None
        if entry.panorama is not None:
            panorama, colour = self._picture(entry.panorama)
        if entry.colour is not None:
            colour = relative_colour(entry.colour, "sky colour")
        if entry.luminance is not None:
            return Sky(entry.luminance, panorama, colour)
        if panorama is not None:
            return Sky(1.0, panorama, colour)
        return Sky(colour=colour)

    def _picture(self, name: str) -> tuple[Any, Any]:
        """Return the linear luminance of a picture file, and its colours relative to it, or None for grey."""
        return read_colours(self._folder / name)

    def _bodies(self, data: Any, where: str) -> list[Body]:
        """Return the bodies of one entry of ``bodies``: one body for each part of the mesh file.

        ``where``: name of the entry in messages.
        """
        needed = ("name", "mesh")
        nested = ("material", "trajectory")
        optional = [name for name in BodyEntry.__dataclass_fields__ if name not in needed]
        given = fields_of(data, where, *needed, optional=(*optional, *nested))
        plain = {key: value for key, value in given.items() if key not in nested}
        entry = build(BodyEntry, plain, where)
        if entry.up is not None:
            one_of(entry.up, ("y", "z"), f"field {where}.up")
        real(entry.scale, f"field {where}.scale", 1e-9, 1e9)
        material = build(MaterialEntry, given.get("material", {}), f"{where}.material")
        trajectory = self._body_trajectory(given, entry, where)
        parts = at_field(
            f"{where}.mesh",
            lambda: load_mesh(
                self._folder / entry.mesh,
                up=entry.up,
                scale=entry.scale,
                animation=entry.animation,
            ),
        )
        _check_animation(entry, parts, where)
        texture = (None, None)
        if material.texture is not None:
            picture_name = material.texture
            texture = at_field(f"{where}.material.texture", lambda: self._picture(picture_name))
        bodies = []
        for name, part in zip(_part_names(entry.name, parts), parts, strict=True):
            own_material = at_field(
                f"{where}.material", partial(_material, part, material, texture, where)
            )
            body = Body(
                name=name,
                mesh=part.mesh,
                material=own_material,
                trajectory=at_field(where, partial(_animated, part, entry, trajectory)),
                category=entry.category,
                instance=entry.instance or entry.name,
            )
            bodies.append(body)
        return bodies

    def _body_trajectory(
        self, given: Mapping[str, Any], entry: BodyEntry, where: str
    ) -> Trajectory | None:
        """Return the trajectory of a body; None if the entry gives neither a trajectory nor a pose."""
        if "trajectory" in given:
            for name in ("position", "rotation"):
                if name in given:
                    raise AmiwarpError(
                        f"field {where}.{name} cannot be combined with a trajectory; put the pose into the trajectory",
                        ErrorCode.FIELD,
                    )
            return self._trajectory(given["trajectory"], f"{where}.trajectory")
        if entry.position is None and entry.rotation is None:
            return None
        position = entry.position or (0.0, 0.0, 0.0)
        rotation = entry.rotation or (0.0, 0.0, 0.0, 1.0)
        return at_field(where, lambda: Trajectory.still(position, rotation=rotation))

    def _trajectory(self, data: Any, where: str) -> Trajectory:
        """Return a trajectory from the name of a CSV or TUM file, or from a list of key poses."""
        if isinstance(data, str):
            return at_field(where, lambda: Trajectory.from_file(self._folder / data))
        poses = [
            build(PoseEntry, entry, place)
            for place, entry in _entries(data, where, "the name of a file or a list")
        ]
        if not poses:
            raise AmiwarpError(f"field {where} is empty; give at least one pose", ErrorCode.FIELD)
        turns = [_rotation(pose, f"{where}[{k}]") for k, pose in enumerate(poses)]
        return at_field(
            where,
            lambda: Trajectory(
                [pose.t for pose in poses], [pose.position for pose in poses], turns
            ),
        )


def _check_animation(entry: BodyEntry, parts: list[LoadedMesh], where: str) -> None:
    """Raise :class:`AmiwarpError` if an entry has fields of an animation whose values cannot apply."""
    if entry.animation_speed is not None:
        real(entry.animation_speed, f"field {where}.animation_speed", 1e-3, 1e3)
    given = [
        name for name in ("animation_loop", "animation_speed") if getattr(entry, name) is not None
    ]
    if given and not any(part.motion for part in parts):
        raise AmiwarpError(
            f"field {where}.{given[0]}: no animation moves a part of {entry.mesh}; remove the field",
            ErrorCode.FIELD,
        )


def _animated(
    part: LoadedMesh, entry: BodyEntry, trajectory: Trajectory | None
) -> Trajectory | None:
    """Return the trajectory of a part of a mesh file: its animation, in the frame that ``trajectory`` moves."""
    if part.motion is None:
        return trajectory
    speed = 1.0 if entry.animation_speed is None else entry.animation_speed
    return AnimatedTrajectory(
        part.motion, loop=bool(entry.animation_loop), speed=speed, carrier=trajectory
    )


def _text(value: Any, where: str) -> str:
    """Return a value that must be text; raise :class:`AmiwarpError` otherwise."""
    if not isinstance(value, str):
        raise AmiwarpError(f"field {where} is {shown(value)}; expected text", ErrorCode.FIELD)
    return value


def _entries(value: Any, where: str, expected: str = "a list") -> list[tuple[str, Any]]:
    """Return the entries of a list, each with the name of its field, such as ``bodies[0]``."""
    if not isinstance(value, list):
        raise AmiwarpError(f"field {where} is {shown(value)}; expected {expected}", ErrorCode.FIELD)
    return [(f"{where}[{k}]", entry) for k, entry in enumerate(value)]


def _rotation(pose: PoseEntry, where: str) -> Any:
    """Return the orientation of a key pose as a quaternion (x, y, z, w)."""
    if pose.look_at is None:
        return pose.rotation or (0.0, 0.0, 0.0, 1.0)
    if pose.rotation is not None:
        raise AmiwarpError(
            f"field {where} has both rotation and look_at; give one of them", ErrorCode.FIELD
        )
    return at_field(where, lambda: looking_at(pose.position, pose.look_at or ()).as_quat())


def _part_names(name: str, parts: list[LoadedMesh]) -> list[str]:
    """Return the names of an entry's bodies: ``name``, or ``name/part`` if the mesh file has several parts."""
    if len(parts) == 1:
        return [name]
    return [f"{name}/{part.name}" for part in parts]


def _material(
    part: LoadedMesh, entry: MaterialEntry, given: tuple[Any, Any], where: str
) -> Material:
    """Return the material of a part; fields of the world file replace values of the mesh file.

    ``given``: luminance and relative colours of the picture that the world file gives, or None.
    """
    part_material = part.material
    texture, colour = given
    if texture is None:
        colour = part_material.colour
    if entry.colour is not None:
        colour = relative_colour(entry.colour, "material colour")
    if texture is not None and part.mesh.uv is None:
        raise AmiwarpError(
            f"field {where}.material.texture needs texture coordinates, but the mesh has none; remove it",
            ErrorCode.FIELD,
        )
    reflectance = part_material.reflectance if texture is None else 1.0
    return Material(
        reflectance if entry.reflectance is None else entry.reflectance,
        part_material.texture if texture is None else texture,
        part_material.emission if entry.emission is None else entry.emission,
        colour,
    )
