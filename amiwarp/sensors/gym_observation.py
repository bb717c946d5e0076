"""Environments of Gymnasium that observe the events of event cameras, as tensors for networks."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.device_events import DeviceEvents
from amiwarp.imaging.tensors import (
    event_count,
    polarity_histogram,
    stacked_histogram,
    time_surface,
    voxel_grid,
)
from amiwarp.imaging.windows import Windows
from amiwarp.sensors.event_camera import EventCamera
from amiwarp.sensors.versions import simulator
from amiwarp.validation import TIME_LIMIT, instance, one_of, whole

gymnasium = simulator("gymnasium")

REPRESENTATIONS: dict[str, Callable[..., Any]] = {
    "event_count": event_count,
    "polarity_histogram": polarity_histogram,
    "voxel_grid": partial(voxel_grid, bins=5),
    "stacked_histogram": partial(stacked_histogram, bins=10),
    "time_surface": partial(time_surface, tau_us=10_000.0),
}
"""Functions that make a tensor of events, by name."""


class _Observer:
    """Steps cameras, and makes tensors of their events."""

    def __init__(
        self,
        eyes: EventCamera,
        state: Callable[[Any], Any],
        step_us: int,
        representation: str,
        options: dict[str, Any],
    ) -> None:
        self._eyes = instance(eyes, EventCamera, "eyes")
        if not callable(state):
            raise AmiwarpError(
                "state is no function; give one that returns the simulator's state of the environment"
            )
        self._state = state
        self._step_us = whole(step_us, "step_us", 1, 10**7, " us")
        name = one_of(representation, REPRESENTATIONS, "representation")
        self._make = partial(REPRESENTATIONS[name], **options)
        self._t_us = 0
        self.zeros = self._tensor(*_nothing(self.cameras, self._eyes.renderer.device))
        """Tensor of no events, Warp array of shape (cameras, ...)."""

    @property
    def cameras(self) -> int:
        """Number of cameras."""
        return self._eyes.renderer.cameras

    def start(self, env: Any) -> wp.array:
        """Start all cameras at the state of an environment, and return the tensors of no events."""
        self._eyes.reset()
        self._t_us = 0
        self._eyes.step(self._state(env), 0)
        return self.zeros

    def advance(
        self, env: Any, fresh: NDArray[np.bool_] | None = None, step_us: int | None = None
    ) -> wp.array:
        """Return the tensors of the events since the state before. ``fresh``: cameras whose worlds were reset.

        ``step_us``: time since then, by default a step of the environment.
        """
        if self._t_us > TIME_LIMIT - 2 * self._step_us:
            raise AmiwarpError("the environment ran longer than the clock; reset it")
        if fresh is not None and fresh.any():
            self._eyes.reset(fresh)
        self._t_us += self._step_us if step_us is None else step_us
        return self._tensor(*self._eyes.step(self._state(env), self._t_us))

    def _tensor(self, events: DeviceEvents, windows: Windows) -> wp.array:
        """Return a tensor of each camera's events."""
        camera = self._eyes.camera
        made = self._make(events, camera.width, camera.height, windows=windows)
        return made if isinstance(made, wp.array) else wp.array(made, device=events.device)

    def space(self, shape: tuple[int, ...]) -> Any:
        """Return the space of tensors of a shape."""
        dtype = np.dtype(wp.dtype_to_numpy(self.zeros.dtype))
        limits = np.finfo(dtype) if dtype.kind == "f" else np.iinfo(dtype)
        low = float(limits.min) if dtype.kind == "f" else 0
        return gymnasium.spaces.Box(low, limits.max, shape, dtype.type)


def _nothing(cameras: int, device: Any) -> tuple[DeviceEvents, Windows]:
    """Return no events of a number of cameras."""
    types = (wp.uint16, wp.uint16, wp.int64, wp.uint8)
    columns = [wp.empty(0, dtype=dtype, device=device) for dtype in types]
    zeros = np.zeros(cameras, np.int64)
    return DeviceEvents(*columns), Windows(start=zeros, stop=zeros, t_start=zeros, t_end=zeros + 1)


