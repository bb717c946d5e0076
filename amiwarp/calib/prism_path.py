"""Path of the optic's angles over time, found in the events: without an encoder, or where it tells too little.

:class:`PathFit` corrects a first path by the brightness map that the photometric stage uses too. The correction of each
angle is a spline whose coefficients are fitted to the residuals of the events. A first path for a speed that varies
much comes from ``repetition_path.py``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.brightness.pairs import off_excess
from amiwarp.brightness.solver import BrightnessMap
from amiwarp.brightness.tiles import Tiles
from amiwarp.calib.path_splines import SAMPLE_US, knots_over, spline_matrix
from amiwarp.calib.photometric.cost import SLOPE_PX, Cost, size_and_phase_directions
from amiwarp.calib.photometric.distances import px_per_rad
from amiwarp.calib.photometric.pairs import check_pairs, collect_everywhere, fine_map_is_determined
from amiwarp.calib.thinning import middle_time
from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events.encoder import Encoder, each_encoder, together
from amiwarp.events.recording import Recording
from amiwarp.optics.models.registry import MODELS

if TYPE_CHECKING:
    from amiwarp.calib.sharpness_search import Search

Vector = NDArray[np.float64]

GATE_PAIRS = 130_000
GATE_TILES = 4
"""Approximate number of pairs of events that tell whether the speed varies, and of tiles of the map."""
PAIRS = 300_000
TILES = 8
"""The same for the path itself."""
KNOTS_PER_TURN = 8.0
"""Number of the spline's knots in a turn. They resolve ripple up to the third harmonic. Two angles share them: with as
many for each, a pair of prisms followed the noise (0.036 px instead of 0.023 px)."""
PAIRS_PER_KNOT = 100
"""Smallest mean number of pairs for each knot; with fewer pairs there are fewer knots."""
PLAIN_SCALE = 1.0
"""Scale of the Cauchy weights while the residuals may still be large [thresholds]. A smaller one would make the steps
too short."""
FIRST_STEPS = 5
MOST_STEPS = 10
"""Number of steps with this scale, and the largest number of all steps."""
TOLERANCE_PX = 0.001
"""Length of a step at which the path has converged [px rms]."""
LONGEST_EXTRAPOLATION = 3.0
"""Largest factor by which a step is extended, because the steps before shrank slowly."""
RIDGE = 1e-4
RIDGE_OF_TWO = 1e-2
"""Weight of the squares of the spline's coefficients, relative to the median weight that the events give them. Two
angles can shift the whole picture together, by turns that grow without bound where both move it the same way. With
1e-3 a pair turned by twice as much as it had hunted, with 1e-2 by 1.1 times."""
SEARCH_STEPS = 10
SEARCH_TOLERANCE = 0.03
"""Largest number of conjugate-gradient steps for the spline's coefficients, and the residual at which they end."""
MAP_STEPS = 12
"""Number of conjugate-gradient steps that find the part of a derivative that a change of the map explains."""
LEAST_DEVIATION_PX = 0.01
"""Smallest deviation from constant speed that is corrected [px rms]: half of an error that counts."""
GATE_STEPS = 2
FIRST_SHARE = 0.5
"""Number of steps that tell whether the speed varies, and the share of a deviation that the first one finds, as the map
has adapted to the constant speed."""
SIGNIFICANT = 5.0
"""Number of standard deviations above which a deviation from constant speed is significant."""
LARGEST_ERROR_PX = 0.1
"""Largest accepted error of the path [px rms]."""
SPEED_SHARE = 1.0 / 16.0
"""Part of a mean turn over which a speed is measured for the text."""
MONOTONE = 0.8
"""Smallest share of the range of the speed between the ends of the recording for it to rise or fall."""


@dataclass(frozen=True)
class _Correction:
    """Spline that corrects one of the angles, and where its coefficients are among those of all."""

    angle: int
    """Number of the angle."""
    path: Encoder
    """Path that it corrects."""
    knots: Vector
    ends: tuple[Any, Any]
    """Its splines at the first and at the second events of the pairs, sparse, shape (pairs, splines) each."""
    own: slice
    """Its coefficients."""
    px: float
    """How far events move per angle [px rms/rad]."""
    direction: NDArray[np.complex128]
    """Direction in which the first event of each pair moves with the angle, of size 1."""

    def at_first_events(self, coefficients: Vector) -> Vector:
        """Return the correction at the first event of each pair [rad], from the coefficients of all angles."""
        return np.asarray(self.ends[0] @ coefficients[self.own])


