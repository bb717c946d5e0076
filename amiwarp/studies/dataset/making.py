"""Data sets: their recordings, the making on local processes or a cluster, the manifest, and an estimate of the cost.

What is there already is kept.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib
import itertools
import json
import math
import os
import re
import socket
import statistics
import time
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from amiwarp._version import __version__
from amiwarp.errors import AmiwarpError, optional_module
from amiwarp.events.device_events import DeviceEvents
from amiwarp.events.recording import Events
from amiwarp.events.truth import MAPS, FrameTruth
from amiwarp.imaging.tensors import windows
from amiwarp.io import convert, open_recording
from amiwarp.io.files import NewFile, errors_name, only_writer, put_in_place, scratch_folder, write_text
from amiwarp.io.formats import FORMAT, MANIFEST, VERSION, make_folder
from amiwarp.io.json_files import LARGEST_INTEGER, append_line, build, create_journal, read_journal
from amiwarp.io.plain_files import save_tensors
from amiwarp.kernels import launch
from amiwarp.optics.camera import LARGEST_SIZE, Camera
from amiwarp.optics.prism import Prism
from amiwarp.simulation.description import CameraMotion, PrismMotion, Scene
from amiwarp.simulation.sensor_model import SensorModel
from amiwarp.simulation.simulator import Engine, RecordedTruth, Simulation, chosen_instants
from amiwarp.simulation.worlds.world import WorldScene
from amiwarp.simulation.worlds.world_files import POSE_FILES, open_world
from amiwarp.studies import cluster
from amiwarp.studies.dataset import specification as spec
from amiwarp.studies.failures import failure_text, noted
from amiwarp.tasks import Progress, cpu_threads, limited_cpu_threads, silent
from amiwarp.translation.translator import translation
from amiwarp.validation import guarded, real, shown, whole

# Recordings of a data set: every combination of source, trajectory, prism, speed, sensor and seed.


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
        """Seed of all random numbers except those of a named world. It depends on the recipe alone.

        Tensors are those of the recording that the same specification gives without output, so they have its seed.
        """
        recorded = {name: value for name, value in self.recipe.items() if name != "output"}
        return int(_digest(recorded)[:16], 16) & spec.LARGEST_SEED

    @property
    def file(self) -> str:
        """Path of the recording, relative to the folder of the data set."""
        stem = re.sub(r"[^A-Za-z0-9_-]+", "_", Path(self.source).stem)[:60]
        return f"{self.split}/{stem}-{self.key}{'.npz' if 'output' in self.recipe else '.h5'}"

    @property
    def output(self) -> spec.OutputEntry | None:
        """Tensors that are written instead of a recording; None for a recording."""
        return spec.OutputEntry(**self.recipe["output"]) if "output" in self.recipe else None


def _digest(data: Any) -> str:
    """Return the SHA-256 of JSON data, in hexadecimal."""
    return hashlib.sha256(json.dumps(data, sort_keys=True, allow_nan=False).encode()).hexdigest()


def list_items(specification: spec.Specification) -> list[Item]:
    """Return all recordings of a specification, in its order.

    Raises :class:`AmiwarpError` for sources not found, and for more than :data:`MOST_RECORDINGS` recordings.
    """
    found = [(source, _axes(specification, source)) for source in spec.find_sources(specification)]
    count = sum(math.prod(map(len, axes)) for _, axes in found)
    if count > spec.MOST_RECORDINGS:
        raise AmiwarpError(
            f"{specification.path}: describes {count:,} recordings; divide it among specifications of at most "
            f"{spec.MOST_RECORDINGS:,} recordings each"
        )
    sources = [source for source, _ in found]
    splits = _drawn(specification, sources) if specification.stratify is None else _stratified(specification, sources)
    return [
        Item(recipe, specification.folder, splits[_identity(source, recipe.get("seed"))], source.labels,
             source.entry.licence)
        for source, axes in found for recipe in _recipes(specification, source, axes)
    ]  # fmt: skip


def _identity(source: spec.Source, seed: int | None) -> str:
    """Return what identifies a source for its split. Equal files, and the worlds of one seed, are the same source."""
    return source.digest or f"{source.name} {seed}"


def _identities(specification: spec.Specification, source: spec.Source) -> list[str]:
    """Return all identities of a source: one, or that of each seed for a named world."""
    return [_identity(source, seed) for seed in (specification.seeds if source.path is None else (None,))]


def _axes(specification: spec.Specification, source: spec.Source) -> tuple[Sequence[Any], ...]:
    """Return what one source is combined with: trajectories, optics, sensors and seeds."""
    if source.entry.kind == "recordings":
        return ()
    prisms = [asdict(prism) for prism in specification.prisms]
    optics = [{"prism": prism, "rpm": rpm} for prism, rpm in itertools.product(prisms, specification.speeds_rpm)]
    if specification.no_prism:
        optics.append({"prism": None, "rpm": None})
    sensors = [{"name": name, **asdict(sensor)} for name, sensor in specification.sensors.items()]
    return _trajectories(specification, source), optics, sensors, specification.seeds


def _recipes(
    specification: spec.Specification, source: spec.Source, axes: Sequence[Sequence[Any]]
) -> Iterator[dict[str, Any]]:
    """Yield what determines each recording of one source."""
    entry = source.entry
    base: dict[str, Any] = {"source": {"kind": entry.kind, "name": source.name, "sha256": source.digest}}
    if specification.output is not None:
        base |= {"output": specification.output.given}
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
    if entry.rotate_deg_s is not None:
        base |= {"rotate_deg_s": entry.rotate_deg_s}
    for trajectory, optic, sensor, seed in itertools.product(*axes):
        yield base | trajectory | optic | {"sensor": sensor, "seed": seed}


def _trajectories(specification: spec.Specification, source: spec.Source) -> list[dict[str, Any]]:
    """Return the camera motions through a world, with the digest of a file of poses. Other sources have none."""
    if source.entry.kind == "world_files" and source.entry.trajectories is None:
        return [{"trajectory": None}]
    if source.entry.kind not in ("worlds", "world_files"):
        return [{}]
    return [
        {"trajectory": name, "poses_sha256": spec.content_digest(specification.folder / name)}
        if name.lower().endswith(POSE_FILES)
        else {"trajectory": name}
        for name in source.entry.trajectories or ("handheld",)
    ]


def _drawn(specification: spec.Specification, sources: Sequence[spec.Source]) -> dict[str, str]:
    """Return the split of each source by its identity, drawn by a hash of it and of the split seed."""
    names = dict.fromkeys(same for source in sources for same in _identities(specification, source))
    return {same: _split(specification, same) for same in names}


def _split(specification: spec.Specification, same: str) -> str:
    """Return the split of the source with an identity."""
    drawn = int(_draw(specification, same)[:13], 16) / 16**13
    total = 0.0
    for name, share in specification.splits.items():
        total += share
        if drawn < total:
            return name
    return [name for name, share in specification.splits.items() if share > 0.0][-1]


def _draw(specification: spec.Specification, same: str) -> str:
    """Return the hash of a source's identity and of the split seed."""
    return _digest([specification.split_seed, same])


