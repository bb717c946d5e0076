"""Specification of a data set: a TOML file that names sources, prisms, speeds, sensors, seeds and splits."""

import contextlib
import csv
import fnmatch
import glob
import hashlib
import inspect
import io
import itertools
import math
import os
import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from amiwarp.errors import AmiwarpError
from amiwarp.imaging import tensors
from amiwarp.io.files import errors_name, open_input
from amiwarp.io.formats import SPLIT_NAME
from amiwarp.io.json_files import LARGEST_INTEGER, at_field, build, fields_of, read_json, read_toml
from amiwarp.optics.camera import Camera
from amiwarp.optics.prism import Prism
from amiwarp.simulation.description import LONGEST_S, PrismMotion
from amiwarp.simulation.sensor_model import SensorModel
from amiwarp.simulation.worlds.named.catalogue import WORLDS
from amiwarp.simulation.worlds.world_files import mesh_files
from amiwarp.validation import one_of, real, shown, whole

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


def _from_one(value: Any, name: str) -> Any:
    """Return a positive number; raise :class:`AmiwarpError` for another one."""
    return whole(value, name, 1, LARGEST_INTEGER)


@dataclass(frozen=True)
class OutputEntry:
    """Fields of ``output``: tensors that are written instead of recordings.

    The fields without a docstring are parameters of the function in :mod:`amiwarp.imaging.tensors`.
    """

    representation: Literal[
        "event_count", "polarity_histogram", "voxel_grid", "stacked_histogram", "time_surface", "latest_times"
    ]
    """Name of the function."""
    bins: Annotated[int, partial(whole, low=1, high=tensors.MOST_BINS)] | None = None
    end_bin: bool | None = None
    normalize: bool | None = None
    limit: Annotated[int, partial(whole, low=1, high=255)] | None = None
    tau_us: Annotated[float, partial(real, low=1e-6)] | None = None
    linear: bool | None = None
    per_polarity: bool | None = None
    carry: bool | None = None
    t_start: int | None = None
    t_end: int | None = None
    window_us: Annotated[int, _from_one] | None = None
    """Length of the windows, which give one tensor each [us]; None for one tensor of all events."""
    window_events: Annotated[int, _from_one] | None = None
    """Number of events in a window, instead of its length."""

    @property
    def given(self) -> dict[str, Any]:
        """Fields that are given, by name."""
        return {name: value for name, value in asdict(self).items() if value is not None}

    @property
    def function(self) -> Callable[..., Any]:
        """Function that makes the tensors."""
        return getattr(tensors, self.representation)

    @property
    def options(self) -> dict[str, Any]:
        """Arguments of the function that are given."""
        other = ("representation", "window_us", "window_events", *(("t_start", "t_end") if self.window_us else ()))
        return {name: value for name, value in self.given.items() if name not in other}

    @property
    def windows(self) -> dict[str, Any]:
        """Arguments of :func:`amiwarp.windows`; none for one tensor of all events."""
        found: dict[str, int | None] = {"duration_us": self.window_us, "count": self.window_events}
        if self.window_us is not None:
            found |= {"t_start": self.t_start, "t_end": self.t_end}
        return {name: value for name, value in found.items() if value is not None}


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
    rotate_deg_s: tuple[float, float, float] | None = None
    """Angular velocity of the camera in front of a picture about its x, y and z axes [deg/s]."""
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


@dataclass(frozen=True, kw_only=True)
class _Plain:
    """Fields of the file that need no conversion."""

    duration_s: float
    prisms: tuple[PrismEntry, ...] = ()
    speeds_rpm: tuple[float, ...] = ()
    no_prism: bool = False
    """Whether to make recordings of a plain event camera too; without ``prisms``, these only."""
    name: str = ""
    camera: CameraEntry = field(default_factory=CameraEntry)
    splits: Mapping[str, float] = field(default_factory=lambda: dict(SPLITS))
    split_seed: int = 0
    stratify: str | None = None
    """Label whose values, the classes, are each divided among the splits by their shares; None: a draw per source."""
    truth_hz: float | None = None
    output: OutputEntry | None = None
    """Tensors to write instead of recordings; None: recordings."""


