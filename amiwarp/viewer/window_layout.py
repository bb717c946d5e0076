"""Where the parts of the window are, and how large its texts are, for any size of the window."""

from __future__ import annotations

from dataclasses import dataclass

LARGEST = (1500, 950)
FRAME_PX = (0, 70)
"""Largest size of the window at the start, and what the desktop needs of the screen for title and panel [px]."""
FONT_PX = 12
FONT_ENDS = (10, 30)
"""Size of the texts in a window of :data:`LARGEST`, and their smallest and largest size [px]."""
COLUMN_SHARE = 0.2
COLUMN_EM = 19
"""Width of the column with the sliders: share of the window, and smallest number of sizes of the font."""
STRIP_SHARE = 0.29
STRIP_EM = 14
"""Height of images and charts: share of the window, and smallest number of sizes of the font."""
TIMELINE_EM = 6.5
SIDE_EM = 22
SLIDER_EM = 3.9
"""Height of the timeline, width of the statistics, and distance of the sliders, in sizes of the font."""
CHARTS_SHARE = 0.42
"""Width of the charts, as a share of what is right of the column."""


@dataclass(frozen=True)
class Rect:
    """Part of the window, in pixels from its left and its lower side."""

    left: float
    low: float
    right: float
    top: float

    @property
    def width(self) -> float:
        """Width [px]."""
        return self.right - self.left

    @property
    def height(self) -> float:
        """Height [px]."""
        return self.top - self.low

    def holds(self, place: tuple[float, float]) -> bool:
        """Return whether a place is in it."""
        return self.left <= place[0] < self.right and self.low <= place[1] < self.top

    def inset(self, left: float, low: float, right: float, top: float) -> Rect:
        """Return what is left without a margin on each side [px]. It has at least one pixel."""
        x, y = self.left + left, self.low + low
        return Rect(x, y, max(self.right - right, x + 1.0), max(self.top - top, y + 1.0))

    def shares(self, size: tuple[int, int]) -> tuple[float, float, float, float]:
        """Return left, low, right and top in shares of a window's size."""
        width, height = size
        return self.left / width, self.low / height, self.right / width, self.top / height


NOWHERE = Rect(0, 0, 1, 1)
"""Place of a part before the first drawing."""


@dataclass(frozen=True)
class Places:
    """Parts of the window."""

    size: tuple[int, int]
    """Width and height of the window [px]."""
    font_px: int
    """Size of the texts [px]."""
    column: Rect
    """Texts and sliders."""
    clouds: Rect
    """Event clouds with their legend and caption."""
    strip: Rect
    """Images, charts and timeline, which the next three are."""
    images: Rect
    charts: Rect
    timeline: Rect
    side: Rect
    """Statistics: right of the clouds, or instead of the charts that a recording without a prism does not have."""


def first_size(screen: tuple[int, int]) -> tuple[int, int]:
    """Return the size of the window at the start, for a screen of a size [px]: the largest that fits."""
    screen_width, screen_height = screen
    largest_width, largest_height = LARGEST
    frame_width, frame_height = FRAME_PX
    width = min(largest_width, screen_width - frame_width)
    height = min(largest_height, screen_height - frame_height)
    return width, height


def places(size: tuple[int, int], *, compensates: bool, statistics: bool) -> Places:
    """Return the parts of a window of a size [px].

    ``compensates``: whether there is a motion to compensate, so that there are charts; ``statistics``: whether there
    are statistics.
    """
    width, height = size
    share = min(width / LARGEST[0], height / LARGEST[1])
    font_px = min(max(round(FONT_PX * share), FONT_ENDS[0]), FONT_ENDS[1])
    column = max(COLUMN_SHARE * width, COLUMN_EM * font_px)
    right = width - (SIDE_EM * font_px if compensates and statistics else 0.0)
    time_top = TIMELINE_EM * font_px
    strip_top = time_top + max(STRIP_SHARE * height, STRIP_EM * font_px)
    middle = width - CHARTS_SHARE * (width - column) if compensates or statistics else width
    charts = Rect(middle, time_top, width, strip_top)
    return Places(
        size,
        font_px,
        Rect(0, 0, column, height),
        Rect(column, strip_top, right, height),
        Rect(column, 0, width, strip_top),
        Rect(column, time_top, middle, strip_top),
        charts,
        Rect(column, 0, width, time_top),
        Rect(right, strip_top, width, height) if compensates else charts,
    )
