"""Which of two attempts holds: with corrected angles or the given ones, with steps of the encoder or without."""

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, cast

import pytest

from amiwarp.calib import attempts, other_angles
from amiwarp.calib.calibrator import Attempt, Calibrator


@dataclass(frozen=True)
class Tried:
    """What is read of an attempt."""

    cost: float
    accepted: bool = True
    unexplained: bool = False
    camera_turned: bool = False
    photometric: Any = None
    search: Any = None


def as_attempt(tried: Tried) -> Attempt:
    return cast("Attempt", tried)


def held(
    monkeypatch: pytest.MonkeyPatch, corrected: Tried, with_camera: Tried, rival: Tried
) -> tuple[tuple[float, ...] | None, Attempt, int]:
    """Return the correction of the angles and the attempt that hold, and how often the angles were held."""
    made = []

    def attempt(*, angles_hold: bool) -> Attempt:
        assert angles_hold
        made.append(angles_hold)
        return as_attempt(rival)

    def unchanged(calibrator: Calibrator, tried: Attempt) -> tuple[Calibrator, Attempt]:
        return calibrator, tried

    def straight(calibrator: Calibrator, tried: Attempt) -> tuple[Calibrator, Attempt]:
        changed = SimpleNamespace(harmonics=(0.1, 0.0), mended=None)
        return cast("Calibrator", changed), as_attempt(corrected)

    def examined(calibrator: Calibrator, tried: Attempt) -> tuple[Calibrator, Attempt]:
        return calibrator, as_attempt(rival if calibrator.harmonics is None else with_camera)

    monkeypatch.setattr(attempts, "with_mended_encoder", unchanged)
    monkeypatch.setattr(attempts, "with_straight_angles", straight)
    monkeypatch.setattr(attempts, "_with_camera_examined", examined)
    given = SimpleNamespace(harmonics=None, mended=None, attempt=attempt)
    calibrator, answer = attempts._with_encoder(
        cast("Calibrator", given), as_attempt(Tried(cost=0.3))
    )
    return calibrator.harmonics, answer, len(made)


def test_given_angles_win_with_a_lower_cost_if_the_camera_turned(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for corrected in (Tried(0.3, camera_turned=True), Tried(0.4, unexplained=True)):
        better = Tried(0.02)
        harmonics, answer, made = held(monkeypatch, corrected, Tried(0.06), better)
        assert (harmonics, answer, made) == (None, better, 1)


def test_corrected_angles_hold_with_the_lower_cost(monkeypatch: pytest.MonkeyPatch) -> None:
    turned = Tried(0.3, camera_turned=True)
    best = Tried(0.02)
    for rival in (Tried(0.06), Tried(0.01, accepted=False), Tried(0.02)):
        harmonics, answer, _ = held(monkeypatch, turned, best, rival)
        assert (harmonics, answer) == ((0.1, 0.0), best)


def test_a_refused_answer_gives_way_to_given_angles(monkeypatch: pytest.MonkeyPatch) -> None:
    rival = Tried(0.2)
    turned = Tried(0.3, camera_turned=True)
    harmonics, answer, _ = held(monkeypatch, turned, Tried(0.1, accepted=False), rival)
    assert (harmonics, answer) == (None, rival)


def test_a_camera_at_rest_costs_no_further_attempt(monkeypatch: pytest.MonkeyPatch) -> None:
    still = Tried(0.1)
    harmonics, answer, made = held(monkeypatch, still, still, Tried(0.01))
    assert (harmonics, answer, made) == ((0.1, 0.0), still, 0)


def test_impossible_steps_are_taken_out_even_if_the_answer_is_refused() -> None:
    """A prism does not jump. With 12 deg lost, an answer was accepted that a turning camera explained, 0.3 px off."""
    tried = as_attempt(Tried(0.53, unexplained=True))
    refused = as_attempt(Tried(0.45, accepted=False, unexplained=True))
    assert other_angles.repairs_steps(refused, tried)
    as_dear = as_attempt(Tried(0.52, accepted=False, unexplained=True))
    assert not other_angles.repairs_steps(as_dear, tried)
