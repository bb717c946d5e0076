"""Description of a simulated recording: motion, sensor, scene, and all other values that determine its events."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Protocol, Self, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from amiwarp.choices import Seeing
from amiwarp.errors import AmiwarpError
from amiwarp.events.encoder import TWO_PI, Encoder, periodic
from amiwarp.events.recording import MetadataValue
from amiwarp.io.pixel_map import PixelMap
from amiwarp.optics.camera import Camera
from amiwarp.optics.mirror import INCIDENCE, MirrorModel
from amiwarp.optics.models import ExactModel, Model, PlateModel, RisleyModel
from amiwarp.optics.prism import Plate, Prism, check_angles, check_phase
from amiwarp.optics.vibration import PARTS, VibrationModel
from amiwarp.simulation.pictures import linear_luminance, read_picture
from amiwarp.simulation.sensor_model import SensorModel
from amiwarp.simulation.worlds.world import BLUR_PX, WorldScene
from amiwarp.validation import INT64, array, guarded, instance, not_called, real, vector, whole

# Motion of the prism and of the camera, and the encoder that measures the prism.

ROTATION_INTERVAL = 1e-3
"""Interval of the steps in which a changing angular velocity is integrated [s]."""
LARGEST_SPEED = 1e9
"""Largest accepted speed of a prism [turns/min] and of a camera's rotation [rad/s]; higher values are mistakes."""
LONGEST_S = 86400.0
"""Longest duration of a simulation [s]."""
LARGEST_OFFSET_US = 1e7
"""Largest clock offset of a simulated encoder [us]. The encoder is sampled for this much longer before and after the
events."""


