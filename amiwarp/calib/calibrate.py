"""Calibration: reads the recording, runs both stages, and refuses what the recording cannot determine."""

from __future__ import annotations

import math
import time
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from amiwarp.calib import checks
from amiwarp.calib.panning import estimate_rates
from amiwarp.calib.parameters import MOTION, RATES, Space, make_space, size_name
from amiwarp.calib.photometric import refine
from amiwarp.calib.result import Calibration, constant_speed
from amiwarp.calib.search import Material, Progress, Search, Settings
from amiwarp.calib.speed import estimate_rpm
from amiwarp.encoder import Encoder
from amiwarp.errors import AmiwarpError
from amiwarp.events import Events, MemoryEvents
from amiwarp.optics import Prism

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.camera import Camera
    from amiwarp.events import Recording

NOMINAL_PRISM = Prism(math.radians(2.0))
"""What is assumed where a recording says nothing of its prism: the apex is sought up to twice this."""
LINEAR = ("off_ratio", "leak")
"""Names that are free in the photometric stage alone: unknowns of its linear equations."""
RUN = 8
"""Events that stay together where a recording is thinned: a cache line of times."""
MOVING_TURNS, MOVING_US = 2.1, 100_000.0
"""Length of the window where the camera's motion is free: in turns, or without a prism."""
LEAST_SHARPNESS_KEPT = 0.88
"""The truth is nearly as sharp as the sharpest (0.93 to 0.99 of the gain, measured); what keeps less is none."""


def calibrate(
    recording: Recording,
    settings: Settings | None = None,
    *,
    device: Any = "cpu",
    progress: Progress | None = None,
    **changes: Any,
) -> Calibration:
    """Finds the prism's parameters in the recording itself: those that make the IWE sharpest, and from there, unless
    it cannot be believed, those that make one brightness map explain the events.

    ``changes`` are fields of :class:`Settings`, over ``settings``. Raises :class:`AmiwarpError` where the recording
    cannot determine the parameters: too few events, under a quarter turn, encoder not covering the events, no
    texture, one edge direction.
    """
    began = time.perf_counter()
    settings = replace(settings or Settings(), **changes)
    settings.check()
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
        verdict = f"keeps only {100 * kept:.0f} % of what sharpness gained: events are missing, or the scene moved"
        found = replace(found, accepted=False, verdict=f"{verdict}; kept the answer of sharpness")
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
    """The search that the recording asks for; two, one each way round, where the prism's speed is unknown."""
    name, camera = recording.name, _camera(recording)
    checks.check_events(len(recording.events), name)
    encoders, free = _encoders(recording, settings)
    events = thin(recording, settings.events)
    searches = []
    for encoder in encoders:
        checks.check_coverage(encoder, int(events.t[0]), int(events.t[-1]), name)
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


def thin(recording: Recording, most: int) -> Events:
    """At most ``most`` events, evenly: every k-th run of the recording's; of a file read in blocks."""
    source = recording.events
    step = max(1, -(-len(source) // most))
    if step == 1:
        return Events.concatenate(list(source.blocks()))
    if isinstance(source, MemoryEvents):
        return _runs(source.slice(0, len(source)), step)
    # blocks of whole periods, so that every run but the last is whole
    blocks = source.blocks(count=step * RUN * max(1, (1 << 20) // (step * RUN)))
    return Events.concatenate([_runs(block, step) for block in blocks])


def _runs(block: Events, step: int) -> Events:
    """The first of every ``step`` runs, copied, so that the block itself can go."""
    from amiwarp.kernels.launch import pool

    whole = len(block) // (step * RUN) * step * RUN

    def pick(values: NDArray[Any]) -> NDArray[Any]:
        runs, rest = values[:whole].reshape(-1, step * RUN)[:, :RUN], values[whole : whole + RUN]
        out = np.empty(runs.size + rest.size, values.dtype)
        out[: runs.size].reshape(runs.shape)[:] = runs
        out[runs.size :] = rest
        return out

    return Events(*pool().map(pick, (block.x, block.y, block.t, block.p)))


def _space(
    recording: Recording,
    camera: Camera,
    encoder: Encoder,
    events: Events,
    settings: Settings,
    free: tuple[str, ...],
) -> Space:
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
        settings.model, camera, recording.prism or NOMINAL_PRISM, free=free, start=start, bounds=settings.bounds,
        rad_per_us=turned / max(duration, 1), duration_us=float(duration), middle_us=_middle(recording),
    )  # fmt: skip


def _material(events: Events, encoder: Encoder, space: Space, middle: int, fold: int) -> Material:
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
