"""Sums in phase with vibrations, mirrors and pairs of prisms, compared with definitions in ``reference/``."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from amiwarp import (
    AmiwarpError,
    Calibration,
    Camera,
    Encoder,
    LockedAngles,
    Mirror,
    MirrorModel,
    Model,
    PhaseReconstruction,
    PhaseSums,
    Plate,
    PlateModel,
    Prism,
    RisleyModel,
    Scene,
    Simulation,
    VibrationModel,
    phase_image,
    phase_picture,
)
from amiwarp.reconstruction import (
    MotionPeriod,
    detail_of_paths,
    harmonics_for,
    is_orbit,
    lag_of_paths,
    path_plan_of,
)
from reference import optics, phase

WIDTH = 96
HEIGHT = 72
CAMERA = Camera.from_fov(WIDTH, HEIGHT, math.radians(50.0))
PX = 1.0 / CAMERA.fx
"""Rotation of the camera that moves the middle by a pixel [rad]."""
ANGLES = 64
INNER = np.s_[10:-10, 10:-10]
Floats = NDArray[np.float64]


def scene(places: Floats, spread: float = math.pi) -> Floats:
    """Return a log intensity of waves of 6 to 30 px whose directions are within ``spread`` of the x axis."""
    rng = np.random.default_rng(1)
    total = np.zeros(places.shape[:-1])
    for _ in range(50):
        wave_number = math.tau / math.exp(rng.uniform(math.log(6.0), math.log(30.0)))
        direction = rng.uniform(-spread, spread)
        along = math.cos(direction) * places[..., 0] + math.sin(direction) * places[..., 1]
        total += 0.1 / wave_number * np.cos(wave_number * along + rng.uniform(0.0, math.tau))
    return total


def sums_of(
    path: Callable[[Floats, Floats], Floats],
    harmonics: int,
    locked: LockedAngles | None = None,
    spread: float = math.pi,
) -> PhaseSums:
    """Return the sums of the scene by their definition, over a period of a path."""
    places = phase.places_over_turn(path, WIDTH, HEIGHT, ANGLES)
    values = phase.sums_of_scene(scene(places, spread), harmonics).astype(np.complex64)
    events = np.ones((HEIGHT, WIDTH), np.int32)
    return PhaseSums(values, events, events, 1.0, 1.0, locked=locked)


def truth(spread: float = math.pi) -> Floats:
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    return scene(np.stack([x, y], axis=2).astype(np.float64), spread)


def correlation(a: NDArray[np.floating], b: NDArray[np.floating]) -> float:
    return float(np.corrcoef(a[INNER].ravel(), b[INNER].ravel())[0, 1])


def vibrated(values: dict[str, float]) -> Callable[[Floats, Floats], Floats]:
    """Return where a vibrating camera's pixels see the scene."""

    def path(pixels: Floats, angles: Floats) -> Floats:
        return optics.turned(CAMERA, optics.vibration(values, angles), pixels)

    return path


LINE = {"amplitude": 2.0 * PX, "phase": math.pi / 2, "backward_x": 0.0, "backward_y": 2.0 * PX}
"""Rotation about the y axis only, which moves the image along x by 4 px."""
LOOP = {
    "amplitude": 3.0 * PX,
    "phase": 0.4,
    "backward_x": 0.8 * PX,
    "second_x": 1.5 * PX,
    "second_y": -0.7 * PX,
}


def vibration(values: dict[str, float]) -> VibrationModel:
    return VibrationModel.from_values(CAMERA, Prism(0.0), values)


def test_a_path_of_several_harmonics_gives_the_scene_back() -> None:
    model = vibration(LOOP)
    assert not is_orbit(model)
    sums = sums_of(vibrated(LOOP), 8)
    found = phase_picture(sums, model, lag=0.0)
    assert correlation(found, truth()) > 0.997
    gain = (found[INNER] * truth()[INNER]).sum() / (truth()[INNER] ** 2).sum()
    assert 0.93 < gain < 1.03
    # A circle alone, or the second one backwards, is another motion.
    circle = {**LOOP, "second_x": 0.0, "second_y": 0.0}
    assert correlation(phase_picture(sums, vibration(circle), lag=0.0), truth()) < 0.99
    mirrored = {**LOOP, "second_y": 0.7 * PX}
    assert correlation(phase_picture(sums, vibration(mirrored), lag=0.0), truth()) < 0.99


