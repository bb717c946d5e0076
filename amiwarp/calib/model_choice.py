"""Choice of the smallest model that a scene needs, and of the parameters that a recording determines.

:class:`ModelChooser` gets the calibration of the exact model. Each smaller model is fitted to it where the scene has
events, which predicts the model's error. Held-out turns give independent evidence on a model that the prediction
favours: it is moved to its sharpest on half of the turns and measured on the other half.
"""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from amiwarp.calib.calibration_events import CalibrationEvents, rotation_window, thin, thin_events
from amiwarp.calib.parameters import DRIFTS, MOTION, ParameterSpace, like_size, make_space, values_of
from amiwarp.calib.photometric.descent import LEAST_CURVATURE, UNDETERMINED_PX
from amiwarp.calib.result import Calibration, FreedParameter, ModelCandidate, ModelChoice, PhotometricSummary
from amiwarp.calib.settings import Settings
from amiwarp.calib.sharpness_search import STEP_PX, HalfSharpness, Quadratic, gradient, padding, split_turns
from amiwarp.choices import Sharpness
from amiwarp.errors import AmiwarpError
from amiwarp.events.encoder import Encoder
from amiwarp.events.recording import Events, MemoryEvents, Recording
from amiwarp.imaging.iwe import CanvasShape, Votes
from amiwarp.imaging.sharpness import SharpnessMeter
from amiwarp.optics.models import MODELS, ExactModel, Model, compensate_by_each, predicted_error, rms, rungs, wrap_angle
from amiwarp.optics.prism import UnsizedPrism, as_wedge
from amiwarp.validation import real

Vector = NDArray[np.float64]


class ModelChooser:
    """Choice of the model and of the free parameters for a recording.

    :attr:`settings` are those of the exact model, with which the recording is to be calibrated first.
    """

    def __init__(self, recording: Recording, settings: Settings, device: Any) -> None:
        """Check the error budget: the largest tolerated model error where the scene has events [px rms]."""
        self._began = time.perf_counter()
        if settings.budget_px is not None and not real(settings.budget_px, "budget_px") > 0.0:
            raise AmiwarpError(f"budget_px = {settings.budget_px}; give an error above 0, for example 0.03")
        self._recording, self._device = recording, device
        self.settings = replace(settings, model="exact")
        self._ready: Groundwork | None = None

    def prepare(self, sharpest: Calibration) -> Iterator[None]:
        """Return a generator that lays the groundwork for the choice, from the answer of the sharpness stage."""
        if sharpest.parameters["apex"]:  # without a prism there is nothing to choose
            names = tuple(n for n in self._tested_names(sharpest) if n not in TILT)
            with contextlib.suppress(AmiwarpError):  # it is raised again after the photometric stage
                self._ready = yield from lay_in_parts(self._recording, sharpest, self.settings, names)

    def choose(self, first: Calibration, calibrate: Callable[[Recording, Settings], Calibration]) -> Calibration:
        """Express the calibration of the exact model by the smallest model that keeps the error budget.

        ``calibrate`` is used to calibrate the exact model again, with more free parameters.
        """
        if not first.parameters["apex"]:
            return first  # without a prism all models are the same
        # the camera and the flat side are those that the calibration found
        prism = replace(as_wedge(self._recording.prism or UnsizedPrism()), flat_side=as_wedge(first.prism).flat_side)
        recording = replace(self._recording, camera=first.camera, prism=prism)
        mended, harmonics = first.path if recording.encoder is not None else None, first.harmonics
        if mended is not None:
            recording, first, self._ready = replace(recording, encoder=mended), replace(first, path=None), None
        if harmonics is not None and recording.encoder is not None:
            recording, self._ready = replace(recording, encoder=recording.encoder.with_harmonics(harmonics)), None
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
            *(f"prediction and held-out turns disagree on the {c.model} model: {c.verdict}" for c in disagreements),
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
        self, recording: Recording, first: Calibration, calibrate: Callable[[Recording, Settings], Calibration]
    ) -> tuple[Trial, tuple[FreedParameter, ...]]:
        """Free the parameters that the recording determines, and calibrate the exact model again with them free.

        Return the trial of the final exact answer, and the decision for each parameter.
        """
        settings, names = self.settings, self._tested_names(first)
        trial = trial_for(recording, first, settings, names, self._ready, device=self._device)
        parameters = judge_parameters(trial, names)
        while more := tuple(n for p in parameters if p.freed and p.name in GROUPS for n in GROUPS[p.name]):
            start = {**settings.start, **first.parameters}
            free = replace(settings, free=(*first.free, *more), start=start, global_algorithm=None)
            try:
                exact = calibrate(recording, free)
            except AmiwarpError as error:
                return trial, tuple(_held(p, f"the calibration fails with it free: {error}") for p in parameters)
            confirmed = tuple(_confirmed(trial, p, exact) for p in parameters)
            if confirmed == parameters:
                warnings = tuple(dict.fromkeys((*first.warnings, *exact.warnings)))
                exact = replace(exact, stages=(*first.stages, *exact.stages), warnings=warnings)
                return trial_for(recording, exact, settings, (), None, device=self._device), parameters
            parameters = confirmed
        return trial, parameters

    def _tested_names(self, exact: Calibration) -> tuple[str, ...]:
        """Return the names of the parameters that might be freed."""
        return candidate_names(self._recording, exact) if self.settings.free is None else ()


