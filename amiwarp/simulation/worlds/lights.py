"""Light in a simulated world: the sun, lamps, and the sky behind all bodies."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.schema.calls import guarded
from amiwarp.simulation.worlds.colours import checked_colour
from amiwarp.validation import array, real, vector

if TYPE_CHECKING:
    pass


@guarded
@dataclass(frozen=True, slots=True)
class Sun:
    """Distant light source, whose light comes from one direction everywhere."""

    direction: tuple[float, float, float]
    """Vector towards the sun in the world's frame. The length has no effect."""
    intensity: float = 0.6
    """Luminance that the sun gives to a white surface that faces the sun."""
    shadows: bool = True
    """Whether bodies cast shadows in this light."""

    def __post_init__(self) -> None:
        direction = vector(self.direction, 3, "sun direction", real)
        length = math.hypot(*direction)
        if not 0.0 < length < math.inf:
            raise AmiwarpError(
                f"sun direction has length {length:.3g}; give the direction towards the sun"
            )
        object.__setattr__(self, "direction", tuple(float(x) / length for x in direction))
        object.__setattr__(self, "intensity", real(self.intensity, "sun intensity", 0.0, 1e6))


@guarded
@dataclass(frozen=True, slots=True)
class Lamp:
    """Point light source."""

    position: tuple[float, float, float]
    """Position in the world's frame [m]."""
    intensity: float = 1.0
    """Luminance that the lamp gives to a white surface that faces the lamp at a distance of 1 m."""
    flicker_hz: float = 0.0
    """Frequency of the flicker [1/s]; 0 for steady light.

    A lamp on alternating current flickers at twice the frequency of the current.
    """
    flicker_depth: float = 1.0
    """Amplitude of the flicker as a fraction of the intensity, 0 to 1."""
    shadows: bool = False
    """Whether bodies cast shadows in this light."""

    def __post_init__(self) -> None:
        object.__setattr__(
            self,
            "position",
            tuple(float(x) for x in vector(self.position, 3, "lamp position", real)),
        )
        for name, high in (("intensity", 1e6), ("flicker_hz", 1e4), ("flicker_depth", 1.0)):
            object.__setattr__(self, name, real(getattr(self, name), f"lamp {name}", 0.0, high))


@guarded
@dataclass(frozen=True, eq=False)
class Sky:
    """Background at infinity, which is seen where no body is."""

    luminance: float = 0.6
    """Luminance of an even sky, or factor by which the panorama is multiplied."""
    panorama: NDArray[Any] | None = None
    """Linear luminance in all directions, shape (height, width); None for an even sky.

    The picture is equirectangular with the elevation up: width and height cover 360 and 180 degrees, whatever their
    ratio. Its middle column shows the direction +x, its right half -y.
    """
    colour: ArrayLike | None = None
    """Linear red, green and blue relative to the luminance, shape ``(3,)``, or ``(height, width, 3)`` for each texel of
    the panorama, as :attr:`Material.colour`. None stands for grey."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "luminance", real(self.luminance, "sky luminance", 0.0, 1e6))
        if self.panorama is not None:
            with np.errstate(over="ignore"):  # infinity is refused
                panorama = array(self.panorama, "sky panorama").astype(np.float32)
            if (
                panorama.ndim != 2
                or min(panorama.shape) < 2
                or not (np.isfinite(panorama).all() and panorama.min() >= 0)
            ):
                raise AmiwarpError(
                    f"sky panorama has shape {panorama.shape}; give values >= 0, (height, width)"
                )
            object.__setattr__(self, "panorama", panorama)
        if self.colour is not None:
            shapes: tuple[tuple[int, ...], ...] = ((3,),)
            if self.panorama is not None:
                shapes = (*shapes, (*self.panorama.shape, 3))
            colour = checked_colour(self.colour, shapes, "sky colour")
            object.__setattr__(self, "colour", colour)
