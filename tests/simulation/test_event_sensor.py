"""EventSensor: the same events as `simulate`, analytic answers, resets, and images that are refused."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import warp as wp
from numpy.typing import NDArray

from amiwarp import (
    AmiwarpError,
    Camera,
    DeviceEvents,
    Events,
    EventSensor,
    Prism,
    Scene,
    SensorModel,
    Simulation,
    Windows,
    event_count,
    voxel_grid,
)
from amiwarp.simulation.engine import Engine

CAMERA = Camera.from_fov(40, 30, math.radians(50.0))
NOISY = SensorModel(shot_noise_hz=30.0, leak_hz=20.0, hot_fraction=0.02, noise_rate_cov_decades=0.2)
EVERYTHING = replace(
    NOISY, cutoff_hz=300.0, buffer_hz=700.0, shot_noise_dark=4.0, leak_jitter_fraction=0.3
)
MODELS = {
    "default": SensorModel(),
    "noisy": NOISY,
    "filtered": EVERYTHING,
    "rows": replace(EVERYTHING, row_us=30.0, contrast_on=0.1),
    "bus": replace(NOISY, bus_rate_mev_s=0.2, bus_queue=50.0),
    "rows and bus": replace(EVERYTHING, row_us=30.0, bus_rate_mev_s=0.2, bus_queue=50.0),
}


class Watched(Engine):
    """A simulation in chunks of one time step, which keeps the log intensities that its pixels see."""

    def __init__(self, simulation: Simulation, step: int) -> None:
        super().__init__(simulation, step)
        assert self._step == step
        self.images: list[NDArray[np.float32]] = []

    def look(self) -> None:
        size = (self._simulation.camera.height, self._simulation.camera.width)
        levels = (
            self._state[1].numpy()["seen"] if self._filters else self._state[0].numpy()["level"]
        )
        self.images.append(np.array(levels, np.float32).reshape(size))

    def _start_pixels(self, steps: Any) -> None:
        super()._start_pixels(steps)
        self.look()


def simulated(
    model: SensorModel, seed: int, device: str, steps: int = 60
) -> tuple[int, list[NDArray[np.float32]], Events]:
    """Return step [us], images and events of a simulation."""
    light = np.random.default_rng(seed).uniform(0.05, 1.0, (24, 32))
    scene = Scene.from_picture(np.kron(light, np.ones((4, 4))).astype(np.float32))
    simulation = Simulation(
        scene, CAMERA, Prism(math.radians(3.0)), 1.0, sensor=model, seed=seed, device=device
    )
    step = Engine(simulation)._step
    engine = Watched(replace(simulation, duration_s=steps * step * 1e-6), step)
    blocks = []
    for block in engine.run():
        blocks.append(block.events())
        engine.look()
    return step, engine.images, Events.concatenate(blocks)


def of_camera(parts: list[tuple[DeviceEvents, Windows]], camera: int) -> Events:
    """Return the events of one camera in all steps."""
    return Events.concatenate(
        [
            events.to_host()[int(found.start[camera]) : int(found.stop[camera])]
            for events, found in parts
        ]
    )


def host(values: Any) -> NDArray[Any]:
    return np.asarray(values.numpy())


def same(a: Events, b: Events) -> None:
    for name in ("x", "y", "t", "p"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


@pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)
def test_each_camera_gives_the_events_of_a_simulation(device: str, model: SensorModel) -> None:
    seeds = [3, 11, 4]
    made = [simulated(model, seed, device) for seed in seeds]
    step = made[0][0]
    assert all(other == step for other, _, _ in made)
    sensor = EventSensor(3, 30, 40, model, seed=seeds, device=device)
    parts = [
        sensor.step(np.stack(images), k * step)
        for k, images in enumerate(zip(*(m[1] for m in made), strict=True))
    ]
    end = step * (len(parts) - 1)
    for camera, (_, _, expected) in enumerate(made):
        found = of_camera(parts, camera)
        assert len(expected) > 1000
        # A bus may transmit after the end
        same(found[: int(np.searchsorted(found.t, end))], expected)


def test_a_ramp_crosses_thresholds_at_analytic_times_for_any_steps(device: str) -> None:
    slopes = np.linspace(-3.0, 3.0, 12).reshape(2, 2, 3)  # log intensity per 10 ms
    sensor = EventSensor(2, 2, 3, SensorModel.ideal(0.25), device=device)
    times = [5, 105, 1005, 4005, 9505, 10005]
    parts = [sensor.step((slopes * (t - 5) / 1e4 - 1.0).astype(np.float32), t) for t in times]
    for camera in range(2):
        events = of_camera(parts, camera)
        assert (np.diff(events.t) >= 0).all()
        for row, column in np.ndindex(2, 3):
            slope = slopes[camera, row, column]
            expected = 5 + np.arange(1, int(abs(slope) / 0.25 - 1e-6) + 1) * 0.25 / abs(slope) * 1e4
            found = events.t[(events.x == column) & (events.y == row)]
            np.testing.assert_allclose(found, expected, rtol=0, atol=1.0)  # us
            assert set(events.p[(events.x == column) & (events.y == row)].tolist()) <= {
                int(slope > 0)
            }


@pytest.mark.parametrize(
    "model",
    [
        replace(SensorModel.ideal(), leak_hz=30.0, leak_jitter_fraction=0.3),
        replace(
            SensorModel.ideal(),
            leak_hz=30.0,
            leak_jitter_fraction=0.3,
            refractory_us=5000.0,
            cutoff_hz=300.0,
        ),
        replace(
            NOISY, leak_hz=30.0, leak_jitter_fraction=0.3, latency_us=0.0, latency_jitter_us=0.0
        ),
    ],
    ids=["leak", "refractory", "noise"],
)
def test_leak_events_are_the_same_for_any_steps(device: str, model: SensorModel) -> None:
    """In a step of a second, each pixel draws its leak anew at each of its 30 events, as in a hundred steps."""
    image = np.full((1, 24, 32), -1.0, np.float32)
    made = []
    for count in (1, 7, 100):
        sensor = EventSensor(1, 24, 32, model, seed=3, device=device)
        times = np.linspace(0, 1_000_000, count + 1).astype(int)
        events = of_camera([sensor.step(image, int(t)) for t in times], 0)
        made.append(events[np.lexsort((events.t, events.x, events.y))])
    for found in made[:2]:
        assert len(found) == pytest.approx(len(made[2]), rel=2e-3)
    by_pixel = [np.bincount(e.y.astype(int) * 32 + e.x, minlength=768) for e in made]
    assert by_pixel[2].mean() > 20.0
    for events, counts in zip(made[:2], by_pixel[:2], strict=True):
        # An event at the end may be just before or after it
        assert np.abs(counts - by_pixel[2]).max() <= 1
        same_count = counts == by_pixel[2]
        assert same_count.mean() > 0.98
        one, other = (e.t[same_count[e.y.astype(int) * 32 + e.x]] for e in (events, made[2]))
        # Us; float32 resolves 0.1 us of a step of a second
        np.testing.assert_allclose(one, other, rtol=0, atol=20.0)


def textures(steps: int, cameras: int = 3) -> NDArray[np.float32]:
    return np.random.default_rng(0).uniform(-2.0, 0.0, (steps, cameras, 8, 10)).astype(np.float32)


@pytest.mark.parametrize(
    "model", [SensorModel(), MODELS["rows and bus"]], ids=["default", "rows and bus"]
)
def test_the_order_of_cameras_and_the_room_do_not_matter(
    device: str, model: SensorModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    images = textures(6)
    sensor = EventSensor(3, 8, 10, model, seed=[5, 6, 7], device=device)
    parts = [sensor.step(batch, 1500 * k) for k, batch in enumerate(images)]
    # Runs out of room and starts over
    monkeypatch.setattr("amiwarp.simulation.event_sensor.EVENTS_PER_PIXEL", 1)
    turned = EventSensor(3, 8, 10, model, seed=[7, 5, 6], device=device)
    others = [turned.step(batch[[2, 0, 1]], 1500 * k) for k, batch in enumerate(images)]
    for camera, place in ((0, 1), (1, 2), (2, 0)):
        assert len(of_camera(parts, camera)) > 100
        same(of_camera(parts, camera), of_camera(others, place))


def test_numbers_of_cameras_and_pixels_need_not_be_powers_of_two(
    device: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As in 520 cameras of 130 x 130 px, rounding both up leaves no bit of a key for the time."""
    images = np.random.default_rng(0).uniform(-2.0, 0.0, (4, 5, 3, 3)).astype(np.float32)
    alone = EventSensor(1, 3, 3, NOISY, seed=4, device=device)
    expected = [alone.step(batch[4:], 1500 * k) for k, batch in enumerate(images)]
    monkeypatch.setattr("amiwarp.simulation.event_sensor.LATEST_US", 1 << (61 - 20 - 3 - 4))
    sensor = EventSensor(5, 3, 3, NOISY, device=device)
    same(
        of_camera([sensor.step(batch, 1500 * k) for k, batch in enumerate(images)], 4),
        of_camera(expected, 0),
    )


