"""EventCamera: rays through every optic, events as by hand, numbers of pictures, resets, recordings, errors."""

import math
import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import warp as wp
from numpy.typing import NDArray

import amiwarp
from amiwarp import Camera, EventCamera, EventSensor, PrismMotion, Rays, Renderer, SensorModel

CAMERA = Camera.from_fov(24, 16, math.radians(50.0))
LENS = Camera.from_fov(24, 16, math.radians(50.0), amiwarp.RadialTangential(-0.1, 0.02))
PRISM = amiwarp.Prism(math.radians(3.0))
WINDOW = amiwarp.Plate(0.01, math.radians(40.0))
THETA = np.array([0.3, 2.0, -1.1])
BOTH = np.array([[0.3, 1.0], [2.0, -0.4], [-1.1, 2.5]])
SENSOR = SensorModel.ideal(0.1)


def optics(camera: Camera) -> dict[str, amiwarp.Model]:
    """Return a model of each optic that turns rays."""
    return {
        "exact": amiwarp.ExactModel.from_prism(camera, PRISM, 0.4),
        "tilted": amiwarp.ExactModel(camera, PRISM, 0.4, tilt=(0.02, -0.03), wobble=(0.01, 0.0)),
        "circle": amiwarp.CircleModel(camera, 0.02, 0.4),
        "radial": amiwarp.RadialCircleModel.from_prism(camera, PRISM, 0.4),
        "pair": amiwarp.RisleyModel.from_prism(camera, PRISM, 0.4),
        "mirror": amiwarp.MirrorModel(camera, 0.01, 0.2, 0.02, 0.1, ratio=1.3),
        "steerer": amiwarp.SteererModel(camera, 0.01, 0.2, 0.02, 0.1, ratio=1.3),
        "vibration": amiwarp.VibrationModel(camera, 0.01, 0.2, roll=(0.01, 0.02)),
    }


def rays_of(eyes: EventCamera, t_us: int = 0) -> tuple[NDArray[Any], NDArray[Any], Rays]:
    """Return origins and directions, axes bundle, row, column, sample and coordinate, and the rays."""
    rays = eyes.rays(t_us)
    values = np.asarray(rays.values.numpy(), np.float64)
    shape = (rays.bundles, -1, *values.shape[1:])
    origins, directions = np.moveaxis(values.reshape(shape), -2, 0)
    return origins, directions, rays


def grid(camera: Camera) -> NDArray[np.float64]:
    x, y = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    return np.stack([x.ravel(), y.ravel()], axis=1).astype(np.float64)


@pytest.mark.parametrize("camera", [CAMERA, LENS], ids=["pinhole", "lens"])
@pytest.mark.parametrize("name", optics(CAMERA))
def test_rays_go_where_compensation_moves_pixels(device: str, camera: Camera, name: str) -> None:
    optic = optics(camera)[name]
    start = THETA if optic.ANGLES == 1 else BOTH
    eyes = EventCamera(Renderer(3, device), camera, optic, start=start, rays_per_pixel=1)
    origins, directions, rays = rays_of(eyes)
    assert rays.bundles == 3
    assert not origins.any()
    np.testing.assert_allclose(np.linalg.norm(directions, axis=-1), 1.0, rtol=0, atol=1e-6)
    pixels = grid(camera)
    for k in range(3):
        theta = np.repeat(start[k : k + 1], len(pixels), axis=0)
        expected = optic.compensate_points(pixels, theta)
        found = camera.rays_to_pixels(directions[k].reshape(-1, 3))
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-3)  # px
        assert np.abs(found - pixels).max() > 0.05


def test_rays_behind_a_plate_start_where_it_shifts_them() -> None:
    depth = 0.5
    optic = amiwarp.PlateModel(CAMERA, WINDOW, 0.3, 1.0 / depth, wedge=(0.001, 0.002))
    eyes = EventCamera(Renderer(3, "cpu"), CAMERA, optic, start=THETA, rays_per_pixel=1)
    origins, directions, _ = rays_of(eyes)
    length = (depth - origins[..., 2]) / directions[..., 2]
    points = (origins + length[..., None] * directions).reshape(3, -1, 3)
    for k in range(3):
        expected = optic.compensate_points(grid(CAMERA), np.full(len(grid(CAMERA)), THETA[k]))
        found = CAMERA.rays_to_pixels(points[k])
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-3)  # px


