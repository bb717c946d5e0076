"""Optical models of a prism, from two parameters to the exact refraction, of a pair of prisms and of a plate.

The formulas are derived in ``docs/explanation/optics.md``.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import groupby
from typing import Any, ClassVar, Self, TypeVar, cast

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.kernels import plate as plate_kernels
from amiwarp.kernels import refraction as kernels
from amiwarp.kernels.launch import RecordedLaunch, launch
from amiwarp.optics.camera import LARGEST_SIZE, Camera, with_lens
from amiwarp.optics.prism import (
    FlatSide,
    NominalPrism,
    Plate,
    Prism,
    apex_from_deflection,
    as_wedge,
    check_angles,
    check_index,
    check_phase,
    deflection_from_apex,
)
from amiwarp.validation import array, choice, guarded, instance, not_called, one_of, real, shown, vector, whole

# Base class of the optical models: what a model knows of itself, and the displacement of points on any device.

Points = TypeVar("Points")
"""Type of points given to a model: NumPy array (n, 2), or Warp array of vec2 of shape (n,). Results have the same type.
"""


@guarded
@dataclass(frozen=True, slots=True)
class Parameter:
    """Parameter of an optical model that a calibration can find.

    Examples
    --------
    >>> amiwarp.ExactModel.PARAMETERS[-1].name
    'index'
    """

    name: str
    """Name in settings, files and results."""
    unit: str
    """Unit of its values: ``rad``, ``1/m``, or ``1`` for a number."""
    half_range: float = math.pi
    """Half width of its default bounds about its start value, in its unit. The size has bounds from its nominal value.
    """
    like_size: bool = False
    """Whether its effect on the sharpness is nearly that of the size, so that sharpness alone hardly finds it."""
    limits: tuple[float, float] = (-math.inf, math.inf)
    """Smallest and largest value in an address of ``amiwarp view``, angles in degrees; infinite for none."""
    label: str = ""
    """Text of its slider in ``amiwarp view``; empty without a slider."""
    slider: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Minimum, maximum and step of its slider, angles in degrees. The slider starts at 0, that of a size at a typical
    value."""
    fine: bool = False
    """Whether its effect is so small that the global search keeps its start value."""
    period: float = 0.0
    """Period of an angle after which the motion repeats [rad], as that of a direction; 0 for none. Such a parameter has
    no bounds unless they are given: only the global search keeps to ``half_range``."""

    def __post_init__(self) -> None:
        for name in ("name", "unit", "label"):
            instance(getattr(self, name), str, f"parameter's {name}")
        real(self.half_range, f"parameter {shown(self.name)}: half_range", 0.0)
        real(self.period, f"parameter {shown(self.name)}: period", 0.0)
        vector(self.slider, 3, f"parameter {shown(self.name)}: slider", real)
        low, high = vector(self.limits, 2, f"parameter {shown(self.name)}: limits", _limit)
        if low > high:
            raise AmiwarpError(f"parameter {shown(self.name)}: limits are {self.limits}; give the smaller one first")


def _limit(value: object, what: str) -> float:
    """Return a number that may be infinite."""
    return value if isinstance(value, float) and math.isinf(value) else real(value, what)


BEYOND_TURNS = 2
"""Turns from its start to which a direction may go: further than any search does, so that it never ends there."""
PHASE = Parameter("phase", "rad")
"""Phase θ_b, which is added to the encoder's angle."""
AMPLITUDE = Parameter(
    "amplitude", "rad", math.radians(0.4), limits=(0.0, 11.4), label="amplitude", slider=(0.0, 3.0, 0.005)
)
"""Size of a motion that no glass makes."""


