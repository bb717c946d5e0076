"""The encoder: angle at a time, unwrapping, index pulses, gaps, coverage, and logs in text files."""

import itertools
import math
from math import tau as TWO_PI

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from amiwarp import AmiwarpError, Encoder, EncoderStream, ErrorCode
from amiwarp.events.encoder_speed import rpm_between
from amiwarp.io import read_encoder_csv
from tests.errors import refused

SPEED = TWO_PI * 50e-6
"""3000 turns a minute [rad/us]."""


def wrapped(angle):
    return (angle + np.pi) % TWO_PI - np.pi


def test_constant_speed():
    encoder = Encoder.constant_speed(3000.0, 1_000_000, 1_250_500)
    t = np.array([1_000_000, 1_000_001, 1_123_457, 1_250_500])
    np.testing.assert_allclose(encoder.angle_at(t), SPEED * (t - 1_000_000), rtol=0, atol=1e-9)
    np.testing.assert_allclose(encoder.speed_at(t), SPEED * 1e6, rtol=0, atol=1e-6)
    assert encoder.rpm == pytest.approx(3000.0, abs=1e-6)
    backwards = Encoder.constant_speed(3000.0, 0, 1000, direction=-1)
    assert backwards.rpm == pytest.approx(-3000.0, abs=1e-6)
    assert backwards.angle_at(500) == pytest.approx(-SPEED * 500, abs=1e-9)


@pytest.mark.parametrize("epoch", [0, 1_700_000_000_000_000])
def test_wrapped_angles_unwrap_at_any_epoch(epoch):
    t = epoch + np.arange(0, 200_000, 1000)
    truth = SPEED * (t - epoch) + 0.3
    for given_angle in (truth, wrapped(truth), truth % TWO_PI):
        encoder = Encoder.from_angles(t, given_angle)
        middle = t[:-1] + 437
        error = wrapped(encoder.angle_at(middle) - (SPEED * (middle - epoch) + 0.3))
        np.testing.assert_allclose(error, 0.0, rtol=0, atol=1e-9)
        assert encoder.rpm == pytest.approx(3000.0, abs=1e-6)


@given(st.floats(-9000, 9000), st.floats(-10, 10), st.integers(0, 2**32))
@settings(max_examples=100)
def test_counts_find_any_speed_below_half_a_turn_per_sample(rpm, phase, seed):
    rng = np.random.default_rng(seed)
    # Intervals jitter by a tenth; at 9000 rpm 2 ms are 0.3 turns.
    t = np.cumsum(rng.integers(1800, 2200, 300))
    turns = rpm / 60e6 * (t - t[0]) + phase
    count = np.floor(turns * 4096) % 4096
    encoder = Encoder.from_counts(t, count, counts_per_turn=4096)
    expected = (turns[-1] - turns[0]) * TWO_PI
    assert encoder.angle[-1] - encoder.angle[0] == pytest.approx(
        expected, abs=1.001 * TWO_PI / 4096
    )


def test_gap_of_many_turns_is_bridged_by_the_speed():
    t = np.arange(0, 400_000, 1000)
    kept = (t < 100_000) | (t > 217_300)
    count = np.round(50e-6 * t * 4096) % 4096
    encoder = Encoder.from_counts(t[kept], count[kept], counts_per_turn=4096)
    assert encoder.rpm == pytest.approx(3000.0, abs=0.1)
    assert encoder.gaps(5000) == [(99_000, 218_000)]
    assert encoder.gaps(200_000) == []


@pytest.mark.parametrize("bits", [None, 40, 54, 60, 64])
def test_wide_counters_that_fall_through_zero_are_exact(bits):
    down = 5000 - 50 * np.arange(200)
    count = down.astype(np.uint64) & np.uint64(2 ** (bits or 64) - 1)
    encoder = Encoder.from_counts(
        1000 * np.arange(200), count, counts_per_turn=4096, counter_bits=bits
    )
    np.testing.assert_allclose(encoder.angle, down * (2.0 * math.pi / 4096), rtol=1e-12)


