"""Choices for simulated worlds."""

import enum


class Seeing(enum.StrEnum):
    """How the pixels see a world."""

    MAPS = "maps"
    """Pictures of the world without the prism, rendered whenever it has moved by half a pixel, and blended between."""
    RAYS = "rays"
    """Rays through the prism into the world, for every pixel and step: exact, and slow on a CPU."""
