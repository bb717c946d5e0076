"""First guesses from the events alone: the prism's speed, when the camera is calm, and its angular velocity."""

import math
from collections.abc import Callable
from typing import cast

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.encoder import Encoder
from amiwarp.events.recording import Events, Recording
from amiwarp.optics.camera import Camera

# Speed of the prism from the events alone: the events of a still scene repeat in every turn.

CELL = 8
"""Side of the cells in which events are counted [px]."""
BIN_US = 1000
"""Length of the time bins in which events are counted, unless another one is given [us]."""
LONGEST_US = 3_000_000
"""Longest duration from the start of the recording that is analysed [us]."""
FASTEST_BINS = 5
"""Shortest detectable period [time bins]: five bins of 1 ms are 12,000 rpm."""
MOST_BINS = 5000
"""Largest number of time bins."""
LEAST_CORRELATION = 0.1
"""Smallest autocorrelation of event counts at which the events are considered to repeat."""
UNLIKE = 0.2
"""Correlation below which the events of two angles are not alike."""
ANGLE_BINS, MOST_TURNS = 96, 24
"""Angle bins per turn and largest number of turns for the check of an encoder's scale."""


def estimate_rpm(recording: Recording, bin_us: int = BIN_US, mover: str = "prism") -> float:
    """Return the speed [1/min], without its sign, from the autocorrelation of signed event counts per cell.

    ``bin_us`` is the length of a time bin [us], a fifth of the shortest turn; ``mover`` names what turns or vibrates.
    Raises :class:`AmiwarpError` if the events do not repeat or the recording has less than two turns.
    """
    counts = signed_counts(recording, bin_us)
    if len(counts) < 2 * FASTEST_BINS:
        raise AmiwarpError(
            f"{recording.name}: the events last {len(counts) * bin_us * 1e-3:g} ms, which is too short to estimate the "
            f"{mover}'s speed; record two turns or more, or give rpm or an encoder"
        )
    # in short bins, chance is a larger share of the counts
    least = LEAST_CORRELATION * bin_us / BIN_US
    return 60e6 / (_period(autocorrelation(counts), recording.name, mover, least) * bin_us)


def encoder_turns_per_period(recording: Recording, encoder: Encoder) -> float:
    """Return the encoder turns after which the events of a still scene repeat: 1 if the encoder's scale is right.

    Raises :class:`AmiwarpError` if the events do not repeat or the recording has less than two turns.
    """
    first, last = _analysed_span(recording)
    covered = encoder.coverage
    first, last = max(first, covered[0]), min(last, covered[1])
    last = min(last, first + int(MOST_TURNS * 60e6 / max(abs(encoder.rpm), 1.0)))
    begin = float(encoder.angle_at(first))

    def bin_of(t: NDArray[np.int64]) -> NDArray[np.int64]:
        return (np.abs(encoder.angle_at(t) - begin) * (ANGLE_BINS / math.tau)).astype(np.int64)

    counts = _signed_counts(recording, first, last, bin_of)
    correlation = autocorrelation(counts)
    # if the encoder counts too much, many bins are like their neighbours: these are no period
    correlation[: int(np.argmax(correlation < UNLIKE))] = -1.0
    return _period(correlation, recording.name) / ANGLE_BINS


