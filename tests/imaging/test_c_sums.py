"""Sums in phase as C: it builds with strict warnings, equals amiwarp in every bit, and its test finds defects."""

import ctypes
import json
import math
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from typer.testing import CliRunner, Result

import amiwarp
from tests.command_line import app

NAMES = {"README.md", "phase_sums.c", "phase_sums.h", "test_phase_sums.c"}
WARNINGS = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-Wconversion"]
SANITIZE = ["-fsanitize=address,undefined", "-fno-sanitize-recover=all"]

needs_gcc = pytest.mark.skipif(shutil.which("gcc") is None, reason="needs gcc")


def run(*args: object) -> Result:
    return CliRunner().invoke(app, [str(arg) for arg in args])


def export(folder: Path, *args: object) -> Path:
    """Run the command, and return the folder."""
    result = run("export-c", folder, *args)
    assert result.exit_code == 0, result.output
    return folder


def status_of_test(folder: Path, *more: str) -> int:
    """Build the test of the C, and return the status with which it ends."""
    sources = [folder / "phase_sums.c", folder / "test_phase_sums.c"]
    subprocess.run(["gcc", *WARNINGS, *more, "-O1", "-o", folder / "test", *sources], check=True)
    return subprocess.run([folder / "test"], timeout=60).returncode


@needs_gcc
@pytest.mark.parametrize(
    "options",
    [
        "--size 32x32 --harmonics 5",
        "--size 1x1 --harmonics 1 --bins 3",
        "--size 7x3 --bins 100 --off-ratio 1.3 --seed 4",
        "--size 2x9 --harmonics 20 --bins 1024 --off-ratio 0.1",
        "--size 3x2 --harmonics 2 --off-ratio 10",
    ],
)
def test_the_c_builds_without_warnings_and_its_test_passes(tmp_path: Path, options: str) -> None:
    folder = export(tmp_path / "sums", *options.split())
    assert {path.name for path in folder.iterdir()} == NAMES
    assert status_of_test(folder, *SANITIZE) == 0


DEFECTS = {
    "bin": (">> 16", ">> 17"),
    "polarity": ("polarity ? PHASE_BINS + bin : bin", "polarity ? bin : PHASE_BINS + bin"),
    "count of polarity": ("events[is_on(row)]++", "events[!is_on(row)]++"),
    "sine": ("+= row[k + 1]", "+= row[k]"),
    "change": ("        pixel->changes++;\n", ""),
    "no change": ("is_on(pixel->last) != is_on(row)", "is_on(pixel->first) != is_on(row)"),
    "extreme of the event before": (
        "extremes[pixel->last]);\n        add",
        "extremes[row]);\n        add",
    ),
    "last": ("    pixel->last = row;\n    pixel->events", "    pixel->events"),
    "not closed": ("if (is_on(pixel->first) != is_on(pixel->last))", "if (0)"),
    "first": (
        "add_row(integers + 3, extremes[pixel->first])",
        "add_row(integers + 3, extremes[pixel->last])",
    ),
    "one too far right": ("x >= PHASE_WIDTH", "x > PHASE_WIDTH"),
    "one too far down": ("y >= PHASE_HEIGHT", "y > PHASE_HEIGHT"),
    "early limit": ("== PHASE_MOST) return", "== PHASE_MOST - 1) return"),
    "no limit": (" == PHASE_MOST) return", " > 65535u) return"),
    "clear": ("            pixel->events[1] = 0;\n", ""),
    "clear of changes": ("            pixel->changes = 0;\n", ""),
    "clear of sums": ("pixel->sums[k] = 0", "pixel->sums[0] = 0"),
    "read": ("integers[1] = pixel->events[1]", "integers[1] = pixel->events[0]"),
    "table": ("{4091, 201,", "{4091, 202,"),
    "pixel": ("&sums->pixels[y][x];\n    if", "&sums->pixels[x][y];\n    if"),
}
"""Defects of phase_sums.c: what stands there, and what instead."""