def test_direction_and_running_counter():
    t = np.arange(0, 100_000, 1000)
    count = 1_000_000 - np.round(50e-6 * t * 2000)
    encoder = Encoder.from_counts(t, count, counts_per_turn=2000, direction=-1)
    assert encoder.rpm == pytest.approx(3000.0, abs=0.1)


def test_index_pulses_make_the_angle_absolute_and_show_slip():
    t = np.arange(0, 400_000, 100)
    pulses = np.arange(7_300, 400_000 - 100, 20_000)
    turns = 50e-6 * t
    encoder = Encoder.from_counts(
        t, np.round(turns * 4096) % 4096, counts_per_turn=4096, index_t_us=pulses
    )
    count = TWO_PI / 4096
    np.testing.assert_allclose(wrapped(encoder.angle_at(pulses)), 0.0, rtol=0, atol=1.5 * count)
    assert np.abs(encoder.slip()).max() < 1.5 * count
    # From the ninth turn on a quarter turn of counts is lost, so a minority of the pulses disagree.
    lost = np.where(t > 300_000, 1024, 0)
    slipped = Encoder.from_counts(
        t, np.round(turns * 4096) - lost, counts_per_turn=4096, index_t_us=pulses
    )
    np.testing.assert_allclose(slipped.slip()[pulses < 300_000], 0.0, rtol=0, atol=1.5 * count)
    np.testing.assert_allclose(
        slipped.slip()[pulses > 300_100], -TWO_PI / 4, rtol=0, atol=1.5 * count
    )
    assert Encoder.constant_speed(60, 0, 10).slip().size == 0


def test_clock_offset_shifts_angle_and_coverage():
    encoder = Encoder.constant_speed(3000.0, 0, 100_000).with_clock_offset(2500.0)
    assert encoder.angle_at(10_000) == pytest.approx(SPEED * 12_500, abs=1e-9)
    assert encoder.coverage == (-3500, 99_500)
    assert encoder.covers(-3500, 99_500)
    assert not encoder.covers(-3501, 0)
    assert encoder.clock_offset_us == 2500.0


HARMONICS = (0.05, -0.1, 0.02, 0.03)


@pytest.mark.parametrize("interval_us", [100, 90_000])
def test_an_error_that_repeats_every_turn_is_corrected(interval_us):
    encoder = Encoder.constant_speed(720.0, 0, 500_000, interval_us=interval_us)
    t = np.arange(*encoder.coverage, 37)
    read = encoder.angle_at(t)
    true = (
        read
        + 0.05 * np.cos(read)
        - 0.1 * np.sin(read)
        + 0.02 * np.cos(2 * read)
        + 0.03 * np.sin(2 * read)
    )
    bent = encoder.with_harmonics(HARMONICS)
    assert np.abs(bent.angle_at(t) - true).max() < 4e-4  # between samples, 1/64 turn apart at most
    assert bent.covers(*encoder.coverage)
    for few in ((0.1, 0.2), (0.1, 0.2, 0.3, 0.4, 0.5), (0.1,) * 10):
        with pytest.raises(AmiwarpError, match="expected 4, 6 or 8 numbers"):
            encoder.with_harmonics(few)


