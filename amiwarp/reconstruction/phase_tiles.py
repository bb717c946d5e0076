"""The detail of a picture from sums in phase, tile by tile: each tile has the orbit of its middle.

With the log intensity L of the scene and the orbit u(θ) = a exp(iθ) + b exp(-iθ) of a pixel, the sums in phase have
the spatial spectra A_m(k) = H_m(k) L(k), H_m(k) = i m (i exp(i arg c))^m J_m(|c|), with c = conj(k) a + k conj(b)
(expansion of Jacobi and Anger). Least squares over the harmonics gives L(k).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any

import numpy as np
import scipy.fft
import warp as wp
from numpy.typing import NDArray

from amiwarp.imaging.bessel import BESSEL_STEP, bessel_table
from amiwarp.imaging.phase import PhaseSums, shared_pairs
from amiwarp.imaging.phase_costs import DAMPING
from amiwarp.kernels import phase_spectra as kernels
from amiwarp.kernels.launch import launch
from amiwarp.kernels.phase_grid import SIDE
from amiwarp.kernels.phase_lines import turns_of_places
from amiwarp.kernels.phase_planes import PLANE, TileTables, tile_scenes
from amiwarp.optics.camera import Camera
from amiwarp.optics.models.base import Model
from amiwarp.optics.orbit import orbits_of
from amiwarp.tasks import cpu_threads, in_order

LEAST_OVERLAP = 24
"""Smallest overlap of tiles beside each other [px]."""
HALF = SIDE // 2 + 1
"""Number of columns of the spectrum of a real scene: the others are conjugates."""


@dataclass(frozen=True)
class TiledScene:
    """What the sums say of the scene, each part with the orbit of its tile."""

    detail: NDArray[np.float32]
    """Log intensity without waves longer than a tile [thresholds], shape (height, width)."""
    rest: NDArray[np.complex64] | None
    """What the scene leaves of the sums, shape (harmonics, height, width), if it was asked for."""


def scene_of_tiles(sums: PhaseSums, model: Model, lag: float, *, with_rest: bool) -> TiledScene:
    """Return the detail of the scene that explains the sums best, and what it leaves of them.

    ``lag`` is the angle by which the optic has turned on before an event is seen [rad].
    """
    harmonics, height, width = sums.values.shape
    plan = plan_of(model, harmonics)
    responses = plan.responses(lag)
    parts = responses.weighted_scenes(sums.values)
    detail = Mosaic((height, width), np.dtype(np.float32))
    for place, part in zip(plan.places, parts, strict=True):
        detail.add(place, part)
    if not with_rest:
        return TiledScene(detail.values, None)
    jobs = [
        partial(_rest_of_tile, sums.values, plan, responses, tile)
        for tile in range(len(plan.places))
    ]
    rest = Mosaic((harmonics, height, width), np.dtype(np.complex64))
    for place, left in zip(plan.places, in_order(jobs, fill_cores=True), strict=True):
        rest.add(place, left)
    return TiledScene(detail.values, rest.values)


def tile_starts(length: int) -> tuple[list[int], int]:
    """Return where the tiles along one side of an image begin [px], and their overlap.

    The first tile begins an overlap before the image, and the last one ends an overlap after it or further.
    """
    # Between the first rise and the last fall, count steps cover the image and one overlap, SIDE - step.
    count = -(-(length + SIDE) // (SIDE - LEAST_OVERLAP)) - 1  # rounded up
    step = -(-(length + SIDE) // (count + 1))  # rounded up
    overlap = SIDE - step
    return [step * k - overlap for k in range(count)], overlap


def weights_of_line(overlap: int) -> NDArray[np.float32]:
    """Return the weights along a tile, whose squares add up to 1 with the squares of the tiles beside it."""
    rise = np.sin((np.arange(overlap) + 0.5) * (math.pi / (2 * overlap)))
    return np.concatenate([rise, np.ones(SIDE - 2 * overlap), rise[::-1]]).astype(np.float32)


@dataclass(frozen=True)
class Plan:
    """What the pictures through one optic have in common."""

    places: list[tuple[int, int]]
    """First row and column of each tile, which may lie outside of the image [px]."""
    window: NDArray[np.float32]
    """Weights of a tile."""
    orbits: NDArray[np.complex64]
    """Motion of each tile's middle, a exp(iθ) + b exp(-iθ), as (a, b) [px], shape (tiles, 2)."""
    bessel: wp.array
    """Bessel functions J_1, J_2, … in steps of :data:`BESSEL_STEP`, on the CPU."""
    tables: Any
    """What the kernels take of all this, a ``TileTables``."""

    def responses(self, lag: float) -> Responses:
        """Return how a scene makes the sums of each tile, if events lag by an angle [rad]."""
        # The orbit's angle is behind.
        late = self.orbits * np.exp(np.array([-1j, 1j]) * lag).astype(np.complex64)
        behind = wp.vec2(math.cos(lag), -math.sin(lag))
        return Responses(wp.clone(shared_pairs(late)), self.bessel, self.tables, behind)


