"""Sharpness stage of the calibration: contrast maximisation."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.calib import checks
from amiwarp.calib.calibration_events import CalibrationEvents
from amiwarp.calib.nlopt_solver import SearchStage, maximise
from amiwarp.calib.parameters import (
    MOTION,
    ParameterSpace,
    globally_searched,
    kept_by_global_search,
    like_size,
    of_orbit,
    optical_parameters,
    phase_names,
    units,
)
from amiwarp.calib.result import StageSummary
from amiwarp.calib.settings import Settings, stage_share
from amiwarp.choices import Sharpness
from amiwarp.events.recording import Events
from amiwarp.imaging.iwe import CanvasShape, Image, TileVotes, UploadedEvents, Votes, upload_events
from amiwarp.imaging.sharpness import SharpnessMeter
from amiwarp.optics.camera import Camera, border
from amiwarp.optics.models import MODELS, Model, build_model, points_on_host
from amiwarp.tasks import Progress

Vector = NDArray[np.float64]

# Sharpness as a function of the free parameters, computed on the device. All buffers are allocated once.

ROTATION_MARGIN_PX = 16.0
"""Extra border of the image of events if the camera's rotation is free [px]."""


class Objective:
    """Sharpness of the IWE of a set of events as a function of the free parameters. Counts its evaluations.

    On CUDA the events are sorted into tiles once, and one captured graph is launched per evaluation.
    """

    def __init__(
        self,
        space: ParameterSpace,
        events: UploadedEvents,
        *,
        kind: Sharpness,
        smoothing: float,
        pad: int,
        scale: float = 1.0,
        per_polarity: bool = False,
        parts: int = 1,
        device: Any = "cpu",
    ) -> None:
        """Allocate the buffers and copy the parameters of the image of events to the device.

        Parameters
        ----------
        space : ParameterSpace
            The free parameters.
        events : UploadedEvents
            The events on the device, with slopes for a free clock offset or rpm, and times for a camera rotation.
        kind : Sharpness
            Measure of sharpness.
        smoothing : float
            Standard deviation of the Gaussian that smooths the image [sensor px].
        pad : int
            Border of the image [px], see :func:`padding`.
        scale : float
            Canvas pixels per sensor pixel.
        per_polarity : bool
            Whether ON and OFF events form separate images.
        parts : int
            Number of disjoint parts of the events that :meth:`each` measures separately.
        device : str or warp.context.Device
            The device.
        """
        self.space, self._moving = space, space.moving
        self.evaluations = 0
        camera = space.camera
        # the paper's J is computed as published, without dithering
        dither = kind is not Sharpness.PAPER_J
        canvas = CanvasShape(camera.width, camera.height, pad, scale, per_polarity, parts=parts, dither=dither)
        if parts > 1:
            events = events.in_parts(parts, per_polarity=per_polarity)
        self._meter = SharpnessMeter(canvas, kind, smoothing=smoothing * scale, device=device)
        self._graph: Any = None
        self._votes: Votes | TileVotes
        # tiles are prepared for one camera, so a free focal length excludes them, and for one prism
        if self._meter.device.is_cuda and "focal_length" not in space.names and MODELS[space.model].ANGLES == 1:
            self._votes = TileVotes(self._meter.image, canvas, events, self._model(space.start))
        else:
            self._votes, self._events = Votes(canvas, self._meter.device), events

    def _model(self, values: Mapping[str, float]) -> Model:
        """Return the model to evaluate, without tables: they would have to be computed at every point."""
        kind = MODELS[self.space.model].closed_form()
        return build_model(kind.NAME, self.space.camera, self.space.prism, values)

    def measure(self, values: Mapping[str, float]) -> list[float]:
        """Return the sharpness of each part at parameter values, in their units."""
        self.evaluations += 1
        votes, model, drift = self._votes, self._model(values), self.space.drift(values)
        rotation = self.space.camera_rotation(values) if self._moving else None
        if isinstance(votes, TileVotes):
            votes.set(0, model, drift=drift, camera_rotation=rotation)
            if self._graph is None:
                with wp.ScopedCapture(self._meter.device) as capture:
                    votes.launch()
                    if self._meter.takes_votes:
                        self._meter.launch(votes.votes[0])
                    else:
                        votes.read(0, self._meter.image)
                        self._meter.launch()
                self._graph = capture.graph
            wp.capture_launch(self._graph)
        else:
            votes.clear()
            votes.add_events(model, self._events, drift=drift, camera_rotation=rotation)
            votes.read(self._meter.image)
            self._meter.launch()
        return self._meter.results()

    def values(self, values: Mapping[str, float]) -> float:
        """Return the sharpness of the image of warped events at parameter values, in their units."""
        return self.measure(values)[0]

    def __call__(self, v: NDArray[np.float64]) -> float:
        """Return the sharpness at a search vector [px]."""
        return self.values(self.space.to_values(v))

    def each(self, values: Mapping[str, float]) -> NDArray[np.float64]:
        """Return the sharpness of each part at parameter values, shape (parts,)."""
        return np.array(self.measure(values))

    def image(self, values: Mapping[str, float]) -> Image:
        """Return the IWE at parameter values, with the border outside the sensor, until the next evaluation."""
        self.measure(values)
        if isinstance(self._votes, TileVotes) and self._meter.takes_votes:
            self._votes.read(0, self._meter.image)
        return self._meter.image