def test_one_seed_gives_successive_seeds(device: str) -> None:
    found = []
    for seed in (5, [5, 6, 7]):
        sensor = EventSensor(3, 8, 10, NOISY, seed=seed, device=device)
        found.append([sensor.step(batch, 1500 * k) for k, batch in enumerate(textures(4))])
    for camera in range(3):
        same(of_camera(found[0], camera), of_camera(found[1], camera))


def test_a_reset_camera_starts_anew_and_the_others_go_on(device: str) -> None:
    images = textures(9)
    plain, mixed = (EventSensor(3, 8, 10, EVERYTHING, seed=2, device=device) for _ in range(2))
    expected = [plain.step(batch, 1500 * k) for k, batch in enumerate(images)]
    found = []
    for k, batch in enumerate(images):
        if k == 4:
            mixed.reset([1])
        found.append(mixed.step(batch, 1500 * k))
    for camera in (0, 2):
        same(of_camera(found, camera), of_camera(expected, camera))
    assert found[4][1].start[1] == found[4][1].stop[1]  # it drops what was not read out
    assert found[4][1].t_start.tolist() == [4500, 6000, 4500]
    alone = EventSensor(1, 8, 10, EVERYTHING, seed=3, device=device)
    anew = [alone.step(batch[1:2], 1500 * k) for k, batch in enumerate(images[4:], 4)]
    assert len(of_camera(anew, 0)) > 100
    same(of_camera(found[4:], 1), of_camera(anew, 0))


