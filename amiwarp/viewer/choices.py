"""Options of the event clouds: colour, third axis and view."""

import enum


class Colour(enum.StrEnum):
    """Quantity that the colour of a point shows."""

    POLARITY = "polarity"
    ANGLE = "angle"
    TIME = "time"
    DENSITY = "density"
    """Number of events in the point's pixel; the scale ends at the 99th percentile."""
    RESIDUAL = "residual"
    """Distance from the centre of the neighbouring events, up to 2 px; for an edge, the distance from its crest."""
    CAUSE = "cause"
    """Cause of the event, from the ground truth of a simulation."""
    INSTANCE = "instance"
    """Instance of a simulated world that the event saw, from the ground truth."""
    DEPTH = "depth"
    """Depth of what the event saw in a simulated world [m], from the ground truth; the scale is logarithmic."""


class Axis(enum.StrEnum):
    """Third axis of the clouds, next to x and y."""

    ANGLE = "angle"
    TIME = "time"


class View(enum.StrEnum):
    """Direction of view."""

    FREE = "free"
    XY = "x-y"
    X_AXIS = "x-θ"
    Y_AXIS = "y-θ"
