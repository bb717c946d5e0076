"""Beside a stream: the watch over the phase, the keeper of the speed, the last seconds as a recording, handing on."""

from __future__ import annotations

import math
import re
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from amiwarp import (
    AmiwarpError,
    Calibration,
    Camera,
    Compensated,
    Compensator,
    Encoder,
    EncoderStream,
    Events,
    Packet,
    Prism,
    PrismMotion,
    Recording,
    SensorModel,
    save_recording,
    simulate,
)
from amiwarp.live.stream import (
    EncoderSamples,
    FileSource,
    LiveSource,
    PacketDecoder,
    PhaseCheck,
    RecentEvents,
    SpeedController,
    SpeedKeeper,
    open_source,
)
from amiwarp.live.stream import recent_events as ring_module
from amiwarp.live.stream.adaptive import WINDOW_US
from amiwarp.live.stream.coverage import prism_orbit
from amiwarp.live.stream.forward import Forward
from amiwarp.live.stream.phase_check import PhaseEstimate
from amiwarp.live.stream.recent_events import SECONDS, followed
from amiwarp.viewer import Inspector
from reference.calibration_sample import exact_calibration

CAMERA, PRISM = Camera.from_fov(120, 90, math.radians(50)), Prism(math.radians(2.0))
BIAS_DEG = 3.5
"""By which the sharpest phase may differ from the true one."""


@pytest.fixture(scope="module")
def recording(texture: np.ndarray) -> Recording:
    return simulate(texture, CAMERA, PRISM, duration_s=0.4, seed=1, sensor=SensorModel.ideal())


def said(live: LiveSource) -> dict[str, str]:
    """Return what the inspector says of a stream: its rows by name, and as "note" what is wrong."""
    rows, note = live.figures()
    return {**{name: text for name, text, _ in rows}, "note": note}


def rpm(rows: dict[str, str]) -> float:
    return float(rows["speed of the prism"].split()[0])


def known(recording: Recording, away_deg: float) -> Calibration:
    assert recording.truth is not None
    values = {
        "apex": PRISM.apex,
        "phase": recording.truth.parameters["phase"] - math.radians(away_deg),
    }
    return exact_calibration(CAMERA, PRISM, values)


def streamed(recording: Recording) -> EncoderStream:
    stream = EncoderStream()
    assert recording.encoder is not None
    stream.append(recording.encoder.t, recording.encoder.angle)
    return stream


def looked(watch: PhaseCheck, encoder: EncoderStream, until_s: float = 120.0) -> float:
    """What the watch finds, which it is asked again and again as by a session."""
    end = time.monotonic() + until_s
    while (found := watch.update(encoder)) is None:
        assert time.monotonic() < end
        time.sleep(0.01)
    return math.degrees(found)


def test_a_watch_sees_that_the_phase_has_moved(recording: Recording) -> None:
    """Of 4 deg the second time: told; the first look is what it is compared with."""
    said: list[str] = []
    watch, encoder = PhaseCheck(known(recording, 1.0), 0.0, said.append), streamed(recording)
    watch.put(recording.events.slice(0, len(recording.events)))
    first = looked(watch, encoder)
    assert first == pytest.approx(1.0, abs=BIAS_DEG)
    assert said == []
    slipped = EncoderStream()
    assert recording.encoder is not None
    slipped.append(recording.encoder.t, recording.encoder.angle - math.radians(4.0))
    end = time.monotonic() + 120.0
    while abs(looked(watch, slipped) - first) < 1.0:
        assert time.monotonic() < end
        time.sleep(0.01)
    assert looked(watch, slipped) - first == pytest.approx(4.0, abs=0.5)
    assert len(said) == 1
    assert re.search(r"moved by \+(3\.[5-9]|4\.[0-5]) deg", said[0])
    watch.close()


