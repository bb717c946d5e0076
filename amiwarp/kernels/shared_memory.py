"""Shared memory of a block of CUDA threads: the windows of :mod:`amiwarp.kernels.tiles`.

The memory is used by address. The address is looked up once, while an array's name would be looked up at every vote.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __shared__ int words[3 * 61 * 64];
    unsigned address = (unsigned)__cvta_generic_to_shared(words);
    asm volatile("" : "+r"(address));  // keeps the compiler from looking it up repeatedly
    return (int)address;
#endif
    return 0;
""")
def window() -> int:
    """Return the address of the block's windows in shared memory; 0 on a CPU."""


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    asm volatile("bar.sync 0;" ::: "memory");
#endif
""")
def wait_for_block():
    """Wait until all threads of the block arrive here."""


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    asm volatile("st.shared.u32 [%0], %1;" :: "r"(address), "r"(value) : "memory");
#endif
""")
def set_word(address: int, value: int):
    """Store a word in shared memory at an address."""


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    asm volatile("red.shared.add.u32 [%0], %1;" :: "r"(address), "r"(value));
#endif
""")
def add_to_word(address: int, value: int):
    """Add to a word in shared memory at an address, atomically."""


@wp.func_native("""
    int value = 0;
#if defined(__CUDA_ARCH__)
    asm volatile("ld.shared.u32 %0, [%1];" : "=r"(value) : "r"(address) : "memory");
#endif
    return value;
""")
def get_word(address: int) -> int:
    """Load a word from shared memory at an address."""