@not_called("make a model such as amiwarp.ExactModel(camera, prism)")
class Model:
    """Optical model: displaces the pixels of a camera by the angle of its prism, and knows its parameters.

    Base class of all models. ``docs/explanation/optics.md`` derives their formulas.

    Examples
    --------
    >>> amiwarp.ExactModel.SIZE, amiwarp.ExactModel.FREE
    ('apex', ('apex', 'phase', 'tilt_x', 'tilt_y', 'cylinder_x', 'cylinder_y', 'wobble_x', 'wobble_y', 'index'))
    """

    NAME: ClassVar[str]
    """Name in settings and files."""
    TEXT: ClassVar[str]
    """Name in the legends of figures, which may say how the model computes."""
    NUMBERS: ClassVar[str]
    """Number of its parameters, as shown in the table of an automatic choice."""
    PARAMETERS: ClassVar[tuple[Parameter, ...]]
    """Parameters that a calibration can find: the size of the prism, the phase, then others."""
    SIMPLIFIES: ClassVar[str | None] = None
    """Name of the next better model of the same optic, which it approximates; None for the best one."""
    STRUCT: ClassVar[Any]
    """Warp struct of its parameters, for which ``compensate`` and ``deflect`` of
    :mod:`amiwarp.kernels.refraction` have overloads."""
    GLASS: ClassVar[type[Prism] | type[Plate]] = Prism
    """Type of the glass in front of the camera."""
    FREE: ClassVar[tuple[str, ...]]
    """Names of the parameters that a calibration can find."""
    FREED: ClassVar[tuple[str, ...]]
    """Names of the parameters that a calibration finds unless settings name others; by default size and phase."""
    PRISM: ClassVar[bool] = True
    """Whether a prism moves the image. Else the camera itself moves, and recordings have no prism."""
    MOVER: ClassVar[str] = "prism"
    """What moves the image, in words."""
    SIZE_HINT: ClassVar[str] = "twice the nominal one, 2 deg if none is given"
    """Largest size that is tried without given bounds, in words."""
    TIME_BIN_US: ClassVar[int] = 1000
    """Length of the time bins in which repetition of the events is looked for [us]: a fifth of the shortest turn."""
    SECTORS: ClassVar[int] = 64
    """Number of parts of a turn, each of which has events, unless the sensor loses them."""
    SIZE: ClassVar[str]
    """Name of the parameter that sets the size of the orbit."""
    ANGLES: ClassVar[int] = 1
    """Number of angles of its state: one prism has one, a pair has two."""
    ORBITS: ClassVar[tuple[tuple[str, str], ...]]
    """Names of size and phase of each prism."""
    TOGETHER: ClassVar[tuple[tuple[str, ...], ...]]
    """Names of the parameters that each step of a global search finds; by default those of one prism after the other.
    """

    camera: Camera
    """Camera intrinsics."""
    phase: float
    """Phase θ_b, added to the encoder's angle [rad]."""

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        cls.FREE = tuple(parameter.name for parameter in cls.PARAMETERS)
        cls.SIZE = cls.FREE[0]
        if "ORBITS" not in vars(cls):
            cls.ORBITS = ((cls.SIZE, cls.FREE[1]),)
        if "TOGETHER" not in vars(cls):
            cls.TOGETHER = cls.ORBITS
        if "FREED" not in vars(cls):
            cls.FREED = tuple(name for orbit in cls.ORBITS for name in orbit)

    @classmethod
    def closed_form(cls) -> type[Model]:
        """Return the model that a search uses in place of this one: itself, unless its tables come from another model.

        Returns
        -------
        type of Model
            A model that computes each pixel from its parameters.
        """
        return cls

    @classmethod
    def size_from_apex(cls, apex: float, prism: NominalPrism) -> float:
        """Return the model's size for a prism of a given apex angle.

        Parameters
        ----------
        apex : float
            Apex angle [rad].
        prism : Prism or UnsizedPrism
            Prism with the refractive index and the flat side.

        Returns
        -------
        float
            Value of the parameter :attr:`SIZE`: here the apex angle itself.
        """
        return apex

    @classmethod
    def apex_from_size(cls, size: float, prism: NominalPrism) -> float:
        """Return the apex angle for the model's size. Inverse of :meth:`size_from_apex`.

        Parameters
        ----------
        size : float
            Value of the parameter :attr:`SIZE`.
        prism : Prism or UnsizedPrism
            Prism with the refractive index and the flat side.

        Returns
        -------
        float
            Apex angle [rad].
        """
        return size

    @classmethod
    def typical_size(cls, camera: Camera, prism: Prism | Plate) -> float:
        """Return a typical size, at which the effect of the parameters is measured.

        Parameters
        ----------
        camera : Camera
            The camera.
        prism : Prism or Plate
            The nominal glass.

        Returns
        -------
        float
            Value of the parameter :attr:`SIZE`: here that with which a search starts.
        """
        return cls.start_values(prism)[cls.SIZE]

    @classmethod
    def default_bounds(cls, name: str, value: float, camera: Camera, prism: Prism | Plate) -> tuple[float, float]:
        """Return the bounds of a parameter of the model that a search keeps unless others are given.

        Parameters
        ----------
        name : str
            Name of the parameter, one of :attr:`FREE`.
        value : float
            Its start value, in its unit.
        camera : Camera
            The camera.
        prism : Prism or Plate
            The nominal glass. Here the size ranges from 0 to that of twice its apex angle.

        Returns
        -------
        low, high : float
            The bounds, in the parameter's unit.
        """
        if one_of(name, cls.FREE, "name") == cls.SIZE:
            return 0.0, cls.size_from_apex(2.0 * as_wedge(prism).apex, as_wedge(prism))
        if name in dict(cls.ORBITS):  # the size of another prism
            return 0.0, 2.0 * value
        if name in dict(cls.ORBITS).values():
            return -PHASE.half_range, PHASE.half_range
        parameter = next(parameter for parameter in cls.PARAMETERS if parameter.name == name)
        half = BEYOND_TURNS * math.tau if parameter.period else parameter.half_range
        return value - half, value + half

    @classmethod
    def turned_values(cls, values: Mapping[str, float], angle: float) -> dict[str, float]:
        """Return the values of the motion at angles that are larger by a constant.

        Parameters
        ----------
        values : mapping of str to float
            Values by name, in their units.
        angle : float
            The constant [rad].

        Returns
        -------
        dict
            The values: here with other phases of all prisms.
        """
        check_given(values, cls.FREE[:2])
        return {**values, **{phase: values[phase] + angle for _, phase in cls.ORBITS if phase in values}}

    @classmethod
    def reversed_values(cls, values: Mapping[str, float]) -> dict[str, float] | None:
        """Return values that describe the same motion by the angle -θ.

        Parameters
        ----------
        values : mapping of str to float
            Values by name, in their units.

        Returns
        -------
        dict or None
            The values, others unchanged; None if the sense of rotation tells one motion from another, as for a prism.
        """
        return None

    @classmethod
    def freed(cls, ratio: float | None) -> tuple[str, ...]:
        """Return the names of the parameters that a calibration finds unless settings name others.

        Parameters
        ----------
        ratio : float or None
            Speed of the second angle relative to the first; None for one angle.

        Returns
        -------
        tuple of str
            The names: here :attr:`FREED`.
        """
        return cls.FREED

    @classmethod
    def twin_values(cls, values: Mapping[str, float]) -> dict[str, float] | None:
        """Return values whose motion is nearly that of other ones, so that a local search starts from both.

        Parameters
        ----------
        values : mapping of str to float
            Values by name, in their units.

        Returns
        -------
        dict or None
            The values, others unchanged; None if the global search tells all motions apart.
        """
        return None

    @classmethod
    def start_values(cls, prism: Prism | Plate) -> dict[str, float]:
        """Return the values with which a search starts if nothing but the nominal prism is known.

        Parameters
        ----------
        prism : Prism or Plate
            The nominal glass.

        Returns
        -------
        dict
            Value of each parameter by name, in its unit.
        """
        wedge = as_wedge(prism)
        given = {cls.SIZE: cls.size_from_apex(wedge.apex, wedge), "index": wedge.index}
        return {name: given.get(name, 0.0) for name in cls.FREE}

    @classmethod
    def from_values(cls, camera: Camera, prism: Prism | Plate, values: Mapping[str, float]) -> Self:
        """Create the model from the values of its parameters.

        Parameters
        ----------
        camera : Camera
            The camera.
        prism : Prism or Plate
            Glass that gives what ``values`` do not contain, such as the flat side.
        values : mapping of str to float
            Values by name, in their units: size and phase at least. Names of other parameters are ignored.

        Returns
        -------
        Model
            The model.

        Raises
        ------
        AmiwarpError
            If size or phase is missing, or a value is unusable.
        """
        return model_of(cls, camera, prism, values)

    @classmethod
    def _of_values(cls, camera: Camera, prism: Prism | Plate, values: Mapping[str, float]) -> Self:
        """Create the model of :meth:`from_values` from values that contain size and phase."""
        raise NotImplementedError

    @classmethod
    def from_prism(cls, camera: Camera, prism: Prism | Plate, phase: float = 0.0) -> Self:
        """Create the model of a prism.

        Parameters
        ----------
        camera : Camera
            The camera.
        prism : Prism or Plate
            The prism, or the plate.
        phase : float, default 0.0
            Added to the encoder's angle [rad].

        Returns
        -------
        Model
            The model.
        """
        return cls.from_values(camera, prism, {**cls.start_values(prism), PHASE.name: phase})

    @classmethod
    def still_values(cls, values: Mapping[str, float]) -> dict[str, float]:
        """Return values with which the model moves no point, and that are else the given ones.

        Parameters
        ----------
        values : mapping of str to float
            Values by name, in their units.

        Returns
        -------
        dict
            The values, with all sizes of 0.
        """
        return {**values, **{size: 0.0 for size, _ in cls.ORBITS}}

    def kernel_values(self) -> tuple[Any, ...]:
        """Return the values of the parameters for kernels, in the order of the fields of :attr:`STRUCT`.

        Returns
        -------
        tuple
            Value of each field. A matrix is an array.
        """
        raise NotImplementedError

    def params(self, device: Any) -> Any:
        """Return the parameters for kernels.

        Parameters
        ----------
        device : str or warp.Device
            The device that runs the kernels.

        Returns
        -------
        warp struct
            Instance of :attr:`STRUCT`.
        """
        return struct_of(self.STRUCT, self.kernel_values())

    def singles(self) -> tuple[Model, ...]:
        """Return a model of each prism on its own.

        Returns
        -------
        tuple of Model
            The model itself, for one prism.
        """
        return (self,)

    def all_angles(self, theta: NDArray[Any]) -> NDArray[np.float64]:
        """Return the angles of all prisms for angles of the first one [rad], shape (..., :attr:`ANGLES`).

        Parameters
        ----------
        theta : numpy.ndarray
            Angles of the first prism [rad].

        Returns
        -------
        numpy.ndarray
            The angles [rad], with one more axis; NaN and infinite ones stay so.
        """
        return np.asarray(theta, np.float64)[..., None]

    def compensate_points(self, xy: Points, theta: Points) -> Points:
        """Return the pixel that the same scene ray would hit without the prism.

        Parameters
        ----------
        xy : numpy.ndarray or warp.array
            Observed pixels [px], shape (n, 2), or a Warp array of vec2 of shape (n,).
        theta : numpy.ndarray or warp.array
            Prism angle of the encoder [rad], shape (n,). A float32 Warp array on the same device if ``xy`` is one.
            For a pair of prisms both angles, shape (n, 2); with one, the second prism follows by the speeds' ratio.

        Returns
        -------
        numpy.ndarray or warp.array
            Compensated pixels [px], of the same shape as ``xy``. A row is NaN if it has no ray: total internal
            reflection, or a ray behind the image plane; or if its pixel or angle is NaN or infinite.

        Raises
        ------
        AmiwarpError
            If the arrays have other shapes, types or devices.
        """
        return _run("compensate_points", self, xy, theta)

    def deflect_points(self, xy: Points, theta: Points) -> Points:
        """Return the observed pixel of a scene ray, given its pixel without the prism.

        Inverse of :meth:`compensate_points`.

        Parameters
        ----------
        xy : numpy.ndarray or warp.array
            Pixels without the prism [px], shape (n, 2), or a Warp array of vec2 of shape (n,).
        theta : numpy.ndarray or warp.array
            As for :meth:`compensate_points`.

        Returns
        -------
        numpy.ndarray or warp.array
            Observed pixels [px], of the same shape as ``xy``. A row is NaN as in :meth:`compensate_points`.

        Raises
        ------
        AmiwarpError
            If the arrays have other shapes, types or devices.
        """
        return _run("deflect_points", self, xy, theta)


