"""Troubles of the encoders of a pair of prisms: lost counts of one of them, and pulses that leave both angles open."""

import math
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from amiwarp import Calibration, Encoder, PrismMotion, Settings, calibrate
from amiwarp.calib import attempts, lost_count_attempts
from amiwarp.calib.calibrator import Attempt, Calibrator
from amiwarp.events import each_encoder, together
from amiwarp.results.calibration import replaces
from amiwarp.studies.stability.encoders import index_pulses
from benchmarks import encoder_troubles
from benchmarks.encoder_troubles import Trouble, compensation_error, recorded
from tests.conftest import COARSE

SIZE = (160, 120)
LOST_AT = 437_300
"""Time at which the encoder of the second prism loses counts [us]."""
STEP = math.radians(5.0)


@pytest.fixture(scope="module")
def pair() -> Trouble:
    """A second of a pair of prisms with good encoders."""
    return encoder_troubles.pair(SIZE, swapped=False)


@pytest.fixture(scope="module")
def slipped(pair: Trouble) -> Trouble:
    """The same, where the encoder of the second prism loses counts."""
    first, second = encoders_of(pair)
    behind = -math.copysign(STEP, second.rpm) * (second.t > LOST_AT)
    encoder = together([first, replace(second, angle=second.angle + behind)])
    return replace(pair, recording=replace(pair.recording, encoder=encoder))


def encoders_of(trouble: Trouble) -> tuple[Encoder, ...]:
    encoder = trouble.recording.encoder
    assert encoder is not None
    return each_encoder(encoder)


def calibrator_of(trouble: Trouble) -> Calibrator:
    return Calibrator(trouble.recording, Settings(model="risley"), "cpu", None)


def test_encoders_come_one_by_one_and_together_again(pair: Trouble) -> None:
    first, second = encoders_of(pair)
    assert first.second is None
    assert second.rpm == pytest.approx(-500.0, rel=1e-3)
    assert each_encoder(first) == (first,)
    again = together([first, second])
    assert again.second is second
    np.testing.assert_array_equal(again.angle, first.angle)


def test_counts_that_the_second_encoder_lost_are_put_back(pair: Trouble, slipped: Trouble) -> None:
    tried = cast(Attempt, SimpleNamespace(doubtful=True))
    mended = lost_count_attempts.without_lost_counts(calibrator_of(slipped), tried)
    assert mended is not None
    assert mended.mended is not None
    assert mended.recording.encoder is mended.mended
    said = mended.mended_words
    assert re.match(r"the second encoder's angle steps by \+(4\.9|5\.0)\d deg", said)
    assert "at 0.437 s, as the events show: it lost counts, or slipped" in said
    assert "first" not in said
    for found, true in zip(each_encoder(mended.mended), encoders_of(pair), strict=True):
        np.testing.assert_allclose(found.angle, true.angle, rtol=0, atol=math.radians(0.15))
    assert lost_count_attempts.without_lost_counts(calibrator_of(pair), tried) is None


def test_commands_of_a_mirror_keep_their_jumps(slipped: Trouble) -> None:
    """A command that does not swing as far as others is an angle that jumps."""
    mirror = replace(calibrator_of(slipped), settings=Settings(model="mirror"))
    search = SimpleNamespace(space=SimpleNamespace(sized=True))
    tried = cast(Attempt, SimpleNamespace(search=search, doubtful=True))
    assert attempts.with_mended_encoder(mirror, tried) == (mirror, tried)


def test_a_path_of_two_angles_is_for_the_encoders_of_both(slipped: Trouble) -> None:
    first, second = encoders_of(slipped)
    path = together([first, second])
    assert replaces(path, path)
    assert not replaces(path, first)
    assert not replaces(first, path)
    later = replace(second, t=second.t + 1)
    assert not replaces(path, together([first, later]))
    far = replace(second, angle=second.angle + 4.0)
    assert not replaces(path, together([first, far]))


@pytest.mark.slow
def test_a_pair_is_calibrated_without_the_counts_that_were_lost(
    slipped: Trouble, tmp_path: Path
) -> None:
    found = calibrate(slipped.recording, model="risley", photometric=COARSE)
    assert compensation_error(slipped, found)[0] < 0.015  # px; 0.13 with the step
    assert "the second encoder's angle steps by +" in found.warnings[-1]
    found.save(tmp_path / "c.json")
    again = Calibration.load(tmp_path / "c.json")
    encoder, events = slipped.recording.encoder, slipped.recording.events
    times = np.linspace(events.t_first, events.t_last, 100).astype(np.int64)
    ends = events.t_first, events.t_last
    np.testing.assert_array_equal(
        again.encoder_for(encoder, *ends).angles_at(times),
        found.encoder_for(encoder, *ends).angles_at(times),
    )


def hunting(rpm: float, share: float, hz: float) -> PrismMotion:
    """Return a motion whose speed swings about its mean."""
    t = np.arange(-0.5, 1.3, 2e-4)
    return PrismMotion(
        np.column_stack([t, rpm * (1.0 + share * np.sin(math.tau * hz * t + 0.7))]), 0.4
    )


@pytest.mark.slow
def test_both_angles_between_pulses_are_found() -> None:
    motion = replace(hunting(720.0, 0.05, 7.0), second=hunting(-500.0, 0.04, 11.0))
    made = recorded(SIZE, motion, second_deg=0.8, seconds=0.8)
    rng = np.random.default_rng(0)
    motions: list[Any] = [replace(motion, second=None), motion.second]
    pulses = together([index_pulses(each, 800_000, 0.0, rng) for each in motions])
    trouble = replace(made, recording=replace(made.recording, encoder=pulses))
    found = calibrate(trouble.recording, model="risley", photometric=COARSE)
    assert compensation_error(trouble, found)[0] < 0.035  # px; 0.12 with a smooth path
    said = found.warnings[-1]
    assert "the first encoder gives pulses only: the angle between them was found" in said
    assert "the second encoder gives pulses only: the angle between them was found" in said
    assert found.path is not None
    assert found.path.second is not None