# Comparison of the models.


def compare_models(trial: Trial) -> tuple[ModelCandidate, ...]:
    """Compare all models, and choose the smallest that keeps the budget and is not clearly worse on held-out turns.

    Models are measured on held-out turns only if that may change the choice, or if no photometric stage has confirmed
    the exact model, and measuring shows whether the recording contradicts it.
    """
    confirmed = accepted_photometric(trial.exact) is not None
    candidates: list[ModelCandidate] = []
    for name in rungs():
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
    numbers = MODELS[name].NUMBERS
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


def express(trial: Trial, name: str, settings: Settings) -> Calibration:
    """Express the exact model's calibration in the parameters of the model ``name``, with uncertainty.

    A circle is fitted to the exact model at the sample. Its size replaces the apex. The sharpness is measured
    like that of the exact model.
    """
    exact = trial.exact
    if MODELS[name].closed_form() is ExactModel:
        return replace(exact, model_name=name)
    size = MODELS[name].SIZE
    space, values = trial.fitted(name, exact)
    gain = values[size] / exact.parameters["apex"]
    known = {size if n == "apex" else n: x * (gain if n == "apex" else 1.0) for n, x in exact.uncertainty.items()}
    free = tuple(size if n == "apex" else n for n in exact.free)
    return replace(
        exact, model_name=name, prism=replace(exact.prism, index=exact.parameters.get("index", exact.prism.index)),
        parameters=values, uncertainty={n: x for n, x in known.items() if n in values},
        free=tuple(n for n in free if n in values), sharpness_after=_sharpness(trial, space, values, settings),
    )  # fmt: skip


def _sharpness(trial: Trial, space: ParameterSpace, values: Mapping[str, float], settings: Settings) -> float:
    """Return the sharpness of all events, on a canvas as large as the search's, so that both values are comparable."""
    like = trial.space_of("exact", trial.exact)
    largest = settings.bounds.get("apex", (0.0, 2.0 * as_wedge(trial.exact.prism).apex))[1]
    camera, kind, device = space.camera, settings.sharpness, trial.device
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


# Decision which of clock offset, tilt and index to calibrate: those that size and phase cannot imitate.

TILT = ("tilt_x", "tilt_y")
"""Parameters of the direction of the prism's axis."""
GROUPS = {"clock_offset": ("clock_offset",), "tilt": TILT, "index": ("index",)}
"""Parameters that the automatic calibration may free, in groups that are freed together."""
REMEDY = {
    "clock_offset": "record at two speeds, or while the prism speeds up: at one speed it is part of the phase",
    "tilt": "record through a wider lens or a stronger prism, with edges near the image's border",
    "index": "give it: through this lens its effect is the same as that of the apex",
    "rpm": "record more turns of a still scene, or use an encoder",
}
"""Advice to the user for each group of parameters that a recording does not determine."""


def candidate_names(recording: Recording, exact: Calibration) -> tuple[str, ...]:
    """Return the names of the parameters that the automatic calibration may free.

    These are none if the camera rotated, which blurs the image. Without an encoder the clock offset is part of the
    phase.
    """
    p = exact.photometric
    if p is not None and any(n in p.sharpness_parameters for n in MOTION):
        return ()
    names = [n for group in GROUPS.values() for n in group if n not in exact.parameters]
    return tuple(n for n in names if n != "clock_offset" or recording.encoder is not None)


def judge_parameters(trial: Trial, names: tuple[str, ...]) -> tuple[FreedParameter, ...]:
    """Decide for each group of the parameters ``names`` whether to free it, and whether a free rpm is determined."""
    found = [_judge(trial, group) for group, members in GROUPS.items() if set(members) <= set(names)]
    if "rpm" in trial.exact.uncertainty:
        angle = trial.exact.uncertainty["rpm"] * (math.tau / 60e6) * trial.duration_us / math.sqrt(12.0)
        std = angle * motion_per_angle(trial.path)
        determined = std <= UNDETERMINED_PX
        verdict = (
            "free: there is no encoder" if determined else f"free: there is no encoder; not determined: {REMEDY['rpm']}"
        )
        found.append(
            FreedParameter(name="rpm", freed=True, determined=determined, std_px=std, gain_px=None, verdict=verdict)
        )
    return tuple(found)


