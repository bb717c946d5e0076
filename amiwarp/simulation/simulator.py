"""From a picture, a camera and a prism to the events that an event camera would give, with the truth beside them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.events import Events, MemoryEvents
from amiwarp.events.recording import MetadataValue, Recording, Truth
from amiwarp.io import RecordingWriter
from amiwarp.optics.camera import Camera
from amiwarp.optics.prism import Prism
from amiwarp.progress import Progress
from amiwarp.simulation.engine import Engine
from amiwarp.simulation.motion import LONGEST_S, CameraMotion, EncoderModel, PrismMotion
from amiwarp.simulation.pictures import linear_luminance, read_picture
from amiwarp.simulation.worlds.world_scene import WorldScene
from amiwarp.validation import instance, real, whole

if TYPE_CHECKING:
    from amiwarp.events.encoder import Encoder

"""Called with the fraction that is done, 0 .. 1."""


@dataclass(frozen=True, slots=True)
class SensorModel:
    """An event camera's pixels; the defaults are those of a good sensor in good light, with fast biases."""

    contrast_on: float = 0.25
    """Rise of log intensity that makes an ON event."""
    contrast_off: float = 0.25
    """Fall of log intensity that makes an OFF event."""
    mismatch: float = 0.03
    """Standard deviation of either threshold from pixel to pixel, relative."""
    refractory_us: float = 100.0
    """Time after an event in which the pixel is blind; its reference is the level at the end of it [us]."""
    latency_us: float = 100.0
    """Mean time from a change to its time stamp [us]."""
    latency_jitter_us: float = 30.0
    """Standard deviation of the latency [us]; the stamps of one pixel stay in order."""
    leak_hz: float = 0.1
    """Rate of ON events of a pixel that sees no change: its reference drifts [1/s]."""
    shot_noise_hz: float = 1.0
    """Rate of random events per pixel, ON and OFF alike, each resetting the reference to the level [1/s]."""
    hot_fraction: float = 0.0002
    """Fraction of the pixels that are hot."""
    hot_hz: float = 100.0
    """Additional rate of random events of a hot pixel [1/s]."""

    def __post_init__(self) -> None:
        limits = {"mismatch": 0.5, "refractory_us": 1e6, "latency_us": 1e4, "latency_jitter_us": 1e3, "leak_hz": 1e3,
                  "shot_noise_hz": 1e5, "hot_fraction": 1.0, "hot_hz": 1e5}  # fmt: skip
        for name, limit in limits.items():
            object.__setattr__(self, name, real(getattr(self, name), f"sensor {name}", 0.0, limit))
        for name in ("contrast_on", "contrast_off"):
            value = real(getattr(self, name), f"sensor {name}", 0.01, 10.0, " (log intensity)")
            object.__setattr__(self, name, value)

    @classmethod
    def ideal(cls, contrast: float = 0.25) -> SensorModel:
        """Equal thresholds and nothing else: no noise, no latency, no refractory time."""
        return cls(contrast, contrast, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


class Frames(Protocol):
    """Pictures with times, read one after the other."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of each picture [px]."""

    @property
    def interval_us(self) -> float | None:
        """Typical time between pictures [us]; None for a still."""

    def read(self) -> Iterator[tuple[int, NDArray[np.float32]]]:
        """Times [us], rising, the first no later than 0, and linear luminance, shape (height, width)."""


@dataclass(frozen=True, slots=True, eq=False)
class Still:
    """One picture that never changes."""

    light: NDArray[np.float32]
    """Linear luminance, shape (height, width)."""

    @property
    def size(self) -> tuple[int, int]:
        return self.light.shape[1], self.light.shape[0]

    @property
    def interval_us(self) -> None:
        return None

    def read(self) -> Iterator[tuple[int, NDArray[np.float32]]]:
        yield 0, self.light


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """What the camera looks at: pictures on a plane at infinity."""

    frames: Frames
    """The pictures."""
    fov: float | None = None
    """Horizontal extent of a picture [rad]; None to fill all that is ever seen. Past its edges it is mirrored."""
    blur: float = 0.5
    """Standard deviation of the optical blur, the pixel's aperture included [sensor pixels]."""

    def __post_init__(self) -> None:
        if self.fov is not None:
            below = math.nextafter(math.pi, 0.0)
            hint = " rad, 0 .. 180 deg; is it given in degrees?"
            object.__setattr__(self, "fov", real(self.fov, "scene fov", 1e-9, below, hint))
        object.__setattr__(self, "blur", real(self.blur, "scene blur", 0.0, 20.0, " px"))

    @classmethod
    def from_picture(cls, picture: str | Path | NDArray[Any], *, fov: float | None = None, blur: float = 0.5) -> Scene:
        """A still from a picture file or an array (see :func:`amiwarp.simulation.pictures.linear_luminance`)."""
        light = read_picture(picture) if isinstance(picture, str | Path) else linear_luminance(picture)
        return cls(Still(light), fov, blur)


@dataclass(frozen=True, eq=False)
class Simulation:
    """All that determines a recording; equal values give equal events, bit for bit, on one kind of device."""

    scene: Scene | WorldScene
    camera: Camera
    prism: Prism
    """The true prism."""
    duration_s: float
    motion: PrismMotion = field(default_factory=PrismMotion)
    camera_motion: CameraMotion = field(default_factory=CameraMotion)
    sensor: SensorModel = field(default_factory=SensorModel)
    encoder_model: EncoderModel = field(default_factory=EncoderModel)
    nominal_prism: Prism | None = None
    """The prism that the recording names; None for the true one."""
    seed: int = 0
    device: str = "cpu"

    def __post_init__(self) -> None:
        kinds = {"camera": Camera, "prism": Prism, "motion": PrismMotion, "sensor": SensorModel,
                 "camera_motion": CameraMotion, "encoder_model": EncoderModel}  # fmt: skip
        if not isinstance(self.scene, WorldScene):
            instance(self.scene, Scene, "simulation's scene")
        for name, kind in kinds.items():
            instance(getattr(self, name), kind, f"simulation's {name}")
        real(self.duration_s, "duration_s", 1e-3, LONGEST_S, " s")
        if self.camera.width * self.camera.height > 1 << 22:
            raise AmiwarpError(f"camera of {self.camera.width}x{self.camera.height} has more than 4194304 pixels")
        whole(self.seed, "seed", 0, (1 << 31) - 1)

    @property
    def duration_us(self) -> int:
        return round(self.duration_s * 1e6)

    def encoder(self) -> Encoder:
        """The encoder's samples; its clock offset is in the truth only."""
        return self.encoder_model.sample(self.motion, self.duration_us, self.seed)

    def truth_parameters(self) -> dict[str, float]:
        """The generating values by the names that calibration uses, and the sensor's."""
        rates = np.asarray(self.camera_motion.rates) if self.camera_motion.constant else np.full(3, np.nan)
        omega = dict(zip(("omega_x", "omega_y", "omega_z"), rates.ravel()[-3:].tolist(), strict=True))
        return {
            "apex": self.prism.apex,
            "index": self.prism.index,
            "phase": self.motion.phase,
            "clock_offset_us": self.encoder_model.clock_offset_us,
            "tilt_x": self.motion.tilt[0],
            "tilt_y": self.motion.tilt[1],
            **{name: value for name, value in omega.items() if math.isfinite(value)},
            **asdict(self.sensor),
        }

    def metadata(self) -> dict[str, MetadataValue]:
        """How the recording was made."""
        return {"simulated": True, "seed": self.seed, "duration_us": self.duration_us}

    def blocks(
        self, *, chunk_us: int | None = None, progress: Progress | None = None
    ) -> Iterator[tuple[Events, NDArray[np.float32]]]:
        """Events of successive spans of time, and for each event its scene point's pixel without the prism, (n, 2).

        Memory stays constant: a span is ``chunk_us``, or a default that depends on the device but changes no event.
        A point is NaN where its ray misses the image plane.
        """
        engine = Engine(self, chunk_us)
        for block in engine.run():
            yield block.to_host()
            if progress is not None:
                progress("simulating", min(1.0, engine.now_us / self.duration_us))

    def log_view(self) -> NDArray[np.float32]:
        """The first picture as the camera sees it at t = 0 with no prism: log intensity, shape (height, width)."""
        from amiwarp.simulation.scenery import log_view

        return log_view(self)

    def run(self, *, progress: Progress | None = None) -> Recording:
        """The whole recording in memory."""
        blocks = list(self.blocks(progress=progress))
        events = Events.concatenate([events for events, _ in blocks])
        points = np.concatenate([points for _, points in blocks])
        return Recording(
            MemoryEvents(events, self.camera.width, self.camera.height),
            self.camera,
            self.encoder(),
            self.nominal_prism or self.prism,
            Truth(self.truth_parameters(), points),
            self.metadata(),
            "simulation",
        )

    def write(self, path: str | Path, *, progress: Progress | None = None, overwrite: bool = False) -> None:
        """The whole recording to a file, in constant memory."""
        with RecordingWriter(
            path,
            width=self.camera.width,
            height=self.camera.height,
            camera=self.camera,
            prism=self.nominal_prism or self.prism,
            encoder=self.encoder(),
            truth_parameters=self.truth_parameters(),
            metadata=self.metadata(),
            overwrite=overwrite,
        ) as writer:
            for events, points in self.blocks(progress=progress):
                writer.append(events, truth_points=points)


def simulate(
    scene: Scene | WorldScene | str | Path | NDArray[Any],
    camera: Camera,
    prism: Prism,
    *,
    duration_s: float,
    motion: PrismMotion | float = 720.0,
    camera_motion: CameraMotion | None = None,
    sensor: SensorModel | None = None,
    encoder: EncoderModel | None = None,
    nominal_prism: Prism | None = None,
    seed: int = 0,
    device: str = "cpu",
    progress: Progress | None = None,
) -> Recording:
    """Simulate a recording; a number for ``motion`` is a constant speed [turns/min].

    For recordings larger than memory use :meth:`Simulation.write` or :meth:`Simulation.blocks`.
    Raises :class:`AmiwarpError` where a value makes no sense or the camera turns away from the picture.
    """
    return Simulation(
        scene if isinstance(scene, Scene | WorldScene) else Scene.from_picture(scene),
        camera,
        prism,
        duration_s,
        motion if isinstance(motion, PrismMotion) else PrismMotion(motion),
        camera_motion or CameraMotion(),
        sensor or SensorModel(),
        encoder or EncoderModel(),
        nominal_prism,
        seed,
        device,
    ).run(progress=progress)
