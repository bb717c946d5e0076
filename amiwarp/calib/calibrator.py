"""One attempt at a calibration, and its outcome: :class:`Calibrator` makes it, :class:`Attempt` is what came out.

The stages of an attempt are named by the settings: a search for the sharpest image, then the photometric stage, which
also corrects lens, prism and sensor, see ``photometric/steps.py``. Which attempts are made is in ``attempts.py``.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.calib import checks, plate
from amiwarp.calib.events_ahead import upload_ahead
from amiwarp.calib.photometric import limits
from amiwarp.calib.photometric.equations import Problem
from amiwarp.calib.photometric.findings import ParameterCorrected
from amiwarp.calib.photometric.lens_at_depths import LensStep, is_explained, next_lens
from amiwarp.calib.photometric.refinement import Refinement
from amiwarp.calib.photometric.steps import refine, summarised
from amiwarp.calib.preparation import prepare
from amiwarp.calib.settings import Settings
from amiwarp.calib.sharpness_search import Search, bound_warnings
from amiwarp.calib.thinning import rotation_window
from amiwarp.calib.without_encoder import (
    in_larger_sense,
    path_is_examined,
    path_of,
    with_path,
    zero_time,
)
from amiwarp.errors import AmiwarpError
from amiwarp.events.encoder import Encoder
from amiwarp.events.recording import MemoryEvents, Recording
from amiwarp.optics.camera import LENS, given_lens, with_lens
from amiwarp.optics.models.registry import MODELS
from amiwarp.optics.prism import Plate
from amiwarp.optics.rotation_path import RotationPath
from amiwarp.results.calibration import (
    Calibration,
    PhotometricSummary,
)
from amiwarp.results.parameters import CHANGES, GROWTH, MOTION, ParameterSpace
from amiwarp.tasks import Progress

MOST_LENSES = 3
"""Largest number of times that depths are found again through a corrected lens."""
DEPTHS_ALONE = "depths explain the events, but one brightness map of the scene does not"
"""Verdict on a plate whose angles were not examined."""


@dataclass(frozen=True)
class Attempt:
    """Outcome of one attempt: a calibration, or the error that ended it."""

    calibration: Calibration | None
    error: AmiwarpError | None = None
    search: Search | None = None
    """The last sharpness search that was begun; of a plate, with the depths that were found."""

    @property
    def photometric(self) -> PhotometricSummary | None:
        """Result of the photometric stage; None if it did not run."""
        return None if self.calibration is None else self.calibration.photometric

    @property
    def accepted(self) -> bool:
        """Whether the photometric stage accepted its result."""
        return self.photometric is not None and self.photometric.accepted

    @property
    def cost(self) -> float:
        """Cost of the photometric stage, relative to the cost without a map; 1 if the stage did not run."""
        return 1.0 if self.photometric is None else self.photometric.cost

    @property
    def unexplained(self) -> bool:
        """Whether the photometric cost is so high that the camera may have rotated."""
        if self.photometric is None:
            return isinstance(self.error, checks.NoSharpOptimumError)
        return self.cost > limits.LARGEST_STILL_COST

    @property
    def doubtful(self) -> bool:
        """Whether there is any sign that something is wrong."""
        return (
            not self.accepted
            or self.photometric is None
            or bool(self.photometric.warnings)
            or self.camera_turned
        )

    @property
    def moving(self) -> NDArray[np.bool_]:
        """Parts of the image in which something moves while others are still, shape (rows, columns); empty for none."""
        return np.array(() if self.photometric is None else self.photometric.moving, np.bool_)

    @property
    def camera_turned(self) -> bool:
        """Whether a rotation of the camera explains much of the photometric residual."""
        return (
            self.photometric is not None
            and self.photometric.rotation_gain > limits.LARGEST_ROTATION_GAIN
        )

    def found(self) -> Calibration:
        """Return the calibration, or raise the error."""
        if self.calibration is None:
            assert self.error is not None
            raise self.error
        return self.calibration


@dataclass(frozen=True)
class Calibrator:
    """Calibration of one model from one recording, by sharpness and then photometrically."""

    recording: Recording
    settings: Settings
    device: Any
    progress: Progress | None
    harmonics: tuple[float, ...] | None = None
    """Correction of the recording's encoder that is in its angles already, as in :attr:`Calibration.harmonics`."""
    host_work: Callable[[Calibration], None] | None = None
    """Work of the host that needs only the answer of the sharpness stage. It is done while a GPU solves a first map."""
    path: Encoder | None = None
    """Path of the prism's angle that was found before, if the recording has no encoder."""
    mended: Encoder | None = None
    """Angles instead of the recording's encoder, if it was wrong; they are in the recording already."""
    mended_words: str = ""
    """What was wrong with them, in words."""
    hidden_px: Mapping[str, float] = field(default_factory=dict)
    """By how much a cause that no attempt looks for may move events [px rms], by its words."""
    turned: RotationPath | None = None
    """Rotation of the camera as a gyroscope measured it; its bias stays free."""

    def attempt(
        self, rival: Attempt | None = None, *, angles_hold: bool = False, fast: bool = False
    ) -> Attempt:
        """Calibrate once by the stages of the settings, with the free parameters that they name.

        The attempt fails early if its image is not clearly sharper than the image of a ``rival``, another attempt, or
        if it does not come to a clearly lower cost. With ``angles_hold``, lens and prism are corrected before an error
        of the prism's angles is looked for; with such an error, the answer is rejected. With ``fast``, for a camera in
        fast motion, the photometric stage ends with its first answer.
        """
        began = time.perf_counter()
        search = None
        hidden_px: dict[str, float] = {}
        try:
            recording = rotation_window(self.recording, self.settings)
            searches = prepare(
                recording,
                self.settings,
                self.path,
                turned=self.turned,
                device=self.device,
                progress=self.progress,
            )
            with upload_ahead(recording, searches[0]) as ahead:
                found_in_senses = []
                for search in searches:
                    found_in_senses.append(search.run())
                search = max(found_in_senses, key=lambda search: search.score)
                search = in_larger_sense(recording, search)
                if recording.encoder is None and self.path is None and path_is_examined(search):
                    search, hidden_px = with_path(recording, search)

                most_cost = math.inf
                if rival is not None:
                    most_cost = limits.LARGEST_COST_RATIO * rival.cost
                    if rival.search is not None:
                        checks.check_sharper(search.gain_over(rival.search), recording.name)
                found = _sharpest(recording, search, *search.check_answer(recording.name))

                if "photometric" in self.settings.stages:
                    through_plate = MODELS[self.settings.model].GLASS is Plate
                    problem = Problem(
                        recording,
                        search,
                        angles_hold=angles_hold,
                        fast=fast,
                        most_cost=most_cost,
                        ahead=ahead,
                        host_work=None
                        if self.host_work is None
                        else partial(self.host_work, found),
                    )
                    if through_plate:
                        found, search = _at_depths(problem, found)
                    else:
                        found = _by_brightness(problem, found)
                else:
                    found = with_warnings(found, *bound_warnings(search.space, found.parameters))
        except AmiwarpError as error:
            return Attempt(None, error, search)
        found = hiding(found, hidden_px)
        return Attempt(replace(found, seconds=time.perf_counter() - began), search=search)

    def turning(self, rival: Attempt | None, *, fast: bool = False) -> Attempt:
        """Return the attempt with a free camera rotation, in the middle of the recording."""
        encoder = self.recording.encoder
        ratio = None if encoder is None else encoder.ratio
        free = (*MODELS[self.settings.model].freed(ratio), "motion")
        if fast:
            free = (*free, *CHANGES, GROWTH)
        turning = replace(self, settings=replace(self.settings, free=free))
        return turning.attempt(rival, fast=fast)

    def turning_in(self, span: tuple[int, int], *, fast: bool = False) -> Attempt:
        """Return the attempt with a free camera rotation in a time span [us]."""
        source = self.recording.events
        events = MemoryEvents(source.between(*span), *source.size)
        within = replace(self, recording=replace(self.recording, events=events))
        return within.turning(None, fast=fast)