def _run(kernel_name: str, model: Model, xy: Any, theta: Any) -> Any:
    kernel, per_point = getattr(kernels, kernel_name), model.ANGLES
    if isinstance(xy, wp.array):
        if not isinstance(theta, wp.array) or theta.device != xy.device or theta.dtype is not wp.float32:
            raise AmiwarpError(
                f"xy is a Warp array on {xy.device}; give theta as a float32 Warp array on the same device"
            )
        if xy.dtype is not wp.vec2 or xy.ndim != 1 or theta.shape not in _shapes(len(xy), per_point):
            given = f"xy has type {xy.dtype} and shape {xy.shape}, theta has shape {theta.shape}"
            raise AmiwarpError(f"{given}; give vec2 of shape (n,) for xy, and shape {_wanted(per_point)} for theta")
        if theta.ndim < per_point:
            theta = wp.array(model.all_angles(theta.numpy()), dtype=float, device=xy.device)
        theta = theta.flatten()
        out = wp.empty_like(xy)
        launch(kernel, len(xy), [model.params(xy.device), model_camera(model, xy.device), xy, theta], [out],
               device=xy.device)  # fmt: skip
        return out
    xy, theta = array(xy, "xy"), array(theta, "theta")
    if xy.ndim != 2 or xy.shape[1] != 2 or theta.shape not in _shapes(len(xy), per_point):
        raise AmiwarpError(f"xy has shape {xy.shape} and theta {theta.shape}; give (n, 2) and {_wanted(per_point)}")
    angles = theta if theta.ndim == per_point else model.all_angles(theta)
    result = _run(kernel_name, model, *points_on_host(xy, angles))
    return result.numpy().astype(xy.dtype if np.issubdtype(xy.dtype, np.floating) else np.float32, copy=False)


def _shapes(n: int, angles: int) -> tuple[tuple[int, ...], ...]:
    """Return the shapes that angles of ``n`` points may have, for a model with this number of angles."""
    return ((n,),) if angles == 1 else ((n,), (n, angles))


def _wanted(angles: int) -> str:
    return "(n,)" if angles == 1 else f"(n, {angles})"


Made = TypeVar("Made", bound=Model)


def model_of(kind: type[Made], camera: Camera, prism: Prism | Plate, values: Mapping[str, float]) -> Made:
    """Create a model as :meth:`Model.from_values` does, but without its checks of types: a search calls it often."""
    check_given(values, kind.FREE[:2])
    return kind._of_values(camera, prism, values)


def build_model(model: str, camera: Camera, prism: Prism | Plate, values: Mapping[str, float]) -> Model:
    """Build the optical model of the parameter values; ``camera`` and ``prism`` give all other values."""
    return model_of(MODELS[one_of(model, MODELS, "model")], with_lens(camera, values), prism, values)


def check_given(values: Mapping[str, float], names: Iterable[str]) -> None:
    """Raise :class:`AmiwarpError` if a parameter has no value."""
    missing = [name for name in names if name not in values]
    if missing:
        raise AmiwarpError(f"values have no {', '.join(missing)}; give the value of each parameter")


def compensate_by_each(models: Sequence[Model], xy: NDArray[Any], theta: NDArray[Any]) -> NDArray[np.float64]:
    """Return the same pixels compensated by each of several models, on the CPU [px], shape (models, n, 2).

    ``xy`` holds the pixels, shape (n, 2). ``theta`` holds the angles of the first prism, wrapped to a turn [rad], shape
    (n,), or (models, n) if each model has its own. One call takes a fraction of the time of a call for each model.
    Successive places of one model share a launch.
    """
    n = len(xy)
    pixels = wp.array(np.tile(xy.astype(np.float32), (len(models), 1)), dtype=wp.vec2, device="cpu", copy=False)
    angles = np.empty((len(models), n), np.float32)
    angles[:] = theta
    if models and models[0].ANGLES > 1:  # a pair is compared with pairs only
        angles = np.stack([model.all_angles(own) for model, own in zip(models, angles, strict=True)]).astype(np.float32)
    points = [pixels, wp.array(angles.ravel(), dtype=float, device="cpu", copy=False)]
    out = wp.empty_like(pixels)
    launches: dict[type, RecordedLaunch] = {}
    for _, group in groupby(range(len(models)), key=lambda k: id(models[k])):
        same = list(group)  # successive places of one model
        model = models[same[0]]
        arguments = [model.params("cpu"), model_camera(model, "cpu")]
        compensate = launches.get(type(model))
        if compensate is None:
            compensate = RecordedLaunch(kernels.compensate_points, [*arguments, *points, 0], [out], device="cpu")
            launches[type(model)] = compensate
        for index, value in enumerate(arguments):
            compensate.set(index, value)
        compensate(same[0] * n, len(same) * n)
    return out.numpy().reshape(len(models), n, 2).astype(np.float64)


def rms(moved: NDArray[np.float64]) -> float:
    """Return the root mean square length of displacements [px], shape (n, 2), without those that are not finite."""
    squares = np.sum(moved**2, axis=1)
    return float(np.sqrt(np.mean(squares[np.isfinite(squares)])))


def points_on_host(xy: NDArray[Any], theta: NDArray[Any]) -> tuple[Any, Any]:
    """Return pixels, shape (n, 2), and prism angles [rad], shape (n,) or (n, angles), as Warp arrays on the CPU."""
    wrapped = wrap_angle(theta).astype(np.float32)
    return wp.array(xy.astype(np.float32), dtype=wp.vec2, device="cpu"), wp.array(wrapped, dtype=float, device="cpu")


def wrap_angle(angle: NDArray[np.float64]) -> NDArray[np.float64]:
    """Wrap an angle [rad] to [-pi, pi) in float64. Wrap angles before they are rounded to float32."""
    with np.errstate(invalid="ignore"):  # an infinite angle becomes NaN
        return (np.asarray(angle, dtype=np.float64) + np.pi) % (2.0 * np.pi) - np.pi


