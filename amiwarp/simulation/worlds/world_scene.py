"""A world and the camera's way through it, as the scene of a simulation."""

from __future__ import annotations

from dataclasses import dataclass

from amiwarp.simulation.worlds.choices import Seeing
from amiwarp.simulation.worlds.scene import World
from amiwarp.simulation.worlds.trajectory import Trajectory
from amiwarp.validation import choice, instance, one_of, real

SAMPLES = (1, 4, 9, 16)
"""Numbers of rays a pixel, or a texel, that can be chosen."""


@dataclass(frozen=True, eq=False)
class WorldScene:
    """What a camera sees on its way through a world; takes the place of :class:`amiwarp.Scene`."""

    world: World
    """The world."""
    trajectory: Trajectory
    """The camera's pose over time."""
    blur: float = 0.5
    """Standard deviation of the optical blur, the pixel's aperture included [px]; a single ray a pixel has none."""
    seeing: Seeing = Seeing.MAPS
    """How the pixels see the world."""
    samples: int | None = None
    """Rays a texel (maps) or a pixel (rays): 1, 4, 9 or 16; None for 4."""
    motion_px: float = 0.5
    """Largest motion between two maps [px]."""

    def __post_init__(self) -> None:
        instance(self.world, World, "world scene's world")
        instance(self.trajectory, Trajectory, "world scene's trajectory")
        object.__setattr__(self, "blur", real(self.blur, "scene blur", 0.0, 20.0, " px"))
        object.__setattr__(self, "seeing", choice(Seeing, self.seeing, "seeing"))
        object.__setattr__(self, "motion_px", real(self.motion_px, "motion_px", 0.01, 2.0, " px"))
        if self.samples is not None:
            one_of(str(self.samples), [str(n) for n in SAMPLES], "samples")
