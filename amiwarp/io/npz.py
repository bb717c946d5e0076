"""NumPy archives with arrays x, y [px], t [us] and p (1 is ON, 0 or -1 OFF), all integers of one length.

Optional numbers ``width`` and ``height`` give the sensor's size; else it is the smallest sensor in use that holds all.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
from numpy.lib.npyio import NpzFile

from amiwarp.errors import AmiwarpError
from amiwarp.events import Recording
from amiwarp.io.files import errors_name
from amiwarp.io.scan import FileEvents, Packet


def open_npz(path: Path) -> Recording:
    """Open an archive of events; its arrays are read whole, and anew each time where they are too large to keep."""
    with errors_name(path, lambda: "reading width and height"), _open(path) as archive:
        size = None
        if "width" in archive and "height" in archive:
            size = (int(archive["width"]), int(archive["height"]))
    events = FileEvents(path, partial(_packets, path), size=size)
    return Recording(events=events, metadata={"format": "npz", **events.repairs}, name=path.stem)


@contextlib.contextmanager
def _open(path: Path) -> Iterator[NpzFile]:
    # Given a path, np.load leaves the file open where it is no archive.
    with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
        if not isinstance(archive, NpzFile):
            raise AmiwarpError(f"{path}: is not an archive of arrays")
        yield archive


def _packets(path: Path, notes: dict[str, int]) -> Iterator[Packet]:
    with _open(path) as archive:
        missing = [name for name in "xytp" if name not in archive]
        if missing:
            raise AmiwarpError(f"{path}: no array {', '.join(missing)}; expected x, y, t, p")
        x, y, t, p = (archive[name] for name in "xytp")
    for name, array in (("x", x), ("y", y), ("t", t), ("p", p)):
        # Floating times could be seconds or microseconds: guessing wrong would go unnoticed.
        if array.dtype.kind not in "iub":
            raise AmiwarpError(f"{path}: array {name} is {array.dtype}; expected integers (t in microseconds)")
        if array.shape != (t.size,):
            raise AmiwarpError(f"{path}: array {name} has shape {array.shape}, t {t.shape}; expected one length (n,)")
    yield x, y, t, p
