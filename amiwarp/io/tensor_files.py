"""Files of the tensors of a recording, which data sets for networks hold."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.io.inputs import errors_name, input_path
from amiwarp.io.numpy_arrays import open_array
from amiwarp.io.outputs import NewFile


def save_tensors(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write the tensors of a recording of a data set by name, without compression, replacing an existing file.

    Equal tensors give equal files.
    """
    with NewFile(path, overwrite=True) as new, open(new.part, "wb") as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]


def read_tensors(path: Path) -> dict[str, NDArray[Any]]:
    """Read the arrays that :func:`save_tensors` wrote. Raises :class:`AmiwarpError` if there is no ``tensor``."""
    arrays = {}
    with errors_name(path, lambda: "reading tensors"), zipfile.ZipFile(input_path(path)) as archive:
        names = [name.removesuffix(".npy") for name in archive.namelist()]
        if "tensor" not in names:
            raise AmiwarpError(
                f"has no array tensor, but {', '.join(names[:8])}; make this recording again",
                ErrorCode.CONTENT_MISSING,
            )
        for name in names:
            with open_array(archive, name, "iuf") as (stream, shape, dtype):
                arrays[name] = np.frombuffer(bytearray(stream.read()), dtype).reshape(shape)
    return arrays
