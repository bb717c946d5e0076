"""Cameras of a simulated rig: event cameras, cameras with frames, and depth cameras."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.rig_recording import check_sensor_name, check_to_rig
from amiwarp.optics.camera import Camera
from amiwarp.optics.prism import Plate, Prism
from amiwarp.results.pixel_map import PixelMap
from amiwarp.schema.calls import guarded
from amiwarp.simulation.choices import FrameEncoding, Seeing
from amiwarp.simulation.encoder_model import EncoderModel
from amiwarp.simulation.imu_model import ImuModel
from amiwarp.simulation.motion import LONGEST_S, Mirror, PrismMotion, Steerer, Vibration
from amiwarp.simulation.sensor_model import SensorModel
from amiwarp.simulation.worlds.world_scene import BLUR_PX
from amiwarp.validation import array, choice, instance, real, whole

FARTHEST_M = 100.0
"""Largest distance of a camera from the origin of its rig, along each axis [m]."""
FASTEST_HZ = 1e5
"""Largest rate of frames [1/s]."""
LONGEST_US = 10_000_000
"""Longest exposure or readout [us]."""
MOST_FRAMES = 1_000_000
"""Largest number of frames of a recording."""
MOST_ELECTRONS = 1e9
"""Largest number of electrons of a pixel."""


def at_origin() -> NDArray[np.float64]:
    """Return the matrix of a camera whose frame is the rig's, shape (3, 4)."""
    return np.eye(3, 4)


def checked_place(to_rig: ArrayLike) -> NDArray[np.float64]:
    """Return a camera's ``to_rig`` as float64, shape (3, 4), with a rotation that is exact.

    Raises :class:`AmiwarpError` if it is no rotation with a place.
    """
    from scipy.spatial.transform import Rotation

    matrix = array(to_rig, "to_rig").astype(np.float64)
    check_to_rig(matrix)
    if np.abs(matrix[:, 3]).max() > FARTHEST_M:
        raise AmiwarpError(
            f"to_rig places the camera at {matrix[:, 3].tolist()} m; give at most {FARTHEST_M:g} m along each axis"
        )
    turn = Rotation.from_matrix(matrix[:, :3]).as_matrix()
    return np.column_stack([turn, matrix[:, 3]])


@dataclass(frozen=True, eq=False)
class _OnRig:
    """Camera at its place on a rig."""

    camera: Camera
    """Camera intrinsics with the lens distortion."""
    to_rig: ArrayLike = field(default_factory=at_origin, kw_only=True)
    """Matrix that turns points in the camera's frame (x right, y down, z forward) into the rig's frame, shape ``(3,
    4)``: rotation, and place [m] in the last column."""

    def __post_init__(self) -> None:
        instance(self.camera, Camera, "rig's camera")
        object.__setattr__(self, "to_rig", checked_place(self.to_rig))


@guarded
@dataclass(frozen=True, eq=False)
class RigEventCamera(_OnRig):
    """Event camera of a rig, with or without an optic that moves its image.

    Examples
    --------
    >>> import numpy as np
    >>> beside = np.column_stack([np.eye(3), (0.06, 0.0, 0.0)])
    >>> amiwarp.RigEventCamera(amiwarp.Camera.from_fov(32, 24, 1.0), to_rig=beside).prism is None
    True
    """

    prism: Prism | Plate | Vibration | Mirror | Steerer | None = None
    """Optic in front of the camera, as in :class:`amiwarp.Simulation`; None for a plain event camera, whose recording
    has neither encoder nor prism."""
    motion: PrismMotion | float = field(default_factory=PrismMotion, kw_only=True)
    """Motion of the prism, or its constant speed [turns/min]."""
    sensor: SensorModel = field(default_factory=SensorModel, kw_only=True)
    """Model of the sensor's pixels and readout."""
    encoder_model: EncoderModel | None = field(default_factory=EncoderModel, kw_only=True)
    """Errors of the encoder; without a prism it has no effect."""
    nominal_prism: Prism | Plate | None = field(default=None, kw_only=True)
    """Nominal prism or plate that is stored with the recording; None for the true one."""
    pixels: PixelMap | None = field(default=None, kw_only=True)
    """Thresholds and hot and dead pixels; None to draw them by the sensor's model."""
    imu: ImuModel | None = field(default=None, kw_only=True)
    """Gyroscope and accelerometer that move with the camera; None for a recording without."""
    blur: float = field(default=BLUR_PX, kw_only=True)
    """Standard deviation of the optical blur, including the area of the pixel [px]."""
    seeing: Seeing = field(default=Seeing.MAPS, kw_only=True)
    """Method by which the light that each pixel receives is computed."""
    samples: int | None = field(default=None, kw_only=True)
    """Number of rays per pixel or texel: 1, 4, 9 or 16; None stands for 4."""
    motion_px: float = field(default=0.5, kw_only=True)
    """Largest motion of the image between two successive maps [px]."""
    truth_hz: float | None = field(default=None, kw_only=True)
    """Rate of the instants whose ground truth is recorded [1/s]; None for none."""

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "blur", real(self.blur, "blur", 0.0, 20.0, " px"))
        object.__setattr__(self, "seeing", choice(Seeing, self.seeing, "seeing"))
        real(self.motion_px, "motion_px", 0.01, 2.0, " px")
        if self.truth_hz is not None:
            real(self.truth_hz, "truth_hz", 1e-3, 1e6, " 1/s")


