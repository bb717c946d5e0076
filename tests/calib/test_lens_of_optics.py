"""A lens that was given wrongly is corrected, and named, whatever optic is in front of the camera."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

import amiwarp
from amiwarp.calib.photometric import limits
from amiwarp.calib.photometric.causes import ASPECT, CENTER, DISTORTION, FOCAL_LENGTH, SIDE, THIRD
from amiwarp.calib.photometric.consistency import testable as causes_to_test
from amiwarp.optics import MODELS
from amiwarp.optics.camera import LENS
from amiwarp.results import make_space
from amiwarp.results.parameters import nominal

K1 = -0.08
"""Distortion of the true lens; the recording states none."""
CAMERA = amiwarp.Camera.from_fov(128, 96, math.radians(75.0))
TRUE_CAMERA = replace(CAMERA, distortion=amiwarp.RadialTangential(k1=K1))
OF_LENS = [FOCAL_LENGTH, CENTER, DISTORTION, ASPECT]
PROMPT = amiwarp.SensorModel(refractory_us=0.0)
SETTINGS = amiwarp.PhotometricSettings(
    pairs=40_000, density=1.0, sensor=amiwarp.SensorTiming(refractory_us=0.0)
)
PAIR = amiwarp.Prism(math.radians(1.6), second=amiwarp.Prism(math.radians(1.3)))
TURNING = amiwarp.PrismMotion(1500.0, 0.3, second=amiwarp.PrismMotion(-2100.0, -0.7))
MIRROR = amiwarp.Mirror((60.0, 78.0), (0.018, 0.014), (0.3, -0.7), (0.1, 1.5), 0.4, 0.8)


def causes_of(model: str, **start: float) -> list[object]:
    kind = MODELS[model]
    glass = PAIR if model == "risley" else amiwarp.Prism(math.radians(1.0))
    ratio = {"ratio": 0.7} if kind.ANGLES > 1 else {}
    space = make_space(
        model,
        CAMERA,
        nominal(glass, kind),
        free=None,
        start={**ratio, **start},
        bounds={},
        rad_per_us=1e-3,
        duration_us=1e5,
    )
    return list(causes_to_test(space))


@pytest.mark.parametrize("model", ["risley", "mirror", "steerer"])
def test_the_lens_of_every_optic_with_two_angles_is_examined(model: str) -> None:
    assert causes_of(model) == OF_LENS


def test_a_vibration_has_its_third_harmonic_too() -> None:
    assert causes_of("vibration") == [*OF_LENS, THIRD]
    assert causes_of("vibration", third_x=0.0) == OF_LENS


def test_only_a_single_prism_has_a_flat_side_to_be_turned() -> None:
    assert SIDE in causes_of("exact")
    assert SIDE not in causes_of("risley")
    assert causes_of("circle") == []


def test_depths_of_a_plate_make_up_for_the_focal_length() -> None:
    plate = amiwarp.Plate(0.01, math.radians(45.0))
    space = make_space(
        "plate", CAMERA, plate, free=None, start={}, bounds={}, rad_per_us=1e-3, duration_us=1e5
    )
    assert causes_to_test(space) == OF_LENS
    at_depths = replace(space, depths=np.ones((CAMERA.height, CAMERA.width)))
    assert causes_to_test(at_depths) == [CENTER, DISTORTION, ASPECT]


def of_pair(texture: np.ndarray, camera: amiwarp.Camera) -> amiwarp.Recording:
    return amiwarp.simulate(
        texture, camera, PAIR, duration_s=0.2, motion=TURNING, sensor=PROMPT, seed=2
    )


def of_mirror(texture: np.ndarray, camera: amiwarp.Camera) -> amiwarp.Recording:
    return amiwarp.simulate(texture, camera, MIRROR, duration_s=0.15, sensor=PROMPT, seed=2)


MADE: dict[str, Callable[[np.ndarray, amiwarp.Camera], amiwarp.Recording]] = {
    "risley": of_pair,
    "mirror": of_mirror,
}


def true_model(model: str) -> amiwarp.optics.Model:
    """Return the model of the simulation."""
    if model == "risley":
        return amiwarp.RisleyModel(TRUE_CAMERA, PAIR, 0.3, -0.7, ratio=-2100.0 / 1500.0)
    no_glass = nominal(None, amiwarp.MirrorModel)
    return amiwarp.MirrorModel.from_values(TRUE_CAMERA, no_glass, MIRROR.parameters())


@pytest.mark.parametrize("model", ["risley", pytest.param("mirror", marks=pytest.mark.slow)])
def test_a_distortion_that_was_not_given_is_found(
    texture: np.ndarray, model: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    # so small a recording leaves every motion uncertain, by an error that is refused elsewhere
    monkeypatch.setattr(limits, "LARGEST_STATED_PX", 1.0)
    recording = MADE[model](texture, TRUE_CAMERA)
    given = replace(recording, camera=CAMERA)
    found = amiwarp.calibrate(given, model=model, events=30_000, photometric=SETTINGS)
    apart = amiwarp.predicted_error(found.model, true_model(model), remove_lag=True)
    assert apart.rms < 0.03
    assert any("calibrate the lens" in said for said in found.warnings)
    assert not {*found.parameters} & {*LENS}
