"""No command overwrites a file that it reads, under any name, or any other existing file without --force."""

import contextlib
import errno
import fcntl
import gc
import inspect
import json
import math
import os
import re
import shutil
import signal
import socket
import stat
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import is_dataclass
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, get_type_hints

import numpy as np
import pytest
from PIL import Image
from typer.models import ArgumentInfo, OptionInfo
from typer.testing import CliRunner, Result

import amiwarp
from amiwarp import (
    AmiwarpError,
    Calibration,
    Camera,
    Encoder,
    ErrorCode,
    Events,
    FrameTruth,
    Layers,
    MemoryEvents,
    Poses,
    Prism,
    Recording,
    RecordingWriter,
    convert,
    open_recording,
    save_recording,
)
from amiwarp.cli import common as cli
from amiwarp.cli.app import COMMANDS, function_of
from amiwarp.events.truth import MAPS, MemoryFrames
from amiwarp.imaging.export import IweFiles
from amiwarp.io import LiveWriter, file_access, outputs, unfinished
from amiwarp.io.inputs import register_reader
from amiwarp.io.json_files import read_json
from amiwarp.io.outputs import NewFile, check_output, only_writer, own_folder, write_text
from amiwarp.io.unfinished import remove_abandoned
from reference.calibration_sample import exact_calibration
from tests import ROOT
from tests.command_line import app
from tests.errors import refused
from tests.networks import write_network

SPECIFICATION = """
format = "amiwarp-dataset-specification"
version = 1
name = "small"
duration_s = 0.01
prisms = [{ apex_deg = 1.0 }]
speeds_rpm = [720.0]
[camera]
size = [64, 48]
fov_deg = 40.0
[[sources]]
pictures = "pictures/*.png"
"""

RIG = """
format = "amiwarp-rig-specification"
version = 1
world = "desk"
trajectory = "still"
duration_s = 0.01
[[sensors]]
name = "plain"
kind = "events"
camera = { size = [64, 48], fov_deg = 60 }
"""

SIZE = (64, 48)
CAMERA = Camera.from_fov(*SIZE, math.radians(40.0))


def run(*args: object) -> Result:
    return CliRunner().invoke(app, [str(arg) for arg in args])


def events(count: int = 2000) -> Events:
    rng = np.random.default_rng(5)
    t = np.sort(rng.integers(0, 200_000, count))
    return Events.from_arrays(
        rng.integers(0, SIZE[0], count), rng.integers(0, SIZE[1], count), t, np.arange(count) % 2
    )


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One file of each kind that a command reads."""
    folder = tmp_path_factory.mktemp("inputs")
    recording = Recording(
        MemoryEvents(events(), *SIZE),
        CAMERA,
        Encoder.constant_speed(720.0, -1000, 201_000),
        Prism(math.radians(2.0)),
    )
    save_recording(folder / "a.h5", recording)
    shutil.copy(folder / "a.h5", folder / "b.h5")
    with open_recording(folder / "a.h5").events.path.open("rb") as file:
        assert file.read(4) == b"\x89HDF"
    values = {
        "apex": math.radians(2.0),
        "index": 1.5168,
        "phase": 0.0,
        "tilt_x": 0.0,
        "tilt_y": 0.0,
    }
    exact_calibration(CAMERA, Prism(math.radians(2.0)), values).save(folder / "cal.json")
    inverse = np.full((CAMERA.height, CAMERA.width), 2.0, np.float32)
    amiwarp.DepthMap(inverse, 0.1 * inverse, np.zeros((*inverse.shape, 3), np.float32)).save(
        folder / "depth.npz"
    )
    camera = {name: getattr(CAMERA, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
    (folder / "cam.json").write_text(json.dumps(camera))
    for name in ("enc.csv", "enc2.csv"):
        (folder / name).write_text("t_us,angle_deg\n-1000,0\n100000,436.3\n201000,872.6\n")
    Image.fromarray(np.tile(np.arange(64, dtype=np.uint8) * 4, (48, 1))).save(folder / "pic.png")
    pictures = folder / "pictures"
    pictures.mkdir()
    for k in range(3):
        shutil.copy(folder / "pic.png", pictures / f"{k}.png")
    amiwarp.PixelMap(*np.ones((8, 48, 64))).save(folder / "map.npz")
    np.save(folder / "v.npy", np.zeros((4, 48, 64), np.float32))
    text = folder / "text"
    text.mkdir()
    (text / "events.txt").write_text(
        "".join(f"{k * 1e-4:.6f} {k % 64} {k % 48} {k % 2}\n" for k in range(100))
    )
    (text / "calib.txt").write_text("50 50 32 24 0 0 0 0 0\n")
    (folder / "speed.txt").write_text("0 600\n1 720\n")
    (folder / "tr.tum").write_text("0 0 0 1.5 0 0 0 1\n1 0 0 1.5 0 0 0 1\n")
    (folder / "tile.obj").write_text("v 0 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\n")
    (folder / "world.toml").write_text(
        'format = "amiwarp-world"\nversion = 1\nsky = {panorama = "pic.png"}\ncamera = {trajectory = "tr.tum"}\n'
        'bodies = [{name = "tile", mesh = "tile.obj"}]\n'
    )
    (folder / "rig.toml").write_text(RIG)
    write_network(folder / "sum.onnx")
    return folder


@pytest.fixture
def place(inputs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the inputs to work in."""
    shutil.copytree(inputs, tmp_path / "w")
    monkeypatch.chdir(tmp_path / "w")
    return tmp_path / "w"


def snapshot(folder: Path) -> dict[str, bytes]:
    return {
        str(f.relative_to(folder)): f.read_bytes()
        for f in folder.rglob("*")
        if f.is_file() and not f.is_symlink()
    }


