"""Estimate of the camera's angular velocity from events that are one turn of the prism apart.

Events of one range of prism angles form the same image in two successive turns, displaced by the camera's rotation
alone. Such images of many angle ranges are cross-correlated patch by patch. The angular velocity is fitted to the
displacements of the patches.
"""

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from amiwarp.calib.first_guess import ANGLE_RANGES
from amiwarp.events.encoder import Encoder
from amiwarp.events.recording import Events
from amiwarp.optics.camera import Camera

Vector = NDArray[np.float64]
Rates = tuple[float, float, float]

LEAST_TURNED = 1.25 * math.tau
"""Smallest angle of the prism from which the angular velocity is estimated [rad]."""
CELL_PX = 2
"""Side of the cells in which events are counted, and of the cells of the correlations [px]."""
PATCHES = (6, 5)
"""Number of image patches along x and y."""
SMOOTHING_PX = 2.0
"""Standard deviation of the Gaussian that smooths the correlations [px]."""
PEAKS = 3
"""Number of correlation peaks examined per image patch."""
PEAK_NEIGHBOURS = np.arange(-4, 5)
"""Distances from a peak within which there is no other one [cells]."""
STARTS = 12
"""Number of candidate angular velocities from which the estimate is refined."""
ROLLS = tuple(range(-60, 61, 12))
"""Rotations about the optical axis that are combined with each correlation peak, as the displacement at one focal
length from the image's middle [px per turn]."""


def estimate_rates(events: Events, encoder: Encoder, camera: Camera) -> Rates:
    """Return the camera's mean angular velocity [rad/s] from about two turns of events.

    The result is zero for less than 1.25 turns.
    """
    angle = encoder.angle_at(events.t)
    change = float(angle[-1] - angle[0])
    direction = math.copysign(1.0, change)
    turned = direction * (angle - angle[0])
    if turned[-1] < LEAST_TURNED:
        return 0.0, 0.0, 0.0
    first_us = int(events.t[0])
    last_us = int(events.t[-1])
    duration_s = (last_us - first_us) * 1e-6
    speed = float(turned[-1]) / duration_s
    turn_s = math.tau / speed

    # How the image of each patch moves from the first to the second turn.
    within_turn = turned % math.tau
    range_of_event = (within_turn * (ANGLE_RANGES / math.tau)).astype(np.int64)
    turn_of_event = (turned / math.tau).astype(np.int64)
    turn_of_event = np.minimum(turn_of_event, 2)  # 2: after two turns, not used
    centres, surfaces = _correlations(events, range_of_event, turn_of_event, camera)
    agreement = _agreement_with(centres, surfaces, camera, turn_s)

    unit = 1.0 / (camera.fx * turn_s)  # moves the image by about one pixel per turn
    candidates = np.array(_candidate_rates(surfaces, unit))
    worst_first = np.argsort(agreement(candidates), kind="stable")
    starts = candidates[worst_first[-STARTS:]]
    return _refined(agreement, starts, unit)


def _refined(agreement: Callable[[Vector], Vector], starts: Vector, unit: float) -> Rates:
    """Return the angular velocity of the best agreement, by searches from several ones."""
    from scipy.optimize import minimize

    corners = np.vstack([np.zeros(3), np.eye(3)])
    simplex = 4.0 * unit * corners

    def cost(rate: Vector) -> float:
        return -float(agreement(rate[None])[0])

    best_cost = math.inf
    best = starts[0]
    for start in starts:
        found = minimize(
            cost,
            start,
            method="Nelder-Mead",
            options={"initial_simplex": start + simplex},
        )
        if float(found.fun) < best_cost:
            best_cost = float(found.fun)
            best = found.x
    x, y, z = best.tolist()
    return x, y, z


def _agreement_with(
    centres: Vector,
    surfaces: Vector,
    camera: Camera,
    turn_s: float,
) -> Callable[[Vector], Vector]:
    """Return a function that sums the patches' correlations for each of some angular velocities, shape (n, 3)."""
    from scipy.ndimage import map_coordinates
    from scipy.spatial.transform import Rotation

    patches = np.arange(len(centres))
    rays = np.asarray(camera.pixels_to_rays(centres.astype(np.float32)), np.float64)
    farthest = max(surfaces.shape[1:]) / 2

    def centres_after_turn(rates: Vector) -> Vector:
        """Return where the centres are after a turn [px], shape (n, patches, 2)."""
        # a static point moves against the camera's rotation
        rotations = Rotation.from_rotvec(-rates * turn_s).as_matrix()
        turned_rays = rotations[:, None] @ rays[:, :, None]
        flat = turned_rays.reshape(-1, 3).astype(np.float32)
        pixels = np.asarray(camera.rays_to_pixels(flat), np.float64)
        return pixels.reshape(len(rates), len(centres), 2)

    def agreement(rates: Vector) -> Vector:
        cells = (centres_after_turn(rates) - centres) / CELL_PX
        # A rotation that moves a patch beyond the correlations agrees with nothing.
        is_near = np.abs(cells) <= farthest
        inside = is_near.all(axis=(1, 2))
        known_cells = np.where(inside[:, None, None], cells, 0.0)
        row = known_cells[..., 1]
        column = known_cells[..., 0]
        patch = np.broadcast_to(patches, row.shape)
        values = map_coordinates(surfaces, [patch, row, column], order=1, mode="grid-wrap")
        total = values.sum(axis=1)
        return np.where(inside, total, 0.0)

    return agreement


