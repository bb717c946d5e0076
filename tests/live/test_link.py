"""The link to the controller: after a fault of controller or line, angles are right again; the fault is reported."""

import contextlib
import itertools
import math
import random
import socket
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from typer.testing import CliRunner

from amiwarp import AmiwarpError
from amiwarp.live import commands as command
from amiwarp.live.link import (
    Answer,
    Controller,
    ControllerStatus,
    EmulatedFault,
    Follower,
    FrameDecoder,
    Index,
    Link,
    LinkUpdate,
    Message,
    Motor,
    Ping,
    Pong,
    PseudoTerminal,
    Samples,
    Sync,
    encode,
    updates,
)
from amiwarp.live.link import link as link_module
from amiwarp.live.link.clocks import WRAP
from amiwarp.live.link.connection import LossReporter
from amiwarp.live.link.emulated_faults import LASTING_FAULTS
from amiwarp.live.link.follower import FROM_FIRST
from amiwarp.live.link.ports import open_port, usb_id
from amiwarp.live.link.protocol import FrameCounters
from tests.rig_world import LONG_S, Wire, World

S = 1_000_000
RPM = 720.0
TOLERANCE = math.tau * (1 / 4096 + RPM * 1.05 / 60 / 1000)
"""Largest angle error [rad]: one count, and the rotation during one sample interval."""
HOST = 7_000 * S
"""The host's clock at simulated time 0 [us]."""


class Line:
    """A controller and a follower on a simulated clock. Data takes 400 us from one to the other."""

    def __init__(
        self, *faults: str, follower: Follower | None = None, rpm: float = RPM, **settings: float
    ) -> None:
        self.motor = Motor(rpm)
        self.controller = Controller(
            self.motor, faults=[EmulatedFault.parse(f) for f in faults], **settings
        )  # type: ignore[arg-type]
        self.follower = follower or Follower("port")
        self.follower.opened(HOST)
        self.now, self.arrived = 0, 0
        self._decoder, self._plugged, self._pings = FrameDecoder(), True, itertools.count()

    def run(self, seconds: float, step_us: int = 5000) -> list[LinkUpdate]:
        """Advance by ``seconds``, with ten pings per second. Return all updates."""
        for now in range(self.now + step_us, self.now + round(seconds * S) + 1, step_us):
            self.now = now
            data = self.controller.advance(self.now)
            if self.controller.plugged and not self._plugged:
                self.follower.opened(HOST + self.now)
                self._decoder = FrameDecoder()
            self._plugged = self.controller.plugged
            self.arrived += sum(
                len(m.t_us) for _, m in self._decoder.feed(data) if isinstance(m, Samples)
            )
            self.follower.feed(data, HOST + self.now + 400)
            if self.now % 100_000 == 0:
                number = next(self._pings)
                self.follower.pinged(number, HOST + self.now)
                self.controller.feed(encode(Ping(number), number), self.now)
        return taken(self.follower)

    def away(self, news: LinkUpdate) -> np.ndarray:
        """Return the angle errors by the controller's present clock [rad]."""
        error = news.angle - self.motor.angle(self.controller.time_at(news.t_us))
        return np.asarray((error + math.pi) % math.tau - math.pi)


def taken(follower: Follower) -> list[LinkUpdate]:
    """Take all updates that are ready."""
    found = [follower.take()]
    while len(found[-1].t_us) or found[-1].messages:
        found.append(follower.take())
    return found[:-1]


def said(news: Iterable[LinkUpdate]) -> str:
    return "\n".join(m for n in news for m in n.messages)


def wait(true: Callable[[], object], seconds: float = LONG_S) -> None:
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.005)