def padding(space: ParameterSpace) -> int:
    """Return the border of the canvas [px] that keeps all events inside at the largest size and at any phase.

    For the camera's rotation it allows twice the start's rates and :data:`ROTATION_MARGIN_PX`; faster answers are
    wrong anyway. It is never larger than the image.
    """
    sizes = dict(MODELS[space.model].ORBITS)
    largest = {n: space.high[n] for n in space.names if n in sizes}
    faster = {n: 2.0 * abs(space.start.get(n, 0.0)) for n in MOTION if n in space.start}
    margin = ROTATION_MARGIN_PX if space.moving else 0.0
    most = max(space.camera.width, space.camera.height)
    return math.ceil(min(reach(space, {**space.start, **largest, **faster}) + margin, most)) + 2


def reach(space: ParameterSpace, values: Mapping[str, float]) -> float:
    """Return the largest displacement of events at ``values`` [px], by the prism and the camera's rotation."""
    camera = space.camera
    kind = MODELS[space.model].closed_form()
    xy, *points = _border_points(camera)
    model, radius = build_model(kind.NAME, camera, space.prism, values), 0.0
    for each in model.singles():
        moved = each.compensate_points(*points).numpy() - xy
        radius += float(np.linalg.norm(moved[np.isfinite(moved).all(axis=1)], axis=1).max(initial=0.0))
    turned = space.camera_rotation(values).reach(camera, space.duration_us * 0.5e-6)
    return radius + float(np.linalg.norm(turned))


@lru_cache(maxsize=16)
def _border_points(camera: Camera) -> tuple[NDArray[np.float64], wp.array, wp.array]:
    """Return pixels of the image's border at 16 prism angles [px], shape (n, 2); and both as Warp arrays on the CPU."""
    at = border(camera)
    xy = np.tile(at, (16, 1))
    return xy, *points_on_host(xy, np.repeat(np.arange(16) * (np.pi / 8), len(at)))


# Gradients and Hessian of sharpness about a point by finite differences, for disjoint parts of the events.

STEP_PX = 0.25
"""Step of the finite differences, as displacement of events [px]."""


def finite_differences(
    each: Callable[[dict[str, float]], Vector], space: ParameterSpace, v: Vector, directions: Vector
) -> tuple[Vector, Vector]:
    """Return the parts' gradients of sharpness [1/px], shape (n, parts), and the mean Hessian [1/px²], shape (n, n).

    ``each`` returns the sharpness of each part at parameter values, shape (parts,). ``v`` is the search vector about
    which they hold. Each row of ``directions`` is a shift of it that moves events by one pixel, shape (n, entries).
    """
    n, steps = len(directions), STEP_PX * directions
    both = [steps[i] + steps[j] for i in range(n) for j in range(i)]
    shifts = [np.zeros(directions.shape[1]), *steps, *-steps, *both, *(-h for h in both)]
    found = np.array([*map(each, [space.to_values(v + h) for h in shifts])])
    centre, up, down = found[0], found[1 : 1 + n], found[1 + n : 1 + 2 * n]
    mixed = iter(np.sum(np.split(found[1 + 2 * n :], 2), axis=0))
    hessian = np.zeros((n, n))
    for i in range(n):
        hessian[i, i] = np.mean(up[i] - 2.0 * centre + down[i]) / STEP_PX**2
        for j in range(i):
            bend = next(mixed) - up[i] - up[j] - down[i] - down[j] + 2.0 * centre
            hessian[i, j] = hessian[j, i] = np.mean(bend) / (2.0 * STEP_PX**2)
    return (up - down) / (2.0 * STEP_PX), hessian