def model_camera(model: Model, device: Any) -> Any:
    """Return the parameters of the model's camera on ``device``, cached per camera."""
    from amiwarp.kernels.camera import camera_params

    return camera_params(model.camera, str(device))


def phase_values(phase: float) -> tuple[float, float, float]:
    """Return a phase [rad] with its cosine and sine: three fields of a model's parameters for kernels."""
    return phase, math.cos(phase), math.sin(phase)


def struct_of(kind: Any, values: Sequence[Any]) -> Any:
    """Return a Warp struct with the given values of its fields, in their order."""
    struct = kind()
    for name, value in zip(kind.vars, values, strict=True):
        if not isinstance(value, int | float) or value:  # a new struct holds zeros, and to set a field takes longer
            setattr(struct, name, value)
    return struct


# Circle and radial circle models: rotations of the bearing vector, described by a few numbers.


class _DeflectionModel(Model):
    """Model that is sized by the deflection on the optical axis."""

    PARAMETERS = (Parameter("deflection", "rad"), PHASE)

    deflection: float
    flat_side: FlatSide

    def __post_init__(self) -> None:
        instance(self.camera, Camera, "camera")
        below = math.nextafter(math.pi / 2.0, 0.0)
        hint = " rad; for a negative deflection, add pi to the phase"
        object.__setattr__(self, "deflection", real(self.deflection, "deflection", 0.0, below, hint))
        object.__setattr__(self, "phase", check_phase(self.phase))
        object.__setattr__(self, "flat_side", choice(FlatSide, self.flat_side, "flat_side"))

    @classmethod
    def size_from_apex(cls, apex: float, prism: NominalPrism) -> float:
        return deflection_from_apex(apex, prism.index, as_wedge(prism).flat_side)

    @classmethod
    def apex_from_size(cls, size: float, prism: NominalPrism) -> float:
        return apex_from_deflection(size, prism.index, as_wedge(prism).flat_side)


@guarded
@dataclass(frozen=True)
class CircleModel(_DeflectionModel):
    """Circle model: rotates every bearing vector by one constant angle.

    Raises
    ------
    AmiwarpError
        If the deflection is not at least 0 and below pi/2, or another field has an unusable value.

    Notes
    -----
    The rotation axis is z × w, with z the optical axis and w = (cos φ, sin φ) the direction of the prism's tilt at
    φ = θ + θ_b. See ``docs/explanation/optics.md``.

    Examples
    --------
    >>> import numpy as np
    >>> camera = amiwarp.Camera(width=640, height=480, fx=500.0, fy=500.0, cx=320.0, cy=240.0)
    >>> model = amiwarp.CircleModel(camera, deflection=0.02)
    >>> model.compensate_points(np.array([[320.0, 240.0]]), np.array([0.0])).round(2)
    array([[330., 240.]])
    """

    NAME, TEXT, NUMBERS, STRUCT = "circle", "circle", "2", kernels.CircleParams
    SIMPLIFIES = "radial"

    camera: Camera
    """Camera intrinsics."""
    deflection: float
    """Angle of the rotation [rad], not negative."""
    phase: float = 0.0
    """Phase θ_b, added to the encoder's angle [rad]."""
    flat_side: FlatSide = FlatSide.SCENE
    """Side that the prism's flat face points to: scene or camera."""

    @classmethod
    def _of_values(cls, camera: Camera, prism: Prism | Plate, values: Mapping[str, float]) -> Self:
        return cls(camera, values["deflection"], values["phase"], as_wedge(prism).flat_side)

    def kernel_values(self) -> tuple[Any, ...]:
        sine = math.sin(self.deflection if self.flat_side is FlatSide.SCENE else -self.deflection)
        return sine, 2.0 * math.sin(self.deflection / 2.0) ** 2, *phase_values(self.phase)


@guarded
@dataclass(frozen=True)
class RadialCircleModel(_DeflectionModel):
    """Radial circle model: rotates each bearing vector by an angle that grows away from the optical axis.

    Raises
    ------
    AmiwarpError
        If the deflection is not at least 0 and below pi/2, or another field has an unusable value.

    Notes
    -----
    The angle is δ(φ) = δ₀ (√(n² − sin²φ)/cos φ − 1)/(n − 1), derived in ``docs/explanation/optics.md``. φ is the angle
    between the optical axis and the bearing on the side of the tilted face. This is the observed bearing if the flat
    face points to the scene, and the scene's bearing if it points to the camera. With the other bearing the model would
    lose its accuracy, which is almost second order in the apex angle.

    Examples
    --------
    >>> camera = amiwarp.Camera(width=640, height=480, fx=500.0, fy=500.0, cx=320.0, cy=240.0)
    >>> model = amiwarp.RadialCircleModel.from_prism(camera, amiwarp.Prism(apex=0.03), phase=0.5)
    >>> round(model.deflection, 4)
    0.0155
    """

    NAME, TEXT, NUMBERS, STRUCT = "radial", "radial", "2, index given", kernels.RadialCircleParams
    SIMPLIFIES = "exact"

    camera: Camera
    """Camera intrinsics."""
    deflection: float
    """Angle of the rotation on the optical axis, δ₀ [rad], not negative."""
    phase: float = 0.0
    """Phase θ_b, added to the encoder's angle [rad]."""
    index: float = 1.5168
    """Refractive index n of the prism."""
    flat_side: FlatSide = FlatSide.SCENE
    """Side that the prism's flat face points to: scene or camera."""

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "index", check_index(self.index, "index"))

    @classmethod
    def _of_values(cls, camera: Camera, prism: Prism | Plate, values: Mapping[str, float]) -> Self:
        return cls(camera, values["deflection"], values["phase"], prism.index, as_wedge(prism).flat_side)

    def kernel_values(self) -> tuple[Any, ...]:
        deflection = self.deflection if self.flat_side is FlatSide.SCENE else -self.deflection
        return deflection, *phase_values(self.phase), self.index


# Exact model: refraction at both faces of the prism.

