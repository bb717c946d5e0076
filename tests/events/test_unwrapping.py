"""Counters that wrap at their width, and angles that wrap at whole turns: unwrapped or refused, never wrong."""

import pickle
from math import tau as TWO_PI
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, event, example, given, settings
from hypothesis import strategies as st

from amiwarp import AmiwarpError, Encoder
from amiwarp.events.unwrapping import UnwrapError
from amiwarp.io import read_encoder_csv


def wrapped(count, bits, *, signed=False):
    half = 2 ** (bits - 1) if signed else 0
    return (count + half) % 2**bits - half


def steady(rpm, counts_per_turn, *, n=3000, start=0):
    t = np.arange(n) * 1000
    return t, start + np.round(rpm / 60e6 * t * counts_per_turn).astype(np.int64)


@pytest.mark.parametrize("bits", [8, 10, 12, 16, 24])
@pytest.mark.parametrize("signed", [False, True])
@pytest.mark.parametrize("rpm", [720.0, -720.0])
@pytest.mark.parametrize("given_bits", [True, False])
def test_a_counter_that_wraps_is_unwrapped(bits, signed, rpm, given_bits):
    """At 1000 counts per turn no power of two is a whole number of turns, so a missed wrap gives a wrong angle."""
    t, count = steady(
        rpm, 1000, start=(2 ** (bits - 1) if signed else 0) + (5000 if rpm < 0 else -5000)
    )
    shown = wrapped(count, bits, signed=signed)
    assert np.ptp(shown) > 0.9 * 2**bits
    encoder = Encoder.from_counts(
        t, shown, counts_per_turn=1000, counter_bits=bits if given_bits else None
    )
    np.testing.assert_allclose(
        encoder.angle - encoder.angle[0], (count - count[0]) * TWO_PI / 1000, rtol=0, atol=1e-6
    )


@st.composite
def rotations(draw):
    """Times [us], true counts and counts per turn of a steady, swinging or accelerating rotation, either way."""
    seed = draw(st.integers(0, 2**32 - 1))
    rng = np.random.default_rng(seed)
    n = draw(st.sampled_from([2, 3, 5, 12, 100, 400]))
    jitter = draw(st.sampled_from([0, 100, 500]))
    t = np.cumsum(rng.integers(1000 - jitter, 1001 + jitter, n))
    per_turn = draw(
        st.sampled_from(
            [4, 100, 360, 500, 1000, 1023, 1024, 2000, 3600, 4095, 4096, 10_000, 65_535]
        )
    )
    most = draw(st.floats(0.001, 0.4))
    kind = draw(st.sampled_from(["steady", "swinging", "speeding up", "stopping"]))
    phase = np.linspace(0.0, 1.0, n)
    speed = {
        "steady": np.ones(n),
        "swinging": np.sin(rng.uniform(1.0, 20.0) * phase),
        "speeding up": 0.1 + 0.9 * phase,
        "stopping": np.where(phase < rng.uniform(0.2, 0.8), 1.0, 0.0),
    }[kind]
    return (
        t,
        np.cumsum(speed * np.diff(t, prepend=t[0])) / 1000.0 * most,
        per_turn,
        draw(st.sampled_from([1, -1])),
        kind,
    )


THREE_SAMPLES = (
    np.array([1000, 2000, 3000]),
    np.array([0.0, 0.28860215, -0.07995398]),
    360,
    1,
    "swinging",
)
"""With 8 bits from 182 on, the counts are 182, 0 and 162: a steady rotation with 360 counts per turn as well."""