@guarded
@dataclass(frozen=True, eq=False)
class RigFrameCamera(_OnRig):
    """Camera of a rig that takes frames: grey or colour, with exposure time and rolling or global shutter.

    A frame is the mean of the light in the exposure of each of its rows. Row ``i`` of ``h`` begins
    ``i / (h - 1) * readout_us`` after the top row.

    Notes
    -----
    With ``electrons``, a pixel collects ``electrons * light / white`` electrons. Their number has Poisson's
    distribution; the readout adds Gaussian noise of ``read_noise`` electrons. There is neither dark current nor fixed
    pattern noise. This is the linear model of the standard EMVA 1288, with both nonuniformities left out.

    Examples
    --------
    >>> amiwarp.RigFrameCamera(amiwarp.Camera.from_fov(32, 24, 1.0), colour=True, rate_hz=60).times(0.05).tolist()
    [2500, 19167, 35833]
    """

    rate_hz: float = field(default=30.0, kw_only=True)
    """Frames per second. The first exposure begins at 0."""
    exposure_us: int = field(default=5000, kw_only=True)
    """Exposure time of each row [us]."""
    readout_us: int = field(default=0, kw_only=True)
    """Time between the begins of the top row's and the bottom row's exposure [us]; 0 for a global shutter."""
    colour: bool = field(default=False, kw_only=True)
    """Whether the frames have red, green and blue; otherwise they are grey."""
    bits: int = field(default=8, kw_only=True)
    """Bits of a value: 8 (uint8) or 16 (uint16)."""
    encoding: FrameEncoding = field(default=FrameEncoding.SRGB, kw_only=True)
    """Relation of values and light."""
    white: float = field(default=1.0, kw_only=True)
    """Luminance of the largest value; brighter light is clipped."""
    electrons: float | None = field(default=None, kw_only=True)
    """Electrons of a pixel at ``white``, which determine the shot noise; None for frames without noise."""
    read_noise: float = field(default=0.0, kw_only=True)
    """Standard deviation of the readout noise [electrons]. Needs ``electrons``."""
    blur: float = field(default=BLUR_PX, kw_only=True)
    """Standard deviation of the optical blur, including the area of the pixel [px]."""
    samples: int | None = field(default=None, kw_only=True)
    """Number of rays per pixel and instant: 1, 4, 9 or 16; None stands for 4."""

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "blur", real(self.blur, "blur", 0.0, 20.0, " px"))
        object.__setattr__(self, "rate_hz", checked_rate(self.rate_hz))
        longest = min(LONGEST_US, math.floor(1e6 / self.rate_hz))
        hint = " us, at most the time between two frames"
        whole(self.exposure_us, "exposure_us", 1, longest, hint)
        whole(self.readout_us, "readout_us", 0, longest, hint)
        if whole(self.bits, "bits", 8, 16) not in (8, 16):
            raise AmiwarpError(f"bits is {self.bits}; give 8 or 16")
        object.__setattr__(self, "encoding", choice(FrameEncoding, self.encoding, "encoding"))
        object.__setattr__(self, "white", real(self.white, "white", 1e-6, 1e6))
        if self.electrons is not None:
            electrons = real(self.electrons, "electrons", 1.0, MOST_ELECTRONS)
            object.__setattr__(self, "electrons", electrons)
        read_noise = real(self.read_noise, "read_noise", 0.0, MOST_ELECTRONS, " electrons")
        object.__setattr__(self, "read_noise", read_noise)
        if self.read_noise and self.electrons is None:
            raise AmiwarpError(
                f"read_noise is {self.read_noise:g}, but electrons is not given; give electrons, the number at white"
            )

    def exposures(self, duration_s: float) -> NDArray[np.int64]:
        """Return when the middle row's exposure of each frame begins and ends.

        Parameters
        ----------
        duration_s : float
            Duration of the recording [s]. A frame whose last row ends later is not taken.

        Returns
        -------
        ndarray
            Begin and end [us], int64, shape ``(k, 2)``.
        """
        free_us = duration_us_of(duration_s) - self.exposure_us - self.readout_us
        starts = starts_at(self.rate_hz, free_us) + self.readout_us // 2
        return np.stack([starts, starts + self.exposure_us], axis=1)

    def times(self, duration_s: float) -> NDArray[np.int64]:
        """Return the times of the frames: the middle of the exposure of the middle row.

        Parameters
        ----------
        duration_s : float
            Duration of the recording [s].

        Returns
        -------
        ndarray
            Times [us], int64, shape ``(k,)``.
        """
        return self.exposures(duration_s)[:, 0] + self.exposure_us // 2


