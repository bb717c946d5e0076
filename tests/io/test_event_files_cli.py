"""``amiwarp info`` and ``amiwarp convert`` with files of other cameras: topics, triggers, estimates for large files."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from amiwarp import Events, open_recording
from reference.io_samples import make_events, write_dat, write_evt, write_native, write_text
from reference.io_samples_extra import (
    arrays,
    write_aedat2,
    write_evimo2,
    write_evt21,
    write_m3ed,
    write_ros1,
)
from tests.command_line import app

EVENTS = make_events(5000)


def run(*args: str | Path) -> str:
    result = CliRunner().invoke(app, [str(arg) for arg in args])
    assert result.exit_code == 0, result.stderr
    return result.stdout


def fails(*args: str | Path) -> str:
    result = CliRunner().invoke(app, [str(arg) for arg in args])
    assert result.exit_code == 1
    return " ".join(result.stderr.split())


@pytest.fixture
def large(monkeypatch: pytest.MonkeyPatch) -> None:
    """Treat files from 1 kB on as large, and their first 600 events as the part that is read, in blocks of 500."""
    monkeypatch.setattr("amiwarp.io.commands.LARGE_BYTES", 1000)
    monkeypatch.setattr("amiwarp.io.description.HEAD_EVENTS", 600)
    for name, value in (
        ("aedat.aedat2.DEFAULT_BLOCK", 500),
        ("prophesee.dat.PIECE_EVENTS", 500),
        ("prophesee.raw.EVT_BYTES", 4000),
        ("text.reader.READ_BYTES", 4000),
    ):
        monkeypatch.setattr(f"amiwarp.io.{name}", value)


def write_later_start(path: Path, events: Events) -> None:
    """Write a RAW file whose words count from 7 ms on."""
    header = "% evt 2.1\n% geometry 320x240\n% t0 7000\n"
    write_evt21(path, Events(events.x, events.y, events.t - 7000, events.p), header=header)


WRITERS: dict[str, Any] = {
    # name: (ending, writer, whether the end of the file tells the last time)
    "dat": ("dat", write_dat, True),
    "aedat2": ("aedat", write_aedat2, True),
    "evt21": ("raw", write_evt21, True),
    "evt21 from t0": ("raw", write_later_start, True),
    "text": ("txt", write_text, True),
}


@pytest.mark.usefixtures("large")
@pytest.mark.parametrize("name", WRITERS)
def test_large_files_are_estimated(tmp_path: Path, name: str) -> None:
    ending, write, tells_end = WRITERS[name]
    events = Events(EVENTS.x, EVENTS.y, EVENTS.t * 50, EVENTS.p)
    path = tmp_path / f"large.{ending}"
    write(path, events)
    data = json.loads(run("info", path, "--json"))
    assert data["estimated"] is True
    assert 0.05 < data["share_read"] < 0.3
    assert data["events"] == pytest.approx(len(events), rel=0.1)
    assert data["count_s"] > 0
    assert data["t_first_us"] == events.t[0]
    if tells_end:
        assert data["t_last_us"] == events.t[-1]
    text = run("info", path)
    assert "events" in text
    assert "--count counts them" in text
    counted = json.loads(run("info", path, "--count", "--json"))
    assert (counted["events"], counted["estimated"], counted["share_read"]) == (
        len(events),
        False,
        1.0,
    )
    assert "about" not in run("info", path, "--count")


@pytest.mark.usefixtures("large")
def test_large_files_with_an_index_are_exact(tmp_path: Path) -> None:
    write_native(tmp_path / "large.h5", EVENTS)
    data = json.loads(run("info", tmp_path / "large.h5", "--json"))
    assert (data["events"], data["estimated"], data["share_read"]) == (len(EVENTS), False, 0.12)
    assert (data["t_first_us"], data["t_last_us"]) == (EVENTS.t[0], EVENTS.t[-1])
    assert data["on_share"] == pytest.approx(EVENTS.p[:600].mean())
    assert "of the first 12 % of the file" in run("info", tmp_path / "large.h5")


@pytest.mark.usefixtures("large")
def test_large_folders_are_estimated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("amiwarp.io.numpy_arrays.DEFAULT_BLOCK", 500)
    write_evimo2(tmp_path / "scene", EVENTS)
    data = json.loads(run("info", tmp_path / "scene", "--json"))
    assert (data["events"], data["estimated"], data["share_read"]) == (len(EVENTS), True, 0.2)


@pytest.mark.usefixtures("large")
def test_small_parts_of_a_file_are_only_read_by_info(tmp_path: Path) -> None:
    write_dat(tmp_path / "large.dat", EVENTS)
    assert len(open_recording(tmp_path / "large.dat").events) == len(EVENTS)


def test_real_large_raw_file(data_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("amiwarp.io.commands.LARGE_BYTES", 1000)
    monkeypatch.setattr("amiwarp.io.description.HEAD_EVENTS", 1000)
    path = data_dir / "evt/evt2_balls_640x480.raw"
    data = json.loads(run("info", path, "--json"))
    # Where the system does not tell how far the decoder has read, all is read.
    assert data["events"] == pytest.approx(521_252, rel=0.2)
    source = open_recording(path).events
    assert (data["t_first_us"], data["t_last_us"]) == (source.t_first, source.t_last)


def test_info_of_other_records(data_dir: Path) -> None:
    text = run("info", data_dir / "aedat/aedat4_davis346_cars.aedat4")
    assert "4 frames, 160 imu samples" in text
    data = json.loads(run("info", data_dir / "aedat/aedat4_davis346_cars.aedat4", "--json"))
    assert (data["records"], data["repairs"]) == ({"frames": 4, "imu_samples": 160}, {})


def test_topics(tmp_path: Path) -> None:
    events = EVENTS[:300]
    topics = {"/left": arrays(events, ros1=True), "/right": arrays(events[:99], ros1=True)}
    write_ros1(tmp_path / "a.bag", topics)
    assert "/left" in fails("info", tmp_path / "a.bag")
    assert (
        json.loads(run("info", tmp_path / "a.bag", "--topic", "/right", "--json"))["events"] == 99
    )
    run("convert", tmp_path / "a.bag", tmp_path / "out.h5", "--topic", "/left", "--fov-deg", "60")
    assert len(open_recording(tmp_path / "out.h5").events) == 300
    write_m3ed(tmp_path / "b.h5", events, sides=("left", "right"))
    assert "prophesee/right" in fails("convert", tmp_path / "b.h5", tmp_path / "c.h5")
    run("convert", tmp_path / "b.h5", tmp_path / "c.h5", "--topic", "prophesee/right")
    assert open_recording(tmp_path / "c.h5").camera is not None


def test_layout_options(tmp_path: Path) -> None:
    """What is assumed is shown, and each option reaches the reader."""
    rows = [(7, 3, 2, 5000), (319, 319, 1, 1000)]  # x, y, polarity, t
    path = tmp_path / "events.csv"
    path.write_text("".join(f"{x},{y},{p},{t}\n" for x, y, p, t in rows))
    assert "--polarity" in fails("info", path)
    twice = fails("info", path, "--polarity", "1=on,2=off,1=off")
    assert "says both on and off of 1; give each value once" in twice
    options = ("--polarity", "1=on,2=off", "--columns", "x,y,p,t", "--sort")
    assert "--time-unit" not in fails("info", path, *options[:4])  # but --sort
    shown = run("info", path, *options)
    assert "assumed    time unit us: times are whole numbers" in shown
    assert "assumed    size 320x320: the file does not state it;" in shown
    assert "(--size)" in shown
    found = json.loads(
        run("info", path, *options, "--time-unit", "ms", "--size", "640x480", "--json")
    )
    assert (found["t_first_us"], found["width"], found["assumptions"]) == (1_000_000, 640, [])
    out = tmp_path / "out.h5"
    assert "note: assumed size 320x320 (--size)" in run("convert", path, out, *options)
    events = open_recording(out).events.slice(0, 2)
    assert [events.x.tolist(), events.y.tolist(), events.t.tolist(), events.p.tolist()] == [
        [319, 7], [319, 3], [1000, 5000], [1, 0],
    ]  # fmt: skip
    said = {
        "what": "size",
        "value": "320x320",
        "why": "the file does not state it; the smallest known sensor with all events",
        "option": "--size",
    }
    assert said in json.loads(run("info", out, "--json"))["assumptions"]
    scaled = tmp_path / "scaled.npz"
    np.savez(scaled, x=[64, 20448], y=[0, 32], t=[0, 9], p=[0, 1])
    run("convert", scaled, tmp_path / "scaled.h5", "--scale-xy", "32")
    assert open_recording(tmp_path / "scaled.h5").events.slice(0, 2).x.tolist() == [2, 639]


@pytest.mark.parametrize(
    ("command", "has_size"),
    [
        ("info", True), ("convert", True), ("calibrate", True), ("compensate", True), ("reconstruct", True),
        ("pixels", True), ("depth", True), ("lens", True),
        ("view", False), ("translate", False),  # whose --size means another one
    ],
)  # fmt: skip
def test_commands_that_open_event_files_have_the_options(command: str, has_size: bool) -> None:
    shown = " ".join(run(command, "--help").replace("│", " ").split())
    for option in ("--columns", "--time-unit", "--polarity", "--scale-xy", "--chip", "--sort"):
        assert option in shown
    assert ("which replaces the size in the file" in shown) == has_size


def test_translate_takes_the_layout_of_its_source(tmp_path: Path) -> None:
    path = tmp_path / "events.csv"
    path.write_text("".join(f"{k % 60},{k % 40},{k % 2 + 1},{100 * k}\n" for k in range(3000)))
    given = ("--columns", "x,y,p,t", "--time-unit", "us")
    assert "--polarity" in fails(
        "translate", path, tmp_path / "a.h5", "--apex-deg", "1", "--rpm", "600", *given
    )
    # Pictures have a rate, a recording has none
    options = (
        *given,
        "--polarity",
        "1=on,2=off",
        "--fps",
        "30",
    )
    assert "does not apply to a recording" in fails(
        "translate", path, tmp_path / "a.h5", "--apex-deg", "1", "--rpm", "600", *options
    )


def test_encoder_from_triggers(data_dir: Path, tmp_path: Path) -> None:
    path = data_dir / "rosbag/ros2_evt3_640x480_trig10Hz.db3"
    run("convert", path, tmp_path / "out.h5", "--encoder-from", "triggers:6")
    encoder = open_recording(tmp_path / "out.h5").encoder
    assert encoder is not None
    assert encoder.index_t is not None
    assert (len(encoder.index_t), encoder.rpm) == (18, pytest.approx(600.0))
    steps = ("--counts-per-turn", "2", "--direction", "-1", "--force")
    run("convert", path, tmp_path / "out.h5", "--encoder-from", "triggers:6", *steps)
    assert open_recording(tmp_path / "out.h5").encoder.rpm == pytest.approx(-300.0)  # type: ignore[union-attr]
    first, last = int(encoder.t[0]), int(encoder.t[-1])
    (tmp_path / "second.csv").write_text(
        f"t_us,angle_deg\n{first},0\n{last},{(last - first) * 0.001}\n"
    )
    second = ("--second-encoder", tmp_path / "second.csv", "--force")
    run("convert", path, tmp_path / "out.h5", "--encoder-from", "triggers:6", *second)
    pair = open_recording(tmp_path / "out.h5").encoder
    assert pair is not None
    assert pair.second is not None
    assert (pair.rpm, pair.second.rpm) == (pytest.approx(600.0), pytest.approx(1000.0 / 6.0))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--encoder-from", "triggers:x"), "write triggers:CHANNEL"),
        (("--encoder-from", "index:0"), "write triggers:CHANNEL"),
        (
            ("--encoder-from", "triggers:0", "--counter-bits", "8"),
            "--counter-bits describe an encoder log",
        ),
        (("--encoder-from", "triggers:0"), "expected at least 2; the rising edges are: none"),
        (("--direction", "-1"), "give --encoder or --encoder-from too"),
    ],
)
def test_encoder_from_refuses(tmp_path: Path, options: tuple[str, ...], message: str) -> None:
    write_evt("evt3")(tmp_path / "a.raw", EVENTS)
    assert message in fails("convert", tmp_path / "a.raw", tmp_path / "out.h5", *options)
    assert not (tmp_path / "out.h5").exists()
    assert np.array_equal(open_recording(tmp_path / "a.raw").events.slice(0, 9).x, EVENTS.x[:9])
