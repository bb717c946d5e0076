"""Calibration of one model: both stages, and the refusal of what the recording does not determine."""

from __future__ import annotations

import math
import time
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from amiwarp.calib import checks
from amiwarp.calib.bad_pixels import Masked, strange_pixels, stretch
from amiwarp.calib.parameters import MOTION, RATES, ParameterSpace, make_space, nominal, size_name
from amiwarp.calib.photometric.stage import refine
from amiwarp.calib.prism_speed import estimate_rpm, turns_per_turn
from amiwarp.calib.result import Calibration, constant_speed
from amiwarp.calib.rotation_estimate import estimate_rates
from amiwarp.calib.sharpness.search import AUTO, Material, Search, Settings
from amiwarp.calib.thinning import thin
from amiwarp.errors import AmiwarpError
from amiwarp.events.encoder import Encoder
from amiwarp.events.events import Events, MemoryEvents
from amiwarp.optics.prism import Prism
from amiwarp.progress import Progress

if TYPE_CHECKING:
    from amiwarp.events.recording import Recording
    from amiwarp.optics.camera import Camera

LINEAR = ("off_ratio", "leak")
"""Names that are free in the photometric stage alone: unknowns of its linear equations."""
STRANGE_SHARE = 0.01
"""Of the events, that must lie on hot or flickering pixels for these to matter."""
MOVING_TURNS, MOVING_US = 2.1, 100_000.0
"""Length of the window where the camera's motion is free: in turns, or without a prism."""
LEAST_SHARPNESS_KEPT = 0.7
"""The truth is nearly as sharp as the sharpest (0.93 to 0.99 of the gain, 0.8 with many hot pixels, measured)."""
STILL_COST, TURNING_GAIN = 0.2, 0.75
"""Where more of the cost remains, the camera may turn; it did where its motion brings that down to this share."""
LEAST_SCALE_ERROR = 0.003
"""Of an encoder, relative, that the events tell: three turns tell it to about 0.001 (measured)."""


def calibrate_model(
    recording: Recording, settings: Settings, *, device: Any = "cpu", progress: Progress | None = None
) -> Calibration:
    """Find the parameters of ``settings.model``, by sharpness and then photometrically.

    If no brightness map explains the events, the camera may have rotated: its rotation is then sought too.
    Raises :class:`AmiwarpError` as :func:`amiwarp.calibrate` does.
    """
    began = time.perf_counter()
    if "photometric" not in settings.stages:
        return attempt(recording, settings, device, progress)
    found = _try(recording, settings, device, progress)
    if recording.encoder is not None and _doubtful(found):
        recording, found = _without_strange(recording, settings, found, device, progress)
        if _doubtful(found):
            found = _why_doubtful(recording, settings, found, device, progress)
    if isinstance(found, AmiwarpError):
        raise found
    _check_confirmed(found, recording.name)
    if isinstance(recording.prism, Prism) and not {"apex", "deflection"} & {*settings.bounds, *settings.start}:
        checks.check_nominal(found.model_name, found.parameters, recording.prism, recording.name)
    return replace(found, seconds=time.perf_counter() - began)


def _try(
    recording: Recording, settings: Settings, device: Any, progress: Progress | None
) -> Calibration | AmiwarpError:
    try:
        return attempt(recording, settings, device, progress)
    except AmiwarpError as error:
        return error


def _without_strange(
    recording: Recording,
    settings: Settings,
    found: Calibration | AmiwarpError,
    device: Any,
    progress: Progress | None,
) -> tuple[Recording, Calibration | AmiwarpError]:
    """The same without hot and flickering pixels, and the recording without them; where they hardly count, as it is.

    Raises :class:`AmiwarpError` where all of the light flickers.
    """
    source, encoder = recording.events, recording.encoder
    assert encoder is not None
    mask, summary = strange_pixels(stretch(source, encoder), encoder, source.size)
    if summary.share < STRANGE_SHARE:
        return recording, found
    checks.check_light(mask, summary, recording.name)
    cleaned = replace(recording, events=Masked(source, mask))
    again = _try(cleaned, settings, device, progress)
    if _sure(found) and not _sure(again):
        return cleaned, found
    if isinstance(again, AmiwarpError):
        return cleaned, again
    return cleaned, replace(again, warnings=(*again.warnings, str(summary)))


def _sure(found: Calibration | AmiwarpError) -> bool:
    return not isinstance(found, AmiwarpError) and found.photometric is not None and found.photometric.accepted


def _doubtful(found: Calibration | AmiwarpError) -> bool:
    """Whether a camera that turns could be why the events are not explained."""
    if isinstance(found, AmiwarpError):
        return isinstance(found, checks.NotSharp)
    return found.photometric is not None and found.photometric.cost > STILL_COST


