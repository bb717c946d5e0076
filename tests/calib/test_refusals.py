"""Recordings that cannot be calibrated are refused with the reason: wrong encoder scales and useless events."""

import math
from collections.abc import Callable
from dataclasses import replace
from math import tau as TWO_PI

import numpy as np
import pytest

from amiwarp import (
    AmiwarpError,
    Camera,
    CameraMotion,
    Encoder,
    Events,
    MemoryEvents,
    Prism,
    Recording,
    Settings,
    calibrate,
    simulate,
)
from amiwarp.calib.checks import check_pulses, check_texture
from amiwarp.calib.first_guess import _period, encoder_turns_per_period
from amiwarp.calib.photometric.findings import Optimum
from amiwarp.calib.photometric.verdicts import refused
from amiwarp.calib.preparation import prepare
from amiwarp.calib.trial import LARGEST_MOTION_PX, in_pixels
from amiwarp.cli.common import interval, number
from amiwarp.results.parameters import units
from tests.conftest import COARSE, TRUE_PRISM

WIDTH, HEIGHT, LENGTH_US = 96, 72, 500_000
CAMERA = Camera.from_fov(WIDTH, HEIGHT, math.radians(50.0))


def scaled(recording: Recording, factor: float) -> Recording:
    assert recording.encoder is not None
    return replace(
        recording, encoder=Encoder(recording.encoder.t, recording.encoder.angle * factor)
    )


# -- an encoder whose scale is wrong


@pytest.mark.parametrize("factor", [1.024, 2.0, 4.0])
def test_a_wrong_scale_is_found_in_the_events(texture: np.ndarray, factor: float) -> None:
    """Not mistaken for a slowly rotating camera, and not confirmed; also if other edges were counted than stated."""
    camera = Camera.from_fov(120, 90, math.radians(50.0))
    recording = simulate(
        texture, camera, TRUE_PRISM, duration_s=0.18 if factor < 4.0 else 0.35, seed=3
    )
    with pytest.raises(
        AmiwarpError, match=r"a still camera explains the events.*counts_per_turn"
    ) as caught:
        calibrate(scaled(recording, factor), model="exact", events=100_000, photometric=COARSE)
    assert float(str(caught.value).rpartition(" times ")[2]) == pytest.approx(factor, abs=0.002)


SMALL = {"model": "exact", "events": 100_000, "photometric": COARSE}


@pytest.fixture(scope="module")
def still(texture: np.ndarray) -> Recording:
    camera = Camera.from_fov(120, 90, math.radians(50.0))
    return simulate(texture, camera, TRUE_PRISM, duration_s=0.18, seed=3)


def test_a_wrong_direction_of_the_encoder_is_named(still: Recording) -> None:
    with pytest.raises(
        AmiwarpError, match=r"turns against the direction of the encoder.*--direction"
    ):
        calibrate(scaled(still, -1.0), **SMALL)


def test_an_encoder_that_slips_at_every_half_turn_is_no_turning_camera(texture: np.ndarray) -> None:
    camera = Camera.from_fov(120, 90, math.radians(60.0))
    recording = simulate(texture, camera, TRUE_PRISM, duration_s=0.34, seed=3)
    assert recording.encoder is not None
    angle = recording.encoder.angle
    half_turns = np.floor(angle / math.pi)
    slipped = Encoder(
        recording.encoder.t, angle - math.radians(3.75) * (half_turns - half_turns[0])
    )
    with pytest.raises(AmiwarpError, match=r"the events repeat every 0\.9\d+ turns of the encoder"):
        calibrate(replace(recording, encoder=slipped), model="exact", photometric=COARSE)


def test_an_apex_beyond_the_bound_is_refused_with_the_bound(still: Recording) -> None:
    small = replace(still, prism=Prism(0.4 * TRUE_PRISM.apex))
    bound = math.degrees(0.8 * TRUE_PRISM.apex)
    with pytest.raises(
        AmiwarpError, match=rf"apex that is tried, {bound:.3g} deg.*apex=0:{2.0 * bound:.3g}deg"
    ):
        calibrate(small, **SMALL)


def test_an_object_over_half_of_the_view_is_no_turning_camera(
    texture: np.ndarray, still: Recording
) -> None:
    assert still.camera is not None
    moving = simulate(
        texture[::-1].copy(), still.camera, TRUE_PRISM, duration_s=0.18, seed=4,
        camera_motion=CameraMotion((0.0, 0.8, 0.1)),
    )  # fmt: skip
    left, right = (r.events.slice(0, len(r.events)) for r in (still, moving))
    left, right = left[np.flatnonzero(left.x < 60)], right[np.flatnonzero(right.x >= 60)]
    t = np.concatenate([left.t, right.t])
    both = Events.concatenate([left, right])[np.argsort(t, kind="stable")]
    found = calibrate(replace(still, events=MemoryEvents(both, 120, 90)), **SMALL)
    assert any("something moves: 50 % of the view are left out" in w for w in found.warnings)
    assert not any("camera turned" in w for w in found.warnings)
    assert found.parameters["apex"] == pytest.approx(TRUE_PRISM.apex, rel=0.02)


