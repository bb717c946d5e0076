"""Commands ``live`` and ``record``: a whole rig, Ctrl-C and SIGKILL at any moment, a full disk, and pipes."""

from __future__ import annotations

import json
import math
import os
import re
import resource
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from typer.testing import CliRunner

from amiwarp import (
    AmiwarpError,
    Calibration,
    Camera,
    Encoder,
    Events,
    MemoryEvents,
    Prism,
    Recording,
    StageStatus,
    compensate,
    open_recording,
    save_recording,
)
from amiwarp.live.commands.session import describe
from amiwarp.live.stream import SessionStatus, encode_encoder, encode_events, encode_hello
from amiwarp.live.stream.sockets import close_listener, listen
from reference.calibration_sample import exact_calibration
from tests import ROOT
from tests.command_line import app
from tests.rig_world import LONG_S

CAMERA, PRISM = Camera.from_fov(64, 48, math.radians(60)), Prism(math.radians(2.0))
SCRIPT = (
    "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler); sys.argv[0] = 'amiwarp'; "
    "from amiwarp.__main__ import main; from amiwarp.cli import app; run = app.app; "
    "app.app = lambda **given: (print('up', file=sys.stderr, flush=True), run(**given)); main()"
)
"""Code of a child process that restores Ctrl-C (background jobs of a shell ignore it) and prints "up" once it runs."""
SENT = 400_000
HELLO = encode_hello(64, 48, CAMERA, PRISM)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with a recording of four seconds, a recording without encoder, and a calibration."""
    path, rng = tmp_path_factory.mktemp("stream"), np.random.default_rng(0)
    t = np.sort(rng.integers(0, 4_000_000, SENT))
    x, y = rng.integers(0, 64, SENT), rng.integers(0, 48, SENT)
    events = MemoryEvents(Events.from_arrays(x, y, t, rng.integers(0, 2, SENT)), 64, 48)
    encoder = Encoder.constant_speed(720.0, -5000, 4_005_000)
    save_recording(path / "recording.h5", Recording(events, CAMERA, encoder, PRISM))
    save_recording(path / "still.h5", Recording(events, CAMERA))
    values = {"apex": PRISM.apex, "phase": 0.4}
    exact_calibration(CAMERA, PRISM, values).save(path / "c.json")
    return path


PAIR_SENT = 50_000
TWO_ANGLES = {
    "pair": ("risley", {"apex": PRISM.apex, "second_apex": 0.02, "phase": 0.4, "second_phase": -0.3}),
    "mirror": ("mirror", {
        "amplitude": 0.02, "second_amplitude": 0.015, "phase": 0.4, "second_phase": -0.9, "direction": 0.1,
        "second_direction": 1.6, "fold": 0.3, "incidence": 0.8,
    }),
}  # fmt: skip
"""Models with two angles and their parameters, by the names of their files."""


@pytest.fixture(scope="module")
def two_angles(folder: Path) -> Path:
    """The folder, with recordings of a pair and of a mirror, each with its calibration, and of the first encoder alone.

    The mirror's angles are those of its commands. The encoders have other sample times, and a clock offset.
    """
    recording = open_recording(folder / "recording.h5")
    events = MemoryEvents(recording.events.slice(0, PAIR_SENT), 64, 48)
    t, other = np.arange(-5000, 520_000, 1000), np.arange(-5100, 520_000, 1300)
    first, second = Encoder(t, t * 7.5e-5, 250.0), Encoder(other, other * -5e-5)
    commands = [
        Encoder.from_command(s, np.sin(3e-4 * s) + 0.4 * np.cos(f * s))
        for s, f in ((t, 7e-4), (other, 5e-4))
    ]
    for name, encoder, prism in (
        ("pair", first.with_second(second), replace(PRISM, second=Prism(0.02))),
        ("mirror", commands[0].with_second(commands[1]), None),
        ("single", first, PRISM),
    ):
        save_recording(folder / f"{name}.h5", Recording(events, CAMERA, encoder, prism))
    for name, (model, values) in TWO_ANGLES.items():
        nominal = Prism(0.0) if name == "mirror" else replace(PRISM, second=Prism(0.02))
        replace(exact_calibration(CAMERA, nominal, values), model_name=model).save(
            folder / f"{name}.json"
        )
    return folder


def assert_same_recording(path: Path, expected: Path) -> None:
    """Assert that two files have the same sensor's events, samples of both encoders, camera and prism."""
    found, given = open_recording(path), open_recording(expected)
    n = len(given.events)
    for name in ("x", "y", "t", "p"):
        np.testing.assert_array_equal(
            getattr(found.events.slice(0, n + 1), name), getattr(given.events.slice(0, n), name)
        )
    assert (found.camera, found.prism) == (given.camera, given.prism)
    assert found.encoder is not None
    assert given.encoder is not None
    assert found.encoder.second is not None
    assert given.encoder.second is not None
    for one, other in (
        (found.encoder, given.encoder),
        (found.encoder.second, given.encoder.second),
    ):
        # Samples of a stream are on the events' clock
        shift = round(other.clock_offset_us - one.clock_offset_us)
        np.testing.assert_array_equal(one.t + shift, other.t)
        np.testing.assert_array_equal(one.angle, other.angle)