# Sharpness on held-out turns: models are fitted to half of the turns and measured on the other half.

FEWEST_TURNS = 2.0
"""Number of turns in a recording from which whole turns are held out."""
SPANS = 32
"""Number of angle spans into which a recording of fewer than two turns is divided; every other span is held out."""
SMOOTHING_PX = 0.6
"""Standard deviation of the Gaussian that smooths the images [px]: small, to resolve differences of good models."""
LONGEST_STEP_PX = 0.5
"""Largest step towards the maximum of sharpness [px]."""
LEAST_CURVATURE_RATIO = 1e-2
"""Smallest curvature of sharpness, as a share of the largest, at which a step is taken along a direction."""
PARTS = 8
"""Number of disjoint parts of each half of the events, whose scatter measures the uncertainty."""


def split_turns(calibration_events: CalibrationEvents) -> tuple[Events, Events]:
    """Return the events of the even and of the odd turns, or of alternate spans if there are less than two turns."""
    events = calibration_events.events
    turned = calibration_events.encoder.angle_at(events.t)
    turned -= turned[0]  # in place: with ten million events, each array has 80 MB
    np.abs(turned, out=turned)
    whole = float(turned.max())
    turned /= math.tau if whole >= FEWEST_TURNS * math.tau else whole / SPANS
    odd = (turned.astype(np.int32) & 1).astype(np.bool_)
    del turned
    return events[np.flatnonzero(~odd)], events[np.flatnonzero(odd)]


class HalfSharpness:
    """Sharpness of one half of the events under any model, measured in disjoint parts."""

    def __init__(
        self, events: Events, calibration_events: CalibrationEvents, space: ParameterSpace, device: Any
    ) -> None:
        """Upload the events. The canvas holds the displacements that the bounds of ``space`` allow."""
        slope = None if calibration_events.slope_of is None else calibration_events.slope_of(events.t)
        middle = space.middle_us if space.moving else None
        uploaded = upload_events(events, calibration_events.encoder, device, slope=slope, middle_us=middle)
        self._events = uploaded.in_parts(PARTS, per_polarity=False)
        camera = space.camera
        canvas = CanvasShape(camera.width, camera.height, padding(space), parts=PARTS, dither=True)
        self._votes = Votes(canvas, device)
        self._meter = SharpnessMeter(canvas, Sharpness.VARIANCE, smoothing=SMOOTHING_PX, device=device)
        self.fastest: dict[str, float] = {}
        """Shortest measured time for one event's angle, displacement and vote [s], by name of the model."""

    def each(self, space: ParameterSpace, values: Mapping[str, float]) -> Vector:
        """Return the sharpness of each part, shape (PARTS,)."""
        model, device = space.build(values), self._meter.device
        self._votes.clear()
        wp.synchronize_device(device)
        began = time.perf_counter()
        self._votes.add_events(
            model, self._events, drift=space.drift(values), camera_rotation=space.camera_rotation(values)
        )
        wp.synchronize_device(device)
        took = (time.perf_counter() - began) / max(self._events.count, 1)
        self.fastest[space.model] = min(took, self.fastest.get(space.model, math.inf))
        self._votes.read(self._meter.image)
        self._meter.launch()
        return np.array(self._meter.results())


def gradient(half: HalfSharpness, space: ParameterSpace, v: Vector) -> Vector:
    """Return the gradient of the mean sharpness at a search vector [1/px]."""
    steps = STEP_PX * np.eye(len(v))
    rise = [half.each(space, space.to_values(v + h)) - half.each(space, space.to_values(v - h)) for h in steps]
    return np.asarray(np.mean(rise, axis=1) / (2.0 * STEP_PX))


