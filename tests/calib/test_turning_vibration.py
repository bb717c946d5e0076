"""A vibrating camera that turns too: when its rotation is freed, when that is kept, and what is said if it is not."""

from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any, cast

import pytest

from amiwarp.calib import attempts
from amiwarp.calib.calibrator import Attempt, Calibrator


@dataclass(frozen=True)
class Found:
    """What the attempts read of a calibration."""

    photometric: Any
    parameters: dict[str, float] = field(
        default_factory=lambda: {"rate_x": 0.1, "rate_y": 0.0, "rate_z": 0.0, "amplitude": 0.01}
    )
    uncertainty: dict[str, float] = field(default_factory=dict)
    free: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    model_name: str = "vibration"
    middle_us: int | None = 5


def attempt(cost: float, *, accepted: bool = True, rotation_gain: float = 0.0) -> Attempt:
    summary = SimpleNamespace(cost=cost, accepted=accepted, rotation_gain=rotation_gain)
    return Attempt(cast("Any", Found(summary)))


def outcome(
    monkeypatch: pytest.MonkeyPatch, tried: Attempt, turning: Attempt, *, free: Any = None
) -> tuple[Attempt, bool]:
    """Return the attempt that is kept, and whether one with a free rotation was made."""
    made = []

    def turn(rival: Attempt | None) -> Attempt:
        made.append(rival)
        return turning

    calibrator = SimpleNamespace(settings=SimpleNamespace(free=free), turning=turn)
    monkeypatch.setattr(attempts, "at_found_speed", lambda calibrator, tried: tried)
    kept = attempts.of_turning_vibration(cast("Calibrator", calibrator), tried)
    return kept, bool(made)


def test_a_rotation_that_explains_the_events_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    for tried in (attempt(0.54), attempt(0.1, rotation_gain=0.06), Attempt(None)):
        kept, _ = outcome(monkeypatch, tried, attempt(0.03))
        found = kept.found()
        assert found.warnings == (
            "the camera turned at 5.7 deg/s; its rotation was calibrated together with the vibration",
        )
        assert {*found.parameters} == {"amplitude"}
        assert found.middle_us is None


def test_no_rotation_is_tried_without_a_sign_of_it(monkeypatch: pytest.MonkeyPatch) -> None:
    for tried in (attempt(0.5), attempt(0.1, rotation_gain=0.05)):
        assert outcome(monkeypatch, tried, attempt(0.01)) == (tried, False)
    given = attempt(0.54)
    assert outcome(monkeypatch, given, attempt(0.01), free=("amplitude",)) == (given, False)


def test_what_no_rotation_explains_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    for turning in (attempt(0.45), attempt(0.03, accepted=False), Attempt(None)):
        kept, made = outcome(monkeypatch, attempt(0.54), turning)
        assert made
        [said] = kept.found().warnings
        assert "54 % of the residual remains" in said
        assert "much noise, or the camera turned" in said
    kept, _ = outcome(monkeypatch, attempt(0.1, rotation_gain=0.33), attempt(0.09))
    [said] = kept.found().warnings
    assert "a slow rotation explains 33 % of the residual" in said


def test_a_refused_attempt_stays_as_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    refused = attempt(0.54, accepted=False)
    assert outcome(monkeypatch, refused, attempt(0.5))[0] is refused


def test_a_rotation_beside_an_encoder_that_is_not_found_is_said(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def unchanged(calibrator: Calibrator, tried: Attempt) -> tuple[Calibrator, Attempt]:
        return calibrator, tried

    monkeypatch.setattr(attempts, "with_mended_encoder", unchanged)
    monkeypatch.setattr(attempts, "with_straight_angles", unchanged)
    settings = SimpleNamespace(free=None, model="mirror")
    calibrator = cast("Calibrator", SimpleNamespace(settings=settings, harmonics=None))
    summary = SimpleNamespace(cost=0.1, accepted=True, rotation_gain=0.33, moving=())
    tried = Attempt(cast("Any", Found(summary)))
    better = attempt(0.02)

    monkeypatch.setattr(attempts, "with_rotation", lambda calibrator, tried: tried)
    _, kept = attempts._with_encoder(calibrator, tried)
    [said] = kept.found().warnings
    assert "a slow rotation explains 33 % of the residual" in said

    monkeypatch.setattr(attempts, "with_rotation", lambda calibrator, tried: better)
    assert attempts._with_encoder(calibrator, tried)[1] is better
