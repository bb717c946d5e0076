"""Specification of a data set: a TOML file that names sources, prisms, speeds, sensors, seeds and splits."""

import inspect
import math
import re
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, fields
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.imaging import recent_tensors, tensors
from amiwarp.io.inputs import errors_name
from amiwarp.io.json_files import read_toml
from amiwarp.io.recorded_dataset import SPLIT_NAME
from amiwarp.learning.dataset.randomise import DrawEntry, check_drawn_prism, check_randomise
from amiwarp.learning.dataset.rig_cameras import (
    DatasetRig,
    check_duration,
    check_fields_beside_rig,
    check_rig_randomise,
    read_dataset_rig,
)
from amiwarp.optics.camera import Camera
from amiwarp.optics.prism import Prism
from amiwarp.schema.records import (
    LARGEST_INTEGER,
    at_field,
    build,
    check_format,
    check_given,
    fields_of,
    with_fields,
)
from amiwarp.simulation.motion import LONGEST_S, PrismMotion
from amiwarp.simulation.sensor_model import SensorModel, named_sensor
from amiwarp.validation import real, shown, whole

FORMAT = "amiwarp-dataset-specification"
VERSION = 1
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


def _check_distinct(values: tuple[Any, ...], name: str, other: str = "") -> None:
    """Raise :class:`AmiwarpError` for an empty list and for equal entries, whose recordings would be the same.

    ``other`` adds a remedy for an empty list.
    """
    if not values:
        raise AmiwarpError(
            f"field {name} is empty; give at least one entry{other}", ErrorCode.FIELD
        )
    first: dict[Any, int] = {}
    for k, value in enumerate(values):
        if first.setdefault(value, k) != k:
            raise AmiwarpError(
                f"field {name}[{k}] repeats {name}[{first[value]}]; remove it", ErrorCode.FIELD
            )


def _seeds(value: Any, name: str) -> tuple[int, ...]:
    """Return the seeds: the given ones of a list, or the first ones of their number."""
    if isinstance(value, list):
        seeds = tuple(whole(seed, f"{name}[{k}]", 0, LARGEST_SEED) for k, seed in enumerate(value))
        _check_distinct(seeds, "seeds")
        return seeds
    hint = "; give their number, or a list of them"
    return tuple(range(whole(value, name, 1, MOST_RECORDINGS, hint)))


def _stratify(value: Any, name: str) -> str | Literal[False]:
    """Return the label whose values are divided among the splits, or False."""
    if value is False or (isinstance(value, str) and value):
        return value
    raise AmiwarpError(
        f"{name} is {shown(value)}; expected the name of a label, or false to draw the split of each source",
        ErrorCode.FIELD,
    )


def _sensors(value: Any, name: str) -> dict[str, SensorModel]:
    """Return the sensors by name. An entry is a name, or a table with a name, and optionally a preset and values."""
    if not isinstance(value, list) or not value:
        raise AmiwarpError(
            f"{name} is {shown(value)}; expected a list of at least one entry", ErrorCode.FIELD
        )
    known = tuple(field.name for field in fields(SensorModel))
    sensors: dict[str, SensorModel] = {}
    for k, entry in enumerate(value):
        where = f"sensors[{k}]"
        table = {"name": entry, "preset": entry} if isinstance(entry, str) else entry
        given = dict(fields_of(table, where, "name", optional=("preset", *known)))
        world_name = given.pop("name")
        preset = given.pop("preset", "default")
        for key, text in (("name", world_name), ("preset", preset)):
            if not isinstance(text, str) or not text:
                raise AmiwarpError(
                    f"field {where}.{key} is {shown(text)}; expected text", ErrorCode.FIELD
                )
        if world_name in sensors:
            raise AmiwarpError(
                f"field {where} has the name {world_name!r} of another sensor; give it its own name",
                ErrorCode.FIELD,
            )
        base = at_field(where, partial(named_sensor, preset))
        sensors[world_name] = with_fields(base, given, where)
    return sensors


