"""Unstrided loads and stores, and an addition that reports carries. With them, CPU compilers vectorise a loop."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.func_native("return ((const uint16_t*)values.data)[i];")
def load_uint16(values: wp.array(dtype=wp.uint16), i: int) -> wp.uint16:
    """Load element ``i`` of a contiguous array of uint16."""


@wp.func_native("return ((const uint8_t*)values.data)[i];")
def load_uint8(values: wp.array(dtype=wp.uint8), i: int) -> wp.uint8:
    """Load element ``i`` of a contiguous array of uint8."""


@wp.func_native("return ((const uint32_t*)values.data)[i];")
def load_uint32(values: wp.array(dtype=wp.uint32), i: int) -> wp.uint32:
    """Load element ``i`` of a contiguous array of uint32."""


@wp.func_native("return ((const int32_t*)values.data)[i];")
def load_int(values: wp.array(dtype=int), i: int) -> int:
    """Load element ``i`` of a contiguous array of int32."""


@wp.func_native("return ((const int64_t*)values.data)[i];")
def load_int64(values: wp.array(dtype=wp.int64), i: int) -> wp.int64:
    """Load element ``i`` of a contiguous array of int64."""


@wp.func_native("return ((const float*)values.data)[i];")
def load_float(values: wp.array(dtype=float), i: int) -> float:
    """Load element ``i`` of a contiguous array of float32."""


@wp.func_native("return ((const uint64_t*)values.data)[i];")
def load_word(values: wp.array(dtype=wp.uint64), i: int) -> wp.uint64:
    """Load element ``i`` of a contiguous array of uint64."""


@wp.func_native("((float*)values.data)[i] = value;")
def store_float(values: wp.array(dtype=float), i: int, value: float):
    """Store ``value`` as element ``i`` of a contiguous array of float32."""


@wp.func_native("((uint8_t*)values.data)[i] = (uint8_t)value;")
def store_uint8(values: wp.array(dtype=wp.uint8), i: int, value: int):
    """Store ``value`` as element ``i`` of a contiguous array of uint8."""


@wp.func_native("((uint32_t*)values.data)[i] = value;")
def store_uint32(values: wp.array(dtype=wp.uint32), i: int, value: wp.uint32):
    """Store ``value`` as element ``i`` of a contiguous array of uint32."""


@wp.func_native("((int32_t*)values.data)[i] = value;")
def store_int(values: wp.array(dtype=int), i: int, value: int):
    """Store ``value`` as element ``i`` of a contiguous array of int32."""


@wp.func_native("((uint64_t*)values.data)[i] = value;")
def store_word(values: wp.array(dtype=wp.uint64), i: int, value: wp.uint64):
    """Store ``value`` as element ``i`` of a contiguous array of uint64."""


@wp.func_native("""
    uint64_t* word = (uint64_t*)values.data + i;
    const uint64_t old = *word, now = old + value;
    *word = now;
    return (old & value) | ((old | value) & ~now);
""")
def add_word(values: wp.array(dtype=wp.uint64), i: int, value: wp.uint64) -> wp.uint64:
    """Add ``value`` to element ``i`` and return the carries: bit k is set if the addition carried out of bit k.

    Only for CPU code in which no other thread writes to the array.
    """