@guarded
@dataclass(frozen=True, eq=False)
class RigDepthCamera(_OnRig):
    """Depth camera of a rig: the depth of each pixel's surface along the optical axis, without noise.

    The depth of the sky is infinite. Surfaces outside of the range are unknown: NaN.

    Examples
    --------
    >>> amiwarp.RigDepthCamera(amiwarp.Camera.from_fov(32, 24, 1.0), rate_hz=100).times(0.02).tolist()
    [0, 10000, 20000]
    """

    rate_hz: float = field(default=30.0, kw_only=True)
    """Images per second. The first one is at 0."""
    nearest_m: float = field(default=0.0, kw_only=True)
    """Smallest depth that is measured [m]."""
    farthest_m: float | None = field(default=None, kw_only=True)
    """Largest depth that is measured [m]; None for any."""

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "rate_hz", checked_rate(self.rate_hz))
        real(self.nearest_m, "nearest_m", 0.0, 1e6, " m")
        if self.farthest_m is not None:
            real(self.farthest_m, "farthest_m", 0.0, 1e6, " m")
            if not self.nearest_m < self.farthest_m:
                raise AmiwarpError(
                    f"nearest_m is {self.nearest_m:g} and farthest_m {self.farthest_m:g}; give a nearer limit that is "
                    "smaller"
                )

    def times(self, duration_s: float) -> NDArray[np.int64]:
        """Return the times of the images.

        Parameters
        ----------
        duration_s : float
            Duration of the recording [s].

        Returns
        -------
        ndarray
            Times [us], int64, shape ``(k,)``.
        """
        return starts_at(self.rate_hz, duration_us_of(duration_s))


RigCamera = RigEventCamera | RigFrameCamera | RigDepthCamera
"""Any camera of a rig."""


def check_camera_names(names: Collection[str]) -> None:
    """Raise :class:`AmiwarpError` for names of a rig's cameras that cannot be names of files next to each other."""
    if not names:
        raise AmiwarpError("the rig has no sensors; give at least one camera")
    known: dict[str, str] = {}
    for name in names:
        check_sensor_name(name)
        other = known.setdefault(name.lower(), name)
        if other != name:
            raise AmiwarpError(
                f"rig has sensors named {other!r} and {name!r}; give names that differ in more than case"
            )


def checked_rate(rate_hz: float) -> float:
    """Return a rate of frames [1/s]. Raises :class:`AmiwarpError` if it is out of range."""
    return real(rate_hz, "rate_hz", 1e-3, FASTEST_HZ, " 1/s")


def duration_us_of(duration_s: float) -> int:
    """Return a duration [us]. Raises :class:`AmiwarpError` if it is out of range."""
    return round(1e6 * real(duration_s, "duration_s", 0.0, LONGEST_S, " s"))


def starts_at(rate_hz: float, latest_us: int) -> NDArray[np.int64]:
    """Return the times k / ``rate_hz`` from 0 to ``latest_us``, rounded [us], shape (n,); none if it is negative."""
    if latest_us < 0:
        return np.zeros(0, np.int64)
    count = math.floor(latest_us * rate_hz / 1e6 + 1e-9) + 1  # rounding must not lose the last
    if count > MOST_FRAMES:
        raise AmiwarpError(
            f"rate_hz {rate_hz:g} gives {count:,} frames; the limit is {MOST_FRAMES:,}; give a lower rate"
        )
    times = np.rint(np.arange(count) * (1e6 / rate_hz)).astype(np.int64)
    return times[times <= latest_us]
