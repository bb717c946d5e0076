"""Calibration of the prism from a recording.

:func:`calibrate` looks which model the recording asks for, and makes the attempts of ``attempts.py``. For the model
``auto``, a :class:`ModelChooser` then chooses among the models of a prism. A plate has a calibration of its own.
"""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any, Unpack

from amiwarp.calib.attempts import calibrated
from amiwarp.calib.calibrator import Calibrator, with_warnings
from amiwarp.calib.model_choice import ModelChooser
from amiwarp.calib.settings import AUTO, CalibrationOptions, Settings
from amiwarp.calib.start_burst import reaching_back, without_start_burst
from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events.recording import Recording
from amiwarp.optics.models.exact import ExactModel
from amiwarp.optics.models.plate import PlateModel
from amiwarp.optics.models.registry import MODELS
from amiwarp.optics.prism import Plate
from amiwarp.results.calibration import (
    Calibration,
)
from amiwarp.results.parameters import best_model
from amiwarp.schema.calls import guarded
from amiwarp.tasks import Progress
from amiwarp.validation import check_names


@guarded
def calibrate(
    recording: Recording,
    settings: Settings | None = None,
    *,
    device: Any = "cpu",
    progress: Progress | None = None,
    **changes: Unpack[CalibrationOptions],
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
    given: dict[str, Any] = {**changes}  # one word may stand for a tuple of it
    settings = replace(settings or Settings(), **given)
    settings.check()
    if settings.model == AUTO:
        settings = _for_optic(recording, settings)

    used, warnings = without_start_burst(recording)
    found = _calibration(used, settings, device, progress)
    if found.path is not None and recording.encoder is None and len(recording.events):
        found = replace(found, path=reaching_back(found.path, recording.events.t_first))
    return with_warnings(found, *warnings)


def _for_optic(recording: Recording, settings: Settings) -> Settings:
    """Return the settings with the model of the recording's optic; for a prism, the model stays ``auto``."""
    best = best_model(recording)
    if best is None:
        choices = ", ".join(
            f"model {name!r} (--model {name}) for a {kind.TEXT}"
            for name, kind in MODELS.items()
            if kind.ANGLES == 2
        )
        raise AmiwarpError(
            f"{recording.name}: has the angles of two motors, and names no optic; give one: {choices}",
            ErrorCode.AMBIGUOUS,
        )
    if best != ExactModel.NAME:
        return replace(settings, model=best)
    if getattr(recording.prism, "second", None) is not None:
        raise AmiwarpError(
            f"{recording.name}: has two prisms, but the angle of one; give the second angle to 'amiwarp convert' by "
            "--second-encoder or --second-ratio, or leave the second prism out"
        )
    return settings


def _calibration(
    recording: Recording, settings: Settings, device: Any, progress: Progress | None
) -> Calibration:
    """Return the calibration of a recording with checked settings."""
    if isinstance(recording.prism, Plate) or settings.model == PlateModel.NAME:
        _check_plate(recording, settings)
    if settings.model != AUTO:
        return calibrated(Calibrator(recording, settings, device, progress))
    chooser = ModelChooser(recording, settings, device)
    exact = calibrated(
        Calibrator(recording, chooser.settings, device, progress, host_work=chooser.prepare)
    )

    def again(changed: Recording, freed: Settings) -> Calibration:
        return calibrated(Calibrator(changed, freed, device, progress, path=exact.path))

    return chooser.choose(exact, again)


def _check_plate(recording: Recording, settings: Settings) -> None:
    """Raise :class:`AmiwarpError` if a recording does not suit the calibration of a plate."""
    name = recording.name
    if not isinstance(recording.prism, Plate):
        raise AmiwarpError(
            f"{name}: the plate is unknown; give its --thickness-mm and --plate-tilt-deg",
            ErrorCode.CONTENT_MISSING,
        )
    if settings.model != PlateModel.NAME:
        raise AmiwarpError(
            f"{name}: the glass is a plate, the model {settings.model!r}; give model 'plate', or a prism"
        )
    if recording.encoder is None:
        raise AmiwarpError(
            f"{name}: a plate's phase needs the encoder, which the recording lacks; add its log",
            ErrorCode.CONTENT_MISSING,
        )
