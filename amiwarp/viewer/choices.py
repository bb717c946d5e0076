"""Options of the event clouds: colour, third axis and view."""

import enum


class Colour(enum.StrEnum):
    """Quantity that the colour of a point in the event clouds shows."""

    POLARITY = "polarity"
    ANGLE = "angle"
    TIME = "time"
    DENSITY = "density"
    """Number of events in the point's pixel; the scale ends at the 99th percentile."""
    RESIDUAL = "residual"
    """Width of the edge on which an event lies, up to 6 px. It falls when the calibration gets better."""
    CAUSE = "cause"
    """Cause of the event, from the ground truth of a simulation."""
    INSTANCE = "instance"
    """Instance of a simulated world that the event saw, from the ground truth."""
    DEPTH = "depth"
    """Depth of the surface that the event saw in a simulated world [m], from the ground truth; logarithmic scale."""


class Axis(enum.StrEnum):
    """Quantity along the third axis of the event clouds, next to x and y."""

    ANGLE = "angle"
    TIME = "time"


class View(enum.StrEnum):
    """Direction from which the event clouds are viewed."""

    FREE = "free"
    XY = "x-y"
    X_AXIS = "x-θ"
    Y_AXIS = "y-θ"
