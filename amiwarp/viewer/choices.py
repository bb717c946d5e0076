"""The closed sets of choices for the clouds."""

import enum


class Colour(enum.StrEnum):
    """What a point's colour tells."""

    POLARITY = "polarity"
    ANGLE = "angle"
    TIME = "time"
    DENSITY = "density"
    """Events in the pixel where it lies, up to the 99th percentile."""
    RESIDUAL = "residual"
    """Distance from the middle of the events about it, up to 2 px: of an edge, from its crest."""


class Axis(enum.StrEnum):
    """The third axis."""

    ANGLE = "angle"
    TIME = "time"


class View(enum.StrEnum):
    """Where the camera stands."""

    FREE = "free"
    XY = "x-y"
    X_AXIS = "x-θ"
    Y_AXIS = "y-θ"
