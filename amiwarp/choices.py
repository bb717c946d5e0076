"""Options with a fixed set of values, for images, pictures, event clouds and simulated worlds."""

import enum
from typing import NoReturn

from amiwarp.errors import AmiwarpError

OPTICAL_MODELS = ("circle", "exact", "radial", "ellipse", "risley", "plate", "mirror", "vibration")
"""Names of the optical models, for programs that do not load them."""


class Option(enum.StrEnum):
    """Base of options with a fixed set of values: a value that none of them has is answered with all of them."""

    @classmethod
    def _missing_(cls, value: object) -> NoReturn:
        raise AmiwarpError(f"{cls.__name__} is {value!r}; choose among {', '.join(cls)}")


class Optic(Option):
    """What moves the image of a simulated camera.

    Examples
    --------
    >>> Optic("plate")
    <Optic.PLATE: 'plate'>
    """

    WEDGE = "wedge"
    """Rotating wedge prism, which moves near and far points alike."""
    PLATE = "plate"
    """Rotating tilted plane-parallel plate, which moves near points only."""
    VIBRATION = "vibration"
    """No glass: the camera itself vibrates. Its recording has no encoder."""
    MIRROR = "mirror"
    """Mirror with two tilts; an encoder records the angles of its two commands."""


# Choices for images of warped events: how to vote, what to do with polarity, which sharpness to measure.


class Vote(Option):
    """How an event's vote is shared among pixels.

    Examples
    --------
    >>> amiwarp.Vote("nearest")
    <Vote.NEAREST: 'nearest'>
    """

    NEAREST = "nearest"
    """The whole vote goes to the nearest pixel."""
    BILINEAR = "bilinear"
    """The vote is shared among the four nearest pixels, by bilinear weights."""


class Layers(Option):
    """How polarity appears in an image of warped events.

    Examples
    --------
    >>> [layers.value for layers in amiwarp.Layers]
    ['merged', 'signed', 'polarity']
    """

    MERGED = "merged"
    """One image: number of events of both polarities, shape ``(height, width)``."""
    SIGNED = "signed"
    """One image: number of ON events minus number of OFF events, shape ``(height, width)``."""
    POLARITY = "polarity"
    """Two images: number of OFF events, then number of ON events, shape ``(2, height, width)``."""


class Sharpness(Option):
    """Sharpness measures of an image of warped events. For each of them, higher is sharper.

    Examples
    --------
    >>> amiwarp.Sharpness("variance")
    <Sharpness.VARIANCE: 'variance'>
    """

    VARIANCE = "variance"
    """Variance of the image of warped events divided by its mean: 1 for events at random pixels, higher where events
    gather."""
    GRADIENT = "gradient"
    """Mean squared gradient of the image of warped events, divided by the image's mean."""
    LAPLACIAN = "laplacian"
    """Mean squared Laplacian of the image of warped events, divided by the image's mean."""
    PAPER_J = "paper_j"
    """Minus the cost J of He et al., J = Σ 1/(1 + exp(h/η)) over pixels with h > 0 events. It fails as
    ``docs/explanation/calibration.md`` shows."""
    ENTROPY = "entropy"
    """Minus the entropy of the distribution of votes over pixels [nat]."""


class CornerMethod(Option):
    """Methods that find corners among events.

    Both look at the times of the latest events on two circles of pixels around an event.

    Examples
    --------
    >>> amiwarp.CornerMethod("arc")
    <CornerMethod.ARC: 'arc'>
    """

    EFAST = "efast"
    """eFAST: the newest pixels form an arc of 3 to 6 of the 16 pixels at radius 3, and of 4 to 8 of the 20 at
    radius 4."""
    ARC = "arc"
    """Arc*: as eFAST, or all pixels but such an arc are the newest. Redundant events are left out: those within 50 ms
    of the one before at their pixel, if both have the same polarity."""


class FilmMode(Option):
    """What the frames of a film of events show.

    Examples
    --------
    >>> amiwarp.FilmMode("surface")
    <FilmMode.SURFACE: 'surface'>
    """

    COUNTS = "counts"
    """Numbers of OFF and ON events per pixel."""
    SURFACE = "surface"
    """Time surface: how long ago the latest event was at each pixel, as an exponential decay."""


# Choices for reconstructed pictures: how to fill unknown parts, and how to display intensity.

CONTRAST = 0.25
"""Default value of the ON threshold [natural log intensity]."""


class Fill(Option):
    """How to fill the parts of a reconstructed picture that the events do not determine.

    Examples
    --------
    >>> [fill.value for fill in amiwarp.Fill]
    ['none', 'smooth', 'edge']
    """

    NONE = "none"
    """Undetermined parts stay NaN."""
    SMOOTH = "smooth"
    """Undetermined parts are interpolated smoothly from the determined parts around them (a membrane)."""
    EDGE = "edge"
    """Undetermined parts are interpolated by an edge-preserving prior: flat regions with sharp edges between them."""


class Tone(Option):
    """Mapping of intensity to pixel values."""

    MAPPED = "mapped"
    """Mapping for display: the 0.5th percentile of intensity is black, the 99.5th is white, with gamma 2.2."""
    LINEAR = "linear"
    """Mapping proportional to intensity: 0 is black, the 99.5th percentile is the largest pixel value."""


# Options of the event clouds: colour, third axis and view.


class Colour(Option):
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


class Axis(Option):
    """Quantity along the third axis of the event clouds, next to x and y."""

    ANGLE = "angle"
    TIME = "time"


class View(Option):
    """Direction from which the event clouds are viewed."""

    FREE = "free"
    XY = "x-y"
    X_AXIS = "x-θ"
    Y_AXIS = "y-θ"


# Options of simulations that have a fixed set of values.


class Seeing(Option):
    """Method by which the simulator computes the light that each pixel receives from a world."""

    MAPS = "maps"
    """Look up pre-rendered pictures of the world (maps), and blend two successive maps linearly in time.

    A map shows the world without the prism. A new map is rendered after the image has moved by half a pixel.
    """
    RAYS = "rays"
    """Cast rays from every pixel through the prism into the world at every time step: exact, but slow on a CPU."""
