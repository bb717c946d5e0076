"""Values of JSON and TOML converted to dataclasses, field by field, by the annotations of the fields.

Supported types are str, bool, int, float, None, literals, enumerations of texts, dataclasses, typed dicts, and lists,
tuples and mappings of these. ``Annotated[kind, check]`` calls ``check`` with the value and its name, and takes what it
returns. So a field states its range and unit, or its conversion, where it is defined; ``Any`` leaves it to the check.
Messages name the field, such as ``stages[0].points[2].apex``.
"""

import dataclasses
import difflib
import enum
import functools
import math
import types
import typing
from collections.abc import Callable, Collection, Mapping
from typing import (
    TYPE_CHECKING,
    Annotated,
    Any,
    Literal,
    TypeVar,
    get_args,
    get_origin,
    get_type_hints,
)

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.validation import choice, one_of, real, shown, whole

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Made = TypeVar("Made")
"""Any type."""
Record = TypeVar("Record", bound="DataclassInstance")
"""Any dataclass."""

LARGEST_INTEGER = 2**62
"""Largest accepted magnitude of a whole number, equal to :data:`amiwarp.validation.TIME_LIMIT`."""

Place = str | tuple[Any, str | int]
"""Where a value lies: the name of the outermost field, or the place of its container with its name or index there.

It becomes a text only for a message: a calibration with all points of its search has 20,000 numbers.
"""
Reader = Callable[[Any, Place], Any]
"""Function that converts a value at a place."""


def name_of(place: Place) -> str:
    """Return a place as text; empty for the whole file."""
    if isinstance(place, str):
        return place
    outer, key = place
    name = name_of(outer)
    if isinstance(key, int):
        return f"{name}[{key}]"
    return f"{name}.{key}" if name else key


def fields_of(
    data: Any, where: str, *needed: str, optional: tuple[str, ...] = ()
) -> dict[str, Any]:
    """Return a JSON object after checking that it has all ``needed`` fields and no others except ``optional`` fields.

    ``where`` names the object for messages; it is empty for the whole file. Raises :class:`AmiwarpError`, which names
    the field.
    """
    if not isinstance(data, dict):
        raise AmiwarpError(f"field {where} is {shown(data)}; expected an object", ErrorCode.FIELD)
    check_given(data, where, *needed)
    prefix = f"{where}." if where else ""
    for name in data:
        if name not in needed and name not in optional:
            known = (*needed, *optional)
            near = difflib.get_close_matches(str(name), known, 1)
            hint = f"; did you mean {near[0]}?" if near else ""
            raise AmiwarpError(
                f"field {prefix}{shown(name)[1:-1]} is unknown; expected {', '.join(known)}{hint}",
                ErrorCode.FIELD,
            )
    return data


def check_given(data: Mapping[str, Any], where: str, *needed: str) -> None:
    """Raise :class:`AmiwarpError` for the first of the ``needed`` fields that a JSON object lacks."""
    for name in needed:
        if name not in data:
            raise AmiwarpError(
                f"field {name_of((where, name))} is missing; add this field", ErrorCode.FIELD
            )


def check_format(data: Mapping[str, Any], name: str, version: int | str) -> None:
    """Raise :class:`AmiwarpError` if the fields ``format`` and ``version`` of a file are others than expected."""
    if data["format"] != name or data["version"] != version:
        given = f"{shown(data['format'])} and {shown(data['version'])}"
        raise AmiwarpError(
            f"fields format and version are {given}; expected {name!r} and {version}",
            ErrorCode.FIELD,
        )


def at_field(where: str, make: Callable[[], Made]) -> Made:
    """Return the result of ``make``, and add the field to the message of an :class:`AmiwarpError`."""
    try:
        return make()
    except AmiwarpError as error:
        message = str(error)
        if f"field {where}" not in message:
            message = f"field {where}: {message}"
        raise AmiwarpError(message) from error


def build(kind: type[Made], data: Any, where: str) -> Made:
    """Return a dataclass made from a JSON object, with each field checked against its annotation.

    Fields with a default may be missing. Raises :class:`AmiwarpError`, which names the field.
    """
    return value_of(kind, data, where)


def with_fields(
    record: Record, data: Any, where: str, names: Collection[str] | None = None
) -> Record:
    """Return a dataclass with the fields that a JSON object gives, each checked against its annotation.

    ``names``: fields that may be given; None for all. Raises :class:`AmiwarpError`, which names the field.
    """
    hints = get_type_hints(type(record), include_extras=True)
    known = [field.name for field in dataclasses.fields(record)]
    if names is not None:
        known = [name for name in known if name in names]
    given = fields_of(data, where, optional=tuple(known))
    values = {
        name: value_of(hints[name], value, name_of((where, name))) for name, value in given.items()
    }
    return at_field(where, lambda: dataclasses.replace(record, **values))


def value_of(kind: Any, value: Any, where: str) -> Any:
    """Return a JSON value converted to its annotated type. Raises :class:`AmiwarpError`, which names the field."""
    return _reader(kind)(value, where)


