"""Maps of a sensor's pixels: arrays with one value or vector per pixel, in a NumPy archive."""

from __future__ import annotations

import math
import os
import zipfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.io.inputs import errors_name, input_path
from amiwarp.io.numpy_arrays import open_array
from amiwarp.io.output_formats import check_ending
from amiwarp.io.outputs import NewFile
from amiwarp.optics.camera import LARGEST_SIZE


def save_map(path: Path, what: str, arrays: Mapping[str, NDArray[Any]], *, overwrite: bool) -> None:
    """Write the arrays of a map, by name, to a ``.npz`` file; ``what`` names such a map."""
    check_ending(path, f"{what}s are written", [".npz"])
    with NewFile(path, overwrite=overwrite) as new, open(new.part, "wb") as file:
        np.savez_compressed(file, **arrays)  # type: ignore[arg-type]


class ArrayMap:
    """Map with values for each pixel, which a file of NumPy arrays holds: a dataclass of the arrays."""

    _WHAT: ClassVar[str]
    """Name of such a map in messages."""
    _COMMAND: ClassVar[str]
    """Command that makes one."""
    _KINDS: ClassVar[Mapping[str, str]]
    """Kinds of data types that each array may have, as in ``numpy.dtype.kind``."""
    _AXES: ClassVar[Mapping[str, int]] = {}
    """Numbers of axes of the arrays that do not have two."""

    def save(self, path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
        """Write the map to a file of NumPy arrays with the names of the attributes.

        Parameters
        ----------
        path : str or Path
            The file, which ends in ``.npz``.
        overwrite : bool, default False
            Whether to replace an existing file.

        Raises
        ------
        AmiwarpError
            If the file has another extension, exists and ``overwrite`` is False, or cannot be written.
        """
        arrays = {name: getattr(self, name) for name in self._KINDS}
        save_map(Path(path), self._WHAT, arrays, overwrite=overwrite)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Self:
        """Read a map that :meth:`save` wrote.

        Parameters
        ----------
        path : str or Path
            The file.

        Returns
        -------
        Self
            The map.

        Raises
        ------
        AmiwarpError
            If the file cannot be read, or does not hold the arrays of a map. The message names the array.
        """
        values = {}
        path = Path(path)
        with (
            errors_name(path, lambda: f"is no {cls._WHAT}"),
            zipfile.ZipFile(input_path(path)) as archive,
        ):
            names = archive.namelist()
            for name, allowed in cls._KINDS.items():
                if f"{name}.npy" not in names:
                    raise AmiwarpError(
                        f"has no array {name}; make the map with '{cls._COMMAND}'",
                        ErrorCode.CONTENT_MISSING,
                    )
                with open_array(archive, name, allowed) as (stream, shape, dtype):
                    if len(shape) != cls._AXES.get(name, 2) or max(shape) > LARGEST_SIZE:
                        raise AmiwarpError(
                            f"array {name} has shape {shape}; expected (height, width)",
                            ErrorCode.FORMAT_UNKNOWN,
                        )
                    data = stream.read(math.prod(shape) * dtype.itemsize)
                    values[name] = np.frombuffer(data, dtype).reshape(shape)
            return cls(**values)


def holds_map(path: Path, kinds: Iterable[type[ArrayMap]]) -> bool:
    """Return whether a file holds a map of one of these kinds, by the names of its arrays."""
    if path.suffix.lower() != ".npz":
        return False
    try:
        with zipfile.ZipFile(input_path(path)) as archive:
            names = {name.removesuffix(".npy") for name in archive.namelist()}
    except (zipfile.BadZipFile, OSError):
        return False
    return any(names >= kind._KINDS.keys() for kind in kinds)
