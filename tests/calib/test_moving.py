"""Calibration with a rotating camera, and scenes that must not be mistaken for rotation."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from amiwarp import (
    AmiwarpError,
    Body,
    Calibration,
    Camera,
    CameraMotion,
    CameraRotation,
    Encoder,
    FlatSide,
    Material,
    Mesh,
    PhotometricSettings,
    Recording,
    Scene,
    SensorModel,
    SensorTiming,
    Simulation,
    Trajectory,
    World,
    WorldScene,
    calibrate,
    iwe,
    model_error,
    open_recording,
    reconstruct,
    simulate,
    truth_model,
)
from amiwarp.calib.camera_rates import estimate_rates
from amiwarp.calib.thinning import thin
from amiwarp.io import read_calib
from amiwarp.results.parameters import RATES
from amiwarp.simulation import linear_luminance
from tests.conftest import TRUE_PRISM

CAMERA = Camera.from_fov(140, 105, math.radians(50.0))
SMALL = Camera.from_fov(100, 75, math.radians(50.0))
KNOWN = PhotometricSettings(
    pairs=40_000, density=1.0, sensor=SensorTiming(latency_us=100.0, refractory_us=100.0)
)
MORE = replace(KNOWN, pairs=300_000)
FREE = ("apex", "phase", "motion")


def turned(texture: NDArray[np.uint8], rates: Any, **extra: Any) -> Recording:
    """Slightly more than two turns of the prism in front of the texture, with a rotating camera."""
    return simulate(
        texture, CAMERA, TRUE_PRISM, duration_s=0.18, camera_motion=CameraMotion(rates), seed=4,
        nominal_prism=replace(TRUE_PRISM, apex=1.2 * TRUE_PRISM.apex), **extra,
    )  # fmt: skip


def error_px(c: Calibration, recording: Recording) -> float:
    assert recording.camera is not None
    assert recording.truth is not None
    return model_error(c.model, truth_model(recording.camera, recording.truth, FlatSide.SCENE)).rms


def rates_of(c: Calibration) -> NDArray[np.float64]:
    return np.array([c.parameters[n] for n in RATES])


@pytest.mark.parametrize(("axis", "speed"), [(1, 10.0), (2, 60.0)])
def test_the_camera_turns(texture: NDArray[np.uint8], axis: int, speed: float) -> None:
    rate = np.eye(3)[axis] * math.radians(speed)
    recording = turned(texture, tuple(rate))
    c = calibrate(recording, free=FREE, photometric=KNOWN, events=40_000)
    assert c.photometric is not None
    assert c.photometric.accepted
    assert np.linalg.norm(rates_of(c) - rate) <= 0.02 * np.linalg.norm(rate)
    assert error_px(c, recording) <= 0.05
    assert c.camera_rotation == CameraRotation(
        tuple(rates_of(c).tolist()), middle_us=c.middle_us or 0
    )


def test_it_turns_ever_faster_and_the_picture_follows(
    texture: NDArray[np.uint8], tmp_path: Path
) -> None:
    """Angular velocity linear in time: its change is found, stored in the file, and used by the reconstruction."""
    simulation = Simulation(
        Scene.from_picture(texture), CAMERA, TRUE_PRISM, 0.18, seed=4,
        camera_motion=CameraMotion([[0.0, 0.0, 0.2, 0.0], [0.2, 0.0, 1.2, 0.0]]),
    )  # fmt: skip
    recording = simulation.run()
    c = calibrate(recording, free=(*FREE, "change_y"), photometric=KNOWN, events=40_000)
    assert c.parameters["change_y"] == pytest.approx(5.0, rel=0.05)
    assert c.camera_rotation is not None
    assert c.camera_rotation.about(0).angular_velocity[1] == pytest.approx(0.2, abs=0.02)
    assert error_px(c, recording) <= 0.05
    c.save(tmp_path / "c.json")
    loaded = Calibration.load(tmp_path / "c.json")
    assert loaded == c
    following, still = (
        reconstruct(recording, loaded, start_us=0, turns=1.0, camera_rotation=rotation)
        for rotation in (None, CameraRotation())
    )
    assert following.residual < 0.3 * still.residual


def test_it_moves_forward_and_the_image_grows(texture: NDArray[np.uint8], device: str) -> None:
    """Towards a picture at 1 m, at 1.5 m/s: in the middle of the recording, the growth is speed over depth."""
    wall = Mesh(np.array([[-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]]), np.array([[0, 1, 2], [0, 2, 3]]),
                np.array([[0, 0], [1, 0], [1, 1], [0, 1]]))  # fmt: skip
    picture = Material(1.0, linear_luminance(texture))
    path = Trajectory(
        [0.0, 0.18], [[0.0, 0.0, -0.135], [0.0, 0.0, 0.135]], [[0.0, 0.0, 0.0, 1.0]] * 2
    )
    recording = Simulation(
        WorldScene(World("wall", (Body("wall", wall, picture),), ambient=1.0), path), CAMERA, TRUE_PRISM, 0.18, seed=4,
        device=device,
    ).run()  # fmt: skip
    c = calibrate(
        recording, free=(*FREE, "growth"), photometric=KNOWN, events=40_000, device=device
    )
    assert c.parameters["growth"] == pytest.approx(1.5, rel=0.03)
    assert np.abs(rates_of(c)).max() < 0.03
    assert error_px(c, recording) <= 0.03
    assert c.camera_rotation is not None
    assert c.camera_rotation.growth == c.parameters["growth"]


def test_a_still_camera_is_found_to_be_still(recording: Recording) -> None:
    assert recording.encoder is not None
    assert recording.camera is not None
    rates = estimate_rates(thin(recording, 400_000), recording.encoder, recording.camera)
    assert np.abs(rates).max() < math.radians(1.0)


def test_what_the_events_do_not_determine_is_held_and_named(recording: Recording) -> None:
    """At constant speed a clock offset equals a phase. This encoder has no counting steps that would separate them."""
    even = Encoder.constant_speed(720.0, recording.events.t_first, recording.events.t_last)
    recording = replace(recording, encoder=even)
    c = calibrate(
        recording, free=("apex", "phase", "clock_offset"), photometric=MORE, events=200_000
    )
    assert c.photometric is not None
    assert c.photometric.held == ("clock_offset",)
    assert "clock_offset" not in c.photometric.uncertainty
    assert any("clock_offset" in warning for warning in c.warnings)
    assert error_px(c, recording) < 0.02


def test_index_and_focal_length(recording: Recording) -> None:
    """Index, focal length and apex make nearly the same motion."""
    c = calibrate(
        recording, free=("apex", "phase", "index", "focal_length"), photometric=KNOWN, events=40_000
    )
    assert c.photometric is not None
    assert c.photometric.accepted
    assert error_px(c, recording) < 0.02
    assert recording.camera is not None
    for name, true in (("index", TRUE_PRISM.index), ("focal_length", recording.camera.fx)):
        if name not in c.photometric.held:
            assert c.parameters[name] == pytest.approx(true, abs=6.0 * c.uncertainty[name])


def test_linear_unknowns(texture: NDArray[np.uint8]) -> None:
    """A strong leak is found. To free it or the ratio of the thresholds costs little accuracy."""
    sensor = SensorModel(contrast_on=0.22, contrast_off=0.28, leak_hz=20.0)
    recording = simulate(texture, SMALL, TRUE_PRISM, duration_s=0.25, sensor=sensor, seed=5)
    for free in (("leak",), ("off_ratio", "leak")):
        # a leak shows where events are few, so all pairs are used
        c = calibrate(recording, free=("apex", "phase", *free), photometric=MORE, events=100_000)
        assert c.photometric is not None
        assert c.photometric.accepted
        assert c.photometric.leak == pytest.approx(20.0, abs=5.0)
        assert 1.0 < c.photometric.off_over_on < 1.4  # 1.27
        assert error_px(c, recording) < 0.03


@pytest.mark.parametrize(("name", "gain"), [("shapes_rotation", 2.99), ("dynamic_rotation", 2.06)])
def test_real_recordings_from_zero(data_dir: Path, name: str, gain: float) -> None:
    """No prism: both stages find the camera's rotation. Their images are at least as sharp as those of motion.txt."""
    folder = data_dir / "text" / name
    recording = open_recording(folder / "events.txt")
    width, height = recording.events.size
    recording = replace(recording, camera=read_calib(folder / "calib.txt", width, height))
    c = calibrate(recording, free=("motion",), start={"apex": 0.0})
    assert c.photometric is not None
    assert c.photometric.accepted
    assert c.middle_us is not None
    sharp, photometric = (
        np.array([values[n] for n in RATES])
        for values in (c.photometric.sharpness_parameters, c.parameters)
    )
    assert np.linalg.norm(photometric) == pytest.approx(np.linalg.norm(sharp), rel=0.05)
    given = np.loadtxt(folder / "motion.txt").ravel()[-3:]
    assert np.linalg.norm(photometric) == pytest.approx(np.linalg.norm(given), rel=0.2)
    events = recording.events.slice(0, len(recording.events))
    encoder = c.encoder_for(None, recording.events.t_first, recording.events.t_last)

    def variance(rates: NDArray[np.float64]) -> float:
        x, y, z = rates.tolist()
        camera_rotation = CameraRotation((x, y, z), middle_us=c.middle_us or 0)
        return float(
            iwe(
                events,
                width,
                height,
                model=c.model,
                encoder=encoder,
                camera_rotation=camera_rotation,
            ).var()
        )

    still = variance(np.zeros(3))
    for rates in (sharp, photometric):
        assert variance(rates) / still >= gain
        assert variance(rates) > variance(given)
    assert (
        reconstruct(
            recording, c, length_us=recording.events.t_last - recording.events.t_first
        ).residual
        < 0.3
    )


