"""Chunks of amiwarp's HDF5 files, which parallel threads encode and decode. HDF5 itself uses one thread.

A stored chunk is a Blosc frame (version 1, as written by HDF5's filter 32001) or deflated bytes, followed by its
Fletcher-32 checksum. HDF5 itself reads the deflated chunks of :attr:`Codec.GZIP`.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.io.hdf5.fletcher32 import checksums
from amiwarp.io.output_formats import Codec

CHUNK = 1 << 18
"""Number of events per HDF5 chunk. With Blosc's LZ4 and shuffle, chunks are written and read faster than without
compression."""

BLOSC = 32001
"""Number of the Blosc filter in HDF5."""

FLETCHER32 = 3
"""Number of the Fletcher-32 filter in HDF5."""

BLOCK_BYTES = 1 << 18
"""Size of the blocks that Blosc compresses [bytes]. It decodes these faster than its smaller default."""

BLOSC_LEVEL = 1
"""Level of Blosc. Higher levels are slower, and their files are hardly smaller."""
GZIP_LEVEL = 1
"""Level of deflate: 1 is the fastest. Higher levels make event files only a few percent smaller."""


@cache
def _blosc() -> Any:
    """Return Blosc's functions, set up for calls in several threads. Its own threads would only add to them.

    The module's functions of the same names also check their arguments, which takes 15 us.
    """
    import blosc

    blosc.set_nthreads(1)
    blosc.set_releasegil(True)
    blosc.set_blocksize(BLOCK_BYTES)
    return blosc.blosc_extension


def blosc_shuffle(dtype: np.dtype[Any]) -> int:
    """Return how Blosc shuffles values: 2 by bits, or 1 by bytes.

    Of times of 8 bytes, bits take twice as long as bytes, and the size changes by -16 to +9 %.
    """
    return 1 if dtype.itemsize == 8 else 2


def encode(values: NDArray[Any], codec: Codec = Codec.BLOSC) -> bytes:
    """Return the stored bytes of a chunk of at least one element. A shorter one is padded with zeros, as by HDF5."""
    (parts,) = encode_parts(values, codec)
    return b"".join(parts)


def encode_parts(column: NDArray[Any], codec: Codec = Codec.BLOSC) -> list[tuple[bytes, bytes]]:
    """Return the stored bytes of each chunk of a column in two parts: the compressed values and their checksum."""
    compress = _compress if codec is Codec.BLOSC else _deflate
    frames = []
    for start in range(0, len(column), CHUNK):
        values = column[start : start + CHUNK]
        missing = CHUNK - len(values)
        if missing:
            padding = np.zeros((missing, *values.shape[1:]), values.dtype)
            values = np.concatenate([values, padding])
        frames.append(compress(np.ascontiguousarray(values)))
    sums = [value.to_bytes(4, "little") for value in checksums(frames)]
    return list(zip(frames, sums, strict=True))


def _compress(values: NDArray[Any]) -> bytes:
    """Compress the bytes of values as HDF5's Blosc filter does."""
    compressed: bytes = _blosc().compress_ptr(
        values.ctypes.data,
        values.nbytes,
        values.itemsize,
        BLOSC_LEVEL,
        blosc_shuffle(values.dtype),
        "lz4",
    )
    return compressed


def _deflate(values: NDArray[Any]) -> bytes:
    """Compress the bytes of values as HDF5's filters shuffle and deflate do."""
    by_value = values.view(np.uint8).reshape(-1, values.itemsize)
    shuffled = by_value.T
    return zlib.compress(shuffled.tobytes(), GZIP_LEVEL)


def decode(stored: Sequence[bytes], out: NDArray[Any]) -> bool:
    """Decode chunks of Blosc, one after the other, into ``out``. Return whether all chunks are undamaged.

    Checksums are computed by a kernel once :func:`amiwarp.io.hdf5.fletcher32.compile_checksums` has been called.
    """
    frames = []
    stored_sums = []
    for chunk in stored:
        frames.append(memoryview(chunk)[:-4])
        stored_sums.append(int.from_bytes(chunk[-4:], "little"))
    if stored_sums != checksums(frames):
        return False
    places = [out[start : start + CHUNK] for start in range(0, len(out), CHUNK)]
    return all(_decompress(frame, place) for frame, place in zip(frames, places, strict=True))


def _decompress(frame: memoryview, out: NDArray[Any]) -> bool:
    """Decompress a Blosc frame into ``out``. Return whether it has the right size and can be decoded."""
    # The header of 16 bytes holds the size before compression at 4, the block size at 8 and the size after
    # compression at 12. Blosc itself would trust them. A frame that is shorter than its header disagrees with them.
    decoded_size = int.from_bytes(frame[4:8], "little")
    encoded_size = int.from_bytes(frame[12:16], "little")
    if decoded_size != out.nbytes or encoded_size != len(frame):
        return False
    blosc = _blosc()
    try:
        size = int(blosc.decompress_ptr(frame, out.ctypes.data))
    except blosc.error:
        return False
    return size == out.nbytes