UPRIGHT = wp.mat33(1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
UPRIGHT_ROWS = np.eye(3)
"""Rotation of a prism axis without tilt: the identity matrix."""


def _pair(name: str, half_range: float, limit: float, slider: tuple[float, float]) -> tuple[Parameter, ...]:
    """Return two parameters, x and y, of one pair of angles; ``slider``: its largest value and step [deg]."""
    (end, step), limits = slider, (-limit, limit)
    return tuple(
        Parameter(
            f"{name}_{axis}", "rad", half_range, limits=limits, label=f"{name} in {axis}", slider=(-end, end, step)
        )
        for axis in "xy"
    )


@guarded
@dataclass(frozen=True)
class ExactModel(Model):
    """Exact model: refracts each ray at both faces of the prism, in closed form.

    Raises
    ------
    AmiwarpError
        If a field has an unusable value.

    Notes
    -----
    The formulas are in ``docs/explanation/optics.md``.

    Examples
    --------
    >>> import numpy as np
    >>> camera = amiwarp.Camera(width=640, height=480, fx=500.0, fy=500.0, cx=320.0, cy=240.0)
    >>> model = amiwarp.ExactModel(camera, amiwarp.Prism(apex=0.03), phase=0.1)
    >>> observed = model.deflect_points(np.array([[100.0, 200.0]]), np.array([0.5]))
    >>> model.compensate_points(observed, np.array([0.5])).round(2)
    array([[100., 200.]])
    """

    NAME, TEXT, NUMBERS, STRUCT = "exact", "exact (closed form)", "2, index given", kernels.ExactParams
    PARAMETERS = (
        Parameter("apex", "rad"),
        PHASE,
        *_pair("tilt", math.radians(5.0), 45.0, (5.0, 0.05)),
        *_pair("cylinder", 0.02, 5.0, (1.0, 0.01)),
        *_pair("wobble", 0.1, 45.0, (5.0, 0.05)),
        Parameter("index", "1", 0.2, like_size=True, limits=(1.0, 5.0)),
    )  # fmt: skip

    camera: Camera
    """Camera intrinsics."""
    prism: Prism
    """Prism whose faces refract the rays."""
    phase: float = 0.0
    """Phase θ_b, added to the encoder's angle [rad]."""
    tilt: tuple[float, float] = (0.0, 0.0)
    """Rotation of the prism's rotation axis about the camera's x, then about its y [rad]."""
    cylinder: tuple[float, float] = (0.0, 0.0)
    """Cylinder power of the tilted face: change of its slope per unit of the camera ray's tangent [rad], along the
    wedge (across it with the opposite sign), and at 45° to it."""
    wobble: tuple[float, float] = (0.0, 0.0)
    """Angles by which the prism's own axis is tipped out of the rotation axis, along the wedge and across it [rad].
    They turn with the prism."""

    def __post_init__(self) -> None:
        instance(self.camera, Camera, "camera")
        instance(self.prism, Prism, "prism")
        object.__setattr__(self, "phase", check_phase(self.phase))
        for name in ("tilt", "cylinder", "wobble"):
            if getattr(self, name) is not getattr(ExactModel, name):  # a tuple of the caller
                object.__setattr__(self, name, check_angles(getattr(self, name), name))

    @classmethod
    def _of_values(cls, camera: Camera, prism: Prism | Plate, values: Mapping[str, float]) -> Self:
        wedge = Prism(values["apex"], values.get("index", prism.index), as_wedge(prism).flat_side)
        pairs = {
            name: (values.get(f"{name}_x", 0.0), values.get(f"{name}_y", 0.0))
            for name in ("tilt", "cylinder", "wobble") if not {f"{name}_x", f"{name}_y"}.isdisjoint(values)
        }  # fmt: skip
        return cls(camera, wedge, values["phase"], **pairs)

    @classmethod
    def still_values(cls, values: Mapping[str, float]) -> dict[str, float]:
        flat = {name: 0.0 if name in ("cylinder_x", "cylinder_y") else value for name, value in values.items()}
        return super().still_values(flat)

    def params(self, device: Any) -> Any:
        *numbers, axis = self.kernel_values()
        matrix = UPRIGHT if axis is UPRIGHT_ROWS else wp.mat33(*axis.ravel().tolist())
        return struct_of(kernels.ExactParams, [*numbers, matrix])

    def kernel_values(self) -> tuple[Any, ...]:
        tilted, uneven = any(self.tilt), any((*self.cylinder, *self.wobble))
        azimuth, angle = math.atan2(*reversed(self.wobble)), math.atan(math.hypot(*self.wobble))
        return (
            math.sin(self.prism.apex), math.cos(self.prism.apex), self.prism.index**2, *phase_values(self.phase),
            int(self.prism.flat_side is FlatSide.SCENE), int(tilted or uneven), int(uneven), *self.cylinder,
            math.cos(azimuth), math.sin(azimuth), math.sin(angle), 2.0 * math.sin(angle / 2.0) ** 2,
            axis_rotation(*self.tilt) if tilted else UPRIGHT_ROWS,
        )  # fmt: skip


# Pair of prisms: exact refraction at the four faces of two prisms that turn independently.


@guarded
@dataclass(frozen=True)
class RisleyModel(Model):
    """Risley pair: refracts each ray at the four faces of two prisms, each with its own angle.

    Raises
    ------
    AmiwarpError
        If the prism has no second one, or a field has an unusable value.

    Notes
    -----
    A ray of the camera meets the first prism, then the second one. Each refracts it as in :class:`ExactModel`; both
    turn about the optical axis.

    Examples
    --------
    >>> import numpy as np
    >>> camera = amiwarp.Camera(width=640, height=480, fx=500.0, fy=500.0, cx=320.0, cy=240.0)
    >>> pair = amiwarp.Prism(apex=0.03, second=amiwarp.Prism(apex=0.03))
    >>> model = amiwarp.RisleyModel(camera, pair)
    >>> model.compensate_points(np.array([[100.0, 200.0]]), np.array([[0.4, 0.4 + np.pi]])).round()  # they cancel
    array([[100., 200.]])
    """

    NAME, TEXT, NUMBERS, STRUCT, ANGLES = "risley", "pair of prisms", "4, indices given", kernels.PairParams, 2
    PARAMETERS = (
        Parameter("apex", "rad"),
        PHASE,
        Parameter("second_apex", "rad", 0.02, limits=(0.0, 30.0), label="second apex", slider=(0.0, 10.0, 0.05)),
        Parameter("second_phase", "rad", limits=(-180.0, 180.0), label="second phase", slider=(-180.0, 180.0, 0.5)),
        Parameter("ratio", "1", 0.01),
    )  # fmt: skip
    ORBITS = (("apex", "phase"), ("second_apex", "second_phase"))

    camera: Camera
    """Camera intrinsics."""
    prism: Prism
    """The prism next to the camera, with the second one."""
    phase: float = 0.0
    """Phase θ_b of the first prism, added to its encoder's angle [rad]."""
    second_phase: float = 0.0
    """Phase of the second prism, added to its encoder's angle [rad]."""
    ratio: float = 0.0
    """Mean speed of the second prism relative to the first, which tells the second angle where only one is given."""

    def __post_init__(self) -> None:
        instance(self.camera, Camera, "camera")
        if instance(self.prism, Prism, "prism").second is None:
            raise AmiwarpError("the prism has no second one; give Prism(apex, second=Prism(apex))")
        for name in ("phase", "second_phase"):
            object.__setattr__(self, name, check_phase(getattr(self, name), name))
        object.__setattr__(self, "ratio", real(self.ratio, "ratio", -1e6, 1e6))

    @classmethod
    def start_values(cls, prism: Prism | Plate) -> dict[str, float]:
        prism = as_wedge(prism)
        second = prism if prism.second is None else prism.second
        return {**super().start_values(prism), "second_apex": second.apex}

    @classmethod
    def _of_values(cls, camera: Camera, prism: Prism | Plate, values: Mapping[str, float]) -> Self:
        prism = as_wedge(prism)
        second = prism if prism.second is None else prism.second
        other = Prism(values.get("second_apex", second.apex), second.index, second.flat_side)
        pair = Prism(values["apex"], prism.index, prism.flat_side, other)
        return cls(camera, pair, values["phase"], values.get("second_phase", 0.0), values.get("ratio", 0.0))

    def kernel_values(self) -> tuple[Any, ...]:
        prisms = (each.kernel_values() for each in self.singles())
        return (*prisms, self.phase, self.second_phase, self.ratio)

    def params(self, device: Any) -> Any:
        prisms = (each.params(device) for each in self.singles())
        return struct_of(kernels.PairParams, [*prisms, *self.kernel_values()[2:]])

    def singles(self) -> tuple[ExactModel, ExactModel]:
        first = ExactModel(self.camera, replace(self.prism, second=None), self.phase)
        return first, ExactModel(self.camera, cast("Prism", self.prism.second), self.second_phase)

    def all_angles(self, theta: NDArray[Any]) -> NDArray[np.float64]:
        return both_angles(theta, self.ratio)


def both_angles(theta: NDArray[Any], ratio: float) -> NDArray[np.float64]:
    """Return two angles [rad], shape (..., 2): those of the first, and the same times the ratio of their speeds."""
    first = np.asarray(theta, np.float64)
    with np.errstate(invalid="ignore"):  # infinity times 0 is NaN
        return np.stack([first, ratio * first], axis=-1)


def axis_rotation(tilt_x: float, tilt_y: float) -> NDArray[np.float64]:
    """Return the rotation matrix (3, 3) of a tilted axis: about x by ``tilt_x``, then about y by ``tilt_y`` [rad]."""
    cx, sx, cy, sy = math.cos(tilt_x), math.sin(tilt_x), math.cos(tilt_y), math.sin(tilt_y)
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, cx, -sx], [0.0, sx, cx]])
    about_y = np.array([[cy, 0.0, sy], [0.0, 1.0, 0.0], [-sy, 0.0, cy]])
    return about_y @ about_x


