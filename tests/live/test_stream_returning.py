"""Streams that break off: what came is kept and it is said; with ``--wait-for-source`` the sender may come back."""

from __future__ import annotations

import json
import math
import os
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from amiwarp import AmiwarpError, Camera, Encoder, Events, Packet, Prism, open_recording
from amiwarp.live.stream import (
    RecentEvents,
    encode_encoder,
    encode_end,
    encode_events,
    encode_hello,
    encode_triggers,
    open_source,
    reopen_source,
    returning_source,
    sources,
)
from amiwarp.live.stream.recent_events import followed
from amiwarp.live.stream.sockets import close_listener, listen
from reference.calibration_sample import exact_calibration
from tests.command_line import app
from tests.live.test_stream_cli import start

CAMERA, PRISM = Camera.from_fov(64, 48, math.radians(60)), Prism(math.radians(2.0))
HELLO = encode_hello(64, 48, CAMERA, PRISM)
END = encode_end()
N = 3000
LONG_S = 120.0


def part(start_us: int, n: int = N) -> bytes:
    """Events over 0.3 s and the angles that belong to them."""
    rng, turning = (
        np.random.default_rng(start_us % 1000),
        Encoder.constant_speed(720.0, start_us - 5000, start_us + 305_000),
    )
    t = np.sort(rng.integers(start_us, start_us + 300_000, n))
    events = Events.from_arrays(
        rng.integers(0, 64, n), rng.integers(0, 48, n), t, rng.integers(0, 2, n)
    )
    return encode_encoder(turning.t, turning.angle) + encode_events(events)


def sent(path: Path) -> np.ndarray:
    events = open_recording(path).events
    return events.slice(0, len(events)).t


@contextmanager
def sender(path: Path, *streams: bytes | Callable[[], bytes]) -> Iterator[str]:
    """Sends one stream to each who connects, and closes the connection."""
    server, address = listen(f"unix:{path}")

    def run() -> None:
        for stream in streams:
            try:
                connection, _ = server.accept()
            except OSError:
                return
            with connection:
                connection.sendall(stream if isinstance(stream, bytes) else stream())

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    try:
        yield address
    finally:
        server.shutdown(socket.SHUT_RDWR)
        thread.join(LONG_S)
        close_listener(server)