@settings(max_examples=500)
@example(THREE_SAMPLES, 8, False, 182, False)
@given(rotations(), st.integers(8, 32), st.booleans(), st.integers(0, 2**32), st.booleans())
def test_counts_are_right_or_refused(rotation, bits, signed, start, given_bits):
    """Steps are under half of the counter's period. With its width counts are right; without it right or refused."""
    t, progress, per_turn, way, kind = rotation
    count = start + way * np.round(progress * min(2**bits, per_turn)).astype(np.int64)
    assume(
        np.abs(np.diff(count)).max() < 0.45 * (2**bits if given_bits else min(2**bits, per_turn))
    )
    shown = wrapped(count, bits, signed=signed)
    try:
        encoder = Encoder.from_counts(
            t, shown, counts_per_turn=per_turn, counter_bits=bits if given_bits else None
        )
    except UnwrapError:
        event(f"refused, {kind}, {'width given' if given_bits else 'width sought'}")
        return
    event(f"found, {kind}, {'width given' if given_bits else 'width sought'}")
    true = (count - count[0]) * (TWO_PI / per_turn)
    assert np.abs(encoder.angle - encoder.angle[0] - true).max() <= 1.001 * TWO_PI / per_turn


@settings(max_examples=300)
@given(rotations(), st.integers(0, 2**32), st.sampled_from([0, None]))
def test_counters_that_start_anew_each_turn(rotation, start, bits):
    t, progress, per_turn, way, _ = rotation
    count = start + way * np.round(progress * per_turn).astype(np.int64)
    assume(np.abs(np.diff(count)).max() < 0.45 * per_turn)
    # counts that only rise may be those of a counter that never wraps: 0, 18, 74 or, at 100 counts a turn, 0, 18, -26
    assume(bits is not None or (np.diff(count % per_turn) < 0).any() or (np.diff(count) >= 0).all())
    try:
        encoder = Encoder.from_counts(
            t, count % per_turn, counts_per_turn=per_turn, counter_bits=bits
        )
    except UnwrapError:
        return
    true = (count - count[0]) * (TWO_PI / per_turn)
    assert np.abs(encoder.angle - encoder.angle[0] - true).max() <= 1.001 * TWO_PI / per_turn


@pytest.mark.parametrize("bits", [8, 16, 24, 32])
def test_a_steady_rotation_is_never_refused(bits):
    """A wrap in a steady rotation reveals the width of the counter, for every width."""
    t, count = steady(600.0, 1000, n=800, start=2**bits - 1500)
    encoder = Encoder.from_counts(t, wrapped(count, bits), counts_per_turn=1000)
    assert encoder.rpm == pytest.approx(600.0, abs=0.2)


@pytest.mark.parametrize(
    ("shown", "per_turn", "bits", "message"),
    [
        (lambda c: c % 12_345, 1000, None, r"wraps by about 12,34\d.*counter_bits"),
        (lambda c: np.where(c < 9000, c, c - 9000), 1000, None, "sample 750: .*counter_bits"),
        (lambda c: c % 4096, 4095, None, "may wrap at 4,09"),
        (lambda c: c % 1024, 1000, 8, "do not fit in 8 bits"),
        (lambda c: c % 200 + 100, 1000, 8, r"counts 100 \.\. 296 do not fit in 8 bits"),
        (lambda c: c % 256, 1000, 9, "sample .*wrapping at 9 bits"),
        (lambda c: c % 70_000, 1000, 0, "do not fit in one turn"),
        (lambda c: c, 1000, 7, "counter_bits = 7; give 8 to 64"),
        (lambda c: c, 1000, 65, "counter_bits = 65"),
    ],
)
def test_what_cannot_be_told_is_refused(shown, per_turn, bits, message):
    t, count = steady(720.0, 1000, n=2000)
    with pytest.raises(AmiwarpError, match=message):
        Encoder.from_counts(t, shown(count), counts_per_turn=per_turn, counter_bits=bits)


@pytest.mark.parametrize("period", [230, 245, 252])
@pytest.mark.parametrize("n", [20, 24, 30])
def test_a_short_log_shows_a_period_that_no_counter_has(period, n):
    """Near 8 bits, but not there; the message names the period that is seen."""
    count = 30 * np.arange(n)
    with pytest.raises(AmiwarpError, match=rf"wraps by about {period},? which is no known period"):
        Encoder.from_counts(np.arange(n) * 1000, count % period, counts_per_turn=1000)