@pytest.mark.parametrize("factor", [0.98, 1.024, 0.5])
def test_a_wrong_scale_is_found_at_the_index_pulses(recording: Recording, factor: float) -> None:
    assert recording.encoder is not None
    true = recording.encoder
    turns = np.arange(math.ceil(true.angle[0] / TWO_PI), math.floor(true.angle[-1] / TWO_PI) + 1)
    pulses = np.interp(turns * TWO_PI, true.angle, true.t).astype(np.int64)
    assert len(pulses) >= 3
    good = replace(recording, encoder=true.with_index(pulses))
    prepare(good, Settings())
    wrong = replace(recording, encoder=Encoder(true.t, true.angle * factor).with_index(pulses))
    with pytest.raises(
        AmiwarpError, match=rf"index pulses come every {factor:.2f}.*counts_per_turn"
    ):
        calibrate(wrong)


def test_pulses_that_are_missing_or_counts_that_are_lost_are_no_scale() -> None:
    encoder = Encoder.constant_speed(720.0, 0, 1_000_000)
    pulses = np.arange(1, 12) * 250_000 // 3
    check_pulses(encoder.with_index(np.delete(pulses, [3, 4, 8])), "missing")
    check_pulses(encoder.with_index(pulses[::2]), "every other")
    lost = Encoder(encoder.t, encoder.angle - np.where(encoder.t > 400_000, 1.0, 0.0))
    check_pulses(lost.with_index(pulses), "lost")
    with pytest.raises(AmiwarpError, match=r"every 0\.99"):
        check_pulses(
            Encoder(encoder.t, encoder.angle * 0.99).with_index(np.delete(pulses, [3, 8])), "scale"
        )


def test_the_events_repeat_once_a_turn_of_a_good_encoder(recording: Recording) -> None:
    assert recording.encoder is not None
    for factor in (0.5, 0.98, 1.0, 1.024, 2.0, 4.0):
        wrong = scaled(recording, factor)
        assert wrong.encoder is not None
        assert encoder_turns_per_period(wrong, wrong.encoder) == pytest.approx(
            factor, rel=0.002 * max(1.0, factor**2)
        )


# -- useless events


def events(x: object, y: object, t: object, p: object) -> Events:
    n = max(map(np.size, (x, y, t, p)))  # type: ignore[arg-type]
    columns = [np.broadcast_to(np.asarray(a), n) for a in (x, y, np.sort(np.asarray(t)), p)]
    return Events(
        *(a.astype(kind) for a, kind in zip(columns, ("u2", "u2", "i8", "u1"), strict=True))
    )


def scattered(
    n: int, width: int = WIDTH, height: int = HEIGHT, length_us: int = LENGTH_US
) -> list[np.ndarray]:
    rng = np.random.default_rng(n)
    return [rng.integers(0, most, n) for most in (width, height, length_us, 2)]


