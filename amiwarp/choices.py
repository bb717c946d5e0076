"""Options with a fixed set of values that several rooms, or commands and settings, use.

In this order: optical models, images of warped events, costs of a search, corners, films, reconstructed pictures, event
clouds. An option of one room is in the room, such as `amiwarp/simulation/choices.py`.
"""

from amiwarp.errors import Option

OPTICAL_MODELS = (
    "circle",
    "exact",
    "radial",
    "ellipse",
    "risley",
    "plate",
    "steerer",
    "mirror",
    "vibration",
)
"""Names of the optical models, for programs that do not load them."""


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


class SearchCost(Option):
    """What the search of a calibration optimises.

    Examples
    --------
    >>> amiwarp.SearchCost("phase")
    <SearchCost.PHASE: 'phase'>
    """

    SHARPNESS = "sharpness"
    """Sharpness of the image of warped events: every evaluation moves the events."""
    PHASE = "phase"
    """Share of the sums of events in phase with the prism that no scene explains. The events are summed once; see
    ``docs/explanation/phase.md``."""


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


CONTRAST = 0.25
"""Default value of the ON threshold [natural log intensity]."""


class PictureMethod(Option):
    """How a picture of the scene is made from events.

    Examples
    --------
    >>> [method.value for method in PictureMethod]
    ['solver', 'phase', 'auto']
    """

    SOLVER = "solver"
    """Least squares over the pairs of consecutive events of each pixel."""
    PHASE = "phase"
    """Sums of each pixel's events in phase with the optic, in closed form: over whole turns of a still scene."""
    AUTO = "auto"
    """Sums in phase where optic, camera and window allow them, else the solver."""


class DepthMethod(Option):
    """How depths are found from a camera at rest behind a rotating tilted plate.

    Examples
    --------
    >>> [method.value for method in amiwarp.DepthMethod]
    ['photometric', 'phase']
    """

    PHOTOMETRIC = "photometric"
    """One brightness map of the scene for each depth that is tried, and the costs of each pixel's pairs of events."""
    PHASE = "phase"
    """Sums of each pixel's events in phase with the plate, and the costs of orbits of tiles: faster and coarser."""


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
    """From a corner: all three axes are seen."""
    XY = "x-y"
    """Along the third axis: the image."""
    X_THIRD = "x-θ"
    """Along y: x and the third axis, which may also be the time."""
    Y_THIRD = "y-θ"
    """Along x: y and the third axis."""
