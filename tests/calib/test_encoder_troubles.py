"""Troubles of encoders that calibration corrects: lost counts, and pulses that leave the angle between them open."""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from amiwarp import (
    AmiwarpError,
    Calibration,
    Encoder,
    EncoderModel,
    Events,
    MemoryEvents,
    Prism,
    PrismMotion,
    Settings,
    calibrate,
)
from amiwarp.calib import (
    attempts,
    checks,
    coarse_encoder,
    pulse_attempts,
    start_burst,
    straight_angles,
)
from amiwarp.calib.calibrator import Calibrator
from amiwarp.calib.lost_counts import Step, changes_of_mean, lost_counts, without_steps
from amiwarp.calib.photometric import limits
from amiwarp.calib.photometric.losses import step_if_missing
from amiwarp.calib.prism_path import PathFit
from amiwarp.calib.pulses import confirm, pulses_only, smooth_path
from amiwarp.calib.repeated_turns import steps_in_events
from amiwarp.viewer import Inspector
from benchmarks import encoder_troubles
from benchmarks.encoder_troubles import (
    Trouble,
    compensation_error,
    hunting,
    losing,
    recorded,
    steady,
    turns_of,
)
from tests.conftest import COARSE

SIZE = (160, 120)
LOST_AT = 337_300
"""Time at which the encoder loses counts [us]."""
STEP = math.radians(100 * 360 / 4096)
BETWEEN_PULSES = "a speed that varies between pulses"


@pytest.fixture(scope="module")
def still() -> Trouble:
    """Eight turns of a steady prism with a good encoder."""
    return recorded(SIZE, steady(), seconds=0.68)


def found_in(trouble: Trouble) -> Calibration:
    return calibrate(trouble.recording, model="exact", photometric=COARSE)


def samples(
    motion: PrismMotion, counts: int, *, index: bool, within_us: int = 0, **model: Any
) -> Encoder:
    """Return an encoder without events that loses counts at 0.337 s."""
    encoder = replace(EncoderModel(counts_per_turn=4096), **model).sample(motion, 1_000_000, 1)
    lost = np.clip((encoder.t - LOST_AT) / max(within_us, 1), 0.0, 1.0)
    given = Encoder(encoder.t, encoder.angle - np.rint(counts * lost) * (math.tau / 4096))
    return (
        given.with_index(turns_of(motion, int(encoder.t[0]), int(encoder.t[-1])))
        if index
        else given
    )


@pytest.mark.parametrize(
    "motion", [steady(), hunting(0.3, 0.7), PrismMotion(-720.0)], ids=["steady", "slow", "back"]
)
@pytest.mark.parametrize("index", [True, False])
@pytest.mark.parametrize("counts", [10, 100, -500])
def test_samples_show_when_counts_were_lost(motion: PrismMotion, index: bool, counts: int) -> None:
    [step] = lost_counts(samples(motion, counts, index=index))
    assert step.angle == pytest.approx(-counts * math.tau / 4096, abs=math.radians(0.15))
    assert step.first_us <= LOST_AT <= step.last_us
    assert step.last_us - step.first_us < 1100


@pytest.mark.parametrize(
    ("degrees", "order"), [(0.3, 3), (1.0, 2), (3.0, 1)], ids=["thrice", "twice", "once"]
)
def test_samples_show_lost_counts_next_to_an_error_that_repeats(degrees: float, order: int) -> None:
    given = samples(PrismMotion(760.0), 15, index=False)
    wave = math.radians(degrees) * np.cos(order * given.angle + 0.4)
    wrong = replace(given, angle=given.angle + wave)
    [step] = lost_counts(wrong)
    assert step.angle == pytest.approx(-15 * math.tau / 4096, abs=math.radians(0.12))
    assert step.first_us <= LOST_AT <= step.last_us
    assert (
        lost_counts(replace(wrong, angle=samples(PrismMotion(760.0), 0, index=False).angle + wave))
        == ()
    )


def test_a_pause_of_the_samples_hides_a_small_step_only() -> None:
    """What the prism does in a pause is not known: between its sides, a path that bends looks like a small step."""
    for counts, shown in ((-12, False), (-200, True)):
        given = samples(hunting(0.05, 20.0), counts, index=False)
        there = np.abs(given.t - LOST_AT) > 6_000
        steps = lost_counts(Encoder(given.t[there], given.angle[there]))
        assert bool(steps) == shown


