"""The camera's clock beside the controller's: pulses find each other, whichever are missing; else arrivals tell."""

from __future__ import annotations

import numpy as np
import pytest

from amiwarp.live.link import ClockSource
from amiwarp.live.link.camera_clock import CameraClock
from amiwarp.live.link.clocks import fit_to_round_trips

OFFSET, DRIFT = 1_700_000_000_000_000, 40e-6


def camera_time(t: float) -> int:
    return round(t + OFFSET + DRIFT * t)


def irregular(count: int, seed: int = 0) -> np.ndarray:
    """Return the times of pulses at intervals of 70 to 130 whole milliseconds [us]."""
    return np.cumsum(np.random.default_rng(seed).integers(70, 131, count)) * 1000


def follow(
    times: np.ndarray,
    *,
    delay_us: int = 8000,
    sync: set[int] | None = None,
    seen: set[int] | None = None,
    seed: int = 0,
) -> CameraClock:
    """Pulses at the controller's ``times``; the numbers that the serial line and the camera report; 2 us of jitter."""
    rng, clock = np.random.default_rng(seed), CameraClock()
    heard = [(t + 500, "sync", k) for k, t in enumerate(times) if sync is None or k in sync]
    heard += [
        (t + delay_us + rng.integers(0, 3000), "trigger", k)
        for k, t in enumerate(times)
        if seen is None or k in seen
    ]
    for host, kind, k in sorted(heard):
        jitter = int(rng.integers(-2, 3))
        if kind == "sync":
            clock.sync(int(times[k]), int(host))
        else:
            clock.triggers([camera_time(times[k]) + jitter], int(host))
    return clock


@pytest.mark.parametrize("delay_us", [0, 8000, 40_000])
def test_pulses_at_even_distances_meet_their_own(delay_us: int) -> None:
    clock = follow(np.arange(60) * 100_000, delay_us=delay_us).clock(None)
    assert clock is not None
    late = 6_000_000
    assert abs(int(clock(late)) - camera_time(late)) <= 4
    assert clock.drift == pytest.approx(DRIFT, abs=4e-6)


@pytest.mark.parametrize("seed", range(20))
def test_pulses_that_one_side_missed_do_no_harm(seed: int) -> None:
    rng = np.random.default_rng(seed)
    times = np.arange(60) * 100_000
    sync, seen = (set(np.flatnonzero(rng.uniform(size=60) > 0.3).tolist()) for _ in range(2))
    clock = follow(times, sync=sync, seen=seen, seed=seed).clock(None)
    assert clock is not None
    assert abs(int(clock(6_000_000)) - camera_time(6_000_000)) <= 8


@pytest.mark.parametrize(("syncs", "triggers"), [(4, 4), (4, 7), (7, 4), (5, 9)])
def test_reports_that_all_come_at_once_do_not_meet_those_of_other_pulses(
    syncs: int, triggers: int
) -> None:
    """The host was busy as it began: what it heard first of either side came late, and it had not heard all."""
    clock, times = CameraClock(), np.arange(40) * 50_000
    heard = [(max(t, 450_000), "sync", t) for t in times[10 - syncs :]]
    heard += [(max(t + 3000, 452_000), "trigger", t) for t in times[10 - triggers :]]
    for host, kind, t in sorted(heard):
        if kind == "sync":
            clock.sync(int(t), int(host))
        else:
            clock.triggers([camera_time(t)], int(host))
        known = clock.clock(None)
        assert known is None or abs(int(known(2_000_000)) - camera_time(2_000_000)) < 100
    assert clock.clock(None) is not None


def test_triggers_that_come_at_once_beside_prompt_syncs_wait_for_others() -> None:
    """As seen on a busy machine: five at once, the sync before the last 80 ms late."""
    clock = CameraClock()
    for k, late in enumerate((0, 6, 0, 82, 8)):
        clock.sync(100_000 * k, 1000 * (100 * k + late))
    for k in range(4):
        clock.triggers([7_000_000 + 100_000 * k], 389_000 + 500 * k)
    clock.triggers([7_400_000], 404_000)
    assert clock.clock(None) is None
    for k in (5, 6):
        clock.sync(100_000 * k, 100_000 * k + 500)
        clock.triggers([7_000_000 + 100_000 * k], 100_000 * k + 4000)
    found = clock.clock(None)
    assert found is not None
    assert found.pairs == 7
    assert int(found(600_000)) == pytest.approx(7_600_000, abs=3)


@pytest.mark.parametrize("seed", range(20))
def test_six_irregular_pulses_are_enough_and_five_are_not(seed: int) -> None:
    assert follow(irregular(5, seed), seed=seed).clock(None) is None
    clock = follow(irregular(6, seed), seed=seed)
    found = clock.clock(None)
    assert found is not None
    assert clock.source is ClockSource.PULSES
    assert abs(int(found(300_000)) - camera_time(300_000)) <= 20


