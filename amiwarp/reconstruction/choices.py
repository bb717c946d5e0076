"""Choices for reconstructed pictures: how to fill unknown parts, and how to display intensity."""

import enum

CONTRAST = 0.25
"""Default ON threshold [log intensity]."""


class Fill(enum.StrEnum):
    """How to fill the parts of a picture that the events do not determine.

    Examples
    --------
    >>> [fill.value for fill in amiwarp.Fill]
    ['none', 'smooth', 'edge']
    """

    NONE = "none"
    """Leave them NaN."""
    SMOOTH = "smooth"
    """Interpolate smoothly from the known parts around (a membrane)."""
    EDGE = "edge"
    """The same with an edge-preserving prior: flat regions with sharp edges between them."""


class Tone(enum.StrEnum):
    """How intensity becomes a pixel value."""

    MAPPED = "mapped"
    """For display: the 0.5th percentile of intensity is black, the 99.5th is white, with gamma 2.2."""
    LINEAR = "linear"
    """Proportional to intensity: 0 is dark, the 99.5th percentile is the largest value."""