@pytest.mark.parametrize("index", [True, False])
@pytest.mark.parametrize(
    "model",
    [
        {},
        {"jitter_us": 50.0},
        {"dropouts_hz": 10.0},
        {"harmonics": (0.05, 0.02, 0.01, 0.0)},
        {"rate_hz": 1e4},
    ],
    ids=["plain", "late", "gaps", "eccentric", "fast"],
)
def test_a_right_encoder_has_no_step(index: bool, model: dict[str, Any]) -> None:
    for motion in (steady(), hunting(0.3, 0.7), hunting(0.1, 60.0)):
        assert lost_counts(samples(motion, 0, index=index, **model)) == ()


def test_an_index_shows_counts_that_were_lost_gradually() -> None:
    [step] = lost_counts(samples(steady(), 100, index=True, within_us=40_000))
    assert step.angle == pytest.approx(-STEP, abs=1e-3)
    assert step.first_us <= LOST_AT
    assert step.last_us >= LOST_AT + 40_000
    assert step.last_us - step.first_us < 84_000


@pytest.mark.parametrize("within_us", [6_000, 10_000])
def test_counts_that_are_lost_over_several_samples_are_no_step_of_them(within_us: int) -> None:
    assert lost_counts(samples(steady(), 100, index=False, within_us=within_us)) == ()


def test_two_losses_are_two_steps() -> None:
    once = samples(steady(), 100, index=True)
    twice = replace(once, angle=once.angle + 0.1 * (once.t > 700_000))
    first, second = lost_counts(twice)
    assert (first.angle, second.angle) == pytest.approx((-STEP, 0.1), abs=1e-3)
    mended = without_steps(twice, (first, second))
    assert float(np.abs(mended.slip()).max()) < 3e-3


def test_a_drift_is_no_step() -> None:
    assert changes_of_mean(np.linspace(0.0, 1.0, 40)) == []
    noise = np.random.default_rng(0).normal(0.0, 0.001, 40)
    assert changes_of_mean(np.where(np.arange(40) < 17, 0.0, 0.3) + noise) == [
        (17, pytest.approx(0.3, abs=0.002))
    ]


def test_events_show_counts_that_were_lost_backwards() -> None:
    slipped = losing(
        recorded(SIZE, PrismMotion(-720.0, 1.0), seconds=0.68), 100, LOST_AT, index=False
    ).recording
    assert slipped.encoder is not None
    [step] = steps_in_events(slipped, slipped.encoder)
    assert step.angle == pytest.approx(-STEP, abs=math.radians(0.5))
    assert step.first_us <= LOST_AT <= step.last_us


def test_events_show_counts_that_were_lost(still: Trouble) -> None:
    encoder = still.recording.encoder
    assert encoder is not None
    assert steps_in_events(still.recording, encoder) == ()
    for within_us in (0, 40_000):
        slipped = losing(still, 100, LOST_AT, index=False, within_us=within_us).recording
        assert slipped.encoder is not None
        [step] = steps_in_events(slipped, slipped.encoder)
        assert step.angle == pytest.approx(-STEP, abs=math.radians(0.5))
        assert step.first_us <= LOST_AT + within_us
        assert step.last_us >= LOST_AT


def test_steps_come_on_the_encoder_s_clock(still: Trouble) -> None:
    slipped = losing(still, 100, LOST_AT, index=False).recording
    assert slipped.encoder is not None
    late = replace(slipped.encoder, t=slipped.encoder.t + 500_000, clock_offset_us=500_000.0)
    [step] = steps_in_events(slipped, late)
    assert step.first_us - 500_000 <= LOST_AT <= step.last_us - 500_000
    assert "at 0.337 s" in Step(337_000, 338_000, STEP).in_words(0)


@pytest.mark.slow
@pytest.mark.parametrize("index", [True, False])
def test_lost_counts_are_put_back(still: Trouble, index: bool, tmp_path: Path) -> None:
    trouble = losing(still, 100, LOST_AT, index=index)
    found = found_in(trouble)
    assert compensation_error(trouble, found)[0] < 0.015  # px; 0.13 without the correction
    shown = "its index pulses" if index else "the events"
    assert "the encoder's angle steps by -8." in found.warnings[-1]
    assert f"at 0.337 s, as {shown} show" in found.warnings[-1]
    found.save(tmp_path / "c.json")
    again = Calibration.load(tmp_path / "c.json")
    encoder, events = trouble.recording.encoder, trouble.recording.events
    assert encoder is not None
    ends = events.t_first, events.t_last
    mended = again.encoder_for(encoder, *ends)
    assert found.path is not None
    np.testing.assert_array_equal(mended.angle, found.path.angle)
    inspector = Inspector(trouble.recording, again)
    np.testing.assert_array_equal(inspector.encoder.angle, found.path.angle)
    # the encoder of another recording keeps its angles
    other = replace(encoder, t=encoder.t + 1)
    np.testing.assert_array_equal(again.encoder_for(other, *ends).angle, other.angle)
    # of a part of the same recording they are replaced
    part = Encoder(encoder.t[100:500], encoder.angle[100:500])
    np.testing.assert_array_equal(again.encoder_for(part, *part.coverage).angle, found.path.angle)


