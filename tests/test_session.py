"""Live sessions, end to end: an emulated controller over a real serial port, an emulated camera over a socket, and what
goes wrong with either; compared with offline compensation of what was recorded, and with the truth."""

from __future__ import annotations

import math
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from amiwarp.calib.result import Calibration
from amiwarp.camera import Camera
from amiwarp.compensate import compensate, compensate_events
from amiwarp.compensator import OUTSIDE, Compensated
from amiwarp.encoder import Encoder
from amiwarp.errors import AmiwarpError
from amiwarp.events import Events, MemoryEvents, Recording
from amiwarp.io import open_recording, save_recording
from amiwarp.io.live_writer import LiveWriter
from amiwarp.link.clocks import monotonic_us
from amiwarp.optics import ExactModel, Prism
from amiwarp.stream.beside import Beside
from amiwarp.stream.emulated import LEAD_US, EmulatedCamera
from amiwarp.stream.packets import Packet, packet
from amiwarp.stream.queues import Policy
from amiwarp.stream.session import Session, Status
from amiwarp.stream.sources import open_source

CAMERA, PRISM = Camera.from_fov(64, 48, math.radians(60)), Prism(math.radians(2.0))
MODEL = ExactModel.from_prism(CAMERA, PRISM, 0.4)
KNOWN = Calibration(
    "exact", CAMERA, PRISM, {"apex": PRISM.apex, "phase": 0.4}, {}, (), "variance", 0.0, 0.0, (), 0, 0.0
)
COUNTS = 65536
SPEED_PX_US = 720 / 60e6 * math.tau * math.radians(2.0) * 0.52 * CAMERA.fx
"""By which the prism moves an event while its clock is wrong by a microsecond."""
TURNING = pytest.mark.skipif(sys.platform == "win32", reason="no pseudo-terminals")


def points(n: int, seconds: float, seed: int = 0) -> Recording:
    """Events of points behind a prism at 720 rpm."""
    rng = np.random.default_rng(seed)
    t = np.sort(rng.integers(0, round(seconds * 1e6), n))
    encoder = Encoder.constant_speed(720.0, -5000, round(seconds * 1e6) + 5000)
    scene = np.stack([rng.uniform(8, 56, 60), rng.uniform(8, 40, 60)], axis=1)[rng.integers(0, 60, n)]
    seen = MODEL.deflect_points(scene.astype(np.float32), np.mod(encoder.angle_at(t), math.tau).astype(np.float32))
    x, y = np.rint(np.clip(seen, 0, [63, 47])).astype(np.uint16).T
    events = Events(x.copy(), y.copy(), t, rng.integers(0, 2, n).astype(np.uint8))
    return Recording(MemoryEvents(events, 64, 48), CAMERA, encoder, PRISM, name="points")


@dataclass
class Ran:
    """What a session left."""

    status: Status
    raw: Recording
    out: Events
    guessed: np.ndarray
    messages: list[str]


def world() -> Callable[[], int]:
    """A clock that begins now [us]."""
    origin = monotonic_us()
    return lambda: monotonic_us() - origin


def ran(folder: Path, recording: Recording, faults: tuple[str, ...] = ()) -> Ran:
    """The recording played by an emulated rig through a session, which writes both files."""
    from amiwarp.link.emulator import Controller, Fault
    from amiwarp.link.link import Link
    from amiwarp.link.rotors import Played
    from amiwarp.link.terminal import PseudoTerminal

    assert recording.encoder is not None
    rotor = Played(recording.encoder)
    controller = Controller(
        rotor, counts_per_turn=COUNTS, drift_ppm=80.0, clock_start=2**32 - 2_000_000,
        faults=[Fault.parse(fault) for fault in faults],
    )  # fmt: skip
    now_us, messages = world(), []

    with (
        PseudoTerminal(controller, folder / "prism", now_us=now_us) as port,
        EmulatedCamera(recording, rotor, controller, f"unix:{folder / 'camera'}", now_us) as camera,
        Link(port.name) as link,
        LiveWriter(folder / "raw.h5", width=64, height=48, camera=CAMERA, prism=PRISM) as raw,
        LiveWriter(folder / "out.h5", width=64, height=48, compensated=True) as out,
    ):
        session = Session(
            open_source(camera.address), KNOWN, link=link, raw=[raw], out=out, wait_us=50_000, say=messages.append
        )
        status = session.run(threading.Event(), lambda _: None)
    import h5py

    with h5py.File(folder / "out.h5") as file:
        guessed = file["events/extrapolated"][:].astype(bool)
    events = open_recording(folder / "out.h5").events
    return Ran(status, open_recording(folder / "raw.h5"), events.slice(0, len(events)), guessed, messages)