def test_angles_are_those_of_the_prism_from_the_first_sample() -> None:
    line = Line(counts_per_turn=4096, drift_ppm=40.0)
    (news,) = line.run(3.0)
    assert (news.restarted, news.messages) == (False, ())
    assert len(news.t_us) == line.arrived > 2990
    assert (np.diff(news.t_us) == 1000).all()
    assert np.abs(line.away(news)).max() < TOLERANCE
    assert np.abs(np.diff(news.angle)).max() < 2 * TOLERANCE
    assert len(news.index_t_us) == pytest.approx(36, abs=1)
    at = np.interp(news.index_t_us, news.t_us, news.angle) / math.tau
    np.testing.assert_allclose(at, np.round(at), atol=1e-3)
    assert len(news.sync) == pytest.approx(30, abs=4)
    assert [n for n, *_ in news.sync] == list(range(len(news.sync)))
    assert all(0 <= host - HOST - t <= 6000 for _, t, host in news.sync)
    assert line.follower.status is not None
    assert line.follower.status.counts_per_turn == 4096


@pytest.mark.parametrize(
    ("fault", "says"),
    [
        ("garbage@2", "damaged frames"), ("truncate@2", "damaged frames"), ("crc@2", "damaged frames"),
        ("drop@2", "damaged frames"), ("missed-index@2", "no index pulse for 1.5 turns"),
        ("stall@2.3+2", "the encoder stays at count"), ("slip@2.01", "slip: 205 counts were lost"),
        ("reverse@2+1", "turns the other way"), ("unplug@2+1.5", ""),
    ],
)  # fmt: skip
def test_after_a_fault_angles_are_right_and_it_was_said(fault: str, says: str) -> None:
    line = Line(fault)
    (news,) = line.run(6.0)
    assert says in "\n".join(news.messages)
    assert bool(news.messages) == bool(says)
    assert not news.restarted
    assert len(news.t_us) == line.arrived
    assert (np.diff(news.t_us) > 0).all()
    name = fault.partition("@")[0]
    begin = EmulatedFault.parse(fault).start_s * S
    # One turn later the index has passed
    end = begin + EmulatedFault.parse(fault).duration_s * S + 90_000
    away = np.abs(line.away(news))
    world = line.controller.time_at(news.t_us)
    assert away[(world < begin) | (world > end)].max() < TOLERANCE
    if name not in ("stall", "slip"):
        assert away.max() < TOLERANCE
    if name in ("garbage", "truncate", "crc", "drop"):
        assert 5500 < line.arrived < 5950
        assert "frames lost: " in "\n".join(news.messages)
        assert len(news.messages) <= 6


def test_counts_that_are_lost_backwards_are_lost() -> None:
    (news,) = Line("slip@2.01", rpm=-RPM).run(4.0)
    assert news.messages == (
        "slip: 205 counts were lost at the index pulse; angles are correct again from there",
    )


@pytest.mark.parametrize(
    ("fault", "at"), [("reset@2", 2.0), ("clock-jump@2", 2.0), ("reset@0.06", 0.06)]
)
def test_a_controller_that_begins_anew(fault: str, at: float) -> None:
    line = Line(fault)
    news = line.run(4.0)
    before = [n for n in news if not n.restarted]
    after = [n for n in news if n.restarted]
    assert len(after) == 1
    assert sum(len(n.t_us) for n in news) == line.arrived
    assert "angles restart" in said(after)
    assert "lost" not in said(news)
    assert np.abs(line.away(after[0])).max() < TOLERANCE
    assert abs(len(after[0].t_us) - 1000 * (4.0 - at)) < 20
    assert sum(len(n.t_us) for n in before) == pytest.approx(1000 * at, abs=20)


def test_sync_pulses_before_a_restart_are_not_given_on_the_clock_after_it() -> None:
    follower = Follower("port")
    follower.opened(HOST)
    follower.feed(encode(Sync(5 * S, 7), 0), HOST)
    follower.feed(encode(Sync(1000, 8), 1), HOST + S)
    (news,) = taken(follower)
    assert news.restarted
    assert news.sync == ((8, 1000, HOST + S),)


