"""Check that the answer of the photometric stage holds everywhere in the image, over time, and for all kinds of pairs.

A wrong answer can leave a small residual, because a wrong camera is mostly absorbed by the size of the orbit. But then
the size that fits differs from place to place. The check linearises the problem at the answer and asks how much of the
residual each of a few likely causes would remove, were it free.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.calib.parameters import DRIFTS, RATES, ParameterSpace, orbit_names, phase_names
from amiwarp.calib.photometric.causes import (
    ASPECT,
    CAUSES,
    CENTER,
    FACES,
    FLAT_SIDE,
    GATED,
    INDEX,
    SCREENED,
    SEAT,
    SHAPES,
    SIDE,
    Cause,
    other_side,
    turned,
    with_cause,
)
from amiwarp.calib.photometric.cost import place_arguments, size_and_phase_directions
from amiwarp.errors import AmiwarpError
from amiwarp.kernels.equations import by_shift, multiply
from amiwarp.kernels.launch import launch
from amiwarp.optics.camera import LENS, Camera, CameraRotation, given_lens
from amiwarp.optics.models import MODELS, Model, compensate_by_each, predicted_error, rms
from amiwarp.optics.prism import as_wedge

if TYPE_CHECKING:
    from amiwarp.calib.photometric.cost import Cost

    Vector = NDArray[np.float64]


HARMONICS = ("cos 1", "sin 1", "cos 2", "sin 2")
"""Names of the unknown factors of cos e, sin e, cos 2e and sin 2e in the error of the encoder's angle e."""
SKEW = ("skew x", "skew y")
"""Names of the unknown changes of the prism's angle from column to column and from row to row [rad/px]."""
PATTERNS = (*HARMONICS, *SKEW)
"""Names of all errors of the prism's angle that are examined, in the order of ``PairSet.angle_patterns``."""
SHAKE = ("shake x cos", "shake x sin", "shake y cos", "shake y sin")
"""Names of the unknown amplitudes of a rotation of the camera about x and y that repeats every turn [px]."""


# Linearised fits about the photometric stage's answer: what would change if one more parameter were free.
#
# Near the answer the residuals are linear in the parameters. With the brightness map eliminated, a fit of any few of
# them is then a small linear problem. Its sums are kept for each square of pixels, whose scatter gives standard
# deviations.

SQUARE_PX = 16
"""Side of the squares of pixels over which sums are kept [px]. Pairs of one square are correlated."""
MAP_STEPS = 12
"""Number of conjugate-gradient steps that find the part of a derivative that a change of the map explains."""


@dataclass(frozen=True)
class Estimate:
    """Change of some parameters by a linearised fit, with its covariance."""

    change: Vector
    """Change of the parameters, shape (n,)."""
    gain: float
    """Share of the sum of squared weighted residuals that the change removes."""
    inverse: Vector
    """Inverse of the sum of the Hessians, shape (n, n)."""
    parts: Callable[[], Vector]
    """Function that returns the gradient of each square after the change, shape (squares, n)."""

    @cached_property
    def covariance(self) -> Vector:
        """Covariance of the change by the sandwich estimate, shape (n, n)."""
        parts = self.parts()
        spare = len(parts) / max(1, len(parts) - len(self.change))
        return np.asarray(self.inverse @ (parts.T @ parts) @ self.inverse * spare)

    def significance(self, first: int) -> float:
        """Return how many standard deviations the parameters from number ``first`` on are away from 0."""
        x = self.change[first:]
        return math.sqrt(max(0.0, float(x @ np.linalg.lstsq(self.covariance[first:, first:], x, rcond=1e-15)[0])))


@dataclass(frozen=True)
class LinearFit:
    """Normal equations of the linearised problem for each square of pixels."""

    names: tuple[str, ...]
    """Names of the columns: the free parameters first, then other unknowns."""
    hessian: Vector
    """Products of the columns, shape (squares, columns, columns)."""
    gradient: Vector
    """Products of the columns with the residuals, shape (squares, columns)."""
    xy: Vector
    """Middle of each square [px], shape (squares, 2)."""
    squares_sum: float
    """Sum of the squared weighted residuals [thresholds²]."""
    _known: dict[tuple[str, ...], Estimate] = field(default_factory=dict, repr=False, init=False)
    """Fits in all squares, by the names of their columns."""

    def fit(self, names: tuple[str, ...], where: NDArray[np.bool_] | None = None) -> Estimate:
        """Return the changes of the columns ``names`` that minimise the residuals, in the squares ``where`` or in all.

        The other columns are fixed.
        """
        if where is not None:
            return self._fit(names, where)
        if names not in self._known:
            self._known[names] = self._fit(names, None)
        return self._known[names]

    def _fit(self, names: tuple[str, ...], where: NDArray[np.bool_] | None) -> Estimate:
        k = [self.names.index(n) for n in names]
        hessian, gradient = self._total if where is None else self._sums(where)
        hessian, gradient = hessian[np.ix_(k, k)], gradient[k]
        scale = np.sqrt(np.maximum(np.diag(hessian), 1e-30))
        scales = np.outer(scale, scale)
        inverse = _pseudo_inverse(hessian / scales) / scales
        change = -inverse @ gradient
        gain = float(change @ hessian @ change) / max(self.squares_sum, 1e-30)

        def parts() -> Vector:
            all_changes, rows = np.zeros(len(self.names)), slice(None) if where is None else where
            all_changes[k] = change
            return np.asarray((self.gradient[rows] + self.hessian[rows] @ all_changes)[:, k])

        return Estimate(change, gain, inverse, parts)

    @cached_property
    def _total(self) -> tuple[Vector, Vector]:
        """Sums over all squares."""
        return self._sums(slice(None))

    def _sums(self, where: NDArray[np.bool_] | slice) -> tuple[Vector, Vector]:
        """Return the sums of the Hessians and of the gradients over some of the squares."""
        return self.hessian[where].sum(axis=0), self.gradient[where].sum(axis=0)

    def adding(self, names: tuple[str, ...], more: tuple[str, ...]) -> tuple[Estimate, float, float]:
        """Return the fit of the columns ``names`` and ``more``, and what ``more`` contributes.

        That is how many standard deviations they are away from 0, and the share of the sum of squares that they remove.
        """
        estimate = self.fit((*names, *more))
        return estimate, estimate.significance(len(names)), estimate.gain - self.fit(names).gain


