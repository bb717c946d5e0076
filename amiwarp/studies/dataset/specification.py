"""Specification of a data set: a TOML file that names sources, prisms, speeds, sensors, seeds and splits."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, TypeVar

from amiwarp.errors import AmiwarpError
from amiwarp.io.input_files import errors_name
from amiwarp.io.json_files import LARGEST_INTEGER, at_field, build, fields_of, read_toml
from amiwarp.optics.camera import Camera
from amiwarp.optics.prism import Prism
from amiwarp.simulation.motion import LONGEST_S, PrismMotion
from amiwarp.simulation.sensor import SensorModel
from amiwarp.validation import real, shown, whole

FORMAT, VERSION = "amiwarp-dataset-specification", 1
"""Values of the fields ``format`` and ``version``."""
SPLITS = {"train": 0.8, "val": 0.1, "test": 0.1}
"""Default shares of the splits."""
KINDS = ("pictures", "videos", "recordings", "translated", "world_files", "worlds")
"""Fields of a source that name its files or worlds; each source has exactly one of them."""
LARGEST_SEED = 2**31 - 1
"""Largest seed of a recording."""
MOST_RECORDINGS = 1_000_000
"""Largest number of recordings, and of seeds."""
MOST_SPLITS = 100
"""Largest number of splits."""

Entry = TypeVar("Entry")


@dataclass(frozen=True)
class CameraEntry:
    """Fields of ``camera``."""

    size: tuple[int, int] | None = None
    """Width and height [px]; None: 640x480, and the size of the pictures of a video."""
    fov_deg: float = 60.0
    """Horizontal field of view [deg]."""

    def build(self, default: tuple[int, int] = (640, 480)) -> Camera:
        """Return the camera. ``default`` is its size [px] if the specification gives none."""
        return Camera.from_fov(*(self.size or default), math.radians(self.fov_deg))


@dataclass(frozen=True)
class PrismEntry:
    """Fields of an entry of ``prisms``."""

    apex_deg: float
    index: float = 1.5168
    flat_side: str = "scene"

    def build(self) -> Prism:
        """Return the prism."""
        return Prism(math.radians(self.apex_deg), self.index, self.flat_side)  # type: ignore[arg-type]  # checked there


@dataclass(frozen=True)
class SourceEntry:
    """Fields of an entry of ``sources``, except ``labels``."""

    pictures: str | None = None
    videos: str | None = None
    recordings: str | None = None
    translated: str | None = None
    world_files: str | None = None
    worlds: tuple[str, ...] | None = None
    fps: float | None = None
    """Pictures per second of a video."""
    duration_s: float | None = None
    """Duration, instead of that of the specification."""
    trajectories: tuple[str, ...] | None = None
    """Camera motions in a world: still, handheld or fast, or files of poses."""
    label_from_folder: str | None = None
    """Name of the label that takes the name of the file's folder."""
    label_table: str | None = None
    """CSV table with the column ``file`` and a column for each label."""
    licence: str = ""

    @property
    def kind(self) -> str:
        """The one of :data:`KINDS` that is given."""
        return next(kind for kind in KINDS if getattr(self, kind) is not None)


@dataclass(frozen=True)
class SourceGroup:
    """One entry of ``sources`` with its constant labels."""

    entry: SourceEntry
    labels: Mapping[str, Any]


@dataclass(frozen=True)
class Specification:
    """Content of a specification file."""

    path: Path
    data: Mapping[str, Any]
    """Fields of the file, unchanged."""
    name: str
    duration_s: float
    camera: CameraEntry
    prisms: tuple[PrismEntry, ...]
    speeds_rpm: tuple[float, ...]
    sensors: Mapping[str, SensorModel]
    seeds: tuple[int, ...]
    splits: Mapping[str, float]
    split_seed: int
    truth_hz: float | None
    sources: tuple[SourceGroup, ...]

    @property
    def folder(self) -> Path:
        """Absolute path of the folder of the file; names of files in it are relative to this folder."""
        return self.path.parent.resolve()


