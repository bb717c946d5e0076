"""Cost of the photometric stage: the robust residual of the equations after the best brightness map was fitted."""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.brightness.solver import BrightnessMap, EventTable, PairSet, SensorTiming, Tiles
from amiwarp.calib.calibration_events import EventsAhead
from amiwarp.calib.nlopt_solver import SearchStage, best_of
from amiwarp.calib.parameters import RATES, ParameterSpace
from amiwarp.calib.settings import GAUSS_NEWTON, PhotometricSettings
from amiwarp.calib.sharpness_search import reach
from amiwarp.errors import AmiwarpError
from amiwarp.events.encoder import Encoder
from amiwarp.events.recording import Events, MemoryEvents, Recording
from amiwarp.imaging.iwe import Image
from amiwarp.kernels.iwe import sum_segments
from amiwarp.kernels.launch import launch
from amiwarp.kernels.map_positions import PATH_TERMS as POWERS
from amiwarp.optics.models import MODELS

if TYPE_CHECKING:
    from amiwarp.calib.sharpness_search import Search

    Vector = NDArray[np.float64]


def place_arguments(space: ParameterSpace, values: Mapping[str, float]) -> dict[str, Any]:
    """Return the keyword arguments of :meth:`BrightnessMap.place` for parameter values."""
    return {
        "model": space.build(values),
        "drift": space.drift(values),
        "camera_rotation": space.camera_rotation(values),
    }


PATH_TERMS = int(POWERS)
"""Number of powers of time in the path of a tile. With four, the motion of a hand over two turns leaves under 0.001 px;
with two it leaves 0.015 px."""
FAST_PATH_TERMS = 3
"""The same for a camera in fast motion over a turn and a half. With one, orbits come out larger by up to 0.03 px."""
FIRST_SCALE = 1.0
"""Scale of the Cauchy weights before the first brightness map is solved [thresholds]."""
SLOPE_PX = 0.005
"""Step of the finite differences that give the derivatives of the residuals [px]."""
STEP_RAD = 0.004
"""Step of the finite differences that give the derivatives of the residuals by an angle [rad]."""
PATH_RIDGE = 1e-4
"""Damping of the paths of tiles, a share of their mean curvature: a scene of parallel edges does not determine both
directions."""
PREDICTED_PX = 0.5
"""Longest step for which the change of the brightness map is predicted [px]."""


def cauchy_costs(residuals: NDArray[Any], scale: float) -> NDArray[Any]:
    """Return the Cauchy cost of each residual [thresholds], relative to that without a map; 1 off the map."""
    return np.asarray(np.log1p((np.nan_to_num(residuals, nan=1.0) / scale) ** 2) / math.log1p(1.0 / scale**2))