def _judge(trial: Trial, group: str) -> FreedParameter:
    """Decide whether to free a group: it must be determined, and held-out turns must become sharper with it."""
    space, members = trial.space, GROUPS[group]
    if not set(members) <= set(space.names):
        return _no_tilt(trial.exact)
    if not set(members) <= set(trial.tested):
        most = min(trial.motion_range(n) for n in members)
        return _undetermined(group, None, f"independently of apex and phase it moves events by at most {most:.2g} px")
    which = [0, 1, *(trial.tested.index(n) for n in members)]
    rows = [space.names.index(n) for n in members]
    longer = np.abs(trial.directions[rows, rows])
    quadratic = trial.quadratic.restricted_to(which)
    std = float((quadratic.deviations()[2:] * longer).max())
    share = float(1.0 / longer.max() ** 2)
    if not (std <= UNDETERMINED_PX and share >= LEAST_CURVATURE):
        how = f"± {std:.2g} px" if std < LARGEST_MOTION_PX else f"over ± {LARGEST_MOTION_PX:g} px"
        return _undetermined(group, std, f"{how}, {share:.1g} of the largest curvature")
    held, freed = (trial.test.each(space, trial.sharpest(k)) for k in ([0, 1], which))
    _, _, gain = trial.as_motion(freed - held)
    moved = float(np.linalg.norm(quadratic.step_to_maximum()[2:]))
    wins = gain[0] > 0.0 and moved > trial.budget_px
    worth = f"{max(gain[0], 0.0):.3f} to {in_pixels(max(gain[1], 0.0))}"
    evidence = f"it moves events by {moved:.3f} px; the gain on held-out turns is equivalent to {worth}"
    return FreedParameter(
        name=group, freed=wins, determined=True, std_px=std, gain_px=gain,
        verdict=f"{'freed' if wins else 'held'}: {evidence}",
    )  # fmt: skip


def _no_tilt(exact: Calibration) -> FreedParameter:
    """Return the decision on a tilt that the photometric stage has ruled out."""
    assert exact.photometric is not None
    assert exact.photometric.center_px is not None
    verdict = f"held: the photometric stage finds that it moves events by at most {largest_tilt(exact):.3f} px"
    std = exact.photometric.center_px[1]
    return FreedParameter(name="tilt", freed=False, determined=True, std_px=std, gain_px=None, verdict=verdict)


def _undetermined(group: str, std_px: float | None, why: str) -> FreedParameter:
    verdict = f"not determined ({why}): {REMEDY[group]}"
    return FreedParameter(name=group, freed=False, determined=False, std_px=std_px, gain_px=None, verdict=verdict)


def _held(p: FreedParameter, why: str) -> FreedParameter:
    """Return the decision for a parameter, not to free it after all; one that was not freed remains as it is."""
    return replace(p, freed=False, verdict=f"held: {why}") if p.name in GROUPS and p.freed else p


def _confirmed(trial: Trial, p: FreedParameter, again: Calibration) -> FreedParameter:
    """Keep a parameter free only if the second calibration changed it significantly and beyond the error budget."""
    if p.name not in GROUPS or not p.freed:
        return p
    start = {**trial.space.start, "clock_offset": trial.encoder.clock_offset_us}
    moved, significant = 0.0, False
    for name in GROUPS[p.name]:
        k = trial.space.names.index(name)
        shift = again.parameters[name] - start[name]
        moved = math.hypot(moved, shift * trial.space.pixels[name] / float(trial.directions[k, k]))
        # a parameter that the photometric stage did not determine has no standard deviation
        significant |= abs(shift) > SIGNIFICANT_STD * again.uncertainty.get(name, math.inf)
    if significant and moved > trial.budget_px:
        return p
    return _held(p, f"a calibration with it free moved events by {moved:.3f} px, not significantly over the budget")


# Groundwork of the choice of a model: what it needs of the sharpness stage's answer.
#
# The photometric stage may still run then.

SEARCH_RANGE = {"clock_offset": 20_000.0, "tilt_x": math.radians(15.0), "tilt_y": math.radians(15.0), "index": 0.4}
"""Half width of the tested range of each parameter that might be freed, in its unit (us, rad, 1)."""
CIRCLES = tuple(name for name, model in rungs().items() if model.closed_form() is model and name != ExactModel.NAME)
"""Models that are fitted to the exact one."""


