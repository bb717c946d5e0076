"""Measurement of the calibration chart: models, algorithms, numbers of events, folding of turns, photometric stage.

Each measured setting is a row of the chart. Folding merges the events of all turns that have the same pixel, polarity
and bin of the prism angle. Each result is compared with the ground truth.
"""

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from amiwarp.calib import Calibration, Settings, calibrate
from amiwarp.calib.presets import settings_to
from amiwarp.calib.settings import STAGES, PhotometricSettings
from amiwarp.errors import AmiwarpError
from amiwarp.imaging.metrics import model_error
from amiwarp.optics.models import rungs
from amiwarp.progress import Progress
from amiwarp.studies.chart.rows import KnownRecording, Row, Task, Timed, measure, near_front

JOB = "calibration"
"""Name of the job to which all rows of the calibration chart belong."""
SHARP = STAGES[:1]
"""Stages of a calibration that uses sharpness alone."""
EVENTS = (100_000, 300_000, 1_000_000, 10**9)
"""Numbers of events with which the calibration is measured; the last one means all events."""
FOLDS = (1024, 512, 256)
"""Numbers of prism angles per turn to which the events are folded."""
PAIRS = (150_000, 300_000, 600_000, 1_200_000)
"""Numbers of event pairs with which the photometric stage is measured."""
GUESS = math.radians(10.0)
"""Phase error [rad] of the start phase that is given to a search without a global stage."""
PAIRS_OF_ALGORITHMS = (
    ("GN_DIRECT_L", "LN_SBPLX"),
    ("GN_DIRECT_L", "LN_COBYLA"),
    ("GN_DIRECT_L", "LN_NELDERMEAD"),
    ("GN_ORIG_DIRECT_L", "LN_BOBYQA"),
    ("GN_CRS2_LM", "LN_BOBYQA"),
    ("GN_MLSL_LDS", "LN_BOBYQA"),
)
"""Pairs of global and local search algorithm that are measured."""


@dataclass(frozen=True)
class CalibrationSetting:
    """Setting of a calibration that the chart measures."""

    label: str
    """Name of the setting in the chart."""
    family: str
    """Family of the setting, which determines its colour in the chart."""
    settings: Settings
    """Settings of the calibration."""
    comparable: bool = True
    """False if the calibration needs a guess of the phase, so that it cannot be compared with the others."""

    def fields(self, device: str) -> dict[str, Any]:
        """Return the fields of the setting's row that do not depend on the measurement."""
        both = "both stages" if self.settings.stages == STAGES else "sharpness alone"
        plain = settings_to(self.settings)
        return {"chart": "calibration", "job": JOB, "label": self.label, "family": self.family,
                "mark": both if self.comparable else "with a guess", "settings": {**plain, "device": device},
                "default": plain == settings_to(Settings()), "comparable": self.comparable}  # fmt: skip


def settings(known: KnownRecording, *, quick: bool) -> list[CalibrationSetting]:
    """Return the calibration settings that the chart measures, the default first."""
    if quick:
        few = Settings(events=50_000, global_evaluations=60)
        return [
            CalibrationSetting("default", "default", Settings()),
            CalibrationSetting("50 k events, sharpness", "events", replace(few, stages=SHARP)),
            CalibrationSetting("circle, 50 k events, sharpness", "model", replace(few, model="circle", stages=SHARP)),
        ]
    return [*_stages(known), *_events(), *_folds(), *_algorithms(), *_photometric(), *_mixed()]


def _both(label: str, family: str, s: Settings) -> Iterator[CalibrationSetting]:
    """Yield a setting with both stages of the calibration, and the same setting with sharpness alone."""
    yield CalibrationSetting(label, family, s)
    yield CalibrationSetting(f"{label}, sharpness", family, replace(s, stages=SHARP))


def _stages(known: KnownRecording) -> Iterator[CalibrationSetting]:
    """Yield the default setting, every model, and the local search that starts from a guess."""
    yield from _both("default", "default", Settings())
    for model in rungs():
        yield from _both(model, "model", Settings(model=model))
    guess = Settings(global_algorithm=None, start={"phase": known.model.phase + GUESS})
    for way in _both("local search from a guess", "algorithms", guess):
        yield replace(way, comparable=False)


def _events() -> Iterator[CalibrationSetting]:
    """Yield settings with other numbers of events than the default."""
    for n in EVENTS[:-1]:
        if n != Settings().events:
            name = f"{n // 1000} k" if n < 1_000_000 else f"{n // 1_000_000} M"
            yield from _both(f"{name} events", "events", Settings(events=n))
    # the photometric stage selects its own pairs, so more events would only delay its start
    yield CalibrationSetting("all events, sharpness", "events", Settings(events=EVENTS[-1], stages=SHARP))


