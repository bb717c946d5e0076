"""Built-in worlds for the simulator. They are generated from a seed and need no files."""

from amiwarp.simulation.worlds.named.catalogue import WORLDS, named_world
from amiwarp.simulation.worlds.named.motion import TRAJECTORIES

__all__ = ["TRAJECTORIES", "WORLDS", "named_world"]