@guarded
@dataclass(frozen=True, slots=True, eq=False)
class PrismMotion:
    """Motion of the prism: its tilt azimuth is ``phase + angle(t)``, with ``angle(0) = 0``.

    Examples
    --------
    >>> motion = amiwarp.PrismMotion(600.0)
    >>> motion.angle([0.0, 50_000.0]).round(4)
    array([0.    , 3.1416])
    """

    rpm: float | ArrayLike = 720.0
    """Speed of the prism [turns/min], negative for backward rotation.

    Or a table of rows (time [s], speed), interpolated linearly and constant outside, shape (n, 2).
    """
    phase: float = 0.0
    """Azimuth of the prism's tilt at encoder angle 0, θ_b [rad]."""
    tilt: tuple[float, float] = (0.0, 0.0)
    """Tilt of the axis of rotation about the camera's x and y axes [rad], as in :class:`amiwarp.ExactModel`."""
    cylinder: tuple[float, float] = (0.0, 0.0)
    """Cylinder power of the tilted face, which turns with the prism [rad], as in :class:`amiwarp.ExactModel`."""
    wobble: tuple[float, float] = (0.0, 0.0)
    """Wobble of the prism about the axis of rotation [rad], as in :class:`amiwarp.ExactModel`."""
    second: PrismMotion | None = None
    """Motion of the second prism of a pair; None for one prism."""
    wedge: tuple[float, float] = (0.0, 0.0)
    """Angle between the faces of a plate, along its tilt and across it [rad], as in :class:`amiwarp.PlateModel`."""

    def __post_init__(self) -> None:
        _check_table("prism speed", self._table())
        if self.second is not None:
            instance(self.second, PrismMotion, "motion of the second prism")
            if self.second.second is not None or any((*self.second.tilt, *self.second.cylinder, *self.second.wobble)):
                raise AmiwarpError("the motion of the second prism has more than speed and phase; leave the rest out")
            if any((*self.tilt, *self.cylinder, *self.wobble)):
                raise AmiwarpError("a pair of prisms has tilt, cylinder power or wobble; simulate one prism with them")
        object.__setattr__(self, "phase", check_phase(self.phase, "prism phase"))
        for name in ("tilt", "cylinder", "wobble", "wedge"):
            object.__setattr__(self, name, check_angles(getattr(self, name), name))

    @classmethod
    def from_function(
        cls,
        rpm: Callable[[NDArray[np.float64]], ArrayLike],
        duration_s: float,
        *,
        phase: float = 0.0,
        tilt: tuple[float, float] = (0.0, 0.0),
    ) -> PrismMotion:
        """Create a motion by sampling a function of time that gives the speed.

        Parameters
        ----------
        rpm : callable
            Function of times [s], shape ``(n,)``, that returns speeds [turns/min].
        duration_s : float
            Duration [s]; samples extend from 0 to just past it, one per millisecond.
        phase : float, optional
            Azimuth at angle 0 [rad].
        tilt : tuple of float, optional
            Tilt of the axis of rotation about the camera's x and y axes [rad].

        Returns
        -------
        PrismMotion
            Motion with a table of speeds.

        Raises
        ------
        AmiwarpError
            If the function returns another shape.
        """
        duration_s = real(duration_s, "duration_s", 0.0, LONGEST_S, " s")
        t = np.arange(math.ceil(duration_s * 1e3) + 2, dtype=np.float64) * 1e-3
        speed = array(rpm(t), "prism speed")
        if speed.shape not in ((), t.shape):
            raise AmiwarpError(f"prism speed has shape {speed.shape}; return one number, or one per time, {t.shape}")
        return cls(np.column_stack([t, np.broadcast_to(speed, t.shape)]), phase, tilt)

    def _table(self) -> NDArray[np.float64]:
        """Return the speed as a table of rows (time [s], speed [rad/s])."""
        rpm = array(self.rpm, "prism speed").astype(np.float64)
        table = np.array([[0.0, rpm], [1.0, rpm]]) if rpm.ndim == 0 else rpm
        return table * np.array([1.0, TWO_PI / 60.0]) if table.ndim == 2 and table.shape[1] == 2 else table

    def angle(self, t_us: ArrayLike) -> NDArray[np.float64]:
        """Return the unwrapped angle, the exact integral of the speed.

        Parameters
        ----------
        t_us : array_like
            Times [us], shape ``(n,)``.

        Returns
        -------
        ndarray
            Angles [rad], shape ``(n,)``.
        """
        t_us = array(t_us, "t_us")
        at, speed = self._table().T
        before = np.concatenate([[0.0], np.cumsum(np.diff(at) * (speed[1:] + speed[:-1]) / 2.0)])

        def integral(t: NDArray[np.float64]) -> NDArray[np.float64]:
            inside = np.clip(t, at[0], at[-1])
            i = np.clip(np.searchsorted(at, inside, side="right") - 1, 0, len(at) - 2)
            mean = (speed[i] + np.interp(inside, at, speed)) / 2.0
            return before[i] + mean * (inside - at[i]) + np.interp(t, at, speed) * (t - inside)

        return np.asarray(integral(np.asarray(t_us, np.float64) * 1e-6) - integral(np.zeros(1)))

    def angles(self, t_us: ArrayLike) -> NDArray[np.float64]:
        """Return the unwrapped angles of all prisms.

        Parameters
        ----------
        t_us : array_like
            Times [us], shape ``(n,)``.

        Returns
        -------
        ndarray
            Angles [rad], shape ``(n,)`` for one prism, ``(n, 2)`` for a pair.
        """
        first = self.angle(t_us)
        return first if self.second is None else np.stack([first, self.second.angle(t_us)], axis=1)

    @property
    def largest_speed(self) -> float:
        """Largest magnitude of the prism's speed [rad/s]."""
        return float(np.abs(self._table()[:, 1]).max())


