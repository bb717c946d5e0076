"""Steps by which the lens in front of a plate is corrected, where depths have absorbed a part of its error."""

import math
from types import SimpleNamespace
from typing import Any

import pytest

from amiwarp.calib.photometric import causes, findings, lens_at_depths, stated_errors

DEVIATION = 0.001


def state(
    found: float, *likely: causes.SuspectedError, rotation_gain: float = 0.0, cost: float = 0.1
) -> Any:
    """Return a state whose check finds a change of k1, and names likely causes."""
    check = SimpleNamespace(
        distortion=(found, DEVIATION),
        likely=tuple(SimpleNamespace(cause=cause) for cause in likely),
        rotation_gain=rotation_gain,
    )
    optimum = findings.Optimum(cost=cost, rise=0.1, moved_px=0.0, next_step_px=0.0)
    answer = SimpleNamespace(cost=cost, optimum=optimum)
    return SimpleNamespace(check=check, answer=answer)


def corrected(share: float, true_k1: float) -> float:
    """Return the distortion after three steps, where each fit finds a share of what is left."""
    k1 = 0.0
    last: lens_at_depths.LensStep | None = None
    for number in range(3):
        likely = [causes.DISTORTION] if number == 0 else []
        last = lens_at_depths.next_lens(state(share * (true_k1 - k1), *likely), last)
        if last is None:
            break
        k1 += last.step
    return k1


@pytest.mark.parametrize("share", [0.25, 0.45, 0.65, 1.0])
def test_a_lens_is_found_whatever_share_of_its_error_a_fit_finds(share: float) -> None:
    assert corrected(share, -0.1) == pytest.approx(-0.1, abs=2.0 * DEVIATION / share)


def test_the_share_is_what_the_step_has_removed() -> None:
    step = lens_at_depths.LensStep(0.02, 0.5, DEVIATION)
    assert step.step == pytest.approx(0.04)
    assert step.share_of(0.008) == pytest.approx(0.3)
    assert step.share_of(0.02) == lens_at_depths.LEAST_SHARE
    assert step.share_of(-0.03) == 1.0


def test_the_deviation_grows_as_the_step_does() -> None:
    first = lens_at_depths.next_lens(state(-0.02, causes.DISTORTION), None)
    assert first is not None
    assert first.deviation == pytest.approx(DEVIATION / stated_errors.FOUND_OF_LENS)


def test_what_is_left_by_chance_is_not_corrected() -> None:
    first = lens_at_depths.next_lens(state(-0.02, causes.DISTORTION), None)
    assert lens_at_depths.next_lens(state(1.9 * DEVIATION), first) is None
    assert lens_at_depths.next_lens(state(2.1 * DEVIATION), first) is not None


def test_a_distortion_is_corrected_only_where_it_is_likely() -> None:
    assert lens_at_depths.next_lens(state(-0.02), None) is None
    assert lens_at_depths.next_lens(state(-0.02, causes.CENTER), None) is None
    assert (
        lens_at_depths.next_lens(state(-0.02, causes.CENTER, causes.DISTORTION), None) is not None
    )


@pytest.mark.parametrize("trouble", [{"rotation_gain": 0.06}, {"cost": 0.51}, {"cost": math.inf}])
def test_events_that_nothing_explains_tell_no_lens(trouble: dict[str, float]) -> None:
    assert lens_at_depths.next_lens(state(-0.02, causes.DISTORTION, **trouble), None) is None
