"""Condition of a simulated recording: rig, scene, sensor and troubles, and which values are sensible."""

import hashlib
import json
import math
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

from amiwarp.optics.camera import Camera
from amiwarp.optics.distortion import RadialTangential
from amiwarp.optics.prism import FlatSide, Prism
from amiwarp.simulation.sensor_model import SensorModel
from amiwarp.studies.stability.scenes import SceneKind

TEXELS = 2.0
"""Texels of the scene's picture per camera pixel, in the middle of the image."""


HARDWARE_DEG = 10.0
"""Standard deviation of the phase that the simulated hardware states [deg]."""


HARDWARE_APEX = 0.05
"""Relative standard deviation of the nominal apex angle that the simulated hardware states."""


@dataclass(frozen=True)
class Condition:
    """Condition under which a recording is simulated. The defaults are harmless.

    Equal conditions and equal seeds give equal recordings.
    """

    scene: str = SceneKind.TEXTURE.value
    """Kind of scene: a value of :class:`SceneKind`."""
    width: int = 320
    """Width of the camera's image [px]."""
    height: int = 240
    """Height of the camera's image [px]."""
    fov_deg: float = 60.0
    """Horizontal field of view of the camera [deg]."""
    apex_deg: float = 1.0
    """Apex angle of the prism [deg]."""
    rpm: float = 720.0
    """Speed of the prism [turns/min]."""
    turns: float = 4.0
    """Duration of the recording [turns of the prism]."""
    contrast: float = 0.25
    """Contrast threshold of the sensor [log intensity]."""
    window_events: int = 0
    """Number of events in the sensor's readout window; 0 for the whole sensor.

    The window is a rectangle about the middle, just large enough for that number.
    """
    lost: float = 0.0
    """Share of the events that are lost in the sensor, at random."""
    noise: float = 0.0
    """Share of background noise among all events, 0 to 1."""
    hot: float = 0.0
    """Share of hot pixels, each with 500 events/s."""
    mismatch: float = 0.03
    """Relative standard deviation of the contrast thresholds between pixels."""
    latency_us: float = 100.0
    """Latency of the sensor's pixels [us]."""
    refractory_us: float = 100.0
    """Refractory period of the pixels [us]."""
    readout_us: float = 0.0
    """Interval of readout scans [us]; time stamps are moved to the end of their scan. 0 for none."""
    cutoff_hz: float = 0.0
    """Bandwidth of the photoreceptor at white [Hz]; 0 for unlimited."""
    bus_rate_mev_s: float = 0.0
    """Largest rate of events on the sensor's bus [million events/s]; 0 for unlimited."""
    counts_per_turn: int = 8192
    """Resolution of the encoder [counts/turn]."""
    jitter_deg: float = 0.0
    """Standard deviation of the angle of an encoder sample [deg]."""
    clock_offset_us: float = 0.0
    """Offset between the clocks of encoder and camera [us]."""
    dropouts_hz: float = 0.0
    """Rate of drop-outs, in which encoder samples are lost [1/s]."""
    encoder_scale: float = 0.0
    """Relative error of the scale of the encoder's angles."""
    slip_deg: float = 0.0
    """Angle that the encoder loses per second [deg], in two steps per turn."""
    backwards: bool = False
    """Whether the encoder counts in the wrong direction."""
    ripple: float = 0.0
    """Relative amplitude of the speed ripple, three periods per turn; the encoder measures it."""
    flat_side_wrong: bool = False
    """Whether the recording states the wrong flat side."""
    focal_error: float = 0.0
    """Relative error of the focal length that the recording states."""
    principal_px: float = 0.0
    """Error of the principal point that the recording states, along x [px]."""
    distortion: float = 0.0
    """Distortion coefficient k1 of the true camera, which the recording does not state."""
    start: str = "none"
    """Phase that is given to the calibration: ``none``, ``right``, or ``wrong`` (by 90 degrees)."""
    lamp: float = 0.0
    """Share of the picture that flickers at 100 Hz."""
    passing: float = 0.0
    """Share of the picture that a passing object hides; its speed is half the picture's width per second."""
    camera_deg_s: float = 0.0
    """Speed of the camera's rotation [deg/s], about a tilted axis."""
    cancelled: float = 0.0
    """Share of the prism's motion in the image that a rotation of the camera cancels."""
    eccentric_deg: float = 0.0
    """Amplitude of the encoder's error that repeats once a turn [deg], at a random angle."""
    second_deg: float = 0.0
    """Amplitude of the encoder's error that repeats twice a turn [deg], at a random angle."""
    index_only: bool = False
    """Whether the encoder gives but one index pulse per turn."""
    turn_ripple: float = 0.0
    """Relative amplitude of the speed ripple, one period per turn, at a random angle."""
    no_encoder: bool = False
    """Whether the recording has no encoder."""
    ramp: float = 0.0
    """Share of the speed that is missing at the start of the recording; the speed then rises linearly."""
    cylinder_deg: float = 0.0
    """Change of the apex over the image, by cylinder power at a random azimuth [deg per unit of the ray's tangent]."""
    wobble_deg: float = 0.0
    """Angle between the prism's axis and the axis of rotation, at a random azimuth [deg]."""
    column_us: float = 0.0
    """Delay of the events from each column of pixels to the next [us]."""
    line_us: float = 0.0
    """Delay of the events from each row of pixels to the next [us]."""
    row_us: float = 0.0
    """Time to read out a row of pixels, one row after the other without a pause [us]; 0 for all at once."""
    aspect_error: float = 0.0
    """True fy / fx - 1; the recording states 0."""
    index_error: float = 0.0
    """True refractive index of the prism minus the one that the recording states."""
    lost_part: float = 0.0
    """Share of each turn whose events are lost, always the same part."""
    timing_known: bool = False
    """Whether latency and refractory period are given to the calibration. Else their effect is part of the phase.

    With an optic, the refractory period is given, and the latency is not."""

    optic: str = ""
    """Optic of the recording, one of :data:`amiwarp.studies.stability.optics.OPTICS`: sizes and speeds are then drawn
    by seed, and ``apex_deg``, ``rpm`` and ``turns`` do not count. Empty for a wedge with these."""
    third_deg: float = 0.0
    """Amplitude of the encoder's error that repeats three times a turn [deg], at a random angle."""
    index_jitter_us: float = 0.0
    """Standard deviation of the time of an index pulse [us]."""
    hunt: float = 0.0
    """Relative amplitude of a swing of the speed, at ``hunt_hz``."""
    hunt_hz: float = 0.0
    """Frequency of this swing [Hz]."""
    lost_once_deg: float = 0.0
    """Angle by which the first encoder is behind once it has lost counts, at a random time [deg]."""
    swapped: bool = False
    """Whether the encoders of both prisms are swapped."""
    command_cubic: float = 0.0
    """Relative part of a mirror's tilt that is proportional to the cube of its command."""
    command_square: float = 0.0
    """Relative part of a mirror's tilt that is proportional to the square of its command."""
    third_px: float = 0.0
    """Radius of the third harmonic of a vibration [px]."""
    unsteady: float = 0.0
    """Relative amplitude of the slow change of a vibration's amplitude."""
    plate_wedge_arcmin: float = 0.0
    """Angle between the faces of a plate, in a random direction [arcmin]."""

    @property
    def key(self) -> str:
        """Hash of the settings, which identifies the condition.

        Later fields count only if they differ from the default, so that earlier results stay valid.
        """
        settings = {
            name: value
            for name, value in asdict(self).items()
            if value or name not in _LATER_FIELDS
        }
        return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:16]

    @property
    def camera(self) -> Camera:
        """Camera with the true intrinsics."""
        camera = Camera.from_fov(self.width, self.height, math.radians(self.fov_deg))
        camera = replace(camera, fy=camera.fy * (1.0 + self.aspect_error))
        if self.distortion:
            camera = replace(camera, distortion=RadialTangential(k1=self.distortion))
        return camera

    @property
    def stated_camera(self) -> Camera:
        """Camera with the intrinsics that the recording states."""
        true = self.camera
        scale = 1.0 + self.focal_error
        return replace(
            true,
            fx=true.fx * scale,
            fy=true.fx * scale,
            cx=true.cx + self.principal_px,
            distortion=None,
        )

    @property
    def stated_side(self) -> FlatSide:
        """Flat side of the prism that the recording states."""
        return FlatSide.CAMERA if self.flat_side_wrong else FlatSide.SCENE

    @property
    def prism(self) -> Prism:
        """Prism with the true parameters."""
        return Prism(math.radians(self.apex_deg))

    @property
    def duration_s(self) -> float:
        """Duration of the recording [s]."""
        return self.turns * 60.0 / self.rpm

    @property
    def sensor(self) -> SensorModel:
        """Sensor without background noise."""
        return SensorModel(
            contrast_on=self.contrast,
            contrast_off=self.contrast,
            mismatch=self.mismatch,
            latency_us=self.latency_us,
            refractory_us=self.refractory_us,
            hot_fraction=self.hot,
            hot_hz=500.0,
            shot_noise_hz=0.1,
            leak_hz=0.1,
            cutoff_hz=self.cutoff_hz,
            bus_rate_mev_s=self.bus_rate_mev_s,
            row_us=self.row_us,
        )


