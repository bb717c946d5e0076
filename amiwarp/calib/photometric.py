"""The second stage: parameters that make the events' brightness changes agree with one map of the scene.

Sharpness is biased by the sensor's hysteresis; here the hysteresis is the equation (see :mod:`amiwarp.brightness`).
For given parameters the map is a linear least-squares problem; the parameters minimise what remains of it, robustly.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from amiwarp.brightness import BrightnessMap, PairSet, Sensor, Tiles, pair_events
from amiwarp.calib.objective import padding
from amiwarp.calib.result import Photometric, StageSummary
from amiwarp.calib.solve import Stage, maximise
from amiwarp.errors import AmiwarpError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from amiwarp.calib.parameters import Space
    from amiwarp.calib.search import Material, Progress
    from amiwarp.encoder import Encoder
    from amiwarp.events import Events, Recording

TILE = 32
"""Side of a tile's pixels [px]."""
GRID = (4, 3)
"""One tile, the busiest, from each of so many columns and rows of the image."""
LONGEST_GAP_US = 60_000
"""Pairs further apart say little: noise has come between."""
FEWEST_PAIRS = 10_000
PAIRS_PER_NODE = 2.5
"""Fewer equations for each unknown of the map fit anything."""
FEWEST_TURNS = 2
FEWEST_TILES = 6
FIRST_SCALE = 1.0
"""Of Cauchy's weights while the map is cold [thresholds]."""
FAR_PX = 1.0
"""The stage looks no further from the sharpness optimum than this, in any direction."""
FIRST_STEP_PX = 0.2
POLISH_STEP_PX = 0.05
LARGEST_COST = 0.35
"""Of the cost with no map at all: above it the equations do not hold, and the scene or camera moved unmodelled."""


@dataclass(frozen=True)
class PhotometricSettings:
    """How the second stage works."""

    pairs: int = 600_000
    """At most about so many pairs of events, in whole turns spread over the recording."""
    algorithm: str = "LN_BOBYQA"
    evaluations: int = 80
    tolerance_px: float = 0.002
    steps: int = 20
    """Conjugate gradients per evaluation; each starts from the last map."""
    density: float = 1.0
    """Nodes of the map per pixel."""
    sensor: Sensor = field(default_factory=Sensor)
    """Known latency and refractory time; what is not known of them stays in the phase."""