class EventObservation(gymnasium.Wrapper):  # type: ignore[misc,name-defined]
    """Environment of Gymnasium that observes the events of one event camera, as a tensor.

    Parameters
    ----------
    env : gymnasium.Env
        Environment of a simulator.
    eyes : EventCamera
        The event camera in it, with one camera.
    state : callable
        Function of ``env.unwrapped`` that returns what ``eyes.step`` takes: the simulator's state after a step.
    step_us : int
        Simulated time of a step of the environment [us].
    representation : {"voxel_grid", "event_count", "polarity_histogram", "stacked_histogram", "time_surface"}
        Function of amiwarp that makes the tensor.
    keep : bool, optional
        Whether an observation is a dictionary of the tensor, ``"events"``, and the environment's own, ``"own"``.
    **options
        Keywords of the function, such as ``bins``.

    Raises
    ------
    AmiwarpError
        If there are several cameras, or a value is unusable.

    Examples
    --------
    >>> env = amiwarp.sensors.EventObservation(env, eyes, lambda env: env.state, step_us=4000)  # doctest: +SKIP
    """

    def __init__(
        self,
        env: Any,
        eyes: EventCamera,
        state: Callable[[Any], Any],
        step_us: int,
        representation: str = "voxel_grid",
        keep: bool = False,
        **options: Any,
    ) -> None:
        super().__init__(env)
        self._observer = _Observer(eyes, state, step_us, representation, options)
        if self._observer.cameras != 1:
            raise AmiwarpError(
                f"there are {self._observer.cameras} cameras for one environment; use EventVectorObservation"
            )
        self._keep = keep
        space = self._observer.space(self._observer.zeros.shape[1:])
        self.observation_space = _spaces(space, env.observation_space, keep)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        """Reset environment and camera.

        Parameters
        ----------
        seed : int, optional
            Seed of the environment. The camera's random numbers start anew, as its own seed says.
        options : dict, optional
            Options of the environment.

        Returns
        -------
        tuple
            The tensor of no events, and the environment's information.
        """
        own, info = self.env.reset(seed=seed, options=options)
        return self._observation(self._observer.start(self.unwrapped), own), info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step the environment, and observe its events.

        Parameters
        ----------
        action : object
            Action of the environment.

        Returns
        -------
        tuple
            Observation, reward, whether the episode terminated, whether it was truncated, information.
        """
        own, reward, terminated, truncated, info = self.env.step(action)
        tensor = self._observer.advance(self.unwrapped)
        return self._observation(tensor, own), reward, terminated, truncated, info

    def _observation(self, tensor: wp.array, own: Any) -> Any:
        values = tensor.numpy()[0].copy()
        return {"events": values, "own": own} if self._keep else values


class EventVectorObservation(gymnasium.vector.VectorWrapper):  # type: ignore[misc,name-defined]
    """Vector environment of Gymnasium that observes the events of an event camera in each of its environments.

    Cameras of environments that reset themselves start anew.

    Parameters
    ----------
    env : gymnasium.vector.VectorEnv
        Vector environment of a simulator.
    eyes : EventCamera
        Event cameras, one in each environment.
    state : callable
        Function of ``env.unwrapped`` that returns what ``eyes.step`` takes: the simulator's state after a step.
    step_us : int
        Simulated time of a step of the environment [us].
    representation : str, optional
        As for :class:`EventObservation`.
    keep : bool, optional
        Whether an observation is a dictionary of the tensors, ``"events"``, and the environment's own, ``"own"``.
    convert : callable, optional
        Function of a Warp array on the device that returns an observation, such as ``torch.from_dlpack``. By default
        observations are NumPy arrays.
    **options
        Keywords of the function that makes the tensor.

    Raises
    ------
    AmiwarpError
        If there is not one camera for each environment, or a value is unusable.

    Examples
    --------
    >>> envs = amiwarp.sensors.EventVectorObservation(  # doctest: +SKIP
    ...     envs, eyes, lambda env: env.state, step_us=4000, convert=torch.from_dlpack)
    """

    def __init__(
        self,
        env: Any,
        eyes: EventCamera,
        state: Callable[[Any], Any],
        step_us: int,
        representation: str = "voxel_grid",
        keep: bool = False,
        convert: Callable[[Any], Any] | None = None,
        **options: Any,
    ) -> None:
        super().__init__(env)
        self._observer = _Observer(eyes, state, step_us, representation, options)
        if self._observer.cameras != env.num_envs:
            raise AmiwarpError(
                f"there are {self._observer.cameras} cameras for {env.num_envs} environments; expected one for each"
            )
        self._keep = keep
        self._convert = convert
        shape = self._observer.zeros.shape
        one = self._observer.space(shape[1:])
        self.single_observation_space = _spaces(one, env.single_observation_space, keep)
        several = self._observer.space(shape)
        self.observation_space = _spaces(several, env.observation_space, keep)
        mode = env.metadata.get("autoreset_mode")
        self._resets_at_once = mode is gymnasium.vector.AutoresetMode.SAME_STEP
        self._resets_next = mode is gymnasium.vector.AutoresetMode.NEXT_STEP
        self._done = np.zeros(env.num_envs, bool)

    def reset(self, *, seed: Any = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        """Reset environments and their cameras: all, or some by ``options["reset_mask"]``.

        Parameters
        ----------
        seed : int or list of int, optional
            Seed of the environments.
        options : dict, optional
            Options of the environments.

        Returns
        -------
        tuple
            The tensors, and the environments' information.
        """
        # Gymnasium takes the mask out of the options
        mask = None if options is None else options.get("reset_mask")
        own, info = self.env.reset(seed=seed, options=options)
        self._done[:] = False
        if mask is None:
            return self._observation(self._observer.start(self.unwrapped), own), info
        fresh = np.asarray(mask, bool)
        # No time passes for the other environments; the sensors' clock needs a microsecond
        return self._observation(self._observer.advance(self.unwrapped, fresh, 1), own), info

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Step the environments, and observe their events.

        Parameters
        ----------
        actions : object
            Actions of the environments.

        Returns
        -------
        tuple
            Observations, rewards, which episodes terminated, which were truncated, information.
        """
        own, rewards, terminated, truncated, info = self.env.step(actions)
        done = np.logical_or(terminated, truncated)
        fresh = None
        if self._resets_at_once:
            fresh = done
        elif self._resets_next:
            fresh = self._done
        tensor = self._observer.advance(self.unwrapped, fresh)
        self._done = done
        return self._observation(tensor, own), rewards, terminated, truncated, info

    def _observation(self, tensor: wp.array, own: Any) -> Any:
        values = tensor.numpy().copy() if self._convert is None else self._convert(tensor)
        return {"events": values, "own": own} if self._keep else values


def _spaces(events: Any, own: Any, keep: bool) -> Any:
    """Return the space of observations."""
    return gymnasium.spaces.Dict({"events": events, "own": own}) if keep else events