@pytest.mark.parametrize("step", [20, 100])
def test_a_prism_that_jumps_by_less_than_half_a_turn_is_believed(step):
    """At rest before and after: no counter wraps by so few counts."""
    count = np.repeat([40, 40 + step], 30)
    encoder = Encoder.from_counts(np.arange(60) * 1000, count, counts_per_turn=1000)
    assert np.ptp(encoder.angle) == pytest.approx(step * TWO_PI / 1000, abs=1e-12)


def test_a_gap_longer_than_a_counter_lasts_is_refused():
    t, count = steady(720.0, 1000)
    kept = (t < 500_000) | (t > 540_000)
    with pytest.raises(AmiwarpError, match="8 bits may have wrapped more than once in the 42 ms"):
        Encoder.from_counts(t[kept], count[kept] % 256, counts_per_turn=1000, counter_bits=8)
    wide = Encoder.from_counts(t[kept], count[kept] % 65_536, counts_per_turn=1000)
    assert wide.rpm == pytest.approx(720.0, abs=0.1)


def test_lost_counts_and_a_stop_are_no_wraps():
    """A counter that does not wrap may lose counts or pause. Index pulses show that, and the log is not refused."""
    t, count = steady(720.0, 1000)
    lost = count - np.where(t > 1_000_000, 250, 0)
    assert Encoder.from_counts(t, lost, counts_per_turn=1000).angle[-1] == pytest.approx(
        lost[-1] * TWO_PI / 1000
    )
    stood = np.where(t < 1_000_000, 0, count - 12_000)
    assert Encoder.from_counts(t, stood, counts_per_turn=1000).angle[-1] == pytest.approx(
        stood[-1] * TWO_PI / 1000
    )


@pytest.mark.parametrize("turns", [1, 2, 9, 32])
def test_angles_that_wrap_at_whole_turns(turns):
    t = np.arange(3000) * 1000
    angle = TWO_PI * 0.012 * np.arange(3000) + 0.3
    encoder = Encoder.from_angles(t, angle % (turns * TWO_PI))
    np.testing.assert_allclose(
        encoder.angle - encoder.angle[0], angle - angle[0], rtol=0, atol=1e-6
    )


def test_angles_that_wrap_elsewhere_are_refused():
    t = np.arange(3000) * 1000
    angle = TWO_PI * 0.012 * np.arange(3000)
    with pytest.raises(AmiwarpError, match=r"-3,272.* where about 4\.32"):
        Encoder.from_angles(t, angle % np.radians(3276.7))
    with pytest.raises(AmiwarpError, match="angle wraps by about 1,00"):
        Encoder.from_angles(t, angle % np.radians(1000.0))
    with pytest.raises(AmiwarpError, match=r"where about 4\.32 was expected"):
        Encoder.from_angles(t, np.where(t == 1_700_000, angle - 2.0, angle) % TWO_PI)


def test_a_log_names_its_line(tmp_path: Path):
    t, count = steady(720.0, 1000, n=2000)
    path = tmp_path / "log.csv"
    path.write_text(
        "# bench\nt_us,count\n"
        + "".join(f"{a},{b}\n" for a, b in zip(t, count % 12_345, strict=True))
    )
    with pytest.raises(
        AmiwarpError, match=r"log.csv: line 1032: the count wraps by about .*--counter-bits"
    ):
        read_encoder_csv(path, counts_per_turn=1000)
    with pytest.raises(AmiwarpError, match="do not fit in 8 bits"):
        read_encoder_csv(path, counts_per_turn=1000, counter_bits=8)
    path.write_text(
        "t_us,count\n" + "".join(f"{a},{b}\n" for a, b in zip(t, count % 256, strict=True))
    )
    assert read_encoder_csv(path, counts_per_turn=1000, counter_bits=8).rpm == pytest.approx(
        720.0, abs=0.1
    )
    path.write_text("t_us,angle_deg\n0,1\n1000,2\n")
    with pytest.raises(AmiwarpError, match="leave counter_bits out"):
        read_encoder_csv(path, counter_bits=8)


def test_the_error_survives_another_process():
    error = pickle.loads(pickle.dumps(UnwrapError.at(7, "no step")))
    assert (error.sample, error.problem, str(error)) == (7, "no step", "encoder sample 7: no step")
