"""Untrusted JSON and TOML files, read strictly and into dataclasses and cameras, and stores of finished work."""

import dataclasses
import difflib
import enum
import hashlib
import json
import math
import os
import re
import tomllib
import types
import typing
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, NoReturn, TypeVar, get_args, get_origin, get_type_hints

from amiwarp.errors import AmiwarpError
from amiwarp.io.files import check_output, errors_name, open_input, write_text
from amiwarp.optics.camera import CAMERA_NUMBERS, DISTORTIONS, Camera
from amiwarp.validation import choice, instance, one_of, real, shown, whole

# Reader of untrusted JSON and TOML files: limited in size, strict, and converted to dataclasses field by field.

Made = TypeVar("Made")

MOST_BYTES = 8 << 20
"""Largest JSON file that is read [bytes]. Its values take up to 45 times as much memory. A calibration with all points
of its search takes about 1 MB."""
MOST_TOML_BYTES = 1 << 20
"""Largest TOML file that is read [bytes]. Such files are written by hand, and Python parses 1 MiB in seconds."""
MOST_PARTS = 32
"""Largest number of parts of a dotted key in TOML, as in ``a.b.c``. Their parser takes time by the square of it."""
_TOO_DOTTED = re.compile(
    r"""(?<![A-Za-z0-9_\\-])(?:(?:[A-Za-z0-9_-]++|"(?:[^"\\\n]|\\.)*+"|'[^'\n]*+')[ \t]*+\.[ \t]*+)"""
    rf"{{{MOST_PARTS}}}"
)
"""Pattern of dotted keys with more parts. Its quantifiers are possessive, so that the time is that of the length."""
LARGEST_INTEGER = 2**62
"""Largest accepted magnitude of a whole number, equal to :data:`amiwarp.events.recording.TIME_LIMIT`."""


def read_json(
    path: str | os.PathLike[str], what: str, *, most_bytes: int = MOST_BYTES, noted: bool = True
) -> dict[str, Any]:
    """Return the JSON object of a file.

    Parameters
    ----------
    path : str or path-like
        A file in UTF-8.
    what : str
        What the file should contain, for messages, such as "a calibration".
    most_bytes : int, optional
        Largest size of the file [bytes].
    noted : bool, default True
        Whether the file is an input, which no command replaces; False for results that the command continues.

    Returns
    -------
    dict
        The object.

    Raises
    ------
    AmiwarpError
        If the file cannot be read, is larger, is not a JSON object, is nested too deeply, or holds a number that is not
        finite or has thousands of digits.
    """
    path = Path(path)
    with errors_name(path, lambda: f"cannot be read as {what}"):
        with open_input(path, noted=noted) as file:
            text = file.read(most_bytes + 1)
        if len(text) > most_bytes:
            raise AmiwarpError(f"{path}: is larger than {most_bytes >> 20} MiB, so it is not {what}; give another file")
        data = parse_json(text)
        if not isinstance(data, dict):
            raise AmiwarpError(f"the file holds {shown(data)}; expected an object in braces")
    return data


def read_toml(path: Path, what: str) -> dict[str, Any]:
    """Return the fields of a TOML file of at most :data:`MOST_TOML_BYTES`.

    ``what`` says what the file should contain, for messages, such as "a world". Raises :class:`AmiwarpError` if the
    file cannot be read, is larger, has a key of more than :data:`MOST_PARTS` parts, or is not TOML.
    """
    with errors_name(path, lambda: f"cannot be read as {what}"):
        with open_input(path) as file:
            data = file.read(MOST_TOML_BYTES + 1)
        if len(data) > MOST_TOML_BYTES:
            raise AmiwarpError(f"is larger than {MOST_TOML_BYTES >> 20} MiB; give another file")
        text = data.decode("utf-8")
        if dotted := _TOO_DOTTED.search(text):
            line = text.count("\n", 0, dotted.start()) + 1
            raise AmiwarpError(f"line {line} has a key of more than {MOST_PARTS} parts; use fewer dots")
        return tomllib.loads(text)