def test_a_motion_along_a_line_shows_the_waves_along_it() -> None:
    model = vibration(LINE)
    found = phase_picture(sums_of(vibrated(LINE), 8, spread=1.0), model, lag=0.0)
    assert correlation(found, truth(1.0)) > 0.99
    # Of a scene of all waves, what changes along the line is right; nothing is known of what changes across it.
    image = phase_image(sums_of(vibrated(LINE), 8), model)
    rows, columns = np.gradient(truth())
    assert correlation(image.gradient[0], columns) > 0.97
    assert correlation(image.gradient[1], rows) < 0.92


MIRROR = {
    "amplitude": 1.5 * PX,
    "phase": 0.3,
    "second_amplitude": 1.2 * PX,
    "second_phase": -0.5,
    "direction": 0.1,
    "second_direction": math.pi / 2,
    "fold": 0.0,
    "incidence": math.radians(45.0),
    "ratio": 1.0,
}


def mirrored(turns: int, second: int, at_zero: float) -> Callable[[Floats, Floats], Floats]:
    def path(pixels: Floats, angles: Floats) -> Floats:
        both = np.stack([turns * angles, second * angles + at_zero], axis=1)
        return optics.in_mirror(CAMERA, MIRROR, pixels, both)

    return path


@pytest.mark.parametrize(("turns", "second"), [(1, -1), (1, 2), (2, 3)])
def test_a_mirror_whose_tilts_are_locked(turns: int, second: int) -> None:
    locked = LockedAngles(turns, second, 0.7)
    model = MirrorModel.from_values(CAMERA, Prism(0.0), MIRROR)
    harmonics = harmonics_for(model, locked)
    sums = sums_of(mirrored(turns, second, 0.7), harmonics, locked)
    assert correlation(phase_picture(sums, model, lag=0.0), truth()) > 0.985
    other = replace(sums, locked=LockedAngles(turns, second, 1.9))
    assert correlation(phase_picture(other, model, lag=0.0), truth()) < 0.95
    if turns > 1:
        assert harmonics > harmonics_for(model, LockedAngles(1, second, 0.7))


def test_a_pair_of_prisms_whose_turns_are_locked() -> None:
    pair = Prism(math.radians(2.0), second=Prism(math.radians(1.5)))
    model = RisleyModel(CAMERA, pair, 0.4, -0.8)

    def path(pixels: Floats, angles: Floats) -> Floats:
        both = np.stack([2.0 * angles, -3.0 * angles + 1.1], axis=1)
        return optics.through_pair(CAMERA, pair, (0.4, -0.8), pixels, both, to_scene=True)

    locked = LockedAngles(2, -3, 1.1)
    sums = sums_of(path, harmonics_for(model, locked), locked)
    assert correlation(phase_picture(sums, model, lag=0.0), truth()) > 0.995


