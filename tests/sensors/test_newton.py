"""NewtonEventCamera: what its rays see in a model of Newton, and what moves there. Skipped without Newton."""

import math
from typing import Any

import numpy as np
import pytest
import warp as wp

import amiwarp
from amiwarp import Camera, EventSensor, PrismMotion, SensorModel
from amiwarp.sensors import NewtonEventCamera

newton = pytest.importorskip("newton")
CAMERA = Camera.from_fov(32, 24, math.radians(60.0))
DOWN = (0.0, 0.0, 4.0, 0.0, 0.0, 0.0, 1.0)
"""A camera 4 m above the ground that looks down; x to the right, y of the world up in the image."""
SENSOR = SensorModel.ideal(0.2)


def one_world(colour: float) -> Any:
    """Return a builder of a world with a ball of a grey value on a body, and a box that rests."""
    world = newton.ModelBuilder()
    ball = world.add_body(
        xform=wp.transform((0.4, 0.3, 2.0), wp.quat_identity()), mass=1.0, label="ball"
    )
    world.add_shape_sphere(ball, radius=0.25, color=(colour,) * 3)
    rests = wp.transform((-0.5, -0.2, 1.0), wp.quat_identity())
    world.add_shape_box(-1, xform=rests, hx=0.3, hy=0.2, hz=0.1, color=(0.4, 0.5, 0.6))
    return world


def model_of(colours: tuple[float, ...], device: str) -> Any:
    builder = newton.ModelBuilder()
    for colour in colours:
        builder.add_world(one_world(colour))
    return builder.finalize(device=device)


def moved(model: Any, along: float) -> Any:
    """Return a state with all balls moved along x [m]."""
    state = model.state()
    places = state.body_q.numpy()
    places[:, 0] += along
    state.body_q.assign(places)
    return state


def test_a_body_is_where_the_camera_model_puts_it(device: str) -> None:
    model = model_of((0.9,), device)
    eyes = NewtonEventCamera(model, CAMERA, pose=DOWN, sensor=SENSOR)
    eyes.step(model.state(), 0)
    found = eyes.surfaces()
    number = found.shape.numpy()[0]
    labels = [number[y, x] for x, y in ((0, 0), (16, 12))]
    assert labels == [-1, -1]
    rows, columns = np.nonzero(number == 0)
    # 0.4 m to the right and 0.3 m up, 2 m away
    expected = [CAMERA.cx + CAMERA.fx * 0.2, CAMERA.cy - CAMERA.fy * 0.15]
    np.testing.assert_allclose([columns.mean(), rows.mean()], expected, atol=0.3)
    assert set(found.body.numpy()[0][number == 0].tolist()) == {0}
    assert set(found.body.numpy()[0][number == 1].tolist()) == {-1}
    nearest = found.distance.numpy()[0][number == 0].min()
    assert nearest == pytest.approx(math.sqrt(4.0 + 0.25) - 0.25, abs=0.02)
    # The camera's z points down, its y to the world's -y
    np.testing.assert_allclose(eyes.camera_poses()[0], [0, 0, 4, 1, 0, 0, 0], atol=1e-6)


def test_each_camera_sees_its_world_through_its_own_angle(device: str) -> None:
    model = model_of((0.9, 0.3), device)
    optic = amiwarp.ExactModel.from_prism(CAMERA, amiwarp.Prism(math.radians(6.0)))
    eyes = NewtonEventCamera(model, CAMERA, optic, pose=DOWN, start=[0.0, 2.0], sensor=SENSOR)
    for along in (0.2, 0.1, 0.0):  # again and again, as CUDA graphs are replayed
        eyes.reset()
        eyes.step(moved(model, along), 0)
        images = eyes.images.numpy()
        for world, start in enumerate((0.0, 2.0)):
            alone = NewtonEventCamera(
                model, CAMERA, optic, pose=DOWN, start=start, worlds=[world], sensor=SENSOR
            )
            alone.step(moved(model, along), 0)
            np.testing.assert_array_equal(alone.images.numpy()[0], images[world])
    shared = NewtonEventCamera(model, CAMERA, optic, pose=DOWN, start=2.0, sensor=SENSOR)
    shared.step(model.state(), 0)
    np.testing.assert_array_equal(shared.images.numpy()[1], images[1])
    # The ball is at what compensation takes its pixel to
    pixels = np.array([[x, y] for y in range(24) for x in range(32)], float)
    plain = NewtonEventCamera(model, CAMERA, pose=DOWN, sensor=SENSOR)
    plain.step(model.state(), 0)
    bright = plain.images.numpy()[0].mean(axis=-1).ravel() > 0.3
    through = images[0].mean(axis=-1).ravel() > 0.3
    there = optic.compensate_points(pixels[through], np.zeros(through.sum())).mean(axis=0)
    np.testing.assert_allclose(there, pixels[bright].mean(axis=0), atol=0.35)