def test_of_two_phases_the_larger_offset_counts_whatever_its_sign(
    recording: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    watch = PhaseCheck(known(recording, 0.0), 1e9, lambda _: None)
    for first, second in ((0.01, -0.03), (-0.04, 0.02), (0.05, 0.06)):
        found = [PhaseEstimate("phase", first, 0.001), PhaseEstimate("second_phase", second, 0.001)]
        monkeypatch.setattr(watch, "result", lambda found=found: found)
        assert watch.update(EncoderStream()) == max(first, second, key=abs)


@pytest.mark.parametrize("sure", [True, False])
def test_a_phase_that_is_off_may_be_a_wrong_clock_while_this_is_not_sure(
    recording: Recording, monkeypatch: pytest.MonkeyPatch, sure: bool
) -> None:
    said: list[str] = []
    watch = PhaseCheck(known(recording, 0.0), 1e9, said.append)
    monkeypatch.setattr(watch, "result", lambda: [PhaseEstimate("phase", 0.3, 0.001)])
    encoder = EncoderStream()
    encoder.sure = sure
    watch.update(encoder)
    assert len(said) == 1
    assert ("the clocks of controller and camera are probably wrong" in said[0]) is not sure
    assert said[0].endswith("calibrate again")


def test_a_watch_compares_with_the_calibration_by_sharpness(recording: Recording) -> None:
    """Which has the same bias. Beyond the search, the difference is at least that large."""
    plain, said = known(recording, 1.0), list[str]()
    found = []
    for bias_deg in (0.0, 3.0, -40.0):
        biased = known(recording, 1.0)
        sharp = {"phase": plain.parameters["phase"] + math.radians(bias_deg)}
        object.__setattr__(biased, "photometric", SimpleNamespace(sharpness_parameters=sharp))
        watch = PhaseCheck(biased, 0.0, said.append)
        watch.put(recording.events.slice(0, len(recording.events)))
        found.append(looked(watch, streamed(recording)))
        watch.close()
    assert found[0] - found[1] == pytest.approx(3.0, abs=0.3)
    assert found[2] == pytest.approx(20.0, abs=0.2)
    assert said == [
        "the phase differs from the calibrated one by at least +20.0 deg: calibrate again"
    ]


@pytest.fixture(scope="module")
def pair(texture: np.ndarray) -> tuple[Recording, Calibration]:
    """A recording of a pair of prisms, and its true calibration."""
    both = replace(PRISM, second=Prism(math.radians(1.5)))
    motion = PrismMotion(720.0, 0.3, second=PrismMotion(-500.0, -0.7))
    made = simulate(
        texture, CAMERA, both, motion=motion, duration_s=0.2, seed=1, sensor=SensorModel.ideal()
    )
    values = {
        "apex": PRISM.apex,
        "second_apex": math.radians(1.5),
        "phase": 0.3,
        "second_phase": -0.7,
    }
    return made, replace(exact_calibration(CAMERA, both, values), model_name="risley")


def test_a_watch_sees_which_prism_of_a_pair_has_moved(pair: tuple[Recording, Calibration]) -> None:
    recording, calibration = pair
    said: list[str] = []
    watch = PhaseCheck(calibration, 0.0, said.append)
    watch.put(recording.events.slice(0, len(recording.events)))
    assert recording.encoder is not None
    first, other = recording.encoder, recording.encoder.second
    assert other is not None

    def samples(slip_deg: float) -> EncoderStream:
        second = EncoderStream()
        stream = EncoderStream(second=second)
        stream.append(first.t, first.angle)
        second.append(other.t, other.angle - math.radians(slip_deg))
        return stream

    assert abs(looked(watch, samples(0.0))) < BIAS_DEG
    assert said == []
    end = time.monotonic() + 120.0
    while not said:
        looked(watch, samples(4.0))
        assert time.monotonic() < end
        time.sleep(0.01)
    assert re.match(
        r"the second phase (has moved by \+(3\.[5-9]|4\.[0-5])|differs from the calibrated one by \+)",
        said[0],
    )
    watch.close()
    assert len(said) == 1


def test_a_ring_of_a_pair_holds_both_encoders(
    pair: tuple[Recording, Calibration], tmp_path: Path
) -> None:
    recording, _ = pair
    assert recording.encoder is not None
    assert recording.encoder.second is not None
    save_recording(tmp_path / "r.h5", replace(recording, truth=None))
    ring = RecentEvents(FileSource(tmp_path / "r.h5"))
    ring.append(recording.events.slice(0, len(recording.events)))
    ring.append_encoder(recording.encoder.t, recording.encoder.angle)
    assert ring.recording() is None  # the second encoder has sent nothing
    second = recording.encoder.second
    late = second.t > 30_000
    ring.append_encoder(second.t[late], second.angle[late], second=True)
    found = ring.recording()
    assert found is not None
    assert found.encoder is not None
    assert found.events.t_first >= 29_000
    t = np.array([40_000, 90_000, 140_000])
    np.testing.assert_allclose(
        found.encoder.angles_at(t), recording.encoder.angles_at(t), rtol=0, atol=1e-9
    )
    assert Inspector(found).knobs.model == "risley"
    ring.restart()
    assert ring.recording() is None


def test_a_jump_of_a_command_is_no_restart() -> None:
    """The ring holds the events of many swings, most of which do not reach the largest command."""
    source = type(
        "Source",
        (),
        {"size": (120, 90), "camera": CAMERA, "prism": None, "name": "made", "encoders": 2},
    )()
    ring, t = RecentEvents(source), np.arange(0, 200_000, 250)
    jumps = 0
    for second, speed in ((False, 7e-4), (True, 5e-4)):
        encoder = Encoder.from_command(t, np.sin(3e-4 * t) + 0.4 * np.cos(speed * t))
        ring.append_encoder(encoder.t, encoder.angle, second=second)
        jumps += len(encoder.t) - len(t)
    assert jumps > 10
    ring.append(Events.from_arrays(np.full(t.size, 5), np.full(t.size, 5), t, np.zeros(t.size)))
    found = ring.recording()
    assert found is not None
    assert len(found.events) == len(t)


def test_a_watch_tells_a_phase_that_is_far_off(recording: Recording) -> None:
    said: list[str] = []
    watch = PhaseCheck(known(recording, 12.0), 0.0, said.append)
    watch.put(recording.events.slice(0, len(recording.events)))
    assert looked(watch, streamed(recording)) == pytest.approx(12.0, abs=BIAS_DEG)
    assert "calibrate again" in said[0]
    watch.close()


def test_a_watch_says_nothing_of_too_little(recording: Recording) -> None:
    watch = PhaseCheck(known(recording, 0.0), 0.0, print)
    assert not watch.start_check(streamed(recording))
    watch.put(recording.events.slice(0, 1000))
    assert not watch.start_check(streamed(recording))
    assert not watch.start_check(EncoderStream())
    assert watch.update(streamed(recording)) is None


def kept(
    recording: Recording, *, most_mev_s: float, fail: bool = False
) -> tuple[list[float], list[str]]:
    model = known(recording, 0.0).model
    controller = SpeedController(prism_orbit(model), 720.0, most_mev_s=most_mev_s)
    asked: list[float] = []
    said: list[str] = []

    def set_speed(rpm: float, ramp: float) -> None:
        assert ramp == controller.ramp_rpm_s
        if fail:
            raise AmiwarpError("refused by the controller")
        asked.append(rpm)

    encoder = streamed(recording)
    compensator, keeper = (
        Compensator(model, encoder),
        SpeedKeeper(model, controller, set_speed, said.append),
    )
    for events in recording.events.blocks(duration_us=2000):
        compensator.put(events, 0)
        keeper.put(compensator.take(0), encoder)
        keeper.close()
    assert keeper.coverage is not None
    assert 0.0 <= keeper.coverage <= 1.0
    return asked, said


def test_a_keeper_asks_for_less_where_there_are_too_many_events(recording: Recording) -> None:
    asked, said = kept(recording, most_mev_s=0.01)
    assert len(asked) > 3
    assert asked == sorted(asked, reverse=True)
    assert 120.0 <= asked[-1] < 700.0
    assert said == []


def test_a_keeper_says_what_the_controller_refuses(recording: Recording) -> None:
    asked, said = kept(recording, most_mev_s=0.01, fail=True)
    assert asked == []
    assert set(said) == {"refused by the controller"}


@pytest.mark.parametrize("packet_us", [2000, 50_000, 400_000])
def test_a_keeper_measures_windows_of_one_length(
    recording: Recording, packet_us: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """However much comes at once; of a backlog the last windows."""
    model, encoder, windows = known(recording, 0.0).model, streamed(recording), []
    controller = SpeedController(prism_orbit(model), 720.0)
    update = SpeedController.update

    def noted(self: SpeedController, start_us: int, end_us: int, *more: Any) -> float | None:
        windows.append((start_us, end_us))
        return update(self, start_us, end_us, *more)

    monkeypatch.setattr(SpeedController, "update", noted)
    compensator = Compensator(model, encoder)
    keeper = SpeedKeeper(model, controller, lambda rpm, ramp: None, pytest.fail)
    for events in recording.events.blocks(duration_us=packet_us):
        compensator.put(events, 0)
        keeper.put(compensator.take(0), encoder)
    keeper.close()
    assert {end - start for start, end in windows} == {WINDOW_US}
    assert all(start == end for (_, end), (start, _) in pairwise(windows[-10:]))
    assert recording.events.t_last - windows[-1][1] < WINDOW_US + packet_us
    assert len(windows) >= min(10, recording.events.t_last // WINDOW_US - 2)


def test_a_keeper_passes_over_what_the_samples_do_not_cover(recording: Recording) -> None:
    """The first two are six times as far apart as the others: before them angles are known for a usual distance."""
    model, encoder = known(recording, 0.0).model, EncoderStream()
    t = np.concatenate([[0], np.arange(6000, 200_000, 1000)])
    encoder.append(t, t * 7.5e-5)
    keeper = SpeedKeeper(
        model, SpeedController(prism_orbit(model)), lambda rpm, ramp: None, pytest.fail
    )
    x = np.full(1000, 10.0, np.float32)
    early = Events(x, x, np.linspace(-5000, 30_000, 1000).astype(np.int64), np.ones(1000, np.uint8))
    late = Events(
        x, x, np.linspace(30_000, 150_000, 1000).astype(np.int64), np.ones(1000, np.uint8)
    )
    keeper.put([Compensated(early, np.zeros(1000, np.uint8))], encoder)
    assert keeper.coverage is None
    keeper.put([Compensated(late, np.zeros(1000, np.uint8))], encoder)
    assert keeper.coverage is not None


def test_a_ring_holds_the_last_seconds(recording: Recording) -> None:
    source = type(
        "Source",
        (),
        {"size": (120, 90), "camera": CAMERA, "prism": PRISM, "name": "made", "encoders": 1},
    )()
    ring = RecentEvents(source)
    assert ring.recording() is None
    rng = np.random.default_rng(0)
    for start in range(0, 10_000_000, 50_000):
        t = np.sort(rng.integers(start, start + 50_000, 100))
        ring.append(
            Events.from_arrays(
                rng.integers(0, 120, 100), rng.integers(0, 90, 100), t, np.zeros(100)
            )
        )
        samples = np.arange(start, start + 50_000, 1000)
        ring.append_encoder(samples, samples * 7.5e-5)
    found = ring.recording()
    assert found is not None
    assert found.encoder is not None
    assert found.events.t_last - found.events.t_first == pytest.approx(SECONDS * 1e6, abs=100_000)
    assert found.encoder.covers(found.events.t_first, found.events.t_last)
    assert found.encoder.rpm == pytest.approx(7.5e-5 * 60e6 / math.tau)
    assert (found.camera, found.prism) == (CAMERA, PRISM)


def made_source() -> Any:
    """Return what a ring needs to know of a source."""
    return type(
        "Source",
        (),
        {"size": (120, 90), "camera": CAMERA, "prism": PRISM, "name": "made", "encoders": 1},
    )()


def put_events(ring: RecentEvents, start: int, stop: int) -> None:
    t = np.arange(start, stop, 500)
    ring.append(Events.from_arrays(np.full(t.size, 5), np.full(t.size, 5), t, np.zeros(t.size)))


@pytest.mark.parametrize("lag_us", [500_000, 3_000_000, 9_000_000])
def test_the_newest_whole_turn_is_given_however_late_the_events_are(lag_us: int) -> None:
    """A computer that is too slow gets the angles at once, and the events with a growing lag."""
    ring, speed = RecentEvents(made_source()), 720.0 * math.tau / 60e6
    live = None
    for start in range(0, 20_000_000, 50_000):
        samples = np.arange(start, start + 50_000, 1000)
        ring.append_encoder(samples, samples * speed)
        if start >= lag_us:
            put_events(ring, start - lag_us, start - lag_us + 50_000)
            if ring.recording() is not None:
                live = live or LiveSource(ring, [])
                newest = live().events.t_last
                assert newest == start - lag_us + 49_500
    assert live is not None
    assert ring.lag_s == pytest.approx(lag_us * 1e-6, abs=0.01)
    rows, note = live.figures()
    lag = next(row for row in rows if row[0] == "lag")
    assert lag[1:] == [f"{lag_us * 1e-6:.1f} s", "bad" if lag_us > 2e6 else ""]
    assert note.startswith(f"The events are {lag_us * 1e-6:.1f} s late: ") is (lag_us > 2e6)
    assert live().encoder.covers(live().events.t_first, live().events.t_last)  # type: ignore[union-attr]


def test_events_that_come_long_before_their_angles_are_kept() -> None:
    ring, speed = RecentEvents(made_source()), 720.0 * math.tau / 60e6
    for start in range(0, 8_000_000, 50_000):
        put_events(ring, start, start + 50_000)
        if start >= 5_000_000:
            samples = np.arange(start - 5_000_000, start - 4_950_000, 1000)
            ring.append_encoder(samples, samples * speed)
    found = ring.recording()
    assert found is not None
    assert found.events.t_last == pytest.approx(2_999_000, abs=1000)
    assert found.events.t_last - found.events.t_first == pytest.approx(SECONDS * 1e6, abs=100_000)
    for start in range(8_000_000, 40_000_000, 50_000):  # the angles end
        put_events(ring, start, start + 50_000)
    held = ring.event_bytes
    put_events(ring, 40_000_000, 40_050_000)
    assert ring.event_bytes == pytest.approx(held, rel=0.02)


def test_gaps_in_the_angles_that_the_late_events_have_not_reached_hide_no_turn() -> None:
    """The angles have a gap each second; the events are 2.5 s late."""
    ring, speed = RecentEvents(made_source()), 720.0 * math.tau / 60e6
    for start in range(0, 10_000_000, 50_000):
        if start % 1_000_000:
            samples = np.arange(start, start + 50_000, 1000)
            ring.append_encoder(samples, samples * speed)
        if start >= 2_500_000:
            put_events(ring, start - 2_500_000, start - 2_450_000)
    found = ring.recording()
    assert found is not None
    assert found.events.t_last == 7_499_500
    assert found.events.t_first >= 7_049_000  # since the gap before it
    assert ring.turn_share == 1.0
    put_events(ring, 7_500_000, 8_080_000)
    found = ring.recording()
    assert found is not None
    assert ring.turn_share == pytest.approx(0.36, abs=0.02)  # since the last gap
    assert 7_900_000 < found.events.t_last < 8_000_000  # the turn before it


def test_the_lag_of_a_stream_with_its_own_angles_is_that_after_its_promptest_events(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now = [100.0]
    monkeypatch.setattr(ring_module.time, "monotonic", lambda: now[0])
    ring = RecentEvents(made_source())
    assert ring.lag_s == 0.0
    for k, late in enumerate((0.5, 0.2, 3.2)):
        now[0] = 100.0 + k + late
        put_events(ring, 1_000_000 * k, 1_000_000 * k + 500)
    assert ring.lag_s == pytest.approx(3.0)
    ring.restart()
    now[0] = 200.0
    put_events(ring, 0, 500)
    assert ring.lag_s == 0.0


def test_the_speed_is_that_of_the_first_turn() -> None:
    """The motor was at rest for a second before the first events."""
    source = type(
        "Source",
        (),
        {"size": (120, 90), "camera": CAMERA, "prism": PRISM, "name": "made", "encoders": 1},
    )()
    ring, speed = RecentEvents(source), 720.0 * math.tau / 60e6
    samples = np.arange(0, 1_090_000, 1000)
    ring.append_encoder(samples, np.maximum(samples - 1_000_000, 0) * speed)
    assert ring.turn_share == 0.0
    for start, complete in ((1_000_000, False), (1_030_000, False), (1_060_000, True)):
        t = np.linspace(start, start + 29_000, 50).astype(np.int64)
        ring.append(Events.from_arrays(np.full(50, 5), np.full(50, 5), t, np.zeros(50)))
        assert (ring.recording() is not None) is complete
        assert ring.turn_share == pytest.approx(
            min((start + 29_000 - 1_000_000) * 720 / 60e6, 1.0), abs=1e-3
        )
    assert ring.age_s < 60.0
    figures = said(LiveSource(ring, ["moved"]))
    assert rpm(figures) == pytest.approx(720.0, rel=1e-3)
    assert figures["last message"] == "moved"
    shown = Inspector(LiveSource(ring, [])())
    assert shown.turn_us == pytest.approx(60e6 / 720.0, rel=1e-3)


def test_lost_angles_are_said_and_no_extrapolated_speed_is_shown() -> None:
    """The controller's port is gone from 0.2 s on. At 0.5 s it is back, after a reset: its angles start at 0."""
    source = type(
        "Source",
        (),
        {"size": (120, 90), "camera": CAMERA, "prism": PRISM, "name": "made", "encoders": 1},
    )()
    ring, stream, speed = RecentEvents(source), EncoderStream(), 720.0 * math.tau / 60e6
    ring.link = type("Link", (), {"connected": True, "name": "COM3"})()

    def arrive(start: int, stop: int, zero: int | None) -> None:
        t = np.arange(start, stop, 1000)
        ring.append(Events.from_arrays(np.full(t.size, 5), np.full(t.size, 5), t, np.zeros(t.size)))
        if zero is not None:
            ring.append_encoder(*stream.append(t, (t - zero) * speed))

    arrive(0, 200_000, 0)
    live = LiveSource(ring, [])
    before = live()
    ring.link.connected = False
    arrive(200_000, 500_000, None)
    assert live().events.t_last <= 200_000
    lost = said(live)
    assert lost["events"] == "receiving"
    assert "No prism angles arrive: the port COM3 of the controller is gone." in lost["note"]
    assert rpm(lost) == pytest.approx(720.0, rel=1e-3)
    ring.link.connected = True
    stream.restart()
    arrive(500_000, 540_000, 500_000)
    back = said(live)
    assert live().events.t_last <= before.events.t_last + 1000
    assert back["note"] == ""
    assert float(said(live)["turn covered"].removesuffix(" %")) == pytest.approx(48.0, abs=2.0)
    assert rpm(back) == pytest.approx(720.0, rel=1e-3)
    arrive(540_000, 600_000, 500_000)
    assert live().events.t_first >= 499_000
    assert rpm(said(live)) == pytest.approx(720.0, rel=1e-3)
    assert Inspector(live()).turn_us == pytest.approx(60e6 / 720.0, rel=1e-3)


def test_a_stream_is_followed_while_one_looks(
    recording: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    save_recording(tmp_path / "r.h5", replace(recording, truth=None))
    messages: list[str] = []
    monkeypatch.setattr(ring_module, "FIRST_S", 120.0)
    looked_at = threading.Event()

    class Held(FileSource):
        """Gives a turn, and the rest once somebody has looked."""

        def packets(self) -> Iterator[Packet]:
            for packet in super().packets():
                if len(packet.events) and packet.events.t[-1] > recording.events.t_first + 200_000:
                    assert looked_at.wait(120.0)
                yield packet

    source = Held(tmp_path / "r.h5")
    ring = RecentEvents(source)
    with followed(source, None, ring, messages.append):
        first = ring.recording()
        assert first is not None
        live = LiveSource(ring, messages)
        assert live().events.t_last >= first.events.t_last
        running = said(live)
        assert (running["note"], running["turn covered"], "last message" in running) == (
            "",
            "100 %",
            False,
        )
        assert rpm(running) == pytest.approx(720.0, rel=1e-3)
        looked_at.set()
        end = time.monotonic() + 120.0
        while not messages:
            assert time.monotonic() < end
            time.sleep(0.01)
        last = ring.recording()
    assert last is not None
    assert last.events.t_last > first.events.t_last
    assert "the stream has ended" in messages[0]
    over = said(live)
    assert over["events"] == "interrupted, last ones shown"
    assert over["note"] == f"The stream is interrupted: {messages[0]}."
    assert over["lost events"] == "0"
    assert live().events.t_last == last.events.t_last
    assert not [t for t in threading.enumerate() if t.name == "amiwarp-follow"]


def test_a_stream_without_a_turn_is_told(tmp_path: Path, recording: Recording) -> None:
    assert recording.encoder is not None
    still = replace(recording.encoder, angle=np.zeros(recording.encoder.t.size))
    save_recording(tmp_path / "r.h5", replace(recording, encoder=still, truth=None))
    source = open_source(str(tmp_path / "r.h5"), pace=None)
    with (
        pytest.raises(AmiwarpError, match="less than one full turn"),
        followed(source, None, RecentEvents(source), lambda _: None),
    ):
        raise AssertionError("followed")


def test_what_is_handed_on_is_what_came(recording: Recording) -> None:
    sent: list[bytes] = []
    sink = type(
        "Sink",
        (),
        {"send": lambda self, data: sent.append(data), "tick": lambda self: sent.append(b"")},
    )()
    forward, events = Forward(sink), recording.events.slice(0, 500)
    forward.append(events)
    forward.append_encoder(np.array([1, 2]), np.array([0.5, 0.6]))
    forward.append_encoder(np.array([3]), np.array([0.7]), second=True)
    forward.tick()
    assert sent.pop() == b""
    first, second, third = [
        message for data in sent for message in PacketDecoder("here").feed(data)
    ]
    assert (third.second, third.t.tolist(), third.angle.tolist()) == (True, [3], [0.7])
    assert isinstance(first, Events)
    np.testing.assert_array_equal(first.t, events.t)
    assert isinstance(second, EncoderSamples)
    np.testing.assert_array_equal(second.angle, [0.5, 0.6])
