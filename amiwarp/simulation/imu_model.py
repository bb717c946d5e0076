"""Model of an inertial measurement unit (IMU) that moves with a simulated camera."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.other_sensors import ImuSamples
from amiwarp.io.file_sensors import GRAVITY
from amiwarp.schema.calls import guarded
from amiwarp.simulation.motion import CameraMotion, rates_of
from amiwarp.simulation.worlds.trajectory import Trajectory, derivatives_of
from amiwarp.validation import array, one_of, real, whole

UP_IN_WORLD = (0.0, 0.0, 1.0)
UP_IN_PICTURE = (0.0, -1.0, 0.0)
"""Directions that point away from the ground: in a world, and in the frame of a picture, whose y axis points down."""
LONGEST_S = 1e6
"""Longest simulated time [s]."""
MOST_SAMPLES = 100_000_000
"""Largest number of samples of one simulation."""
SEED_OF_IMU = 0x1A0
"""Number that makes the random numbers of an IMU independent of the random numbers of pixels and encoder."""
MILLI_G = 1e-3 * GRAVITY
MICRO_G = 1e-6 * GRAVITY
"""Units of data sheets [m/s^2]."""


@dataclass(frozen=True)
class Motion:
    """Motion of a camera at some instants."""

    to_world: NDArray[np.float64]
    """Rotation matrices from the camera's frame to the world's, shape ``(n, 3, 3)``."""
    acceleration: NDArray[np.float64]
    """Acceleration of the camera's centre in the world [m/s^2], shape ``(n, 3)``."""
    angular_velocity: NDArray[np.float64]
    """Angular velocity in the camera's frame [rad/s], shape ``(n, 3)``."""
    angular_acceleration: NDArray[np.float64]
    """Angular acceleration in the camera's frame [rad/s^2], shape ``(n, 3)``."""


MotionAt = Callable[[NDArray[np.float64]], Motion]
"""Function that returns the motion at times [s], shape ``(n,)``."""


