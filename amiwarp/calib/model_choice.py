"""Choice of the smallest model that a scene needs, and of the parameters that a recording determines.

:class:`ModelChooser` gets the calibration of the exact model. Each smaller model is fitted to it where the scene has
events, which predicts the model's error. Held-out turns give independent evidence on a model that the prediction
favours: it is moved to its sharpest on half of the turns and measured on the other half.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.calib.freed_parameters import (
    GROUPS,
    candidate_names,
    confirmed_freedom,
    held_instead,
    judge_parameters,
)
from amiwarp.calib.groundwork import CIRCLES, TILT, Groundwork, accepted_photometric, lay_groundwork
from amiwarp.calib.held_out_turns import gradient
from amiwarp.calib.settings import Settings
from amiwarp.calib.sharpness_objective import padding
from amiwarp.calib.trial import CONVERSION_FACTOR, Trial, in_pixels, trial_for
from amiwarp.choices import Sharpness
from amiwarp.errors import AmiwarpError
from amiwarp.events.recording import Recording
from amiwarp.imaging.canvas import CanvasShape
from amiwarp.imaging.sharpness import SharpnessMeter
from amiwarp.imaging.votes import Votes
from amiwarp.optics.models.comparison import predicted_error
from amiwarp.optics.models.exact import ExactModel
from amiwarp.optics.models.registry import MODELS, rungs
from amiwarp.optics.prism import UnsizedPrism, as_wedge
from amiwarp.results.calibration import Calibration, FreedParameter, ModelCandidate, ModelChoice
from amiwarp.results.parameters import ParameterSpace
from amiwarp.validation import real

Vector = NDArray[np.float64]


class ModelChooser:
    """Choice of the model and of the free parameters for a recording.

    :attr:`settings` ask for the exact model, with which the recording is to be calibrated first.
    """

    def __init__(self, recording: Recording, settings: Settings, device: Any) -> None:
        """Check the error budget: the largest tolerated model error where the scene has events [px rms]."""
        self._began = time.perf_counter()
        if settings.budget_px is not None and not real(settings.budget_px, "budget_px") > 0.0:
            raise AmiwarpError(
                f"budget_px = {settings.budget_px}; give an error above 0, for example 0.03"
            )
        self._recording = recording
        self._device = device
        self.settings = replace(settings, model="exact")
        self._ready: Groundwork | None = None

    def prepare(self, sharpest: Calibration) -> None:
        """Lay the groundwork for the choice, from the first answer of the sharpness stage."""
        if self._ready is not None or not sharpest.parameters["apex"]:
            return  # without a prism there is nothing to choose
        names = tuple(n for n in self._tested_names(sharpest) if n not in TILT)
        # The error is raised again after the photometric stage.
        with contextlib.suppress(AmiwarpError):
            self._ready = lay_groundwork(self._recording, sharpest, self.settings, names)

    def choose(
        self, first: Calibration, calibrate: Callable[[Recording, Settings], Calibration]
    ) -> Calibration:
        """Express the calibration of the exact model by the smallest model that keeps the error budget.

        ``calibrate`` is used to calibrate the exact model again, with more free parameters.
        """
        if not first.parameters["apex"]:
            return first  # without a prism all models are the same
        # the camera and the flat side are those that the calibration found
        prism = replace(
            as_wedge(self._recording.prism or UnsizedPrism()),
            flat_side=as_wedge(first.prism).flat_side,
        )
        recording = replace(self._recording, camera=first.camera, prism=prism)
        mended = first.path if recording.encoder is not None else None
        harmonics = first.harmonics
        if mended is not None:
            recording = replace(recording, encoder=mended)
            first = replace(first, path=None)
            self._ready = None
        if harmonics is not None and recording.encoder is not None:
            recording = replace(recording, encoder=recording.encoder.with_harmonics(harmonics))
            self._ready = None
        first = replace(first, harmonics=None)
        trial, parameters = self._with_free_parameters(recording, first, calibrate)
        candidates = compare_models(trial)
        chosen = express(trial, next(c.model for c in candidates if c.chosen), self.settings)
        whole = time.perf_counter() - self._began
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
            *(
                f"prediction and held-out turns disagree on the {c.model} model: {c.verdict}"
                for c in disagreements
            ),
        )
        return replace(
            chosen,
            ladder=choice,
            seconds=whole,
            warnings=(*chosen.warnings, *warnings),
            harmonics=harmonics,
            path=chosen.path if mended is None else mended,
        )

    def _with_free_parameters(
        self,
        recording: Recording,
        first: Calibration,
        calibrate: Callable[[Recording, Settings], Calibration],
    ) -> tuple[Trial, tuple[FreedParameter, ...]]:
        """Free the parameters that the recording determines, and calibrate the exact model again with them free.

        Return the trial of the final exact answer, and the decision for each parameter.
        """
        settings = self.settings
        names = self._tested_names(first)
        trial = trial_for(recording, first, settings, names, self._ready, device=self._device)
        parameters = judge_parameters(trial, names)
        while True:
            more: list[str] = []
            for parameter in parameters:
                if parameter.freed:
                    more += GROUPS.get(parameter.name, ())
            if not more:
                return trial, parameters
            start = {**settings.start, **first.parameters}
            free = replace(settings, free=(*first.free, *more), start=start, global_algorithm=None)
            try:
                exact = calibrate(recording, free)
            except AmiwarpError as error:
                why = f"the calibration fails with it free: {error}"
                return trial, tuple(held_instead(named, why) for named in parameters)
            confirmed = tuple(confirmed_freedom(trial, named, exact) for named in parameters)
            if confirmed == parameters:
                warnings = tuple(dict.fromkeys((*first.warnings, *exact.warnings)))
                exact = replace(exact, stages=(*first.stages, *exact.stages), warnings=warnings)
                final = trial_for(recording, exact, settings, (), device=self._device)
                return final, parameters
            parameters = confirmed

    def _tested_names(self, exact: Calibration) -> tuple[str, ...]:
        """Return the names of the parameters that might be freed."""
        return candidate_names(self._recording, exact) if self.settings.free is None else ()


def compare_models(trial: Trial) -> tuple[ModelCandidate, ...]:
    """Compare all models, and choose the smallest that keeps the budget and is not clearly worse on held-out turns.

    Models are measured on held-out turns only if that may change the choice, or if no photometric stage has confirmed
    the exact model, and measuring shows whether the recording contradicts it.
    """
    confirmed = accepted_photometric(trial.exact) is not None
    candidates: list[ModelCandidate] = []
    for name in rungs():
        predicted = trial.predicted[name]
        held_out = None
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
    return trial.test.of_parts(space, space.to_values(v + step))


def _candidate(
    trial: Trial, name: str, predicted: float, held_out: Vector | None, *, found: bool
) -> ModelCandidate:
    """Return the summary of a candidate model; ``found``: whether a smaller model was chosen already.

    ``held_out`` is the model's sharpness on the held-out turns, None if it was not measured.
    """
    sharpness = mean = std = seen = cost = None
    if held_out is not None:
        sharpness = float(held_out.mean())
        mean, std, seen = trial.as_motion(trial.reference - held_out)
        cost = 1e9 * min(half.fastest_s[name] for half in (trial.train, trial.test))
    chosen = (
        predicted <= trial.budget_px
        and not found
        and (seen is None or seen[0] <= trial.rejection_px)
    )
    verdict = _verdict(trial, name, predicted, seen)
    if chosen:
        verdict = f"the smallest that keeps the budget; {verdict}"
    elif found:
        verdict = f"larger than needed; {verdict}"
    numbers = MODELS[name].NUMBERS
    if name == "exact" and any(trial.exact.parameters.get(n) for n in TILT):
        numbers = numbers.replace("2", "4")
    return ModelCandidate(
        model=name,
        numbers=numbers,
        predicted_px=predicted,
        sharpness=sharpness,
        loss=mean,
        loss_std=std,
        seen_px=seen,
        cost_ns=cost,
        chosen=chosen,
        verdict=verdict,
    )


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
        agree = seen[1] <= trial.rejection_px
        return f"under the budget; held-out turns {'agree' if agree else 'are inconclusive'}"
    if seen[1] < budget / CONVERSION_FACTOR:
        return "predicted over the budget, but held-out turns show no error"
    agree = seen[0] > budget / CONVERSION_FACTOR
    return f"over the budget; held-out turns {'agree' if agree else 'are inconclusive'}"


def _agree(trial: Trial, candidate: ModelCandidate) -> bool:
    """Return whether the held-out turns are consistent with the candidate's predicted error, if they were measured."""
    if candidate.seen_px is None:
        return True
    low, high = candidate.seen_px
    if candidate.predicted_px <= trial.budget_px:
        return -trial.rejection_px <= high and low <= trial.rejection_px
    return high >= trial.budget_px / CONVERSION_FACTOR