@lru_cache(maxsize=8)
def plan_of(model: Model, harmonics: int) -> Plan:
    """Return the plan of pictures through an optic."""
    places, window = places_and_window(model.camera)
    found = orbits_of(model, tile_middles(model.camera, places))
    orbits = np.stack([found.forward, found.backward], axis=1).astype(np.complex64)
    return plan_of_orbits(places, window, orbits, harmonics)


def places_and_window(camera: Camera) -> tuple[list[tuple[int, int]], NDArray[np.float32]]:
    """Return the first row and column of each tile of an image [px], and the weights of a tile."""
    rows, overlap_y = tile_starts(camera.height)
    columns, overlap_x = tile_starts(camera.width)
    places = [(row, column) for row in rows for column in columns]
    return places, np.outer(weights_of_line(overlap_y), weights_of_line(overlap_x))


def tile_middles(camera: Camera, places: list[tuple[int, int]]) -> NDArray[np.float64]:
    """Return the middle of each tile, or the nearest point of the image [px], shape (tiles, 2)."""
    middles = np.array([(column + SIDE / 2, row + SIDE / 2) for row, column in places])
    return np.clip(middles, 0.0, (camera.width - 1.0, camera.height - 1.0))


def plan_of_orbits(
    places: list[tuple[int, int]],
    window: NDArray[np.float32],
    orbits: NDArray[np.complex64],
    harmonics: int,
) -> Plan:
    """Return the plan of tiles with these places, weights and orbits, as :class:`Plan` has them."""
    bessel = bessel_of(orbits, harmonics)
    tables = TileTables()
    tables.places = wp.array(places, dtype=wp.vec2i, device="cpu")
    tables.window = wp.array(window, dtype=float, device="cpu")
    tables.turns = wp.clone(shared_pairs(turns_of_places().astype(np.complex64)))
    tables.steps = wp.empty((len(orbits), SIDE, HALF), dtype=wp.vec2, device="cpu")
    shape = (len(orbits), len(bessel), SIDE, HALF)
    tables.strengths = wp.empty(shape, dtype=float, device="cpu")
    inputs = [shared_pairs(orbits), bessel, 1.0 / BESSEL_STEP, DAMPING]
    outputs = [tables.steps, tables.strengths]
    launch(kernels.response_tables, tables.steps.size, inputs, outputs, device="cpu")
    return Plan(places, window, orbits, bessel, tables)


def bessel_of(orbits: NDArray[np.complex64], harmonics: int) -> wp.array:
    """Return the table of Bessel functions for all waves of tiles with these orbits, on the CPU."""
    reach = float(np.abs(orbits).sum(axis=1).max())
    table = bessel_table(harmonics, math.sqrt(2.0) * math.pi * reach)
    return wp.array(table, dtype=float, device="cpu", copy=False)


