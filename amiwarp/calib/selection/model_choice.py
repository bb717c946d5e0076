"""The smallest model of the ladder that a scene needs, and which parameters it can tell.

The exact model is calibrated; each smaller one is fitted to its answer where the scene has events, which predicts its
error. Held-out turns judge beside it: each model, moved to its sharpest on half of the turns, is measured on the rest.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from amiwarp.calib.result import Calibration, ModelCandidate, ModelChoice
from amiwarp.calib.selection import free_parameters
from amiwarp.calib.selection.smaller_models import fit
from amiwarp.calib.selection.trial import FACTOR, Trial, by_sharpness, in_pixels, make_trial
from amiwarp.calib.sharpness.held_out import slope
from amiwarp.calib.sharpness.objective import padding
from amiwarp.calib.sharpness.search import Settings
from amiwarp.calib.single_model import calibrate_model
from amiwarp.errors import AmiwarpError
from amiwarp.imaging.choices import Sharpness
from amiwarp.imaging.sharpness_costs import SharpnessMeter
from amiwarp.imaging.warped_image import CanvasShape, Votes
from amiwarp.optics.models import MODELS, predicted_error
from amiwarp.progress import Progress

if TYPE_CHECKING:
    from amiwarp.calib.parameters import ParameterSpace
    from amiwarp.calib.selection.trial import Vector
    from amiwarp.events.recording import Recording

NUMBERS = {"circle": "2", "radial": "2, index given", "ellipse": "6 a pixel", "exact": "2, index given"}


def calibrate_auto(
    recording: Recording,
    settings: Settings,
    *,
    device: Any = "cpu",
    progress: Progress | None = None,
    budget_px: float | None = None,
) -> Calibration:
    """Calibrates by the exact model, then takes the smallest model that keeps the budget where the scene has events.

    ``budget_px``: largest error of a model that counts as none [px rms]; None: a tenth of the blur that quantisation
    and timing leave anyway. Raises :class:`AmiwarpError` where the recording cannot determine the exact model.
    """
    began = time.perf_counter()
    if budget_px is not None and not budget_px > 0.0:
        raise AmiwarpError(f"budget_px = {budget_px}; give an error above 0, as 0.03")
    settings = replace(settings, model="exact")
    first = calibrate_model(recording, settings, device=device, progress=progress)
    if not first.parameters["apex"]:
        return first  # without a prism all models are one
    names = free_parameters.candidates(recording, first) if settings.free is None else ()
    trial = make_trial(recording, first, settings, names, device=device, budget_px=budget_px)
    parameters = free_parameters.judge_parameters(trial)
    while more := free_parameters.wanted(parameters):
        again = free_parameters.freed_settings(first, settings, more)
        try:
            exact = calibrate_model(recording, again, device=device, progress=progress)
        except AmiwarpError as error:
            parameters = free_parameters.refused(parameters, str(error))
            break
        parameters = free_parameters.confirm(trial, parameters, exact)
        if free_parameters.wanted(parameters) == more:
            exact = replace(exact, stages=(*first.stages, *exact.stages))
            trial = make_trial(recording, exact, settings, (), device=device, budget_px=budget_px)
            break
    judged = judge_rungs(trial)
    pick = next(k for k, j in enumerate(judged) if j.rung.chosen)
    chosen = expressed(trial, judged[pick], settings, device)
    whole = time.perf_counter() - began
    agreed = all(_agree(trial, j.rung) for j in judged[: pick + 1])
    ladder = ModelChoice(
        budget_px=trial.budget_px,
        timing_px=trial.timing_px,
        agreed=agreed,
        exact=dict(trial.exact.parameters),
        exact_uncertainty=dict(trial.exact.uncertainty),
        rungs=tuple(j.rung for j in judged),
        parameters=parameters,
        seconds=whole - first.seconds,
    )
    warnings = (*_elsewhere(trial, chosen), *(
        f"the judges do not agree on the {j.rung.model} model: {j.rung.verdict}"
        for j in judged[: pick + 1]
        if not _agree(trial, j.rung)
    ))  # fmt: skip
    return replace(chosen, ladder=ladder, seconds=whole, warnings=(*chosen.warnings, *warnings))


def _elsewhere(trial: Trial, chosen: Calibration) -> tuple[str, ...]:
    """A word of caution where a model keeps the budget only because the events are where they are."""
    away = predicted_error(chosen.model, trial.exact.model).rms
    if away <= FACTOR * trial.budget_px:
        return ()
    return (
        f"the {chosen.model_name} model is enough where this recording has events, but {away:.2f} px off over the "
        "whole image: for other recordings take calibration.exact, or calibrate with --model exact",
    )


@dataclass(frozen=True)
class Judged:
    """A rung beside its best fit to the exact answer."""

    rung: ModelCandidate
    values: Mapping[str, float]


def judge_rungs(trial: Trial) -> tuple[Judged, ...]:
    """Every model of the ladder by both judges; the smallest that neither rejects is the chosen one."""
    target, sharp = (trial.places.moved(c.model) for c in (trial.exact, by_sharpness(trial.exact)))
    top = trial.sharpest([0, 1])
    reference = trial.test.each(trial.space, top)
    judged: list[Judged] = []
    for name in MODELS:
        if name in ("circle", "radial"):
            values, predicted = fit(trial.rung(name, trial.exact), target, trial.places)
            held_out = _refined(trial, trial.rung(name, by_sharpness(trial.exact)), sharp)
        elif name == "ellipse":
            values, predicted, held_out = _as_ellipse(trial, top)
        else:
            values, predicted, held_out = dict(trial.exact.parameters), 0.0, reference
        found = any(j.rung.chosen for j in judged)
        judged.append(Judged(_rung(trial, name, predicted, reference, held_out, found=found), values))
    return tuple(judged)


def _refined(trial: Trial, space: ParameterSpace, sharp: Vector) -> Vector:
    """Held-out sharpness of a smaller model, moved to its sharpest on the other turns from its fit to the exact one."""
    values, _ = fit(space, sharp, trial.places)
    v = space.to_vector(values)
    step = trial.bend.of([0, 1]).top(slope(trial.train, space, v))
    return trial.test.each(space, space.to_values(v + step))


def _as_ellipse(trial: Trial, top: Mapping[str, float]) -> tuple[dict[str, float], float, Vector]:
    """The ellipse follows the exact model: its parameters are the same, its error that beside the exact sharpest."""
    space = replace(trial.space, model="ellipse")
    model = space.build(top)
    predicted = trial.places.distance(model, trial.space.build(top))
    trial.train.each(space, top, model)  # for its time
    return dict(trial.exact.parameters), predicted, trial.test.each(space, top, model)


def _rung(
    trial: Trial, name: str, predicted: float, reference: Vector, held_out: Vector, *, found: bool
) -> ModelCandidate:
    mean, std, seen = trial.seen(reference - held_out)
    takes = predicted <= trial.budget_px and seen[0] <= trial.tells_px and not found
    verdict = _verdict(trial, name, predicted, seen)
    if takes or found:
        verdict = f"{'the smallest that keeps the budget' if takes else 'larger than needed'}; {verdict}"
    numbers = NUMBERS[name]
    if name == "exact" and any(trial.exact.parameters.get(n) for n in ("tilt_x", "tilt_y")):
        numbers = numbers.replace("2", "4")
    cost = 1e9 * min(half.fastest[name] for half in (trial.train, trial.test))
    return ModelCandidate(name, numbers, predicted, float(held_out.mean()), mean, std, seen, cost, takes, verdict)


def _verdict(trial: Trial, name: str, predicted: float, seen: tuple[float, float]) -> str:
    """What both judges say, in words."""
    budget = trial.budget_px
    if name == "exact":
        return "the others are measured by it"
    if seen[1] < -trial.tells_px:
        by = in_pixels(-seen[1])
        return f"sharper on held-out turns than the exact model, by {by}: is index, flat side or lens wrong?"
    if predicted <= budget:
        if seen[0] > trial.tells_px:
            return f"under the budget as predicted, but held-out turns miss what {in_pixels(seen[0])} are worth"
        return f"under the budget; held-out turns {'agree' if seen[1] <= trial.tells_px else 'cannot tell better'}"
    if seen[1] < budget / FACTOR:
        return "over the budget as predicted, though held-out turns miss nothing"
    return f"over the budget; held-out turns {'agree' if seen[0] > budget / FACTOR else 'cannot tell'}"


def _agree(trial: Trial, rung: ModelCandidate) -> bool:
    """Neither judge is surely on the other side of the budget."""
    low, high = rung.seen_px
    if rung.predicted_px <= trial.budget_px:
        return -trial.tells_px <= high and low <= trial.tells_px
    return high >= trial.budget_px / FACTOR


def expressed(trial: Trial, judged: Judged, settings: Settings, device: Any) -> Calibration:
    """The exact answer in the terms of one rung: deflection in place of the apex, with its uncertainty.

    Sharpness is measured as the exact model's was.
    """
    exact, name, values = trial.exact, judged.rung.model, judged.values
    if name in ("exact", "ellipse"):
        return replace(exact, model_name=name)
    space = trial.rung(name, exact)
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
    """Of all events, on an image as large as the search's: beside it the number stands."""
    like = trial.rung("exact", trial.exact)
    largest = settings.bounds.get("apex", (0.0, 2.0 * trial.exact.prism.apex))[1]
    camera, kind = space.camera, settings.sharpness
    plain = kind is Sharpness.PAPER_J
    pad = padding(replace(like, high={**like.high, "apex": largest}))
    canvas = CanvasShape(camera.width, camera.height, pad, per_polarity=settings.per_polarity, dither=not plain)
    votes = Votes(canvas, device)
    meter = SharpnessMeter(canvas, kind, smoothing=0.0 if plain else settings.smoothing_px, device=device)
    events = trial.material.on(device, space.middle_us if space.moving else None)
    votes.add_events(
        space.build(values), events, drift=space.drift(values), camera_rotation=space.camera_rotation(values)
    )
    votes.read(meter.image)
    meter.launch()
    return meter.results()[0]