@pytest.mark.parametrize("name", list(TWO_ANGLES))
def test_a_replay_of_two_encoders_is_compensated_and_recorded_again(
    two_angles: Path, tmp_path: Path, name: str
) -> None:
    """``live`` replays the file, and passes its packets on to ``record``; both files are the recording."""
    source, calibration = two_angles / f"{name}.h5", two_angles / f"{name}.json"
    words = [sys.executable, "-c", "from amiwarp.__main__ import main; main()"]
    files = ["--out", tmp_path / "o.h5", "--record", tmp_path / "r.h5", "--raw-to", "-"]
    args = ["live", source, "--fast", "--calibration", calibration, "--device", "cpu", *files]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    with subprocess.Popen(
        [*words, *map(str, args)], env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as live:
        record = [*words, "record", "-", str(tmp_path / "h.h5"), "--json"]
        done = subprocess.run(
            record, env=environment, stdin=live.stdout, capture_output=True, check=True
        )
        assert live.stderr is not None
        error = live.stderr.read().decode()
    assert live.returncode == 0, error
    assert open_recording(tmp_path / "r.h5").metadata.get("optic") == (
        "mirror" if name == "mirror" else None
    )
    assert f"{PAIR_SENT:,} events" in error
    assert json.loads(done.stdout)["events"] == PAIR_SENT
    for copy in ("r.h5", "h.h5"):
        assert_same_recording(tmp_path / copy, source)
    compensate(open_recording(source), Calibration.load(calibration), tmp_path / "offline.h5")
    with h5py.File(tmp_path / "o.h5") as file:
        assert not file["events/extrapolated"][:].any()
    found, offline = (open_recording(tmp_path / n) for n in ("o.h5", "offline.h5"))
    for column in ("x", "y", "t", "p"):
        columns = (getattr(each.events.slice(0, PAIR_SENT), column) for each in (found, offline))
        np.testing.assert_array_equal(*columns)
    assert found.encoder is not None
    assert found.encoder.second is not None


def test_geared_prisms_are_recorded_with_both_angles(two_angles: Path, tmp_path: Path) -> None:
    run = CliRunner().invoke
    done = run(
        app,
        [
            "record",
            str(two_angles / "single.h5"),
            str(tmp_path / "r.h5"),
            "--fast",
            "--second-ratio",
            "-0.5",
        ],
    )
    assert done.exit_code == 0, done.stderr
    found, given = (
        open_recording(path).encoder for path in (tmp_path / "r.h5", two_angles / "single.h5")
    )
    assert found is not None
    assert given is not None
    t = np.arange(0, 500_000, 777)
    np.testing.assert_array_equal(found.angles_at(t), given.with_second(-0.5).angles_at(t))
    args = [
        "live",
        str(two_angles / "single.h5"),
        "--fast",
        "--calibration",
        str(two_angles / "pair.json"),
    ]
    done = run(
        app, [*args, "--second-ratio", "-0.5", "--out", str(tmp_path / "o.h5"), "--device", "cpu"]
    )
    assert done.exit_code == 0, done.stderr
    pair = Calibration.load(two_angles / "pair.json")
    compensate(open_recording(tmp_path / "r.h5"), pair, tmp_path / "offline.h5")
    live, offline = (
        open_recording(tmp_path / n).events.slice(0, PAIR_SENT) for n in ("o.h5", "offline.h5")
    )
    np.testing.assert_array_equal(live.x, offline.x)
    np.testing.assert_array_equal(live.y, offline.y)


@pytest.mark.parametrize(
    ("args", "says"),
    [
        ("live single.h5 --calibration pair.json", "single.h5: there are samples of one encoder, but the calibration "
         "belongs to a pair of prisms, which has two angles; give a source with the samples of both encoders"),
        ("live single.h5 --calibration mirror.json", "or --second-ratio if both are geared"),
        ("live pair.h5 --calibration c.json", "pair.h5: there are two prism angles, but the calibrated "
         "model, exact, has one; give a calibration of a pair"),
        ("live single.h5 --calibration c.json --second-ratio 1", "there are two prism angles"),
        ("live pair.h5 --calibration pair.json --second-ratio 1", "both encoders; leave --second-ratio out"),
        ("record pair.h5 o.h5 --second-ratio 1", "both encoders; leave --second-ratio out"),
        ("record single.h5 o.h5 --second-ratio nan", "--second-ratio = nan"),
        ("emulate --recording pair.h5 --camera unix:none", "two encoders, the emulated controller one"),
        ("lens pair.h5 camera.json --live", "a lens is calibrated with one prism"),
    ],
)  # fmt: skip
def test_two_encoders_where_they_do_not_fit_are_one_line(
    two_angles: Path, monkeypatch: pytest.MonkeyPatch, args: str, says: str
) -> None:
    monkeypatch.chdir(two_angles)
    before = set(two_angles.iterdir())
    done = CliRunner().invoke(app, args.split())
    assert (done.exit_code, done.stderr.count("\n")) == (1, 1), done.output
    assert says in done.stderr
    assert set(two_angles.iterdir()) == before


def test_a_controller_measures_one_prism(two_angles: Path, tmp_path: Path) -> None:
    """Its encoder replaces those of the source. The second angle then follows by the ratio of the speeds."""
    from amiwarp.live.link import Controller, Motor, PseudoTerminal

    run = CliRunner().invoke
    with PseudoTerminal(Controller(Motor(720.0)), tmp_path / "prism") as port:
        args = [
            "live",
            str(two_angles / "pair.h5"),
            "--port",
            port.name,
            "--calibration",
            str(two_angles / "pair.json"),
        ]
        refused = run(app, args)
        adaptive = run(app, [*args, "--second-ratio", "-0.7", "--adaptive"])
        done = run(app, ["record", str(two_angles / "pair.h5"), str(tmp_path / "r.h5"), "--port", port.name,
                         "--second-ratio", "-0.7"])  # fmt: skip
    assert "leave --port out to take the samples of the source, or --second-ratio" in refused.stderr
    assert "--adaptive sets the speed of one prism" in adaptive.stderr
    assert done.exit_code == 0, done.stderr
    assert (
        "controller: firmware 1.1.0 on emulated, supply unknown: its pin is not connected\n"
        in done.stdout
    )
    encoder = open_recording(tmp_path / "r.h5").encoder
    assert encoder is not None
    assert encoder.second is not None
    np.testing.assert_array_equal(encoder.second.t, encoder.t)
    np.testing.assert_array_equal(encoder.second.angle, -0.7 * encoder.angle)


PATIENT = "import amiwarp.live.stream.sockets as sockets; sockets.DRAIN_S = 120.0; "
"""Code placed before a command that serves packets: at the end it waits longer for slow receivers."""


def start(
    args: Sequence[str | Path], *, before: str = "", **given: object
) -> subprocess.Popen[str]:
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    return subprocess.Popen(
        [sys.executable, "-c", before + SCRIPT, *map(str, args)], env=environment, text=True, stdout=subprocess.PIPE,
        stderr=subprocess.PIPE, **given,
    )  # type: ignore[call-overload,no-any-return]  # fmt: skip


def times(path: Path) -> np.ndarray:
    events = open_recording(path).events
    return events.slice(0, len(events)).t if len(events) else np.zeros(0, np.int64)


def reached(done: Callable[[], object], process: subprocess.Popen[str] | None = None) -> None:
    until = time.monotonic() + LONG_S
    while not done():
        assert time.monotonic() < until
        assert process is None or process.poll() is None, process.communicate()
        time.sleep(0.01)


def flushed(part: Path) -> int:
    """Return the number of events in a recording that is being written; 0 if it cannot be read yet."""
    copy = part.with_name("copy.h5")
    try:
        shutil.copyfile(part, copy)
        return len(open_recording(copy).events)
    except (AmiwarpError, OSError):
        return 0
    finally:
        copy.unlink(missing_ok=True)


def test_a_replayed_file_is_compensated_recorded_and_reported(folder: Path, tmp_path: Path) -> None:
    args = [
        "live",
        folder / "recording.h5",
        "--fast",
        "--calibration",
        folder / "c.json",
        "--json",
        "--device",
        "cpu",
    ]
    done = CliRunner().invoke(
        app, [*map(str, args), "--out", str(tmp_path / "o.h5"), "--record", str(tmp_path / "r.h5")]
    )
    assert done.exit_code == 0, done.stderr
    said = json.loads(done.stdout)
    assert said["events"] == said["compensated"] == SENT
    assert said["dropped"] == said["without_angle"] == said["late"] == 0
    np.testing.assert_array_equal(times(tmp_path / "r.h5"), times(folder / "recording.h5"))
    compensate(
        open_recording(tmp_path / "r.h5"),
        Calibration.load(folder / "c.json"),
        tmp_path / "offline.h5",
    )
    live, offline = (open_recording(tmp_path / name).events for name in ("o.h5", "offline.h5"))
    for name in ("x", "y", "t", "p"):
        np.testing.assert_array_equal(
            getattr(live.slice(0, SENT), name), getattr(offline.slice(0, SENT), name)
        )
    assert {p.name for p in tmp_path.iterdir()} == {"o.h5", "r.h5", "offline.h5"}


def test_a_recording_ends_at_the_given_time(folder: Path, tmp_path: Path) -> None:
    args = [
        "record",
        str(folder / "recording.h5"),
        str(tmp_path / "r.h5"),
        "--seconds",
        "0.001",
        "--json",
    ]
    done = CliRunner().invoke(app, args)
    assert done.exit_code == 0, done.stderr
    assert json.loads(done.stdout)["events"] < SENT


def test_addresses_that_the_system_chose_are_reported(folder: Path) -> None:
    args = [
        "live",
        str(folder / "recording.h5"),
        "--fast",
        "--calibration",
        str(folder / "c.json"),
        "--device",
        "cpu",
    ]
    done = CliRunner().invoke(app, [*args, "--to", "tcp::0", "--raw-to", "tcp::0", "--json"])
    assert done.exit_code == 0, done.stderr
    said = json.loads(done.stdout)["messages"]
    assert done.stderr.splitlines() == said
    found = [
        re.fullmatch(r"(\w+) packets are served at tcp:127\.0\.0\.1:(\d+)", text) for text in said
    ]
    assert [match and match[1] for match in found] == ["uncompensated", "compensated"]
    assert all(match and int(match[2]) > 0 for match in found)


@pytest.mark.parametrize("when", ["up", "opened", "flowing"])
def test_interrupted_recordings_are_whole_files(folder: Path, tmp_path: Path, when: str) -> None:
    """Ctrl-C during the start leaves no file; later it leaves a file with all events received so far."""
    out = tmp_path / "r.h5"
    with start(["record", folder / "recording.h5", out, "--json"]) as process:
        try:
            assert process.stderr is not None
            assert process.stderr.readline() == "up\n"
            if when != "up":
                reached((tmp_path / "r.part.h5").exists)
            if when == "flowing":
                reached(lambda: flushed(tmp_path / "r.part.h5") > 0)
            process.send_signal(signal.SIGINT)
            said, error = process.communicate(timeout=LONG_S)
        finally:
            process.kill()
    if process.returncode == 130 and when != "flowing":
        assert "interrupted" in error
        assert list(tmp_path.iterdir()) == []
        return
    assert (process.returncode, error) == (0, "")
    assert json.loads(said)["events"] == len(times(out))
    assert {p.name for p in tmp_path.iterdir()} == {"r.h5"}
    np.testing.assert_array_equal(times(out), times(folder / "recording.h5")[: len(times(out))])


def test_a_killed_recording_holds_what_came_before_its_last_moment(
    folder: Path, tmp_path: Path
) -> None:
    """Received events are written soon, even if no more arrive. SIGKILL loses only the most recent ones."""
    out, part = tmp_path / "r.h5", tmp_path / "r.part.h5"
    recording = open_recording(folder / "recording.h5")
    assert recording.encoder is not None
    sent, t, angle = recording.events.slice(0, SENT), recording.encoder.t, recording.encoder.angle
    server, address = listen(f"unix:{tmp_path / 's'}")
    server.settimeout(LONG_S)
    with start(["record", address, out]) as process:
        try:
            with server.accept()[0] as sender:
                sender.settimeout(LONG_S)
                sender.sendall(HELLO + encode_encoder(t[t < 2_000_000], angle[t < 2_000_000]))
                sender.sendall(encode_events(sent[:200_000]))
                reached(lambda: flushed(part) == 200_000, process)
                sender.sendall(encode_events(sent[200_000:300_000]))
                process.kill()
                process.communicate()
        finally:
            process.kill()
            process.communicate()
            close_listener(server)
    assert not out.exists()
    found = times(part)
    assert len(found) >= 200_000
    np.testing.assert_array_equal(found, sent.t[: len(found)])
    encoder = open_recording(part).encoder
    assert encoder is not None
    np.testing.assert_array_equal(encoder.t, t[t < 2_000_000])


def test_a_full_disk_ends_it_and_keeps_what_came(folder: Path, tmp_path: Path) -> None:
    """A limit on the file size simulates the full disk."""
    out, most = tmp_path / "r.h5", 4_600_000

    def limit() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (most, most))

    with start(["record", folder / "recording.h5", out, "--fast"], preexec_fn=limit) as process:
        _, error = process.communicate(timeout=LONG_S)
    assert process.returncode == 1
    line = error.splitlines()[-1]
    assert str(out) in line
    assert "make room" in line
    kept = times(out)
    assert f"{len(kept)} events" in line
    np.testing.assert_array_equal(kept, times(folder / "recording.h5")[: len(kept)])
    assert {p.name for p in tmp_path.iterdir()} == {"r.h5"}


