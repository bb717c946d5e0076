"""Calibration on the events that the inspector shows."""

from dataclasses import replace

from amiwarp.calib.calibration import calibrate
from amiwarp.calib.settings import AUTO, Settings
from amiwarp.errors import AmiwarpError
from amiwarp.events.recording import Recording
from amiwarp.optics.models.exact import ExactModel
from amiwarp.optics.models.registry import alternatives
from amiwarp.results.calibration import Calibration
from amiwarp.tasks import Progress
from amiwarp.viewer.filters import rate_text
from amiwarp.viewer.inspector import Inspector
from amiwarp.viewer.selected_part import select_part
from amiwarp.viewer.sliders import orbit_text

SHARPNESS_ONLY = ("sharpness",)
"""Stages of a calibration without the photometric one."""


def calibrated_events(inspector: Inspector, *, whole: bool = False) -> tuple[Recording, str]:
    """Return the events that :func:`find_calibration` uses, and a description of them for the page."""
    recording = inspector.recording
    if whole:
        return recording, f"the whole recording, {len(recording.events):,} events"
    part, start_us, length_us, _ = select_part(inspector, inspector.loaded, inspector.loaded.region)

    selection = inspector.selection
    start_s = (start_us - recording.events.t_first) * 1e-6
    end_s = start_s + length_us * 1e-6
    polarity = {None: "", 0: "OFF ", 1: "ON "}[selection.polarity]
    texts = [f"{len(part.events):,} {polarity}events from {start_s:.3f} s to {end_s:.3f} s"]
    if selection.region is not None:
        left, top, right, bottom = selection.region
        texts.append(f"x {left} to {right}, y {top} to {bottom} px")
    if selection.hide_hot:
        texts.append("without hot pixels")
    if selection.noise_us is not None:
        texts.append(f"without background activity ({selection.noise_us * 1e-3:g} ms)")
    if selection.refractory_us:
        texts.append(f"refractory period {selection.refractory_us * 1e-3:g} ms")
    if selection.most_per_s:
        texts.append(f"at most {rate_text(selection.most_per_s)}")
    if selection.every > 1:
        texts.append(f"one of {selection.every} events")
    return part, ", ".join(texts)


def find_calibration(
    inspector: Inspector,
    settings: Settings | None = None,
    *,
    whole: bool = False,
    progress: Progress | None = None,
) -> tuple[Calibration, str]:
    """Calibrate on the events of the window and the selection, or on the whole recording as ``amiwarp calibrate`` does.

    Returns the calibration of the whole camera, which nobody has accepted yet, and a description of it. Without an
    encoder, the search starts at the speed set on the page. Raises :class:`AmiwarpError` if these events cannot
    determine the parameters.
    """
    recording, scope = calibrated_events(inspector, whole=whole)
    if settings is None:
        wedge = ExactModel.NAME in alternatives(inspector.knobs.model)
        settings = Settings(model=AUTO if wedge else inspector.knobs.model)
    rpm = inspector.knobs.rpm
    if rpm and not inspector.has_encoder:
        settings = replace(settings, start={"rpm": rpm, **settings.start})
    try:
        found = calibrate(recording, settings, device=inspector.device, progress=progress)
    except AmiwarpError as error:
        if whole or settings.stages == SHARPNESS_ONLY:
            raise
        # Some thousand events of a small region can mislead the checks of the photometric stage.
        settings = replace(settings, stages=SHARPNESS_ONLY)
        found = calibrate(recording, settings, device=inspector.device, progress=progress)
        reason, _, _ = str(error).partition(";")
        reason = reason.removeprefix(f"{recording.name}: ").removeprefix("photometric stage: ")
        doubt = (
            f"by sharpness alone, as the photometric stage refused so few events ({reason}); "
            "to be sure, calibrate on the whole recording"
        )
        found = replace(found, warnings=(*found.warnings, doubt))
    if not whole:
        found = replace(found, camera=inspector.camera)

    sharpness = inspector.sharpness_meter()
    before = sharpness(None)
    now = sharpness(inspector.knobs)
    after = sharpness(inspector.knobs_of(found))
    exact = found.exact
    warnings = "".join(f"; {text}" for text in found.warnings)
    orbit = orbit_text(exact.model_name, inspector.knobs_of(exact).value, found.parameters["phase"])
    return found, (
        f"found on {scope}: {found.model_name} model, {orbit}; sharpness of the region {before:.3g} as recorded, "
        f"{now:.3g} now, {after:.3g} with the result; {found.seconds:.1f} s{warnings}"
    )
