"""Buffers of votes on a CPU: one image of 32-bit sums per slice of the events."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import warp as wp

from amiwarp.imaging.canvas import Image
from amiwarp.imaging.uploaded_events import LARGEST_WEIGHT
from amiwarp.kernels import launch as launches
from amiwarp.kernels import pixel_votes, workers
from amiwarp.kernels.iwe import CPU_WIDTH, add_sums, read_sums
from amiwarp.kernels.launch import RecordedLaunch, launch
from amiwarp.kernels.pixel_votes import BLOCK, CAPACITY
from amiwarp.kernels.program import Program
from amiwarp.tasks import cpu_threads

SMALLEST = 512
"""Fewest blocks of a slice."""


class PixelVotes:
    """Sums of the votes of each pixel on a CPU, allocated once. Before they overflow, they move to 64-bit totals."""

    EVENTS = pixel_votes.vote_event_blocks
    EVENTS_OF_ROTATING_CAMERA = pixel_votes.vote_rotating_camera_blocks
    POINTS = pixel_votes.vote_point_blocks
    """Kernels for :meth:`vote`."""

    def __init__(self, canvas: Any, layers: int) -> None:
        """Allocate the sums. ``canvas``: Warp struct ``amiwarp.kernels.votes.Canvas``."""
        self._canvas = canvas
        self._cells = layers * canvas.rows * canvas.columns
        # votes and blocks of pixels may reach beyond the last row, with zeros
        size = self._cells + canvas.columns + 2 + CPU_WIDTH
        self._sums = wp.zeros((cpu_threads(), size), dtype=int, device="cpu")
        self._slices = [self._sums[k] for k in range(self._sums.shape[0])]
        self._totals = wp.empty(0, dtype=wp.int64, device="cpu")
        self._room = CAPACITY  # number of events that the sums can still take
        self._stale = False  # whether the sums are to be cleared before they are used
        self._reader: tuple[Image, Program] | None = None
        """Image that was read last, and the recorded launch that reads it."""

    def clear(self) -> None:
        """Discard all votes. The next vote clears the sums, each in the thread that adds to it."""
        self._stale = True
        self._totals = wp.empty(0, dtype=wp.int64, device="cpu")
        self._room = CAPACITY

    def _clear_stale(self) -> None:
        """Clear the sums if they are to be cleared, so that they can be used."""
        if self._stale:
            workers.run_together([sums.zero_ for sums in self._slices])
            self._stale = False

    def range_voter(self, x: Any, y: Any, layer: Any) -> Callable[[int, int], None]:
        """Return a function that votes a range of blocks of points in the calling thread."""
        vote = RecordedLaunch(
            pixel_votes.vote_point_blocks,
            [x, y, layer, self._canvas, len(x), 0],
            [self._slices[0]],
            device="cpu",
        )

        def vote_range(first: int, blocks: int) -> None:
            self._reserve(blocks * int(BLOCK))
            self._clear_stale()
            vote(first, blocks)

        return vote_range

    def vote(
        self,
        kernel: Any,
        inputs: list[Any],
        count: int,
        total: int,
    ) -> None:
        """Vote ``count`` entries that stand for ``total`` events, in pieces that fit into the sums."""
        block = int(BLOCK)
        blocks = math.ceil(count / block)
        if total <= CAPACITY:
            piece = max(blocks, 1)
        else:
            largest = 1 if total == count else LARGEST_WEIGHT
            piece = CAPACITY // (block * largest)
        columns = [*inputs, count]
        for first in range(0, blocks, piece):
            n = min(piece, blocks - first)
            self._reserve(total if n == blocks else CAPACITY)
            launches.launch_slices(
                kernel,
                n,
                columns,
                self._slices,
                first=first,
                smallest=SMALLEST,
                clear=self._stale,
            )
            self._stale = False

    def _reserve(self, events: int) -> None:
        """Make room for the votes of a number of events."""
        if events > self._room:
            cells = self._cells
            if not len(self._totals):
                self._totals = wp.zeros(cells, dtype=wp.int64, device="cpu")
            launch(add_sums, cells, [self._sums], [self._totals], device="cpu")
            self._stale = True
            self._room = CAPACITY
        self._room -= events

    def read(self, image: Image) -> None:
        """Write the current image [events] to ``image``; the votes are kept."""
        self._clear_stale()
        inputs = [self._sums, self._totals, self._canvas, image.frame]
        outputs = [image.pixels]
        if len(self._totals):
            launch(read_sums, image.blocks, inputs, outputs, device="cpu", smallest=SMALLEST)
            return
        read_image, program = self._reader or (None, None)
        if program is None or read_image is not image:
            program = Program("cpu")
            program.add(read_sums, image.blocks, inputs, outputs, smallest=SMALLEST)
            self._reader = image, program
        program.launch()