def distance(first: np.ndarray, events: Events) -> np.ndarray:
    return np.hypot(first[:, 0] - events.x, first[:, 1] - events.y)


def check_all_there(found: Ran, recording: Recording) -> None:
    """Every event once and in order, in either file."""
    sent = recording.events.slice(0, len(recording.events))
    raw = found.raw.events.slice(0, len(found.raw.events))
    for name in ("x", "y", "t", "p"):
        np.testing.assert_array_equal(getattr(raw, name), getattr(sent, name))
    np.testing.assert_array_equal(found.out.t, sent.t)
    np.testing.assert_array_equal(found.out.p, sent.p)
    assert (found.status.events, found.status.done, found.status.dropped) == (len(sent), len(sent), 0)


@TURNING
def test_live_is_offline_compensation_of_what_was_recorded(tmp_path: Path) -> None:
    """Over a pseudo-terminal and a socket, clocks tied by pulses, the controller's clock wrapping on the way."""
    recording = points(60_000, 1.5)
    found = ran(tmp_path, recording)
    check_all_there(found, recording)
    compensate(found.raw, KNOWN, tmp_path / "offline.h5")
    events = open_recording(tmp_path / "offline.h5").events
    offline = events.slice(0, len(events))
    apart = np.hypot(found.out.x - offline.x, found.out.y - offline.y)
    assert np.nanmax(apart[~found.guessed]) <= 1e-3
    assert np.count_nonzero(found.guessed) < 0.05 * len(offline)
    assert np.nanmax(apart) < 0.05
    # and the truth: counts of a 65536th turn, clocks to a few microseconds
    sent = recording.events.slice(0, len(offline))
    assert recording.encoder is not None
    truth = compensate_events(sent, MODEL, recording.encoder)
    assert np.nanmax(distance(truth, found.out)[~found.guessed]) < 0.02
    assert found.status.clock is not None
    assert found.status.clock.drift == pytest.approx(-80e-6, abs=20e-6)
    assert found.messages == []


@TURNING
@pytest.mark.parametrize(
    ("fault", "said"),
    [("unplug@1.5+0.3", "back"), ("reset@1.6", "anew"), ("clock-jump@1.6", "anew"), ("slip@1.6", "slip"),
     ("crc@1.5+0.3", "frames"), ("drop@1.5+0.3", "frames"), ("stall@1.5+0.2", "slip"),
     ("missed-index@1.4+0.4", "index")],
)  # fmt: skip
def test_a_fault_loses_nothing_and_is_told(tmp_path: Path, fault: str, said: str) -> None:
    recording = points(60_000, 2.4)
    found = ran(tmp_path, recording, (fault,))
    check_all_there(found, recording)
    assert any(said in message for message in found.messages), found.messages
    sent = recording.events.slice(0, len(recording.events))
    assert recording.encoder is not None
    away = distance(compensate_events(sent, MODEL, recording.encoder), found.out)
    # the camera begins about a second and a bit after the world: well before and well after the fault all is right
    late = sent.t > 2_400_000 - 300_000
    early = sent.t < 1_400_000 - LEAD_US - 200_000
    assert np.count_nonzero(early) > 1000
    # a busy machine hears of pulses too late to pair them; then the host ties the clocks, as well as the clock says
    assert found.status.clock is not None
    allowed = 0.05 + 4.0 * found.status.clock.offset_std_us * SPEED_PX_US
    for part in (early, late):
        assert np.nanpercentile(away[part & ~found.guessed], 99) < allowed
        assert np.count_nonzero(found.guessed & part) < 0.2 * np.count_nonzero(part)


@TURNING
def test_an_emulated_camera_loses_nothing_where_its_client_is_slow(tmp_path: Path) -> None:
    from amiwarp.link.emulator import Controller
    from amiwarp.link.rotors import Played

    recording, now_us = points(3_000_000, 0.3), world()
    assert recording.encoder is not None
    rotor = Played(recording.encoder)
    controller = Controller(rotor, counts_per_turn=COUNTS)

    with EmulatedCamera(recording, rotor, controller, f"unix:{tmp_path / 'camera'}", now_us) as camera:
        source, got = open_source(camera.address), []
        for k, given in enumerate(source.packets()):
            got.append(given.events)
            if k == 1:
                time.sleep(2.0)
        source.close()
        assert camera.done.wait(10.0)
    np.testing.assert_array_equal(Events.concatenate(got).t, recording.events.slice(0, 3_000_000).t)
    assert camera.late_us > 500_000