def _pseudo_inverse(matrix: Vector) -> Vector:
    """Return the pseudo-inverse of a symmetric, positive semidefinite matrix, faster than ``numpy.linalg.pinv``.

    Eigenvalues below a millionth of the largest count as 0.
    """
    values, vectors = np.linalg.eigh(matrix)
    large = values > 1e-6 * values[-1]
    return np.asarray(vectors[:, large] / values[large] @ vectors[:, large].T)


def linear_fit(cost: Cost, columns: dict[str, Any]) -> LinearFit:
    """Return the linearised problem of ``columns``, derivatives of the residuals on the device, by name.

    The map must have been solved at the answer.
    """
    b = cost.brightness
    b.prepare_projection()
    for name, column in columns.items():
        known, left = cost.columns.get(name, (None, None))
        if left is None or known is not column:
            cost.columns[name] = column, cost.unexplained(column, steps=MAP_STEPS)
    left = [cost.columns[name][1] for name in columns]
    next(cost.meanwhile, None)
    sums, squares, width = _products_by_square(cost, left)
    xy = np.stack([squares % width, squares // width], axis=1).astype(np.float64)
    return LinearFit(
        tuple(columns), sums[:, :-1, :-1], sums[:, :-1, -1], (xy + 0.5) * SQUARE_PX, float(sums[:, -1, -1].sum())
    )


def _products_by_square(cost: Cost, columns: list[Any]) -> tuple[Vector, NDArray[np.int64], int]:
    """Return the products of the columns and, as the last one, the residuals, shape (squares, n + 1, n + 1).

    Also return the numbers of the squares that hold pairs, row by row, and how many a row has.
    """
    b, camera = cost.brightness, cost.space.camera
    width, height = (-(-side // SQUARE_PX) for side in (camera.width, camera.height))
    return *b.residuals.products_by_square([*columns, b.residuals.values], SQUARE_PX, width, height), width


GATE = 1.0
"""How many standard deviations more than by chance a group of unknowns must be away from 0 to be examined."""
GATE_SHARE = 0.15
"""Share of the gain asked of a group of unknowns that it must have already while the map is fixed. It has 0.2 to 0.6 of
the gain with the map's change where it is wrong."""


def telling(cost: Cost, groups: list[dict[str, Any]], least_gain: float) -> list[dict[str, Any]]:
    """Return those groups of derivatives of the residuals that may remove the share ``least_gain`` of their squares.

    The map has been solved, so that the residuals are nearly orthogonal to what a change of the map explains. So the
    gradient needs no projection, which takes most of the time of a :func:`linear_fit`.
    """
    columns = {name: column for group in groups for name, column in group.items()}
    if not columns:
        return []
    sums, names = _products_by_square(cost, [*columns.values()])[0], [*columns]
    total = sums.sum(axis=0)

    def square(matrix: Vector, vector: Vector) -> float:
        return max(0.0, float(vector @ np.linalg.lstsq(matrix, vector, rcond=1e-12)[0]))

    def may(group: dict[str, Any]) -> bool:
        k = [names.index(name) for name in group]
        each, gradient = sums[:, k, -1], total[k, -1]
        away = math.sqrt(square(each.T @ each, gradient))
        gain = square(total[np.ix_(k, k)], gradient) / max(float(total[-1, -1]), 1e-30)
        return away > math.sqrt(len(group)) + GATE and gain >= GATE_SHARE * least_gain

    return [group for group in groups if group and may(group)]


def masked(column: Any, factor: Any) -> Any:
    """Return a derivative times a factor for each pair, all on the device."""
    out = wp.empty_like(column)
    launch(multiply, len(column), [column, factor], [out], device=column.device)
    return out


SLOPE_PX = 0.02
"""Step of the finite differences that give the derivatives of the residuals [px]."""
SIGNIFICANT = 5.0
"""Number of standard deviations from which on a cause is significant."""
LEAST_GAIN = 0.002
"""Smallest share of the squared residuals that a cause must remove. Right answers leave 0.001 at most."""
LEAST_ANGLE_GAIN = 0.01
"""Smallest share that an error of the prism's angle must remove. Right angles leave 0.003 at most."""
FIRST_LOOK = 0.5
"""Share of what is asked of an error of the angle that it must have before all that may look like it is examined."""
SHAKE_SHARE = 0.75
"""A shake counts if it explains this share of what all causes together explain, with fewer unknowns. Eight wrong lenses
left 0.02 to 0.62 of it, shakes by 30 % of the prism's motion 0.84 to 1.7."""
LEAST_SHAKE_GAIN = 0.0025
"""Smallest share of the squared residuals that a shake must explain beyond all causes together. An index that is wrong
by 0.06 left 0.0013 to it at most while no cause freed it, shakes by 30 % of the prism's motion 0.0048 or more."""
LEAST_FURTHER_GAIN = 0.0005
"""Smallest share that a further cause must remove once the given lens has turned out to be wrong."""
LEAST_MOVE_PX = 0.005
"""Smallest change of the model for which a cause is reported [px rms over the image and a turn]."""
NOTABLE_PX = 0.025
"""Smallest drift, or spread over the image, of the orbit's size and phase that is reported [px]."""
GAP_SHARE, LEAST_STD_PX = 0.5, 0.002
"""Systematic standard deviation of the answer: a share of the difference between the answers of pairs with long and
with short gaps, and a least value [px]. Measured on recordings with known truth."""
MAP_ERROR = {"size": 0.008, "phase": 0.03}
"""Standard deviation of the errors of brightness that all pairs share because the map is interpolated linearly between
nodes [thresholds], as far as they change size and phase. It holds for nodes 1 px apart, and grows with the square of
their distance. Edges in a map are too soft, so that an ON event and the OFF event after it seem further apart: 68 of 73
phases came out too large, by 0.017 thresholds in the median for nodes 1 px apart, and by 0.036 at most in 95 %."""
LENS_DOUBT = 0.01
"""Standard deviation of a given lens: what moves points at the border of the image by this share of their distance from
its middle. Focusing from far to 100 focal lengths changes a focal length by as much."""
DOUBT = 2.0
"""Factor of the standard deviation that a doubtful lens adds: a linearised fit finds too small changes."""
ROWS, COLUMNS, TURN = 7, 9, 12
"""Numbers of rows and columns of pixels, and of angles of a turn, on which displacements are compared."""
FOLLOW_PX = 0.05
"""Step of the parameters for that comparison [px]."""
REGIONS = (3, 2)
"""Number of columns and rows of the parts of the image whose answers are compared."""
FEWEST_SQUARES = 4
"""Smallest number of squares of pixels with events for a part of the image to be compared."""
TELLING = 3.0
"""Number of standard deviations between the two sides of the prism from which on the events tell them apart."""


@dataclass(frozen=True)
class Finding:
    """A cause for which the answer does not hold everywhere."""

    cause: Cause
    moved_px: float
    """Change of the model over the image and a turn if the cause is corrected, constant lag removed [px rms]."""
    gain: float
    """Share of the squared residuals that the correction removes."""
    significance: float
    """Distance of the correction from none [standard deviations]."""
    start: Vector
    """Corrected search vector in the space of :func:`with_cause` [px]."""


@dataclass(frozen=True)
class Consistency:
    """Result of the check."""

    step: Vector
    """Remaining Gauss-Newton step of the free parameters [px], shape (n,)."""
    systematic: Vector
    """Covariance of the errors that do not scatter from place to place [px²], shape (n, n)."""
    findings: tuple[Finding, ...]
    """Causes that are significant, the likeliest first."""
    drift: tuple[float, float]
    """Change of the orbit's size and phase over the recording [px rms]; 0 if not significant."""
    spread: tuple[float, float]
    """Standard deviation of the orbit's size and phase between parts of the image, beyond their scatter [px]."""
    rotation_gain: float
    """Share of the squared residuals that a slow rotation of the camera would remove; 0 if it is not significant."""
    untold_px: float
    """Error if the other side of the prism is the flat one [px rms], if the events do not tell which it is; else 0."""
    center_px: tuple[float, float] | None = None
    """Correction of the principal point, and its standard deviation, as displacements of events [px rms]; None if it is
    free or cannot be tested."""
    shake_px: float = 0.0
    """Least amplitude of a rotation of the camera that repeats every turn [px], if the camera seems to shake so; else
    0."""

    def inconsistent_px(self) -> float:
        """Return the largest error that the check found [px].

        A phase that drifts or differs from place to place blurs the image, but its mean is right.
        """
        return max([f.moved_px for f in self.findings[:1]] + [abs(self.drift[0]), self.spread[0]])

    def likeliest(self) -> str:
        """Return the likeliest cause of an inconsistency, in words."""
        if self.findings:
            return f"{self.findings[0].cause.words} is wrong"
        if abs(self.drift[0]) >= max(self.spread):
            return "the camera or the scene moved"
        if self.spread[1] > self.spread[0]:
            return "the pixels are slow where it is dark, or the clock or the encoder is wrong"
        return "the lens is wrong, near things moved past the camera, or events were lost"

    def warnings(self) -> list[str]:
        """Return a sentence for each inconsistency that a user should know of."""
        out = []
        if self.findings:
            f = self.findings[0]
            out.append(
                f"the answer does not hold everywhere in the image: {f.cause.words} seems to be wrong, which amounts "
                f"to {f.moved_px:.2f} px rms"
            )
        elif max(self.spread) >= NOTABLE_PX:
            what = "phase" if self.spread[1] > self.spread[0] else "size"
            out.append(
                f"the {what} of the orbit differs by {max(self.spread):.2f} px between parts of the image: "
                f"{self.likeliest()}"
            )
        if max(abs(d) for d in self.drift) >= NOTABLE_PX:
            what = "phase" if abs(self.drift[1]) > abs(self.drift[0]) else "size"
            out.append(
                f"the {what} of the orbit drifts over the recording by {max(abs(d) for d in self.drift):.2f} px rms: "
                "the scale or the clock of the encoder is wrong, or the camera moved"
            )
        if self.untold_px:
            out.append(
                "the events do not tell which side of the prism is flat; if the given one is wrong, the error is "
                f"{self.untold_px:.2f} px rms"
            )
        return out


def check_consistency(cost: Cost, best: Vector) -> Consistency:
    """Check the answer ``best`` [px]. The map must be solved there; it is not changed."""
    space = cost.space
    columns, causes = _columns(cost, best), testable(space)
    doubtful = bool(set(LENS) & set(space.names))
    screened = causes if doubtful else [c for c in causes if c in SCREENED]
    for cause in screened:
        if cause not in GATED:
            columns |= _cause_columns(cost, best, cause)
    # wobble and index look like cylinder power: where the first look finds none of that, it finds none of them
    alike = [c for c in screened if c in (INDEX, SEAT)] if FACES in screened else []
    gates = [c for c in screened if c in GATED and c not in alike]
    least_gain = LEAST_FURTHER_GAIN if doubtful else LEAST_GAIN
    gated = [_rotation_columns(cost, best), *(_cause_columns(cost, best, cause) for cause in gates)]
    for group in telling(cost, gated, least_gain):
        columns |= group
    for cause in alike if set(FACES.names) <= columns.keys() else ():
        columns |= _cause_columns(cost, best, cause)
    fit, shake_px = linear_fit(cost, columns), 0.0
    findings = _findings(cost, best, fit, screened, least_gain)
    if findings and not doubtful:
        for cause in causes:
            if cause not in SCREENED:
                columns |= _cause_columns(cost, best, cause)
        columns |= _shake_columns(cost, best)
        fit = linear_fit(cost, columns)
        findings = _findings(cost, best, fit, causes, LEAST_GAIN)
        shake_px = _shake(space, fit)
    brightness = cost.brightness
    systematic = _systematic(space, fit) + map_errors(space, best, fit, brightness.count, brightness.tiles.density)
    systematic += lens_errors(space, best, fit, least_gain) + (_doubt(space, fit, causes) if doubtful else 0.0)
    return Consistency(
        step=fit.fit(space.names).change, systematic=systematic, findings=tuple(findings),
        drift=_drift(space, best, fit), spread=_spread(space, best, fit),
        rotation_gain=_rotation_gain(space, fit), untold_px=_untold(space, best, fit),
        center_px=_center(space, best, fit), shake_px=shake_px,
    )  # fmt: skip


def _columns(cost: Cost, best: Vector) -> dict[str, Any]:
    """Return the derivatives of the residuals by the free parameters, and those of some pairs by size and phase.

    ``long …`` are the derivatives of pairs with long gaps only; ``late …`` grow with the time of the pair.
    """
    space, pairs = cost.space, cost.brightness.pairs
    columns = slopes(cost, space, best, space.names)
    late, long = pairs.split_by_time()
    for name in _path(space):
        columns[f"long {name}"] = masked(columns[name], long)
    for name in _orbit(space):
        if not (set(DRIFTS) & set(space.names) or space.moving):
            columns[f"late {name}"] = masked(columns[name], late)
    return columns


def _orbit(space: ParameterSpace) -> list[str]:
    """Return the names of the free ones of size and phase, of each prism."""
    return [n for n in space.names if n in orbit_names(MODELS[space.model])]


def _path(space: ParameterSpace) -> list[str]:
    """Return the names of the free parameters that shape the path of the image: those of :func:`_orbit` for glass."""
    kind = MODELS[space.model]
    return _orbit(space) if kind.PRISM else [n for n in space.names if n in kind.FREE]


def _systematic(space: ParameterSpace, fit: LinearFit) -> Vector:
    """Return the covariance of errors that pairs with long and with short gaps do not share [px²]."""
    names = _path(space)
    which = [space.names.index(n) for n in names]
    change = np.zeros(len(space.names))
    change[which] = fit.fit((*space.names, *(f"long {n}" for n in names))).change[len(space.names) :]
    least = np.zeros(len(change))
    least[which] = LEAST_STD_PX**2
    return np.asarray(GAP_SHARE**2 * np.outer(change, change) + np.diag(least))


def map_errors(space: ParameterSpace, best: Vector, fit: LinearFit, pairs: int, density: float) -> Vector:
    """Return the covariance of errors that the map's interpolation between nodes causes [px²].

    An error of brightness that all pairs share moves the answer by at most its size times the root of their number, in
    standard deviations for independent errors of one threshold.
    """
    others = [n for n in _path(space) if n not in _orbit(space)]
    units = [np.eye(len(best))[space.names.index(n)] for n in others]
    along = np.array([*size_and_phase_directions(space, best), *units]).reshape(-1, len(best))
    names = (*_orbit(space), *others)
    error = np.array([MAP_ERROR["phase" if n in phase_names() else "size"] / density**2 for n in names])
    variances = error**2 * pairs * np.einsum("ki,ij,kj->k", along, fit.fit(space.names).inverse, along)
    return np.asarray(along.T * variances @ along)


def lens_errors(space: ParameterSpace, best: Vector, fit: LinearFit, least_gain: float) -> Vector:
    """Return the covariance of size and phase [px²] by errors of the given lens that the check cannot see.

    The events tell the displacements. Which apex these mean depends on the lens. Its errors are those of
    :data:`LENS_DOUBT`, up to the size that would be found.
    """
    n, camera, values = len(best), space.camera, space.to_values(best)
    covariance, names = np.zeros((n, n)), [name for name in LENS if name not in space.names]
    if space.model != "exact" or not space.cartesian or not names:
        return covariance
    scale = {"focal_length": camera.fx, "k1": (2.0 * camera.fx / camera.width) ** 2, "fy_over_fx": 1.0}
    given = {**given_lens(camera), **values}
    doubts = [{**values, name: given[name] + LENS_DOUBT * scale.get(name, 0.5 * camera.width)} for name in names]
    steps = [space.to_values(best + FOLLOW_PX * unit) for unit in np.eye(n)]
    at, *ends = displacements([space.build(each) for each in (values, *steps, *doubts)])
    moved = np.stack(ends, axis=1) - at[:, None]
    moved = moved[np.isfinite(moved).all(axis=1)]
    unseen = np.full(len(names), math.inf)  # largest error that the check would not find, in those of the lens
    for k, name in enumerate(names):
        if name in fit.names:
            found = least_gain * fit.squares_sum * float(fit.fit((*space.names, name)).inverse[-1, -1])
            unseen[k] = DOUBT * math.sqrt(found) / max(rms(moved[:, n + k].reshape(-1, 2)), 1e-9)
    # a lens parameter that was not tested looks like a wrong scale
    if names[0] == "focal_length":
        unseen[np.isinf(unseen)] = unseen[0]
    lens = moved[:, n:] * np.minimum(unseen, 1.0)
    follows = FOLLOW_PX * np.linalg.lstsq(moved[:, :n], lens, rcond=None)[0]
    which = [space.names.index(name) for name in _orbit(space)]
    covariance[np.ix_(which, which)] = follows[which] @ follows[which].T
    return covariance


def over_a_turn(models: Sequence[Model], xy: NDArray[Any]) -> Vector:
    """Return where each of several models of one image moves pixels, shape (n, 2), over a turn [px].

    The result has the shape (models, n, TURN, 2).
    """
    theta = np.linspace(0.0, math.tau, TURN, endpoint=False)
    points, angles = np.repeat(xy, TURN, axis=0).astype(np.float32), np.tile(theta, len(xy))
    return np.asarray(compensate_by_each(models, points, angles).reshape(len(models), len(xy), TURN, 2))


def displacements(models: Sequence[Model], xy: NDArray[Any] | None = None) -> Vector:
    """Return the displacements of pixels over a turn by each of several models of one image [px].

    The pixels ``xy`` have the shape (n, 2); without them a grid is used. The result has one row per model, without the
    mean of each pixel: this moves the pixel's picture, not its events against each other.
    """
    if xy is None:
        camera = models[0].camera
        x, y = np.meshgrid(np.linspace(0, camera.width - 1, COLUMNS), np.linspace(0, camera.height - 1, ROWS))
        xy = np.stack([x.ravel(), y.ravel()], axis=1)
    away = over_a_turn(models, xy) - xy[:, None]
    return np.asarray((away - away.mean(axis=2, keepdims=True)).reshape(len(models), -1))


def _doubt(space: ParameterSpace, fit: LinearFit, causes: list[Cause]) -> Vector:
    """Return the covariance of the answer [px²] if everything else about a lens that was given wrongly is doubtful."""
    others = [n for cause in causes for n in cause.names if n in fit.names and n != FLAT_SIDE]
    estimate = fit.fit((*space.names, *others))
    n = len(space.names)
    return np.asarray(DOUBT**2 * (estimate.covariance[:n, :n] + np.outer(estimate.change[:n], estimate.change[:n])))


def _spread(space: ParameterSpace, best: Vector, fit: LinearFit) -> tuple[float, float]:
    """Return the standard deviation of size and phase between the parts of the image, beyond their scatter [px].

    The estimate of DerSimonian and Laird (Controlled Clinical Trials 1986) for the variance between groups.
    """
    names = tuple(_orbit(space)[:2])
    along = np.array(size_and_phase_directions(space, best)[:2])[:, [space.names.index(n) for n in names]]
    places = np.minimum(fit.xy * REGIONS / (space.camera.width, space.camera.height), np.array(REGIONS) - 0.5)
    region = places.astype(int) @ (1, REGIONS[0])
    found = [fit.fit(names, region == k) for k in np.unique(region) if np.count_nonzero(region == k) >= FEWEST_SQUARES]
    if len(found) < 2:
        return 0.0, 0.0
    values = np.array([along @ e.change for e in found])
    variances = np.array([np.diag(along @ e.covariance @ along.T) for e in found])
    weights = 1.0 / np.maximum(variances, 1e-12)
    total = weights.sum(axis=0)
    mean = (weights * values).sum(axis=0) / total
    excess = (weights * (values - mean) ** 2).sum(axis=0) - (len(found) - 1)
    size, phase = np.sqrt(np.maximum(0.0, excess / (total - (weights**2).sum(axis=0) / total))).tolist()
    return size, phase


def _untold(space: ParameterSpace, best: Vector, fit: LinearFit) -> float:
    """Return the error if the other side of the prism is flat [px rms], if the events do not tell; else 0."""
    if FLAT_SIDE not in fit.names:
        return 0.0
    std = math.sqrt(float(fit.fit((*space.names, FLAT_SIDE)).covariance[-1, -1]))
    if std * TELLING <= 1.0:
        return 0.0
    values = space.to_values(best)
    away = distance(other_side(space).build(turned(space, values)), space.build(values))
    return away if away >= LEAST_MOVE_PX else 0.0


def stated_px(space: ParameterSpace, v: Vector, covariance: Vector) -> float:
    """Return the error of the model at ``v`` that its covariance states, constant lag removed [px rms]."""
    variances, axes = np.linalg.eigh(covariance)
    at = space.build(space.to_values(v))
    ends = (v + math.sqrt(max(0.0, x)) * axis for x, axis in zip(variances, axes.T, strict=True))
    return math.hypot(*(distance(space.build(space.to_values(end)), at) for end in ends))


def distance(model: Model, other: Model) -> float:
    """Return the distance of two models over the image and a turn, constant lag removed [px rms]."""
    return predicted_error(model, other, remove_lag=True, grid=8).rms


def slopes(cost: Cost, space: ParameterSpace, v: Vector, names: Iterable[str]) -> dict[str, Any]:
    """Return the derivatives of the residuals by parameters of ``space`` at its search vector ``v``, by name.

    They are on the device. The map must be solved at ``v``.
    """

    def by(name: str) -> Any:
        step = np.zeros(len(v))
        step[space.names.index(name)] = SLOPE_PX
        up, down = (place_arguments(space, space.to_values(at)) for at in (v + step, v - step))
        return cost.brightness.find_slope(up, down, 2.0 * SLOPE_PX)

    return {name: once(cost, name, partial(by, name)) for name in names}


def once(cost: Cost, name: str, find: Callable[[], Any]) -> Any:
    """Return a derivative of the residuals by name, which is found once for each solution of the map."""
    if name not in cost.columns:
        cost.columns[name] = find(), None
    return cost.columns[name][0]


def shifted(cost: Cost, v: Vector, shift: Any) -> Any:
    """Return the derivative of the residuals by a factor of ``shift``, changes of the angles at the ends of pairs.

    ``shift`` is a Warp array of shape (2 · padded pairs,), or (2, padded pairs). The map must be solved at ``v``.
    """
    first, second = cost.by_angle(v)
    out = wp.empty_like(first)
    launch(by_shift, len(first), [first, second, shift.flatten()], [out], device=first.device)
    return out


def _rotation_columns(cost: Cost, best: Vector) -> dict[str, Any]:
    """Return the derivatives of the residuals by a slow rotation of the camera about each axis, if it is not free."""
    space, at = cost.space, cost.at(best)
    half_s = max(0.5 * float(np.ptp(cost.brightness.pairs.some_times)), 1e-6)

    def about(axis: Vector) -> Any:
        x, y, z = axis * (SLOPE_PX / space.camera.fx / half_s)
        # one-sided differences: a camera at rest is faster to compute, and only the gain counts
        return cost.brightness.find_slope({**at, "camera_rotation": CameraRotation((x, y, z))}, at, SLOPE_PX)

    axes = zip(RATES if not space.moving else (), np.eye(3), strict=False)
    return {name: once(cost, name, partial(about, axis)) for name, axis in axes}


def _shake_columns(cost: Cost, best: Vector) -> dict[str, Any]:
    """Return the derivatives of the residuals by rotations of the camera that repeat every turn, for a still camera.

    They are rotations about x and about y by the cosine and by the sine of the encoder's angle [px at the centre].
    """
    pairs, camera, at = cost.brightness.pairs, cost.space.camera, cost.at(best)
    if cost.space.moving or not _orbit(cost.space) or MODELS[cost.space.model].ANGLES > 1:
        return {}
    rows, times, columns = pairs.angle_patterns((0.0, 0.0)), pairs.arrays.time, {}
    for k, name in enumerate(SHAKE):
        x, y = np.eye(2)[k // 2] * (SLOPE_PX / camera.fx)
        pairs.arrays.time = rows[k % 2].flatten()
        turns = (CameraRotation((s * x, s * y, 0.0), middle_us=cost.brightness.middle_us) for s in (1.0, -1.0))
        up, down = ({**at, "camera_rotation": turn} for turn in turns)
        columns[name] = cost.brightness.find_slope(up, down, 2.0 * SLOPE_PX)
    pairs.arrays.time = times
    return columns


def _angle_columns(cost: Cost, best: Vector) -> dict[str, Any]:
    """Return the derivatives of the residuals by patterns of the prism's angle, for a still camera."""
    pairs, camera = cost.brightness.pairs, cost.space.camera
    one = MODELS[cost.space.model].ANGLES == 1
    if cost.space.moving or pairs.arrays.slope.shape[0] or not (one and _orbit(cost.space)):
        return {}
    rows = pairs.angle_patterns((0.5 * camera.width, 0.5 * camera.height))
    # harmonics of a vibration's angle look like those of its motion
    examined = PATTERNS if MODELS[cost.space.model].PRISM else SKEW
    return {name: shifted(cost, best, rows[PATTERNS.index(name)]) for name in examined}


def by_refractory(cost: Cost, best: Vector) -> Vector:
    """Return the change of the answer ``best`` [px] per angle by which what moves turns in the refractory period [rad].

    The period sets the reference of a pair, its first event, later. The map must be solved at ``best``.
    """
    names = cost.space.names
    columns = slopes(cost, cost.space, best, names) | {"refractory": cost.by_angle(best)[0]}
    hessian = linear_fit(cost, columns).hessian.sum(axis=0)
    return np.asarray(-_pseudo_inverse(hessian[:-1, :-1]) @ hessian[:-1, -1])


def change_of_speed_px(cost: Cost, best: Vector) -> float:
    """Return how far a steady change of the speed over the recording moves events [px rms]; 0 if not significant.

    It is the estimate of a linearised fit, which finds a share of the change only. The map must be solved at ``best``.
    """
    pairs, names = cost.brightness.pairs, cost.space.names
    times = pairs.time.astype(np.float64)
    late = (times - times.mean()) / max(float(times.std()), 1e-9)
    waves = {"late": late, "square": late**2 - np.mean(late**2)}
    columns = slopes(cost, cost.space, best, names)
    for name, wave in waves.items():
        shift = np.zeros((2, pairs.arrays.stride), np.float32)
        shift[:, : len(pairs)] = wave
        columns[name] = shifted(cost, best, wp.array(shift, dtype=float, device=cost.brightness.device))
    estimate, significance, _ = linear_fit(cost, columns).adding((*names, "late"), ("square",))
    moved = px_per_rad(cost.space, best) * abs(float(estimate.change[-1])) * float(waves["square"].std())
    return moved if significance >= SIGNIFICANT else 0.0


@dataclass(frozen=True)
class AngleFit:
    """Errors of the prism's angle, by a linearised fit."""

    names: tuple[str, ...]
    """Names of the errors, of :data:`PATTERNS`."""
    change: Vector
    """Correction of the angle: factors of :data:`PATTERNS`, 0 for those that were not fitted, shape (6,)."""
    moved_px: float
    """How far the correction moves events [px rms]."""


def fit_angles(cost: Cost, best: Vector, names: tuple[str, ...] = ()) -> AngleFit | None:
    """Return the errors ``names`` of the prism's angle at ``best`` [px]; without names, those that are significant.

    None if there are none, or if they cannot be examined. What a slow rotation of the camera or a wrong camera or prism
    explains does not count.
    """
    angles = _angle_columns(cost, best)
    groups = [{name: angles[name] for name in group} for group in (HARMONICS, SKEW) if angles.keys() >= {*group}]
    if not angles or not (names or telling(cost, groups, LEAST_ANGLE_GAIN)):
        return None
    given = slopes(cost, cost.space, best, cost.space.names)
    if not names and not _told(linear_fit(cost, given | angles), [*given], groups, FIRST_LOOK):
        return None
    given |= _rotation_columns(cost, best)
    given |= _cause_columns(cost, best, ASPECT) if ASPECT in testable(cost.space) else {}
    others: dict[str, Any] = {}
    if not names:
        # cylinder power stands for wobble too, which has nearly the same effect
        for cause in (c for c in testable(cost.space) if c in SCREENED and c not in (INDEX, SEAT)):
            others |= {n: x for n, x in _cause_columns(cost, best, cause).items() if n not in given}
    fit = linear_fit(cost, given | angles | others)
    names = names or _told(fit, [*given, *others], groups)
    if not names:
        return None
    found = dict(zip(names, fit.fit((*given, *names)).change[len(given) :].tolist(), strict=True))
    change = np.array([found.get(name, 0.0) for name in PATTERNS])
    return AngleFit(names, change, px_per_rad(cost.space, best) * rms_angle(cost.space.camera, change))


def _told(
    fit: LinearFit, others: Sequence[str], groups: Sequence[Iterable[str]], share: float = 1.0
) -> tuple[str, ...]:
    """Return the names of those groups of errors of the angle that are significant beyond the columns ``others``.

    ``share`` is a factor of what is asked of them.
    """
    names: tuple[str, ...] = ()
    for group in groups:
        rest = (n for other in groups if other is not group for n in other)
        _, significance, gain = fit.adding((*others, *rest), (*group,))
        names += (*group,) if significance >= share * SIGNIFICANT and gain >= share * LEAST_ANGLE_GAIN else ()
    return names


def rms_angle(camera: Camera, factors: Vector) -> float:
    """Return how large an error of the angle is, given by factors of :data:`PATTERNS`, shape (6,) [rad rms]."""
    spread = np.sqrt([0.5, 0.5, 0.5, 0.5, camera.width**2 / 12.0, camera.height**2 / 12.0])
    return float(np.linalg.norm(factors * spread))


def px_per_rad(space: ParameterSpace, best: Vector) -> float:
    """Return how far events move per angle of the prism [px rms/rad]."""
    return float(np.linalg.norm(best[:2])) if space.cartesian else space.pixels.get("phase", 0.0)


def _shake(space: ParameterSpace, fit: LinearFit) -> float:
    """Return the amplitude of a shake that explains much of what all causes together leave [px]; 0 if none does."""
    if not {*SHAKE} <= {*fit.names}:
        return 0.0
    causes = tuple(n for cause in CAUSES for n in cause.names if n in fit.names and n not in space.names)
    # a wrong fy / fx bends the orbit as a shake on an ellipse does: it is freed for both
    free = (*space.names, *(n for n in causes if n in ASPECT.names))
    estimate, significance, gain = fit.adding(free, SHAKE)
    others = fit.adding(free, tuple(n for n in causes if n not in free))[2]
    _, _, left = fit.adding((*space.names, *causes), SHAKE)
    if significance < SIGNIFICANT or gain < SHAKE_SHARE * others or left < LEAST_SHAKE_GAIN:
        return 0.0
    return float(np.linalg.norm(estimate.change[-len(SHAKE) :]) / math.sqrt(2.0))


def _rotation_gain(space: ParameterSpace, fit: LinearFit) -> float:
    """Return the share of the squared residuals that a slow rotation of the camera explains; 0 if not significant."""
    if space.moving or not {*RATES} <= {*fit.names}:
        return 0.0
    _, significance, gain = fit.adding(space.names, RATES)
    return gain if significance >= SIGNIFICANT else 0.0


def _center(space: ParameterSpace, best: Vector, fit: LinearFit) -> tuple[float, float] | None:
    """Return the correction of the principal point and its standard deviation, as displacements of events [px rms]."""
    if not set(CENTER.names) <= set(fit.names) - set(space.names):
        return None
    n = len(space.names)
    estimate = fit.fit((*space.names, *CENTER.names))
    # the unit of the search vector holds for the nominal prism
    size = space.to_values(best)["apex"] / as_wedge(space.prism).apex
    std = math.sqrt(float(np.trace(estimate.covariance[n:, n:])))
    return size * float(np.linalg.norm(estimate.change[n:])), size * std


def testable(space: ParameterSpace) -> list[Cause]:
    """Return the causes that can be tested: those that are not free anyway, for the exact model."""
    if space.model != "exact" or not space.cartesian:
        return []
    # a prism whose other side is flat looks nearly like one with cylinder power
    shaped = {n for cause in SHAPES for n in cause.names} & set(space.names)
    return [c for c in CAUSES if not set(c.names) & set(space.names) and not (shaped and c == SIDE)]


def _cause_columns(cost: Cost, best: Vector, cause: Cause) -> dict[str, Any]:
    """Return the derivatives of the residuals by the parameters of a cause, by name."""
    space = cost.space
    values = space.to_values(best)
    try:
        if cause == SIDE:
            ends = place_arguments(other_side(space), turned(space, values)), place_arguments(space, values)
            return {FLAT_SIDE: once(cost, FLAT_SIDE, partial(cost.brightness.find_slope, *ends, 1.0))}
        wide, v = with_cause(space, cause, values)
    except AmiwarpError:
        return {}  # it moves no event
    return slopes(cost, wide, v, cause.names)


def _findings(cost: Cost, best: Vector, fit: LinearFit, causes: list[Cause], least_gain: float) -> list[Finding]:
    """Return the significant causes, ordered by the share of the residual that their correction removes."""
    found = []
    for cause in causes:
        if not set(cause.names) <= set(fit.names):
            continue
        estimate, significance, gain = fit.adding(cost.space.names, cause.names)
        if significance < SIGNIFICANT or gain < least_gain:
            continue
        moved, start = _corrected(cost, best, cause, estimate.change)
        if moved >= LEAST_MOVE_PX:
            found.append(Finding(cause, moved, gain, significance, start))
    return sorted(found, key=lambda f: -f.gain)


def _corrected(cost: Cost, best: Vector, cause: Cause, change: Vector) -> tuple[float, Vector]:
    """Return how far the correction of a cause changes the model [px rms], and the corrected search vector."""
    space, n = cost.space, len(best)
    here = space.build(space.to_values(best))
    wide, v = with_cause(space, cause, space.to_values(best))
    if cause == SIDE:
        return float(change[n]) * distance(wide.build(wide.to_values(v)), here), v
    low, high = wide.bounds()
    v = np.clip(v + change, low, high)
    return distance(wide.build(wide.to_values(v)), here), v


def _drift(space: ParameterSpace, best: Vector, fit: LinearFit) -> tuple[float, float]:
    """Return the significant change of size and phase over the recording [px rms]."""
    late = tuple(name for name in fit.names if name.startswith("late "))
    if len(late) < 2:
        return 0.0, 0.0
    n = len(space.names)
    estimate = fit.fit((*space.names, *late))
    along = np.array([d[[space.names.index(name.removeprefix("late ")) for name in late]]
                      for d in size_and_phase_directions(space, best)])  # fmt: skip
    change = along @ estimate.change[n:]
    std = np.sqrt(np.diag(along @ estimate.covariance[n:, n:] @ along.T))
    significant = np.where(np.abs(change) > SIGNIFICANT * std, change, 0.0)
    # size and phase of each prism in turn: those of the prism for which they change most
    size, phase = (max(significant[k::2].tolist(), key=abs) for k in (0, 1))
    return size, phase
