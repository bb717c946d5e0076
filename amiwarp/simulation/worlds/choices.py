"""Options of simulated worlds that have a fixed set of values."""

import enum


class Seeing(enum.StrEnum):
    """Method by which the simulator computes the light that each pixel receives from a world."""

    MAPS = "maps"
    """Look up pre-rendered pictures of the world (maps), and blend two successive maps linearly in time.

    A map shows the world without the prism. A new map is rendered after the image has moved by half a pixel.
    """
    RAYS = "rays"
    """Cast rays from every pixel through the prism into the world at every time step: exact, but slow on a CPU."""