def flicker() -> Events:
    """Every eighth pixel fires at each of 40 flashes, alternately ON and OFF; the scene is still."""
    at = np.arange(WIDTH * HEIGHT // 8) * 8
    flashes = np.repeat(np.arange(40), len(at))
    return events(np.tile(at % WIDTH, 40), np.tile(at // WIDTH, 40), flashes * 12_500, flashes % 2)


def row() -> Events:
    at = np.arange(20_000)
    return events(at % WIDTH, 30, at * 25, at // WIDTH % 2)


N = 20_000
USELESS: dict[str, Callable[[], Events]] = {
    **{f"{n} events": lambda n=n: events(*scattered(n)) for n in (0, 1, 2, 10)},
    "one pixel": lambda: events(40, 30, *scattered(N)[2:]),
    "a pixel that alternates": lambda: events(40, 30, np.arange(N) * 25, np.arange(N) % 2),
    "a corner": lambda: events(0, 0, *scattered(N)[2:]),
    "one time": lambda: events(*scattered(N)[:2], np.full(N, 5000), scattered(N)[3]),
    "one polarity": lambda: events(*scattered(N)[:3], 1),
    "one row": row,
    "one row at random": lambda: events(scattered(N)[0], 30, *scattered(N)[2:]),
    "noise": lambda: events(*scattered(N)),
    "a moment": lambda: events(*scattered(N, length_us=200)),
    "a block": lambda: events(
        40 + scattered(N, 4)[0], 30 + scattered(N, 4, 4)[1], *scattered(N)[2:]
    ),
    "flicker": flicker,
}
ENCODERS: dict[str, Callable[[], Encoder | None]] = {
    "good": lambda: Encoder.constant_speed(720.0, -2000, LENGTH_US + 2000),
    "none": lambda: None,
    "two samples": lambda: Encoder(np.array([-10, LENGTH_US + 10]), np.array([0.0, 40.0])),
    "still": lambda: Encoder.constant_speed(0.0, -2000, LENGTH_US + 2000),
    "a part": lambda: Encoder.constant_speed(720.0, 100_000, 200_000),
    "creeping": lambda: Encoder.constant_speed(1e-3, -2000, LENGTH_US + 2000),
}


@pytest.mark.parametrize(
    ("what", "encoder"),
    [
        (what, encoder)
        for what in USELESS
        for encoder in ENCODERS
        if what == "noise" or encoder in ("good", "none")
    ],
)
def test_events_of_no_use_are_refused_with_a_reason(what: str, encoder: str) -> None:
    made = MemoryEvents(USELESS[what](), WIDTH, HEIGHT)
    recording = Recording(
        made, CAMERA, ENCODERS[encoder](), Prism(math.radians(2.0)), name="recording"
    )
    with pytest.raises(AmiwarpError, match=r"^recording: ") as caught:
        calibrate(recording)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("what", ["one pixel", "flicker", "one row at random"])
def test_pixels_that_flicker_are_named(what: str) -> None:
    made = MemoryEvents(USELESS[what](), WIDTH, HEIGHT)
    recording = Recording(
        made, CAMERA, ENCODERS["good"](), Prism(math.radians(2.0)), name="recording"
    )
    with pytest.raises(
        AmiwarpError, match=r"flicker or fire at random, [\d,]+ in all, \d+ events are left"
    ):
        calibrate(recording)


def test_a_motion_that_turns_all_out_of_view_is_refused() -> None:
    made = MemoryEvents(USELESS["one pixel"](), WIDTH, HEIGHT)
    recording = Recording(made, CAMERA, None, Prism(math.radians(2.0)), name="recording")
    with pytest.raises(AmiwarpError, match=r"^recording: "):
        calibrate(
            recording,
            free=("apex", "phase", "motion", "rpm"),
            local_evaluations=40,
            global_evaluations=20,
        )


# -- numbers out of their range are not printed


def test_words_for_numbers_that_mean_nothing() -> None:
    assert in_pixels(0.25) == "0.250 px"
    assert in_pixels(27_431.659) == f"more than {LARGEST_MOTION_PX:g} px"
    assert "over 1.5 px" in refused(Optimum(0.1, rise=0.1, moved_px=0.1, next_step_px=3e5))
    assert "100 %" in refused(Optimum(1.7, rise=0.1, moved_px=0.1, next_step_px=0.0))
    assert "explains the events better" in refused(
        Optimum(0.1, rise=-0.02, moved_px=0.1, next_step_px=0.0)
    )
    assert "0.4 % of the residual more" in refused(
        Optimum(0.1, rise=0.004, moved_px=0.1, next_step_px=0.0)
    )
    worse = np.linspace(0.0, 1.0, 8)
    with pytest.raises(AmiwarpError, match="it is less sharp, or the same"):
        check_texture(worse, worse + 3.0, worse, "recording")


@pytest.mark.parametrize(
    ("text", "low", "high"),
    [
        ("0:4deg", 0.0, math.radians(4.0)),
        ("-10:10deg", -math.radians(10.0), math.radians(10.0)),
        ("-0.2rad:10deg", -0.2, math.radians(10.0)),
        ("-1deg:0", -math.radians(1.0), 0.0),
        (" 1 : 2 rad", 1.0, 2.0),
    ],
)
def test_bounds_share_a_unit_and_zero_needs_none(text: str, low: float, high: float) -> None:
    assert interval(text, "rad", "--bound apex") == pytest.approx((low, high))


def test_every_parameter_may_be_written_on_the_command_line() -> None:
    for name, unit in units().items():
        assert number("0", unit, f"--start {name}") == 0.0
    assert number("1.5", units()["growth"], "--start growth") == 1.5


def test_bounds_that_are_none() -> None:
    assert number("0", "rad", "--start phase") == 0.0
    assert number("0", "rad/s", "--start rate_x") == 0.0
    assert interval("-5:5ms", "us", "--bound clock_offset") == (-5000.0, 5000.0)
    for text in ("1:4", "1deg:4", "4deg", ":4deg", "nan:4deg", "0:infdeg"):
        with pytest.raises(AmiwarpError, match="--bound apex: "):
            interval(text, "rad", "--bound apex")


def test_a_correlation_without_a_second_peak_keeps_the_first_period() -> None:
    lag = np.arange(200.0)
    falling = 0.6 - 1e-3 * lag - 1e-7 * lag**2  # no peak, and a parabola whose top is far away
    correlation = falling + 0.4 * np.exp(-(((lag - 20.3) / 2.0) ** 2))
    assert _period(correlation, "recording") == pytest.approx(20.3, rel=0.25)