def _stratified(specification: spec.Specification, sources: Sequence[spec.Source]) -> dict[str, str]:
    """Return the split of each source by its identity, so that the splits share the sources of every class.

    The sources of a class are ordered by their hash, and this order is cut at the shares. Raises
    :class:`AmiwarpError` for a source without class or with two of them, and for a class with fewer sources than
    splits.
    """
    label = str(specification.stratify)
    first: dict[str, spec.Source] = {}
    classes: defaultdict[Any, list[str]] = defaultdict(list)
    with errors_name(specification.path, lambda: f"field stratify is {shown(label)}"):
        for source in sources:
            if label not in source.labels:
                raise AmiwarpError(f"{source.name} has no such label; add it, or remove stratify")
            for same in _identities(specification, source):
                known = first.setdefault(same, source)
                if known is source:
                    classes[source.labels[label]].append(same)
                elif known.labels[label] != source.labels[label]:
                    raise AmiwarpError(
                        f"{known.name} and {source.name} have the same content but the labels "
                        f"{shown(known.labels[label])} and {shown(source.labels[label])}; remove one of them"
                    )
        shares = {name: share for name, share in specification.splits.items() if share > 0.0}
        splits: dict[str, str] = {}
        for value, members in classes.items():
            if len(members) < len(shares):
                raise AmiwarpError(
                    f"class {shown(value)} has {len(members)} different sources for the {len(shares)} splits "
                    f"{', '.join(shares)}; add sources of it, or give fewer splits"
                )
            members.sort(key=partial(_draw, specification))
            names = [name for name, count in _counts(shares, len(members)).items() for _ in range(count)]
            splits.update(zip(members, names, strict=True))
    return splits


def _counts(shares: Mapping[str, float], total: int) -> dict[str, int]:
    """Return how many of ``total`` sources each split gets: its share, rounded, but at least one."""
    exact = {name: share * total for name, share in shares.items()}
    counts = {name: max(1, math.floor(value)) for name, value in exact.items()}
    while (spare := total - sum(counts.values())) != 0:
        able = [name for name in counts if spare > 0 or counts[name] > 1]
        name = max(able, key=lambda name: math.copysign(1.0, spare) * (exact[name] - counts[name]))
        counts[name] += 1 if spare > 0 else -1
    return counts


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
    file: Annotated[str, partial(_of_pattern, "[A-Za-z0-9_-]+/[A-Za-z0-9_-]*-[0-9a-f]{16}[.](h5|npz)")]
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

    def __post_init__(self) -> None:
        if not Path(self.file).stem.endswith(self.key):  # the file may be moved or removed
            raise AmiwarpError(f"file is {shown(self.file)}; expected a name with the key {self.key}")


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
    """Device; :data:`amiwarp.studies.cluster.ANY_GPU` is the worker's GPU."""
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
        return Failed(job.item.key, failure_text(error))


