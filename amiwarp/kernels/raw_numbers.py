"""What decoders of records and packets share: times of 32 bits that wrap, and numbers at any address."""

import warp as wp

wp.set_module_options({"enable_backward": False})

HALF_WRAP = wp.constant(wp.int64(1 << 31))
"""Half the range of a time of 32 bits. A larger step is a wrap."""
OUTSIDE = wp.constant(wp.int64(-(1 << 62)))
"""Stands for a number that lies outside of what is read."""


@wp.struct
class Span:
    """A part of the memory."""

    address: wp.uint64
    """Address of the first byte."""
    size: wp.int64
    """Number of bytes."""


@wp.func
def wrap_between(last: wp.int64, now: wp.int64) -> int:
    """Return 1 if the time wraps between two records, -1 if it wraps backwards, else 0."""
    if last - now > HALF_WRAP:
        return 1
    if now - last > HALF_WRAP:
        return -1
    return 0


@wp.func_native("""
    const uint8_t* from = (const uint8_t*)address + at;
    uint32_t part = 0;
#ifdef __CUDA_ARCH__
    // Byte by byte: a GPU reads no number across its borders, and its compiler takes memcpy() for one such read.
    for (int k = 0; k < width; ++k) part |= (uint32_t)from[k] << (8 * k);
#else
    if (width == 2) { uint16_t half; memcpy(&half, from, 2); part = half; }
    else memcpy(&part, from, 4);
#endif
    if (width == 2) return is_signed ? (int64_t)(int16_t)part : (int64_t)part;
    return is_signed ? (int64_t)(int32_t)part : (int64_t)part;
""")
def load_number(address: wp.uint64, at: wp.int64, width: int, is_signed: int) -> wp.int64:
    """Load a number of 2 or 4 bytes, which may begin at any address."""


@wp.func
def number_at(span: Span, at: wp.int64, width: int, is_signed: int) -> wp.int64:
    """Return a number of 2 or 4 bytes; :data:`OUTSIDE` if a part of it lies outside the span."""
    if at < wp.int64(0) or at + wp.int64(width) > span.size:
        return OUTSIDE
    return load_number(span.address, at, width, is_signed)


@wp.func_native("return (uint64_t)data.data;")
def address_of(data: wp.array(dtype=wp.uint8)) -> wp.uint64:
    """Return the address of an array."""


@wp.func
def span_of(data: wp.array(dtype=wp.uint8)) -> Span:
    """Return the memory of an array."""
    span = Span()
    span.address = address_of(data)
    span.size = wp.int64(data.shape[0])
    return span
