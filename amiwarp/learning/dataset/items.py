"""Recordings of a data set: every combination of source, trajectory, prism, speed, sensor and seed."""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import json
import math
import re
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.io.inputs import errors_name
from amiwarp.learning.dataset import specification as spec
from amiwarp.learning.dataset.digests import content_digest
from amiwarp.learning.dataset.randomise import draw
from amiwarp.learning.dataset.sources import Source, find_sources
from amiwarp.simulation.worlds.world_choice import POSE_FILES
from amiwarp.validation import shown


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
    stratum: str = ""
    """Sources among which the splits were divided by their shares, such as ``class = 'disc'``; empty for a draw."""

    @cached_property
    def key(self) -> str:
        """Digest of the recipe, which identifies the recording."""
        return _digest(self.recipe)[:16]

    @property
    def kind(self) -> str:
        """Kind of the source, one of :data:`amiwarp.learning.dataset.specification.KINDS`."""
        return str(self.recipe["source"]["kind"])

    @property
    def source(self) -> str:
        """Name of the source."""
        return str(self.recipe["source"]["name"])

    @property
    def same(self) -> str:
        """What identifies the source for its split. Equal files, and the worlds of one seed, are the same source."""
        return _identity(self.source, self.recipe["source"]["sha256"], self.recipe.get("seed"))

    @property
    def seed(self) -> int:
        """Seed of all random numbers except a named world's. It depends on the recipe alone.

        Tensors are made of the recording that the same specification gives without output, so they have its seed.
        """
        recorded = {name: value for name, value in self.recipe.items() if name != "output"}
        return int(_digest(recorded)[:16], 16) & spec.LARGEST_SEED

    @property
    def file(self) -> str:
        """Path of the recording, relative to the folder of the data set. The path of a rig is a folder."""
        stem = re.sub(r"[^A-Za-z0-9_-]+", "_", Path(self.source).stem)[:60]
        ending = ".npz" if "output" in self.recipe else ".h5"
        if self.cameras:
            ending = ""
        return f"{self.split}/{stem}-{self.key}{ending}"

    @property
    def cameras(self) -> Sequence[str]:
        """Names of the cameras of a rig; none for the recording of one camera."""
        names: Sequence[str] = self.recipe["rig"]["cameras"] if "rig" in self.recipe else ()
        return names

    @property
    def drawn(self) -> Mapping[str, float]:
        """Values that the recording drew from the ranges of the specification, by name."""
        values: Mapping[str, float] = self.recipe.get("drawn", {})
        return values

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
    axes_of_sources = [
        (source, _axes(specification, source)) for source in find_sources(specification)
    ]
    count = sum(math.prod(map(len, axes)) for _, axes in axes_of_sources)
    if count > spec.MOST_RECORDINGS:
        raise AmiwarpError(
            f"{specification.path}: describes {count:,} recordings; divide it among specifications of at most "
            f"{spec.MOST_RECORDINGS:,} recordings each"
        )
    sources = [source for source, _ in axes_of_sources]
    divided = _divided(specification, sources)
    items = []
    for source, axes in axes_of_sources:
        for recipe in _recipes(specification, source, axes):
            same = _identity(source.name, source.digest, recipe.get("seed"))
            split, stratum = divided[same]
            labels = _with_drawn(specification, source, recipe)
            licence = source.entry.licence
            items.append(Item(recipe, specification.folder, split, labels, licence, stratum))
    return items


def _with_drawn(
    specification: spec.Specification, source: Source, recipe: Mapping[str, Any]
) -> dict[str, Any]:
    """Return the labels of a recording: its source's labels, and the values that it drew.

    Raises :class:`AmiwarpError` for a label with the name of a drawn value.
    """
    drawn = recipe.get("drawn", {})
    both = sorted(source.labels.keys() & drawn.keys())
    if both:
        raise AmiwarpError(
            f"{specification.path}: {source.name} has the label {shown(both[0])}, which randomise draws; rename the "
            "label",
            ErrorCode.FIELD,
        )
    return {**source.labels, **drawn}


