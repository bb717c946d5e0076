"""Live sessions with an emulated controller at a pseudo-terminal and an emulated camera at a socket, and their faults.

Results are compared with offline compensation of the same recording and with the ground truth.
"""

from __future__ import annotations

import itertools
import math
import re
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from amiwarp import (
    AmiwarpError,
    Camera,
    Compensated,
    Encoder,
    EncoderStream,
    Events,
    ExactModel,
    MemoryEvents,
    Packet,
    Policy,
    Prism,
    Recording,
    compensate,
    compensate_events,
    open_recording,
    save_recording,
)
from amiwarp.compensation import EXTRAPOLATED, NO_ANGLE, OUTSIDE
from amiwarp.io import LiveWriter
from amiwarp.live.background_worker import BackgroundWorker
from amiwarp.live.link import ClockSource, LinkUpdate, monotonic_us
from amiwarp.live.link.clocks import fit_to_round_trips
from amiwarp.live.stream import (
    EmulatedCamera,
    Session,
    SessionStatus,
    make_packet,
    open_source,
    stream_source,
)
from amiwarp.live.stream import session as session_module
from amiwarp.live.stream.emulated_camera import LEAD_US
from amiwarp.live.stream.encoder_feed import EncoderFeed
from amiwarp.live.stream.session_status import IntervalFigures
from reference.calibration_sample import exact_calibration
from tests.rig_world import LONG_S, Counted, Wire, World, has_taken_in

CAMERA, PRISM = Camera.from_fov(64, 48, math.radians(60)), Prism(math.radians(2.0))
MODEL = ExactModel.from_prism(CAMERA, PRISM, 0.4)
KNOWN = exact_calibration(CAMERA, PRISM, {"apex": PRISM.apex, "phase": 0.4})
COUNTS = 65536
SPEED_PX_US = 720 / 60e6 * math.tau * math.radians(2.0) * 0.52 * CAMERA.fx
"""Displacement of an event for each microsecond of clock error [px/us]."""
TURNING = pytest.mark.skipif(sys.platform == "win32", reason="no pseudo-terminals")


def points(n: int, seconds: float, seed: int = 0) -> Recording:
    """Events of scene points behind a prism at 720 rpm."""
    rng = np.random.default_rng(seed)
    t = np.sort(rng.integers(0, round(seconds * 1e6), n))
    encoder = Encoder.constant_speed(720.0, -5000, round(seconds * 1e6) + 5000)
    scene = np.stack([rng.uniform(8, 56, 60), rng.uniform(8, 40, 60)], axis=1)[
        rng.integers(0, 60, n)
    ]
    seen = MODEL.deflect_points(
        scene.astype(np.float32), np.mod(encoder.angle_at(t), math.tau).astype(np.float32)
    )
    x, y = np.rint(np.clip(seen, 0, [63, 47])).astype(np.uint16).T
    events = Events(x.copy(), y.copy(), t, rng.integers(0, 2, n).astype(np.uint8))
    return Recording(MemoryEvents(events, 64, 48), CAMERA, encoder, PRISM, name="points")


@dataclass
class Ran:
    """Results of a session."""

    status: SessionStatus
    raw: Recording
    out: Events
    guessed: np.ndarray
    messages: list[str]


def world() -> Callable[[], int]:
    """Return a clock that begins now [us]."""
    origin = monotonic_us()
    return lambda: monotonic_us() - origin


def ran(folder: Path, recording: Recording, faults: tuple[str, ...] = ()) -> Ran:
    """Play the recording with an emulated rig through a session, which writes both files."""
    from amiwarp.live.link import Controller, EmulatedFault, Link, Played, PseudoTerminal

    assert recording.encoder is not None
    rotor = Played(recording.encoder)
    controller = Controller(
        rotor, counts_per_turn=COUNTS, drift_ppm=80.0, clock_start=2**32 - 2_000_000,
        faults=[EmulatedFault.parse(fault) for fault in faults],
    )  # fmt: skip
    begun, messages = threading.Event(), []
    world = World(begun.is_set)

    with (
        pytest.MonkeyPatch.context() as patch,
        PseudoTerminal(controller, folder / "prism", now_us=world.step) as port,
        EmulatedCamera(
            recording, rotor, controller, f"unix:{folder / 'camera'}", world.now
        ) as camera,
        Link(port.name, host_us=world.now) as link,
        LiveWriter(folder / "raw.h5", width=64, height=48, camera=CAMERA, prism=PRISM) as raw,
        LiveWriter(folder / "out.h5", width=64, height=48, compensated=True) as out,
    ):
        for module in (session_module, stream_source):
            patch.setattr(module, "monotonic_us", world.now)
        source = Counted(open_source(camera.address))
        session = Session(
            source, KNOWN, link=link, raw=[raw], out=out, wait_us=50_000, say=messages.append
        )
        world.conditions += [Wire(link, port), has_taken_in(session, source, camera, link)]
        begun.set()
        stop = threading.Event()
        hung = threading.Timer(2.0 * LONG_S, stop.set)
        hung.start()
        status = session.run(stop, lambda _: None)
        hung.cancel()
    import h5py

    with h5py.File(folder / "out.h5") as file:
        guessed = file["events/extrapolated"][:].astype(bool)
    events = open_recording(folder / "out.h5").events
    return Ran(
        status, open_recording(folder / "raw.h5"), events.slice(0, len(events)), guessed, messages
    )


