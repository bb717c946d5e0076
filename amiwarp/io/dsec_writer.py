"""Writer of HDF5 files with the layout of DSEC: events/x, y, t, p, t_offset and ms_to_idx, and no other dataset.

DSEC's files do not hold the sensor size. It is added as attributes, which DSEC's programs ignore.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from amiwarp.events.events import Events, regroup
from amiwarp.io.chunks import CHUNK, append_chunk, encode
from amiwarp.io.native_layout import make_dataset, ms_entries
from amiwarp.io.output_formats import Outline

COLUMNS = {"x": np.uint16, "y": np.uint16, "t": np.uint32, "p": np.uint8}
"""Types of DSEC's datasets."""


def write_dsec(part: Path, blocks: Iterable[Events], about: Outline) -> None:
    """Write all events, one chunk of each dataset at a time."""
    import h5py

    with h5py.File(part, "x") as file:
        file.attrs["width"], file.attrs["height"] = about.width, about.height
        file["t_offset"] = np.int64(about.t_first)
        datasets = {
            name: make_dataset(file, f"events/{name}", dtype, codec=about.codec) for name, dtype in COLUMNS.items()
        }
        index: list[np.ndarray] = []
        written = ms = 0
        for events in regroup(blocks, count=CHUNK):
            for entries in ms_entries(events.t, about.t_first, ms, written):
                index.append(entries)
                ms += entries.size
            columns = {"x": events.x, "y": events.y, "t": events.t - about.t_first, "p": events.p}
            for name, dtype in COLUMNS.items():
                stored = encode(columns[name].astype(dtype), about.codec)
                append_chunk(datasets[name], written, stored, len(events))
            written += len(events)
        file["ms_to_idx"] = np.concatenate([np.zeros(0, np.int64), *index]).astype(np.uint64)
