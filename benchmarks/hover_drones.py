"""Drones of the hover study: worlds of Newton, how the drones fly, and what their event cameras see.

All drones fly in one batch. A drone is moved by tilting: the tilt follows the command with a lag, gravity accelerates
the drone along it, and wind pushes. Only the places go to Newton, which draws what the cameras see.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import warp as wp
from torch import Tensor

import amiwarp
from amiwarp.sensors import NewtonEventCamera

STEP_US = 20_000
"""Time from one command to the next [us]."""
SUBSTEPS = 4
HEIGHT_M = 2.0
GRAVITY = 9.81
TILT_LAG_S = 0.1
"""Time constant with which the tilt follows its command."""
MOST_TILT = math.radians(12.0)
DRAG_PER_S = 0.2
WIND = 0.15
"""Standard deviation of the acceleration by wind [m/s²]."""
WIND_TIME_S = 1.5
START_M = 0.25
"""Largest distance from the middle at the start, along each axis."""
LOST_M = 1.0
"""Distance from the middle at which a drone is lost."""

SIDE = 64
FOV = math.radians(60.0)
APEX = math.radians(3.0)
RPM = 720.0
BINS = 5
KINDS = ("plain", "prism", "blind")
"""What a drone sees by: a plain event camera, one behind a turning prism, or nothing."""


def world_of(rng: np.random.Generator) -> Any:
    """Return a builder of one world: a bright cross on dark ground that marks the middle, clutter, and the drone."""
    import newton

    world = newton.ModelBuilder()
    flat = wp.quat_identity()
    grey = rng.uniform(0.15, 0.3)
    ground = wp.transform((0.0, 0.0, -0.05), flat)
    world.add_shape_box(-1, xform=ground, hx=6.0, hy=6.0, hz=0.05, color=(grey,) * 3)
    for length, width in ((0.3, 0.06), (0.06, 0.3)):
        middle = wp.transform((0.0, 0.0, 0.004), flat)
        world.add_shape_box(-1, xform=middle, hx=length, hy=width, hz=0.005, color=(1.0,) * 3)
    for distance, around, turned, long, wide, bright in rng.random((16, 6)):
        far = 0.6 + 1.8 * distance
        place = (far * math.cos(math.tau * around), far * math.sin(math.tau * around), 0.01)
        turn = wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), math.pi * float(turned))
        world.add_shape_box(
            -1,
            xform=wp.transform(place, turn),
            hx=0.05 + 0.25 * long,
            hy=0.05 + 0.15 * wide,
            hz=0.01,
            color=(0.3 + 0.5 * bright,) * 3,
        )
    high = wp.transform((0.0, 0.0, HEIGHT_M), flat)
    inertia = wp.mat33(0.01, 0.0, 0.0, 0.0, 0.01, 0.0, 0.0, 0.0, 0.01)
    world.add_body(xform=high, mass=1.0, inertia=inertia, label="drone")
    return world


def model_of(drones: int, seed: int, device: str) -> Any:
    """Return a model of Newton with a world of its own for each drone."""
    import newton

    builder = newton.ModelBuilder()
    rng = np.random.default_rng(seed)
    for _ in range(drones):
        builder.add_world(world_of(rng))
    return builder.finalize(device=device)


def eyes_of(model: Any, kind: str, seed: int) -> NewtonEventCamera:
    """Return the cameras of all drones, which look down."""
    camera = amiwarp.Camera.from_fov(SIDE, SIDE, FOV)
    options: dict[str, Any] = {"body": "drone", "seed": seed}
    if kind == "prism":
        optic = amiwarp.ExactModel.from_prism(camera, amiwarp.Prism(APEX))
        options |= {"optic": optic, "motion": amiwarp.PrismMotion(rpm=RPM)}
    return NewtonEventCamera(model, camera, **options)


@dataclass
class Flight:
    """State of all drones along x and y, each of shape (drones, 2), on the device of the policy."""

    place: Tensor
    """Distance from the middle [m]."""
    speed: Tensor
    """Velocity [m/s]."""
    tilt: Tensor
    """Tilt towards which the drone accelerates [rad]."""
    wind: Tensor
    """Acceleration by wind [m/s²]."""

    @classmethod
    def start(cls, drones: int, rng: torch.Generator, device: str) -> Flight:
        """Return drones at rest somewhere near the middle."""
        shape = (drones, 2)
        place = START_M * (2.0 * torch.rand(shape, generator=rng, device=device) - 1.0)
        wind = WIND * torch.randn(shape, generator=rng, device=device)
        rest = torch.zeros(shape, device=device)
        return cls(place, rest, rest.clone(), wind)

    def advance(self, command: Tensor, rng: torch.Generator) -> Flight:
        """Return the state after one step with a command: the tilt that is wanted [rad]."""
        step_s = STEP_US * 1e-6 / SUBSTEPS
        wanted = command.clamp(-MOST_TILT, MOST_TILT)
        place, speed, tilt, wind = self.place, self.speed, self.tilt, self.wind
        kept = math.exp(-step_s / WIND_TIME_S)
        for _ in range(SUBSTEPS):
            tilt = tilt + (wanted - tilt) * (step_s / TILT_LAG_S)
            acceleration = GRAVITY * torch.tan(tilt) + wind - DRAG_PER_S * speed
            speed = speed + step_s * acceleration
            place = place + step_s * speed
            gust = torch.randn(wind.shape, generator=rng, device=wind.device)
            wind = kept * wind + WIND * math.sqrt(1.0 - kept * kept) * gust
        return Flight(place, speed, tilt, wind)

    def lost(self) -> Tensor:
        """Return which drones are too far from the middle, shape (drones,)."""
        return self.place.norm(dim=1) > LOST_M

    def poses(self) -> Tensor:
        """Return x, y, z [m] and quaternion of each drone, as Newton has them, shape (drones, 7)."""
        # A drone that accelerates along x is turned about y, and one that accelerates along y against x
        half_x = -0.5 * self.tilt[:, 1]
        half_y = 0.5 * self.tilt[:, 0]
        height = torch.full_like(half_x, HEIGHT_M)
        sines = torch.sin(half_x) * torch.cos(half_y), torch.cos(half_x) * torch.sin(half_y)
        last = -torch.sin(half_x) * torch.sin(half_y), torch.cos(half_x) * torch.cos(half_y)
        return torch.stack([self.place[:, 0], self.place[:, 1], height, *sines, *last], dim=1)


class Drones:
    """A batch of drones that fly, and see."""

    def __init__(self, drones: int, kind: str, seed: int, device: str) -> None:
        """Make worlds and cameras. ``seed`` tells worlds, starts, winds and the noise of the sensors."""
        self.kind = kind
        self.count = drones
        self.device = device
        self._eyes: NewtonEventCamera | None = None
        if kind != "blind":
            model = model_of(drones, seed, device)
            self._state = model.state()
            self._eyes = eyes_of(model, kind, seed)
        self._rng = torch.Generator(device).manual_seed(seed)
        self._t_us = 0
        self.flight = Flight.start(drones, self._rng, device)
        self.events = 0
        """Number of events since the start."""

    def start(self) -> Tensor:
        """Start all drones anew, and return what they see: nothing yet."""
        self.flight = Flight.start(self.count, self._rng, self.device)
        self.events = 0
        # The prism of each flight starts at another angle
        self._t_us = int(torch.randint(84, (1,), generator=self._rng, device=self.device)) * 1000
        if self._eyes is not None:
            self._eyes.reset()
            self._eyes.step(self._placed(), self._t_us)
        return torch.zeros((self.count, BINS, SIDE, SIDE), device=self.device)

    def advance(self, command: Tensor) -> Tensor:
        """Fly one step, and return the events of each drone on the way, shape (drones, bins, rows, columns)."""
        self.flight = self.flight.advance(command, self._rng)
        self._t_us += STEP_US
        if self._eyes is None:
            return torch.zeros((self.count, BINS, SIDE, SIDE), device=self.device)
        events, windows = self._eyes.step(self._placed(), self._t_us)
        self.events += len(events)
        grids = amiwarp.voxel_grid(events, SIDE, SIDE, bins=BINS, windows=windows)
        return torch.as_tensor(wp.to_torch(wp.array(grids, device=self.device)))

    def _placed(self) -> Any:
        """Return the state of Newton with the drones where they are."""
        poses = self.flight.poses().contiguous()
        self._state.body_q.assign(wp.from_torch(poses, dtype=wp.transform))
        return self._state

    def known(self) -> Tensor:
        """Return what a drone knows without its camera, shape (drones, 4): its tilt, and cosine and sine of the prism.

        The prism's angle is the one in the middle of the last step, and 0 for a plain camera.
        """
        turned = math.tau * RPM / 60.0 * 1e-6 * (self._t_us - STEP_US / 2)
        angle = [math.cos(turned), math.sin(turned)] if self.kind == "prism" else [0.0, 0.0]
        of_prism = torch.tensor(angle, device=self.device).expand(self.count, 2)
        return torch.cat([self.flight.tilt / MOST_TILT, of_prism], dim=1)