@pytest.fixture(scope="module")
def calibration(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("known") / "c.json"
    values = {"apex": PRISM.apex, "phase": 0.4}
    exact_calibration(CAMERA, PRISM, values).save(path)
    return path


@pytest.mark.parametrize("command", ["record", "live"])
@pytest.mark.parametrize("tail", [b"", END[:7]])
def test_a_stream_that_breaks_off_is_a_failure_with_whole_files(
    tmp_path: Path, calibration: Path, command: str, tail: bytes
) -> None:
    with sender(tmp_path / "s", HELLO + part(0) + tail) as address:
        out = tmp_path / "o.h5"
        given = (
            [str(out)]
            if command == "record"
            else ["--calibration", str(calibration), "--out", str(out), "--device", "cpu"]
        )
        done = CliRunner().invoke(app, [command, address, *given, "--json"])
    assert done.exit_code == 1
    (line,) = done.stderr.splitlines()
    assert f"{address}: the stream broke off: ended " in line
    assert f"the {N:,} events received until then are kept" in line
    assert "--wait-for-source" in line
    assert len(sent(out)) == json.loads(done.stdout)["events"] == N
    assert json.loads(done.stdout)["broke_off"] in line
    assert {p.name for p in tmp_path.iterdir()} == {"o.h5"}


def test_a_whole_stream_is_none(tmp_path: Path) -> None:
    with sender(tmp_path / "s", HELLO + part(0) + END) as address:
        done = CliRunner().invoke(
            app, ["record", address, str(tmp_path / "o.h5"), "--json", "--wait-for-source", "30"]
        )
    assert (done.exit_code, done.stderr) == (0, "")
    assert json.loads(done.stdout)["broke_off"] is None
    assert json.loads(done.stdout)["returns"] == 0


@pytest.mark.parametrize("command", ["record", "live"])
def test_a_sender_that_returns_is_gone_on_with(
    tmp_path: Path, calibration: Path, command: str
) -> None:
    """Also twice, and also when it is cut before its hello."""
    streams = [HELLO + part(0), HELLO + part(400_000), HELLO[:9], HELLO + part(800_000) + END]
    with sender(tmp_path / "s", *streams) as address:
        out = tmp_path / "o.h5"
        given = (
            [str(out)]
            if command == "record"
            else ["--calibration", str(calibration), "--out", str(out), "--device", "cpu"]
        )
        done = CliRunner().invoke(
            app, [command, address, *given, "--json", "--wait-for-source", "60"]
        )
    assert done.exit_code == 0, done.stderr
    said = json.loads(done.stdout)
    assert (said["events"], said["returns"], said["broke_off"], said["late"]) == (3 * N, 2, None, 0)
    assert "the stream broke off after 3,000 events" in said["messages"][0]
    assert "waiting up to 60 s" in said["messages"][0]
    assert "the stream is back after" in said["messages"][1]
    t = sent(out)
    assert len(t) == 3 * N
    assert (np.diff(t) >= 0).all()


@pytest.mark.parametrize(
    ("back", "says"),
    [
        (HELLO + part(100_000) + END, "its clock restarted"),
        (encode_hello(32, 24) + END, "is back with a camera of 32x24 pixels, before it had 64x48"),
        (encode_hello(64, 48) + END, "is back with another camera, prism or number of encoders"),
        (
            encode_hello(64, 48, CAMERA, PRISM, 2) + END,
            "is back with another camera, prism or number of encoders",
        ),
        (b"GET / HTTP/1.1\r\n\r\n    ", "it begins with b'GET '"),
    ],
)
def test_another_camera_or_clock_is_not_gone_on_with(
    tmp_path: Path, back: bytes, says: str
) -> None:
    with sender(tmp_path / "s", HELLO + part(0), back) as address:
        done = CliRunner().invoke(
            app, ["record", address, str(tmp_path / "o.h5"), "--wait-for-source", "60"]
        )
    assert done.exit_code == 1
    assert says in done.stderr.splitlines()[-1]
    assert len(sent(tmp_path / "o.h5")) == N


def test_a_clock_that_does_not_fit_the_hosts_is_said(tmp_path: Path) -> None:
    """In order, but an hour ahead after a moment."""
    said: list[str] = []
    with sender(tmp_path / "s", HELLO + part(0), HELLO + part(3_600_000_000) + END) as address:
        packets = list(open_source(address, wait_s=LONG_S, say=said.append).packets())
    assert sum(len(packet.events) for packet in packets) == 2 * N
    assert [packet.returned for packet in packets].count(True) == 1
    assert "3599.7 s passed on the camera's clock" in said[-1]
    assert "may have restarted" in said[-1]


def test_a_sender_that_does_not_return_ends_it(tmp_path: Path) -> None:
    with sender(tmp_path / "s", HELLO + part(0)) as address:
        done = CliRunner().invoke(
            app, ["record", address, str(tmp_path / "o.h5"), "--wait-for-source", "0.5"]
        )
    assert done.exit_code == 1
    assert "its sender was not back in " in done.stderr.splitlines()[-1]
    assert len(sent(tmp_path / "o.h5")) == N


def test_a_sender_that_connects_may_return(tmp_path: Path) -> None:
    path, said = tmp_path / "s", []
    got: list[Packet] = []

    def read() -> None:
        source = open_source(f"unix-listen:{path}", wait_s=LONG_S, say=said.append)
        got.extend(source.packets())

    thread = threading.Thread(target=read, daemon=True)
    thread.start()
    for k, stream in enumerate((HELLO + part(0), HELLO + part(400_000) + END)):
        with socket.socket(socket.AF_UNIX) as ours:
            until = time.monotonic() + LONG_S
            while len(said) < k:  # it listens again after that
                assert time.monotonic() < until
                time.sleep(0.01)
            while ours.connect_ex(str(path)):
                assert time.monotonic() < until
                time.sleep(0.01)
            ours.sendall(stream)
    thread.join(LONG_S)
    assert not thread.is_alive()
    assert sum(len(packet.events) for packet in got) == 2 * N
    assert len(said) == 2
    assert not path.exists()


@pytest.mark.parametrize("spec", ["-", "recording.h5"])
def test_files_and_pipes_do_not_return(tmp_path: Path, spec: str) -> None:
    done = CliRunner().invoke(
        app, ["record", spec, str(tmp_path / "o.h5"), "--wait-for-source", "5"]
    )
    assert done.exit_code == 1
    assert f"{spec}: --wait-for-source applies to streams and cameras only" in done.stderr
    assert done.stderr.count("\n") == 1


def test_a_wait_for_a_sender_can_be_interrupted(tmp_path: Path) -> None:
    """Ctrl-C ends it with a whole file, and says what is missing."""
    args = ["record", f"unix:{tmp_path / 's'}", tmp_path / "o.h5", "--wait-for-source", "100000"]
    with sender(tmp_path / "s", HELLO + part(0)), start(args) as process:
        try:
            assert process.stderr is not None
            while "waiting up to" not in process.stderr.readline():
                assert process.poll() is None
            process.send_signal(signal.SIGINT)
            _, error = process.communicate(timeout=LONG_S)
        finally:
            process.kill()
    assert process.returncode == 1
    assert "the stream broke off" in error
    assert len(sent(tmp_path / "o.h5")) == N


def test_a_view_says_that_its_stream_broke_off(tmp_path: Path) -> None:
    said: list[str] = []
    with sender(tmp_path / "s", HELLO + part(0)) as address:
        source = open_source(address)
        ring = RecentEvents(source)
        with followed(source, None, ring, said.append):
            until = time.monotonic() + LONG_S
            while not said:
                assert time.monotonic() < until
                time.sleep(0.01)
    assert "the stream broke off: ended without an end packet" in said[0]
    assert "3,000 events" in said[0]


def test_a_camera_is_opened_again_once_it_is_back(monkeypatch: pytest.MonkeyPatch) -> None:
    tries: list[str] = []

    def opened(spec: str) -> str:
        tries.append(spec)
        if len(tries) < 3:
            raise AmiwarpError("no such camera")
        return f"source of {spec}"

    monkeypatch.setattr(sources, "open_source", opened)
    monkeypatch.setattr(returning_source, "REOPEN_S", 0.01)
    stop = threading.Event()
    assert reopen_source("dv:1", stop) == "source of dv:1"  # type: ignore[comparison-overlap]
    assert tries == ["dv:1"] * 3
    assert reopen_source("recording.h5", stop) is None  # would be played again and again
    stop.set()
    for spec in ("prophesee", f"unix:{os.devnull}", "tcp-listen:127.0.0.1:0"):
        assert reopen_source(spec, stop) is None
    assert len(tries) == 3


def test_a_view_of_less_than_a_turn_says_how_it_ended(tmp_path: Path) -> None:
    with sender(tmp_path / "s", HELLO) as address:
        source = open_source(address)
        view = followed(source, None, RecentEvents(source), print)
        with pytest.raises(
            AmiwarpError, match="less than one full turn before the stream ended: it broke off"
        ):
            view.__enter__()


@pytest.mark.parametrize(
    ("kind", "number"), [("encoder", signal.SIGINT), ("triggers", signal.SIGTERM)]
)
def test_a_flood_without_events_can_be_ended(tmp_path: Path, number: int, kind: str) -> None:
    """One signal ends it, with a whole file; the sender would go on for long."""
    server, address = listen(f"unix:{tmp_path / 's'}")
    flowing, rows, most = threading.Event(), 1 << 12, 100_000

    def flood() -> None:
        connection, _ = server.accept()
        with connection:
            connection.sendall(HELLO)
            for k in range(most):
                t = np.arange(k * rows, (k + 1) * rows, dtype=np.int64)
                try:
                    connection.sendall(
                        encode_encoder(t, t * 1e-6) if kind == "encoder" else encode_triggers(t)
                    )
                except OSError:
                    return
                if k == 500:
                    flowing.set()

    thread = threading.Thread(target=flood, daemon=True)
    thread.start()
    try:
        with start(["record", address, tmp_path / "o.h5", "--json"]) as process:
            try:
                assert flowing.wait(LONG_S)
                process.send_signal(number)
                said, error = process.communicate(timeout=LONG_S)
            finally:
                process.kill()
    finally:
        close_listener(server)
        thread.join(LONG_S)
    assert (process.returncode, error.splitlines()[1:]) == (0, []), error
    assert json.loads(said)["events"] == 0
    assert {p.name for p in tmp_path.iterdir()} == {"o.h5"}
    assert os.path.getsize(tmp_path / "o.h5") > 0


@pytest.mark.parametrize(
    ("spec", "accepts", "address"),
    [
        ("unix:/run/dvs-listen.sock", False, "unix:/run/dvs-listen.sock"),
        ("unix-listen:/run/dvs-listen.sock", True, "unix:/run/dvs-listen.sock"),
        ("tcp-listen:127.0.0.1:5000", True, "tcp:127.0.0.1:5000"),
    ],
)
def test_a_sender_is_waited_for_where_it_was(
    monkeypatch: pytest.MonkeyPatch, spec: str, accepts: bool, address: str
) -> None:
    asked = []

    def noted(of_listener: bool) -> Callable[[str], Iterator[None]]:
        def attempts(where: str) -> Iterator[None]:
            asked.append((of_listener, where))
            yield None

        return attempts

    monkeypatch.setattr(returning_source, "iter_accepted", noted(True))
    monkeypatch.setattr(returning_source, "iter_connected", noted(False))
    assert list(returning_source.sender_attempts(spec)) == [None]
    assert asked == [(accepts, address)]
