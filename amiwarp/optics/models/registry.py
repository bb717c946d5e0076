"""The optical models by name."""

from __future__ import annotations

from collections.abc import Mapping

from amiwarp.optics.camera import Camera, with_lens
from amiwarp.optics.models.base import Model, model_of
from amiwarp.optics.models.circle import CircleModel, RadialCircleModel
from amiwarp.optics.models.ellipse import EllipseModel
from amiwarp.optics.models.exact import ExactModel
from amiwarp.optics.models.mirror import MirrorModel
from amiwarp.optics.models.pair import RisleyModel
from amiwarp.optics.models.plate import PlateModel
from amiwarp.optics.models.steerer import SteererModel
from amiwarp.optics.models.vibration import VibrationModel
from amiwarp.optics.prism import Plate, Prism
from amiwarp.validation import one_of

MODELS: dict[str, type[Model]] = {
    model.NAME: model
    for model in (
        CircleModel,
        ExactModel,
        RadialCircleModel,
        EllipseModel,
        RisleyModel,
        PlateModel,
        SteererModel,
        MirrorModel,
        VibrationModel,
    )
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


def alternatives(name: str) -> dict[str, type[Model]]:
    """Return all models of the same optic as a model, by name: the best one and its approximations."""
    better = MODELS[name].SIMPLIFIES
    return rungs(name) if better is None else alternatives(better)


def build_model(
    model: str, camera: Camera, prism: Prism | Plate, values: Mapping[str, float]
) -> Model:
    """Build the optical model of the parameter values.

    ``model``: its name. ``values``: parameters by name, in their units, of the model and of the camera's lens.
    ``camera`` and ``prism`` give what the values do not contain. Raises :class:`AmiwarpError` for an unknown model, or
    if size or phase is missing.
    """
    model_class = MODELS[one_of(model, MODELS, "model")]
    return model_of(model_class, with_lens(camera, values), prism, values)
