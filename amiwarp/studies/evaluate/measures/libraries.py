"""Optional libraries of the evaluations."""

from __future__ import annotations

import importlib
from typing import Any

from amiwarp.errors import AmiwarpError


def library(name: str) -> Any:
    """Return a module of an optional library. Raises :class:`AmiwarpError` if it is not installed."""
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        what = name.partition(".")[0]
        raise AmiwarpError(f"'amiwarp evaluate' needs {what}; run: pip install 'amiwarp[evaluate]'") from error