@dataclass(frozen=True)
class _Plain:
    """Fields of the file that need no conversion."""

    duration_s: float
    prisms: tuple[PrismEntry, ...]
    speeds_rpm: tuple[float, ...]
    name: str = ""
    camera: CameraEntry = field(default_factory=CameraEntry)
    splits: Mapping[str, float] = field(default_factory=lambda: dict(SPLITS))
    split_seed: int = 0
    truth_hz: float | None = None


_OWN = ("sensors", "seeds", "sources")
"""Fields that are converted one by one."""


def load_specification(path: str | Path) -> Specification:
    """Read and check a specification. Raises :class:`AmiwarpError`, which names the field, the value and the remedy."""
    path = Path(path)
    data = read_toml(path, "a specification of a data set")
    with errors_name(path, lambda: "is no specification of a data set"):
        plain = [f.name for f in fields(_Plain)]
        needed = ("format", "version", "duration_s", "prisms", "speeds_rpm", "sources")
        fields_of(data, "", *needed, optional=tuple(n for n in (*plain, *_OWN) if n not in needed))
        if data["format"] != FORMAT or data["version"] != VERSION:
            given = f"{shown(data['format'])} and {shown(data['version'])}"
            raise AmiwarpError(f"fields format and version are {given}; expected {FORMAT!r} and {VERSION}")
        values = build(_Plain, {name: data[name] for name in plain if name in data}, "")
        _check(values)
        return Specification(
            path=path,
            data=data,
            name=values.name or path.stem,
            duration_s=real(values.duration_s, "field duration_s", 1e-3, LONGEST_S, " s"),
            camera=values.camera,
            prisms=values.prisms,
            speeds_rpm=values.speeds_rpm,
            sensors=_sensors(data.get("sensors", ["default"])),
            seeds=_seeds(data.get("seeds", 1)),
            splits=values.splits,
            split_seed=values.split_seed,
            truth_hz=values.truth_hz,
            sources=tuple(_source(entry, f"sources[{k}]") for k, entry in enumerate(_entries(data, "sources"))),
        )


def _entries(data: Mapping[str, Any], name: str) -> list[Any]:
    """Return a list with at least one entry."""
    found = data[name]
    if not isinstance(found, list) or not found:
        raise AmiwarpError(f"field {name} is {shown(found)}; expected a list of at least one entry")
    return found


def _check(values: _Plain) -> None:
    """Raise :class:`AmiwarpError` for values out of range and for repeated ones."""
    at_field("camera", values.camera.build)
    for name in ("prisms", "speeds_rpm"):
        _check_distinct(getattr(values, name), name)
    for k, prism in enumerate(values.prisms):
        at_field(f"prisms[{k}]", prism.build)
    for k, rpm in enumerate(values.speeds_rpm):
        at_field(f"speeds_rpm[{k}]", lambda rpm=rpm: PrismMotion(rpm))  # type: ignore[misc]
    if values.truth_hz is not None:
        real(values.truth_hz, "field truth_hz", 1e-3, 1e6, " Hz")
    if len(values.splits) > MOST_SPLITS:
        raise AmiwarpError(f"field splits has {len(values.splits):,} names; give at most {MOST_SPLITS}")
    for name, share in values.splits.items():
        if not re.fullmatch(r"[A-Za-z0-9_-]+", name):
            raise AmiwarpError(f"field splits has the name {shown(name)}; use letters, digits, '-' and '_'")
        real(share, f"field splits.{name}", 0.0, 1.0)
    total = math.fsum(values.splits.values())
    if abs(total - 1.0) > 1e-6:
        raise AmiwarpError(f"field splits has shares that sum to {total:g}; change them so that they sum to 1")


def _check_distinct(values: tuple[Any, ...], name: str) -> None:
    """Raise :class:`AmiwarpError` for an empty list and for equal entries, whose recordings would be the same."""
    if not values:
        raise AmiwarpError(f"field {name} is empty; give at least one entry")
    first: dict[Any, int] = {}
    for k, value in enumerate(values):
        if first.setdefault(value, k) != k:
            raise AmiwarpError(f"field {name}[{k}] repeats {name}[{first[value]}]; remove it")