@guarded
@dataclass(frozen=True, slots=True, eq=False)
class Vibration:
    """Vibration of a camera without a prism, to simulate in place of a prism: small rotations at one frequency.

    Examples
    --------
    >>> vibration = amiwarp.Vibration(hz=100.0, amplitude=0.007)
    >>> vibration.motion.angle([0.0, 5_000.0]).round(4)
    array([0.    , 3.1416])
    """

    hz: float | ArrayLike
    """Frequency [Hz], or a table of rows (time [s], frequency), as the speed of :class:`PrismMotion`."""
    amplitude: float
    """Radius of the forward circle [rad], as in :class:`amiwarp.VibrationModel`."""
    phase: float = 0.0
    """Phase of the forward circle at the start [rad]."""
    backward: tuple[float, float] = (0.0, 0.0)
    """Rotation about the camera's x and y axes by the backward circle at the start [rad]."""
    roll: tuple[float, float] = (0.0, 0.0)
    """Rotation about the optical axis: factors of the cosine and sine of the angle [rad]."""
    second: tuple[float, float] = (0.0, 0.0)
    """Rotation about x and y by the forward circle of the second harmonic at the start [rad]."""
    second_backward: tuple[float, float] = (0.0, 0.0)
    """The same by the backward circle of the second harmonic [rad]."""
    third: tuple[float, float] = (0.0, 0.0)
    """Rotation about x and y by the forward circle of the third harmonic at the start [rad]."""
    third_backward: tuple[float, float] = (0.0, 0.0)
    """The same by the backward circle of the third harmonic [rad]."""

    def __post_init__(self) -> None:
        _ = self.motion, self.model(Camera.from_fov(8, 8, 1.0))  # their checks

    @property
    def motion(self) -> PrismMotion:
        """Angle of the vibration over time."""
        hz = array(self.hz, "vibration hz").astype(np.float64)
        if hz.ndim == 0:
            return PrismMotion(60.0 * real(self.hz, "vibration hz", 1e-3, 1e5, " Hz"), self.phase)
        return PrismMotion(hz * (1.0, 60.0) if hz.ndim == 2 and hz.shape[1] == 2 else hz, self.phase)

    def model(self, camera: Camera) -> VibrationModel:
        """Return the model of the camera's rotation.

        Parameters
        ----------
        camera : Camera
            The camera.

        Returns
        -------
        VibrationModel
            The model.
        """
        return VibrationModel(camera, self.amplitude, self.phase, **self._parts())

    def parameters(self) -> dict[str, float]:
        """Return the true values by the names that calibration uses.

        Returns
        -------
        dict
            Values in their units. ``rpm`` is missing if the frequency changes.
        """
        parts = self._parts().items()
        pairs = {f"{name}_{axis}": float(x) for name, pair in parts for axis, x in zip("xy", pair, strict=True)}
        speed = {"rpm": 60.0 * float(self.hz)} if isinstance(self.hz, int | float) else {}
        return {"amplitude": float(self.amplitude), "phase": float(self.phase), **pairs, **speed}

    def _parts(self) -> dict[str, tuple[float, float]]:
        return {name: getattr(self, name) for name in PARTS}


