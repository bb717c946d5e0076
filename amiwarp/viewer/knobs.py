"""Parameters of the prism under which the inspector shows a recording, and where their values come from."""

from __future__ import annotations

import enum
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from amiwarp.optics.models.parameter import PHASE
from amiwarp.optics.models.registry import MODELS, alternatives
from amiwarp.optics.prism import Prism
from amiwarp.results.parameters import optical_parameters


class Source(enum.StrEnum):
    """Where the value of a parameter comes from. The value of a member is the text that the page shows."""

    ASSUMED = "assumed"
    ESTIMATED = "estimated"
    FILE = "from the file"
    CALIBRATED = "calibrated"
    HAND = "set by hand"
    TRUTH = "known truth"


@dataclass(frozen=True)
class Knobs:
    """Parameters of the prism that the page's sliders set."""

    model: str = "exact"
    """Name of the optical model."""
    apex: float = 0.0
    """Apex angle of the prism [rad]. Other optics have their size among :attr:`others`."""
    phase: float = 0.0
    """Phase θ_b of the prism [rad]."""
    clock_offset: float = 0.0
    """Offset between the clocks of encoder and camera, as in :class:`Encoder` [us]."""
    rpm: float = 0.0
    """Speed of the prism if the recording has no encoder [1/min]."""
    focal_length: float | None = None
    """Calibrated focal length [px]; None: the camera's."""
    others: tuple[tuple[str, float], ...] = ()
    """Names and values of other parameters of optical models that are not 0, sorted by name."""

    @classmethod
    def given(cls, values: Mapping[str, float], **known: Any) -> Knobs:
        """Return parameters with ``known`` fields, and the other parameters of optical models among the ``values``."""
        return cls(**known).with_values({name: values[name] for name in OTHERS if name in values})

    def value(self, name: str) -> float | None:
        """Return the value of a parameter; None if it is not known and has no slider."""
        if name not in OTHERS:
            return getattr(self, name)
        return dict(self.others).get(name, 0.0 if name in SLIDING else None)

    def with_values(self, values: Mapping[str, float]) -> Knobs:
        """Return the parameters with other values of some of them."""
        others = dict(self.others) | {
            name: value for name, value in values.items() if name in OTHERS
        }
        fields: dict[str, Any] = {
            name: value for name, value in values.items() if name not in OTHERS
        }
        not_zero = sorted((name, value) for name, value in others.items() if value)
        return replace(self, **fields, others=tuple(not_zero))

    @property
    def calibrated_only(self) -> dict[str, float]:
        """Parameters by name that the page cannot change, and that a calibration or the known truth gave."""
        without_slider = [name for name in OTHERS if name not in SLIDING]
        found = {name: self.value(name) for name in (*without_slider, "focal_length")}
        return {name: value for name, value in found.items() if value is not None}


def size_name(model: str) -> str:
    """Return the name of the parameter that the slider of a model's size sets: for all models of wedges the apex."""
    kind = MODELS[model]
    if kind.PRISM and kind.GLASS is Prism:
        return "apex"
    return kind.SIZE


WEDGE_SIZES = {kind.SIZE for name, kind in MODELS.items() if size_name(name) == "apex"}
"""Names of the sizes of models that the slider of the apex sets."""
OTHERS = {
    name: p for name, p in optical_parameters().items() if name not in (*WEDGE_SIZES, PHASE.name)
}
"""Parameters of the optical models but for phase and sizes of wedges, by name."""
SLIDING = {name: p for name, p in OTHERS.items() if p.label}
"""Those among :data:`OTHERS` that have a slider."""


def foreign_names(model: str) -> set[str]:
    """Return the names among :data:`OTHERS` of parameters that no model of the same optic has."""
    return OTHERS.keys() - {
        name for other_model in alternatives(model).values() for name in other_model.FREE
    }


CURVE_HALF_WIDTH = {
    "apex": math.radians(0.4),
    "phase": math.radians(30.0),
    "clock_offset": 5000.0,
    "rpm": 6.0,
    **{name: p.half_range for name, p in SLIDING.items()},
}
"""Half width of the range of each parameter over which its sharpness curve is drawn, in the parameter's unit."""