class TilePaths:
    """Paths on which the scene of each tile of a :class:`BrightnessMap` moves in the image, beyond the rotation.

    A path is a polynomial of time. As the map, it is a nuisance: derivatives by the parameters lose the part that a
    change of the paths explains.
    """

    def __init__(self, brightness: BrightnessMap, terms: int) -> None:
        """Start with tiles at rest. ``terms`` is the number of powers of time."""
        self._map, pairs = brightness, brightness.pairs
        self.tile: NDArray[np.int32] = pairs.column("tile")
        """Tile of each pair."""
        self._order = np.argsort(self.tile, kind="stable")
        self._used, self._starts = np.unique(self.tile[self._order], return_index=True)
        half_s = max(0.5 * float(np.ptp(pairs.some_times)), 1e-6)
        powers = np.diag(half_s ** -np.arange(1.0, PATH_TERMS + 1.0))[:terms]
        self._units = np.kron(np.eye(2), powers)
        """Factors of the powers of time that move a tile by 1 px at the ends of the window, shape (terms, powers)."""
        self.moved_px: Vector = np.zeros((len(brightness.tiles.origin), 2 * terms))
        """Motion until the end of the window by each power of time along x, then y [px], shape (tiles, terms)."""
        self._changes: list[Any] = []

    def set(self, moved_px: Vector) -> None:
        """Set the paths."""
        self.moved_px = moved_px
        self._map.pairs.set_path(moved_px @ self._units)

    def linearise(self, at: Mapping[str, Any], steps: int) -> None:
        """Compute the derivatives of the residuals by the paths, at a point where the map is solved."""
        b, changes, left = self._map, self._changes or [None] * len(self._units), []
        self._base, self._changes = self.moved_px, []
        self._slopes: list[Vector] = []
        for k, change in enumerate(changes):
            step = np.zeros_like(self.moved_px)
            step[:, k] = SLOPE_PX
            up, down = (b.pairs.path_array((self.moved_px + s * step) @ self._units) for s in (1.0, -1.0))
            slope = b.find_slope({**at, "path": up}, {**at, "path": down}, 2.0 * SLOPE_PX)
            left.append(self._on_host(b.unexplained(slope, change, steps=steps)))
            self._changes.append(b.explaining_change())
        self._left = np.stack(left, axis=1)
        self._weight = self._on_host(b.residuals.weight)
        hessian = self._sums(self._left[:, :, None] * (self._left * self._weight[:, None])[:, None, :])
        ridge = PATH_RIDGE * np.trace(hessian, axis1=1, axis2=2) / hessian.shape[1] + 1e-9
        self._inverse = np.linalg.inv(hessian + ridge[:, None, None] * np.eye(hessian.shape[1]))
        self._step = -self._factors(b.residuals.values)

    def unexplained(self, column: Any) -> Any:
        """Return the part of a derivative, on the device, that no change of the paths explains."""
        factors, rest = self._factors(column), column.numpy().copy()
        rest[: len(self.tile)] -= np.einsum("ij,ij->i", self._left, factors[self.tile])
        self._slopes.append(factors)
        return wp.array(rest, dtype=float, device=column.device)

    def gain(self) -> float:
        """Return the share of a tile's squared residuals that the next step of its path removes.

        It is the share that a quarter of the tiles exceed: the others may show moving objects.
        """
        residual = self._on_host(self._map.residuals.values)
        removed = -(self._sums(self._left * (residual * self._weight)[:, None]) * self._step).sum(axis=1)
        share = removed[self._used] / self._sums(residual**2 * self._weight)[self._used]
        return float(np.quantile(share, 0.75))

    def follow(self, step: Vector) -> None:
        """Change the paths, and the map with them, as :meth:`linearise` predicts for a step of the parameters."""
        moved = self._base + np.clip(self._step, -LONGEST_STEP_PX, LONGEST_STEP_PX)
        moved = moved - np.tensordot(step, self._slopes[: len(step)], 1)
        change, nodes = moved - self.moved_px, self._map.tiles.nodes
        self.set(moved)
        image = self._map.unknowns
        for by, of_map in zip(change.T, self._changes, strict=True):
            image[:nodes] -= (of_map.numpy()[:nodes].reshape(len(by), -1) * by[:, None]).ravel()
        self._map.unknowns = image

    def costs(self, scale: float) -> Vector:
        """Return the mean Cauchy cost of each tile, relative to that without a map; 0 without pairs."""
        cost = cauchy_costs(self._map.residuals.values.numpy()[: len(self.tile)].astype(np.float64), scale)
        return self._sums(cost) / np.maximum(self._sums(np.ones(len(cost))), 1.0)

    def _factors(self, column: Any) -> Vector:
        """Return the changes of the paths that explain most of a column, shape (tiles, terms)."""
        gradient = self._sums(self._left * (self._on_host(column) * self._weight)[:, None])
        return np.asarray(np.einsum("tij,tj->ti", self._inverse, gradient))

    def _on_host(self, column: Any) -> Vector:
        return np.nan_to_num(column.numpy()[: len(self.tile)]).astype(np.float64)

    def _sums(self, values: Vector) -> Vector:
        """Return the sums of values of the pairs over each tile."""
        out = np.zeros((len(self.moved_px), *values.shape[1:]))
        out[self._used] = np.add.reduceat(values[self._order], self._starts, axis=0)
        return out