def signed_counts(recording: Recording, bin_us: int) -> NDArray[np.float32]:
    """Return ON minus OFF events per time bin of a length [us] and cell, shape (bins, cells)."""
    first, last = _analysed_span(recording)
    last = min(last, first + MOST_BINS * bin_us - 1)
    return _signed_counts(recording, first, last, lambda t: (t - first) // bin_us)


def _analysed_span(recording: Recording) -> tuple[int, int]:
    first = recording.events.t_first
    return first, min(recording.events.t_last, first + LONGEST_US - 1)


def _signed_counts(
    recording: Recording, first: int, last: int, bin_of: Callable[[NDArray[np.int64]], NDArray[np.int64]]
) -> NDArray[np.float32]:
    """Return ON minus OFF events between two times [us], shape (bins, cells); ``bin_of`` maps times to bins."""
    width, height = recording.events.size
    columns, rows = -(-width // CELL), -(-height // CELL)
    bins = int(bin_of(np.array([last]))[0]) + 1
    counts = np.zeros(bins * rows * columns, dtype=np.float32)
    for start in range(first, last + 1, 100 * BIN_US):
        e = recording.events.between(start, min(start + 100 * BIN_US, last + 1))
        cell = (e.y // CELL).astype(np.int64) * columns + e.x // CELL
        # if the prism turns back, events may map beyond the last bin
        flat = np.minimum(bin_of(e.t), bins - 1) * (rows * columns) + cell
        counts += np.bincount(flat, weights=2.0 * e.p - 1.0, minlength=len(counts)).astype(np.float32)
    return counts.reshape(bins, rows * columns)


def autocorrelation(counts: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return the unbiased autocorrelation of event counts, summed over cells.

    It is 1 at lag 0; the lags reach 3/4 of the duration.
    """
    n = len(counts)
    power = np.zeros(n + 1)
    for part in np.array_split(counts - counts.mean(axis=0), max(1, counts.shape[1] // 512), axis=1):
        power += (np.abs(np.fft.rfft(part, 2 * n, axis=0)) ** 2).sum(axis=1)
    raw = np.fft.irfft(power)[: max(2, 3 * n // 4)]
    unbiased = raw / (n - np.arange(len(raw)))
    return cast("NDArray[np.float64]", unbiased / max(unbiased[0], 1e-30))


def _period(
    correlation: NDArray[np.float64], name: str, mover: str = "prism", least: float = LEAST_CORRELATION
) -> float:
    """Return the period of a correlation [bins]: its first strong peak, refined at multiples of the period."""
    period = _first_period(correlation, name, mover, least)
    multiple = 1
    while 2 * multiple * period < 0.6 * len(correlation):
        multiple *= 2
        period = _peak_near(correlation, multiple * period, 0.1 * period) / multiple
    return period


def _first_period(correlation: NDArray[np.float64], name: str, mover: str, least: float) -> float:
    inner = correlation[1:-1]
    peaks = 1 + np.flatnonzero((inner > correlation[:-2]) & (inner >= correlation[2:]))
    peaks = peaks[peaks >= FASTEST_BINS]
    if not len(peaks) or correlation[peaks].max() < least:
        raise AmiwarpError(
            f"{name}: the events do not repeat, so the {mover}'s speed cannot be estimated (the scene moves, or the "
            "recording has less than two turns); give rpm or an encoder"
        )
    first = peaks[correlation[peaks] >= 0.7 * correlation[peaks].max()][0]
    return _peak_near(correlation, float(first), 1.0)


def _peak_near(correlation: NDArray[np.float64], lag: float, reach: float) -> float:
    """Return the lag of the largest correlation within ``reach`` bins of ``lag``, refined by a parabola.

    The top of a parabola through a peak is within half a bin; at the end of the range there may be no peak.
    """
    low = max(1, int(np.floor(lag - reach)))
    high = min(len(correlation) - 2, int(np.ceil(lag + reach)))
    k = low + int(np.argmax(correlation[low : high + 1]))
    before, here, after = correlation[k - 1 : k + 2]
    bend = before - 2.0 * here + after
    return float(k + np.clip(0.5 * (before - after) / bend, -0.5, 0.5) if bend < 0.0 else k)


# Time at which the camera is calmest: there the events of one turn repeat those of the turn before.

CALM_TURNS = 2.15
"""Length of a calm span [turns]: a little more than a camera's rotation is calibrated from."""
LEAST_REPETITION = 0.5
"""Smallest correlation of the events of successive turns in a calm span. A still camera's is 0.9, and that of a scene
that moves by a cell in a turn is near 0."""
LEAST_CALM = 0.7
"""Correlation below which the camera may be in fast motion even in the calmest span: it is that of a calm hand."""
MOST_CALM_TURNS = 96
"""Largest number of turns that are examined, which limits the memory."""
LESS_CALM = 0.75
"""Largest correlation in the middle of a recording for which a calmer span replaces it, as a share of the span's. In a
hand it was 0.91 at least."""


def calmest_span(recording: Recording, encoder: Encoder) -> tuple[float, tuple[int, int] | None]:
    """Return how well the events of successive turns repeat where the camera moves least, and that time span [us].

    The first is their correlation. The span is None if the camera does not become clearly calmer than in the middle of
    the recording. Of a long recording :data:`LONGEST_US` about its middle are
    examined, and at most :data:`MOST_CALM_TURNS`.
    """
    covered = encoder.coverage
    first, last = max(recording.events.t_first, covered[0]), min(recording.events.t_last, covered[1])
    middle, longest = (first + last) // 2, min(LONGEST_US, int(MOST_CALM_TURNS * 60e6 / max(abs(encoder.rpm), 1.0)))
    first, last = max(first, middle - longest // 2), min(last, middle + longest // 2)
    at = np.linspace(first, last, max(2, (last - first) // BIN_US)).astype(np.int64)
    begin = float(encoder.angle_at(first))

    def turned(t: NDArray[np.int64]) -> NDArray[np.float64]:
        return np.asarray(np.abs(encoder.angle_at(t) - begin) * (ANGLE_RANGES / math.tau))

    counts = _signed_counts(recording, first, last, lambda t: turned(t).astype(np.int64))
    counts -= counts.mean(axis=0)
    pairs, span = round((CALM_TURNS - 1.0) * ANGLE_RANGES), round(CALM_TURNS * ANGLE_RANGES)
    if len(counts) <= span:
        return 1.0, None

    def over_span(a: NDArray[np.float32], b: NDArray[np.float32]) -> NDArray[np.float64]:
        """Return the sums of products over ``pairs`` bins, from each bin on."""
        total = np.concatenate([[0.0], np.cumsum(np.einsum("ij,ij->i", a, b), dtype=np.float64)])
        return np.asarray(total[pairs:] - total[:-pairs])

    here, later = counts[:-ANGLE_RANGES], counts[ANGLE_RANGES:]
    energy = np.sqrt(over_span(here, here) * over_span(later, later))
    repetition = over_span(here, later) / np.maximum(energy, 1e-30)
    best, bins = int(np.argmax(repetition)), np.maximum.accumulate(turned(at))
    in_middle = repetition[min(len(repetition) - 1, max(0, int(np.interp(middle, at, bins)) - span // 2))]
    most = float(repetition[best])
    if most < LEAST_REPETITION or in_middle > LESS_CALM * most:
        return most, None
    start, stop = np.interp([best, best + span], bins, at)
    return most, (int(start), int(stop))


# Estimate of the camera's angular velocity from events that are one turn of the prism apart.
#
# Events of one range of prism angles form the same image in two successive turns, displaced by the camera's rotation
# alone. Such images of many angle ranges are cross-correlated patch by patch. The angular velocity is fitted to the
# displacements of the patches.

ANGLE_RANGES = 24
"""Number of ranges of prism angles per turn."""
PATCHES = (6, 5)
"""Number of image patches along x and y."""
SMOOTHING_PX = 2.0
"""Standard deviation of the Gaussian that smooths the correlations [px]."""
PEAKS = 3
"""Number of correlation peaks examined per image patch."""
STARTS = 12
"""Number of candidate angular velocities from which the estimate is refined."""
ROLLS = tuple(range(-60, 61, 12))
"""Rotations about the optical axis that are combined with each correlation peak [1/focal length per turn]."""


def estimate_rates(events: Events, encoder: Encoder, camera: Camera) -> tuple[float, float, float]:
    """Return the camera's mean angular velocity [rad/s] from about two turns of events.

    The result is zero for less than 1.25 turns.
    """
    from scipy.ndimage import map_coordinates
    from scipy.optimize import minimize
    from scipy.spatial.transform import Rotation

    angle = encoder.angle_at(events.t)
    direction = math.copysign(1.0, float(angle[-1] - angle[0]))
    turned = direction * (angle - angle[0])
    if turned[-1] < 1.25 * math.tau:
        return 0.0, 0.0, 0.0
    seconds = math.tau / (float(turned[-1]) / ((int(events.t[-1]) - int(events.t[0])) * 1e-6))
    bins = (turned % math.tau * (ANGLE_RANGES / math.tau)).astype(np.int64)
    turn = np.minimum((turned / math.tau).astype(np.int64), 2)
    at, surfaces = correlations(events, bins, turn, camera)
    rays = np.asarray(camera.pixels_to_rays(at.astype(np.float32)), np.float64)

    patch = np.arange(len(at))

    def agreement(rates: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the sum of the patches' correlations for each of the angular velocities (n, 3)."""
        # a static point moves against the camera's rotation
        turned_rays = Rotation.from_rotvec(-rates * seconds).as_matrix()[:, None] @ rays[:, :, None]
        pixels = camera.rays_to_pixels(turned_rays.reshape(-1, 3).astype(np.float32))
        cells = (np.asarray(pixels, np.float64).reshape(len(rates), len(at), 2) - at) / 2.0
        inside = (np.abs(cells) <= max(surfaces.shape[1:]) / 2).all(axis=(1, 2))
        where = np.where(inside[:, None, None], cells, 0.0)
        values = map_coordinates(
            surfaces, [np.broadcast_to(patch, where.shape[:2]), where[..., 1], where[..., 0]], order=1, mode="grid-wrap"
        )
        return np.where(inside, values.sum(axis=1), 0.0)

    unit = 1.0 / (camera.fx * seconds)  # moves the image by about one pixel per turn
    candidates = np.array(hypotheses(surfaces, unit))
    starts = candidates[np.argsort(agreement(candidates), kind="stable")[-STARTS:]]
    simplex = 4.0 * unit * np.vstack([np.zeros(3), np.eye(3)])

    def cost(rate: NDArray[np.float64]) -> float:
        return -float(agreement(rate[None])[0])

    runs = [minimize(cost, s, method="Nelder-Mead", options={"initial_simplex": s + simplex}) for s in starts]
    x, y, z = min(runs, key=lambda run: float(run.fun)).x.tolist()
    return x, y, z


def hypotheses(surfaces: NDArray[np.float64], unit: float) -> list[tuple[float, float, float]]:
    """Return candidate angular velocities [rad/s]: each patch's correlation peaks, combined with several rolls."""
    found = []
    for surface in [surfaces.sum(axis=0), *surfaces]:
        for _ in range(PEAKS):
            row, column = np.unravel_index(int(surface.argmax()), surface.shape)
            x, y = (
                2.0 * (n - size if n > size / 2 else n)
                for n, size in zip((column, row), surface.shape[::-1], strict=True)
            )
            # a rotation about x moves the image along y, one about y along -x
            found += [(y * unit, -x * unit, roll * unit) for roll in ROLLS]
            surface = surface.copy()
            around = [(np.arange(-4, 5) + k) % n for k, n in zip((row, column), surface.shape, strict=True)]
            surface[np.ix_(*around)] = 0.0
    return found


def correlations(
    events: Events, bins: NDArray[np.int64], turn: NDArray[np.int64], camera: Camera
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the centres of the patches [px] and the cross-correlation of successive turns in each patch.

    The centres have shape (patches, 2). The correlations have shape (patches, rows, columns), cells of 2 px of
    displacement, periodic borders and values from 0 to 1.
    """
    half = (camera.height // 2, camera.width // 2)
    size = tuple(2 ** math.ceil(math.log2(1.5 * n)) for n in half)
    centres = [((i + 0.5) / PATCHES[0] * half[1], (j + 0.5) / PATCHES[1] * half[0]) for j in range(PATCHES[1])
               for i in range(PATCHES[0])]  # fmt: skip
    y, x = np.mgrid[: half[0], : half[1]]
    spread = (half[1] / PATCHES[0] * 0.5, half[0] / PATCHES[1] * 0.5)
    windows = [np.exp(-0.5 * (((x - cx) / spread[0]) ** 2 + ((y - cy) / spread[1]) ** 2)) for cx, cy in centres]
    total = [np.zeros((size[0], size[1] // 2 + 1), np.complex128) for _ in centres]
    for b in range(ANGLE_RANGES):
        before, after = (
            _signed_counts_of_pairs(events[np.flatnonzero((bins == b) & (turn == k))], half) for k in (0, 1)
        )
        spectrum = np.fft.rfft2(after, size)
        for k, window in enumerate(windows):
            total[k] += np.conj(np.fft.rfft2(before * window, size)) * spectrum
    from scipy.ndimage import gaussian_filter

    surfaces = np.array([gaussian_filter(np.fft.irfft2(each, size), SMOOTHING_PX / 2.0, mode="wrap") for each in total])
    high = np.maximum(surfaces.max(axis=(1, 2), keepdims=True), 1e-12)
    return 2.0 * np.array(centres) + 0.5, np.maximum(surfaces, 0.0) / high


def _signed_counts_of_pairs(events: Events, half: tuple[int, int]) -> NDArray[np.float64]:
    """Return the number of ON minus OFF events in cells of 2 × 2 px."""
    cell = np.minimum(events.y // 2, half[0] - 1).astype(np.int64) * half[1] + np.minimum(events.x // 2, half[1] - 1)
    counts = np.bincount(cell, weights=2.0 * events.p - 1.0, minlength=half[0] * half[1])
    return np.asarray(counts, np.float64).reshape(half)