def test_further_harmonics_are_corrected_too() -> None:
    encoder = Encoder.constant_speed(720.0, 0, 300_000)
    t = np.arange(0, 300_000, 37)
    read = encoder.angle_at(t)
    third = read + 0.01 * np.cos(3 * read) - 0.02 * np.sin(3 * read)
    fourth = third - 0.03 * np.cos(4 * read) + 0.01 * np.sin(4 * read)
    of_third = (0.0, 0.0, 0.0, 0.0, 0.01, -0.02)
    assert np.abs(encoder.with_harmonics(of_third).angle_at(t) - third).max() < 3e-4
    of_both = encoder.with_harmonics((*of_third, -0.03, 0.01))
    assert np.abs(of_both.angle_at(t) - fourth).max() < 8e-4

    pair = encoder.with_second(-1.0)
    of_second = (0.0, 0.0, 0.0, 0.0, 0.0, 0.03)
    found = pair.with_harmonics((*of_third, *of_second)).angles_at(t)
    assert np.array_equal(found[:, 0], encoder.with_harmonics(of_third).angle_at(t))
    assert np.abs(found[:, 1] + read + 0.03 * np.sin(3 * read)).max() < 3e-4
    with pytest.raises(AmiwarpError, match="expected 4, 8, 12 or 16 numbers"):
        pair.with_harmonics(of_third)


def test_a_stream_corrects_its_angles_too():
    encoder = Encoder.constant_speed(720.0, 0, 100_000)
    stream = EncoderStream(harmonics=HARMONICS)
    stream.append(encoder.t, encoder.angle)
    t = np.arange(20_000, 80_000, 371)
    assert np.array_equal(
        stream.over(20_000, 80_000).angle_at(t), encoder.with_harmonics(HARMONICS).angle_at(t)
    )


def test_extrapolates_one_interval_and_no_more():
    encoder = Encoder.from_angles([0, 1000, 2000], [0.0, 0.1, 0.3])
    np.testing.assert_allclose(encoder.angle_at([-1000, 3000]), [-0.1, 0.5], rtol=0, atol=1e-12)
    for t in (-1001, 3001):
        with pytest.raises(AmiwarpError, match="outside the encoder"):
            encoder.angle_at(t)
    assert encoder.angle_at(np.zeros(0, np.int64)).shape == (0,)


def test_a_block_gets_the_angles_of_the_whole():
    rng = np.random.default_rng(3)
    t = np.cumsum(rng.integers(1, 300, 500))
    encoder = Encoder(t, np.cumsum(rng.normal(size=500))).with_clock_offset(-7.25)
    first, last = encoder.coverage
    times = np.sort(rng.integers(first, last + 1, 2000))
    angle, speed = encoder.angle_at(times), encoder.speed_at(times)
    within = (times - 7.25 >= t[0]) & (times - 7.25 <= t[-1])
    np.testing.assert_allclose(
        angle[within], np.interp(times[within] - 7.25, t, encoder.angle), rtol=0, atol=1e-9
    )
    for start in range(0, 2000, 13):
        some = slice(start, start + 13)
        np.testing.assert_allclose(encoder.angle_at(times[some]), angle[some], rtol=0, atol=1e-9)
        np.testing.assert_allclose(encoder.speed_at(times[some]), speed[some], rtol=0, atol=1e-3)


def test_a_gap_at_the_end_is_not_extrapolated_over():
    encoder = Encoder(np.array([0, 100, 200, 300, 10_000]), np.arange(5.0))
    assert encoder.coverage == (-100, 12_500)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Encoder.from_angles([0], [0.0]), "at least 2"),
        (lambda: Encoder.from_angles([0, 0], [0.0, 0.1]), "sample 1 .* not later"),
        (lambda: Encoder.from_angles([0, 1], [0.0, np.nan]), "sample 1 is nan"),
        (lambda: Encoder.from_angles([0, 1, 2], [0.0, 0.1]), "one length"),
        (lambda: Encoder.from_angles([0.0, np.inf], [0.0, 0.1]), "not finite"),
        (lambda: Encoder.from_counts([0, 1], [0, 1], counts_per_turn=0), "counts_per_turn"),
        (lambda: Encoder.from_counts([0, 1], [0, 1], counts_per_turn=2**40 + 1), "counts_per_turn"),
        (lambda: Encoder.from_counts([0, 1], [0, 1], counts_per_turn=10, direction=2), "direction"),
        (
            lambda: Encoder.from_counts([0, 9], [0, 1], counts_per_turn=10, index_t_us=[10]),
            "pulse at 10 us",
        ),
        (
            lambda: Encoder.from_counts([0, 9], [0, 1], counts_per_turn=10, index_t_us=[]),
            "no index pulse",
        ),
        (
            lambda: Encoder.constant_speed(np.nan, 0, 1),
            "constant_speed: rpm = nan is not a finite number",
        ),
        (lambda: Encoder.constant_speed(1.0, 0, 1, direction=2), "direction = 2"),
        (lambda: Encoder.constant_speed(1.0, -(2**62), -(2**62) + 9), "constant speed: t_first"),
        (lambda: Encoder.constant_speed(1.0, 2**62 - 9, 2**62), "constant speed: t_last"),
        (lambda: Encoder.constant_speed(1.0, 0, 1).with_clock_offset(np.inf), "clock_offset_us"),
        (lambda: Encoder(np.arange(3), np.array([0.0, np.inf, 1.0])), "sample 1 has angle inf"),
        (lambda: Encoder(np.arange(3, dtype=np.int32), np.zeros(3)), "int64"),
    ],
)
def test_refuses(make, message):
    with pytest.raises(AmiwarpError, match=message):
        make()


