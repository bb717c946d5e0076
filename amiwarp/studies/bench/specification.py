"""Specification of AMI-Bench: which recordings a set has, and the cameras that make each of them."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.io.json_files import read_toml
from amiwarp.optics.camera import Camera
from amiwarp.optics.prism import Prism
from amiwarp.schema.records import build, check_format
from amiwarp.simulation.choices import FrameEncoding
from amiwarp.simulation.motion import PrismMotion
from amiwarp.simulation.rigs.cameras import RigCamera, RigEventCamera, RigFrameCamera
from amiwarp.simulation.rigs.rig import Rig
from amiwarp.simulation.sensor_model import SensorModel
from amiwarp.simulation.worlds.named.catalogue import named_world
from amiwarp.simulation.worlds.world import lit
from amiwarp.validation import one_of, whole

FORMAT = "ami-bench-specification"
VERSION = "1.0"
"""Values of the fields ``format`` and ``version``."""
FILE = Path(__file__).with_name("bench-1.0.toml")
"""The specification."""
SETS = ("small", "full")
"""Names of the sets of recordings."""
PRISM = "prism"
PLAIN = "plain"
FRAMES = "frames"
"""Names of the cameras of a recording: behind the prism, plain, and standard."""
Seed = Annotated[int, partial(whole, low=0, high=2**31 - 1)]


@dataclass(frozen=True)
class _Group:
    """Recordings of one world: each speed in each light with each seed."""

    world: str
    speeds: tuple[Literal["rest", "slow", "fast"], ...]
    lights: tuple[Literal["bright", "dim"], ...]
    seeds: tuple[Seed, ...]


@dataclass(frozen=True)
class _Set:
    size: tuple[int, int]
    duration_s: float
    recordings: tuple[_Group, ...]


@dataclass(frozen=True)
class _FrameCamera:
    rate_hz: float
    exposure_us: int
    electrons: float
    read_noise: float


@dataclass(frozen=True)
class _File:
    """Fields of the specification file."""

    format: str
    version: str
    sensor: str
    fov_deg: float
    rpm: float
    index: float
    nominal_apex_deg: float
    apex_deg: tuple[float, float]
    mount_error_deg: float
    light: Mapping[str, float]
    motion: Mapping[str, str]
    frames: _FrameCamera
    sets: Mapping[str, _Set]


@dataclass(frozen=True)
class Entry:
    """A recording of the benchmark."""

    set_name: str
    """Name of its set."""
    world: str
    """Name of the world, see :func:`amiwarp.named_world`."""
    speed: str
    """Motion of the camera: rest, slow or fast."""
    light: str
    """Light: bright or dim."""
    seed: int
    """Seed of the world, and of all that is drawn."""

    @property
    def name(self) -> str:
        """Name of the recording, and of its files."""
        return f"{self.world}-{self.speed}-{self.light}-{self.seed}"

    @property
    def tasks(self) -> tuple[str, ...]:
        """Names of the tasks that score this recording, in the order of the table."""
        names = ["calibration", "picture"]
        if self.speed != "rest":
            names.append("flow")
        if self.world == "ball":
            names.append("detection")
        names.append("rotation")
        return tuple(names)

    @property
    def camera(self) -> Camera:
        """Intrinsics of all cameras of the recording."""
        width, height = _set_of(self).size
        return Camera.from_fov(width, height, math.radians(_specification().fov_deg))

    @property
    def duration_us(self) -> int:
        """Duration [us]."""
        return round(1e6 * _set_of(self).duration_s)

    @property
    def moment_us(self) -> int:
        """Time of picture, flow and detection: the middle of the recording [us]."""
        return self.duration_us // 2

    @property
    def turn_us(self) -> int:
        """Duration of a turn of the prism, rounded [us]."""
        return round(60e6 / _specification().rpm)

    @property
    def rotation_ends_us(self) -> NDArray[np.int64]:
        """Ends of the successive windows of the rotation [us], shape (n + 1,).

        Windows last a turn. They begin half a turn after the start, so that the turns before and after the middle of
        each end lie in the recording.
        """
        half = self.turn_us // 2
        count = (self.duration_us - 2 * half) // self.turn_us
        return half + self.turn_us * np.arange(count + 1, dtype=np.int64)

    @property
    def _drawn_seed(self) -> int:
        """Seed of what is drawn for this recording alone."""
        text = f"AMI-Bench {VERSION} {self.set_name} {self.name}"
        return int.from_bytes(hashlib.sha256(text.encode()).digest()[:4], "big") >> 1

    @property
    def mounted_phase(self) -> float:
        """Phase of the prism as its mount gives it [rad]: the true one with an error."""
        _, phase, error = self._drawn()
        return (phase + error) % (2.0 * math.pi)

    def _drawn(self) -> tuple[float, float, float]:
        """Return the true apex angle and phase, and the error of the mount [rad]."""
        known = _specification()
        rng = np.random.default_rng(self._drawn_seed)
        apex_deg = rng.uniform(*known.apex_deg)
        phase = rng.uniform(0.0, 2.0 * math.pi)
        error_deg = rng.uniform(-known.mount_error_deg, known.mount_error_deg)
        return math.radians(apex_deg), phase, math.radians(error_deg)

    def rig(self, device: str = "cpu") -> Rig:
        """Return the rig of the three cameras, which share place and lens."""
        known = _specification()
        duration_s = _set_of(self).duration_s
        motion = known.motion[self.speed]
        world, trajectory = named_world(self.world, motion, seed=self.seed, duration_s=duration_s)
        apex, phase, _ = self._drawn()
        sensor = SensorModel.preset(known.sensor)
        behind_prism = RigEventCamera(
            self.camera,
            Prism(apex, known.index),
            motion=PrismMotion(known.rpm, phase),
            sensor=sensor,
            nominal_prism=Prism(math.radians(known.nominal_apex_deg), known.index),
        )
        frames = RigFrameCamera(
            self.camera,
            rate_hz=known.frames.rate_hz,
            exposure_us=known.frames.exposure_us,
            electrons=known.frames.electrons,
            read_noise=known.frames.read_noise,
            bits=16,
            encoding=FrameEncoding.LINEAR,
        )
        cameras: dict[str, RigCamera] = {
            PRISM: behind_prism,
            PLAIN: RigEventCamera(self.camera, sensor=sensor),
            FRAMES: frames,
        }
        light = known.light[self.light]
        return Rig(
            lit(world, light), trajectory, cameras, duration_s, self._drawn_seed, device=device
        )


@cache
def _specification() -> _File:
    """Return the specification in the package."""
    data = read_toml(FILE, "the specification of AMI-Bench")
    check_format(data, FORMAT, VERSION)
    return build(_File, data, "")


def _set_of(entry: Entry) -> _Set:
    return _specification().sets[entry.set_name]


def entries(set_name: str) -> tuple[Entry, ...]:
    """Return the recordings of a set, in order.

    Raises :class:`AmiwarpError` for a set that does not exist.
    """
    one_of(set_name, SETS, "set")
    found = []
    for group in _specification().sets[set_name].recordings:
        for speed in group.speeds:
            for light in group.lights:
                for seed in group.seeds:
                    found.append(Entry(set_name, group.world, speed, light, seed))
    return tuple(found)


def chosen_entries(set_name: str, only: tuple[str, ...] = ()) -> tuple[Entry, ...]:
    """Return the recordings of a set that are named; all of them without names.

    Raises :class:`AmiwarpError` for a name that the set does not have.
    """
    known = {entry.name: entry for entry in entries(set_name)}
    for name in only:
        if name not in known:
            raise AmiwarpError(
                f"recording {name!r} is not in the set {set_name}; choose among {', '.join(known)}"
            )
    return tuple(entry for name, entry in known.items() if not only or name in only)