def test_a_plate_moves_each_tile_by_its_depth() -> None:
    """A wall at 0.6 m on the left, and at 0.3 m on the right, some tiles apart."""
    camera = Camera.from_fov(320, 72, math.radians(70.0))
    plate = Plate(0.012, math.radians(45.0))
    depths = np.full((72, 320), 1.0 / 0.6, np.float32)
    depths[:, 160:] = 1.0 / 0.3

    def path(pixels: Floats, angles: Floats) -> Floats:
        inverse = depths[pixels[:, 1].astype(int), pixels[:, 0].astype(int)]
        return optics.at_depth(camera, plate, 0.5, pixels, angles, inverse.astype(np.float64))

    places = phase.places_over_turn(path, 320, 72, 32)
    values = phase.sums_of_scene(scene(places), 7).astype(np.complex64)
    events = np.ones((72, 320), np.int32)
    sums = PhaseSums(values, events, events, 1.0, 1.0)
    model = PlateModel(camera, plate, 0.5).with_depths(depths)
    y, x = np.mgrid[:72, :320]
    seen = scene(np.stack([x, y], axis=2).astype(np.float64))
    found = phase_picture(sums, model, lag=0.0)
    assert correlation(found[:, :88], seen[:, :88]) > 0.985
    assert correlation(found[:, 232:], seen[:, 232:]) > 0.93
    flat = PlateModel(camera, plate, 0.5, inverse_depth=1.0 / 0.6)
    wrong = phase_picture(sums, flat, lag=0.0)
    assert correlation(wrong[:, 232:], seen[:, 232:]) < 0.9


@pytest.mark.parametrize("degrees", [-8.0, 0.0, 12.0, 40.0])
def test_the_lag_of_events_is_found_and_undone(degrees: float) -> None:
    model = vibration(LOOP)
    sums = sums_of(vibrated(LOOP), 8)
    order = np.arange(1, 9)[:, None, None]
    turned = sums.values * np.exp(-1j * order * math.radians(degrees))
    late = replace(sums, values=turned.astype(np.complex64))
    image = phase_image(late, model)
    assert math.degrees(image.lag) == pytest.approx(degrees, abs=1.0)
    assert correlation(image.log, truth()) > 0.997
    assert phase_picture(late, model).tolist() == image.log.tolist()


def test_the_lag_is_searched_in_the_angle_of_the_first_turn() -> None:
    """Over two turns of the first angle, the angle of the sums goes half as fast."""
    locked = LockedAngles(2, 3, 0.7)
    model = MirrorModel.from_values(CAMERA, Prism(0.0), MIRROR)
    plan = path_plan_of(model, locked, 12)
    sums = sums_of(mirrored(2, 3, 0.7), 12, locked)
    order = np.arange(1, 13)[:, None, None]
    for degrees, expected in ((9.0, 9.0), (50.0, 36.0)):
        late = sums.values * np.exp(-1j * order * math.radians(degrees))
        found = lag_of_paths(replace(sums, values=late.astype(np.complex64)), plan)
        assert math.degrees(found) == pytest.approx(expected, abs=0.7)


def test_the_rest_is_what_the_scene_leaves() -> None:
    """Sums that a scene explains leave little; a wrong motion leaves much."""
    sums = sums_of(vibrated(LOOP), 8)
    right = phase_image(sums, vibration(LOOP))
    wrong = phase_image(sums, vibration({**LOOP, "phase": 1.6}))
    # One event each at a pixel are hardly any noise
    assert np.median(right.misfit[INNER]) < 0.1
    assert np.median(wrong.misfit[INNER]) > 0.3


def test_further_harmonics_decide_which_form_is_taken() -> None:
    circle = vibration({"amplitude": 3.0 * PX, "phase": 0.4})
    assert is_orbit(circle)
    assert not is_orbit(vibration(LINE))
    sums = sums_of(vibrated({"amplitude": 3.0 * PX, "phase": 0.4}), 8)
    closed = phase_picture(sums, circle, lag=0.0)
    plan = path_plan_of(circle, None, 8)
    scene_found = detail_of_paths(sums, plan, 0.0)
    sharp = scene_found - gaussian_filter(scene_found, 4.0)
    assert correlation(sharp, closed - gaussian_filter(closed, 4.0)) > 0.999


def test_what_moves_nothing_is_refused() -> None:
    sums = sums_of(vibrated(LINE), 8)
    with pytest.raises(AmiwarpError, match=r"vibration model moves the image by 0 px only"):
        phase_picture(sums, vibration({"amplitude": 0.0, "phase": 0.0}))
    far = PlateModel(CAMERA, Plate(0.01, math.radians(45.0)))
    with pytest.raises(AmiwarpError, match=r"plate model moves the image by 0 px"):
        phase_picture(sums, far)


