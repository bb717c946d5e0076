"""Choices for reconstructed pictures: how to fill unknown parts, and how to display intensity."""

import enum

CONTRAST = 0.25
"""Default value of the ON threshold [natural log intensity]."""


class Fill(enum.StrEnum):
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


class Tone(enum.StrEnum):
    """Mapping of intensity to pixel values."""

    MAPPED = "mapped"
    """Mapping for display: the 0.5th percentile of intensity is black, the 99.5th is white, with gamma 2.2."""
    LINEAR = "linear"
    """Mapping proportional to intensity: 0 is black, the 99.5th percentile is the largest pixel value."""