def test_axes_of_the_renderer_change_signs() -> None:
    class UpsideDown(Renderer):
        AXES = (1, -1, -1)

    optic = amiwarp.PlateModel(CAMERA, WINDOW)
    plain = rays_of(EventCamera(Renderer(1, "cpu"), CAMERA, optic, start=1.0))
    turned = rays_of(EventCamera(UpsideDown(1, "cpu"), CAMERA, optic, start=1.0))
    for found, expected in zip(turned[:2], plain[:2], strict=True):
        np.testing.assert_array_equal(found, expected * [1, -1, -1])


def test_cameras_with_one_angle_share_their_rays() -> None:
    optic = optics(CAMERA)["exact"]
    shared = EventCamera(Renderer(3, "cpu"), CAMERA, optic, motion=PrismMotion(600.0))
    assert shared.rays(1000).bundles == 1
    motions = [PrismMotion(rpm) for rpm in (600.0, 700.0, 800.0)]
    own = EventCamera(Renderer(3, "cpu"), CAMERA, optic, motion=motions)
    assert own.rays(1000).bundles == 3
    np.testing.assert_allclose(own.angles(1000), np.array([0.02, 0.7 / 30, 0.8 / 30]) * math.pi)


@pytest.mark.parametrize("count", [1, 4, 9, 16, 25])
def test_rays_of_a_pixel_are_spread_evenly_over_it(count: int) -> None:
    eyes = EventCamera(Renderer(1, "cpu"), CAMERA, rays_per_pixel=count)
    _, directions, _ = rays_of(eyes)
    places = CAMERA.rays_to_pixels(directions.reshape(-1, 3)).reshape(-1, count, 2)
    places = places - grid(CAMERA)[:, None]
    np.testing.assert_allclose(places.mean(axis=1), 0.0, atol=1e-4)
    assert np.abs(places).max() < 0.5
    side = math.isqrt(count)
    columns = 4 if count == 4 else side  # rotated: each ray has its own column and row
    for axis in range(2):
        cells = np.floor((places[0, :, axis] + 0.5) * columns)
        assert np.bincount(cells.astype(int)).tolist() == [count // columns] * columns


@dataclass
class Stripes(Renderer):
    """Stripes at infinity, whose phase is the state; it computes on the host."""

    period: float = 0.2

    def __post_init__(self) -> None:
        super().__init__(2, "cpu")

    def between(self, before: float, after: float, fraction: float) -> float:
        return before + fraction * (after - before)

    def luminance(self, scene: float, rays: Rays) -> NDArray[np.float32]:
        parts = [rays.bundle(k).numpy()[..., 1, :] for k in range(self.cameras)]
        directions = np.stack(parts).astype(np.float64)
        across = directions[..., 0] / directions[..., 2]
        light = 0.5 + 0.4 * np.sin(across / self.period * math.tau + scene)
        return light.mean(axis=-1).astype(np.float32)


class Kept(Stripes):
    """Stripes that keep their pictures."""

    def __init__(self) -> None:
        self.period = 0.2
        self.__post_init__()
        self.drawn: list[NDArray[np.float32]] = []

    def luminance(self, scene: float, rays: Rays) -> NDArray[np.float32]:
        self.drawn.append(super().luminance(scene, rays))
        return self.drawn[-1]


def same(found: Any, expected: Any) -> None:
    for name in ("x", "y", "t", "p"):
        np.testing.assert_array_equal(getattr(found, name).numpy(), getattr(expected, name).numpy())


@pytest.mark.parametrize(
    "model",
    [SENSOR, SensorModel.preset("davis346"), SensorModel.preset("dvxplorer")],
    ids=["ideal", "davis346", "dvxplorer"],
)
@pytest.mark.parametrize("start", [0.0, [0.0, 2.0]], ids=["shared", "own"])
def test_events_are_those_of_a_sensor_fed_by_hand(model: SensorModel, start: Any) -> None:
    renderer = Kept()
    eyes = EventCamera(
        renderer,
        CAMERA,
        optics(CAMERA)["exact"],
        motion=PrismMotion(720.0),
        start=start,
        sensor=model,
        seed=[4, 9],
        pictures=3,
    )
    sensor = EventSensor(2, 16, 24, model, seed=[4, 9])
    eyes.step(0.0, 500)
    sensor.step(renderer.drawn[0], 500, "linear")
    for k, phase in enumerate((0.8, 1.9)):
        begin, end = 500 + 4001 * k, 500 + 4001 * (k + 1)
        found, windows = eyes.step(phase, end)
        by_camera: list[list[Any]] = [[], []]
        pictures = renderer.drawn[1 + 3 * k : 4 + 3 * k]
        times = [begin + 4001 * n // 3 for n in (1, 2)] + [end]
        for image, t in zip(pictures, times, strict=True):
            events, parts = sensor.step(image, t, "linear")
            for camera in range(2):
                chosen = slice(int(parts.start[camera]), int(parts.stop[camera]))
                by_camera[camera].append(events[chosen])
        assert eyes.pictures == 3
        assert windows.t_start.tolist() == [begin] * 2
        assert windows.t_end.tolist() == [end] * 2
        for camera in range(2):
            expected = amiwarp.DeviceEvents.concatenate(by_camera[camera])
            assert len(expected) > 50
            same(found[int(windows.start[camera]) : int(windows.stop[camera])], expected)
        assert int(windows.stop[-1]) == len(found)


def test_the_number_of_pictures_follows_the_optic() -> None:
    optic = amiwarp.CircleModel(CAMERA, 0.02)
    path = 0.02 * CAMERA.fx * 0.01 * math.tau * 12  # px in 10 ms, at the middle
    eyes = EventCamera(Stripes(), CAMERA, optic, motion=PrismMotion(720.0), sensor=SENSOR)
    eyes.step(0.0, 0)
    eyes.step(0.0, 10_000)
    # towards the corners, a rotation moves pixels of a flat image further
    assert path / 0.25 <= eyes.pictures <= 1.6 * path / 0.25 + 1
    backward = EventCamera(Stripes(), CAMERA, optic, motion=PrismMotion(-720.0), sensor=SENSOR)
    backward.step(0.0, 0)
    backward.step(0.0, 10_000)
    assert backward.pictures == eyes.pictures


@pytest.mark.parametrize("name", ["mirror", "pair"])
def test_both_angles_of_an_optic_count(name: str) -> None:
    optic = optics(CAMERA)[name]
    motion = PrismMotion(0.0, second=PrismMotion(2400.0))
    eyes = EventCamera(Stripes(), CAMERA, optic, motion=motion, sensor=SENSOR)
    eyes.step(0.0, 0)
    eyes.step(0.0, 10_000)
    assert eyes.pictures > 2


def test_a_given_number_that_is_too_small_is_named_once() -> None:
    optic = amiwarp.CircleModel(CAMERA, 0.05)
    motion = PrismMotion(1500.0)
    eyes = EventCamera(Stripes(), CAMERA, optic, motion=motion, sensor=SENSOR, pictures=1)
    eyes.step(0.0, 0)
    with pytest.warns(UserWarning, match="moves the image by .* px from one picture") as caught:
        eyes.step(0.0, 10_000)
    assert caught[0].filename == __file__
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        eyes.step(0.0, 20_000)


def test_too_many_pictures_are_not_drawn() -> None:
    optic = amiwarp.CircleModel(CAMERA, 0.1)
    eyes = EventCamera(Kept(), CAMERA, optic, motion=PrismMotion(30_000.0), sensor=SENSOR)
    eyes.step(0.0, 0)
    with pytest.warns(UserWarning, match="256 are drawn; step more often"):
        eyes.step(0.0, 60_000)
    assert eyes.pictures == 256


def test_a_reset_world_starts_from_its_new_state() -> None:
    """Its camera has no events in that step, and the other one the same as without the reset."""
    both = [EventCamera(Kept(), CAMERA, sensor=SENSOR, pictures=3) for _ in range(2)]
    for eyes in both:
        eyes.step(0.0, 0)
        eyes.step(1.0, 1000)
    both[0].reset(0)
    events, windows = both[0].step(3.0, 2000)
    plain, others = both[1].step(3.0, 2000)
    assert windows.start[0] == windows.stop[0]
    assert windows.t_start.tolist() == [2000, 1000]
    same(
        events[int(windows.start[1]) : int(windows.stop[1])],
        plain[int(others.start[1]) : int(others.stop[1])],
    )
    assert len(events) > 20
    _, windows = both[0].step(3.5, 3000)
    assert (windows.stop > windows.start).all()
    both[0].reset()
    assert len(both[0].step(0.0, 0)[0]) == 0


def test_a_recording_has_the_true_encoder_and_can_be_compensated(tmp_path: Any) -> None:
    optic = amiwarp.ExactModel(CAMERA, PRISM, 0.4, tilt=(0.01, -0.02))
    eyes = EventCamera(
        Stripes(), CAMERA, optic, motion=PrismMotion(720.0), start=[0.5, 1.5], sensor=SENSOR
    )
    steps = [eyes.step(0.0, 1000 + 5000 * k) for k in range(5)]
    poses = np.tile([0.0, 0, 0, 0, 0, 0, 1], (5, 1))
    recording = eyes.recording(steps, 1, prism=PRISM, poses=poses)
    amiwarp.save_recording(tmp_path / "camera.h5", recording)
    found = amiwarp.open_recording(tmp_path / "camera.h5")
    assert len(found.events) == sum(int(w.stop[1] - w.start[1]) for _, w in steps)
    assert found.encoder is not None
    assert found.prism == PRISM
    assert found.truth is not None
    expected = {
        "apex": PRISM.apex,
        "phase": 0.4,
        "tilt_x": 0.01,
        "tilt_y": -0.02,
        "index": PRISM.index,
    }
    assert expected.items() <= found.truth.parameters.items()
    assert found.truth.poses is not None
    assert len(found.truth.poses) == 5
    np.testing.assert_allclose(
        found.encoder.angle_at([1000, 21_000]), 1.5 + 0.024 * math.pi * np.array([1, 21]), atol=1e-6
    )


def test_a_recording_of_a_mirror_has_both_angles() -> None:
    optic = optics(CAMERA)["mirror"]
    eyes = EventCamera(
        Stripes(), CAMERA, optic, motion=PrismMotion(720.0), start=BOTH[:2], sensor=SENSOR
    )
    steps = [eyes.step(0.0, 5000 * k) for k in range(2)]
    recording = eyes.recording(steps, 1)
    assert recording.metadata["optic"] == "mirror"
    assert recording.encoder is not None
    turned = 0.024 * math.pi * 5
    expected = BOTH[1] + np.array([turned, 1.3 * turned])
    np.testing.assert_allclose(recording.encoder.angles_at([5000])[0], expected, atol=1e-6)


EXACT = optics(CAMERA)["exact"]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"optic": optics(LENS)["exact"]}, "make it for the event camera's"),
        ({"motion": PrismMotion()}, "motion without an optic"),
        ({"optic": EXACT, "motion": [PrismMotion()]}, "1 entries"),
        ({"optic": EXACT, "start": [0.0, 1.0, 2.0]}, "start has shape"),
        ({"optic": EXACT, "start": math.nan}, "start"),
        ({"rays_per_pixel": 5}, "choose among 1, 4, 9, 16, 25"),
        ({"pictures": 0}, "pictures"),
        ({"optic": amiwarp.EllipseModel.from_prism(CAMERA, PRISM)}, "give the model of the glass"),
    ],
)
def test_unusable_values_are_refused(options: dict[str, Any], words: str) -> None:
    with pytest.raises(amiwarp.AmiwarpError, match=words):
        EventCamera(Stripes(), CAMERA, **options)