@pytest.mark.filterwarnings("ignore:.* of the pixels change")
def test_events_are_those_of_a_sensor_fed_by_hand(device: str) -> None:
    model = model_of((0.9, 0.3), device)
    optic = amiwarp.ExactModel.from_prism(CAMERA, amiwarp.Prism(math.radians(3.0)))
    options = {"motion": PrismMotion(720.0), "start": [0.0, 1.0], "pose": DOWN}
    preset = SensorModel.preset("davis346")
    eyes = NewtonEventCamera(model, CAMERA, optic, sensor=preset, pictures=3, **options)
    by_hand = NewtonEventCamera(model, CAMERA, optic, sensor=preset, pictures=1, **options)
    sensor = EventSensor(2, 24, 32, preset, device=device)
    states = [moved(model, 0.02 * k / 3) for k in range(4)]
    eyes.step(states[0], 0)
    events, windows = eyes.step(states[3], 6000)
    found: list[Any] = []
    for k, state in enumerate(states):
        by_hand.step(state, 2000 * k)
        found.append(sensor.step(by_hand.images.numpy(), 2000 * k, "linear"))
    expected = by_hand.recording(found, 1).events[:]
    ours = events[int(windows.start[1]) : int(windows.stop[1])].to_host()
    assert len(expected) > 20
    # Places in between are rounded, so that single events may differ by a little
    assert abs(len(ours) - len(expected)) <= 2
    shorter = min(len(ours), len(expected)) // 2
    np.testing.assert_allclose(ours.t[:shorter], expected.t[:shorter], atol=50)


def test_a_camera_on_a_body_moves_with_it(device: str) -> None:
    model = model_of((0.9, 0.3), device)
    eyes = NewtonEventCamera(model, CAMERA, body="ball", pose=(0, 0, 2, 0, 0, 0, 1), sensor=SENSOR)
    eyes.step(model.state(), 0)
    first = eyes.camera_poses()
    np.testing.assert_allclose(first[:, :3], [[0.4, 0.3, 4.0]] * 2, atol=1e-6)
    events, _ = eyes.step(moved(model, 0.1), 10_000)
    np.testing.assert_allclose(eyes.camera_poses()[:, 0], 0.5, atol=1e-6)
    # The box passes by, 3 m away; the ball stays in the middle
    assert eyes.pictures >= 0.1 / 3.0 * CAMERA.fx / 0.25 - 1
    assert len(events) > 0
    flow = eyes.flow_to(moved(model, 0.2)).numpy()[0]
    number = eyes.surfaces().shape.numpy()[0]
    np.testing.assert_allclose(flow[number == 0], 0.0, atol=1e-3)
    box = flow[number == 1]
    assert len(box)
    assert np.median(box[:, 0]) == pytest.approx(-0.1 / 2.9 * CAMERA.fx, abs=1e-3)


def test_pictures_between_states_are_at_places_in_between(device: str) -> None:
    model = model_of((0.9,), device)
    eyes = NewtonEventCamera(model, CAMERA, pose=DOWN, sensor=SENSOR)
    renderer = eyes.renderer
    before, after = (renderer.snapshot(moved(model, along)) for along in (0.0, 0.4))
    half = renderer.between(before, after, 0.25)
    np.testing.assert_allclose(half.body_q.numpy()[0, :3], [0.5, 0.3, 2.0], atol=1e-6)
    turned = before.body_q.numpy().copy()
    turned[0, 3:] = [0.0, 0.0, -math.sin(0.5), -math.cos(0.5)]  # 1 rad, as the other quaternion
    after.body_q.assign(turned)
    half = renderer.between(before, after, 0.25)
    expected = [0.0, 0.0, math.sin(0.125), math.cos(0.125)]
    np.testing.assert_allclose(half.body_q.numpy()[0, 3:], expected, atol=1e-5)


WALL = 3.0
"""Distance of a wall [m]."""
HALF = 0.9
"""Tangent of the angle between its middle and its edge."""


