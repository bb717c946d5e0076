"""Conditions: what is simulated or read for one cell of an evaluation, and the size of a run."""

from __future__ import annotations

import hashlib
import json
import math
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from amiwarp.optics.camera import Camera
from amiwarp.optics.prism import Prism
from amiwarp.simulation.description import Scene
from amiwarp.simulation.motion import PrismMotion
from amiwarp.simulation.sensor_model import SensorModel
from amiwarp.simulation.simulator import Simulation
from amiwarp.simulation.worlds.named.catalogue import named_world
from amiwarp.simulation.worlds.world_scene import WorldScene
from amiwarp.studies.evaluate.discs import DiscTarget

INDEX = 1.55
"""Refractive index of the paper's prism."""
FOCAL_PX = 554.0
"""Focal length [px] of 640 px over a field of view of 60 deg. A smaller image is the middle of the sensor: its
displacements in pixels are the same."""
FEATURES_APEX = math.radians(1.0)
"""Apex angle of the paper's corners and segmentation [rad]; elsewhere it is 0.5 deg."""
NOMINAL = 1.15
"""Nominal apex angle that calibration starts from, relative to the true one."""
DISCS = "discs"
"""Name of the picture of :class:`DiscTarget` among the worlds."""
IDEAL = "none"
"""Name of the sensor without any of :data:`LIMITS`."""
BANDWIDTH = "bandwidth"
"""Name of the limit of the photoreceptors."""
LIMITS = {
    BANDWIDTH: ("cutoff_hz",),
    "refractory period": ("refractory_us",),
    "readout": ("row_us", "bus_rate_mev_s", "bus_queue"),
    "latency jitter": ("latency_us", "latency_jitter_us"),
    "mismatch and noise": ("mismatch", "leak_hz", "shot_noise_hz", "shot_noise_dark"),
}
"""Limits of a sensor, by the fields of :class:`amiwarp.SensorModel` that describe them."""
SETUP_SEED = 1_000_003
"""Seed of the recording that a prism is calibrated from once; no evaluation scores it."""
SETUP_S = 2.0
"""Duration of that recording [s]."""


@dataclass(frozen=True)
class Condition:
    """Description of a simulated recording."""

    world: str = "room"
    """Name of the world, see :func:`amiwarp.named_world`; or :data:`DISCS` for a picture of discs at infinity."""
    trajectory: str = "handheld"
    """Motion of the camera: still, handheld or fast."""
    apex: float = math.radians(0.5)
    """Apex angle of the prism [rad]."""
    rpm: float = 720.0
    """Speed of the prism [turns/min]."""
    seed: int = 0
    """Seed of the world, of the camera's motion and of the sensor."""
    duration_s: float = 0.25
    """Duration [s]."""
    width: int = 240
    """Width of the image [px]."""
    height: int = 180
    """Height of the image [px]."""
    focal_px: float = FOCAL_PX
    """Focal length [px]."""
    sensor: str = "dvxplorer"
    """Name of the sensor, see :meth:`amiwarp.SensorModel.preset`."""
    cutoff_hz: float | None = None
    """Bandwidth of the photoreceptors at white [Hz], 0 for unlimited; None for the sensor's own."""
    only: str | None = None
    """The only one of :data:`LIMITS` that the sensor has, or :data:`IDEAL` for none of them; None for all."""

    @property
    def key(self) -> str:
        """Short text that identifies the condition."""
        return hashlib.sha256(json.dumps(asdict(self), sort_keys=True).encode()).hexdigest()[:12]

    @property
    def phase(self) -> float:
        """Azimuth of the prism at the start of the recording [rad], which depends on the seed."""
        return float(np.random.default_rng(self.seed).uniform(0.0, 2.0 * math.pi))

    @property
    def text(self) -> str:
        """Description in words: world, motion, prism and seed, and what else differs from the defaults."""
        prism = f"apex {math.degrees(self.apex):.4g}°, {self.rpm:g} rpm"
        parts = [f"{self.world} {self.trajectory}", prism, f"seed {self.seed}"]
        stated = {"world", "trajectory", "apex", "rpm", "seed"}
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name not in stated and value != field.default:
                parts.append(f"{field.name} {value}")
        return ", ".join(parts)

    @property
    def setup(self) -> Condition:
        """Recording of a still scene by the usual lens that the same prism and sensor are calibrated from."""
        return replace(
            self,
            world="room",
            trajectory="still",
            seed=SETUP_SEED,
            duration_s=SETUP_S,
            focal_px=FOCAL_PX,
        )

    def simulation(self, device: str) -> Simulation:
        """Return the simulation of the AMI-EV under this condition."""
        horizontal_view = 2.0 * math.atan(self.width / (2.0 * self.focal_px))
        return Simulation(
            self._scene(),
            Camera.from_fov(self.width, self.height, horizontal_view),
            Prism(self.apex, INDEX),
            self.duration_s,
            motion=PrismMotion(self.rpm, self.phase),
            sensor=self._sensor(),
            nominal_prism=Prism(NOMINAL * self.apex, INDEX),
            seed=self.seed,
            device=device,
        )

    def _scene(self) -> Scene | WorldScene:
        if self.world == DISCS:
            return DiscTarget.of_seed((self.width, self.height), self.seed).scene(self.focal_px)
        world, trajectory = named_world(
            self.world, self.trajectory, seed=self.seed, duration_s=self.duration_s
        )
        return WorldScene(world, trajectory)

    def _sensor(self) -> SensorModel:
        """Return the sensor with this condition's bandwidth, and without the limits that it leaves out."""
        sensor = SensorModel.preset(self.sensor)
        if self.only is not None:
            limit = {name: getattr(sensor, name) for name in LIMITS.get(self.only, ())}
            sensor = replace(SensorModel.ideal(sensor.contrast_on), **limit)
        if self.cutoff_hz is not None:
            sensor = replace(sensor, cutoff_hz=self.cutoff_hz)
        return sensor


