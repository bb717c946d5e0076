"""What else may explain an uneven prism that was found: a wobble and uneven faces move the image nearly alike."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from amiwarp.optics.models.exact import ExactModel
from amiwarp.optics.models.several import compensate_by_each
from amiwarp.results.calibration import Calibration

Vector = NDArray[np.float64]

SHAPES = ("wobble", "cylinder")
"""Names of the two shapes, without their axes."""
OTHER_SHAPE = "the other shape of the prism"
"""Words of what could hide if a shape was found."""
STEP_RAD = 1e-3
"""Step of the finite differences in the parameters of a shape [rad]."""
ROUNDS = 3
"""Number of Gauss-Newton steps: the displacements are nearly linear."""
SIGNIFICANT = 3.0
"""Number of standard deviations above which a shape was found."""


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


def with_rival_shape(found: Calibration, free: tuple[str, ...] | None) -> Calibration:
    """Return the calibration with what else may explain the shape of the prism that was found, and how far that is.

    It is unchanged if no shape was found, or if it was in the parameters ``free``.
    """
    if free is not None or not isinstance(found.model, ExactModel):
        return found
    shapes = [shape for shape in SHAPES if _is_found(found, shape)]
    if len(shapes) != 1:
        return found
    shape = shapes[0]
    rival = other_shape(found.model, shape)
    warning = _in_words(found.model, shape, rival)
    stage = found.photometric
    if stage is not None:
        bound_px = math.hypot(rival.moving_px, rival.still_px)
        hidden_px = {**stage.hidden_px, OTHER_SHAPE: bound_px}
        stage = replace(stage, hidden_px=hidden_px)
    return replace(found, photometric=stage, warnings=(*found.warnings, warning))


def _in_words(model: ExactModel, shape: str, rival: Rival) -> str:
    """Return the warning that a rival may explain the shape that was found."""
    if rival.shape == "cylinder":
        cylinder = rival.values
        cause = "its faces are uneven (cylinder"
    else:
        cylinder = model.cylinder
        cause = "the prism sits askew in its mount (wobble"
    magnified = one_sided_px(model, math.hypot(*cylinder))
    angle = math.degrees(math.hypot(*rival.values))
    return (
        f"instead of the {shape} that was found, it may be that {cause}, {angle:.2g} deg): the "
        f"motions differ by {rival.moving_px:.2g} px rms. No event tells where points are at rest, which differs by "
        f"{rival.still_px:.2g} px; a face that is curved along one direction only also magnifies the image, by "
        f"{magnified:.2g} px rms at rest, and that shows in a calibration of the lens through the prism only"
    )


def _is_found(found: Calibration, shape: str) -> bool:
    """Return whether a shape is significant along one of its axes."""
    for name in (f"{shape}_x", f"{shape}_y"):
        std = found.uncertainty.get(name)
        if std is None:
            continue
        if abs(found.parameters[name]) > SIGNIFICANT * std:
            return True
    return False


def one_sided_px(model: ExactModel, cylinder: float) -> float:
    """Return how far the still part of a cylinder on one side moves points [px rms]; ``cylinder``: its power [rad].

    A slope of the face that grows along one direction only, by twice the cylinder's power, is the cylinder and a lens.
    """
    camera = model.camera
    square = (camera.width**2 + camera.height**2) / 12.0
    radius = math.sqrt(square)
    return (model.prism.index - 1.0) * cylinder * radius


def other_shape(model: ExactModel, shape: str) -> Rival:
    """Return the other shape whose motion is nearest to the motion by a wobble or cylinder power."""
    other = "cylinder" if shape == "wobble" else "wobble"
    target = _displaced([model])[0]
    values = np.array([model.prism.apex, model.phase, 0.0, 0.0])

    def made(at_point: Vector) -> ExactModel:
        """Return the model with other values of apex, phase and the other shape."""
        apex, phase, x, y = at_point.tolist()
        prism = replace(model.prism, apex=apex)
        shapes = {shape: (0.0, 0.0), other: (x, y)}
        return replace(model, prism=prism, phase=phase, **shapes)  # type: ignore[arg-type]

    # Fit the motion by least squares.
    steps = np.diag([0.01 * model.prism.apex, STEP_RAD, STEP_RAD, STEP_RAD])
    for _ in range(ROUNDS):
        models = [made(values)]
        for step in steps:
            models.append(made(values + step))
        at_point, *ends = _displaced(models)
        columns = np.stack([_moving(end - at_point).ravel() for end in ends], axis=1)
        left = _moving(target - at_point).ravel()
        change, *_ = np.linalg.lstsq(columns, left, rcond=None)
        values = values + change @ steps

    # What moves with the prism shows in the events; where points are at rest does not.
    away = target - _displaced([made(values)])[0]
    still = away.mean(axis=1, keepdims=True)
    _, _, x, y = values.tolist()
    return Rival(
        other,
        (x, y),
        moving_px=_rms(away - still),
        still_px=_rms(still),
    )


def _displaced(models: list[ExactModel]) -> Vector:
    """Return the places of a grid of pixels over a turn by each model [px], shape (models, pixels, angles, 2)."""
    camera = models[0].camera
    columns = np.linspace(0, camera.width - 1, 9)
    rows = np.linspace(0, camera.height - 1, 7)
    x, y = np.meshgrid(columns, rows)
    xy = np.stack([x.ravel(), y.ravel()], axis=1)
    theta = np.arange(12) * (math.tau / 12)

    points = np.repeat(xy, len(theta), axis=0).astype(np.float32)
    angles = np.tile(theta, len(xy))
    found = compensate_by_each(models, points, angles)
    by_pixel = found.reshape(len(models), len(xy), len(theta), 2)
    return np.asarray(by_pixel, np.float64)


def _moving(places: Vector) -> Vector:
    """Return places over a turn without the mean of each point."""
    mean = places.mean(axis=1, keepdims=True)
    return np.asarray(places - mean)


def _rms(away: Vector) -> float:
    squares = np.sum(away**2, axis=-1)
    return float(np.sqrt(np.nanmean(squares)))
