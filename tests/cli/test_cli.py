"""Command line: help, examples, JSON output and failures of the commands."""

import contextlib
import inspect
import json
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner, Result

from amiwarp import (
    AmiwarpError,
    Calibration,
    Events,
    MemoryEvents,
    PrismMotion,
    open_recording,
    save_recording,
)
from amiwarp.cli.app import COMMANDS, function_of
from amiwarp.cli.common import number
from amiwarp.kernels import quiet_start
from amiwarp.results.parameters import LINEAR_UNKNOWNS, units
from amiwarp.simulation.commands.rig_options import RigOptions
from tests import ROOT
from tests.command_line import app


def test_help_and_info_load_only_what_they_need(made: tuple[Path, str]) -> None:
    """The list of commands repeats what the commands say of themselves, without loading them."""
    for name, command in COMMANDS.items():
        first = inspect.getdoc(function_of(name)).split("\n\n")[0]
        assert first.replace("\n", " ") == command.summary, name
    code = (
        "import sys; from amiwarp.cli.app import app\n"
        "try: app(['--help'])\n"
        "except SystemExit: print({m.split('.')[0] for m in sys.modules} & {'numpy', 'warp', 'scipy'})\n"
        "try: app(['info', sys.argv[1]])\n"
        "except SystemExit: print({m.split('.')[0] for m in sys.modules} & {'warp', 'scipy', 'matplotlib'})"
    )
    words = [sys.executable, "-c", code, str(made[0] / "recording.h5")]
    ran = subprocess.run(words, capture_output=True, text=True, check=True)
    assert "fx" in ran.stdout
    assert ran.stdout.splitlines().count("set()") == 2


def run(*args: str | Path) -> Result:
    return CliRunner().invoke(app, [str(arg) for arg in args])


def ok(*args: str | Path) -> dict[str, Any]:
    """Run a command with ``--json`` and return its JSON object. Nothing else may be on stdout."""
    result = run(*args, "--json")
    assert result.exit_code == 0, result.stderr
    data = json.loads(result.stdout)
    assert isinstance(data, dict)
    return data


def fails(code: int, *args: str | Path) -> str:
    """Run a command that must exit with ``code``, and return its only line on stderr."""
    result = run(*args)
    assert (result.exit_code, result.stdout) == (code, ""), result.output
    assert result.stderr.count("\n") == 1, result.stderr
    assert "Traceback" not in result.stderr
    return str(result.stderr)


@pytest.fixture(scope="session")
def made(tmp_path_factory: pytest.TempPathFactory, texture: np.ndarray) -> tuple[Path, str]:
    """Folder with a picture, its recording (160 × 120 px, 0.2 s) and its calibration, and what ``calibrate`` printed.

    The calibration is that of the help's example. The folder is not to be written to.
    """
    folder = tmp_path_factory.mktemp("cli")
    Image.fromarray(texture).save(folder / "photo.jpg", quality=95)
    ok(
        "simulate", folder / "recording.h5", "--picture", folder / "photo.jpg", "--size", "160x120", "--fov-deg", "40",
        "--duration", "0.2", "--apex-deg", "2", "--nominal-apex-deg", "2.4", "--phase-deg", "100", "--seed", "4",
    )  # fmt: skip
    with contextlib.chdir(folder):
        result = run(*shlex.split(COMMANDS["calibrate"].example)[1:])
    assert result.exit_code == 0, result.stderr
    (folder / "calibration.png").unlink()
    return folder, result.stdout