def _make(job: Job) -> Made:
    began, began_processor = time.perf_counter(), time.process_time()
    item, device = job.item, "cuda:0" if job.device == cluster.ANY_GPU else job.device
    path = job.out / item.file
    part = job.scratch / path.name
    written = write_recording(item, part, device)
    digest = spec.content_digest(part, noted=False)
    make_folder(path.parent)
    put_in_place(part, path, overwrite=True)
    return Made(
        item.key, item.file, path.stat().st_size, digest, *written, round(time.perf_counter() - began, 6),
        round(time.process_time() - began_processor, 6), device, __version__,
    )  # fmt: skip


def write_recording(
    item: Item, path: Path, device: str, duration_s: float | None = None
) -> tuple[int, float, int, int]:
    """Write a recording or its tensors to ``path``, replacing it. ``duration_s`` shortens a simulated recording.

    Return its number of events, its duration (as simulated, or from the first event to the last) [s], and the width and
    height of the sensor [px].
    """
    if item.kind == "recordings":
        return _write_existing(item, path, device)
    simulation = simulation_of(item, device, duration_s)
    rate, size = item.recipe.get("truth_hz"), (simulation.camera.width, simulation.camera.height)
    if item.output is None:
        events = simulation.write(path, truth_hz=rate, overwrite=True)
    else:
        events = _write_simulated_tensors(simulation, item.output, path, rate)
    return events, simulation.duration_s, *size


def _write_existing(item: Item, path: Path, device: str) -> tuple[int, float, int, int]:
    """Write what a source of the kind ``recordings`` gives, as :func:`write_recording` does."""
    source = item.folder / item.source
    if item.output is None:
        done = convert(source, path, overwrite=True)
        count, first, last, size = done.events, done.t_first, done.t_last, (done.width, done.height)
    else:
        events = open_recording(source).events
        count, size = len(events), events.size
        first, last = (events.t_first, events.t_last) if count else (None, None)
        save_tensors(path, _tensors(events.slice(0, count), size, item.output, device=device))
    return count, 0.0 if first is None or last is None else (last - first) * 1e-6, *size


def _write_simulated_tensors(
    simulation: Simulation, output: spec.OutputEntry, path: Path, truth_hz: float | None
) -> int:
    """Simulate a recording and write its tensors, which are made on the device. Return the number of events.

    The ground truth of instants is written too, if there is some. That of the events is not computed.
    """
    recorded = RecordedTruth(simulation, chosen_instants(simulation.duration_us, truth_hz))
    blocks, frames = list[DeviceEvents](), list[FrameTruth]()
    engine = Engine(simulation)
    for block in engine.run():
        blocks.append(block.on_device()[0])
        frames.extend(recorded.frames_before(engine.now_us))
    events = DeviceEvents.concatenate(blocks)
    arrays = _tensors(events, (simulation.camera.width, simulation.camera.height), output)
    if frames:
        arrays["truth_t"] = np.array([frame.t_us for frame in frames], np.int64)
        arrays |= {name: np.stack([getattr(frame, name) for frame in frames]) for name in MAPS}
    save_tensors(path, arrays)
    return len(events)


def _tensors(
    events: Events | DeviceEvents, size: tuple[int, int], output: spec.OutputEntry, **options: Any
) -> dict[str, NDArray[Any]]:
    """Return the tensors of a recording by name: ``tensor``, and the times of its windows if there are several."""
    found = windows(events, **output.windows) if output.windows else None
    tensor = output.function(events, *size, windows=found, **output.options, **options)
    times = {} if found is None else {"t_start": found.t_start, "t_end": found.t_end}
    return {"tensor": tensor if isinstance(tensor, np.ndarray) else tensor.numpy(), **times}


def simulation_of(item: Item, device: str, duration_s: float | None = None) -> Simulation:
    """Return the simulation of a recording. ``duration_s`` shortens it."""
    if item.recipe["prism"] is None:
        return _seen_through(item, Prism(0.0), PrismMotion(), device, duration_s).without_prism()
    prism, motion = spec.PrismEntry(**item.recipe["prism"]).build(), PrismMotion(item.recipe["rpm"])
    return _seen_through(item, prism, motion, device, duration_s)


def _seen_through(item: Item, prism: Prism, motion: PrismMotion, device: str, duration_s: float | None) -> Simulation:
    """Return the simulation of a recording through a prism."""
    recipe = item.recipe
    camera, source = spec.CameraEntry(**recipe["camera"]), os.fspath(item.folder / item.source)
    length = recipe["duration_s"] if duration_s is None else duration_s
    sensor = SensorModel(**{name: value for name, value in recipe["sensor"].items() if name != "name"})
    if item.kind == "translated":
        return translation(open_recording(source), prism, duration_s=length, motion=motion, sensor=sensor,
                           seed=item.seed, device=device)  # fmt: skip
    if item.kind == "videos":
        return _of_video(item, source, camera, duration_s=length, prism=prism, motion=motion, sensor=sensor,
                         seed=item.seed, device=device)  # fmt: skip
    scene = Scene.from_picture(source) if item.kind == "pictures" else _world(item, source)
    turning = CameraMotion([math.radians(rate) for rate in recipe.get("rotate_deg_s", (0.0, 0.0, 0.0))])
    return Simulation(scene, camera.build(), prism, length, motion, turning, sensor=sensor, seed=item.seed,
                      device=device)  # fmt: skip


