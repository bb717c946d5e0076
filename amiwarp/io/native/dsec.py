"""Writer of HDF5 files with the layout of DSEC: events/x, y, t, p, t_offset and ms_to_idx, and no other dataset.

DSEC's files do not hold the sensor size. It is added as attributes, which DSEC's programs ignore.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterable
from functools import partial
from pathlib import Path

import numpy as np

from amiwarp.events.recording import Events, regroup
from amiwarp.io.hdf5.chunk_file import ChunkFile
from amiwarp.io.hdf5.chunks import CHUNK
from amiwarp.io.hdf5.datasets import append_values, make_dataset
from amiwarp.io.native.layout import EVENTS
from amiwarp.io.native.ms_index import ms_entries
from amiwarp.io.output_formats import Outline

DSEC = EVENTS | {"t": np.uint32}
"""Types of DSEC's datasets. Times count from ``t_offset``; the limits of :mod:`amiwarp.io.output_formats` refuse
recordings over 2**32 us, which would wrap."""


def write_dsec(part: Path, blocks: Iterable[Events], about: Outline) -> None:
    """Write all events, one chunk of each dataset at a time."""
    with contextlib.closing(ChunkFile(part, libver=None)) as chunks:
        file = chunks.hdf5
        file.attrs["width"] = about.width
        file.attrs["height"] = about.height
        file["t_offset"] = np.int64(about.t_first)
        make = partial(make_dataset, file, codec=about.codec)
        datasets = {name: make(f"events/{name}", dtype) for name, dtype in DSEC.items()}

        index = [np.zeros(0, np.int64)]
        index_length = 0
        written = 0
        for events in regroup(blocks, count=CHUNK):
            for entries in ms_entries(events.t, about.t_first, index_length, written):
                index.append(entries)
                index_length += entries.size
            columns = {
                "x": events.x,
                "y": events.y,
                "t": events.t - about.t_first,
                "p": events.p,
            }
            for name, dtype in DSEC.items():
                values = columns[name].astype(dtype)
                append_values(datasets[name], written, values, about.codec)
            written += len(events)
            chunks.check()

        ms_to_idx = make("ms_to_idx", np.uint64)
        stored = np.concatenate(index).astype(np.uint64)
        for start in range(0, index_length, CHUNK):
            piece = stored[start : start + CHUNK]
            append_values(ms_to_idx, start, piece, about.codec)