class Made:
    """A source of given packets."""

    camera, prism, size, name, has_encoder = CAMERA, PRISM, (64, 48), "made", True

    def __init__(self, packets: list[Packet], error: Exception | None = None) -> None:
        self._packets, self._error, self.closed = packets, error, False

    def packets(self) -> Iterator[Packet]:
        yield from self._packets
        if self._error is not None:
            raise self._error

    def close(self) -> None:
        self.closed = True


def packets_of(recording: Recording, size: int = 500) -> list[Packet]:
    encoder, sent = recording.encoder, 0
    assert encoder is not None
    out = []
    for events in recording.events.blocks(count=size):
        until = int(np.searchsorted(encoder.t, events.t[-1])) + 2
        out.append(packet(0, events, encoder_t=encoder.t[sent:until], encoder_angle=encoder.angle[sent:until]))
        sent = until
    return out


def through(source: Made, **given: object) -> tuple[list[Compensated], Status]:
    out: list[Compensated] = []
    session = Session(source, KNOWN, sinks=(out.append,), **given)  # type: ignore[arg-type]
    status = session.run(threading.Event(), lambda _: None)
    assert source.closed
    return out, status


def test_packets_out_of_order_come_out_sorted_and_once() -> None:
    recording = points(20_000, 0.5)
    given = packets_of(recording, 200)
    rng = np.random.default_rng(0)
    order = np.argsort(np.arange(len(given)) + rng.uniform(0, 1.6, len(given)))  # late by a packet or two
    shuffled = [given[k] for k in order]
    samples = [packet(0, encoder_t=p.encoder_t, encoder_angle=p.encoder_angle) for p in given]
    out, status = through(Made(samples + [packet(0, p.events) for p in shuffled]))
    found = Events.concatenate([p.events for p in out])
    assert (found.t[1:] >= found.t[:-1]).all()
    assert len(found) == 20_000
    sent = recording.events.slice(0, 20_000)
    on_time = np.isin(found.t, sent.t)
    assert np.count_nonzero(~on_time) <= status.late < 600
    assert np.bincount(found.p.astype(int)).tolist() == np.bincount(sent.p.astype(int)).tolist()


def test_a_source_that_fails_loses_nothing_that_came() -> None:
    recording = points(20_000, 0.5)
    out: list[Compensated] = []
    source = Made(packets_of(recording), AmiwarpError("the camera is gone"))
    session = Session(source, KNOWN, sinks=(out.append,))
    with pytest.raises(AmiwarpError, match="camera is gone"):
        session.run(threading.Event(), lambda _: None)
    assert sum(len(p.events) for p in out) == session.status.done == 20_000
    assert source.closed


def test_a_session_that_is_stopped_finishes_what_came(tmp_path: Path) -> None:
    recording, stop = points(20_000, 0.5), threading.Event()
    given = packets_of(recording)

    class Endless(Made):
        def packets(self) -> Iterator[Packet]:
            yield from given[:20]
            stop.set()
            yield from given[20:]
            raise AssertionError("it goes on")

    with LiveWriter(tmp_path / "raw.h5", width=64, height=48) as raw:
        status = Session(Endless([]), KNOWN, raw=[raw]).run(stop, lambda _: None)
    assert 10_000 <= status.events == status.done < 20_000
    assert len(open_recording(tmp_path / "raw.h5").events) == status.events


def test_a_sink_that_fails_ends_the_session_and_says_so() -> None:
    def full(_packet: Compensated) -> None:
        raise AmiwarpError("disk: no space left")

    with pytest.raises(AmiwarpError, match="no space left"):
        Session(Made(packets_of(points(20_000, 0.5))), KNOWN, sinks=(full,)).run(threading.Event(), lambda _: None)


def test_a_taker_that_fails_takes_nothing_from_the_others(tmp_path: Path) -> None:
    """A disk that is full: the other file gets all that had come."""

    class Full:
        calls = 0

        def append(self, events: Events) -> None:
            self.calls += 1
            if self.calls == 3:
                raise AmiwarpError("no space left")

        def append_encoder(self, *_: object) -> None: ...

        def tick(self) -> None: ...

    with LiveWriter(tmp_path / "raw.h5", width=64, height=48) as raw:
        session = Session(Made(packets_of(points(20_000, 0.5))), KNOWN, raw=[Full(), raw])
        with pytest.raises(AmiwarpError, match="no space left"):
            session.run(threading.Event(), lambda _: None)
    assert session.status.events == session.status.done == len(open_recording(tmp_path / "raw.h5").events) >= 1500