def _why_doubtful(
    recording: Recording,
    settings: Settings,
    found: Calibration | AmiwarpError,
    device: Any,
    progress: Progress | None,
) -> Calibration | AmiwarpError:
    """The answer with the camera's motion free, or ``found``; or the error that the encoder's scale is wrong.

    A slow camera motion explains some of what a wrong scale does to the events, and the reverse: where it leaves more
    than a still scene does, the cause that leaves less is named.
    """
    moving = found if settings.free is not None else _turning(recording, settings, found, device, progress)
    if moving is not found and _cost(moving) <= STILL_COST:
        return moving
    scaled = _scaled(recording, settings, found, device, progress)
    if scaled is None or (moving is not found and _cost(moving) <= scaled[1]):
        return moving
    turns, cost = scaled
    return checks.wrong_scale(recording.name, turns, "the events repeat", _cost(found), cost)


def _cost(found: Calibration | AmiwarpError) -> float:
    return 1.0 if isinstance(found, AmiwarpError) or found.photometric is None else found.photometric.cost


def _scaled(
    recording: Recording,
    settings: Settings,
    found: Calibration | AmiwarpError,
    device: Any,
    progress: Progress | None,
) -> tuple[float, float] | None:
    """Turns of the encoder in which the events repeat, and the cost if that is one turn; None if it explains no more.

    The events of a still scene repeat every turn; if they do so at another angle, the encoder's scale may be wrong.
    """
    encoder = recording.encoder
    assert encoder is not None
    try:
        turns = turns_per_turn(recording, encoder)
    except AmiwarpError:
        return None  # the events do not repeat: the scene or the camera moves
    if abs(turns - 1.0) < LEAST_SCALE_ERROR:
        return None
    right = replace(encoder, angle=encoder.angle / turns, index_t=None)
    again = _try(replace(recording, encoder=right), settings, device, progress)
    return (turns, _cost(again)) if _sure(again) and _cost(again) <= TURNING_GAIN * _cost(found) else None


def _turning(
    recording: Recording,
    settings: Settings,
    found: Calibration | AmiwarpError,
    device: Any,
    progress: Progress | None,
) -> Calibration | AmiwarpError:
    """The same with the camera's motion free, where that explains the events so much better; else ``found``."""
    free = (size_name(settings.model), "phase", "motion")
    moving = _try(recording, replace(settings, free=free), device, progress)
    if isinstance(moving, AmiwarpError) or moving.photometric is None or not moving.photometric.accepted:
        return found
    if moving.photometric.cost > TURNING_GAIN * _cost(found):
        return found
    speed = math.degrees(math.hypot(*(moving.parameters[n] for n in RATES)))
    # the prism is what the calibration is for; the camera's motion was that of two turns in the middle
    prism = {n: x for n, x in moving.parameters.items() if n not in MOTION}
    return replace(
        moving,
        parameters=prism,
        uncertainty={n: x for n, x in moving.uncertainty.items() if n not in MOTION},
        free=tuple(n for n in moving.free if n not in MOTION),
        middle_us=None,
        warnings=(*moving.warnings, f"the camera turned at {speed:.1f} deg/s: found with its motion free"),
    )


def _check_confirmed(found: Calibration, name: str) -> None:
    """Sharpness alone may be tenths of a pixel off: without the second stage's word there is no answer."""
    if _sure(found):
        return
    reasons = [w for w in found.warnings if "photometric" in w]
    raise AmiwarpError(
        f"{name}: {'; '.join(reasons)}; the answer of sharpness alone may be several tenths of a pixel off: "
        "take it with --stages sharpness, or record a scene that stays still"
    )


def attempt(recording: Recording, settings: Settings, device: Any, progress: Progress | None) -> Calibration:
    """Both stages once, with what is free as told."""
    began = time.perf_counter()
    recording = moving_window(recording, settings)
    searches = prepare(recording, settings, device=device, progress=progress)
    for search in searches:
        search.run()
    search = max(searches, key=lambda s: s.score)
    best = search.best
    warnings, uncertainty = search.judge(recording.name)
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
        zero_us=_middle(recording) if recording.encoder is None and search.space.sized else None,
        middle_us=search.space.middle_us if search.space.moving else None,
        events=len(search.material.events),
        seconds=time.perf_counter() - began,
        warnings=warnings,
    )
    if "photometric" in settings.stages:
        result = _second_stage(recording, search, result, progress)
    return replace(result, seconds=time.perf_counter() - began)


def _second_stage(recording: Recording, search: Search, result: Calibration, progress: Progress | None) -> Calibration:
    """The answer of the photometric stage, or that of sharpness with a warning that says why."""
    try:
        found, summary = refine(recording, search, linear(search.settings), progress=progress)
    except AmiwarpError as error:
        return replace(result, warnings=(*result.warnings, f"no photometric stage: {error}"))
    after = search.fine.values(dict(found.parameters))
    kept = (after - result.sharpness_before) / max(result.sharpness_after - result.sharpness_before, 1e-12)
    if found.accepted and kept < LEAST_SHARPNESS_KEPT:
        much = f"keeps only {100 * kept:.0f} %" if kept > 0.005 else "keeps nothing"
        verdict = f"{much} of what sharpness gained: events are missing, or the scene moved"
        found = replace(found, accepted=False, verdict=verdict)
    if found.held:
        vain = f"the events do not determine {', '.join(found.held)}: not moved by the photometric stage"
        result = replace(result, warnings=(*result.warnings, vain))
    result = replace(result, stages=(*result.stages, summary), photometric=found)
    if not found.accepted:
        return replace(result, warnings=(*result.warnings, f"photometric stage: {found.verdict}"))
    return replace(result, parameters=found.parameters, uncertainty=found.uncertainty, sharpness_after=after)


