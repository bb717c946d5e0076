"""What the decoders of event files share: blocks that are decoded at the same time, and where their output begins."""

from __future__ import annotations

import array
import mmap
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.validation import shown

Integers = NDArray[np.int64]

CPU_RECORDS = 1 << 15
"""Number of records that one thread decodes on a CPU."""

CUDA_RECORDS = 1 << 12
"""Number of records that one thread decodes on CUDA."""


def records_per_thread(device: Any) -> int:
    """Return the number of records that one thread decodes on a device."""
    return CPU_RECORDS if device.is_cpu else CUDA_RECORDS


def sums_before(values: NDArray[Any]) -> Integers:
    """Return for each value the sum of the values before it, so that blocks know where their output begins."""
    sums = np.zeros(values.size, np.int64)
    np.cumsum(values[:-1], out=sums[1:])
    return sums


def address_of(data: bytes) -> int:
    """Return where some bytes lie in memory."""
    return int(np.frombuffer(data, np.uint8).ctypes.data)


def new_rows(count: int, struct: Any) -> NDArray[Any]:
    """Return rows of the fields of a Warp struct, all 0."""
    return np.zeros(count, struct.numpy_dtype())


def cut_into_blocks(counts: Integers, device: Any) -> tuple[Integers, Integers, Integers]:
    """Cut packets into blocks, each for one thread: a large packet into several, one without events into none.

    ``counts``: number of the events of each packet. Return, for each block, the index of its packet, the number of the
    packet's events before it, and the number of its own, at least one.
    """
    length = records_per_thread(device)
    blocks_of_packet = -(-counts // length)  # rounded up
    packet = np.repeat(np.arange(counts.size), blocks_of_packet)
    first_block = sums_before(blocks_of_packet)[packet]
    block_in_packet = np.arange(packet.size) - first_block
    before = length * block_in_packet
    packet_events = np.minimum(counts[packet] - before, length)
    return packet, before, packet_events


def words_on(
    device: Any,
    data: Any,
    word: np.dtype[Any],
    what: str,
    version: str,
    record: int,
) -> Any:
    """Return some data as a Warp array of words on a device.

    Parameters
    ----------
    device : wp.Device
        The device. An array that is there is not copied, unless it begins within a word.
    data : bytes or array
        Whole records: bytes, or a contiguous array of bytes or of integers of a word's size.
    word : np.dtype
        Type of a word, little-endian.
    what, version : str
        Names of the data and of their format, for messages.
    record : int
        Size of a record [bytes].

    Raises
    ------
    AmiwarpError
        If the data have another type or end within a record.
    """
    import warp as wp

    from amiwarp.events.device_columns import import_array

    def check(shape: tuple[int, ...], given: np.dtype[Any]) -> None:
        """Raise :class:`AmiwarpError` for data that are not whole records."""
        if len(shape) != 1 or given.kind not in "iu" or given.itemsize not in (1, word.itemsize):
            expected = "bytes" if word.itemsize == 1 else f"bytes or {word.name}"
            raise AmiwarpError(
                f"{what} are {given} of shape {shape}; expected {expected} of shape (n,) for {version}"
            )
        size = shape[0] * given.itemsize
        if size % record:
            unit = "word" if record == word.itemsize else "record"
            raise AmiwarpError(
                f"{what} are {size} bytes, which end within a {unit} of {record} bytes; keep the "
                "rest for the next call"
            )

    dtype = wp.dtype_from_numpy(word)
    if isinstance(data, (bytes, bytearray)):
        data = np.frombuffer(data, np.uint8)
    elif isinstance(data, (memoryview, array.array, mmap.mmap)):
        data = np.asarray(data)
    if isinstance(data, np.ma.MaskedArray):
        raise AmiwarpError(f"{what} are a masked array; give them without a mask")
    if isinstance(data, np.ndarray):
        check(data.shape, data.dtype)
        little_endian = data.dtype.newbyteorder("<")
        plain = np.ascontiguousarray(data, little_endian)
        return wp.array(plain.view(word), dtype=dtype, device=device, copy=not device.is_cpu)
    if not hasattr(data, "__dlpack__") and not isinstance(data, wp.array):
        raise AmiwarpError(f"{what} are {shown(data)}; expected bytes or an array")

    given = import_array(data, what).to(device)
    check(given.shape, np.dtype(wp.dtype_to_numpy(given.dtype)))
    if given.size and given.ptr % word.itemsize:
        # A GPU reads no word across its borders.
        given = wp.clone(given)
    size = given.size * wp.types.type_size_in_bytes(given.dtype)
    count = size // word.itemsize
    words = wp.array(ptr=given.ptr, dtype=dtype, shape=count, device=device)
    # The memory is of this array, which must live as long.
    words._owner = given
    return words