@dataclass(frozen=True, kw_only=True)
class Specification(_Plain):
    """Content of a specification file."""

    path: Path
    data: Mapping[str, Any]
    """Fields of the file, unchanged."""
    sensors: Mapping[str, SensorModel]
    seeds: tuple[int, ...]
    sources: tuple[SourceGroup, ...]

    @property
    def folder(self) -> Path:
        """Absolute path of the folder of the file; names of files in it are relative to this folder."""
        return self.path.parent.resolve()


_OWN = ("sensors", "seeds", "sources")
"""Fields that are converted one by one."""


def load_specification(path: str | Path) -> Specification:
    """Read and check a specification. Raises :class:`AmiwarpError`, which names the field, the value and the remedy."""
    path = Path(path)
    data = read_toml(path, "a specification of a data set")
    with errors_name(path, lambda: "is no specification of a data set"):
        plain = [f.name for f in fields(_Plain)]
        optics = () if data.get("no_prism") else ("prisms", "speeds_rpm")
        needed = ("format", "version", "duration_s", *optics, "sources")
        fields_of(data, "", *needed, optional=tuple(n for n in (*plain, *_OWN) if n not in needed))
        if data["format"] != FORMAT or data["version"] != VERSION:
            given = f"{shown(data['format'])} and {shown(data['version'])}"
            raise AmiwarpError(f"fields format and version are {given}; expected {FORMAT!r} and {VERSION}")
        values = build(_Plain, {name: data[name] for name in plain if name in data}, "")
        _check(values)
        sources = tuple(_source(entry, f"sources[{k}]") for k, entry in enumerate(_entries(data, "sources")))
        if values.no_prism:
            _check_motion(sources)
        return Specification(
            **vars(values) | {"name": values.name or path.stem},
            path=path,
            data=data,
            sensors=_sensors(data.get("sensors", ["default"])),
            seeds=_seeds(data.get("seeds", 1)),
            sources=sources,
        )


def _entries(data: Mapping[str, Any], name: str) -> list[Any]:
    """Return a list with at least one entry."""
    found = data[name]
    if not isinstance(found, list) or not found:
        raise AmiwarpError(f"field {name} is {shown(found)}; expected a list of at least one entry")
    return found


def _check(values: _Plain) -> None:
    """Raise :class:`AmiwarpError` for values out of range and for repeated ones."""
    real(values.duration_s, "field duration_s", 1e-3, LONGEST_S, " s")
    at_field("camera", values.camera.build)
    if not values.no_prism or values.prisms or values.speeds_rpm:
        for name in ("prisms", "speeds_rpm"):
            other = " or, for plain cameras only, remove both prisms and speeds_rpm" if values.no_prism else ""
            _check_distinct(getattr(values, name), name, other)
    for k, prism in enumerate(values.prisms):
        at_field(f"prisms[{k}]", prism.build)
    for k, rpm in enumerate(values.speeds_rpm):
        at_field(f"speeds_rpm[{k}]", lambda rpm=rpm: PrismMotion(rpm))  # type: ignore[misc]
    if values.truth_hz is not None:
        real(values.truth_hz, "field truth_hz", 1e-3, 1e6, " Hz")
    if values.output is not None:
        _check_output(values.output)
    if len(values.splits) > MOST_SPLITS:
        raise AmiwarpError(f"field splits has {len(values.splits):,} names; give at most {MOST_SPLITS}")
    for name, share in values.splits.items():
        if not re.fullmatch(SPLIT_NAME, name):
            raise AmiwarpError(f"field splits has the name {shown(name)}; use letters, digits, '-' and '_'")
        real(share, f"field splits.{name}", 0.0, 1.0)
    total = math.fsum(values.splits.values())
    if abs(total - 1.0) > 1e-6:
        raise AmiwarpError(f"field splits has shares that sum to {total:g}; change them so that they sum to 1")