def _of_video(item: Item, source: str, entry: spec.CameraEntry, **settings: Any) -> Simulation:
    """Return the simulation of a video, whose size is that of the camera unless the specification gives one."""
    from amiwarp.simulation.pictures import open_pictures

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


# Files that describe a data set: the journal of finished recordings, and the manifest as JSON and as Parquet.

JOURNAL, TABLE = "journal.jsonl", "manifest.parquet"
"""Names of the files in the folder of a data set."""


def require_pyarrow() -> Any:
    """Return pyarrow. Raises :class:`AmiwarpError` if it is not installed."""
    return optional_module("pyarrow", "dataset", "'amiwarp dataset' needs pyarrow")


def check_folder(out: Path) -> None:
    """Raise :class:`AmiwarpError` if a folder holds other files than a data set."""
    if out.is_dir() and not (out / JOURNAL).exists():
        other = sorted(p.name for p in out.iterdir() if not p.name.startswith("."))
        if other:
            raise AmiwarpError(f"{out}: holds other files, such as {other[0]}; give a new folder")


class Journal:
    """Recordings that were made, on disk. A later entry replaces an earlier one of the same key."""

    def __init__(self, out: Path) -> None:
        self._out, self._path = out, out / JOURNAL
        self.damaged: list[str] = []
        """What is wrong with damaged lines of the journal, and with damaged recordings."""
        found = read_journal(self._path, lambda data: build(Made, data, ""), self.damaged)
        self.made = {made.key: made for made in found}
        """Recordings by the key of their item."""

    def create(self) -> None:
        """Create the journal unless it exists. It marks the folder as a data set."""
        create_journal(self._path)

    def add(self, made: Made) -> None:
        """Add a recording."""
        self.made[made.key] = made
        append_line(self._path, asdict(made))

    def move(self, item: Item) -> None:
        """Move the recording of an item to the folder of its split, if it is in that of an earlier split."""
        made = self.made[item.key]
        if made.file != item.file:
            make_folder((self._out / item.file).parent)
            put_in_place(self._out / made.file, self._out / item.file, overwrite=True)
            self.add(replace(made, file=item.file))

    def drop(self, item: Item) -> None:
        """Forget the recording of an item, which is made again, and remove it from the folder of an earlier split."""
        made = self.made.pop(item.key, None)
        if made is not None and made.file != item.file:
            (self._out / made.file).unlink(missing_ok=True)

    def is_there(self, item: Item) -> bool:
        """Return whether the recording of an item is in the journal, and its file has the size stated there.

        It may lie in the folder of an earlier split.
        """
        made = self.made.get(item.key)
        if made is None:
            return False
        path = self._out / made.file
        return path.is_file() and path.stat().st_size == made.bytes

    def is_intact(self, item: Item) -> bool:
        """Return whether the file of a recording that is there has the checksum of the journal."""
        made = self.made[item.key]
        try:
            if spec.content_digest(self._out / made.file, noted=False) == made.sha256:
                return True
        except AmiwarpError as error:  # a file that cannot be read is made again, as a damaged one
            self.damaged.append(str(error))
            return False
        self.damaged.append(f"{self._out / made.file}: does not have the checksum of {JOURNAL}")
        return False

    def others(self, items: Sequence[Item]) -> list[str]:
        """Return the existing recordings that belong to none of the items, for example of an earlier specification."""
        files = {item.file for item in items}
        return sorted(made.file for made in self.made.values()
                      if made.file not in files and (self._out / made.file).exists())  # fmt: skip


def write_manifest(
    out: Path, specification: spec.Specification, items: Sequence[Item], journal: Journal, failed: Sequence[Failed]
) -> None:
    """Write the manifest of the recordings that are finished, as JSON and as Parquet."""
    rows = [_row(item, journal.made[item.key]) for item in items if item.key in journal.made]
    by_key = {item.key: item for item in items}
    licences = Counter((item.source, item.licence) for item in items if item.key in journal.made)
    head = {
        "format": FORMAT,
        "version": VERSION,
        "name": specification.name,
        "amiwarp": __version__,
        "date": time.strftime("%Y-%m-%d"),
        "specification": specification.data,
        "complete": len(rows) == len(items),
        "recordings": len(items),
        "events": sum(row["events"] for row in rows),
        "bytes": sum(row["bytes"] for row in rows),
        "splits": dict(Counter(row["split"] for row in rows)),
        "licences": _licences(licences),
        "failed": [{"file": by_key[f.key].file, "source": by_key[f.key].source, "error": f.error} for f in failed],
        "not_in_specification": journal.others(items),
    }
    text = json.dumps(head, indent=1, default=str).removesuffix("\n}")
    lines = ",\n".join("  " + json.dumps(row) for row in rows)  # one line for each recording
    write_text(out / MANIFEST, f'{text},\n "items": [\n{lines}\n ]\n}}\n', overwrite=True)
    _write_table(out / TABLE, rows)