_LATER_FIELDS = (
    "cutoff_hz",
    "bus_rate_mev_s",
    "principal_px",
    "encoder_scale",
    "eccentric_deg",
    "second_deg",
    "index_only",
    "turn_ripple",
    "no_encoder",
    "ramp",
    "cylinder_deg",
    "wobble_deg",
    "column_us",
    "line_us",
    "row_us",
    "aspect_error",
    "index_error",
    "lost_part",
    "timing_known",
    "optic",
    "third_deg",
    "index_jitter_us",
    "hunt",
    "hunt_hz",
    "lost_once_deg",
    "swapped",
    "command_cubic",
    "command_square",
    "third_px",
    "unsteady",
    "plate_wedge_arcmin",
)
"""Fields of :class:`Condition` with default 0 that did not exist when the first cells were stored."""


LARGEST_VALUES: dict[str, float] = {
    "noise": 0.5, "camera_deg_s": 30.0, "jitter_deg": 0.5,
    "contrast": 0.6, "lost": 0.1, "hot": 0.001, "mismatch": 0.1, "latency_us": 1000.0, "refractory_us": 1000.0,
    "readout_us": 500.0, "clock_offset_us": 1000.0, "dropouts_hz": 10.0, "slip_deg": 0.0, "backwards": 0.0,
    "encoder_scale": 1e-4, "ripple": 0.2, "focal_error": 0.03, "principal_px": 10.0, "lamp": 0.05,
    "passing": 0.02, "cancelled": 0.0,
    "eccentric_deg": 3.0,  # a disc of 10 mm radius, half a millimetre off centre
    "second_deg": 1.0,  # sine and cosine signals of an encoder whose amplitudes differ by 3.5 %
    "turn_ripple": 0.1,  # a small motor that turns an unbalanced prism
    "ramp": 1.0,  # the recording begins when the motor is switched on
    "cylinder_deg": 0.1,  # a cast wedge, bent by 7 um over 25 mm, 20 mm in front of the pupil
    "wobble_deg": 0.5,  # 0.2 mm of play in a mount 20 mm wide
    "column_us": 1.0, "line_us": 1.0,  # the whole sensor within 0.3 ms, as at 3,000 scans per second
    "row_us": 4.0,  # 240 rows within 1 ms
    "aspect_error": 0.03,  # pictures of the lens calibration that were resized, 640x480 to 640x466
    "index_error": 0.06,  # fused silica taken for N-BK7
    "lost_part": 0.4,  # a guard, or a bus that is full whenever the longest edges move
    "third_deg": 0.5,  # a magnetic encoder after its own linearisation
    "index_jitter_us": 200.0,  # pulses that a microcontroller reads between other work
    "hunt": 0.03, "hunt_hz": 20.0,  # a small motor whose controller is not tuned
    "lost_once_deg": 9.0,  # 100 counts of 4,096, while a microcontroller is busy
    "swapped": 1.0,  # two plugs that fit both sockets
    "command_cubic": 0.1,  # a mirror that is driven without feedback, up to its limit
    "command_square": 0.05,  # the same, about a position at rest that is off its middle
    "third_px": 0.25,  # a shaker driven hard, with no spring
    "unsteady": 0.15,  # a shaker held in a hand
    "plate_wedge_arcmin": 2.0,  # a window from stock; better ones have 0.1
}  # fmt: skip
"""Largest values of the condition fields for which a calibration is expected to work."""


