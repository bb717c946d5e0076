"""Style in which event clouds are drawn: what their colours and their third axis show, and the directions of view."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from amiwarp.choices import Axis, Colour, View
from amiwarp.validation import choice

BACKGROUND_AND_INK = {False: ("white", "#333333"), True: ("#15181c", "#d8d8d8")}
"""Colours of background and lines, for light (False) and dark (True) mode."""
CAMERA_DIRECTIONS = {
    View.FREE: ((1.0, -1.35, 0.75), (0.0, 0.0, 1.0)),
    View.XY: ((0.0, 0.0, 1.0), (0.0, 1.0, 0.0)),
    View.X_THIRD: ((0.0, -1.0, 0.0), (0.0, 0.0, 1.0)),
    View.Y_THIRD: ((-1.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
}
"""Direction from the clouds to the camera, and the upward direction, for each view."""
PICTURE_PX = (1400, 620)
"""Default width and height of a picture of the clouds [px]."""
ORBIT_COLOUR = "#009e73"
"""Colour of the model's orbit, as on the page."""


@dataclass(frozen=True)
class Look:
    """Style in which the event clouds are drawn."""

    colour: Colour = Colour.POLARITY
    """Quantity that the points' colour shows."""
    axis: Axis = Axis.ANGLE
    """Quantity along the third axis: prism angle or time."""
    point_size: float = 2.0
    """Diameter of the points in the picture [px]. In the view along the third axis, 2 is the size of the pixels."""
    opacity: float = 1.0
    """Opacity of the points, 0 to 1."""
    dark: bool = False
    """Whether the background is dark."""
    overlaid: bool = False
    """Whether both clouds are drawn in one frame, with the first one in grey."""
    titles: tuple[str, ...] = ("as recorded", "compensated")
    """Titles of the clouds. With a single title, only the second cloud is drawn."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "colour", choice(Colour, self.colour, "colour"))
        object.__setattr__(self, "axis", choice(Axis, self.axis, "axis"))

    def for_clouds(self, titles: Sequence[str]) -> Look:
        """Return the look for clouds with these titles. A single cloud gets the whole picture."""
        return replace(self, titles=tuple(titles), overlaid=self.overlaid or len(titles) == 1)