OVER_INPUTS = (
    ("calibrate a.h5 {}", "a.h5"),
    ("calibrate a.h5 out.json --figure {}", "a.h5"),
    ("calibrate a.h5 out.json --preset cal.json --figure {}", "cal.json"),
    ("calibrate a.h5 {} --camera cam.json", "cam.json"),
    ("lens a.h5 {}", "a.h5"),
    ("lens b.h5 out.json --calibration {}", "b.h5"),
    ("lens a.h5 {} --live --fast", "a.h5"),
    ("compensate a.h5 {} --calibration cal.json", "a.h5"),
    ("compensate a.h5 {} --calibration cal.json", "cal.json"),
    ("compensate a.h5 out.h5 --calibration cal.json --iwe {}", "cal.json"),
    ("compensate a.h5 {} --calibration cal.json --preset tr.tum", "tr.tum"),
    ("compensate a.h5 {} --calibration cal.json --depth depth.npz", "depth.npz"),
    ("compensate a.h5 {} --calibration cal.json --encoder enc.csv", "enc.csv"),
    (
        "compensate a.h5 {} --calibration cal.json --encoder enc.csv --second-encoder enc2.csv",
        "enc2.csv",
    ),
    ("render a.h5 {}", "a.h5"),
    ("reconstruct a.h5 {} --calibration cal.json", "a.h5"),
    ("reconstruct a.h5 out.png --calibration cal.json --mask {}", "cal.json"),
    ("reconstruct a.h5 {} --network sum.onnx", "sum.onnx"),
    ("phase a.h5 cal.json {}", "a.h5"),
    ("phase a.h5 cal.json out.npz --figure {}", "cal.json"),
    ("pixels a.h5 cal.json {}", "a.h5"),
    ("pixels a.h5 cal.json {}", "cal.json"),
    ("depth a.h5 cal.json {}", "a.h5"),
    ("depth a.h5 cal.json out.npz --ply {}", "cal.json"),
    ("depth a.h5 cal.json out.npz --figure {}", "cal.json"),
    ("simulate {} --picture pic.png --duration 0.01", "pic.png"),
    ("simulate {} --picture pic.png --camera cam.json --duration 0.01", "cam.json"),
    ("simulate {} --picture pic.png --speed speed.txt --duration 0.01", "speed.txt"),
    ("simulate {} --picture pic.png --pixels map.npz --size 64x48 --duration 0.01", "map.npz"),
    ("simulate out.h5 --world room --camera cam.json --duration 0.01 --preview {}", "cam.json"),
    ("simulate {} --world room --trajectory tr.tum --size 64x48 --duration 0.01", "tr.tum"),
    *(
        ("simulate {} --world world.toml --size 64x48 --duration 0.01", read)
        for read in ("world.toml", "tile.obj", "pic.png", "tr.tum")
    ),
    ("simulate {} --rig rig.toml", "rig.toml"),
    ("translate v.npy {} --fps 100", "v.npy"),
    ("translate pictures {} --fps 100", "pictures/0.png"),
    ("translate pictures {} --fps 100 --camera cam.json", "cam.json"),
    ("translate pictures {} --fps 100 --speed speed.txt", "speed.txt"),
    ("translate pictures {} --fps 100 --events a.h5", "a.h5"),
    ("convert a.h5 {}", "a.h5"),
    ("filter a.h5 {} --every 2", "a.h5"),
    ("convert a.h5 {} --encoder enc.csv", "enc.csv"),
    ("convert a.h5 {} --foxglove --calibration cal.json", "cal.json"),
    ("convert a.h5 {} --encoder enc.csv --second-encoder enc2.csv", "enc2.csv"),
    ("convert a.h5 {} --camera cam.json", "cam.json"),
    ("convert text/events.txt {}", "text/calib.txt"),
    ("record a.h5 {} --fast", "a.h5"),
    ("record a.h5 {} --fast --camera cam.json", "cam.json"),
    ("live a.h5 --fast --calibration cal.json --out {}", "cal.json"),
    ("live a.h5 --fast --calibration cal.json --out {}", "a.h5"),
    ("live a.h5 --fast --calibration cal.json --record {}", "a.h5"),
    ("live a.h5 --fast --calibration cal.json --picture {}", "cal.json"),
    ("live a.h5 --fast --hot-pixels b.h5 --out {}", "b.h5"),
    ("live a.h5 --fast --undistort cam.json --out {}", "cam.json"),
    ("live a.h5 --fast --tensor count --tensor-out {}", "a.h5"),
    ("view a.h5 --screenshot {}", "a.h5"),
    ("view a.h5 --calibration cal.json --screenshot {}", "cal.json"),
    ("view a.h5 --camera cam.json --screenshot {}", "cam.json"),
    ("view a.h5 --beside b.h5 --screenshot {}", "b.h5"),
    (
        "view a.h5 --thickness-mm 10 --plate-tilt-deg 45 --depth depth.npz --screenshot {}",
        "depth.npz",
    ),
)


def path_options(name: str) -> Iterator[tuple[str, bool]]:
    """Yield the options and arguments of a command that are paths, and whether the command writes to them."""
    for key, kind in get_type_hints(function_of(name), include_extras=True).items():
        group = get_type_hints(kind, include_extras=True) if is_dataclass(kind) else {key: kind}
        for one, hint in group.items():
            marks = [mark for mark in getattr(hint, "__metadata__", ()) if isinstance(mark, str)]
            if "Path" in str(getattr(hint, "__origin__", hint)) and cli.NO_FILE not in marks:
                argument = any(isinstance(mark, ArgumentInfo) for mark in hint.__metadata__)
                option = f"--{one.replace('_', '-')}"
                for mark in hint.__metadata__:
                    # typer keeps a name that an annotation gives as its default
                    if isinstance(mark, OptionInfo) and str(mark.default).startswith("--"):
                        option = mark.default
                yield (
                    "" if argument else option,
                    bool({cli.OUTPUT, cli.OUTPUT_FOLDER, cli.OUTPUT_EITHER} & set(marks)),
                )


def options_of(line: str) -> set[tuple[str, str]]:
    """Return the command of a line with each of its options, and with "" for its arguments."""
    command, *words = line.split()
    return {(command, word) for word in words if word.startswith("--")} | {(command, "")}


def test_every_input_of_every_command_is_in_the_tables() -> None:
    """A new command or option that reads a file gets its lines in both tables."""
    over = {pair for line, _ in OVER_INPUTS for pair in options_of(line)}
    endless = {pair for line in ENDLESS for pair in options_of(line)}
    for command in COMMANDS:
        options = list(path_options(command))
        read = {(command, option) for option, writes in options if not writes}
        assert read <= endless
        if command not in (
            "bench",
            "chart",
            "dataset",
            "demo",
            "design",
            "emulate",
            "evaluate",
            "export",
            "info",
            "truth",
        ):
            assert read <= over  # these commands write to a folder, or nothing


def same_name(path: Path) -> Path:
    return path


def symlink(path: Path) -> Path:
    link = path.with_name(f"symlink{path.suffix}")
    link.symlink_to(path.name)
    return link


def hard_link(path: Path) -> Path:
    link = path.with_name(f"hardlink{path.suffix}")
    link.hardlink_to(path)
    return link


def roundabout(path: Path) -> Path:
    return path.parent / ".." / path.parent.name / path.name


WAYS = (same_name, symlink, hard_link, roundabout)
"""Ways to name a file."""


def assert_not_overwritten(place: Path, line: str, target: Path) -> None:
    before = snapshot(place)
    for more in ((), ("--force",)):
        result = run(*line.format(target).split(), *more)
        assert result.exit_code == 1, (line, target, result.output)
        expected = (
            "is read in this run|written here as"
            if more
            else "is read in this run|exists|written as|expected one of"
        )
        assert any(word in result.stderr for word in expected.split("|")), (line, result.stderr)
        assert result.stderr.count("\n") == 1
        assert snapshot(place) == before, (line, target)


@pytest.mark.parametrize(
    ("line", "read", "name"),
    [(line, read, WAYS[k % len(WAYS)]) for k, (line, read) in enumerate(OVER_INPUTS)],
    ids=lambda value: getattr(value, "__name__", value),
)
def test_no_command_writes_over_what_it_reads(
    place: Path, line: str, read: str, name: Callable[[Path], Path]
) -> None:
    """The lines take turns with the ways to name the input; --force changes nothing."""
    assert_not_overwritten(place, line, name(place / read))


@pytest.mark.parametrize("name", WAYS)
def test_no_command_writes_over_what_it_reads_under_any_name(
    place: Path, name: Callable[[Path], Path]
) -> None:
    for line, read in OVER_INPUTS:
        target = name(place / read)
        assert_not_overwritten(place, line, target)
        if target.name != Path(read).name:
            target.unlink()