SMALLEST_VALUES: dict[str, float] = {
    "turns": 0.5,
    "counts_per_turn": 64,
    "distortion": -0.08,
    "apex_deg": 0.5,
}
"""Smallest values of the condition fields for which a calibration is expected to work.

An apex of 0.5 degrees gives an orbit of 1.2 px; at 0.25 degrees the orbit lies within a pixel.
"""


SMALLEST_OR_NONE: dict[str, float] = {"cutoff_hz": 300.0, "bus_rate_mev_s": 3.0}
"""Smallest values of condition fields for which a calibration is expected to work, where 0 also does, because it means
no limit."""


FEWEST_EVENTS = 20_000
"""Smallest number of events for which a calibration is expected to work."""


OPTIC_ALWAYS: dict[str, tuple[float, float]] = {
    "fov_deg": (45.0, 75.0),
    "contrast": (0.15, 0.35),
    "mismatch": (0.0, 0.08),
    "noise": (0.0, 0.2),
    "latency_us": (50.0, 300.0),
}
"""Ranges of the condition fields that every random combination with an optic draws."""


def sensible(condition: Condition, events: int) -> bool:
    """Return whether a calibration is expected to work under a condition (the sensible region).

    That is a working rig, and a scene that the aims cover.
    """
    if events < FEWEST_EVENTS:
        return False
    if condition.scene not in (SceneKind.TEXTURE, SceneKind.EDGES, SceneKind.PRINT):
        return False
    for name, most in LARGEST_VALUES.items():
        if not getattr(condition, name) <= most:
            return False
    for name, least in SMALLEST_VALUES.items():
        if not getattr(condition, name) >= least:
            return False
    for name, least in SMALLEST_OR_NONE.items():
        value = getattr(condition, name)
        if value and not value >= least:
            return False
    return True


COMBINED = 8
"""Number of axes that combine two troubles."""


# Axes of every optic: one list, and the optics that each applies to.


def troubles_of(c: Condition) -> list[str]:
    """Return the fields of a condition that are a trouble: not the default, nor what every combination may have."""

    def harmless(name: str, default: Any) -> bool:
        value = getattr(c, name)
        low, high = OPTIC_ALWAYS.get(name, (default, default))
        return name == "optic" or value == default or low <= value <= high

    return [field.name for field in fields(Condition) if not harmless(field.name, field.default)]


@dataclass(frozen=True)
class Cell:
    """Condition and seed of one recording of the study."""

    condition: Condition
    """Condition under which the recording is simulated."""
    seed: int
    """Seed of the simulated recording and of the search."""

    @property
    def name(self) -> str:
        """Name of the file of the cell, without its ending."""
        return f"{self.condition.key}_{self.seed}"
