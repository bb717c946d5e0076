"""Environments of Gymnasium with events: its own checks, resets and representations. Skipped without Gymnasium."""

from typing import Any

import numpy as np
import pytest

import amiwarp
from amiwarp import Camera, EventCamera, Rays, Renderer, SensorModel

gymnasium = pytest.importorskip("gymnasium")
from gymnasium.utils.env_checker import check_env  # noqa: E402

pytestmark = pytest.mark.filterwarnings("ignore:.*is different from the unwrapped version")
CAMERA = Camera.from_fov(12, 8, 1.0)
STEP_US = 2000


class Wave(Renderer):
    """A wave whose phase is the state of each environment, shape (cameras,)."""

    def between(self, before: Any, after: Any, fraction: float) -> Any:
        return before + fraction * (after - before)

    def luminance(self, scene: Any, rays: Rays) -> Any:
        x = np.arange(12) * 0.5
        light = 0.5 + 0.4 * np.sin(x + np.asarray(scene)[:, None, None])
        return np.broadcast_to(light, (self.cameras, 8, 12)).astype(np.float32)


def camera(count: int) -> EventCamera:
    return EventCamera(Wave(count, "cpu"), CAMERA, sensor=SensorModel(contrast_on=0.1), pictures=4)


class Turning(gymnasium.Env):  # type: ignore[misc]
    """An angle that the action turns; an episode has five steps."""

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012  # as Gymnasium has it
    render_mode = None
    action_space = gymnasium.spaces.Discrete(2)
    observation_space = gymnasium.spaces.Box(-10.0, 10.0, (1,), np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.angle = float(self.np_random.uniform(0.0, 0.5))
        self.count = 0
        return np.array([self.angle], np.float32), {}

    def step(self, action: int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.angle += 0.8 if action else 0.0
        self.count += 1
        return np.array([self.angle], np.float32), 0.0, self.count >= 5, False, {}


def state_of(env: Any) -> Any:
    return np.array([env.angle])


def states_of(envs: Any) -> Any:
    return np.array([env.unwrapped.angle for env in envs.envs])


def wrapped(**options: Any) -> Any:
    return amiwarp.sensors.EventObservation(Turning(), camera(1), state_of, STEP_US, **options)


@pytest.mark.parametrize(
    ("options", "shape", "dtype"),
    [
        ({}, (5, 8, 12), np.float32),
        ({"bins": 3}, (3, 8, 12), np.float32),
        ({"representation": "event_count"}, (8, 12), np.int32),
        ({"representation": "polarity_histogram"}, (2, 8, 12), np.int32),
        ({"representation": "stacked_histogram", "bins": 4}, (8, 8, 12), np.uint8),
        ({"representation": "time_surface"}, (2, 8, 12), np.float32),
    ],
)
def test_gymnasium_s_own_check_passes(options: Any, shape: Any, dtype: Any) -> None:
    env = wrapped(**options)
    assert env.observation_space.shape[-2:] == shape[-2:]
    assert np.prod(env.observation_space.shape) == np.prod(shape)
    assert env.observation_space.dtype == dtype
    check_env(env, skip_render_check=True)


def test_the_check_passes_with_the_own_observation() -> None:
    env = wrapped(keep=True)
    check_env(env, skip_render_check=True)
    observation, _ = env.reset(seed=0)
    assert set(observation) == {"events", "own"}
    assert not observation["events"].any()


def test_observations_are_tensors_of_the_camera_s_events() -> None:
    env = wrapped(bins=3)
    env.reset(seed=4)
    eyes = camera(1)
    eyes.step(state_of(env.unwrapped), 0)
    for k, action in enumerate((1, 0, 1), 1):
        found = env.step(action)[0]
        events, windows = eyes.step(state_of(env.unwrapped), k * STEP_US)
        expected = amiwarp.voxel_grid(events, 12, 8, bins=3, windows=windows).numpy()[0]
        np.testing.assert_array_equal(found, expected)
        assert expected.any() == bool(len(events))
    assert found.any()


def vector(mode: Any) -> Any:
    envs = gymnasium.vector.SyncVectorEnv([Turning, Turning], autoreset_mode=mode)
    return amiwarp.sensors.EventVectorObservation(
        envs, camera(2), states_of, STEP_US, representation="event_count"
    )


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_cameras_of_environments_that_reset_themselves_start_anew(mode: str) -> None:
    envs = vector(gymnasium.vector.AutoresetMode(mode))
    envs.reset(seed=[1, 2])
    envs.env.envs[0].count = 2  # the first environment ends after three steps
    seen = [envs.step(np.array([1, 1])) for _ in range(5)]
    counts = np.array([observation.sum(axis=(1, 2)) for observation, *_ in seen])
    assert (counts[:, 1] > 0).tolist() == [True] * 4 + [mode == "NextStep"]
    reset_in = 3 if mode == "NextStep" else 2
    assert (counts[:, 0] > 0).tolist() == [k != reset_in for k in range(5)]
    assert [bool(done[0]) for _, _, done, _, _ in seen] == [k == 2 for k in range(5)]


def test_some_environments_are_reset_by_a_mask() -> None:
    envs = vector(gymnasium.vector.AutoresetMode.DISABLED)
    envs.reset(seed=[1, 2])
    envs.step(np.array([1, 1]))
    found, _ = envs.reset(options={"reset_mask": np.array([True, False])})
    assert found.shape == (2, 8, 12)
    assert not found[0].any()
    assert envs._observer._t_us == STEP_US + 1
    after = envs.step(np.array([1, 1]))[0]
    assert after[0].any()
    assert after[1].any()


def test_observations_may_be_converted_on_the_device() -> None:
    torch = pytest.importorskip("torch")
    envs = gymnasium.vector.SyncVectorEnv([Turning, Turning])
    wrapped = amiwarp.sensors.EventVectorObservation(
        envs, camera(2), states_of, STEP_US, convert=torch.from_dlpack
    )
    observation, _ = wrapped.reset(seed=1)
    assert isinstance(observation, torch.Tensor)
    assert observation.shape == wrapped.observation_space.shape == (2, 5, 8, 12)


def test_unusable_values_are_refused() -> None:
    for given, words in (
        ({"representation": "frames"}, "representation"),
        ({"eyes": camera(2)}, "use EventVectorObservation"),
        ({"state": None}, "state is no function"),
        ({"step_us": 0}, "step_us"),
    ):
        values: dict[str, Any] = {"eyes": camera(1), "state": state_of, "step_us": STEP_US, **given}
        with pytest.raises(amiwarp.AmiwarpError, match=words):
            amiwarp.sensors.EventObservation(Turning(), **values)
    envs = gymnasium.vector.SyncVectorEnv([Turning, Turning])
    with pytest.raises(amiwarp.AmiwarpError, match="3 cameras for 2 environments"):
        amiwarp.sensors.EventVectorObservation(envs, camera(3), states_of, STEP_US)
