"""Calibration of one model: sharpness stage, photometric stage, and refusal of results that the events do not support.

If no brightness map explains the events, three causes are tried in turn: hot or flickering pixels, a rotating camera,
and a wrong scale of the encoder.
"""

from __future__ import annotations

import math
import time
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from amiwarp.calib import checks
from amiwarp.calib.bad_pixels import MaskedEventSource, strange_pixels, stretch
from amiwarp.calib.calibration_events import CalibrationEvents, thin
from amiwarp.calib.first_guess import encoder_turns_per_period, estimate_rates, estimate_rpm
from amiwarp.calib.parameters import LENS, MOTION, RATES, ParameterSpace, make_space, nominal, with_lens
from amiwarp.calib.photometric.answer_search import LARGEST_COST_RATIO, LARGEST_ROTATION_GAIN, LARGEST_STILL_COST
from amiwarp.calib.photometric.cost import upload_ahead
from amiwarp.calib.photometric.stage import refine
from amiwarp.calib.result import Calibration, constant_speed
from amiwarp.calib.settings import AUTO, Settings
from amiwarp.calib.sharpness import Search
from amiwarp.errors import AmiwarpError
from amiwarp.events.encoder import Encoder
from amiwarp.events.events import Events, MemoryEvents
from amiwarp.optics.models import MODELS, size_names
from amiwarp.optics.prism import Prism
from amiwarp.progress import Progress

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from amiwarp.calib.calibration_events import EventsAhead
    from amiwarp.events.recording import Recording
    from amiwarp.optics.camera import Camera


# Preparation of a search: the encoder, the events and the parameter space for a recording.

LINEAR_UNKNOWNS = ("off_ratio", "leak")
"""Free parameters that only the photometric stage has: unknowns of its linear equations."""
ROTATION_WINDOW_TURNS, ROTATION_WINDOW_US = 2.1, 100_000.0
"""Length of the part of a recording that is used if the camera's rotation is free: in turns, or without a prism in
microseconds."""