@settings(max_examples=50)
@given(
    st.lists(st.integers(1, 40), min_size=1, max_size=60),
    st.integers(0, 10**15),
    st.floats(-3e6, 3e6),
)
def test_a_stream_is_the_encoder_of_its_last_samples(sizes, origin, offset):
    n = sum(sizes) + 2
    t = origin + np.cumsum(np.random.default_rng(n).integers(1, 2000, n))
    encoder, stream = Encoder(t, SPEED * (t - origin), offset), EncoderStream(offset, capacity=64)
    stream.append(t[:2], encoder.angle[:2])
    start = 2
    for size in sizes:
        stream.append(t[start : start + size], encoder.angle[start : start + size])
        start += size
    assert len(stream) >= min(n, 64)
    low, high = stream.first + 2000, stream.last
    asked = np.linspace(low, high, 50).astype(np.int64) if low < high else np.array([high])
    np.testing.assert_array_equal(
        stream.over(int(asked[0]), high).angle_at(asked), encoder.angle_at(asked)
    )
    assert not stream.guessed(asked).any()
    assert stream.knows(int(asked[0]), int(asked[-1]))
    assert not stream.knows(int(asked[0]), high + 1)
    after = np.array([high + 1, high + 5000])
    assert stream.guessed(after).all()
    expected = SPEED * ((after - origin) + offset)
    np.testing.assert_allclose(
        stream.over(high, high + 5000).angle_at(after), expected, rtol=0, atol=1e-6
    )


def test_a_stream_leaves_out_what_comes_late():
    stream = EncoderStream()
    stream.append([0, 1000, 900, 1000, 2000], [0.0, 1.0, 7.0, 7.0, 2.0])
    assert stream.dropped == 2
    stream.append([1500, 2000, 3000], [7.0, 7.0, 3.0])
    assert stream.dropped == 4
    np.testing.assert_allclose(stream.over(0, 3000).angle, [0.0, 1.0, 2.0, 3.0])


def test_a_stream_that_stood_still_is_guessed_to_stand():
    stream = EncoderStream()
    stream.append(np.arange(0, 200_000, 1000), np.minimum(np.arange(200), 100) * 0.075)
    assert stream.over(199_000, 250_000).angle_at(250_000) == pytest.approx(7.5)