@dataclass(frozen=True)
class RecordedCondition:
    """Recording of a real camera, given as a file."""

    path: Path
    """File of the recording."""
    seed: int = 0
    """Seed of the calibration."""

    @property
    def text(self) -> str:
        """Name of the file."""
        return str(self.path)

    @property
    def key(self) -> str:
        """Short text that identifies the recording."""
        stat = self.path.stat()
        text = json.dumps([str(self.path.resolve()), stat.st_size, stat.st_mtime_ns, self.seed])
        return hashlib.sha256(text.encode()).hexdigest()[:12]


@dataclass(frozen=True)
class Settings:
    """Size of a run."""

    quick: bool = True
    """Whether the run is short: a small image and few values."""
    seeds: int = 2
    """Number of seeds of each condition."""
    first_seed: int = 1
    """First seed. The settings of the algorithms were chosen with seed 0, which is therefore not scored."""
    width: int = 240
    """Width of the images [px]."""
    height: int = 180
    """Height of the images [px]."""
    duration_s: float = 0.25
    """Duration of a recording [s]."""
    device: str = "cpu"
    """Device that computes."""

    def conditions(self, **values: Any) -> list[Condition]:
        """Return a condition of this size for each seed, with the given ``values`` of its other fields."""
        size = {"width": self.width, "height": self.height, "duration_s": self.duration_s}
        described = {**size, **values}
        seeds = range(self.first_seed, self.first_seed + self.seeds)
        return [Condition(**described, seed=seed) for seed in seeds]

    def scenes(self) -> list[Condition]:
        """Return the room at rest and moving; in full also in fast motion, and the desk and the street."""
        scenes = [("room", "still"), ("room", "handheld")]
        if not self.quick:
            scenes += [("room", "fast"), ("desk", "handheld"), ("street", "handheld")]
        conditions = []
        for world, motion in scenes:
            conditions += self.conditions(world=world, trajectory=motion)
        return conditions


QUICK = Settings()
FULL = Settings(quick=False, seeds=10, width=320, height=240)


def wide_focal(settings: Settings) -> float:
    """Return the focal length with which an image of any size sees what the whole sensor does [px]."""
    return FOCAL_PX * settings.width / 640.0
