"""Check that the answer of the photometric stage holds everywhere in the image, over time, and for all kinds of pairs.

A wrong answer can leave a small residual, because a wrong camera is mostly absorbed by the size of the orbit. But then
the size that fits differs from place to place. The check linearises the problem at the answer and asks how much of the
residual each of a few likely causes would remove, were it free.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.calib.parameters import RATES, ParameterSpace
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
    THIRD,
    Cause,
    other_side,
    turned,
    with_cause,
)
from amiwarp.calib.photometric.cost import size_and_phase_directions
from amiwarp.calib.photometric.derivatives import SHAKE, by_cause, by_parts_of_pairs, by_rotation, by_shake, orbit_of
from amiwarp.calib.photometric.distances import distance
from amiwarp.calib.photometric.findings import Finding
from amiwarp.calib.photometric.linear_fit import SIGNIFICANT, LinearFit, linear_fit, telling
from amiwarp.calib.photometric.stated_errors import hidden_px
from amiwarp.calib.photometric.systematic import errors_of_a_wrong_lens, gap_errors, lens_errors, map_errors
from amiwarp.optics.camera import LENS
from amiwarp.optics.models import MODELS
from amiwarp.optics.prism import as_wedge

if TYPE_CHECKING:
    from amiwarp.calib.photometric.cost import Cost

    Vector = NDArray[np.float64]

LEAST_GAIN = 0.002
"""Smallest share of the squared residuals that a cause must remove. Right answers leave 0.001 at most."""
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
BOUND_VARIANCE = 3.0
"""Ratio of a bound's square to the variance of what lies anywhere within it. The errors of a map's interpolation are
bounds: all pairs would have to err in the same sense."""
REGIONS = (3, 2)
"""Number of columns and rows of the parts of the image whose answers are compared."""
FEWEST_SQUARES = 4
"""Smallest number of squares of pixels with events for a part of the image to be compared."""
TELLING = 3.0
"""Number of standard deviations between the two sides of the prism from which on the events tell them apart."""


@dataclass(frozen=True)
class LikelyCause:
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
class Consistency(Finding):
    """Result of the check."""

    step: Vector
    """Remaining Gauss-Newton step of the free parameters [px], shape (n,)."""
    systematic: Vector
    """Covariance of the errors that do not scatter from place to place [px²], shape (n, n)."""
    method: Vector
    """The part of it that is the method's own: it is an error of the motion, whatever the lens [px²], shape (n, n)."""
    hidden_px: Mapping[str, float]
    """By how much each cause that was looked for may still change the motion [px rms], by its words."""
    likely: tuple[LikelyCause, ...]
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
        of_causes = [each.moved_px for each in self.likely[:1]]
        return max([*of_causes, abs(self.drift[0]), self.spread[0]])


def check_consistency(cost: Cost, best: Vector) -> Consistency:
    """Check the answer ``best`` [px]. The map must be solved there; it is not changed."""
    space = cost.space
    causes = testable(space)
    # a lens that was given wrongly once may be wrong in more than one way: then everything is examined at once
    doubtful = bool(set(LENS) & set(space.names))
    least_gain = LEAST_FURTHER_GAIN if doubtful else LEAST_GAIN
    screened = causes if doubtful else [c for c in causes if c in SCREENED]
    columns = _screened_columns(cost, best, screened, least_gain)
    fit = linear_fit(cost, columns)
    likely = _likely(cost, best, fit, screened, least_gain)
    shake_px = 0.0
    if likely and not doubtful:
        for cause in causes:
            if cause not in SCREENED:
                columns |= by_cause(cost, best, cause)
        columns |= by_shake(cost, best)
        fit = linear_fit(cost, columns)
        likely = _likely(cost, best, fit, causes, LEAST_GAIN)
        shake_px = _shake(space, fit)
    of_lens = lens_errors(space, best, fit, least_gain)
    if doubtful:
        of_lens = of_lens + errors_of_a_wrong_lens(space, fit, causes)
    brightness = cost.brightness
    of_map = map_errors(space, best, fit, brightness.count, brightness.tiles.density)
    of_gaps = gap_errors(space, fit)
    return Consistency(
        step=fit.fit(space.names).change,
        systematic=of_gaps + of_map + of_lens,
        method=of_gaps + of_map / BOUND_VARIANCE,
        hidden_px=hidden_px(space, best, fit, causes),
        likely=tuple(likely),
        drift=_drift(space, best, fit),
        spread=_spread(space, best, fit),
        rotation_gain=_rotation_gain(space, fit),
        untold_px=_untold(space, best, fit),
        center_px=_center(space, best, fit),
        shake_px=shake_px,
    )