def prepare(
    recording: Recording, settings: Settings, *, device: Any = "cpu", progress: Progress | None = None
) -> list[Search]:
    """Return the searches for a recording: one, or one for each sense of rotation if the prism's speed is unknown.

    For the model ``auto`` the search is that of the exact model, to which the smaller models are fitted later.
    Raises :class:`AmiwarpError` if the recording does not suit a calibration.
    """
    if settings.model == AUTO:
        settings = replace(settings, model="exact")
    name, camera = recording.name, _camera(recording)
    checks.check_events(len(recording.events), name)
    encoders, free = _encoders(recording, settings)
    events = thin(recording, settings.events)
    if isinstance(recording.events, MaskedEventSource) and len(events) < settings.events:
        checks.check_unmasked_events(len(events), recording.events.mask, name)
    searches = []
    for encoder in encoders:
        checks.check_coverage(encoder, int(events.t[0]), int(events.t[-1]), name)
        checks.check_pulses(encoder, name)
        space = _space(recording, camera, encoder, events, settings, free)
        calibration_events = _calibration_events(events, encoder, space, _middle(recording), settings.fold)
        if space.sized:
            checks.check_turned(encoder.angle_at(events.t[:: max(1, len(events) // 10_000)]), name)
        searches.append(Search(space, calibration_events, settings, device, progress))
    return searches


def rotation_window(recording: Recording, settings: Settings) -> Recording:
    """Return two turns from the recording's middle if the camera's rotation is free, else the recording itself.

    The rotation model holds for a short time only.
    """
    if not settings.free or not {"motion", *MOTION} & set(settings.free):
        return recording
    encoder, events = recording.encoder, recording.events
    rpm = settings.start.get("rpm", 0.0) if encoder is None else encoder.rpm
    length = ROTATION_WINDOW_TURNS * 60e6 / abs(rpm) if abs(rpm) > 1e-3 else ROTATION_WINDOW_US
    middle = _middle(recording)
    cut = events.between(round(middle - length / 2), round(middle + length / 2))
    return replace(recording, events=MemoryEvents(cut, *events.size))


def linear_unknowns(settings: Settings) -> tuple[str, ...]:
    """Return the free parameters that are unknowns of the photometric stage's linear equations."""
    return tuple(n for n in settings.free or () if n in LINEAR_UNKNOWNS)


def zero_time(recording: Recording, space: ParameterSpace) -> int | None:
    """Return the time at which the prism angle is defined as 0 [us] if there is no encoder; None if there is one."""
    return _middle(recording) if recording.encoder is None and space.sized else None


def _camera(recording: Recording) -> Camera:
    if recording.camera is None:
        raise AmiwarpError(f"{recording.name}: the camera is unknown; give its intrinsics or its field of view")
    return recording.camera


def _encoders(recording: Recording, settings: Settings) -> tuple[list[Encoder], tuple[str, ...]]:
    """Return the encoders to try and the free parameters.

    Without an encoder these are constant speeds: the given one, or the one found in the events with either sign.
    """
    kind = MODELS[settings.model]
    free = kind.FREE[:2] if settings.free is None else settings.free
    free = tuple(n for n in free if n not in LINEAR_UNKNOWNS)
    if not {*size_names(), "phase"} & set(free) and settings.start.get(kind.SIZE) == 0.0:
        return [constant_speed(0.0, recording.events.t_first, recording.events.t_last, _middle(recording))], free
    if recording.encoder is not None:
        if "rpm" in free or "rpm" in settings.start:
            raise AmiwarpError(
                f"{recording.name}: the encoder gives the rpm; remove rpm from the settings, or free clock_offset"
            )
        return [recording.encoder], free
    if "clock_offset" in free or "clock_offset" in settings.start:
        raise AmiwarpError(
            f"{recording.name}: the recording has no encoder, so clock_offset is part of the phase; remove "
            "clock_offset from the settings"
        )
    rpm = settings.start.get("rpm")
    speeds = [rpm] if rpm is not None else [s * estimate_rpm(recording) for s in (1.0, -1.0)]
    first, last = recording.events.t_first, recording.events.t_last
    encoders = [constant_speed(s, first, last, _middle(recording)) for s in speeds]
    return encoders, free if "rpm" in free else (*free, "rpm")


def _middle(recording: Recording) -> int:
    """Return the middle time of the recording [us], about which a change of speed changes the phase least."""
    return (recording.events.t_first + recording.events.t_last) // 2


def _space(
    recording: Recording,
    camera: Camera,
    encoder: Encoder,
    events: Events,
    settings: Settings,
    free: tuple[str, ...],
) -> ParameterSpace:
    """Return the space of the free parameters, started at estimates from the encoder and the events."""
    duration = int(events.t[-1]) - int(events.t[0])
    turned = float(np.ptp(encoder.angle_at(events.t[[0, -1]])))
    start = dict(settings.start)
    if "rpm" in free:
        start["rpm"] = encoder.rpm
    if "clock_offset" in free:
        start.setdefault("clock_offset", encoder.clock_offset_us)
    if ("motion" in free or set(RATES) & set(free)) and turned > 0.0 and not set(RATES) & set(start):
        found = dict(zip(RATES, estimate_rates(events, encoder, camera), strict=True))
        start |= {n: rate for n, rate in found.items() if "motion" in free or n in free}
    return make_space(
        settings.model, camera, nominal(recording.prism), free=free, start=start, bounds=settings.bounds,
        rad_per_us=turned / max(duration, 1), duration_us=float(duration), middle_us=_middle(recording),
    )  # fmt: skip


def _calibration_events(
    events: Events, encoder: Encoder, space: ParameterSpace, middle: int, fold: int
) -> CalibrationEvents:
    """Return the calibration events with their encoder and the angles' derivative by a free clock offset or rpm."""
    if fold and (space.moving or {"clock_offset", "rpm"} & set(space.names)):
        raise AmiwarpError(
            f"fold = {fold} with {', '.join(space.names)} free: folding discards the events' times; set fold to 0"
        )
    if "clock_offset" in space.start:
        encoder = encoder.with_clock_offset(space.start["clock_offset"])
    if "clock_offset" in space.names:
        return CalibrationEvents(events, encoder, lambda t: encoder.speed_at(t) * 1e-6)
    if "rpm" in space.names:
        return CalibrationEvents(events, encoder, lambda t: (t - middle).astype(np.float64) * (2.0 * math.pi / 60e6))
    return CalibrationEvents(events, encoder, None, fold)


LEAST_BAD_SHARE = 0.01
"""Share of the events on hot or flickering pixels above which these pixels are masked."""
LEAST_SCALE_ERROR = 0.003
"""Smallest relative error of an encoder's scale that is reported. Three turns measure the scale to about 0.001."""


def calibrate_model(
    recording: Recording,
    settings: Settings,
    *,
    device: Any = "cpu",
    progress: Progress | None = None,
    meanwhile: Callable[[Calibration], Iterator[None]] | None = None,
) -> Calibration:
    """Return the calibration of ``settings.model``, by sharpness and then photometrically.

    If no brightness map explains the events, or a slow rotation of the camera explains much of what is left, the
    camera's rotation is freed too. ``meanwhile`` is called with the answer of the sharpness stage and returns an
    iterator. Its steps are taken while a GPU works on the photometric stage, those that are left after the stage.
    Raises :class:`AmiwarpError` as :func:`amiwarp.calibrate` does.
    """
    began = time.perf_counter()
    if "photometric" not in settings.stages:
        return _calibrate_once(recording, settings, device, progress)
    found = _calibration_or_error(recording, settings, device, progress, meanwhile)
    if recording.encoder is not None:
        if _unexplained(found):
            recording, found = _without_bad_pixels(recording, settings, found, device, progress)
        if _unexplained(found):
            found = _explain(recording, settings, found, device, progress)
        elif settings.free is None and _camera_turned(found):
            found = _with_rotation(recording, settings, found, device, progress)
    if isinstance(found, AmiwarpError):
        raise found
    _check_confirmed(found, recording.name)
    if isinstance(recording.prism, Prism) and not size_names() & {*settings.bounds, *settings.start}:
        checks.check_nominal(found.model_name, found.parameters, recording.prism, recording.name)
    return replace(found, seconds=time.perf_counter() - began)


def _calibration_or_error(
    recording: Recording,
    settings: Settings,
    device: Any,
    progress: Progress | None,
    meanwhile: Callable[[Calibration], Iterator[None]] | None = None,
) -> Calibration | AmiwarpError:
    try:
        return _calibrate_once(recording, settings, device, progress, meanwhile)
    except AmiwarpError as error:
        return error


def _without_bad_pixels(
    recording: Recording,
    settings: Settings,
    found: Calibration | AmiwarpError,
    device: Any,
    progress: Progress | None,
) -> tuple[Recording, Calibration | AmiwarpError]:
    """Mask hot and flickering pixels if they have a notable share of the events, and calibrate without them.

    Return the masked recording and the better of both calibrations. Raises :class:`AmiwarpError` if most pixels
    flicker.
    """
    source, encoder = recording.events, recording.encoder
    assert encoder is not None
    mask, summary = strange_pixels(stretch(source, encoder), encoder, source.size)
    if summary.share < LEAST_BAD_SHARE:
        return recording, found
    checks.check_light(mask, summary, recording.name)
    cleaned = replace(recording, events=MaskedEventSource(source, mask))
    again = _calibration_or_error(cleaned, settings, device, progress)
    if _accepted(found) and not _accepted(again):
        return cleaned, found
    if isinstance(again, AmiwarpError):
        return cleaned, again
    return cleaned, replace(again, warnings=(*again.warnings, str(summary)))


def _accepted(found: Calibration | AmiwarpError) -> bool:
    """Return whether the photometric stage accepted its result."""
    return not isinstance(found, AmiwarpError) and found.photometric is not None and found.photometric.accepted


def _unexplained(found: Calibration | AmiwarpError) -> bool:
    """Return whether the photometric cost of a calibration is so high that the camera may have rotated."""
    if isinstance(found, AmiwarpError):
        return isinstance(found, checks.NoSharpOptimumError)
    return found.photometric is not None and found.photometric.cost > LARGEST_STILL_COST


def _camera_turned(found: Calibration | AmiwarpError) -> bool:
    """Return whether a rotation of the camera explains much of the photometric residual."""
    if isinstance(found, AmiwarpError) or found.photometric is None:
        return False
    return found.photometric.rotation_gain > LARGEST_ROTATION_GAIN


def _explain(
    recording: Recording,
    settings: Settings,
    found: Calibration | AmiwarpError,
    device: Any,
    progress: Progress | None,
) -> Calibration | AmiwarpError:
    """Return the calibration with a free camera rotation, the error of a wrong encoder scale, or ``found`` unchanged.

    A slow camera rotation and a wrong encoder scale have similar effects on the events. If the rotation leaves a high
    cost, the cause with the lower cost is taken.
    """
    moving = found if settings.free is not None else _with_rotation(recording, settings, found, device, progress)
    if moving is not found and _cost(moving) <= LARGEST_STILL_COST:
        return moving
    scaled = _with_other_scale(recording, settings, found, device, progress)
    if scaled is None or (moving is not found and _cost(moving) <= scaled[1]):
        return moving
    turns, cost = scaled
    return checks.wrong_scale(recording.name, turns, "the events repeat", _cost(found), cost)


def _cost(found: Calibration | AmiwarpError) -> float:
    """Return the cost of the photometric stage relative to that without a map; 1 if the stage did not run."""
    return 1.0 if isinstance(found, AmiwarpError) or found.photometric is None else found.photometric.cost


def _with_other_scale(
    recording: Recording,
    settings: Settings,
    found: Calibration | AmiwarpError,
    device: Any,
    progress: Progress | None,
) -> tuple[float, float] | None:
    """Return after how many encoder turns events repeat, and the photometric cost with the scale corrected by it.

    The events of a still scene repeat every turn of the prism. If they repeat at another encoder angle, the encoder's
    scale may be wrong. None if the corrected scale does not lower the cost enough.
    """
    encoder = recording.encoder
    assert encoder is not None
    try:
        turns = encoder_turns_per_period(recording, encoder)
    except AmiwarpError:
        return None  # the events do not repeat: the scene or the camera moves
    if abs(turns - 1.0) < LEAST_SCALE_ERROR:
        return None
    corrected = replace(encoder, angle=encoder.angle / turns, index_t=None)
    again = _calibration_or_error(replace(recording, encoder=corrected), settings, device, progress)
    return (turns, _cost(again)) if _accepted(again) and _cost(again) <= LARGEST_COST_RATIO * _cost(found) else None


def _with_rotation(
    recording: Recording,
    settings: Settings,
    found: Calibration | AmiwarpError,
    device: Any,
    progress: Progress | None,
) -> Calibration | AmiwarpError:
    """Return the calibration with a free camera rotation if that lowers the photometric cost enough; else ``found``."""
    free = (MODELS[settings.model].SIZE, "phase", "motion")
    moving = _calibration_or_error(recording, replace(settings, free=free), device, progress)
    if isinstance(moving, AmiwarpError) or moving.photometric is None or not moving.photometric.accepted:
        return found
    if moving.photometric.cost > LARGEST_COST_RATIO * _cost(found):
        return found
    speed = math.degrees(math.hypot(*(moving.parameters[n] for n in RATES)))
    # only the prism's parameters are kept: the rotation holds for two turns in the middle of the recording
    prism = {n: x for n, x in moving.parameters.items() if n not in MOTION}
    return replace(
        moving,
        parameters=prism,
        uncertainty={n: x for n, x in moving.uncertainty.items() if n not in MOTION},
        free=tuple(n for n in moving.free if n not in MOTION),
        middle_us=None,
        warnings=(
            *moving.warnings,
            f"the camera turned at {speed:.1f} deg/s; its rotation was calibrated together with the prism",
        ),
    )


def _check_confirmed(found: Calibration, name: str) -> None:
    """Raise :class:`AmiwarpError` unless the photometric stage accepted its result.

    The answer of sharpness alone may be off by tenths of a pixel.
    """
    if _accepted(found):
        return
    reasons = [w for w in found.warnings if "photometric" in w]
    raise AmiwarpError(
        f"{name}: {'; '.join(reasons)}; the result of the sharpness stage alone may be off by several tenths of "
        "a pixel: accept it with --stages sharpness, or record a scene that stays still"
    )


def _calibrate_once(
    recording: Recording,
    settings: Settings,
    device: Any,
    progress: Progress | None,
    meanwhile: Callable[[Calibration], Iterator[None]] | None = None,
) -> Calibration:
    """Return the calibration by the stages of the settings, with the free parameters that they name."""
    began = time.perf_counter()
    recording = rotation_window(recording, settings)
    searches = prepare(recording, settings, device=device, progress=progress)
    with upload_ahead(recording, searches[0]) as ahead:
        return replace(
            _run_stages(recording, searches, ahead, progress, meanwhile), seconds=time.perf_counter() - began
        )


def _run_stages(
    recording: Recording,
    searches: list[Search],
    ahead: EventsAhead | None,
    progress: Progress | None,
    meanwhile: Callable[[Calibration], Iterator[None]] | None,
) -> Calibration:
    """Return the calibration by the sharpest of the searches, and by the photometric stage if the settings name it.

    Its time is not set. ``ahead``: events of the photometric stage that are already on the device.
    """
    for search in searches:
        search.run()
    search = max(searches, key=lambda s: s.score)
    settings = search.settings
    best = search.best
    warnings, uncertainty = search.check_answer(recording.name)
    still = {n: 0.0 for n in (search.space.size_name, *MOTION) if n in best}
    before = search.fine.values({**best, **still})
    result = Calibration(
        model_name=settings.model,
        camera=search.space.camera,
        prism=search.space.prism,
        parameters=best,
        uncertainty=uncertainty,
        free=search.space.names,
        sharpness_name=settings.sharpness.value,
        sharpness_before=before,
        sharpness_after=search.score,
        stages=tuple(search.stages),
        zero_us=zero_time(recording, search.space),
        middle_us=search.space.middle_us if search.space.moving else None,
        events=len(search.calibration_events.events),
        seconds=0.0,
        warnings=warnings,
    )
    if "photometric" in settings.stages:
        result = _photometric_stage(recording, search, result, ahead, progress, meanwhile)
    return result


def _photometric_stage(
    recording: Recording,
    search: Search,
    result: Calibration,
    ahead: EventsAhead | None,
    progress: Progress | None,
    meanwhile: Callable[[Calibration], Iterator[None]] | None,
) -> Calibration:
    """Return the photometric stage's result, or the sharpness stage's result with a warning that says why."""
    try:
        linear = linear_unknowns(search.settings)
        steps = iter(()) if meanwhile is None else meanwhile(result)
        found, summary, space = refine(recording, search, linear, ahead=ahead, progress=progress, meanwhile=steps)
        for _ in steps:
            pass
    except AmiwarpError as error:
        return replace(result, warnings=(*result.warnings, f"the photometric stage failed: {error}"))
    if found.held:
        undetermined = f"the events do not determine {', '.join(found.held)}: the photometric stage left it unchanged"
        result = replace(result, warnings=(*result.warnings, undetermined))
    warnings = (*result.warnings, *found.warnings)
    result = replace(result, stages=(*result.stages, summary), photometric=found, warnings=warnings)
    if not found.accepted:
        return replace(result, warnings=(*result.warnings, f"photometric stage: {found.verdict}"))
    lens = {n: x for n, x in found.parameters.items() if n in LENS and n not in search.full_space.names}
    return replace(
        result,
        camera=with_lens(result.camera, lens),
        prism=space.prism,
        parameters={n: x for n, x in found.parameters.items() if n not in lens},
        uncertainty={n: x for n, x in found.uncertainty.items() if n not in lens},
        free=tuple(n for n in space.names if n not in lens),
        sharpness_after=search.sharpness_in(space, found.parameters),
    )