def distance(first: np.ndarray, events: Events) -> np.ndarray:
    return np.hypot(first[:, 0] - events.x, first[:, 1] - events.y)


def check_all_there(found: Ran, recording: Recording) -> None:
    """Check that both files have every event once and in order."""
    sent = recording.events.slice(0, len(recording.events))
    raw = found.raw.events.slice(0, len(found.raw.events))
    for name in ("x", "y", "t", "p"):
        np.testing.assert_array_equal(getattr(raw, name), getattr(sent, name))
    np.testing.assert_array_equal(found.out.t, sent.t)
    np.testing.assert_array_equal(found.out.p, sent.p)
    assert (found.status.events, found.status.done, found.status.dropped) == (
        len(sent),
        len(sent),
        0,
    )


@TURNING
def test_live_is_offline_compensation_of_what_was_recorded(tmp_path: Path) -> None:
    """Over a pseudo-terminal and a socket. Sync pulses relate the clocks, and the controller's clock wraps."""
    recording = points(60_000, 1.5)
    found = ran(tmp_path, recording)
    check_all_there(found, recording)
    compensate(found.raw, KNOWN, tmp_path / "offline.h5")
    events = open_recording(tmp_path / "offline.h5").events
    offline = events.slice(0, len(events))
    apart = np.hypot(found.out.x - offline.x, found.out.y - offline.y)
    assert np.nanmax(apart[~found.guessed]) <= 1e-3
    assert not found.guessed.any()
    # and with the truth: one count is 1/65536 turn, and clocks are accurate to a few microseconds
    sent = recording.events.slice(0, len(offline))
    assert recording.encoder is not None
    truth = compensate_events(sent, MODEL, recording.encoder)
    assert np.nanmax(distance(truth, found.out)[~found.guessed]) < 0.02
    assert found.status.clock is not None
    assert found.status.clock.drift == pytest.approx(-80e-6, abs=20e-6)
    assert found.status.clock_source is ClockSource.PULSES
    assert len(found.messages) == 1
    assert found.messages[0].startswith(
        "the clocks of controller and camera are related by 6 pulses, within 0."
    )


