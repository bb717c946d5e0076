"""Description of a simulated recording: the scene, and all other values that determine its events."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.recording import MetadataValue
from amiwarp.optics.camera import Camera
from amiwarp.optics.models import ExactModel
from amiwarp.optics.prism import Prism
from amiwarp.simulation.motion import LONGEST_S, CameraMotion, EncoderModel, PrismMotion
from amiwarp.simulation.pictures import linear_luminance, read_picture
from amiwarp.simulation.sensor import SensorModel
from amiwarp.simulation.worlds.world import WorldScene
from amiwarp.validation import guarded, instance, real, whole


class Frames(Protocol):
    """Pictures with times, which are read one after the other (protocol)."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of each picture [px]."""

    @property
    def interval_us(self) -> float | None:
        """Typical time between pictures [us]; None for a still picture."""

    def read(self) -> Iterator[tuple[int, NDArray[np.float32]]]:
        """Yield times and pictures.

        Yields
        ------
        tuple
            Time [us], increasing, the first no later than 0; and linear luminance, float32, shape ``(height, width)``.
        """


@dataclass(frozen=True, slots=True, eq=False)
class Still:
    """Single picture that never changes."""

    light: NDArray[np.float32]
    """Linear luminance of the picture, shape (height, width); white is 1."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the picture [px]."""
        return self.light.shape[1], self.light.shape[0]

    @property
    def interval_us(self) -> None:
        """Time between pictures: None, because there is only one picture."""
        return None

    def read(self) -> Iterator[tuple[int, NDArray[np.float32]]]:
        """Yield the picture at time 0."""
        yield 0, self.light


@guarded
@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """Scene in front of the camera: pictures on a plane at infinity.

    Examples
    --------
    >>> import numpy as np
    >>> amiwarp.Scene.from_picture(np.ones((48, 64), np.float32)).frames.size
    (64, 48)
    """

    frames: Frames
    """Pictures of the scene, in order of time."""
    fov: float | None = None
    """Horizontal field of view of the picture [rad]. Beyond its edges the picture is mirrored.

    None: the picture is just large enough to cover everything that the camera sees through the turning prism.
    """
    blur: float = 0.5
    """Standard deviation of the optical blur [sensor px], which includes the pixel's aperture."""

    def __post_init__(self) -> None:
        if self.fov is not None:
            below = math.nextafter(math.pi, 0.0)
            hint = " rad, 0 .. 180 deg; is it given in degrees?"
            object.__setattr__(self, "fov", real(self.fov, "scene fov", 1e-9, below, hint))
        object.__setattr__(self, "blur", real(self.blur, "scene blur", 0.0, 20.0, " px"))

    @classmethod
    def from_picture(cls, picture: str | Path | NDArray[Any], *, fov: float | None = None, blur: float = 0.5) -> Scene:
        """Make a still scene from a picture.

        Parameters
        ----------
        picture : str, Path or ndarray
            Picture file, or pixel values of shape ``(height, width)`` or ``(height, width, 3)``. uint8 and uint16
            values are sRGB-encoded; floating values are linear, with white at 1.
        fov : float, optional
            Horizontal field of view of the picture [rad]. By default the picture is just large enough to cover
            everything that the camera sees through the turning prism.
        blur : float, optional
            Standard deviation of the optical blur [sensor px].

        Returns
        -------
        Scene
            The scene.

        Raises
        ------
        AmiwarpError
            If the picture cannot be read, or has another shape or type.
        """
        light = read_picture(picture) if isinstance(picture, str | Path) else linear_luminance(picture)
        return cls(Still(light), fov, blur)


@dataclass(frozen=True, eq=False)
class SimulationValues:
    """Description of a simulated recording: all that determines its events."""

    scene: Scene | WorldScene
    """Scene in front of the camera: pictures at infinity, or a world."""
    camera: Camera
    """Camera intrinsics, of at most 4194304 pixels."""
    prism: Prism
    """Prism in front of the camera, with its true parameters."""
    duration_s: float
    """Duration of the recording [s]."""
    motion: PrismMotion = field(default_factory=PrismMotion)
    """Motion of the prism: speed, phase, tilt, cylinder power and wobble."""
    camera_motion: CameraMotion = field(default_factory=CameraMotion)
    """Rotation of the camera; by default none."""
    sensor: SensorModel = field(default_factory=SensorModel)
    """Model of the sensor's pixels and readout."""
    encoder_model: EncoderModel | None = field(default_factory=EncoderModel)
    """Errors of the encoder; None for a camera without a prism, whose recording has neither encoder nor prism."""
    nominal_prism: Prism | None = None
    """Nominal prism that is stored with the recording; None for the true prism."""
    seed: int = 0
    """Seed of all random numbers of the simulation."""
    device: str = "cpu"
    """Device that computes, such as ``cpu`` or ``cuda:0``."""
    source: Mapping[str, MetadataValue] = field(default_factory=dict)
    """Description of what the scene was made from; it becomes part of the recording's metadata."""

    def __post_init__(self) -> None:
        if not isinstance(self.scene, WorldScene):
            instance(self.scene, Scene, "simulation's scene")
        kinds: dict[str, type] = {"camera": Camera, "prism": Prism, "motion": PrismMotion, "sensor": SensorModel,
                 "camera_motion": CameraMotion}  # fmt: skip
        if self.encoder_model is not None:
            kinds["encoder_model"] = EncoderModel
        for name, kind in kinds.items():
            instance(getattr(self, name), kind, f"simulation's {name}")
        real(self.duration_s, "duration_s", 1e-3, LONGEST_S, " s")
        if self.camera.width * self.camera.height > 1 << 22:
            given = f"{self.camera.width}x{self.camera.height}"
            raise AmiwarpError(f"camera of {given} has more than 4194304 pixels; give a smaller camera")
        whole(self.seed, "seed", 0, (1 << 31) - 1)

    @property
    def duration_us(self) -> int:
        """Duration of the recording, rounded [us]."""
        return round(self.duration_s * 1e6)

    @property
    def true_model(self) -> ExactModel:
        """True optical model of the prism."""
        motion = self.motion
        return ExactModel(self.camera, self.prism, motion.phase, motion.tilt, motion.cylinder, motion.wobble)