def _licences(counts: Mapping[tuple[str, str], int]) -> list[dict[str, Any]]:
    """Return the licences with the number of their sources and recordings."""
    sources, recordings = Counter[str](), Counter[str]()
    for (_, licence), count in counts.items():
        sources[licence] += 1
        recordings[licence] += count
    return [
        {"licence": name or "not stated", "sources": sources[name], "recordings": recordings[name]}
        for name in sorted(sources)
    ]


def _row(item: Item, made: Made) -> dict[str, Any]:
    """Return the entry of a recording in the manifest. Settings that it does not have are None."""
    recipe = item.recipe
    prism = recipe.get("prism") or {}
    return {
        "file": made.file,
        "sha256": made.sha256,
        "bytes": made.bytes,
        "split": item.split,
        "labels": dict(item.labels),
        "events": made.events,
        "duration_s": made.duration_s,
        "width": made.width,
        "height": made.height,
        "seed": None if item.kind == "recordings" else item.seed,
        "source": item.source,
        "source_kind": item.kind,
        "source_sha256": recipe["source"]["sha256"],
        "licence": item.licence,
        "apex_deg": prism.get("apex_deg"),
        "index": prism.get("index"),
        "flat_side": prism.get("flat_side"),
        "rpm": recipe.get("rpm"),
        "sensor": (recipe.get("sensor") or {}).get("name"),
        "variant": recipe.get("seed"),
        "trajectory": recipe.get("trajectory"),
        "representation": (recipe.get("output") or {}).get("representation"),
        "device": made.device,
        "amiwarp": made.amiwarp,
    }


