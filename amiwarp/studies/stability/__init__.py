"""Stability study (atlas of failures): recordings under ever harder conditions, calibrated by several methods."""

from amiwarp.studies.stability.cells import (
    AXES,
    METHODS,
    QUICK_METHODS,
    Axis,
    Cell,
    Condition,
    Method,
    Outcome,
    Result,
    Store,
    Stored,
    chosen,
    identity,
    make,
    quick_axes,
    run,
    run_cell,
    sensible,
)
from amiwarp.studies.stability.report import Atlas, aggregate, draw, load, summary

__all__ = [
    "AXES", "METHODS", "QUICK_METHODS", "Atlas", "Axis", "Cell", "Condition", "Method", "Outcome", "Result", "Store",
    "Stored", "aggregate", "chosen", "draw", "identity", "load", "make", "quick_axes", "run", "run_cell", "sensible",
    "summary",
]  # fmt: skip
