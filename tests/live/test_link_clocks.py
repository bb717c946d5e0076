"""Clocks that wrap, drift apart and are read with a delay."""

import numpy as np
import pytest

from amiwarp import AmiwarpError
from amiwarp.live.link.clocks import WRAP, UnwrappedClock, fit_to_pulses, fit_to_round_trips

DRIFT, OFFSET = 35e-6, 123_456_789_000


def test_a_clock_of_32_bits_goes_on() -> None:
    rng = np.random.default_rng(0)
    true = 4_000_000_000 + np.cumsum(rng.integers(100, 100_000_000, 500))  # over eleven wraps
    clock = UnwrappedClock()
    found = np.array([clock(int(t) % WRAP) for t in true])
    np.testing.assert_array_equal(found - found[0], true - true[0])


def test_what_comes_late_is_put_where_it_belongs() -> None:
    clock = UnwrappedClock()
    assert [clock(t % WRAP) for t in (WRAP - 10, WRAP + 20, WRAP - 5, WRAP + 30)] == [
        WRAP - 10, WRAP + 20, WRAP - 5, WRAP + 30]  # fmt: skip


def pulses(n: int, jitter_us: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    own = 5_000_000_000 + np.sort(rng.integers(0, 60_000_000, n))
    other = own + OFFSET + DRIFT * (own - own[0]) + rng.normal(0.0, jitter_us, n)
    return own, np.rint(other).astype(np.int64)


@pytest.mark.parametrize("jitter_us", [0.3, 5.0])
def test_pulses_give_offset_and_drift_with_honest_deviations(jitter_us: float) -> None:
    misses = []
    for seed in range(60):
        own, other = pulses(50, jitter_us, seed)
        clock = fit_to_pulses(own, other)
        assert clock.drift == pytest.approx(DRIFT, abs=6 * clock.drift_std)
        true = OFFSET + DRIFT * (clock.at_us - own[0])
        misses.append((clock.offset_us - true) / clock.offset_std_us)
        there = own[-1] + 10_000_000
        expected = there + OFFSET + DRIFT * (there - own[0])
        std = np.hypot(clock.offset_std_us, clock.drift_std * (there - clock.at_us))
        assert abs(int(clock(there)) - expected) < 6 * std + 1
    # Time stamps are never assumed more accurate than a microsecond
    assert 0.3 < np.std(misses) < 1.4


def test_pulses_taken_for_others_are_left_out() -> None:
    own, other = pulses(60, 1.0, 3)
    other[[7, 20, 41]] += [40_000, -900, 250]
    clock = fit_to_pulses(own, other)
    assert clock.pairs == 57
    assert clock.drift == pytest.approx(DRIFT, abs=6 * clock.drift_std)


def test_three_pulses_that_agree_are_enough() -> None:
    own = np.array([1_200_000, 1_820_000, 1_940_000, 7_810_000, 9_710_000])
    clock = fit_to_pulses(own, own + np.array([100, 100, 100, 253, -8]))
    assert (clock.offset_us, clock.drift, clock.pairs) == (
        pytest.approx(100.0),
        pytest.approx(0.0, abs=1e-12),
        3,
    )


def test_round_trips_give_it_to_within_their_way() -> None:
    rng = np.random.default_rng(1)
    sent = 7_000_000_000 + np.arange(100) * 300_000
    there, back = rng.exponential(200.0, 100) + 150.0, rng.exponential(200.0, 100) + 150.0
    back[::9] += 30_000.0  # the host was busy
    at = sent + there
    other = np.rint(at + OFFSET + DRIFT * (at - sent[0])).astype(np.int64)
    clock = fit_to_round_trips(sent, other, np.rint(at + back).astype(np.int64))
    true = OFFSET + DRIFT * (clock.at_us - sent[0])
    assert abs(clock.offset_us - true) < 4 * clock.offset_std_us < 200.0
    assert clock.drift == pytest.approx(DRIFT, abs=5 * clock.drift_std)


def test_too_little_is_said() -> None:
    with pytest.raises(AmiwarpError, match="2 and 2 pulses"):
        fit_to_pulses([1, 2], [3, 4])
    with pytest.raises(AmiwarpError, match="3 and 2 pulses"):
        fit_to_pulses([1, 2, 3], [3, 4])
    with pytest.raises(AmiwarpError, match="2 round trips"):
        fit_to_round_trips([1, 2], [3, 4], [5, 6])
    with pytest.raises(AmiwarpError, match="the shortest -1 us"):
        fit_to_round_trips([1, 2, 3], [3, 4, 5], [5, 6, 2])


def test_all_at_one_time_leaves_the_drift_open() -> None:
    clock = fit_to_pulses([10, 10, 10], [30, 30, 31])
    assert clock.offset_us == pytest.approx(20.0, abs=1.0)
    assert clock.drift_std > 1.0