@TURNING
@pytest.mark.parametrize(
    ("fault", "said"),
    [("unplug@1.5+0.3", "back"), ("reset@1.6", "restart"), ("clock-jump@1.6", "restart"), ("slip@1.6", "slip"),
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
    # the camera starts one second after the clock; well before and after the fault, angles are right
    late = sent.t > 2_400_000 - 300_000
    early = sent.t < 1_400_000 - LEAD_US - 200_000
    assert np.count_nonzero(early) > 1000
    for part in (early, late):
        assert not found.guessed[part].any()
        assert away[part].max() < 0.02
    assert found.status.clock is not None
    # Synchronised by pulses, also after the controller's reset
    assert found.status.clock.offset_std_us < 1.0


def test_an_emulated_camera_sees_the_pulses_of_a_controller_that_was_reset(tmp_path: Path) -> None:
    """After a reset, the controller counts its pulses from 0."""
    from amiwarp.live.link import Controller, EmulatedFault, Played

    recording, clock = points(1000, 0.1), World()
    assert recording.encoder is not None
    rotor = Played(recording.encoder)
    controller = Controller(rotor, faults=[EmulatedFault.parse("reset@0.55")])
    got: list[int] = []
    with EmulatedCamera(
        recording, rotor, controller, f"unix:{tmp_path / 'camera'}", clock.now
    ) as camera:
        source = open_source(camera.address)
        packets = source.packets()
        while clock.now() < 900_000:  # no event yet
            controller.advance(clock.step())
            until = time.monotonic() + LONG_S
            while len(got) < len(controller.pulses) and time.monotonic() < until:
                got += next(packets).triggers.tolist()
        source.close()
    # the pulse after the reset is the first one of the controller's new time
    assert len(got) >= 7
    assert (np.diff(got) >= 70_000).all()
    assert [number for number, _ in controller.pulses][-3:] == [0, 1, 2]


@TURNING
def test_an_emulated_camera_loses_nothing_where_its_client_is_slow(tmp_path: Path) -> None:
    from amiwarp.live.link import Controller, Played

    recording, now_us = points(3_000_000, 0.3), world()
    assert recording.encoder is not None
    rotor = Played(recording.encoder)
    controller = Controller(rotor, counts_per_turn=COUNTS)

    with EmulatedCamera(
        recording, rotor, controller, f"unix:{tmp_path / 'camera'}", now_us
    ) as camera:
        source, got = open_source(camera.address), []
        for k, given in enumerate(source.packets()):
            got.append(given.events)
            if k == 1:
                time.sleep(2.0)
        source.close()
        assert camera.done.wait(LONG_S)
    np.testing.assert_array_equal(Events.concatenate(got).t, recording.events.slice(0, 3_000_000).t)
    assert camera.late_us > 500_000


class Made:
    """A source of given packets."""

    camera, prism, size, name, encoders = CAMERA, PRISM, (64, 48), "made", 1

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
        out.append(
            make_packet(
                0, events, encoder_t=encoder.t[sent:until], encoder_angle=encoder.angle[sent:until]
            )
        )
        sent = until
    return out


PAIR = replace(PRISM, second=Prism(math.radians(1.4)))
PAIR_VALUES = {
    "apex": PAIR.apex,
    "second_apex": math.radians(1.4),
    "phase": 0.4,
    "second_phase": -0.3,
}
KNOWN_PAIR = replace(exact_calibration(CAMERA, PAIR, PAIR_VALUES), model_name="risley")


def of_pair(recording: Recording, ratio: float | None = None) -> Recording:
    """The recording with a second encoder: by a ratio of speeds, or with sample times of its own."""
    t = np.arange(-4000, 510_000, 1300)
    assert recording.encoder is not None
    second = Encoder(t, t * -5e-5 + 0.1 * np.sin(t * 1e-5)) if ratio is None else ratio
    return replace(recording, prism=PAIR, encoder=recording.encoder.with_second(second))


@pytest.mark.parametrize("ratio", [None, -0.7])
def test_a_pair_is_compensated_and_recorded_as_its_recording_is(
    tmp_path: Path, ratio: float | None
) -> None:
    """With the samples of two encoders, and with those of one and the ratio of the speeds."""
    recording = of_pair(points(20_000, 0.5), ratio)
    encoder = recording.encoder
    assert encoder is not None
    save_recording(tmp_path / "file.h5", recording if ratio is None else replace(recording, encoder=replace(
        encoder, second=None)))  # fmt: skip
    source, out = open_source(str(tmp_path / "file.h5"), pace=None), list[Compensated]()
    with LiveWriter(tmp_path / "raw.h5", width=64, height=48, encoders=2) as raw:
        session = Session(source, KNOWN_PAIR, raw=[raw], sinks=(out.append,), second_ratio=ratio)
        status = session.run(threading.Event(), lambda _: None)
    assert (status.done, status.guessed, status.unknown) == (20_000, 0, 0)
    found, given = Events.concatenate([p.events for p in out]), recording.events.slice(0, 20_000)
    expected = compensate_events(given, KNOWN_PAIR.model, encoder)
    np.testing.assert_array_equal(np.stack([found.x, found.y], axis=1), expected)
    again = open_recording(tmp_path / "raw.h5").encoder
    assert again is not None
    assert again.second is not None
    assert encoder.second is not None
    for one, other in ((again, encoder), (again.second, encoder.second)):
        np.testing.assert_array_equal(one.t, other.t)
        np.testing.assert_array_equal(one.angle, other.angle)


def test_a_second_encoder_that_is_late_is_waited_for() -> None:
    """Its samples follow the last events, in packets of their own."""
    recording = of_pair(points(20_000, 0.5))
    assert recording.encoder is not None
    second = recording.encoder.second
    assert second is not None
    late = [make_packet(0, second_t=second.t[k : k + 50], second_angle=second.angle[k : k + 50])
            for k in range(0, len(second.t), 50)]  # fmt: skip
    source, out = Made([*packets_of(recording), *late]), list[Compensated]()
    source.encoders = 2
    Session(source, KNOWN_PAIR, sinks=(out.append,), wait_us=10**9).run(
        threading.Event(), lambda _: None
    )
    found, flags = (
        Events.concatenate([p.events for p in out]),
        np.concatenate([p.flags for p in out]),
    )
    expected = compensate_events(
        recording.events.slice(0, 20_000), KNOWN_PAIR.model, recording.encoder
    )
    np.testing.assert_array_equal(np.stack([found.x, found.y], axis=1), expected)
    assert set(flags.tolist()) <= {0, OUTSIDE}


def test_a_sender_that_returns_continues_neither_encoder() -> None:
    """The angles between the two parts are estimates, and the encoders may have other zeros after it."""
    recording = of_pair(points(20_000, 0.5))
    assert recording.encoder is not None
    second = recording.encoder.second
    assert second is not None
    parts = []
    for low, high, turn in ((-5000, 200_000, 0.0), (205_000, 520_000, 1.0)):
        a, b = ((e.t >= low) & (e.t < high) for e in (recording.encoder, second))
        samples = make_packet(0, encoder_t=recording.encoder.t[a], encoder_angle=recording.encoder.angle[a] + turn,
                              second_t=second.t[b], second_angle=second.angle[b] - turn)  # fmt: skip
        parts.append(replace(samples, returned=low > 0))
    source = Made([parts[0], parts[1], make_packet(0, recording.events.slice(0, 20_000))])
    source.encoders = 2
    out: list[Compensated] = []
    Session(source, KNOWN_PAIR, sinks=(out.append,)).run(threading.Event(), lambda _: None)
    flags, t = np.concatenate([p.flags for p in out]), np.concatenate([p.events.t for p in out])
    estimated = (flags & EXTRAPOLATED) > 0
    assert estimated[(t > 200_000) & (t < 204_000)].all()
    assert not estimated[(t < 198_000) | (t > 207_000)].any()


def test_a_source_of_one_encoder_does_not_suit_a_pair() -> None:
    source = Made(packets_of(points(2000, 0.5)))
    with pytest.raises(AmiwarpError, match="the model has two prisms, the encoder measures one"):
        Session(source, KNOWN_PAIR)
    source.encoders = 2
    with pytest.raises(AmiwarpError, match="the model has one prism"):
        Session(source, KNOWN)


def through(source: Made, **given: object) -> tuple[list[Compensated], SessionStatus]:
    out: list[Compensated] = []
    session = Session(source, KNOWN, sinks=(out.append,), **given)  # type: ignore[arg-type]
    status = session.run(threading.Event(), lambda _: None)
    assert source.closed
    return out, status


def test_packets_out_of_order_come_out_sorted_and_once() -> None:
    recording = points(20_000, 0.5)
    given = packets_of(recording, 200)
    rng = np.random.default_rng(0)
    # Up to two packets late
    order = np.argsort(np.arange(len(given)) + rng.uniform(0, 1.6, len(given)))
    shuffled = [given[k] for k in order]
    samples = [make_packet(0, encoder_t=p.encoder_t, encoder_angle=p.encoder_angle) for p in given]
    out, status = through(Made(samples + [make_packet(0, p.events) for p in shuffled]))
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


@pytest.mark.parametrize("slow", ["compensation", "writing"])
def test_a_stopped_session_drops_what_takes_too_long(
    monkeypatch: pytest.MonkeyPatch, slow: str
) -> None:
    """The time for it begins with the stop. What was dropped is counted."""
    monkeypatch.setattr(session_module, "DRAIN_S", 0.2)
    monkeypatch.setattr(session_module, "STEP_BYTES", 1)
    recording, stop, said = points(20_000, 0.5), threading.Event(), list[str]()
    given, go = packets_of(recording), threading.Event()

    class Slow:
        """A consumer that takes 10 ms for each packet."""

        count = 0

        def append(self, events: Events) -> None:
            stop.set()
            go.wait(0.01)
            self.count += len(events)

        def append_encoder(self, *_: object, second: bool) -> None:
            pass

        def tick(self) -> None:
            pass

    class Ahead(Made):
        def packets(self) -> Iterator[Packet]:
            yield from given
            stop.wait(LONG_S)

    def take(_packet: Compensated) -> None:
        stop.set()
        go.wait(0.05)

    raw = Slow()
    if slow == "writing":
        session = Session(Ahead([]), raw=[raw], say=said.append)
    else:
        session = Session(Ahead([]), KNOWN, sinks=(take,), say=said.append)
        session._compensator.batch = 500  # type: ignore[union-attr]
    status = session.run(stop, lambda _: None)
    (message,) = said
    processed, written = (
        int(n.replace(",", "")) for n in re.findall(r"([\d,]+) (?:events )?that waited", message)
    )
    assert message.startswith("dropped 0.2 s after the stop: ")
    if slow == "writing":
        assert processed + written + raw.count == 20_000
        assert written > 0
        assert raw.count > 0
    else:
        assert (processed, written) == (20_000 - status.events, 0)
        assert status.dropped == processed > 0


def test_a_session_whose_source_ends_drops_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(session_module, "DRAIN_S", 0.0)
    source = Made(packets_of(points(20_000, 0.5)))
    out: list[Compensated] = []
    status = Session(source, KNOWN, sinks=(out.append, lambda _: time.sleep(0.02))).run(
        threading.Event(), lambda _: None, seconds=LONG_S
    )
    assert status.done == sum(len(p.events) for p in out) == 20_000
    assert status.dropped == 0


def test_a_session_ends_at_its_time_and_not_at_the_next_report(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Each packet of a millisecond is processed before the next one comes."""
    now_us = 0
    monkeypatch.setattr(session_module, "monotonic_us", lambda: now_us)

    class Paced(Made):
        def packets(self) -> Iterator[Packet]:
            nonlocal now_us
            until = time.monotonic() + LONG_S
            for k in range(1, 1001):
                now_us = 1000 * k
                yield make_packet(now_us, Events.from_arrays([1], [1], [now_us], [1]))
                while (
                    not stop.is_set() and session.status.events < k - 1 and time.monotonic() < until
                ):
                    time.sleep(1e-4)

    stop, session = threading.Event(), Session(Paced([]))
    status = session.run(stop, lambda _: None, seconds=0.25, every_s=0.2)
    assert stop.is_set()
    assert 0.249 <= status.seconds < 0.26


def test_a_sink_that_fails_ends_the_session_and_says_so() -> None:
    def full(_packet: Compensated) -> None:
        raise AmiwarpError("disk: no space left")

    with pytest.raises(AmiwarpError, match="no space left"):
        Session(Made(packets_of(points(20_000, 0.5))), KNOWN, sinks=(full,)).run(
            threading.Event(), lambda _: None
        )


def test_a_taker_that_fails_takes_nothing_from_the_others(tmp_path: Path) -> None:
    """One disk is full. The other file gets all events received so far."""

    class Full:
        calls = 0

        def append(self, events: Events) -> None:
            self.calls += 1
            if self.calls == 3:
                raise AmiwarpError("no space left")

        def append_encoder(self, *_: object, second: bool) -> None: ...

        def tick(self) -> None: ...

    with LiveWriter(tmp_path / "raw.h5", width=64, height=48) as raw:
        session = Session(Made(packets_of(points(20_000, 0.5))), KNOWN, raw=[Full(), raw])
        with pytest.raises(AmiwarpError, match="no space left"):
            session.run(threading.Event(), lambda _: None)
    assert (
        session.status.events
        == session.status.done
        == len(open_recording(tmp_path / "raw.h5").events)
        >= 1500
    )


class Whole(Made):
    """A source that reports when it has passed on all its packets."""

    def __init__(self, packets: list[Packet]) -> None:
        super().__init__(packets)
        self.given = threading.Event()

    def packets(self) -> Iterator[Packet]:
        yield from super().packets()
        self.given.set()


def test_samples_that_wait_in_the_queue_are_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """The samples of each packet follow it, and a sink is slow for longer than the wait for the encoder."""
    given = packets_of(points(100_000, 0.5))
    apart = [
        make_packet(0, p.events) if k % 2 == 0 else replace(p, events=Events.empty())
        for p in given
        for k in (0, 1)
    ]
    now_us = 0
    out: list[Compensated] = []
    monkeypatch.setattr(session_module, "monotonic_us", lambda: now_us)

    def sink(done: Compensated) -> None:
        nonlocal now_us
        if not out:
            assert source.given.wait(LONG_S)
            now_us += 100_000
        out.append(done)

    source = Whole(apart)
    status = Session(source, KNOWN, sinks=(sink,)).run(threading.Event(), lambda _: None)
    assert status.done == 100_000
    assert status.guessed == 0


def test_a_source_that_does_not_let_go_is_left_behind() -> None:
    given, stop, free = packets_of(points(20_000, 0.5)), threading.Event(), threading.Event()

    class Stuck(Made):
        def packets(self) -> Iterator[Packet]:
            yield from given
            stop.set()
            free.wait(LONG_S)

    source, out = Stuck([]), []
    status = Session(source, KNOWN, sinks=(out.append,)).run(stop, lambda _: None)
    assert status.done == 20_000
    assert not source.closed
    free.set()


@pytest.mark.parametrize(("offset", "calibrated"), [(0.0, True), (700.0, True), (700.0, False)])
def test_the_clock_offset_of_a_file_is_applied_once(
    tmp_path: Path, offset: float, *, calibrated: bool
) -> None:
    """The calibration's offset, or else the file's, applies once, live and offline, to file and live recording."""
    recording = points(20_000, 0.5)
    assert recording.encoder is not None
    late = Encoder(recording.encoder.t + 700, recording.encoder.angle, offset)
    save_recording(tmp_path / "file.h5", replace(recording, encoder=late))
    known = replace(
        KNOWN, parameters={**KNOWN.parameters, **({"clock_offset": 700.0} if calibrated else {})}
    )
    source = open_source(str(tmp_path / "file.h5"), pace=None)
    out: list[Compensated] = []
    with LiveWriter(tmp_path / "raw.h5", width=64, height=48, clock_offset_us=offset) as raw:
        Session(source, known, raw=[raw], sinks=(out.append,)).run(
            threading.Event(), lambda _: None
        )
    live = Events.concatenate([p.events for p in out])
    for name in ("file.h5", "raw.h5"):
        compensate(open_recording(tmp_path / name), known, tmp_path / f"offline-{name}")
        offline = open_recording(tmp_path / f"offline-{name}").events.slice(0, 20_000)
        assert np.nanmax(np.hypot(live.x - offline.x, live.y - offline.y)) < 1e-3


def test_a_slow_sink_makes_a_queue_drop_and_not_grow() -> None:
    recording = points(40_000, 0.5)
    held: list[int] = []
    source = Whole(packets_of(recording))

    def slow(_packet: Compensated) -> None:
        assert source.given.wait(LONG_S)
        held.append(session._queue.held)

    session = Session(source, KNOWN, sinks=(slow,), policy=Policy.DROP_OLDEST, queue_events=3000)
    status = session.run(threading.Event(), lambda _: None)
    assert max(held) <= 3000
    assert status.dropped > 0
    assert status.done + status.dropped == 40_000


def test_a_status_tells_rate_latency_coverage_and_sharpness(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Each packet arrives at the end of its time span and is compensated 3 ms later."""
    seen: list[SessionStatus] = []
    now_us = 0
    monkeypatch.setattr(session_module, "monotonic_us", lambda: now_us)
    given = packets_of(points(400_000, 3.0))

    class Paced(Made):
        def packets(self) -> Iterator[Packet]:
            nonlocal now_us
            events, until = 0, time.monotonic() + LONG_S
            for part in given:
                events += len(part.events)
                now_us = int(part.events.t[-1])
                yield replace(part, arrived_us=now_us - 3000)
                while session.status.done < events and time.monotonic() < until:
                    time.sleep(1e-4)

    out: list[Compensated] = []
    session = Session(Paced([]), KNOWN, sinks=(out.append,))
    session.run(threading.Event(), lambda status: seen.append(replace(status)), every_s=0.1)
    between = seen[1:-1]  # the first and the last cover shorter intervals
    assert len(between) >= 25
    assert [s.rate_mev_s for s in between] == pytest.approx([400_000 / 3e6] * len(between), rel=0.1)
    assert {s.latency_ms for s in between} == {(3.0, 3.0)}
    assert {s.covered for s in between} == {1.0}
    assert min(s.sharpness or 0.0 for s in between) > 2.0  # random events have sharpness 1
    assert [s.rpm for s in between] == pytest.approx([720.0] * len(between), rel=1e-3)
    assert not any((p.flags & ~np.uint8(OUTSIDE)).any() for p in out)


def test_a_status_counts_each_flag_of_the_events_by_itself() -> None:
    flags = np.array([0] * 9 + [OUTSIDE] * 5 + [EXTRAPOLATED] * 3 + [OUTSIDE | EXTRAPOLATED] * 2 + [OUTSIDE | NO_ANGLE],
                     np.uint8)  # fmt: skip
    events = Events.from_arrays([1] * 20, [2] * 20, np.arange(20), [1] * 20)
    status, figures = SessionStatus(), IntervalFigures(0)
    figures.add(Compensated(events, flags), 0, status)
    assert (status.done, status.outside, status.guessed, status.unknown) == (20, 8, 5, 1)
    figures.report(1000, status)
    assert status.covered == pytest.approx(1.0 - 6 / 20)


class Pulses:
    """Link to a controller of whose samples, pulses and clock a test decides. Times are the controller's [us]."""

    def __init__(self, times: Sequence[int], *, late_us: int, now_us: Callable[[], int]) -> None:
        self._times, self._late_us, self._now_us = list(times), late_us, now_us
        self._sampled = 0

    def clock(self) -> None:
        return None

    def poll(self) -> LinkUpdate:
        now = self._now_us()
        sync = []
        while self._times and self._times[0] + self._late_us <= now:
            sync.append((len(sync), self._times.pop(0), now))
        t = np.arange(self._sampled, max(now, self._sampled), 1000)
        self._sampled += 1000 * len(t)
        return LinkUpdate(t_us=t, angle=t * 720 / 60e6 * math.tau, index_t_us=np.zeros(0, np.int64), sync=tuple(sync),
                          restarted=False, messages=())  # fmt: skip


@pytest.mark.parametrize(
    ("intervals_ms", "late_us", "triggers", "flag", "said"),
    [
        ((70, 131), 0, True, 0, "by 6 pulses"),
        ((70, 131), 2_500_000, True, 0, "by "),
        (
            (100, 101),
            0,
            True,
            EXTRAPOLATED,
            "by pulses at regular intervals, as an older controller sends them",
        ),
        ((70, 131), 0, False, NO_ANGLE | OUTSIDE, "are not known yet: events wait for sync pulses"),
    ],
)
def test_events_wait_for_the_clocks_and_are_flagged_if_these_are_not_sure(
    monkeypatch: pytest.MonkeyPatch,
    intervals_ms: tuple[int, int],
    late_us: int,
    triggers: bool,
    flag: int,
    said: str,
) -> None:
    """The camera's clock is 3 s ahead of the controller's; the controller's reports may be late by seconds."""
    now_us = 0
    monkeypatch.setattr(session_module, "monotonic_us", lambda: now_us)
    monkeypatch.setattr(session_module.time, "monotonic", lambda: now_us * 1e-6)
    times = np.cumsum(np.random.default_rng(3).integers(*intervals_ms, 160)) * 1000
    link = Pulses(times.tolist(), late_us=late_us, now_us=lambda: now_us)
    messages: list[str] = []
    out: list[Compensated] = []
    session = Session(Made([]), KNOWN, link=link, sinks=(out.append,), say=messages.append)  # type: ignore[arg-type]
    rng = np.random.default_rng(0)
    sent = []
    for now_us in range(0, 13_000_000, 20_000):
        t = np.sort(rng.integers(now_us, now_us + 20_000, 50)) + 3_000_000 - 20_000
        events = Events.from_arrays(
            rng.integers(0, 64, 50), rng.integers(0, 48, 50), t, np.ones(50, int)
        )
        sent.append(events)
        seen = times[(times > now_us - 20_000) & (times <= now_us)] + 3_000_000 if triggers else []
        session._queue.put(make_packet(now_us, events, triggers=np.array(seen, np.int64)))
        session._step()
    assert any(said in message for message in messages), messages
    done = Events.concatenate([packet.events for packet in out])
    flags = np.concatenate([packet.flags for packet in out])
    given = Events.concatenate(sent)[: len(done)]
    assert len(done) > 50 * 40  # those that waited longest, of twelve seconds, at least
    # of the events of the first sample on, which nothing can be known about before
    since = given.t >= 3_000_000
    assert set((flags[since] & ~np.uint8(OUTSIDE if not flag & NO_ANGLE else 0)).tolist()) == {flag}
    if flag & NO_ANGLE:
        assert np.isnan(done.x).all()
        return
    encoder = Encoder.constant_speed(720.0, 0, 14_000_000)
    moved = Events.from_arrays(given.x, given.y, given.t - 3_000_000, given.p)
    truth = compensate_events(moved[np.flatnonzero(since)[0] :], MODEL, encoder)
    apart = np.hypot(truth[:, 0] - done.x[since], truth[:, 1] - done.y[since])
    assert np.nanmax(apart) < 0.01


def test_pulses_that_come_late_replace_arrival_times(monkeypatch: pytest.MonkeyPatch) -> None:
    """A cable that is plugged in after 8 s: the events before are guesses, those after it are sure and right."""
    now_us = 0
    monkeypatch.setattr(session_module, "monotonic_us", lambda: now_us)
    times = np.cumsum(np.random.default_rng(3).integers(70, 131, 150)) * 1000
    link = Pulses(times.tolist(), late_us=0, now_us=lambda: now_us)
    link.clock = lambda: fit_to_round_trips([0, 1000, 2000], [50, 1050, 2050], [100, 1100, 2100])  # type: ignore[method-assign,assignment,return-value]
    messages: list[str] = []
    out: list[Compensated] = []
    session = Session(Made([]), KNOWN, link=link, sinks=(out.append,), say=messages.append)  # type: ignore[arg-type]
    rng = np.random.default_rng(0)
    sent = []
    known = []
    delay_us = 15_000  # of all packets, which arrival times cannot know
    for now_us in range(0, 11_000_000, 20_000):
        t = np.sort(rng.integers(now_us, now_us + 20_000, 50)) + 3_000_000 - 20_000 - delay_us
        events = Events.from_arrays(
            rng.integers(0, 64, 50), rng.integers(0, 48, 50), t, np.ones(50, int)
        )
        sent.append(events)
        seen = (
            times[(times > now_us - 20_000) & (times <= now_us)] + 3_000_000
            if now_us > 8_000_000
            else []
        )
        session._queue.put(make_packet(now_us, events, triggers=np.array(seen, np.int64)))
        session._step()
        known.append(session.status.clock_source)
    changes = [a for a, b in itertools.pairwise([None, *known]) if a is not b][1:] + known[-1:]
    assert changes == [ClockSource.UNKNOWN, ClockSource.ARRIVAL, ClockSource.PULSES]
    by_arrival, by_pulses = messages
    assert "by arrival times" in by_arrival
    assert "by 6 pulses" in by_pulses
    done = Events.concatenate([packet.events for packet in out])
    flags = np.concatenate([packet.flags for packet in out])
    given = Events.concatenate(sent)[: len(done)]
    assert (flags[(given.t > 10_000_000) & (given.t < 10_500_000)] & EXTRAPOLATED).all()
    assert not (flags[given.t > 12_000_000] & EXTRAPOLATED).any()
    sure = (flags & (EXTRAPOLATED | NO_ANGLE)) == 0
    assert np.count_nonzero(sure) > 5000
    encoder = Encoder.constant_speed(720.0, 0, 12_000_000)
    moved = Events.from_arrays(given.x, given.y, np.maximum(given.t - 3_000_000, 0), given.p)
    truth = compensate_events(moved, MODEL, encoder)
    apart = np.hypot(truth[:, 0] - done.x, truth[:, 1] - done.y)
    assert np.nanmax(apart[sure]) < 0.01
    assert np.nanmax(apart[~sure]) > 1.0  # as it was without pulses
    # and the latency is the true one, though no packet ever came without delay
    session._report(lambda _: None)
    assert session.status.latency_ms[1] > delay_us * 1e-3


def test_the_latency_counts_from_the_events_own_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """What waited in a socket before it was read counts, too: here 2 s, of which the first packet had none."""
    now_us = 0
    monkeypatch.setattr(session_module, "monotonic_us", lambda: now_us)
    session = Session(Made([]), KNOWN, sinks=())
    packets = packets_of(points(4000, 0.2))
    for k, packet in enumerate(packets):
        last = int(packet.events.t[-1])
        now_us = last if k == 0 else last + 2_000_000
        session._queue.put(replace(packet, arrived_us=now_us))
        session._step()
    session._report(lambda _: None)
    assert session.status.latency_ms == (2000.0, 2000.0)


def test_samples_that_wait_while_the_controller_restarts_are_not_used_on_its_new_clock() -> None:
    def update(t_us: list[int], angle: list[float], *, restarted: bool) -> LinkUpdate:
        return LinkUpdate(t_us=np.array(t_us), angle=np.array(angle), index_t_us=np.zeros(0, np.int64), sync=(),
                          restarted=restarted, messages=())  # fmt: skip

    updates = [
        update([7_000_000, 7_001_000], [70.0, 70.1], restarted=False),
        update([500, 1500], [0.0, 0.1], restarted=True),
    ]
    link = SimpleNamespace(poll=lambda: updates.pop(0), clock=lambda: None)
    given: list[float] = []
    encoder = EncoderStream()
    feed = EncoderFeed(
        link, encoder, lambda t, angle, index_t, second: given.extend(angle), lambda _: None
    )  # type: ignore[arg-type]
    feed.poll()
    assert given == []  # the camera's clock is not known yet
    for t in (1000, 2000, 3000):
        feed.take(make_packet(t + 50, Events.from_arrays([1], [1], [t], [1])))
    link.clock = lambda: fit_to_round_trips([0, 1000, 2000], [50, 1050, 2050], [100, 1100, 2100])
    updates.append(update([], [], restarted=False))
    feed.settle()
    feed.poll()
    assert given == [0.0, 0.1]
    assert encoder.first is not None
    assert encoder.first < 1000


def test_what_runs_beside_keeps_its_order_and_tells_what_failed() -> None:
    done: list[int] = []
    beside = BackgroundWorker()
    for k in range(500):
        beside.put(lambda k=k: done.append(k))
    beside.close()
    assert done == list(range(500))
    failing = BackgroundWorker()

    def fail() -> None:
        raise AmiwarpError("full")

    failing.put(fail)
    with pytest.raises(AmiwarpError, match="full"):
        failing.close()
    failing.end()