@pytest.mark.parametrize("which", [None, [True, True, True], [2, 0, 1]])
def test_a_reset_of_all_cameras_starts_the_time_anew(device: str, which: Any) -> None:
    images = textures(4)
    sensor = EventSensor(3, 8, 10, MODELS["rows and bus"], device=device)
    first = [sensor.step(batch, 1500 * k) for k, batch in enumerate(images)]
    sensor.reset(which)
    second = [sensor.step(batch, 1500 * k) for k, batch in enumerate(images)]
    for camera in range(3):
        same(of_camera(first, camera), of_camera(second, camera))


def test_still_images_give_no_events(device: str) -> None:
    sensor = EventSensor(2, 3, 4, SensorModel.ideal(), device=device)
    still = np.full((2, 3, 4), -0.5, np.float32)
    for t in (0, 1000, 2000):
        events, found = sensor.step(still, t)
        assert len(events) == 0
        assert found.stop.tolist() == [0, 0]
        assert not host(voxel_grid(events, 4, 3, bins=2, windows=found)).any()
    events, found = sensor.step(
        still + np.float32(0.6) * (np.arange(2) == 1)[:, None, None].astype(np.float32), 3000
    )
    assert host(event_count(events, 4, 3, windows=found)).sum(axis=(1, 2)).tolist() == [0, 24]


def test_the_image_of_one_camera_can_be_given_with_an_axis_in_front(device: str) -> None:
    sensor = EventSensor(1, 3, 4, SensorModel.ideal(), device=device)
    still = np.full((3, 4), -0.5, np.float32)
    sensor.step(still[None], 0)  # NumPy gives the new axis a stride of 0
    events, _ = sensor.step((still + np.float32(0.6))[None], 1000)
    assert len(events) == 24


def test_images_of_warp_stay_as_they_are_and_events_on_their_device(device: str) -> None:
    images = textures(2)
    sensor, other = (EventSensor(3, 8, 10, device=device) for _ in range(2))
    for k in range(2):
        given = wp.array(images[k], device=device)
        events, _ = sensor.step(given, 1500 * k)
        expected, _ = other.step(images[k], 1500 * k)
        np.testing.assert_array_equal(given.numpy(), images[k])
        same(events.to_host(), expected.to_host())
    assert len(events) > 100
    assert str(events.device) == device


