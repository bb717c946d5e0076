"""Recordings of a data set: every combination of source, trajectory, prism, speed, sensor and seed."""

from __future__ import annotations

import hashlib
import itertools
import json
import math
import os
import re
import socket
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from amiwarp._version import __version__
from amiwarp.cpu_threads import limited_cpu_threads
from amiwarp.errors import AmiwarpError
from amiwarp.io import convert, open_recording
from amiwarp.io.atomic_output import make_folder, put_in_place
from amiwarp.io.json_files import LARGEST_INTEGER
from amiwarp.optics.camera import LARGEST_SIZE
from amiwarp.simulation.description import Scene
from amiwarp.simulation.motion import PrismMotion
from amiwarp.simulation.sensor import SensorModel
from amiwarp.simulation.simulator import Simulation
from amiwarp.simulation.worlds.world import WorldScene
from amiwarp.simulation.worlds.world_files import POSE_FILES, open_world
from amiwarp.studies.cluster import ANY_GPU
from amiwarp.studies.dataset.specification import (
    LARGEST_SEED,
    MOST_RECORDINGS,
    CameraEntry,
    PrismEntry,
    Source,
    Specification,
    content_digest,
    find_sources,
)
from amiwarp.translation.translator import translation
from amiwarp.validation import real, shown, whole

if TYPE_CHECKING:
    from amiwarp.optics.camera import Camera


@dataclass(frozen=True)
class Item:
    """One recording of a data set."""

    recipe: Mapping[str, Any]
    """Everything that determines the recording, as JSON data."""
    folder: Path
    """Folder to which the names in the recipe are relative."""
    split: str
    """Split that it belongs to."""
    labels: Mapping[str, Any]
    """Labels by name."""
    licence: str
    """Licence of the source."""

    @cached_property
    def key(self) -> str:
        """Digest of the recipe, which identifies the recording."""
        return _digest(self.recipe)[:16]

    @property
    def kind(self) -> str:
        """Kind of the source, one of :data:`amiwarp.studies.dataset.specification.KINDS`."""
        return str(self.recipe["source"]["kind"])

    @property
    def source(self) -> str:
        """Name of the source."""
        return str(self.recipe["source"]["name"])

    @property
    def seed(self) -> int:
        """Seed of all random numbers except those of a named world. It depends on the recipe alone."""
        return int(self.key, 16) & LARGEST_SEED

    @property
    def file(self) -> str:
        """Path of the recording, relative to the folder of the data set."""
        stem = re.sub(r"[^A-Za-z0-9_-]+", "_", Path(self.source).stem)[:60]
        return f"{self.split}/{stem}-{self.key}.h5"


def _digest(data: Any) -> str:
    """Return the SHA-256 of JSON data, in hexadecimal."""
    return hashlib.sha256(json.dumps(data, sort_keys=True, allow_nan=False).encode()).hexdigest()


def list_items(specification: Specification) -> list[Item]:
    """Return all recordings of a specification, in its order.

    Raises :class:`AmiwarpError` for sources not found, and for more than :data:`MOST_RECORDINGS` recordings.
    """
    found = [(source, _axes(specification, source)) for source in find_sources(specification)]
    count = sum(math.prod(map(len, axes)) for _, axes in found)
    if count > MOST_RECORDINGS:
        raise AmiwarpError(
            f"{specification.path}: describes {count:,} recordings; divide it among specifications of at most "
            f"{MOST_RECORDINGS:,} recordings each"
        )
    return [item for source, axes in found for item in _of_source(specification, source, axes)]


def _of_source(specification: Specification, source: Source, axes: Sequence[Sequence[Any]]) -> Iterator[Item]:
    """Yield the recordings of one source."""
    split: dict[str, str] = {}
    for recipe in _recipes(specification, source, axes):
        # Equal files, and the worlds of one seed, are the same source and lie in the same split.
        same = source.digest or f"{source.name} {recipe['seed']}"
        if same not in split:
            split[same] = _split(specification, same)
        yield Item(recipe, specification.folder, split[same], source.labels, source.entry.licence)


def _axes(specification: Specification, source: Source) -> tuple[Sequence[Any], ...]:
    """Return what one source is combined with: trajectories, prisms, speeds, sensors and seeds."""
    if source.entry.kind == "recordings":
        return ()
    return (
        _trajectories(specification, source), [asdict(prism) for prism in specification.prisms],
        specification.speeds_rpm, [{"name": name, **asdict(sensor)} for name, sensor in specification.sensors.items()],
        specification.seeds,
    )  # fmt: skip


