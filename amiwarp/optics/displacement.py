"""Base class of the optical models: what a model knows of itself, and the displacement of points on any device."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import groupby
from typing import TYPE_CHECKING, Any, ClassVar, Self, TypeVar

import numpy as np
import warp as wp

from amiwarp.errors import AmiwarpError
from amiwarp.kernels import refraction as kernels
from amiwarp.kernels.launch import RecordedLaunch, launch
from amiwarp.optics.camera import Camera, camera_params
from amiwarp.validation import array, guarded

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from numpy.typing import NDArray

    from amiwarp.optics.prism import NominalPrism, Prism

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
    """Unit of its values: ``rad``, or ``1`` for a number."""
    half_range: float = math.pi
    """Half width of its default bounds about its start value, in its unit. The size has bounds from its nominal value.
    """
    like_size: bool = False
    """Whether its effect on the sharpness is nearly that of the size, so that sharpness alone hardly finds it."""
    limits: tuple[float, float] = (-math.inf, math.inf)
    """Smallest and largest value in an address of ``amiwarp view``, angles in degrees."""
    label: str = ""
    """Text of its slider in ``amiwarp view``; empty without a slider."""
    slider: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Minimum, maximum and step of its slider, angles in degrees; the slider starts at 0."""


PHASE = Parameter("phase", "rad")
"""Phase θ_b, which is added to the encoder's angle."""