# -- scenes that violate the model: refused, or the first stage's answer with a warning, never silently worse


@dataclass(frozen=True)
class Film:
    """One picture per millisecond, computed when it is read."""

    picture: Callable[[float], NDArray[Any]]
    seconds: float

    @property
    def size(self) -> tuple[int, int]:
        height, width = self.picture(0.0).shape
        return width, height

    @property
    def interval_us(self) -> float:
        return 1000.0

    def read(self) -> Iterator[tuple[int, NDArray[np.float32]]]:
        for k in range(round(self.seconds * 1e3) + 1):
            yield 1000 * k, linear_luminance(self.picture(k * 1e-3))


def outcome(film: Film) -> tuple[Recording, Calibration | None]:
    recording = Simulation(Scene(film), CAMERA, TRUE_PRISM, film.seconds, seed=6).run()
    try:
        return recording, calibrate(recording, photometric=KNOWN, events=40_000)
    except AmiwarpError:
        return recording, None


def check_honest(recording: Recording, c: Calibration | None) -> None:
    """Check: no answer, or that of contrast maximisation with a warning, or one at least as accurate."""
    if c is None:
        return
    if c.photometric is None or not c.photometric.accepted:
        assert any("photometric" in warning for warning in c.warnings)
        return
    before = replace(c, parameters=c.photometric.sharpness_parameters)
    assert error_px(c, recording) <= error_px(before, recording)