@needs_gcc
@pytest.mark.parametrize("name", DEFECTS)
def test_its_test_finds_a_defect(tmp_path: Path, name: str) -> None:
    folder = export(tmp_path / "sums", "--size", "12x12", "--harmonics", 2)
    right, wrong = DEFECTS[name]
    file = folder / "phase_sums.c"
    text = file.read_text()
    assert right in text
    file.write_text(text.replace(right, wrong, 1))
    assert status_of_test(folder, "-Wno-type-limits") != 0


class BuiltSums:
    """The exported C as a library."""

    def __init__(self, folder: Path, width: int, height: int, harmonics: int) -> None:
        library = folder / "sums.so"
        source = folder / "phase_sums.c"
        shared = ["-O2", "-shared", "-fPIC", "-o", library, source]
        subprocess.run(["gcc", *WARNINGS, *shared], check=True)
        self.library = ctypes.CDLL(str(library))
        self.shape = (height, width, 3 + 2 * harmonics)
        self.sums = np.full(height * width * (3 + 2 * harmonics), -1, np.int32)
        """Memory of ``struct phase_sums``."""
        self.memory = ctypes.c_void_p(self.sums.ctypes.data)
        self.library.phase_clear(self.memory)

    def add(self, events: amiwarp.Events, turns: NDArray[np.integer[Any]]) -> list[int]:
        """Add events at angles [1/65536 turn], and return the results."""
        return [
            self.library.phase_add(self.memory, *map(int, event))
            for event in zip(events.x, events.y, turns, events.p, strict=True)
        ]

    def integers(self) -> NDArray[np.int32]:
        """Read all pixels."""
        out = np.empty(self.shape, np.int32)
        for y, x in np.ndindex(*self.shape[:2]):
            self.library.phase_read(self.memory, x, y, ctypes.c_void_p(out[y, x].ctypes.data))
        return out


@needs_gcc
@pytest.mark.parametrize(
    ("harmonics", "bins", "off_ratio"), [(1, 16, 1.0), (5, 64, 1.25), (9, 100, 9.0)]
)
def test_the_c_gives_the_sums_bit_for_bit(
    tmp_path: Path, harmonics: int, bins: int, off_ratio: float
) -> None:
    options = ["--harmonics", harmonics, "--bins", bins, "--off-ratio", off_ratio]
    folder = export(tmp_path / "sums", "--size", "11x6", *options)
    rng = np.random.default_rng(1)
    count = 5000
    events = amiwarp.Events.from_arrays(
        rng.integers(0, 11, count),
        rng.integers(0, 6, count),
        np.arange(count),
        rng.integers(0, 2, count),
    )
    turns = rng.integers(0, 65536, count)
    built = BuiltSums(folder, 11, 6, harmonics)
    assert not any(built.add(events, turns))
    settings = {"turns": 2.0, "off_ratio": off_ratio, "bins": bins, "direction": -1}
    found = amiwarp.PhaseSums.from_integers(built.integers(), **settings)
    angles = turns * (math.tau / 65536)
    expected = amiwarp.phase_sums(events, angles, 11, 6, harmonics=harmonics, **settings)
    np.testing.assert_array_equal(found.values, expected.values)
    np.testing.assert_array_equal(found.on, expected.on)
    np.testing.assert_array_equal(found.off, expected.off)
    np.testing.assert_array_equal(found.changes, expected.changes)