def _recipes(specification: Specification, source: Source, axes: Sequence[Sequence[Any]]) -> Iterator[dict[str, Any]]:
    """Yield what determines each recording of one source."""
    entry = source.entry
    base: dict[str, Any] = {"source": {"kind": entry.kind, "name": source.name, "sha256": source.digest}}
    if entry.kind == "recordings":
        yield base
        return
    base |= {"camera": asdict(specification.camera)}
    if entry.kind in ("videos", "translated"):
        base |= {"fps": entry.fps, "duration_s": entry.duration_s}
    else:
        base |= {"duration_s": entry.duration_s or specification.duration_s}
    if entry.kind in ("worlds", "world_files"):
        base |= {"truth_hz": specification.truth_hz}
    for trajectory, prism, rpm, sensor, seed in itertools.product(*axes):
        yield base | trajectory | {"prism": prism, "rpm": rpm, "sensor": sensor, "seed": seed}


def _trajectories(specification: Specification, source: Source) -> list[dict[str, Any]]:
    """Return the camera motions through a world, with the digest of a file of poses. Other sources have none."""
    if source.entry.kind == "world_files" and source.entry.trajectories is None:
        return [{"trajectory": None}]
    if source.entry.kind not in ("worlds", "world_files"):
        return [{}]
    return [
        {"trajectory": name, "poses_sha256": content_digest(specification.folder / name)}
        if name.lower().endswith(POSE_FILES)
        else {"trajectory": name}
        for name in source.entry.trajectories or ("handheld",)
    ]


def _split(specification: Specification, source: str) -> str:
    """Return the split of a source, drawn by a hash of it and of the split seed."""
    drawn = int(_digest([specification.split_seed, source])[:13], 16) / 16**13
    total = 0.0
    for name, share in specification.splits.items():
        total += share
        if drawn < total:
            return name
    return [name for name, share in specification.splits.items() if share > 0.0][-1]


# Making of one recording of a data set, by a worker.


def _of_pattern(pattern: str, text: str, what: str) -> str:
    """Return text that a regular expression matches; raise :class:`AmiwarpError` for other text."""
    if not re.fullmatch(pattern, text):
        raise AmiwarpError(f"{what} is {shown(text)}; expected text of the form {pattern}")
    return text


@dataclass(frozen=True)
class Made:
    """A recording that was made, as the journal keeps it."""

    key: Annotated[str, partial(_of_pattern, "[0-9a-f]{16}")]
    """Key of the item."""
    file: Annotated[str, partial(_of_pattern, "[A-Za-z0-9_-]+/[A-Za-z0-9_-]*-[0-9a-f]{16}[.]h5")]
    """Path, relative to the folder of the data set."""
    bytes: Annotated[int, partial(whole, low=0, high=LARGEST_INTEGER)]
    """Size [bytes]."""
    sha256: Annotated[str, partial(_of_pattern, "[0-9a-f]{64}")]
    """SHA-256 of the file, in hexadecimal."""
    events: Annotated[int, partial(whole, low=0, high=LARGEST_INTEGER)]
    """Number of events."""
    duration_s: Annotated[float, partial(real, low=0.0, high=LARGEST_INTEGER * 1e-6)]
    """Duration: as simulated, or from the first event to the last [s]."""
    width: Annotated[int, partial(whole, low=1, high=LARGEST_SIZE)]
    """Width of the sensor [px]."""
    height: Annotated[int, partial(whole, low=1, high=LARGEST_SIZE)]
    """Height of the sensor [px]."""
    seconds: Annotated[float, partial(real, low=0.0, high=1e9)]
    """Time that the worker took [s]."""
    processor_s: Annotated[float, partial(real, low=0.0, high=1e9)]
    """Processor time that its process took [s]."""
    device: Annotated[str, partial(_of_pattern, "cpu|cuda:[0-9]{1,3}")]
    """Device that it was computed on."""
    amiwarp: Annotated[str, partial(_of_pattern, "[A-Za-z0-9.+-]{1,64}")]
    """Version of amiwarp."""


@dataclass(frozen=True)
class Failed:
    """A recording that could not be made."""

    key: str
    """Key of the item."""
    error: str
    """Message of the error."""


@dataclass(frozen=True)
class Job:
    """What a worker gets."""

    item: Item
    """Recording to make."""
    out: Path
    """Folder of the data set."""
    scratch: Path
    """Folder for unfinished files, on the same disk."""
    device: str
    """Device; :data:`ANY_GPU` is the worker's GPU."""
    threads: int | None
    """Number of CPU threads that the worker may use; None for all."""