def parse_json(text: bytes) -> Any:
    """Return the value of JSON text. Raises :class:`AmiwarpError` for invalid JSON and non-finite numbers."""
    try:
        return json.loads(text.decode("utf-8"), parse_constant=_refuse, parse_float=_finite)
    except AmiwarpError:
        raise
    except RecursionError as error:
        raise AmiwarpError("the JSON nests too deeply") from error
    except UnicodeDecodeError as error:
        raise AmiwarpError(f"byte {error.start} is not UTF-8") from error
    except ValueError as error:
        raise AmiwarpError(f"is not JSON: {error}") from error


def _refuse(word: str) -> NoReturn:
    """Raise :class:`AmiwarpError` for the words NaN and Infinity, which JSON does not allow."""
    raise AmiwarpError(f"the JSON holds {word}; expected finite numbers")


def _finite(digits: str) -> float:
    """Convert digits to a finite number; raise :class:`AmiwarpError` if it is too large for float64."""
    value = float(digits)
    if not math.isfinite(value):
        raise AmiwarpError(f"the JSON holds {shown(digits)}, beyond the largest float64")
    return value


def fields_of(data: Any, where: str, *needed: str, optional: tuple[str, ...] = ()) -> dict[str, Any]:
    """Return a JSON object after checking that it has all ``needed`` fields and no others except ``optional`` fields.

    ``where`` names the object for messages; it is empty for the whole file. Raises :class:`AmiwarpError`, which names
    the field.
    """
    if not isinstance(data, dict):
        raise AmiwarpError(f"field {where} is {shown(data)}; expected an object")
    prefix = f"{where}." if where else ""
    for name in needed:
        if name not in data:
            raise AmiwarpError(f"field {prefix}{name} is missing; add this field")
    for name in data:
        if name not in needed and name not in optional:
            known = (*needed, *optional)
            near = difflib.get_close_matches(str(name), known, 1)
            hint = f"; did you mean {near[0]}?" if near else ""
            raise AmiwarpError(f"field {prefix}{shown(name)[1:-1]} is unknown; expected {', '.join(known)}{hint}")
    return data


def at_field(where: str, make: Callable[[], Made]) -> Made:
    """Return the result of ``make``, and add the field to the message of an :class:`AmiwarpError`."""
    try:
        return make()
    except AmiwarpError as error:
        message = str(error)
        raise AmiwarpError(message if f"field {where}" in message else f"field {where}: {message}") from error


def build(kind: type[Made], data: Any, where: str) -> Made:
    """Return a dataclass made from a JSON object, with each field checked against its annotation.

    Fields with a default may be missing. For supported types see :func:`value_of`. Raises :class:`AmiwarpError`, which
    names the field.
    """
    hints = get_type_hints(kind, include_extras=True)
    known: tuple[Any, ...] = dataclasses.fields(kind)  # type: ignore[arg-type]
    has_default = {
        f.name: f.default is not dataclasses.MISSING or f.default_factory is not dataclasses.MISSING for f in known
    }
    needed = [name for name, has in has_default.items() if not has]
    optional = tuple(name for name, has in has_default.items() if has)
    given = fields_of(data, where, *needed, optional=optional)
    prefix = f"{where}." if where else ""
    return kind(**{name: value_of(hints[name], value, f"{prefix}{name}") for name, value in given.items()})


