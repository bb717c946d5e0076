"""Launching: one launch on CUDA, slices from a thread pool on the CPU (Warp runs one thread a launch there)."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from itertools import pairwise
from typing import Any

import warp as wp

from amiwarp.kernels.cores import cpu_threads

SMALLEST_SLICE = 1 << 15  # below this many threads a slice costs more to launch than to run


@cache
def pool() -> ThreadPoolExecutor:
    """Threads for launches on the CPU, one a core."""
    return ThreadPoolExecutor(cpu_threads(), thread_name_prefix="amiwarp")


@cache
def beside() -> ThreadPoolExecutor:
    """One thread, for what may go on beside and must keep its order."""
    return ThreadPoolExecutor(1, thread_name_prefix="amiwarp-beside")


def load(kernel: Any, device: Any) -> None:
    """Compiles and loads a kernel as it is launched here: once, before threads would each try."""
    kernel.module.load(device, block_dim=1 if device.is_cpu else None)


def slices(n: int, parts: int, smallest: int = SMALLEST_SLICE) -> list[tuple[int, int]]:
    """At most ``parts`` contiguous (start, stop) ranges that cover ``range(n)``, none much below ``smallest``."""
    parts = max(1, min(parts, n // smallest))
    edges = [n * k // parts for k in range(parts + 1)]
    return list(pairwise(edges))


def launch(
    kernel: Any,
    n: int,
    inputs: Sequence[Any],
    outputs: Sequence[Any],
    *,
    device: Any,
    first: int = 0,
    smallest: int = SMALLEST_SLICE,
) -> None:
    """Run a kernel whose last input is ``start: int`` over ``range(first, first + n)``, on all cores of a CPU.

    Each thread of the kernel must write places of its own: slices run at the same time.
    """
    device = wp.get_device(device)
    if n == 0:
        return
    if not device.is_cpu:
        wp.launch(kernel, dim=n, inputs=[*inputs, first], outputs=list(outputs), device=device)
        return
    ranges = slices(n, cpu_threads(), smallest)
    load(kernel, device)

    def run(span: tuple[int, int]) -> None:
        inputs_ = [*inputs, first + span[0]]
        wp.launch(kernel, dim=span[1] - span[0], inputs=inputs_, outputs=list(outputs), device=device)

    list(pool().map(run, ranges)) if len(ranges) > 1 else run(ranges[0])


def launch_slices(
    kernel: Any,
    n: int,
    inputs: Sequence[Any],
    outputs: Sequence[Any],
    *,
    device: Any,
    first: int = 0,
    smallest: int = SMALLEST_SLICE,
) -> None:
    """As :func:`launch`, but slice k writes into ``outputs[k]`` alone: for threads that add to shared places.

    Over ``range(first, first + n)``. On CUDA one launch adds into ``outputs[0]`` with atomics.
    """
    device = wp.get_device(device)
    if n == 0:
        return
    ranges = slices(n, len(outputs), smallest) if device.is_cpu else [(0, n)]
    if device.is_cpu:
        load(kernel, device)

    def run(job: tuple[tuple[int, int], Any]) -> None:
        (start, stop), out = job
        wp.launch(kernel, dim=stop - start, inputs=[*inputs, first + start], outputs=[out], device=device)

    jobs = list(zip(ranges, outputs, strict=False))
    list(pool().map(run, jobs)) if len(jobs) > 1 else run(jobs[0])


class Recorded:
    """A launch to be launched again, which takes a tenth of the time; its kernel's last input is ``start: int``."""

    def __init__(self, kernel: Any, inputs: Sequence[Any], outputs: Sequence[Any], *, device: Any) -> None:
        """Arrays among the inputs and outputs are used each time. Nothing is launched yet."""
        device = wp.get_device(device)
        load(kernel, device)
        self._start = len(inputs)
        self._command = wp.launch(kernel, 1, [*inputs, 0], list(outputs), device=device, record_cmd=True)

    def set(self, index: int, value: Any) -> None:
        """Another input from now on."""
        self._command.set_param_at_index(index, value)

    def __call__(self, first: int, n: int) -> None:
        """Over ``range(first, first + n)``, on a CPU by this thread alone."""
        self._command.set_dim(n)
        self._command.set_param_at_index(self._start, first)
        self._command.launch()


def slice_count(device: Any) -> int:
    """How many outputs :func:`launch_slices` can use on ``device``."""
    return cpu_threads() if wp.get_device(device).is_cpu else 1