def make(job: Job) -> Made | Failed:
    """Make a recording. Raises :class:`AmiwarpError` if the folder of the data set is not visible to this worker."""
    if not job.scratch.is_dir():
        raise AmiwarpError(
            f"the worker on {socket.gethostname()} does not see {job.scratch.parent}; put the data set and its sources "
            "on a disk that all workers share under the same path"
        )
    try:
        with limited_cpu_threads(job.threads):
            return _make(job)
    except Exception as error:  # whatever one recording raises must not stop the others
        what = str(error) if isinstance(error, AmiwarpError) else f"{type(error).__name__}: {error}"
        return Failed(job.item.key, " ".join(what.split())[:500])


def _make(job: Job) -> Made:
    began, began_processor = time.perf_counter(), time.process_time()
    item, device = job.item, "cuda:0" if job.device == ANY_GPU else job.device
    part, path = job.scratch / f"{item.key}.h5", job.out / item.file
    written = write_recording(item, part, device)
    digest = content_digest(part, noted=False)
    make_folder(path.parent)
    put_in_place(part, path, overwrite=True)
    return Made(
        item.key, item.file, path.stat().st_size, digest, written.events, written.duration_s,
        written.width, written.height, round(time.perf_counter() - began, 6),
        round(time.process_time() - began_processor, 6), device, __version__,
    )  # fmt: skip


@dataclass(frozen=True)
class Written:
    """A recording that was written."""

    events: int
    """Number of events."""
    duration_s: float
    """Duration: as simulated, or from the first event to the last [s]."""
    width: int
    """Width of the sensor [px]."""
    height: int
    """Height of the sensor [px]."""


def write_recording(item: Item, path: Path, device: str, duration_s: float | None = None) -> Written:
    """Write a recording to ``path``, replacing it. ``duration_s`` shortens a simulated recording."""
    if item.kind == "recordings":
        done = convert(item.folder / item.source, path, overwrite=True)
        length = 0 if done.t_first is None or done.t_last is None else done.t_last - done.t_first
        return Written(done.events, length * 1e-6, done.width, done.height)
    simulation = simulation_of(item, device, duration_s)
    events = simulation.write(path, truth_hz=item.recipe.get("truth_hz"), overwrite=True)
    return Written(events, simulation.duration_s, simulation.camera.width, simulation.camera.height)


def simulation_of(item: Item, device: str, duration_s: float | None = None) -> Simulation:
    """Return the simulation of a recording. ``duration_s`` shortens it."""
    recipe = item.recipe
    camera, source = CameraEntry(**recipe["camera"]), os.fspath(item.folder / item.source)
    length = recipe["duration_s"] if duration_s is None else duration_s
    prism, motion = PrismEntry(**recipe["prism"]).build(), PrismMotion(recipe["rpm"])
    sensor = SensorModel(**{name: value for name, value in recipe["sensor"].items() if name != "name"})
    if item.kind == "translated":
        return translation(open_recording(source), prism, duration_s=length, motion=motion, sensor=sensor,
                           seed=item.seed, device=device)  # fmt: skip
    if item.kind == "videos":
        return _of_video(item, source, camera, duration_s=length, prism=prism, motion=motion, sensor=sensor,
                         seed=item.seed, device=device)  # fmt: skip
    scene = Scene.from_picture(source) if item.kind == "pictures" else _world(item, source)
    return Simulation(scene, camera.build(), prism, length, motion, sensor=sensor, seed=item.seed, device=device)


def _of_video(item: Item, source: str, entry: CameraEntry, **settings: Any) -> Simulation:
    """Return the simulation of a video, whose size is that of the camera unless the specification gives one."""
    from amiwarp.simulation.sequences import open_pictures

    pictures = open_pictures(source, fps=item.recipe["fps"])
    camera: Camera = entry.build(pictures.size)
    return translation(pictures, camera=camera, **settings)


def _world(item: Item, source: str) -> WorldScene:
    """Return the world of a recording. The seed of a named world is that of the specification."""
    recipe = item.recipe
    way = recipe["trajectory"]
    if way is not None and way.lower().endswith(POSE_FILES):
        way = os.fspath(item.folder / way)
    name = item.source if item.kind == "worlds" else source
    return WorldScene(*open_world(name, way, seed=recipe["seed"], duration_s=recipe["duration_s"]))
