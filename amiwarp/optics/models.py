"""Models of the displacement by the prism, from two parameters to the exact refraction.

The formulas are derived in ``docs/explanation/optics.md``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, cast

import numpy as np

from amiwarp.errors import AmiwarpError
from amiwarp.optics.circle_models import CircleModel, RadialCircleModel
from amiwarp.optics.displacement import Model as Model
from amiwarp.optics.ellipse_model import EllipseModel
from amiwarp.optics.exact_model import ExactModel
from amiwarp.validation import guarded, whole

if TYPE_CHECKING:
    from numpy.typing import NDArray


MODELS: dict[str, type[Model]] = {
    model.NAME: model for model in (CircleModel, ExactModel, RadialCircleModel, EllipseModel)
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