def choose_tiles(
    events: Events, width: int, height: int, reach: int, density: float
) -> tuple[NDArray[np.int32], Tiles]:
    """The busiest cell of :data:`TILE` px from each part of the image: tile of each pixel (or -1), and the tiles.

    ``events``: a sample. ``reach`` [px]: how far a pixel's events can be moved.
    """
    columns, rows = max(1, width // TILE), max(1, height // TILE)
    counts = np.zeros((rows, columns), dtype=np.int64)
    np.add.at(counts, (np.minimum(events.y // TILE, rows - 1), np.minimum(events.x // TILE, columns - 1)), 1)
    tile_of = np.full((height, width), -1, dtype=np.int32)
    corners: list[tuple[int, int]] = []
    for part_rows in np.array_split(np.arange(rows), min(GRID[1], rows)):
        for part_columns in np.array_split(np.arange(columns), min(GRID[0], columns)):
            part = counts[np.ix_(part_rows, part_columns)]
            row, column = np.unravel_index(int(part.argmax()), part.shape)
            x, y = int(part_columns[column]) * TILE, int(part_rows[row]) * TILE
            tile_of[y : y + TILE, x : x + TILE] = len(corners)
            corners.append((x - reach, y - reach))
    side = math.ceil((TILE + 2 * reach) * density) + 2
    return tile_of, Tiles(np.array(corners, dtype=np.float32), side, side, density)


def gather_pairs(
    recording: Recording, encoder: Encoder, tile_of: NDArray[np.int32], most: int, sensor: Sensor, device: Any
) -> PairSet:
    """Pairs of whole turns, two or more where there are, spread evenly over the recording, until ``most`` are found.

    Where two turns hold many more, whole tiles are left out: fewer pairs on the same map would leave it undetermined.
    """
    first, last = recording.events.t_first, recording.events.t_last
    turn = min(60e6 / max(abs(encoder.rpm), 1e-6), float(last - first + 1))
    turns = max(1, int((last - first + 1) / turn))
    parts: list[PairSet] = []
    for k in _spread(turns):
        start = first + int(k * turn)
        events = recording.events.between(start, start + int(turn))
        part = pair_events(
            events, tile_of, longest_gap_us=LONGEST_GAP_US, shortest_gap_us=2.0 * sensor.refractory_us, device=device
        )
        parts.append(part)
        if len(parts) >= FEWEST_TURNS and sum(map(len, parts)) >= most:
            break
    pairs = PairSet.concatenate(parts)
    tiles = int(tile_of.max()) + 1
    keep = max(FEWEST_TILES, round(tiles * most / max(len(pairs), 1)))
    return pairs if keep >= tiles else pairs[np.isin(pairs.tile, np.array(_spread(tiles)[:keep]))]


def _spread(n: int) -> list[int]:
    """0 … n-1 so that any beginning of it is spread evenly: van der Corput's order."""
    bits = max(1, (n - 1).bit_length())
    order = (int(f"{k:0{bits}b}"[::-1], 2) for k in range(1 << bits))
    return [k for k in order if k < n]


def off_excess(pairs: PairSet) -> float:
    """Excess of the OFF threshold over the ON threshold, counted, not solved for: that would shrink it with the map.

    Over a whole turn brightness comes back to where it was, so ON steps and OFF steps add up to nothing.
    """
    on = int((pairs.on == 1).sum())
    return on / max(1, len(pairs) - on) - 1.0


def check_pairs(name: str, coverage: NDArray[np.float32], pairs: int) -> float:
    """Share of the equations that are left once the map is determined; raises where they are too few."""
    touched = int((coverage > 0.5).sum())
    if pairs < max(FEWEST_PAIRS, PAIRS_PER_NODE * touched):
        raise AmiwarpError(
            f"{name}: {pairs} pairs of events are too few for {touched} places of a map; record for longer"
        )
    return 1.0 - touched / pairs


class _Cost:
    """Robust residual as a function of the space's vector; the map is warm from call to call."""

    def __init__(self, space: Space, brightness: BrightnessMap, steps: int) -> None:
        self.space, self.brightness, self.steps = space, brightness, steps
        self.scale = FIRST_SCALE
        self.evaluations = 0

    def warm_up(self, v: NDArray[np.float64]) -> None:
        """First map, and the scale of the weights from its residual."""
        self.residuals(v, rounds=3, steps=2 * self.steps)
        self.scale = max(0.1, 1.5 * float(np.nanmedian(np.abs(self.last))))
        self.residuals(v)

    def residuals(self, v: NDArray[np.float64], *, rounds: int = 1, steps: int | None = None) -> NDArray[np.float32]:
        values = self.space.to_values(v)
        self.brightness.place(self.space.build(values), drift=self.space.drift(values))
        self.last = self.brightness.solve(self.scale, steps=steps or self.steps, rounds=rounds)
        return self.last

    def terms(self, residuals: NDArray[np.float32]) -> NDArray[np.float64]:
        """Cauchy's cost of each pair over that of a pair with no map; a pair off the map counts as such."""
        known = np.where(np.isfinite(residuals), residuals, 1.0).astype(np.float64)
        return np.asarray(np.log1p((known / self.scale) ** 2) / math.log1p(1.0 / self.scale**2))

    def __call__(self, v: NDArray[np.float64]) -> float:
        self.evaluations += 1
        return -float(self.terms(self.residuals(v)).mean())


def refine(
    recording: Recording,
    space: Space,
    material: Material,
    start: Mapping[str, float],
    settings: PhotometricSettings,
    *,
    device: Any = "cpu",
    progress: Progress | None = None,
) -> tuple[Photometric, StageSummary]:
    """Runs the stage from the first stage's answer ``start``; ``material``: its events, which tell where texture is.

    Raises :class:`AmiwarpError` where there are too few pairs.
    """
    width, height = recording.events.size
    tile_of, tiles = choose_tiles(material.events, width, height, padding(space) + 2, settings.density)
    pairs = gather_pairs(recording, material.encoder, tile_of, settings.pairs, settings.sensor, device)
    slope = None
    if material.slope_of is not None:
        slope = np.stack([material.slope_of(t) for t in (pairs.first_t, pairs.second_t)], axis=1).astype(np.float32)
    brightness = BrightnessMap(
        pairs,
        tiles,
        material.encoder,
        sensor=settings.sensor,
        slope=slope,
        off_excess=off_excess(pairs),
        device=device,
    )
    cost = _Cost(space, brightness, settings.steps)
    v = space.to_vector(dict(start))
    cost.warm_up(v)
    left = check_pairs(recording.name, brightness.coverage(cost.scale), len(pairs))
    at_start = -cost(v)
    low, high = (np.clip(edge, v - FAR_PX, v + FAR_PX) for edge in space.bounds())

    def score(at: NDArray[np.float64]) -> float:
        if progress is not None:
            progress("photometric", cost.evaluations, settings.evaluations)
        return cost(at)

    def search(at: NDArray[np.float64], step: float) -> Stage:
        return maximise(
            score, settings.algorithm, low=low, high=high, start=at, evaluations=settings.evaluations,
            tolerance=settings.tolerance_px, step=step,
        )  # fmt: skip

    stage = search(v, FIRST_STEP_PX)
    # the map lags the parameters while they move far: once more from near, with a better map
    cost.steps *= 2
    stage = joined(stage, search(stage.x, POLISH_STEP_PX))
    result = _conclude(cost, stage.x, v, at_start, start, pairs, left)
    return result, StageSummary.of("photometric", stage, space)


def joined(first: Stage, second: Stage) -> Stage:
    """Two runs as one; the answer is the second's, whose map was the better."""
    return replace(
        second,
        evaluations=first.evaluations + second.evaluations,
        seconds=first.seconds + second.seconds,
        points=np.concatenate([first.points, second.points]),
        scores=np.concatenate([first.scores, second.scores]),
    )


def _conclude(
    cost: _Cost,
    best: NDArray[np.float64],
    v: NDArray[np.float64],
    at_start: float,
    start: Mapping[str, float],
    pairs: PairSet,
    left: float,
) -> Photometric:
    """Final map at the optimum, covariance, and the verdict; ``left``: see :func:`check_pairs`."""
    space = cost.space
    residuals = cost.residuals(best, rounds=2)
    final = float(cost.terms(residuals).mean())
    covariance = _covariance(cost, best, pairs.tile) / left**2
    moved = float(np.linalg.norm(best - v))
    accepted, verdict = _verdict(final, at_start, moved)
    return Photometric(
        accepted=accepted,
        verdict=verdict,
        parameters=space.to_values(best),
        uncertainty=space.deviations(best, covariance),
        sharpness_parameters=dict(start),
        moved_px=moved,
        cost=final,
        cost_at_sharpness=at_start,
        residual=float(np.nanmedian(np.abs(residuals))),
        pairs=len(pairs),
        off_over_on=1.0 + off_excess(pairs),
    )


def _verdict(cost: float, at_start: float, moved: float) -> tuple[bool, str]:
    if cost > LARGEST_COST:
        return False, (
            f"no map of the scene explains the events ({100 * cost:.0f} % of the residual remains): the scene or the "
            "camera moved, or light flickered; kept the answer of sharpness"
        )
    if moved > 0.95 * FAR_PX:
        return False, f"the optimum lies over {FAR_PX:g} px from that of sharpness; kept the answer of sharpness"
    if cost > at_start:
        return False, "no better than the answer of sharpness, which was kept"
    return True, f"one map explains the events ({100 * cost:.0f} % of the residual remains)"


def _covariance(cost: _Cost, best: NDArray[np.float64], tile: NDArray[np.int32], h: float = 0.1) -> NDArray[np.float64]:
    """Sandwich estimate [px²]: curvature of the cost, and the scatter of its slope from tile to tile.

    Tiles have maps of their own, so their slopes are independent.
    """
    n = len(best)
    tiles = np.unique(tile)
    share = np.array([(tile == k).mean() for k in tiles])

    def by_tile(v: NDArray[np.float64]) -> NDArray[np.float64]:
        terms = cost.terms(cost.residuals(v))
        return np.bincount(tile, weights=terms)[tiles] / np.bincount(tile)[tiles]

    centre = by_tile(best)
    up = [by_tile(best + step) for step in np.eye(n) * h]
    down = [by_tile(best - step) for step in np.eye(n) * h]
    slopes = np.array([(u - d) / (2.0 * h) for u, d in zip(up, down, strict=True)])
    hessian = np.diag([float(share @ (u + d - 2.0 * centre)) / h**2 for u, d in zip(up, down, strict=True)])
    for i in range(n):
        for j in range(i):
            both = np.eye(n)[i] * h + np.eye(n)[j] * h
            value = by_tile(best + both) + by_tile(best - both) - up[i] - down[i] - up[j] - down[j] + 2.0 * centre
            hessian[i, j] = hessian[j, i] = float(share @ value) / (2.0 * h**2)
    weighted = slopes * share
    scatter = (weighted - weighted.mean(axis=1, keepdims=True)) @ weighted.T * len(tiles) / max(1, len(tiles) - 1)
    values, vectors = np.linalg.eigh(hessian)
    inverse = vectors @ np.diag(1.0 / np.maximum(values, 1e-3 * max(float(values.max()), 1e-12))) @ vectors.T
    return np.asarray(inverse @ scatter @ inverse)