@pytest.fixture
def place(made: tuple[Path, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Working folder with links to the files of ``folder``."""
    for file in made[0].iterdir():
        (tmp_path / file.name).symlink_to(file)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def left_behind(place: Path, *expected: str) -> set[str]:
    """Return the names of files in ``place`` that are neither the fixture's nor in ``expected``."""
    known = {"photo.jpg", "recording.h5", "calibration.json", *expected}
    return {file.name for file in place.iterdir()} - known


def test_help_of_everything_shows_an_example() -> None:
    assert set(COMMANDS) == set(re.findall(r"^│ (\w[\w-]*)  ", run("--help").stdout, re.M))
    for name, command in COMMANDS.items():
        result = run(name, "--help")
        assert result.exit_code == 0
        text = " ".join(result.stdout.split())
        assert f"Example: {command.example}" in text
        assert all(option in text for option in ("--json", "--device", "--seed"))


def test_the_help_names_every_parameter() -> None:
    text = run("calibrate", "--help").stdout
    named = set(re.findall(r"\w+", re.sub(r"[│\n]", " ", text)))
    assert set(units()) | {"motion", *LINEAR_UNKNOWNS} <= named


def test_the_warning_of_a_missing_driver_is_hidden_on_machines_without_a_gpu(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    def init() -> None:
        os.write(
            2,
            b"Warp CUDA warning: Could not find or load the NVIDIA CUDA driver. No GPU.\nanother line\n",
        )

    monkeypatch.setattr(quiet_start.wp, "init", init)
    monkeypatch.setattr(quiet_start, "GPU_FILES", (tmp_path / "nvidiactl",))
    assert "cpu" in quiet_start.start_quietly()
    assert capfd.readouterr().err == "another line\n"
    (tmp_path / "nvidiactl").touch()
    quiet_start.start_quietly()
    assert "NVIDIA CUDA driver" in capfd.readouterr().err


def test_version() -> None:
    import amiwarp

    assert run("--version").stdout.strip() == amiwarp.__version__


def test_examples_of_the_help_run(place: Path, texture: np.ndarray) -> None:
    """Run the help examples that need only the fixture's files. The fixture ran calibrate's, other tests run demo's."""
    for name in ("info", "compensate"):
        words = shlex.split(COMMANDS[name].example)
        assert words[:2] == ["amiwarp", name]
        ok(*words[1:])
    assert left_behind(place) == {"compensated.h5", "iwe.png"}
    (place / "recording.h5").unlink()
    ok(*shlex.split(COMMANDS["simulate"].example)[1:], "--size", "64x48", "--duration", "0.05")
    _own_recording(place)
    line = (
        COMMANDS["convert"]
        .example.replace("events.raw", "events.npz")
        .replace("recording.h5", "mine.h5")
    )
    ok(*shlex.split(line)[1:])
    (place / "pictures").mkdir()
    for k in range(3):
        Image.fromarray(np.roll(texture, k)[:60, :80]).save(place / "pictures" / f"{k}.png")
    line = (
        COMMANDS["translate"]
        .example.replace("video.mp4", "pictures")
        .replace("recording.h5", "moved.h5")
    )
    assert ok(*shlex.split(line)[1:], "--fps", "50")["duration_s"] == pytest.approx(0.06, abs=1e-9)
    assert open_recording(place / "moved.h5").events.size == (80, 60)


def _own_recording(place: Path) -> None:
    """Write ``events.npz`` with 1,000 events in one second, and ``encoder.csv`` with one turn per second."""
    rng = np.random.default_rng(5)
    t = np.sort(rng.integers(0, 1_000_000, 1000))
    np.savez(
        place / "events.npz", x=rng.integers(0, 64, 1000), y=rng.integers(0, 48, 1000), t=t, p=t % 2
    )
    rows = [f"{t},{t * 4096 // 1_000_000}" for t in range(-1000, 1_002_000, 1000)]
    (place / "encoder.csv").write_text("\n".join(["t_us,count", *rows]) + "\n")


def test_simulate_stores_its_ground_truth(place: Path) -> None:
    data = ok("info", "recording.h5")
    assert (data["width"], data["height"], data["compensated"]) == (160, 120, False)
    assert data["truth"]["apex_deg"] == pytest.approx(2.0, abs=1e-9)
    assert data["truth"]["phase_deg"] == pytest.approx(100.0, abs=1e-9)
    assert data["prism"]["apex_deg"] == pytest.approx(2.4, abs=1e-9)
    assert data["camera"]["fov_deg"] == pytest.approx(40.0, abs=1e-9)
    assert data["encoder"]["rpm"] == pytest.approx(720.0, abs=1.0)
    assert data["encoder"]["covers_events"] is True
    assert data["encoder"]["gaps"] == []
    assert data["truth_points"] is True
    assert data["repairs"] == {}
    assert data["duration_s"] == pytest.approx(0.2, abs=0.01)
    assert 0.3 < data["on_share"] < 0.7


def test_seed_decides_the_recording(place: Path) -> None:
    def simulated(name: str, seed: str) -> bytes:
        ok(
            "simulate",
            name,
            "--picture",
            "photo.jpg",
            "--size",
            "64x48",
            "--duration",
            "0.05",
            "--seed",
            seed,
        )
        return open_recording(name).events.slice(0, 10_000_000).t.tobytes()

    assert simulated("a.h5", "1") == simulated("b.h5", "1")
    assert simulated("c.h5", "2") != simulated("d.h5", "1")


def test_simulate_takes_every_fault_of_sensor_and_encoder(place: Path) -> None:
    (place / "speed.csv").write_text("# s, rpm\n0,700\n0.1,740\n")
    ok(
        "simulate", "faulty.h5", "--picture", "photo.jpg", "--size", "64x48", "--duration", "0.1", "--ideal",
        "--contrast-on", "0.3", "--shot-noise-hz", "2", "--counts-per-turn", "0", "--rate-hz", "500",
        "--speed", "speed.csv", "--tilt-deg", "1,-0.5", "--rotate-deg-s", "0,5,0", "--flat-side", "camera",
        "--cylinder-deg", "0.1,-0.2", "--wobble-deg", "0,1.5", "--encoder-error-deg", "0,0.3,0,0",
    )  # fmt: skip
    data = ok("info", "faulty.h5")
    truth = data["truth"]
    assert (
        truth["contrast_on"],
        truth["contrast_off"],
        truth["shot_noise_hz"],
        truth["leak_hz"],
    ) == (0.3, 0.25, 2, 0)
    angles = ("tilt_y_deg", "cylinder_x_deg", "cylinder_y_deg", "wobble_x_deg", "wobble_y_deg")
    assert [truth[name] for name in angles] == pytest.approx([-0.5, 0.1, -0.2, 0.0, 1.5], abs=1e-9)
    assert truth["omega_y"] == pytest.approx(np.radians(5.0), abs=1e-9)
    assert data["prism"]["flat_side"] == "camera"
    assert data["encoder"]["rpm"] == pytest.approx(720.0, abs=3.0)
    assert data["encoder"]["interval_us"] == pytest.approx(2000.0, abs=20.0)
    encoder = open_recording("faulty.h5").encoder
    assert encoder is not None
    turned = PrismMotion([[0.0, 700.0], [0.1, 740.0]]).angle(encoder.t)
    # Rad
    np.testing.assert_allclose(
        encoder.angle - turned, np.radians(0.3) * np.sin(turned), rtol=0, atol=5e-4
    )


def test_the_second_prism_turns_backwards_by_default(tmp_path: Path) -> None:
    """Also if the speed of the first one is a table."""
    (tmp_path / "speed.csv").write_text("0,700\n0.1,740\n")
    for speed in (tmp_path / "speed.csv", None):
        motion = RigOptions(second_apex_deg=1.0, speed=speed).build_motion()
        first, second = motion.angles([0.0, 5e4, 9e4]).T
        assert first[2] > 5.0
        np.testing.assert_array_equal(second, -first)


def test_calibrate_finds_the_truth(place: Path) -> None:
    found = Calibration.load("calibration.json")
    assert np.degrees(found.parameters["apex"]) == pytest.approx(2.0, abs=0.1)
    # Events lag behind the edges, more so at higher thresholds, so the phase differs from the mechanical one.
    assert np.degrees(found.parameters["phase"]) == pytest.approx(100.0, abs=8.0)


def test_calibrate_takes_every_setting(place: Path) -> None:
    data = ok(
        "calibrate", "recording.h5", "--model", "circle", "--sharpness", "gradient", "--global-algorithm", "none",
        "--local-algorithm", "LN_SBPLX", "--free", "deflection,phase", "--start", "deflection=1deg", "--start",
        "phase=1.6rad", "--bound", "deflection=0.5deg:1.5deg", "--bound", "phase=60deg:140deg", "--local-evaluations",
        "40", "--tolerance-px", "0.01", "--smoothing-px", "1.5", "--per-polarity", "--events", "50000",
        "--window", "0.05:0.18", "--nominal-apex-deg", "2.2", "--index", "1.52", "--flat-side", "scene",
        "--fov-deg", "40", "--figure", "cost.png", "--stages", "sharpness", "--latency-us", "100",
        "--refractory-us", "50",
    )  # fmt: skip
    assert data["file"] == "recording.calibration.json"
    assert [stage["algorithm"] for stage in data["stages"]] == ["LN_SBPLX"]
    assert data["stages"][0]["evaluations"] <= 40
    assert data["sharpness"]["kind"] == "gradient"
    assert data["sharpness"]["after"] > data["sharpness"]["before"]
    assert 0 < data["events"] <= 50_000
    assert data["prism"]["index"] == 1.52
    assert 60.0 <= data["parameters"]["phase"]["degrees"] <= 140.0
    assert np.asarray(Image.open("cost.png")).shape[1] > 1000
    assert left_behind(place) == {"recording.calibration.json", "cost.png"}


def test_calibrate_says_that_a_burst_was_left_out(place: Path) -> None:
    recording = open_recording("recording.h5")
    y, x = np.divmod(np.arange(2000), 160)
    burst = Events.from_arrays(x, y, np.full(2000, -20_000), np.ones(2000))
    events = MemoryEvents(Events.concatenate([burst, recording.events[:]]), *recording.events.size)
    save_recording("burst.h5", replace(recording, events=events, truth=None))
    given = ("calibrate", "burst.h5", "burst.json", "--stages", "sharpness")
    found = ok(*given)
    said = "2,000 events carry the first time stamp (-20000 us), far more than any later one"
    assert found["warnings"][-1].startswith(said)
    assert Calibration.load("burst.json").warnings[-1].startswith(said)
    assert f"warning: {said}" in run(*given, "--force").stdout


def test_calibrate_prints_a_table(made: tuple[Path, str]) -> None:
    _, printed = made
    assert re.search(r"^apex +[12]\.\d+ +\S+ +deg$", printed, re.M), printed
    assert re.search(r"^local +LN_\w+ +\d+ +[\d.]+ s", printed, re.M), printed
    assert "sharpness (variance): " in printed


def test_compensate_keeps_every_event(place: Path) -> None:
    data = ok("compensate", "recording.h5", "out.h5", "--calibration", "calibration.json")
    before, after = open_recording("recording.h5").events, open_recording("out.h5").events
    assert data["events"] == len(before) == len(after)
    a, b = before.slice(0, len(before)), after.slice(0, len(after))
    assert np.array_equal(a.t, b.t)
    assert np.array_equal(a.p, b.p)
    assert b.x.dtype == np.float32
    with h5py.File("out.h5") as file:
        assert int((file["events/inside"][:] == 0).sum()) == data["outside"]
    assert ok("info", "out.h5")["compensated"] is True


@pytest.mark.parametrize(
    ("layers", "shape"),
    [("merged", (120, 160)), ("signed", (120, 160)), ("polarity", (2, 120, 160))],
)
def test_iwe_whole(place: Path, layers: str, shape: tuple[int, ...]) -> None:
    ok("compensate", "recording.h5", "out.h5", "--calibration", "calibration.json", "--iwe", "iwe.npy", "--iwe",
       "iwe.png", "--iwe-layers", layers)  # fmt: skip
    image = np.load("iwe.npy")
    with h5py.File("out.h5") as file:
        inside = int(file["events/inside"][:].sum())
    assert (image.shape, image.dtype) == (shape, np.float32)
    if layers != "signed":
        # events at the border lose a part of their vote to pixels outside the image
        assert 0.98 * inside <= image.sum() <= inside * 1.001
    picture = np.asarray(Image.open("iwe.png"))
    assert picture.shape == ((120, 160, 3) if layers == "polarity" else (120, 160))
    assert picture.max() == 255 or layers == "polarity"


def test_iwe_by_windows_adds_up_to_the_whole(place: Path) -> None:
    common = ("compensate", "recording.h5", "out.h5", "--calibration", "calibration.json", "--iwe")
    ok(*common, "whole.npy")
    data = ok(*common, "parts.npy", "--iwe", "parts.png", "--iwe-window-ms", "30", "--force")
    whole, parts = np.load("whole.npy"), np.load("parts.npy")
    assert parts.shape == (7, 120, 160)
    assert np.abs(parts.sum(axis=0) - whole).max() <= 1e-3 * whole.max()
    assert len(data["iwe"]) == 8
    assert left_behind(place) == {
        "out.h5",
        "whole.npy",
        "parts.npy",
        *(f"parts_{k:05d}.png" for k in range(7)),
    }


def test_convert_adds_encoder_camera_and_prism(place: Path) -> None:
    _own_recording(place)
    camera = {"width": 64, "height": 48, "fx": 80.0, "fy": 80.0, "cx": 31.5, "cy": 23.5}
    (place / "camera.json").write_text(json.dumps(camera))
    data = ok("convert", "events.npz", "mine.h5", "--encoder", "encoder.csv", "--counts-per-turn", "4096",
              "--direction", "-1", "--camera", "camera.json", "--nominal-apex-deg", "1.5",
              "--index", "1.6")  # fmt: skip
    assert (data["events"], data["encoder_covers"], data["encoder_gaps"]) == (1000, True, [])
    seen = ok("info", "mine.h5")
    assert (seen["events"], seen["width"], seen["camera"]["fx"]) == (1000, 64, 80.0)
    assert seen["encoder"]["rpm"] == pytest.approx(-60.0, abs=0.1)
    assert seen["prism"] == {"apex_deg": pytest.approx(1.5), "index": 1.6, "flat_side": "scene"}


def test_convert_says_what_a_format_leaves_out(place: Path) -> None:
    data = ok("convert", "recording.h5", "out.aedat4")
    assert (data["format"], data["left_out"]) == (
        "aedat4", ["encoder", "camera", "prism", "ground truth", "metadata"]
    )  # fmt: skip
    assert "the format text are written as .txt, not '.bin'" in fails(
        1, "convert", "recording.h5", "out.bin", "--format", "text"
    )
    result = run("convert", "recording.h5", "out.txt", "--format", "text")
    assert result.exit_code == 0
    left_out = "encoder, camera, prism, ground truth, metadata"
    assert f"note: text does not hold, and leaves out: {left_out}\n" in result.stdout
    assert len((place / "out.txt").read_text().splitlines()) == data["events"]
    assert "leaves out" not in run("convert", "recording.h5", "plain.h5", "--codec", "gzip").stdout
    assert ok("info", "plain.h5")["events"] == data["events"]


def test_rounding_is_reported(place: Path) -> None:
    """By compensate and by convert, as text and as JSON."""
    ok("compensate", "recording.h5", "moved.h5", "--calibration", "calibration.json")
    found = ok(
        "compensate",
        "recording.h5",
        "a.raw",
        "--calibration",
        "calibration.json",
        "--round",
        "nearest",
    )
    assert (found["format"], found["rounding"], found["dropped"]) == (
        "evt3",
        "nearest",
        found["outside"],
    )
    assert found["left_out"] == ["encoder", "camera", "prism", "ground truth", "metadata"]
    assert ok("info", "a.raw", "--count")["events"] == found["events"] - found["dropped"]
    note = f"note: rounded to whole pixels (nearest); {found['dropped']:,} events outside are dropped\n"
    left_out = "leaves out: encoder, camera, prism, ground truth, metadata\n"
    for command in (
        ("compensate", "recording.h5", "b.raw", "--calibration", "calibration.json"),
        ("convert", "moved.h5", "c.raw"),
    ):
        result = run(*command, "--round", "nearest")
        assert result.exit_code == 0, result.stderr
        assert note in result.stdout
        assert left_out in result.stdout
        assert (place / command[2]).read_bytes() == (place / "a.raw").read_bytes()
    same, other = (
        ok("convert", "moved.h5", f"{seed}.npz", "--round", "dithered", "--seed", seed)["dropped"]
        for seed in "34"
    )
    dithered = ("--calibration", "calibration.json", "--round", "dithered", "--seed", "3")
    assert ok("compensate", "recording.h5", "3b.npz", *dithered)["dropped"] == same != other
    assert (place / "3b.npz").read_bytes() == (place / "3.npz").read_bytes()
    assert "give --round" in fails(
        1, "compensate", "recording.h5", "d.raw", "--calibration", "calibration.json"
    )


def test_info_prints_a_table(place: Path) -> None:
    result = run("info", "recording.h5")
    assert result.exit_code == 0
    assert re.search(r"^size +160 x 120 px$", result.stdout, re.M)
    assert re.search(
        r"^encoder +[\d,]+ samples, 7\d\d\.?\d* rpm, .*covers the events; no gaps$",
        result.stdout,
        re.M,
    )


def _bad_files(place: Path) -> None:
    (place / "garbage.h5").write_bytes(bytes(range(256)) * 20)
    (place / "empty.raw").write_bytes(b"")
    (place / "cut.h5").write_bytes((place / "recording.h5").read_bytes()[:5000])
    (place / "bad.json").write_text(
        '{"format": "amiwarp-calibration", "version": 1, "model": "exact"}'
    )
    (place / "list.json").write_text("[1, 2]")
    (place / "nocamera.json").write_text('{"width": 160}')
    data = json.loads((place / "calibration.json").read_text())
    data["camera"]["width"] = 99
    (place / "narrow.json").write_text(json.dumps(data))
    (place / "notes.txt").write_text("no picture")
    Image.fromarray(np.full((48, 64), 99, np.uint8)).save(place / "grey.png")
    (place / "falling.csv").write_text("1,700\n0,700\n")
    _own_recording(place)


IWE_WINDOW = (
    *("compensate", "recording.h5", "out.h5", "--calibration", "calibration.json"),
    *("--iwe", "i.npy", "--iwe-window-ms"),
)
BAD = [
    (("info", "missing.h5"), "missing.h5"),
    (("info", "garbage.h5"), "garbage.h5"),
    (("info", "empty.raw"), "empty.raw"),
    (("info", "cut.h5"), "cut.h5"),
    (("info", "."), "folder"),
    (("convert", "garbage.h5", "out.h5"), "garbage.h5"),
    (("convert", "recording.h5", "recording.h5"), "recording.h5"),
    (("convert", "recording.h5", "nowhere/out.h5"), "nowhere"),
    (("convert", "recording.h5", "out.h5", "--encoder", "missing.csv"), "missing.csv"),
    (("convert", "events.npz", "out.h5", "--encoder", "encoder.csv"), "counts_per_turn"),
    (("convert", "events.npz", "out.h5", "--counts-per-turn", "5"), "--encoder"),
    (("convert", "recording.h5", "out.h5", "--camera", "nocamera.json"), "height"),
    (("convert", "recording.h5", "out.h5", "--camera", "narrow.json"), "99x120"),
    (
        ("convert", "recording.h5", "out.h5", "--camera", "narrow.json", "--fov-deg", "60"),
        "give one of them",
    ),
    (
        (
            "simulate",
            "out.h5",
            "--picture",
            "photo.jpg",
            "--camera",
            "narrow.json",
            "--size",
            "99x120",
        ),
        "leave --size out",
    ),
    (("simulate", "out.h5", "--picture", "notes.txt"), "notes.txt"),
    (("simulate", "out.h5", "--picture", "missing.jpg"), "missing.jpg"),
    (("simulate", "out.h5", "--picture", "photo.jpg", "--size", "big"), "640x480"),
    (
        ("simulate", "out.h5", "--picture", "photo.jpg", "--apex-deg", "45"),
        "--apex-deg = 45.0 is not",
    ),
    (("simulate", "out.h5", "--picture", "photo.jpg", "--fov-deg", "500"), "--fov-deg = 500.0"),
    (
        ("simulate", "out.h5", "--picture", "photo.jpg", "--scene-fov-deg", "nan"),
        "--scene-fov-deg = nan",
    ),
    (("simulate", "out.h5", "--picture", "photo.jpg", "--tilt-deg", "100,0"), "--tilt-deg = 100.0"),
    (
        ("simulate", "out.h5", "--world", "desk", "--optic", "plate", "--plate-tilt-deg", "200"),
        "--plate-tilt-deg",
    ),
    (
        ("simulate", "out.h5", "--world", "desk", "--optic", "plate", "--thickness-mm", "300"),
        "0 .. 200 mm",
    ),
    (
        (
            "simulate",
            "out.h5",
            "--picture",
            "photo.jpg",
            "--optic",
            "vibration",
            "--amplitude-deg",
            "20",
        ),
        "-deg = 20.0",
    ),
    (
        (
            "simulate",
            "out.h5",
            "--picture",
            "photo.jpg",
            "--optic",
            "mirror",
            "--mirror-deg",
            "-1,1",
        ),
        "-deg = -1.0",
    ),
    (
        ("convert", "recording.h5", "out.h5", "--nominal-apex-deg", "40"),
        "--nominal-apex-deg = 40.0",
    ),
    (
        ("simulate", "out.h5", "--picture", "photo.jpg", "--optic", "vibration", "--apex-deg", "5"),
        "applies to a wedge",
    ),
    (
        (
            "simulate",
            "out.h5",
            "--picture",
            "photo.jpg",
            "--optic",
            "vibration",
            "--speed",
            "no.csv",
        ),
        "--optic wedge",
    ),
    (
        ("simulate", "out.h5", "--picture", "photo.jpg", "--optic", "vibration", "--rate-hz", "9"),
        "or a mirror or a steerer; give",
    ),
    (
        ("simulate", "out.h5", "--picture", "photo.jpg", "--optic", "mirror", "--phase-deg", "40"),
        "--phase-deg applies",
    ),
    (
        ("simulate", "out.h5", "--picture", "photo.jpg", "--thickness-mm", "5"),
        "--thickness-mm applies to a plate",
    ),
    (
        ("simulate", "out.h5", "--picture", "photo.jpg", "--rpm", "9", "--speed", "no.csv"),
        "--rpm and --speed both",
    ),
    (
        ("simulate", "out.h5", "--picture", "photo.jpg", "--speed", "falling.csv"),
        "falling.csv: prism speed: the times",
    ),
    (
        ("simulate", "out.h5", "--picture", "photo.jpg", "--speed", "empty.raw"),
        "empty.raw: prism speed",
    ),
    (("simulate", "out.h5", "--picture", "photo.jpg", "--mismatch", "7"), "mismatch"),
    (("simulate", "out.h5", "--picture", "photo.jpg", "--tilt-deg", "1"), "--tilt-deg"),
    (("simulate", "out.h5", "--picture", "photo.jpg", "--cylinder-deg", "1"), "--cylinder-deg"),
    (
        ("simulate", "out.h5", "--picture", "photo.jpg", "--encoder-error-deg", "1,2"),
        "--encoder-error-deg",
    ),
    (
        (
            "simulate",
            "nowhere/out.h5",
            "--picture",
            "photo.jpg",
            "--size",
            "64x48",
            "--duration",
            "0.01",
        ),
        "nowhere",
    ),
    (("simulate", "out.h5", "--picture", "photo.jpg", "--size", "4²x48"), "640x480"),
    (("translate", "missing.mp4", "out.h5"), "missing.mp4"),
    (("translate", "notes.txt", "out.h5"), "notes.txt"),
    (("translate", "grey.png", "out.h5"), "grey.png: does not state its duration; give --duration"),
    (("calibrate", "missing.h5"), "missing.h5"),
    (("calibrate", "events.npz"), "camera"),
    (("calibrate", "recording.h5", "--camera", "garbage.h5"), "or as .json or .yaml"),
    (("calibrate", "recording.h5", "--model", "spiral"), "spiral"),
    (("calibrate", "recording.h5", "--global-algorithm", "GN_GUESS"), "GN_GUESS"),
    (("calibrate", "recording.h5", "--local-algorithm", "LD_LBFGS"), "LD_LBFGS"),
    (("calibrate", "recording.h5", "--free", "apex,colour"), "colour"),
    (("calibrate", "recording.h5", "--start", "apex=1"), "1.2deg"),
    (("calibrate", "recording.h5", "--start", "colour=1"), "colour"),
    (("calibrate", "recording.h5", "--bound", "apex=1deg"), "LOW:HIGH"),
    (("calibrate", "recording.h5", "--bound", "apex=2deg:1deg"), "apex"),
    (("calibrate", "recording.h5", "--window", "5:6"), "5:6"),
    (("calibrate", "recording.h5", "--window", "0.1"), "START:END"),
    (("calibrate", "recording.h5", "--window", "0:0.001"), "events"),
    (("calibrate", "recording.h5", "nowhere/c.json"), "nowhere"),
    (("calibrate", "recording.h5", "--figure", "cost.jpg"), "cost.jpg"),
    (("calibrate", "recording.h5", "--figure", "nowhere/cost.png"), "nowhere"),
    (("calibrate", "recording.h5", "--rpm", "720"), "encoder gives the rpm"),
    (("compensate", "recording.h5", "out.h5", "--calibration", "missing.json"), "missing.json"),
    (("compensate", "recording.h5", "out.h5", "--calibration", "bad.json"), "bad.json"),
    (("compensate", "recording.h5", "out.h5", "--calibration", "list.json"), "list.json"),
    (("compensate", "recording.h5", "out.h5", "--calibration", "recording.h5"), "recording.h5"),
    (("compensate", "recording.h5", "out.h5", "--calibration", "narrow.json"), "99x120"),
    (
        ("compensate", "recording.h5", "recording.h5", "--calibration", "calibration.json"),
        "recording.h5",
    ),
    (
        (
            "compensate",
            "recording.h5",
            "out.h5",
            "--calibration",
            "calibration.json",
            "--iwe",
            "iwe.bmp",
        ),
        "iwe.bmp",
    ),
    (
        (
            "compensate",
            "recording.h5",
            "out.h5",
            "--calibration",
            "calibration.json",
            "--iwe-window-ms",
            "5",
        ),
        "--iwe",
    ),
    (
        (
            "compensate",
            "recording.h5",
            "no/o.h5",
            "--calibration",
            "calibration.json",
            "--iwe",
            "i.npy",
        ),
        "no/o.h5",
    ),
    ((*IWE_WINDOW, "inf"), "--iwe-window-ms = inf"),
    ((*IWE_WINDOW, "1e30"), "--iwe-window-ms = 1e+30"),
    (
        (
            "reconstruct",
            "recording.h5",
            "a.png",
            "--calibration",
            "calibration.json",
            "--start",
            "nan",
        ),
        "--start = nan",
    ),
    (
        (
            "reconstruct",
            "recording.h5",
            "a.png",
            "--calibration",
            "calibration.json",
            "--length",
            "inf",
        ),
        "--length = inf",
    ),
    (("pixels", "recording.h5", "calibration.json", "a.npz", "--length", "inf"), "--length = inf"),
    (("pixels", "recording.h5", "calibration.json", "a.npz", "--start", "1e30"), "--start = 1e+30"),
    (
        (
            "reconstruct",
            "recording.h5",
            "a.npy",
            "--calibration",
            "calibration.json",
            "--bits",
            "16",
        ),
        "--bits and",
    ),
    (
        (
            "reconstruct",
            "recording.h5",
            "a.npy",
            "--calibration",
            "calibration.json",
            "--tone",
            "linear",
        ),
        "--bits and",
    ),
    (
        (
            "reconstruct",
            "recording.h5",
            "a.png",
            "--calibration",
            "calibration.json",
            "--bins",
            "3",
        ),
        "--bins and",
    ),
    (
        ("reconstruct", "recording.h5", "a.png", "--network", "quarter-turn", "--multiple", "4"),
        "--bins and",
    ),
    (("truth", "recording.h5", "truth", "--poses", "tum", "--with-prism"), "give --flow too"),
    (("depth", "recording.h5", "calibration.json", "a.npz"), "the calibration has the exact model"),
    (("convert", "recording.h5", "a.rrd", "--frame-ms", "inf"), "--frame-ms = inf"),
    (("calibrate", "recording.h5", "--window", "0:1e30"), "START:END"),
    (("calibrate", "recording.h5", "--second-apex-deg", "1"), "--second-ratio"),
    (("demo", "--picture", "notes.txt", "--out", "demo"), "notes.txt"),
    (("demo", "--out", "notes.txt"), "notes.txt"),
    (("simulate", "out.h5", "--picture", "photo.jpg", "--device", "cuda:77"), "cuda:77"),
]


@pytest.mark.parametrize(
    ("args", "named"), BAD, ids=lambda value: " ".join(value) if isinstance(value, tuple) else ""
)
def test_bad_input_is_one_line_and_leaves_nothing(
    place: Path, args: tuple[str, ...], named: str
) -> None:
    _bad_files(place)
    before = left_behind(place)
    contents = (place / "recording.h5").read_bytes()
    assert named in fails(1, *args)
    assert left_behind(place, "demo") == before
    assert (place / "recording.h5").read_bytes() == contents


@pytest.mark.parametrize(
    "args",
    [
        ("explode",),
        ("--explode",),
        ("info",),
        ("info", "recording.h5", "--explode"),
        ("info", "recording.h5", "--seed", "-1"),
        ("calibrate", "recording.h5", "--sharpness", "loud"),
        ("compensate", "recording.h5", "out.h5"),
        ("simulate", "out.h5"),
        ("translate", "photo.jpg", "out.h5", "--thickness-mm", "5"),
        ("translate", "photo.jpg", "out.h5", "--optic", "plate"),
        ("board", "board.pdf", "--square-mm", "nan"),
        (
            "reconstruct",
            "recording.h5",
            "a.png",
            "--calibration",
            "calibration.json",
            "--turns",
            "0.1",
        ),
    ],
)
def test_wrong_usage_is_exit_2_and_one_line(place: Path, args: tuple[str, ...]) -> None:
    assert "--help" in fails(2, *args)
    assert left_behind(place) == set()


def test_a_turning_camera_without_a_prism(place: Path, data_dir: Path) -> None:
    """Estimate the camera's motion from a recording without a prism, then reconstruct the picture."""
    events = str(data_dir / "text" / "dynamic_rotation" / "events.txt")
    args = [
        "--free",
        "motion",
        "--start",
        "apex=0deg",
        "--start",
        "rate_y=20deg/s",
        "--bound",
        "rate_z=-1rad/s:1rad/s",
    ]
    found = ok("calibrate", events, "moving.json", *args, "--photometric-algorithm", "LN_BOBYQA")
    assert found["parameters"]["rate_y"]["value"] == pytest.approx(2.0, rel=0.05)
    assert found["parameters"]["rate_y"]["unit"] == "rad/s"
    picture = ok(
        "reconstruct", events, "moving.png", "--calibration", "moving.json", "--length", "0.02"
    )
    assert picture["residual"] < 0.3


INTERRUPTIBLE = (
    "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler); "
    "signal.signal(signal.SIGHUP, signal.SIG_DFL)"
)
"""Code that restores Ctrl-C and SIGHUP in a child process. A shell's background jobs ignore the one, what nohup runs
the other, and so do their children."""


@pytest.mark.parametrize(
    ("command", "number"),
    [("simulate", signal.SIGINT), ("simulate", signal.SIGTERM), ("simulate", signal.SIGHUP),
     ("calibrate", signal.SIGINT)],
)  # fmt: skip
def test_interrupt_leaves_nothing(place: Path, command: str, number: signal.Signals) -> None:
    args = {
        "simulate": ["simulate", "long.h5", "--picture", "photo.jpg", "--duration", "60"],
        "calibrate": ["calibrate", "recording.h5", "long.json", "--global-evaluations", "1000000"],
    }[command]
    script = f"{INTERRUPTIBLE}; sys.argv[0] = 'amiwarp'; from amiwarp.__main__ import main"
    script += (
        "; import amiwarp.calib.calibration as c; calibrate = c.calibrate; "
        "c.calibrate = lambda *a, **k: (print('at work', flush=True), calibrate(*a, **k))[1]; main()"
    )
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    process = subprocess.Popen(
        [sys.executable, "-c", script, *args], cwd=place, env=environment, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip
    with process:
        try:
            assert process.stdout is not None
            if command == "simulate":
                wait_until(lambda: any(file.name.endswith(".part") for file in place.iterdir()))
            else:
                assert process.stdout.readline() == "at work\n"
                # Interrupt at an arbitrary point of a calibration that would take hours
                time.sleep(1.0)
            process.send_signal(number)
            out, error = process.communicate(timeout=120)
        finally:
            process.kill()
    assert (process.returncode, out) == (130, ""), error
    assert error.count("\n") == 1, error
    assert left_behind(place) == set()


def test_interrupt_while_the_command_is_loaded_is_one_line() -> None:
    script = (
        "import sys, types; from amiwarp.__main__ import main\n"
        "def find(name, path, target=None):\n"
        "    if name == 'typer': raise KeyboardInterrupt\n"
        "sys.meta_path.insert(0, types.SimpleNamespace(find_spec=find)); main()"
    )
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, "-c", script], env=environment, text=True, capture_output=True, check=False
    )
    assert (done.returncode, done.stdout) == (130, "")
    assert done.stderr == "amiwarp: interrupted; nothing was left half-written\n"


def test_interrupt_inside_a_finaliser_while_the_command_is_loaded_is_one_line() -> None:
    script = (
        f"{INTERRUPTIBLE}; import sys, types; from amiwarp.__main__ import main\n"
        "class Dropping:\n"
        "    def __del__(self):\n"
        "        signal.raise_signal(signal.SIGINT)\n"
        "        for _ in range(10): pass\n"
        "def find(name, path, target=None):\n"
        "    if name == 'typer': Dropping()\n"
        "sys.meta_path.insert(0, types.SimpleNamespace(find_spec=find)); sys.argv[1:] = ['info', '--help']; main()"
    )
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, "-c", script], env=environment, text=True, capture_output=True, check=False
    )
    assert (done.returncode, done.stdout) == (130, "")
    assert done.stderr == "amiwarp: interrupted; nothing was left half-written\n"