def sources_of_splits(
    specification: spec.Specification, items: Sequence[Item]
) -> dict[str, dict[str, int]]:
    """Return the number of different sources of each split, by the stratum of the sources."""
    found: dict[str, dict[str, set[str]]] = {}
    for item in items:
        found.setdefault(item.stratum, {}).setdefault(item.split, set()).add(item.same)
    counts = {}
    for stratum, splits in found.items():
        names = [name for name in specification.splits if name in splits]
        counts[stratum] = {name: len(splits[name]) for name in names}
    return counts


def _identity(name: str, digest: str, seed: int | None) -> str:
    """Return what identifies a source for its split: its content, or the name and seed of a named world."""
    return digest or f"{name} {seed}"


def _identities(specification: spec.Specification, source: Source) -> list[str]:
    """Return all identities of a source: one, or one for each seed of a named world."""
    seeds = specification.seeds if source.path is None else (None,)
    return [_identity(source.name, source.digest, seed) for seed in seeds]


def _axes(specification: spec.Specification, source: Source) -> tuple[Sequence[Any], ...]:
    """Return what one source is combined with: trajectories, optics, sensors and seeds; for a rig only the ends."""
    if source.entry.kind == "recordings":
        return ()
    if specification.of_rig is not None:
        return _trajectories(specification, source), specification.seeds
    prisms = [asdict(prism) for prism in specification.prisms]
    optics = [
        {"prism": prism, "rpm": rpm}
        for prism, rpm in itertools.product(prisms, specification.speeds_rpm)
    ]
    if specification.no_prism:
        optics.append({"prism": None, "rpm": None})
    sensors = [{"name": name, **asdict(sensor)} for name, sensor in specification.sensors.items()]
    return _trajectories(specification, source), optics, sensors, specification.seeds


def _recipes(
    specification: spec.Specification, source: Source, axes: Sequence[Sequence[Any]]
) -> Iterator[dict[str, Any]]:
    """Yield what determines each recording of one source."""
    entry = source.entry
    base: dict[str, Any] = {
        "source": {"kind": entry.kind, "name": source.name, "sha256": source.digest}
    }
    if specification.output is not None:
        base |= {"output": specification.output.given}
    if entry.kind == "recordings":
        yield base
        return
    if specification.of_rig is not None:
        yield from _rig_recipes(specification, base, entry, axes)
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
        recipe = base | trajectory | optic | {"sensor": sensor, "seed": seed}
        if specification.randomise:
            recipe["drawn"] = draw(specification.randomise, recipe)
        yield recipe


def _rig_recipes(
    specification: spec.Specification,
    base: Mapping[str, Any],
    entry: spec.SourceEntry,
    axes: Sequence[Sequence[Any]],
) -> Iterator[dict[str, Any]]:
    """Yield what determines each recorded rig in one world."""
    assert specification.of_rig is not None
    shared = {
        "rig": specification.of_rig.recipe,
        "duration_s": entry.duration_s or specification.duration_s,
    }
    for trajectory, seed in itertools.product(*axes):
        recipe = dict(base) | shared | trajectory | {"seed": seed}
        if specification.randomise:
            recipe["drawn"] = draw(specification.randomise, recipe)
        yield recipe


def _trajectories(specification: spec.Specification, source: Source) -> list[dict[str, Any]]:
    """Return the camera motions through a world, with the digest of a file of poses. Other sources have none."""
    if source.entry.kind == "world_files" and source.entry.trajectories is None:
        return [{"trajectory": None}]
    if source.entry.kind not in ("worlds", "world_files"):
        return [{}]
    motions = []
    for name in source.entry.trajectories or ("handheld",):
        motion = {"trajectory": name}
        if name.lower().endswith(POSE_FILES):
            motion["poses_sha256"] = content_digest(specification.folder / name)
        motions.append(motion)
    return motions


