"""Datasets of the native layout: made empty, and filled chunk by chunk."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.io.hdf5.chunks import BLOSC_LEVEL, CHUNK, GZIP_LEVEL, blosc_shuffle, encode
from amiwarp.io.output_formats import Codec


def make_dataset(
    file: Any,
    name: str,
    dtype: Any,
    row: tuple[int, ...] = (),
    chunk_rows: int = CHUNK,
    codec: Codec = Codec.BLOSC,
) -> Any:
    """Create an empty dataset of the native layout, whose rows have the shape ``row``."""
    import hdf5plugin

    options: dict[str, Any]
    if codec is Codec.BLOSC:
        shuffle = blosc_shuffle(np.dtype(dtype))
        options = {
            "compression": hdf5plugin.Blosc(cname="lz4", clevel=BLOSC_LEVEL, shuffle=shuffle)
        }
    else:
        options = {"compression": "gzip", "compression_opts": GZIP_LEVEL, "shuffle": True}
    # The checksum covers the compressed bytes. Its cost is too small to measure. LZ4 alone misses most damage.
    return file.create_dataset(
        name,
        shape=(0, *row),
        maxshape=(None, *row),
        chunks=(chunk_rows, *row),
        dtype=dtype,
        fletcher32=True,
        **options,
    )


def append_chunk(dataset: Any, start: int, stored: bytes, count: int) -> None:
    """Append an encoded chunk of ``count`` elements to a dataset of ``start`` elements, a whole number of chunks."""
    row = dataset.shape[1:]
    first_of_row = (0,) * len(row)
    dataset.id.set_extent((start + count, *row))
    dataset.id.write_direct_chunk((start, *first_of_row), stored)


def append_values(dataset: Any, start: int, values: NDArray[Any], codec: Codec) -> None:
    """Append the values of a chunk, as :func:`append_chunk`."""
    append_chunk(dataset, start, encode(values, codec), len(values))
