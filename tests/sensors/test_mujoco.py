"""MujocoWarpEventCamera: what is looked up in its larger views, and what moves. Skipped without MuJoCo Warp."""

import math
from typing import Any

import numpy as np
import pytest
import warp as wp

import amiwarp
from amiwarp import Camera, PrismMotion, Rays, SensorModel
from amiwarp.sensors import MujocoWarpEventCamera, look_up, wide_camera

mujoco = pytest.importorskip("mujoco")
mujoco_warp = pytest.importorskip("mujoco_warp")
CAMERA = Camera.from_fov(32, 24, math.radians(60.0))
PRISM = amiwarp.Prism(math.radians(6.0))
SENSOR = SensorModel.ideal(0.2)
SCENE = """<mujoco><option timestep="0.002"/>
<visual><headlight ambient="1 1 1" diffuse="0 0 0" specular="0 0 0"/></visual>
<worldbody><camera name="other" pos="5 5 5"/><camera name="eye" pos="0 0 4" fovy="33"/>
<body name="ball" pos=".4 .3 2"><freejoint/><geom type="sphere" size=".25" rgba=".9 .9 .9 1"/></body>
<geom type="box" pos="-.5 -.2 1" size=".3 .2 .1" rgba=".3 .3 .3 1"/></worldbody></mujoco>"""


def worlds(device: str, count: int = 2) -> tuple[Any, Any, Any]:
    """Return the model on the host and on the device, and the data of some worlds."""
    mjm = mujoco.MjModel.from_xml_string(SCENE)
    start = mujoco.MjData(mjm)
    mujoco.mj_forward(mjm, start)
    with wp.ScopedDevice(device):
        return mjm, mujoco_warp.put_model(mjm), mujoco_warp.put_data(mjm, start, nworld=count)


def move(data: Any, model: Any, along: float) -> None:
    """Move all balls along x to a place [m]."""
    places = data.qpos.numpy()
    places[:, 0] = along
    data.qpos.assign(places)
    with wp.ScopedDevice(str(data.qpos.device)):
        mujoco_warp.kinematics(model, data)
        mujoco_warp.camlight(model, data)


def ball_of(mjm: Any) -> int:
    """Return the number of the ball among the geometries."""
    return int(np.argmax([mjm.geom(k).type == mujoco.mjtGeom.mjGEOM_SPHERE for k in range(2)]))


def centre(image: np.ndarray) -> np.ndarray:
    """Return the centre of the bright ball in an image [px]."""
    rows, columns = np.nonzero(image > 0.6)
    return np.array([columns.mean(), rows.mean()])


def test_bodies_are_where_the_camera_model_puts_them(device: str) -> None:
    mjm, model, data = worlds(device)
    eyes = MujocoWarpEventCamera(mjm, model, data, "eye", CAMERA, sensor=SENSOR)
    assert mjm.camera("eye").fovy == 33.0
    eyes.step(data, 0)
    expected = np.array([CAMERA.cx + CAMERA.fx * 0.2, CAMERA.cy - CAMERA.fy * 0.15])
    images = eyes.images.numpy().mean(axis=-1)
    assert images[0].max() == pytest.approx(0.9, abs=0.02)
    np.testing.assert_allclose(centre(images[1]), expected, atol=0.3)
    found = eyes.surfaces()
    ball = ball_of(mjm)
    number = found.shape.numpy()
    rows, columns = np.nonzero(number[1] == ball)
    np.testing.assert_allclose([columns.mean(), rows.mean()], expected, atol=0.3)
    assert set(found.body.numpy()[1][number[1] == ball].tolist()) == {2 + ball}
    nearest = found.distance.numpy()[1][number[1] == ball].min()
    assert nearest == pytest.approx(math.sqrt(4.0 + 0.25) - 0.25, abs=0.02)
    np.testing.assert_allclose(eyes.camera_poses()[0], [0, 0, 4, 1, 0, 0, 0], atol=1e-6)


def test_the_optic_moves_the_view_as_compensation_says(device: str) -> None:
    mjm, model, data = worlds(device)
    optic = amiwarp.ExactModel.from_prism(CAMERA, PRISM)
    start = [0.0, 2.0]
    options: dict[str, Any] = {"sensor": SENSOR, "rays_per_pixel": 9}
    eyes = MujocoWarpEventCamera(mjm, model, data, "eye", CAMERA, optic, start=start, **options)
    plain = MujocoWarpEventCamera(mjm, model, data, "eye", CAMERA, **options)
    for camera in (eyes, plain):
        camera.step(data, 0)
    rest = centre(plain.images.numpy()[0].mean(axis=-1))
    for world, angle in enumerate(start):
        seen = centre(eyes.images.numpy()[world].mean(axis=-1))
        found = optic.compensate_points(seen[None], np.array([angle]))[0]
        np.testing.assert_allclose(found, rest, atol=0.3)
        assert np.linalg.norm(seen - rest) > 1.0


