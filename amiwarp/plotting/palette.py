"""Colours of all figures and point clouds, distinguishable with all common kinds of colour vision deficiency.

Most are the colours of Okabe and Ito, "Color Universal Design", 2008.
"""

from amiwarp.imaging.export import OFF_COLOUR, ON_COLOUR

BLACK = "#000000"
BLUE = "#0072b2"
GREEN = "#009e73"
ORANGE = "#e69f00"
PINK = "#cc79a7"
SKY_BLUE = "#56b4e9"
VERMILION = "#d55e00"

__all__ = ["BLACK", "BLUE", "GREEN", "OFF_COLOUR", "ON_COLOUR", "ORANGE", "PINK", "SKY_BLUE", "VERMILION"]
