"""Calibration by He et al. (Science Robotics 2024), for comparison: circle model, their cost J, and a grid search.

The grid is refined about the values that the hardware gives: the nominal prism and the mounted phase. The paper states
neither the grid nor η. As in the paper, the result is not checked and has no uncertainty.
"""

import math
import time
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.calib.checks import size_warnings
from amiwarp.calib.nlopt_solver import best_of
from amiwarp.calib.preparation import prepare
from amiwarp.calib.settings import STAGES, Settings
from amiwarp.calib.sharpness_search import Search
from amiwarp.calib.start_burst import without_start_burst
from amiwarp.calib.without_encoder import path_of, zero_time
from amiwarp.choices import Sharpness
from amiwarp.events.recording import MemoryEvents, Recording
from amiwarp.results.calibration import Calibration, StageSummary
from amiwarp.results.search_stage import SearchStage
from amiwarp.tasks import Progress, part, silent

WINDOW_US = 2_000_000
"""Duration of the events that the paper calibrates on [us]."""
LEVELS = 3
"""Number of successive grids, each as wide as two steps of the previous grid."""
SIDE = 11
"""Number of values of each parameter on a grid."""
SIZE_RANGE = (0.5, 1.5)
"""Lowest and highest deflection on the first grid, relative to the nominal deflection."""
PHASE_RANGE = math.radians(45.0)
"""Half width of the range of phases on the first grid, about the mounted phase [rad]. If no phase is given, the grid
spans a full turn."""


def calibrate_as_paper(
    recording: Recording,
    *,
    start: Mapping[str, float] | None = None,
    device: Any = "cpu",
    progress: Progress | None = None,
) -> Calibration:
    """Return a calibration by the paper's method from the recording's first 2 s.

    Without an encoder, the prism's speed or path is found as :func:`amiwarp.calibrate` finds it; the result then holds
    for these 2 s only. ``start`` may give the mounted phase [rad]. Raises :class:`AmiwarpError` if the recording does
    not suit a calibration: too few events, or an encoder that does not cover them.
    """
    began = time.perf_counter()
    recording, warnings = without_start_burst(recording)
    source = recording.events
    cut = source.between(source.t_first, source.t_first + WINDOW_US)
    given = dict(start or {})
    settings = Settings(
        model="circle", sharpness=Sharpness.PAPER_J, events=len(cut), stages=STAGES[:1], start=given
    )
    used = replace(recording, events=MemoryEvents(cut, *source.size))
    searches = prepare(used, settings, device=device)
    report = progress or silent
    share = 1.0 / len(searches)
    stages = [
        _grid_search(
            search, mounted="phase" in given, progress=part(report, k * share, (k + 1) * share)
        )
        for k, search in enumerate(searches)
    ]
    # without an encoder, both senses of rotation are tried
    stage, search = max(zip(stages, searches, strict=True), key=lambda found: found[0].score)
    best = search.space.to_values(stage.x)
    return Calibration(
        model_name="circle",
        camera=search.space.camera,
        prism=search.space.prism,
        parameters=best,
        uncertainty={},
        free=search.space.names,
        sharpness_name=Sharpness.PAPER_J.value,
        sharpness_before=search.fine.values({**best, search.space.size_name: 0.0}),
        sharpness_after=stage.score,
        stages=(
            StageSummary.of(
                "grid", stage, search.space.names, map(search.space.to_values, stage.points)
            ),
        ),
        zero_us=zero_time(used, search),
        path=path_of(used, search),
        events=len(cut),
        seconds=time.perf_counter() - began,
        warnings=(*warnings, *size_warnings(recording)),
    )


def _grid_search(search: Search, *, mounted: bool, progress: Progress) -> SearchStage:
    """Return the best point of successively finer grids; ``mounted``: whether the phase of the mount is given."""
    space = search.space
    began = time.perf_counter()
    nominal = space.start
    size = nominal[space.size_name]
    phase = nominal["phase"]
    size_half = 0.5 * (SIZE_RANGE[1] - SIZE_RANGE[0]) * size
    phase_half = PHASE_RANGE if mounted else math.pi
    columns = SIDE if mounted else round(SIDE * math.pi / PHASE_RANGE)
    points: list[NDArray[np.float64]] = []
    scores: list[float] = []
    budget = SIDE * columns + (LEVELS - 1) * SIDE * SIDE
    for _ in range(LEVELS):
        sizes = np.linspace(size - size_half, size + size_half, SIDE)
        phases = np.linspace(phase - phase_half, phase + phase_half, columns)
        for s in sizes:
            for p in phases:
                v = space.to_vector({**nominal, space.size_name: float(s), "phase": float(p)})
                points.append(v)
                scores.append(search.fine(v))
                progress("calibrating, global", len(points) / budget)
        size, phase = (
            space.to_values(points[int(np.argmax(scores))])[n] for n in (space.size_name, "phase")
        )
        size_half = 2.0 * size_half / (SIDE - 1)
        phase_half = 2.0 * phase_half / (columns - 1)
        columns = SIDE
    return best_of("grid", points, scores, seconds=time.perf_counter() - began, ended="its budget")
