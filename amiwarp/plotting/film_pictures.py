"""The picture of a frame of a film, and the line of text below it."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.choices import Layers
from amiwarp.imaging.canvas import CanvasShape
from amiwarp.imaging.export import brightest, in_two_colours, to_picture
from amiwarp.imaging.iwe import PIECE
from amiwarp.imaging.palette import OFF_ON_BLACK, ON_ON_BLACK
from amiwarp.imaging.tensors import latest_times
from amiwarp.imaging.votes import Votes
from amiwarp.plotting.film_frames import Shown
from amiwarp.reconstruction.picture_files import LIMITS_UPDATE

NEVER = -(2**62)
"""Time of the latest event of a pixel that has had none [us]."""

BRIGHT = 95.0
"""Percentile of the pixels with events whose count is brightest. Single hot pixels must not darken a sparse frame."""


class CountPainter:
    """Pictures of the numbers of OFF and ON events. Their brightness follows the events slowly, without flicker."""

    def __init__(self, size: tuple[int, int], device: Any) -> None:
        """Take the width and height of the sensor [px]."""
        self._votes = Votes(CanvasShape(*size, per_polarity=True), device)
        self._top: float | None = None

    def __call__(self, shown: Shown) -> NDArray[np.uint8]:
        """Return the picture of the events, shape ``(height, width, 3)``."""
        for start in range(0, len(shown.events), PIECE):
            self._votes.add_unmoved(shown.events[start : start + PIECE])
        counts = self._votes.take()
        top = brightest(counts, BRIGHT)
        if counts.any():
            if self._top is None:
                self._top = top
            else:
                self._top += LIMITS_UPDATE * (top - self._top)
        return to_picture(counts, Layers.POLARITY, top=self._top)


class SurfacePainter:
    """Pictures of the time surfaces of OFF and ON events. Each event is looked at once, however slowly it decays."""

    def __init__(self, size: tuple[int, int], decay_us: float, device: Any) -> None:
        """Take the width and height of the sensor [px], and the time constant of the decay [us]."""
        self._size = size
        self._decay_us = decay_us
        self._device = device
        width, height = size
        self._latest = np.full((2, height, width), NEVER, np.int64)

    def __call__(self, shown: Shown) -> NDArray[np.uint8]:
        """Return the picture after the events since the frame before, shape ``(height, width, 3)``."""
        if len(shown.events):
            latest = latest_times(shown.events, *self._size, device=self._device)
            np.maximum(self._latest, np.asarray(latest), out=self._latest)
        age = (shown.end_us - self._latest).astype(np.float32)
        off, on = np.exp(age / np.float32(-self._decay_us))
        rgb = np.clip(in_two_colours(off, on), 0.0, 1.0)
        return np.asarray(np.rint(rgb * 255.0), np.uint8)


FONT_SHARE = 1 / 50
FONT_SIZES = (11, 28)
"""Height of the font as a share of the picture's width, and its limits [px]."""
INK = (190, 190, 190)
"""Colour of the text."""


class Caption:
    """Line of text: time, event rate, length of a frame, and the colours of OFF and ON."""

    def __init__(self, width: int, first_us: int, decimals: int, note: str | None) -> None:
        """Take the width of the film [px], the time that is 0, the decimals of a time [s], and a text about frames.

        Without a text, it is the number of events of each frame.
        """
        from PIL import ImageFont

        low, high = FONT_SIZES
        self._space = min(max(round(width * FONT_SHARE), low), high)
        self._font = ImageFont.load_default(self._space)
        height = round(1.6 * self._space)
        self._shape = (height, width)
        self._first_us = first_us
        self._decimals = decimals
        self._note = note

    def parts(self, shown: Shown) -> list[tuple[str, tuple[int, ...]]]:
        """Return the texts of the line with their colours."""
        seconds = (shown.end_us - self._first_us) * 1e-6
        time = f"{seconds:.{self._decimals}f} s"
        rate = _rate(1e6 * shown.new / max(shown.length_us, 1))
        note = f"{len(shown.events):,} events" if self._note is None else self._note
        off = tuple(round(255 * part) for part in OFF_ON_BLACK)
        on = tuple(round(255 * part) for part in ON_ON_BLACK)
        return [(time, INK), (rate, INK), ("OFF", off), ("ON", on), (note, INK)]

    def __call__(self, shown: Shown) -> NDArray[np.uint8]:
        """Return the picture of the line, shape ``(height, width, 3)``. What does not fit is left out."""
        from PIL import Image, ImageDraw

        height, width = self._shape
        image = Image.new("RGB", (width, height))
        draw = ImageDraw.Draw(image)
        left = self._space / 2
        for text, colour in self.parts(shown):
            right = left + draw.textlength(text, font=self._font)
            if right > width:
                break
            draw.text((left, height / 2), text, fill=colour, font=self._font, anchor="lm")
            left = right + self._space
        return np.asarray(image)


def _rate(per_s: float) -> str:
    """Return a rate of events in words, with a unit in which it is not 0."""
    for unit, size in (("Mev/s", 1e6), ("kev/s", 1e3)):
        if per_s >= 0.1 * size:
            return f"{per_s / size:.2f} {unit}"
    return f"{per_s:.0f} ev/s"