def test_a_stream_knows_the_angles_up_to_both_sides_of_a_gap():
    """The ends of a gap are samples; one microsecond into the gap, or outside all samples, the angle is an estimate."""
    stream, offset = EncoderStream(clock_offset_us=250.0), 250
    t = np.concatenate([np.arange(0, 50_000, 1000), np.arange(49_000, 100_000, 1000) + 20_001])
    stream.append(t[:70], SPEED * t[:70])
    stream.append(t[70:], SPEED * t[70:])
    assert (stream.first, stream.last) == (-1000 - offset, int(t[-1]) - offset)
    known = np.array([0, 24_000, 49_000, 69_001, t[-1]]) - offset
    estimated = np.array([-1, 49_001, 60_000, 69_000, t[-1] + 1]) - offset
    asked = np.sort(np.concatenate([known, estimated]))
    np.testing.assert_array_equal(asked[stream.guessed(asked)], estimated)
    for one in asked:
        assert stream.guessed(np.array([one]))[0] == (one in estimated)
        assert stream.knows(int(one), int(one)) == (one in known)
    assert stream.knows(0 - offset, 49_000 - offset)
    assert stream.knows(69_001 - offset, int(t[-1]) - offset)
    assert not stream.knows(49_000 - offset, 69_001 - offset)


def test_an_interval_of_20_ms_is_no_gap():
    stream = EncoderStream()
    stream.append([0, 20_000], [0.0, 1.0])
    stream.append([40_000], [2.0])
    assert stream.knows(0, 40_000)


def test_after_a_restart_the_earlier_samples_go_on_at_their_speed():
    stream = EncoderStream()
    stream.restart()  # before the first sample there is nothing to end
    t, angle = stream.append(np.arange(0, 60_000, 1000), SPEED * np.arange(0, 60_000, 1000))
    assert t.size == 60
    stream.restart()
    t, angle = stream.append([69_000, 70_000], [0.25, 0.25 + SPEED * 1000])
    assert t.tolist() == [68_999, 69_000, 70_000]
    np.testing.assert_allclose(
        angle, [SPEED * 68_999, 0.25, 0.25 + SPEED * 1000], rtol=0, atol=1e-9
    )
    assert stream.knows(0, 59_000)
    assert not stream.knows(59_000, 60_000)
    assert stream.guessed(np.array([59_000, 59_001, 68_999, 69_000])).tolist() == [
        False,
        True,
        True,
        False,
    ]
    np.testing.assert_allclose(
        stream.over(0, 70_000).angle_at([64_000]), SPEED * 64_000, rtol=0, atol=1e-9
    )
    assert stream.rpm == pytest.approx(3000.0, abs=1e-6)
    # Only the first samples after a restart
    later, _ = stream.append([71_000], [0.25 + SPEED * 2000])
    assert later.tolist() == [71_000]


def test_a_restart_within_a_microsecond_adds_no_sample():
    stream = EncoderStream()
    stream.append([0, 1000], [0.0, 0.1])
    stream.restart()
    assert stream.append([1001, 2000], [5.0, 5.1])[0].tolist() == [1001, 2000]


def test_a_stream_refuses_what_is_no_angle():
    stream = EncoderStream()
    with pytest.raises(AmiwarpError, match="finite"):
        stream.append([0, 1], [0.0, np.nan])
    with pytest.raises(AmiwarpError, match="one length"):
        stream.append([0, 1], [0.0])
    with pytest.raises(AmiwarpError, match="two samples"):
        stream.over(0, 1)
    with pytest.raises(AmiwarpError, match="capacity = 3 is not a whole number in 16"):
        EncoderStream(capacity=3)


