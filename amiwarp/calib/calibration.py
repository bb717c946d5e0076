"""Calibration of the prism from a recording."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

from amiwarp.calib.model_choice import calibrate_auto
from amiwarp.calib.result import Calibration
from amiwarp.calib.settings import AUTO, Settings
from amiwarp.calib.single_model import calibrate_model
from amiwarp.events.recording import Recording
from amiwarp.progress import Progress
from amiwarp.validation import check_names, guarded


@guarded
def calibrate(
    recording: Recording,
    settings: Settings | None = None,
    *,
    device: Any = "cpu",
    progress: Progress | None = None,
    **changes: Any,
) -> Calibration:
    """Find the prism's parameters in the recording itself.

    Parameters
    ----------
    recording : Recording
        The recording. Its camera must be known.
    settings : Settings, optional
        Settings of the calibration; by default ``Settings()``.
    device : str or warp.context.Device
        Device that computes, such as ``cpu`` or ``cuda:0``.
    progress : Progress, optional
        Function that is called with the current stage and the finished share.
    **changes : dict
        Fields of :class:`Settings` that replace those of ``settings``.

    Returns
    -------
    Calibration
        Parameters with their standard deviations, and how they were found.

    Raises
    ------
    AmiwarpError
        If the recording cannot determine the parameters: too few events, less than a quarter turn, an encoder that
        does not cover the events, no texture, edges in one direction only, or events that no brightness map explains.

    Notes
    -----
    The sharpness stage is contrast maximisation: it finds the parameters that make the image of warped events (IWE)
    sharpest. The photometric stage starts from its answer and finds the parameters for which one brightness map of the
    scene explains the events. If no map does, the camera may have rotated; its rotation is then calibrated too. The
    formulas and measured errors are in ``docs/explanation/calibration.md``.

    Examples
    --------
    >>> import numpy as np
    >>> blocks = np.random.default_rng(0).integers(0, 255, (30, 40), dtype=np.uint8)
    >>> texture = np.kron(blocks, np.ones((8, 8), np.uint8))
    >>> camera = amiwarp.Camera.from_fov(80, 60, 0.9)
    >>> recording = amiwarp.simulate(texture, camera, amiwarp.Prism(apex=0.03), duration_s=0.1, seed=0)
    >>> calibration = amiwarp.calibrate(recording, model="exact")
    >>> round(calibration.parameters["apex"], 3)
    0.03
    """
    check_names(changes, [entry.name for entry in fields(Settings)], "calibrate: setting ")
    settings = replace(settings or Settings(), **changes)
    settings.check()
    if settings.model == AUTO:
        return calibrate_auto(recording, settings, device=device, progress=progress, budget_px=settings.budget_px)
    return calibrate_model(recording, settings, device=device, progress=progress)
