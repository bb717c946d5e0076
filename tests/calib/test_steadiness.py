"""A vibration that does more than its model says: the refusal names what it does."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest

import amiwarp
from amiwarp.calib.photometric import findings
from amiwarp.calib.photometric.verdicts import refused

CAMERA = amiwarp.Camera.from_fov(160, 120, math.radians(32.2))
HZ, AMPLITUDE, DURATION_S = 100.0, 0.0144, 0.12
"""Frequency, amplitude [rad] of 4 px, and duration."""
CHANGES = "an amplitude of the vibration that changes"
SMALL_SHARE = 0.012
"""A change of the amplitude that is not refused."""
SETTINGS = amiwarp.PhotometricSettings(
    pairs=100_000, sensor=amiwarp.SensorTiming(refractory_us=100.0)
)

Turns = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True, eq=False)
class Shaken(amiwarp.CameraMotion):
    """Rotation of a camera about x and y by any function of time [s], whose values are x + iy [rad]."""

    path: Turns = np.zeros_like

    @property
    def constant(self) -> bool:
        return False

    @property
    def largest_rates(self) -> np.ndarray:
        return np.array([1.0, 1.0, 0.0]) * math.tau * HZ * AMPLITUDE

    def orientation(self, duration_s: float) -> Callable[[np.ndarray], np.ndarray]:
        from scipy.spatial.transform import Rotation

        def at(t: np.ndarray) -> np.ndarray:
            turn = self.path(np.asarray(t))
            return np.asarray(
                Rotation.from_rotvec(np.stack([turn.real, turn.imag, 0.0 * t], axis=1)).as_matrix()
            )

        return at


def ellipse(t: np.ndarray) -> np.ndarray:
    angle = math.tau * HZ * t
    return np.asarray(
        AMPLITUDE * (0.67 * np.exp(1j * (angle + 0.7)) + 0.33 * np.exp(-1j * (angle + 1.1)))
    )


def swelling(t: np.ndarray) -> np.ndarray:
    return np.asarray(ellipse(t) * (1.0 + 0.15 * np.sin(math.tau * 19.0 * t)))


def swelling_a_little(t: np.ndarray) -> np.ndarray:
    return np.asarray(ellipse(t) * (1.0 + SMALL_SHARE * np.sin(math.tau * 19.0 * t)))


def wavering(t: np.ndarray) -> np.ndarray:
    return ellipse(t + 0.15 / (math.tau * HZ) * np.sin(math.tau * 19.0 * t))


def triangle(t: np.ndarray) -> np.ndarray:
    wave = 1.0 - 4.0 * np.abs((HZ * t + 0.3) % 1.0 - 0.5)
    return np.asarray(AMPLITUDE * wave * (1.0 + 0.3j))


def recorded(path: Turns) -> amiwarp.Recording:
    from pyvista.examples import mapfile

    scene = amiwarp.Scene.from_picture(mapfile)
    motion = Shaken(path=path)
    still = amiwarp.Simulation(scene, CAMERA, amiwarp.Prism(0.0), DURATION_S, camera_motion=motion)
    return still.without_prism().run()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("path", "said"),
    [
        (swelling, "the amplitude of the vibration changes during the recording"),
        (wavering, "the frequency of the vibration changes"),
        (triangle, "the vibration is no sum of three harmonics"),
    ],
)
def test_the_refusal_names_what_the_motion_does(path: Turns, said: str) -> None:
    with pytest.raises(amiwarp.AmiwarpError, match=said):
        amiwarp.calibrate(recorded(path), model="vibration", photometric=SETTINGS)


@pytest.mark.slow
def test_a_steady_ellipse_is_accepted() -> None:
    found = amiwarp.calibrate(recorded(ellipse), model="vibration", photometric=SETTINGS)
    assert abs(found.parameters["rpm"]) == pytest.approx(60.0 * HZ, rel=2e-5)
    assert found.parameters["amplitude"] == pytest.approx(0.67 * AMPLITUDE, rel=0.01)
    assert found.photometric is not None
    assert found.photometric.hidden_px.get(CHANGES, 0.0) < 0.01


@pytest.mark.slow
def test_a_small_change_of_the_amplitude_is_bounded() -> None:
    found = amiwarp.calibrate(recorded(swelling_a_little), model="vibration", photometric=SETTINGS)
    assert found.photometric is not None
    size_px = CAMERA.fx * AMPLITUDE * math.hypot(0.67, 0.33)
    true_px = SMALL_SHARE * size_px / math.sqrt(2.0)
    assert true_px < found.photometric.hidden_px[CHANGES] < 2.0 * true_px


@pytest.mark.parametrize(
    ("kind", "said"),
    [("harmonics", "three harmonics"), ("amplitude", "the amplitude"), ("speed", "the frequency")],
)
def test_each_kind_has_words_and_a_remedy(kind: str, said: str) -> None:
    words = refused(
        findings.UnsteadyMotion(kind, moved_px=0.0913, std_px=0.001, significance=90.0, gain=0.2)
    )
    assert said in words
    assert "0.09 px or more" in words
    assert ("record while it is steady" in words) == (kind != "harmonics")


@pytest.mark.parametrize(
    ("part", "said"),
    [
        ("thresholds", "lower the sensor's thresholds"),
        ("refractory", "--refractory-us"),
        ("events", "record for longer"),
    ],
)
def test_a_large_stated_error_names_its_large_parts(part: str, said: str) -> None:
    words = refused(findings.StatedError(0.05, (part,)))
    assert "within 0.05 px only" in words
    assert said in words
    assert words.count(":") == 2
    assert said in refused(findings.StatedError(0.05, ("thresholds", "refractory", "events")))
