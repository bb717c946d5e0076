"""Description of a simulated recording: motion, sensor, scene, and all other values that determine its events."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol, Self, cast

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.recording import MetadataValue
from amiwarp.optics.camera import Camera
from amiwarp.optics.models.base import Model
from amiwarp.optics.models.exact import ExactModel
from amiwarp.optics.models.pair import RisleyModel
from amiwarp.optics.models.plate import PlateModel
from amiwarp.optics.prism import Plate, Prism
from amiwarp.results.pixel_map import PixelMap
from amiwarp.schema.calls import guarded
from amiwarp.schema.type_names import not_called
from amiwarp.simulation.choices import Seeing
from amiwarp.simulation.encoder_model import EncoderModel
from amiwarp.simulation.imu_model import ImuModel
from amiwarp.simulation.motion import (
    LONGEST_S,
    CameraMotion,
    Commanded,
    Mirror,
    Moved,
    PrismMotion,
    Steerer,
    Vibration,
)
from amiwarp.simulation.picture_light import linear_luminance, read_picture
from amiwarp.simulation.sensor_model import SensorModel
from amiwarp.simulation.worlds.world_scene import BLUR_PX, WorldScene
from amiwarp.validation import instance, real, whole


@not_called(
    "derive a class for amiwarp.Scene, or make a scene of one picture with amiwarp.Scene.from_picture"
)
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
    blur: float = BLUR_PX
    """Standard deviation of the optical blur [sensor px], which includes the pixel's aperture."""

    def __post_init__(self) -> None:
        if self.fov is not None:
            below = math.nextafter(math.pi, 0.0)
            hint = " rad, 0 .. 180 deg; is it given in degrees?"
            object.__setattr__(self, "fov", real(self.fov, "scene fov", 1e-9, below, hint))
        object.__setattr__(self, "blur", real(self.blur, "scene blur", 0.0, 20.0, " px"))

    @classmethod
    def from_picture(
        cls, picture: str | Path | NDArray[Any], *, fov: float | None = None, blur: float = BLUR_PX
    ) -> Scene:
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
        if isinstance(picture, str | Path):
            return cls(Still(read_picture(picture)), fov, blur)
        return cls(Still(linear_luminance(picture)), fov, blur)