def test_interrupt_inside_a_finaliser_is_not_lost(place: Path) -> None:
    """Python drops exceptions raised inside a finaliser; the command must end nevertheless."""
    script = f"""
{INTERRUPTIBLE}
import time
import amiwarp.io
from amiwarp.__main__ import main

class Dropping:
    def __del__(self):
        signal.raise_signal(signal.SIGINT)
        for _ in range(10):
            pass

def slow(*args, **extra):
    thing = Dropping()
    del thing
    time.sleep(3000)

amiwarp.io.open_recording = slow
main()
"""
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, "-c", script, "info", "recording.h5"],
        cwd=place, env=environment, capture_output=True, text=True, timeout=300,
    )  # fmt: skip
    assert (done.returncode, done.stdout) == (130, "")
    assert done.stderr.count("\n") == 1, done.stderr


def test_interrupt_while_h5py_is_loaded_is_not_lost(place: Path) -> None:
    """Code by Cython drops exceptions in places while a module is loaded, here the registration of a class."""
    script = f"""
{INTERRUPTIBLE}
import abc
from amiwarp.io.hdf5.chunk_file import ChunkFile
from amiwarp.__main__ import main

def register(cls, other):
    abc.ABCMeta.register = registered
    signal.raise_signal(signal.SIGINT)
    for _ in range(10):
        pass
    return registered(cls, other)

def created(*args, **options):
    global registered
    registered, abc.ABCMeta.register = abc.ABCMeta.register, register
    create(*args, **options)

create, ChunkFile.__init__ = ChunkFile.__init__, created
main()
"""
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, "-c", script, "simulate", "short.h5", "--picture", "photo.jpg", "--duration", "0.001"],
        cwd=place, env=environment, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stdout) == (130, "")
    assert done.stderr.count("\n") == 1, done.stderr
    assert left_behind(place) == set()