def _sharpest(
    recording: Recording, search: Search, warnings: tuple[str, ...], uncertainty: dict[str, float]
) -> Calibration:
    """Return the calibration by the sharpness stage that ``search`` ran. Its time is not set."""
    settings = search.settings
    space = search.space
    best = search.best
    at_rest = dict.fromkeys((name for name in MOTION if name in best), 0.0)
    still = {**MODELS[space.model].still_values(best), **at_rest}
    return Calibration(
        model_name=settings.model,
        camera=space.camera,
        prism=space.prism,
        parameters=best,
        uncertainty=uncertainty,
        free=space.names,
        sharpness_name=settings.sharpness.value,
        sharpness_before=search.fine.values(still),
        sharpness_after=search.score,
        stages=search.stages,
        zero_us=zero_time(recording, search),
        path=path_of(recording, search),
        middle_us=space.middle_us if space.moving else None,
        events=len(search.calibration_events.events),
        seconds=0.0,
        warnings=warnings,
    )


def _at_depths(problem: Problem, sharpest: Calibration) -> tuple[Calibration, Search]:
    """Return the calibration of a plate with what the photometric stage says of it, and the search at its depths.

    If the lens is wrong, phase and depths are found again through the corrected one, and the answer with the lower cost
    counts. Raises :class:`AmiwarpError` as :func:`plate.refine_phase` does.
    """
    found, search = _at_each_depth(problem, sharpest)
    state = refine(replace(problem, sharp=search))
    as_given = found, state, search
    given = given_lens(found.camera)["k1"]
    last: LensStep | None = None
    corrected: list[ParameterCorrected] = []
    for _ in range(MOST_LENSES):
        last = next_lens(state, last)
        if last is None:
            break
        k1 = given_lens(found.camera)["k1"] + last.step
        corrected = [ParameterCorrected("k1", given, k1, last.deviation)]
        camera = with_lens(found.camera, {"k1": k1})
        phase = {"phase": found.parameters["phase"]}
        again = replace(sharpest, camera=camera, parameters={**sharpest.parameters, **phase})
        through = replace(problem, sharp=problem.sharp.through(camera))
        found, search = _at_each_depth(through, again)
        state = refine(replace(through, sharp=search))

    if corrected and state.answer.cost >= as_given[1].answer.cost:
        found, state, search = as_given
        return _examined(state, found), search
    return _examined(state.noticing(*corrected), found), search