@dataclass(frozen=True)
class Responses:
    """How a scene makes the sums of each tile: inputs of the kernels, on the CPU."""

    orbits: wp.array
    """Motion of each tile's middle, as (a, b)."""
    bessel: wp.array
    """Bessel functions J_1, J_2, … in steps of :data:`BESSEL_STEP`."""
    tables: Any
    """The responses without lag, and what else the tiles have in common."""
    behind: wp.vec2
    """exp(-i lag), by which the steps turn."""

    def weighted_scenes(self, values: NDArray[np.complex64]) -> NDArray[np.float32]:
        """Return the weighted scenes of all tiles by least squares, shape (tiles, side, side).

        ``values`` are the sums in phase of the image, shape (harmonics, height, width).
        """
        tiles = len(self.tables.places)
        shares = min(tiles, cpu_threads())
        planes = np.empty((shares, 2 * PLANE), np.float32)
        spectra = np.empty((shares, len(values), SIDE, SIDE), np.complex64)
        scenes = np.empty((shares, SIDE, HALF), np.complex64)
        parts = np.empty((tiles, SIDE, SIDE), np.float32)
        outputs = [
            wp.array(planes, device="cpu", copy=False),
            shared_pairs(spectra),
            shared_pairs(scenes),
            wp.array(parts, device="cpu", copy=False),
        ]
        inputs = [shared_pairs(values), self.tables, self.behind]
        launch(tile_scenes, shares, inputs, outputs, device="cpu", smallest=1)
        return parts

    def scene(self, spectra: NDArray[np.complex64], tile: int) -> NDArray[np.complex64]:
        """Return the spectrum of the scene of a tile by least squares, shape (side, side // 2 + 1).

        ``spectra`` are the Fourier transforms of its sums, shape (harmonics, side, side).
        """
        scene = np.empty((SIDE, HALF), np.complex64)
        inputs = [shared_pairs(spectra), self.tables.steps, self.tables.strengths]
        inputs += [tile, self.behind]
        launch(kernels.scene_spectrum, SIDE, inputs, [shared_pairs(scene)], device="cpu")
        return scene

    def rest(
        self, spectra: NDArray[np.complex64], scene: NDArray[np.complex64], tile: int
    ) -> NDArray[np.complex64]:
        """Return what a scene leaves of the spectra of a tile, shaped as the spectra."""
        rest = np.empty_like(spectra)
        inputs = [shared_pairs(spectra), self.orbits, tile, self.bessel, 1.0 / BESSEL_STEP]
        inputs.append(shared_pairs(scene))
        launch(kernels.rest_spectra, rest[0].size, inputs, [shared_pairs(rest)], device="cpu")
        return rest


def _rest_of_tile(
    values: NDArray[np.complex64], plan: Plan, responses: Responses, tile: int
) -> NDArray[np.complex64]:
    """Return the weighted rest of the sums of a tile."""
    cut = cut_out(values, plan.places[tile], plan.window)
    spectra = scipy.fft.fft2(cut, workers=1, overwrite_x=True)
    rest = responses.rest(spectra, responses.scene(spectra, tile), tile)
    return np.asarray(plan.window * scipy.fft.ifft2(rest, workers=1, overwrite_x=True))


def cut_out(
    values: NDArray[np.complex64], place: tuple[int, int], window: NDArray[np.float32]
) -> NDArray[np.complex64]:
    """Return the weighted values of a tile, 0 outside of the image, shape (harmonics, side, side)."""
    image, inside = _overlap_of(values.shape[1:], place)
    cut = np.zeros((len(values), SIDE, SIDE), np.complex64)
    # As real numbers, two for each pixel: NumPy would make complex numbers of the weights.
    weights = np.repeat(window[inside], 2, axis=1)
    seen = values.view(np.float32)[:, *_of_pairs(image)]
    np.multiply(seen, weights, out=cut.view(np.float32)[:, *_of_pairs(inside)])
    return cut


class Mosaic:
    """An image, or several, of weighted tiles that overlap."""

    def __init__(self, shape: tuple[int, ...], dtype: np.dtype[Any]) -> None:
        """Start without tiles."""
        self.values = np.zeros(shape, dtype)

    def add(self, place: tuple[int, int], tile: NDArray[Any]) -> None:
        """Add a tile that begins at a row and column."""
        image, inside = _overlap_of(self.values.shape[-2:], place)
        self.values[..., *image] += tile[..., *inside]


_Area = tuple[slice, slice]
"""Rows and columns."""


def _overlap_of(shape: tuple[int, ...], place: tuple[int, int]) -> tuple[_Area, _Area]:
    """Return the part of an image under a tile, and this part within the tile."""
    starts = [max(0, first) for first in place]
    stops = [min(length, first + SIDE) for length, first in zip(shape, place, strict=True)]
    image = [slice(a, b) for a, b in zip(starts, stops, strict=True)]
    tile = [slice(s.start - first, s.stop - first) for s, first in zip(image, place, strict=True)]
    return (image[0], image[1]), (tile[0], tile[1])


def _of_pairs(area: _Area) -> _Area:
    """Return the area in an image whose columns are pairs."""
    rows, columns = area
    return rows, slice(2 * columns.start, 2 * columns.stop)