def test_seven_regular_pulses_are_enough_and_six_are_not() -> None:
    assert follow(np.arange(6) * 100_000).clock(None) is None
    clock = follow(np.arange(7) * 100_000)
    found = clock.clock(None)
    assert found is not None
    assert abs(int(found(300_000)) - camera_time(300_000)) <= 20
    assert clock.source is ClockSource.REGULAR
    assert found.offset_std_us == 100_000  # by which it may be wrong


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("delay_us", [0, 50_000, 300_000, 1_000_000, 5_000_000, 9_000_000])
@pytest.mark.parametrize("missed", [0.0, 0.3])
def test_irregular_pulses_meet_their_own_however_late_the_reports_are(
    seed: int, delay_us: int, missed: float
) -> None:
    rng = np.random.default_rng(seed)
    times = irregular(200, seed)
    sync, seen = (set(np.flatnonzero(rng.uniform(size=200) >= missed).tolist()) for _ in range(2))
    clock = follow(times, delay_us=delay_us, sync=sync, seen=seen, seed=seed)
    found = clock.clock(None)
    assert found is not None
    assert clock.source is ClockSource.PULSES
    late = int(times[-1])
    assert abs(int(found(late)) - camera_time(late)) <= 3
    assert found.offset_std_us < 1.0


@pytest.mark.parametrize("seed", range(20))
def test_triggers_of_something_else_are_never_paired(seed: int) -> None:
    """Pulses of the controller, and triggers at other irregular times."""
    clock = CameraClock()
    heard = [(int(t), 0) for t in irregular(150, seed)] + [
        (int(t), 1) for t in irregular(150, seed + 1000)
    ]
    for t, is_trigger in sorted(heard):
        if is_trigger:
            clock.triggers([camera_time(t)], t)
        else:
            clock.sync(t, t)
        assert clock.clock(None) is None


def test_irregular_pulses_that_repeat_fit_under_two_shifts_and_are_not_paired() -> None:
    """Eight different intervals, again and again: nothing tells one round from the next."""
    times = np.cumsum(np.tile(np.array([71, 95, 128, 88, 101, 119, 77, 110]), 10)) * 1000
    assert follow(times, seen=set(range(24)), delay_us=9_000_000).clock(None) is None
    assert follow(times, delay_us=9_000_000).clock(None) is None


def test_a_clock_that_has_drifted_while_no_pulse_was_seen_is_still_met() -> None:
    """Quartzes that warm up: 0.4 ms in five minutes without triggers."""
    times = irregular(3200)
    clock = CameraClock()
    for k, t in enumerate(times.tolist()):
        clock.sync(t, t + 500)
        if k < 100:
            clock.triggers([camera_time(t)], t + 4000)
        elif k >= 3100:
            clock.triggers([camera_time(t) + 400], t + 4000)
        if k >= 10:
            assert clock.clock(None) is not None
    found = clock.clock(None)
    assert found is not None
    assert abs(int(found(int(times[-1]))) - camera_time(int(times[-1])) - 400) <= 5


def test_extra_triggers_between_the_pulses_do_no_harm() -> None:
    """As the falling edges, which some cameras report, too."""
    times = irregular(30)
    clock = CameraClock()
    for t in times.tolist():
        clock.sync(t, t + 500)
        clock.triggers([camera_time(t), camera_time(t + 1000)], t + 4000)
    found = clock.clock(None)
    assert found is not None
    assert abs(int(found(int(times[-1]))) - camera_time(int(times[-1]))) <= 2


def test_a_camera_clock_that_jumps_is_noticed_and_found_again() -> None:
    times = irregular(80)
    clock = CameraClock()
    errors = []
    for k, t in enumerate(times.tolist()):
        jump = 0 if k < 40 else 250_000
        clock.sync(t, t + 500)
        clock.triggers([camera_time(t) + jump], t + 4000)
        found = clock.clock(None)
        errors.append(None if found is None else int(found(t)) - camera_time(t) - jump)
    assert errors[39] is not None
    assert abs(errors[39]) <= 2
    assert None in errors[40:60]
    assert errors[-1] is not None
    assert abs(errors[-1]) <= 2


def test_a_pulled_trigger_cable_keeps_the_map_and_the_pulses_after_it_match_again() -> None:
    times = irregular(1500)
    clock = CameraClock()
    for k, t in enumerate(times.tolist()):
        clock.sync(t, t + 500)
        if not 50 <= k < 1200:
            clock.triggers([camera_time(t)], t + 4000)
        if k >= 10:
            known = clock.clock(None)
            assert known is not None
            gone_us = t - int(times[49]) if 50 <= k < 1200 else 0
            # 2e-6 of the time since the last pulse that was seen
            assert clock.source is (
                ClockSource.OLD if gone_us > 100_000_000 else ClockSource.PULSES
            )
            assert known.offset_std_us >= 2e-6 * gone_us
            assert clock.relation == 1
    found = clock.clock(None)
    assert found is not None
    assert abs(int(found(int(times[-1]))) - camera_time(int(times[-1]))) <= 2
    assert found.pairs >= 90


