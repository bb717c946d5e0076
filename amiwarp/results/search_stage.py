"""Record of one run of a search algorithm."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from amiwarp.schema.calls import guarded
from amiwarp.validation import INT64, finite, instance, real, whole


@guarded
@dataclass(frozen=True, kw_only=True)
class SearchStage:
    """Record of one run of a search algorithm: its best point and all evaluated points."""

    algorithm: str
    """Name of the search algorithm, such as ``LN_BOBYQA``."""
    x: NDArray[np.float64]
    """Evaluated point with the highest score [px], shape ``(n,)`` for n free parameters."""
    score: float
    """Score at the best point; higher is better."""
    evaluations: int
    """Number of evaluations of the score in the run."""
    seconds: float
    """Run time of the search [s]."""
    ended: str
    """Reason why the search ended, in words."""
    points: NDArray[np.float64] = field(repr=False)
    """All evaluated points in order [px], shape ``(evaluations, n)``."""
    scores: NDArray[np.float64] = field(repr=False)
    """Score of each evaluated point, shape ``(evaluations,)``."""

    def __post_init__(self) -> None:
        for name in ("algorithm", "ended"):
            instance(getattr(self, name), str, f"search stage's {name}")
        whole(self.evaluations, "search stage's evaluations", 0, INT64[1])
        for name in ("score", "seconds"):
            real(getattr(self, name), f"search stage's {name}")
        for name in ("x", "points", "scores"):
            finite(getattr(self, name), f"search stage's {name}")
