"""Images of windows: sums, counts or latest times of their events, computed by kernels."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import lru_cache, partial
from typing import Any, NamedTuple

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.device_events import find_indices
from amiwarp.imaging.whole_windows import are_sparse, run_on_windows, takes_whole_windows
from amiwarp.imaging.window_batch import MOST_EVENTS, WindowBatch, window_rows
from amiwarp.imaging.windows import Windows
from amiwarp.imaging.zeroed_words import give_zeros, take_zeros
from amiwarp.kernels import tensor_values, tensors_by_window, tensors_cpu, tensors_cuda
from amiwarp.kernels import tensors as kernels
from amiwarp.kernels.background_activity import NEVER
from amiwarp.kernels.launch import launch, slices
from amiwarp.kernels.loading import load
from amiwarp.kernels.tensors import BLOCK, RUN
from amiwarp.kernels.workers import run_together
from amiwarp.tasks import cpu_threads

MOST_BYTES = {"cpu": 1 << 25, "cuda": 1 << 30}
"""Memory for the images of the windows that are processed in one launch [bytes]; at least one window is processed."""
SMALLEST = 256
"""Fewest blocks of a slice on a CPU."""
LEAST_ADDED = 1 << 15
"""Fewest numbers of the spare groups that a CPU thread adds."""


class Grid(NamedTuple):
    """Values of :class:`amiwarp.kernels.tensors.Grid`."""

    width: int
    height: int
    border: int = 0
    steps: int = 1
    rate: int = 0
    layers: int = 1
    low: int = 0
    off: int = 1
    parts: int = 1


@lru_cache(maxsize=256)
def struct_of(kind: Any, *values: int) -> Any:
    """Return a struct of numbers, which must not be changed. To make one takes as long as a launch."""
    struct = kind()
    for name, value in zip(kind.vars, values, strict=False):
        setattr(struct, name, value)
    return struct


def _images(
    batch: WindowBatch,
    grid: Grid,
    kernel: Any,
    on_cpu: Any,
    dtype: Any,
    *,
    sums: int = 1,
    empty: int = 0,
) -> Iterator[tuple[int, int, wp.array]]:
    """Compute the images of all windows by a kernel. Yield the first window, the number of windows, and their images.

    ``on_cpu``: kernel for blocks of events. ``sums``: numbers of type ``dtype`` in each pixel, ``empty`` at first. The
    images are overwritten by the next ones; on a CPU, the caller clears images of words.
    """
    cut = batch.windows
    device = batch.device
    check_lengths(cut, grid)
    # A window has a group of pixels for each part of its time intervals.
    rows_of_group = grid.height + 2 * grid.border
    columns_of_group = grid.width + 2 * grid.border
    group = grid.layers * rows_of_group * columns_of_group
    groups = grid.steps * grid.parts
    bytes_of_window = groups * group * sums * wp.types.type_size_in_bytes(dtype)
    fitting = MOST_BYTES["cpu" if device.is_cpu else "cuda"] // bytes_of_window
    most = min(max(fitting, 1), len(cut))

    # Behind the images there are the spare groups of the slices, and places for the events outside the image.
    threads = cpu_threads() if device.is_cpu else 1
    spare = most * groups
    trash = (spare + threads - 1) * group
    size = (trash + threads * 2 * (grid.width + 16)) * sums
    if size > MOST_EVENTS:
        raise AmiwarpError(
            f"a window has {groups * group} pixels in all its images; give fewer bins"
        )
    in_words = device.is_cpu and on_cpu is tensors_cpu.add_event_word_blocks
    images = take_zeros(size) if in_words else wp.empty(size, dtype=dtype, device=device)

    columns = batch.device_columns()
    for first in range(0, len(cut), most or 1):
        number = min(most, len(cut) - first)
        if not in_words:
            images.fill_(empty)
        together = cut if number == len(cut) else cut[first : first + number]
        rows, blocks = window_rows(together, device)
        inputs = [*columns, rows, struct_of(kernels.Grid, *grid)]
        outputs = [batch.faults, images]
        if device.is_cpu:
            _add_on_cpu(on_cpu, inputs, outputs, blocks, spare, group * sums, trash)
        elif blocks:
            inputs.append(struct_of(kernels.Part))
            wp.launch(kernel, blocks * int(BLOCK), inputs, outputs, device=device)
        yield first, number, images

    if in_words:
        images.numpy()[trash:size] = 0
        give_zeros(images)


def check_lengths(cut: Windows, grid: Grid) -> None:
    """Raise :class:`AmiwarpError` if the time in a window, in the units of the grid, may not be exact."""
    if grid.rate and len(cut):
        longest = int((cut.t_end - cut.t_start).max())
        too_long = (1 << 53) // grid.rate
        if longest >= too_long:
            raise AmiwarpError(f"a window lasts {longest} us; give one below {too_long} us")


def _add_on_cpu(
    kernel: Any,
    inputs: list[Any],
    outputs: list[wp.array],
    blocks: int,
    spare: int,
    group: int,
    trash: int,
) -> None:
    """Run a kernel on slices of the blocks. Add the spare groups of all slices but the first, and clear them.

    ``spare``: number of the first spare group. ``group``: numbers in a group. ``trash``: first pixel after all groups.
    """
    images = outputs[-1]
    grid = inputs[-1]
    load(kernel, images.device)
    if not blocks:
        return
    # The first slice adds to the images themselves, each other one to a spare group.
    run_of = int(RUN) if kernel is tensors_cpu.add_event_word_blocks else 1
    parts = []
    for number, (first, stop) in enumerate(slices(blocks, cpu_threads(), SMALLEST)):
        spare_group = spare + number - 1 if number else -1
        outside = trash + number * 2 * (grid.width + 16)
        part = struct_of(kernels.Part, first, spare_group, outside, stop)
        runs = -(-(stop - first) // run_of)  # rounded up
        parts.append((part, runs))

    def run(part: Any, n: int) -> None:
        wp.launch(kernel, n, [*inputs, part], outputs, device=images.device)

    run_together([partial(run, *part) for part in parts])
    combine = np.maximum if kernel is tensors_cpu.keep_latest_blocks else np.add
    _add_spare_groups([part for part, _ in parts[1:]], inputs, images, group, combine)


def _add_spare_groups(
    parts: Sequence[Any], inputs: list[Any], images: wp.array, group: int, combine: np.ufunc
) -> None:
    """Add the spare groups of slices to the images by ``combine``, and clear them.

    ``parts``: the slices, as structs. ``inputs``: inputs of the kernel that filled them. ``group``: numbers in a group.
    """
    if not parts:
        return
    # Each spare group belongs to the group of pixels in which its slice begins.
    replaced = wp.zeros(1, dtype=int, device=images.device)
    values = images.numpy()
    pairs = []
    _, _, t, _, *others = inputs
    for part in parts:
        wp.launch(
            tensors_cpu.find_replaced_group, 1, [t, *others, part], [replaced], device=images.device
        )
        first_of_target = int(replaced.numpy()[0]) * group
        first_of_spare = part.spare * group
        target = values[first_of_target : first_of_target + group]
        spare = values[first_of_spare : first_of_spare + group]
        pairs.append((target, spare))

    def add(first: int, stop: int) -> None:
        for whole_target, whole_spare in pairs:
            target = whole_target[first:stop]
            spare = whole_spare[first:stop]
            combine(target, spare, out=target)
            spare[:] = 0

    ranges = slices(group, cpu_threads(), LEAST_ADDED)
    run_together([partial(add, first, stop) for first, stop in ranges])


def result_rows(out: wp.array, first: int, number: int) -> wp.array:
    """Return the results of some windows as one row."""
    rows = out if number == len(out) else out[first : first + number]
    return rows.flatten()


def count_images(batch: WindowBatch, grid: Grid) -> Iterator[tuple[int, int, wp.array]]:
    """Count the events at the nearest pixels, see :func:`_images`."""
    return _images(batch, grid, tensors_cuda.count_events, tensors_cpu.count_event_blocks, wp.int32)


def latest_images(
    batch: WindowBatch,
    grid: Grid,
    *,
    carry: bool,
) -> Iterator[tuple[int, int, wp.array]]:
    """Find the latest times at the nearest pixels, see :func:`_images`. With ``carry``, also of earlier windows."""
    size = grid.layers * grid.height * grid.width
    before = None
    image_groups = _images(
        batch,
        grid,
        tensors_cuda.keep_latest,
        tensors_cpu.keep_latest_blocks,
        wp.int64,
        empty=int(NEVER),
    )
    for first, number, images in image_groups:
        if carry:
            inputs = [images, number, size, before or images]
            launch(tensor_values.carry_latest, size, inputs, [], device=batch.device)
            before = wp.clone(images[(number - 1) * size : number * size])
        yield first, number, images


def share_images(batch: WindowBatch, grid: Grid, bins: int) -> wp.array | NDArray[np.float32]:
    """Return the bins of all windows, shape (windows, layers * bins, height, width)."""
    shape = grid.layers * bins, grid.height, grid.width
    parts = 1
    fullest = CAPACITY
    if batch.events.whole_pixels:
        parts, fullest = _parts(batch, grid)
    in_words = fullest < CAPACITY
    low = 63 - max(fullest.bit_length(), LEAST_BITS)
    of_pixels = not batch.events.whole_pixels or (in_words and parts == 1)
    if of_pixels and takes_whole_windows(batch) and are_sparse(batch, math.prod(shape)):
        scratch = _scratch_of_whole_windows(batch, grid)
        if scratch <= MOST_EVENTS:  # which kernels can address; otherwise, an error follows below
            return _shares_of_whole_windows(batch, grid._replace(low=low), bins, scratch)
    out = batch.empty(shape, wp.float32)
    if in_words:  # both shares of an event in one word
        kernel = tensors_cuda.add_event_words
        on_cpu = tensors_cpu.add_event_word_blocks
        read = tensor_values.read_bins
        sums = 1
        border = 0
    else:
        kernel = tensors_cuda.share_events
        on_cpu = tensors_cpu.share_event_blocks
        read = tensor_values.read_shares
        sums = 2
        border = 1
    grid = grid._replace(border=border, low=low, parts=parts)
    length = grid.width if batch.device.is_cpu else 1
    of_thread = length * bins if in_words else length
    for first, number, images in _images(batch, grid, kernel, on_cpu, wp.int64, sums=sums):
        part = result_rows(out, first, number)
        launch(
            read,
            part.size // of_thread,
            [images, struct_of(kernels.Grid, *grid), bins, length],
            [part],
            device=batch.device,
            smallest=SMALLEST // 4,
        )
    return out


def _shares_of_whole_windows(
    batch: WindowBatch, grid: Grid, bins: int, scratch: int
) -> NDArray[np.float32]:
    """Return what :func:`share_images` returns, by kernels that take whole windows."""
    check_lengths(batch.windows, grid)
    out = batch.zeros((grid.layers * bins, grid.height, grid.width), np.float32)
    if batch.events.whole_pixels:
        kernel = tensors_by_window.add_word_windows
    else:
        kernel = tensors_by_window.share_windows
        grid = grid._replace(border=1)
    settings = [struct_of(kernels.Grid, *grid), bins]
    run_on_windows(batch, kernel, settings, out, scratch=scratch)
    return out


def _scratch_of_whole_windows(batch: WindowBatch, grid: Grid) -> int:
    """Return the number of words that :func:`_shares_of_whole_windows` needs for each thread: two images."""
    if batch.events.whole_pixels:
        return 2 * grid.width * grid.height
    # An image with a border, of two sums for each pixel; behind both, a place for the events outside
    image = 2 * grid.layers * (grid.height + 2) * (grid.width + 2)
    return 2 * image + 2 * (grid.width + 16)


CAPACITY = 1 << 19
LEAST_BITS = 16
"""Number of events in a part of a time interval from which words are not used. Fewer events leave more bits for their
shares: 24 bits just below the capacity, and 30 bits below ``2**LEAST_BITS`` events. With 24 bits, the sum of ten
thousand shares is exact to 1e-5."""
MOST_IMAGES = 52
"""Largest memory of a window's images for each of its events, if its time intervals are cut into parts [bytes]."""


