"""Validation of the JSON of a hello message, the first message of a stream.

Its sender is not trusted, so every field is checked.
"""

import json
from typing import Any, NoReturn

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.optics.camera import LARGEST_SIZE

LARGEST = 1e9
"""Largest accepted absolute value of all numbers other than sizes."""
MOST_COEFFICIENTS = 8
"""Largest accepted number of distortion coefficients."""
SHOWN = 60
"""Largest number of characters of a wrong value that are shown in a message."""


def read_fields(payload: bytes | bytearray) -> dict[str, Any]:
    """Return the fields of a hello message; the known fields are checked for type and range.

    Raises :class:`AmiwarpError` for text that is not JSON or too deeply nested, and for missing or wrong fields.
    """
    try:
        fields = json.loads(payload, parse_constant=_refuse)
    except RecursionError as error:
        raise AmiwarpError(
            "its hello message is nested too deeply; send one JSON object with 'camera' and 'prism' in it",
            ErrorCode.FILE_DAMAGED,
        ) from error
    except ValueError as error:
        raise AmiwarpError(
            f"its hello message is not JSON: {error}; send one JSON object", ErrorCode.FILE_DAMAGED
        ) from error
    _check_object("its hello", fields)
    _check_size("its hello", fields)
    # Null stands for a field that is left out.
    for name in ("camera", "prism", "encoders"):
        if fields.get(name) is None:
            fields.pop(name, None)
    # 1.0 and true are equal to 1 in Python.
    encoders = fields.get("encoders", 1)
    if encoders not in (1, 2) or isinstance(encoders, bool | float):
        _raise_wrong("its hello", "encoders", fields["encoders"], "1 or 2, the number of encoders")
    if "camera" in fields:
        _check_camera("its hello's camera", fields["camera"])
    if "prism" in fields:
        _check_prism("its hello's prism", fields["prism"])
    return fields


def _check_camera(where: str, fields: Any) -> None:
    _check_object(where, fields)
    _check_size(where, fields)
    _check_numbers(where, fields, "fx", "fy", "cx", "cy")
    _check_words(where, fields, "distortion_model")
    given = fields.get("distortion", [])
    fits = isinstance(given, list) and len(given) <= MOST_COEFFICIENTS
    if not fits or not all(map(_is_number, given)):
        _raise_wrong(where, "distortion", given, f"a list of up to {MOST_COEFFICIENTS} numbers")


def _check_prism(where: str, fields: Any) -> None:
    _check_object(where, fields)
    sizes = ("thickness", "tilt") if "thickness" in fields else ("apex",)
    seconds = ("second_apex", "second_index") if "second_apex" in fields else ()
    _check_numbers(where, fields, *sizes, "index", *seconds)
    _check_words(where, fields, "flat_side", "second_flat_side")


def _check_object(where: str, fields: Any) -> None:
    if not isinstance(fields, dict):
        raise AmiwarpError(
            f"{where} is {_shown(fields)}; expected an object of attributes", ErrorCode.FILE_DAMAGED
        )


def _check_size(where: str, fields: dict[str, Any]) -> None:
    for name in ("width", "height"):
        value = fields.get(name)
        if isinstance(value, bool) or not isinstance(value, int):
            _raise_wrong(where, name, value, f"a whole number of pixels, 1 .. {LARGEST_SIZE}")
    width, height = fields["width"], fields["height"]
    if not (1 <= width <= LARGEST_SIZE and 1 <= height <= LARGEST_SIZE):
        size = f"{_shown(width)}x{_shown(height)}"
        raise AmiwarpError(
            f"{where} has a size of {size}; expected 1 .. {LARGEST_SIZE} pixels each way",
            ErrorCode.FILE_DAMAGED,
        )


def _check_numbers(where: str, fields: dict[str, Any], *names: str) -> None:
    for name in names:
        if not _is_number(fields.get(name)):
            _raise_wrong(where, name, fields.get(name), f"a number up to {LARGEST:g}")


def _check_words(where: str, fields: dict[str, Any], *names: str) -> None:
    for name in names:
        value = fields.get(name, "")
        if not isinstance(value, str) or len(value) > SHOWN or not value.isprintable():
            _raise_wrong(where, name, value, "a word")


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= LARGEST


def _refuse(constant: str) -> NoReturn:
    raise ValueError(f"{constant} is not a JSON number")


def _raise_wrong(where: str, name: str, value: Any, expected: str) -> NoReturn:
    if value is None:
        raise AmiwarpError(
            f"{where} has no attribute '{name}'; add this attribute: {expected}",
            ErrorCode.CONTENT_MISSING,
        )
    raise AmiwarpError(
        f"{where} attribute '{name}' is {_shown(value)}; expected {expected}",
        ErrorCode.FILE_DAMAGED,
    )


def _shown(value: Any) -> str:
    """Return the value as JSON text, shortened if it is long."""
    try:
        text = json.dumps(value)
    except RecursionError:
        return "nested too deeply"
    return text if len(text) <= SHOWN else f"{text[:SHOWN]}..."
