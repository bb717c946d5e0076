"""Measurement of the calibration chart: models, algorithms, numbers of events, folding of turns, photometric stage.

Folding merges the events of all turns that have the same pixel, polarity and bin of the prism angle. Each result is
compared with the ground truth.
"""

from __future__ import annotations

import contextlib
import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from amiwarp.calib.calibration import calibrate
from amiwarp.calib.presets import settings_to
from amiwarp.calib.settings import STAGES, PhotometricSettings, Settings
from amiwarp.errors import AmiwarpError
from amiwarp.imaging.metrics import model_error
from amiwarp.optics.models.registry import rungs
from amiwarp.results.calibration import Calibration
from amiwarp.studies.chart.rows import Row, near_front
from amiwarp.studies.chart.timing import Task, Timed, measure, measured_row
from amiwarp.studies.chart.truth import KnownRecording
from amiwarp.tasks import Progress

JOB = "calibration"
"""Name of the job to which all rows of the calibration chart belong."""
SHARPNESS_ONLY = STAGES[:1]
"""Stages of a calibration that uses sharpness alone."""
EVENTS = (100_000, 300_000, 1_000_000, 10**9)
"""Numbers of events with which the calibration is measured; the last one means all events."""
FOLDS = (1024, 512, 256)
"""Numbers of prism angles per turn to which the events are folded."""
PAIRS = (150_000, 300_000, 600_000, 1_200_000)
"""Numbers of event pairs with which the photometric stage is measured."""
GUESS_ERROR_RAD = math.radians(10.0)
"""Error of the start phase that is given to a search without a global stage [rad]."""
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

    def row_fields(self, device: str) -> dict[str, Any]:
        """Return the fields of the setting's row that do not depend on the measurement."""
        both = "both stages" if self.settings.stages == STAGES else "sharpness alone"
        plain = settings_to(self.settings)
        return {
            "chart": JOB,
            "job": JOB,
            "label": self.label,
            "family": self.family,
            "mark": both if self.comparable else "with a guess",
            "settings": {**plain, "device": device},
            "default": plain == settings_to(Settings()),
            "comparable": self.comparable,
        }


def calibration_settings(known: KnownRecording, *, quick: bool) -> list[CalibrationSetting]:
    """Return the calibration settings that the chart measures, the default first."""
    if quick:
        few = Settings(events=50_000, global_evaluations=60)
        return [
            CalibrationSetting("default", "default", Settings()),
            CalibrationSetting(
                "50 k events, sharpness", "events", replace(few, stages=SHARPNESS_ONLY)
            ),
            CalibrationSetting(
                "circle, 50 k events, sharpness",
                "model",
                replace(few, model="circle", stages=SHARPNESS_ONLY),
            ),
        ]
    return [*_models(known), *_events(), *_folds(), *_algorithms(), *_photometric(), *_mixed()]


def _both(label: str, family: str, settings: Settings) -> Iterator[CalibrationSetting]:
    """Yield a setting with both stages of the calibration, and the same setting with sharpness alone."""
    yield CalibrationSetting(label, family, settings)
    yield CalibrationSetting(
        f"{label}, sharpness", family, replace(settings, stages=SHARPNESS_ONLY)
    )


def _models(known: KnownRecording) -> Iterator[CalibrationSetting]:
    """Yield the default setting, every model, and the local search that starts from a guess."""
    yield from _both("default", "default", Settings())
    for model in rungs():
        yield from _both(model, "model", Settings(model=model))
    guess = Settings(global_algorithm=None, start={"phase": known.model.phase + GUESS_ERROR_RAD})
    for setting in _both("local search from a guess", "algorithms", guess):
        yield replace(setting, comparable=False)


def _events() -> Iterator[CalibrationSetting]:
    """Yield settings with other numbers of events than the default."""
    for count in EVENTS[:-1]:
        if count != Settings().events:
            name = f"{count // 1000} k" if count < 1_000_000 else f"{count // 1_000_000} M"
            yield from _both(f"{name} events", "events", Settings(events=count))
    # The photometric stage selects its own pairs, so more events would only delay its start
    yield CalibrationSetting(
        "all events, sharpness", "events", Settings(events=EVENTS[-1], stages=SHARPNESS_ONLY)
    )


def _folds() -> Iterator[CalibrationSetting]:
    """Yield settings with other numbers of angles for folding.

    Folded, all events may cost little more than a part of them.
    """
    for bins in (0, *FOLDS):
        if bins != Settings().fold:
            yield CalibrationSetting(
                f"{_folded(bins)}, sharpness", "folding", Settings(fold=bins, stages=SHARPNESS_ONLY)
            )
    if FOLDS[-1] != Settings().fold:
        yield CalibrationSetting(_folded(FOLDS[-1]), "folding", Settings(fold=FOLDS[-1]))
    for bins in FOLDS:
        settings = Settings(events=EVENTS[-1], fold=bins, stages=SHARPNESS_ONLY)
        yield CalibrationSetting(f"all events, {_folded(bins)}, sharpness", "folding", settings)


def _folded(bins: int) -> str:
    """Return the label of a setting that folds events to ``bins`` angles; 0: no folding."""
    return f"folded to {bins} angles" if bins else "not folded"