def _divided(
    specification: spec.Specification, sources: Sequence[Source]
) -> dict[str, tuple[str, str]]:
    """Return the split and the stratum of each source by its identity."""
    if specification.stratify is False:
        names = dict.fromkeys(
            same for source in sources for same in _identities(specification, source)
        )
        return {same: (_split(specification, same), "") for same in names}
    if specification.stratify is not None:
        label = specification.stratify
        with errors_name(specification.path, lambda: f"field stratify is {shown(label)}"):
            strata = _strata(specification, sources, label)
            _check_sizes(specification, strata)
        return _stratified(specification, strata)
    for label in _common_labels(sources):
        with contextlib.suppress(AmiwarpError):
            strata = _strata(specification, sources, label)
            _check_sizes(specification, strata)
            return _stratified(specification, strata)
    together = [same for source in sources for same in _identities(specification, source)]
    return _stratified(specification, {"all sources": list(dict.fromkeys(together))})


def _common_labels(sources: Sequence[Source]) -> list[str]:
    """Return the labels that all sources have, with more than one value, in the order of the first source."""
    labels = []
    for label in sources[0].labels:
        values = {source.labels.get(label) for source in sources}
        if len(values) > 1 and all(label in source.labels for source in sources):
            labels.append(label)
    return labels


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


def _strata(
    specification: spec.Specification, sources: Sequence[Source], label: str
) -> dict[str, list[str]]:
    """Return the identities of the sources of each class, which is a value of a label.

    Raises :class:`AmiwarpError` for a source without class or with two of them.
    """
    first: dict[str, Source] = {}
    strata: defaultdict[str, list[str]] = defaultdict(list)
    for source in sources:
        if label not in source.labels:
            raise AmiwarpError(f"{source.name} has no such label; add it, or remove stratify")
        for same in _identities(specification, source):
            known = first.setdefault(same, source)
            if known is source:
                strata[f"{label} = {source.labels[label]!r}"].append(same)
            elif known.labels[label] != source.labels[label]:
                raise AmiwarpError(
                    f"{known.name} and {source.name} have the same content but the labels "
                    f"{shown(known.labels[label])} and {shown(source.labels[label])}; remove one of them"
                )
    return strata


def _check_sizes(specification: spec.Specification, strata: Mapping[str, Sequence[str]]) -> None:
    """Raise :class:`AmiwarpError` for a class with fewer sources than splits."""
    names = _shares(specification)
    for stratum, members in strata.items():
        if len(members) < len(names):
            raise AmiwarpError(
                f"{stratum} has {len(members)} different sources for the {len(names)} splits "
                f"{', '.join(names)}; add sources of it, or give fewer splits"
            )


def _shares(specification: spec.Specification) -> dict[str, float]:
    """Return the shares of the splits that get sources."""
    return {name: share for name, share in specification.splits.items() if share > 0.0}


def _stratified(
    specification: spec.Specification, strata: Mapping[str, list[str]]
) -> dict[str, tuple[str, str]]:
    """Return the split and the stratum of each source by its identity, so that the splits share each stratum.

    The sources of a stratum are ordered by their hash, and this order is cut at the shares.
    """
    divided = {}
    for stratum, members in strata.items():
        ordered = sorted(members, key=partial(_draw, specification))
        names = []
        for name, count in _counts(_shares(specification), len(members)).items():
            names += [name] * count
        for same, name in zip(ordered, names, strict=True):
            divided[same] = (name, stratum)
    return divided


def _counts(shares: Mapping[str, float], total: int) -> dict[str, int]:
    """Return how many of ``total`` sources each split gets: its share, rounded.

    It is at least one, if there are as many sources as splits.
    """
    least = 1 if total >= len(shares) else 0
    exact = {name: share * total for name, share in shares.items()}
    counts = {name: max(least, math.floor(value)) for name, value in exact.items()}
    while (spare := total - sum(counts.values())) != 0:
        able = [name for name in counts if spare > 0 or counts[name] > least]
        name = max(able, key=lambda name: math.copysign(1.0, spare) * (exact[name] - counts[name]))
        counts[name] += 1 if spare > 0 else -1
    return counts