@pytest.mark.parametrize(
    "line",
    [
        "calibrate a.h5 {}.json",
        "calibrate a.h5 new.json --figure {}.png",
        "compensate a.h5 {}.h5 --calibration cal.json",
        "compensate a.h5 new.h5 --calibration cal.json --iwe {}.png",
        "compensate a.h5 new.h5 --calibration cal.json --iwe {}.npy",
        "render a.h5 {}.mp4",
        "reconstruct a.h5 {}.png --calibration cal.json",
        "reconstruct a.h5 {}.png --network sum.onnx",
        "reconstruct a.h5 new.png --calibration cal.json --mask {}.png",
        "simulate {}.h5 --picture pic.png --duration 0.01",
        "translate v.npy {}.h5 --fps 100",
        "convert a.h5 {}.h5",
        "record a.h5 {}.h5 --fast",
        "live a.h5 --fast --calibration cal.json --out {}.h5",
        "live a.h5 --fast --calibration cal.json --record {}.h5",
        "live a.h5 --fast --calibration cal.json --picture {}.mp4",
        "live a.h5 --fast --tensor count --tensor-out {}.h5",
        "view a.h5 --screenshot {}.png",
        "view a.h5 --screenshot {}.pdf",
        "view a.h5 --screenshot {}.vtp",
    ],
)
def test_what_exists_is_replaced_by_force_alone(place: Path, line: str) -> None:
    words = line.format("there").split()
    there = next(Path(word) for word in words if word.startswith("there"))
    there.write_bytes(b"mine")
    before = snapshot(place)
    result = run(*words)
    assert (result.exit_code, result.stdout) == (1, ""), result.output
    assert f"{there}: exists; give another name, or --force" in result.stderr
    assert snapshot(place) == before
    if words[0] in ("convert", "compensate", "simulate", "record", "live", "render"):
        assert run(*words, "--force").exit_code == 0
        assert there.read_bytes() != b"mine"


NOT_WRITTEN = ("raw", "mcap", "jpg", "xyz", "")
"""Extensions of which a command that writes something else must not make a file."""

FOLDER = ("h5", "npz", "png", "json", "csv")
"""Extensions that folders must not have."""

NAMES: dict[tuple[str, str], tuple[str, tuple[str, ...]]] = {
    # (command, option): (command line, refused extensions)
    ("calibrate", "out"): ("calibrate a.h5 {}", ("h5", "png", *NOT_WRITTEN)),
    ("calibrate", "figure"): ("calibrate a.h5 new.json --figure {}", ("h5", "svg", *NOT_WRITTEN)),
    ("board", "out"): ("board {}", ("h5", "png", *NOT_WRITTEN)),
    ("lens", "out"): ("lens a.h5 {}", ("h5", "png", *NOT_WRITTEN)),
    ("lens", "calibration"): ("lens a.h5 new.json --calibration {}", ("h5", "yaml", *NOT_WRITTEN)),
    ("lens", "figure"): ("lens a.h5 new.json --figure {}", ("h5", "json", *NOT_WRITTEN)),
    ("compensate", "out"): ("compensate a.h5 {} --calibration cal.json", ("json", "xyz", "jpg", "")),
    ("compensate", "iwe"): ("compensate a.h5 new.h5 --calibration cal.json --iwe {}", ("h5", "tif", *NOT_WRITTEN)),
    ("filter", "out"): ("filter a.h5 {} --every 2", ("json", "xyz", "jpg", "")),
    ("convert", "out"): ("convert a.h5 {}", ("json", "xyz", "jpg", "")),
    ("live", "out"): ("live a.h5 --fast --calibration cal.json --out {}", ("npz", "txt", *NOT_WRITTEN)),
    ("live", "record"): ("live a.h5 --fast --calibration cal.json --record {}", ("npz", "txt", *NOT_WRITTEN)),
    ("live", "tensor_out"): ("live a.h5 --fast --tensor count --tensor-out {}", ("npz", "txt", *NOT_WRITTEN)),
    ("live", "picture"): ("live a.h5 --fast --calibration cal.json --picture {}", ("h5", "png", *NOT_WRITTEN)),
    ("render", "out"): ("render a.h5 {}", ("h5", "png", *NOT_WRITTEN)),
    ("reconstruct", "out"): ("reconstruct a.h5 {} --calibration cal.json", ("h5", *NOT_WRITTEN)),
    ("phase", "out"): ("phase a.h5 cal.json {}", ("h5", "npy", *NOT_WRITTEN)),
    ("phase", "figure"): ("phase a.h5 cal.json new.npz --figure {}", ("h5", "npy", *NOT_WRITTEN)),
    ("pixels", "out"): ("pixels a.h5 cal.json {}", ("h5", "npy", *NOT_WRITTEN)),
    ("depth", "out"): ("depth a.h5 cal.json {}", ("h5", "npy", *NOT_WRITTEN)),
    ("depth", "ply"): ("depth a.h5 cal.json new.npz --ply {}", ("h5", "npy", *NOT_WRITTEN)),
    ("depth", "figure"): ("depth a.h5 cal.json new.npz --figure {}", ("h5", "npy", *NOT_WRITTEN)),
    ("reconstruct", "mask"): (
        "reconstruct a.h5 new.png --calibration cal.json --mask {}", ("h5", "mp4", *NOT_WRITTEN),
    ),
    ("record", "out"): ("record a.h5 {} --fast", ("npz", "txt", *NOT_WRITTEN)),
    ("simulate", "out"): ("simulate {} --picture pic.png --duration 0.01", ("npz", "txt", *NOT_WRITTEN)),
    ("simulate", "preview"): ("simulate new.h5 --world room --duration 0.01 --preview {}", ("h5", *NOT_WRITTEN)),
    ("translate", "out"): ("translate v.npy {} --fps 100", ("npz", "txt", *NOT_WRITTEN)),
    ("view", "screenshot"): ("view a.h5 --screenshot {}", ("h5", "gif", *NOT_WRITTEN)),
    ("chart", "out"): ("chart --quick --out {}", FOLDER),
    ("dataset", "out"): ("dataset spec.toml {}", FOLDER),
    ("demo", "out"): ("demo --size 64x48 --duration 0.1 --picture pic.png --out {}", FOLDER),
    ("design", "out"): ("design --size 64x48 --apex-deg 1 --rpm 720 --out {}", FOLDER),
    ("bench", "out"): ("bench --small --methods frames --out {}", FOLDER),
    ("evaluate", "out"): ("evaluate --quick --out {}", FOLDER),
    ("export-c", "out"): ("export-c {}", FOLDER),
    ("export", "out"): ("export made {} --to webdataset", FOLDER),
    ("stability", "out"): ("stability --quick --out {}", FOLDER),
    ("truth", "out"): ("truth world.h5 {} --poses tum", FOLDER),
}  # fmt: skip
"""Every option that names a file or a folder to write. Other extensions would be false names for the content."""


