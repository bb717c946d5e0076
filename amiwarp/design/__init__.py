"""The choice of prism and speed for a camera, before either is bought."""

from amiwarp.design.choose import Choice, Design, Limits, Timing, design
from amiwarp.design.orbit import Orbit
from amiwarp.design.volume import Volume

__all__ = ["Choice", "Design", "Limits", "Orbit", "Timing", "Volume", "design"]
