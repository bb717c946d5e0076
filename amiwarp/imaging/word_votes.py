"""Buffers of votes on CUDA: one image of 64-bit words, each of which holds the sums of a cell."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import warp as wp

from amiwarp.kernels.iwe import add_totals, empty_words, read_votes
from amiwarp.kernels.launch import RecordedLaunch, launch, specialised
from amiwarp.kernels.word_votes import TRASH, Cells, vote_events, vote_points, vote_quickly, vote_rotating_camera

if TYPE_CHECKING:
    from amiwarp.imaging.device_events import UploadedEvents
    from amiwarp.imaging.device_image import Image

FIRST_BATCH, LARGEST_BATCH = 1 << 21, 1 << 27
"""Sizes of the first and the largest batch of the fast voting kernel on CUDA [events].

The fast kernel does not check whether a 32-bit word of the image overflows; the words are added to the image and
cleared after each batch. The first batch is small. Later batches have a size that fills the fullest word to about
:data:`TARGET_FILL`. If a word overflowed, or if there are fewer events than the first batch, the exact kernel votes,
which checks every addition.
"""
TARGET_FILL = 600
"""Number of events that the fullest word of the image should receive per batch of the fast voting kernel. A word holds
up to 1,023."""


class WordVotes:
    """Words of the cells of an image on CUDA, and 64-bit totals, allocated once."""

    def __init__(self, canvas: Any, layers: int, device: Any) -> None:
        """Allocate the words. ``canvas``: Warp struct ``amiwarp.kernels.votes.Canvas``."""
        self._params, self.device = canvas, device
        n = self._trash = layers * canvas.rows * canvas.columns
        self._cells, self._fast = Cells(), Cells()
        for cells in (self._cells, self._fast):
            cells.words = wp.zeros(n + int(TRASH), dtype=wp.uint64, device=device)
            cells.totals = wp.zeros(n, dtype=wp.int64, device=device)
        self._batches: list[tuple[list[Any], int, int]] = []  # voted by the fast kernel, not verified yet
        self._batches_fit: bool | None = None
        self._batch = FIRST_BATCH
        self._recorded: tuple[list[Any], Any] | None = None  # inputs of the last fast vote, and its recorded launch
        self._read: tuple[Image, Any] | None = None
        self._record_launches()

    def _record_launches(self) -> None:
        """Record the launches that follow each batch of the fast vote."""
        self._counts = wp.zeros((64, 1024), dtype=wp.int64, device=self.device)
        self._fullest = wp.zeros(1, dtype=int, device=self.device)
        fast = self._fast
        self._clear_words = wp.launch(
            empty_words, len(fast.words), [self._params, fast, 0], [self._counts, self._fullest], device=self.device,
            record_cmd=True,
        )  # fmt: skip
        inputs = [fast.totals, self._counts.flatten()]
        n, to = max(len(fast.totals), self._counts.size), [self._cells.totals]
        self._add_fast_totals = wp.launch(add_totals, n, inputs, to, device=self.device, record_cmd=True)

    def clear(self) -> None:
        """Discard all votes."""
        self._discard_batches()
        self._cells.words.zero_()
        self._cells.totals.zero_()

    def add_events(self, inputs: list[Any], events: UploadedEvents, camera_rotation: Any | None) -> None:
        """Vote events. ``inputs``: model, camera, columns of the events and canvas, as the kernels take them."""
        if camera_rotation is not None:
            self._vote_exactly(vote_rotating_camera, [*inputs, camera_rotation], events.count)
        elif len(events.arrays.weight):
            self._vote_exactly(vote_events, inputs, events.count)
        else:
            self._vote_in_batches(inputs, events.count)

    def add_points(self, x: Any, y: Any, layer: Any, count: int) -> None:
        """Vote the first ``count`` points."""
        self._vote_exactly(vote_points, [x, y, layer, self._params], count)

    def range_voter(self, x: Any, y: Any, layer: Any) -> Callable[[int, int], None]:
        """Return a function that votes a range of points."""
        return RecordedLaunch(vote_points, [x, y, layer, self._params], [self._cells], device=self.device)

    def _vote_exactly(self, kernel: Any, inputs: list[Any], count: int, first: int = 0) -> None:
        """Vote by the exact kernel, which checks for overflow at every addition."""
        launch(kernel, count, inputs, [self._cells], device=self.device, first=first)

    def _vote_in_batches(self, inputs: list[Any], count: int) -> None:
        """Vote on CUDA by the fast kernel, whose result is verified later; few events are voted exactly at once."""
        start, vote = 0, None
        while start < count:
            batch = min(count - start, self._batch)
            if self._batches_fit is False or batch < FIRST_BATCH:
                self._vote_exactly(vote_events, inputs, count - start, start)
                return
            vote = vote or self._recorded_vote(inputs)
            vote.set_dim(batch)
            vote.set_param_at_index(len(inputs) + 1, start)
            vote.launch()
            self._clear_words.set_param_at_index(2, len(self._batches))
            self._clear_words.launch()
            self._fast.words.zero_()
            self._batches.append((inputs, batch, start))
            if self._batches_fit is None or len(self._batches) == len(self._counts):
                self._verify_batches()
            start += batch

    def _recorded_vote(self, inputs: list[Any]) -> Any:
        """Return the recorded launch of the fast kernel, which takes a tenth of the time of a new launch."""
        if self._recorded is not None:
            before, vote = self._recorded
            if type(inputs[0]) is type(before[0]) and all(a is b for a, b in zip(inputs[1:], before[1:], strict=True)):
                vote.set_param_at_index(0, inputs[0])
                self._recorded = inputs, vote
                return vote
        given = [*inputs, self._trash, 0]
        kernel = specialised(vote_quickly, given)
        vote = wp.launch(kernel, 1, given, [self._fast], device=self.device, record_cmd=True)
        self._recorded = inputs, vote
        return vote

    def _verify_batches(self) -> None:
        """Keep the votes of the fast kernel if no word overflowed; otherwise vote their events again exactly."""
        if not self._batches:
            return
        counts = self._counts[: len(self._batches)].numpy().sum(axis=1)
        if self._batches_fit is None:
            self._batch = min(
                max(FIRST_BATCH * TARGET_FILL // max(int(self._fullest.numpy()[0]), 1), FIRST_BATCH), LARGEST_BATCH
            )
        self._batches_fit = bool((counts == [count for _, count, _ in self._batches]).all())
        if self._batches_fit:
            self._add_fast_totals.launch()
            self._batches.clear()
            return
        for inputs, count, first in self._batches:
            self._vote_exactly(vote_events, inputs, count, first)
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
        if self._read is None or self._read[0] is not image:
            given, to = [self._cells, self._params, image.frame, 0], [image.pixels]
            self._read = image, wp.launch(read_votes, image.blocks, given, to, device=self.device, record_cmd=True)
        self._read[1].launch()