@dataclass(frozen=True)
class Quadratic:
    """Quadratic approximation of sharpness about a point along n directions."""

    slopes: Vector
    """Gradient of the sharpness of each part of the events [1/px], shape ``(n, parts)``."""
    hessian: Vector
    """Hessian of the mean sharpness [1/px²], shape ``(n, n)``."""

    @classmethod
    def about(cls, half: HalfSharpness, space: ParameterSpace, v: Vector, directions: Vector) -> Quadratic:
        """Return the approximation about a search vector.

        Each row of ``directions`` is a vector that moves events by one pixel, shape (n, entries of the vector).
        """
        return cls(*finite_differences(partial(half.each, space), space, v, directions))

    def restricted_to(self, which: list[int]) -> Quadratic:
        """Return the approximation along the directions whose numbers are in ``which``."""
        return Quadratic(self.slopes[which], self.hessian[np.ix_(which, which)])

    def step_to_maximum(self, gradient: Vector | None = None) -> Vector:
        """Return the step to the sharpest point [px]: 0 along flat directions, at most :data:`LONGEST_STEP_PX` long.

        ``gradient`` [1/px] replaces the approximation's own gradient, for another model with about the same Hessian.
        """
        values, vectors = np.linalg.eigh(-self.hessian)
        along = vectors.T @ (self.slopes.mean(axis=1) if gradient is None else gradient)
        floor = LEAST_CURVATURE_RATIO * max(float(values.max()), 1e-12)
        step = vectors @ np.where(values > floor, along / np.maximum(values, floor), 0.0)
        return np.asarray(step * min(1.0, LONGEST_STEP_PX / max(float(np.linalg.norm(step)), 1e-12)))

    @property
    def curvature(self) -> float:
        """Mean curvature of sharpness over the directions [1/px²], positive at a maximum."""
        return -float(np.trace(self.hessian)) / len(self.hessian)

    def deviations(self) -> Vector:
        """Return the standard deviation of the maximum along each direction [px], by the sandwich estimate."""
        values, vectors = np.linalg.eigh(-self.hessian)
        floor = LEAST_CURVATURE_RATIO * max(float(values.max()), 1e-12)
        inverse = vectors @ np.diag(1.0 / np.maximum(values, floor)) @ vectors.T
        scatter = np.atleast_2d(np.cov(self.slopes)) / self.slopes.shape[1]
        return np.asarray(np.sqrt(np.diag(inverse @ scatter @ inverse)))


# Contrast maximisation: a global search on a coarse image of events, then a local search on a fine one.

LEAST_INSIDE_PX = 0.05
"""Distance of a parameter from its bounds below which it lies on them [px]."""
CANDIDATES = 3
"""Largest number of optima of the coarse image from which the local search starts."""


