"""Effect of a prism on a camera's image: radii of the pixels' orbits, and error of each refraction model."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.optics.camera import Camera
from amiwarp.optics.models.base import Model
from amiwarp.optics.models.comparison import predicted_error
from amiwarp.optics.models.ellipse import EllipseModel
from amiwarp.optics.models.exact import ExactModel
from amiwarp.optics.models.registry import rungs
from amiwarp.optics.prism import Prism

QUARTER_SWING = 1.0 - math.sqrt(0.5)
"""Smallest displacement across an edge in a quarter turn on an orbit of radius 1.

The minimum is over all edge directions and all start angles.
"""
GRID = 12
"""Number of rows of the grid of pixels on which the circle models are fitted."""
ACROSS_IMAGE = 33
"""Number of columns of the grid of pixels whose paths are followed."""
DOWN_IMAGE = 25
"""Number of its rows."""
TURN_ANGLES = 24
"""Number of angles per turn at which these pixels are followed."""


@dataclass(frozen=True, slots=True)
class Orbit:
    """Effect of a prism on a camera's image, independent of its speed."""

    apex: float
    """Apex angle of the prism [rad]."""
    deflection: float
    """Deflection of the ray on the optical axis [rad]."""
    radius: float
    """Radius of the orbits [px], rms over the image."""
    smallest: float
    """Radius of the smallest orbit in the image [px]."""
    errors: dict[str, float]
    """For each model, the distance of its best fit from the exact model [px rms over image and turn]."""

    @property
    def swing(self) -> float:
        """Smallest displacement across an edge in a quarter turn, anywhere in the image [px]."""
        return QUARTER_SWING * self.smallest


def orbit_of(camera: Camera, prism: Prism, device: str = "cpu") -> Orbit:
    """Return the orbit of a prism: radii, and the errors of all models.

    Raises :class:`AmiwarpError` if no pixel has a ray during a whole turn.
    """
    rms, smallest = orbit_radii(camera, prism)
    errors = _model_errors(ExactModel(camera, prism), device)
    return Orbit(prism.apex, prism.deflection, rms, smallest, errors)


def orbit_radii(camera: Camera, prism: Prism) -> tuple[float, float]:
    """Return the radius of the orbits [px], rms over the image, and the smallest radius [px].

    Raises :class:`AmiwarpError` if no pixel has a ray during a whole turn.
    """
    moved = paths(ExactModel(camera, prism), image_grid(camera), TURN_ANGLES)
    whole_turn = np.isfinite(moved).all(axis=(1, 2))
    radii = radii_of(moved[whole_turn])
    if not len(radii):
        raise AmiwarpError(
            f"apex {math.degrees(prism.apex):.6g} deg: no pixel of this camera has a ray during a "
            "whole turn; choose a smaller apex or a lens with a narrower view"
        )
    return float(np.sqrt(np.mean(radii**2))), float(radii.min())


def image_grid(
    camera: Camera, across: int = ACROSS_IMAGE, down: int = DOWN_IMAGE
) -> NDArray[np.float64]:
    """Return a grid of pixels over the whole image, row by row, shape ``(down * across, 2)``."""
    x, y = np.meshgrid(
        np.linspace(0, camera.width - 1, across), np.linspace(0, camera.height - 1, down)
    )
    return np.stack([x.ravel(), y.ravel()], axis=1)


def paths(
    model: Model, pixels: NDArray[np.float64], per_turn: int, turns: int = 1
) -> NDArray[np.float64]:
    """Return the path of what each pixel sees in the image at rest, over whole turns of the first angle.

    The shape is (pixels, ``per_turn * turns``, 2). Positions are NaN where a pixel has no ray.
    """
    theta = np.arange(per_turn * turns) * (2.0 * np.pi / per_turn)
    xy = np.repeat(pixels, len(theta), axis=0)
    moved = model.compensate_points(xy, np.tile(theta, len(pixels)))
    return moved.reshape(len(pixels), len(theta), 2)


def radii_of(moved: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rms distance of each path, shape (pixels, angles, 2), from its middle: of a circle, its radius."""
    from_middle = moved - moved.mean(axis=1, keepdims=True)
    square = np.sum(from_middle**2, axis=2)
    return np.asarray(np.sqrt(np.mean(square, axis=1)))


def _model_errors(exact: ExactModel, device: str) -> dict[str, float]:
    """Return the error of each refraction model's best fit [px rms]."""
    errors = {}
    for name, kind in rungs().items():
        if kind is ExactModel:
            errors[name] = 0.0
            continue
        fitted = _fitted(kind, exact, device)
        errors[name] = predicted_error(fitted, exact, remove_lag=True).rms
    return errors


def _fitted(kind: type[Model], exact: ExactModel, device: str) -> Model:
    """Return the model of a kind that is nearest to the exact one."""
    if kind.closed_form() is kind:
        return _sized(kind, exact)
    # Tables are made from the exact model.
    return EllipseModel.from_model(exact, device)


def _sized(kind: type[Model], exact: ExactModel) -> Model:
    """Return the model whose size fits the exact model best."""
    from scipy.optimize import minimize_scalar

    start = kind.start_values(exact.prism)

    def sized(size: float) -> Model:
        return kind.from_values(exact.camera, exact.prism, {**start, kind.SIZE: size})

    def error(size: float) -> float:
        return predicted_error(sized(size), exact, grid=GRID).rms

    size = start[kind.SIZE]
    bounds = (0.5 * size, 4.0 * size)
    tolerance = 1e-3 * size
    optimum = minimize_scalar(error, bounds=bounds, method="bounded", options={"xatol": tolerance})
    return sized(float(optimum.x))


LEAST_SWING = 1.0
"""Smallest useful displacement across an edge in a quarter turn [px].

An edge that moves less may not cross any pixel.
"""
