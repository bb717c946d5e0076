"""Tensors on a CPU by kernels of which each thread takes whole windows: for few events, or many windows."""

from __future__ import annotations

from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.imaging.window_batch import WindowBatch, table_of_windows
from amiwarp.imaging.windows import Windows
from amiwarp.imaging.zeroed_words import give_zeros, take_zeros
from amiwarp.kernels.launch import launch_on_host
from amiwarp.kernels.workers import run_together
from amiwarp.tasks import cpu_threads

FEW_EVENTS = 1 << 15
"""Number of events below which one thread is as fast as several."""
LEAST_WORK = 1 << 14
"""Least work of a thread [events]. An element of the result, which is memory to clear, counts 1/32 event."""
PIXELS_OF_EVENT = 24
"""Least number of a window's pixels in all bins for each of its events, with which sums are read event by event."""


def takes_whole_windows(batch: WindowBatch) -> bool:
    """Return whether threads should take whole windows: on a CPU, if that uses as many of them as there is work for."""
    if not batch.device.is_cpu:
        return False
    return len(batch.events) < FEW_EVENTS or len(batch.windows) >= cpu_threads()


def are_sparse(batch: WindowBatch, size: int) -> bool:
    """Return whether the windows have few events for their ``size`` pixels in all bins."""
    cut = batch.windows
    return int((cut.stop - cut.start).max(initial=0)) * PIXELS_OF_EVENT <= size


def run_on_windows(
    batch: WindowBatch, kernel: Any, settings: list[Any], out: NDArray[Any], *, scratch: int = 0
) -> None:
    """Run a kernel of :mod:`amiwarp.kernels.tensors_by_window` on all windows.

    ``settings``: its inputs after the windows. ``out``: the result of all windows. ``scratch``: number of words that
    the kernel needs, all zero before and after.
    """
    if not len(batch.windows):
        return
    rows, _ = table_of_windows(batch.windows)
    results = out.reshape((len(batch.windows), -1))

    def run(first: int, stop: int) -> None:
        arguments = [*batch.columns, rows[first:stop], *settings, batch.faults]
        words = None
        if scratch:
            words = take_zeros(scratch)
            arguments.append(words)
        arguments.append(results[first:stop])
        launch_on_host(kernel, stop - first, arguments)
        if words is not None:
            give_zeros(words)

    run_together([partial(run, *span) for span in _shares(batch.windows, out.size)])


def _shares(cut: Windows, size: int) -> list[tuple[int, int]]:
    """Return ranges of windows with about the same work, one for each thread. ``size``: elements of the result."""
    if len(cut) == 1 or cpu_threads() == 1:
        return [(0, len(cut))]
    threads = min(cpu_threads(), len(cut))
    work = np.cumsum(cut.stop - cut.start + size // (32 * len(cut)))
    threads = max(1, min(threads, int(work[-1]) // LEAST_WORK))
    edges = np.searchsorted(work, work[-1] * np.arange(1, threads) / threads)
    return [span for span in pairwise([0, *edges.tolist(), len(cut)]) if span[0] < span[1]]