@guarded
@dataclass(frozen=True, slots=True, eq=False)
class Mirror:
    """Mirror with two tilts, to simulate in place of a prism. It shows the scene mirrored.

    Each tilt follows the cosine of an angle that grows with its frequency; an encoder records both angles.

    Examples
    --------
    >>> mirror = amiwarp.Mirror(hz=(60.0, 77.0), amplitude=(0.008, 0.006))
    >>> mirror.motion.angles([0.0, 5_000.0]).round(4).tolist()
    [[0.0, 0.0], [1.885, 2.419]]
    """

    hz: tuple[float, float]
    """Frequencies of the first and of the second tilt [Hz]."""
    amplitude: tuple[float, float]
    """Amplitudes of both tilts [rad], as in :class:`amiwarp.MirrorModel`."""
    phase: tuple[float, float] = (0.0, 0.0)
    """Phases of both tilts [rad]."""
    direction: tuple[float, float] = (0.0, 0.5 * math.pi)
    """Directions in the image along which both tilts move it, from x towards y [rad]."""
    fold: float = 0.0
    """Direction in the image in which the mirror folds the optical axis [rad]."""
    incidence: float = INCIDENCE
    """Angle of incidence of the optical axis on the mirror at rest [rad]."""

    def __post_init__(self) -> None:
        for name in ("hz", "amplitude", "phase", "direction"):
            object.__setattr__(self, name, tuple(vector(getattr(self, name), 2, f"mirror {name}", real)))
        _ = self.motion, self.model(Camera.from_fov(8, 8, 1.0))  # their checks

    @property
    def motion(self) -> PrismMotion:
        """Angles of both commands over time."""
        first, second = (60.0 * real(hz, "mirror hz", -1e5, 1e5, " Hz") for hz in self.hz)
        return PrismMotion(first, self.phase[0], second=PrismMotion(second, self.phase[1]))

    def model(self, camera: Camera) -> MirrorModel:
        """Return the model of the mirror.

        Parameters
        ----------
        camera : Camera
            The camera.

        Returns
        -------
        MirrorModel
            The model.
        """
        return MirrorModel.from_values(camera, Prism(0.0), self.parameters())

    def parameters(self) -> dict[str, float]:
        """Return the true values by the names that calibration uses.

        Returns
        -------
        dict
            Values in their units.
        """
        pairs = {"amplitude": self.amplitude, "phase": self.phase, "direction": self.direction}
        both = {f"{k * 'second_'}{name}": pair[k] for name, pair in pairs.items() for k in (0, 1)}
        ratio = self.hz[1] / self.hz[0] if self.hz[0] else 0.0
        return {**both, "ratio": ratio, "fold": self.fold, "incidence": self.incidence}


Moved = Vibration | Mirror
"""What rotates the view without glass."""


@guarded
@dataclass(frozen=True, slots=True, eq=False)
class CameraMotion:
    """Rotation of the camera about its own axes. At t = 0 it faces the picture.

    Examples
    --------
    >>> amiwarp.CameraMotion((0.0, 0.5, 0.0)).constant
    True
    """

    rates: ArrayLike = (0.0, 0.0, 0.0)
    """Angular velocity of the camera in its own frame [rad/s], shape (3,).

    Or a table of rows (time [s], ωx, ωy, ωz), interpolated linearly and constant outside, shape (n, 4).
    """

    def __post_init__(self) -> None:
        _check_table("camera rotation", self._table(), columns=4)

    def _table(self) -> NDArray[np.float64]:
        rates = array(self.rates, "camera rotation").astype(np.float64)
        return np.array([[0.0, *rates], [1.0, *rates]]) if rates.shape == (3,) else rates

    @property
    def largest_rates(self) -> NDArray[np.float64]:
        """Largest magnitude of each component [rad/s], shape (3,)."""
        return np.asarray(np.abs(self._table()[:, 1:]).max(axis=0))

    @property
    def constant(self) -> bool:
        """Whether the angular velocity never changes."""
        return bool((self._table()[:, 1:] == self._table()[0, 1:]).all())

    def orientation(self, duration_s: float) -> Callable[[NDArray[np.float64]], NDArray[np.float64]]:
        """Return the orientation as a function of time.

        Parameters
        ----------
        duration_s : float
            Duration [s].

        Returns
        -------
        callable
            Function of times [s], 0 to ``duration_s``, shape ``(n,)``. It returns rotation matrices from the camera's
            frame to the picture's, shape ``(n, 3, 3)``.
        """
        from scipy.spatial.transform import Rotation

        table = self._table()
        if self.constant:
            return lambda t: np.asarray(Rotation.from_rotvec(np.outer(t, table[0, 1:])).as_matrix())
        step = ROTATION_INTERVAL
        grid = np.arange(math.ceil(duration_s / step) + 2) * step
        rates = np.stack([np.interp(grid + step / 2.0, table[:, 0], column) for column in table[:, 1:].T], axis=1)
        nodes = [np.eye(3)]
        for matrix in Rotation.from_rotvec(rates * step).as_matrix()[:-1]:
            nodes.append(nodes[-1] @ matrix)
        corners = np.stack(nodes)

        def at(t: NDArray[np.float64]) -> NDArray[np.float64]:
            i = np.clip((t / step).astype(np.int64), 0, len(grid) - 1)
            rest = Rotation.from_rotvec(rates[i] * (t - grid[i])[:, None]).as_matrix()
            return np.asarray(corners[i] @ rest)

        return at