def _seeds(value: Any) -> tuple[int, ...]:
    """Return the seeds: those of a list, or the first ones of their number."""
    if isinstance(value, list):
        seeds = tuple(whole(seed, f"field seeds[{k}]", 0, LARGEST_SEED) for k, seed in enumerate(value))
        _check_distinct(seeds, "seeds")
        return seeds
    return tuple(range(whole(value, "field seeds", 1, MOST_RECORDINGS, "; give their number, or a list of them")))


_MAKERS: dict[str, Callable[[], SensorModel]] = {"default": SensorModel, "ideal": SensorModel.ideal}
"""Sensors by name, in addition to the presets of :class:`SensorModel`."""


def _sensors(value: Any) -> dict[str, SensorModel]:
    """Return the sensors by name. An entry is a name, or a table with a name, and optionally a preset and values."""
    found: dict[str, SensorModel] = {}
    for k, entry in enumerate(_entries({"sensors": value}, "sensors")):
        where = f"sensors[{k}]"
        table = {"name": entry, "preset": entry} if isinstance(entry, str) else entry
        known = tuple(f.name for f in fields(SensorModel))
        given = dict(fields_of(table, where, "name", optional=("preset", *known)))
        name, preset = given.pop("name"), given.pop("preset", "default")
        for key, text in (("name", name), ("preset", preset)):
            if not isinstance(text, str) or not text:
                raise AmiwarpError(f"field {where}.{key} is {shown(text)}; expected text")
        if name in found:
            raise AmiwarpError(f"field {where} has the name {name!r} of another sensor; give it its own name")
        found[name] = at_field(where, lambda: replace(_sensor(preset), **given))  # noqa: B023  # called at once
    return found


def _sensor(preset: str) -> SensorModel:
    return _MAKERS[preset]() if preset in _MAKERS else SensorModel.preset(preset)


def _source(data: Any, where: str) -> SourceGroup:
    """Return one entry of ``sources``."""
    known = (*(f.name for f in fields(SourceEntry)), "labels")
    given = dict(fields_of(data, where, optional=known))
    labels = given.pop("labels", {})
    if not isinstance(labels, dict):
        raise AmiwarpError(f"field {where}.labels is {shown(labels)}; expected a table")
    for name, value in labels.items():
        _check_label(value, f"field {where}.labels.{name}")
    entry = build(SourceEntry, given, where)
    _check_source(entry, where)
    return SourceGroup(entry, labels)


def _check_label(value: Any, what: str) -> None:
    """Raise :class:`AmiwarpError` for a value that cannot be a label."""
    if isinstance(value, int | float) and not isinstance(value, bool):
        real(value, what, -LARGEST_INTEGER, LARGEST_INTEGER)
    elif not isinstance(value, str | bool):
        raise AmiwarpError(f"{what} is {shown(value)}; expected text, a number or true/false")


def _check_source(entry: SourceEntry, where: str) -> None:
    """Raise :class:`AmiwarpError` for fields of a source that do not belong together, and for values out of range."""
    kinds = [kind for kind in KINDS if getattr(entry, kind) is not None]
    if len(kinds) != 1:
        raise AmiwarpError(f"field {where} has {' and '.join(kinds) or 'no source'}; give one of {', '.join(KINDS)}")
    uses = {"fps": ("videos",), "trajectories": ("worlds", "world_files"),
            "duration_s": ("pictures", "videos", "translated", "worlds", "world_files")}  # fmt: skip
    for name, allowed in uses.items():
        if getattr(entry, name) is not None and kinds[0] not in allowed:
            raise AmiwarpError(f"field {where}.{name} does not apply to {kinds[0]}; remove it")
    if kinds[0] == "worlds" and (entry.label_from_folder or entry.label_table):
        raise AmiwarpError(f"field {where} has labels from files, but names worlds without files; give labels there")
    for name in ("worlds", "trajectories"):
        if getattr(entry, name) is not None:
            _check_distinct(getattr(entry, name), f"{where}.{name}")
    if entry.duration_s is not None:
        real(entry.duration_s, f"field {where}.duration_s", 1e-3, LONGEST_S, " s")