@dataclass(frozen=True, eq=False)
class SimulationValues:
    """Description of a simulated recording: all that determines its events."""

    scene: Scene | WorldScene
    """Scene in front of the camera: pictures at infinity, or a world."""
    camera: Camera
    """Camera intrinsics, of at most 4194304 pixels."""
    prism: Prism | Plate | Vibration | Mirror | Steerer
    """Prism, plate, mirror or beam steerer in front of the camera, with its true parameters, or vibration of a camera
    without glass. A plate needs a world, which is seen by rays."""
    duration_s: float
    """Duration of the recording [s]."""
    motion: PrismMotion | float = field(default_factory=PrismMotion)
    """Motion of the prism: speed, phase, tilt, cylinder power and wobble; or its constant speed [turns/min].

    A speed becomes a :class:`PrismMotion`. Vibrations, mirrors and beam steerers have their own motion.
    """
    camera_motion: CameraMotion = field(default_factory=CameraMotion)
    """Rotation of the camera; by default none."""
    sensor: SensorModel = field(default_factory=SensorModel)
    """Model of the sensor's pixels and readout."""
    encoder_model: EncoderModel | None = field(default_factory=EncoderModel)
    """Errors of the encoder; None for a camera without a prism, whose recording has neither encoder nor prism. A
    vibrating camera has none either way."""
    nominal_prism: Prism | Plate | None = None
    """Nominal prism or plate that is stored with the recording; None for the true one."""
    seed: int = 0
    """Seed of all random numbers of the simulation."""
    device: str = "cpu"
    """Device that computes, such as ``cpu`` or ``cuda:0``."""
    source: Mapping[str, MetadataValue] = field(default_factory=dict)
    """Description of what the scene was made from; it becomes part of the recording's metadata."""
    pixels: PixelMap | None = None
    """Thresholds and hot and dead pixels; None to draw them by the sensor's model. Unknown thresholds are drawn."""
    imu: ImuModel | None = None
    """Gyroscope and accelerometer that move with the camera; None for a recording without."""

    def __post_init__(self) -> None:
        if not isinstance(self.scene, WorldScene):
            instance(self.scene, Scene, "simulation's scene")
        if isinstance(self.prism, Moved):
            object.__setattr__(self, "motion", self.prism.motion)
        elif not isinstance(self.motion, PrismMotion):
            object.__setattr__(self, "motion", PrismMotion(self.motion))
        if isinstance(self.prism, Vibration):
            object.__setattr__(self, "encoder_model", None)
        self._check_types()
        if isinstance(self.prism, Plate):
            self._check_plate()
        elif any(self.prism_motion.wedge):
            raise AmiwarpError(
                "wedge is the angle between the faces of a plate; give a prism its apex angle"
            )
        real(self.duration_s, "duration_s", 1e-3, LONGEST_S, " s")
        self._check_pixels()
        whole(self.seed, "seed", 0, (1 << 31) - 1)
        if not isinstance(self.prism, Commanded):
            self._check_pair()

    def _check_types(self) -> None:
        """Raise :class:`AmiwarpError` for a value of another type."""
        kinds: dict[str, type] = {
            "camera": Camera,
            "sensor": SensorModel,
            "camera_motion": CameraMotion,
        }
        if not isinstance(self.prism, Plate | Moved):
            kinds["prism"] = Prism
        if self.encoder_model is not None:
            kinds["encoder_model"] = EncoderModel
        if self.imu is not None:
            kinds["imu"] = ImuModel
        for name, kind in kinds.items():
            instance(getattr(self, name), kind, f"simulation's {name}")

    def _check_pixels(self) -> None:
        """Raise :class:`AmiwarpError` for too many pixels, or a pixel map of another size."""
        camera = f"{self.camera.width}x{self.camera.height}"
        if self.camera.width * self.camera.height > 1 << 22:
            raise AmiwarpError(
                f"camera of {camera} has more than 4194304 pixels; give a smaller camera"
            )
        if self.pixels is None:
            return
        width, height = instance(self.pixels, PixelMap, "simulation's pixels").size
        if (width, height) != (self.camera.width, self.camera.height):
            raise AmiwarpError(
                f"the pixel map has {width}x{height} pixels, the camera {camera}; give the map of this camera"
            )

    def _check_pair(self) -> None:
        """Raise :class:`AmiwarpError` if only one of prism and motion is of a pair."""
        prism_has = self.glass.second is not None
        motion_has = self.prism_motion.second is not None
        if prism_has == motion_has:
            return
        has, lacks = ("prism", "motion") if prism_has else ("motion", "prism")
        raise AmiwarpError(
            f"the {has} has a second prism, the {lacks} has none; give both or neither"
        )

    @property
    def prism_motion(self) -> PrismMotion:
        """Motion of the prism, the vibration, the mirror or the beam steerer."""
        return cast(PrismMotion, self.motion)

    @property
    def duration_us(self) -> int:
        """Duration of the recording, rounded [us]."""
        return round(self.duration_s * 1e6)

    def _check_plate(self) -> None:
        """Let a world be seen by rays; raise :class:`AmiwarpError` for what a plate cannot show."""
        if not isinstance(self.scene, WorldScene):
            raise AmiwarpError(
                "a plate does not move a picture, which is at infinity; give a world (--world room)"
            )
        if any((*self.prism_motion.tilt, *self.prism_motion.cylinder, *self.prism_motion.wobble)):
            raise AmiwarpError(
                "tilt, cylinder and wobble belong to a prism; leave them out for a plate"
            )
        object.__setattr__(self, "scene", replace(self.scene, seeing=Seeing.RAYS))

    @property
    def true_model(self) -> ExactModel | RisleyModel | PlateModel:
        """True optical model of the prism, of both prisms, or of the plate in front of a scene at infinity."""
        return self.bending if self.plate is None else self.plate

    @property
    def glass(self) -> Prism:
        """The prism; one with an apex angle of 0 for any other optic."""
        return self.prism if isinstance(self.prism, Prism) else Prism(0.0)

    @property
    def at_rest(self) -> Self:
        """The same values with a prism that bends no ray, or a mirror or a beam steerer at rest."""
        if isinstance(self.prism, Commanded):
            return replace(self, prism=replace(self.prism, amplitude=(0.0, 0.0)))
        motion = replace(self.prism_motion, cylinder=(0.0, 0.0), second=None, wedge=(0.0, 0.0))
        return replace(self, prism=replace(self.glass, apex=0.0, second=None), motion=motion)

    @property
    def bending(self) -> ExactModel | RisleyModel:
        """True model of how a prism changes the direction of rays; with other optics, of one that does not."""
        motion = self.prism_motion
        second = motion.second
        prism = self.glass
        if second is None or prism.second is None:
            return ExactModel(
                self.camera, prism, motion.phase, motion.tilt, motion.cylinder, motion.wobble
            )
        end_us = [1e6 * self.duration_s]
        first_turned = motion.angle(end_us)[0]
        second_turned = second.angle(end_us)[0]
        ratio = second_turned / first_turned if first_turned else 0.0
        return RisleyModel(self.camera, prism, motion.phase, second.phase, ratio)

    @property
    def plate(self) -> PlateModel | None:
        """True model of the plate, for a scene at infinity; None for a prism."""
        if not isinstance(self.prism, Plate):
            return None
        return PlateModel(
            self.camera, self.prism, self.prism_motion.phase, wedge=self.prism_motion.wedge
        )

    @property
    def moving_model(self) -> Model:
        """True model of what changes the direction of rays: prisms, mirror, beam steerer or vibration."""
        if isinstance(self.prism, Moved):
            return self.prism.model(self.camera)
        return self.bending