def _check_output(output: OutputEntry) -> None:
    """Raise :class:`AmiwarpError` for a field that the function does not take, or if one is missing that it needs."""
    known = inspect.signature(output.function).parameters
    for name in output.options:
        if name not in known:
            raise AmiwarpError(f"field output.{name} does not apply to {output.representation}; remove it")
    for name, parameter in known.items():
        if parameter.default is parameter.empty and name not in ("events", "width", "height", *output.options):
            raise AmiwarpError(f"field output.{name} is missing; {output.representation} needs it")
    times = () if output.window_us is not None else ("t_start", "t_end")
    both = [name for name in ("window_us", "window_events", *times) if name in output.given]
    if output.windows and len(both) > 1:
        raise AmiwarpError(f"field output has {' and '.join(both)}; give one kind of windows, or t_start and t_end")
    if output.t_start is not None and output.t_end is not None and output.t_end < output.t_start:
        raise AmiwarpError(
            f"field output.t_end is {output.t_end} us, before output.t_start, {output.t_start} us; give a later end"
        )


def _check_motion(sources: tuple[SourceGroup, ...]) -> None:
    """Raise :class:`AmiwarpError` for a source that a camera without a prism cannot see, or that needs a prism."""
    for k, entry in enumerate(group.entry for group in sources):
        if entry.kind == "translated":
            raise AmiwarpError(
                f"field sources[{k}].translated is of a plain camera already, but no_prism is true; name it as "
                "recordings in a specification without prisms, or remove no_prism"
            )
        if entry.kind == "pictures" and not any(entry.rotate_deg_s or ()):
            raise AmiwarpError(
                f"field sources[{k}].pictures stand still, so a camera without a prism (no_prism) sees only noise; "
                "let the camera turn with rotate_deg_s = [x, y, z], or remove no_prism"
            )


