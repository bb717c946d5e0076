"""Stability study (atlas of failures): recordings under ever harder conditions, calibrated by several methods."""

from amiwarp.studies.stability.axes import AXES, Axis
from amiwarp.studies.stability.cells import METHODS, Cell, Method, Outcome, Result, Store, Stored, identity, run_cell
from amiwarp.studies.stability.conditions import Condition, make, sensible
from amiwarp.studies.stability.figures import draw
from amiwarp.studies.stability.report import Atlas, aggregate, load, summary
from amiwarp.studies.stability.run import QUICK_METHODS, chosen, quick_axes, run

__all__ = [
    "AXES", "METHODS", "QUICK_METHODS", "Atlas", "Axis", "Cell", "Condition", "Method", "Outcome", "Result", "Store",
    "Stored", "aggregate", "chosen", "draw", "identity", "load", "make", "quick_axes", "run", "run_cell", "sensible",
    "summary",
]  # fmt: skip