def test_what_a_renderer_cannot_do_is_named() -> None:
    bare = Renderer(1, "cpu")
    with pytest.raises(amiwarp.AmiwarpError, match="has no method luminance"):
        EventCamera(bare, CAMERA).step(None, 0)
    with pytest.raises(amiwarp.AmiwarpError, match="give pictures=1"):
        bare.between(0, 1, 0.5)
    eyes = EventCamera(Stripes(), CAMERA, sensor=SENSOR)
    with pytest.raises(amiwarp.AmiwarpError, match="call step first"):
        eyes.surfaces()
    eyes.step(0.0, 0)
    for call in (eyes.surfaces, eyes.camera_poses, lambda: eyes.flow_to(0.0)):
        with pytest.raises(amiwarp.AmiwarpError, match="does not know"):
            call()
    with pytest.raises(amiwarp.AmiwarpError, match="give a later time"):
        eyes.step(0.0, 0)
    with pytest.raises(amiwarp.AmiwarpError, match="no steps"):
        eyes.recording([])


@dataclass
class Moving(Stripes):
    """A wall at 2 m before one camera, which moves along x by the state [m]; the wall is body 0 and turns about z."""

    turn: float = 0.0

    def __post_init__(self) -> None:
        Renderer.__init__(self, 1, "cpu")

    def cameras_at(self, scene: float) -> Any:
        return wp.array([[scene, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]], dtype=wp.transform, device="cpu")

    def bodies(self, scene: float) -> Any:
        half = 0.5 * self.turn * scene
        wall = [0.0, 0.0, 2.0, 0.0, 0.0, math.sin(half), math.cos(half)]
        return wp.array([wall], dtype=wp.transform, device="cpu")

    def surfaces(self, scene: float, rays: Rays) -> Any:
        directions = rays.values.numpy()[:, :, 0, 1]
        distance = (2.0 / directions[..., 2])[None].astype(np.float32)
        distance[:, 0] = 0.0  # the first row sees the sky
        body = np.zeros(distance.shape, np.int32)
        given = wp.array(body, dtype=int, device="cpu")
        return amiwarp.Surfaces(wp.array(distance, dtype=float, device="cpu"), given, given)


