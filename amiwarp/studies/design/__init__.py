"""Design study: choice of a prism and its speed for a camera, before either is bought."""

from amiwarp.studies.design.choice import Choice, Design, Limits, Timing, design
from amiwarp.studies.design.event_volume import Volume
from amiwarp.studies.design.orbit_size import Orbit

__all__ = ["Choice", "Design", "Limits", "Orbit", "Timing", "Volume", "design"]