@pytest.mark.slow
@pytest.mark.parametrize("index", [True, False])
def test_counts_that_were_lost_gradually_are_put_back(still: Trouble, index: bool) -> None:
    trouble = losing(still, 100, LOST_AT, index=index, within_us=40_000)
    found = found_in(trouble)
    assert compensation_error(trouble, found)[0] < 0.03
    assert "the encoder's angle steps by" in found.warnings[-1]


def test_a_right_encoder_is_left_alone(still: Trouble) -> None:
    found = found_in(still)
    assert found.path is None
    assert found.warnings == ()


def test_pulses_have_a_smooth_path() -> None:
    motion = hunting(0.05, 3.0)
    t = turns_of(motion, -200_000, 1_200_000)
    pulses = Encoder(t, np.rint(motion.angle(t) / math.tau) * math.tau, 25.0)
    assert pulses_only(pulses)
    assert not pulses_only(samples(motion, 0, index=True))
    path = smooth_path(pulses)
    assert path.clock_offset_us == 25.0
    inside = (path.t > 0) & (path.t < 1_000_000)
    away = (path.angle - motion.angle(path.t))[inside]
    assert float(np.std(away)) < 0.01  # rad; linear between the pulses it is 0.027
    assert set(t.tolist()) <= set(path.t.tolist())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("motion", "jitter_us"),
    [(steady, 500.0), (lambda: hunting(0.06, 17.0), 0.0), (lambda: hunting(0.05, 3.0), 0.0)],
    ids=["jitter", "17 Hz", "3 Hz"],
)
def test_the_angle_between_pulses_is_found(
    motion: Callable[[], PrismMotion], jitter_us: float
) -> None:
    trouble = encoder_troubles.pulses_only(recorded(SIZE, motion()), jitter_us)
    found = found_in(trouble)
    assert compensation_error(trouble, found)[0] < 0.02
    assert "the encoder gives pulses only" in found.warnings[-1]


@pytest.mark.slow
@pytest.mark.parametrize(("share", "hz"), [(0.02, 9.0), (0.06, 50.0)], ids=["slow", "fast"])
def test_a_swing_between_pulses_leaves_little(share: float, hz: float) -> None:
    trouble = encoder_troubles.pulses_only(recorded(SIZE, hunting(share, hz), seconds=0.8))
    found = calibrate(trouble.recording, model="exact")
    assert compensation_error(trouble, found)[0] < 0.006  # px; 0.04 and 0.03 without a path
    assert "the encoder gives pulses only" in found.warnings[-1]


def test_even_pulses_keep_their_angles() -> None:
    trouble = encoder_troubles.pulses_only(recorded(SIZE, steady(), seconds=0.4))
    found = found_in(trouble)
    assert found.path is None
    assert found.warnings == ()
    assert found.photometric is not None
    assert 0.0 < found.photometric.hidden_px[BETWEEN_PULSES] < 0.02


@pytest.mark.slow
def test_what_is_not_found_between_pulses_is_bounded() -> None:
    trouble = encoder_troubles.pulses_only(recorded(SIZE, hunting(0.004, 9.0), seconds=0.8))
    found = calibrate(trouble.recording, model="exact")
    error_px = compensation_error(trouble, found)[0]
    assert found.path is None
    assert found.photometric is not None
    assert error_px < found.photometric.hidden_px[BETWEEN_PULSES] < 3.0 * error_px