def _label(value: Any, name: str) -> Any:
    """Return the value of a label: text, a number or a truth value."""
    if isinstance(value, int | float) and not isinstance(value, bool):
        real(value, name, -LARGEST_INTEGER, LARGEST_INTEGER)
    elif not isinstance(value, str | bool):
        raise AmiwarpError(
            f"{name} is {shown(value)}; expected text, a number or true/false", ErrorCode.FIELD
        )
    return value


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

    The fields without a docstring are parameters of the function in :mod:`amiwarp.imaging.tensors`
    or :mod:`amiwarp.imaging.recent_tensors`.
    """

    representation: Literal[
        "event_count",
        "polarity_histogram",
        "voxel_grid",
        "stacked_histogram",
        "time_surface",
        "latest_times",
        "tore_volume",
        "mixed_density_stack",
        "event_spike_tensor",
    ]
    """Name of the function."""
    bins: Annotated[int, partial(whole, low=1, high=tensors.MOST_BINS)] | None = None
    end_bin: bool | None = None
    normalize: bool | None = None
    limit: Annotated[int, partial(whole, low=1, high=255)] | None = None
    tau_us: Annotated[float, partial(real, low=1e-6)] | None = None
    linear: bool | None = None
    depth: Annotated[int, partial(whole, low=1, high=recent_tensors.MOST_DEPTH)] | None = None
    shortest_us: Annotated[float, partial(real, low=0.0)] | None = None
    longest_us: Annotated[float, partial(real, low=0.0)] | None = None
    stacks: Annotated[int, partial(whole, low=1, high=recent_tensors.MOST_STACKS)] | None = None
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
        of_recent_events = hasattr(recent_tensors, self.representation)
        return getattr(recent_tensors if of_recent_events else tensors, self.representation)

    @property
    def options(self) -> dict[str, Any]:
        """Arguments of the function that are given."""
        other = (
            "representation",
            "window_us",
            "window_events",
            *(("t_start", "t_end") if self.window_us else ()),
        )
        return {name: value for name, value in self.given.items() if name not in other}

    @property
    def windows(self) -> dict[str, Any]:
        """Arguments of :func:`amiwarp.windows`; none for one tensor of all events."""
        arguments: dict[str, int | None] = {
            "duration_us": self.window_us,
            "count": self.window_events,
        }
        if self.window_us is not None:
            arguments |= {"t_start": self.t_start, "t_end": self.t_end}
        return {name: value for name, value in arguments.items() if value is not None}


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
    """Duration, instead of the specification's."""
    rotate_deg_s: tuple[float, float, float] | None = None
    """Angular velocity of the camera in front of a picture about its x, y and z axes [deg/s]."""
    trajectories: tuple[str, ...] | None = None
    """Camera motions in a world: still, handheld or fast, or files of poses."""
    label_from_folder: str | None = None
    """Name of the label that takes the name of the file's folder."""
    label_table: str | None = None
    """CSV table with the column ``file`` and a column for each label."""
    labels: Mapping[str, Annotated[Any, _label]] = field(default_factory=dict)
    """Labels that all files of the source have."""
    licence: str = ""

    @property
    def kind(self) -> str:
        """The one of :data:`KINDS` that is given."""
        return next(kind for kind in KINDS if getattr(self, kind) is not None)


@dataclass(frozen=True, kw_only=True)
class _File:
    """Fields of a specification file."""

    format: str
    version: int
    duration_s: Annotated[float, partial(real, low=1e-3, high=LONGEST_S, hint=" s")]
    sources: tuple[SourceEntry, ...]
    prisms: tuple[PrismEntry, ...] = ()
    speeds_rpm: tuple[float, ...] = ()
    no_prism: bool = False
    """Whether to make recordings of a plain event camera too; without ``prisms``, these only."""
    name: str = ""
    camera: CameraEntry = field(default_factory=CameraEntry)
    splits: Mapping[str, float] = field(default_factory=lambda: dict(SPLITS))
    split_seed: int = 0
    stratify: Annotated[Any, _stratify] = None
    """Label whose values, the classes, are each divided among the splits by their shares; False: a draw per source.

    None: the first label that all sources have and whose classes have at least as many sources as there are splits;
    without such a label, all sources are one class."""
    truth_hz: Annotated[float, partial(real, low=1e-3, high=1e6, hint=" Hz")] | None = None
    output: OutputEntry | None = None
    """Tensors to write instead of recordings; None: recordings."""
    sensors: Annotated[Any, _sensors] = field(default_factory=lambda: {"default": SensorModel()})
    """Sensors by name."""
    randomise: Mapping[str, DrawEntry] = field(default_factory=dict)
    """Ranges from which each recording draws values, by their names."""
    seeds: Annotated[Any, _seeds] = (0,)
    """Seed of each recording of the same source, optic and sensor."""
    rig: Any = None
    """File of a rig, or a table of its cameras, that records instead of one camera; None for one camera."""