def _algorithms() -> Iterator[CalibrationSetting]:
    """Yield settings with other search algorithms and numbers of search steps."""
    for first, second in PAIRS_OF_ALGORITHMS:
        settings = Settings(global_algorithm=first, local_algorithm=second, stages=SHARPNESS_ONLY)
        # NLopt's names begin with GN_ or LN_.
        label = f"{first[3:]} + {second[3:]}, sharpness"
        yield CalibrationSetting(label, "algorithms", settings)
    for budget in (60, 240):
        yield CalibrationSetting(
            f"{budget} global steps, sharpness",
            "algorithms",
            Settings(global_evaluations=budget, stages=SHARPNESS_ONLY),
        )


def _photometric() -> Iterator[CalibrationSetting]:
    """Yield settings with other algorithms and numbers of pairs for the photometric stage."""
    for pairs in PAIRS:
        if pairs != PhotometricSettings().pairs:
            yield CalibrationSetting(
                f"{pairs // 1000} k pairs",
                "pairs",
                Settings(photometric=PhotometricSettings(pairs=pairs)),
            )
    by_bobyqa = Settings(photometric=PhotometricSettings(algorithm="LN_BOBYQA"))
    yield CalibrationSetting("photometric by BOBYQA", "algorithms", by_bobyqa)


def _mixed() -> Iterator[CalibrationSetting]:
    """Yield settings with few events for the first stage, whose error the photometric stage corrects."""
    for events, pairs in itertools.product(EVENTS[:2], PAIRS[:2]):
        if events != Settings().events and pairs != PhotometricSettings().pairs:
            settings = Settings(events=events, photometric=PhotometricSettings(pairs=pairs))
            label = f"{events // 1000} k events, {pairs // 1000} k pairs"
            yield CalibrationSetting(label, "events and pairs", settings)


def calibration_rows(
    known: KnownRecording,
    device: str,
    *,
    repeats: int,
    quick: bool,
    seed: int,
    progress: Progress,
    failed: dict[str, str],
) -> tuple[list[Row], list[str]]:
    """Measure all settings; return their rows, and notes on settings that the calibration refuses on this recording.

    Settings that fail are noted in ``failed`` by their labels, with the error.
    """
    all_settings = calibration_settings(known, quick=quick)

    def run(settings: Settings) -> Calibration | AmiwarpError:
        try:
            return calibrate(known.recording, replace(settings, seed=seed), device=device)
        except AmiwarpError as error:
            # A refusal is a result: its time is measured, and it is noted, not failed.
            return error

    def row(timed: Timed) -> Row | None:
        calibration: Calibration | AmiwarpError | None = timed.result
        if calibration is None or isinstance(calibration, AmiwarpError):
            return None
        return measured_row(
            timed, failed, lambda: (model_error(calibration.model, known.model).rms, None)
        )

    progress("calibrating", 0.0)
    for settings in _kinds(all_settings):
        # What fails here fails in its measurement too, and is noted there.
        with contextlib.suppress(Exception):
            short = run(_shortened(settings))
            if isinstance(short, AmiwarpError) or _lacks_photometric(short, settings):
                # The short run may have ended before it used every kernel.
                run(settings)

    tasks = []
    for setting in all_settings:
        tasks.append(
            Task(partial(run, setting.settings), len(known.events), setting.row_fields(device))
        )
    timed = measure(
        tasks,
        repeats,
        progress,
        "calibrating",
        warm_up=False,
        release=True,
        # Only settings near the best of all are measured again.
        again=lambda once: near_front([row(timed_setting) for timed_setting in once]),
    )

    notes = []
    for timed_setting, setting in zip(timed, all_settings, strict=True):
        if timed_setting.failure:
            failed[setting.label] = timed_setting.failure
        elif isinstance(timed_setting.result, AmiwarpError):
            notes.append(f"{setting.label}: refused, {timed_setting.result}")
        elif _lacks_photometric(timed_setting.result, setting.settings, accepted=True):
            notes.append(f"{setting.label}: the photometric stage kept the result of sharpness")
    rows = [measured for measured in map(row, timed) if measured is not None]
    return rows, notes


def _lacks_photometric(
    calibration: Calibration, settings: Settings, *, accepted: bool = False
) -> bool:
    """Return whether a calibration lacks the photometric stage that its settings ask for.

    ``accepted``: whether the stage's result must have been accepted, too.
    """
    if settings.stages != STAGES:
        return False
    if calibration.photometric is None:
        return True
    return accepted and not calibration.photometric.accepted


def _kinds(all_settings: list[CalibrationSetting]) -> list[Settings]:
    """Return one setting of each kind. They run before the measurement, so that their kernels are compiled."""
    by_kind = {}
    for setting in all_settings:
        settings = setting.settings
        kind = (
            settings.model,
            settings.stages,
            settings.fold > 0,
            settings.photometric.algorithm,
        )
        by_kind[kind] = settings
    return list(by_kind.values())


def _shortened(settings: Settings) -> Settings:
    """Return a setting with just enough events and steps to compile what it uses."""
    return replace(
        settings,
        events=20_000,
        global_evaluations=20,
        local_evaluations=10,
        photometric=PhotometricSettings(pairs=20_000, algorithm=settings.photometric.algorithm),
    )
