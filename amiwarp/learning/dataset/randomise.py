"""Randomised values of a specification: ranges from which each recording draws its light, sensor, optic and shake."""

from __future__ import annotations

import hashlib
import json
import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Any

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.optics.prism import Prism
from amiwarp.schema.records import at_field
from amiwarp.simulation.motion import PrismMotion
from amiwarp.simulation.sensor_model import SensorModel
from amiwarp.validation import one_of, real, shown

SCENES = ("pictures", "worlds", "world_files")
"""Kinds of sources that are a scene, in contrast to a recording of one."""
SIMULATED = ("pictures", "videos", "translated", "worlds", "world_files")
"""Kinds of sources that are simulated."""
SENSOR = tuple(field.name for field in fields(SensorModel))
"""Names of the values of the sensor."""


def _check_apex(value: float) -> None:
    Prism(math.radians(value))


def _check_rpm(value: float) -> None:
    PrismMotion(value)


def _within(low: float, high: float, unit: str = "") -> Callable[[float], None]:
    """Return a function that raises :class:`AmiwarpError` for a value outside a range."""

    def check(value: float) -> None:
        real(value, "a drawn value", low, high, unit)

    return check


OPTIC: dict[str, Callable[[float], None]] = {
    "apex_deg": _check_apex,
    "rpm": _check_rpm,
    "start_deg": _within(-360.0, 360.0, " deg"),
}
"""Names of the values of the prism, with their checks. Recordings without a prism have none."""
SCENE: dict[str, Callable[[float], None]] = {
    "light": _within(1e-3, 1e3),
    "gamma": _within(0.1, 10.0),
    "blur_px": _within(0.0, 20.0, " px"),
    "shake_deg": _within(0.0, 10.0, " deg"),
    "shake_hz": _within(0.1, 200.0, " Hz"),
    "shake_direction_deg": _within(-360.0, 360.0, " deg"),
}
"""Names of the values of the scene and of the camera's shake, with their checks."""
APPLIES = {
    **dict.fromkeys((*SENSOR, *OPTIC), SIMULATED),
    **dict.fromkeys(SCENE, SCENES),
    "gamma": ("pictures",),
}
"""Kinds of sources to which each value applies."""


@dataclass(frozen=True)
class DrawEntry:
    """Fields of an entry of ``randomise``: a range or a choice, of which exactly one is given."""

    uniform: tuple[float, float] | None = None
    """Lowest and highest value, between which all are equally likely."""
    log_uniform: tuple[float, float] | None = None
    """Lowest and highest value, between which all logarithms are equally likely."""
    choice: tuple[float, ...] | None = None
    """Values that are equally likely."""

    def __post_init__(self) -> None:
        given = [name for name, value in vars(self).items() if value is not None]
        if len(given) != 1:
            raise AmiwarpError(
                f"has {' and '.join(given) or 'no range'}; give one of uniform, log_uniform and choice",
                ErrorCode.FIELD,
            )
        if not self.ends:
            raise AmiwarpError("choice is empty; give at least one value", ErrorCode.FIELD)
        if self.choice is None and self.ends[0] >= self.ends[1]:
            raise AmiwarpError(
                f"{given[0]} is {shown(list(self.ends))}; give the lowest and a higher value",
                ErrorCode.FIELD,
            )
        if self.log_uniform is not None and self.log_uniform[0] <= 0.0:
            raise AmiwarpError(
                f"log_uniform begins at {self.log_uniform[0]:g}; give a value above 0",
                ErrorCode.FIELD,
            )

    @property
    def ends(self) -> tuple[float, ...]:
        """Lowest and highest value of a range, or all values of a choice."""
        return self.uniform or self.log_uniform or self.choice or ()

    def at(self, share: float) -> float:
        """Return the value at a share of the range, 0 to below 1, to six digits."""
        if self.choice is not None:
            return self.choice[int(share * len(self.choice))]
        low, high = self.ends
        value = low + (high - low) * share
        if self.log_uniform is not None:
            value = low * (high / low) ** share
        return min(max(float(f"{value:.6g}"), low), high)


def check_randomise(entries: Mapping[str, DrawEntry], kinds: Sequence[str]) -> None:
    """Raise :class:`AmiwarpError` for values that cannot be drawn.

    ``kinds``: kinds of the sources of the specification.
    """
    for name, entry in entries.items():
        where = f"randomise.{name}"
        one_of(name, APPLIES, "field randomise has the value")
        for value in entry.ends:
            at_field(where, partial(_check_value, name, value))
        for k, kind in enumerate(kinds):
            if kind not in APPLIES[name]:
                raise AmiwarpError(
                    f"field {where} does not apply to sources[{k}], {kind}; remove one of them",
                    ErrorCode.FIELD,
                )
    if ("shake_deg" in entries) != ("shake_hz" in entries):
        raise AmiwarpError(
            "field randomise has one of shake_deg and shake_hz; give both", ErrorCode.FIELD
        )
    if "shake_direction_deg" in entries and "shake_deg" not in entries:
        raise AmiwarpError(
            "field randomise.shake_direction_deg needs shake_deg and shake_hz; give them too",
            ErrorCode.FIELD,
        )


def check_drawn_prism(entries: Mapping[str, DrawEntry], prisms: int, speeds: int) -> None:
    """Raise :class:`AmiwarpError` for values of the prism that do not fit the numbers of prisms and speeds."""
    for name, count, others in (("apex_deg", prisms, "prisms"), ("rpm", speeds, "speeds_rpm")):
        if name in entries and count != 1:
            raise AmiwarpError(
                f"field randomise.{name} replaces the value of {others}, which has {count} entries; give one",
                ErrorCode.FIELD,
            )
    if "start_deg" in entries and not prisms:
        raise AmiwarpError(
            "field randomise.start_deg is the angle of a prism, but there are no prisms; remove it",
            ErrorCode.FIELD,
        )


def _check_value(name: str, value: float) -> None:
    """Raise :class:`AmiwarpError` for a value that its setting cannot have."""
    if name in SENSOR:
        replace(SensorModel(), **{name: value})
    else:
        (OPTIC | SCENE)[name](value)


def draw(entries: Mapping[str, DrawEntry], recipe: Mapping[str, Any]) -> dict[str, float]:
    """Return the values of a recording.

    Each depends on the source, the seed, the trajectory and its name alone. So recordings of one source and seed that
    differ in optic and sensor see the same scene, and another entry changes no value.
    """
    source = recipe["source"]
    same = [source["sha256"] or source["name"], recipe.get("seed"), recipe.get("trajectory")]
    values = {}
    for name, entry in entries.items():
        is_plain = "prism" in recipe and recipe["prism"] is None
        if name in OPTIC and is_plain:
            continue
        digest = hashlib.sha256(json.dumps([*same, name]).encode()).hexdigest()
        values[name] = entry.at(int(digest[:13], 16) / 16**13)
    return values


def drawn_ranges(drawn: Sequence[Mapping[str, float]]) -> dict[str, dict[str, float]]:
    """Return the least, the median and the largest of the drawn values of recordings, by their name."""
    ranges = {}
    for name in dict.fromkeys(name for values in drawn for name in values):
        found = [values[name] for values in drawn if name in values]
        ranges[name] = {
            "least": min(found),
            "median": statistics.median(found),
            "largest": max(found),
        }
    return ranges
