"""Arrays of a MATLAB file. Runs in the reading process."""

from typing import Any

import numpy as np
from numpy.typing import NDArray


def matlab_arrays(path: str) -> dict[str, NDArray[Any]]:
    """Return the numeric arrays of a MATLAB file, with the fields of structures by ``structure/field``."""
    from scipy.io import loadmat

    arrays: dict[str, NDArray[Any]] = {}

    def collect(name: str, value: Any) -> None:
        if isinstance(value, dict):
            for key, inner in value.items():
                if not key.startswith("__"):
                    collect(f"{name}/{key}".lstrip("/"), inner)
        elif isinstance(value, np.ndarray) and _may_hold_events(value):
            arrays[name] = value

    collect("", loadmat(path, simplify_cells=True))
    return arrays


def _may_hold_events(array: NDArray[Any]) -> bool:
    return array.dtype.kind in "iufb" and array.size > 1 and array.ndim <= 2
