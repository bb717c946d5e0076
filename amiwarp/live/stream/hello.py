"""The JSON of a hello: read from a peer that may send anything, so every field is checked before it is used."""

from __future__ import annotations

import json
from typing import Any, NoReturn

from amiwarp.errors import AmiwarpError

LARGEST_PX = 65536
"""Sides of a frame [px]."""
LARGEST = 1e9
"""Largest amount of any other number: focal lengths, distortion, angles."""
MOST_COEFFICIENTS = 5
SHOWN = 60
"""Characters of a wrong value that a message repeats."""


def read_fields(held: bytes | bytearray) -> dict[str, Any]:
    """Return the fields of a hello, those that are known with the right type and in range.

    Raises :class:`AmiwarpError` for text that is not JSON, nested too deeply, or a field that is missing or wrong.
    """
    try:
        fields = json.loads(held, parse_constant=_refuse)
    except RecursionError as error:
        raise AmiwarpError("its hello is nested too deeply; send one object, 'camera' and 'prism' in it") from error
    except ValueError as error:
        raise AmiwarpError(f"its hello is not JSON: {error}; send one object") from error
    _object("its hello", fields)
    _sides("its hello", fields)
    for name in ("camera", "prism"):
        if fields.get(name) is None:
            fields.pop(name, None)
    if "camera" in fields:
        _camera("its hello's camera", fields["camera"])
    if "prism" in fields:
        _prism("its hello's prism", fields["prism"])
    return fields


def _camera(where: str, fields: Any) -> None:
    _object(where, fields)
    _sides(where, fields)
    _numbers(where, fields, "fx", "fy", "cx", "cy")
    _texts(where, fields, "distortion_model")
    given = fields.get("distortion", [])
    if not isinstance(given, list) or len(given) > MOST_COEFFICIENTS or not all(map(_is_number, given)):
        _wrong(where, "distortion", given, f"a list of up to {MOST_COEFFICIENTS} numbers")


def _prism(where: str, fields: Any) -> None:
    _object(where, fields)
    _numbers(where, fields, "apex", "index")
    _texts(where, fields, "flat_side")


def _object(where: str, fields: Any) -> None:
    if not isinstance(fields, dict):
        raise AmiwarpError(f"{where} is {_shown(fields)}; expected an object of attributes")


def _sides(where: str, fields: dict[str, Any]) -> None:
    for name in ("width", "height"):
        value = fields.get(name)
        if isinstance(value, bool) or not isinstance(value, int):
            _wrong(where, name, value, f"a whole number of pixels, 1 .. {LARGEST_PX}")
    width, height = fields["width"], fields["height"]
    if not (1 <= width <= LARGEST_PX and 1 <= height <= LARGEST_PX):
        size = f"{_shown(width)}x{_shown(height)}"
        raise AmiwarpError(f"{where} tells a size of {size}; expected 1 .. {LARGEST_PX} pixels each way")


def _numbers(where: str, fields: dict[str, Any], *names: str) -> None:
    for name in names:
        if not _is_number(fields.get(name)):
            _wrong(where, name, fields.get(name), f"a number up to {LARGEST:g}")


def _texts(where: str, fields: dict[str, Any], *names: str) -> None:
    for name in names:
        value = fields.get(name, "")
        if not isinstance(value, str) or len(value) > SHOWN or not value.isprintable():
            _wrong(where, name, value, "a word")


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= LARGEST


def _refuse(constant: str) -> NoReturn:
    raise ValueError(f"{constant} is no number of JSON")


def _wrong(where: str, name: str, value: Any, expected: str) -> NoReturn:
    if value is None:
        raise AmiwarpError(f"{where} has no attribute '{name}'; add it: {expected}")
    raise AmiwarpError(f"{where} attribute '{name}' is {_shown(value)}; expected {expected}")


def _shown(value: Any) -> str:
    """Return the value as JSON, cut where it is long."""
    try:
        text = json.dumps(value)
    except RecursionError:
        return "nested too deeply"
    return text if len(text) <= SHOWN else f"{text[:SHOWN]}..."
