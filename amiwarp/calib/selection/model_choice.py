"""Choice of the smallest model that a scene needs, and of the parameters that a recording determines.

The exact model is calibrated. Each smaller model is fitted to its answer where the scene has events, which predicts the
model's error. Held-out turns give independent evidence on a model that the prediction favours: it is moved to its
sharpest on half of the turns and measured on the other half.
"""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from amiwarp.calib.result import Calibration
from amiwarp.calib.selection import free_parameters
from amiwarp.calib.selection.groundwork import (
    CIRCLES,
    TILT,
    Groundwork,
    accepted_photometric,
    lay_groundwork,
    lay_in_parts,
)
from amiwarp.calib.selection.trial import CONVERSION_FACTOR, Trial, in_pixels, largest_tilt, make_trial
from amiwarp.calib.sharpness.held_out import gradient
from amiwarp.calib.sharpness.objective import padding
from amiwarp.calib.sharpness.search import Settings
from amiwarp.calib.single_model import calibrate_model
from amiwarp.calib.summaries import FreedParameter, ModelCandidate, ModelChoice
from amiwarp.errors import AmiwarpError
from amiwarp.imaging.choices import Sharpness
from amiwarp.imaging.sharpness_costs import SharpnessMeter
from amiwarp.imaging.warped_image import CanvasShape, Votes
from amiwarp.optics.model_error import predicted_error
from amiwarp.optics.models import MODELS
from amiwarp.optics.prism import UnsizedPrism
from amiwarp.progress import Progress
from amiwarp.validation import real

if TYPE_CHECKING:
    from amiwarp.calib.parameters import ParameterSpace
    from amiwarp.calib.selection.trial import Vector
    from amiwarp.events.recording import Recording

NUMBERS = {"circle": "2", "radial": "2, index given", "ellipse": "6 a pixel", "exact": "2, index given"}
"""Number of parameters of each model, as shown in the table of the candidates."""


def calibrate_auto(
    recording: Recording,
    settings: Settings,
    *,
    device: Any = "cpu",
    progress: Progress | None = None,
    budget_px: float | None = None,
) -> Calibration:
    """Calibrate the exact model, then express its result by the smallest model that keeps the error budget.

    ``budget_px`` is the largest tolerated model error where the scene has events [px rms]; None: a tenth of the blur
    by quantisation and timing. Raises :class:`AmiwarpError` if the recording cannot determine the exact model.
    """
    began = time.perf_counter()
    if budget_px is not None and not real(budget_px, "budget_px") > 0.0:
        raise AmiwarpError(f"budget_px = {budget_px}; give an error above 0, for example 0.03")
    settings = replace(settings, model="exact")
    ready: list[Groundwork] = []

    def prepare(sharpest: Calibration) -> Iterator[None]:
        if not sharpest.parameters["apex"]:
            return  # without a prism there is nothing to choose
        names = tuple(n for n in _tested_names(recording, sharpest, settings) if n not in TILT)
        with contextlib.suppress(AmiwarpError):  # it is raised again after the photometric stage
            ready.append((yield from lay_in_parts(recording, sharpest, settings, names)))

    first = calibrate_model(recording, settings, device=device, progress=progress, meanwhile=prepare)
    if not first.parameters["apex"]:
        return first  # without a prism all models are the same
    recording = _as_corrected(recording, first)
    trial, parameters = _free_parameters(
        recording, first, settings, ready, device=device, progress=progress, budget_px=budget_px
    )
    candidates = compare_models(trial)
    chosen = express(trial, next(c.model for c in candidates if c.chosen), settings, device)
    whole = time.perf_counter() - began
    disagreements = [c for c in candidates if not _agree(trial, c)]
    choice = ModelChoice(
        budget_px=trial.budget_px,
        timing_px=trial.timing_px,
        agreed=not disagreements,
        exact=dict(trial.exact.parameters),
        exact_uncertainty=dict(trial.exact.uncertainty),
        rungs=candidates,
        parameters=parameters,
        seconds=whole - first.seconds,
    )
    warnings = (
        *_whole_image_warning(trial, chosen),
        *(f"prediction and held-out turns disagree on the {c.model} model: {c.verdict}" for c in disagreements),
    )
    return replace(chosen, ladder=choice, seconds=whole, warnings=(*chosen.warnings, *warnings))


def _as_corrected(recording: Recording, found: Calibration) -> Recording:
    """Return the recording with the camera and the flat side that its calibration found."""
    prism = replace(recording.prism or UnsizedPrism(), flat_side=found.prism.flat_side)
    return replace(recording, camera=found.camera, prism=prism)