def wait_until(done: Any, seconds: float = 120.0) -> None:
    end = time.monotonic() + seconds
    while not done():
        assert time.monotonic() < end
        time.sleep(0.05)


def test_stdout_of_a_process_is_json_alone(place: Path) -> None:
    """Warp's banner and VTK's warnings do not appear on stdout."""
    args = [
        "compensate",
        "recording.h5",
        "out.h5",
        "--calibration",
        "calibration.json",
        "--json",
        "--device",
        "cpu",
    ]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, "-m", "amiwarp", *args],
        cwd=place,
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    )
    assert json.loads(done.stdout)["events"] > 0
    assert done.stderr == ""


ONE_IMAGE = """
import numpy as np
import warp as wp
{before}
import amiwarp

def image():
    x, t = np.arange(8, dtype=np.uint16), np.arange(8)
    amiwarp.iwe(amiwarp.Events(x, x, t, x.astype(np.uint8) % 2), 8, 8)

if __name__ == "__main__":
    import multiprocessing
    image()
    worker = multiprocessing.get_context("spawn").Process(target=image)
    worker.start()
    worker.join()
    print("level", wp.config.log_level)
"""


@pytest.mark.parametrize(
    ("before", "verbose", "level", "loads"),
    [("", "", 30, False), ("", "1", 20, True), ("wp.config.log_level = wp.LOG_DEBUG", "", 10, True),
     ("wp.config.log_level = wp.LOG_ERROR", "", 40, False)],
    ids=["default", "verbose", "own level, lower", "own level, higher"],
)  # fmt: skip
def test_warp_is_quiet_in_python_unless_wanted(
    tmp_path: Path, before: str, verbose: str, level: int, loads: bool
) -> None:
    """Warp's lines appear, of both processes, or nothing but results does, also while kernels are compiled."""
    (tmp_path / "program.py").write_text(ONE_IMAGE.format(before=before))
    environment = {
        **os.environ,
        "PYTHONPATH": str(ROOT),
        "AMIWARP_VERBOSE": verbose,
    }
    if not before and not verbose:
        environment["WARP_CACHE_PATH"] = str(tmp_path / "cache")
    done = subprocess.run(
        [sys.executable, "program.py"],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    )
    lines = done.stdout.splitlines()
    assert lines[-1] == f"level {level}"
    if loads:
        assert sum(line.startswith("Warp 1.") for line in lines) == 2
        assert sum(line.startswith("Module amiwarp.kernels.iwe ") for line in lines) >= 2
    else:
        assert lines == lines[-1:]


@pytest.mark.parametrize(
    ("text", "unit", "value"),
    [("90deg", "rad", np.pi / 2), ("1.5 rad", "rad", 1.5), ("-0.25ms", "us", -250.0), ("30", "us", 30.0),
     ("720rpm", "1/min", 720.0), ("90deg/s", "rad/s", np.pi / 2),
     ("2rad/s2", "rad/s2", 2.0), ("554", "px", 554.0), ("-720", "1/min", -720.0), ("1.5", "1", 1.5)],
)  # fmt: skip
def test_numbers_with_units(text: str, unit: str, value: float) -> None:
    assert number(text, unit, "x") == pytest.approx(value, abs=1e-12)


@pytest.mark.parametrize(
    ("text", "unit"),
    [("1", "rad"), ("1", "rad/s"), ("1rpm", "rad"), ("nan", "1"), ("", "us"), ("infdeg", "rad")],
)
def test_invalid_numbers_are_refused(text: str, unit: str) -> None:
    with pytest.raises(AmiwarpError, match="not a value"):
        number(text, unit, "x")