def _at_each_depth(problem: Problem, sharpest: Calibration) -> tuple[Calibration, Search]:
    """Return the calibration of a plate with its phase, and the search with the depth of what each pixel sees."""
    search = problem.sharp

    def report(share: float) -> None:
        search.report("photometric", share)

    found, depths = plate.refine_phase(sharpest, problem.recording, search.device, report)
    space = replace(search.space, depths=depths).holding(found.parameters)
    full_space = replace(search.full_space, depths=depths).holding(found.parameters)
    at_depths = replace(search, space=space, full_space=full_space)
    return found, at_depths.at(found.parameters, stages=search.stages)


def _by_brightness(problem: Problem, sharpest: Calibration) -> Calibration:
    """Return the calibration after the photometric stage, or the one by sharpness with the reason why it stays."""
    search = problem.sharp
    try:
        summary, stage, space = summarised(refine(problem))
    except AmiwarpError as error:
        failed = f"the photometric stage failed: {error}"
        at_bounds = bound_warnings(search.space, sharpest.parameters)
        return with_warnings(sharpest, failed, *at_bounds)

    few = few_events_in_words(summary, len(problem.recording.events))
    found = with_warnings(sharpest, *_held_in_words(summary), *summary.warnings, *few)
    found = replace(found, stages=(*found.stages, stage), photometric=summary)
    if not summary.accepted:
        rejected = f"photometric stage: {summary.verdict}"
        at_bounds = bound_warnings(search.space, sharpest.parameters)
        return with_warnings(found, rejected, *at_bounds)
    found = _refined(search, found, summary, space)
    return with_warnings(found, *bound_warnings(space, summary.parameters))


def _examined(state: Refinement, found: Calibration) -> Calibration:
    """Return the calibration of a plate with what the photometric stage says of its angles and of its error.

    If the stage does not explain the events at the depths that were found, nothing is said: they are noisy, or the
    camera turns slowly, which pairs of events with short gaps hardly show.
    """
    summary, stage, _ = summarised(state)
    found = replace(found, stages=(*found.stages, stage))
    if not is_explained(state):
        silent = replace(summary, accepted=True, verdict=DEPTHS_ALONE, warnings=(), harmonics=())
        return replace(found, photometric=replace(silent, deviation_px=None, hidden_px={}))
    if summary.deviation_px is not None:
        hidden_px = {
            **summary.hidden_px,
            **plate.hidden_by_faces(found),
            **plate.hidden_by_plate(found),
        }
        summary = replace(summary, hidden_px=hidden_px)
    found = with_warnings(replace(found, photometric=summary), *summary.warnings)
    if not summary.accepted:
        return with_warnings(found, f"photometric stage: {summary.verdict}")
    return found


def _held_in_words(summary: PhotometricSummary) -> list[str]:
    """Return a warning of the parameters that the photometric stage did not change, if there are any."""
    if not summary.held:
        return []
    names = ", ".join(summary.held)
    return [f"the events do not determine {names}: the photometric stage left it unchanged"]


def few_events_in_words(summary: PhotometricSummary, events: int) -> list[str]:
    """Return a warning that a recording has too few events to determine the motion well, if it has."""
    deviation_px = summary.deviation_px
    if deviation_px is None or events >= limits.FEW_EVENTS:
        return []
    if deviation_px < limits.NOTABLE_DEVIATION_PX:
        return []
    return [
        f"few events: the {events:,} events determine the motion of the image with a standard deviation of "
        f"{deviation_px:.2g} px; record for longer, or show a scene with more texture"
    ]


def _refined(
    search: Search, sharpest: Calibration, summary: PhotometricSummary, space: ParameterSpace
) -> Calibration:
    """Return the calibration with the accepted parameters of the photometric stage."""
    # What the stage corrected of the lens belongs to the camera, unless it was a free parameter.
    lens = {
        name: value
        for name, value in summary.parameters.items()
        if name in LENS and name not in search.full_space.names
    }
    return replace(
        sharpest,
        camera=with_lens(sharpest.camera, lens),
        prism=space.prism,
        parameters={n: x for n, x in summary.parameters.items() if n not in lens},
        uncertainty={n: x for n, x in summary.uncertainty.items() if n not in lens},
        free=tuple(name for name in space.names if name not in lens),
        sharpness_after=search.sharpness_in(space, summary.parameters),
    )


def hiding(found: Calibration, hidden_px: Mapping[str, float]) -> Calibration:
    """Return the calibration with further causes that could hide, by words [px rms], if it states an error at all."""
    stage = found.photometric
    if stage is None or stage.deviation_px is None:
        return found
    return replace(found, photometric=replace(stage, hidden_px={**stage.hidden_px, **hidden_px}))


def with_warnings(found: Calibration, *warnings: str) -> Calibration:
    """Return the calibration with more warnings."""
    return replace(found, warnings=(*found.warnings, *warnings))