def _check_table(what: str, table: NDArray[np.float64], columns: int = 2) -> None:
    """Raise :class:`AmiwarpError` for a table of wrong shape, with values out of range or unsorted times."""
    if table.ndim != 2 or table.shape[1] != columns or len(table) < 2:
        raise AmiwarpError(f"{what} has shape {table.shape}; give one value, or at least 2 rows of {columns} numbers")
    if not (np.abs(table) <= LARGEST_SPEED).all():  # NaN fails
        worst = table[~(np.abs(table) <= LARGEST_SPEED)][0]
        raise AmiwarpError(f"{what} contains {worst:g}; expected numbers in {-LARGEST_SPEED:g} .. {LARGEST_SPEED:g}")
    if not (np.diff(table[:, 0]) > 0).all():
        raise AmiwarpError(f"{what}: the times of its rows do not increase; sort the rows by time")


@guarded
@dataclass(frozen=True, slots=True)
class EncoderModel:
    """Errors that a simulated encoder makes.

    Raises :class:`AmiwarpError` for values out of range.

    Examples
    --------
    >>> encoder = amiwarp.EncoderModel.ideal().sample(amiwarp.PrismMotion(600.0), duration_us=1000, seed=0)
    >>> encoder.angle_at([500]).round(6)
    array([0.031416])
    """

    counts_per_turn: int | None = 8192
    """Resolution of the encoder [counts/turn]: the angle is rounded to the nearest count; None disables rounding."""
    rate_hz: float = 1000.0
    """Rate of the encoder samples [Hz]."""
    jitter_us: float = 1.0
    """Standard deviation of the time stamp of an encoder sample [us]."""
    clock_offset_us: float = 0.0
    """Offset of the encoder's clock: encoder time minus event time [us]."""
    dropouts_hz: float = 0.0
    """Mean number of drop-outs per second [Hz]."""
    dropout_us: float = 5000.0
    """Duration of a drop-out, in which all encoder samples are lost [us]."""
    harmonics: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    """Error of the angle that repeats every turn: factors of cos θ, sin θ, cos 2θ and sin 2θ [rad].

    Eccentric discs and magnets cause the first two. The prism itself turns without this error.
    """

    def __post_init__(self) -> None:
        if self.counts_per_turn is not None:
            counts = whole(self.counts_per_turn, "encoder counts_per_turn", 1, 2**31, ", or None")
            object.__setattr__(self, "counts_per_turn", counts)
        limits = {"rate_hz": (0.1, 1e6), "jitter_us": (0.0, 1e6), "dropouts_hz": (0.0, 1e5), "dropout_us": (0.0, 1e9),
                  "clock_offset_us": (-LARGEST_OFFSET_US, LARGEST_OFFSET_US)}  # fmt: skip
        for name, (low, high) in limits.items():
            object.__setattr__(self, name, real(getattr(self, name), f"encoder {name}", low, high))
        harmonics = vector(self.harmonics, 4, "encoder harmonics", partial(real, low=-1.0, high=1.0, hint=" rad"))
        object.__setattr__(self, "harmonics", harmonics)

    @classmethod
    def ideal(cls) -> EncoderModel:
        """Return an encoder without rounding and jitter.

        Returns
        -------
        EncoderModel
            The encoder.
        """
        return cls(counts_per_turn=None, jitter_us=0.0)

    def sample(self, motion: PrismMotion, duration_us: int, seed: int) -> Encoder:
        """Sample the encoder from 0 to ``duration_us`` on the camera's clock, with a margin at both ends.

        Parameters
        ----------
        motion : PrismMotion
            Motion of the prism.
        duration_us : int
            Duration [us].
        seed : int
            Seed of the random errors.

        Returns
        -------
        Encoder
            Samples with times on the encoder's clock. Its clock offset is 0: calibration has to find it.
        """
        duration_us = whole(duration_us, "duration_us", 0, round(1e6 * LONGEST_S), " us")
        seed = whole(seed, "seed", 0, INT64[1])
        rng = np.random.default_rng([seed, 0xE2C])  # independent of the pixels' random numbers
        interval = 1e6 / self.rate_hz
        spare = math.ceil((abs(self.clock_offset_us) + 8.0 * self.jitter_us) / interval) + 2
        true_t = np.rint(np.arange(-spare, math.ceil(duration_us / interval) + spare + 1) * interval).astype(np.int64)
        angle = motion.angle(true_t - self.clock_offset_us)
        if any(self.harmonics):
            angle = angle + periodic(angle, self.harmonics)
        if self.counts_per_turn is not None:
            angle = np.rint(angle * (self.counts_per_turn / TWO_PI)) * (TWO_PI / self.counts_per_turn)
        stamp = true_t + np.rint(rng.normal(0.0, self.jitter_us, len(true_t))).astype(np.int64)
        kept = np.ones(len(stamp), np.bool_)
        for start in rng.uniform(0.0, duration_us, rng.poisson(self.dropouts_hz * duration_us * 1e-6)):
            kept &= (true_t < start) | (true_t >= start + self.dropout_us)
        kept[[0, -1]] = True
        stamp, angle = stamp[kept], angle[kept]
        rising = np.concatenate([[True], stamp[1:] > np.maximum.accumulate(stamp)[:-1]])
        second = None if motion.second is None else self.sample(motion.second, duration_us, seed + 1)
        return Encoder(stamp[rising], angle[rising], second=second)


