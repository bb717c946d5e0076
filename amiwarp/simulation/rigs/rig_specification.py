"""Reader of a rig's file: a TOML file that names a world, a trajectory and cameras."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.io.inputs import errors_name
from amiwarp.io.json_files import read_toml
from amiwarp.schema.calls import guarded
from amiwarp.schema.records import build, check_format, check_given, value_of
from amiwarp.simulation.motion import LONGEST_S
from amiwarp.simulation.rigs.camera_entries import read_camera
from amiwarp.simulation.rigs.cameras import RigCamera
from amiwarp.simulation.rigs.paper_platform import PAPER_PLATFORM, paper_platform
from amiwarp.simulation.rigs.rig import Rig
from amiwarp.simulation.worlds.world_choice import POSE_FILES, WORLD_FILES, open_world
from amiwarp.validation import one_of, real, shown, whole

FORMAT = "amiwarp-rig-specification"
VERSION = 1
"""Values of the fields ``format`` and ``version``."""


@dataclass(frozen=True, kw_only=True)
class CamerasEntry:
    """Fields of a rig's file that name its cameras."""

    rig: str | None = None
    sensors: tuple[Any, ...] = ()


@dataclass(frozen=True, kw_only=True)
class RigEntry(CamerasEntry):
    """Fields of a rig's file."""

    format: str
    version: int
    world: str
    duration_s: Annotated[float, partial(real, low=1e-3, high=LONGEST_S, hint=" s")]
    trajectory: str | None = None
    seed: Annotated[int, partial(whole, low=0, high=2**31 - 1)] = 0


@guarded
def load_rig(
    path: str | Path,
    *,
    world: str | None = None,
    trajectory: str | None = None,
    duration_s: float | None = None,
    seed: int | None = None,
    device: str = "cpu",
) -> Rig:
    """Read a simulated rig from a TOML file.

    File names in the file are relative to its folder.

    Parameters
    ----------
    path : str or Path
        Rig file with the suffix ``.toml``.
    world, trajectory : str, optional
        Name or file, instead of the file's.
    duration_s : float, optional
        Duration [s], instead of the file's.
    seed : int, optional
        Seed, instead of the file's.
    device : str, optional
        Device to compute on.

    Returns
    -------
    Rig
        The rig.

    Raises
    ------
    AmiwarpError
        If the file or a file named in it cannot be read, or if a field is missing, unknown or has an invalid value.
        The message names the file and the field.

    Examples
    --------
    >>> import pathlib
    >>> _ = pathlib.Path("stereo.toml").write_text('''
    ... format = "amiwarp-rig-specification"
    ... version = 1
    ... world = "desk"
    ... duration_s = 0.1
    ... [[sensors]]
    ... name = "left"
    ... kind = "events"
    ... camera = {size = [64, 48], fov_deg = 60}
    ... [[sensors]]
    ... name = "right"
    ... kind = "events"
    ... position = [0.06, 0, 0]
    ... camera = {size = [64, 48], fov_deg = 60}
    ... ''')
    >>> list(amiwarp.load_rig("stereo.toml").sensors)
    ['left', 'right']
    """
    path = Path(path)
    overriding: dict[str, Any] = {"duration_s": duration_s, "seed": seed}
    given = {name: value for name, value in overriding.items() if value is not None}
    entry = replace(read_rig_file(path), **given)
    with errors_name(path, lambda: "is no file of a rig"):
        folder = path.parent
        sensors = read_cameras(entry, folder)
        world_name = world or _in_folder(entry.world, WORLD_FILES, folder)
        way = trajectory
        if way is None and entry.trajectory is not None:
            way = _in_folder(entry.trajectory, POSE_FILES, folder)
        of_world, of_rig = open_world(world_name, way, seed=entry.seed, duration_s=entry.duration_s)
        return Rig(of_world, of_rig, sensors, entry.duration_s, entry.seed, device)


def read_rig_file(path: Path) -> RigEntry:
    """Return the fields of a rig's file. The values of its cameras are not checked yet."""
    data = read_toml(path, "a rig")
    with errors_name(path, lambda: "is no file of a rig"):
        check_given(data, "", "format", "version")
        check_format(data, FORMAT, VERSION)
        return build(RigEntry, data, "")


def _in_folder(name: str, endings: tuple[str, ...], folder: Path) -> str:
    """Return a name as it is, or the path of the file in a folder that it names."""
    return str(folder / name) if name.lower().endswith(endings) else name


def read_cameras(entry: CamerasEntry, folder: Path, within: str = "") -> dict[str, RigCamera]:
    """Return the cameras of a rig by name.

    ``folder``: folder of the files that they name; ``within``: name of the field that holds the entry, with a dot.
    """
    sensors: dict[str, RigCamera] = {}
    if entry.rig is not None:
        one_of(entry.rig, (PAPER_PLATFORM,), f"field {within}rig")
        sensors |= paper_platform()
    for k, data in enumerate(entry.sensors):
        where = f"{within}sensors[{k}]"
        if not isinstance(data, dict):
            raise AmiwarpError(f"field {where} is {shown(data)}; expected a table", ErrorCode.FIELD)
        check_given(data, where, "name", "kind")
        name = value_of(str, data["name"], f"{where}.name")
        if name in sensors:
            raise AmiwarpError(
                f"field {where} has the name {shown(name)} of another sensor; give it its own name",
                ErrorCode.FIELD,
            )
        rest = {key: value for key, value in data.items() if key != "name"}
        sensors[name] = read_camera(rest, where, folder)
    if not sensors:
        raise AmiwarpError(
            f'field {within}sensors is missing; add [[{within}sensors]], or rig = "{PAPER_PLATFORM}"',
            ErrorCode.FIELD,
        )
    return sensors
