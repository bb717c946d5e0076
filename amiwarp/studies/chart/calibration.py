"""The calibration's rows: models, algorithms, events, folding and the photometric stage, each against the truth."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from amiwarp.calib import Calibration, Settings, calibrate
from amiwarp.calib.photometric.stage import PhotometricSettings
from amiwarp.calib.presets import settings_to
from amiwarp.calib.sharpness.search import STAGES
from amiwarp.errors import AmiwarpError
from amiwarp.imaging.metrics import model_error
from amiwarp.optics.models import MODELS
from amiwarp.progress import Progress
from amiwarp.studies.chart.rows import Row, Task, Timed, measure, near_front
from amiwarp.studies.chart.truth import Known

JOB = "calibration"
SHARP = STAGES[:1]
EVENTS = (100_000, 300_000, 1_000_000, 10**9)
FOLDS = (1024, 512, 256)
PAIRS = (150_000, 300_000, 600_000, 1_200_000)
GUESS = math.radians(10.0)
"""How far off the phase is from which the search without a global stage starts."""
PAIRS_OF_ALGORITHMS = (
    ("GN_DIRECT_L", "LN_SBPLX"),
    ("GN_DIRECT_L", "LN_COBYLA"),
    ("GN_DIRECT_L", "LN_NELDERMEAD"),
    ("GN_ORIG_DIRECT_L", "LN_BOBYQA"),
    ("GN_CRS2_LM", "LN_BOBYQA"),
    ("GN_MLSL_LDS", "LN_BOBYQA"),
)


@dataclass(frozen=True)
class Setting:
    """One way to calibrate."""

    label: str
    family: str
    settings: Settings
    comparable: bool = True

    def fields(self, device: str) -> dict[str, Any]:
        """Of the row."""
        both = "both stages" if self.settings.stages == STAGES else "sharpness alone"
        plain = settings_to(self.settings)
        return {"chart": "calibration", "job": JOB, "label": self.label, "family": self.family,
                "mark": both if self.comparable else "with a guess", "settings": {**plain, "device": device},
                "default": plain == settings_to(Settings()), "comparable": self.comparable}  # fmt: skip


def settings(known: Known, *, quick: bool) -> list[Setting]:
    """The sensible combinations, the default first."""
    if quick:
        few = Settings(events=50_000, global_evaluations=60)
        return [
            Setting("default", "default", Settings()),
            Setting("50 k events, sharpness", "events", replace(few, stages=SHARP)),
            Setting("circle, 50 k events, sharpness", "model", replace(few, model="circle", stages=SHARP)),
        ]
    return [*_stages(known), *_events(), *_folds(), *_algorithms(), *_photometric(), *_mixed()]


def _both(label: str, family: str, s: Settings) -> Iterator[Setting]:
    yield Setting(label, family, s)
    yield Setting(f"{label}, sharpness", family, replace(s, stages=SHARP))


def _stages(known: Known) -> Iterator[Setting]:
    yield from _both("default", "default", Settings())
    for model in MODELS:
        yield from _both(model, "model", Settings(model=model))
    guess = Settings(global_algorithm=None, start={"phase": known.model.phase + GUESS})
    for way in _both("local search from a guess", "algorithms", guess):
        yield replace(way, comparable=False)


def _events() -> Iterator[Setting]:
    for n in EVENTS[:-1]:
        if n != Settings().events:
            name = f"{n // 1000} k" if n < 1_000_000 else f"{n // 1_000_000} M"
            yield from _both(f"{name} events", "events", Settings(events=n))
    # the photometric stage takes pairs of its own: more events would only take longer to start it
    yield Setting("all events, sharpness", "events", Settings(events=EVENTS[-1], stages=SHARP))


def _folds() -> Iterator[Setting]:
    """Folded, all events may cost little more than some."""
    for bins in (0, *FOLDS):
        if bins != Settings().fold:
            yield Setting(f"{_folded(bins)}, sharpness", "folding", Settings(fold=bins, stages=SHARP))
    if FOLDS[-1] != Settings().fold:
        yield Setting(_folded(FOLDS[-1]), "folding", Settings(fold=FOLDS[-1]))
    for bins in FOLDS:
        s = Settings(events=EVENTS[-1], fold=bins, stages=SHARP)
        yield Setting(f"all events, {_folded(bins)}, sharpness", "folding", s)


def _folded(bins: int) -> str:
    return f"folded to {bins} angles" if bins else "not folded"


def _algorithms() -> Iterator[Setting]:
    for first, second in PAIRS_OF_ALGORITHMS:
        s = Settings(global_algorithm=first, local_algorithm=second, stages=SHARP)
        yield Setting(f"{first[3:]} + {second[3:]}, sharpness", "algorithms", s)
    for budget in (60, 240):
        yield Setting(f"{budget} global steps, sharpness", "algorithms",
                      Settings(global_evaluations=budget, stages=SHARP))  # fmt: skip


def _photometric() -> Iterator[Setting]:
    for pairs in PAIRS:
        if pairs != PhotometricSettings().pairs:
            yield Setting(f"{pairs // 1000} k pairs", "pairs", Settings(photometric=PhotometricSettings(pairs=pairs)))
    yield Setting("photometric by BOBYQA", "algorithms",
                  Settings(photometric=PhotometricSettings(algorithm="LN_BOBYQA")))  # fmt: skip


def _mixed() -> Iterator[Setting]:
    """Few events for a start that the photometric stage mends."""
    for events, pairs in itertools.product(EVENTS[:2], PAIRS[:2]):
        if events != Settings().events and pairs != PhotometricSettings().pairs:
            s = Settings(events=events, photometric=PhotometricSettings(pairs=pairs))
            yield Setting(f"{events // 1000} k events, {pairs // 1000} k pairs", "events and pairs", s)


def rows(
    known: Known, device: str, *, repeats: int, quick: bool, seed: int, tell: Progress
) -> tuple[list[Row], list[str]]:
    """All rows, and notes on settings that the calibration refuses on this recording."""
    ways = settings(known, quick=quick)

    def run(s: Settings) -> Calibration | AmiwarpError:
        try:
            return calibrate(known.recording, replace(s, seed=seed), device=device)
        except AmiwarpError as error:
            return error

    tell("calibrating", 0.0)
    for s in _kinds(ways):
        short = run(_shortened(s))
        if isinstance(short, AmiwarpError) or (s.stages == STAGES and short.photometric is None):
            run(s)  # the short one may have ended before it came to every kernel
    tasks = [Task(partial(run, way.settings), len(known.events), way.fields(device)) for way in ways]

    def row(t: Timed) -> Row | None:
        found: Calibration | AmiwarpError = t.result
        return None if isinstance(found, AmiwarpError) else t.row(model_error(found.model, known.model).rms)

    timed = measure(tasks, repeats, partial(tell, "calibrating"), warm_up=False,
                    again=lambda once: near_front([row(t) for t in once]))  # fmt: skip
    notes = []
    for t, way in zip(timed, ways, strict=True):
        if isinstance(t.result, AmiwarpError):
            notes.append(f"{way.label}: refused, {t.result}")
        elif way.settings.stages == STAGES and (t.result.photometric is None or not t.result.photometric.accepted):
            notes.append(f"{way.label}: kept the answer of sharpness")
    return [found for found in map(row, timed) if found is not None], notes


def _kinds(ways: list[Setting]) -> list[Settings]:
    """One setting of each kind: its kernels are compiled off the clock."""
    every = (way.settings for way in ways)
    return list({(s.model, s.stages, s.fold > 0, s.photometric.algorithm): s for s in every}.values())


def _shortened(s: Settings) -> Settings:
    few = PhotometricSettings(pairs=20_000, algorithm=s.photometric.algorithm)
    return replace(s, events=20_000, global_evaluations=20, local_evaluations=10, photometric=few)