# Scene, and all values of a simulation.


@not_called("derive a class for amiwarp.Scene, or make a scene of one picture with amiwarp.Scene.from_picture")
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
        light = read_picture(picture) if isinstance(picture, str | Path) else linear_luminance(picture)
        return cls(Still(light), fov, blur)


@dataclass(frozen=True, eq=False)
class SimulationValues:
    """Description of a simulated recording: all that determines its events."""

    scene: Scene | WorldScene
    """Scene in front of the camera: pictures at infinity, or a world."""
    camera: Camera
    """Camera intrinsics, of at most 4194304 pixels."""
    prism: Prism | Plate | Vibration | Mirror
    """Prism, plate or mirror in front of the camera, with its true parameters, or vibration of a camera without glass.
    A plate needs a world, which is seen by rays."""
    duration_s: float
    """Duration of the recording [s]."""
    motion: PrismMotion | float = field(default_factory=PrismMotion)
    """Motion of the prism: speed, phase, tilt, cylinder power and wobble; or its constant speed [turns/min].

    A speed becomes a :class:`PrismMotion`. Vibrations and mirrors have their own motion.
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

    def __post_init__(self) -> None:
        if not isinstance(self.scene, WorldScene):
            instance(self.scene, Scene, "simulation's scene")
        if isinstance(self.prism, Moved):
            object.__setattr__(self, "motion", self.prism.motion)
        elif not isinstance(self.motion, PrismMotion):
            object.__setattr__(self, "motion", PrismMotion(self.motion))
        if isinstance(self.prism, Vibration):
            object.__setattr__(self, "encoder_model", None)
        kinds: dict[str, type] = {
            "camera": Camera, "sensor": SensorModel, "camera_motion": CameraMotion,
        }  # fmt: skip
        if not isinstance(self.prism, Plate | Moved):
            kinds["prism"] = Prism
        if self.encoder_model is not None:
            kinds["encoder_model"] = EncoderModel
        for name, kind in kinds.items():
            instance(getattr(self, name), kind, f"simulation's {name}")
        if isinstance(self.prism, Plate):
            self._check_plate()
        elif any(self.prism_motion.wedge):
            raise AmiwarpError("wedge is the angle between the faces of a plate; give a prism its apex angle")
        real(self.duration_s, "duration_s", 1e-3, LONGEST_S, " s")
        if self.camera.width * self.camera.height > 1 << 22:
            given = f"{self.camera.width}x{self.camera.height}"
            raise AmiwarpError(f"camera of {given} has more than 4194304 pixels; give a smaller camera")
        size = self.camera.width, self.camera.height
        if self.pixels is not None and instance(self.pixels, PixelMap, "simulation's pixels").size != size:
            given, expected = (f"{width}x{height}" for width, height in (self.pixels.size, size))
            raise AmiwarpError(f"the pixel map has {given} pixels, the camera {expected}; give the map of this camera")
        whole(self.seed, "seed", 0, (1 << 31) - 1)
        if not isinstance(self.prism, Mirror) and (self.glass.second is None) != (self.prism_motion.second is None):
            has, lacks = ("prism", "motion") if self.prism_motion.second is None else ("motion", "prism")
            raise AmiwarpError(f"the {has} has a second prism, the {lacks} has none; give both or neither")

    @property
    def prism_motion(self) -> PrismMotion:
        """Motion of the prism; that of the vibration or mirror, if there is one."""
        return cast(PrismMotion, self.motion)

    @property
    def duration_us(self) -> int:
        """Duration of the recording, rounded [us]."""
        return round(self.duration_s * 1e6)

    def _check_plate(self) -> None:
        """Let a world be seen by rays; raise :class:`AmiwarpError` for what a plate cannot show."""
        if not isinstance(self.scene, WorldScene):
            raise AmiwarpError("a plate does not move a picture, which is at infinity; give a world (--world room)")
        if any((*self.prism_motion.tilt, *self.prism_motion.cylinder, *self.prism_motion.wobble)):
            raise AmiwarpError("tilt, cylinder and wobble are those of a prism; leave them out for a plate")
        object.__setattr__(self, "scene", replace(self.scene, seeing=Seeing.RAYS))

    @property
    def true_model(self) -> ExactModel | RisleyModel | PlateModel:
        """True optical model of the prism, or of both prisms; for a plate, that of a scene at infinity."""
        return self.bending if self.plate is None else self.plate

    @property
    def glass(self) -> Prism:
        """The prism; one with an apex angle of 0 for a plate, a mirror or a vibrating camera."""
        return self.prism if isinstance(self.prism, Prism) else Prism(0.0)

    @property
    def at_rest(self) -> Self:
        """The same values with a prism that bends no ray, or a mirror that is not tilted."""
        if isinstance(self.prism, Mirror):
            return replace(self, prism=replace(self.prism, amplitude=(0.0, 0.0)))
        motion = replace(self.prism_motion, cylinder=(0.0, 0.0), second=None, wedge=(0.0, 0.0))
        return replace(self, prism=replace(self.glass, apex=0.0, second=None), motion=motion)

    @property
    def bending(self) -> ExactModel | RisleyModel:
        """True model of how a prism changes the direction of rays; with other optics, of one that does not."""
        motion, second, prism = self.prism_motion, self.prism_motion.second, self.glass
        if second is None or prism.second is None:
            return ExactModel(self.camera, prism, motion.phase, motion.tilt, motion.cylinder, motion.wobble)
        turned, by = second.angle([1e6 * self.duration_s])[0], motion.angle([1e6 * self.duration_s])[0]
        return RisleyModel(self.camera, prism, motion.phase, second.phase, turned / by if by else 0.0)

    @property
    def plate(self) -> PlateModel | None:
        """True model of the plate, for a scene at infinity; None for a prism."""
        if not isinstance(self.prism, Plate):
            return None
        return PlateModel(self.camera, self.prism, self.prism_motion.phase, wedge=self.prism_motion.wedge)

    @property
    def moving_model(self) -> Model:
        """True model of what changes the direction of rays: the prisms, the mirror or the vibration."""
        return self.prism.model(self.camera) if isinstance(self.prism, Moved) else self.bending