def _free_parameters(
    recording: Recording,
    first: Calibration,
    settings: Settings,
    ready: list[Groundwork],
    *,
    device: Any,
    progress: Progress | None,
    budget_px: float | None,
) -> tuple[Trial, tuple[FreedParameter, ...]]:
    """Free the parameters that the recording determines, and calibrate the exact model again with them free.

    ``ready`` may hold groundwork that was laid before. Return the trial of the final exact answer, and the decision for
    each parameter.
    """
    names = _tested_names(recording, first, settings)
    trial = trial_for(recording, first, settings, names, ready, device=device, budget_px=budget_px)
    parameters = free_parameters.judge_parameters(trial, names)
    while more := free_parameters.freed_names(parameters):
        again = free_parameters.freed_settings(first, settings, more)
        try:
            exact = calibrate_model(recording, again, device=device, progress=progress)
        except AmiwarpError as error:
            return trial, free_parameters.hold_all(parameters, str(error))
        parameters = free_parameters.confirm_freed(trial, parameters, exact)
        if free_parameters.freed_names(parameters) == more:
            warnings = tuple(dict.fromkeys((*first.warnings, *exact.warnings)))
            exact = replace(exact, stages=(*first.stages, *exact.stages), warnings=warnings)
            return trial_for(recording, exact, settings, (), [], device=device, budget_px=budget_px), parameters
    return trial, parameters


def trial_for(
    recording: Recording,
    exact: Calibration,
    settings: Settings,
    names: tuple[str, ...],
    ready: list[Groundwork],
    *,
    device: Any,
    budget_px: float | None,
) -> Trial:
    """Return the trial of ``exact``, which tests the parameters ``names``.

    It does not test the tilt if the photometric stage has shown that a tilt moves events by less than the budget.
    ``ready`` may hold groundwork that was laid before.
    """
    untilted = tuple(n for n in names if n not in TILT)
    tilt = largest_tilt(exact)
    if tilt < math.inf:
        ground = next((g for g in ready if g.serves(exact, untilted)), None)
        ground = ground or lay_groundwork(recording, exact, settings, untilted)
        trial = make_trial(ground, exact, device=device, budget_px=budget_px)
        if tilt <= trial.budget_px or names == untilted:
            return trial
    ground = lay_groundwork(recording, exact, settings, names)
    return make_trial(ground, exact, device=device, budget_px=budget_px)


def _tested_names(recording: Recording, exact: Calibration, settings: Settings) -> tuple[str, ...]:
    """Return the names of the parameters that might be freed."""
    return free_parameters.candidate_names(recording, exact) if settings.free is None else ()


def _whole_image_warning(trial: Trial, chosen: Calibration) -> tuple[str, ...]:
    """Return a warning if the chosen model keeps the error budget at this recording's events only."""
    if chosen.model_name == "exact":
        return ()
    away = predicted_error(chosen.model, trial.exact.model).rms
    if away <= CONVERSION_FACTOR * trial.budget_px:
        return ()
    return (
        f"the {chosen.model_name} model suffices where this recording has events, but its error over the whole image "
        f"is {away:.2f} px: for other recordings use calibration.exact, or calibrate with --model exact",
    )


def compare_models(trial: Trial) -> tuple[ModelCandidate, ...]:
    """Compare all models, and choose the smallest that keeps the budget and is not clearly worse on held-out turns.

    Models are measured on held-out turns only if that may change the choice, or if no photometric stage has confirmed
    the exact model, and measuring shows whether the recording contradicts it.
    """
    confirmed = accepted_photometric(trial.exact) is not None
    candidates: list[ModelCandidate] = []
    for name in MODELS:
        predicted, held_out = trial.predicted[name], None
        found = any(c.chosen for c in candidates)
        if name in CIRCLES and not found and (predicted <= trial.budget_px or not confirmed):
            held_out = _refined(trial, name)
        elif name == "exact" and any(c.sharpness is not None for c in candidates):
            held_out = trial.reference
        candidates.append(_candidate(trial, name, predicted, held_out, found=found))
    return tuple(candidates)


def _refined(trial: Trial, name: str) -> Vector:
    """Return the held-out sharpness of a smaller model, with the parameters that are sharpest on the training turns."""
    space, values = trial.fitted(name, trial.answer)
    v = space.to_vector(values)
    step = trial.quadratic.restricted_to([0, 1]).step_to_maximum(gradient(trial.train, space, v))
    return trial.test.each(space, space.to_values(v + step))


