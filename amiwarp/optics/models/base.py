"""Base class of the optical models: what a model knows of itself, and the displacement of points on any device."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any, ClassVar, Self, TypeVar

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError

# Loaded for their overloads: Warp's cache tells kernels apart by all overloads that are loaded when they are compiled.
# So every program finds the kernels that others have compiled.
from amiwarp.kernels import ellipse as _ellipse  # noqa: F401
from amiwarp.kernels import exact as _exact  # noqa: F401
from amiwarp.kernels import plate as _plate  # noqa: F401
from amiwarp.kernels import prism_pair as _prism_pair  # noqa: F401
from amiwarp.kernels import radial_circle as _radial_circle  # noqa: F401
from amiwarp.kernels import refraction as kernels
from amiwarp.kernels.launch import launch
from amiwarp.optics.camera import Camera
from amiwarp.optics.models.parameter import PHASE, Parameter
from amiwarp.optics.models.structs import points_on_host, struct_of
from amiwarp.optics.prism import NominalPrism, Plate, Prism, as_wedge
from amiwarp.schema.type_names import not_called
from amiwarp.validation import array, one_of

Points = TypeVar("Points")
"""Type of points given to a model: NumPy array (n, 2), or Warp array of vec2 of shape (n,). Results have the same type.
"""
BEYOND_TURNS = 2
"""Turns from its start to which a direction may go: further than any search does, so that it never ends there."""


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
    """Names of the parameters that each step of a global search finds; by default size and phase, one prism after the
    other."""

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
        """Return the model that a search uses instead of this one: itself, unless its tables come from another model.

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
            Value of the parameter :attr:`SIZE`: here the one with which a search starts.
        """
        return cls.start_values(prism)[cls.SIZE]

    @classmethod
    def default_bounds(
        cls,
        name: str,
        value: float,
        camera: Camera,
        prism: Prism | Plate,
    ) -> tuple[float, float]:
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
            The nominal glass. Here the size ranges from 0 to the size for twice its apex angle.

        Returns
        -------
        low, high : float
            The bounds, in the parameter's unit.
        """
        name = one_of(name, cls.FREE, "name")
        if name == cls.SIZE:
            wedge = as_wedge(prism)
            return 0.0, cls.size_from_apex(2.0 * wedge.apex, wedge)
        sizes, phases = zip(*cls.ORBITS, strict=True)
        if name in sizes:  # of another prism
            return 0.0, 2.0 * value
        if name in phases:
            return -PHASE.half_range, PHASE.half_range
        parameter = next(known for known in cls.PARAMETERS if known.name == name)
        half_range = parameter.half_range
        if parameter.period:
            half_range = BEYOND_TURNS * math.tau
        return value - half_range, value + half_range

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
        turned = dict(values)
        for _, phase in cls.ORBITS:
            if phase in values:
                turned[phase] = values[phase] + angle
        return turned

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
        """Return other values with nearly the same motion, so that a local search starts from both.

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
        size = cls.size_from_apex(wedge.apex, wedge)
        given = {cls.SIZE: size, "index": wedge.index}
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
        values = cls.start_values(prism)
        values[PHASE.name] = phase
        return cls.from_values(camera, prism, values)

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
        still = dict(values)
        for size, _ in cls.ORBITS:
            still[size] = 0.0
        return still

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
        return _displaced(kernels.compensate_points, self, xy, theta)

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
        return _displaced(kernels.deflect_points, self, xy, theta)


def _displaced(kernel: Any, model: Model, xy: Any, theta: Any) -> Any:
    """Return points moved by a kernel, as the arrays that were given: on a device, or NumPy arrays."""
    if isinstance(xy, wp.array):
        points = xy
        angles = _angles_on_device(model, points, theta)
    else:
        xy = array(xy, "xy")
        points, angles = _on_host(model, xy, theta)
    device = points.device
    moved = wp.empty_like(points)
    params = model.params(device)
    camera = model_camera(model, device)
    launch(kernel, len(points), [params, camera, points, angles.flatten()], [moved], device=device)
    if points is xy:
        return moved
    dtype = xy.dtype if np.issubdtype(xy.dtype, np.floating) else np.float32
    return moved.numpy().astype(dtype, copy=False)


def _on_host(model: Model, xy: NDArray[Any], theta: Any) -> tuple[wp.array, wp.array]:
    """Return points and all angles of a model as Warp arrays on the CPU."""
    theta = array(theta, "theta")
    are_points = xy.ndim == 2 and xy.shape[1] == 2
    if not are_points or theta.shape not in _shapes(len(xy), model.ANGLES):
        raise AmiwarpError(
            f"xy has shape {xy.shape} and theta {theta.shape}; give (n, 2) and {_wanted(model.ANGLES)}"
        )
    if theta.ndim != model.ANGLES:
        theta = model.all_angles(theta)
    return points_on_host(xy, theta)


def _angles_on_device(model: Model, xy: wp.array, theta: Any) -> wp.array:
    """Return all angles of a model at points on a device."""
    device = xy.device
    if not isinstance(theta, wp.array) or theta.device != device or theta.dtype is not wp.float32:
        raise AmiwarpError(
            f"xy is a Warp array on {device}; give theta as a float32 Warp array on the same device"
        )
    are_points = xy.dtype is wp.vec2 and xy.ndim == 1
    if not are_points or theta.shape not in _shapes(len(xy), model.ANGLES):
        given = f"xy has type {xy.dtype} and shape {xy.shape}, theta has shape {theta.shape}"
        wanted = f"give vec2 of shape (n,) for xy, and shape {_wanted(model.ANGLES)} for theta"
        raise AmiwarpError(f"{given}; {wanted}")
    if theta.ndim < model.ANGLES:
        all_angles = model.all_angles(theta.numpy())
        return wp.array(all_angles, dtype=float, device=device)
    return theta


def _shapes(points: int, angles: int) -> tuple[tuple[int, ...], ...]:
    """Return the shapes that angles of points may have, for a model with this number of angles."""
    if angles == 1:
        return ((points,),)
    return (points,), (points, angles)


def _wanted(angles: int) -> str:
    """Return the shape of the angles in an error message."""
    return "(n,)" if angles == 1 else f"(n, {angles})"


AnyModel = TypeVar("AnyModel", bound=Model)


def model_of(
    model_class: type[AnyModel],
    camera: Camera,
    prism: Prism | Plate,
    values: Mapping[str, float],
) -> AnyModel:
    """Create a model as :meth:`Model.from_values` does, but without its checks of types: a search calls it often."""
    check_given(values, model_class.FREE[:2])
    return model_class._of_values(camera, prism, values)


def check_given(values: Mapping[str, float], names: Iterable[str]) -> None:
    """Raise :class:`AmiwarpError` if a parameter has no value."""
    missing = [name for name in names if name not in values]
    if missing:
        listed = ", ".join(missing)
        raise AmiwarpError(f"values have no {listed}; give the value of each parameter")


def model_camera(model: Model, device: Any) -> Any:
    """Return the parameters of the model's camera on ``device``, cached per camera."""
    from amiwarp.kernels.camera import camera_params

    return camera_params(model.camera, str(device))