def output_options() -> set[tuple[str, str]]:
    """Return command and name of every option that is marked as an output."""
    found = set()
    for command in COMMANDS:
        hints = get_type_hints(function_of(command), include_extras=True)
        for kind in [hint for hint in hints.values() if is_dataclass(hint)]:
            hints |= get_type_hints(kind, include_extras=True)
        marked = {cli.OUTPUT, cli.OUTPUT_FOLDER, cli.OUTPUT_EITHER}
        found |= {
            (command, name)
            for name, hint in hints.items()
            if marked & set(getattr(hint, "__metadata__", ()))
        }
    return found


def test_names_are_tested_of_every_output() -> None:
    assert output_options() == set(NAMES)


@pytest.fixture
def world(place: Path) -> None:
    """Add a recording with true poses, and the specification of a data set."""
    with RecordingWriter(place / "world.h5", width=64, height=48) as writer:
        writer.append(events())
        writer.append_poses(Poses(np.array([0, 1000]), np.tile([0.0, 0, 0, 0, 0, 0, 1], (2, 1))))
    (place / "spec.toml").write_text(SPECIFICATION)


@pytest.mark.usefixtures("world")
@pytest.mark.parametrize("option", NAMES, ids=" ".join)
def test_commands_refuse_a_name_that_means_another_format(
    place: Path, option: tuple[str, str]
) -> None:
    line, endings = NAMES[option]
    before = sorted(place.rglob("*"))
    for ending in endings:
        name = f"false.{ending}".removesuffix(".")
        result = run(*line.format(name).split())
        assert (result.exit_code, result.stdout) == (1, ""), (name, result.output)
        refusal = result.stderr.strip().splitlines()[-1]
        folder = NAMES[option][1] is FOLDER
        remedy = (
            "give the name of a folder"
            if folder
            else "give a name that ends in|amiwarp convert|choose among"
        )
        assert re.search(rf"{re.escape(name)}: .*({remedy})", refusal), (name, refusal)
        assert sorted(place.rglob("*")) == before


def test_commands_that_write_native_recordings_name_the_conversion(place: Path) -> None:
    result = run("simulate", "s.raw", "--picture", "pic.png", "--duration", "0.01")
    assert "write s.h5, then run: amiwarp convert s.h5 s.raw" in result.stderr


DEPTHS = np.ones((3, 4)), np.ones((3, 4)), np.ones((3, 4, 3))
CALLS: dict[str, Callable[[Path, Any], object]] = {
    "Board.save": lambda path, _: amiwarp.Board(3, 4, 0.03).save(path),
    "Calibration.save": lambda path, given: given.calibration.save(path),
    "DepthMap.save": lambda path, _: amiwarp.DepthMap(*DEPTHS).save(path),
    "DepthMap.save_points": lambda path, _: amiwarp.DepthMap(*DEPTHS).save_points(path),
    "PhaseImage.save": lambda path, _: amiwarp.PhaseImage(*np.ones((5, 3, 4)), 1.0).save(path),
    "PixelMap.save": lambda path, _: amiwarp.PixelMap(*np.ones((8, 3, 4))).save(path),
    "RecordingWriter": lambda path, _: amiwarp.RecordingWriter(
        path, width=64, height=48
    ).__enter__(),
    "Simulation.write": lambda path, given: given.simulation.write(path),
    "Trajectory.save_tum": lambda path, _: amiwarp.Trajectory.still(
        [0, 0, 0], look_at=[0, 1, 0]
    ).save_tum(path),
    "compensate": lambda path, given: amiwarp.compensate(given.recording, given.calibration, path),
    "convert": lambda path, _: amiwarp.convert("a.h5", path),
    "filter_recording": lambda path, _: amiwarp.filter_recording(
        open_recording("a.h5"), path, amiwarp.EventFilter(every=2)
    ),
    "render": lambda path, given: amiwarp.render(given.recording, path),
    "save_camera": lambda path, given: amiwarp.save_camera(path, given.simulation.camera),
    "save_flow_dsec": lambda path, given: amiwarp.save_flow_dsec(path, given.frames),
    "save_flow_mvsec": lambda path, given: amiwarp.save_flow_mvsec(path, given.frames),
    "save_poses_tum": lambda path, given: amiwarp.save_poses_tum(path, given.poses),
    "save_recording": lambda path, given: amiwarp.save_recording(path, given.recording),
}
"""Every public function that can replace a file, called with a path."""


def replacing() -> set[str]:
    """Return the public functions and methods with a parameter ``overwrite``."""
    found = set()
    for name in amiwarp.PUBLIC_NAMES:
        public = getattr(amiwarp, name)
        functions = {name: public} | {
            f"{name}.{method}": function
            for method, function in (vars(public).items() if inspect.isclass(public) else ())
            if inspect.isfunction(function) and not method.startswith("_")
        }
        for key, function in functions.items():
            with contextlib.suppress(TypeError, ValueError):
                if "overwrite" in inspect.signature(function).parameters:
                    found.add(key)
    return found


def test_functions_refuse_a_name_that_means_another_format(place: Path) -> None:
    folders = {"export_dataset", "Rig.write", "RigWriter", "convert_rig", "save_rig"}
    assert replacing() - folders == set(CALLS)
    camera, prism = amiwarp.Camera.from_fov(*SIZE, 1.0), Prism(0.01)
    simulation = amiwarp.Simulation(amiwarp.Scene.from_picture("pic.png"), camera, prism, 0.01)
    maps = {name: np.zeros((3, 4, *shape), dtype) for name, (dtype, shape) in MAPS.items()}
    pose = {"rotation": np.array([0.0, 0.0, 0.0, 1.0]), "position": np.zeros(3), "joints": {}}
    instants = [FrameTruth(t_us=t, **maps, **pose) for t in (0, 1000)]
    frames = MemoryFrames(instants)
    poses = amiwarp.Poses(t=np.array([0]), camera=np.zeros((1, 7)))
    given = SimpleNamespace(
        recording=open_recording("a.h5"), calibration=Calibration.load("cal.json"), simulation=simulation,
        frames=frames, poses=poses,
    )  # fmt: skip
    before = sorted(place.rglob("*"))
    for name, call in CALLS.items():
        for ending in (".h5", ".png") if name == "save_flow_dsec" else (".jpg", ".xyz"):
            with pytest.raises(AmiwarpError, match=rf"false\{ending}: .*; (give|choose)"):
                call(Path(f"false{ending}"), given)
    assert sorted(place.rglob("*")) == before


def test_default_output_of_calibrate_is_refused_before_the_search(place: Path) -> None:
    (place / "a.calibration.json").write_text("mine")
    result = run("calibrate", "a.h5")
    assert (result.exit_code, "a.calibration.json: exists" in result.stderr) == (1, True)


def test_windows_of_events_that_exist_are_refused_before_the_work(place: Path) -> None:
    (place / "w_00001.png").write_bytes(b"mine")
    before = snapshot(place)
    line = "compensate a.h5 out.h5 --calibration cal.json --iwe w.png --iwe-window-ms 50"
    result = run(*line.split())
    assert (result.exit_code, "w_00001.png: exists" in result.stderr) == (1, True), result.stderr
    assert snapshot(place) == before
    assert run(*line.split(), "--force").exit_code == 0
    assert (place / "w_00001.png").read_bytes()[:4] == b"\x89PNG"


