"""What a prism does to the image of a camera: the radii of the orbits, and what each model of them costs."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from amiwarp.errors import AmiwarpError
from amiwarp.optics.models import MODELS, CircleModel, EllipseModel, ExactModel, RadialCircleModel, predicted_error
from amiwarp.optics.prism import Prism

if TYPE_CHECKING:
    from amiwarp.optics.camera import Camera

QUARTER_SWING = 1.0 - math.sqrt(0.5)
"""Least that a quarter turn of radius 1 moves an edge across itself, over all its directions and all starts."""
GRID = 12
"""Rows of pixels at which the circles are fitted."""


@dataclass(frozen=True, slots=True)
class Orbit:
    """What a prism does to the image, at any speed."""

    apex: float
    """[rad]."""
    deflection: float
    """Of the axial ray [rad]."""
    radius: float
    """Of the orbits, rms over the image [px]."""
    smallest: float
    """Radius of the smallest orbit of the image [px]."""
    errors: dict[str, float]
    """For each rung of the ladder its best fit's distance from the exact model, rms over image and turn [px]."""

    @property
    def swing(self) -> float:
        """Least that a quarter turn moves an edge across itself, anywhere in the image [px]."""
        return QUARTER_SWING * self.smallest


def orbit_of(camera: Camera, prism: Prism, device: str = "cpu") -> Orbit:
    """Radii, and the errors of all models. Raises :class:`AmiwarpError` where no pixel keeps its ray for a turn."""
    rms, smallest = orbit_radii(camera, prism)
    return Orbit(prism.apex, prism.deflection, rms, smallest, _model_errors(ExactModel(camera, prism), device))


def orbit_radii(camera: Camera, prism: Prism) -> tuple[float, float]:
    """Radius of the orbits [px], rms over the image and smallest; see :func:`orbit_of` for what is raised."""
    exact = ExactModel(camera, prism)
    x, y = np.linspace(0, camera.width - 1, 33), np.linspace(0, camera.height - 1, 25)
    grid = np.stack([m.ravel() for m in np.meshgrid(x, y)], axis=1)
    theta = np.arange(24) * (2.0 * np.pi / 24)
    moved = exact.compensate_points(np.repeat(grid, 24, axis=0), np.tile(theta, len(grid))).reshape(len(grid), 24, 2)
    radii = np.sqrt(np.mean(np.sum((moved - moved.mean(axis=1, keepdims=True)) ** 2, axis=2), axis=1))
    radii = radii[np.isfinite(radii)]
    if not len(radii):
        raise AmiwarpError(f"apex {math.degrees(prism.apex):.6g} deg: no pixel of this camera has a ray all the turn "
                           "long; take a smaller apex or a narrower lens")  # fmt: skip
    return float(np.sqrt(np.mean(radii**2))), float(radii.min())


def _model_errors(exact: ExactModel, device: str) -> dict[str, float]:
    """Of the best fit of each rung [px rms]; circles are given the deflection that suits the image best."""
    fitted = {
        "circle": _fitted(CircleModel, exact),
        "radial": _fitted(RadialCircleModel, exact),
        "ellipse": EllipseModel.from_model(exact, device),
    }
    return {n: predicted_error(fitted[n], exact, remove_lag=True).rms if n in fitted else 0.0 for n in MODELS}


def _fitted(kind: type[CircleModel | RadialCircleModel], exact: ExactModel) -> CircleModel | RadialCircleModel:
    from scipy.optimize import minimize_scalar

    def sized(deflection: float) -> CircleModel | RadialCircleModel:
        return replace(kind.from_prism(exact.camera, exact.prism), deflection=deflection)

    def error(deflection: float) -> float:
        return predicted_error(sized(deflection), exact, grid=GRID).rms

    size = exact.prism.deflection
    found = minimize_scalar(error, bounds=(0.5 * size, 4.0 * size), method="bounded", options={"xatol": 1e-3 * size})
    return sized(float(found.x))
