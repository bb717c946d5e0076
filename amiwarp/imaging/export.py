"""Write images of warped events to files, from a stream of event blocks: one image, or one per time window.

Memory use is constant.
"""

from __future__ import annotations

import io
import itertools
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.choices import Layers
from amiwarp.errors import AmiwarpError
from amiwarp.events.recording import Events, EventSource
from amiwarp.imaging.canvas import CanvasShape
from amiwarp.imaging.iwe import PIECE
from amiwarp.imaging.palette import OFF_ON_BLACK, ON_ON_BLACK
from amiwarp.imaging.votes import Votes
from amiwarp.io.file_access import allocate
from amiwarp.io.output_formats import check_ending
from amiwarp.io.outputs import NewFile, check_output
from amiwarp.validation import choice

PNG_LEVEL = 7
"""Level of compression of PNG files. The highest level, 9, takes five times as long, for files that are 1 % smaller."""
PERCENTILE = 99.5
"""Percentile of the pixels with events whose count is shown as white."""
GAMMA = 0.5
"""Gamma of displayed images. Counts span decades; their square root keeps weak edges visible next to strong ones."""
MOST_WINDOWS = 100_000
"""Largest number of time windows, each written as one image."""


def brightest(counts: NDArray[Any], percentile: float = PERCENTILE) -> float:
    """Return the event count that is shown brightest: the percentile of the pixels with events, or 1 without events."""
    positive = counts[counts > 0]
    if not positive.size:
        return 1.0
    return float(np.percentile(positive, percentile))


def tone(counts: NDArray[Any], top: float | None = None) -> NDArray[np.float32]:
    """Return the brightness 0 .. 1 of event counts >= 0, with gamma :data:`GAMMA`.

    ``top``: count that is shown as 1, by default the :func:`brightest`.
    """
    if top is None:
        top = brightest(counts)
    share = np.clip(counts / top, 0.0, 1.0)
    return np.asarray(share**GAMMA, np.float32)


def in_two_colours(off: NDArray[Any], on: NDArray[Any]) -> NDArray[Any]:
    """Return the brightness of OFF and ON events as colours on black, at most 2, shape ``(height, width, 3)``."""
    colours = np.array([OFF_ON_BLACK, ON_ON_BLACK], off.dtype)
    # A product of matrices is eight times as fast as two sums over an axis of three.
    return np.stack([off, on], axis=-1) @ colours


def to_picture(
    image: NDArray[np.float32],
    layers: Layers,
    *,
    top: float | None = None,
) -> NDArray[np.uint8]:
    """Return an image of events as an 8-bit picture, shape ``(height, width)``; with polarities ``(height, width, 3)``.

    Merged: no events is black, many are white. Signed: zero is grey, ON is white, OFF is black. Polarity: OFF is blue,
    ON is orange. ``top``: count that is shown brightest, see :func:`tone`.
    """
    bright: NDArray[Any]
    layers = choice(Layers, layers, "layers")
    if layers is Layers.MERGED:
        bright = tone(image, top)
    elif layers is Layers.SIGNED:
        bright = 0.5 + 0.5 * np.sign(image) * tone(np.abs(image), top)
    else:
        off, on = tone(image, top)
        bright = in_two_colours(off, on)
    levels = np.clip(bright, 0.0, 1.0) * 255.0
    return np.asarray(np.rint(levels), np.uint8)


def save_png(path: Path, picture: Any, *, overwrite: bool = False) -> None:
    """Write an 8-bit picture (an array or a Pillow image) as a PNG file. On failure no file remains."""
    check_ending(path, "pictures are written", [".png"])
    with NewFile(path, overwrite=overwrite) as new:
        encode_png(new.part, picture)


def save_values(path: Path, image: NDArray[np.float32]) -> None:
    """Write the values of an image as float32 to a new .tif file; of several layers, each to a page."""
    from PIL import Image

    check_ending(path, "values of images are written", [".tif"])
    with NewFile(path) as new:
        height, width = image.shape[-2:]
        layers = np.asarray(image.reshape(-1, height, width), np.float32)
        first, *more = map(Image.fromarray, layers)
        encode_image(new.part, first, "TIFF", save_all=bool(more), append_images=more)


def encode_png(path: Path, picture: Any) -> None:
    """Write an 8-bit picture (an array or a Pillow image) as PNG to a temporary file, which the caller renames."""
    from PIL import Image

    image = picture if isinstance(picture, Image.Image) else Image.fromarray(picture)
    encode_image(path, image, "PNG", compress_level=PNG_LEVEL)


def encode_image(path: Path, image: Any, kind: str, **options: Any) -> None:
    """Write a Pillow image to a temporary file. Raises OSError on a full disk, which Pillow may not notice."""
    buffer = io.BytesIO()
    image.save(buffer, format=kind, **options)
    path.write_bytes(buffer.getbuffer())


