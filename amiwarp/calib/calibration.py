"""Calibration of the prism from a recording."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from amiwarp.calib.result import Calibration
from amiwarp.calib.selection.model_choice import calibrate_auto
from amiwarp.calib.sharpness.search import AUTO, Settings
from amiwarp.calib.single_model import calibrate_model
from amiwarp.events.recording import Recording
from amiwarp.progress import Progress


def calibrate(
    recording: Recording,
    settings: Settings | None = None,
    *,
    device: Any = "cpu",
    progress: Progress | None = None,
    **changes: Any,
) -> Calibration:
    """Finds the prism's parameters in the recording itself: those that make the IWE sharpest, and from there those
    that make one brightness map explain the events. Where no map does, the camera may have turned: its motion is then
    sought too.

    ``changes`` are fields of :class:`Settings`, over ``settings``. Raises :class:`AmiwarpError` where the recording
    cannot determine the parameters: too few events, under a quarter turn, encoder not covering the events, no
    texture, one edge direction, events that no map explains.
    """
    settings = replace(settings or Settings(), **changes)
    settings.check()
    if settings.model == AUTO:
        return calibrate_auto(recording, settings, device=device, progress=progress, budget_px=settings.budget_px)
    return calibrate_model(recording, settings, device=device, progress=progress)
