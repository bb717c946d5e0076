"""Reader of untrusted JSON and TOML files: limited in size, and strict.

:mod:`amiwarp.schema.records` converts their values to dataclasses.
"""

import json
import math
import os
import re
import tomllib
from pathlib import Path
from typing import Any, NoReturn

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.io.inputs import errors_name, open_input
from amiwarp.validation import shown

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
"""Pattern of dotted keys with more parts. Its quantifiers are possessive, so the time grows with the length only."""


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
            raise AmiwarpError(
                f"{path}: is larger than {most_bytes >> 20} MiB, so it is not {what}; give another file",
                ErrorCode.FORMAT_UNKNOWN,
            )
        data = parse_json(text)
        if not isinstance(data, dict):
            raise AmiwarpError(
                f"the file holds {shown(data)}; expected an object in braces", ErrorCode.FIELD
            )
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
            raise AmiwarpError(
                f"is larger than {MOST_TOML_BYTES >> 20} MiB; give another file", ErrorCode.FIELD
            )
        text = data.decode("utf-8")
        dotted = _TOO_DOTTED.search(text)
        if dotted is not None:
            line = text.count("\n", 0, dotted.start()) + 1
            raise AmiwarpError(
                f"line {line} has a key of more than {MOST_PARTS} parts; use fewer dots",
                ErrorCode.FIELD,
            )
        return tomllib.loads(text)


def parse_json(text: bytes) -> Any:
    """Return the value of JSON text. Raises :class:`AmiwarpError` for invalid JSON and non-finite numbers."""
    try:
        return json.loads(text.decode("utf-8"), parse_constant=_refuse, parse_float=_finite)
    except AmiwarpError:
        raise
    except RecursionError as error:
        raise AmiwarpError("the JSON nests too deeply", ErrorCode.FIELD) from error
    except UnicodeDecodeError as error:
        raise AmiwarpError(f"byte {error.start} is not UTF-8", ErrorCode.FORMAT_UNKNOWN) from error
    except ValueError as error:
        raise AmiwarpError(f"is not JSON: {error}", ErrorCode.FORMAT_UNKNOWN) from error


def _refuse(word: str) -> NoReturn:
    """Raise :class:`AmiwarpError` for the words NaN and Infinity, which JSON does not allow."""
    raise AmiwarpError(f"the JSON holds {word}; expected finite numbers", ErrorCode.FIELD)


def _finite(digits: str) -> float:
    """Convert digits to a finite number; raise :class:`AmiwarpError` if it is too large for float64."""
    value = float(digits)
    if not math.isfinite(value):
        raise AmiwarpError(
            f"the JSON holds {shown(digits)}, beyond the largest float64", ErrorCode.FIELD
        )
    return value
