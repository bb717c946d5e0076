"""Motion in a simulation: prisms that turn, a vibrating camera, a mirror, a beam steerer, and a camera that rotates."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.optics.camera import Camera
from amiwarp.optics.models.mirror import INCIDENCE, MirrorModel
from amiwarp.optics.models.steerer import SteererModel
from amiwarp.optics.models.vibration import PARTS, VibrationModel
from amiwarp.optics.prism import Prism, check_angles, check_phase
from amiwarp.schema.calls import guarded
from amiwarp.validation import array, instance, real, vector

ROTATION_INTERVAL = 1e-3
"""Interval of the steps in which a changing angular velocity is integrated [s]."""
LARGEST_SPEED = 1e9
"""Largest accepted speed of a prism [turns/min] and of a camera's rotation [rad/s]; higher values are mistakes."""
LONGEST_S = 86400.0
"""Longest duration of a simulation [s]."""


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
            self._check_pair(instance(self.second, PrismMotion, "motion of the second prism"))
        object.__setattr__(self, "phase", check_phase(self.phase, "prism phase"))
        for name in ("tilt", "cylinder", "wobble", "wedge"):
            object.__setattr__(self, name, check_angles(getattr(self, name), name))

    def _check_pair(self, second: PrismMotion) -> None:
        """Raise :class:`AmiwarpError` for what the motion of a pair of prisms cannot have."""
        if second.second is not None or second._is_uneven:
            raise AmiwarpError(
                "the motion of the second prism has more than speed and phase; leave the rest out"
            )
        if self._is_uneven:
            raise AmiwarpError(
                "a pair of prisms has tilt, cylinder power or wobble; simulate one prism with them"
            )

    @property
    def _is_uneven(self) -> bool:
        """Whether the motion has tilt, cylinder power or wobble."""
        return any((*self.tilt, *self.cylinder, *self.wobble))

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
            raise AmiwarpError(
                f"prism speed has shape {speed.shape}; return one number, or one per time, {t.shape}"
            )
        return cls(np.column_stack([t, np.broadcast_to(speed, t.shape)]), phase, tilt)

    def _table(self) -> NDArray[np.float64]:
        """Return the speed as a table of rows (time [s], speed [rad/s]).

        A table of another shape is returned as it is, and refused by :func:`_check_table`.
        """
        rpm = array(self.rpm, "prism speed").astype(np.float64)
        if rpm.ndim == 0:
            rpm = np.array([[0.0, rpm], [1.0, rpm]])
        if rpm.ndim != 2 or rpm.shape[1] != 2:
            return rpm
        return rpm * np.array([1.0, math.tau / 60.0])

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
        times, speeds = self._table().T
        of_intervals = np.diff(times) * (speeds[1:] + speeds[:-1]) / 2.0
        until_row = np.concatenate([[0.0], np.cumsum(of_intervals)])

        def integral(t: NDArray[np.float64]) -> NDArray[np.float64]:
            """Return the angle since the first row of the table."""
            inside = np.clip(t, times[0], times[-1])
            row = np.searchsorted(times, inside, side="right") - 1
            row = np.clip(row, 0, len(times) - 2)
            mean_speed = (speeds[row] + np.interp(inside, times, speeds)) / 2.0
            beyond = np.interp(t, times, speeds) * (t - inside)  # at the first or the last speed
            return until_row[row] + mean_speed * (inside - times[row]) + beyond

        seconds = np.asarray(t_us, np.float64) * 1e-6
        return np.asarray(integral(seconds) - integral(np.zeros(1)))

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
        if self.second is None:
            return first
        return np.stack([first, self.second.angle(t_us)], axis=1)

    @property
    def largest_speed(self) -> float:
        """Largest magnitude of the prism's speed [rad/s]."""
        return float(np.abs(self._table()[:, 1]).max())


@guarded
@dataclass(frozen=True, slots=True, eq=False)
class Vibration:
    """Vibration of a camera without a prism, to simulate instead of a prism: small rotations at one frequency.

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
        # PrismMotion refuses a table of another shape.
        if hz.ndim == 2 and hz.shape[1] == 2:
            hz = hz * (1.0, 60.0)
        return PrismMotion(hz, self.phase)

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
        values = {"amplitude": float(self.amplitude), "phase": float(self.phase)}
        for name, (x, y) in self._parts().items():
            values[f"{name}_x"] = float(x)
            values[f"{name}_y"] = float(y)
        if isinstance(self.hz, int | float):
            values["rpm"] = 60.0 * float(self.hz)
        return values

    def _parts(self) -> dict[str, tuple[float, float]]:
        return {name: getattr(self, name) for name in PARTS}


@guarded
@dataclass(frozen=True, slots=True, eq=False)
class Mirror:
    """Mirror with two tilts, to simulate instead of a prism. It shows the scene mirrored.

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
        _check_both_commands(self, "mirror")
        _ = self.motion, self.model(Camera.from_fov(8, 8, 1.0))  # their checks

    @property
    def motion(self) -> PrismMotion:
        """Angles of both commands over time."""
        return _motion_of_both(self, "mirror")

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
        return {**_values_of_both(self), "fold": self.fold, "incidence": self.incidence}


