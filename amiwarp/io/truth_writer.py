"""Writer of a simulated world's ground truth into native recordings: of each event, of chosen instants, and poses.

``docs/reference/recording-format.md`` describes the format.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.truth import MAPS, EventTruth, FrameTruth, Poses, WorldLabels, as_poses, check_truth
from amiwarp.io.chunks import Codec
from amiwarp.io.native_layout import Columns
from amiwarp.io.row_writer import ROWS, RowWriter

EVENT_COLUMNS: dict[str, tuple[type[np.generic], tuple[int, ...]]] = {
    "cause": (np.uint8, ()),
    "instance": (np.uint16, ()),
    "depth": (np.float32, ()),
    "place": (np.float32, (3,)),
}
"""Names of the datasets in ``truth/events``, with the data type and the shape of a row."""


def event_columns(truth: EventTruth, count: int) -> Columns:
    """Return the ground truth of ``count`` events as datasets.

    Raises :class:`AmiwarpError` for arrays of another length or shape, and for values without meaning.
    """
    columns: Columns = {}
    if truth.points is not None:
        points = np.asarray(truth.points, np.float32)
        if points.shape != (count, 2):
            raise AmiwarpError(f"truth points have shape {points.shape}; expected ({count}, 2)")
        columns["truth/x"], columns["truth/y"] = points[:, 0], points[:, 1]
    for name, (dtype, row) in EVENT_COLUMNS.items():
        given = getattr(truth, name)
        if given is not None:
            values = np.asarray(given, dtype)
            if values.shape != (count, *row):
                raise AmiwarpError(f"truth of {name} has shape {values.shape}; expected {(count, *row)}")
            columns[f"truth/events/{name}"] = values
    for name, values in columns.items():
        check_truth(name, values)
    return columns


class TruthWriter(RowWriter):
    """Writer of labels, instants and poses into an open HDF5 file.

    All instants must have the same joints. All tables of poses must have the same bodies and joints.
    """

    def __init__(self, file: Any, path: Path, size: tuple[int, int], codec: Codec) -> None:
        """Set up the writer; ``size`` is the width and height of the sensor [px]."""
        super().__init__(file, path, codec)
        self._size = size
        self._names: dict[str, tuple[str, ...]] = {}

    def write_header(self, parameters: Mapping[str, float] | None, labels: WorldLabels | None) -> None:
        """Write the true parameters of a simulation, and the names of a world's instances and their classes."""
        if parameters is not None:
            group = self._file.create_group("truth")
            for name, value in parameters.items():
                group.attrs[name] = float(value)
        if labels is None:
            return
        self._file.require_group("truth/world").attrs["name"] = labels.name
        self._write_names("truth/world/instances", labels.instances)
        self._write_names("truth/world/categories", labels.categories)

    def append_frame(self, frame: FrameTruth) -> None:
        """Append the ground truth of an instant, which must be later than the previous instants."""
        width, height = self._size
        rows: dict[str, NDArray[Any]] = {}
        for name, (dtype, tail) in MAPS.items():
            rows[name] = np.asarray(getattr(frame, name), dtype)
            if rows[name].shape != (height, width, *tail):
                raise AmiwarpError(
                    f"{self._path}: {name} of the instant {frame.t_us} us has shape {rows[name].shape}; "
                    f"expected {(height, width, *tail)}"
                )
        self._check_later("truth/frames/t", frame.t_us)
        self._append("truth/frames/t", np.array([frame.t_us], np.int64), ROWS)
        self._append("truth/frames/pose", as_poses(frame.rotation, frame.position)[None], ROWS)
        self._append_joints("truth/frames/joints", {name: at[None] for name, at in frame.joints.items()})
        for name, values in rows.items():
            self._append(f"truth/frames/{name}", values[None], 1)

    def append_poses(self, poses: Poses) -> None:
        """Append a table of poses, which must be later than the previous poses."""
        if not len(poses):
            return
        self._check_later("truth/poses/t", int(poses.t[0]))
        self._append("truth/poses/t", np.asarray(poses.t, np.int64), ROWS)
        self._append("truth/poses/camera", np.asarray(poses.camera, np.float64), ROWS)
        self._append_joints("truth/joints/position", poses.joints)
        if poses.bodies:
            self._keep_names("truth/poses/body_names", poses.bodies)
            self._append("truth/poses/bodies", np.stack(list(poses.bodies.values()), axis=1), ROWS)

    def append_known(self, t_us: int, mask: NDArray[np.bool_]) -> None:
        """Append a mask of known pixels, which holds from a time later than those before."""
        width, height = self._size
        if mask.shape != (height, width):
            raise AmiwarpError(f"{self._path}: mask at {t_us} us has shape {mask.shape}; expected {(height, width)}")
        self._check_later("truth/known/t", t_us)
        self._append("truth/known/t", np.array([t_us], np.int64), ROWS)
        self._append("truth/known/mask", np.asarray(mask, np.uint8)[None], 1)

    def _append(self, name: str, values: NDArray[Any], chunk_rows: int) -> None:
        check_truth(name, values)
        super()._append(name, values, chunk_rows)

    def _append_joints(self, name: str, joints: Mapping[str, NDArray[np.float64]]) -> None:
        """Append the positions of joints [m], shape (k, 3) each, to the dataset ``name``."""
        if joints:
            self._keep_names("truth/joints/names", joints)
            self._append(name, np.stack(list(joints.values()), axis=1).astype(np.float64), ROWS)

    def _keep_names(self, name: str, given: Iterable[str]) -> None:
        """Write the names at the first call, and check that later calls give the same names."""
        names = tuple(given)
        if name not in self._names:
            self._names[name] = names
            self._write_names(name, names)
        elif self._names[name] != names:
            raise AmiwarpError(f"{self._path}: {name} changed between calls; give the same names in the same order")

    def _write_names(self, name: str, names: tuple[str, ...]) -> None:
        """Write names to a dataset of UTF-8 strings."""
        import h5py

        encoded = [text.encode("utf-8", "replace") for text in names]
        kind = h5py.string_dtype("utf-8", max([1, *(len(text) for text in encoded)]))
        self._file.create_dataset(name, data=np.array(encoded, kind))