def _write_table(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write the entries as Parquet."""
    pyarrow = require_pyarrow()
    parquet = importlib.import_module("pyarrow.parquet")
    with NewFile(path, overwrite=True) as new:
        parquet.write_table(pyarrow.Table.from_pylist(flat_rows(rows)), new.part)


def flat_rows(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return the entries as rows of a table: each label is a value ``label_NAME``; the others keep their name."""
    labels = sorted({name for row in rows for name in row["labels"]})
    return [
        {**{k: v for k, v in row.items() if k != "labels"}, **{f"label_{n}": row["labels"].get(n) for n in labels}}
        for row in rows
    ]


MOST_READERS = 8
"""Largest number of threads that read finished recordings."""
CHECKED = 256
"""Number of recordings that are given to these threads at a time."""


@guarded
@dataclass(frozen=True)
class DatasetSummary:
    """What :func:`make_dataset` did.

    Examples
    --------
    >>> summary = amiwarp.DatasetSummary(
    ...     recordings=12, made=11, kept=0, failed={"train/a-1.h5": "no such file"}, not_in_specification=(),
    ...     splits={"train": 11}, events=10, size_bytes=100, seconds=2.0, worker_seconds=3.0,
    ...     processor_seconds=2.5, workers=2)
    >>> summary.made + summary.kept + len(summary.failed) == summary.recordings
    True
    """

    recordings: int
    """Number of recordings that the specification describes."""
    made: int
    """Number of recordings that were made."""
    kept: int
    """Number of recordings that were there already."""
    failed: Mapping[str, str]
    """Error message of each recording that could not be made, by its file."""
    not_in_specification: tuple[str, ...]
    """Recordings in the folder that the specification does not describe. They are kept, but not in the manifest."""
    splits: Mapping[str, int]
    """Number of finished recordings of each split."""
    events: int
    """Number of events in the recordings that were made."""
    size_bytes: int
    """Size of the recordings that were made [bytes]."""
    seconds: float
    """Elapsed time [s]."""
    worker_seconds: float
    """Time that the workers spent on recordings, added up [s]."""
    processor_seconds: float
    """Processor time that they spent, added up [s]."""
    workers: int
    """Largest number of workers; 0 if there was nothing to make."""
    damaged: tuple[str, ...] = ()
    """What was wrong with the journal, and with each damaged recording. These recordings were made again."""


@guarded
def make_dataset(
    specification: str | Path,
    out: str | Path,
    *,
    scheduler: str | None = None,
    workers: int | None = None,
    device: str = "cpu",
    progress: Progress | None = None,
) -> DatasetSummary:
    """Make the recordings of a data set that are missing, and write its manifest.

    A recording that cannot be made is reported in the manifest and does not stop the others.

    Parameters
    ----------
    specification : str or Path
        TOML file that describes the data set.
    out : str or Path
        Folder of the data set: a new folder, or the folder of an earlier call.
    scheduler : str, optional
        Address of a Dask scheduler, such as ``tcp://10.0.0.1:8786``. By default, processes of this machine do the
        work. All workers need access to ``out`` and to the sources under the same paths.
    workers : int, optional
        Number of local processes. By default one for each core, or up to four for each GPU. One worker runs in this
        process, and needs no Dask.
    device : str, optional
        ``cpu``; ``cuda`` for all GPUs, which the workers share evenly; or one GPU, such as ``cuda:0``.
    progress : Progress, optional
        Called with the state and the finished share.

    Returns
    -------
    DatasetSummary
        Numbers of recordings, failures and the speed.

    Raises
    ------
    AmiwarpError
        If the specification is wrong, a source is not found, the folder holds other files, or workers are missing.

    Notes
    -----
    Several local workers are processes that import the running script. Call this function under
    ``if __name__ == "__main__":`` in a script.

    Examples
    --------
    >>> import pathlib
    >>> _ = pathlib.Path("step.pgm").write_text("P2 4 2 255 0 255 0 255 255 0 255 0")
    >>> _ = pathlib.Path("small.toml").write_text('''
    ... format = "amiwarp-dataset-specification"
    ... version = 1
    ... duration_s = 0.002
    ... camera = {size = [16, 12]}
    ... prisms = [{apex_deg = 1.0}]
    ... speeds_rpm = [720.0, 1800.0]
    ... sources = [{pictures = "*.pgm"}]
    ... ''')
    >>> amiwarp.make_dataset("small.toml", "small", workers=1).made
    2
    """
    began = time.perf_counter()
    out, report = Path(out), progress or silent
    loaded = spec.load_specification(specification)
    require_pyarrow()
    check_folder(out)
    items = list_items(loaded)
    count = _local_workers(scheduler, workers, device)
    make_folder(out)
    with only_writer(out):
        return _make_missing(
            loaded, items, out, scheduler=scheduler, count=count, device=device, report=report, began=began
        )


def _make_missing(
    loaded: spec.Specification,
    items: Sequence[Item],
    out: Path,
    *,
    scheduler: str | None,
    count: int | None,
    device: str,
    report: Progress,
    began: float,
) -> DatasetSummary:
    """Make the recordings that the folder lacks, and write the manifest."""
    journal = Journal(out)
    journal.create()
    todo = missing(journal, items, report)
    made: list[Made] = []
    failed: list[Failed] = []
    events = most_workers = 0
    try:
        if todo:
            target, threads = out.resolve(), cluster.threads_of_worker(device, count)
            with (
                scratch_folder(target) as scratch,
                cluster.start_workers("amiwarp dataset", "dataset", scheduler, count or 0, device) as running,
                contextlib.closing(
                    cluster.run_jobs(running, make, (Job(item, target, scratch, device, threads) for item in todo))
                ) as results,
            ):
                first = time.perf_counter()
                report(f"0 of {len(todo):,} recordings", 0.0)
                for done, (job, future) in enumerate(results, 1):
                    result = _result(job, future)
                    if isinstance(result, Failed):
                        failed.append(result)
                    else:
                        made.append(result)
                        events += result.events
                        journal.add(result)
                    most_workers = max(most_workers, running.count())
                    report(_line(done, len(failed), len(todo), events, time.perf_counter() - first), done / len(todo))
    finally:
        write_manifest(out, loaded, items, journal, failed)
    files = {item.key: item.file for item in items}
    return DatasetSummary(
        recordings=len(items),
        made=len(made),
        kept=len(items) - len(todo),
        failed={files[one.key]: one.error for one in failed},
        not_in_specification=tuple(journal.others(items)),
        splits=dict(Counter(item.split for item in items if item.key in journal.made)),
        events=events,
        size_bytes=sum(one.bytes for one in made),
        seconds=time.perf_counter() - began,
        worker_seconds=sum(one.seconds for one in made),
        processor_seconds=sum(one.processor_s for one in made),
        workers=most_workers,
        damaged=tuple(journal.damaged),
    )


def missing(journal: Journal, items: Sequence[Item], progress: Progress) -> list[Item]:
    """Return the items without an undamaged recording, in an order that depends on their keys alone.

    Undamaged recordings whose split has changed are moved to its folder.
    The order mixes long and short recordings, so that the speed so far predicts the rest. The files are read by several
    threads, to compare their checksums.
    """
    there = [item for item in items if journal.is_there(item)]
    intact: set[str] = set()
    with ThreadPoolExecutor(min(cpu_threads(), MOST_READERS)) as pool:
        for first in range(0, len(there), CHECKED):
            block = there[first : first + CHECKED]
            intact.update(
                item.key for item, good in zip(block, pool.map(journal.is_intact, block), strict=True) if good
            )
            progress("checking finished recordings", (first + len(block)) / len(there))
    for item in there:
        if item.key in intact:
            journal.move(item)
    todo = [item for item in items if item.key not in intact]
    for item in todo:
        journal.drop(item)
    return sorted(todo, key=lambda item: item.key)


def _local_workers(scheduler: str | None, workers: int | None, device: str) -> int | None:
    """Return the number of local workers; None with a scheduler.

    Raises :class:`AmiwarpError` if this machine lacks their device.
    """
    if scheduler is not None:
        if workers is not None:
            raise AmiwarpError(f"workers = {workers} applies to local processes; leave it out with a scheduler")
        return None
    known = launch.start_quietly()
    if device not in (*known, *([cluster.ANY_GPU] if cluster.gpu_count(known) else [])):
        raise AmiwarpError(f"device {device!r} is not available; choose one of {', '.join(known)}")
    return cluster.worker_count(workers, device)


def _result(job: Job, future: Future[Made | Failed]) -> Made | Failed:
    """Return the result of a job. A worker that dies, for example for want of memory, is a failure of its recording.

    Raises :class:`AmiwarpError` if the worker does not see the folder of the data set.
    """
    message = cluster.failure_of(future)
    if not message or isinstance(future.exception(), AmiwarpError):
        return future.result()
    return Failed(job.item.key, message)


def _line(done: int, failed: int, total: int, events: int, seconds: float) -> str:
    """Return the state of a run as text, with the time left at the mean speed so far."""
    left = (total - done) * seconds / done
    lost = f", {failed:,} failed" if failed else ""
    return f"{done:,} of {total:,} recordings{lost}, {events / seconds / 1e6:.3g} Mev/s, {duration_text(left)} left"


def duration_text(seconds: float) -> str:
    """Return a duration with the unit in which it reads best."""
    for unit, length in (("days", 86400.0), ("h", 3600.0), ("min", 60.0)):
        if seconds >= 2.0 * length:
            return f"{seconds / length:.1f} {unit}"
    return f"{seconds:.0f} s"


# Estimate of the size of a data set and of the time to make it, from short samples of its recordings.

SAMPLES = 24
"""Largest number of recordings that are sampled for each kind of source."""
LONGEST_SAMPLE_S = 0.1
"""Longest simulated time of a sample [s]."""
SAMPLING_S = 10.0
"""Time after which no further sample of a kind of source begins [s]."""


@guarded
@dataclass(frozen=True)
class DatasetPlan:
    """What :func:`plan_dataset` expects of a data set.

    Examples
    --------
    >>> plan = amiwarp.DatasetPlan(
    ...     recordings=12, missing=10, splits={"train": 12}, sources={"pictures": 12}, samples=6, uncertainty=0.1,
    ...     events=1e6, size_bytes=1e7, worker_seconds=30.0, workers=2, device="cpu")
    >>> plan.seconds
    15.0
    """

    recordings: int
    """Number of recordings that the specification describes."""
    missing: int
    """Number of them that are not in the folder."""
    splits: Mapping[str, int]
    """Number of recordings of each split."""
    sources: Mapping[str, int]
    """Number of recordings of each kind of source."""
    samples: int
    """Number of missing recordings that were sampled."""
    uncertainty: float
    """Standard error of the expected time, relative to it, from the spread of the samples."""
    events: float
    """Expected number of events of the missing recordings."""
    size_bytes: float
    """Expected size of the missing recordings [bytes]."""
    worker_seconds: float
    """Expected time of the missing recordings, added over the workers [s]."""
    workers: int
    """Number of workers."""
    device: str
    """Device of the samples."""
    failed: Mapping[str, str] = field(default_factory=dict)
    """Error message of each sample that could not be made, by its file. The estimate leaves these samples out."""

    @property
    def seconds(self) -> float:
        """Expected time [s], if the workers do not slow each other down."""
        return self.worker_seconds / max(self.workers, 1)


@dataclass(frozen=True)
class _Cost:
    """Events, bytes and seconds of a recording."""

    events: float = 0.0
    bytes: float = 0.0
    seconds: float = 0.0

    def plus(self, other: _Cost, times: float = 1.0) -> _Cost:
        """Return the sum with ``other`` times a factor."""
        return _Cost(
            self.events + times * other.events, self.bytes + times * other.bytes, self.seconds + times * other.seconds
        )


@guarded
def plan_dataset(
    specification: str | Path,
    out: str | Path,
    *,
    workers: int | None = None,
    device: str = "cpu",
    progress: Progress | None = None,
) -> DatasetPlan:
    """Estimate the size of a data set and the time to make it. No recording is added to the folder.

    Up to 24 recordings of each kind of source are simulated for at most 0.1 s each, within about 10 s. Events, bytes
    and time are taken to grow linearly with the duration, and the mean of the samples stands for all recordings of that
    kind.

    Parameters
    ----------
    specification : str or Path
        TOML file that describes the data set.
    out : str or Path
        Folder of the data set, which need not exist.
    workers : int, optional
        Number of workers. By default one for each core, or up to four for each GPU.
    device : str, optional
        Device as for :func:`make_dataset`.
    progress : Progress, optional
        Called with the finished share.

    Returns
    -------
    DatasetPlan
        Counts, and the expected events, size and time.

    Raises
    ------
    AmiwarpError
        If the specification is wrong, a source is not found, or no sample of a kind of source can be made.

    Examples
    --------
    >>> import pathlib
    >>> _ = pathlib.Path("step.pgm").write_text("P2 4 2 255 0 255 0 255 255 0 255 0")
    >>> _ = pathlib.Path("small.toml").write_text('''
    ... format = "amiwarp-dataset-specification"
    ... version = 1
    ... duration_s = 0.002
    ... camera = {size = [16, 12]}
    ... prisms = [{apex_deg = 1.0}]
    ... speeds_rpm = [720.0]
    ... seeds = 10
    ... sources = [{pictures = "*.pgm"}]
    ... ''')
    >>> amiwarp.plan_dataset("small.toml", "small", workers=2).missing
    10
    """
    out = Path(out)
    items = list_items(spec.load_specification(specification))
    check_folder(out)
    journal = Journal(out)
    todo = sorted((item for item in items if not journal.is_there(item)), key=lambda item: item.key)
    by_kind: defaultdict[str, list[Item]] = defaultdict(list)
    for item in todo:
        by_kind[item.kind].append(item)
    count = cluster.worker_count(workers, device)
    threads = cluster.threads_of_worker(device, count)
    failed: dict[str, str] = {}
    groups = list(by_kind.values())
    total, samples, variance = _sample_all(groups, out, device, threads, progress or silent, failed)
    return DatasetPlan(
        recordings=len(items),
        missing=len(todo),
        splits=dict(Counter(item.split for item in items)),
        sources=dict(Counter(item.kind for item in items)),
        samples=samples,
        uncertainty=variance**0.5 / total.seconds if total.seconds else 0.0,
        events=total.events,
        size_bytes=total.bytes,
        worker_seconds=total.seconds,
        workers=count,
        device=device,
        failed=failed,
    )


def _sample_all(
    groups: Sequence[Sequence[Item]],
    out: Path,
    device: str,
    threads: int | None,
    progress: Progress,
    failed: dict[str, str],
) -> tuple[_Cost, int, float]:
    """Return the expected cost of all recordings, the number of samples, and the variance of the expected time [s²].

    Each group holds the recordings of one kind of source. Samples that cannot be made are noted in ``failed``.
    """
    total, samples, variance = _Cost(), 0, 0.0
    # The samples are written to the disk of the data set, whose folder may not exist yet.
    near = next(folder for folder in (out.resolve(), *out.resolve().parents) if folder.is_dir())
    with scratch_folder(near) as scratch:
        for group in groups:
            one_device = "cuda:0" if device == cluster.ANY_GPU else device
            found = _sample(group, scratch, one_device, threads, progress, failed)
            for cost in found:
                total = total.plus(cost, len(group) / len(found))
            samples += len(found)
            variance += len(group) ** 2 * _variance_of_mean([cost.seconds for cost in found], len(group))
    return total, samples, variance


def _sample(
    items: Sequence[Item],
    scratch: Path,
    device: str,
    threads: int | None,
    progress: Progress,
    failed: dict[str, str],
) -> list[_Cost]:
    """Return the costs of sampled recordings. The order of the items is random.

    A recording that fails is noted in ``failed`` and left out. Raises :class:`AmiwarpError` if all fail.
    """
    chosen, began, costs = items[:SAMPLES], time.perf_counter(), list[_Cost]()
    with limited_cpu_threads(threads):
        for count, item in enumerate(chosen, 1):
            with noted(failed, item.file):
                if not costs:  # compiles the kernels
                    _cost(item, scratch, device, 1e-3)
                costs.append(_whole_cost(item, scratch, device))
            if not costs and count == len(chosen):
                raise AmiwarpError(f"no sample of {item.kind} can be made; {item.file}: {failed[item.file]}")
            progress(f"sampling {item.kind}", count / len(chosen))
            if costs and time.perf_counter() - began > SAMPLING_S:
                break
    return costs


def _variance_of_mean(values: Sequence[float], of: int) -> float:
    """Return the variance of the mean of values that were drawn from ``of`` without replacement."""
    if len(values) < 2:
        return 0.0
    return statistics.variance(values) / len(values) * (1.0 - len(values) / of)


def _whole_cost(item: Item, scratch: Path, device: str) -> _Cost:
    """Return the cost of a recording, extrapolated from two short ones if it is long."""
    whole = item.recipe.get("duration_s")
    if whole is None and item.kind in ("videos", "translated"):
        whole = simulation_of(item, device).duration_s
    if whole is None or whole <= LONGEST_SAMPLE_S:
        return _cost(item, scratch, device, None)
    short, long = (_cost(item, scratch, device, s) for s in (0.5 * LONGEST_SAMPLE_S, LONGEST_SAMPLE_S))
    slope = long.plus(short, -1.0)
    rising = _Cost(*(max(0.0, value) for value in (slope.events, slope.bytes, slope.seconds)))
    return long.plus(rising, (whole - LONGEST_SAMPLE_S) / (0.5 * LONGEST_SAMPLE_S))


def _cost(item: Item, scratch: Path, device: str, duration_s: float | None) -> _Cost:
    """Make a recording, and return its computing time and its size."""
    path = scratch / Path(item.file).name
    began = time.perf_counter()
    events, *_ = write_recording(item, path, device, duration_s)
    spec.content_digest(path, noted=False)
    cost = _Cost(events, path.stat().st_size, time.perf_counter() - began)
    path.unlink()
    return cost
