"""Launches that run again and again over the same arrays: a captured graph on CUDA, recorded slices on a CPU."""

from collections.abc import Sequence
from typing import Any

import warp as wp

from amiwarp.kernels.cores import cpu_threads
from amiwarp.kernels.launch import SMALLEST_SLICE, pool, slices

BLOCK_DIM = 256  # threads of a block on CUDA; sums over blocks count on whole ones


class Program:
    """Arrays and numbers are those given to :meth:`add`; what changes from run to run must lie in an array."""

    def __init__(self, device: Any) -> None:
        self.device = wp.get_device(device)
        self._stages: list[list[Any]] = []
        self._graph: Any = None

    def add(
        self,
        kernel: Any,
        n: int,
        inputs: Sequence[Any],
        outputs: Sequence[Any],
        *,
        smallest: int = SMALLEST_SLICE,
    ) -> None:
        """A kernel over ``range(n)`` whose last input is ``start: int``; see :func:`amiwarp.kernels.launch.launch`."""
        if n == 0:
            return
        if not self.device.is_cpu:
            self._stages.append([self._record(kernel, -(-n // BLOCK_DIM) * BLOCK_DIM, [*inputs, 0], outputs)])
            return
        ranges = slices(n, cpu_threads(), smallest)
        self._stages.append([self._record(kernel, b - a, [*inputs, a], outputs) for a, b in ranges])

    def add_slices(
        self, kernel: Any, n: int, inputs: Sequence[Any], outputs: Sequence[Any], *, smallest: int = SMALLEST_SLICE
    ) -> None:
        """As :meth:`add`, slice k into ``outputs[k]`` alone; on CUDA all into the first, over ``range(n)`` alone."""
        if n == 0:
            return
        ranges = slices(n, len(outputs), smallest) if self.device.is_cpu else [(0, n)]
        jobs = zip(ranges, outputs, strict=False)
        self._stages.append([self._record(kernel, b - a, [*inputs, a], [out]) for (a, b), out in jobs])

    def _record(self, kernel: Any, n: int, inputs: Sequence[Any], outputs: Sequence[Any]) -> Any:
        kernel.module.load(self.device, block_dim=1 if self.device.is_cpu else BLOCK_DIM)
        return wp.launch(
            kernel, dim=n, inputs=list(inputs), outputs=list(outputs), device=self.device, block_dim=BLOCK_DIM,
            record_cmd=True,
        )  # fmt: skip

    def launch(self) -> None:
        """All that was added, in order, once and for all."""
        for stage in self._stages:
            _run_stage(stage)

    def run(self, times: int = 1) -> None:
        """The same again and again."""
        if self.device.is_cpu:
            for _ in range(times):
                self.launch()
            return
        if self._graph is None:
            with wp.ScopedCapture(self.device) as capture:
                self.launch()
            self._graph = capture.graph
        for _ in range(times):
            wp.capture_launch(self._graph)


def _run_stage(stage: list[Any]) -> None:
    """The first slice here, the others on the pool's threads."""
    others = [pool().submit(command.launch) for command in stage[1:]]
    stage[0].launch()
    for other in others:
        other.result()
