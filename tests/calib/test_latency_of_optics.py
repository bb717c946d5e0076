"""A given latency: the photometric stage starts at the phases of the motion before it."""

import math

import numpy as np
import pytest

import amiwarp
from amiwarp.calib.photometric.equations import before_latency
from amiwarp.optics import MODELS
from amiwarp.results.parameters import nominal

CAMERA = amiwarp.Camera.from_fov(160, 120, math.radians(60.0))
RATIO = -1.3
LATE_RAD = 0.06
VALUES = {
    "mirror": {"amplitude": 0.01, "phase": 0.4, "second_amplitude": 0.008, "second_phase": -2.9},
    "steerer": {"amplitude": 0.01, "phase": 0.4, "second_amplitude": 0.008, "second_phase": -2.9},
    "vibration": {
        "amplitude": 0.01,
        "phase": 3.1,
        "backward_x": 0.004,
        "backward_y": -0.002,
        "roll_x": 0.003,
        "roll_y": 0.001,
        "second_x": 0.001,
        "second_y": 0.002,
        "third_backward_x": 0.0007,
    },
}


@pytest.mark.parametrize("model", [*VALUES])
def test_events_of_earlier_angles_are_moved_as_those_at_the_time_stamps(model: str) -> None:
    kind = MODELS[model]
    prism = nominal(None, kind)
    ratio = {"ratio": RATIO} if kind.ANGLES > 1 else {}
    values = {**kind.start_values(prism), **VALUES[model], **ratio}
    stamped = kind.from_values(CAMERA, prism, values)
    before = kind.from_values(CAMERA, prism, before_latency(kind, values, LATE_RAD))

    rng = np.random.default_rng(5)
    xy = rng.uniform((0, 0), (159, 119), (200, 2))
    theta = rng.uniform(-3.0, 3.0, 200)
    late: float | np.ndarray = LATE_RAD
    if kind.ANGLES > 1:
        theta = np.stack([theta, RATIO * theta], axis=1)
        late = LATE_RAD * np.array([1.0, RATIO])
    expected = stamped.compensate_points(xy, theta)
    moved = before.compensate_points(xy, theta - late)
    np.testing.assert_allclose(moved, expected, rtol=0, atol=1e-3)  # px
    unchanged = stamped.compensate_points(xy, theta - late)
    assert np.abs(unchanged - expected).max() > 0.05  # px