@dataclass(frozen=True)
class _Equations:
    """Linearised equations of the pairs for the coefficients of the splines, and the sizes."""

    columns: Any
    """Derivatives of the residuals by the coefficients, and by the sizes, sparse, shape (pairs, unknowns)."""
    residual: Vector
    """Residual of each pair [thresholds]; 0 off the map."""
    weight: Vector
    """Weight of each pair; 0 off the map."""
    used: int
    """Number of pairs on the map."""


class PathFit:
    """Fit of the path of each angle of the optic, and of its sizes, to pairs of events on a brightness map."""

    def __init__(
        self,
        recording: Recording,
        search: Search,
        pairs: int = PAIRS,
        tiles: int = TILES,
        angles: Sequence[int] | None = None,
        knots_per_turn: float = KNOTS_PER_TURN,
    ) -> None:
        """Collect about ``pairs`` pairs at the answer of ``search``, and solve the map.

        The encoder of ``search`` is the first path: a constant speed, or the encoder of the recording if it has one.
        The paths of ``angles`` are fitted, which are their numbers; by default those of all. They share the knots.
        Raises :class:`AmiwarpError` for too few pairs.
        """
        space = search.space
        settings = search.settings.photometric
        self._recording = recording
        self._first = search.calibration_events.encoder
        self._pairs, places = collect_everywhere(recording, search, settings, pairs, tiles)
        self._v = space.to_vector({**space.start, **search.best})
        excess = off_excess(self._pairs, with_leak=False)

        def solved_on(tiles: Tiles) -> tuple[Cost, NDArray[np.float32]]:
            brightness = BrightnessMap(
                self._pairs,
                tiles,
                off_excess=excess,
                middle_us=space.middle_us,
            )
            cost = Cost.on(brightness, space, settings.steps)
            cost.warm_up(self._v)
            return cost, brightness.coverage(cost.scale)

        self._cost, coverage = solved_on(places)
        is_fine = places.density > 1.0
        if is_fine and not fine_map_is_determined(coverage, len(self._pairs)):
            self._cost, coverage = solved_on(places.at_density(1.0))
        check_pairs(recording.name, coverage, len(self._pairs))

        # size and phase of each prism in turn
        self._along_sizes = size_and_phase_directions(space, self._v)[0::2]
        # times of the events of the pairs after the first event of the recording [us], shape (2, pairs)
        after_middle_us = self._pairs.time.astype(np.float64) * 1e6
        self._t = after_middle_us + (space.middle_us - recording.events.t_first)
        self._azimuth = self._pairs.arrays.azimuth.numpy().reshape(4, -1).copy()
        if angles is None:
            angles = range(MODELS[space.model].ANGLES)
        self._corrections = self._splines_of(angles, knots_per_turn)
        # Coefficients of the corrections that are applied [rad]
        self._found = np.zeros(self._corrections[-1].own.stop)
        # How far events move per coefficient [px rms/rad]
        self._px = np.zeros(len(self._found))
        for each in self._corrections:
            self._px[each.own] = each.px
        self.std_px = math.inf
        """Standard deviation of the paths by the scatter of the residuals [px rms]; infinite before a step."""
        # The last change of these coefficients and of the sizes [px]
        self._last: Vector | None = None

    def _splines_of(self, angles: Sequence[int], knots_per_turn: float) -> list[_Correction]:
        """Return the splines that correct some angles, given by their numbers."""
        space = self._cost.space
        values = space.to_values(self._v)
        first = self._recording.events.t_first
        last = self._recording.events.t_last
        paths = each_encoder(self._first)
        times = np.arange(0, last - first + 1, SAMPLE_US, dtype=np.int64)
        first_events = np.rint(self._t[0]).astype(np.int64) + first
        most_per_turn = knots_per_turn / len(angles)
        knots_of_angle = len(self._pairs) / len(angles) / PAIRS_PER_KNOT
        found: list[_Correction] = []
        place = 0
        for angle in angles:
            path = paths[angle]
            theta = path.angle_at(times + first)
            turns = abs(float(theta[-1] - theta[0])) / math.tau
            per_turn = min(most_per_turn, max(1.0, knots_of_angle / turns))
            knots = knots_over(times.astype(np.float64), theta, per_turn)
            at_first = spline_matrix(knots, self._t[0])
            at_second = spline_matrix(knots, self._t[1])
            own = slice(place, place + at_first.shape[1])
            place = own.stop
            _, phase = MODELS[space.model].ORBITS[angle]
            turned = path.angle_at(first_events) + values[phase]
            found.append(
                _Correction(
                    angle=angle,
                    path=path,
                    knots=knots,
                    ends=(at_first, at_second),
                    own=own,
                    px=px_per_rad(space, self._v, angle),
                    direction=1j * np.exp(1j * turned),
                )
            )
        return found

    def deviates(self, least_px: float = LEAST_DEVIATION_PX) -> bool:
        """Return whether the paths deviate significantly from the first ones, and by at least ``least_px``.

        A step is repeated only if the first one finds a notable part of the deviation.
        """
        for k in range(GATE_STEPS):
            self._improve(k)
            found_share = FIRST_SHARE if k == 0 else 1.0
            if not self.shows(found_share * least_px):
                return False
        return True

    def shows(self, least_px: float) -> bool:
        """Return whether the present paths deviate significantly, and by at least ``least_px``."""
        return self.deviation_px() >= max(least_px, SIGNIFICANT * self.std_px)

    def run(self) -> Encoder:
        """Improve the paths and the sizes until the steps are short; return the path.

        Raises :class:`AmiwarpError` if the events do not determine the path.
        """
        for k in range(MOST_STEPS):
            moved_px = self._improve(k)
            if k > FIRST_STEPS and moved_px < TOLERANCE_PX:
                break
        error_px = max(moved_px, self.std_px)
        if not error_px <= LARGEST_ERROR_PX:
            raise AmiwarpError(
                f"{self._recording.name}: the prism's speed varies, and the events determine the path of its angle to "
                f"{error_px:.2f} px only; use an encoder, let the prism turn steadily, or show a scene with more edges",
                ErrorCode.CALIBRATION_REFUSED,
            )

        paths = [*each_encoder(self._first)]
        for each in self._corrections:
            paths[each.angle] = self._corrected(each)
        return together(paths)

    def _corrected(self, each: _Correction) -> Encoder:
        """Return the path of an angle with its correction."""
        path = each.path
        t_first = self._recording.events.t_first
        t = path.t - round(path.clock_offset_us) - t_first
        spline = spline_matrix(each.knots, t.astype(np.float64))
        mean = float(np.mean(each.at_first_events(self._found)))  # part of the phase
        theta = path.angle + spline @ self._found[each.own] - mean
        if self._recording.encoder is not None:
            return replace(path, angle=theta)
        theta -= np.interp(middle_time(self._recording) - t_first, t, theta)
        return Encoder(path.t, theta)

    def _improve(self, k: int) -> float:
        """Take step number ``k``; return its length [px rms]."""
        scale = PLAIN_SCALE
        if k >= FIRST_STEPS:
            median = self._cost.brightness.residuals.median()
            scale = max(0.1, 1.5 * median)
        self._cost.set_scale(scale)
        change, sizes_px, self.std_px = self._step()
        step = np.append(change * self._px, sizes_px)
        if not np.isfinite(step).all():
            raise self._undetermined()

        # Steps that shrink slowly are extended, as if the rest of the series were taken at once.
        if self._last is not None and k not in (0, FIRST_STEPS):
            last_square = max(float(self._last @ self._last), 1e-30)
            shrunk = float(step @ self._last) / last_square
            most = 1.0 - 1.0 / LONGEST_EXTRAPOLATION
            step = step / (1.0 - min(max(shrunk, -0.5), most))
        self._last = step
        count = len(self._found)
        change = step[:count] / self._px
        self._move(change, step[count:])
        return self._motion_px(change)

    def _motion_px(self, coefficients: Vector) -> float:
        """Return how far the corrections with some coefficients move events against each other [px rms].

        What a shift of the whole picture, or constant phases and sizes, explain does not count. Two angles can turn so
        that they shift the picture.
        """
        ones = np.ones(len(self._pairs))
        explained = [ones, 1j * ones]
        moved = np.zeros(len(ones), np.complex128)
        for each in self._corrections:
            moved += each.px * each.at_first_events(coefficients) * each.direction
            explained += [each.direction, 1j * each.direction]

        # The smallest rest, as two real numbers for each pair
        columns = np.array(explained)
        products = (columns.conj() @ columns.T).real
        sums = (columns.conj() @ moved).real
        factors, *_ = np.linalg.lstsq(products, sums, rcond=1e-9)
        rest = moved - factors @ columns
        return float(np.sqrt(np.mean(np.abs(rest) ** 2)))

    def deviation_px(self) -> float:
        """Return the deviation of the present paths from constant speed, or from the encoder [px rms]."""
        if self._recording.encoder is not None:
            return self._motion_px(self._found)
        (only,) = self._corrections  # a speed is found for one angle
        times = np.rint(self._t[0]).astype(np.int64) + self._recording.events.t_first
        angle = self._first.angle_at(times) + only.at_first_events(self._found)
        t = (self._t[0] - self._t[0].mean()) * 1e-6
        constant_speed = np.polyval(np.polyfit(t, angle, 1), t)
        return only.px * float(np.std(angle - constant_speed))

    def _step(self) -> tuple[Vector, Vector, float]:
        """Return the change of the coefficients [rad] and of the sizes [px], and the paths' standard deviation [px].

        The map is eliminated: conjugate gradients use only products with the part of a column that no map explains.
        """
        from scipy.linalg import cho_factor
        from scipy.sparse import diags

        equations = self._equations()
        columns = equations.columns
        normal: Vector = (columns.T @ diags(equations.weight) @ columns).toarray()
        share = RIDGE if len(self._corrections) == 1 else RIDGE_OF_TWO
        ridge = share * float(np.median(np.diag(normal))) + 1e-12
        try:
            factor = cho_factor(normal + ridge * np.eye(len(normal)))
        except np.linalg.LinAlgError as error:  # knots without events
            raise self._undetermined() from error

        x = self._solve(equations, factor, ridge)
        of_paths = len(self._found)
        std_px = self._std_px(equations, factor)
        return x[:of_paths], x[of_paths:], std_px

    def _equations(self) -> _Equations:
        """Return the equations of the pairs for the splines' coefficients and the sizes, on the map as it is."""
        from scipy.sparse import csr_array, diags, hstack

        residuals = self._cost.brightness.residuals
        count = len(self._pairs)
        self._cost.residuals(self._v, rounds=2)
        residual = residuals.values.numpy()[:count].astype(np.float64)
        weight = residuals.weight.numpy()[:count].astype(np.float64)
        by_ends, by_sizes = self._slopes()

        # Pairs off the map count nothing.
        good = np.isfinite(residual) & np.isfinite(by_sizes).all(axis=0)
        good &= np.isfinite(by_ends).all(axis=(0, 1))
        good &= weight > 0.0
        by_sizes = np.where(good, by_sizes, 0.0)
        by_ends = np.where(good, by_ends, 0.0)

        blocks: list[Any] = []
        for each, (by_first, by_second) in zip(self._corrections, by_ends, strict=True):
            at_first, at_second = each.ends
            blocks.append(diags(by_first) @ at_first + diags(by_second) @ at_second)
        blocks.append(csr_array(by_sizes.T))
        return _Equations(
            columns=hstack(blocks).tocsr(),
            residual=np.where(good, residual, 0.0),
            weight=np.where(good, weight, 0.0),
            used=int(np.count_nonzero(good)),
        )

    def _solve(self, equations: _Equations, factor: Any, ridge: float) -> Vector:
        """Return the changes of coefficients and sizes that minimise the residuals, by conjugate gradients.

        The smallest corrections count of those that fit as well, so that steps do not add up to large ones.

        They are preconditioned by the normal equations for a fixed map, of which ``factor`` is the Cholesky factor.
        """
        from scipy.linalg import cho_solve

        columns = equations.columns
        weight = equations.weight
        self._cost.brightness.prepare_projection()
        left = -(columns.T @ (weight * self._unexplained(equations.residual)))
        left[: len(self._found)] -= ridge * self._found
        x = np.zeros(len(left))
        direction = cho_solve(factor, left)
        first_power = float(left @ direction)
        power = first_power
        for _ in range(SEARCH_STEPS):
            moved = self._unexplained(columns @ direction)
            product = columns.T @ (weight * moved) + ridge * direction
            length = power / max(float(direction @ product), 1e-30)
            x += length * direction
            left -= length * product
            preconditioned = cho_solve(factor, left)
            before = power
            power = float(left @ preconditioned)
            if not power > SEARCH_TOLERANCE**2 * first_power:
                break
            direction = preconditioned + power / before * direction
        return x

    def _unexplained(self, column: Vector) -> Vector:
        """Return the part of a column that no change of the map explains."""
        brightness = self._cost.brightness
        count = len(self._pairs)
        padded = np.zeros(self._pairs.arrays.stride, np.float32)
        padded[:count] = column
        on_device = wp.array(padded, dtype=float, device=brightness.device)
        rest = brightness.unexplained(on_device, steps=MAP_STEPS)
        of_pairs = rest.numpy()[:count].astype(np.float64)
        return np.nan_to_num(of_pairs)

    def _std_px(self, equations: _Equations, factor: Any) -> float:
        """Return the standard deviation of the paths [px rms], from the scatter of the residuals."""
        from scipy.linalg import cho_solve

        square = float(equations.weight @ equations.residual**2)
        variance = square / max(equations.used, 1)
        unknowns = equations.columns.shape[1]
        inverse = cho_solve(factor, np.eye(unknowns))
        stds_px: list[float] = []
        for each in self._corrections:
            spline, _ = each.ends
            products = (spline.T @ spline).toarray() / len(self._pairs)
            own_inverse = inverse[each.own, each.own]
            own_variance = variance * float(np.sum(own_inverse * products))
            stds_px.append(each.px * math.sqrt(own_variance))
        return math.hypot(*stds_px)

    def _undetermined(self) -> AmiwarpError:
        return AmiwarpError(
            f"{self._recording.name}: the events do not determine the path of the prism's angle at all times; use "
            "an encoder, or record a scene with more edges",
            ErrorCode.CALIBRATION_REFUSED,
        )

    def _slopes(self) -> tuple[Vector, Vector]:
        """Return the residuals' derivatives by the angles and by the sizes.

        The first have the shape (angles, 2, pairs), for the angle at each event of a pair; the second (sizes, pairs).
        """
        count = len(self._pairs)

        def on_host(column: Any) -> Vector:
            return np.asarray(column.numpy()[:count], np.float64)

        by_ends = []
        for each in self._corrections:
            first, second = self._cost.by_angle(self._v, each.angle)
            by_ends.append([on_host(first), on_host(second)])
        by_sizes = []
        for along in self._along_sizes:
            step = SLOPE_PX * along
            larger = self._cost.at(self._v + step)
            smaller = self._cost.at(self._v - step)
            slope = self._cost.brightness.find_slope(larger, smaller, 2.0 * SLOPE_PX)
            by_sizes.append(on_host(slope))
        return np.array(by_ends), np.array(by_sizes)

    def _move(self, change: Vector, sizes_px: Vector) -> None:
        """Change the coefficients [rad] and the sizes [px], and turn the angles of the pairs."""
        self._found += change
        for along, size_px in zip(self._along_sizes, sizes_px.tolist(), strict=True):
            self._v = self._v + size_px * along
        count = len(self._pairs)
        angles = MODELS[self._cost.space.model].ANGLES
        azimuth = self._azimuth.copy()
        for each in self._corrections:
            for k, spline in enumerate(each.ends):
                turn = spline @ self._found[each.own]
                if angles > 1:  # several angles are stored as they are, one as its cosine and sine
                    azimuth[angles * k + each.angle, :count] += turn
                    continue
                cosine = self._azimuth[2 * k, :count]
                sine = self._azimuth[2 * k + 1, :count]
                turned = (cosine + 1j * sine) * np.exp(1j * turn)
                azimuth[2 * k, :count] = turned.real
                azimuth[2 * k + 1, :count] = turned.imag
        self._pairs.arrays.azimuth.assign(azimuth.astype(np.float32).ravel())


def speed_in_words(path: Encoder) -> str:
    """Return how the speed of the prism changes along a path."""
    # The path goes beyond the times of the events.
    first = int(path.t[0]) + SAMPLE_US
    last = int(path.t[-1]) - 2 * SAMPLE_US
    turn_us = 60e6 / max(abs(path.rpm), 1e-6)
    piece_us = max(SPEED_SHARE * turn_us, 2.0 * SAMPLE_US)
    pieces = max(2, round((last - first) / piece_us))
    edges = np.linspace(first, last, 1 + pieces)
    angle = path.angle_at(np.rint(edges).astype(np.int64))
    rad_per_us = np.diff(angle) / np.diff(edges)
    rpm = np.abs(rad_per_us) * 60e6 / math.tau
    low = float(rpm.min())
    high = float(rpm.max())
    begin = rpm[0]
    end = rpm[-1]
    if abs(end - begin) >= MONOTONE * (high - low):
        how = "rose" if end > begin else "fell"
        return f"{how} from {begin:.0f} to {end:.0f} rpm"
    return f"varied between {low:.0f} and {high:.0f} rpm"
