"""Short versions of benchmarks/load.py: every event of a stream is kept, removed with a reason, or counted as lost."""

import numpy as np
import pytest

from amiwarp import Compensated, Events
from benchmarks.load import clock, from_process, steady
from benchmarks.load_pictures import pictures
from benchmarks.load_processes import cable, killed_reader, slow_reader
from benchmarks.load_stream import PERIOD_PACKETS, Check, Pattern

MEV_S = 0.5


@pytest.fixture(scope="module")
def pattern() -> Pattern:
    return Pattern(MEV_S)


def test_a_stream_is_whole_and_equal_to_the_filtered_file(pattern: Pattern) -> None:
    row = steady(MEV_S, 0.4, pattern)
    assert row["right"]
    assert row["sent"] == 200_000 == row["kept"] + sum(row["removed"].values())
    assert len(row["removed"]) == 3
    assert min(row["removed"].values()) > 0
    assert row["kept"] > 500


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["shm", "tcp"])
def test_a_stream_of_another_process_is_whole(pattern: Pattern, kind: str) -> None:
    row = from_process(MEV_S, 0.3, pattern, kind)
    assert (row["right"], row["lost_packets"], row["sent"]) == (True, 0, 150_000)


def test_a_clock_that_jumps_loses_no_event(pattern: Pattern) -> None:
    row = clock(MEV_S, 0.4, pattern)
    assert row["right"]
    assert 90_000 < row["late"] <= 100_000


@pytest.mark.slow
def test_pictures_are_those_of_a_camera_without_a_stream() -> None:
    row = pictures(0.2, 0.5)
    assert row["right"]
    assert row["compared"] == 5


@pytest.mark.slow
def test_readers_that_are_slow_or_killed_harm_no_other(pattern: Pattern) -> None:
    assert slow_reader(MEV_S, 1.0, pattern, must_lose=False)["right"]
    assert killed_reader(MEV_S, 1.0, pattern)["right"]


@pytest.mark.slow
def test_a_sender_that_returns_goes_on(pattern: Pattern) -> None:
    assert cable(MEV_S, 0.4, pattern)["right"]


@pytest.mark.parametrize("fault", ["lost", "doubled", "swapped", "moved", "late", "polarity"])
def test_the_check_sees_what_is_wrong(pattern: Pattern, fault: str) -> None:
    whole = pattern.expected
    x, y, t, p = (column.copy() for column in (whole.x, whole.y, whole.t, whole.p))
    order = np.arange(len(whole))
    if fault == "lost":
        order = np.delete(order, 700)
    elif fault == "doubled":
        order = np.insert(order, 700, 700)
    elif fault == "swapped":
        order[[700, 705]] = order[[705, 700]]
    elif fault == "moved":
        x[700] = np.nextafter(x[700], np.float32(1e9))
    elif fault == "late":
        t[700] += 1
    else:
        p[700] ^= 1
    right = Check(pattern)
    right.take(Compensated(whole, np.zeros(len(whole), np.uint8), 0))
    check = Check(pattern)
    found = Events(x[order], y[order], t[order], p[order])
    check.take(Compensated(found, np.zeros(len(found), np.uint8), 0))
    assert (right.wrong, right.events) == (0, len(whole))
    assert check.wrong > 0


def test_the_check_sees_a_period_that_comes_twice_and_one_that_lacks(pattern: Pattern) -> None:
    whole = pattern.expected
    flags = np.zeros(len(whole), np.uint8)
    check = Check(pattern)
    for shift_us, wrong, skipped in ((0, 0, 0), (100_000, 0, 0), (100_000, 1, 0), (400_000, 1, 2)):
        later = Events(whole.x, whole.y, whole.t + shift_us, whole.p)
        check.take(Compensated(later, flags, 0))
        assert (check.wrong, check.skipped) == (wrong, skipped)


def test_each_period_of_the_pattern_is_filtered_alike(pattern: Pattern) -> None:
    packets = [pattern.packet(k, 5000) for k in range(2 * PERIOD_PACKETS)]
    assert pattern.filter is not None
    kept = pattern.filter.apply(Events.concatenate(packets), (1280, 720))
    half = len(pattern.expected)
    assert len(kept) == 2 * half
    assert np.array_equal(kept.t[half:] - kept.t[:half], np.full(half, 100_000))
    assert np.array_equal(kept.x[half:], kept.x[:half])