@settings(max_examples=60)
@given(
    st.lists(st.integers(0, 30), min_size=1, max_size=12), st.sampled_from(["sines", "steps", "noise"]),
    st.integers(0, 99),
)  # fmt: skip
def test_a_command_in_parts_has_the_angles_of_the_whole(sizes, shape, seed):
    """All but the last sample, whose direction the next one would show."""
    rng, n = np.random.default_rng(seed), sum(sizes) + 2
    t = np.cumsum(rng.integers(2, 700, n))
    u = {
        "sines": np.sin(4e-4 * t) + 0.4 * np.sin(1.1e-3 * t),
        "steps": rng.integers(-2, 3, n).astype(float),
        "noise": rng.normal(size=n),
    }[shape]
    u[-1] = u[-2] + 0.1
    largest = float(np.abs(u).max()) * 1.1
    whole, stream, got = Encoder.from_command(t, u, largest=largest), EncoderStream(), []
    for start, stop in itertools.pairwise(np.cumsum([0, *sizes, 2])):
        got.append(stream.append_command(t[start:stop], u[start:stop], largest=largest))
    found_t, found = (np.concatenate(column) for column in zip(*got, strict=True))
    kept = whole.t < t[-1]
    np.testing.assert_array_equal(found_t, whole.t[kept])
    np.testing.assert_array_equal(found, whole.angle[kept])
    np.testing.assert_allclose(
        largest * np.cos(whole.angle_at(t[1:-1])), u[1:-1], rtol=0, atol=0.2 * largest
    )


def test_a_stream_refuses_commands_that_it_cannot_describe():
    stream = EncoderStream()
    stream.append_command([0, 1000, 2000], [0.0, 1.0, 1.5], largest=2.0)
    for t, u, largest, said in (
        ([3000], [2.1], 2.0, "command is 2.1, larger than the largest, 2"),
        ([3000], [np.nan], 2.0, "not finite"),
        ([3000, 4000], [1.0], 2.0, "one value for each time"),
        ([3000], [0.0], 0.0, "largest command is 0; give a number above 0"),
    ):
        with pytest.raises(AmiwarpError, match=said):
            stream.append_command(t, u, largest=largest)
    assert (len(stream), stream.dropped) == (2, 0)
    stream.append_command([1500, 2000, 3000], [0.0, 0.0, 1.8], largest=2.0)
    assert (len(stream), stream.dropped) == (3, 2)
    with pytest.raises(AmiwarpError, match="larger than the largest, 1"):
        Encoder.from_command([0, 1000], [0.0, 2.0], largest=1.0)


def test_after_a_restart_a_command_begins_anew():
    stream, t = EncoderStream(), np.arange(0, 40_000, 500)
    u = np.sin(4e-4 * t)
    stream.append_command(t[:40], u[:40], largest=1.0)
    stream.restart()
    stream.append_command(t[40:], u[40:], largest=1.0)
    assert stream.guessed(np.array([10_000, 19_600, 30_000])).tolist() == [False, True, False]
    np.testing.assert_allclose(
        np.cos(stream.over(21_000, 39_000).angle_at(t[44:78])), u[44:78], rtol=0, atol=5e-3
    )


def test_a_stream_of_two_encoders_is_covered_where_both_are():
    second = EncoderStream(250.0)
    stream = EncoderStream(250.0, second=second)
    t = np.arange(0, 100_000, 1000)
    stream.append(t, SPEED * t)
    assert (stream.first, stream.last, stream.knows(0, 10)) == (None, None, False)
    assert stream.guessed(np.arange(3)).all()
    with pytest.raises(AmiwarpError, match="fewer than two samples"):
        stream.over(0, 1)
    later = np.concatenate([np.arange(20_000, 40_000, 700), np.arange(62_000, 80_000, 700)])
    second.append(later, -0.5 * SPEED * later)
    assert (stream.first, stream.last) == (19_300 - 250, int(later[-1]) - 250)
    assert stream.knows(20_000 - 250, 39_000)
    for begin, end in ((19_749, 19_800), (39_000, 61_000), (79_000, int(later[-1]) - 249)):
        assert not stream.knows(begin, end)
        assert stream.guessed(np.arange(begin, end + 1))[[0, -1]].any()
    asked = np.array([21_000, 35_000])
    encoder = stream.over(21_000, 35_000)
    np.testing.assert_allclose(
        encoder.angles_at(asked), SPEED * np.outer(asked + 250, [1.0, -0.5]), rtol=1e-12
    )
    assert encoder.clock_offset_us == 250.0
    stream.restart()
    assert (stream.append([101_000], [0.0])[0].size, second.append([101_000], [0.0])[0].size) == (
        2,
        2,
    )


