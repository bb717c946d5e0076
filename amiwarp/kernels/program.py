"""Programs of launches that run repeatedly on the same arrays: a CUDA graph, or recorded CPU slices."""

from collections.abc import Callable, Sequence
from typing import Any

import warp as wp

from amiwarp.kernels.launch import BLOCK_DIM, SMALLEST_SLICE, RecordedLaunch, slices
from amiwarp.kernels.workers import run_together
from amiwarp.tasks import cpu_threads

FEW_LAUNCHES = 6
"""Number of launches up to which they take less time than the capture of a graph."""
MOST_RUNS = 6
"""Largest number of runs that one CUDA graph may hold: launching a graph takes longer than a few small kernels."""


class Program:
    """Sequence of kernel launches that can be run many times.

    Arrays and numbers are those passed to :meth:`add`. A value that changes between runs must be stored in an array.
    """

    def __init__(self, device: Any) -> None:
        self.device = wp.get_device(device)
        self._stages: list[list[Callable[[], None]]] = []
        self._graphs: dict[int, Any] = {}

    def add(
        self,
        kernel: Any,
        n: int,
        inputs: Sequence[Any],
        outputs: Sequence[Any],
        *,
        smallest: int = SMALLEST_SLICE,
    ) -> None:
        """Append a kernel over ``range(n)`` whose last input is ``start: int``.

        See :func:`amiwarp.kernels.launch.launch`. On CUDA the range is rounded up to whole blocks.
        """
        if n == 0:
            return
        if self.device.is_cpu:
            ranges = slices(n, cpu_threads(), smallest)
        else:
            blocks = -(-n // BLOCK_DIM)  # rounded up
            ranges = [(0, blocks * BLOCK_DIM)]
        stage = []
        for start, stop in ranges:
            given = [*inputs, start]
            recorded = RecordedLaunch(kernel, given, outputs, device=self.device, n=stop - start)
            stage.append(recorded.repeat)
        self._stages.append(stage)

    def add_slices(
        self,
        kernel: Any,
        n: int,
        inputs: Sequence[Any],
        outputs: Sequence[Any],
        *,
        smallest: int = SMALLEST_SLICE,
    ) -> None:
        """Append a kernel as :meth:`add` does, but give each slice of its threads an output.

        Slice k writes ``outputs[k]``. On CUDA there is one slice with ``n`` threads, which writes ``outputs[0]``.
        """
        if n == 0:
            return
        ranges = slices(n, len(outputs), smallest) if self.device.is_cpu else [(0, n)]
        stage = []
        for (start, stop), out in zip(ranges, outputs, strict=False):
            given = [*inputs, start]
            recorded = RecordedLaunch(kernel, given, [out], device=self.device, n=stop - start)
            stage.append(recorded.repeat)
        self._stages.append(stage)

    def launch(self) -> None:
        """Run all stages once, in the order in which they were added."""
        for stage in self._stages:
            run_together(stage)

    def run(self, times: int = 1) -> None:
        """Run all stages ``times`` times; more than a few launches on CUDA run as graphs."""
        if self.device.is_cpu or times * len(self._stages) <= FEW_LAUNCHES:
            for _ in range(times):
                self.launch()
            return
        runs = max(n for n in range(1, MOST_RUNS + 1) if times % n == 0)
        graph = self._graph(runs)
        for _ in range(times // runs):
            wp.capture_launch(graph)

    def _graph(self, runs: int) -> Any:
        """Return the CUDA graph of a number of runs. The first call captures it."""
        if runs not in self._graphs:
            with wp.ScopedCapture(self.device) as capture:
                for _ in range(runs):
                    self.launch()
            self._graphs[runs] = capture.graph
        return self._graphs[runs]
