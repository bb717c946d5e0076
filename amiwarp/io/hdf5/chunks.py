"""Chunks of amiwarp's HDF5 files, which parallel threads encode and decode. HDF5 itself uses one thread.

A stored chunk is a Blosc frame (version 1, as written by HDF5's filter 32001) or deflated bytes, followed by its
Fletcher-32 checksum. HDF5 itself reads the deflated chunks of :attr:`Codec.GZIP`.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.io.output_formats import Codec

CHUNK = 1 << 18
"""Number of events per HDF5 chunk. With Blosc's LZ4 and shuffle, chunks are written and read faster than without
compression."""

BLOSC = 32001
"""Number of the Blosc filter in HDF5."""

FLETCHER32 = 3
"""Number of the Fletcher-32 filter in HDF5."""

CHECKSUM_ROW = 2048
"""Number of 16-bit words that the checksum sums at a time."""

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
    sums = [value.to_bytes(4, "little") for value in _checksums(frames)]
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

    Checksums are computed by a kernel once :func:`compile_checksums` has been called.
    """
    frames = []
    stored_sums = []
    for chunk in stored:
        frames.append(memoryview(chunk)[:-4])
        stored_sums.append(int.from_bytes(chunk[-4:], "little"))
    if stored_sums != _checksums(frames):
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


def checksum(data: bytes | memoryview) -> int:
    """Return the Fletcher-32 checksum as HDF5 computes it.

    HDF5 sums big-endian 16-bit words modulo 65535. A last odd byte is the upper half of a word. Here the words are
    summed as little-endian: modulo 65535, swapping the bytes of a word multiplies it by 256.
    """
    count = len(data) // 2
    words = np.frombuffer(data, np.dtype("<u2"), count)
    in_table = count - count % CHECKSUM_ROW
    table = words[:in_table].reshape(-1, CHECKSUM_ROW)
    rest = words[in_table:].astype(np.int64)

    # uint32 holds the sums of up to 65,537 rows of words: 256 MiB, the largest chunk that is read.
    # Word i is counted once in the first sum, and count - i times in the second.
    columns = table.sum(axis=0, dtype=np.uint32)
    rows = table.sum(axis=1, dtype=np.uint32)
    first = int(columns.sum(dtype=np.int64))
    second = count * first - _moment(columns) - CHECKSUM_ROW * _moment(rows)
    second += int(rest @ np.arange(rest.size, 0, -1))
    first += int(rest.sum())

    # The bytes of the words are swapped.
    first *= 256
    second *= 256
    if len(data) % 2:
        first += data[-1] << 8
        second += first
    return _fold_carries(second) << 16 | _fold_carries(first)


def _moment(sums: NDArray[np.uint32]) -> int:
    """Return the sum of each value times its index."""
    return int(sums.astype(np.int64) @ np.arange(sums.size))


def _fold_carries(total: int) -> int:
    """Return a sum modulo 65535 as end-around carries give it: 65535 for every multiple of 65535 except 0."""
    if not total:
        return 0
    return (total - 1) % 65535 + 1


def _checksums_by_numpy(parts: Sequence[bytes | memoryview]) -> list[int]:
    """Return the checksum of each block of bytes."""
    return [checksum(part) for part in parts]


_checksums: Callable[[Sequence[bytes | memoryview]], list[int]] = _checksums_by_numpy
"""Function that computes checksums: with a kernel after :func:`compile_checksums`."""


def compile_checksums() -> None:
    """Compute all later checksums with one of Warp's kernels, in less time and without Python's lock.

    For programs that run Warp's kernels. Others do not load Warp for it. Call it before threads use Warp.
    """
    global _checksums
    if _checksums is _checksums_by_numpy:
        from amiwarp.kernels.checksum import Checksums

        _checksums = Checksums()


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