def _screened_columns(cost: Cost, best: Vector, screened: Sequence[Cause], least_gain: float) -> dict[str, Any]:
    """Return the derivatives of the residuals that every answer is examined with."""
    columns = by_parts_of_pairs(cost, best)
    for cause in screened:
        if cause not in GATED:
            columns |= by_cause(cost, best, cause)
    # wobble and index look like cylinder power: where the first look finds none of that, it finds none of them
    alike = [c for c in screened if c in (INDEX, SEAT)] if FACES in screened else []
    gates = [c for c in screened if c in GATED and c not in alike]
    gated = [by_rotation(cost, best), *(by_cause(cost, best, cause) for cause in gates)]
    for group in telling(cost, gated, least_gain):
        columns |= group
    if set(FACES.names) <= columns.keys():
        for cause in alike:
            columns |= by_cause(cost, best, cause)
    return columns


def _spread(space: ParameterSpace, best: Vector, fit: LinearFit) -> tuple[float, float]:
    """Return the standard deviation of size and phase between the parts of the image, beyond their scatter [px].

    The estimate of DerSimonian and Laird (Controlled Clinical Trials 1986) for the variance between groups.
    """
    names = tuple(orbit_of(space)[:2])  # of the first prism
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
    """Return the causes that can be tested: those of the exact model that are not free anyway, or of a vibration."""
    if {*THIRD.names} <= {*MODELS[space.model].FREE} and not {*THIRD.names} & {*space.start}:
        return [THIRD]
    if space.model != "exact" or not space.cartesian:
        return []
    # a prism whose other side is flat looks nearly like one with cylinder power
    shaped = {n for cause in SHAPES for n in cause.names} & set(space.names)
    return [c for c in CAUSES if not set(c.names) & set(space.names) and not (shaped and c == SIDE)]


def _likely(cost: Cost, best: Vector, fit: LinearFit, causes: Sequence[Cause], least_gain: float) -> list[LikelyCause]:
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
            found.append(LikelyCause(cause, moved, gain, significance, start))
    return sorted(found, key=lambda f: -f.gain)


def _corrected(cost: Cost, best: Vector, cause: Cause, change: Vector) -> tuple[float, Vector]:
    """Return how far the correction of a cause changes the model [px rms], and the corrected search vector."""
    space = cost.space
    here = space.build(space.to_values(best))
    wide, v = with_cause(space, cause, space.to_values(best))
    if cause == SIDE:
        share = float(change[len(best)])
        return share * distance(wide.build(wide.to_values(v)), here), v
    low, high = wide.bounds()
    v = np.clip(v + change, low, high)
    return distance(wide.build(wide.to_values(v)), here), v


def _drift(space: ParameterSpace, best: Vector, fit: LinearFit) -> tuple[float, float]:
    """Return the significant change of size and phase over the recording [px rms]."""
    late = tuple(name for name in fit.names if name.startswith("late "))
    if len(late) < 2:
        return 0.0, 0.0
    n = len(space.names)
    which = [space.names.index(name.removeprefix("late ")) for name in late]
    estimate = fit.fit((*space.names, *late))
    along = np.array([direction[which] for direction in size_and_phase_directions(space, best)])
    change = along @ estimate.change[n:]
    std = np.sqrt(np.diag(along @ estimate.covariance[n:, n:] @ along.T))
    significant = np.where(np.abs(change) > SIGNIFICANT * std, change, 0.0)
    # size and phase of each prism in turn: of the prism for which they change most
    size = max(significant[0::2].tolist(), key=abs)
    phase = max(significant[1::2].tolist(), key=abs)
    return size, phase
