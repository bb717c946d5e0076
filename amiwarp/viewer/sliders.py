"""Sliders and fields of the prism's parameters: their units, limits, values and texts."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

from amiwarp.optics.models.registry import MODELS, size_names
from amiwarp.viewer.inspector import Inspector
from amiwarp.viewer.knobs import OTHERS, SLIDING, Knobs, Source, size_name


class Slider(NamedTuple):
    """Slider of a parameter, in the page's units."""

    label: str
    unit: str
    """Unit, with angles in degrees; empty for a number."""
    ends: tuple[float, float, float]
    """Smallest value, largest value and step."""


class GivenField(NamedTuple):
    """Field of a property of camera or prism that a recording may lack."""

    label: str
    unit: str
    limits: tuple[float, float]
    """Smallest and largest value."""


LIMITS = {
    "apex": (0.0, 29.9),
    "phase": (-3600.0, 3600.0),
    "clock_offset": (-1e9, 1e9),
    **{name: p.limits for name, p in SLIDING.items()},
    "rpm": (-1e5, 1e5),
    **{name: p.limits for name, p in OTHERS.items()},
    "focal_length": (0.1, 1e6),
}
"""Smallest and largest value of each parameter in an address and a field, in degrees or the parameter's own unit."""
UNITS = {
    **dict.fromkeys(LIMITS, 1.0),
    **dict.fromkeys(("apex", "phase"), math.radians(1.0)),
    **{name: math.radians(1.0) for name, p in OTHERS.items() if p.unit == "rad"},
}
"""Conversion from the units of page and address (angles in degrees) to the parameters' units (radians): factors."""
GIVEN = {
    "fov_deg": GivenField("field of view", "°", (1.0, 170.0)),
    "prism_index": GivenField("refractive index", "", (1.01, 3.5)),
}
"""Properties of camera and prism that a recording may lack."""
_SLIDERS_OF_MODELS = {
    name: Slider(p.label, {"rad": "°", "1": ""}.get(p.unit, p.unit), p.slider)
    for name, p in SLIDING.items()
}
# The sizes first, behind the apex; other parameters last.
SLIDERS = {
    "apex": Slider("apex angle", "°", (0.0, 3.0, 0.005)),
    **{name: slider for name, slider in _SLIDERS_OF_MODELS.items() if name in size_names()},
    "phase": Slider("phase", "°", (-180.0, 180.0, 0.25)),
    "clock_offset": Slider("clock offset", "µs", (-20000.0, 20000.0, 10.0)),
    "rpm": Slider("speed of the prism", "rpm", (-3000.0, 3000.0, 0.5)),
    **{name: slider for name, slider in _SLIDERS_OF_MODELS.items() if name not in size_names()},
}
"""Sliders by parameter, in their order on the page. The apex's may be longer."""
FIELD_LIMITS = {
    **{name: LIMITS[name] for name in SLIDERS},
    **{name: field.limits for name, field in GIVEN.items()},
}
"""Smallest and largest value of the fields of the prism and the camera, in the page's units."""


def knob_values(inspector: Inspector) -> dict[str, float]:
    """Return the prism's parameters in the page's units, rounded as the page shows them."""
    return {name: _in_page_units(name, inspector.knobs) for name in SLIDERS}


def _in_page_units(name: str, knobs: Knobs) -> float:
    """Return a parameter as the page shows it; 0 if the model has none."""
    return round((knobs.value(name) or 0.0) / UNITS[name], 4)


def sliders(inspector: Inspector) -> list[dict[str, Any]]:
    """Return the sliders of the model's parameters: label, unit, ends, step, limits, value, true value and source."""
    values = knob_values(inspector)
    known = truths(inspector)
    # Of the sizes, only the ones of the shown model's orbits.
    shown = {*MODELS[inspector.knobs.model].FREE} - size_names()
    shown |= {*inspector.orbit_names, "clock_offset" if inspector.has_encoder else "rpm"}
    out = []
    for name, slider in SLIDERS.items():
        if name not in shown:
            continue
        least, most, step = slider.ends
        if name == "apex":
            most = max(most, round(2.0 * math.degrees(inspector.nominal_apex), 1))
        low, high = FIELD_LIMITS[name]
        out.append(
            {
                "name": name,
                "label": slider.label,
                "unit": slider.unit,
                "least": least,
                "most": most,
                "step": step,
                "low": low,
                "high": high,
                "value": values[name],
                "truth": known[name],
                "note": str(inspector.sources[name].value),
            }
        )
    return out


def given_fields(inspector: Inspector) -> list[dict[str, Any]]:
    """Return the properties of camera and prism that the recording lacks: name, label, unit, value and its limits."""
    not_known = (Source.ASSUMED, Source.HAND)
    values = {}
    if inspector.sources["camera"] in not_known:
        values["fov_deg"] = inspector.fov_deg
    if inspector.sources["prism"] in not_known and MODELS[inspector.knobs.model].PRISM:
        values["prism_index"] = inspector.prism.index

    fields = []
    for name, value in values.items():
        field = GIVEN[name]
        low, high = field.limits
        fields.append(
            {
                "name": name,
                "label": field.label,
                "unit": field.unit,
                "value": round(value, 4),
                "low": low,
                "high": high,
            }
        )
    return fields


def truths(inspector: Inspector) -> dict[str, float | None]:
    """Return the known true parameters in the page's units; None for an unknown one."""
    known = inspector.truth
    if known is None:
        return dict.fromkeys(SLIDERS)
    return {name: _in_page_units(name, known) for name in SLIDERS}


def with_unit(name: str, value: float, digits: int = 4) -> str:
    """Return a value of a slider, in its unit, as text."""
    unit = SLIDERS[name].unit
    space = "" if unit in {"°", ""} else " "
    return f"{value:.{digits}g}{space}{unit}"


def orbit_text(model: str, value: Callable[[str], float | None], phase: float) -> str:
    """Return the size of a model, as its slider sets it, and its phase [rad], with their units.

    ``value``: function that returns the value of a parameter by its name.
    """
    name = size_name(model)
    size = with_unit(name, (value(name) or 0.0) / UNITS[name])
    return f"{name.replace('_', ' ')} {size}, phase {math.degrees(phase):.4g}°"
