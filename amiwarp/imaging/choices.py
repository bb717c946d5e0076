"""The closed sets of choices for images of warped events."""

import enum


class Vote(enum.StrEnum):
    """How an event's vote is shared among pixels."""

    NEAREST = "nearest"
    BILINEAR = "bilinear"


class Layers(enum.StrEnum):
    """What becomes of polarity."""

    MERGED = "merged"
    """All events count alike: (height, width)."""
    SIGNED = "signed"
    """ON minus OFF: (height, width)."""
    POLARITY = "polarity"
    """OFF, then ON: (2, height, width)."""


class Sharpness(enum.StrEnum):
    """What is measured; higher is sharper for each."""

    VARIANCE = "variance"
    """Variance over mean: 1 for events scattered at random, more where they gather."""
    GRADIENT = "gradient"
    """Mean squared gradient over mean."""
    LAPLACIAN = "laplacian"
    """Mean squared Laplacian over mean."""
    PAPER_J = "paper_j"
    """Minus He et al.'s J = Σ over h > 0 of 1/(1 + exp(h/η)); ``docs/calibration.md`` says where it fails."""
    ENTROPY = "entropy"
    """Minus the entropy of the votes' distribution over pixels [nat]."""
