"""Share of a calibration that is finished, for progress messages."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from amiwarp.calib.sharpness.search import Settings


def stage_share(settings: Settings, stage: str, share: float) -> tuple[str, float]:
    """Return a progress message and the finished share of a calibration, assuming that all stages take equally long."""
    names = [] if settings.global_algorithm is None else ["global"]
    names += ["local", "photometric"][: len(settings.stages)]
    return f"calibrating, {stage}", (names.index(stage) + min(share, 1.0)) / len(names)