@dataclass(frozen=True, kw_only=True)
class Groundwork:
    """Events at which models are compared, and how the parameters of the models move them."""

    answer: Calibration
    """Calibration of the exact model with the sharpness stage's parameters."""
    encoder: Encoder
    """Encoder that gives the prism angles of the events, with the calibrated clock offset."""
    encoder_noise: float
    """Standard deviation of the encoder's angle noise [rad]."""
    events: Events
    """Events of the recording: all that are in memory, or a part of those in a file."""
    most_events: int
    """Largest number of events on which sharpness is measured."""
    sample: Places
    """Evenly thinned events at which the displacements of models are compared."""
    rad_per_us: float
    """Mean speed of the prism [rad/us]."""
    duration_us: float
    """Duration of the events [us]."""
    space: ParameterSpace
    """Parameter space of the exact model in which all parameters that might be freed are free."""
    circles: tuple[LinearMotion, ...]
    """Motion of the sample by each of the models :data:`CIRCLES`."""
    start: Vector
    """Parameters found by the sharpness stage, as a vector of ``space`` [px], shape ``(n,)``."""
    directions: Vector
    """One search direction per parameter (see :func:`independent_directions`), shape ``(n, n)``."""
    tested: tuple[str, ...]
    """Parameters that move events measurably within their tested range: size, phase and possibly others."""

    def serves(self, exact: Calibration, names: tuple[str, ...]) -> bool:
        """Return whether the groundwork for ``exact`` and the parameters ``names`` would be this one."""
        a, b = self.answer, sharpness_answer(exact)
        return (
            (a.camera, a.prism, a.parameters) == (b.camera, b.prism, b.parameters)
            and not set(DRIFTS) & set(a.parameters)  # the encoder depends on them
            and self.space.names[2:] == names
        )

    def space_of(self, model: str, exact: Calibration) -> ParameterSpace:
        """Return the parameter space of ``model`` about the calibration ``exact``, with only size and phase free."""
        return candidate_space(
            model, exact, (), rad_per_us=self.rad_per_us, duration_us=self.duration_us, pixels=self.space.pixels
        )

    def fitted(self, model: str, exact: Calibration) -> tuple[ParameterSpace, dict[str, float]]:
        """Return the space of a smaller model about ``exact``, and its parameters that fit ``exact`` best."""
        space = self.space_of(model, exact)
        target = self.sample.compensated(exact.model)
        ((values, _),) = fit(linear_motions([space], self.sample), target, self.sample)
        return space, values

    def motion_range(self, name: str) -> float:
        """Return how far a parameter moves events in its tested range [px rms], beyond what size and phase can do."""
        return _motion_range(self.space, self.directions, name)


def lay_groundwork(recording: Recording, exact: Calibration, settings: Settings, names: tuple[str, ...]) -> Groundwork:
    """Return the groundwork for the choice among models. ``names`` are the parameters that might be freed."""
    parts = lay_in_parts(recording, exact, settings, names)
    while True:
        try:
            next(parts)
        except StopIteration as end:
            return cast("Groundwork", end.value)


def lay_in_parts(
    recording: Recording, exact: Calibration, settings: Settings, names: tuple[str, ...]
) -> Generator[None, None, Groundwork]:
    """Return a generator that lays the groundwork of :func:`lay_groundwork` in three parts of similar length."""
    window = rotation_window(recording, settings)
    source, most = window.events, settings.events
    if isinstance(source, MemoryEvents):
        events = source.slice(0, len(source))
    else:
        events = thin(window, most)
        most = len(events)
    first, last = int(events.t[0]), int(events.t[-1])
    encoder = exact.encoder_for(recording.encoder, first, last)
    if not encoder.covers(first, last):  # a calibrated clock offset may uncover the first or the last events
        events = events[slice(*np.searchsorted(events.t, encoder.coverage))]
        first, last = int(events.t[0]), int(events.t[-1])
    duration = float(max(last - first, 1))
    speed = float(np.ptp(encoder.angle_at(events.t[[0, -1]]))) / duration
    sample, answer = Places.of(events, encoder), sharpness_answer(exact)
    tilted = bool(set(TILT) & set(names))
    pixels = None if tilted else scales(sample.path(answer.model), sample, answer, speed)
    space = candidate_space("exact", answer, names, rad_per_us=speed, duration_us=duration, pixels=pixels)
    space = _with_search_range(space)
    circles = [
        candidate_space(name, answer, (), rad_per_us=speed, duration_us=duration, pixels=space.pixels)
        for name in CIRCLES
    ]
    yield
    (motion,) = linear_motions([space], sample)
    rows = independent_directions(motion)
    yield
    smaller = linear_motions(circles, sample)
    return Groundwork(
        answer=answer, encoder=encoder, encoder_noise=encoder_noise(encoder), events=events, most_events=most,
        sample=sample, rad_per_us=speed, duration_us=duration, space=space, circles=tuple(smaller), start=motion.v,
        directions=rows, tested=tuple(n for n in space.names if _motion_range(space, rows, n) >= STEP_PX),
    )  # fmt: skip


def accepted_photometric(exact: Calibration) -> PhotometricSummary | None:
    """Return the result of the photometric stage if it is the calibration's result, else None."""
    p = exact.photometric
    return p if p is not None and p.accepted else None


def sharpness_answer(exact: Calibration) -> Calibration:
    """Return the calibration with the sharpness stage's parameters, which are sharper than the photometric stage's."""
    p = accepted_photometric(exact)
    if p is None:
        return exact
    # parameters that only the photometric stage found stay; a camera rotation that was discarded stays discarded
    unsharp = like_size(p.sharpness_parameters)
    found = {n: x for n, x in p.sharpness_parameters.items() if n in exact.parameters and n not in unsharp}
    return replace(exact, parameters={**exact.parameters, **found})