class IweFiles:
    """Writer that accumulates event blocks into images and saves them.

    Use it in a ``with`` block: the files appear when the block ends without an error.
    """

    def __init__(
        self,
        paths: Sequence[Path],
        source: EventSource,
        *,
        window_us: int | None,
        layers: Layers,
        device: Any,
    ) -> None:
        """Check the output paths. ``window_us`` is the length of a window [us]; None makes one image of all events.

        Raises :class:`AmiwarpError` for an ending other than .png or .npy, and for too many windows.
        """
        for path in paths:
            check_ending(path, "images of events are written", [".png", ".npy"])
        self.written: list[Path] = []
        self._layers = choice(Layers, layers, "layers")
        per_polarity = self._layers is not Layers.MERGED
        self._votes = Votes(CanvasShape(*source.size, per_polarity=per_polarity), device)

        self._window_us = window_us
        self._first = 0
        duration = 1
        if len(source):
            self._first = source.t_first
            duration = source.t_last - self._first + 1
        self._count = 1 if window_us is None else -(-duration // window_us)  # rounded up
        if self._count > MOST_WINDOWS:
            raise AmiwarpError(
                f"{self._count} windows exceed the limit of {MOST_WINDOWS}; give a longer --iwe-window-ms"
            )
        self._window = 0
        self._paths = paths
        self._check_outputs()
        self._unfinished: list[NewFile] = []
        self._stacks: dict[Path, Any] = {}

    def __enter__(self) -> IweFiles:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        try:
            if kind is None:
                self._finish()
        finally:
            self._stacks.clear()
            for new in self._unfinished:
                new.discard()

    def add(self, events: Events) -> None:
        """Add compensated events to the image of their time window. Blocks must be in time order."""
        for window, piece in self._pieces(events):
            while self._window < window:
                self._write_window()
            self._votes.add_unmoved(piece)

    def _pieces(self, events: Events) -> Iterator[tuple[int, Events]]:
        """Split the events by time window; yield the index of the window and the events in it."""
        edges = {0, len(events), *range(0, len(events), PIECE)}
        window = np.zeros(len(events), np.int64)
        if self._window_us is not None:
            window = (events.t - self._first) // self._window_us
            begins = np.flatnonzero(np.diff(window)) + 1
            edges.update(begins.tolist())
        cuts = sorted(edges)
        for start, stop in itertools.pairwise(cuts):
            yield int(window[start]), events[start:stop]

    def _write_window(self) -> None:
        """Write the image of the current window, which is complete, to each path."""
        votes = self._votes.take()
        image = votes if self._layers is Layers.POLARITY else votes[0]
        if self._layers is Layers.SIGNED:
            image = votes[1] - votes[0]
        for path in self._paths:
            if path.suffix.lower() == ".npy":
                self._stack(path, image.shape)[self._window] = image
            else:
                part = self._begin_file(self._numbered(path, self._window))
                encode_png(part, to_picture(image, self._layers))
        self._window += 1

    def _stack(self, path: Path, shape: tuple[int, ...]) -> Any:
        """Return the memory-mapped array of a .npy output; create it at the first call."""
        if path not in self._stacks:
            part = self._begin_file(path)
            full = (self._count, *shape)
            stored = shape if self._window_us is None else full
            flat = np.lib.format.open_memmap(part, mode="w+", dtype=np.float32, shape=stored)
            # Reserve the space: writing a mapped page to a full disk kills the process.
            with open(part, "r+b") as file:
                allocate(file.fileno(), 0, os.path.getsize(part))
            self._stacks[path] = flat.reshape(full)
        return self._stacks[path]

    def _numbered(self, path: Path, number: int) -> Path:
        """Return the path of one window's image."""
        if self._window_us is None:
            return path
        return path.with_name(f"{path.stem}_{number:05d}{path.suffix}")

    def _check_outputs(self) -> None:
        """Check all output paths before any work; raise :class:`AmiwarpError` if one of them cannot be written."""
        for path in self._paths:
            png = path.suffix.lower() == ".png"
            count = self._count if png else 1
            check_output(self._numbered(path, 0) if png else path)
            names_present = set(os.listdir(path.parent)) if count > 1 else set()
            for name in (self._numbered(path, number) for number in range(count)):
                if name.name in names_present:
                    check_output(name)

    def _begin_file(self, path: Path) -> Path:
        """Create the temporary file of one output and return its path."""
        self._unfinished.append(NewFile(path))
        return self._unfinished[-1].part

    def _finish(self) -> None:
        """Write the remaining windows and rename all files to their final names."""
        while self._window < self._count:
            self._write_window()
        while self._stacks:  # Windows does not rename a file that is mapped
            _, stack = self._stacks.popitem()
            stack.flush()
            del stack
        for new in self._unfinished:
            new.commit()
            self.written.append(new.path)