class Model:
    """Optical model: displaces the pixels of a camera by the angle of its prism, and knows its parameters.

    Base class of all models. ``docs/explanation/optics.md`` derives their formulas.

    Examples
    --------
    >>> amiwarp.ExactModel.SIZE, amiwarp.ExactModel.FREE
    ('apex', ('apex', 'phase', 'tilt_x', 'tilt_y', 'index'))
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
    FREE: ClassVar[tuple[str, ...]]
    """Names of the parameters that a calibration can find."""
    SIZE: ClassVar[str]
    """Name of the parameter that sets the size of the orbit."""

    camera: Camera
    """Camera intrinsics."""
    phase: float
    """Phase θ_b, added to the encoder's angle [rad]."""

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        cls.FREE = tuple(parameter.name for parameter in cls.PARAMETERS)
        cls.SIZE = cls.FREE[0]

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
    def start_values(cls, prism: Prism) -> dict[str, float]:
        """Return the values with which a search starts if nothing but the nominal prism is known.

        Parameters
        ----------
        prism : Prism
            The nominal prism.

        Returns
        -------
        dict
            Value of each parameter by name, in its unit.
        """
        given = {cls.SIZE: cls.size_from_apex(prism.apex, prism), "index": prism.index}
        return {name: given.get(name, 0.0) for name in cls.FREE}

    @classmethod
    def from_values(cls, camera: Camera, prism: Prism, values: Mapping[str, float]) -> Self:
        """Create the model from the values of its parameters.

        Parameters
        ----------
        camera : Camera
            The camera.
        prism : Prism
            Prism that gives what ``values`` do not contain, such as the flat side.
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
    def _of_values(cls, camera: Camera, prism: Prism, values: Mapping[str, float]) -> Self:
        """Create the model of :meth:`from_values` from values that contain size and phase."""
        raise NotImplementedError

    @classmethod
    def from_prism(cls, camera: Camera, prism: Prism, phase: float = 0.0) -> Self:
        """Create the model of a prism.

        Parameters
        ----------
        camera : Camera
            The camera.
        prism : Prism
            The prism.
        phase : float, default 0.0
            Added to the encoder's angle [rad].

        Returns
        -------
        Model
            The model.
        """
        return cls.from_values(camera, prism, {**cls.start_values(prism), PHASE.name: phase})

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

    def compensate_points(self, xy: Points, theta: Points) -> Points:
        """Return the pixel that the same scene ray would hit without the prism.

        Parameters
        ----------
        xy : numpy.ndarray or warp.array
            Observed pixels [px], shape (n, 2), or a Warp array of vec2 of shape (n,).
        theta : numpy.ndarray or warp.array
            Prism angle of the encoder [rad], shape (n,). A float32 Warp array on the same device if ``xy`` is one.

        Returns
        -------
        numpy.ndarray or warp.array
            Compensated pixels [px], of the same shape as ``xy``. A row is NaN if it has no ray: total internal
            reflection, or a ray behind the image plane.

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
            Prism angle of the encoder [rad], shape (n,). A float32 Warp array on the same device if ``xy`` is one.

        Returns
        -------
        numpy.ndarray or warp.array
            Observed pixels [px], of the same shape as ``xy``. A row is NaN if it has no ray.

        Raises
        ------
        AmiwarpError
            If the arrays have other shapes, types or devices.
        """
        return _run("deflect_points", self, xy, theta)


def _run(kernel_name: str, model: Model, xy: Any, theta: Any) -> Any:
    kernel = getattr(kernels, kernel_name)
    if isinstance(xy, wp.array):
        if not isinstance(theta, wp.array) or theta.device != xy.device or theta.dtype is not wp.float32:
            raise AmiwarpError(
                f"xy is a Warp array on {xy.device}; give theta as a float32 Warp array on the same device"
            )
        if xy.dtype is not wp.vec2 or xy.ndim != 1 or xy.shape != theta.shape:
            given = f"xy has type {xy.dtype} and shape {xy.shape}, theta has shape {theta.shape}"
            raise AmiwarpError(f"{given}; give vec2 for xy, and shape (n,) for both")
        out = wp.empty_like(xy)
        launch(kernel, len(xy), [model.params(xy.device), model_camera(model, xy.device), xy, theta], [out],
               device=xy.device)  # fmt: skip
        return out
    xy, theta = array(xy, "xy"), array(theta, "theta")
    if xy.ndim != 2 or xy.shape[1] != 2 or theta.shape != xy.shape[:1]:
        raise AmiwarpError(f"xy has shape {xy.shape} and theta {theta.shape}; give (n, 2) and (n,)")
    result = _run(kernel_name, model, *points_on_host(xy, theta))
    return result.numpy().astype(xy.dtype if np.issubdtype(xy.dtype, np.floating) else np.float32, copy=False)


Made = TypeVar("Made", bound=Model)


def model_of(kind: type[Made], camera: Camera, prism: Prism, values: Mapping[str, float]) -> Made:
    """Create a model as :meth:`Model.from_values` does, but without its checks of types: a search calls it often."""
    check_given(values, kind.FREE[:2])
    return kind._of_values(camera, prism, values)


def check_given(values: Mapping[str, float], names: Iterable[str]) -> None:
    """Raise :class:`AmiwarpError` if a parameter has no value."""
    missing = [name for name in names if name not in values]
    if missing:
        raise AmiwarpError(f"values have no {', '.join(missing)}; give the value of each parameter")


def compensate_by_each(models: Sequence[Model], xy: NDArray[Any], theta: NDArray[Any]) -> NDArray[np.float64]:
    """Return the same pixels compensated by each of several models, on the CPU [px], shape (models, n, 2).

    ``xy`` holds the pixels, shape (n, 2). ``theta`` holds the prism angles, wrapped to a turn [rad], shape (n,), or
    (models, n) if each model has its own. One call takes a fraction of the time of a call for each model. Successive
    places of one model share a launch.
    """
    n = len(xy)
    pixels = wp.array(np.tile(xy.astype(np.float32), (len(models), 1)), dtype=wp.vec2, device="cpu", copy=False)
    angles = np.empty((len(models), n), np.float32)
    angles[:] = theta
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
    """Return pixels, shape (n, 2), and prism angles [rad], shape (n,), as Warp arrays on the CPU."""
    wrapped = wrap_angle(theta).astype(np.float32)
    return wp.array(xy.astype(np.float32), dtype=wp.vec2, device="cpu"), wp.array(wrapped, dtype=float, device="cpu")


def wrap_angle(angle: NDArray[np.float64]) -> NDArray[np.float64]:
    """Wrap an angle [rad] to [-pi, pi) in float64. Wrap angles before they are rounded to float32."""
    return (np.asarray(angle, dtype=np.float64) + np.pi) % (2.0 * np.pi) - np.pi


def model_camera(model: Model, device: Any) -> Any:
    """Return the parameters of the model's camera on ``device``, cached per camera."""
    return camera_params(model.camera, str(device))


def phase_values(phase: float) -> tuple[float, float, float]:
    """Return a phase [rad] with its cosine and sine: three fields of a model's parameters for kernels."""
    return phase, math.cos(phase), math.sin(phase)


def struct_of(kind: Any, values: Sequence[Any]) -> Any:
    """Return a Warp struct with the given values of its fields, in their order."""
    struct = kind()
    for name, value in zip(kind.vars, values, strict=True):
        setattr(struct, name, value)
    return struct