def relayed(server: socket.socket, camera: Path, go: threading.Event) -> None:
    """Relay the emulated camera to one client. Connect to the camera, which then starts to play, once ``go`` is set."""
    with server.accept()[0] as client, socket.socket(socket.AF_UNIX) as source:
        client.sendall(HELLO)
        assert go.wait(LONG_S)
        source.connect(str(camera))
        with source.makefile("rb") as stream:
            assert stream.read(len(HELLO)) == HELLO
            while data := stream.read1(1 << 16):
                client.sendall(data)


def test_a_rig_as_three_commands(folder: Path, tmp_path: Path) -> None:
    """Run ``emulate`` with its camera, ``live`` on its port, and ``record`` on the packets that ``live`` passes on."""
    rig = [
        "emulate",
        "--link",
        tmp_path / "prism",
        "--recording",
        folder / "recording.h5",
        "--counts-per-turn",
        65536,
    ]
    handed, recording = f"unix:{tmp_path / 'handed'}", threading.Event()
    server, served = listen(f"unix:{tmp_path / 'relay'}")
    server.settimeout(LONG_S)
    relay = threading.Thread(
        target=relayed, args=(server, tmp_path / "camera", recording), daemon=True
    )
    relay.start()
    with start([*rig, "--camera", f"unix:{tmp_path / 'camera'}"]) as emulator:
        try:
            assert emulator.stdout is not None
            assert emulator.stdout.readline().strip() == str(tmp_path / "prism")
            args = [
                "live",
                served,
                "--port",
                tmp_path / "prism",
                "--calibration",
                folder / "c.json",
                "--device",
                "cpu",
            ]
            files = [
                "--out",
                tmp_path / "o.h5",
                "--record",
                tmp_path / "r.h5",
                "--raw-to",
                handed,
                "--wait-ms",
                50,
            ]
            with start([*args, *files, "--json"], before=PATIENT) as live:
                reached((tmp_path / "handed").exists, live)
                with start(["record", handed, tmp_path / "h.h5", "--json"]) as record:
                    reached((tmp_path / "h.part.h5").exists, record)  # it has connected
                    recording.set()
                    said, error = live.communicate(timeout=LONG_S)
                    recorded, other = record.communicate(timeout=LONG_S)
            assert live.returncode == 0, error
            assert record.returncode == 0, other
            emulator.communicate(timeout=LONG_S)
            assert emulator.returncode == 0
        finally:
            emulator.kill()
            relay.join(LONG_S)
            close_listener(server)
    data = json.loads(said)
    assert data["events"] == data["compensated"] == SENT
    assert data["dropped"] == data["late"] == 0
    # on a busy machine samples arrive late: those angles are marked, all others equal those of offline compensation
    with h5py.File(tmp_path / "o.h5") as file:
        marked = file["events/extrapolated"][:].astype(bool)
    assert np.count_nonzero(marked) == data["extrapolated"] + data["without_angle"]
    compensate(
        open_recording(tmp_path / "r.h5"),
        Calibration.load(folder / "c.json"),
        tmp_path / "offline.h5",
    )
    live_events, offline = (
        open_recording(tmp_path / name).events.slice(0, SENT) for name in ("o.h5", "offline.h5")
    )
    np.testing.assert_array_equal(live_events.t, offline.t)
    apart = np.hypot(live_events.x - offline.x, live_events.y - offline.y)
    assert (apart[~marked] <= 1e-3).all()
    # the client that connected before the camera started has received all events
    assert json.loads(recorded)["events"] == SENT
    np.testing.assert_array_equal(times(tmp_path / "h.h5"), times(folder / "recording.h5"))
    assert not [p for p in tmp_path.iterdir() if p.name in ("prism", "camera", "handed")]


