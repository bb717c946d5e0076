"""Choices for images of warped events: how to vote, what to do with polarity, which sharpness to measure."""

import enum


class Vote(enum.StrEnum):
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


class Layers(enum.StrEnum):
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


class Sharpness(enum.StrEnum):
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


class CornerMethod(enum.StrEnum):
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