def _with_search_range(space: ParameterSpace) -> ParameterSpace:
    return replace(
        space,
        low={n: space.start[n] - SEARCH_RANGE[n] if n in SEARCH_RANGE else x for n, x in space.low.items()},
        high={n: space.start[n] + SEARCH_RANGE[n] if n in SEARCH_RANGE else x for n, x in space.high.items()},
    )


def _motion_range(space: ParameterSpace, directions: Vector, name: str) -> float:
    """Return the value of :meth:`Groundwork.motion_range`; infinite for parameters without a range."""
    k = space.names.index(name)
    return SEARCH_RANGE[name] * space.pixels[name] / abs(float(directions[k, k])) if name in SEARCH_RANGE else math.inf


# Data for the choice of a model: training and held-out events, and the parameters that might be freed.

SIGNIFICANT_STD = 2.0
"""Number of standard deviations by which a larger model, or a freed parameter, must be sharper on held-out turns."""
CONVERSION_FACTOR = 2.0
"""Factor by which a displacement inferred from a loss of sharpness may be wrong: sharpness sees displacements only at
edges and across them."""
BIAS_PX = 0.1
"""Typical distance of the sharpest parameters from the true ones [px]. Smaller displacements are not significant in
sharpness."""
LARGEST_MOTION_PX = 3.0
"""Largest displacement to which a loss of sharpness is converted [px]: the quadratic approximation of sharpness holds
only near the optimum."""
TILT_FACTOR = 2.0
"""Factor by which a tilt may move events further than the correction of the principal point that it asks for: a tenth,
for lenses of 20 to 90 deg. The rest is for the linearised fit, which may find too small changes."""


@dataclass(frozen=True, kw_only=True)
class Trial(Groundwork):
    """Calibrated exact model, with the two halves of the events on which models are fitted and compared.

    The sharpness of the halves is measured when it is first used: most recordings do not need it.
    """

    exact: Calibration
    """Calibration of the exact model, with which smaller models are compared."""
    path: Vector
    """Coordinates of the sample compensated by the exact model at :data:`TURN` [px], shape ``(TURN_ANGLES, n, 2)``."""
    predicted: Mapping[str, float]
    """Predicted error of each model: the distance of its best fit from the exact model at the sample [px rms]."""
    budget_px: float
    """Largest tolerated error of a smaller model relative to the exact one [px rms]."""
    timing_px: float
    """Estimated blur from encoder noise, clock resolution and latency jitter [px rms]."""
    device: Any
    """Device that measures sharpness."""

    @cached_property
    def calibration_events(self) -> CalibrationEvents:
        """Evenly thinned events on which sharpness is measured, with their encoder."""
        drifts = "clock_offset" in self.space.names
        slope_of = (lambda t: self.encoder.speed_at(t) * 1e-6) if drifts else None
        return CalibrationEvents(thin_events(self.events, self.most_events), self.encoder, slope_of)

    @cached_property
    def _halves(self) -> tuple[HalfSharpness, ...]:
        halves = split_turns(self.calibration_events)
        return tuple(HalfSharpness(half, self.calibration_events, self.space, self.device) for half in halves)

    @property
    def train(self) -> HalfSharpness:
        """Sharpness of the training turns, on which models are fitted."""
        return self._halves[0]

    @property
    def test(self) -> HalfSharpness:
        """Sharpness of the held-out turns, on which models are compared."""
        return self._halves[1]

    @cached_property
    def quadratic(self) -> Quadratic:
        """Quadratic approximation of the exact model's sharpness on the training turns, along all tested directions."""
        rows = [self.space.names.index(n) for n in self.tested]
        return Quadratic.about(self.train, self.space, self.start, self.directions[rows])

    @cached_property
    def reference(self) -> Vector:
        """Sharpness of the exact model on the held-out turns, with the parameters sharpest on the training turns."""
        return self.test.each(self.space, self.sharpest([0, 1]))

    @property
    def rejection_px(self) -> float:
        """Error shown by held-out turns above which a model is rejected even if its predicted error is small [px]."""
        return max(CONVERSION_FACTOR * self.budget_px, BIAS_PX)

    def shift_along(self, which: list[int], steps: Vector) -> Vector:
        """Return the change of the search vector [px] for ``steps`` along the directions numbered in ``which``."""
        rows = [self.directions[self.space.names.index(self.tested[k])] for k in which]
        return np.asarray(steps @ np.array(rows))

    def sharpest(self, which: list[int]) -> dict[str, float]:
        """Return the exact model's sharpest parameters on the training turns along the directions in ``which``."""
        step = self.quadratic.restricted_to(which).step_to_maximum()
        return self.space.to_values(self.start + self.shift_along(which, step))

    def as_motion(self, loss: Vector) -> tuple[float, float, tuple[float, float]]:
        """Return the mean and standard deviation of losses of sharpness, and the equivalent displacements [px rms].

        ``loss`` holds the losses of disjoint parts. The curvature of sharpness converts the mean minus and plus
        :data:`SIGNIFICANT_STD` standard deviations to displacements, negative for a gain, limited to
        :data:`LARGEST_MOTION_PX`. Without curvature the displacements are the two limits.
        """
        mean, std = float(loss.mean()), float(loss.std(ddof=1)) / math.sqrt(len(loss))
        curvature = self.quadratic.restricted_to([0, 1]).curvature
        if not curvature > 0.0:
            return mean, std, (-LARGEST_MOTION_PX, LARGEST_MOTION_PX)
        low, high = (
            math.copysign(min(math.sqrt(2.0 * abs(x) / curvature), LARGEST_MOTION_PX), x)
            for x in (mean - SIGNIFICANT_STD * std, mean + SIGNIFICANT_STD * std)
        )
        return mean, std, (low, high)