@needs_gcc
def test_a_region_that_a_microcontroller_summed_gives_its_picture(tmp_path: Path) -> None:
    """A region of 32x32 px of a sensor of 64x48, with its corner subtracted from the events and from the camera."""
    y, x = np.mgrid[0:96, 0:96]
    scene = 0.5 + 0.2 * np.sin(x / 5.0) + 0.2 * np.cos(y / 4.0 + x / 9.0)
    camera = amiwarp.Camera.from_fov(64, 48, 1.0)
    recording = amiwarp.simulate(
        scene.astype(np.float32), camera, amiwarp.Prism(0.06), duration_s=0.2
    )
    model = amiwarp.ExactModel.from_prism(camera, recording.prism, 0.0)
    encoder = recording.encoder
    first = recording.events.t_first
    # a turn at 720 rpm
    events = recording.events.between(first, first + 83_333)
    turns = np.rint(encoder.angle_at(events.t) * (65536 / math.tau)).astype(np.int64) % 65536

    left, top = 16, 8
    folder = export(tmp_path / "sums", "--size", "32x32", "--harmonics", 5)
    built = BuiltSums(folder, 32, 32, 5)
    moved = amiwarp.Events(events.x - left, events.y - top, events.t, events.p)
    results = np.array(built.add(moved, turns))
    inside = (events.x >= left) & (events.x < left + 32) & (events.y >= top) & (events.y < top + 32)
    np.testing.assert_array_equal(results == 0, inside)
    np.testing.assert_array_equal(results == 1, ~inside)

    sums = amiwarp.PhaseSums.from_integers(built.integers(), turns=1.0, off_ratio=1.0)
    region = replace(camera, width=32, height=32, cx=camera.cx - left, cy=camera.cy - top)
    part = amiwarp.phase_picture(sums, replace(model, camera=region))
    of_all = amiwarp.phase_sums(events, encoder, 64, 48, turns=1.0, harmonics=5, off_ratio=1.0)
    whole = amiwarp.phase_picture(of_all, model)[top : top + 32, left : left + 32]
    # Borders of the region differ: the whole sensor knows what lies beyond them.
    middle = np.s_[6:-6, 6:-6]
    assert np.corrcoef(part[middle].ravel(), whole[middle].ravel())[0, 1] > 0.97


def test_the_command_prints_ram_and_flash(tmp_path: Path) -> None:
    result = run("export-c", tmp_path / "a", "--size", "30x20", "--harmonics", 3, "--json")
    data = json.loads(result.stdout)
    assert data["ram_bytes"] == 600 * (6 * 2 + 6 * 4)
    assert data["table_bytes"] == 4 * 64 * 6 * 2
    assert set(data["files"]) == NAMES == {path.name for path in (tmp_path / "a").iterdir()}
    result = run("export-c", tmp_path / "b", "--size", "30x20", "--harmonics", 3)
    assert "21,600 bytes of RAM, tables of 3,072 bytes of flash" in result.stdout
    assert "21,600 bytes of RAM" in (tmp_path / "b" / "README.md").read_text()


def test_the_same_command_writes_the_same_bytes_and_a_seed_other_events(tmp_path: Path) -> None:
    first = export(tmp_path / "a", "--size", "5x5")
    again = export(tmp_path / "b", "--size", "5x5")
    other = export(tmp_path / "c", "--size", "5x5", "--seed", 1)
    for name in NAMES:
        assert (first / name).read_bytes() == (again / name).read_bytes()
        same = name != "test_phase_sums.c"
        assert ((first / name).read_bytes() == (other / name).read_bytes()) == same


def test_existing_files_are_replaced_by_force_alone(tmp_path: Path) -> None:
    folder = tmp_path / "sums"
    folder.mkdir()
    (folder / "README.md").write_text("mine")
    result = run("export-c", folder)
    assert (result.exit_code, "README.md: exists" in result.stderr) == (1, True), result.output
    assert {path.name for path in folder.iterdir()} == {"README.md"}
    assert (folder / "README.md").read_text() == "mine"
    export(folder, "--force")
    assert {path.name for path in folder.iterdir()} == NAMES


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("--size 32", "is not a size"),
        ("--size 0x32", "width"),
        ("--size 32x1025", "height"),
        ("--harmonics 0", "harmonics"),
        ("--harmonics 32", "harmonics"),
        ("--bins 2", "bins"),
        ("--bins 1025", "bins"),
        ("--off-ratio 0", "off_ratio"),
        ("--off-ratio 11", "off_ratio"),
        ("--off-ratio nan", "off_ratio"),
    ],
)
def test_numbers_out_of_range_are_refused(tmp_path: Path, options: str, message: str) -> None:
    result = run("export-c", tmp_path / "sums", *options.split())
    assert (result.exit_code, message in result.stderr) == (1, True), result.output
    assert not (tmp_path / "sums").exists()
