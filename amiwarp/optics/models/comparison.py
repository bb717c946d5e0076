"""Distance between two optical models over the image and one turn of the prism."""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.optics.models.base import Model
from amiwarp.schema.calls import guarded
from amiwarp.validation import whole

ANGLES = 36
"""Number of prism angles over one turn at which models are compared."""
LAGS = 24
"""Number of lags over one turn from which the search for the best one starts."""
LAG_REACH = 0.3
"""How far the best lag may be from the start of the search [rad]: more than the distance between two starts."""


def rms(moved: NDArray[np.float64]) -> float:
    """Return the root mean square length of displacements [px], shape (n, 2), without those that are not finite."""
    squares = np.sum(moved**2, axis=1)
    return float(np.sqrt(np.mean(squares[np.isfinite(squares)])))


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
def predicted_error(
    model: Model, exact: Model, *, remove_lag: bool = False, grid: int = 24
) -> ModelError:
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
    theta = np.arange(ANGLES) * (2.0 * np.pi / ANGLES)
    of_x, of_y, of_theta = np.meshgrid(x, y, theta, indexing="ij")
    mesh = np.stack([of_x.ravel(), of_y.ravel(), of_theta.ravel()], axis=1)
    pixels = mesh[:, :2]
    angles = mesh[:, 2]
    target = exact.compensate_points(pixels, angles)

    def distances(lag: float) -> NDArray[np.float64]:
        moved = model.compensate_points(pixels, angles - lag) - target
        length = np.linalg.norm(moved, axis=1)
        return cast("NDArray[np.float64]", length[np.isfinite(length)])

    def rms_distance(lag: float) -> float:
        return float(np.sqrt(np.mean(distances(lag) ** 2)))

    if not len(distances(0.0)):
        raise AmiwarpError(
            "the two models have no valid point in common; compare models of the same camera and prism"
        )
    lag = 0.0
    if remove_lag:
        # The distance may have several minima within a turn: start from the lag with the smallest one.
        lags = np.arange(-LAGS // 2, LAGS // 2) * (2.0 * np.pi / LAGS)
        start = min(lags, key=rms_distance)
        minimum = minimize_scalar(
            rms_distance,
            bounds=(start - LAG_REACH, start + LAG_REACH),
            method="bounded",
            options={"xatol": 1e-6},
        )
        best = float(minimum.x)
        if rms_distance(best) < rms_distance(0.0):
            lag = best
    largest = float(distances(lag).max())
    return ModelError(rms_distance(lag), largest, lag)
