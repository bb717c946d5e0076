"""Preparation of a search: the encoder, the events and the parameter space for a recording."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from amiwarp.calib import checks
from amiwarp.calib.bad_pixels import MaskedEventSource
from amiwarp.calib.parameters import MOTION, RATES, ParameterSpace, nominal, size_name
from amiwarp.calib.prism_speed import estimate_rpm
from amiwarp.calib.result import constant_speed
from amiwarp.calib.rotation_estimate import estimate_rates
from amiwarp.calib.sharpness.calibration_events import CalibrationEvents
from amiwarp.calib.sharpness.search import AUTO, Search, Settings
from amiwarp.calib.space_setup import make_space
from amiwarp.calib.thinning import thin
from amiwarp.errors import AmiwarpError
from amiwarp.events.encoder import Encoder
from amiwarp.events.events import Events, MemoryEvents
from amiwarp.progress import Progress

if TYPE_CHECKING:
    from amiwarp.events.recording import Recording
    from amiwarp.optics.camera import Camera

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
    free = (size_name(settings.model), "phase") if settings.free is None else settings.free
    free = tuple(n for n in free if n not in LINEAR_UNKNOWNS)
    if not {"apex", "deflection", "phase"} & set(free) and settings.start.get(size_name(settings.model)) == 0.0:
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
