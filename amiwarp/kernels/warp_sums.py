"""Sums over neighbouring threads of a CUDA warp, in fixed order.

A run is a sequence of neighbouring threads of a warp with the same key. On a CPU each thread is a run. All threads of
a warp must call these functions.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    const unsigned lane = threadIdx.x & 31u;
    const int before = __shfl_up_sync(0xffffffffu, key, 1);
    return (int)((__ballot_sync(0xffffffffu, before != key) | 1u) & (0xffffffffu >> (31u - lane)));
#endif
    return 1;
""")
def run_starts(key: int) -> int:
    """Return the threads of the warp, up to this one, at which runs start, as bits."""


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    const int lane = threadIdx.x & 31, first = 31 - __clz(starts);
    for (int step = 1; step < 32; step *= 2) {
        const float other = __shfl_up_sync(0xffffffffu, value, step);
        if (lane - step >= first) value += other;
    }
#endif
    return value;
""")
def sum_run(value: float, starts: int) -> float:
    """Return the sum of a value over the threads of the run up to this one, added in fixed order."""


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    const int after = __shfl_down_sync(0xffffffffu, key, 1);
    return (threadIdx.x & 31) == 31 || after != key;
#endif
    return true;
""")
def ends_run(key: int) -> bool:
    """Return whether this thread is the last one of its run."""
