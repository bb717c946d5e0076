"""What else may explain an uneven prism that was found: a wobble and uneven faces move the image nearly alike."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from amiwarp.calib.result import Calibration
from amiwarp.optics.models import ExactModel, compensate_by_each

SHAPES = ("wobble", "cylinder")
"""Names of the two shapes, without their axes."""
STEP_RAD = 1e-3
"""Step of the finite differences in the parameters of a shape [rad]."""
ROUNDS = 3
"""Number of Gauss-Newton steps: the displacements are nearly linear."""
SIGNIFICANT = 3.0
"""Number of standard deviations from which on a shape was found."""


@dataclass(frozen=True)
class Rival:
    """The other shape, fitted to the motion by the one that was found."""

    shape: str
    """Its name."""
    values: tuple[float, float]
    """Its parameters, x and y [rad]."""
    moving_px: float
    """Distance of the motions, which the events show [px rms]."""
    still_px: float
    """Distance of the places about which points move, which no event shows [px rms]."""


def uneven_in_words(found: Calibration, free: tuple[str, ...] | None) -> tuple[str, ...]:
    """Return a sentence about the shape of the prism that was found, unless it was in the parameters ``free``."""
    if free is not None or not isinstance(found.model, ExactModel):
        return ()
    shapes = [shape for shape in SHAPES if _is_found(found, shape)]
    if len(shapes) != 1:
        return ()
    rival = other_shape(found.model, shapes[0])
    cylinder = rival.values if rival.shape == "cylinder" else found.model.cylinder
    magnified = one_sided_px(found.model, math.hypot(*cylinder))
    angle = math.degrees(math.hypot(*rival.values))
    names = {"wobble": "the prism sits askew in its mount (wobble", "cylinder": "its faces are uneven (cylinder"}
    return (
        f"instead of the {shapes[0]} that was found, it may be that {names[rival.shape]}, {angle:.2g} deg): the "
        f"motions differ by {rival.moving_px:.2g} px rms. No event tells where points are at rest, which differs by "
        f"{rival.still_px:.2g} px; a face that is curved along one direction only also magnifies the image, by "
        f"{magnified:.2g} px rms at rest, and that shows in a calibration of the lens through the prism only",
    )


def _is_found(found: Calibration, shape: str) -> bool:
    for name in (f"{shape}_x", f"{shape}_y"):
        std = found.uncertainty.get(name)
        if std is not None and abs(found.parameters[name]) > SIGNIFICANT * std:
            return True
    return False


def one_sided_px(model: ExactModel, cylinder: float) -> float:
    """Return how far the still part of a cylinder on one side moves points [px rms]; ``cylinder``: its power [rad].

    A slope of the face that grows along one direction only, by twice the cylinder's power, is the cylinder and a lens.
    """
    camera = model.camera
    radius = math.sqrt((camera.width**2 + camera.height**2) / 12.0)
    return (model.prism.index - 1.0) * cylinder * radius


def other_shape(model: ExactModel, shape: str) -> Rival:
    """Return the other shape whose motion is nearest to that of a model with a wobble or cylinder power."""
    other = SHAPES[1 - SHAPES.index(shape)]
    target = _displaced([model])[0]
    values = np.array([model.prism.apex, model.phase, 0.0, 0.0])

    def made(at: NDArray[np.float64]) -> ExactModel:
        apex, phase, x, y = (float(each) for each in at)
        uneven = {shape: (0.0, 0.0), other: (x, y)}
        return replace(model, prism=replace(model.prism, apex=apex), phase=phase, **uneven)  # type: ignore[arg-type]

    steps = np.diag([0.01 * model.prism.apex, STEP_RAD, STEP_RAD, STEP_RAD])
    for _ in range(ROUNDS):
        at, *ends = _displaced([made(values), *(made(values + step) for step in steps)])
        columns = np.stack([_moving(end - at).ravel() for end in ends], axis=1)
        change = np.linalg.lstsq(columns, _moving(target - at).ravel(), rcond=None)[0]
        values = values + change @ steps
    away = target - _displaced([made(values)])[0]
    still = away.mean(axis=1, keepdims=True)
    return Rival(other, (float(values[2]), float(values[3])), _rms(away - still), _rms(still))


def _displaced(models: list[ExactModel]) -> NDArray[np.float64]:
    """Return the places of a grid of pixels over a turn by each model [px], shape (models, pixels, angles, 2)."""
    camera = models[0].camera
    x, y = np.meshgrid(np.linspace(0, camera.width - 1, 9), np.linspace(0, camera.height - 1, 7))
    xy = np.stack([x.ravel(), y.ravel()], axis=1)
    theta = np.arange(12) * (math.tau / 12)
    points = np.repeat(xy, len(theta), axis=0).astype(np.float32)
    found = compensate_by_each(models, points, np.tile(theta, len(xy)))
    return np.asarray(found.reshape(len(models), len(xy), len(theta), 2), np.float64)


def _moving(places: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(places - places.mean(axis=1, keepdims=True))


def _rms(away: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.nanmean(np.sum(away**2, axis=-1))))