def test_light_is_finer_than_8_bits(device: str) -> None:
    mjm, model, data = worlds(device, 1)
    eyes = MujocoWarpEventCamera(mjm, model, data, "eye", CAMERA, sensor=SENSOR)
    eyes.step(data, 0)
    values = eyes.images.numpy() * 255.0
    assert np.abs(values - np.rint(values)).max() > 0.1


def test_what_moves_gives_events_and_pictures(device: str) -> None:
    mjm, model, data = worlds(device, 1)
    eyes = MujocoWarpEventCamera(mjm, model, data, "eye", CAMERA, sensor=SENSOR)
    eyes.step(data, 0)
    move(data, model, 0.5)
    flow = eyes.flow_to(data).numpy()[0]
    number = eyes.surfaces().shape.numpy()[0]
    assert np.median(flow[number == ball_of(mjm)][:, 0]) == pytest.approx(
        0.05 * CAMERA.fx, rel=0.15
    )
    events, _ = eyes.step(data, 10_000)
    assert 0.05 * CAMERA.fx / 0.25 <= eyes.pictures <= 0.07 * CAMERA.fx / 0.25
    assert len(events) > 10
    rest = len(eyes.step(data, 20_000)[0])
    assert (rest, eyes.pictures) == (0, 1)


def test_a_scene_at_rest_gives_events_through_the_prism_only(device: str) -> None:
    mjm, model, data = worlds(device, 1)
    optic = amiwarp.ExactModel.from_prism(CAMERA, PRISM)
    eyes = MujocoWarpEventCamera(
        mjm, model, data, "eye", CAMERA, optic, motion=PrismMotion(720.0), sensor=SENSOR
    )
    eyes.step(data, 0)
    events, _ = eyes.step(data, 10_000)
    assert len(events) > 20


@pytest.mark.parametrize("name", ["exact", "mirror"])
def test_the_larger_view_has_all_that_is_seen(name: str) -> None:
    optic = {
        "exact": amiwarp.ExactModel.from_prism(CAMERA, PRISM),
        "mirror": amiwarp.MirrorModel(CAMERA, 0.01, 0.2, 0.02, 0.1, ratio=1.3),
    }[name]
    wide = wide_camera(CAMERA, optic)
    corners = np.array([[-0.5, -0.5], [31.5, -0.5], [-0.5, 23.5], [31.5, 23.5]])
    for angle in np.linspace(0.0, math.tau, 40):
        moved = optic.compensate_points(corners, np.full(4, angle))
        x, y = wide.rays_to_pixels(CAMERA.pixels_to_rays(moved)).T
        assert (x > 0.0).all()
        assert (x < wide.width - 1).all()
        assert (y > 0.0).all()
        assert (y < wide.height - 1).all()
    assert wide.fx == 2.0 * CAMERA.fx
    assert wide.width < 2.6 * CAMERA.width


def test_rays_are_looked_up_bilinearly() -> None:
    wide = Camera(8, 6, 10.0, 10.0, 3.5, 2.5)
    x, y = np.meshgrid(np.arange(8.0), np.arange(6.0))
    values = np.stack([x, 10.0 * y, x + y], axis=-1)
    pictures = wp.array(np.stack([values, values + 1.0]), dtype=wp.vec3, device="cpu")
    places = np.array([[1.25, 2.5], [3.0, 4.75]])
    directions = wide.pixels_to_rays(places)
    bundle = np.zeros((1, 1, 2, 2, 3), np.float32)
    bundle[0, 0, :, 1] = directions * [1, -1, -1]
    rays = Rays(wp.array(bundle, dtype=wp.vec3, device="cpu"), 1)
    found = look_up(pictures, wide, rays, (1, -1, -1), 0.5).numpy()
    mean = places.mean(axis=0)
    expected = 0.5 * np.array([mean[0], 10.0 * mean[1], mean.sum()])
    np.testing.assert_allclose(found[:, 0, 0], [expected, expected + 0.5], atol=1e-4)


def test_what_cannot_be_drawn_is_refused() -> None:
    mjm, model, data = worlds("cpu", 1)
    with pytest.raises(amiwarp.AmiwarpError, match="no camera 'ear'; its cameras are other, eye"):
        MujocoWarpEventCamera(mjm, model, data, "ear", CAMERA)
    plate = amiwarp.PlateModel(CAMERA, amiwarp.Plate(0.01, 0.7))
    with pytest.raises(amiwarp.AmiwarpError, match="use Newton for plates"):
        MujocoWarpEventCamera(mjm, model, data, "eye", CAMERA, plate)
    with pytest.raises(amiwarp.AmiwarpError, match="further than 76 deg"):
        wide_camera(Camera.from_fov(32, 24, math.radians(160.0)), None)