def test_two_angles_need_to_be_locked() -> None:
    model = MirrorModel.from_values(CAMERA, Prism(0.0), MIRROR)
    with pytest.raises(AmiwarpError, match=r"mirror model has two angles.*PhaseReconstruction"):
        phase_picture(sums_of(vibrated(LINE), 8), model)


def encoders(ratio: float, *, ripple: float = 0.0) -> Encoder:
    t = np.arange(0, 400_001, 500)
    first = math.tau * 20.0 * 1e-6 * t
    second = ratio * first + 0.7 + ripple * np.sin(1.3 * first)
    return Encoder(t, first).with_second(Encoder(t, second))


def period_of(encoder: Encoder, values: dict[str, float] = MIRROR) -> MotionPeriod:
    model = MirrorModel.from_values(CAMERA, Prism(0.0), values)
    return MotionPeriod.of(model, encoder, 0, 400_000)


@pytest.mark.parametrize(
    ("ratio", "turns"), [(1.0, (1, 1)), (-1.0, (1, -1)), (1.5, (2, 3)), (-0.4, (5, -2))]
)
def test_the_period_of_two_angles_is_found(ratio: float, turns: tuple[int, int]) -> None:
    encoder = encoders(ratio)
    period = period_of(encoder)
    found = period.locked(100_000, 200_000)
    assert found == LockedAngles(*turns, pytest.approx(0.7))
    times = np.array([3_000, 250_000])
    expected = encoder.angle_at(times) / turns[0]
    np.testing.assert_allclose(period.encoder.angle_at(times), expected)
    assert period.encoder.second is None


def test_angles_that_do_not_repeat_are_refused() -> None:
    with pytest.raises(AmiwarpError, match=r"mirror turns 1\.37.*drive both in step.*solver"):
        period_of(encoders(1.3717))
    wavy = period_of(encoders(1.0, ripple=0.5))
    with pytest.raises(AmiwarpError, match=r"strays by \d+ deg from 1/1.*solver"):
        wavy.locked(0, 400_000)
    one = Encoder.constant_speed(1200.0, 0, 400_000)
    with pytest.raises(AmiwarpError, match="the encoder measures one"):
        period_of(one)


def test_a_mirror_that_tilts_about_one_axis_has_one_angle() -> None:
    one = Encoder.constant_speed(1200.0, 0, 400_000)
    period = period_of(one, {**MIRROR, "second_amplitude": 0.0})
    assert period.locked(0, 400_000) == LockedAngles(1, 0, 0.0)
    assert period.encoder.rpm == pytest.approx(1200.0)


def calibration(model: Model, values: dict[str, float]) -> Calibration:
    return Calibration(
        model_name=model.NAME,
        camera=CAMERA,
        prism=Prism(0.0),
        parameters=values,
        uncertainty={},
        free=(),
        sharpness_name="variance",
        sharpness_before=1.0,
        sharpness_after=2.0,
        stages=(),
        events=10,
        seconds=0.0,
    )


def test_a_recording_through_a_mirror_is_a_picture(texture: NDArray[np.uint8]) -> None:
    mirror = Mirror((20.0, 30.0), (1.5 * PX, 1.5 * PX), (0.0, 0.7))
    simulation = Simulation(Scene.from_picture(texture), CAMERA, mirror, 0.4, seed=2)
    recording = simulation.run()
    work = PhaseReconstruction(recording, calibration(simulation.moving_model, mirror.parameters()))
    assert work.turn_us == pytest.approx(100_000, rel=1e-3)
    start, length = work.span()
    assert length == pytest.approx(100_000, rel=1e-3)
    sums = work.sums(start, length)
    assert sums.locked is not None
    assert (sums.locked.turns, sums.locked.second_turns) == (2, 3)
    picture = work.window(start, length)
    seen = simulation.log_view()
    assert correlation(picture.log, seen) > 0.95
    with pytest.raises(AmiwarpError, match="whole turn"):
        work.window(start, 60_000)