def test_a_geared_stream_has_the_angles_of_its_encoder_times_the_ratio():
    stream, t = EncoderStream(second=-0.5), np.arange(0, 10_000, 1000)
    stream.append(t, SPEED * t)
    assert (stream.first, stream.last, stream.knows(0, 9000)) == (-1000, 9000, True)
    expected = Encoder(t, SPEED * t).with_second(-0.5).angles_at([1500, 7777])
    np.testing.assert_array_equal(stream.over(1000, 8000).angles_at([1500, 7777]), expected)


@pytest.mark.parametrize(
    ("second", "said"),
    [
        (
            EncoderStream(5.0),
            "the second encoder has a clock offset of 5 us, the first one of 0 us; give both the same",
        ),
        (EncoderStream(second=-0.5), "a pair has two prisms"),
        (np.nan, "speed of the second prism"),
        (1e7, "speed of the second prism"),
        ("x", "speed of the second prism"),
    ],
)
def test_a_second_encoder_that_is_none(second, said):
    with pytest.raises(AmiwarpError, match=said):
        EncoderStream(second=second)


def test_one_count_a_turn_is_taken():
    encoder = Encoder.from_counts(
        np.arange(50) * 1000, np.arange(50), counts_per_turn=1, counter_bits=16
    )
    np.testing.assert_allclose(np.diff(encoder.angle), TWO_PI, rtol=0, atol=1e-12)


def test_the_clock_offset_is_a_plain_number():
    for given_offset in (5, np.float32(5.0), np.int64(5)):
        encoder = Encoder(np.array([0, 1000]), np.array([0.0, 1.0]), given_offset)
        assert type(encoder.clock_offset_us) is float
        assert encoder.clock_offset_us == 5.0


def test_the_largest_number_of_counts_is_taken():
    encoder = Encoder.from_counts([0, 1000], [0, 2**38], counts_per_turn=2**40)
    np.testing.assert_allclose(np.diff(encoder.angle), TWO_PI / 4, rtol=0, atol=1e-9)


def test_arrays_given_are_not_changed():
    t, angle = np.arange(0, 5000, 1000), wrapped(np.arange(5) * 2.0)
    before = angle.copy()
    Encoder.from_angles(t, angle).with_index([1500])
    np.testing.assert_array_equal(angle, before)