def light_at(x: Any, y: Any) -> Any:
    """Return the luminance of the wall where rays of these tangents meet it: waves of 8 to 20 px."""
    tau = math.tau * CAMERA.fx
    waves = np.sin(tau * x / 9.0) + np.sin(tau * y / 8.0) + np.sin(tau * (x + y) / 17.0 + 1.0)
    return 0.5 + 0.11 * (waves + np.sin(tau * (x - 2.0 * y) / 20.0))


def wall(device: str) -> Any:
    """Return a model of the wall below the camera at the origin, textured by :func:`light_at`."""
    side = 1024
    places = ((np.arange(side) + 0.5) / side * 2.0 - 1.0) * HALF
    light = light_at(*np.meshgrid(places, places))
    curved = 1.055 * light ** (1.0 / 2.4) - 0.055
    picture = np.rint(255.0 * np.where(light < 0.0031308, 12.92 * light, curved)).astype(np.uint8)
    half = WALL * HALF
    corners = [[-half, -half, 0], [half, -half, 0], [half, half, 0], [-half, half, 0]]
    mesh = newton.Mesh(
        np.array(corners, np.float32),
        np.array([0, 1, 2, 0, 2, 3], np.int32),
        uvs=np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32),
        texture=np.repeat(picture[..., None], 3, axis=2),
        compute_inertia=False,
    )
    builder = newton.ModelBuilder()
    place = wp.transform((0.0, 0.0, -WALL), wp.quat_identity())
    builder.add_shape_mesh(-1, xform=place, mesh=mesh, color=(1.0, 1.0, 1.0))
    return builder.finalize(device=device)


@pytest.mark.parametrize("distorted", [False, True])
def test_a_prism_moves_a_textured_wall_as_its_model_says(device: str, distorted: bool) -> None:
    lens = amiwarp.RadialTangential(-0.1, 0.02) if distorted else None
    camera = Camera.from_fov(32, 24, math.radians(60.0), lens)
    optic = amiwarp.ExactModel(camera, amiwarp.Prism(math.radians(4.0)), 0.3, tilt=(0.02, -0.01))
    model = wall(device)
    eyes = NewtonEventCamera(model, camera, optic, start=2.0, sensor=SENSOR)
    eyes.renderer.sensor.set_ambient_light((1.0, 1.0, 1.0))
    eyes.renderer.sensor.create_default_light(color=(0.0, 0.0, 0.0))
    eyes.step(model.state(), 0)
    image = eyes.images.numpy()[0].mean(axis=-1)
    x, y = np.meshgrid(np.arange(32.0), np.arange(24.0))
    steps = (np.arange(6) + 0.5) / 6.0 - 0.5
    expected = np.zeros((5, 24, 32))
    moves = [(0.0, 0.0), (0.05, 0.0), (-0.05, 0.0), (0.0, 0.05), (0.0, -0.05)]
    for k, (right, down) in enumerate(moves):
        for u in steps:
            for v in steps:
                pixels = np.stack([(x + u).ravel(), (y + v).ravel()], axis=1)
                seen = optic.compensate_points(pixels, np.full(x.size, 2.0))
                seen += np.array([right, down])
                rays = camera.pixels_to_rays(seen)
                light = light_at(rays[:, 0] / rays[:, 2], rays[:, 1] / rays[:, 2])
                expected[k] += light.reshape(x.shape) / steps.size**2
    slopes = np.stack([(expected[1] - expected[2]).ravel(), (expected[3] - expected[4]).ravel()])
    shift, *_ = np.linalg.lstsq(10.0 * slopes.T, (image - expected[0]).ravel(), rcond=None)
    np.testing.assert_allclose(shift, 0.0, atol=0.01)  # px
    assert np.abs(image - expected[0]).max() < 0.03
    assert image.std() > 0.1


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"body": "wheel"}, "0 bodies of world 0 have the label 'wheel'; .* ball"),
        ({"body": 7}, "body"),
        ({"body": [0, 1], "worlds": [0]}, "give one each"),
        ({"worlds": 3}, "worlds"),
        ({"worlds": [2]}, "worlds"),
        ({"pose": (0, 0, 4)}, "pose has shape"),
        ({"pose": (0, 0, 4, 0, 0, 0, 0)}, "quaternion of pose"),
    ],
)
def test_unusable_values_are_refused(options: dict[str, Any], words: str) -> None:
    with pytest.raises(amiwarp.AmiwarpError, match=words):
        NewtonEventCamera(model_of((0.9, 0.3), "cpu"), CAMERA, **options)