@functools.cache
def _reader(kind: Any) -> Reader:
    """Return the function that converts values to a type."""
    origin = get_origin(kind)
    arguments = get_args(kind)
    if dataclasses.is_dataclass(kind) and isinstance(kind, type):
        return _dataclass_reader(kind)
    if typing.is_typeddict(kind):
        hints = get_type_hints(kind, include_extras=True)
        return _fields_reader(hints, tuple(hints), ())
    if origin is Annotated:
        return _checking_reader(_reader(arguments[0]), arguments[1])
    if origin in (types.UnionType, typing.Union):
        [inner] = (part for part in arguments if part is not types.NoneType)
        return _optional_reader(_reader(inner))
    if origin is Literal:
        return lambda value, place: one_of(value, arguments, f"field {name_of(place)}")
    if origin in (dict, Mapping):
        return _mapping_reader(_reader(arguments[1]))
    if origin is tuple and arguments[-1] is not ...:
        return _fixed_tuple_reader([_reader(part) for part in arguments])
    if origin in (list, tuple):
        return _list_reader(origin, _reader(arguments[0]))
    if isinstance(kind, type) and issubclass(kind, enum.StrEnum):
        return lambda value, place: choice(kind, value, f"field {name_of(place)}")
    if kind not in _PLAIN_READERS:
        raise TypeError(f"values of {kind} cannot be read from JSON")
    return _PLAIN_READERS[kind]


def _read_float(value: Any, place: Place) -> float:
    if type(value) is float and math.isfinite(value):
        return value  # without making the name of the place
    return real(value, f"field {name_of(place)}")


def _read_int(value: Any, place: Place) -> int:
    return whole(value, f"field {name_of(place)}", -LARGEST_INTEGER, LARGEST_INTEGER)


def _read_text(value: Any, place: Place) -> str:
    if not isinstance(value, str):
        raise AmiwarpError(
            f"field {name_of(place)} is {shown(value)}; expected text", ErrorCode.FIELD
        )
    return value


def _read_truth_value(value: Any, place: Place) -> bool:
    if not isinstance(value, bool):
        raise AmiwarpError(
            f"field {name_of(place)} is {shown(value)}; expected true or false", ErrorCode.FIELD
        )
    return value


_PLAIN_READERS: dict[Any, Reader] = {
    float: _read_float,
    int: _read_int,
    str: _read_text,
    bool: _read_truth_value,
    Any: lambda value, _: value,
}


def _dataclass_reader(kind: type[Any]) -> Reader:
    """Return the reader of a dataclass, whose fields with a default may be missing."""
    needed: list[str] = []
    optional: list[str] = []
    for field in dataclasses.fields(kind):
        defaults = (field.default, field.default_factory)
        if all(default is dataclasses.MISSING for default in defaults):
            needed.append(field.name)
        else:
            optional.append(field.name)
    hints = get_type_hints(kind, include_extras=True)
    read_fields = _fields_reader(hints, tuple(needed), tuple(optional))

    def read(value: Any, place: Place) -> Any:
        values = read_fields(value, place)
        if place == "":
            return kind(**values)
        # the class may refuse a value out of range, or fields that do not belong together
        return at_field(name_of(place), lambda: kind(**values))

    return read


def _fields_reader(
    hints: Mapping[str, Any], needed: tuple[str, ...], optional: tuple[str, ...]
) -> Reader:
    """Return the reader of an object whose fields have known names and types."""

    # Readers are looked up when they are needed: a field may have the type that it is a field of.
    def read(value: Any, place: Place) -> dict[str, Any]:
        given = fields_of(value, name_of(place), *needed, optional=optional)
        return {name: _reader(hints[name])(entry, (place, name)) for name, entry in given.items()}

    return read


def _checking_reader(read: Reader, check: Callable[[Any, str], Any]) -> Reader:
    """Return the reader of a type with a check that each value then passes."""
    return lambda value, place: check(read(value, place), f"field {name_of(place)}")


def _optional_reader(read: Reader) -> Reader:
    """Return the reader of a type that may also be None."""
    return lambda value, place: None if value is None else read(value, place)


def _mapping_reader(read: Reader) -> Reader:
    """Return the reader of an object whose fields have any name, and one type."""

    def read_mapping(value: Any, place: Place) -> dict[str, Any]:
        given = value if isinstance(value, dict) else fields_of(value, name_of(place))
        return {name: read(entry, (place, name)) for name, entry in given.items()}

    return read_mapping


def _entries(value: Any, place: Place) -> list[Any]:
    """Return the entries of a list. Raises :class:`AmiwarpError` for another value."""
    if not isinstance(value, list):
        raise AmiwarpError(
            f"field {name_of(place)} is {shown(value)}; expected a list", ErrorCode.FIELD
        )
    return value


def _list_reader(kind: Any, read: Reader) -> Reader:
    """Return the reader of a list or tuple of any length."""
    return lambda value, place: kind(
        read(entry, (place, index)) for index, entry in enumerate(_entries(value, place))
    )


def _fixed_tuple_reader(readers: list[Reader]) -> Reader:
    """Return the reader of a tuple that has a type for each entry."""

    def read(value: Any, place: Place) -> tuple[Any, ...]:
        entries = _entries(value, place)
        if len(entries) != len(readers):
            raise AmiwarpError(
                f"field {name_of(place)} has {len(entries)} entries; expected {len(readers)}",
                ErrorCode.FIELD,
            )
        pairs = zip(readers, entries, strict=True)
        return tuple(
            read_one(entry, (place, index)) for index, (read_one, entry) in enumerate(pairs)
        )

    return read