def test_csv_of_angles_counts_and_index(tmp_path):
    t = np.arange(0, 100_000, 1000)
    path = tmp_path / "angles.csv"
    rows = "".join(f"{ti},{np.degrees(SPEED * ti) % 360:.6f}\n" for ti in t)
    path.write_text("# bench 3\nt_us, angle_deg\n" + rows)
    assert read_encoder_csv(path).rpm == pytest.approx(3000.0, abs=1e-3)
    assert read_encoder_csv(path, direction=-1).rpm == pytest.approx(-3000.0, abs=1e-3)
    counts = np.round(50e-6 * t * 2000).astype(int) + 700
    path.write_text(
        "index,count,t_us\n"
        + "".join(
            f"{int(c % 2000 < 200)},{c % 2000},{ti}\n" for c, ti in zip(counts, t, strict=True)
        )
    )
    encoder = read_encoder_csv(path, counts_per_turn=2000)
    assert encoder.rpm == pytest.approx(3000.0, abs=0.1)
    # The first pulse comes after 13 ms. A pulse counts once, however long it is high.
    assert encoder.index_t is not None
    assert encoder.index_t.tolist() == [13_000, 33_000, 53_000, 73_000, 93_000]
    np.testing.assert_allclose(encoder.slip(), 0.0, rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is empty"),
        ("t_us,angle_deg\n", "0 samples"),
        ("t_us,angle\n0,1\n1,2\n", "header"),
        ("angle_deg\n0\n1\n", "header"),
        ("t_us,t_us,count\n0,0,1\n1,1,1\n", "header"),
        ("t_us,angle_deg,count\n0,0,1\n1,1,1\n", "one of"),
        ("t_us,angle_deg\n0,1\n1,2,3\n", "line 3 is '1,2,3'"),
        ("t_us,angle_deg\n0,1\n\n1,x\n", "line 4 is '1,x'"),
        ("t_us,angle_deg\n0,1\n1,nan\n", "line 3 is '1,nan'"),
        ("t_us,angle_deg\n0,1\n1e300,2\n", "line 3"),
        ("t_us,angle_deg\n0,1\n0,2\n", "line 3: t_us is not later"),
        ("t_us,angle_deg\n0,1\n\n5,2\n5,3\n", "line 5: t_us is not later"),
        ("t_us,count\n0,1\n1,2\n", "counts_per_turn"),
        ("t_us,angle_deg,index\n0,1,0\n1,2,7\n", "line 3: index"),
        ("t_us,angle_deg\n\udcff,1\n", "line 2 is '.*,1'; expected 2 numbers"),
        (
            "t_us,angle_deg\n#" + "9" * 1000 + "\n0,1\n1,2\n",
            "line 2 is longer than 1000 characters",
        ),
    ],
)
def test_csv_refuses(tmp_path, text, message):
    path = tmp_path / "bad.csv"
    path.write_bytes(text.encode("utf-8", "surrogateescape"))
    with pytest.raises(AmiwarpError, match=message) as caught:
        read_encoder_csv(path)
    assert "bad.csv" in str(caught.value)


def test_csv_has_a_limit(tmp_path, monkeypatch):
    monkeypatch.setattr("amiwarp.io.encoder_csv.MOST_ROWS", 5)
    path = tmp_path / "long.csv"
    path.write_text("t_us,angle_deg\n" + "".join(f"{k},{k}\n" for k in range(5)))
    assert len(read_encoder_csv(path).t) == 5
    path.write_text("t_us,angle_deg\n" + "".join(f"{k},{k}\n" for k in range(6)))
    with pytest.raises(
        AmiwarpError, match=r"long\.csv: has over 5 samples; give fewer, at a lower rate"
    ):
        read_encoder_csv(path)


def test_csv_missing(tmp_path):
    with refused(ErrorCode.FILE_MISSING):
        read_encoder_csv(tmp_path / "none.csv")


def test_the_speed_is_that_between_two_times() -> None:
    t = np.arange(0, 2_000_001, 1000)
    encoder = Encoder(t, np.maximum(t - 1_000_000, 0) * 7.5e-5, 250.0)
    assert rpm_between(encoder, 1_000_000, 2_000_000) == pytest.approx(
        7.5e-5 * 60e6 / TWO_PI, rel=1e-3
    )
    assert rpm_between(encoder, 0, 900_000) == 0.0
    assert rpm_between(encoder, -(10**9), 10**9) == pytest.approx(encoder.rpm, rel=2e-3)
    assert rpm_between(encoder, 5, 5) == rpm_between(encoder, 10**8, 10**9) == encoder.rpm


def test_times_in_seconds_are_refused() -> None:
    encoder = Encoder.constant_speed(720.0, 0, 1_000_000)
    for wrong in (np.array([0.25, 0.5]), math.nan):
        with pytest.raises(AmiwarpError, match="microseconds"):
            encoder.angle_at(wrong)
        with pytest.raises(AmiwarpError, match="microseconds"):
            encoder.speed_at(wrong)
        with pytest.raises(AmiwarpError, match="microseconds"):
            encoder.with_index(wrong)
    with pytest.raises(AmiwarpError, match=r"np.rint\(t \* 1e6\)"):
        Encoder.from_angles([0.0, 0.5, 1.0], [0.0, 0.1, 0.2])
    np.testing.assert_array_equal(encoder.angle_at(np.array([2e5])), encoder.angle_at([200_000]))
