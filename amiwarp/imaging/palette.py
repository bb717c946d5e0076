"""Colours of all figures, point clouds and images, distinguishable with all common kinds of colour vision deficiency.

Most are the colours of Okabe and Ito, "Color Universal Design", 2008.
"""

BLACK = "#000000"
BLUE = "#0072b2"
GREEN = "#009e73"
ORANGE = "#e69f00"
PINK = "#cc79a7"
SKY_BLUE = "#56b4e9"
VERMILION = "#d55e00"

MODEL_COLOURS = (ORANGE, GREEN, BLUE, VERMILION, PINK, SKY_BLUE)
"""Colours of the optical models in figures: of the approximations, then of the model that they approximate."""

OFF_COLOUR = BLUE
ON_COLOUR = VERMILION
"""Colours of OFF and ON events on a light ground."""
OFF_ON_BLACK = (0.20, 0.55, 1.00)
ON_ON_BLACK = (1.00, 0.55, 0.10)
"""Colours of OFF and ON events on a black ground, as RGB from 0 to 1. The colours for a light ground would be too dark.
"""