def _check_distinct(values: tuple[Any, ...], name: str, other: str = "") -> None:
    """Raise :class:`AmiwarpError` for an empty list and for equal entries, whose recordings would be the same.

    ``other`` adds a remedy for an empty list.
    """
    if not values:
        raise AmiwarpError(f"field {name} is empty; give at least one entry{other}")
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
    uses = {"fps": ("videos",), "rotate_deg_s": ("pictures",), "trajectories": ("worlds", "world_files"),
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


# Sources of a data set: files found by their patterns, named worlds, and the labels that they carry.

MOST_VISITED = 2_000_000
"""Largest number of files and folders that one pattern leads through."""
MOST_TABLE_BYTES = 256 << 20
"""Largest table of labels that is read [bytes]."""


@dataclass(frozen=True)
class Source:
    """One picture, video, recording, world file or named world."""

    entry: SourceEntry
    """Entry of the specification that it belongs to."""
    name: str
    """Path relative to the folder of the specification, or name of a world."""
    path: Path | None
    """File; None for a named world."""
    digest: str
    """SHA-256 of the content, in hexadecimal; empty for a named world."""
    labels: Mapping[str, Any]
    """Labels by name."""


def find_sources(specification: Specification) -> list[Source]:
    """Return all sources. Raises :class:`AmiwarpError` for a pattern without files and for a file found twice."""
    found: dict[str, tuple[int, Source]] = {}
    kinds: dict[str, tuple[type, int]] = {}
    for k, group in enumerate(specification.sources):
        with errors_name(specification.path, lambda k=k: f"field sources[{k}]"):  # type: ignore[misc]
            for source in _of_group(specification.folder, group, f"sources[{k}]"):
                if source.name in found:
                    raise AmiwarpError(
                        f"field sources[{k}] names {source.name}, as does sources[{found[source.name][0]}]; "
                        "change one of them, so that each recording is made once"
                    )
                found[source.name] = (k, source)
                _check_label_types(source.labels, kinds, k)
    return [source for _, source in found.values()]


def _check_label_types(labels: Mapping[str, Any], kinds: dict[str, tuple[type, int]], k: int) -> None:
    """Raise :class:`AmiwarpError` if a label has values of two types. ``kinds`` holds the type of each label so far."""
    for name, value in labels.items():
        kind, first = kinds.setdefault(name, (type(value), k))
        if kind is not type(value):
            raise AmiwarpError(
                f"field sources[{k}] has the label {name} = {value!r}, but in sources[{first}] it is of type "
                f"{kind.__name__}; use one type"
            )


def _of_group(folder: Path, group: SourceGroup, where: str) -> Iterator[Source]:
    """Yield the sources of one entry."""
    entry = group.entry
    if entry.worlds is not None:
        for name in entry.worlds:
            one_of(name, WORLDS, f"field {where}.worlds")
            yield Source(entry, name, None, "", dict(group.labels))
        return
    pattern = getattr(entry, entry.kind)
    names = _matches(folder, pattern)
    if not names:
        raise AmiwarpError(
            f"field {where}.{entry.kind} is {shown(pattern)}, which matches no file in {folder}; change it"
        )
    table = None if entry.label_table is None else _read_labels(folder / entry.label_table)
    digest: Callable[[Path], str] = partial(_world_digest, {}) if entry.kind == "world_files" else content_digest
    for name in names:
        path = folder / name
        yield Source(entry, Path(name).as_posix(), path, digest(path), _labels(group, path, table))


def _matches(folder: Path, pattern: str) -> list[str]:
    """Return the paths that match a pattern as in the module glob, sorted and relative to ``folder``.

    Raises :class:`AmiwarpError` after :data:`MOST_VISITED` entries of folders.
    """
    visited = itertools.count(1)

    def entries(name: str) -> Iterator[os.DirEntry[str]]:
        with contextlib.suppress(OSError, ValueError), os.scandir(folder / name) as listed:
            for entry in listed:  # without entries: no folder, or an unreadable one
                if next(visited) > MOST_VISITED:
                    raise _TooMany
                yield entry

    def below(name: str) -> Iterator[str]:
        waiting: list[tuple[str, frozenset[tuple[int, int]]]] = [(name, frozenset())]
        while waiting:
            here, above = waiting.pop()
            with contextlib.suppress(OSError, ValueError):
                state = os.stat(folder / here)
                if (same := (state.st_dev, state.st_ino)) not in above:  # a link to a folder above it has no end
                    yield here
                    deeper = [e.name for e in entries(here) if not e.name.startswith(".") and _is_folder(e)]
                    waiting += [(os.path.join(here, inner), above | {same}) for inner in deeper]

    def step(name: str, segment: str) -> Iterator[str]:
        if segment == "**":
            yield from below(name)
        elif glob.has_magic(segment):
            names = (e.name for e in entries(name) if segment.startswith(".") or not e.name.startswith("."))
            yield from (os.path.join(name, found) for found in fnmatch.filter(names, segment))
        elif os.path.lexists(folder / name / segment):
            yield os.path.join(name, segment)

    names = ["/" if pattern.startswith("/") else ""]
    segments = [segment for segment in pattern.split("/") if segment]
    try:
        for segment in (*segments, "*") if pattern.endswith("**") else segments:
            names = list(dict.fromkeys(found for name in names for found in step(name, segment)))
    except _TooMany:
        raise AmiwarpError(
            f"pattern {shown(pattern)} leads through more than {MOST_VISITED:,} files and folders; name the folders"
        ) from None
    return sorted(name for name in names if name)


def _is_folder(entry: os.DirEntry[str]) -> bool:
    """Return whether an entry is a folder or a link to one."""
    with contextlib.suppress(OSError):  # a link to itself
        return entry.is_dir()
    return False


class _TooMany(Exception):
    """The limit of :func:`_matches`."""


def _labels(group: SourceGroup, path: Path, table: tuple[Path, dict[Path, dict[str, Any]]] | None) -> dict[str, Any]:
    """Return the labels of a file: constant ones, its folder's name, and those of the table."""
    labels = dict(group.labels)
    if group.entry.label_from_folder is not None:
        labels[group.entry.label_from_folder] = path.absolute().parent.name
    if table is not None:
        row = table[1].get(path.resolve())
        if row is None:
            raise AmiwarpError(f"{table[0]}: has no row for {path}; add it, or change the pattern of the source")
        labels |= row
    return labels


def _read_labels(path: Path) -> tuple[Path, dict[Path, dict[str, Any]]]:
    """Return the labels of each file of a CSV table, whose column ``file`` is relative to the folder of the table.

    A column of numbers becomes numbers; any other column is text.
    """
    with errors_name(path, lambda: "is no table of labels"):
        with open_input(path) as file:
            text = file.read(MOST_TABLE_BYTES + 1)
        if len(text) > MOST_TABLE_BYTES:
            raise AmiwarpError(f"is larger than {MOST_TABLE_BYTES >> 20} MiB; divide it among several sources")
        reader = csv.DictReader(io.StringIO(text.decode("utf-8-sig"), newline=""))
        names = [name for name in reader.fieldnames or () if name != "file"]
        if "file" not in (reader.fieldnames or ()) or not names:
            raise AmiwarpError("has no column 'file' or no other column; write a header such as file,class")
        _check_once(reader.fieldnames or (), "column", "give each label one column")
        rows = list(reader)
        for k, row in enumerate(rows):
            if None in row or None in row.values():
                raise AmiwarpError(f"row {k + 1} has more or fewer cells than the header; correct it")
        columns = {name: _column([row[name] for row in rows]) for name in names}
        files = [(path.parent / row["file"]).resolve() for row in rows]
        _check_once(files, "file", "keep one row of it")
        return path, {file: {name: columns[name][k] for name in names} for k, file in enumerate(files)}


def _check_once(values: Sequence[object], what: str, remedy: str) -> None:
    """Raise :class:`AmiwarpError` for a column or a file of a table that is there twice."""
    twice = [value for value, count in Counter(values).items() if count > 1]
    if twice:
        raise AmiwarpError(f"has the {what} {shown(str(twice[0]))} twice; {remedy}")


def _column(values: list[str]) -> list[Any]:
    """Return the values of a column as whole numbers, as numbers, or as text. Numbers like 007 are text."""
    if all(re.fullmatch(r"-?(0|[1-9]\d{0,17})", value) for value in values):
        return [int(value) for value in values]
    if all(re.fullmatch(r"-?(0|[1-9]\d*)(\.\d+)?([eE][+-]?\d{1,2})?", value) for value in values):
        return [float(value) for value in values]
    return list(values)


def content_digest(path: Path, *, noted: bool = True) -> str:
    """Return the SHA-256 of a file, or of the names and contents of the files in a folder.

    ``noted`` is False for a recording of the data set, which may be replaced.
    """
    with errors_name(path, lambda: "cannot be read"):
        if path.is_dir():
            total = hashlib.sha256()
            for file in sorted(p for p in path.iterdir() if p.is_file()):
                total.update(f"{file.name}\0{content_digest(file)}\n".encode())
            return total.hexdigest()
        with open_input(path, noted=noted) as opened:
            return hashlib.file_digest(opened, "sha256").hexdigest()


def _world_digest(known: dict[Path, str], path: Path) -> str:
    """Return the SHA-256 of a world file, of the files that it names, and of those that its meshes name.

    ``known`` holds the digests of named files so far, because worlds share large meshes.
    """
    data = read_json(path, "a world") if path.suffix.lower() == ".json" else read_toml(path, "a world")
    named = {file for text in _texts(data) if os.path.isfile(file := path.parent / text)}
    for file in named - known.keys():
        known[file] = "\n".join(content_digest(one) for one in [file, *sorted(set(mesh_files(file)))])
    digests = [content_digest(path), *(known[file] for file in sorted(named))]
    return hashlib.sha256("\n".join(digests).encode()).hexdigest()


def _texts(data: Any) -> Iterator[str]:
    """Yield all texts among the values of JSON data."""
    if isinstance(data, str):
        yield data
    for value in data.values() if isinstance(data, dict) else data if isinstance(data, list) else ():
        yield from _texts(value)