def _folds() -> Iterator[CalibrationSetting]:
    """Yield settings with other numbers of angles for folding.

    Folded, all events may cost little more than a part of them.
    """
    for bins in (0, *FOLDS):
        if bins != Settings().fold:
            yield CalibrationSetting(f"{_folded(bins)}, sharpness", "folding", Settings(fold=bins, stages=SHARP))
    if FOLDS[-1] != Settings().fold:
        yield CalibrationSetting(_folded(FOLDS[-1]), "folding", Settings(fold=FOLDS[-1]))
    for bins in FOLDS:
        s = Settings(events=EVENTS[-1], fold=bins, stages=SHARP)
        yield CalibrationSetting(f"all events, {_folded(bins)}, sharpness", "folding", s)


def _folded(bins: int) -> str:
    """Return the label of a setting that folds events to ``bins`` angles; 0: no folding."""
    return f"folded to {bins} angles" if bins else "not folded"


def _algorithms() -> Iterator[CalibrationSetting]:
    """Yield settings with other search algorithms and numbers of search steps."""
    for first, second in PAIRS_OF_ALGORITHMS:
        s = Settings(global_algorithm=first, local_algorithm=second, stages=SHARP)
        yield CalibrationSetting(f"{first[3:]} + {second[3:]}, sharpness", "algorithms", s)
    for budget in (60, 240):
        yield CalibrationSetting(f"{budget} global steps, sharpness", "algorithms",
                      Settings(global_evaluations=budget, stages=SHARP))  # fmt: skip


def _photometric() -> Iterator[CalibrationSetting]:
    """Yield settings with other algorithms and numbers of pairs for the photometric stage."""
    for pairs in PAIRS:
        if pairs != PhotometricSettings().pairs:
            yield CalibrationSetting(
                f"{pairs // 1000} k pairs", "pairs", Settings(photometric=PhotometricSettings(pairs=pairs))
            )
    by_bobyqa = Settings(photometric=PhotometricSettings(algorithm="LN_BOBYQA"))
    yield CalibrationSetting("photometric by BOBYQA", "algorithms", by_bobyqa)


def _mixed() -> Iterator[CalibrationSetting]:
    """Yield settings with few events for the first stage, whose error the photometric stage corrects."""
    for events, pairs in itertools.product(EVENTS[:2], PAIRS[:2]):
        if events != Settings().events and pairs != PhotometricSettings().pairs:
            s = Settings(events=events, photometric=PhotometricSettings(pairs=pairs))
            yield CalibrationSetting(f"{events // 1000} k events, {pairs // 1000} k pairs", "events and pairs", s)


def rows(
    known: KnownRecording, device: str, *, repeats: int, quick: bool, seed: int, progress: Progress
) -> tuple[list[Row], list[str]]:
    """Measure all settings; return their rows, and notes on settings that the calibration refuses on this recording."""
    ways = settings(known, quick=quick)

    def run(s: Settings) -> Calibration | AmiwarpError:
        try:
            return calibrate(known.recording, replace(s, seed=seed), device=device)
        except AmiwarpError as error:
            return error

    progress("calibrating", 0.0)
    for s in _kinds(ways):
        short = run(_shortened(s))
        if isinstance(short, AmiwarpError) or (s.stages == STAGES and short.photometric is None):
            run(s)  # the short run may have ended before it used every kernel
    tasks = [Task(partial(run, way.settings), len(known.events), way.fields(device)) for way in ways]

    def row(t: Timed) -> Row | None:
        found: Calibration | AmiwarpError = t.result
        return None if isinstance(found, AmiwarpError) else t.row(model_error(found.model, known.model).rms)

    timed = measure(tasks, repeats, progress, "calibrating", warm_up=False, release=True,
                    again=lambda once: near_front([row(t) for t in once]))  # fmt: skip
    notes = []
    for t, way in zip(timed, ways, strict=True):
        if isinstance(t.result, AmiwarpError):
            notes.append(f"{way.label}: refused, {t.result}")
        elif way.settings.stages == STAGES and (t.result.photometric is None or not t.result.photometric.accepted):
            notes.append(f"{way.label}: the photometric stage kept the result of sharpness")
    return [found for found in map(row, timed) if found is not None], notes


def _kinds(ways: list[CalibrationSetting]) -> list[Settings]:
    """Return one setting of each kind. They run before the measurement, so that their kernels are compiled."""
    every = (way.settings for way in ways)
    return list({(s.model, s.stages, s.fold > 0, s.photometric.algorithm): s for s in every}.values())


def _shortened(s: Settings) -> Settings:
    """Return a setting with few events and steps, for a short run."""
    few = PhotometricSettings(pairs=20_000, algorithm=s.photometric.algorithm)
    return replace(s, events=20_000, global_evaluations=20, local_evaluations=10, photometric=few)