# Ellipse model: tables of the displacement for every pixel, fitted to another model or to measured pairs of pixels.

HARMONIC_ANGLES = 16
"""Number of angles at which a model is approximated."""


@guarded
@dataclass(frozen=True, eq=False)
class EllipseModel(Model):
    """Ellipse model: stores the mean and the first harmonic of the displacement for every observed pixel.

    Raises
    ------
    AmiwarpError
        If a table does not have the camera's size, or another field has an unusable value.

    Notes
    -----
    The displacement at φ = θ + θ_b is d(φ) = offset + cosine · cos φ + sine · sin φ [px].

    Examples
    --------
    >>> camera = amiwarp.Camera(width=32, height=24, fx=40.0, fy=40.0, cx=15.5, cy=11.5)
    >>> model = amiwarp.EllipseModel.from_prism(camera, amiwarp.Prism(apex=0.03))
    >>> model.cosine.shape
    (24, 32, 2)
    """

    NAME, TEXT, NUMBERS, STRUCT = "ellipse", "ellipse (table)", "6 a pixel", kernels.EllipseParams
    PARAMETERS = ExactModel.PARAMETERS
    SIMPLIFIES = "exact"

    camera: Camera
    """Camera intrinsics."""
    offset: NDArray[np.float32] = field(repr=False)
    """Mean displacement [px], shape ``(height, width, 2)``. In all tables, NaN marks a pixel without a ray."""
    cosine: NDArray[np.float32] = field(repr=False)
    """Cosine term of the displacement [px], shape ``(height, width, 2)``."""
    sine: NDArray[np.float32] = field(repr=False)
    """Sine term of the displacement [px], shape ``(height, width, 2)``."""
    phase: float = 0.0
    """Phase θ_b, added to the encoder's angle [rad]."""

    def __post_init__(self) -> None:
        instance(self.camera, Camera, "camera")
        object.__setattr__(self, "phase", check_phase(self.phase))
        for name in ("offset", "cosine", "sine"):
            table = array(getattr(self, name), name)
            shape = (self.camera.height, self.camera.width, 2)
            if table.shape != shape:
                raise AmiwarpError(f"{name} has shape {table.shape}; expected {shape}, the camera's rows and columns")
            if np.isinf(table).any():
                raise AmiwarpError(f"{name} holds an infinite displacement; give NaN for a pixel without a ray")
            object.__setattr__(self, name, table.astype(np.float32, copy=False))

    @classmethod
    def closed_form(cls) -> type[Model]:
        return ExactModel

    @classmethod
    def _of_values(cls, camera: Camera, prism: Prism | Plate, values: Mapping[str, float]) -> Self:
        return cls.from_model(ExactModel.from_values(camera, prism, values))

    @classmethod
    def from_model(cls, model: Model, device: Any = "cpu") -> Self:
        """Fit the tables to another model, by least squares over 16 angles for each pixel.

        Parameters
        ----------
        model : Model
            The model to approximate: one of a single prism or plate, other than the ellipse model.
        device : str or warp.Device, default "cpu"
            The device that does the fit.

        Returns
        -------
        EllipseModel
            The model. Its tables are NaN at pixels without a ray.

        Raises
        ------
        AmiwarpError
            If the model is of another optic, or an ellipse model.
        """
        if model.ANGLES != 1 or not model.PRISM or isinstance(model, EllipseModel):
            raise AmiwarpError(f"the {model.NAME} model cannot be fitted by ellipses; give a model of one prism")
        height, width = model.camera.height, model.camera.width
        table = wp.empty((height, width, 6), dtype=float, device=device)
        phi = math.tau * np.arange(HARMONIC_ANGLES) / HARMONIC_ANGLES
        angles = wp.array(np.stack([np.cos(phi), np.sin(phi)], axis=1), dtype=wp.vec2, device=device)
        inputs = [replace(cast("Any", model), phase=0.0).params(device), model_camera(model, device), angles]
        launch(kernels.fit_harmonics, height * width, inputs, [table], device=device)
        offset, cosine, sine = np.split(table.numpy(), 3, axis=2)
        return cls(model.camera, offset, cosine, sine, model.phase)

    @classmethod
    def fit(
        cls,
        camera: Camera,
        xy: NDArray[np.float64],
        theta: NDArray[np.float64],
        compensated: NDArray[np.float64],
        *,
        degree: int = 4,
    ) -> EllipseModel:
        """Fit the tables to measured pairs of pixels, by least squares.

        Each of the six table components is a polynomial of the pixel's position. The tables include the phase, so the
        model's ``phase`` is 0.

        Parameters
        ----------
        camera : Camera
            The camera.
        xy : numpy.ndarray
            Observed pixels [px], shape (n, 2).
        theta : numpy.ndarray
            Prism angle of the encoder [rad], shape (n,).
        compensated : numpy.ndarray
            The same points without the prism [px], shape (n, 2). Pairs with NaN or infinity in any array are left out.
        degree : int, default 4
            Total degree of the polynomials.

        Returns
        -------
        EllipseModel
            The model.

        Raises
        ------
        AmiwarpError
            If the pairs do not determine all coefficients, or a pixel is over 65,536 px away.
        """
        xy, theta = np.asarray(xy, dtype=np.float64), np.asarray(theta, dtype=np.float64)
        compensated, degree = np.asarray(compensated, dtype=np.float64), whole(degree, "degree", 0, 20)
        if xy.ndim != 2 or xy.shape[1] != 2 or compensated.shape != xy.shape or theta.shape != xy.shape[:1]:
            given = f"xy has shape {xy.shape}, theta {theta.shape} and compensated {compensated.shape}"
            raise AmiwarpError(f"{given}; give (n, 2), (n,) and (n, 2)")
        shift = compensated - xy
        valid = np.isfinite(shift).all(axis=1) & np.isfinite(theta)
        if not valid.any():
            raise AmiwarpError(f"{len(xy)} pairs hold no finite values; give measured pairs of pixels")
        farthest = float(max(np.abs(xy[valid]).max(), np.abs(compensated[valid]).max()))
        if farthest > LARGEST_SIZE:
            raise AmiwarpError(
                f"a pair of pixels lies {farthest:g} px from the origin; give pixels within {LARGEST_SIZE} px, or NaN "
                "for points outside the image"
            )
        basis = _polynomials(camera, xy[valid], degree)
        angle = theta[valid][:, None]
        design = np.hstack([basis, basis * np.cos(angle), basis * np.sin(angle)])
        solution, _, rank, _ = np.linalg.lstsq(design, shift[valid], rcond=None)
        if rank < design.shape[1]:
            raise AmiwarpError(
                f"{len(design)} pairs determine {rank} of {design.shape[1]} coefficients; "
                f"spread them over the image and the angles, or lower degree = {degree}"
            )
        rows, cols = np.mgrid[: camera.height, : camera.width]
        pixels = _polynomials(camera, np.stack([cols.ravel(), rows.ravel()], axis=1).astype(np.float64), degree)
        shape = (3, camera.height, camera.width, 2)
        tables = np.stack([pixels @ part for part in np.split(solution, 3)]).reshape(shape).astype(np.float32)
        return cls(camera, tables[0], tables[1], tables[2])

    def kernel_values(self) -> tuple[Any, ...]:
        return *phase_values(self.phase), np.concatenate([self.offset, self.cosine, self.sine], axis=2)

    @cached_property
    def _tables(self) -> dict[str, Any]:
        return {}

    def params(self, device: Any) -> Any:
        if str(device) not in self._tables:
            *phase, table = self.kernel_values()
            on_device = wp.array(table, dtype=float, device=device)
            self._tables[str(device)] = struct_of(kernels.EllipseParams, [*phase, on_device])
        return self._tables[str(device)]


