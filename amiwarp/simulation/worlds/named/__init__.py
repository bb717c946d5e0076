"""Built-in worlds for the simulator. They are generated from a seed and need no files."""

from amiwarp.simulation.worlds.named.camera_paths import TRAJECTORIES
from amiwarp.simulation.worlds.named.catalogue import WORLDS, named_world

__all__ = ["TRAJECTORIES", "WORLDS", "named_world"]
