"""The closed sets of choices for reconstructed pictures."""

import enum

CONTRAST = 0.25
"""ON threshold where none is given [log intensity]."""


class Fill(enum.StrEnum):
    """What stands where the events say nothing."""

    NONE = "none"
    """Nothing: NaN."""
    SMOOTH = "smooth"
    """The membrane through what is known around it."""
    EDGE = "edge"
    """The same, but that it breaks rather than bends: flat parts with edges between them."""


class Tone(enum.StrEnum):
    """How intensity becomes a pixel's value."""

    MAPPED = "mapped"
    """For the eye: the 0.5th percentile of intensity is black, the 99.5th white, with gamma 2.2."""
    LINEAR = "linear"
    """Proportional to intensity: 0 is dark, the 99.5th percentile the largest value."""