@pytest.mark.parametrize(
    ("few_px", "all_px", "found", "stated_px"),
    [
        ((0.001, 0.004), (0.02, 0.001), False, (0.001, 0.004)),
        ((0.013, 0.004), (0.013, 0.001), True, (0.013, 0.001)),
        ((0.013, 0.004), (0.004, 0.001), False, (0.004, 0.001)),
        ((0.013, 0.004), (0.013, 0.003), False, (0.013, 0.003)),
        ((0.030, 0.004), (0.009, 0.003), True, (0.009, 0.003)),
    ],
    ids=["few exclude it", "all show it", "all exclude it", "all leave it open", "few show it"],
)
def test_all_pairs_decide_what_few_leave_open(
    monkeypatch: pytest.MonkeyPatch,
    still: Trouble,
    few_px: tuple[float, float],
    all_px: tuple[float, float],
    found: bool,
    stated_px: tuple[float, float],
) -> None:
    """Each pair of numbers is a deviation from the smooth path through pulses, and its standard deviation [px]."""
    pulses = encoder_troubles.pulses_only(still).recording
    assert pulses.encoder is not None
    path = smooth_path(pulses.encoder)

    class Fit(PathFit):
        def __init__(self, *given: Any, knots_per_turn: float = 16.0, **named: Any) -> None:
            self.px = few_px if len(given) > 2 else all_px
            self.std_px = self.px[1]

        def _improve(self, k: int) -> float:
            return 0.0

        def deviation_px(self) -> float:
            return self.px[0]

        def run(self) -> Encoder:
            return path

    monkeypatch.setattr(pulse_attempts, "PathFit", Fit)
    monkeypatch.setattr(pulse_attempts, "px_per_rad", lambda *_: 0.0)
    start = SimpleNamespace(
        calibration_events=SimpleNamespace(events=pulses.events[:]),
        space=SimpleNamespace(to_vector=lambda _: None),
        best={},
    )
    monkeypatch.setattr(pulse_attempts, "search_on", lambda *_: start)
    calibrator = Calibrator(pulses, Settings(model="exact"), "cpu", None)
    tried: Any = SimpleNamespace(doubtful=True, calibration=None)
    between = pulse_attempts.between_pulses(
        calibrator,
        tried,
        SimpleNamespace(full_space=None),  # type: ignore[arg-type]
    )
    assert (between.calibrator is not None) == found
    assert (between.deviation_px, between.std_px) == stated_px


@pytest.mark.parametrize(
    ("cost", "doubtful", "taken"),
    [(0.0098, True, True), (0.0104, False, True), (0.0104, True, False), (0.0106, False, False)],
    ids=["lower", "hardly higher", "with a warning", "higher"],
)
def test_a_path_may_cost_a_little_more(
    monkeypatch: pytest.MonkeyPatch, still: Trouble, cost: float, doubtful: bool, taken: bool
) -> None:
    pulses = encoder_troubles.pulses_only(still).recording
    given = Calibrator(pulses, Settings(model="exact"), "cpu", None)
    mended = replace(given, mended=pulses.encoder)
    between = SimpleNamespace(calibrator=mended, deviation_px=0.05, std_px=0.003)
    space = SimpleNamespace(sized=True)
    tried: Any = SimpleNamespace(
        cost=0.01, search=SimpleNamespace(space=space), unexplained=False, camera_turned=False
    )
    again = SimpleNamespace(
        accepted=True,
        calibration=True,
        cost=cost,
        doubtful=doubtful,
        unexplained=False,
        camera_turned=False,
    )
    monkeypatch.setattr(pulse_attempts, "between_pulses", lambda *_: between)
    monkeypatch.setattr(Calibrator, "attempt", lambda _: again)
    calibrator, attempt = attempts.with_mended_encoder(given, tried)
    assert (attempt is again) == taken
    left_px = math.sqrt(0.05**2 - 0.003**2)
    hidden_px = 0.006 if taken else left_px + 0.006
    assert calibrator.hidden_px == {BETWEEN_PULSES: pytest.approx(hidden_px)}


def test_a_shift_of_the_picture_is_no_deviation_of_a_path() -> None:
    rng = np.random.default_rng(3)
    first = 1j * np.exp(1j * np.linspace(0.0, 20.0, 400))
    second = 1j * np.exp(1j * np.linspace(1.0, -13.0, 400))
    px = (2.0, 3.0)
    fit = object.__new__(PathFit)
    fit._pairs = np.zeros(400)

    def moved_px(*turned: np.ndarray) -> float:
        fit._corrections = [
            SimpleNamespace(px=size, direction=along, at_first_events=lambda _, turn=turn: turn)
            for size, along, turn in zip(px, (first, second), turned, strict=True)
        ]
        return fit._motion_px(np.zeros(0))

    # Turns of both angles that move the picture by the same at all times
    both = np.array([px[0] * first, px[1] * second])
    columns = np.moveaxis(np.array([both.real, both.imag]), 2, 0)
    turns = np.linalg.solve(columns, np.full((400, 2, 1), 0.2))[..., 0]
    assert moved_px(*turns.T) == pytest.approx(0.0, abs=1e-9)
    assert moved_px(np.full(400, 0.1), np.zeros(400)) == pytest.approx(0.0, abs=1e-9)
    noise = rng.normal(0.0, 0.01, 400)
    assert moved_px(noise, np.zeros(400)) == pytest.approx(0.02, rel=0.1)


