"""The second stage: parameters that make the events' brightness changes agree with one map of the scene.

Sharpness is biased by the sensor's hysteresis. Here the hysteresis is the equation:
see :mod:`amiwarp.brightness.solver`.
For given parameters the map is a linear least-squares problem; the parameters minimise what remains of it, robustly.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from amiwarp.brightness.event_pairs import EventTable, PairSet, SensorTiming, off_excess
from amiwarp.brightness.solver import BrightnessMap
from amiwarp.calib.parameters import LATE, MOTION
from amiwarp.calib.photometric.acceptance import FAR_PX, verdict
from amiwarp.calib.photometric.gauss_newton import GAUSS_NEWTON, Slopes, determined, iterate
from amiwarp.calib.photometric.minimum_check import around_optimum
from amiwarp.calib.photometric.scene_tiles import choose_tiles, one_tile
from amiwarp.calib.result import PhotometricSummary, StageSummary
from amiwarp.calib.sharpness.objective import reach
from amiwarp.calib.solve import LOCAL_ALGORITHMS, SearchStage, check_algorithm, maximise
from amiwarp.calib.stage_share import stage_share
from amiwarp.errors import AmiwarpError
from amiwarp.validation import real, whole

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.brightness.solver import Tiles
    from amiwarp.calib.parameters import ParameterSpace
    from amiwarp.calib.sharpness.search import Search
    from amiwarp.events.encoder import Encoder
    from amiwarp.events.recording import Recording
    from amiwarp.progress import Progress

MARGIN_PX, MOVING_MARGIN_PX = 3, 8
"""By which the map of a tile is grown: the parameters may move events so far."""
LONGEST_GAP_US = 60_000
"""Pairs further apart say little: noise has come between."""
FEWEST_PAIRS = 1_500
PAIRS_PER_NODE = 1.5
"""Fewer equations for each unknown of the map fit anything."""
FEWEST_TURNS = 2
FEWEST_TILES = 6
FIRST_SCALE = 1.0
"""Of Cauchy's weights while the map is cold [thresholds]."""
FAR_MOVING_PX = 4.0
"""The stage looks no further in the camera's motion from the sharpness optimum than this."""
RESTARTS = 3
"""Searches from places that turned out to cost less than the result, at most."""
FIRST_STEP_PX = 0.2
POLISH_STEP_PX = 0.05
SLOPE_PX = 0.02
"""Of the differences that give the residuals' slopes [px]."""


@dataclass(frozen=True)
class PhotometricSettings:
    """How the second stage works."""

    pairs: int = 300_000
    """At most about so many pairs of events, in whole turns spread over the recording."""
    algorithm: str = GAUSS_NEWTON
    """That, or one of NLopt's derivative-free local algorithms by name."""
    evaluations: int = 80
    """Budget of each of an NLopt algorithm's two runs."""
    tolerance_px: float = 0.002
    steps: int = 20
    """Conjugate gradients per evaluation; each starts from the last map."""
    density: float = 1.0
    """Nodes of the map per pixel."""
    sensor: SensorTiming = field(default_factory=SensorTiming)
    """Known latency and refractory time; what is not known of them stays in the phase."""

    def check(self) -> None:
        """Raise :class:`AmiwarpError` for an unknown algorithm or a number out of range."""
        check_algorithm(self.algorithm, (GAUSS_NEWTON, *LOCAL_ALGORITHMS))
        for name in ("pairs", "evaluations", "steps"):
            whole(getattr(self, name), f"photometric {name}", 1, 10**12)
        real(self.tolerance_px, "photometric tolerance_px", 0.0, 1e3, " px")
        real(self.density, "photometric density", 0.01, 100.0)