def _candidate(trial: Trial, name: str, predicted: float, held_out: Vector | None, *, found: bool) -> ModelCandidate:
    """Return the summary of a candidate model; ``found``: whether a smaller model was chosen already.

    ``held_out`` is the model's sharpness on the held-out turns, None if it was not measured.
    """
    sharpness = mean = std = seen = cost = None
    if held_out is not None:
        sharpness = float(held_out.mean())
        mean, std, seen = trial.as_motion(trial.reference - held_out)
        cost = 1e9 * min(half.fastest[name] for half in (trial.train, trial.test))
    chosen = predicted <= trial.budget_px and not found and (seen is None or seen[0] <= trial.rejection_px)
    verdict = _verdict(trial, name, predicted, seen)
    if chosen or found:
        verdict = f"{'the smallest that keeps the budget' if chosen else 'larger than needed'}; {verdict}"
    numbers = NUMBERS[name]
    if name == "exact" and any(trial.exact.parameters.get(n) for n in TILT):
        numbers = numbers.replace("2", "4")
    return ModelCandidate(
        model=name, numbers=numbers, predicted_px=predicted, sharpness=sharpness, loss=mean, loss_std=std,
        seen_px=seen, cost_ns=cost, chosen=chosen, verdict=verdict,
    )  # fmt: skip


def _verdict(trial: Trial, name: str, predicted: float, seen: tuple[float, float] | None) -> str:
    """Return a sentence that compares a model's predicted error with its error on held-out turns."""
    budget = trial.budget_px
    if name == "exact":
        return "the reference for the others"
    if seen is None:
        return f"{'under' if predicted <= budget else 'over'} the budget"
    if seen[1] < -trial.rejection_px:
        by = in_pixels(-seen[1])
        return f"sharper on held-out turns than the exact model, by {by}: check index, flat side and lens"
    if predicted <= budget:
        if seen[0] > trial.rejection_px:
            return f"predicted under the budget, but held-out turns show an error of at least {in_pixels(seen[0])}"
        return f"under the budget; held-out turns {'agree' if seen[1] <= trial.rejection_px else 'are inconclusive'}"
    if seen[1] < budget / CONVERSION_FACTOR:
        return "predicted over the budget, but held-out turns show no error"
    return f"over the budget; held-out turns {'agree' if seen[0] > budget / CONVERSION_FACTOR else 'are inconclusive'}"


def _agree(trial: Trial, candidate: ModelCandidate) -> bool:
    """Return whether the held-out turns are consistent with the candidate's predicted error, if they were measured."""
    if candidate.seen_px is None:
        return True
    low, high = candidate.seen_px
    if candidate.predicted_px <= trial.budget_px:
        return -trial.rejection_px <= high and low <= trial.rejection_px
    return high >= trial.budget_px / CONVERSION_FACTOR


def express(trial: Trial, name: str, settings: Settings, device: Any) -> Calibration:
    """Express the exact model's calibration in the parameters of the model ``name``, with uncertainty.

    A circle is fitted to the exact model at the sample. The deflection replaces the apex. The sharpness is measured
    like that of the exact model.
    """
    exact = trial.exact
    if name in ("exact", "ellipse"):
        return replace(exact, model_name=name)
    space, values = trial.fitted(name, exact)
    gain = values["deflection"] / exact.parameters["apex"]
    known = {
        "deflection" if n == "apex" else n: x * (gain if n == "apex" else 1.0) for n, x in exact.uncertainty.items()
    }
    free = tuple("deflection" if n == "apex" else n for n in exact.free)
    return replace(
        exact, model_name=name, prism=replace(exact.prism, index=exact.parameters.get("index", exact.prism.index)),
        parameters=values, uncertainty={n: x for n, x in known.items() if n in values},
        free=tuple(n for n in free if n in values), sharpness_after=_sharpness(trial, space, values, settings, device),
    )  # fmt: skip


def _sharpness(
    trial: Trial, space: ParameterSpace, values: Mapping[str, float], settings: Settings, device: Any
) -> float:
    """Return the sharpness of all events, on a canvas as large as the search's, so that both values are comparable."""
    like = trial.space_of("exact", trial.exact)
    largest = settings.bounds.get("apex", (0.0, 2.0 * trial.exact.prism.apex))[1]
    camera, kind = space.camera, settings.sharpness
    plain = kind is Sharpness.PAPER_J
    pad = padding(replace(like, high={**like.high, "apex": largest}))
    canvas = CanvasShape(camera.width, camera.height, pad, per_polarity=settings.per_polarity, dither=not plain)
    votes = Votes(canvas, device)
    meter = SharpnessMeter(canvas, kind, smoothing=0.0 if plain else settings.smoothing_px, device=device)
    events = trial.calibration_events.on(device, space.middle_us if space.moving else None)
    votes.add_events(
        space.build(values), events, drift=space.drift(values), camera_rotation=space.camera_rotation(values)
    )
    votes.read(meter.image)
    meter.launch()
    return meter.results()[0]
