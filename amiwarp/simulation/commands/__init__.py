"""Simulated recordings: ``amiwarp simulate`` and ``translate``, and the options of their rigs and worlds."""

from amiwarp.simulation.commands.simulate import run_simulate
from amiwarp.simulation.commands.translate import run_translate

__all__ = ["run_simulate", "run_translate"]