@pytest.mark.parametrize(
    "command", ["design --size 64x48 --apex-deg 1 --rpm 720", "chart a.h5 --quick"]
)
def test_folders_keep_what_they_hold(place: Path, command: str) -> None:
    file = place / ("design.csv" if "design" in command else "chart.csv")
    file.write_bytes(b"mine")
    result = run(*command.split(), "--out", ".")
    assert result.exit_code == 1, result.output
    assert file.read_bytes() == b"mine"


def test_demo_replaces_its_own_folder_alone(place: Path) -> None:
    (place / "mine").mkdir()
    (place / "mine" / "recording.h5").write_bytes(b"mine")
    result = run(
        "demo", "--out", "mine", "--size", "64x48", "--duration", "0.1", "--picture", "pic.png"
    )
    assert (result.exit_code, "recording.h5: exists" in result.stderr) == (1, True), result.stderr
    assert (place / "mine" / "recording.h5").read_bytes() == b"mine"
    with own_folder(place / "mine"):
        write_text(place / "mine" / "recording.h5", "new")
    assert (place / "mine" / "recording.h5").read_text() == "new"


@pytest.mark.parametrize(
    "line",
    [
        "live a.h5 --fast --calibration cal.json --out x.h5 --record x.h5",
        "live a.h5 --fast --calibration cal.json --out x.h5 --record ./y/../x.h5",
        "compensate a.h5 x.png --calibration cal.json --iwe x.png",
        "calibrate a.h5 x.png --figure x.png",
    ],
)
def test_one_name_for_two_outputs_is_refused(place: Path, line: str) -> None:
    (place / "y").mkdir()
    before = snapshot(place)
    for more in ((), ("--force",)):
        result = run(*line.split(), *more)
        assert (result.exit_code, "is given for two outputs" in result.stderr) == (1, True), (
            result.output
        )
        assert snapshot(place) == before


def special(kind: str, path: Path) -> Path:
    if kind == "named pipe (FIFO)":
        os.mkfifo(path)
    elif kind == "socket":
        with socket.socket(socket.AF_UNIX) as server:
            server.bind(path.name)
    elif kind == "folder":
        path.mkdir()
    else:
        return Path("/dev/null")
    return path


@pytest.mark.parametrize("kind", ["named pipe (FIFO)", "socket", "folder", "character device"])
@pytest.mark.parametrize("line", ["convert a.h5 {}", "calibrate a.h5 {}", "record a.h5 {} --fast",
                                  "compensate a.h5 x.h5 --calibration cal.json --iwe {}"])  # fmt: skip
def test_outputs_that_are_no_files_are_refused(place: Path, kind: str, line: str) -> None:
    path = special(kind, place / "thing.png")
    mode = stat.S_IFMT(os.stat(path).st_mode)
    for more in ((), ("--force",)):
        result = run(*line.format(path).split(), *more)
        assert (result.exit_code, f"is a {kind}; give the name of a file" in result.stderr) == (
            1,
            True,
        ), result.output
    assert stat.S_IFMT(os.stat(path).st_mode) == mode


ENDLESS = (
    "info {}",
    "convert {} out.h5",
    "filter {} out.h5 --every 2",
    "convert a.h5 out.h5 --encoder {}",
    "convert a.h5 out.h5 --encoder enc.csv --second-encoder {}",
    "convert a.h5 out.h5 --camera {}.json",
    "convert a.h5 out.mcap --foxglove --calibration {}",
    "convert a.h5 out.h5 --camera {}.txt",
    "convert a.h5 out.h5 --camera {}.yaml",
    "calibrate {} out.json",
    "calibrate a.h5 out.json --preset {}",
    "lens a.h5 {} out.json",
    "lens {} out.json --live",
    "compensate {} out.h5 --calibration cal.json",
    "compensate a.h5 out.h5 --calibration {}",
    "compensate a.h5 out.h5 --calibration cal.json --preset {}",
    "compensate a.h5 out.h5 --calibration cal.json --depth {}",
    "compensate a.h5 out.h5 --calibration cal.json --encoder {}",
    "compensate a.h5 out.h5 --calibration cal.json --encoder enc.csv --second-encoder {}",
    "render {} out.mp4",
    "reconstruct {} out.png --calibration cal.json",
    "reconstruct a.h5 out.png --calibration {}",
    "reconstruct a.h5 out.png --network {}.onnx",
    "simulate out.h5 --picture {}",
    "phase {} cal.json out.npz",
    "phase a.h5 {} out.npz",
    "pixels {} cal.json out.npz",
    "pixels a.h5 {} out.npz",
    "depth {} cal.json out.npz",
    "depth a.h5 {} out.npz",
    "simulate out.h5 --picture pic.png --speed {}",
    "simulate out.h5 --picture pic.png --pixels {}",
    "translate {} out.h5 --fps 100",
    "translate {}.npy out.h5 --fps 100",
    "record {} out.h5 --fast",
    "live {} --calibration cal.json --out out.h5",
    "live a.h5 --calibration {} --out out.h5",
    "live a.h5 --fast --hot-pixels {} --out out.h5",
    "live a.h5 --fast --undistort {}.json --out out.h5",
    "view {} --screenshot out.png",
    "view a.h5 --calibration {} --screenshot out.png",
    "demo --out out --picture {}",
    "design --out out --picture {}",
    "chart {} --out out --quick",
    "chart a.h5 --out out --quick --picture {}",
    "compensate a.h5 out.h5 --preset {} --calibration cal.json",
    "dataset {}.toml out",
    "export {} out --to parquet",
    "design --out out --camera {}.json --apex-deg 1 --rpm 720",
    "emulate --link link --camera unix:camera --recording {}",
    "bench run frames --out out --data {}",
    "bench score mine --truth {}",
    "evaluate --out out --recording {}",
    "record a.h5 out.h5 --fast --camera {}.json",
    "simulate out --rig {}.toml",
    "simulate out.h5 --world {}.toml",
    "simulate out.h5 --world room --trajectory {}.tum",
    "simulate out.h5 --picture pic.png --camera {}.json",
    "translate pictures out.h5 --fps 100 --events {}",
    "translate pictures out.h5 --fps 100 --speed {}",
    "translate pictures out.h5 --fps 100 --camera {}.txt",
    "calibrate a.h5 out.json --camera {}.json",
    "truth {} out --flow dsec",
    "view a.h5 --camera {}.json --screenshot out.png",
    "view a.h5 --beside {} --screenshot out.png",
    "view a.h5 --thickness-mm 10 --plate-tilt-deg 45 --depth {} --screenshot out.png",
)


@pytest.mark.parametrize("line", ENDLESS)
def test_inputs_that_never_end_are_refused(place: Path, line: str) -> None:
    name = next(word for word in line.split() if "{}" in word).format("pipe")
    os.mkfifo(place / name)
    result = run(*line.format("pipe").split())
    assert result.exit_code == 1, result.output
    assert f"{name}: is a named pipe (FIFO); give a regular file" in result.stderr
    assert not any(f.name.startswith("out.") for f in place.iterdir())