def test_an_adaptive_speed_reaches_the_motor(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The motor starts from rest. Random events exceed the allowed event rate, so the speed is reduced."""
    from amiwarp.live.link import Controller, Motor, PseudoTerminal

    motor = Motor()
    monkeypatch.setattr("amiwarp.live.link.link.ANSWER_S", LONG_S)
    with PseudoTerminal(Controller(motor, supply_mv=11_900), tmp_path / "prism") as port:
        args = [
            "live",
            str(folder / "recording.h5"),
            "--port",
            port.name,
            "--calibration",
            str(folder / "c.json"),
        ]
        options = ["--adaptive", "--most-mev-s", "0.05", "--device", "cpu", "--json"]
        done = CliRunner().invoke(app, [*args, *options])
    assert done.exit_code == 0, done.stderr
    assert 119.0 < motor.target_rpm(0) < 715.0
    said = json.loads(done.stdout)
    controller = said["controller"]
    assert (controller["firmware"], controller["board"], controller["supply_v"]) == (
        "1.1.0",
        "emulated",
        11.9,
    )
    assert said["events"] == said["compensated"] == SENT


@pytest.mark.parametrize(
    ("args", "says"),
    [
        (["live", "still.h5", "--calibration", "c.json"], "still.h5: contains no encoder samples"),
        (["record", "still.h5", "o.h5"], "give the controller's --port"),
        (
            ["live", "recording.h5", "--calibration", "c.json", "--adaptive"],
            "give the controller's --port",
        ),
        (["live", "nowhere.h5", "--calibration", "c.json"], "nowhere.h5"),
        (["live", "tcp:127.0.0.1:1", "--calibration", "c.json"], "tcp:127.0.0.1:1"),
        (
            ["live", "recording.h5", "--calibration", "c.json", "--port", "/dev/no-such-port"],
            "/dev/no-such-port",
        ),
        (["record", "recording.h5", "nowhere/o.h5", "--fast"], "nowhere"),
        (["record", "dv", "o.h5"], "amiwarp[dv]"),
        (
            ["live", "recording.h5", "--calibration", "c.json", "--to", "-", "--raw-to", "-"],
            "mix two streams",
        ),
        (
            ["live", "recording.h5", "--calibration", "c.json", "--raw-to", "-", "--json"],
            "--json and --raw-to - both",
        ),
        (
            ["live", "recording.h5", "--calibration", "c.json", "--limit-rpm", "900"],
            "apply to --adaptive",
        ),
        (
            [
                "live",
                "recording.h5",
                "--calibration",
                "c.json",
                "--adaptive",
                "--least-rpm",
                "2000",
            ],
            "--least-rpm 2000",
        ),
        (["record", "recording.h5", "o.h5", "--counts-per-turn", "9"], "give its --port"),
        (
            ["emulate", "--recording", "recording.h5", "--camera", "unix:none", "--rpm", "9"],
            "--rpm applies to",
        ),
        (["emulate", "--link", "nowhere/prism"], "there is no folder nowhere"),
    ],
    ids=lambda v: " ".join(v) if isinstance(v, list) else "",
)
def test_bad_input_is_one_line(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, args: list[str], says: str
) -> None:
    monkeypatch.chdir(folder)
    monkeypatch.setitem(sys.modules, "dv_processing", None)  # as if it were not installed
    before = set(folder.iterdir())
    done = CliRunner().invoke(app, args)
    assert done.exit_code == 1
    assert says in done.stderr
    assert done.stderr.count("\n") == 1
    assert set(folder.iterdir()) == before


def test_another_camera_is_refused(folder: Path, tmp_path: Path) -> None:
    values = {"apex": PRISM.apex, "phase": 0.4}
    other = exact_calibration(Camera.from_fov(32, 24, 1.0), PRISM, values)
    other.save(tmp_path / "other.json")
    done = CliRunner().invoke(
        app, ["live", str(folder / "recording.h5"), "--calibration", str(tmp_path / "other.json")]
    )
    assert done.exit_code == 1
    assert re.search(r"is 64x48, the calibration is for 32x24", done.stderr)


def test_the_status_line_fits_the_terminal() -> None:
    """The figures that matter least are left out first; losses are always shown."""
    plain = SessionStatus(seconds=3.04, events=1_234_567, rate_mev_s=0.4)
    assert describe(plain) == "3.0 s, 0.40 Mev/s, 1,234,567 events"
    full = replace(
        plain, seconds=99_999.0, events=10**12, rate_mev_s=1234.5, dropped=10**9, late=10**6, waiting=8_000_000, done=5,
        latency_ms=(12.3, 99.0), covered=0.987, sharpness=12.3, rpm=720.0, coverage=0.5,
    )  # fmt: skip
    for width in (40, 80, 100, 200):
        assert len(describe(full, width)) <= width
    assert describe(full).startswith(
        "99999.0 s, 1234.50 Mev/s, 1,000,000,000 dropped, 1,000,000 late"
    )
    assert "8,000,000 waiting" in describe(full, 200)
    assert "latency 12.3 ms, encoder 98.7 %, 720 rpm, sharpness 12.30, edges 50 %" in describe(
        full, 200
    )


def test_the_status_line_of_a_plain_stream_names_no_encoder() -> None:
    stages = [StageStatus("read", 200, 200), StageStatus("filter", 200, 50)]
    status = SessionStatus(seconds=1.0, events=200, done=50, latency_ms=(3.0, 4.0), stages=stages)
    text = describe(status, 200)
    assert "latency 3.0 ms" in text
    assert "filter keeps 25 %" in text
    assert "encoder" not in text
    status.stages.append(StageStatus("compensate", 50, 50))
    assert "encoder 100.0 %" in describe(status, 200)
