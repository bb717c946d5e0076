"""Optional libraries of the evaluations."""

from __future__ import annotations

from typing import Any

from amiwarp.errors import optional_module


def library(name: str) -> Any:
    """Return a module of an optional library. Raises :class:`AmiwarpError` if it is not installed."""
    return optional_module(name, "evaluate", f"'amiwarp evaluate' needs {name.partition('.')[0]}")
