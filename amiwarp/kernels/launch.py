"""Kernel launches: a single launch on CUDA, slices on several threads on the CPU; launches that are repeated."""

import contextlib
from collections import defaultdict
from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
import warp as wp

from amiwarp.kernels.loading import load, specialised
from amiwarp.kernels.workers import run_together
from amiwarp.tasks import cpu_threads
from amiwarp.workarounds import address

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


_ARRAYS = (np.ndarray, wp.array)
"""Types of arrays, as a tuple, which is tested in less time."""


class HostLaunch:
    """Launch of a kernel on a CPU, in the calling thread, that is repeated with other arrays.

    Of arrays of the same types, only addresses and shapes are replaced, which takes a seventh of the time of a launch.
    """

    def __init__(self, kernel: Any, arguments: Sequence[Any]) -> None:
        """Record the launch without running it, with empty arrays, because it keeps them alive."""
        given = []
        for value in arguments:
            if isinstance(value, _ARRAYS):
                of_numpy = isinstance(value, np.ndarray)
                dtype = wp.dtype_from_numpy(value.dtype) if of_numpy else value.dtype
                value = wp.empty((0,) * value.ndim, dtype=dtype, device="cpu")
            given.append(value)
        self._command = wp.launch(kernel, 1, given, device="cpu", record_cmd=True)
        self._n = 1
        self._shapes: list[Any] = [None] * len(given)

    def run(self, arguments: Sequence[Any], n: int) -> None:
        """Run the kernel over ``range(n)``. The arrays are contiguous, and of the types of the recorded ones."""
        command = self._command
        if n != self._n:
            command.set_dim(n)
            self._n = n
        for k, value in enumerate(arguments):
            if isinstance(value, _ARRAYS):
                described = command.params[1 + k]
                described.data = address(value) if isinstance(value, np.ndarray) else value.ptr
                if value.shape != self._shapes[k]:
                    self._shapes[k] = value.shape
                    described.shape[: value.ndim] = value.shape
                    described.strides[: value.ndim] = value.strides
            else:
                command.set_param_at_index(k, value)
        command.launch()


_idle_launches: defaultdict[Any, list[HostLaunch]] = defaultdict(list)
"""Launches that no thread uses, by kernel and types of the arrays."""


def launch_on_host(kernel: Any, n: int, arguments: Sequence[Any]) -> None:
    """Run a kernel over ``range(n)`` on a CPU, in the calling thread, with contiguous arrays of NumPy or Warp."""
    types = tuple(value.dtype for value in arguments if isinstance(value, _ARRAYS))
    idle = _idle_launches[kernel, types]
    found = None
    with contextlib.suppress(IndexError):  # no launch is idle
        found = idle.pop()
    if found is None:
        load(kernel, wp.get_device("cpu"))
        found = HostLaunch(kernel, arguments)
    found.run(arguments, n)
    idle.append(found)


def slice_count(device: Any) -> int:
    """Return the number of slices of a launch on ``device``."""
    return cpu_threads() if wp.get_device(device).is_cpu else 1