@pytest.mark.parametrize(
    ("tick_us", "stamps", "before_us"),
    [(1, 1, 0), (1, 20, 0), (1, 20, 100_000), (1000, 1, 0), (1000, 1, 100_000)],
    ids=["one stamp", "several", "long before", "coarse clock", "coarse, before"],
)
def test_a_burst_is_set_aside_whatever_the_clock(
    still: Trouble, tick_us: int, stamps: int, before_us: int
) -> None:
    source = still.recording.events
    given = source.slice(0, len(source))
    ticks = MemoryEvents(Events(given.x, given.y, given.t // tick_us * tick_us, given.p), *SIZE)
    plain = replace(still, recording=replace(still.recording, events=ticks))
    assert start_burst.without_start_burst(plain.recording)[1] == ()
    started = encoder_troubles.with_burst(plain, 6139, stamps, before_us).recording
    used, (said,) = start_burst.without_start_burst(started)
    gone = len(started.events) - len(used.events)
    assert 6139 <= gone < 6139 + 1500  # those of two milliseconds at most
    assert f"{gone:,} events c" in said
    assert used.events.t_first > started.events.t_first + stamps - 2


def test_a_path_that_is_no_number_is_refused(
    still: Trouble, monkeypatch: pytest.MonkeyPatch
) -> None:
    fit = object.__new__(PathFit)
    fit._recording, fit._cost, fit._px = (
        still.recording,
        SimpleNamespace(set_scale=lambda scale: None),
        10.0,
    )
    monkeypatch.setattr(PathFit, "_step", lambda _: (np.array([math.nan]), 0.0, 0.0))
    with pytest.raises(AmiwarpError, match="do not determine the path of the prism's angle"):
        fit._improve(0)


def test_prisms_look_swapped_only_if_they_fit_the_other_way_round() -> None:
    pair = Prism(0.02, second=Prism(0.016))
    swapped = {"apex": 0.0161, "second_apex": 0.0199}
    assert checks.look_swapped(swapped, pair)
    assert checks.pair_is_far(swapped, pair)
    for right in (
        {"apex": 0.0199, "second_apex": 0.0161},
        {"apex": 0.015, "second_apex": 0.015},
        {"apex": 0.016},
    ):
        assert not checks.look_swapped(right, pair)
    alike = Prism(0.02, second=Prism(0.018))
    assert checks.look_swapped({"apex": 0.018, "second_apex": 0.02}, alike)
    assert not checks.pair_is_far({"apex": 0.018, "second_apex": 0.02}, alike)
    assert not checks.look_swapped({"apex": 0.019, "second_apex": 0.019}, alike)


@pytest.mark.slow
def test_swapped_encoders_of_a_pair_are_named() -> None:
    swapped = encoder_troubles.pair(SIZE, swapped=True).recording
    said = (
        "the encoders of the two prisms seem to be swapped: as given, "
        "the prisms have 80 and 12[56] % of their nominal"
    )
    with pytest.raises(AmiwarpError, match=said):
        calibrate(swapped, photometric=COARSE)
    assert not any(
        "swapped" in w
        for w in calibrate(encoder_troubles.pair(SIZE, swapped=False).recording).warnings
    )


def test_noise_is_not_taken_for_missing_events() -> None:
    rng = np.random.default_rng(0)
    right = rng.normal(0.05, 0.05, 1000)
    noise = rng.uniform(0.5, 1.5, 800)
    lost = rng.normal(-0.9, 0.1, 100)
    assert step_if_missing(np.concatenate([right, noise])) == 0.0
    assert step_if_missing(np.concatenate([right + 0.2, lost])) > limits.NOTABLE_STEP
    assert step_if_missing(np.zeros(0)) == 0.0


@pytest.mark.slow
def test_a_noisy_recording_of_gravel_is_answered() -> None:
    trouble = encoder_troubles.noisy(0.35, (120, 90), apex_deg=2.0, gravel=True, seconds=0.4)
    found = found_in(trouble)
    assert compensation_error(trouble, found)[0] < 0.02
    assert not any("missing" in w for w in found.warnings)


@pytest.mark.slow
def test_half_of_the_events_of_gravel_are_missed() -> None:
    trouble = recorded((120, 90), steady(), apex_deg=2.0, gravel=True, seconds=0.4)
    events = trouble.recording.events[:]
    kept = np.random.default_rng(0).uniform(size=len(events)) >= 0.5
    lossy = replace(trouble.recording, events=MemoryEvents(events[kept], 120, 90), truth=None)
    found = calibrate(lossy, model="exact", photometric=COARSE)
    assert any("a fifth or more of the events are missing" in w for w in found.warnings)


def counted(numbers: list[int], window_us: int = 2000) -> MemoryEvents:
    """Return events of which each window of time has a number."""
    t = np.concatenate(
        [k * window_us + np.arange(n) * window_us // n for k, n in enumerate(numbers)]
    )
    x = np.arange(len(t)) % SIZE[0]
    return MemoryEvents(Events.from_arrays(x, 0 * x, t, 0 * x), *SIZE)


@pytest.mark.parametrize(("next_one", "is_burst"), [(1900, True), (3000, True), (4700, False)])
def test_events_that_grow_fewer_slowly_are_no_burst(next_one: int, is_burst: bool) -> None:
    """A third of what the first window has beyond the usual number is left in the second one."""
    numbers = [10_000, next_one, *[1900] * 60]
    assert start_burst.burst_size(counted(numbers)) == (10_000 if is_burst else 0)


def test_a_full_second_window_ends_the_search_for_a_burst(monkeypatch: pytest.MonkeyPatch) -> None:
    """Only if the second window has fewer than half of the events of the first, the later ones are read."""
    read: list[int] = []
    read_slice = MemoryEvents.slice

    def counting(self: MemoryEvents, start: int, stop: int) -> Events:
        read.append(stop - start)
        return read_slice(self, start, stop)

    monkeypatch.setattr(MemoryEvents, "slice", counting)
    assert start_burst.burst_size(counted([2000] * 60)) == 0
    assert read == []
    assert start_burst.burst_size(counted([4000, 2000, *[1900] * 60])) == 4000
    assert len(read) == 1


@pytest.mark.slow
def test_a_focal_length_that_drifts_is_no_turning_camera() -> None:
    trouble = recorded(SIZE, steady(), seconds=0.6, growth=0.06)
    found = found_in(trouble)
    assert compensation_error(trouble, found)[0] < 0.02
    assert not any("camera turned" in w for w in found.warnings)
    [said] = [w for w in found.warnings if "the image grew by" in w]
    assert float(said.split()[4]) == pytest.approx(6.0, abs=0.5)
    assert "growth" not in found.parameters


@pytest.mark.parametrize(("ratio", "said"), [(0.85, True), (0.97, False)])
def test_a_path_between_pulses_that_explains_little_is_said(
    still: Trouble, monkeypatch: pytest.MonkeyPatch, ratio: float, said: bool
) -> None:
    """Neither is it taken, unless the pulses confirm it."""
    pulses = Encoder(np.arange(5) * 40_000, np.arange(5) * math.tau)
    recording = replace(still.recording, encoder=pulses)
    calibrator = Calibrator(recording, Settings(model="exact"), "cpu", None)
    sized = SimpleNamespace(space=SimpleNamespace(sized=True))
    tried: Any = SimpleNamespace(search=sized, cost=0.25, unexplained=True, camera_turned=False)
    again = SimpleNamespace(
        accepted=True,
        cost=ratio * 0.25,
        doubtful=True,
        unexplained=True,
        camera_turned=False,
        calibration=SimpleNamespace(),
    )
    path = Encoder(pulses.t, pulses.angle + 0.01)
    between = SimpleNamespace(
        calibrator=replace(calibrator, mended=path), deviation_px=0.05, std_px=0.003
    )
    monkeypatch.setattr(pulse_attempts, "confirmed_by", lambda *_: False)
    monkeypatch.setattr(pulse_attempts, "between_pulses", lambda *_: between)
    monkeypatch.setattr(Calibrator, "attempt", lambda _: again)
    found, kept = attempts.with_mended_encoder(calibrator, tried)
    assert kept is tried
    assert found.mended is None
    assert ("gives pulses only" in found.mended_words) == said
    monkeypatch.setattr(
        pulse_attempts,
        "confirmed_by",
        lambda by, given: by.mended is path and given is pulses,
    )
    found, kept = attempts.with_mended_encoder(calibrator, tried)
    assert (found.mended is path, kept is again) == (said, said)
    again.camera_turned = True
    assert attempts.with_mended_encoder(calibrator, tried)[1] is tried


@pytest.mark.parametrize(
    ("accepted", "harmonics", "turned", "cost", "is_taken"),
    [
        (True, (), (False, False), 0.09, True),
        (False, (0.0, 0.01), (False, False), 0.09, True),  # corrected next
        (False, (), (False, False), 0.09, False),
        (True, (), (True, True), 0.09, True),  # the camera turns with the counts and without them
        (True, (), (False, True), 0.09, False),
        (
            True,
            (),
            (False, False),
            0.104,
            True,
        ),  # depths that are found anew make as much of a difference
        (True, (), (False, False), 0.106, False),
    ],
)
def test_counts_are_put_back_although_something_else_is_wrong_too(
    still: Trouble,
    monkeypatch: pytest.MonkeyPatch,
    accepted: bool,
    harmonics: tuple[float, ...],
    turned: tuple[bool, bool],
    cost: float,
    is_taken: bool,
) -> None:
    """A step of the samples is no motion of a prism. ``turned``: whether the camera turned, before and after."""
    recording = replace(still.recording, encoder=samples(steady(), 100, index=False))
    calibrator = Calibrator(recording, Settings(model="exact"), "cpu", None)
    before, after = turned
    tried: Any = SimpleNamespace(
        search=SimpleNamespace(space=SimpleNamespace(sized=True)),
        cost=0.1,
        unexplained=False,
        camera_turned=before,
        doubtful=False,
    )
    again = SimpleNamespace(
        accepted=accepted,
        cost=cost,
        unexplained=False,
        camera_turned=after,
        calibration=SimpleNamespace(),
        photometric=SimpleNamespace(harmonics=harmonics),
    )
    monkeypatch.setattr(Calibrator, "attempt", lambda *_, **__: again)
    found, kept = attempts.with_mended_encoder(calibrator, tried)
    assert (kept is again) == is_taken
    assert ("steps by" in found.mended_words) == is_taken


def test_a_path_that_is_not_determined_between_pulses_is_said(
    still: Trouble, monkeypatch: pytest.MonkeyPatch
) -> None:
    pulses = Encoder(np.arange(5) * 40_000, np.arange(5) * math.tau)
    calibrator = Calibrator(
        replace(still.recording, encoder=pulses), Settings(model="exact"), "cpu", None
    )
    tried: Any = SimpleNamespace(search=SimpleNamespace(space=SimpleNamespace(sized=True)))

    def undetermined(*_: Any) -> None:
        raise AmiwarpError("undetermined")

    monkeypatch.setattr(pulse_attempts, "between_pulses", undetermined)
    found, kept = attempts.with_mended_encoder(calibrator, tried)
    assert kept is tried
    assert "gives pulses only" in found.mended_words


@pytest.mark.parametrize("further_cost", [0.05, 0.2])
def test_what_a_correction_of_the_angles_leaves_is_corrected_too(
    still: Trouble, monkeypatch: pytest.MonkeyPatch, further_cost: float
) -> None:
    """A large error of one angle of two hides that of the other. A further correction must lower the cost."""
    first, left = (0.02, 0.0, 0.0, 0.0), (0.001, 0.01, 0.0, 0.005)
    tried_with: list[Any] = []

    def attempt(self: Calibrator, **_: bool) -> Any:
        tried_with.append(self.harmonics)
        is_right = len(tried_with) == 2 and further_cost < 0.1
        of_stage = SimpleNamespace(harmonics=() if is_right else left, parameters={})
        cost = 0.1 if len(tried_with) == 1 else further_cost
        return SimpleNamespace(
            accepted=is_right, cost=cost, photometric=of_stage, calibration=SimpleNamespace()
        )

    monkeypatch.setattr(Calibrator, "attempt", attempt)
    monkeypatch.setattr(straight_angles, "with_warnings", lambda found, *_: found)
    calibrator = Calibrator(still.recording, Settings(model="exact"), "cpu", None)
    tried: Any = SimpleNamespace(
        photometric=SimpleNamespace(harmonics=first, parameters={}), cost=0.25, accepted=False
    )
    found, _ = straight_angles.with_straight_angles(calibrator, tried)
    both = (0.021, 0.01, 0.0, 0.005)
    assert tried_with == [first, pytest.approx(both)]
    assert found.harmonics == pytest.approx(both if further_cost < 0.1 else first)


@pytest.mark.parametrize(
    ("accepted", "cost", "is_taken"),
    [(True, 0.09, True), (True, 0.11, False), (False, 0.05, False)],
)
def test_a_correction_of_an_accepted_answer_must_be_accepted_and_lower_the_cost(
    still: Trouble, monkeypatch: pytest.MonkeyPatch, accepted: bool, cost: float, is_taken: bool
) -> None:
    """Of third harmonics, which an answer is not refused for."""
    third = (0.0, 0.0, 0.0, 0.0, 0.02, 0.0)
    of_stage = SimpleNamespace(harmonics=(), parameters={})
    again: Any = SimpleNamespace(
        accepted=accepted, cost=cost, photometric=of_stage, calibration=SimpleNamespace()
    )
    monkeypatch.setattr(Calibrator, "attempt", lambda *_, **__: again)
    said: list[str] = []
    monkeypatch.setattr(straight_angles, "with_warnings", lambda _, *words: said.extend(words))
    calibrator = Calibrator(still.recording, Settings(model="exact"), "cpu", None)
    tried: Any = SimpleNamespace(
        photometric=SimpleNamespace(harmonics=third, parameters={}), cost=0.1, accepted=True
    )
    found, kept = straight_angles.with_straight_angles(calibrator, tried)
    assert (found.harmonics == third) == (kept is not tried) == is_taken
    corrected = "the encoder's angle is wrong by 1.1 deg three times a turn: it was corrected"
    assert said == [corrected] * is_taken


def coarse(counts: int, rpm: float, sample_us: int, seconds: float = 0.7) -> Encoder:
    """Return an encoder that rounds its angles down to few counts a turn."""
    t = np.arange(-5_000, round(seconds * 1e6), sample_us)
    angle = t * (rpm * math.tau / 60e6)
    return Encoder(t, np.floor(angle * counts / math.tau) * math.tau / counts)


def test_the_step_of_a_coarse_encoder() -> None:
    assert coarse_encoder.step_rad(coarse(64, 700.0, 1000)) == pytest.approx(math.tau / 64)
    assert coarse_encoder.step_rad(coarse(64, -100.0, 1000)) == pytest.approx(math.tau / 64)
    # Without a sample that repeats an angle, steps of several sizes may be the motion's own.
    assert coarse_encoder.step_rad(coarse(64, 700.0, 5000)) == 0.0
    steady_angles = Encoder(np.arange(0, 90_000, 1000), np.linspace(0.0, 7.0, 90))
    assert coarse_encoder.step_rad(steady_angles) == 0.0
    at_rest = replace(steady_angles, angle=np.zeros(90))
    assert coarse_encoder.step_rad(at_rest) == 0.0
    starting = replace(steady_angles, angle=np.maximum(0.0, np.linspace(-1.0, 1.0, 90)) ** 3)
    assert coarse_encoder.step_rad(starting) == 0.0


def test_a_coarse_encoder_is_named(still: Trouble) -> None:
    """Half of the time of a count, its angle is 0.05 rad early or late."""
    recording = replace(still.recording, encoder=coarse(64, 720.0, 1000))
    found = calibrate(recording, photometric=COARSE, model="exact")
    [said] = [w for w in found.warnings if "coarse" in w]
    orbit_px = float(
        np.linalg.norm(
            found.model.compensate_points([[80, 60]], [0.0])
            - found.model.compensate_points([[80, 60]], [math.pi])
        )
    )
    error_px = 0.5 * orbit_px * math.tau / 64.0 / math.sqrt(12.0)
    assert said.startswith("the encoder is coarse: its angles are multiples of 5.6 deg")
    assert f"moves events by {error_px:.2f} px rms" in said
    assert found.photometric is not None
    stated_px = found.photometric.hidden_px["the steps of a coarse encoder"]
    assert stated_px == pytest.approx(2.0 * error_px, rel=0.15)


def test_pulses_confirm_a_path_that_bends_between_them() -> None:
    t = np.arange(8) * 100_000
    pulses = Encoder(t, np.arange(8) * math.tau)
    times = np.arange(0, t[-1] + 1, 1000)
    steady_angle = times * (math.tau / 100_000)
    between = Encoder(times, steady_angle + 0.03 * np.sin(times * (math.tau / 100_000)))
    beside = Encoder(times, steady_angle + 0.03 * np.sin(times * (1.3 * math.tau / 100_000)))
    shifted = replace(between, angle=between.angle + 0.5)  # a phase is no distance
    assert [confirm(pulses, path, 0, int(t[-1])) for path in (between, shifted, beside)] == [
        True,
        True,
        False,
    ]
    assert not confirm(pulses, between, 0, 250_000)  # three pulses tell nothing