def value_of(kind: Any, value: Any, where: str) -> Any:
    """Return a JSON value converted to its annotated type. Raises :class:`AmiwarpError`, which names the field.

    Supported types are str, bool, int, float, None, literals, enumerations of texts, dataclasses, typed dicts, and
    lists, tuples and mappings of these. ``Annotated[kind, check]`` calls ``check`` with the value and its name.
    """
    if dataclasses.is_dataclass(kind) and isinstance(kind, type):
        return build(kind, value, where)
    if typing.is_typeddict(kind):
        hints = get_type_hints(kind, include_extras=True)
        given, prefix = fields_of(value, where, *hints), f"{where}." if where else ""
        return {name: value_of(hint, given[name], f"{prefix}{name}") for name, hint in hints.items()}
    if get_origin(kind) is Annotated:
        plain, check = get_args(kind)
        return check(value_of(plain, value, where), f"field {where}")
    if get_origin(kind) in (types.UnionType, typing.Union):
        parts = [part for part in get_args(kind) if part is not types.NoneType]
        return None if value is None else value_of(parts[0], value, where)
    if get_origin(kind) is Literal:
        return one_of(value, get_args(kind), f"field {where}")
    if isinstance(kind, type) and issubclass(kind, enum.StrEnum):
        return choice(kind, value, f"field {where}")
    if kind is float:
        return real(value, f"field {where}")
    if kind is int:
        return whole(value, f"field {where}", -LARGEST_INTEGER, LARGEST_INTEGER)
    if kind in (str, bool):
        if not isinstance(value, kind):
            raise AmiwarpError(
                f"field {where} is {shown(value)}; expected {'text' if kind is str else 'true or false'}"
            )
        return value
    return _container(kind, value, where)


def _container(kind: Any, value: Any, where: str) -> Any:
    """Convert a JSON value to its annotated list, tuple or mapping type."""
    origin, inner = get_origin(kind), get_args(kind)
    if origin in (dict, Mapping):
        given = value if isinstance(value, dict) else fields_of(value, where)
        return {name: value_of(inner[1], entry, f"{where}.{shown(name)[1:-1]}") for name, entry in given.items()}
    if not isinstance(value, list):
        raise AmiwarpError(f"field {where} is {shown(value)}; expected a list")
    fixed = origin is tuple and inner[-1] is not ...
    if fixed and len(value) != len(inner):
        raise AmiwarpError(f"field {where} has {len(value)} entries; expected {len(inner)}")
    kinds = inner if fixed else (inner[0],) * len(value)
    return origin(value_of(k, entry, f"{where}[{i}]") for i, (k, entry) in enumerate(zip(kinds, value, strict=True)))


def camera_from_json(data: Any, where: str = "") -> Camera:
    """Return a camera from a JSON object.

    ``where`` is the object's name in messages. Raises :class:`AmiwarpError` naming the field.
    """
    given = fields_of(data, where, *CAMERA_NUMBERS, optional=("distortion",))
    prefix, lens = f"{where}." if where else "", given.get("distortion")
    distortion = None
    if lens is not None:
        numbers = dict(lens) if isinstance(lens, dict) else fields_of(lens, f"{prefix}distortion")
        kind = one_of(numbers.pop("kind", None), DISTORTIONS, f"field {prefix}distortion.kind")
        distortion = build(DISTORTIONS[kind], numbers, f"{prefix}distortion")
    return Camera(**{name: given[name] for name in CAMERA_NUMBERS}, distortion=distortion)


# Finished work that a later run continues from, as JSON with a checksum: folders of cells, and journals.
#
# The checksum shows damage. Anybody can compute it, so that the values are checked as well before they are used.

SEAL = "checksum"
"""Field with the SHA-256 of the canonical JSON of all other fields, in hexadecimal."""
MOST_CELL_BYTES = 8 << 20
"""Largest file of a cell that is read [bytes]."""
MOST_JOURNAL_BYTES = 1 << 30
"""Largest journal that is read [bytes]."""
MOST_LINE_BYTES = 1 << 16
"""Longest line of a journal that is read [bytes]."""


def sealed(data: Mapping[str, Any]) -> dict[str, Any]:
    """Return a JSON object with its checksum."""
    return {SEAL: _digest(data), **data}


def unsealed(data: Any) -> dict[str, Any]:
    """Return a JSON object without its checksum, in place. Raises :class:`AmiwarpError` if the two do not match."""
    given = instance(data, dict, "the content").pop(SEAL, None)
    if given != _digest(data):
        raise AmiwarpError(f"field {SEAL} is {'missing' if given is None else f'{shown(given)}, not of this content'}")
    return dict(data)