def test_round_trips_before_a_restart_do_not_tell_the_clock_after_it() -> None:
    follower = Follower("port")
    follower.opened(HOST)
    for k in range(3):
        follower.pinged(k, HOST + k * S)
        follower.feed(encode(Pong(k, 5 * S + k * S), k), HOST + k * S + 400)
    assert follower.clock() is not None
    follower.feed(encode(Sync(1000, 0), 3), HOST + 3 * S)  # the clock begins anew
    assert follower.clock() is None


def test_samples_out_of_order_are_reported_once() -> None:
    losses, received = LossReporter(), FrameCounters()
    losses.out_of_order = 3
    assert list(losses.check(received, S)) == ["samples dropped, out of order: 3"]
    assert list(losses.check(received, 3 * S)) == []
    losses.out_of_order += 2
    assert list(losses.check(received, 5 * S)) == ["samples dropped, out of order: 2"]


def test_damage_that_lasts_is_reported_every_second() -> None:
    """Ten frames are damaged per second. The first is cut by the opening of the port."""
    losses, received = LossReporter(), FrameCounters()
    reported = []
    for k in range(46):
        received.damaged += 1
        reported += [(k, sentence) for sentence in losses.check(received, k * S // 10)]
    sentence = "dropped damaged frames or lines; is the cable noisy?"
    assert reported == [
        (1, sentence),
        (12, sentence),
        (23, sentence),
        (34, sentence),
        (45, sentence),
    ]
    assert list(losses.check(received, 60 * S)) == []


def test_unplugged_and_switched_off_is_a_restart_though_the_clock_fits() -> None:
    line = Line(clock_start=3 * S)
    line.run(1.0)
    line.follower.opened(HOST + 21 * S)
    line.controller = Controller(line.motor, clock_start=5 * S, start_us=21 * S)
    line.now = 21 * S
    (news,) = line.run(1.0)
    assert news.restarted
    assert np.abs(line.away(news)).max() < TOLERANCE


def test_a_wrap_of_the_clock_is_no_restart() -> None:
    line = Line(clock_start=WRAP - S)
    (news,) = line.run(3.0)
    assert not news.restarted
    assert news.messages == ()
    assert (np.diff(news.t_us) == 1000).all()
    assert news.t_us[-1] > WRAP
    assert np.abs(line.away(news)).max() < TOLERANCE


def test_a_wrap_of_the_counts_is_no_restart() -> None:
    follower, rng = Follower("port"), random.Random(0)
    status = ControllerStatus(0, 1, 0, RPM, RPM, 1000)
    follower.feed(encode(status, 0), HOST)
    first = (1 << 31) - 1500
    for k in range(4000):
        count = first + k - (1 << 31)
        count = (count % WRAP) - (1 << 31)
        message: Message = (
            Index(k * 1000, count) if (first + k) % 1000 == 0 else Samples((k * 1000,), (count,))
        )
        follower.feed(encode(message, k + 1), HOST + k * 1000 + rng.randrange(400))
    (news,) = taken(follower)
    assert (news.messages, news.restarted) == ((), False)
    np.testing.assert_allclose(
        np.diff(news.angle), math.tau / 1000 * np.diff(news.t_us) / 1000, atol=1e-9
    )


def test_each_index_pulse_is_told_once_however_often_one_asks() -> None:
    line, news = Line(counts_per_turn=4096), []
    for _ in range(600):
        news += line.run(0.005)
    t, angle, pulses = (
        np.concatenate([getattr(n, name) for n in news]) for name in ("t_us", "angle", "index_t_us")
    )
    assert len(pulses) == pytest.approx(36, abs=1)
    assert t[0] <= pulses[0]
    assert (np.diff(pulses) > 80_000).all()
    at = np.interp(pulses, t, angle) / math.tau
    np.testing.assert_allclose(at, np.round(at), atol=1e-3)


def test_samples_wait_for_the_index_two_turns_at_most() -> None:
    line = Line("missed-index@0+1")
    news = line.run(0.15)
    assert sum(len(n.t_us) for n in news) == 0
    (news,) = line.run(0.35)
    assert (
        "no index pulse in 2 turns: angles are relative to the first encoder count" in news.messages
    )
    assert news.angle[0] == 0.0
    (news,) = line.run(1.5)
    assert any("first index pulse: angles are absolute from now on" in m for m in news.messages)
    absolute = news.t_us >= news.index_t_us[0]
    assert np.abs(line.away(news)[absolute]).max() < TOLERANCE
    assert np.abs(np.diff(news.angle)).max() < math.pi + TOLERANCE


def test_counts_per_turn_are_the_controller_s_else_those_given() -> None:
    def rows(told: int | None, given: int | None) -> list[LinkUpdate]:
        follower = Follower("port", given)
        for k in range(4000):
            if told is not None and k == 900:
                follower.feed(encode(ControllerStatus(k * 1000, 1, 0, 60.0, 60.0, told), k), HOST)
            message: Message = Index(k * 1000, 100) if k == 100 else Samples((k * 1000,), (k,))
            follower.feed(encode(message, k), HOST + k * 1000)
        return taken(follower)

    for told, given, used in ((1000, 500, 1000), (0, 500, 500), (None, 500, 500)):
        (news,) = rows(told, given)
        assert (news.messages, len(news.t_us)) == (("no index pulse for 1.5 turns",), 3999)
        assert news.angle[-1] == pytest.approx(math.tau * 3899 / used)
    (news,) = rows(None, None)
    assert (len(news.t_us), len(news.messages)) == (0, 1)
    assert "give counts_per_turn" in news.messages[0]


def text(times: Iterable[int], per_turn: int = 1000) -> list[bytes]:
    """Return text lines of a prism at one turn per second."""
    return [f"{t % WRAP},{t * per_turn // S}\r\n".encode() for t in times]


def test_lines_of_text_are_given_out_at_once() -> None:
    follower = Follower("port", 1000)
    follower.opened(HOST)
    for k, line in enumerate([b"123,\n", b"t_us,count\n", *text(range(5 * S, 8 * S, 1000))]):
        follower.feed(line, HOST + k * 1000)
    (news,) = taken(follower)
    assert news.messages == ("port: lines of text have no index pulse: " + FROM_FIRST,)
    assert len(news.t_us) == 3000
    np.testing.assert_allclose(news.angle, math.tau * np.arange(3000) / 1000, atol=1e-9)
    silent = Follower("port")
    silent.feed(b"".join(text(range(0, S, 1000))), HOST)
    (news,) = taken(silent)
    assert "give counts_per_turn" in news.messages[0]
    assert len(news.t_us) == 0


def test_a_wrong_digit_in_a_line_is_left_out_and_a_reset_is_not() -> None:
    follower = Follower("port", 1000)
    lines = text(range(5 * S, 6 * S, 1000))
    lines[200] = lines[200].replace(b"5", b"", 1)
    lines[300] = lines[300].replace(b",", b",9", 1)
    for k, line in enumerate([*lines, *text(range(0, S, 1000))]):
        follower.feed(line, HOST + k * 1000)
    first, second = taken(follower)
    assert len(first.t_us) == 997  # the first line may be incomplete
    assert "damaged frames or lines" in said([first])
    assert (second.restarted, len(second.t_us), second.t_us[0]) == (True, 1000, 0)


def test_faults_that_the_controller_reports_are_said_once() -> None:
    follower = Follower("port")
    for k, bits in enumerate((0, 2, 2, 3, 16, 0, 2)):
        follower.feed(encode(ControllerStatus(k * S, 1, bits, 0.0, 0.0, 4096), k), HOST + k * S)
    assert [m.rpartition(": ")[2] for m in said(taken(follower)).splitlines()] == [
        "over-current",
        "stall",
        "over-current",
    ]
    line = Line()  # "host lost" is reported after the first ping only
    line.run(1.0)
    t = line.controller.clock(line.now)
    line.follower.feed(encode(ControllerStatus(t, 1, 16, RPM, RPM, 4096), 0), HOST + line.now)
    assert "the controller reports a fault: host lost" in said(taken(line.follower))


def test_a_host_that_sleeps_takes_nothing_for_a_reset() -> None:
    """Data that waited in the port for ten seconds comes first, then new data."""
    line = Line()
    line.run(1.0)
    waited, line.now = line.controller.advance(1_300_000), 11 * S
    line.follower.feed(waited, HOST + line.now)
    line.controller.advance(line.now)
    (news,) = line.run(1.0)
    assert not news.restarted
    assert "frames lost: " in news.messages[0]
    assert np.abs(line.away(news)).max() < TOLERANCE


def test_memory_is_bounded_and_what_is_dropped_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(updates, "MOST_WAITING_SAMPLES", 1000)
    line = Line("reset@1.5")
    news = [n for n in (line.follower.take(), *line.run(4.0)) if len(n.t_us)]
    assert sum(len(n.t_us) for n in news) == 1000
    assert f"{line.arrived - 1000:,} samples were dropped, the oldest" in said(news)
    assert news[0].restarted  # reported, although all samples before the reset are gone
    assert np.abs(line.away(news[-1])).max() < TOLERANCE
    assert news[-1].index_t_us[0] >= news[-1].t_us[0]


def test_garbage_is_said_in_a_sentence_and_raises_nothing() -> None:
    follower, rng = Follower("port"), random.Random(3)
    follower.opened(HOST)
    for k in range(3000):
        follower.feed(rng.randbytes(50), HOST + k * 2000)
    (news,) = taken(follower)
    assert len(news.messages) == 1
    assert "neither frames nor lines of samples" in news.messages[0]
    for k in range(2000):  # complete frames with random content
        t, c = rng.getrandbits(32), rng.getrandbits(31)
        status = ControllerStatus(
            t, rng.randrange(256), rng.getrandbits(16), math.nan, math.inf, rng.getrandbits(32)
        )
        for message in (Samples((t,), (c,)), status, Index(t, c)):
            follower.feed(encode(message, rng.getrandbits(16)), HOST + 6 * S + k * 2000)
    assert sum(len(n.t_us) for n in taken(follower)) <= 2000


@pytest.mark.parametrize("drift_ppm", [-80.0, 250.0])
def test_the_clock_is_found_with_honest_deviations(drift_ppm: float) -> None:
    controller, follower = (
        Controller(Motor(), drift_ppm=drift_ppm, clock_start=WRAP - 20 * S),
        Follower("port"),
    )
    rng = np.random.default_rng(2)
    for k in range(60):
        assert (follower.clock() is None) == (k < 3)
        sent = (k + 1) * S
        there, back = rng.exponential(200.0, 2).astype(int) + 100
        follower.pinged(k, HOST + sent)
        follower.feed(controller.advance(sent), HOST + sent)
        controller.feed(encode(Ping(k), k), sent + there)
        follower.feed(controller.advance(sent + there), HOST + sent + there + back)
    clock = follower.clock()
    assert clock is not None
    assert clock.drift == pytest.approx(drift_ppm * 1e-6, abs=4 * clock.drift_std)
    assert clock.drift_std < 2e-6
    true = controller.clock(clock.at_us - HOST) - clock.at_us
    assert clock.offset_us == pytest.approx(true, abs=4 * clock.offset_std_us)
    assert clock.offset_std_us < 150.0


# Through pySerial and pseudo-terminals.


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "prism"


class Live:
    """An emulator in real time."""

    def __init__(
        self, path: Path, *faults: str, rpm: float = RPM, drift_ppm: float = 0.0, sample_hz: float = 1000.0,
        now_us: Callable[[], int] | None = None,
    ) -> None:  # fmt: skip
        self.motor = Motor(rpm)
        self.controller = Controller(
            self.motor,
            faults=[EmulatedFault.parse(f) for f in faults],
            drift_ppm=drift_ppm,
            sample_hz=sample_hz,
        )
        self.terminal = PseudoTerminal(self.controller, path, now_us=now_us)

    def __enter__(self) -> "Live":
        return self

    def __exit__(self, *_: object) -> None:
        self.terminal.close()

    def away(self, news: LinkUpdate) -> np.ndarray:
        error = news.angle - self.motor.angle(self.controller.time_at(news.t_us))
        return np.asarray((error + math.pi) % math.tau - math.pi)


class Paced(Live):
    """An emulator on a simulated clock, which waits for its link and stands still while ``running`` is clear."""

    def __init__(self, path: Path, *faults: str, rpm: float = RPM, drift_ppm: float = 0.0) -> None:
        self.running = threading.Event()
        self.world = World(self.running.is_set)
        super().__init__(path, *faults, rpm=rpm, drift_ppm=drift_ppm, now_us=self.world.step)

    @contextlib.contextmanager
    def link(self) -> Iterator[Link]:
        with Link(self.terminal.name, host_us=self.world.now) as link:
            self.world.conditions.append(Wire(link, self.terminal))
            self.running.set()
            yield link


def test_live_angles_and_clock(path: Path) -> None:
    with Paced(path, drift_ppm=3000.0) as live, live.link() as link:
        assert link.connected
        wait(lambda: len(link._follower.trips) >= 11 and link.status is not None)
        news = link.poll()
        assert (news.messages, news.restarted) == ((), False)
        assert len(news.t_us) > 300  # with those before the first status
        assert np.abs(live.away(news)).max() < TOLERANCE
        clock = link.clock()
        assert clock is not None
        assert clock.drift == pytest.approx(3e-3, abs=5 * clock.drift_std)
        true = live.controller.clock(clock.at_us) - clock.at_us
        assert clock.offset_us == pytest.approx(true, abs=5 * clock.offset_std_us)
    assert not link.connected
    assert [
        t.name for t in threading.enumerate() if t.name in ("amiwarp-link", "amiwarp-emulator")
    ] == []


def test_a_port_that_was_unplugged_comes_back(path: Path) -> None:
    with Paced(path, "unplug@1.6+0.5") as live, live.link() as link:
        seen = threading.Event()
        live.world.conditions.append(lambda: link.connected or seen.is_set())
        wait(lambda: not link.connected)
        with pytest.raises(AmiwarpError, match="not sent, the port is gone"):
            link.stop()
        seen.set()
        wait(lambda: link.connected)
        news = [link.poll()]
        wait(lambda: news.append(link.poll()) or sum(len(n.t_us) for n in news[1:]) > 200)
        assert [m.partition(": ")[2] for m in said(news).splitlines()] == [
            "the port is gone; trying again until it is back",
            "the port is back",
        ]
        assert not any(n.restarted for n in news)
        t, angle = (np.concatenate([getattr(n, name) for n in news]) for name in ("t_us", "angle"))
        gap = int(np.argmax(np.diff(t)))
        assert np.diff(t)[gap] > 300_000
        assert gap > 200
        away = angle - live.motor.angle(live.controller.time_at(t))
        # Whole turns are counted, too
        assert np.abs(away - math.tau * np.round(away[0] / math.tau)).max() < TOLERANCE


def test_a_link_is_closed_while_its_port_is_gone(path: Path) -> None:
    with Paced(path, "unplug@0.3+60") as live, live.link() as link:
        wait(lambda: not link.connected)


def test_commands_over_the_line(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    waits: list[float] = []
    monkeypatch.setattr(link_module, "ANSWER_S", LONG_S)
    with Paced(path, rpm=0.0) as live, live.link() as link:
        link.set_speed(900.0, 10_000.0)
        wait(
            lambda: (
                link.status is not None
                and (link.status.state, link.status.target_rpm) == (1, 900.0)
            )
        )
        with pytest.raises(
            AmiwarpError, match=r"set speed 1e\+06 rpm: refused by the controller, out of range"
        ):
            link.set_speed(1e6, 100.0)
        with pytest.raises(AmiwarpError, match="-5 counts per turn"):
            link.set_counts(-5)
        with pytest.raises(AmiwarpError, match="not possible now"):
            link.set_counts(1000)
        link.stop()
        wait(lambda: link.status is not None and link.status.state == 0)
        link.set_counts(1000)
        wait(lambda: link.status is not None and link.status.counts_per_turn == 1000)
        live.controller.feed = lambda data, now_us: None  # type: ignore[method-assign]
        monkeypatch.undo()
        wait_for = link._changed.wait_for
        monkeypatch.setattr(
            link._changed, "wait_for", lambda true, s: waits.append(s) or wait_for(true, s)
        )
        with pytest.raises(AmiwarpError, match="stop: no answer in 1 s"):
            link.stop()
        assert waits == [1.0]  # the only wait


def test_a_port_that_is_open_elsewhere_is_not_shared(path: Path) -> None:
    with (
        Live(path),
        Link(str(path)),
        pytest.raises(AmiwarpError, match="another program has this port open"),
    ):
        Link(str(path))


def listed(
    monkeypatch: pytest.MonkeyPatch,
    *ports: tuple[str, int | None, int | None],
    product: str | None = "Board",
) -> None:
    from serial.tools import list_ports

    found = [SimpleNamespace(device=d, vid=v, pid=p, product=product) for d, v, p in ports]
    monkeypatch.setattr(list_ports, "comports", lambda: found)


def test_ports_by_usb_id_and_by_what_they_send(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    dumb = tmp_path / "a-dumb-one"
    with Live(path), Live(dumb) as other:
        other.controller.plugged = False
        other.controller.advance = lambda now_us: b""  # type: ignore[method-assign]
        listed(
            monkeypatch,
            (str(dumb), None, None),
            (str(tmp_path / "absent"), None, None),
            (str(path), 0x16C0, 0x483),
        )
        # Each of 20 reads of the silent port takes 0.05 s of simulated time
        listened = itertools.count()

        def clock() -> float:
            assert other.terminal._master is not None
            if other.terminal._without_peer(other.terminal._master):
                return 0.0
            return 0.05 * next(listened)

        monkeypatch.setattr("amiwarp.live.link.ports.time", SimpleNamespace(monotonic=clock))
        for where in ("16C0:0483", None):
            with Link(where) as link:
                assert link.name == str(path)
                wait(lambda link=link: len(link.poll().t_us))  # type: ignore[misc]
        assert usb_id(str(path)) == "16c0:0483"
        assert usb_id(str(dumb)) is None


def test_a_port_that_is_not_there_is_said_with_those_that_are(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    listed(monkeypatch, ("/dev/ttyACM7", 0x16C0, 0x483))
    for where, says in (
        ("/dev/nothing", r"/dev/nothing: no such port; there are /dev/ttyACM7 \(16c0:0483 Board\)"),
        ("1234:abcd", "USB id 1234:abcd: 0 ports have this id; there are /dev/ttyACM7"),
        (
            None,
            "no port sends controller data; there are /dev/ttyACM7.*no such port.*give a port by name",
        ),
        ("nowhere://x", "nowhere://x: cannot be opened"),
    ):
        with pytest.raises(AmiwarpError, match=says):
            open_port(where)
    listed(monkeypatch)
    with pytest.raises(AmiwarpError, match="there is no serial port; is the controller plugged in"):
        open_port("/dev/nothing")
    with pytest.raises(AmiwarpError, match="counts_per_turn = 0"):
        Link("/dev/nothing", counts_per_turn=0)


def test_a_usb_id_of_two_ports_asks_for_a_name(monkeypatch: pytest.MonkeyPatch) -> None:
    listed(monkeypatch, ("COM3", 0x16C0, 0x483), ("COM4", 0x16C0, 0x483), product=None)
    with pytest.raises(AmiwarpError) as error:
        open_port("16c0:0483")
    assert str(error.value) == (
        "USB id 16c0:0483: 2 ports have this id, give a port by name; "
        "there are COM3 (16c0:0483), COM4 (16c0:0483)"
    )


def test_lines_over_a_socket_take_no_commands() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server, Link(
        f"socket://127.0.0.1:{server.getsockname()[1]}", counts_per_turn=1000
    ) as link, server.accept()[0] as peer:  # fmt: skip
        peer.sendall(b"t,c\n" + b"".join(text(range(0, S, 1000))))
        seen: list[int] = []
        wait(lambda: seen.extend(link.poll().t_us.tolist()) or len(seen) >= 1000)
        assert seen == list(range(0, S, 1000))
        with pytest.raises(AmiwarpError, match="lines of text, which take no commands"):
            link.stop()


def test_answers_to_no_command_are_not_kept() -> None:
    """An answer that arrives before its command would be mistaken for the answer to it."""
    with socket.create_server(("127.0.0.1", 0)) as server, contextlib.ExitStack() as held:
        link = Link(f"socket://127.0.0.1:{server.getsockname()[1]}", counts_per_turn=1000)
        peer = held.enter_context(server.accept()[0])
        held.callback(link.close)
        answers = [encode(Answer(k, 2), k) for k in range(500)]
        peer.sendall(b"".join(answers) + encode(ControllerStatus(0, 1, 0, 720.0, 720.0, 4096), 500))
        wait(lambda: link.status is not None)
        assert link._answers == {}
        with pytest.raises(AmiwarpError, match="no answer in 1 s"):
            link.stop()
        assert link._answers == {}


def motor(*args: object) -> tuple[int, str, BaseException | None]:
    import typer

    from amiwarp.cli.common import command as register

    app = typer.Typer()
    register(app, command.run_motor, name="motor", example="")
    done = CliRunner().invoke(app, [str(a) for a in args])
    return done.exit_code, done.stdout, done.exception


def test_the_command_sets_shows_and_stops(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(link_module, "ANSWER_S", LONG_S)
    monkeypatch.setattr(command.motor, "WAIT_S", LONG_S)
    with Live(path, rpm=0.0, sample_hz=50.0):  # so slow that no sample is lost on a busy machine
        code, out, _ = motor("set", "--rpm", -300, "--ramp-rpm-s", 10_000, "--port", path)
        assert code == 0
        assert "set to -300 rpm" in out
        wait(lambda: "at speed" in motor("status", "--port", path)[1])
        code, out, _ = motor("stop", "--port", path, "--json")
        assert '"target_rpm": 0.0' in out
        assert '"answers": true' in out


@pytest.mark.parametrize(
    ("args", "says"),
    [
        (("set", "--rpm", 3001), "--rpm 3001 is beyond the limit of 3000 rpm"),
        (("set", "--rpm", -200, "--limit-rpm", 100), "--rpm -200 is beyond the limit of 100 rpm"),
        (("set", "--rpm", "nan"), "--rpm nan is beyond"),
        (("set",), "needs --rpm"),
        (("stop", "--rpm", 5), "stop do not accept it"),
        (("stop", "--ramp-rpm-s", 3), "--ramp-rpm-s applies to 'amiwarp motor set'"),
    ],
)
def test_a_speed_beyond_the_limit_is_refused_before_the_port_is_opened(
    args: tuple[object, ...], says: str
) -> None:
    code, _, error = motor(*args, "--port", "/dev/nothing")
    assert code == 1
    assert says in str(error)


def test_every_fault_is_tested_above() -> None:
    assert set(LASTING_FAULTS) == {
        "garbage", "truncate", "crc", "drop", "missed-index", "stall", "reverse", "unplug",
    }  # fmt: skip
