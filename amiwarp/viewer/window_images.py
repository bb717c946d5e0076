"""Images of the window: before and after compensation with their colour bars; the mouse draws a region on them."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from amiwarp.imaging.regions import Region
from amiwarp.plotting.colours import Scale
from amiwarp.viewer.drawing import ORBIT_COLOUR, ShownImages
from amiwarp.viewer.texts import LINE, text_width
from amiwarp.viewer.window_layout import NOWHERE, Rect
from amiwarp.viewer.window_paper import LINES, Paper

BAR_EM = 1.0
"""Width of a colour bar, in sizes of the font."""
SQUARE = 32
"""Width and height of the legend of two polarities [colours]."""
LEAST_REGION_PX = 4
"""Smallest width and height of a drawn region [px of the sensor]."""


def thinned(values: NDArray[np.float32], step: int) -> NDArray[np.float32]:
    """Return the largest values in squares of ``step`` pixels of an image, shape ``(..., height, width)``."""
    for axis in (-2, -1) if step > 1 else ():
        values = np.fmax.reduceat(values, range(0, values.shape[axis], step), axis=axis)
    return values


def value_text(value: NDArray[np.float32], scale: Scale) -> str:
    """Return the value of a pixel as text. ``value``: shape ``()``, or ``(2,)`` for OFF and ON."""
    if value.ndim:
        return f"{value[0]:g} OFF, {value[1]:g} ON"
    if not math.isfinite(float(value)):
        return scale.missing_text
    return f"{float(value):g} events" if scale.counts else f"{float(value):.4g} {scale.unit}"


class ImageRow:
    """Two images of one region side by side, or one."""

    def __init__(self, choose: Callable[[Region], None], changed: Callable[[], None]) -> None:
        """``choose``: shows a region that was drawn; ``changed``: draws the images again."""
        self._choose, self._changed = choose, changed
        self.images: ShownImages | None = None
        self.titles: tuple[str, ...] = ()
        self.region: Region = (0, 0, 1, 1)
        self.note = ""
        self.rect = NOWHERE
        self.frames: list[Rect] = []
        """Where the images are; what is around them is paper, unlike pixels without events."""
        self._shown: list[tuple[NDArray[np.float32], Scale]] = []
        self._drawn: dict[int, tuple[tuple[object, ...], NDArray[np.uint8]]] = {}
        self._bars: dict[Scale, NDArray[np.uint8]] = {}
        self._frame: Rect | None = None
        self._start: tuple[int, int] | None = None
        self._end: tuple[int, int] = (0, 0)
        self._under = ""  # what is under the mouse

    def pixel_at(self, place: tuple[int, int]) -> tuple[int, int] | None:
        """Return the pixel of the sensor under a place of the window; None outside of the images."""
        for frame in self.frames:
            if frame.holds(place):
                return self._pixel(frame, place)
        return None

    def _pixel(self, frame: Rect, place: tuple[int, int]) -> tuple[int, int]:
        """Return the pixel of an image's frame at a place, or the next one if the place is outside."""
        left, top, right, bottom = self.region
        x = left + math.floor((place[0] - frame.left) / frame.width * (right - left))
        y = top + math.floor((frame.top - place[1]) / frame.height * (bottom - top))
        return min(max(x, left), right - 1), min(max(y, top), bottom - 1)

    def press(self, place: tuple[int, int]) -> bool:
        """Begin a region if the mouse is on an image; return whether it is."""
        self._frame = next((frame for frame in self.frames if frame.holds(place)), None)
        if self._frame is None:
            return False
        self._start = self._end = self._pixel(self._frame, place)
        return True

    def drag(self, place: tuple[int, int]) -> None:
        """Follow the mouse with the other corner of the region."""
        assert self._frame is not None
        self._end = self._pixel(self._frame, place)
        self._changed()

    def release(self) -> None:
        """Show the drawn region, unless it is too small."""
        (left, top, right, bottom), self._start = self._drawn_region(), None
        if min(right - left, bottom - top) >= LEAST_REGION_PX:
            self._choose((left, top, right, bottom))
        self._changed()

    def _drawn_region(self) -> Region:
        assert self._start is not None
        (x0, x1), (y0, y1) = (sorted(pair) for pair in zip(self._start, self._end, strict=True))
        return x0, y0, x1 + 1, y1 + 1

    def hover(self, place: tuple[int, int]) -> bool:
        """Describe the pixel under the mouse; return whether the description has changed."""
        before, self._under, pixel = self._under, "", self.pixel_at(place)
        if pixel is not None:
            left, top, *_ = self.region
            values = [value_text(image[..., pixel[1] - top, pixel[0] - left], scale) for image, scale in self._shown]
            self._under = f"x {pixel[0]}, y {pixel[1]} px: {' → '.join(values)}"
        return self._under != before

    def draw(self, paper: Paper, rect: Rect) -> None:
        """Draw the images into a part of the window."""
        em, line = paper.font_px, LINE * paper.font_px
        self.rect, self.frames, self._shown = rect, [], []
        pair = self.images
        if pair is None:
            paper.text(self.note, rect.left + em, rect.top - line, up="top")
            return
        images = [(pair.before, pair.scale), (pair.after, pair.after_scale or pair.scale)][-len(self.titles) :]
        own = pair.after_scale is not None
        bars = len(images) if own else 1
        bar_width = BAR_EM * em + max(self._bar_space(scale, em) for _, scale in images)
        left, top, right, bottom = self.region
        high = rect.height - 2.6 * line
        wide = (rect.width - em * (1 + len(images)) - bars * bar_width) / len(images)
        share = min(wide / (right - left), high / (bottom - top))
        wide, high = (max(1.0, math.floor(share * n)) for n in (right - left, bottom - top))
        x, low = rect.left + em, rect.top - 1.3 * line - high
        for k, ((image, scale), title) in enumerate(zip(images, self.titles, strict=True)):
            frame = Rect(math.floor(x), math.floor(low), math.floor(x) + wide, math.floor(low) + high)
            paper.text(title, frame.left, rect.top, up="top")
            if image is None:
                paper.text("needs compensated events", frame.left, frame.top - em, up="top")
            else:
                paper.picture(self._rgb(k, image, scale, wide), frame)
                self.frames.append(frame)
                self._shown.append((image, scale))
            paper.frame(Rect(frame.left - 1, frame.low - 1, frame.right + 1, frame.top + 1))
            x = frame.right + em
            if own or k == len(images) - 1:
                self._draw_bar(paper, Rect(x, frame.low, x + BAR_EM * em, frame.top), scale)
                x += bar_width
        self._draw_region(paper)
        words = self._under or self.note or images[-1][1].label
        paper.text(words, rect.left + em, low - 0.4 * em, up="top")

    def _rgb(self, k: int, image: NDArray[np.float32], scale: Scale, wide: float) -> NDArray[np.uint8]:
        """Return the colours of an image, with about as many pixels as its place in the window."""
        step = max(1, math.floor(image.shape[-1] / wide))
        key = image, scale, step
        known, rgb = self._drawn.get(k, ((), np.zeros((1, 1, 3), np.uint8)))
        if len(known) != 3 or known[0] is not image or known[1:] != key[1:]:
            rgb = scale.rgb(thinned(image, step))
            self._drawn[k] = key, rgb
        return rgb

    def _bar_space(self, scale: Scale, em: float) -> float:
        """Return the width of the numbers of a colour bar, and of the gaps beside them [px]."""
        return (
            1.4 * em
            + max((text_width(text, em) for _, text in scale.ticks()), default=0.0)
            + (2.0 * em if scale.colours == "polarity" else 0.0)
        )

    def _draw_bar(self, paper: Paper, bar: Rect, scale: Scale) -> None:
        """Draw a colour bar with its numbers; for two polarities a square, OFF to the right and ON upwards."""
        em = paper.font_px
        if scale.colours == "polarity":
            values = scale.low + np.linspace(0.0, 1.0, SQUARE) ** (1.0 / scale.gamma) * (scale.high - scale.low)
            both = np.stack(np.broadcast_arrays(values, values[::-1, None])).astype(np.float32)
            square = Rect(bar.left, bar.top - 3.0 * em, bar.left + 3.0 * em, bar.top)
            paper.picture(self._bar_rgb(scale, both), square)
            paper.frame(square)
            for text, x, y, across, up in (
                (f"{scale.high:g} ON", square.right + 0.3 * em, square.top, "left", "top"),
                (f"{scale.high:g} OFF", square.left, square.low - 0.2 * em, "left", "top"),
            ):
                paper.text(text, x, y, across=across, up=up)
            return
        shares = np.linspace(1.0, 0.0, 128)[:, None] ** (1.0 / scale.gamma)
        paper.picture(self._bar_rgb(scale, scale.low + shares * (scale.high - scale.low)), bar)
        paper.frame(bar)
        for place, text in scale.ticks():
            y = bar.low + place * bar.height
            paper.line([(bar.right, y), (bar.right + 0.3 * em, y)])
            paper.text(text, bar.right + 0.5 * em, y)

    def _bar_rgb(self, scale: Scale, values: NDArray[np.floating]) -> NDArray[np.uint8]:
        """Return the colours of a bar, which stay the same array while the scale does."""
        if scale not in self._bars:
            self._bars = dict([*self._bars.items()][-1:]) | {scale: scale.rgb(values)}
        return self._bars[scale]

    def _draw_region(self, paper: Paper) -> None:
        if self._start is None:
            return
        left, top, right, bottom = self.region
        x0, y0, x1, y1 = self._drawn_region()
        for frame in self.frames:
            across, up = frame.width / (right - left), frame.height / (bottom - top)
            drawn = Rect(
                frame.left + (x0 - left) * across,
                frame.top - (y1 - top) * up,
                frame.left + (x1 - left) * across,
                frame.top - (y0 - top) * up,
            )
            paper.area(drawn, ORBIT_COLOUR, 0.3, LINES)
            paper.frame(drawn, ORBIT_COLOUR, 2.0)