def _digest(data: Mapping[str, Any]) -> str:
    canonical = json.dumps(data, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(canonical.encode()).hexdigest()


class CellStore:
    """Folder of cells, that is of results of single runs. Each is a file with a checksum.

    A file that is damaged counts as missing: it is noted in ``damaged``, and replaced when the cell is written.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.damaged: list[str] = []
        """What is wrong with each damaged file that was read."""

    def read(self, name: str, make: Callable[[dict[str, Any]], Made]) -> Made | None:
        """Return what ``make`` makes of the fields of a cell; None if its file is missing or damaged.

        ``make`` raises :class:`AmiwarpError` for fields that a run does not write. So does this method for a folder.
        """
        path = self.folder / name
        if not os.path.lexists(path):
            return None
        if path.is_dir():
            raise AmiwarpError(f"{path}: is a folder, where the file of a cell belongs; remove it")
        try:
            with errors_name(path, lambda: "is damaged"):
                return make(unsealed(read_json(path, "a cell", most_bytes=MOST_CELL_BYTES, noted=False)))
        except AmiwarpError as error:
            self.damaged.append(str(error))
            return None

    def write(self, name: str, data: Mapping[str, Any]) -> None:
        """Write the fields of a cell. A pipe or a device of its name is replaced too."""
        path = self.folder / name
        if os.path.lexists(path) and not path.is_file():
            path.unlink()
        write_text(path, json.dumps(sealed(data), separators=(",", ":"), allow_nan=False) + "\n", overwrite=True)


def create_journal(path: Path) -> None:
    """Create an empty journal unless it exists. Raises :class:`AmiwarpError` if that fails."""
    check_output(path, overwrite=True)
    with errors_name(path, lambda: "cannot be written"):
        path.touch()


def append_line(path: Path, data: Mapping[str, Any]) -> None:
    """Append an object with its checksum to a journal. Raises :class:`AmiwarpError` if that fails."""
    check_output(path, overwrite=True)
    with errors_name(path, lambda: "cannot be written"), path.open("ab+") as file:
        size = file.seek(0, 2)
        if size:
            file.seek(size - 1)
        cut_off = size and file.read(1) != b"\n"
        file.write(b"\n" * bool(cut_off) + json.dumps(sealed(data), allow_nan=False).encode() + b"\n")


def read_journal(path: Path, make: Callable[[dict[str, Any]], Made], damaged: list[str]) -> Iterator[Made]:
    """Yield what ``make`` makes of the fields of each line of a journal; nothing if it does not exist.

    Lines that are damaged, or of which ``make`` raises :class:`AmiwarpError`, are left out, and noted together in
    ``damaged``. Raises :class:`AmiwarpError` for a journal that is not a regular file or is too large.
    """
    if not os.path.lexists(path):
        return
    bad, first = 0, ""
    with errors_name(path, lambda: "cannot be read as a journal"), open_input(path, noted=False) as file:
        if os.fstat(file.fileno()).st_size > MOST_JOURNAL_BYTES:
            raise AmiwarpError(f"is larger than {MOST_JOURNAL_BYTES >> 20} MiB, so it is no journal; remove it")
        for number, line in enumerate(iter(lambda: file.readline(MOST_LINE_BYTES), b""), 1):
            while not line.endswith(b"\n") and (rest := file.readline(MOST_LINE_BYTES)):
                line = rest[-1:]  # too long for a line of a journal
            try:
                with errors_name(path, lambda number=number: f"line {number}"):  # type: ignore[misc]
                    made = make(unsealed(parse_json(line)))
            except AmiwarpError as error:
                bad, first = bad + 1, first or str(error)
                continue
            yield made
    if bad:
        damaged.append(f"{first}; {bad:,} lines are damaged" if bad > 1 else first)
