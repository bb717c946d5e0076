"""Recordings of a data set: every combination of source, trajectory, prism, speed, sensor and seed."""

from __future__ import annotations

import hashlib
import itertools
import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from amiwarp.errors import AmiwarpError
from amiwarp.simulation.worlds.open_world import POSE_FILES
from amiwarp.studies.dataset.sources import Source, content_digest, find_sources
from amiwarp.studies.dataset.specification import LARGEST_SEED, MOST_RECORDINGS, Specification


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
