"""Models of the displacement by the prism, from two parameters to the exact refraction.

The formulas are derived in ``docs/explanation/optics.md``.
"""

from __future__ import annotations

from amiwarp.optics.circle_models import CircleModel, RadialCircleModel
from amiwarp.optics.ellipse_model import EllipseModel
from amiwarp.optics.exact_model import ExactModel

Model = CircleModel | RadialCircleModel | EllipseModel | ExactModel
MODELS: dict[str, type[Model]] = {
    "circle": CircleModel,
    "exact": ExactModel,
    "radial": RadialCircleModel,
    "ellipse": EllipseModel,
}
"""Optical models by name, ordered by their number of calibrated parameters, then by their measured cost per event."""
