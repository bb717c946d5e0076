"""Models of the displacement by the prism, from two parameters to the exact refraction.

The formulas are derived in ``docs/explanation/optics.md``.
"""

from __future__ import annotations

from amiwarp.optics.circle_models import CircleModel, RadialCircleModel
from amiwarp.optics.displacement import model_camera, wrap_angle
from amiwarp.optics.ellipse_model import EllipseModel
from amiwarp.optics.exact_model import ExactModel, axis_rotation
from amiwarp.optics.model_error import ModelError, predicted_error
from amiwarp.optics.prism import FlatSide, Prism, apex_from_deflection, deflection_from_apex

__all__ = [
    "MODELS", "CircleModel", "EllipseModel", "ExactModel", "FlatSide", "Model", "ModelError", "Prism",
    "RadialCircleModel", "apex_from_deflection", "axis_rotation", "deflection_from_apex", "model_camera",
    "predicted_error", "wrap_angle",
]  # fmt: skip

Model = CircleModel | RadialCircleModel | EllipseModel | ExactModel
MODELS: dict[str, type[Model]] = {
    "circle": CircleModel,
    "exact": ExactModel,
    "radial": RadialCircleModel,
    "ellipse": EllipseModel,
}
"""Models by name, ordered by their number of calibrated parameters, then by their measured cost per event."""