@dataclass(frozen=True, kw_only=True)
class Specification(_File):
    """Content of a specification file."""

    path: Path
    data: Mapping[str, Any]
    """Fields of the file, unchanged."""
    of_rig: DatasetRig | None = None
    """Cameras of the rig; None for one camera."""

    @property
    def folder(self) -> Path:
        """Absolute path of the folder of the file; names of files in it are relative to this folder."""
        return self.path.parent.resolve()


def load_specification(path: str | Path) -> Specification:
    """Read and check a specification. Raises :class:`AmiwarpError`, which names the field, the value and the remedy."""
    path = Path(path)
    data = read_toml(path, "a specification of a data set")
    with errors_name(path, lambda: "is no specification of a data set"):
        optics = () if data.get("no_prism") or "rig" in data else ("prisms", "speeds_rpm")
        check_given(data, "", "format", "version", "duration_s", *optics, "sources")
        check_format(data, FORMAT, VERSION)
        values = build(_File, data, "")
        _check(values)
        of_rig = None
        if "rig" in data:
            check_fields_beside_rig(data)
            of_rig = read_dataset_rig(values.rig, path.parent)
            _check_rig(values, of_rig)
        else:
            _check_camera(values)
        named = vars(values) | {"name": values.name or path.stem}
        return Specification(**named, path=path, data=data, of_rig=of_rig)


def _check(values: _File) -> None:
    """Raise :class:`AmiwarpError` for values that do not belong together and for repeated ones."""
    if len(values.splits) > MOST_SPLITS:
        raise AmiwarpError(
            f"field splits has {len(values.splits):,} names; give at most {MOST_SPLITS}",
            ErrorCode.FIELD,
        )
    for name, share in values.splits.items():
        if not re.fullmatch(SPLIT_NAME, name):
            raise AmiwarpError(
                f"field splits has the name {shown(name)}; use letters, digits, '-' and '_'",
                ErrorCode.FIELD,
            )
        real(share, f"field splits.{name}", 0.0, 1.0)
    total = math.fsum(values.splits.values())
    if abs(total - 1.0) > 1e-6:
        raise AmiwarpError(
            f"field splits has shares that sum to {total:g}; change them so that they sum to 1",
            ErrorCode.FIELD,
        )
    if not values.sources:
        raise AmiwarpError(
            "field sources is []; expected a list of at least one entry", ErrorCode.FIELD
        )
    for k, entry in enumerate(values.sources):
        _check_source(entry, f"sources[{k}]")
    kinds = [entry.kind for entry in values.sources]
    check_randomise(values.randomise, kinds)


def _check_camera(values: _File) -> None:
    """Raise :class:`AmiwarpError` for optics, a camera and tensors of a data set of one camera that do not fit."""
    at_field("camera", values.camera.build)
    if not values.no_prism or values.prisms or values.speeds_rpm:
        for name in ("prisms", "speeds_rpm"):
            other = (
                " or, for plain cameras only, remove both prisms and speeds_rpm"
                if values.no_prism
                else ""
            )
            _check_distinct(getattr(values, name), name, other)
    for k, prism in enumerate(values.prisms):
        at_field(f"prisms[{k}]", prism.build)
    for k, rpm in enumerate(values.speeds_rpm):
        at_field(f"speeds_rpm[{k}]", lambda rpm=rpm: PrismMotion(rpm))  # type: ignore[misc]
    if values.output is not None:
        _check_output(values.output)
    check_drawn_prism(values.randomise, len(values.prisms), len(values.speeds_rpm))
    if values.no_prism:
        _check_motion(values.sources, shakes="shake_deg" in values.randomise)


