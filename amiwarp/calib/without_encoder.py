"""The path of the prism's angle in a recording without an encoder: a constant speed, or a path found in the events.

A speed can be found in either sense of rotation. Whether it varies is examined for a still camera.
"""

from __future__ import annotations

from dataclasses import replace

from amiwarp.calib.calibration_events import CalibrationEvents
from amiwarp.calib.photometric.stated_errors import BOUND
from amiwarp.calib.preparation import prepare
from amiwarp.calib.prism_path import (
    FIRST_SHARE,
    GATE_PAIRS,
    GATE_TILES,
    LEAST_DEVIATION_PX,
    PathFit,
)
from amiwarp.calib.sharpness_search import Search
from amiwarp.calib.thinning import middle_time
from amiwarp.errors import AmiwarpError
from amiwarp.events.encoder import Encoder
from amiwarp.events.recording import Recording
from amiwarp.optics.models.registry import MODELS
from amiwarp.results.calibration import (
    constant_speed,
)

VARYING_SPEED = "a speed that varies"
"""Words of what could hide in the angle of a recording without an encoder."""


def zero_time(recording: Recording, search: Search) -> int | None:
    """Return the time at which the prism's angle of a calibration without an encoder is 0 [us]; else None."""
    return middle_time(recording) if recording.encoder is None and search.space.sized else None


def path_of(recording: Recording, search: Search) -> Encoder | None:
    """Return the path of the prism's angle that a search without an encoder follows; None for an encoder or a speed."""
    if recording.encoder is None and _on_path(search):
        return search.calibration_events.encoder
    return None


def _on_path(search: Search) -> bool:
    """Return whether the search for a recording without an encoder has a path, not a constant speed."""
    return search.space.sized and "rpm" not in search.space.start


def path_is_examined(search: Search) -> bool:
    """Return whether the path of the prism's angle is examined: for a still camera, if no speed is given."""
    space = search.space
    settings = search.settings
    given = "rpm" in settings.start or "rpm" in (settings.free or ())
    # A ripple within a turn looks like harmonics of a vibration.
    vibrates = not MODELS[space.model].PRISM
    if given or vibrates or "photometric" not in settings.stages:
        return False
    return space.cartesian and not space.moving


def with_path(recording: Recording, search: Search) -> tuple[Search, dict[str, float]]:
    """Return the search with the path of the prism's angle, or unchanged if a constant speed explains the events.

    Also return by how much the path may still move events [px rms], by words; nothing if it was not examined.
    """
    varies = _on_path(search)
    encoder = search.calibration_events.encoder
    if not varies:
        first = recording.events.t_first
        last = recording.events.t_last
        encoder = constant_speed(search.best["rpm"], first, last, middle_time(recording))
    try:
        start = search_on(encoder, search)
        # Few pairs are enough to see that a speed is constant.
        if not varies:
            quick = PathFit(recording, start, GATE_PAIRS, GATE_TILES)
            if not quick.deviates():
                return search, _hidden_by_speed(quick)
        fit = PathFit(recording, start)
        path = fit.run()
    except AmiwarpError:
        if varies:
            raise
        return search, {}
    if not varies and fit.deviation_px() < LEAST_DEVIATION_PX:
        return search, _hidden_by_speed(fit)
    found = search_on(path, search)
    return found.run(found.best), {VARYING_SPEED: BOUND * fit.std_px}


def _hidden_by_speed(fit: PathFit) -> dict[str, float]:
    """Return by how much a path that is not corrected may move events [px rms], by words.

    A fit that ended with its first step found a part of the deviation.
    """
    return {VARYING_SPEED: fit.deviation_px() / FIRST_SHARE + BOUND * fit.std_px}


def in_larger_sense(recording: Recording, search: Search) -> Search:
    """Return the search in the sense of rotation in which the circle is the larger one, if there are two."""
    best = search.best
    space = search.space
    values = MODELS[space.model].reversed_values(best)
    if values is None or "rpm" not in space.names:
        return search
    if values[space.size_name] <= best[space.size_name]:
        return search

    rpm = -best["rpm"]
    settings = replace(search.settings, start={**search.settings.start, "rpm": rpm})
    reversed_search, *_ = prepare(
        recording, settings, device=search.device, progress=search.progress
    )
    start = {**reversed_search.space.start, **values, "rpm": rpm}
    return reversed_search.at(start, stages=search.stages).run(start)


def search_on(path: Encoder, search: Search) -> Search:
    """Return a search like another one, at its answer, for a path of the prism's angle."""
    space = search.full_space
    events = search.calibration_events
    if not _on_path(search):
        # The path holds what a constant speed and its drift described.
        start = {name: value for name, value in space.start.items() if name != "rpm"}
        space = replace(space.without(("rpm",)), start=start, undrifted={})
    on_path = Search.over(
        space,
        CalibrationEvents(events.events, path, None, events.fold),
        search.settings,
        search.device,
        search.progress,
    )
    best = {name: value for name, value in search.best.items() if name != "rpm"}
    return on_path.at(best, stages=search.stages)