class _Gatherer:
    """Pairs whose two events both fall on one tile of the scene, at the first stage's answer."""

    def __init__(self, recording: Recording, search: Search, tile_of: NDArray[np.int32], sensor: SensorTiming) -> None:
        from scipy import ndimage

        self.recording, self.search, self.sensor, self.tile_of = recording, search, sensor, tile_of
        far = math.ceil(reach(search.space, search.best)) + 1
        near = ndimage.maximum_filter((tile_of >= 0).astype(np.uint8), size=2 * far + 1) > 0
        self.near = np.where(near, 0, -1).astype(np.int32)
        self._found: list[PairSet] = []
        self._done = 0

    def within(self, spans: list[tuple[int, int]]) -> PairSet:
        """Of spans of time [us], which no pair leaves: those found before, and those of spans that are new."""
        if len(spans) > self._done:
            self._found.append(self._of(spans[self._done :]))
            self._done = len(spans)
        return PairSet.concatenate(self._found)

    def _of(self, spans: list[tuple[int, int]]) -> PairSet:
        search, source = self.search, self.recording.events
        space, best, material = search.space, search.best, search.material
        table = EventTable([source.between(*span) for span in spans], self.near, search.device)
        pairs = table.pairs(
            material.encoder, longest_gap_us=LONGEST_GAP_US, shortest_gap_us=2.0 * self.sensor.refractory_us,
            sensor=self.sensor, middle_us=space.middle_us,
        )  # fmt: skip
        if not len(pairs):
            return pairs
        if material.slope_of is not None:
            pairs = pairs.with_slope(material.slope_of, space.middle_us)
        every = np.ones(int(self.tile_of.max()) + 1, np.bool_)
        return pairs.on_tiles(space.build(best), space.camera_rotation(best), space.drift(best), self.tile_of, every)


def turn_length(recording: Recording, encoder: Encoder) -> float:
    """Length of a turn [us], or of the whole recording where it is shorter."""
    whole = float(recording.events.t_last - recording.events.t_first + 1)
    return min(60e6 / max(abs(encoder.rpm), 1e-6), whole)


def gather_pairs(recording: Recording, search: Search, settings: PhotometricSettings) -> tuple[PairSet, Tiles]:
    """Pairs of whole turns, two or more where there are, spread evenly over the recording, until there are enough.

    Where two turns hold many more, whole tiles are left out: fewer pairs on the same map would leave it undetermined.
    """
    first, last = recording.events.t_first, recording.events.t_last
    turn = turn_length(recording, search.material.encoder)
    turns = max(1, int((last - first + 1) / turn))
    margin = MOVING_MARGIN_PX if search.whole.moving else MARGIN_PX
    if len(recording.events.between(first, first + int(FEWEST_TURNS * turn) + 1)) <= settings.pairs:
        tile_of, tiles = one_tile(*recording.events.size, settings.density, margin)
    else:
        tile_of, tiles = choose_tiles(search.image(), settings.density, margin)
    gatherer = _Gatherer(recording, search, tile_of, settings.sensor)
    # the two turns of a camera that moves belong together
    spans = [(first + int(k * turn), first + int(k * turn) + int(turn)) for k in _spread(turns)]
    if search.whole.moving:
        spans = [(first, last + 1)]
    many = min(FEWEST_TURNS, len(spans))
    pairs = gatherer.within(spans[:many])
    while len(pairs) < settings.pairs and many < len(spans):
        many = min(len(spans), max(many + 1, math.ceil(many * settings.pairs / max(len(pairs), 1))))
        pairs = gatherer.within(spans[:many])
    count = len(tiles.origin)
    keep = max(FEWEST_TILES, round(count * settings.pairs / max(len(pairs), 1)))
    return (pairs if keep >= count else pairs.of_tiles(np.isin(np.arange(count), _spread(count)[:keep]))), tiles


def _spread(n: int) -> list[int]:
    """0 … n-1 so that any beginning of it is spread evenly: van der Corput's order."""
    bits = max(1, (n - 1).bit_length())
    order = (int(f"{k:0{bits}b}"[::-1], 2) for k in range(1 << bits))
    return [k for k in order if k < n]


def check_pairs(name: str, coverage: NDArray[np.float32], pairs: int) -> float:
    """Share of the equations that are left once the map is determined; raises where they are too few."""
    touched = int((coverage > 0.5).sum())
    if pairs < max(FEWEST_PAIRS, PAIRS_PER_NODE * touched):
        raise AmiwarpError(
            f"{name}: {pairs} pairs of events are too few for {touched} places of a map; record for longer"
        )
    return 1.0 - touched / pairs