def _check_rig(values: _File, of_rig: DatasetRig) -> None:
    """Raise :class:`AmiwarpError` for sources and ranges that do not fit a rig."""
    for k, entry in enumerate(values.sources):
        where = f"sources[{k}]"
        if entry.kind not in ("worlds", "world_files"):
            raise AmiwarpError(
                f"field {where}.{entry.kind} does not apply to a rig, which moves through a world; give worlds or "
                "world_files",
                ErrorCode.FIELD,
            )
        of_source = entry.duration_s is not None
        name = f"{where}.duration_s" if of_source else "duration_s"
        check_duration(of_rig.cameras, entry.duration_s or values.duration_s, name)
    check_rig_randomise(values.randomise, of_rig.cameras)


def _check_output(output: OutputEntry) -> None:
    """Raise :class:`AmiwarpError` for a field that the function does not take, or if one is missing that it needs."""
    known = inspect.signature(output.function).parameters
    for name in output.options:
        if name not in known:
            raise AmiwarpError(
                f"field output.{name} does not apply to {output.representation}; remove it",
                ErrorCode.FIELD,
            )
    for name, parameter in known.items():
        if parameter.default is parameter.empty and name not in (
            "events",
            "width",
            "height",
            *output.options,
        ):
            raise AmiwarpError(
                f"field output.{name} is missing; {output.representation} needs it", ErrorCode.FIELD
            )
    times = () if output.window_us is not None else ("t_start", "t_end")
    both = [name for name in ("window_us", "window_events", *times) if name in output.given]
    if output.windows and len(both) > 1:
        raise AmiwarpError(
            f"field output has {' and '.join(both)}; give one kind of windows, or t_start and t_end",
            ErrorCode.FIELD,
        )
    if output.t_start is not None and output.t_end is not None and output.t_end < output.t_start:
        raise AmiwarpError(
            f"field output.t_end is {output.t_end} us, before output.t_start, {output.t_start} us; give a later end",
            ErrorCode.FIELD,
        )


def _check_motion(sources: tuple[SourceEntry, ...], *, shakes: bool) -> None:
    """Raise :class:`AmiwarpError` for a source that a camera without a prism cannot see, or that needs a prism."""
    for k, entry in enumerate(sources):
        if entry.kind == "translated":
            raise AmiwarpError(
                f"field sources[{k}].translated is of a plain camera already, but no_prism is true; name it as "
                "recordings in a specification without prisms, or remove no_prism",
                ErrorCode.FIELD,
            )
        if entry.kind == "pictures" and not any(entry.rotate_deg_s or ()) and not shakes:
            raise AmiwarpError(
                f"field sources[{k}].pictures stand still, so a camera without a prism (no_prism) sees only noise; "
                "let the camera turn with rotate_deg_s = [x, y, z], or remove no_prism",
                ErrorCode.FIELD,
            )


def _check_source(entry: SourceEntry, where: str) -> None:
    """Raise :class:`AmiwarpError` for fields of a source that do not belong together, and for values out of range."""
    kinds = [kind for kind in KINDS if getattr(entry, kind) is not None]
    if len(kinds) != 1:
        raise AmiwarpError(
            f"field {where} has {' and '.join(kinds) or 'no source'}; give one of {', '.join(KINDS)}",
            ErrorCode.FIELD,
        )
    uses = {
        "fps": ("videos",),
        "rotate_deg_s": ("pictures",),
        "trajectories": ("worlds", "world_files"),
        "duration_s": ("pictures", "videos", "translated", "worlds", "world_files"),
    }
    for name, allowed in uses.items():
        if getattr(entry, name) is not None and kinds[0] not in allowed:
            raise AmiwarpError(
                f"field {where}.{name} does not apply to {kinds[0]}; remove it", ErrorCode.FIELD
            )
    if kinds[0] == "worlds" and (entry.label_from_folder or entry.label_table):
        raise AmiwarpError(
            f"field {where} has labels from files, but names worlds without files; give labels there",
            ErrorCode.FIELD,
        )
    for name in ("worlds", "trajectories"):
        if getattr(entry, name) is not None:
            _check_distinct(getattr(entry, name), f"{where}.{name}")
    if entry.duration_s is not None:
        real(entry.duration_s, f"field {where}.duration_s", 1e-3, LONGEST_S, " s")