def test_samples_that_wait_in_the_queue_are_waited_for() -> None:
    """Each packet's come after it; a sink was slow for longer than one waits for the encoder."""
    given = packets_of(points(100_000, 0.5))
    apart = [packet(0, p.events) if k % 2 == 0 else replace(p, events=Events.empty()) for p in given for k in (0, 1)]
    slow = iter([0.1])
    out: list[Compensated] = []

    def sink(done: Compensated) -> None:
        time.sleep(next(slow, 0.0))
        out.append(done)

    status = Session(Made(apart), KNOWN, sinks=(sink,)).run(threading.Event(), lambda _: None)
    assert status.done == 100_000
    assert status.guessed < 2000


def test_a_source_that_does_not_let_go_is_left_behind() -> None:
    given, stop, free = packets_of(points(20_000, 0.5)), threading.Event(), threading.Event()

    class Stuck(Made):
        def packets(self) -> Iterator[Packet]:
            yield from given
            stop.set()
            free.wait(30.0)

    source, out = Stuck([]), []
    status = Session(source, KNOWN, sinks=(out.append,)).run(stop, lambda _: None)
    assert status.done == 20_000
    assert not source.closed
    free.set()


@pytest.mark.parametrize("offset", [0.0, 700.0])
def test_the_clock_offset_of_a_file_is_applied_once(tmp_path: Path, offset: float) -> None:
    """By the calibration's value, live as offline, of the file and of what was recorded of it."""
    recording = points(20_000, 0.5)
    assert recording.encoder is not None
    late = Encoder(recording.encoder.t + 700, recording.encoder.angle, offset)
    save_recording(tmp_path / "file.h5", replace(recording, encoder=late))
    known = replace(KNOWN, parameters={**KNOWN.parameters, "clock_offset": 700.0})
    source = open_source(str(tmp_path / "file.h5"), pace=None)
    out: list[Compensated] = []
    with LiveWriter(tmp_path / "raw.h5", width=64, height=48, clock_offset_us=offset) as raw:
        Session(source, known, raw=[raw], sinks=(out.append,)).run(threading.Event(), lambda _: None)
    live = Events.concatenate([p.events for p in out])
    for name in ("file.h5", "raw.h5"):
        compensate(open_recording(tmp_path / name), known, tmp_path / f"offline-{name}")
        offline = open_recording(tmp_path / f"offline-{name}").events.slice(0, 20_000)
        assert np.nanmax(np.hypot(live.x - offline.x, live.y - offline.y)) < 1e-3


def test_a_slow_sink_makes_a_queue_drop_and_not_grow() -> None:
    recording = points(40_000, 0.5)
    held: list[int] = []
    session: Session | None = None

    def slow(_packet: Compensated) -> None:
        assert session is not None
        held.append(session._queue.held)
        time.sleep(0.004)

    session = Session(Made(packets_of(recording)), KNOWN, sinks=(slow,), policy=Policy.DROP_OLDEST, queue_events=3000)
    status = session.run(threading.Event(), lambda _: None)
    assert max(held) <= 3000
    assert status.dropped > 0
    assert status.done + status.dropped == 40_000


def test_a_status_tells_rate_latency_coverage_and_sharpness() -> None:
    seen: list[tuple[float, ...]] = []

    def note(s: Status) -> None:
        seen.append((s.rate_mev_s, *s.latency_ms, s.covered, s.sharpness or 0.0, s.rpm or 0.0))

    out: list[Compensated] = []
    Session(Made(packets_of(points(400_000, 3.0))), KNOWN, sinks=(out.append,)).run(
        threading.Event(), note, every_s=0.02
    )
    rate, median, p99, covered, sharp, rpm = np.array(seen[1:]).max(axis=0)
    assert rate > 0.1
    assert 0.0 <= median <= p99
    assert covered == 1.0
    assert sharp > 2.0  # events at random have 1
    assert rpm == pytest.approx(720.0)
    assert not any((p.flags & ~np.uint8(OUTSIDE)).any() for p in out)


def test_what_runs_beside_keeps_its_order_and_tells_what_failed() -> None:
    done: list[int] = []
    beside = Beside()
    for k in range(500):
        beside.put(lambda k=k: done.append(k))
    beside.close()
    assert done == list(range(500))
    failing = Beside()

    def fail() -> None:
        raise AmiwarpError("full")

    failing.put(fail)
    with pytest.raises(AmiwarpError, match="full"):
        failing.close()
    failing.end()