def in_pixels(px: float) -> str:
    """Return a displacement as text; above the largest measurable displacement only that limit is given."""
    return f"{px:.3f} px" if px < LARGEST_MOTION_PX else f"more than {LARGEST_MOTION_PX:g} px"


def trial_for(
    recording: Recording,
    exact: Calibration,
    settings: Settings,
    names: tuple[str, ...],
    ready: Groundwork | None = None,
    *,
    device: Any,
) -> Trial:
    """Return the trial of ``exact``, which tests the parameters ``names``.

    It does not test the tilt if the photometric stage has shown that a tilt moves events by less than the budget.
    ``ready``: groundwork that was laid before, if any.
    """
    untilted = tuple(n for n in names if n not in TILT)
    tilt = largest_tilt(exact)
    if tilt < math.inf:
        ground = ready if ready is not None and ready.serves(exact, untilted) else None
        ground = ground or lay_groundwork(recording, exact, settings, untilted)
        trial = make_trial(ground, exact, device=device, budget_px=settings.budget_px)
        if tilt <= trial.budget_px or names == untilted:
            return trial
    ground = lay_groundwork(recording, exact, settings, names)
    return make_trial(ground, exact, device=device, budget_px=settings.budget_px)


def make_trial(ground: Groundwork, exact: Calibration, *, device: Any, budget_px: float | None) -> Trial:
    """Compare the models with the calibrated exact model, on the groundwork for it.

    ``budget_px`` is the largest tolerated model error [px rms]; None: :data:`SHARE` of the blur by quantisation and
    timing.
    """
    path = ground.sample.path(exact.model)
    timing = timing_blur(path, ground.encoder_noise, ground.rad_per_us)
    predicted = {name: px for name, (_, px) in zip(CIRCLES, fit(ground.circles, path[0], ground.sample), strict=True)}
    return Trial(
        **vars(ground), exact=exact, path=path, predicted={**predicted, "ellipse": ellipse_error(path), "exact": 0.0},
        budget_px=budget_px or SHARE * math.hypot(QUANTISATION_PX, timing), timing_px=timing, device=device,
    )  # fmt: skip


def largest_tilt(exact: Calibration) -> float:
    """Return how far a tilt of the prism's axis may move events [px rms]; infinite if only sharpness can show it.

    A tilt would ask the photometric stage for another principal point.
    """
    p = accepted_photometric(exact)
    if p is None or p.center_px is None:
        return math.inf
    moved, std = p.center_px
    return TILT_FACTOR * (moved + SIGNIFICANT_STD * std)


# Fit of the models with fewer parameters to the exact model, at the events of a scene.
#
# The module also estimates the blur that remains even with the exact model: by encoder noise, clock resolution and
# latency jitter.

SAMPLED = 1_000
"""Number of events at which models are compared: enough for an rms error accurate to 3 %."""
SLOPE_PX = 0.25
"""Step of the finite differences in the search vector [px]."""
TURN_ANGLES = 4
"""Number of prism angles that give the mean and the first harmonic of a motion. Four keep the ellipse model's error to
0.3 %: higher harmonics fall off quickly."""
TURN = math.tau * np.arange(TURN_ANGLES)[:, None] / TURN_ANGLES
"""These prism angles, from the event's own [rad], shape ``(TURN_ANGLES, 1)``."""
QUANTISATION_PX = 1.0 / math.sqrt(12.0)
"""Standard deviation of the error from rounding coordinates to whole pixels [px]."""
CLOCK_US = 1.0 / math.sqrt(12.0)
"""Standard deviation of the error from rounding times to whole microseconds [us]."""
LATENCY_JITTER_US = 30.0
"""Assumed standard deviation of the latency of a good sensor in good light [us]. It cannot be measured from a
recording."""
SHARE = 0.1
"""Default limit of the model error, as a share of the blur by quantisation and timing."""