class Cost:
    """Robust residual of the brightness equations as a function of the search vector.

    Each evaluation starts from the previous brightness map.
    """

    def __init__(
        self, space: ParameterSpace, brightness: BrightnessMap, steps: int, meanwhile: Iterator[None] | None = None
    ) -> None:
        self._space, self.brightness, self.steps = space, brightness, steps
        self.scale = FIRST_SCALE
        self.evaluations = 0
        self.meanwhile = iter(()) if meanwhile is None else meanwhile
        """Other work, whose steps are taken where the host would wait for a GPU."""
        self._solved: NDArray[np.float64] | None = None
        self._changes: list[Any] = []
        """Derivatives of the brightness map by each parameter [1/px], from which the next solution starts."""
        self.columns: dict[str, tuple[Any, Any]] = {}
        """Derivatives of the residuals at the last solution, on the device, by name; each with the part of it that no
        change of the map explains, or None if that was not needed yet."""
        self._by_angle: tuple[Any, Any] | None = None
        self.paths: TilePaths | None = None
        """Paths of the tiles; None if their scenes move with the camera's rotation alone."""

    @property
    def space(self) -> ParameterSpace:
        """Space of the search vector."""
        return self._space

    @space.setter
    def space(self, space: ParameterSpace) -> None:
        self._space, self._changes = space, []
        self._solve_at(None)

    def _solve_at(self, v: NDArray[np.float64] | None) -> None:
        """Note at which search vector the map was solved, and forget the derivatives of earlier residuals."""
        self._solved, self.columns, self._by_angle = v, {}, None

    def warm_up(self, v: NDArray[np.float64]) -> None:
        """Solve the first brightness map at the search vector ``v``, and scale the weights by its residuals."""
        self.residuals(v, rounds=3)
        next(self.meanwhile, None)
        # a coarse map needs its damping
        if self.brightness.tiles.density > 1.0 and self.brightness.relax_damping():
            self.residuals(v, rounds=3)
        self.scale = max(0.1, 1.5 * self.brightness.residuals.median())
        self.residuals(v)

    def renew(self, v: NDArray[np.float64]) -> None:
        """Discard the brightness map and solve a new one at ``v``: a map is biased to the parameters of its fit."""
        self.brightness.clear()
        self._solve_at(None)
        self.brightness.place(**self.at(v))
        self.brightness.solve(FIRST_SCALE, steps=2 * self.steps, rounds=3)

    def replace_map(self, unknowns: wp.array) -> None:
        """Replace the brightness map and the other unknowns; the residuals remain."""
        self.brightness.unknowns = unknowns
        self._solve_at(None)

    def at(self, v: NDArray[np.float64]) -> dict[str, Any]:
        """Return the keyword arguments of :meth:`BrightnessMap.place` for the search vector ``v``."""
        return place_arguments(self.space, self.space.to_values(v))

    def residuals(self, v: NDArray[np.float64], *, rounds: int = 1, steps: int | None = None) -> None:
        """Solve the brightness map at the search vector ``v``. The residuals stay on the device."""
        self.brightness.place(**self.at(v))
        self.brightness.solve(self.scale, steps=steps or self.steps, rounds=rounds)
        self._solve_at(v)

    def converge(self, v: NDArray[np.float64]) -> None:
        """Solve the brightness map at ``v`` in two rounds, unless it was last solved there."""
        if self._solved is None or not np.array_equal(self._solved, v):
            self.residuals(v, rounds=2)

    def by_angle(self, v: NDArray[np.float64]) -> tuple[Any, Any]:
        """Return the derivatives of the residuals by the prism's angle at the first and at the second event of a pair.

        They are on the device, shape (padded pairs,) each. The map must be solved at ``v``.
        """
        if self._by_angle is None:
            arrays, at = self.brightness.pairs.arrays, self.at(v)
            given, ends = arrays.slope, ({**at, "drift": STEP_RAD}, {**at, "drift": -STEP_RAD})

            def by(end: int) -> Any:
                shift = wp.zeros((2, arrays.stride), dtype=float, device=self.brightness.device)
                shift[end].fill_(1.0)
                arrays.slope = shift.flatten()
                return self.brightness.find_slope(*ends, 2.0 * STEP_RAD)

            self._by_angle = by(0), by(1)
            arrays.slope = given
        return self._by_angle

    def mean(self) -> float:
        """Return the mean Cauchy cost, relative to that without a map.

        Pairs of events off the map keep their cost without a map.
        """
        return self.start_mean()()

    def start_mean(self) -> Callable[[], float]:
        """Start to compute :meth:`mean` for the present residuals. Return a function that waits for it."""
        mean, without_map = self.brightness.residuals.start_mean_cost(self.scale, missing=1.0), 1.0 / self.scale**2
        return lambda: mean() / math.log1p(without_map)

    def __call__(self, v: NDArray[np.float64]) -> float:
        """Return the negative cost at the search vector ``v``, a score to be maximised."""
        self.evaluations += 1
        self.residuals(v)
        return -self.mean()

    def start_settled(self, v: NDArray[np.float64]) -> Callable[[], float]:
        """Start to compute the score at ``v``, with the map first changed by :meth:`predict`.

        Return a function that waits for it.
        """
        self.predict(v)
        self.evaluations += 1
        self.residuals(v)
        mean = self.start_mean()
        return lambda: -mean()

    def predict(self, v: NDArray[np.float64]) -> None:
        """Change the map as its derivatives by the parameters predict for a ``v`` nearby, if :meth:`slopes` found them.

        After a step in ``v`` the map would converge slowly.
        """
        if self._solved is None or not self._changes:
            return
        step = v - self._solved
        if self.paths is not None:
            self.paths.follow(v - self._sloped)
        if np.linalg.norm(step) <= PREDICTED_PX:
            for change, moved in zip(self._changes, step, strict=True):
                self.brightness.add(change, float(moved))

    def unexplained(self, column: Any, change: Any = None, *, steps: int) -> Any:
        """Return the part of a derivative that no change of the map and of the tiles' paths explains."""
        left = self.brightness.unexplained(column, change, steps=steps)
        return left if self.paths is None else self.paths.unexplained(left)

    def slopes(self, v: NDArray[np.float64], *, with_parts: bool = False) -> Slopes:
        """Return the residuals' derivatives at ``v``, minus the part that a change of the map can explain.

        The gradient uses these differences too. The derivatives themselves are a biased gradient: damping makes the map
        too flat, so that a larger orbit explains more.
        """
        return self.start_slopes(v, with_parts=with_parts)()

    def start_slopes(self, v: NDArray[np.float64], *, with_parts: bool = False) -> Callable[[], Slopes]:
        """Start to compute :meth:`slopes`. Return a function that waits for them."""
        b, n = self.brightness, len(v)
        if self._solved is None or not np.array_equal(self._solved, v):
            self.residuals(v)
        b.prepare_projection()
        steps, slopes = np.eye(n) * SLOPE_PX, []
        for step in steps:
            slopes.append(b.find_slope(self.at(v + step), self.at(v - step), 2.0 * SLOPE_PX))
        left, changes, self._changes = [], self._changes or [None] * n, []
        if self.paths is not None:
            self._sloped = v
            self.paths.linearise(self.at(v), self.steps // 2)
        for slope, change in zip(slopes, changes, strict=True):
            left.append(self.unexplained(slope, change, steps=self.steps // 2))
            self._changes.append(b.explaining_change())
        upper = np.triu_indices(n)
        pairs = [(left[i], left[j]) for i, j in zip(*upper, strict=True)]
        products = b.residuals.start_products([*pairs, *((row, b.residuals.values) for row in left)])
        clusters = b.residuals.start_clusters(left) if with_parts else lambda: np.empty((n, 0))

        def result() -> Slopes:
            sums, hessian = products(), np.zeros((n, n))
            hessian[upper] = sums[:-n]
            hessian.T[upper] = sums[:-n]
            return Slopes(hessian, sums[-n:], clusters())

        return result


def size_and_phase_directions(space: ParameterSpace, best: Vector) -> list[Vector]:
    """Return unit vectors of the search space along size and phase of each prism, if these are free."""
    unit, found = np.eye(len(best)), []
    for size, phase in MODELS[space.model].ORBITS:
        free = [k for k, name in enumerate(space.names) if name in (size, phase)]
        if free and free[0] in space.orbits:
            x, y = best[free] / max(float(np.linalg.norm(best[free])), 1e-9)
            found += [x * unit[free[0]] + y * unit[free[1]], x * unit[free[1]] - y * unit[free[0]]]
        else:
            found += [unit[k] for k in free]
    return found


# Choice of the parts of the scene that the photometric stage maps.

TILE = 32
"""Side of a tile of the scene [px]."""
FEW_SEGMENTS = 2048
"""Smallest number of segments of rows for which a second CPU thread counts events."""
WITHOUT_GLASS = 3
"""Factor of the number of pairs for a mirror or a vibrating camera. Their parameters need a map with several nodes per
pixel: with a coarser one, the worst of 30 simulated mirrors was wrong by 0.024 px, with it by 0.008 px."""
GRID = (4, 3)
"""Number of columns and rows into which the image is divided. The tile with most events is chosen from each part."""


def choose_tiles(image: Image, pad: int, density: float, margin: int) -> tuple[NDArray[np.int32], Tiles]:
    """Choose the tile with most events from each part of the scene.

    ``image`` is the IWE at the answer of the sharpness stage, with a border of ``pad`` px outside the sensor;
    ``density`` gives map nodes per pixel, and ``margin`` the border of a tile's map [px]. Return the tile number of
    each of the sensor's pixels, or -1, and the tiles.
    """
    layers, height, width = image.shape[0], image.shape[1] - 2 * pad, image.shape[2] - 2 * pad
    columns, rows = max(1, width // TILE), max(1, height // TILE)
    used = rows * min(TILE, height)
    sums: Any = wp.empty((used, columns), dtype=wp.float64, device=image.device)
    inputs = [image.pixels, image.frame, layers, pad, min(TILE, width)]
    launch(sum_segments, sums.size, inputs, [sums], device=image.device, smallest=FEW_SEGMENTS)
    counts = sums.numpy().reshape(rows, -1, columns).sum(axis=1)
    tile_of = np.full((height, width), -1, dtype=np.int32)
    corners: list[tuple[int, int]] = []
    for part_rows in np.array_split(np.arange(rows), min(GRID[1], rows)):
        for part_columns in np.array_split(np.arange(columns), min(GRID[0], columns)):
            part = counts[np.ix_(part_rows, part_columns)]
            row, column = np.unravel_index(int(part.argmax()), part.shape)
            x, y = int(part_columns[column]) * TILE, int(part_rows[row]) * TILE
            tile_of[y : y + TILE, x : x + TILE] = len(corners)
            corners.append((x - margin, y - margin))
    side = math.ceil((TILE + 2 * margin) * density) + 2
    return tile_of, Tiles(np.array(corners, dtype=np.float32), side, side, density)


def near_tiles(tiles: Tiles, margin: int, far: int, shape: tuple[int, ...]) -> NDArray[np.int32]:
    """Return 0 for the pixels that are at most ``far`` pixels from a tile, along each axis, else -1.

    ``margin`` is that of the tiles, ``shape`` the image's (height, width). With few nodes per pixel, tiles count as
    larger than they are, by up to the distance of two nodes.
    """
    near = np.full(shape, -1, dtype=np.int32)
    down, across = (int((n - 2) / tiles.density) - 2 * margin for n in (tiles.rows, tiles.columns))
    for left, top in (tiles.origin.astype(int) + margin).tolist():
        near[max(0, top - far) : top + down + far, max(0, left - far) : left + across + far] = 0
    return near


def one_tile(width: int, height: int, density: float, margin: int) -> tuple[NDArray[np.int32], Tiles]:
    """Return the whole image as one tile, for recordings with few events; see :func:`choose_tiles`."""
    origin = np.array([[-margin, -margin]], dtype=np.float32)
    rows, columns = (math.ceil((n + 2 * margin) * density) + 2 for n in (height, width))
    return np.zeros((height, width), dtype=np.int32), Tiles(origin, rows, columns, density)


# Collection of the pairs of successive events of a pixel that the photometric stage uses.

MARGIN_PX, ROTATION_MARGIN_PX = 3, 8
"""Border of a tile's brightness map for events that a change of the parameters moves [px]: for a still camera, and for
a rotating one."""
LONGEST_GAP_US = 60_000
"""Longest time between the two events of a pair [us]. Noise makes longer gaps unreliable."""
LONGEST_PATH_GAP_US = 200_000
"""The same for pairs that tell the path of the prism's angle: while the prism starts from rest, events come slowly."""
FEWEST_PAIRS = 1_500
"""Smallest number of pairs of events for the photometric stage."""
PAIRS_PER_NODE = 1.5
"""Smallest number of equations per unknown of the brightness map. A map with fewer fits any parameters."""
MANY_PAIRS = 100_000
"""Number of pairs from which on fewer of them per node determine a fine map."""
FINE_PAIRS_PER_NODE, FINE_PAIRS_PER_NODE_OF_MANY = 4.2, 3.9
"""Smallest number of equations per unknown of a map with more than one node per pixel along each axis: of a recording
with few pairs, and of one with :data:`MANY_PAIRS`."""
FEWEST_TURNS = 2
"""Number of turns of the prism that are always used, if the recording has them."""
EVENTS_PER_PAIR = 10
"""Number of events that are copied ahead for each wanted pair. The tiles hold about a tenth of the events as pairs."""
EVENTS_AT_A_TIME = 4_000_000
"""Mean number of events in each of the time spans that are read one after the other."""
FEWEST_TILES = 6
"""Number of tiles of the scene that are always used."""


FEWEST_OF_SECTOR, SILENT_SHARE = 20, 0.05
"""Median number of events of a part of a turn from which on silence is looked for, and the share of that number below
which a part is silent. The model tells the number of parts."""


class _PairCollector:
    """Collector of pairs of events that fall on the same tile, compensated by the result of the sharpness stage."""

    def __init__(
        self,
        recording: Recording,
        search: Search,
        tile_of: NDArray[np.int32],
        near: NDArray[np.int32],
        sensor: SensorTiming,
    ) -> None:
        """``tile_of`` is the tile of each pixel of the map, or -1; events of the pixels with ``near`` >= 0 are used."""
        self.recording, self.search, self.sensor = recording, search, sensor
        self._tile_of, self._near = (wp.array(a, dtype=int, device=search.device) for a in (tile_of, near))
        self._found: list[PairSet] = []
        self._done = 0
        self._heard_us = self._read_us = 0
        self.longest_gap_us = LONGEST_GAP_US

    @property
    def silent_share(self) -> float:
        """Share of the time in which no events came."""
        return 1.0 - self._heard_us / max(1, self._read_us)

    def read(self, spans: list[tuple[int, int]]) -> int:
        """Collect the pairs of events inside the time spans [us], which extend those of earlier calls.

        Return the number of all pairs. Only new spans are read.
        """
        if len(spans) > self._done:
            self._found.append(self._new_pairs(spans[self._done :]))
            self._done = len(spans)
        return sum(map(len, self._found))

    def pairs(self) -> PairSet:
        """Return all pairs."""
        return PairSet.concatenate(self._found)

    def _new_pairs(self, spans: list[tuple[int, int]]) -> PairSet:
        search, source = self.search, self.recording.events
        space, best, calibration_events = search.space, search.best, search.calibration_events
        joined = None if search.ahead is None else search.ahead.take(spans)
        sector = turn_length(self.recording, calibration_events.encoder) / MODELS[space.model].SECTORS
        parts = [part for span in spans for part in split_at_silence(source.between(*span), sector)]
        self._heard_us += sum(int(part.t[-1]) - int(part.t[0]) for part in parts)
        self._read_us += sum(stop - start for start, stop in spans)
        if joined is not None and sum(map(len, parts)) < len(joined):
            joined = None
        table = EventTable(parts, self._near, search.device, joined=joined)
        pairs = table.pairs(
            calibration_events.encoder, longest_gap_us=self.longest_gap_us,
            shortest_gap_us=2.0 * self.sensor.refractory_us, sensor=self.sensor, middle_us=space.middle_us,
        )  # fmt: skip
        if not len(pairs):
            return pairs
        if calibration_events.slope_of is not None:
            pairs = pairs.with_slope(calibration_events.slope_of, space.middle_us)
        return pairs.on_tiles(space.build(best), space.camera_rotation(best), space.drift(best), self._tile_of)


def split_at_silence(events: Events, length_us: float) -> list[Events]:
    """Return the events in parts, without the silence between them: times of ``length_us`` and more with few events.

    Where a sensor or its link loses all events for a while, the next event of a pixel does not follow the last one.
    """
    t = events.t
    edges = np.arange(int(t[0]), int(t[-1]) + length_us, length_us) if len(t) else np.zeros(0)
    at = np.searchsorted(t, np.ceil(edges).astype(np.int64))  # real numbers would make a copy of all times
    counts = np.diff(at)
    if not len(counts) or np.median(counts) < FEWEST_OF_SECTOR:
        return [events] if len(t) else []
    heard = np.concatenate([[0], (counts >= SILENT_SHARE * np.median(counts)).astype(np.int8), [0]])
    starts, stops = (at[np.flatnonzero(np.diff(heard) == step)].tolist() for step in (1, -1))
    return [events[a:b] for a, b in zip(starts, stops, strict=True)]


def turn_length(recording: Recording, encoder: Encoder) -> float:
    """Return the duration of a turn of the prism [us]; the duration of the recording if it is shorter."""
    whole = float(recording.events.t_last - recording.events.t_first + 1)
    return min(60e6 / max(abs(encoder.rpm), 1e-6), whole)


def time_spans(recording: Recording, search: Search) -> list[tuple[int, int]]:
    """Return the time spans whose events give pairs, in the order of their use [us]: turns of the prism.

    A rotating camera needs successive turns, so it gets one span.
    """
    first, last = recording.events.t_first, recording.events.t_last
    if search.full_space.moving:
        return [(first, last + 1)]
    turn = turn_length(recording, search.calibration_events.encoder)
    turns = max(1, int((last - first + 1) / turn))
    return [(first + int(k * turn), first + int(k * turn) + int(turn)) for k in van_der_corput(turns)]


def upload_ahead(recording: Recording, search: Search) -> AbstractContextManager[EventsAhead | None]:
    """Start to copy the events that :func:`collect_pairs` will probably need to a GPU.

    Only events in memory are copied. On a CPU, or without a photometric stage, the context gives None.
    """
    device, source, settings = wp.get_device(search.device), recording.events, search.settings
    if device.is_cpu or not isinstance(source, MemoryEvents) or "photometric" not in settings.stages:
        return nullcontext()
    most = EVENTS_PER_PAIR * most_pairs(search)
    return EventsAhead(source, time_spans(recording, search), most, device)


def most_pairs(search: Search) -> int:
    """Return the approximate largest number of pairs."""
    return search.settings.photometric.pairs * (1 if MODELS[search.space.model].PRISM else WITHOUT_GLASS)


def collect_pairs(recording: Recording, search: Search, settings: PhotometricSettings) -> tuple[PairSet, Tiles, float]:
    """Return pairs of events from whole turns spread over the recording, the map's tiles, and the share of silence.

    There are about :func:`most_pairs` pairs. At least :data:`FEWEST_TURNS` turns are used, if the recording has them.
    If these hold too many pairs, whole tiles are left out: fewer pairs on the same tiles would not determine the map.
    A camera in fast motion always gets tiles, as their scenes move on their own paths.
    Silence is the time in which no events came.
    """
    first, most = recording.events.t_first, most_pairs(search)
    turn = turn_length(recording, search.calibration_events.encoder)
    margin = ROTATION_MARGIN_PX if search.full_space.moving else MARGIN_PX
    few = len(recording.events.between(first, first + int(FEWEST_TURNS * turn) + 1)) <= most
    if few and not search.fast:
        tile_of, tiles = one_tile(*recording.events.size, settings.density, margin)
    else:
        tile_of, tiles = choose_tiles(search.fine.image(search.best), search.pad, settings.density, margin)
    near = near_tiles(tiles, margin, math.ceil(reach(search.space, search.best)) + 1, tile_of.shape)
    collector = _PairCollector(recording, search, tile_of, near, settings.sensor)
    spans = time_spans(recording, search)
    many = min(FEWEST_TURNS, len(spans))
    found = collector.read(spans[:many])
    while found < most and many < len(spans):
        many = min(len(spans), max(many + 1, math.ceil(many * most / max(found, 1))))
        found = collector.read(spans[:many])
    pairs, count = collector.pairs(), len(tiles.origin)
    keep = max(FEWEST_TILES, round(count * most / max(len(pairs), 1)))
    if keep >= count:
        return pairs, tiles, collector.silent_share
    pairs = pairs.of_tiles(np.isin(np.arange(count), van_der_corput(count)[:keep]))
    return pairs, tiles, collector.silent_share


def collect_everywhere(
    recording: Recording, search: Search, settings: PhotometricSettings, most: int, most_tiles: int
) -> tuple[PairSet, Tiles]:
    """Return about ``most`` pairs of events from all times of a recording, and at most ``most_tiles`` tiles.

    The pairs come from pixels that are evenly spread over the tiles.
    """
    source = recording.events
    tile_of, tiles = choose_tiles(search.fine.image(search.best), search.pad, settings.density, MARGIN_PX)
    used = van_der_corput(len(tiles.origin))[:most_tiles]
    number = np.full(len(tiles.origin) + 1, -1, np.int32)  # the last one is that of pixels without a tile
    number[used] = np.arange(len(used))
    tile_of, tiles = number[tile_of], replace(tiles, origin=tiles.origin[used])
    near = near_tiles(tiles, MARGIN_PX, math.ceil(reach(search.space, search.best)) + 1, tile_of.shape)
    share = most / max(1.0, len(source) * float(np.mean(tile_of >= 0)))
    near[np.random.default_rng(0).random(near.shape) >= share] = -1
    collector = _PairCollector(recording, search, tile_of, near, settings.sensor)
    collector.longest_gap_us = LONGEST_PATH_GAP_US
    parts = -(-len(source) // EVENTS_AT_A_TIME)
    edges = np.linspace(source.t_first, source.t_last + 1, parts + 1).astype(np.int64).tolist()
    spans = [*itertools.pairwise(edges)]
    for k in range(parts):
        collector.read(spans[: k + 1])
    return collector.pairs(), tiles


def van_der_corput(n: int) -> list[int]:
    """Return 0 … n-1 in van der Corput's order: the first k numbers are evenly spread for every k."""
    bits = max(1, (n - 1).bit_length())
    order = (int(f"{k:0{bits}b}"[::-1], 2) for k in range(1 << bits))
    return [k for k in order if k < n]


def pairs_per_node(coverage: NDArray[np.float32], pairs: int) -> float:
    """Return the number of pairs of events per node of the map that they touch."""
    return pairs / max(1, int((coverage > 0.5).sum()))


def fine_map_is_determined(coverage: NDArray[np.float32], pairs: int) -> bool:
    """Return whether there are enough pairs for a map with more than one node per pixel along each axis."""
    fewest = FINE_PAIRS_PER_NODE_OF_MANY if pairs >= MANY_PAIRS else FINE_PAIRS_PER_NODE
    return pairs_per_node(coverage, pairs) >= fewest


def check_pairs(name: str, coverage: NDArray[np.float32], pairs: int) -> float:
    """Return 1 minus the ratio of map unknowns to pairs of events; raise :class:`AmiwarpError` for too few pairs."""
    ratio = pairs_per_node(coverage, pairs)
    if pairs < FEWEST_PAIRS or ratio < PAIRS_PER_NODE:
        raise AmiwarpError(
            f"{name}: {pairs} pairs of events are too few for the {pairs / ratio:.0f} unknowns of a brightness map; "
            "record for longer"
        )
    return 1.0 - 1.0 / ratio


MOST_STEPS = 15
"""Largest number of Gauss-Newton steps."""
FIRST_STEPS = 3
"""Number of steps after which a search may be given up: the first ones may only turn towards the optimum."""
LONGEST_STEP_PX = 1.0
"""Largest change of any parameter in one Gauss-Newton step [px]."""
HALVINGS = 4
"""Number of step lengths that are tried along a Gauss-Newton direction, each half of the previous one."""


@dataclass(frozen=True)
class Slopes:
    """Derivatives of the weighted least-squares problem with the brightness map eliminated (Kaufman 1975).

    They are sums over the pairs of events.
    """

    hessian: Vector
    """Gauss-Newton Hessian [thresholds²/px²], shape ``(parameters, parameters)``."""
    gradient: Vector
    """Half the cost's gradient [thresholds²/px], shape ``(parameters,)``. The brightness map is optimal, so its change
    adds nothing to the gradient."""
    parts: Vector
    """Contribution of each cluster of pairs of events to the gradient, shape ``(parameters, clusters)``."""

    def restricted_to(self, which: list[int]) -> Slopes:
        """Return the derivatives by some of the parameters only."""
        return Slopes(self.hessian[np.ix_(which, which)], self.gradient[which], self.parts[which])

    def step(self) -> Vector:
        """Return the change of the parameters by a Gauss-Newton step [px]."""
        ridge = 1e-6 * float(np.trace(self.hessian)) * np.eye(len(self.hessian))
        return np.asarray(-np.linalg.solve(self.hessian + ridge, self.gradient))

    def covariance(self) -> Vector:
        """Return the parameters' covariance [px²]: the sandwich estimate from the clusters' gradients."""
        clusters = self.parts.shape[1]
        parts = self.parts - self.parts.mean(axis=1, keepdims=True)
        scatter = parts @ parts.T * clusters / max(1, clusters - 1 - len(parts))
        # successive pairs of a pixel share an event and are correlated, so the inverse Hessian alone is too small
        inverse = _inverse(self.hessian)
        return np.asarray(inverse @ scatter @ inverse)


def _inverse(hessian: Vector) -> Vector:
    """Return the inverse of the Hessian, with very small eigenvalues raised."""
    values, vectors = np.linalg.eigh(hessian)
    return np.asarray(vectors @ np.diag(1.0 / np.maximum(values, 1e-9 * max(float(values[-1]), 1e-12))) @ vectors.T)


UNDETERMINED_PX, LEAST_CURVATURE = 0.3, 1e-3
"""A parameter is undetermined if its standard deviation exceeds the first value [px], or if its curvature is below the
second, a share of the largest curvature."""


def determined(slopes: Slopes, space: ParameterSpace, left: float) -> tuple[str, ...]:
    """Return the names of the free parameters that the events determine.

    A parameter is weak if its standard deviation is large, or if its curvature, with all others free, is far below the
    largest one: then the standard deviation is unreliable. The weakest parameter is removed until none is weak. Size,
    phase and rates always stay. ``left`` is the share of equations beyond the map's unknowns.
    """
    names = list(space.names)
    core = sum(n in (space.size_name, "phase", *RATES) for n in names)
    names.sort(key=lambda n: n not in (space.size_name, "phase", *RATES))
    while len(names) > max(core, 1):
        part = slopes.restricted_to([space.names.index(n) for n in names])
        curvature = 1.0 / np.diag(_inverse(part.hessian)) / part.hessian.diagonal().max()
        deviation = np.sqrt(np.diag(part.covariance())) / left
        weak = [
            k for k in range(core, len(names))
            if not (deviation[k] <= UNDETERMINED_PX and curvature[k] >= LEAST_CURVATURE)
        ]  # fmt: skip
        if not weak:
            break
        names.pop(min(weak, key=lambda k: float(curvature[k])))
    return tuple(n for n in space.names if n in names)


def iterate(
    start_score: Callable[[Vector], Callable[[], float]],
    start_slopes: Callable[[Vector], Callable[[], Slopes]],
    start: Vector,
    *,
    low: Vector,
    high: Vector,
    tolerance: float,
    report: Callable[[int, int], None],
    early: bool = True,
    least: float = -math.inf,
    walls: tuple[Vector, Vector] | None = None,
) -> SearchStage:
    """Maximise a score by Gauss-Newton steps until they are shorter than ``tolerance`` [px] in every parameter.

    A step that lowers the score is halved. The search stays in the box ``low .. high`` [px]. It also ends if all steps
    that are left, each as good as the last one, would not reach the score ``least``, and at the second step in turn to
    one of the ``walls``, bounds [px] on which an answer is of no use. Its answer is the best evaluated point.
    ``report`` gets the number of steps done and the largest number. ``start_score`` and ``start_slopes`` return
    functions that wait for the result at a point. If ``early``, slopes are also started where the score may turn out
    lower, and then not waited for.
    """
    began = time.perf_counter()
    v, points, scores, ended, at_wall = np.clip(start, low, high), [], [], "budget", 0
    waiting = start_score(v)
    slopes = start_slopes(v) if early else None
    here = waiting()
    points.append(v)
    scores.append(here)
    for k in range(MOST_STEPS):
        report(k, MOST_STEPS)
        step = (slopes or start_slopes(v))().step()
        step *= min(1.0, LONGEST_STEP_PX / max(float(np.abs(step).max()), 1e-12))
        for _ in range(HALVINGS):
            trial = np.clip(v + step, low, high)
            moved = float(np.abs(trial - v).max())
            waiting = start_score(trial)
            slopes = start_slopes(trial) if early and moved >= tolerance and k + 1 < MOST_STEPS else None
            value = waiting()
            points.append(trial)
            scores.append(value)
            if value >= here:
                break
            step = step / 2.0
        gained = value - here
        at_wall = at_wall + 1 if walls is not None and bool(((trial <= walls[0]) | (trial >= walls[1])).any()) else 0
        if value >= here:
            v, here = trial, value
        if k + 1 >= FIRST_STEPS and here + (MOST_STEPS - 1 - k) * gained < least:
            ended = "too far from the least score"
            break
        if at_wall > 1:
            ended = "bound"
            break
        if moved < tolerance or value < here:
            ended = "tolerance" if moved < tolerance else "no better step"
            break
    return best_of(GAUSS_NEWTON, points, scores, seconds=time.perf_counter() - began, ended=ended)