@pytest.mark.parametrize(
    ("with_sync", "with_triggers", "patience_us"),
    [(False, False, 3_000_000), (True, False, 6_500_000), (True, True, 10_000_000)],
)
def test_arrival_times_are_used_only_after_pulses_were_waited_for(
    with_sync: bool, with_triggers: bool, patience_us: int
) -> None:
    sent = np.arange(20) * 50_000
    host, clock = fit_to_round_trips(sent, sent + 150, sent + 300), CameraClock()
    rng = np.random.default_rng(0)
    for t in range(0, 12_000_000, 50_000):
        clock.packet(camera_time(t), t + 2000)
        if with_triggers:
            clock.triggers([camera_time(t)], t + 2000)
        if with_sync:
            clock.sync(int(rng.integers(t, t + 40_000)), t)  # at other intervals
        known = clock.clock(host) is not None
        assert known == (t >= patience_us)
        assert clock.source is (ClockSource.ARRIVAL if known else ClockSource.UNKNOWN)
    clock.restart()
    assert clock.clock(host) is None
    clock.settle()
    assert clock.clock(host) is not None


def test_after_a_restart_of_the_controller_it_is_found_anew() -> None:
    clock = follow(np.arange(10) * 100_000)
    clock.restart()
    assert clock.clock(None) is None
    for t in irregular(8).tolist():
        clock.sync(t, 9_000_000 + t)
        clock.triggers([5_000_000 + t], 9_004_000 + t)
    again = clock.clock(None)
    assert again is not None
    assert abs(int(again(400_000)) - 5_400_000) <= 3


def test_without_pulses_arrivals_tell_within_what_they_say() -> None:
    """The host's clock is 7 s ahead of the controller's; packets need 2 ms and up to 3 more."""
    rng, clock = np.random.default_rng(0), CameraClock()
    sent = np.arange(20) * 50_000 + 7_000_000
    host = fit_to_round_trips(sent, sent - 7_000_000 + 150, sent + 300)
    for t in range(0, 1_000_000, 1000):
        clock.packet(camera_time(t), t + 7_000_000 + 2000 + int(rng.integers(0, 3000)))
    clock.settle()
    found = clock.clock(host)
    assert found is not None
    error = int(found(1_000_000)) - camera_time(1_000_000)
    assert -2500 < error < 0  # by the shortest way of the packets, which nothing tells
    assert found.offset_std_us > 1000


@pytest.mark.parametrize("ahead_us", [0, 3_600_000_000])
def test_without_pulses_a_controller_that_runs_fast_is_followed(ahead_us: int) -> None:
    """The controller's clock gains 0.2 ms per second on the host's, the camera's none; packets need 2 ms.

    ``ahead_us``: by how much the host's clock is ahead of both, as it runs since the computer was started.
    """
    sent, clock = np.arange(20) * 50_000, CameraClock()
    answered = np.rint((sent + 150) * 1.0002).astype(np.int64)
    host = fit_to_round_trips(sent + ahead_us, answered, sent + ahead_us + 300)
    for t in sent.tolist():
        clock.packet(t - 2000, t + ahead_us)
    clock.settle()
    found = clock.clock(host)
    assert found is not None
    for seconds in (0, 10, 20):
        assert abs(int(found(round(1e6 * seconds * 1.0002))) - (1_000_000 * seconds - 2000)) <= 5


def test_a_camera_that_returns_has_no_delay_of_its_former_clock() -> None:
    host, clock = (
        fit_to_round_trips([0, 1000, 2000], [150, 1150, 2150], [300, 1300, 2300]),
        CameraClock(),
    )
    for t in (10_000, 20_000, 30_000):
        clock.packet(t - 1000, t)
    clock.returned()
    assert clock.clock(host) is None
    for t in (50_000_000, 50_010_000, 50_020_000):  # its clock begins anew
        clock.packet(t - 50_000_000, t)
    clock.settle()
    found = clock.clock(host)
    assert found is not None
    assert int(found(50_005_000)) == 5000


def test_a_map_between_clocks_far_apart_is_inverted() -> None:
    clock = follow(irregular(60)).clock(None)
    assert clock is not None
    for own in (0, 5_000_000, 3_600_000_000):
        assert clock.inverse(int(clock(own))) == pytest.approx(own, abs=1.0)


def test_nothing_is_known_at_first() -> None:
    assert CameraClock().clock(None) is None