class Search:
    """Search for the parameters that make the image of warped events sharpest.

    :meth:`run` sets ``best``, the values of all parameters, and ``score``, the sharpness there.
    """

    def __init__(
        self,
        space: ParameterSpace,
        calibration_events: CalibrationEvents,
        settings: Settings,
        device: Any,
        progress: Progress | None,
    ) -> None:
        self.full_space = space
        """Parameter space of the photometric stage: all free parameters."""
        self.space = space.without(like_size(space.names)) if "photometric" in settings.stages else space
        """Parameter space of the sharpness search: without the parameters that are left to the photometric stage."""
        self.calibration_events, self.settings, self.device = calibration_events, settings, device
        self.progress = progress
        self.stages: list[StageSummary] = []
        self.pad = padding(self.space)
        """Border of the fine image outside the sensor [px]."""
        self.fine = self._objective(calibration_events, scale=1.0, smoothing=settings.smoothing_px)

    def _objective_by_parts(self, kind: Sharpness) -> Objective:
        """Return an objective that measures disjoint parts of the events separately."""
        smoothing = max(1.0, self.settings.smoothing_px)
        return self._objective(self.calibration_events, scale=1.0, smoothing=smoothing, kind=kind, parts=PARTS)

    def _objective(
        self,
        events: CalibrationEvents,
        *,
        scale: float,
        smoothing: float,
        kind: Sharpness | None = None,
        space: ParameterSpace | None = None,
        parts: int = 1,
    ) -> Objective:
        s = self.settings
        kind, space = kind or s.sharpness, space or self.space
        pad = self.pad if space is self.space else padding(space)
        if kind is Sharpness.PAPER_J:
            smoothing = 0.0  # J counts pixels with h > 0, and a Gaussian's tails would make almost all of them positive
        return Objective(
            space, events.on(self.device, space.middle_us if space.moving else None),
            kind=kind, smoothing=smoothing, pad=pad, scale=scale,
            per_polarity=s.per_polarity, parts=parts, device=self.device,
        )  # fmt: skip

    def run(self, start: Mapping[str, float] | None = None) -> None:
        """Run the global and the local search; set ``best``, ``score`` and ``stages``.

        With ``start``, values of all parameters, only the local search runs.
        """
        s, space = self.settings, self.space
        starts = [space.to_vector(space.start if start is None else start)]
        still = globally_searched(space.without(kept_by_global_search(space)))
        if start is None and s.global_algorithm is not None and still.names:
            found = [dict(still.start)]
            for part in self._global_parts(still):
                one = part(found[0])
                objective, first = self._coarse_objective(self.calibration_events, one), one.to_vector(one.start)
                stage = self._maximise(objective, s.global_algorithm, first, s.global_evaluations, step=1.0)
                found = [one.to_values(v) for v in distinct_optima(stage, CANDIDATES)]
            free = [{name: values[name] for name in space.names} for values in found]
            twins = [twin for values in free if (twin := MODELS[space.model].twin_values(values)) is not None]
            starts = [space.to_vector(values) for values in (*free, *twins)]
        if space.moving:
            starts = [self._track_rotation(each) for each in starts]
        runs: list[SearchStage] = []
        for each in starts:
            known = [run.x for run in runs]  # near an optimum that is known a search ends early
            runs.append(self._maximise(self.fine, s.local_algorithm, each, s.local_evaluations, step=0.7, known=known))
        best = max(runs, key=lambda run: run.score)
        self.best, self.score = space.to_values(best.x), best.score

    def _global_parts(self, space: ParameterSpace) -> list[Callable[[Mapping[str, float]], ParameterSpace]]:
        """Return for each step of the global search how its space follows from the values of the step before.

        The prisms of a pair are searched one after the other: each removes its part of the blur.
        """
        together = MODELS[space.model].TOGETHER
        if len(together) == 1:
            return [lambda _: space]
        return [partial(of_orbit, space, k) for k, names in enumerate(together) if {*names} & {*space.names}]

    def _coarse_objective(self, events: CalibrationEvents, space: ParameterSpace) -> Objective:
        step = max(1, len(events.events) // (self.settings.events // 3 + 1))
        return self._objective(events.every(step), scale=0.5, smoothing=4.0, space=space)

    def _track_rotation(self, start: NDArray[np.float64]) -> NDArray[np.float64]:
        """Improve the start values of a rotating camera by a local search on the coarse image.

        Without a prism there is no estimate of the rotation. Then the events come from windows that grow about the
        middle: in a short window the blur is smaller than the smoothing, whatever the speed.
        """
        for share in (1.0,) if self.space.sized else (0.125, 0.25, 0.5, 1.0):
            objective = self._coarse_objective(self.calibration_events.central(share), self.space)
            stage = self._maximise(
                objective, self.settings.local_algorithm, start, self.settings.local_evaluations, step=2.0
            )
            start = stage.x
        return start

    def _maximise(
        self,
        objective: Objective,
        algorithm: str,
        start: NDArray[np.float64],
        budget: int,
        step: float,
        known: Sequence[NDArray[np.float64]] = (),
    ) -> SearchStage:
        """Run a search algorithm and append its summary to ``stages``."""
        space, values = objective.space, []
        low, high = space.bounds()
        name = "global" if algorithm.startswith("G") else "local"

        def score(v: NDArray[np.float64]) -> float:
            self.report(name, objective.evaluations / budget)
            values.append(space.to_values(v))
            return objective.measure(values[-1])[0]

        s = self.settings
        stage = maximise(
            score, algorithm, low=low, high=high, start=start, evaluations=budget, tolerance=s.tolerance_px, step=step,
            inner=s.local_algorithm, seed=s.seed, known=known,
        )  # fmt: skip
        self.stages.append(StageSummary.of(name, stage, space.names, values))
        return stage

    def report(self, stage: str, share: float) -> None:
        """Tell the progress function which share of a stage is finished."""
        if self.progress is not None:
            self.progress(*stage_share(self.settings, stage, share))

    def gain_over(self, other: Search) -> float:
        """Return by how much the image is sharper than at another search's answer [standard deviations].

        Both searches have the same events, or this one has a camera's rotation, without which the other answer is
        measured here.
        """
        parts = self._objective_by_parts(Sharpness.VARIANCE)
        here, space = parts.each(self.best), self.space
        if space.moving:
            still = {n: other.best[n] for n in other.space.names} | dict.fromkeys(
                (n for n in MOTION if n in self.best), 0.0
            )
            return checks.significance(here, parts.each({**self.best, **still}))
        return checks.significance(here, other._objective_by_parts(Sharpness.VARIANCE).each(other.best))

    def check_answer(self, name: str) -> tuple[tuple[str, ...], dict[str, float]]:
        """Return warnings and standard deviations; raise :class:`AmiwarpError` if chance explains the sharpness."""
        best, space, camera = self.best, self.space, self.space.camera
        parts = self._objective_by_parts(self.settings.sharpness)
        if space.sized:
            # variance, whatever the measure of the search: the paper's J may prefer an image without compensation
            plain = self.settings.sharpness is Sharpness.VARIANCE
            variance = parts if plain else self._objective_by_parts(Sharpness.VARIANCE)
            kind = MODELS[space.model]
            points = (best, kind.turned_values(best, math.pi), kind.still_values(best))
            sharp, opposite, still = (variance.each(values) for values in points)
            if "photometric" in self.settings.stages:
                size, most = space.size_name, space.high[space.size_name]
                checks.check_size(kind, best[size] + LEAST_INSIDE_PX / space.pixels[size], most, name)
            checks.check_texture(sharp, opposite, still, name, kind.MOVER)
            # not the border outside the sensor, and as much inside, where the view ends: at most a quarter of it
            inset = self.pad + min(self.pad, min(camera.width, camera.height) // 4)
            checks.check_directions(self.fine.image(best), inset, name)
        v = space.to_vector(best)
        covariance, warnings = estimate_covariance(parts, v)
        return warnings, space.deviations(v, covariance)

    def sharpness_in(self, space: ParameterSpace, values: Mapping[str, float]) -> float:
        """Return the sharpness at ``values`` with the camera and the prism of ``space``."""
        known, fine = self.space, self.fine
        same = (space.model, space.names, space.camera, space.prism, space.moving, space.start, space.high) == (
            known.model, known.names, known.camera, known.prism, known.moving, known.start, known.high
        )  # fmt: skip
        if not same:
            smoothing = self.settings.smoothing_px
            fine = self._objective(self.calibration_events, scale=1.0, smoothing=smoothing, space=space)
        return fine.values(values)


def bound_warnings(space: ParameterSpace, values: Mapping[str, float]) -> tuple[str, ...]:
    """Return a warning for each free parameter whose value lies on one of its bounds.

    A bound beyond which there are no values is none.
    """
    unit = units()
    known = optical_parameters()
    at_bound = []
    for name in space.names:
        least, most = known[name].limits if name in known else (-math.inf, math.inf)
        scale = math.radians(1.0) if unit.get(name) == "rad" else 1.0
        below = values[name] - space.low[name] if space.low[name] > scale * least else math.inf
        above = space.high[name] - values[name] if space.high[name] < scale * most else math.inf
        if name not in phase_names() and min(below, above) * space.pixels[name] < LEAST_INSIDE_PX:
            at_bound.append(name)
    shown = {n: f"{n} = {values[n]:.6g} {unit.get(n, '')}".rstrip() for n in at_bound}
    return tuple(f"{text} lies on its bound; widen the bounds of {n}" for n, text in shown.items())


def distinct_optima(stage: SearchStage, most: int, apart: float = 6.0) -> list[NDArray[np.float64]]:
    """Return at most ``most`` best points of a stage, each at least ``apart`` px away from all better points."""
    points = stage.points.tolist()
    chosen: list[int] = []
    for k in np.argsort(-stage.scores, kind="stable").tolist():
        if all(math.dist(points[k], points[other]) >= apart for other in chosen):
            chosen.append(k)
            if len(chosen) == most:
                break
    return [stage.points[k] for k in chosen]


def estimate_covariance(parts: Objective, v: NDArray[np.float64]) -> tuple[NDArray[np.float64], tuple[str, ...]]:
    """Return the covariance of the optimum [px²], and warnings that name the parameters of flat directions.

    The sandwich estimate H⁻¹ cov(g) H⁻¹ / n from n disjoint parts of the events: g is a part's gradient at the optimum
    of all events, and H the mean Hessian of the parts.
    """
    slopes, hessian = finite_differences(parts.each, parts.space, v, np.eye(len(v)))
    gradients = slopes.T
    values, vectors = np.linalg.eigh(-hessian)
    largest = max(float(values.max()), 1e-12)
    weak = values < 1e-3 * largest
    inverse = vectors @ np.diag(1.0 / np.maximum(values, 1e-3 * largest)) @ vectors.T
    names = parts.space.names
    warnings = tuple(
        f"the events hardly determine {names[int(np.argmax(np.abs(vectors[:, k])))]} (curvature "
        f"{values[k] / largest:.1e} of the largest one)"
        for k in np.flatnonzero(weak)
    )
    return inverse @ np.atleast_2d(np.cov(gradients.T)) @ inverse / len(gradients), warnings
