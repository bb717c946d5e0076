"""Images of the window: before and after compensation with their colour bars; the mouse draws a region on them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from amiwarp.imaging.regions import Region
from amiwarp.plotting.colours import Scale
from amiwarp.viewer.images import ShownImages
from amiwarp.viewer.look import ORBIT_COLOUR
from amiwarp.viewer.page_state import polarity_square
from amiwarp.viewer.texts import LINE, fitting_font, text_width
from amiwarp.viewer.window_layout import Rect
from amiwarp.viewer.window_paper import LINES, Paper

BAR_EM = 1.0
LABEL_EM = 1.0
"""Width of a colour bar, and of its label, which is written upwards, in sizes of the font."""
LEAST_REGION_PX = 4
"""Smallest width and height of a drawn region [px of the sensor]."""


def thinned(values: NDArray[np.float32], step: int, *, signed: bool = False) -> NDArray[np.float32]:
    """Return the largest values in squares of ``step`` pixels of an image, shape ``(..., height, width)``.

    ``signed``: the values farthest from 0, of a difference.
    """
    if step == 1:
        return values
    height, width = values.shape[-2:]
    rows = np.fmax.reduceat(values, range(0, height, step), axis=-2)
    largest = np.fmax.reduceat(rows, range(0, width, step), axis=-1)
    if not signed:
        return largest
    smallest = -thinned(-values, step)
    return np.where(-smallest > largest, smallest, largest)


def value_text(value: NDArray[np.float32], scale: Scale) -> str:
    """Return the value of a pixel as text. ``value``: shape ``()``, or ``(2,)`` for OFF and ON."""
    if value.ndim:
        return f"{value[0]:g} OFF, {value[1]:g} ON"
    if not math.isfinite(float(value)):
        return scale.missing_text
    return f"{float(value):g} events" if scale.counts else f"{float(value):.4g} {scale.unit}"


def bar_label(scale: Scale) -> str:
    """Return the label of a colour bar, which says if its numbers are not at equal distances."""
    return f"{scale.label} (square root)" if scale.gamma == 0.5 else scale.label


@dataclass(frozen=True, eq=False)
class ImagePanel:
    """One image of the row."""

    title: str
    values: NDArray[np.float32] | None
    """Shape ``(height, width)``, or ``(2, height, width)`` for OFF and ON; None if there is no such image."""
    scale: Scale
    """How the values become colours."""
    region: Region
    """Part of the sensor that the image shows."""


def panels_of(images: ShownImages, titles: tuple[str, ...], region: Region) -> list[ImagePanel]:
    """Return the images of a region, from the second one backwards as many as there are titles."""
    after_scale = images.after_scale or images.scale
    both = [(images.before, images.scale), (images.after, after_scale)]
    shown = both[-len(titles) :]
    panels = []
    for title, (values, scale) in zip(titles, shown, strict=True):
        panels.append(ImagePanel(title, values, scale, region))
    return panels


class ImageRow:
    """Images side by side."""

    def __init__(self, choose: Callable[[Region], None], changed: Callable[[], None]) -> None:
        """``choose``: shows a region that was drawn; ``changed``: draws the images again."""
        self._choose = choose
        self._changed = changed
        self.panels: list[ImagePanel] = []
        self.note = ""
        """What limits the images, or why there are none."""
        self.region: Region = (0, 0, 1, 1)
        """Part of the sensor that the clouds show."""
        self.frames: list[Rect] = []
        """Where the images are; what is around them is paper, unlike pixels without events."""
        self._drawn: dict[int, tuple[NDArray[np.float32], Scale, int, NDArray[np.uint8]]] = {}
        self._bars: dict[Scale, NDArray[np.uint8]] = {}
        self._drawn_on = 0  # the image on which a region is drawn
        self._start: tuple[int, int] | None = None
        self._end: tuple[int, int] = (0, 0)
        self._mouse = -1, -1  # where the mouse was last
        self._under = ""  # what is under the mouse

    def pixel_at(self, place: tuple[int, int]) -> tuple[int, tuple[int, int]] | None:
        """Return the number of the image at a place of the window, and the pixel of the sensor; None beside them."""
        for k, frame in enumerate(self.frames):
            if frame.holds(place) and self.panels[k].values is not None:
                return k, self._pixel(k, place)
        return None

    def _pixel(self, k: int, place: tuple[int, int]) -> tuple[int, int]:
        """Return the pixel of an image at a place, or the next one if the place is outside."""
        frame = self.frames[k]
        left, top, right, bottom = self.panels[k].region
        x = left + math.floor((place[0] - frame.left) / frame.width * (right - left))
        y = top + math.floor((frame.top - place[1]) / frame.height * (bottom - top))
        return min(max(x, left), right - 1), min(max(y, top), bottom - 1)

    def press(self, place: tuple[int, int]) -> bool:
        """Begin a region if the mouse is on an image; return whether it is."""
        found = self.pixel_at(place)
        if found is None:
            return False
        self._mouse = place
        self._drawn_on, self._start = found
        self._end = self._start
        return True

    def drag(self, place: tuple[int, int]) -> None:
        """Follow the mouse with the other corner of the region."""
        self._mouse = place
        if self._drawn_on >= len(self.frames):  # the images have changed meanwhile
            self._start = None
        if self._start is None:
            return
        self._end = self._pixel(self._drawn_on, place)
        self._changed()

    def release(self) -> None:
        """Show the drawn region, unless it is too small."""
        if self._start is None:
            return
        left, top, right, bottom = self._drawn_region()
        self._start = None
        if min(right - left, bottom - top) >= LEAST_REGION_PX:
            self._choose((left, top, right, bottom))
        self._changed()

    def _region_text(self) -> str:
        """Return the region that is being drawn as text; empty without one."""
        if self._start is None:
            return ""
        left, top, right, bottom = self._drawn_region()
        return f"x {left} to {right}, y {top} to {bottom} px"

    def _drawn_region(self) -> Region:
        assert self._start is not None
        left, right = sorted((self._start[0], self._end[0]))
        top, bottom = sorted((self._start[1], self._end[1]))
        return left, top, right + 1, bottom + 1

    def hover(self, place: tuple[int, int]) -> bool:
        """Describe the pixel under the mouse; return whether the description has changed."""
        before = self._under
        self._mouse = place
        self._read()
        return self._under != before

    def _read(self) -> None:
        """Describe the pixel that is under the mouse now: the images may have changed since it moved."""
        self._under = ""
        found = self.pixel_at(self._mouse)
        if found is None:
            return
        k, (x, y) = found
        region = self.panels[k].region
        left, top, *_ = region
        texts = []
        for panel in self.panels:
            if panel.region == region and panel.values is not None:
                value = panel.values[..., y - top, x - left]
                texts.append(value_text(value, panel.scale))
        self._under = f"x {x}, y {y} px: {' → '.join(texts)}"

    def draw(self, paper: Paper, rect: Rect) -> None:
        """Draw the images into a part of the window."""
        em = paper.font_px
        line = LINE * paper.font_px
        self.frames = []
        left = rect.left + em
        wide = self._width_of_each(rect, em)
        for k, panel in enumerate(self.panels):
            frame = self._frame_of(panel, rect, left, wide, line)
            self.frames.append(frame)
            paper.text(panel.title, frame.left, rect.top, up="top")
            if panel.values is None:
                paper.text("needs compensated events", frame.left, frame.top - em, up="top")
            else:
                paper.picture(self._rgb(k, panel, frame.width), frame)
            paper.frame(Rect(frame.left - 1, frame.low - 1, frame.right + 1, frame.top + 1))
            left = frame.right + em
            if self._has_bar(k):
                bar = Rect(left, frame.low, left + BAR_EM * em, frame.top)
                self._draw_bar(paper, bar, panel.scale)
                left += BAR_EM * em + self._bar_space(panel.scale, em)
                label = bar_label(panel.scale)
                size = fitting_font(label, frame.height, em)
                paper.text(label, left - LABEL_EM * em, frame.low, font_px=size, upwards=True)
        self._draw_regions(paper)

        # Below the images: what is drawn or under the mouse, or a note
        self._read()
        words = self._region_text() or self._under or self.note
        lowest = min((frame.low for frame in self.frames), default=rect.low + 1.3 * line)
        below = max(rect.low + 1.1 * line, lowest)
        paper.text(words, rect.left + em, below - 0.4 * em, up="top")

    @staticmethod
    def _frame_of(panel: ImagePanel, rect: Rect, left: float, wide: float, line: float) -> Rect:
        """Return the place of an image, as large as the room for it allows, below a line for its title.

        ``left``: where it begins; ``wide``: width that there is for it; ``line``: height of a line of text [px].
        """
        region_left, region_top, region_right, region_bottom = panel.region
        columns = region_right - region_left
        rows = region_bottom - region_top
        high = rect.height - 2.6 * line
        scale = min(wide / columns, high / rows)
        width = max(1, math.floor(scale * columns))
        height = max(1, math.floor(scale * rows))
        left_px = math.floor(left)
        low_px = math.floor(rect.top - 1.3 * line - height)
        return Rect(left_px, low_px, left_px + width, low_px + height)

    def _has_bar(self, k: int) -> bool:
        """Return whether an image has a colour bar of its own: the last one of each scale."""
        return k + 1 == len(self.panels) or self.panels[k].scale != self.panels[k + 1].scale

    def _width_of_each(self, rect: Rect, em: int) -> float:
        """Return the width that there is for each image [px]."""
        count = len(self.panels)
        bars = [self.panels[k].scale for k in range(count) if self._has_bar(k)]
        bars_px = sum(BAR_EM * em + self._bar_space(scale, em) for scale in bars)
        return max(1.0, (rect.width - em * (1 + count) - bars_px) / max(count, 1))

    def _rgb(self, k: int, panel: ImagePanel, width: float) -> NDArray[np.uint8]:
        """Return the colours of an image, with about as many pixels as its place in the window."""
        assert panel.values is not None
        step = max(1, math.floor(panel.values.shape[-1] / width))
        if k in self._drawn:
            values, scale, known_step, rgb = self._drawn[k]
            if values is panel.values and (scale, known_step) == (panel.scale, step):
                return rgb
        rgb = panel.scale.rgb(
            thinned(panel.values, step, signed=panel.scale.colours == "difference")
        )
        self._drawn[k] = (panel.values, panel.scale, step, rgb)
        return rgb

    def _bar_space(self, scale: Scale, em: int) -> float:
        """Return the width of the numbers and the label of a colour bar, and of the gaps beside them [px]."""
        numbers = max((text_width(text, em) for _, text in scale.ticks()), default=0.0)
        space = (1.4 + LABEL_EM) * em + numbers
        if scale.colours == "polarity":  # the square is wider than a bar
            space += 3.5 * em
        return space

    def _draw_bar(self, paper: Paper, bar: Rect, scale: Scale) -> None:
        """Draw a colour bar with its numbers; for two polarities a square, OFF to the right and ON upwards."""
        em = paper.font_px
        if scale.colours == "polarity":
            both = polarity_square(scale).astype(np.float32)
            square = Rect(bar.left, bar.top - 3.0 * em, bar.left + 3.0 * em, bar.top)
            paper.picture(self._bar_rgb(scale, both), square)
            paper.frame(square)
            most = f"{scale.high:g}"
            paper.text(f"{most} ON", square.right + 0.3 * em, square.top, across="left", up="top")
            paper.text(f"{most} OFF", square.left, square.low - 0.2 * em, across="left", up="top")
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
            last = list(self._bars.items())[-1:]  # there are two scales at most
            self._bars = dict(last) | {scale: scale.rgb(values)}
        return self._bars[scale]

    def _draw_regions(self, paper: Paper) -> None:
        """Draw the region that the mouse draws, and on images of a larger part the frame of the shown one."""
        for frame, panel in zip(self.frames, self.panels, strict=True):
            if panel.region != self.region:
                paper.frame(self._on_image(frame, panel.region, self.region), ORBIT_COLOUR, 2.0)
            if self._start is None or self._drawn_on >= len(self.panels):
                continue
            if panel.region == self.panels[self._drawn_on].region:
                drawn = self._on_image(frame, panel.region, self._drawn_region())
                paper.area(drawn, ORBIT_COLOUR, 0.3, LINES)
                paper.frame(drawn, ORBIT_COLOUR, 2.0)

    @staticmethod
    def _on_image(frame: Rect, shown: Region, region: Region) -> Rect:
        """Return where a region is on the image of another one."""
        shown_left, shown_top, shown_right, shown_bottom = shown
        left, top, right, bottom = region
        across = frame.width / (shown_right - shown_left)
        up = frame.height / (shown_bottom - shown_top)
        return Rect(
            frame.left + (left - shown_left) * across,
            frame.top - (bottom - shown_top) * up,
            frame.left + (right - shown_left) * across,
            frame.top - (top - shown_top) * up,
        )
