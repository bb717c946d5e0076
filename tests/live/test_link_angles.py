"""Angles from counts and index pulses, with faults."""

import math

import pytest

from amiwarp import AmiwarpError
from amiwarp.live.link.angle_tracker import AngleTracker, EncoderFault, FaultReport

PER_TURN = 1000


def turned(
    angles: AngleTracker, first: int, last: int, *, zero: int = 0, index: bool = True
) -> list[FaultReport]:
    """Feed every tenth count from ``first`` to ``last``, and an index pulse at each passage of ``zero``."""
    found: list[FaultReport] = []
    way = 10 if last > first else -10
    for count in range(first, last, way):
        found += angles.count(count, count)[1]
        if index and any((c - zero) % PER_TURN == 0 for c in range(count, count + way, way // 10)):
            found += angles.index(
                count,
                next(c for c in range(count, count + way, way // 10) if (c - zero) % PER_TURN == 0),
            )
    return found


def test_the_first_index_is_the_zero() -> None:
    angles = AngleTracker(PER_TURN)
    assert angles.count(0, 70)[0] == 0.0
    assert not angles.absolute
    assert turned(angles, 80, 5000, zero=300) == []
    assert angles.absolute
    assert angles.count(9, 5050)[0] == pytest.approx(math.tau * 4.75)


@pytest.mark.parametrize("lost", [-40, 25, 300])
def test_a_slip_is_found_told_and_mended(lost: int) -> None:
    angles = AngleTracker(PER_TURN)
    assert turned(angles, 0, 3500) == []
    # The counts jump by ``lost``, the disc does not
    found = turned(angles, 3500 + lost, 8500, zero=lost)
    assert [(r.fault, r.counts) for r in found] == [(EncoderFault.SLIP, lost)]
    assert angles.count(0, 8500 + lost)[0] == pytest.approx(math.tau * 8.5)


@pytest.mark.parametrize("lost", [-40, 25, 300])
def test_a_slip_backwards_has_the_sign_of_one_forwards(lost: int) -> None:
    angles = AngleTracker(PER_TURN)
    assert turned(angles, 0, -3500) == []
    found = turned(angles, -3500 - lost, -8500, zero=-lost)
    assert [(r.fault, r.counts) for r in found] == [(EncoderFault.SLIP, lost)]
    assert angles.count(0, -8500 - lost)[0] == pytest.approx(-math.tau * 8.5)


def test_a_little_is_the_width_of_the_pulse() -> None:
    angles = AngleTracker(PER_TURN)
    turned(angles, 0, 1500)
    assert angles.index(0, 2007) == ()
    assert angles.index(0, 2993) == ()


def test_a_missed_index_is_told_once_and_changes_nothing() -> None:
    angles = AngleTracker(PER_TURN)
    turned(angles, 0, 2500)
    found = turned(angles, 2500, 6500, index=False)
    assert [r.fault for r in found] == [EncoderFault.MISSED_INDEX]
    assert found[0].counts == pytest.approx(1.5 * PER_TURN, abs=11)
    assert turned(angles, 6500, 9000) == []
    assert angles.count(0, 9000)[0] == pytest.approx(math.tau * 9)
    found = turned(angles, 9000, 13_000, index=False)
    assert [r.fault for r in found] == [EncoderFault.MISSED_INDEX]  # again, after one that came


def test_a_reversal_is_told_and_the_angle_follows() -> None:
    angles = AngleTracker(PER_TURN)
    turned(angles, 0, 4300)
    found = turned(angles, 4300, 1500)
    assert [r.fault for r in found] == [EncoderFault.REVERSED]
    assert angles.count(0, 1500)[0] == pytest.approx(math.tau * 1.5)


def test_after_a_reversal_an_index_that_is_missed_counts_from_there() -> None:
    angles = AngleTracker(PER_TURN)
    turned(angles, 0, 4900)
    # 1.9 turns back, but only 1 turn from the last pulse
    found = turned(angles, 4900, 3000, index=False)
    assert [r.fault for r in found] == [EncoderFault.REVERSED, EncoderFault.MISSED_INDEX]


def test_an_encoder_that_stands_on_an_edge_is_no_reversal() -> None:
    angles = AngleTracker(PER_TURN)
    turned(angles, 0, 1500)
    assert all(angles.count(0, 1490 + k % 2)[1] == () for k in range(50))


def test_no_counts_are_no_turn() -> None:
    with pytest.raises(AmiwarpError, match="counts_per_turn = 0"):
        AngleTracker(0)
