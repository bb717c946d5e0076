"""Effect of a prism on a camera's image: radii of the pixels' orbits, and error of each refraction model."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from amiwarp.errors import AmiwarpError
from amiwarp.optics.circle_models import CircleModel, RadialCircleModel
from amiwarp.optics.ellipse_model import EllipseModel
from amiwarp.optics.exact_model import ExactModel
from amiwarp.optics.model_error import predicted_error
from amiwarp.optics.models import MODELS
from amiwarp.optics.prism import Prism

if TYPE_CHECKING:
    from amiwarp.optics.camera import Camera

QUARTER_SWING = 1.0 - math.sqrt(0.5)
"""Smallest displacement across an edge in a quarter turn on an orbit of radius 1.

The minimum is over all edge directions and all start angles.
"""
GRID = 12
"""Number of rows of the grid of pixels on which the circle models are fitted."""


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
    return Orbit(prism.apex, prism.deflection, rms, smallest, _model_errors(ExactModel(camera, prism), device))


def orbit_radii(camera: Camera, prism: Prism) -> tuple[float, float]:
    """Return the radius of the orbits [px], rms over the image, and the smallest radius [px].

    Raises :class:`AmiwarpError` if no pixel has a ray during a whole turn.
    """
    exact = ExactModel(camera, prism)
    x, y = np.linspace(0, camera.width - 1, 33), np.linspace(0, camera.height - 1, 25)
    grid = np.stack([m.ravel() for m in np.meshgrid(x, y)], axis=1)
    theta = np.arange(24) * (2.0 * np.pi / 24)
    moved = exact.compensate_points(np.repeat(grid, 24, axis=0), np.tile(theta, len(grid))).reshape(len(grid), 24, 2)
    radii = np.sqrt(np.mean(np.sum((moved - moved.mean(axis=1, keepdims=True)) ** 2, axis=2), axis=1))
    radii = radii[np.isfinite(radii)]
    if not len(radii):
        raise AmiwarpError(f"apex {math.degrees(prism.apex):.6g} deg: no pixel of this camera has a ray during a "
                           "whole turn; choose a smaller apex or a lens with a narrower view")  # fmt: skip
    return float(np.sqrt(np.mean(radii**2))), float(radii.min())


def _model_errors(exact: ExactModel, device: str) -> dict[str, float]:
    """Return the error of each refraction model's best fit [px rms]; circle models get the best deflection."""
    fitted = {
        "circle": _fitted(CircleModel, exact),
        "radial": _fitted(RadialCircleModel, exact),
        "ellipse": EllipseModel.from_model(exact, device),
    }
    return {n: predicted_error(fitted[n], exact, remove_lag=True).rms if n in fitted else 0.0 for n in MODELS}


def _fitted(kind: type[CircleModel | RadialCircleModel], exact: ExactModel) -> CircleModel | RadialCircleModel:
    """Return the circle model whose deflection fits the exact model best."""
    from scipy.optimize import minimize_scalar

    def sized(deflection: float) -> CircleModel | RadialCircleModel:
        return replace(kind.from_prism(exact.camera, exact.prism), deflection=deflection)

    def error(deflection: float) -> float:
        return predicted_error(sized(deflection), exact, grid=GRID).rms

    size = exact.prism.deflection
    found = minimize_scalar(error, bounds=(0.5 * size, 4.0 * size), method="bounded", options={"xatol": 1e-3 * size})
    return sized(float(found.x))
