"""Images of warped events into files, from blocks that go by: whole or by windows of time, in constant memory."""

from __future__ import annotations

import io
import itertools
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

import numpy as np

from amiwarp.errors import AmiwarpError
from amiwarp.imaging.choices import Layers
from amiwarp.imaging.warped_image import PIECE, CanvasShape, Votes
from amiwarp.io.output import NewFile, allocate, check_output
from amiwarp.validation import choice

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.events.events import Events, EventSource

PERCENTILE = 99.5
"""Of the pixels with events: what is as bright as this, or brighter, is white."""
GAMMA = 0.5
"""Counts span decades; their square root shows weak edges beside strong ones."""
OFF_COLOUR, ON_COLOUR = (0.20, 0.55, 1.00), (1.00, 0.55, 0.10)
"""Blue and orange: told apart by all common kinds of colour vision."""
MOST_WINDOWS = 100_000


def tone(counts: NDArray[Any]) -> NDArray[np.float32]:
    """Counts, zero or more, to 0 .. 1 for the eye: gamma :data:`GAMMA` up to the :data:`PERCENTILE`."""
    positive = counts[counts > 0]
    top = float(np.percentile(positive, PERCENTILE)) if positive.size else 1.0
    return np.asarray(np.clip(counts / top, 0.0, 1.0) ** GAMMA, np.float32)


def to_picture(image: NDArray[np.float32], layers: Layers) -> NDArray[np.uint8]:
    """8-bit picture of an image: grey, or (height, width, 3) where it has polarities.

    Merged: black to white. Signed: grey is zero, white ON, black OFF. Polarity: blue is OFF, orange ON.
    """
    shown: NDArray[Any]
    layers = choice(Layers, layers, "layers")
    if layers is Layers.MERGED:
        shown = tone(image)
    elif layers is Layers.SIGNED:
        shown = 0.5 + 0.5 * np.sign(image) * tone(np.abs(image))
    else:
        bright = tone(image)
        shown = bright[0][..., None] * np.array(OFF_COLOUR) + bright[1][..., None] * np.array(ON_COLOUR)
    return np.asarray(np.rint(np.clip(shown, 0.0, 1.0) * 255.0), np.uint8)


def save_png(path: Path, picture: Any, *, overwrite: bool = False) -> None:
    """Write an 8-bit picture, an array or Pillow's, whole or not at all."""
    with NewFile(path, overwrite=overwrite) as new:
        encode_png(new.part, picture)


def encode_png(path: Path, picture: Any) -> None:
    """Write an 8-bit picture, an array or Pillow's, to an unfinished file."""
    from PIL import Image

    image = picture if isinstance(picture, Image.Image) else Image.fromarray(picture)
    encode_image(path, image, "PNG", optimize=True)


def encode_image(path: Path, image: Any, kind: str, **options: Any) -> None:
    """Write Pillow's image to an unfinished file. Raises OSError on a full disk, where Pillow itself may not notice."""
    buffer = io.BytesIO()
    image.save(buffer, format=kind, **options)
    path.write_bytes(buffer.getbuffer())


class IweFiles:
    """Collects blocks into images and writes them; a ``with`` block: its files appear when it ends without an error."""

    def __init__(
        self, paths: Sequence[Path], source: EventSource, *, window_us: int | None, layers: Layers, device: Any
    ) -> None:
        """``window_us`` None makes one image of all. Raises :class:`AmiwarpError` for other endings than .png, .npy."""
        for path in paths:
            if path.suffix.lower() not in (".png", ".npy"):
                raise AmiwarpError(f"{path}: images of events are written as .png or .npy")
        self.written: list[Path] = []
        self._layers = layers = choice(Layers, layers, "layers")
        width, height = source.size
        self._votes = Votes(CanvasShape(width, height, per_polarity=layers is not Layers.MERGED), device)
        self._window_us = window_us
        self._first = source.t_first if len(source) else 0
        duration = source.t_last - self._first + 1 if len(source) else 1
        self._count = 1 if window_us is None else -(-duration // window_us)
        if self._count > MOST_WINDOWS:
            raise AmiwarpError(f"{self._count} windows are more than {MOST_WINDOWS}; give a longer --iwe-window-ms")
        self._at = 0
        self._paths = paths
        self._check_outputs()
        self._new: list[NewFile] = []
        self._stacks: dict[Path, Any] = {}

    def __enter__(self) -> IweFiles:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if kind is None:
                self._finish()
        finally:
            self._stacks.clear()
            for new in self._new:
                new.discard()

    def add(self, events: Events) -> None:
        """Votes compensated events, which follow in time on those before."""
        for window, piece in self._pieces(events):
            while self._at < window:
                self._put()
            self._votes.add_as_they_are(piece)

    def _pieces(self, events: Events) -> Iterator[tuple[int, Events]]:
        edges = {0, len(events), *range(0, len(events), PIECE)}
        window = np.zeros(len(events), np.int64)
        if self._window_us is not None:
            window = (events.t - self._first) // self._window_us
            edges |= set((np.flatnonzero(np.diff(window)) + 1).tolist())
        cuts = sorted(edges)
        for start, stop in itertools.pairwise(cuts):
            yield int(window[start]), events[start:stop]

    def _put(self) -> None:
        """The window is complete: its image goes to each of the files."""
        votes = self._votes.take()
        image = votes if self._layers is Layers.POLARITY else votes[0]
        if self._layers is Layers.SIGNED:
            image = votes[1] - votes[0]
        for path in self._paths:
            if path.suffix.lower() == ".npy":
                self._stack(path, image.shape)[self._at] = image
            else:
                encode_png(self._begin(self._numbered(path, self._at)), to_picture(image, self._layers))
        self._at += 1

    def _stack(self, path: Path, shape: tuple[int, ...]) -> Any:
        if path not in self._stacks:
            part = self._begin(path)
            full = (self._count, *shape)
            flat = np.lib.format.open_memmap(
                part, mode="w+", dtype=np.float32, shape=shape if self._window_us is None else full
            )
            with open(part, "r+b") as file:  # a full disk would end the process when its pages are written
                allocate(file.fileno(), 0, os.path.getsize(part))
            self._stacks[path] = flat.reshape(full)
        return self._stacks[path]

    def _numbered(self, path: Path, at: int) -> Path:
        return path if self._window_us is None else path.with_name(f"{path.stem}_{at:05d}{path.suffix}")

    def _check_outputs(self) -> None:
        """Raise AmiwarpError before the work if an image cannot be written at its end."""
        for path in self._paths:
            count = self._count if path.suffix.lower() == ".png" else 1
            check_output(self._numbered(path, 0) if count > 1 else path)
            there = set(os.listdir(path.parent)) if count > 1 else set()
            for name in (self._numbered(path, at) for at in range(count)):
                if name.name in there:
                    check_output(name)

    def _begin(self, path: Path) -> Path:
        self._new.append(NewFile(path))
        return self._new[-1].part

    def _finish(self) -> None:
        while self._at < self._count:
            self._put()
        for stack in self._stacks.values():
            stack.flush()
        self._stacks.clear()
        for new in self._new:
            new.commit()
            self.written.append(new.path)


__all__ = ["IweFiles", "Layers", "save_png", "to_picture", "tone"]