def test_flickering_light(texture: NDArray[np.uint8]) -> None:
    """Mains lighting: the whole scene dims to 40 % and recovers 100 times a second."""

    def picture(t: float) -> NDArray[np.float32]:
        light = np.float32(0.7 + 0.3 * math.cos(math.tau * 100.0 * t))
        return linear_luminance(texture) * light

    recording, c = outcome(Film(picture, 0.25))
    assert c is None or c.photometric is None or not c.photometric.accepted
    check_honest(recording, c)


def test_an_object_moves_through(texture: NDArray[np.uint8]) -> None:
    """A third of the image moves independently at 400 px/s."""

    def picture(t: float) -> NDArray[np.uint8]:
        out = texture.copy()
        rows = slice(60, 180)
        out[rows] = np.roll(texture[rows][:, ::-1], round(400.0 * t), axis=1)
        return out

    recording, c = outcome(Film(picture, 0.25))
    check_honest(recording, c)


def test_blank_scene() -> None:
    grey = np.full((60, 80), 128, np.uint8)
    recording = simulate(grey, SMALL, TRUE_PRISM, duration_s=0.25, seed=6)
    with pytest.raises(AmiwarpError, match=r"events are too few|sharper than chance"):
        calibrate(recording)
    noisy = simulate(
        grey, SMALL, TRUE_PRISM, duration_s=0.25, seed=6, sensor=SensorModel(shot_noise_hz=50.0)
    )
    with pytest.raises(AmiwarpError, match="sharper than chance"):
        calibrate(noisy)


def test_a_hand_trembles(texture: NDArray[np.uint8]) -> None:
    # within two turns, the speed of a tremor is no linear function of time
    t = np.linspace(0.0, 0.2, 201)
    rates = np.stack(
        [0.1 * np.cos(18.0 * t), 0.08 * np.sin(18.0 * t + 0.5), np.zeros(len(t))], axis=1
    )
    recording = turned(texture, np.column_stack([t, rates]))
    c = calibrate(
        recording, free=FREE, photometric=replace(KNOWN, density=2.0, pairs=20_000), events=30_000
    )
    assert {*RATES, "apex", "phase"} <= {*c.free} & {*c.uncertainty}
    assert error_px(c, recording) <= 0.01
