"""Writer of the tensors of a stream to an HDF5 file."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from amiwarp.errors import AmiwarpError
from amiwarp.io.inputs import errors_name
from amiwarp.io.outputs import NewFile

COLUMNS = ("t_start", "t_end", "events")
"""Datasets next to the tensors: start and end of each window [us], and its number of events."""


class TensorWriter:
    """Writes tensors of one shape to ``path`` (.h5), in a ``with`` block. The file has its name once it is complete.

    Dataset ``tensor`` has one tensor after another, shape ``(k, ...)``, and the datasets of :data:`COLUMNS` have one
    number for each. After an exception in the block no file is left.
    """

    def __init__(self, path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
        self.path = Path(path)
        if self.path.suffix.lower() not in (".h5", ".hdf5"):
            raise AmiwarpError(
                f"{self.path}: tensors are written to HDF5; give a name that ends in .h5"
            )
        self._new = NewFile(self.path, overwrite=overwrite)
        self._resources = contextlib.ExitStack()
        self._file: Any = None
        self.count = 0
        """Number of tensors in the file."""

    def __enter__(self) -> TensorWriter:
        import h5py

        self._resources.enter_context(self._new)
        with errors_name(self.path, lambda: "making the file"):
            self._file = self._resources.enter_context(h5py.File(self._new.part, "w"))
            for name in COLUMNS:
                self._file.create_dataset(name, (0,), np.int64, maxshape=(None,), chunks=(1024,))
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._resources.__exit__(kind, error, trace)

    def append(self, tensor: Any, t_start: int, t_end: int, events: int) -> None:
        """Append a tensor of a window from ``t_start`` to ``t_end`` [us] with its number of events."""
        values = np.asarray(tensor)
        with errors_name(self.path, lambda: f"after {self.count} tensors"):
            if "tensor" not in self._file:
                self._file.create_dataset(
                    "tensor",
                    (0, *values.shape),
                    values.dtype,
                    maxshape=(None, *values.shape),
                    chunks=(1, *values.shape),
                    compression="gzip",
                    compression_opts=1,
                )
            for name, value in zip(
                ("tensor", *COLUMNS), (values, t_start, t_end, events), strict=True
            ):
                dataset = self._file[name]
                dataset.resize(self.count + 1, axis=0)
                dataset[self.count] = value
        self.count += 1
