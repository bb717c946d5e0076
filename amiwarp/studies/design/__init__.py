"""Design study: choice of a prism and its speed for a camera, before either is bought."""

from amiwarp.studies.design.choice import Choice, Design, Limits, Orbit, Timing, Volume, design

__all__ = ["Choice", "Design", "Limits", "Orbit", "Timing", "Volume", "design"]
