"""Writer of NumPy archives, which :func:`numpy.load` reads: the arrays x, y, t and p, and the numbers width and height.

An archive holds one array after the other. The arrays therefore grow in temporary files next to the archive.
"""

from __future__ import annotations

import contextlib
import shutil
import zipfile
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.lib import format as npy

from amiwarp.events.events import Events
from amiwarp.io.atomic_output import scratch_folder
from amiwarp.io.output_formats import Outline

COLUMNS = {"x": "<u2", "y": "<u2", "t": "<i8", "p": "|u1"}
"""Types of the arrays. x and y of compensated events are float32."""


def write_npz(part: Path, blocks: Iterable[Events], about: Outline) -> None:
    """Write all events."""
    columns, count = COLUMNS, 0
    with scratch_folder(part.parent) as folder:
        with contextlib.ExitStack() as opened:
            files = {name: opened.enter_context((folder / name).open("wb")) for name in COLUMNS}
            for events in blocks:
                columns = COLUMNS if events.whole_pixels else {**COLUMNS, "x": "<f4", "y": "<f4"}
                count += len(events)
                for name, dtype in columns.items():
                    files[name].write(np.ascontiguousarray(getattr(events, name), dtype).data)
        with zipfile.ZipFile(part, "x") as archive:
            for name, dtype in columns.items():
                with (
                    archive.open(zipfile.ZipInfo(f"{name}.npy"), "w", force_zip64=True) as member,
                    (folder / name).open("rb") as column,
                ):
                    header = {"descr": dtype, "fortran_order": False, "shape": (count,)}
                    npy.write_array_header_1_0(member, header)
                    shutil.copyfileobj(column, member, 1 << 20)
            for name in ("width", "height"):
                with archive.open(zipfile.ZipInfo(f"{name}.npy"), "w") as member:
                    npy.write_array(member, np.array(getattr(about, name)))
