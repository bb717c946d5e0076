"""Buffers of votes on CUDA: one image of 64-bit words, each of which holds the sums of a cell."""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

import warp as wp

from amiwarp.imaging.canvas import Image
from amiwarp.kernels.iwe import add_totals, empty_words, read_votes
from amiwarp.kernels.launch import RecordedLaunch, launch
from amiwarp.kernels.word_votes import (
    TRASH,
    Cells,
    vote_events,
    vote_points,
    vote_quickly,
    vote_rotating_camera,
)

FIRST_BATCH = 1 << 21
LARGEST_BATCH = 1 << 27
"""Sizes of the first and the largest batch of the fast voting kernel [events].

The fast kernel does not check whether a 32-bit word of the image overflows; the words are added to the image and
cleared after each batch. The first batch is small. Later batches have a size that fills the fullest word to about
:data:`TARGET_FILL`. If a word overflowed, or if there are fewer events than the first batch, the exact kernel votes,
which checks every addition.
"""
TARGET_FILL = 600
"""Number of events that the fullest word of the image should receive per batch of the fast voting kernel. A word holds
up to 1,023."""
MOST_UNVERIFIED = 1 << 26
"""Number of unverified events at which the next call verifies them first. Their arrays, of 16 bytes per event and
more, are held until then, so that they can be voted again."""


class WordVotes:
    """Words of the cells of an image on CUDA, and 64-bit totals, allocated once."""

    EVENTS = vote_events
    EVENTS_OF_ROTATING_CAMERA = vote_rotating_camera
    POINTS = vote_points
    """Kernels for :meth:`vote`."""

    def __init__(self, canvas: Any, layers: int, device: Any) -> None:
        """Allocate the words. ``canvas``: Warp struct ``amiwarp.kernels.votes.Canvas``."""
        self._params = canvas
        self.device = device
        count = layers * canvas.rows * canvas.columns
        self._trash = count  # index of the first word behind the image
        self._cells = Cells()
        self._fast = Cells()
        for cells in (self._cells, self._fast):
            cells.words = wp.zeros(count + int(TRASH), dtype=wp.uint64, device=device)
            cells.totals = wp.zeros(count, dtype=wp.int64, device=device)

        self._batches: list[tuple[list[Any], int, int]] = []
        """Inputs, number of events and first event of each unverified batch of the fast kernel."""
        self._batches_fit: bool | None = None
        """Whether no word overflowed in the last batches that were verified; None before the first."""
        self._batch_size = FIRST_BATCH
        self._recorded: tuple[list[Any], RecordedLaunch] | None = None
        """Inputs of the last fast vote, and its launch."""
        self._reader: tuple[Image, RecordedLaunch] | None = None
        """Image that was read last, and the recorded launch that reads it."""
        self._record_launches()

    def _record_launches(self) -> None:
        """Record the launches that follow each batch of the fast vote."""
        self._counts = wp.zeros((64, 1024), dtype=wp.int64, device=self.device)
        self._fullest = wp.zeros(1, dtype=int, device=self.device)
        fast = self._fast
        self._clear_words = RecordedLaunch(
            empty_words,
            [self._params, fast, 0],
            [self._counts, self._fullest],
            device=self.device,
            n=len(fast.words),
        )
        self._add_fast_totals = RecordedLaunch(
            add_totals,
            [fast.totals, self._counts.flatten()],
            [self._cells.totals],
            device=self.device,
            n=max(len(fast.totals), self._counts.size),
        )

    def clear(self) -> None:
        """Discard all votes."""
        self._discard_batches()
        self._cells.words.zero_()
        self._cells.totals.zero_()

    def range_voter(self, x: Any, y: Any, layer: Any) -> Callable[[int, int], None]:
        """Return a function that votes a range of points."""
        return RecordedLaunch(
            vote_points, [x, y, layer, self._params, 0], [self._cells], device=self.device
        )

    def vote(self, kernel: Any, inputs: list[Any], count: int, total: int) -> None:
        """Vote ``count`` entries that stand for ``total`` events.

        Many events are voted by the fast kernel, whose result is verified later. ``kernel`` votes all others exactly:
        it checks for overflow at every addition.
        """
        if sum(size for _, size, _ in self._batches) >= MOST_UNVERIFIED:
            self._verify_batches()
        start = 0
        vote_fast = None
        may_be_fast = kernel is self.EVENTS and total == count
        while may_be_fast and self._batches_fit is not False and count - start >= FIRST_BATCH:
            size = min(count - start, self._batch_size)
            vote_fast = vote_fast or self._recorded_vote(inputs)
            vote_fast(start, size)
            self._clear_words.set(2, len(self._batches))
            self._clear_words.repeat()
            self._fast.words.zero_()
            self._batches.append((inputs, size, start))
            if self._batches_fit is None or len(self._batches) == len(self._counts):
                self._verify_batches()
            start += size
        launch(kernel, count - start, inputs, [self._cells], device=self.device, first=start)

    def _recorded_vote(self, inputs: list[Any]) -> RecordedLaunch:
        """Return the recorded launch of the fast kernel, which takes a tenth of the time of a new launch."""
        if self._recorded is not None:
            last_inputs, vote_fast = self._recorded
            model, *arrays = inputs
            last_model, *last_arrays = last_inputs
            same_kernel = type(model) is type(last_model)
            same_arrays = all(map(operator.is_, arrays, last_arrays))
            if same_kernel and same_arrays:
                vote_fast.set(0, model)
                self._recorded = inputs, vote_fast
                return vote_fast
        vote_fast = RecordedLaunch(
            vote_quickly, [*inputs, self._trash, 0], [self._fast], device=self.device
        )
        self._recorded = inputs, vote_fast
        return vote_fast

    def _verify_batches(self) -> None:
        """Keep the votes of the fast kernel if no word overflowed; otherwise vote their events again exactly."""
        if not self._batches:
            return
        counts = self._counts[: len(self._batches)].numpy().sum(axis=1)
        if self._batches_fit is None:
            fullest = max(int(self._fullest.numpy()[0]), 1)
            filling = FIRST_BATCH * TARGET_FILL // fullest
            self._batch_size = min(max(filling, FIRST_BATCH), LARGEST_BATCH)
        self._batches_fit = bool((counts == [size for _, size, _ in self._batches]).all())
        if self._batches_fit:
            self._add_fast_totals.repeat()
            self._batches.clear()
            return
        for inputs, size, first in self._batches:
            launch(vote_events, size, inputs, [self._cells], device=self.device, first=first)
        self._discard_batches()

    def _discard_batches(self) -> None:
        """Discard the votes of the fast kernel that are not verified yet."""
        if self._batches:
            self._fast.totals.zero_()
            self._counts.zero_()
            self._batches.clear()

    def read(self, image: Image) -> None:
        """Write the current image [events] to ``image``; the votes are kept."""
        self._verify_batches()
        last_image, read_image = self._reader or (None, None)
        if read_image is None or last_image is not image:
            inputs = [self._cells, self._params, image.frame, 0]
            read_image = RecordedLaunch(
                read_votes, inputs, [image.pixels], device=self.device, n=image.blocks
            )
            self._reader = image, read_image
        read_image.repeat()
