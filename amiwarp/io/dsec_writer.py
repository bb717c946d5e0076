"""Writer of HDF5 files with the layout of DSEC: events/x, y, t, p, t_offset and ms_to_idx, and no other dataset.

DSEC's files do not hold the sensor size. It is added as attributes, which DSEC's programs ignore.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.events.events import Events, regroup
from amiwarp.io.chunk_file import ChunkFile
from amiwarp.io.chunks import CHUNK, Codec, append_chunk, encode
from amiwarp.io.native_layout import make_dataset, ms_entries
from amiwarp.io.output_formats import Outline

COLUMNS = {"x": np.uint16, "y": np.uint16, "t": np.uint32, "p": np.uint8}
"""Types of DSEC's datasets."""


def write_dsec(part: Path, blocks: Iterable[Events], about: Outline) -> None:
    """Write all events, one chunk of each dataset at a time."""
    with contextlib.closing(ChunkFile(part, libver=None)) as chunks:
        file = chunks.hdf5
        file.attrs["width"], file.attrs["height"] = about.width, about.height
        file["t_offset"] = np.int64(about.t_first)
        create = partial(make_dataset, file, codec=about.codec)
        datasets = {name: create(f"events/{name}", dtype) for name, dtype in COLUMNS.items()}
        index = [np.zeros(0, np.int64)]
        written = ms = 0
        for events in regroup(blocks, count=CHUNK):
            for entries in ms_entries(events.t, about.t_first, ms, written):
                index.append(entries)
                ms += entries.size
            columns = {"x": events.x, "y": events.y, "t": events.t - about.t_first, "p": events.p}
            for name, dtype in COLUMNS.items():
                _append(datasets[name], written, columns[name].astype(dtype), about.codec)
            written += len(events)
            chunks.check()
        stored = create("ms_to_idx", np.uint64)
        found = np.concatenate(index).astype(np.uint64)
        for start in range(0, ms, CHUNK):
            _append(stored, start, found[start : start + CHUNK], about.codec)


def _append(dataset: Any, start: int, values: NDArray[Any], codec: Codec) -> None:
    """Append a chunk without HDF5's buffers."""
    append_chunk(dataset, start, encode(values, codec), len(values))
