"""Making and checking of AMI-Bench's recordings: files without ground truth, which anyone makes again."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events.other_sensors import ImageStore
from amiwarp.events.recording import EventSource, MetadataValue, Recording
from amiwarp.io.formats import open_recording
from amiwarp.io.json_files import read_json
from amiwarp.io.native.copying import save_recording
from amiwarp.io.output_formats import make_folder
from amiwarp.io.outputs import write_text
from amiwarp.studies.bench.specification import FRAMES, PLAIN, PRISM, VERSION, Entry
from amiwarp.studies.bench.submission import UNITS
from amiwarp.tasks import Progress, part, silent

CHECKSUMS = Path(__file__).with_name("checksums-1.0.json")
"""Checksums of the small set."""
INDEX = "bench.json"
"""Name of the file that describes a folder of recordings."""
COLUMNS = {"x": "<u2", "y": "<u2", "t": "<i8", "p": "|u1"}
"""Arrays of events as a checksum takes them, one after the other."""


@dataclass(frozen=True)
class Made:
    """What was made of a set of recordings."""

    made: list[str]
    """Names of the recordings that were simulated."""
    kept: list[str]
    """Names of the recordings that were there."""
    equal: list[str]
    """Files whose checksum is the one that the package states."""
    different: list[str]
    """Files whose checksum is another one than the package states."""
    unknown: list[str]
    """Files of which the package states none."""


def make_recordings(
    folder: Path, entries: Sequence[Entry], device: str, progress: Progress = silent
) -> Made:
    """Make the recordings that a folder lacks, and compare the checksums of all with those in the package.

    Raises :class:`AmiwarpError` if the folder cannot be written.
    """
    for name in ("", PRISM, PLAIN):
        make_folder(folder / name)
    stated = stated_checksums()
    outcome = Made([], [], [], [], [])
    for place, entry in enumerate(entries):
        advance = part(progress, place / len(entries), (place + 1) / len(entries))
        if all(path.exists() for path in files_of(folder, entry).values()):
            outcome.kept.append(entry.name)
        else:
            _simulate(folder, entry, device, advance)
            outcome.made.append(entry.name)
        for name, digest in checksums(folder, entry).items():
            expected = stated.get(entry.set_name, {}).get(name)
            if expected is None:
                outcome.unknown.append(name)
            elif expected == digest:
                outcome.equal.append(name)
            else:
                outcome.different.append(name)
    _write_index(folder / INDEX, entries)
    return outcome


def files_of(folder: Path, entry: Entry) -> dict[str, Path]:
    """Return the files of a recording, by camera; the plain camera's also holds the frames."""
    return {camera: folder / camera / f"{entry.name}.h5" for camera in (PRISM, PLAIN)}


def _simulate(folder: Path, entry: Entry, device: str, progress: Progress) -> None:
    """Simulate the three cameras of a recording, and write what their user would know."""
    found = entry.rig(device).run(progress=progress)
    cameras = {name: sensor.recording for name, sensor in found.sensors.items()}
    about: dict[str, MetadataValue] = {
        "benchmark": f"AMI-Bench {VERSION}",
        "duration_us": entry.duration_us,
    }
    plain = replace(cameras[PLAIN], frames=cameras[FRAMES].frames)
    files = files_of(folder, entry)
    for camera, recording in ((PRISM, cameras[PRISM]), (PLAIN, plain)):
        public = replace(recording, truth=None, metadata=about, name=entry.name)
        if not files[camera].exists():
            save_recording(files[camera], public)


def open_recordings(folder: Path, entry: Entry) -> dict[str, Recording]:
    """Return the recordings of both event cameras, by their names.

    Raises :class:`AmiwarpError` if one is missing or has another size.
    """
    opened = {}
    for camera, path in files_of(folder, entry).items():
        if not path.exists():
            raise AmiwarpError(
                f"{path}: does not exist; make it with 'amiwarp bench make {folder}'",
                ErrorCode.FILE_MISSING,
            )
        recording = open_recording(path)
        size = (entry.camera.width, entry.camera.height)
        if recording.events.size != size:
            raise AmiwarpError(
                f"{path}: has {recording.events.size} px, the recording of this name in the set {entry.set_name} "
                f"{size} px; make the set {entry.set_name} in another folder"
            )
        opened[camera] = recording
    return opened


def checksums(folder: Path, entry: Entry) -> dict[str, str]:
    """Return the checksums of a recording's events and frames, by names such as ``prism/room-rest-bright-1``."""
    opened = open_recordings(folder, entry)
    frames = opened[PLAIN].frames
    assert frames is not None
    return {
        f"{PRISM}/{entry.name}": events_checksum(opened[PRISM].events),
        f"{PLAIN}/{entry.name}": events_checksum(opened[PLAIN].events),
        f"{FRAMES}/{entry.name}": frames_checksum(frames),
    }


def events_checksum(events: EventSource) -> str:
    """Return the SHA-256 of the events: all of x and y (uint16), t (int64, us) and p (uint8), little-endian."""
    every = events.slice(0, len(events))
    digest = hashlib.sha256()
    for name, dtype in COLUMNS.items():
        digest.update(_bytes(getattr(every, name), dtype))
    return digest.hexdigest()


def frames_checksum(frames: ImageStore) -> str:
    """Return the SHA-256 of the frames: times (int64, us), then the values of each (uint16), little-endian."""
    digest = hashlib.sha256(_bytes(frames.t, "<i8"))
    for place in range(len(frames)):
        digest.update(_bytes(frames[place], "<u2"))
    return digest.hexdigest()


def _bytes(values: NDArray[Any], dtype: str) -> bytes:
    return np.ascontiguousarray(values, dtype).tobytes()


def stated_checksums() -> Mapping[str, Mapping[str, str]]:
    """Return the checksums in the package, by set and name."""
    return read_json(CHECKSUMS, "checksums of AMI-Bench", noted=False)["sets"]


def _write_index(path: Path, entries: Sequence[Entry]) -> None:
    """Write what a method must know of the recordings and of the answers."""
    recordings = []
    for entry in entries:
        recordings.append(
            {
                "name": entry.name,
                "world": entry.world,
                "speed": entry.speed,
                "light": entry.light,
                "tasks": list(entry.tasks),
                "duration_us": entry.duration_us,
                "moment_us": entry.moment_us,
                "rotation_ends_us": entry.rotation_ends_us.tolist(),
                "mounted_phase_rad": entry.mounted_phase,
            }
        )
    index = {
        "format": "ami-bench-recordings",
        "version": VERSION,
        "set": entries[0].set_name,
        "units": UNITS,
        "recordings": recordings,
    }
    write_text(path, json.dumps(index, indent=1) + "\n", overwrite=True)
