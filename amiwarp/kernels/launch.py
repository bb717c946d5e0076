"""Kernel launches: a single launch on CUDA, slices on several threads on the CPU; launches that are repeated."""

from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise
from typing import Any

import warp as wp

from amiwarp.kernels.loading import load, specialised
from amiwarp.kernels.workers import run_together
from amiwarp.tasks import cpu_threads

BLOCK_DIM = 256
"""CUDA threads per block. Block sums require full blocks."""
SMALLEST_SLICE = 1 << 15
"""Fewest threads per slice: launching a smaller slice takes longer than running it."""


def slices(n: int, parts: int, smallest: int = SMALLEST_SLICE) -> list[tuple[int, int]]:
    """Return at most ``parts`` contiguous (start, stop) ranges that cover ``range(n)``.

    Each range has about ``smallest`` elements or more.
    """
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

    Slices run at the same time, so no two threads of the kernel may write to the same element.
    """
    device = wp.get_device(device)
    if n == 0:
        return
    kernel = specialised(kernel, inputs)
    if not device.is_cpu:
        wp.launch(kernel, dim=n, inputs=[*inputs, first], outputs=list(outputs), device=device)
        return
    load(kernel, device)
    jobs = []
    for start, stop in slices(n, cpu_threads(), smallest):
        given = [*inputs, first + start]
        jobs.append(partial(wp.launch, kernel, stop - start, given, list(outputs), device=device))
    run_together(jobs)


def launch_slices(
    kernel: Any,
    n: int,
    inputs: Sequence[Any],
    outputs: Sequence[Any],
    *,
    first: int = 0,
    smallest: int = SMALLEST_SLICE,
    clear: bool = False,
) -> None:
    """Run a kernel on a CPU as :func:`launch` does, but let slice k write into ``outputs[k]`` only.

    For kernels whose threads add to the same elements. The range is ``range(first, first + n)``. With ``clear``, all
    outputs are first set to zero, by the threads that write into them.
    """
    device = wp.get_device("cpu")
    ranges = slices(n, len(outputs), smallest)
    kernel = specialised(kernel, inputs)
    load(kernel, device)

    def run(out: Any, start: int, stop: int) -> None:
        if clear:
            out.zero_()
        if stop > start:
            given = [*inputs, first + start]
            wp.launch(kernel, dim=stop - start, inputs=given, outputs=[out], device=device)

    if clear:  # the other outputs, too
        ranges += [(0, 0)] * (len(outputs) - len(ranges))
    run_together([partial(run, out, *span) for span, out in zip(ranges, outputs, strict=False)])


class RecordedLaunch:
    """Recorded kernel launch that can be repeated, which takes a tenth of the time of a new launch."""

    def __init__(
        self, kernel: Any, inputs: Sequence[Any], outputs: Sequence[Any], *, device: Any, n: int = 1
    ) -> None:
        """Record the launch over ``range(n)`` without running it. Each repeat uses the same arrays."""
        device = wp.get_device(device)
        kernel = specialised(kernel, inputs)
        load(kernel, device)
        self._start = len(inputs) - 1
        self._first = inputs[-1]
        self._n = n
        self._command = wp.launch(
            kernel,
            n,
            list(inputs),
            list(outputs),
            device=device,
            block_dim=BLOCK_DIM,
            record_cmd=True,
        )
        self.repeat: Callable[[], None] = self._command.launch
        """Function that runs the kernel once more; on a CPU in the calling thread only."""

    def set(self, index: int, value: Any) -> None:
        """Replace the argument at ``index`` for all later runs."""
        self._command.set_param_at_index(index, value)

    def __call__(self, first: int, n: int) -> None:
        """Run a kernel whose last input is ``start: int`` over ``range(first, first + n)``, as :attr:`repeat` does."""
        if n != self._n:
            self._n = n
            self._command.set_dim(n)
        if first != self._first:
            self._first = first
            self._command.set_param_at_index(self._start, first)
        self._command.launch()


class RepeatedLaunches:
    """Launches on a device that are repeated with few changes.

    On CUDA a launch keeps the arguments of the last one of its kernel, and converts only those that differ. That takes
    less than half of the time of :func:`launch`. The last arguments live as long as this object.
    """

    def __init__(self, device: Any) -> None:
        self._device = wp.get_device(device)
        self._last: dict[Any, tuple[RecordedLaunch, list[Any]]] = {}

    def __call__(
        self,
        kernel: Any,
        n: int,
        inputs: Sequence[Any],
        outputs: Sequence[Any],
        *,
        smallest: int = SMALLEST_SLICE,
    ) -> None:
        """Run a kernel over ``range(n)`` as :func:`launch` does."""
        if self._device.is_cpu or n == 0:
            launch(kernel, n, inputs, outputs, device=self._device, smallest=smallest)
            return
        kernel = specialised(kernel, inputs)
        arguments = [*inputs, 0, *outputs]
        recorded, last = self._last.pop(kernel, (None, []))
        if recorded is None:
            recorded = RecordedLaunch(kernel, [*inputs, 0], outputs, device=self._device)
            last = arguments
        for k, (value, old) in enumerate(zip(arguments, last, strict=True)):
            is_struct = hasattr(value, "_cls")  # its values may have changed
            if value is not old or is_struct:
                recorded.set(k, value)
        self._last[kernel] = recorded, arguments
        recorded(0, n)


def slice_count(device: Any) -> int:
    """Return the number of slices of a launch on ``device``."""
    return cpu_threads() if wp.get_device(device).is_cpu else 1