def test_images_of_any_strides_are_taken(device: str) -> None:
    images = textures(2, cameras=1)
    padded = np.zeros((4, 8, 20), np.float32)
    sensor = EventSensor(1, 8, 10, device=device)
    expected = [sensor.step(images[k], 1500 * k) for k in range(2)]
    assert len(expected[1][0]) > 30

    def views(image: NDArray[np.float32]) -> dict[str, NDArray[np.float32]]:
        padded[::4, :, ::2] = image
        return {
            "one image": image,
            "with an axis": image[None],
            "every fourth camera": padded[::4, :, ::2],
            "by columns": np.asfortranarray(image),
            "backwards": np.ascontiguousarray(image[::-1])[::-1],
        }

    for name in views(images[0, 0]):
        sensor = EventSensor(1, 8, 10, device=device)
        found = [sensor.step(views(images[k, 0])[name], 1500 * k) for k in range(2)]
        same(of_camera(found, 0), of_camera(expected, 0))


@pytest.mark.parametrize(
    ("images", "t_us", "message"),
    [
        (np.zeros((3, 8, 10), np.uint8), 10, "images are uint8.*give encoding='srgb8'"),
        (np.zeros((8, 10), np.float32), 10, r"shape \(8, 10\); expected .* of shape \(3, 8, 10\)"),
        (np.full((3, 8, 10), np.nan, np.float32), 10, "camera 0 has log intensity nan at row 0, column 0"),
        (np.where(np.arange(240).reshape(3, 8, 10) == 95, -np.inf, 0).astype(np.float32), 10,
         "camera 1 has log intensity -inf at row 1, column 5.*take the log of luminance"),
        (np.zeros((3, 8, 10), np.float32), 1, "t_us is 1 after 1 us"),
        (np.zeros((3, 8, 10), np.float32), 1 << 40, "give a later time, images in between, or fewer cameras"),
        (np.zeros((3, 8, 10), np.float32), 2.5, "t_us"),
        ("images", 10, "images"),
    ],
)  # fmt: skip
def test_bad_images_are_refused_and_change_nothing(
    device: str, images: Any, t_us: Any, message: str
) -> None:
    batches = textures(3)
    sensor, other = (EventSensor(3, 8, 10, device=device) for _ in range(2))
    expected = [other.step(batch, t) for batch, t in zip(batches, (0, 1, 1500), strict=True)]
    found = [sensor.step(batch, t) for batch, t in zip(batches[:2], (0, 1), strict=True)]
    with pytest.raises(AmiwarpError, match=message):
        sensor.step(images, t_us)
    found.append(sensor.step(batches[2], 1500))
    for camera in range(3):
        same(of_camera(found, camera), of_camera(expected, camera))


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"cameras": 0}, "cameras = 0"),
        ({"seed": [1, 2]}, r"seed has shape \(2,\)"),
        ({"seed": [1, 2, -1]}, "one for each of 3 cameras"),
        ({"seed": -1}, "seed = -1"),
        ({"height": 4000, "width": 40_000}, "480000000 pixels; the limit is 16777216; give fewer cameras"),
        ({"cameras": 520, "height": 130, "width": 130, "model": SensorModel(row_us=1.0)},
         "with row_us count as 33554432 pixels; the limit is 16777216"),
        ({"model": SensorModel(row_us=5000.0)}, "give a smaller row_us"),
        ({"model": "gen4"}, "model"),
    ],
)  # fmt: skip
def test_bad_values_are_refused(values: dict[str, Any], message: str) -> None:
    with pytest.raises(AmiwarpError, match=message):
        EventSensor(**{"cameras": 3, "height": 8, "width": 10, **values})


@pytest.mark.parametrize("which", [[3], [-1], [True, False], [0.5]])
def test_a_reset_of_no_camera_is_refused(which: Any) -> None:
    with pytest.raises(AmiwarpError, match="which"):
        EventSensor(3, 8, 10).reset(which)


def test_tensors_of_pytorch_go_in_and_come_out(device: str) -> None:
    torch = pytest.importorskip("torch")
    images = textures(2)
    sensor, other = (EventSensor(3, 8, 10, device=device) for _ in range(2))
    for k in range(2):
        events, found = sensor.step(torch.from_numpy(images[k]).to(device), 1500 * k)
        expected, _ = other.step(images[k], 1500 * k)
    same(events.to_host(), expected.to_host())
    grid = torch.from_dlpack(voxel_grid(events, 10, 8, bins=2, windows=found))
    assert grid.shape == (3, 2, 8, 10)
    assert float(grid.abs().sum()) > 0.0