def _candidate_rates(surfaces: Vector, unit: float) -> list[Rates]:
    """Return candidate angular velocities [rad/s]: each patch's correlation peaks, combined with several rolls."""
    found: list[Rates] = []
    for surface in [surfaces.sum(axis=0), *surfaces]:
        rows, columns = surface.shape
        for _ in range(PEAKS):
            row, column = np.unravel_index(int(surface.argmax()), surface.shape)
            x = _displacement(int(column), columns)
            y = _displacement(int(row), rows)
            for roll in ROLLS:
                # a rotation about x moves the image along y, one about y along -x
                found.append((y * unit, -x * unit, roll * unit))

            # The next peak is not beside this one.
            near_rows = (row + PEAK_NEIGHBOURS) % rows
            near_columns = (column + PEAK_NEIGHBOURS) % columns
            surface = surface.copy()
            surface[np.ix_(near_rows, near_columns)] = 0.0
    return found


def _displacement(cell: int, cells: int) -> float:
    """Return the displacement [px] of a cell of a correlation with periodic borders: the far half is negative."""
    if cell > cells / 2:
        cell -= cells
    return float(CELL_PX * cell)


def _correlations(
    events: Events,
    range_of_event: NDArray[np.int64],
    turn_of_event: NDArray[np.int64],
    camera: Camera,
) -> tuple[Vector, Vector]:
    """Return the centres of the patches [px] and the cross-correlation of successive turns in each patch.

    ``range_of_event`` holds the range of prism angles of each event, and ``turn_of_event`` its turn: only 0 and 1 are
    used. The centres have shape (patches, 2). The correlations have shape (patches, rows, columns), cells of
    :data:`CELL_PX` of displacement, periodic borders and values from 0 to 1.
    """
    from scipy.ndimage import gaussian_filter

    rows = camera.height // CELL_PX
    columns = camera.width // CELL_PX
    padded_rows = _padded(rows)
    padded_columns = _padded(columns)
    size = (padded_rows, padded_columns)
    centres, windows = _patches(rows, columns)
    patches = len(windows)

    spectra = np.zeros((patches, padded_rows, padded_columns // 2 + 1), np.complex128)
    for range_index in range(ANGLE_RANGES):
        in_range = range_of_event == range_index
        first_turn = np.flatnonzero(in_range & (turn_of_event == 0))
        second_turn = np.flatnonzero(in_range & (turn_of_event == 1))
        before = _signed_counts_in_cells(events[first_turn], rows, columns)
        after = _signed_counts_in_cells(events[second_turn], rows, columns)
        after_spectrum = np.fft.rfft2(after, size)
        for total, window in zip(spectra, windows, strict=True):
            before_spectrum = np.fft.rfft2(before * window, size)
            total += np.conj(before_spectrum) * after_spectrum

    smoothing = SMOOTHING_PX / CELL_PX
    surfaces = np.empty((patches, padded_rows, padded_columns))
    for surface, spectrum in zip(surfaces, spectra, strict=True):
        correlation = np.fft.irfft2(spectrum, size)
        gaussian_filter(correlation, smoothing, output=surface, mode="wrap")
    highest = surfaces.max(axis=(1, 2), keepdims=True)
    positive = np.maximum(surfaces, 0.0)
    # Cell c holds the pixels 2c and 2c + 1, whose middle is 2c + 0.5.
    middle_of_cell = 0.5 * (CELL_PX - 1)
    return CELL_PX * centres + middle_of_cell, positive / np.maximum(highest, 1e-12)


def _padded(cells: int) -> int:
    """Return the power of two that leaves room for displacements beside a number of cells."""
    needed = 1.5 * cells
    return int(2 ** math.ceil(math.log2(needed)))


def _patches(rows: int, columns: int) -> tuple[Vector, list[Vector]]:
    """Return the centres of the patches [cells], shape (n, 2), and a Gaussian window about each, (rows, columns).

    Both are half a cell right of and below the patches' middles, which changes nothing, because they agree.
    """
    across, down = PATCHES
    spread_x = columns / across * 0.5
    spread_y = rows / down * 0.5
    y, x = np.mgrid[:rows, :columns]
    centres = []
    windows = []
    for j in range(down):
        for i in range(across):
            centre_x = (i + 0.5) / across * columns
            centre_y = (j + 0.5) / down * rows
            away_x = (x - centre_x) / spread_x
            away_y = (y - centre_y) / spread_y
            centres.append((centre_x, centre_y))
            windows.append(np.exp(-0.5 * (away_x**2 + away_y**2)))
    return np.array(centres), windows


def _signed_counts_in_cells(events: Events, rows: int, columns: int) -> Vector:
    """Return the number of ON minus OFF events in cells of :data:`CELL_PX`, shape (rows, columns)."""
    row = np.minimum(events.y // CELL_PX, rows - 1).astype(np.int64)
    column = np.minimum(events.x // CELL_PX, columns - 1)
    cell = row * columns + column
    sign = 2.0 * events.p - 1.0
    counts = np.bincount(cell, weights=sign, minlength=rows * columns)
    return np.asarray(counts, np.float64).reshape(rows, columns)