@guarded
@dataclass(frozen=True, slots=True, eq=False)
class Steerer:
    """Beam steerer of two deflectors, to simulate instead of a prism.

    Each deflector follows the cosine of an angle that grows with its frequency; an encoder records both angles.

    Examples
    --------
    >>> steerer = amiwarp.Steerer(hz=(5000.0, 6100.0), amplitude=(0.01, 0.008))
    >>> steerer.motion.angles([0.0, 50.0]).round(4).tolist()
    [[0.0, 0.0], [1.5708, 1.9164]]
    """

    hz: tuple[float, float]
    """Frequencies of the commands of the first and of the second deflector [Hz]."""
    amplitude: tuple[float, float]
    """Largest deflections by both [rad], as in :class:`amiwarp.SteererModel`."""
    phase: tuple[float, float] = (0.0, 0.0)
    """Phases of both [rad]."""
    direction: tuple[float, float] = (0.0, 0.5 * math.pi)
    """Directions in the image along which both move it, from x towards y [rad]."""

    def __post_init__(self) -> None:
        _check_both_commands(self, "steerer")
        _ = self.motion, self.model(Camera.from_fov(8, 8, 1.0))  # their checks

    @property
    def motion(self) -> PrismMotion:
        """Angles of both commands over time."""
        return _motion_of_both(self, "steerer")

    def model(self, camera: Camera) -> SteererModel:
        """Return the model of the beam steerer.

        Parameters
        ----------
        camera : Camera
            The camera.

        Returns
        -------
        SteererModel
            The model.
        """
        return SteererModel.from_values(camera, Prism(0.0), self.parameters())

    def parameters(self) -> dict[str, float]:
        """Return the true values by the names that calibration uses.

        Returns
        -------
        dict
            Values in their units.
        """
        return _values_of_both(self)


def _check_both_commands(optic: Mirror | Steerer, what: str) -> None:
    """Make pairs of the values of an optic's two commands; raise :class:`AmiwarpError` for others."""
    for name in ("hz", "amplitude", "phase", "direction"):
        pair = tuple(vector(getattr(optic, name), 2, f"{what} {name}", real))
        object.__setattr__(optic, name, pair)


def _motion_of_both(optic: Mirror | Steerer, what: str) -> PrismMotion:
    """Return the angles of an optic's two commands over time."""
    first_rpm, second_rpm = (60.0 * real(hz, f"{what} hz", -1e5, 1e5, " Hz") for hz in optic.hz)
    first_phase, second_phase = optic.phase
    second = PrismMotion(second_rpm, second_phase)
    return PrismMotion(first_rpm, first_phase, second=second)


def _values_of_both(optic: Mirror | Steerer) -> dict[str, float]:
    """Return the true values of an optic's two motions by the names that calibration uses."""
    values = {}
    pairs = {"amplitude": optic.amplitude, "phase": optic.phase, "direction": optic.direction}
    for name, (first, second) in pairs.items():
        values[name] = first
        values[f"second_{name}"] = second
    first_hz, second_hz = optic.hz
    values["ratio"] = second_hz / first_hz if first_hz else 0.0
    return values


Commanded = Mirror | Steerer
"""What moves the image as two commands say."""
Moved = Vibration | Commanded
"""What moves the view without glass that turns."""


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
        if rates.shape != (3,):
            return rates
        return np.array([[0.0, *rates], [1.0, *rates]])

    @property
    def largest_rates(self) -> NDArray[np.float64]:
        """Largest magnitude of each component [rad/s], shape (3,)."""
        return np.asarray(np.abs(self._table()[:, 1:]).max(axis=0))

    @property
    def constant(self) -> bool:
        """Whether the angular velocity never changes."""
        return bool((self._table()[:, 1:] == self._table()[0, 1:]).all())

    def orientation(
        self, duration_s: float
    ) -> Callable[[NDArray[np.float64]], NDArray[np.float64]]:
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
            rate = table[0, 1:]
            return lambda t: np.asarray(Rotation.from_rotvec(np.outer(t, rate)).as_matrix())

        # The rate of each step is the rate at its middle.
        step = ROTATION_INTERVAL
        grid = np.arange(math.ceil(duration_s / step) + 2) * step
        rates = rates_of(self, grid + step / 2.0)
        nodes = [np.eye(3)]
        for matrix in Rotation.from_rotvec(rates * step).as_matrix()[:-1]:
            nodes.append(nodes[-1] @ matrix)
        corners = np.stack(nodes)

        def at(t: NDArray[np.float64]) -> NDArray[np.float64]:
            i = np.clip((t / step).astype(np.int64), 0, len(grid) - 1)
            rest = Rotation.from_rotvec(rates[i] * (t - grid[i])[:, None]).as_matrix()
            return np.asarray(corners[i] @ rest)

        return at


def rates_of(rotation: CameraMotion, t: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
    """Return the angular velocity of a camera in its own frame at times [s], in rad/s, shape ``(n, 3)``."""
    table = rotation._table()
    columns = [np.interp(t, table[:, 0], column) for column in table[:, 1:].T]
    return np.stack(columns, axis=-1)


def _check_table(what: str, table: NDArray[np.float64], columns: int = 2) -> None:
    """Raise :class:`AmiwarpError` for a table of wrong shape, with values out of range or unsorted times."""
    if table.ndim != 2 or table.shape[1] != columns or len(table) < 2:
        raise AmiwarpError(
            f"{what} has shape {table.shape}; give one value, or at least 2 rows of {columns} numbers"
        )
    in_range = np.abs(table) <= LARGEST_SPEED  # False for NaN
    if not in_range.all():
        worst = table[~in_range][0]
        raise AmiwarpError(
            f"{what} contains {worst:g}; expected numbers in {-LARGEST_SPEED:g} .. {LARGEST_SPEED:g}"
        )
    if not (np.diff(table[:, 0]) > 0).all():
        raise AmiwarpError(f"{what}: the times of its rows do not increase; sort the rows by time")