@guarded
@dataclass(frozen=True)
class ImuModel:
    """Gyroscope and accelerometer of a simulated camera: their place, rate and errors.

    A sample is the true value, plus a bias that is drawn once and then walks at random, plus white noise; it is clipped
    to the range and rounded to the resolution. The default has no errors.

    Notes
    -----
    Noise follows the usual model of Allan deviations (IEEE Std 952): white noise of density ``d`` has the standard
    deviation ``d * sqrt(rate)`` in each sample, and a bias that walks by ``w`` changes by ``w * sqrt(dt)``.

    Examples
    --------
    >>> amiwarp.ImuModel.preset("bmi160").rate_hz
    200.0
    """

    rate_hz: float = 200.0
    """Samples per second [Hz], 1 to 100,000."""
    gyroscope_noise: float = 0.0
    """Density of the gyroscope's white noise [rad/s/sqrt(Hz)]."""
    gyroscope_walk: float = 0.0
    """Random walk of the gyroscope's bias [rad/s^2/sqrt(Hz)]."""
    gyroscope_bias: float = 0.0
    """Standard deviation of the gyroscope's first bias, of each axis [rad/s]."""
    accelerometer_noise: float = 0.0
    """Density of the accelerometer's white noise [m/s^2/sqrt(Hz)]."""
    accelerometer_walk: float = 0.0
    """Random walk of the accelerometer's bias [m/s^3/sqrt(Hz)]."""
    accelerometer_bias: float = 0.0
    """Standard deviation of the accelerometer's first bias, of each axis [m/s^2]."""
    gyroscope_range: float | None = None
    """Largest angular velocity that is measured [rad/s]; None for any."""
    accelerometer_range: float | None = None
    """Largest acceleration that is measured [m/s^2]; None for any."""
    bits: int = 0
    """Bits of a sample over twice the range, 8 to 32; 0 for samples that are not rounded."""
    to_camera: ArrayLike = field(default_factory=lambda: np.eye(3))
    """Rotation matrix from the IMU's axes to the camera's, shape ``(3, 3)``."""
    position: ArrayLike = (0.0, 0.0, 0.0)
    """Place of the accelerometer in the camera's frame [m], shape ``(3,)``."""

    def __post_init__(self) -> None:
        limits = {
            "gyroscope_noise": 1.0,
            "gyroscope_walk": 1.0,
            "gyroscope_bias": 10.0,
            "accelerometer_noise": 10.0,
            "accelerometer_walk": 10.0,
            "accelerometer_bias": 100.0,
        }
        object.__setattr__(self, "rate_hz", real(self.rate_hz, "IMU rate_hz", 1.0, 1e5, " Hz"))
        for name, limit in limits.items():
            object.__setattr__(self, name, real(getattr(self, name), f"IMU {name}", 0.0, limit))
        for name in ("gyroscope_range", "accelerometer_range"):
            value = getattr(self, name)
            if value is not None:
                object.__setattr__(self, name, real(value, f"IMU {name}", 1e-3, 1e5))
        self._check_bits()
        place = array(self.position, "IMU position").astype(np.float64)
        if place.shape != (3,) or not (np.abs(place) <= 10.0).all():
            raise AmiwarpError(
                f"IMU position is {place.tolist()}; give 3 numbers of at most 10 m, in the camera's frame"
            )
        object.__setattr__(self, "position", place)
        rotation = array(self.to_camera, "IMU to_camera").astype(np.float64)
        nothing = np.zeros((0, 3))
        ImuSamples(np.zeros(0, np.int64), nothing, nothing, rotation)  # checks the rotation
        object.__setattr__(self, "to_camera", rotation)

    def _check_bits(self) -> None:
        """Raise :class:`AmiwarpError` for a number of bits that is not known, or has no range."""
        bits = whole(self.bits, "IMU bits", 0, 32)
        if bits == 0:
            return
        if bits < 8:
            raise AmiwarpError(f"IMU bits is {bits}; give 8 to 32, or 0 for samples as they are")
        for name in ("gyroscope_range", "accelerometer_range"):
            if getattr(self, name) is None:
                raise AmiwarpError(
                    f"IMU bits is {bits}, but {name} is unlimited; give {name}, or bits=0"
                )

    @classmethod
    def preset(cls, name: str) -> ImuModel:
        """Return the model of a known IMU.

        Parameters
        ----------
        name : str
            ``bmi160`` (Bosch; in the DVXplorer), ``mpu6500`` (InvenSense; in the DAVIS346) or ``ideal``.

        Returns
        -------
        ImuModel
            The model, in the camera's centre and with the camera's axes.

        Raises
        ------
        AmiwarpError
            If the name is unknown.

        Notes
        -----
        - ``bmi160``: data sheet BST-BMI160-DS000 (Bosch Sensortec): noise 0.007 deg/s/sqrt(Hz) and 180
          ug/sqrt(Hz), zero offsets 3 deg/s and 40 mg, ranges 2000 deg/s and 16 g, 16 bits.
        - ``mpu6500``: data sheet PS-MPU-6500A-01 (InvenSense): noise 0.01 deg/s/sqrt(Hz) and 300 ug/sqrt(Hz),
          zero offsets 5 deg/s and 60 mg, ranges 2000 deg/s and 16 g, 16 bits.

        Zero offsets are taken as one standard deviation. No data sheet states how biases walk: 2e-5 rad/s^2/sqrt(Hz)
        and 3e-4 m/s^3/sqrt(Hz) are values of the order that calibrations of such sensors give, without a source.

        Examples
        --------
        >>> amiwarp.ImuModel.preset("mpu6500").bits
        16
        """
        return _PRESETS[one_of(name, _PRESETS, "IMU preset")]

    def follow(
        self,
        trajectory: Trajectory,
        duration_s: float,
        *,
        gravity: float = GRAVITY,
        seed: int = 0,
    ) -> ImuSamples:
        """Simulate the samples of an IMU whose camera follows a trajectory.

        Parameters
        ----------
        trajectory : Trajectory
            Poses of the camera in the world, whose z axis points up. Where the trajectory ends, the camera stands still
            at once: no sample has the jolt.
        duration_s : float
            Duration [s]. The first sample is at 0.
        gravity : float, optional
            Acceleration of gravity [m/s^2].
        seed : int, optional
            Seed of all random numbers.

        Returns
        -------
        ImuSamples
            Samples with the rotation to the camera's axes. At rest, the acceleration points up.

        Raises
        ------
        AmiwarpError
            If a value is out of range, or there are too many samples.

        Examples
        --------
        >>> still = amiwarp.Trajectory.still([0, 0, 0], look_at=[1, 0, 0])
        >>> imu = amiwarp.ImuModel(rate_hz=100).follow(still, 0.1)
        >>> len(imu), imu.acceleration[0].round(5).tolist()
        (11, [0.0, -9.80665, 0.0])
        """
        up = real(gravity, "gravity", 0.0, 100.0, " m/s^2") * np.array(UP_IN_WORLD)
        return self._measure(lambda t: motion_of(trajectory, t), duration_s, up, seed)

    def turn(
        self,
        rotation: CameraMotion,
        duration_s: float,
        *,
        gravity: float = GRAVITY,
        seed: int = 0,
    ) -> ImuSamples:
        """Simulate the samples of an IMU whose camera turns in front of a picture.

        Parameters
        ----------
        rotation : CameraMotion
            Rotation of the camera. At t = 0 the camera's y axis points to the ground.
        duration_s : float
            Duration [s]. The first sample is at 0.
        gravity : float, optional
            Acceleration of gravity [m/s^2].
        seed : int, optional
            Seed of all random numbers.

        Returns
        -------
        ImuSamples
            Samples with the rotation to the camera's axes.

        Raises
        ------
        AmiwarpError
            If a value is out of range, or there are too many samples.

        Examples
        --------
        >>> imu = amiwarp.ImuModel().turn(amiwarp.CameraMotion((0.0, 0.5, 0.0)), 0.1)
        >>> imu.angular_velocity[0].tolist()
        [0.0, 0.5, 0.0]
        """
        up = real(gravity, "gravity", 0.0, 100.0, " m/s^2") * np.array(UP_IN_PICTURE)

        def motion_at(t: NDArray[np.float64]) -> Motion:
            return rotation_of(rotation, duration_s, t)

        return self._measure(motion_at, duration_s, up, seed)

    def _measure(
        self, motion_at: MotionAt, duration_s: float, up: NDArray[np.float64], seed: int
    ) -> ImuSamples:
        """Return the samples of a motion. ``up``: what an accelerometer at rest reads, in the world [m/s^2]."""
        duration_s = real(duration_s, "duration_s", 1e-3, LONGEST_S, " s")
        whole(seed, "seed", 0, (1 << 31) - 1)
        count = math.floor(duration_s * self.rate_hz) + 1
        if count > MOST_SAMPLES:
            raise AmiwarpError(
                f"{duration_s:g} s at {self.rate_hz:g} Hz are {count:,} IMU samples; give at most {MOST_SAMPLES:,}"
            )
        # Time stamps are whole microseconds; the samples are true at the time stamps.
        t_us = np.rint(1e6 * np.arange(count) / self.rate_hz).astype(np.int64)
        motion = motion_at(1e-6 * t_us)
        to_camera = np.asarray(self.to_camera, np.float64)
        # Rows of vectors times R are R's transpose applied to each: from the camera's axes to the IMU's.
        turning = motion.angular_velocity @ to_camera
        felt = self._specific_force(motion, up) @ to_camera
        rng = np.random.default_rng([seed, SEED_OF_IMU])
        turning = self._with_errors(turning, "gyroscope", rng)
        felt = self._with_errors(felt, "accelerometer", rng)
        return ImuSamples(t_us, turning, felt, to_camera)

    def _specific_force(self, motion: Motion, up: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return what an accelerometer at its place feels, in the camera's frame [m/s^2], shape ``(n, 3)``."""
        in_world = motion.acceleration + up
        at_centre = np.einsum("nji,nj->ni", motion.to_world, in_world)
        lever = np.asarray(self.position, np.float64)
        tangential = np.cross(motion.angular_acceleration, lever)
        centripetal = np.cross(motion.angular_velocity, np.cross(motion.angular_velocity, lever))
        return np.asarray(at_centre + tangential + centripetal)

    def _with_errors(
        self, true: NDArray[np.float64], sensor: str, rng: np.random.Generator
    ) -> NDArray[np.float64]:
        """Return samples as a sensor measures them, from the true values, shape ``(n, 3)``."""
        noise = getattr(self, f"{sensor}_noise") * math.sqrt(self.rate_hz)
        walk = getattr(self, f"{sensor}_walk") / math.sqrt(self.rate_hz)
        limit = getattr(self, f"{sensor}_range")
        first_bias = getattr(self, f"{sensor}_bias") * rng.standard_normal(3)
        steps = walk * rng.standard_normal(true.shape)
        steps[0] = first_bias
        bias = np.cumsum(steps, axis=0)
        measured = true + bias + noise * rng.standard_normal(true.shape)
        if limit is None:
            return np.asarray(measured)
        measured = np.clip(measured, -limit, limit)
        if self.bits:
            # The largest code is one step below the range, as in two's complement.
            step = limit / 2 ** (self.bits - 1)
            codes = np.clip(
                np.rint(measured / step), -(2 ** (self.bits - 1)), 2 ** (self.bits - 1) - 1
            )
            measured = codes * step
        return np.asarray(measured)


def motion_of(trajectory: Trajectory, t: NDArray[np.float64]) -> Motion:
    """Return how a trajectory moves at times [s], shape ``(n,)``. Outside of its poses, the camera stands still."""
    to_world, _ = trajectory.poses(t)
    acceleration = np.zeros((len(t), 3))
    rate = np.zeros((len(t), 3))
    rate_change = np.zeros((len(t), 3))
    times = np.asarray(trajectory.t, np.float64)
    moving = (t >= times[0]) & (t <= times[-1])
    if len(times) > 1 and moving.any():
        acceleration[moving], rate[moving], rate_change[moving] = derivatives_of(
            trajectory, t[moving]
        )
    return Motion(to_world, acceleration, rate, rate_change)


def rotation_of(motion: CameraMotion, duration_s: float, t: NDArray[np.float64]) -> Motion:
    """Return how a camera turns in front of a picture at times [s], shape ``(n,)``."""
    to_picture = motion.orientation(duration_s)(np.clip(t, 0.0, duration_s))
    rate = rates_of(motion, t)
    half_s = 1e-4
    ahead = rates_of(motion, t + half_s)
    behind = rates_of(motion, t - half_s)
    return Motion(to_picture, np.zeros_like(rate), rate, (ahead - behind) / (2.0 * half_s))


_BMI160 = ImuModel(
    gyroscope_noise=math.radians(0.007),
    gyroscope_walk=2e-5,
    gyroscope_bias=math.radians(3.0),
    accelerometer_noise=180.0 * MICRO_G,
    accelerometer_walk=3e-4,
    accelerometer_bias=40.0 * MILLI_G,
    gyroscope_range=math.radians(2000.0),
    accelerometer_range=16.0 * GRAVITY,
    bits=16,
)
_MPU6500 = replace(
    _BMI160,
    gyroscope_noise=math.radians(0.01),
    gyroscope_bias=math.radians(5.0),
    accelerometer_noise=300.0 * MICRO_G,
    accelerometer_bias=60.0 * MILLI_G,
)
_PRESETS = {"bmi160": _BMI160, "mpu6500": _MPU6500, "ideal": ImuModel()}