def prepare(
    recording: Recording, settings: Settings, *, device: Any = "cpu", progress: Progress | None = None
) -> list[Search]:
    """The search that the recording asks for; two, one each way round, where the prism's speed is unknown.

    For ``auto``, that of the exact model: its answer is what the smaller ones are fitted to.
    """
    if settings.model == AUTO:
        settings = replace(settings, model="exact")
    name, camera = recording.name, _camera(recording)
    checks.check_events(len(recording.events), name)
    encoders, free = _encoders(recording, settings)
    events = thin(recording, settings.events)
    if isinstance(recording.events, Masked) and len(events) < settings.events:
        checks.check_left(len(events), recording.events.mask, name)
    searches = []
    for encoder in encoders:
        checks.check_coverage(encoder, int(events.t[0]), int(events.t[-1]), name)
        checks.check_pulses(encoder, name)
        space = _space(recording, camera, encoder, events, settings, free)
        material = _material(events, encoder, space, _middle(recording), settings.fold)
        if space.sized:
            checks.check_turn(encoder.angle_at(events.t[:: max(1, len(events) // 10_000)]), name)
        searches.append(Search(space, material, settings, device, progress))
    return searches


def moving_window(recording: Recording, settings: Settings) -> Recording:
    """The two turns in the recording's middle where the camera's motion is free: for longer it moves otherwise."""
    if not settings.free or not {"motion", *MOTION} & set(settings.free):
        return recording
    encoder, events = recording.encoder, recording.events
    rpm = settings.start.get("rpm", 0.0) if encoder is None else encoder.rpm
    length = MOVING_TURNS * 60e6 / abs(rpm) if abs(rpm) > 1e-3 else MOVING_US
    middle = _middle(recording)
    cut = events.between(round(middle - length / 2), round(middle + length / 2))
    return replace(recording, events=MemoryEvents(cut, *events.size))


def linear(settings: Settings) -> tuple[str, ...]:
    """What is free in the equations of the photometric stage themselves."""
    return tuple(n for n in settings.free or () if n in LINEAR)


def _camera(recording: Recording) -> Camera:
    if recording.camera is None:
        raise AmiwarpError(f"{recording.name}: the camera is unknown; give its intrinsics or its field of view")
    return recording.camera


def _encoders(recording: Recording, settings: Settings) -> tuple[list[Encoder], tuple[str, ...]]:
    """The recording's encoder; or constant speeds found in the events, both ways round. And what is to be free."""
    free = (size_name(settings.model), "phase") if settings.free is None else settings.free
    free = tuple(n for n in free if n not in LINEAR)
    if not {"apex", "deflection", "phase"} & set(free) and settings.start.get(size_name(settings.model)) == 0.0:
        return [constant_speed(0.0, recording.events.t_first, recording.events.t_last, _middle(recording))], free
    if recording.encoder is not None:
        if "rpm" in free or "rpm" in settings.start:
            raise AmiwarpError(f"{recording.name}: the encoder gives the rpm; leave it out, or free clock_offset")
        return [recording.encoder], free
    if "clock_offset" in free or "clock_offset" in settings.start:
        raise AmiwarpError(f"{recording.name}: has no encoder, so clock_offset is part of the phase; leave it out")
    rpm = settings.start.get("rpm")
    speeds = [rpm] if rpm is not None else [s * estimate_rpm(recording) for s in (1.0, -1.0)]
    first, last = recording.events.t_first, recording.events.t_last
    encoders = [constant_speed(s, first, last, _middle(recording)) for s in speeds]
    return encoders, free if "rpm" in free else (*free, "rpm")


def _middle(recording: Recording) -> int:
    """Where a change of speed changes the phase least [us]."""
    return (recording.events.t_first + recording.events.t_last) // 2


def _space(
    recording: Recording,
    camera: Camera,
    encoder: Encoder,
    events: Events,
    settings: Settings,
    free: tuple[str, ...],
) -> ParameterSpace:
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


def _material(events: Events, encoder: Encoder, space: ParameterSpace, middle: int, fold: int) -> Material:
    if fold and (space.moving or {"clock_offset", "rpm"} & set(space.names)):
        raise AmiwarpError(
            f"fold = {fold} with {', '.join(space.names)} free: folding forgets when an event came; leave it out"
        )
    if "clock_offset" in space.start:
        encoder = encoder.with_clock_offset(space.start["clock_offset"])
    if "clock_offset" in space.names:
        return Material(events, encoder, lambda t: encoder.speed_at(t) * 1e-6)
    if "rpm" in space.names:
        return Material(events, encoder, lambda t: (t - middle).astype(np.float64) * (2.0 * math.pi / 60e6))
    return Material(events, encoder, None, fold)