def test_flow_is_that_of_a_wall() -> None:
    eyes = EventCamera(Moving(), CAMERA, sensor=SENSOR)
    eyes.step(0.0, 0)
    flow = eyes.flow_to(0.1).numpy()[0]
    np.testing.assert_allclose(flow[1:, :, 0], -0.05 * CAMERA.fx, atol=1e-3)
    np.testing.assert_allclose(flow[1:, :, 1], 0.0, atol=1e-3)
    np.testing.assert_allclose(flow[0], 0.0, atol=1e-3)
    turning = EventCamera(Moving(turn=1.0), CAMERA, sensor=SENSOR)
    turning.step(0.0, 0)
    flow = turning.flow_to(0.1).numpy()[0]
    x, y = np.meshgrid(np.arange(24) - CAMERA.cx, np.arange(16) - CAMERA.cy)
    expected = math.cos(0.1) * x - math.sin(0.1) * y - 0.05 * CAMERA.fx - x
    np.testing.assert_allclose(flow[1:, :, 0], expected[1:], atol=2e-3)


def test_the_number_of_pictures_follows_the_scene() -> None:
    eyes = EventCamera(Moving(), CAMERA, sensor=SENSOR)
    eyes.step(0.0, 0)
    eyes.step(0.1, 10_000)
    assert eyes.pictures == math.ceil(0.05 * CAMERA.fx / 0.25)
    eyes.reset(0)
    eyes.step(5.0, 20_000)  # a jump
    assert eyes.pictures == 1
    eyes.step(5.1, 30_000)
    assert eyes.pictures > 1
