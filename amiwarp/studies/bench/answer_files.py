"""Reading of AMI-Bench's array files, which others wrote: exact names, kinds, shapes and ranges."""

from __future__ import annotations

import math
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.io.inputs import errors_name, input_path
from amiwarp.io.numpy_arrays import open_array
from amiwarp.validation import shown

KIND_TEXTS = {"f": "floating-point numbers", "b": "truth values (bool)"}
"""Kinds of arrays in words, by ``numpy.dtype.kind``."""


@dataclass(frozen=True)
class ArrayField:
    """What an array of a file must be."""

    kind: str
    """Kind of its type, as in ``numpy.dtype.kind``."""
    shape: tuple[int, ...]
    """Its shape."""
    largest: float = math.inf
    """Largest magnitude of its values."""
    unit: str = ""
    """Unit of its values, for messages."""
    may_be_nan: bool = False
    """Whether values may be NaN."""


def read_arrays(
    path: Path, fields: Mapping[str, ArrayField], remedy: str
) -> dict[str, NDArray[Any]]:
    """Return the arrays of a NumPy archive (.npz), which holds these and no others.

    ``remedy`` says what to do about a missing file. Raises :class:`AmiwarpError`, which names the file, the array and
    the value.
    """
    if not path.exists():
        raise AmiwarpError(f"{path}: does not exist; {remedy}", ErrorCode.FILE_MISSING)
    with (
        errors_name(path, lambda: "cannot be read as arrays"),
        zipfile.ZipFile(input_path(path)) as archive,
    ):
        _check_names([name.removesuffix(".npy") for name in archive.namelist()], fields)
        return {name: _read(archive, name, field) for name, field in fields.items()}


def _check_names(given: list[str], fields: Mapping[str, ArrayField]) -> None:
    """Raise :class:`AmiwarpError` unless each name is given once, and no other."""
    expected = ", ".join(fields)
    for name in fields:
        if given.count(name) != 1:
            times = "is missing" if name not in given else f"is there {given.count(name)} times"
            raise AmiwarpError(f"array {name} {times}; give it once", ErrorCode.CONTENT_MISSING)
    for name in given:
        if name not in fields:
            raise AmiwarpError(
                f"array {shown(name)} is unknown; expected {expected} alone", ErrorCode.FIELD
            )


def _read(archive: zipfile.ZipFile, name: str, field: ArrayField) -> NDArray[Any]:
    """Return an array of an archive after its checks."""
    with open_array(archive, name, "iufb") as (stream, shape, dtype):
        if dtype.kind != field.kind:
            raise AmiwarpError(
                f"array {name} is {dtype}; expected {KIND_TEXTS[field.kind]}", ErrorCode.FIELD
            )
        if shape != field.shape:
            raise AmiwarpError(
                f"array {name} has shape {shape}; expected {field.shape}", ErrorCode.FIELD
            )
        data = stream.read(math.prod(shape) * dtype.itemsize)
    values = np.frombuffer(data, dtype).reshape(shape)
    if field.kind == "f":
        _check_values(values, name, field)
    return values


def _check_values(values: NDArray[Any], name: str, field: ArrayField) -> None:
    """Raise :class:`AmiwarpError` for the first value that is not finite or too large."""
    wrong = ~(np.abs(values) <= min(field.largest, np.finfo(np.float64).max))
    if field.may_be_nan:
        wrong &= ~np.isnan(values)
    if wrong.any():
        place = tuple(int(k) for k in np.argwhere(wrong)[0])
        limit = ""
        if math.isfinite(field.largest):
            limit = f" up to {field.largest:g} {field.unit}"
        raise AmiwarpError(
            f"array {name} holds {values[place]:g} at {place}; expected finite numbers{limit}",
            ErrorCode.FIELD,
        )