def _polynomials(camera: Camera, xy: NDArray[np.float64], degree: int) -> NDArray[np.float64]:
    """Return products of Chebyshev polynomials of total degree ≤ ``degree``, with pixels scaled to [-1, 1].

    The shape is (n, terms).
    """
    scaled = 2.0 * xy / np.maximum([camera.width - 1.0, camera.height - 1.0], 1.0) - 1.0
    full = np.polynomial.chebyshev.chebvander2d(scaled[:, 0], scaled[:, 1], [degree, degree])
    return cast("NDArray[np.float64]", full.reshape(len(xy), degree + 1, degree + 1)[:, _triangle(degree)])


def _triangle(degree: int) -> NDArray[np.bool_]:
    i = np.arange(degree + 1)
    return i[:, None] + i[None, :] <= degree


# Plate model: the camera sees from a centre that moves on a circle.

NOMINAL_INVERSE_DEPTH = 2.0
"""Inverse depth with which a search starts [1/m]."""
LARGEST_INVERSE_DEPTH = 20.0
"""Upper limit of inverse depths [1/m]."""
LARGEST_WEDGE = math.radians(0.5)
"""Default bound of the angle between a plate's faces [rad]. Stock windows have 1 arcmin or less."""


@guarded
@dataclass(frozen=True, eq=False)
class PlateModel(Model):
    """Plate model: the camera sees each ray from a centre that the plate moves on a circle.

    The direction of a ray does not change. So a scene at infinity does not move, and the orbit of a point is
    proportional to its inverse depth: one for all pixels, or one for each (:attr:`depths`).

    Raises
    ------
    AmiwarpError
        If an inverse depth is not between 0 and 20 / m, the map of inverse depths does not have the camera's size, or
        another field has an unusable value.

    Notes
    -----
    A bearing u sees along the line from g N, where N = (sin α · w, cos α) is the normal of the faces at φ = θ + θ_b,
    and g = t (1 − c / √(n² − 1 + c²)) with c = u · N. A point of inverse depth ρ on it appears at
    u_xy + ρ g (N_xy u_z − N_z u_xy), with u_z unchanged. Faces that are not parallel change u before, by Snell's law.
    See ``docs/explanation/optics.md``.

    Examples
    --------
    >>> import math
    >>> import numpy as np
    >>> camera = amiwarp.Camera(width=640, height=480, fx=554.0, fy=554.0, cx=320.0, cy=240.0)
    >>> model = amiwarp.PlateModel(camera, amiwarp.Plate(0.01, math.radians(45.0)), inverse_depth=2.0)
    >>> model.compensate_points(np.array([[320.0, 240.0]]), np.array([0.0])).round(1)
    array([[323.7, 240. ]])
    """

    NAME, TEXT, NUMBERS, STRUCT = "plate", "tilted plate", "4, plate given", plate_kernels.PlateParams
    GLASS = Plate
    PARAMETERS = (
        Parameter("inverse_depth", "1/m", 1.0, limits=(0.0, LARGEST_INVERSE_DEPTH), label="inverse depth",
                  slider=(0.0, 5.0, 0.01)),
        PHASE,
        Parameter("wedge_x", "rad", LARGEST_WEDGE, fine=True),
        Parameter("wedge_y", "rad", LARGEST_WEDGE, fine=True),
    )  # fmt: skip

    camera: Camera
    """Camera intrinsics."""
    plate: Plate
    """Plate that shifts the rays."""
    phase: float = 0.0
    """Phase θ_b, added to the encoder's angle [rad]."""
    inverse_depth: float = 0.0
    """Inverse depth of the scene [1/m], as seen from the resting centre; 0: the plate moves nothing."""
    depths: NDArray[np.float32] | None = field(default=None, repr=False)
    """Inverse depth of what each pixel sees [1/m], shape ``(height, width)``, instead of :attr:`inverse_depth`."""
    wedge: tuple[float, float] = (0.0, 0.0)
    """Angle between the faces, along the tilt and across it [rad]: the normal of the face to the scene leans by it."""

    def __post_init__(self) -> None:
        instance(self.camera, Camera, "camera")
        instance(self.plate, Plate, "plate")
        object.__setattr__(self, "phase", check_phase(self.phase))
        object.__setattr__(self, "wedge", check_angles(self.wedge, "wedge"))
        largest = LARGEST_INVERSE_DEPTH
        object.__setattr__(self, "inverse_depth", real(self.inverse_depth, "inverse_depth", 0.0, largest, " 1/m"))
        if self.depths is None:
            return
        table, size = array(self.depths, "depths"), (self.camera.height, self.camera.width)
        if table.shape != size:
            raise AmiwarpError(f"depths has shape {table.shape}; expected {size}, the camera's rows and columns")
        if not ((table >= 0.0) & (table <= largest)).all():
            raise AmiwarpError(f"depths has values outside 0 .. {largest:g} 1/m; give the inverse depth of each pixel")
        object.__setattr__(self, "depths", table.astype(np.float32, copy=False))

    @classmethod
    def start_values(cls, prism: Prism | Plate) -> dict[str, float]:
        return {cls.SIZE: NOMINAL_INVERSE_DEPTH, PHASE.name: 0.0, "wedge_x": 0.0, "wedge_y": 0.0}

    @classmethod
    def default_bounds(cls, name: str, value: float, camera: Camera, prism: Prism | Plate) -> tuple[float, float]:
        if one_of(name, cls.FREE, "name") == cls.SIZE:
            return 0.0, 2.0 * NOMINAL_INVERSE_DEPTH
        return super().default_bounds(name, value, camera, prism)

    @classmethod
    def _of_values(cls, camera: Camera, prism: Prism | Plate, values: Mapping[str, float]) -> Self:
        if not isinstance(prism, Plate):
            raise AmiwarpError("the plate model needs the plate's thickness and tilt; give a Plate as the glass")
        wedge = values.get("wedge_x", 0.0), values.get("wedge_y", 0.0)
        return cls(camera, prism, values["phase"], values["inverse_depth"], wedge=wedge)

    @classmethod
    def still_values(cls, values: Mapping[str, float]) -> dict[str, float]:
        return {**super().still_values(values), "wedge_x": 0.0, "wedge_y": 0.0}

    def with_depths(self, depths: NDArray[Any]) -> PlateModel:
        """Return this model with the inverse depth of what each pixel sees.

        Parameters
        ----------
        depths : numpy.ndarray
            Inverse depths [1/m], shape ``(height, width)``.

        Returns
        -------
        PlateModel
            The model.
        """
        return replace(self, depths=np.asarray(depths))

    def kernel_values(self) -> tuple[Any, ...]:
        sine, cosine = math.sin(self.plate.tilt), math.cos(self.plate.tilt)
        inside = self.plate.index**2 - 1.0
        wedge = np.array(self.wedge)
        return *phase_values(self.phase), self.plate.thickness, inside, sine, cosine, self.inverse_depth, wedge

    def params(self, device: Any) -> Any:
        values = self.kernel_values()
        plate = self._plate_params()
        if self.depths is None:
            return plate
        if str(device) not in self._tables:
            self._tables[str(device)] = wp.array(self.depths, dtype=float, device=device)
        return struct_of(plate_kernels.PlateMapParams, [*values[:3], plate, self._tables[str(device)]])

    def _plate_params(self) -> Any:
        *numbers, wedge = self.kernel_values()
        return struct_of(plate_kernels.PlateParams, [*numbers, wp.vec2(*wedge.tolist())])

    @cached_property
    def _tables(self) -> dict[str, Any]:
        return {}

    def compensate_at(self, xy: NDArray[Any], theta: NDArray[Any], inverse_depth: NDArray[Any]) -> NDArray[np.float64]:
        """Return the pixel without the plate of points at known depths.

        Parameters
        ----------
        xy : numpy.ndarray
            Observed pixels [px], shape (n, 2).
        theta : numpy.ndarray
            Plate angle of the encoder [rad], shape (n,).
        inverse_depth : numpy.ndarray
            Inverse depth of what each pixel sees [1/m], shape (n,).

        Returns
        -------
        numpy.ndarray
            Compensated pixels [px], shape (n, 2). A row is NaN as in :meth:`compensate_points`, or if its inverse depth
            is NaN or infinite.
        """
        xy, theta, rho = array(xy, "xy"), array(theta, "theta"), array(inverse_depth, "inverse_depth")
        if xy.ndim != 2 or xy.shape[1] != 2 or not theta.shape == rho.shape == xy.shape[:1]:
            given = f"xy has shape {xy.shape}, theta {theta.shape} and inverse_depth {rho.shape}"
            raise AmiwarpError(f"{given}; give (n, 2), (n,) and (n,)")
        points = points_on_host(xy, theta)
        depths = wp.array(rho.astype(np.float32), dtype=float, device="cpu")
        plate = self._plate_params()
        out = wp.empty_like(points[0])
        inputs = [plate, model_camera(self, "cpu"), *points, depths]
        launch(plate_kernels.compensate_at_depths, len(out), inputs, [out], device="cpu")
        return np.asarray(out.numpy(), np.float64)


