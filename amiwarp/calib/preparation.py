"""Preparation of an attempt: the encoder, the events and the parameter space for a recording."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from amiwarp.calib import checks, first_guess
from amiwarp.calib.bad_pixels import MaskedEventSource
from amiwarp.calib.calibration_events import CalibrationEvents
from amiwarp.calib.camera_rates import estimate_rates
from amiwarp.calib.repetition_path import varying_paths
from amiwarp.calib.settings import AUTO, Settings
from amiwarp.calib.sharpness_search import Search
from amiwarp.calib.thinning import middle_time, thin
from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events.device_events import check_sensor
from amiwarp.events.encoder import Encoder, check_prisms
from amiwarp.events.recording import Events, Recording
from amiwarp.optics.camera import Camera
from amiwarp.optics.models.registry import MODELS, size_names
from amiwarp.optics.rotation_path import RotationPath
from amiwarp.results.calibration import (
    constant_speed,
)
from amiwarp.results.parameters import (
    LINEAR_UNKNOWNS,
    RATES,
    ParameterSpace,
    nominal,
    phase_names,
    units,
)
from amiwarp.results.space_setup import make_space
from amiwarp.tasks import Progress


def prepare(
    recording: Recording,
    settings: Settings,
    path: Encoder | None = None,
    *,
    turned: RotationPath | None = None,
    device: Any = "cpu",
    progress: Progress | None = None,
) -> list[Search]:
    """Return the searches for a recording: one, or one for each sense of rotation if the prism's speed is unknown.

    ``path`` is the path of the prism's angle that was found before, if the recording has no encoder. ``turned`` is the
    rotation of the camera that a gyroscope measured.

    For the model ``auto`` the exact model is searched, to which the smaller models are fitted later.
    Raises :class:`AmiwarpError` if the recording does not suit a calibration.
    """
    if settings.model == AUTO:
        settings = replace(settings, model="exact")
    name = recording.name
    camera = camera_of(recording)
    checks.check_events(len(recording.events), name)
    encoders, free = _encoders(recording, settings, path)
    events = thin(recording, settings.events)
    if isinstance(recording.events, MaskedEventSource) and len(events) < settings.events:
        checks.check_unmasked_events(len(events), recording.events.mask, name)

    searches = []
    kind = MODELS[settings.model]
    for encoder in encoders:
        check_prisms(encoder, kind.ANGLES)
        checks.check_coverage(encoder, int(events.t[0]), int(events.t[-1]), name)
        checks.check_pulses(encoder, name)
        space = _space(recording, camera, encoder, events, settings, free, turned)
        calibration_events = _calibration_events(
            events, encoder, space, middle_time(recording), settings.fold
        )
        if space.sized:
            some_times = events.t[:: max(1, len(events) // 10_000)]
            angles = encoder.angles_at(some_times).reshape(-1, kind.ANGLES)
            for k, which in enumerate(("the prism", "the second prism")[: kind.ANGLES]):
                checks.check_turned(angles[:, k], name, which)
        searches.append(Search.over(space, calibration_events, settings, device, progress))
    return searches


def camera_of(recording: Recording) -> Camera:
    """Return the camera of a recording. Raises :class:`AmiwarpError` if it is unknown."""
    if recording.camera is None:
        raise AmiwarpError(
            f"{recording.name}: the camera is unknown; give --camera or --fov-deg, or in Python "
            "dataclasses.replace(recording, camera=amiwarp.Camera.from_fov(width, height, radians))",
            ErrorCode.CONTENT_MISSING,
        )
    return recording.camera


def _encoders(
    recording: Recording, settings: Settings, path: Encoder | None
) -> tuple[list[Encoder], tuple[str, ...]]:
    """Return the encoders to try and the free parameters.

    Without an encoder these are the known path, or constant speeds: the given one, or the one found in the events with
    either sign. If the events show that the speed varies much, they are paths with either sense of rotation.
    """
    check_sensor(recording.events[:1])
    kind = MODELS[settings.model]
    encoder = recording.encoder
    free = settings.free
    if free is None:
        free = kind.freed(None if encoder is None else encoder.ratio)
    free = tuple(name for name in free if name not in LINEAR_UNKNOWNS)

    def at_speed(rpm: float) -> Encoder:
        source = recording.events
        return constant_speed(rpm, source.t_first, source.t_last, middle_time(recording))

    # Without a prism, its angle does not matter.
    without_prism = settings.start.get(kind.SIZE) == 0.0
    if without_prism and not {*size_names(), "phase"} & set(free):
        return [at_speed(0.0)], free

    if encoder is not None:
        if "rpm" in free or "rpm" in settings.start:
            raise AmiwarpError(
                f"{recording.name}: the encoder gives the rpm; remove rpm from the settings, or free clock_offset",
                ErrorCode.OPTIONS,
            )
        return [encoder], free
    if "clock_offset" in free or "clock_offset" in settings.start:
        raise AmiwarpError(
            f"{recording.name}: the recording has no encoder, so clock_offset is part of the phase; remove "
            "clock_offset from the settings",
            ErrorCode.OPTIONS,
        )
    if path is not None:
        return [path], free

    rpm = settings.start.get("rpm")
    if rpm is not None:
        speeds = [rpm]
    else:
        if "rpm" not in free:
            paths = varying_paths(recording)
            if paths:
                return paths, free
        found = first_guess.estimate_rpm(recording, kind.TIME_BIN_US, kind.MOVER)
        speeds = [found]
        # A motion that can be described by either sense is searched in one.
        either_sense = kind.reversed_values(dict.fromkeys(kind.FREE, 0.0)) is not None
        if not either_sense:
            speeds.append(-found)
    if "rpm" not in free:
        free = (*free, "rpm")
    return [at_speed(speed) for speed in speeds], free


def _space(
    recording: Recording,
    camera: Camera,
    encoder: Encoder,
    events: Events,
    settings: Settings,
    free: tuple[str, ...],
    turned: RotationPath | None,
) -> ParameterSpace:
    """Return the space of the free parameters, started at estimates from the encoder and the events."""
    duration_us = int(events.t[-1]) - int(events.t[0])
    angle = float(np.ptp(encoder.angle_at(events.t[[0, -1]])))

    start = dict(settings.start)
    if "rpm" in free:
        start["rpm"] = encoder.rpm
    if "clock_offset" in free:
        start.setdefault("clock_offset", encoder.clock_offset_us)
    if encoder.ratio is not None:
        start["ratio"] = encoder.ratio
    # The rates are estimated unless a gyroscope or the user gave them.
    of_rotation = RATES if "motion" in free else tuple(name for name in RATES if name in free)
    known = turned is not None or bool(set(RATES) & set(start))
    if of_rotation and not known and angle > 0.0:
        rates = estimate_rates(events, encoder, camera)
        found = dict(zip(RATES, rates, strict=True))
        start |= {name: found[name] for name in of_rotation}

    prism = nominal(recording.prism, MODELS[settings.model])
    space = make_space(
        settings.model,
        camera,
        prism,
        free=free,
        start=start,
        bounds=settings.bounds,
        rad_per_us=angle / max(duration_us, 1),
        duration_us=float(duration_us),
        middle_us=middle_time(recording),
        path=turned,
    )

    # A start outside the bounds would be moved silently.
    for name in sorted(settings.start.keys() - settings.bounds.keys() - phase_names()):
        given = start[name]
        if given != space.start[name]:
            span = f"{space.low[name]:.6g} .. {space.high[name]:.6g} {units()[name]}"
            raise AmiwarpError(
                f"start of {name} = {given:.6g} is not in {span}; give its bounds too (--bound)"
            )
    return space


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
        rad_per_us_per_rpm = 2.0 * math.pi / 60e6
        return CalibrationEvents(
            events, encoder, lambda t: (t - middle).astype(np.float64) * rad_per_us_per_rpm
        )
    return CalibrationEvents(events, encoder, None, fold)