class Cost:
    """Robust residual as a function of the space's vector; the map is warm from call to call."""

    def __init__(self, space: ParameterSpace, brightness: BrightnessMap, steps: int) -> None:
        self.space, self.brightness, self.steps = space, brightness, steps
        self.scale = FIRST_SCALE
        self.evaluations = 0
        self._solved: NDArray[np.float64] | None = None
        self._changes: list[Any] = []
        """Of the map as each parameter changes [per px], as the last slopes found them: the next start from there."""

    def warm_up(self, v: NDArray[np.float64]) -> None:
        """First map, and the scale of the weights from its residual."""
        self.residuals(v, rounds=3, steps=2 * self.steps)
        self.scale = max(0.1, 1.5 * self.brightness.residuals.median())
        self.residuals(v)

    def renew(self, v: NDArray[np.float64]) -> None:
        """Forget the map, which remembers where it was fitted, and make another at ``v``."""
        unknowns = self.brightness.unknowns
        unknowns[: self.brightness.tiles.nodes] = 0.0
        self.brightness.unknowns = unknowns
        self.brightness.place(**self.at(v))
        self.brightness.solve(FIRST_SCALE, steps=2 * self.steps, rounds=3)

    def at(self, v: NDArray[np.float64]) -> dict[str, Any]:
        """Arguments of :meth:`BrightnessMap.place`."""
        values = self.space.to_values(v)
        space = self.space
        return {
            "model": space.build(values),
            "drift": space.drift(values),
            "camera_rotation": space.camera_rotation(values),
        }

    def residuals(self, v: NDArray[np.float64], *, rounds: int = 1, steps: int | None = None) -> None:
        """Leaves them with the map, on the device."""
        self.brightness.place(**self.at(v))
        self.brightness.solve(self.scale, steps=steps or self.steps, rounds=rounds)
        self._solved = v

    def mean(self) -> float:
        """Cauchy's cost of the pairs over that of pairs with no map; a pair off the map counts as such."""
        return self.brightness.residuals.mean_cost(self.scale, missing=1.0) / math.log1p(1.0 / self.scale**2)

    def __call__(self, v: NDArray[np.float64], *, steps: int | None = None) -> float:
        self.evaluations += 1
        self.residuals(v, steps=steps)
        return -self.mean()

    def settled(self, v: NDArray[np.float64]) -> float:
        """The same with more steps: a map that lags a long step of the parameters would speak against it."""
        return self(v, steps=3 * self.steps // 2)

    def slopes(self, v: NDArray[np.float64], *, with_parts: bool = False) -> Slopes:
        """The residuals' slopes at ``v``, less what a change of the map would make of them."""
        b, n = self.brightness, len(v)
        if self._solved is None or not np.array_equal(self._solved, v):
            self.residuals(v)
        if len(self._changes) != n:
            self._changes = [b.new_change() for _ in v]
        b.prepare_projection()
        steps = np.eye(n) * SLOPE_PX
        plain = [b.find_slope(self.at(v + step), self.at(v - step), 2.0 * SLOPE_PX) for step in steps]
        both = zip(plain, self._changes, strict=True)
        left = [b.unexplained(row, change, steps=self.steps // 2) for row, change in both]
        upper = np.triu_indices(n)
        pairs = [(left[i], left[j]) for i, j in zip(*upper, strict=True)]
        sums = b.residuals.products([*pairs, *((row, b.residuals.values) for row in plain)])
        hessian = np.zeros((n, n))
        hessian[upper] = sums[:-n]
        hessian.T[upper] = sums[:-n]
        return Slopes(hessian, sums[-n:], b.residuals.clusters(left) if with_parts else np.empty((n, 0)))


def refine(
    recording: Recording, search: Search, linear: tuple[str, ...], *, progress: Progress | None = None
) -> tuple[PhotometricSummary, StageSummary]:
    """Runs the stage from the first stage's answer; ``linear``: which of ``off_ratio`` and ``leak`` are free.

    Raises :class:`AmiwarpError` where there are too few pairs.
    """
    settings: PhotometricSettings = search.settings.photometric
    pairs, tiles = gather_pairs(recording, search, settings)
    space = search.whole.holding({n: x for n, x in search.best.items() if n not in search.whole.names})
    # without a whole turn brightness need not come back to where it was
    whole = abs(search.material.encoder.rpm) * (recording.events.t_last - recording.events.t_first) >= 60e6
    excess = off_excess(pairs, with_leak="leak" in linear) if whole else 0.0
    brightness = BrightnessMap(
        pairs, tiles, off_excess=None if "off_ratio" in linear else excess, with_leak="leak" in linear,
        middle_us=space.middle_us,
    )  # fmt: skip
    cost = Cost(space, brightness, settings.steps)
    v = space.to_vector({**space.start, **search.best})
    cost.warm_up(v)
    left = check_pairs(recording.name, brightness.coverage(cost.scale), len(pairs))
    keep = determined(cost.slopes(v, with_parts=True), space, left)
    held = tuple(n for n in space.names if n not in keep)
    # sharpness was free to move the others along with them, so they stay where it left them
    cost.space = space = space.without(held).holding({n: x for n, x in search.best.items() if n in held})
    v = space.to_vector({**space.start, **search.best})
    if held:
        cost.warm_up(v)

    def report(share: float) -> None:
        if progress is not None:
            progress(*stage_share(search.settings, "photometric", share))

    stage, result = _settle(cost, v, left, settings, report)
    found = replace(result, sharpness_parameters=dict(search.best), pairs=len(pairs), held=held)
    return found, StageSummary.of("photometric", stage, space)


def limits(space: ParameterSpace, v: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The box about the first stage's answer."""
    far = np.array([math.inf if n in LATE else FAR_MOVING_PX if n in MOTION else FAR_PX for n in space.names])
    low, high = space.bounds()
    return np.clip(low, v - far, v + far), np.clip(high, v - far, v + far)


def _settle(
    cost: Cost, v: NDArray[np.float64], left: float, settings: PhotometricSettings, report: Callable[[float], None]
) -> tuple[SearchStage, PhotometricSummary]:
    """Searches from the first stage's answer, and again from any place near the result that costs less.

    The map of few events follows a wrong answer so far that no step from there helps: that is no optimum.
    """
    stage = _search(cost, v, v, settings, report)
    result, around = _conclude(cost, stage.x, v, left)
    for _ in range(RESTARTS):
        lower = [place for place, rise in around if rise < 0.0]
        if not lower:
            break
        cost.renew(lower[0])
        stage = joined(stage, _search(cost, v, lower[0], settings, report))
        result, around = _conclude(cost, stage.x, v, left)
    return stage, result


def _search(
    cost: Cost,
    v: NDArray[np.float64],
    start: NDArray[np.float64],
    settings: PhotometricSettings,
    report: Callable[[float], None],
) -> SearchStage:
    """One search from ``start``, in the box about the first stage's answer ``v``."""
    low, high = limits(cost.space, v)

    def tell(done: int, budget: int) -> None:
        report(done / budget)

    def score(at: NDArray[np.float64]) -> float:
        tell(cost.evaluations, 2 * settings.evaluations)
        return cost(at)

    if settings.algorithm == GAUSS_NEWTON:
        return iterate(cost.settled, cost.slopes, start, low, high, settings.tolerance_px, tell)

    def run(at: NDArray[np.float64], step: float) -> SearchStage:
        return maximise(
            score, settings.algorithm, low=low, high=high, start=at, evaluations=settings.evaluations,
            tolerance=settings.tolerance_px, step=step,
        )  # fmt: skip

    stage = run(start, FIRST_STEP_PX)
    # the map lags the parameters while they move far: once more from near, with a better map
    cost.steps *= 2
    return joined(stage, run(stage.x, POLISH_STEP_PX))


def joined(first: SearchStage, second: SearchStage) -> SearchStage:
    """Two runs as one; the answer is the second's, whose map was the better."""
    return replace(
        second,
        evaluations=first.evaluations + second.evaluations,
        seconds=first.seconds + second.seconds,
        points=np.concatenate([first.points, second.points]),
        scores=np.concatenate([first.scores, second.scores]),
    )


def _conclude(
    cost: Cost,
    best: NDArray[np.float64],
    v: NDArray[np.float64],
    left: float,
) -> tuple[PhotometricSummary, list[tuple[NDArray[np.float64], float]]]:
    """Final map at the optimum, covariance, and the verdict; ``left``: see :func:`check_pairs`.

    Returns the places around, and by how much each costs more, the least first.
    """
    space = cost.space
    # like with like: the map had longer by now than when the search began
    cost.residuals(v, rounds=2)
    at_start = cost.mean()
    cost.residuals(best, rounds=2)
    final, residual = cost.mean(), cost.brightness.residuals.median()
    slopes = cost.slopes(best, with_parts=True)
    covariance = slopes.covariance() / left**2
    asked = np.array([n not in LATE for n in space.names])
    near = np.array([n not in (*LATE, *MOTION) for n in space.names])
    leak, excess = (float(x) for x in cost.brightness.extra)  # before the map follows elsewhere
    around = around_optimum(cost, best, final)
    rise = around[0][1] if around else math.inf
    ahead = float(np.linalg.norm(slopes.step()[near]))
    accepted, words = verdict(final, rise, float(np.linalg.norm((best - v)[near])), ahead)
    found = PhotometricSummary(
        accepted=accepted,
        verdict=words,
        parameters=space.to_values(best),
        uncertainty=space.deviations(best, covariance),
        sharpness_parameters={},
        moved_px=float(np.linalg.norm((best - v)[asked])),
        cost=final,
        cost_at_sharpness=at_start,
        residual=residual,
        pairs=0,
        off_over_on=1.0 + excess,
        leak=leak,
    )
    return found, around
