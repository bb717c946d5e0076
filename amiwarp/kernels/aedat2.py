"""Decoders of the records of AEDAT 2.0 files: a word with an address and one with the time, both big-endian.

The address holds an event, an edge of the external input, or a sample of a frame or of the inertial unit (IMU). One
thread reads one block of records. The first pass counts what each block holds and how often its time wraps, so that a
second pass knows where each block's output begins, and the time at its start.
"""

import warp as wp

from amiwarp.kernels.event_arrays import EventArrays, store_event
from amiwarp.kernels.native_code import load_uint32
from amiwarp.kernels.raw_numbers import wrap_between

wp.set_module_options({"enable_backward": False})

# What a record is.
EVENT = wp.constant(0)
EDGE = wp.constant(1)
IMU = wp.constant(2)
FRAME = wp.constant(3)
"""The sample of a frame that counts the frame: the reset level is of type 0, the signal of type 1, and one pixel's
signal is counted."""
OTHER = wp.constant(4)


@wp.struct
class Camera:
    """Layout of a camera's addresses."""

    davis: int
    """Whether the camera is a DAVIS, not a DVS128, whose addresses have another layout."""
    width: int
    height: int


@wp.struct
class Counts:
    """What a block of records holds."""

    events: int
    edges: int
    imu: int
    """Number of records of IMU samples."""
    frames: int
    wraps: int
    """How often the time wraps, less how often it wraps backwards, from the record before the block on."""
    last: wp.int64
    """Time of the last record, as stored [us]."""


@wp.struct
class Start:
    """Where the output of a block begins."""

    event: int
    edge: int
    imu: int
    wraps: int
    """How often the time has wrapped before the block."""


@wp.struct
class OtherArrays:
    """Edges at the external input, and records of IMU samples."""

    edge_t: wp.array(dtype=wp.int64)
    """Times of the edges [us]."""
    imu_t: wp.array(dtype=wp.int64)
    """Times of the records [us]."""
    imu_words: wp.array(dtype=wp.uint32)
    """Addresses of the records."""


@wp.func_native("""
#ifdef __CUDA_ARCH__
    return __byte_perm(word, 0, 0x0123);
#else
    return __builtin_bswap32(word);
#endif
""")
def swapped_bytes(word: wp.uint32) -> wp.uint32:
    """Return a word with its bytes in the other order."""


@wp.func
def address_at(words: wp.array(dtype=wp.uint32), record: int) -> wp.uint32:
    """Return the address of a record."""
    return swapped_bytes(load_uint32(words, 2 * record))


@wp.func
def time_at(words: wp.array(dtype=wp.uint32), record: int) -> wp.int64:
    """Return the time of a record, as stored [us]."""
    return wp.int64(swapped_bytes(load_uint32(words, 2 * record + 1)))


@wp.func
def kind_of(address: wp.uint32, davis: int) -> int:
    """Return what a record is."""
    if davis == 0:
        return int((address >> wp.uint32(15)) & wp.uint32(1))
    kind = int((address >> wp.uint32(10)) & wp.uint32(3))
    if (address >> wp.uint32(31)) == wp.uint32(0):
        return kind & 1
    if kind == 3:
        return IMU
    if kind == 1 and ((address >> wp.uint32(12)) & wp.uint32(0x7FFFF)) == wp.uint32(0):
        return FRAME
    return OTHER


@wp.func
def time_before(words: wp.array(dtype=wp.uint32), first: int, before: wp.int64) -> wp.int64:
    """Return the time before record ``first``: its own for the first one of all, of which ``before`` is negative."""
    if first > 0:
        return time_at(words, first - 1)
    if before < wp.int64(0):
        return time_at(words, 0)
    return before


@wp.kernel
def survey_aedat2(
    words: wp.array(dtype=wp.uint32),
    length: int,
    camera: Camera,
    before: wp.int64,
    start: int,
    counts: wp.array(dtype=Counts),
):
    """Count what each block of ``length`` records holds.

    ``before``: time of the record before all, as stored [us], or -1 if there is none.
    """
    block = wp.tid() + start
    first = block * length
    last = time_before(words, first, before)
    count = Counts()
    for i in range(first, wp.min(first + length, words.shape[0] // 2)):
        kind = kind_of(address_at(words, i), camera.davis)
        now = time_at(words, i)
        count.wraps += wrap_between(last, now)
        last = now
        if kind == EVENT:
            count.events += 1
        elif kind == EDGE:
            count.edges += 1
        elif kind == IMU:
            count.imu += 1
        elif kind == FRAME:
            count.frames += 1
    count.last = last
    counts[block] = count


@wp.kernel
def decode_aedat2(
    words: wp.array(dtype=wp.uint32),
    length: int,
    camera: Camera,
    before: wp.int64,
    starts: wp.array(dtype=Start),
    start: int,
    events: EventArrays,
    others: OtherArrays,
):
    """Write what each block holds."""
    block = wp.tid() + start
    first = block * length
    last = time_before(words, first, before)
    event = starts[block].event
    edge = starts[block].edge
    imu = starts[block].imu
    wraps = starts[block].wraps
    for i in range(first, wp.min(first + length, words.shape[0] // 2)):
        address = address_at(words, i)
        stored = time_at(words, i)
        wraps += wrap_between(last, stored)
        last = stored
        now = stored + (wp.int64(wraps) << wp.int64(32))
        kind = kind_of(address, camera.davis)
        bits = int(address)
        if kind == EVENT:
            # Pixels count from the bottom right. Those outside the frame become large numbers.
            column = 127 - ((bits >> 1) & 0x7F)
            row = 127 - ((bits >> 8) & 0x7F)
            polarity = 1 - (bits & 1)  # bit 0 is 0 for an ON event
            if camera.davis != 0:
                column = camera.width - 1 - ((bits >> 12) & 0x3FF)
                row = camera.height - 1 - ((bits >> 22) & 0x1FF)
                polarity = (bits >> 11) & 1
            store_event(events, event, wp.uint16(column), wp.uint16(row), now, wp.uint8(polarity))
            event += 1
        elif kind == EDGE:
            others.edge_t[edge] = now
            edge += 1
        elif kind == IMU:
            others.imu_t[imu] = now
            others.imu_words[imu] = address
            imu += 1
