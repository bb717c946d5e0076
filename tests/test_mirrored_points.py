"""The guess of the point that DIRECT evaluates next."""

import nlopt
import numpy as np
import pytest
import warp as wp

from amiwarp.calib import calibrate
from amiwarp.calib.sharpness.mirrored_points import MirroredPoints
from amiwarp.events.recording import Recording


@pytest.mark.parametrize("algorithm", ["GN_DIRECT_L", "GN_DIRECT", "GN_DIRECT_L_NOSCAL", "GN_ORIG_DIRECT_L"])
@pytest.mark.parametrize(("low", "high"), [([-13.3, -13.3], [13.7, 13.7]), ([-2.1, -1.0, 0.0], [7.3, 2.0, 5.0])])
def test_most_second_points_are_guessed(algorithm: str, low: list[float], high: list[float]) -> None:
    mirrored = MirroredPoints(np.subtract(high, low).tolist())
    guess: list[float] | None = None
    right = 0

    def cost(x: np.ndarray, _gradient: np.ndarray) -> float:
        nonlocal guess, right
        if guess is not None and np.allclose(guess, x, rtol=0.0, atol=1e-10):
            mirrored.confirm(x.tolist())
            guess, right = None, right + 1
        else:
            guess = mirrored.guess(x.tolist())
        return float(((x - 1.1) ** 2).sum() + np.cos(3.0 * x).sum())

    optimiser = nlopt.opt(getattr(nlopt, algorithm), len(low))
    optimiser.set_lower_bounds(low)
    optimiser.set_upper_bounds(high)
    optimiser.set_maxeval(120)
    optimiser.set_min_objective(cost)
    optimiser.optimize(np.zeros(len(low)))
    assert right >= 40  # at most 59 of 120 points are second ones


def test_points_off_all_axes_give_no_guess() -> None:
    mirrored = MirroredPoints([9.0, 9.0])
    assert mirrored.guess([0.0, 0.0]) is None
    assert mirrored.guess([3.0, 1.0]) is None
    np.testing.assert_allclose(mirrored.guess([3.0, 0.0]), [-3.0, 0.0])


def test_guesses_change_no_score(recording: Recording, monkeypatch: pytest.MonkeyPatch) -> None:
    if not wp.is_cuda_available():
        pytest.skip("no CUDA device")
    found = [calibrate(recording, model="exact", stages=("sharpness",), device="cuda:0")]
    monkeypatch.setattr(MirroredPoints, "guess", lambda *_: None)
    found.append(calibrate(recording, model="exact", stages=("sharpness",), device="cuda:0"))
    one, other = ([stage.points for stage in c.stages] for c in found)
    assert len(one[0]) == 120
    assert one == other