# The models by name.

MODELS: dict[str, type[Model]] = {
    model.NAME: model for model in (CircleModel, ExactModel, RadialCircleModel, EllipseModel, RisleyModel, PlateModel)
}
"""Optical models by name, ordered by their number of calibrated parameters, then by their measured cost per event."""


def size_names() -> set[str]:
    """Return the names of the parameters that are the size of a model."""
    return {model.SIZE for model in MODELS.values()}


def rungs(name: str = ExactModel.NAME) -> dict[str, type[Model]]:
    """Return a model and all that approximate it, directly or not, by name in the order of :data:`MODELS`."""

    def approximates(other: str | None) -> bool:
        return other is not None and (other == name or approximates(MODELS[other].SIMPLIFIES))

    return {other: model for other, model in MODELS.items() if approximates(other)}


def alternatives(name: str) -> dict[str, type[Model]]:
    """Return all models of the same optic as a model, by name: the best one and its approximations."""
    better = MODELS[name].SIMPLIFIES
    return rungs(name) if better is None else alternatives(better)


# Distance between two optical models over the image and one turn of the prism.


@guarded
@dataclass(frozen=True, slots=True)
class ModelError:
    """Distance between two models over the image and one turn of the prism."""

    rms: float
    """Root mean square distance of the two models [px]."""
    worst: float
    """Largest distance of the two models [px]."""
    lag: float
    """Constant angle that was subtracted from the first model's theta before the comparison [rad]; 0 by default."""


@guarded
def predicted_error(model: Model, exact: Model, *, remove_lag: bool = False, grid: int = 24) -> ModelError:
    """Return the distance between two optical models of the same prism, over the image and 36 prism angles.

    Parameters
    ----------
    model : Model
        Model to judge.
    exact : Model
        Model to compare with.
    remove_lag : bool, optional
        Whether to subtract first the constant prism angle that minimises the distance.
    grid : int, optional
        Rows of the grid of pixels; its cells are square. Pixels without a ray in either model are left out.

    Returns
    -------
    ModelError
        Root mean square and largest distance [px], and the lag [rad].

    Raises
    ------
    AmiwarpError
        If no pixel has a ray in both models.

    Examples
    --------
    >>> camera, prism = amiwarp.Camera.from_fov(320, 240, 1.0), amiwarp.Prism(0.02)
    >>> exact = amiwarp.ExactModel(camera, prism)
    >>> circle = amiwarp.CircleModel(camera, prism.deflection)
    >>> bool(amiwarp.predicted_error(circle, exact).rms < 1.0)
    True
    """
    from scipy.optimize import minimize_scalar

    camera = exact.camera
    grid = whole(grid, "grid", 1, 1000)
    columns = max(2, round(grid * camera.width / camera.height))
    x = np.round(np.linspace(0, camera.width - 1, columns))
    y = np.round(np.linspace(0, camera.height - 1, max(2, grid)))
    theta = np.arange(36) * (2.0 * np.pi / 36)
    mesh = np.stack([m.ravel() for m in np.meshgrid(x, y, theta, indexing="ij")], axis=1)
    target = exact.compensate_points(mesh[:, :2], mesh[:, 2])

    def distance(lag: float) -> NDArray[np.float64]:
        d = np.linalg.norm(model.compensate_points(mesh[:, :2], mesh[:, 2] - lag) - target, axis=1)
        return cast("NDArray[np.float64]", d[np.isfinite(d)])

    def rms(lag: float) -> float:
        return float(np.sqrt(np.mean(distance(lag) ** 2)))

    if not len(distance(0.0)):
        raise AmiwarpError("the two models have no valid point in common; compare models of the same camera and prism")
    lag = 0.0
    if remove_lag:
        start = min(np.arange(-12, 12) * (np.pi / 12), key=rms)
        bounds = (start - 0.3, start + 0.3)
        lag = float(minimize_scalar(rms, bounds=bounds, method="bounded", options={"xatol": 1e-6}).x)
        lag = lag if rms(lag) < rms(0.0) else 0.0
    return ModelError(rms(lag), float(distance(lag).max()), lag)
