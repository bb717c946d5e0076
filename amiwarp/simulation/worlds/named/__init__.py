"""Named worlds: scenes made by a program, which need no files."""

from amiwarp.simulation.worlds.named.catalogue import WORLDS, named_world
from amiwarp.simulation.worlds.named.motion import TRAJECTORIES

__all__ = ["TRAJECTORIES", "WORLDS", "named_world"]