@dataclass(frozen=True)
class Places:
    """Evenly thinned events at which models are compared.

    A difference between models therefore counts where and when the scene has events.
    """

    xy: NDArray[np.float64]
    """Pixel coordinates of the events [px], shape ``(n, 2)``."""
    theta: NDArray[np.float64]
    """Prism angle of each event according to the encoder, wrapped to a turn [rad], shape ``(n,)``."""
    speed: NDArray[np.float64]
    """Speed of the prism at each event [rad/us], shape ``(n,)``."""

    @classmethod
    def of(cls, events: Events, encoder: Encoder, most: int = SAMPLED) -> Places:
        """Return about ``most`` evenly thinned events with their prism angles and speeds."""
        some = events[:: max(1, len(events) // most)]
        xy = np.stack([some.x, some.y], axis=1).astype(np.float64)
        return cls(xy, wrap_angle(encoder.angle_at(some.t)), encoder.speed_at(some.t) * 1e-6)

    def compensated(self, model: Model) -> NDArray[np.float64]:
        """Return the events' compensated coordinates [px], shape (n, 2)."""
        return compensate_by_each([model], self.xy, self.theta)[0]

    def path(self, model: Model) -> NDArray[np.float64]:
        """Return the events' compensated coordinates at :data:`TURN` [px], shape (TURN_ANGLES, n, 2)."""
        return compensate_by_each([model] * len(TURN), self.xy, self.theta + TURN)

    def distance(self, model: Model, other: Model, *, remove_lag: bool = False) -> float:
        """Return the rms distance of two models at the events [px].

        With ``remove_lag``, a constant angle between the models does not count.
        """
        away = self.compensated(model) - self.compensated(other)
        if remove_lag:
            angles = self.theta + np.array([[0.01], [-0.01]])
            later, earlier = compensate_by_each([model, model], self.xy, angles)
            per_angle = later - earlier
            away = away - per_angle * (np.nansum(away * per_angle) / np.nansum(per_angle**2))
        return rms(away)


def motion_per_angle(path: NDArray[np.float64]) -> float:
    """Return how far compensated events move per change of the prism angle [px rms per rad].

    ``path`` holds their coordinates at :data:`TURN` [px], shape (TURN_ANGLES, n, 2). The result is exact for the first
    harmonic of the motion, next to which the others are small.
    """
    return rms(path[1] - path[-1]) / (2.0 * math.sin(TURN[1, 0]))


def scales(path: NDArray[np.float64], sample: Places, exact: Calibration, speed: float) -> dict[str, float]:
    """Return how far events move per unit of each of the exact model's parameters, to first order in the apex [px rms].

    ``path`` holds the coordinates of the sample's events at :data:`TURN` [px], shape (TURN_ANGLES, n, 2). ``speed`` is
    the mean speed of the prism [rad/us].
    """
    moved, turned = rms(path[0] - sample.xy), motion_per_angle(path)
    found = exact.parameters
    return {
        "apex": moved / found["apex"], "phase": turned, "clock_offset": turned * abs(speed),
        "index": moved / (found.get("index", exact.prism.index) - 1.0),
    }  # fmt: skip


def timing_blur(path: NDArray[np.float64], noise: float, speed: float) -> float:
    """Return the blur [px rms] by encoder noise [rad], clock resolution and latency jitter at a prism speed [rad/us].

    ``path`` holds the compensated coordinates of n events at :data:`TURN` [px], shape (TURN_ANGLES, n, 2).
    """
    return motion_per_angle(path) * math.hypot(noise, speed * math.hypot(CLOCK_US, LATENCY_JITTER_US))


def encoder_noise(encoder: Encoder) -> float:
    """Return the standard deviation of an encoder's angle noise [rad], rounding included; 0 for less than 4 samples.

    Samples are compared with the interpolation between their two neighbours: at most about :data:`SAMPLED`, however
    long the recording is. The median magnitude of the differences gives the standard deviation of white noise.
    """
    t, angle = encoder.t, encoder.angle
    if len(t) < 4:
        return 0.0
    step = max(1, len(t) // SAMPLED)
    (t0, a0), (t1, a1), (t2, a2) = ((t[k : len(t) - 2 + k : step], angle[k : len(t) - 2 + k : step]) for k in range(3))
    middle = (t1 - t0) / (t2 - t0)
    excess = a1 - a0 - middle * (a2 - a0)
    share = 1.0 + middle**2 + (1.0 - middle) ** 2
    return float(np.median(np.abs(excess) / np.sqrt(share))) / 0.6745


def candidate_space(
    model: str,
    exact: Calibration,
    free: tuple[str, ...],
    *,
    rad_per_us: float,
    duration_us: float,
    pixels: Mapping[str, float] | None = None,
) -> ParameterSpace:
    """Return the parameter space of ``model`` about the exact calibration: size, phase and ``free`` are free.

    ``rad_per_us`` is the mean speed of the prism [rad/us], ``duration_us`` the duration of the events [us]. ``pixels``
    tells how far events move per unit of each free parameter of the exact model [px rms]; None: it is measured.
    """
    found = exact.parameters
    prism = replace(as_wedge(exact.prism), apex=found["apex"], index=found.get("index", exact.prism.index))
    size, start = MODELS[model].SIZE, values_of(model, found)
    start[size] = MODELS[model].size_from_apex(found["apex"], prism)
    start["phase"] = math.remainder(found["phase"], math.tau)
    if pixels is not None:
        pixels = {**pixels, size: pixels["apex"] * prism.apex / start[size]}
    return make_space(
        model, exact.camera, prism, free=(size, "phase", *free), start=start, bounds={size: (0.0, 2.0 * start[size])},
        rad_per_us=rad_per_us, duration_us=duration_us, middle_us=exact.middle_us or 0, pixels=pixels,
    )  # fmt: skip


@dataclass(frozen=True)
class LinearMotion:
    """Motion of n events to first order about a point of a parameter space of k dimensions."""

    space: ParameterSpace
    """The parameter space."""
    v: NDArray[np.float64]
    """The point: a search vector [px], shape ``(k,)``."""
    at: NDArray[np.float64]
    """Compensated coordinates of the events at the point [px], shape ``(n, 2)``."""
    slopes: NDArray[np.float64]
    """Their change per entry of the search vector [px/px], shape ``(k, n, 2)``."""


def linear_motions(spaces: Sequence[ParameterSpace], sample: Places) -> list[LinearMotion]:
    """Return the motion of events about the start of each parameter space, by finite differences.

    The motion is nearly linear in size and phase, which are Cartesian. The differences by other parameters take a step
    both ways: a clock offset turns the orbits, and a tilt that moves events by :data:`SLOPE_PX` is large.
    """
    starts = [space.to_vector(space.start) for space in spaces]
    steps = [SLOPE_PX * np.eye(len(v)) for v in starts]
    near = [
        [space.to_values(at) for at in (v, *(v + h), *(v - h[2:]))]
        for space, v, h in zip(spaces, starts, steps, strict=True)
    ]
    each = [(space, values) for space, several in zip(spaces, near, strict=True) for values in several]
    drifts = np.array([[space.drift(values)] for space, values in each])
    models = [space.build(values) for space, values in each]
    moved = compensate_by_each(models, sample.xy, sample.theta + drifts * sample.speed)
    found = []
    for space, v, part in zip(spaces, starts, np.split(moved, np.cumsum([len(n) for n in near])[:-1]), strict=True):
        at, ahead, back = part[0], part[1 : 1 + len(v)], part[1 + len(v) :]
        slopes = (ahead - at) / SLOPE_PX
        slopes[2:] = (ahead[2:] - back) / (2.0 * SLOPE_PX)
        found.append(LinearMotion(space, v, at, slopes))
    return found


def fit(
    motions: Sequence[LinearMotion], target: NDArray[np.float64], sample: Places
) -> list[tuple[dict[str, float], float]]:
    """Fit the parameters of several models to the compensated coordinates ``target`` [px], shape (n, 2).

    Return the parameters and the remaining distance [px rms] of each model. The phase is fitted too, which removes a
    constant lag. The displacement is nearly linear: one Gauss-Newton step is accurate to 0.00001 px.
    """
    best = []
    for m in motions:
        fields = _finite(np.stack([m.at - target, *m.slopes]))
        left, design = fields[0], fields[1:]
        best.append(m.space.to_values(m.v - np.linalg.solve(design @ design.T, design @ left)))
    models = [m.space.build(values) for m, values in zip(motions, best, strict=True)]
    found = compensate_by_each(models, sample.xy, sample.theta)
    return [(values, rms(at - target)) for values, at in zip(best, found, strict=True)]


def _finite(fields: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return fields of motion, shape (k, n, 2), in rows of 2 n numbers, without the events that one of them lacks."""
    valid = np.isfinite(np.sum(fields, axis=0)).all(axis=1)
    return (fields if valid.all() else fields[:, valid]).reshape(len(fields), -1)


def ellipse_error(path: NDArray[np.float64]) -> float:
    """Return the error of the ellipse model [px rms]: the second and higher harmonics of the motion ``path``.

    ``path`` holds the compensated coordinates of n events [px] at :data:`TURN`, shape (TURN_ANGLES, n, 2).
    """
    # mean and first harmonic of the motion at each event's own angle, the first of the turn
    ellipse = np.einsum("k,knx->nx", 1.0 + 2.0 * np.cos(TURN[:, 0]), path) / len(TURN)
    return rms(path[0] - ellipse)


def independent_directions(motion: LinearMotion) -> NDArray[np.float64]:
    """Return search directions along which each parameter moves events by 1 px in ways that size and phase cannot.

    The rows are search vectors, shape (k, k). The first two are unit vectors along size and phase. Each other row is a
    unit vector, minus the size and phase that best reproduce its motion of events, scaled so that the remaining motion
    is one pixel (rms).
    """
    fields = _finite(motion.slopes)
    directions = np.eye(len(fields))
    products = fields @ fields[:2].T
    for k in range(2, len(fields)):
        reproduced = np.linalg.lstsq(products[:2], products[k], rcond=None)[0]
        left = fields[k] - reproduced @ fields[:2]
        directions[k, :2] = -reproduced
        directions[k] /= max(float(np.sqrt(2.0 * np.mean(left**2))), 1e-9)
    return directions