def test_an_interrupted_command_leaves_no_empty_folder(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: object, **more: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("amiwarp.studies.design.design", interrupted)
    (place / "mine").mkdir()
    for out in ("new/inner", "mine", "mine/inner"):
        result = run("design", "--size", "64x48", "--fov-deg", "60", "--out", out)
        assert result.exit_code == 130, result.output
    assert not (place / "new").exists()
    assert list((place / "mine").iterdir()) == []


@pytest.mark.parametrize(
    "line",
    [
        "convert {}.h5 b.h5",
        "info {}.h5",
        "info {}/a.h5",
        "convert a.h5 {}.h5",
        "convert a.h5 {}/b.h5",
        "record a.h5 {}.h5 --fast",
        "record a.h5 {}/b.h5 --fast",
        "design --size 64x48 --apex-deg 1 --rpm 720 --out {}",
        "dataset a.toml {}",
        "export {} b --to dsec",
        "export . {} --to dsec",
    ],
)
def test_names_that_are_too_long_are_refused_at_once(place: Path, line: str) -> None:
    before = snapshot(place)
    result = run(*line.format("é" * 130).split())
    assert result.exit_code == 1, result.stderr
    assert re.search(r"has 26\d bytes; the limit is 255; give a shorter name", result.stderr), (
        result.stderr
    )
    assert snapshot(place) == before


def test_the_longest_names_can_be_written(place: Path) -> None:
    """The names of unfinished files are longer than those of files."""
    for name in ("n" * 252 + ".h5", "é" * 126 + ".h5"):
        assert run("convert", "a.h5", name).exit_code == 0
        assert (place / name).is_file()
    live = "n" * 247
    assert run("record", "a.h5", f"{live}.h5", "--fast").exit_code == 0
    result = run("record", "a.h5", f"{live}n.h5", "--fast")
    assert result.exit_code == 1
    assert re.search(r"\.part\.h5: the name .* has 256 bytes; the limit is 255", result.stderr), (
        result.stderr
    )
    assert not list(place.glob(".*.part"))


def test_file_systems_may_have_shorter_names(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "pathconf", lambda path, name: 143, raising=False)
    check_output(tmp_path / ("n" * 143))
    with pytest.raises(AmiwarpError, match="has 144 bytes; the limit is 143"):
        check_output(tmp_path / ("n" * 144))


@pytest.mark.parametrize(
    "line",
    [
        "dataset s.toml {}",
        "evaluate --quick --out {}",
        "stability --quick --out {}",
        "stability --redraw --out {}",
    ],
)
def test_two_commands_do_not_continue_the_results_in_one_folder(place: Path, line: str) -> None:
    (place / "one.pgm").write_text("P2 4 2 255 0 255 0 255 255 0 255 0")
    (place / "s.toml").write_text("""
        format = "amiwarp-dataset-specification"
        version = 1
        duration_s = 0.002
        camera = {size = [16, 12]}
        prisms = [{apex_deg = 1.0}]
        speeds_rpm = [720.0]
        sources = [{pictures = "one.pgm"}]
    """)
    (place / "results").mkdir()
    with only_writer(place / "results"):
        result = run(*line.format("results").split())
        assert result.exit_code == 1, result.stderr
        assert (
            "amiwarp: results: another command writes its results to this folder; wait"
            in result.stderr
        )
        with pytest.raises(AmiwarpError, match="another command"), only_writer(place / "results"):
            pass
        with only_writer(place):  # another folder
            pass
    assert not [path for path in (place / "results").rglob("*") if path.is_file()]
    with only_writer(place / "results"):  # it is free again
        pass
    if line.startswith("dataset"):
        assert run(*line.format("results").split()).exit_code == 0


def test_a_folder_without_locks_can_be_written_to(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def no_locks(*_: object) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", no_locks)
    with only_writer(tmp_path), only_writer(tmp_path):
        pass


@pytest.mark.parametrize(
    "line",
    [
        "compensate a.h5 first.h5 --calibration cal.json --iwe {}/i.png",
        "compensate a.h5 {}/b.h5 --calibration cal.json --iwe i.png",
        "live a.h5 --fast --calibration cal.json --record r.h5 --out {}/o.h5",
    ],
)
def test_a_folder_that_takes_no_files_is_found_before_the_first_output(
    place: Path, monkeypatch: pytest.MonkeyPatch, line: str
) -> None:
    """Only an attempt shows it, for example on a network drive."""
    (place / "full").mkdir()
    before, take = snapshot(place), unfinished._take_lock

    def refused(folder: Path) -> Any:
        if folder.name == "full":
            raise OSError(errno.EROFS, "Read-only file system")
        return take(folder)

    monkeypatch.setattr(unfinished, "_take_lock", refused)
    result = run(*line.format("full").split())
    assert result.exit_code == 1, result.stderr
    assert re.search(
        r"amiwarp: full/\w\.\w+: cannot be written: Read-only file system; choose", result.stderr
    )
    assert snapshot(place) == before


@pytest.mark.parametrize(
    "second", ["--out b.h5", "--to unix:no/socket", "--raw-to tcp:256.0.0.1:5000"]
)
def test_a_second_output_that_cannot_be_made_leaves_no_first_one(place: Path, second: str) -> None:
    (place / "b.part.h5").touch()  # as if another command writes b.h5
    before = snapshot(place)
    result = run(*f"live a.h5 --fast --calibration cal.json --record first.h5 {second}".split())
    assert result.exit_code == 1, result.stderr
    assert snapshot(place) == before


@pytest.mark.parametrize("exists", [True, False])
@pytest.mark.parametrize("writer", ["convert", "record"])
def test_a_symbolic_link_is_followed(place: Path, exists: bool, writer: str) -> None:
    (place / "real").mkdir()
    real, link = place / "real" / "out.h5", place / "out.h5"
    link.symlink_to(real)
    if exists:
        real.write_bytes(b"mine")
        assert run(writer, "a.h5", link, *(["--fast"] if writer == "record" else [])).exit_code == 1
        assert real.read_bytes() == b"mine"
    result = run(writer, "a.h5", link, "--force", *(["--fast"] if writer == "record" else []))
    assert result.exit_code == 0, result.output
    assert link.is_symlink()
    assert [f.name for f in real.parent.iterdir()] == ["out.h5"]
    assert len(open_recording(real).events) == 2000


def test_a_loop_of_links_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a").symlink_to("b")
    (tmp_path / "b").symlink_to("a")
    with pytest.raises(AmiwarpError, match="cannot be written"):
        check_output(tmp_path / "a")


def test_a_file_that_appears_meanwhile_is_kept(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    new = NewFile(path)
    new.part.write_text("ours")
    path.write_text("theirs")
    with refused(ErrorCode.OUTPUT_EXISTS), new:
        pass
    assert path.read_text() == "theirs"
    assert os.listdir(tmp_path) == ["a.txt"]


def test_a_file_that_appears_in_the_last_moment_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The file appears between the last check and the rename. The rename itself replaces nothing."""
    path = tmp_path / "a.txt"
    seen = outputs.check_output

    def late(target: Path, **options: Any) -> Path:
        found = seen(target, **options)
        path.write_text("theirs")
        return found

    new = NewFile(path)
    new.part.write_text("ours")
    monkeypatch.setattr(outputs, "check_output", late)
    with pytest.raises(AmiwarpError, match="another program"), new:
        pass
    assert path.read_text() == "theirs"


def test_an_interrupt_while_the_lock_is_taken_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The lock file exists by then, but the process does not know of it yet."""
    taken = unfinished._lock

    def interrupted(file: Any) -> bool | None:
        signal.raise_signal(signal.SIGINT)
        return taken(file)

    handler = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        monkeypatch.setattr(unfinished, "_lock", interrupted)
        with pytest.raises(KeyboardInterrupt), outputs.protecting_files([], [], overwrite=False):
            NewFile(tmp_path / "a.txt")
    finally:
        signal.signal(signal.SIGINT, handler)
    assert os.listdir(tmp_path) == []


def test_disks_without_hard_links(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def link(*_: object) -> None:
        raise PermissionError

    monkeypatch.setattr(os, "link", link)
    write_text(tmp_path / "a.txt", "new")
    assert {f.name: f.read_text() for f in tmp_path.iterdir()} == {"a.txt": "new"}


def test_a_replaced_file_keeps_who_may_read_it(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_text("old")
    path.chmod(0o640)
    write_text(path, "new", overwrite=True)
    assert (path.read_text(), stat.S_IMODE(path.stat().st_mode)) == ("new", 0o640)


WRITER = """
import os, sys
from amiwarp.io.outputs import NewFile
from amiwarp.io.unfinished import scratch_folder
os.getpid = lambda: int(sys.argv[1])  # a number in another namespace, or on another machine
new = NewFile("a.txt")
new.part.write_text("half")
with scratch_folder(new.part.parent) as scratch:
    (scratch / "b.txt").write_text("half")
    if len(sys.argv) > 2 and os.fork():
        os._exit(0)  # leaves the descriptor of the lock to the child
    print(flush=True)
    sys.stdin.read()
    if len(sys.argv) == 2:
        new.part.write_text("whole")
        new.commit()
        (scratch / "b.txt").read_text()
"""


@pytest.fixture
def dead_pid() -> int:
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    return process.pid


def start_writer(folder: Path, *words: object) -> subprocess.Popen[str]:
    """Start a process that has an unfinished file and a scratch folder, and goes on at the end of its input."""
    line = [sys.executable, "-c", WRITER, *map(str, words)]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    process = subprocess.Popen(line, cwd=folder, env=environment(), text=True, **pipes)  # type: ignore[call-overload]
    assert process.stdout.readline() == "\n"
    return process


def clean(folder: Path) -> set[str]:
    """Write a file as the next run would, and return the names of all files but this one."""
    remove_abandoned.cache_clear()
    write_text(folder / "new.txt", "", overwrite=True)
    return set(os.listdir(folder)) - {"new.txt"}


def test_what_another_process_writes_is_kept_whatever_its_number(
    tmp_path: Path, dead_pid: int
) -> None:
    """In a container, or on another machine with the same name, the number of a process means nothing."""
    with start_writer(tmp_path, dead_pid) as writer:
        before = set(os.listdir(tmp_path))
        assert clean(tmp_path) == before
        assert len(before) == 3
        writer.communicate("")
    assert writer.returncode == 0
    assert clean(tmp_path) == {"a.txt"}
    assert (tmp_path / "a.txt").read_text() == "whole"


@pytest.mark.skipif(shutil.which("unshare") is None, reason="needs unshare")
def test_what_a_process_in_a_container_writes_is_kept(tmp_path: Path) -> None:
    line = [
        "unshare",
        "--user",
        "--map-root-user",
        "--pid",
        "--fork",
        "--mount-proc",
        sys.executable,
        "-c",
    ]
    if subprocess.run([*line, ""], check=False, capture_output=True).returncode:
        pytest.skip("may not make a namespace")
    script = WRITER.replace("os.getpid = lambda: int(sys.argv[1])", "assert os.getpid() == 1")
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with subprocess.Popen(
        [*line, script, "0"], cwd=tmp_path, env=environment(), text=True, **pipes
    ) as writer:
        assert writer.stdout.readline() == "\n"
        before = set(os.listdir(tmp_path))
        assert clean(tmp_path) == before
        assert len(before) == 3
        writer.communicate("")
    assert clean(tmp_path) == {"a.txt"}


@pytest.mark.parametrize("fork", [False, True])
def test_what_a_killed_run_left_is_removed_by_the_next(
    tmp_path: Path, dead_pid: int, fork: bool
) -> None:
    """If the run has forked, when both processes have ended."""
    with start_writer(tmp_path, os.getppid(), *["fork"] * fork) as writer:
        if fork:
            writer.wait()
            assert len(clean(tmp_path)) == 3
            writer.stdin.close()
            writer.stdout.read()  # until the child has ended
        else:
            writer.kill()
    assert clean(tmp_path) == set()


def test_what_may_still_be_written_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Files of another system or without a lock file, and all files if the file system has no locks."""
    with start_writer(tmp_path, 1) as writer:
        writer.kill()
    left = set(os.listdir(tmp_path))
    system = unfinished._system()
    keep = {f".a.h5.{system}-00c0ffee-00c0ffee.part", ".a.h5.0123456789ab-00c0ffee-00c0ffee.part",
            ".0123456789ab-00c0ffee.part", ".part", "a.part", ".a.h5.part"}  # fmt: skip
    for name in keep:
        (tmp_path / name).write_bytes(b"")

    def unknown(*_: object) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    with monkeypatch.context() as patched:
        patched.setattr(fcntl, "flock", unknown)
        assert clean(tmp_path) == keep | left
    assert clean(tmp_path) == keep


def test_sigkill_leaves_nothing_after_the_next_run(tmp_path: Path) -> None:
    script = (
        "import os, signal, sys; from pathlib import Path; from amiwarp.io.outputs import NewFile\n"
        "new = NewFile(Path(sys.argv[1])); new.part.write_text('half'); os.kill(os.getpid(), signal.SIGKILL)"
    )
    done = subprocess.run(
        [sys.executable, "-c", script, tmp_path / "a.txt"], env=environment(), check=False
    )
    assert done.returncode == -9
    assert [name.endswith(".part") for name in os.listdir(tmp_path)] == [True, True]
    remove_abandoned.cache_clear()
    write_text(tmp_path / "a.txt", "whole")
    assert os.listdir(tmp_path) == ["a.txt"]


def environment() -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": str(ROOT)}


def test_api_calls_guard_what_they_read(place: Path) -> None:
    recording = open_recording("a.h5")
    before = snapshot(place)
    calibration = Calibration.load("cal.json")
    from amiwarp import compensate

    for write in (
        lambda: compensate(recording, calibration, "a.h5", overwrite=True),
        lambda: save_recording("a.h5", recording, overwrite=True),
        lambda: convert("a.h5", "a.h5", overwrite=True),
    ):
        with pytest.raises(AmiwarpError, match="is read in this run"):
            write()
    with pytest.raises(AmiwarpError, match=r"a\.h5: calibrations are written as \.json"):
        calibration.save("a.h5", overwrite=True)
    for write in (
        lambda: compensate(recording, calibration, "cal.json"),
        lambda: convert("a.h5", "cal.json"),
        lambda: calibration.save("cal.json"),
    ):
        with pytest.raises(AmiwarpError, match=r"cal\.json: exists"):
            write()
    assert snapshot(place) == before
    calibration.save("cal.json", overwrite=True)
    assert snapshot(place) == before


def test_a_source_that_is_no_longer_in_use_guards_nothing(tmp_path: Path) -> None:
    (tmp_path / "a.npz").write_bytes(b"")
    kept = type("Source", (), {})()
    kept.itself = kept
    register_reader(kept, tmp_path / "a.npz")
    with pytest.raises(AmiwarpError, match="is read in this run"):
        write_text(tmp_path / "a.npz", "", overwrite=True)
    del kept
    gc.disable()  # it is now only in a cycle
    try:
        write_text(tmp_path / "a.npz", "{}", overwrite=True)
    finally:
        gc.enable()
    assert (tmp_path / "a.npz").read_text() == "{}"


def test_files_in_a_folder_that_is_read_are_inputs(tmp_path: Path) -> None:
    np.save(tmp_path / "dataset_events_t.npy", np.linspace(0.0, 1.0, 50))
    np.save(tmp_path / "dataset_events_xy.npy", np.zeros((50, 2), np.uint16))
    np.save(tmp_path / "dataset_events_p.npy", np.zeros(50, np.uint8))
    recording = open_recording(tmp_path)
    with pytest.raises(AmiwarpError, match="is read in this run"):
        write_text(tmp_path / "dataset_events_p.npy", "", overwrite=True)
    assert len(recording.events) == 50


def test_a_command_may_replace_what_it_has_written_and_read(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    with outputs.protecting_files((), (), overwrite=True):
        write_text(path, "{}")
        assert read_json(path, "test") == {}
        write_text(path, '{"second": 2}')
    with outputs.protecting_files((), (), overwrite=True):
        assert read_json(path, "test") == {"second": 2}
        with pytest.raises(AmiwarpError, match="is read in this run"):
            write_text(path, "{}")


def writers(path: Path) -> Iterator[Any]:
    yield RecordingWriter(path, width=SIZE[0], height=SIZE[1])
    yield LiveWriter(path, width=SIZE[0], height=SIZE[1])


def test_a_recording_that_appears_while_one_is_written_is_kept(tmp_path: Path) -> None:
    def write(writer: Any) -> None:
        with writer:
            writer.append(events())
            (tmp_path / "a.h5").write_bytes(b"theirs")

    for k, writer in enumerate(writers(tmp_path / "a.h5")):
        with pytest.raises(AmiwarpError, match=r"a\.h5: exists"):
            write(writer)
        assert (tmp_path / "a.h5").read_bytes() == b"theirs"
        (tmp_path / "a.h5").unlink()
        # a live recording is kept
        assert os.listdir(tmp_path) == ([] if k == 0 else ["a.part.h5"])
    assert len(open_recording(tmp_path / "a.part.h5").events) == 2000


FULL = """
import resource, sys
from pathlib import Path
import numpy as np
from amiwarp.errors import AmiwarpError
from amiwarp.reconstruction.picture_files import save_grey
from amiwarp.imaging.export import save_png
resource.setrlimit(resource.RLIMIT_FSIZE, (2000, 2000))
noise = np.random.default_rng(0).random((60, 80), np.float32)
for write, name in (
    (lambda p: save_grey(noise, p, bits=16), "a.tif"),
    (lambda p: save_grey(noise, p, bits=16), "a.png"),
    (lambda p: save_png(p, np.uint8(255 * noise)), "b.png"),
):
    try:
        write(Path(sys.argv[1], name))
    except AmiwarpError as error:
        print(error)
"""


def test_pictures_on_a_full_disk(tmp_path: Path) -> None:
    """Pillow itself reports no error for a partly written TIFF."""
    words = [sys.executable, "-c", FULL, tmp_path]
    done = subprocess.run(words, env=environment(), capture_output=True, text=True, check=True)
    failed = [
        line.partition(": cannot be written: File too large")[0]
        for line in done.stdout.splitlines()
    ]
    assert failed == [str(tmp_path / name) for name in ("a.tif", "a.png", "b.png")]
    assert os.listdir(tmp_path) == []


def test_a_stack_of_images_takes_its_room_on_the_disk_first(tmp_path: Path) -> None:
    """If the disk has no room for a page of a memory-mapped file, the system ends the process."""
    source = MemoryEvents(events(), *SIZE)
    with IweFiles(
        [tmp_path / "a.npy"], source, window_us=10_000, layers=Layers.MERGED, device="cpu"
    ) as files:
        files.add(compensated(events()))
        (part,) = tmp_path.glob(".a.npy.*.part")
        found = part.stat()
        assert found.st_blocks * 512 >= found.st_size > 20 * 4 * SIZE[0] * SIZE[1]


def test_every_image_of_a_window_is_checked_before_the_first(tmp_path: Path) -> None:
    source = MemoryEvents(events(), *SIZE)
    (tmp_path / "a_00002.png").write_bytes(b"mine")
    for paths, message in (
        (["a.png"], r"a_00002\.png: exists"),
        (["a.npy", "a.png"], r"a_00002\.png: exists"),
    ):
        with pytest.raises(AmiwarpError, match=message):
            IweFiles(
                [tmp_path / p for p in paths],
                source,
                window_us=10_000,
                layers=Layers.MERGED,
                device="cpu",
            )
    IweFiles([tmp_path / "a.npy"], source, window_us=10_000, layers=Layers.MERGED, device="cpu")
    IweFiles([tmp_path / "a.png"], source, window_us=None, layers=Layers.MERGED, device="cpu")


def test_the_image_of_the_only_window_is_checked(tmp_path: Path) -> None:
    source = MemoryEvents(events(), *SIZE)
    one = partial(
        IweFiles,
        [tmp_path / "a.png"],
        source,
        window_us=1 << 40,
        layers=Layers.MERGED,
        device="cpu",
    )
    (tmp_path / "a.png").write_bytes(b"mine")
    with one() as files:
        files.add(compensated(events()))
    assert files.written == [tmp_path / "a_00000.png"]
    with pytest.raises(AmiwarpError, match=r"a_00000\.png: exists"):
        one()


@pytest.mark.parametrize(
    "number", [errno.EINVAL, errno.ENOSYS, errno.EOPNOTSUPP, errno.ENOSPC, errno.EFBIG]
)
def test_only_a_full_disk_refuses_to_reserve_space(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    """A file system that cannot reserve space is used without."""

    def refuse(handle: int, start: int, count: int) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(os, "posix_fallocate", refuse)
    with (tmp_path / "a").open("wb") as file:
        if number in (errno.ENOSPC, errno.EFBIG):
            with pytest.raises(OSError, match=os.strerror(number)):
                file_access.allocate(file.fileno(), 0, 100)
        else:
            file_access.allocate(file.fileno(), 0, 100)


def compensated(given: Events) -> Events:
    return Events(given.x.astype(np.float32), given.y.astype(np.float32), given.t, given.p)


def test_a_scratch_folder_whose_removal_is_interrupted_goes_with_the_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def use() -> None:
        with (
            outputs.protecting_files((), (), overwrite=False),
            unfinished.scratch_folder(tmp_path) as scratch,
        ):
            (scratch / "big").write_bytes(b"x")
            monkeypatch.setattr(outputs.shutil, "rmtree", interrupted)

    def interrupted(path: Path) -> None:
        monkeypatch.undo()
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        use()
    assert os.listdir(tmp_path) == []