def _parts(batch: WindowBatch, grid: Grid) -> tuple[int, int]:
    """Return into how many parts each time interval is cut so that words can be used, and the most events in a part.

    The second number is an upper bound, exact if there are many events. From CAPACITY on, words cannot be used.
    """
    cut = batch.windows
    most = int((cut.stop - cut.start).max(initial=0))
    if most < CAPACITY or not grid.rate:
        return 1, most
    span = cut.t_end - cut.t_start
    parts = 1 << (most // (grid.rate * CAPACITY)).bit_length()
    image = 8 * grid.layers * grid.width * grid.height
    while (
        grid.steps * parts * image <= MOST_IMAGES * most
        and int(span.max()) * grid.rate * parts < 1 << 53
    ):
        number = grid.rate * parts
        k = np.arange(1, number)[:, None]
        edges = cut.t_start - -k * span // number  # rounded up
        at_edges = find_indices(batch.events, edges.ravel()).reshape(edges.shape)
        inside = np.clip(at_edges, cut.start, cut.stop)
        indices = np.stack([cut.start, *inside, cut.stop])
        fullest = int(np.diff(indices, axis=0).max())
        if fullest < CAPACITY:
            return parts, fullest
        parts *= 2
    return 1, most


def normalise(values: wp.array | NDArray[np.float32]) -> None:
    """Bring the values of each row that are not zero to a mean of 0 and a standard deviation of 1."""
    device = values.device
    rows, columns = values.shape
    parts = math.ceil(columns / ROW)
    moments = wp.empty((rows, parts), dtype=wp.vec3d, device=device)
    wp.launch(tensor_values.sum_moments, moments.shape, [values, ROW], [moments], device=device)
    while parts > 1:
        parts = math.ceil(parts / ROW)
        fewer = wp.empty((rows, parts), dtype=wp.vec3d, device=device)
        wp.launch(tensor_values.add_moments, fewer.shape, [moments, ROW], [fewer], device=device)
        moments = fewer
    wp.launch(tensor_values.normalise, values.shape, [moments, values], device=device)


ROW = 64
"""Number of values that a thread adds up."""
