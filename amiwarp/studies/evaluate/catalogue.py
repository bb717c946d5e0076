"""Evaluations by name. A new one needs its module in this folder and its name in :data:`EVALUATIONS`."""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from typing import Any, Protocol, cast

from amiwarp.errors import AmiwarpError
from amiwarp.studies.evaluate.claims import Claim
from amiwarp.studies.evaluate.conditions import Condition, Settings
from amiwarp.studies.evaluate.results import CellResult, Table

EVALUATIONS = (
    "texture",
    "edges",
    "pictures",
    "corners",
    "segmentation",
    "flow",
    "pose",
    "apex_speed",
    "fading",
    "convexity",
    "stereo",
    "inertial",
)
"""Names of the evaluations, in the order of the report: each is a module of this folder, see :class:`Evaluation`."""
UNCALIBRATED = ("apex_speed", "fading", "convexity")
"""Names of the evaluations that need no calibration."""


class Evaluation(Protocol):
    """What the module of an evaluation contains."""

    TITLE: str
    """Title in the report."""
    PROTOCOL: str
    """What is computed, and how."""
    DIFFERENCES: str
    """How that differs from the paper."""
    VERSION: int
    """Version of ``measure``. Raise it when the results change: older cells are then run anew."""
    Values: Any
    """Type of what ``measure`` returns: a typed dict, whose fields have their ranges. A cell of other values is not
    used."""
    NEEDS_TRUTH: bool
    """Whether it needs ground truth. If not, it also runs on recordings."""

    def conditions(self, settings: Settings) -> list[Condition]:
        """Return the conditions under which the evaluation runs."""

    def measure(self, streams: Any, settings: Settings) -> dict[str, Any]:
        """Return the result of one condition, as JSON data. ``streams``: :class:`Streams`."""

    def tables(self, results: Sequence[CellResult]) -> list[Table]:
        """Return the tables of all results, each with its chart. Results of failed cells have no values."""

    def claims(self, results: Sequence[CellResult]) -> list[Claim]:
        """Return the paper's claims, and checks of their robustness, with the verdicts that follow from the results.

        The function ``pictures(results)``, which returns the pictures of the evaluation, is optional.
        """


def load(name: str) -> Evaluation:
    """Return an evaluation. Raises :class:`AmiwarpError` if there is none of that name."""
    if name not in EVALUATIONS:
        raise AmiwarpError(f"unknown evaluation {name!r}; choose among {', '.join(EVALUATIONS)}")
    return cast("Evaluation", importlib.import_module(f"amiwarp.studies.evaluate.{name}"))