def express(trial: Trial, name: str, settings: Settings) -> Calibration:
    """Express the exact model's calibration in the parameters of the model ``name``, with uncertainty.

    A circle is fitted to the exact model at the sample. Its size replaces the apex. The sharpness is measured
    as for the exact model.
    """
    exact = trial.exact
    if MODELS[name].closed_form() is ExactModel:
        return replace(exact, model_name=name)
    size = MODELS[name].SIZE
    space, values = trial.fitted(name, exact)
    # The size takes the apex's place.
    gain = values[size] / exact.parameters["apex"]
    known: dict[str, float] = {}
    for parameter, std in exact.uncertainty.items():
        if parameter == "apex":
            known[size] = std * gain
        else:
            known[parameter] = std
    free = tuple(size if parameter == "apex" else parameter for parameter in exact.free)
    return replace(
        exact,
        model_name=name,
        prism=replace(exact.prism, index=exact.parameters.get("index", exact.prism.index)),
        parameters=values,
        uncertainty={parameter: std for parameter, std in known.items() if parameter in values},
        free=tuple(parameter for parameter in free if parameter in values),
        sharpness_after=_sharpness(trial, space, values, settings),
    )


def _sharpness(
    trial: Trial, space: ParameterSpace, values: Mapping[str, float], settings: Settings
) -> float:
    """Return the sharpness of all events, on a canvas as large as the search's, so that both values are comparable."""
    like = trial.space_of("exact", trial.exact)
    largest = settings.bounds.get("apex", (0.0, 2.0 * as_wedge(trial.exact.prism).apex))[1]
    camera = space.camera
    kind = settings.sharpness
    device = trial.device
    plain = kind is Sharpness.PAPER_J
    pad = padding(replace(like, high={**like.high, "apex": largest}))
    canvas = CanvasShape(
        camera.width, camera.height, pad, per_polarity=settings.per_polarity, dither=not plain
    )
    votes = Votes(canvas, device)
    meter = SharpnessMeter(
        canvas, kind, smoothing=0.0 if plain else settings.smoothing_px, device=device
    )
    events = trial.calibration_events.on(device, space.middle_us if space.moving else None)
    votes.add_events(
        space.build(values),
        events,
        drift=space.drift(values),
        camera_rotation=space.camera_rotation(values),
    )
    votes.read(meter.image)
    meter.launch()
    return meter.results()[0]


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
