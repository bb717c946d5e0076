"""Check that the answer of the photometric stage holds everywhere in the image, over time, and for all kinds of pairs.

A wrong answer can leave a small residual, because a wrong camera is mostly absorbed by the size of the orbit. But then
the size that fits differs from place to place. The check linearises the problem at the answer and asks how much of the
residual each of a few likely causes would remove, were it free.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.calib.photometric.causes import (
    ASPECT,
    CENTER,
    DISTORTION,
    FACES,
    FLAT_SIDE,
    FOCAL_LENGTH,
    INDEX,
    LOOKED_AT_FIRST,
    SCREENED,
    SEAT,
    SIDE,
    SUSPECTS,
    THIRD,
    UNEVEN,
    SuspectedError,
    other_side,
    values_with_other_side,
    with_cause,
)
from amiwarp.calib.photometric.cost import size_and_phase_directions
from amiwarp.calib.photometric.derivatives import (
    SHAKE,
    by_cause,
    by_parts_of_pairs,
    by_rotation,
    by_shake,
    orbit_of,
)
from amiwarp.calib.photometric.distances import distance
from amiwarp.calib.photometric.findings import Finding
from amiwarp.calib.photometric.linear_fit import SIGNIFICANT, LinearFit, linear_fit, telling
from amiwarp.calib.photometric.stated_errors import BOUND, hidden_px
from amiwarp.calib.photometric.systematic import (
    errors_of_a_wrong_lens,
    gap_errors,
    least_errors,
    lens_errors,
    map_errors,
)
from amiwarp.optics.camera import LENS
from amiwarp.optics.models.exact import ExactModel
from amiwarp.optics.models.registry import MODELS
from amiwarp.optics.prism import as_wedge
from amiwarp.results.parameters import RATES, ParameterSpace

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
CLOCK = "the encoder's clock or scale"
"""Words of what could hide in a phase that drifts over the recording."""
DRIFT_SHARE = 0.3
"""Share of a drift of the phase that a linearised fit finds: the map absorbs the rest. It was 0.33 of a clock that was
wrong by 0.2 %."""
TELLING = 3.0
"""Number of standard deviations between the two sides of the prism above which the events tell them apart."""


@dataclass(frozen=True)
class LikelyCause:
    """A cause for which the answer does not hold everywhere."""

    cause: SuspectedError
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
    of_map: Vector
    """The part of it by the map, whose errors are a share of the contrast threshold [px²], shape (n, n)."""
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
    distortion: tuple[float, float] | None = None
    """Change of the distortion k1 that a linearised fit finds at found depths, and its standard deviation; None without
    such depths."""
    shake_px: float = 0.0
    """Least amplitude of a rotation of the camera that repeats every turn [px], if the camera seems to shake so; else
    0."""

    def inconsistent_px(self) -> float:
        """Return the largest error that the check found [px].

        A phase that drifts or differs from place to place blurs the image, but its mean is right.
        """
        size_drift, _ = self.drift
        size_spread, _ = self.spread
        of_causes = [each.moved_px for each in self.likely[:1]]
        return max([*of_causes, abs(size_drift), size_spread])


def check_consistency(cost: Cost, best: Vector) -> Consistency:
    """Check the answer ``best`` [px]. The map must be solved there; it is not changed."""
    space = cost.space
    causes = testable(space)
    # a lens that was given wrongly once may be wrong in more than one way: then everything is examined at once
    doubtful = not set(LENS).isdisjoint(space.names)
    # found depths have absorbed a part of what a wrong lens leaves
    little = doubtful or space.depths is not None
    least_gain = LEAST_FURTHER_GAIN if little else LEAST_GAIN
    # where depths make up for the focal length, nothing resembles the other causes
    screened = causes
    if not doubtful and space.depths is None:
        screened = [cause for cause in causes if cause in SCREENED]
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
        likely = _likely(cost, best, fit, causes, least_gain)
        shake_px = _shake(space, fit)

    of_lens = lens_errors(space, best, fit, least_gain)
    if doubtful:
        of_lens = of_lens + errors_of_a_wrong_lens(space, fit, causes)
    pairs = cost.brightness.count
    density = cost.brightness.tiles.density
    of_map = map_errors(space, best, fit, pairs, density)
    of_gaps = gap_errors(space, fit)
    hidden = hidden_px(space, best, fit, causes)
    # the depth of each pixel makes up for what differs over the image
    spread = (0.0, 0.0)
    if space.depths is None:
        spread = _spread(space, best, fit)
    return Consistency(
        step=fit.fit(space.names).change,
        systematic=of_gaps + least_errors(space) + of_map + of_lens,
        method=of_gaps + of_map / BOUND_VARIANCE,
        of_map=of_map,
        hidden_px=hidden | _clock_bound(space, best, fit),
        likely=tuple(likely),
        drift=_drift(space, best, fit),
        spread=spread,
        rotation_gain=_rotation_gain(space, fit),
        untold_px=_untold(space, best, fit),
        center_px=_center(space, best, fit),
        distortion=_distortion(space, best, fit),
        shake_px=shake_px,
    )


def _screened_columns(
    cost: Cost, best: Vector, screened: Sequence[SuspectedError], least_gain: float
) -> dict[str, Any]:
    """Return the derivatives of the residuals that every answer is examined with."""
    columns = by_parts_of_pairs(cost, best)
    for cause in screened:
        if cause not in LOOKED_AT_FIRST:
            columns |= by_cause(cost, best, cause)
    # wobble and index look like cylinder power: where the first look finds none of that, it finds none of them
    alike: list[SuspectedError] = []
    if FACES in screened:
        alike = [cause for cause in screened if cause in (INDEX, SEAT)]
    gated = [by_rotation(cost, best)]
    for cause in screened:
        if cause in LOOKED_AT_FIRST and cause not in alike:
            gated.append(by_cause(cost, best, cause))
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
    which = [space.names.index(name) for name in names]
    along = np.array(size_and_phase_directions(space, best)[:2])[:, which]

    # An answer from each part of the image.
    size_of_image = (space.camera.width, space.camera.height)
    last = np.array(REGIONS) - 0.5
    places = np.minimum(fit.xy * REGIONS / size_of_image, last)
    region = places.astype(int) @ (1, REGIONS[0])
    changes = []
    variances_of_parts = []
    for number in np.unique(region):
        inside = region == number
        if np.count_nonzero(inside) < FEWEST_SQUARES:
            continue
        estimate = fit.fit(names, inside)
        changes.append(along @ estimate.change)
        variances_of_parts.append(np.diag(along @ estimate.covariance @ along.T))
    groups = len(changes)
    if groups < 2:
        return 0.0, 0.0

    values = np.array(changes)
    variances = np.array(variances_of_parts)
    weights = 1.0 / np.maximum(variances, 1e-12)
    total = weights.sum(axis=0)
    mean = (weights * values).sum(axis=0) / total
    excess = (weights * (values - mean) ** 2).sum(axis=0) - (groups - 1)
    between = excess / (total - (weights**2).sum(axis=0) / total)
    size, phase = np.sqrt(np.maximum(0.0, between)).tolist()
    return size, phase


def _untold(space: ParameterSpace, best: Vector, fit: LinearFit) -> float:
    """Return the error if the other side of the prism is flat [px rms], if the events do not tell; else 0."""
    if FLAT_SIDE not in fit.names:
        return 0.0
    estimate = fit.fit((*space.names, FLAT_SIDE))
    std = math.sqrt(float(estimate.covariance[-1, -1]))
    if std * TELLING <= 1.0:
        return 0.0
    values = space.to_values(best)
    other = other_side(space).build(values_with_other_side(space, values))
    away = distance(other, space.build(values))
    return away if away >= LEAST_MOVE_PX else 0.0


def _shake(space: ParameterSpace, fit: LinearFit) -> float:
    """Return the amplitude of a shake that explains much of what all causes together leave [px]; 0 if none does."""
    if not set(SHAKE).issubset(fit.names):
        return 0.0
    causes: list[str] = []
    for cause in SUSPECTS:
        for name in cause.names:
            if name in fit.names and name not in space.names:
                causes.append(name)
    # a wrong fy / fx bends the orbit as a shake on an ellipse does: it is freed for both
    of_aspect = [name for name in causes if name in ASPECT.names]
    free = (*space.names, *of_aspect)
    not_free = tuple(name for name in causes if name not in free)
    estimate, significance, gain = fit.adding(free, SHAKE)
    _, _, others = fit.adding(free, not_free)
    _, _, left = fit.adding((*space.names, *causes), SHAKE)
    if significance < SIGNIFICANT or left < LEAST_SHAKE_GAIN or gain < SHAKE_SHARE * others:
        return 0.0
    amplitudes = estimate.change[-len(SHAKE) :]
    return float(np.linalg.norm(amplitudes) / math.sqrt(2.0))


def _rotation_gain(space: ParameterSpace, fit: LinearFit) -> float:
    """Return the share of the squared residuals that a slow rotation of the camera explains; 0 if not significant."""
    if space.moving or not {*RATES} <= {*fit.names}:
        return 0.0
    _, significance, gain = fit.adding(space.names, RATES)
    return gain if significance >= SIGNIFICANT else 0.0


def _center(space: ParameterSpace, best: Vector, fit: LinearFit) -> tuple[float, float] | None:
    """Return the correction of the principal point and its standard deviation, as displacements of events [px rms]."""
    may_be_freed = set(fit.names) - set(space.names)
    if space.model != ExactModel.NAME or not may_be_freed.issuperset(CENTER.names):
        return None
    count = len(space.names)
    estimate = fit.fit((*space.names, *CENTER.names))
    change = float(np.linalg.norm(estimate.change[count:]))
    variance = float(np.trace(estimate.covariance[count:, count:]))
    # the unit of the search vector holds for the nominal prism
    size = space.to_values(best)["apex"] / as_wedge(space.prism).apex
    return size * change, size * math.sqrt(variance)


def _distortion(space: ParameterSpace, best: Vector, fit: LinearFit) -> tuple[float, float] | None:
    """Return the change of k1 at found depths and its standard deviation; None if it was not examined there."""
    if space.depths is None or "k1" not in fit.names:
        return None
    estimate = fit.fit((*space.names, "k1"))
    wide, _ = with_cause(space, DISTORTION, space.to_values(best))
    px_per_unit = wide.pixels["k1"]
    std = math.sqrt(float(estimate.covariance[-1, -1]))
    return float(estimate.change[-1]) / px_per_unit, std / px_per_unit


def testable(space: ParameterSpace) -> list[SuspectedError]:
    """Return the causes that can be tested: of what the model has, and what is neither free nor found before."""
    kind = MODELS[space.model]
    if kind.SIMPLIFIES is not None or not space.cartesian:
        return []
    adjustable = {*LENS, *kind.FREE}
    if space.model == ExactModel.NAME:
        adjustable.add(FLAT_SIDE)
    free = set(space.names)
    causes = []
    for cause in SUSPECTS:
        names = {*cause.names}
        # only the size of orbits tells the focal length, and the depth of each pixel makes up for that
        if cause == FOCAL_LENGTH and space.depths is not None:
            continue
        # a third harmonic is given or was found by an earlier attempt
        known = cause == THIRD and names & {*space.start}
        if names <= adjustable and not names & free and not known:
            causes.append(cause)
    # a prism whose other side is flat looks nearly like one with cylinder power
    shaped = any(set(cause.names) & free for cause in UNEVEN)
    if shaped:
        causes = [cause for cause in causes if cause != SIDE]
    return causes


def _likely(
    cost: Cost, best: Vector, fit: LinearFit, causes: Sequence[SuspectedError], least_gain: float
) -> list[LikelyCause]:
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
    return sorted(found, key=lambda each: -each.gain)


def _corrected(
    cost: Cost,
    best: Vector,
    cause: SuspectedError,
    change: Vector,
) -> tuple[float, Vector]:
    """Return how far the correction of a cause changes the model [px rms], and the corrected search vector."""
    space = cost.space
    values = space.to_values(best)
    here = space.build(values)
    wide, v = with_cause(space, cause, values)
    if cause == SIDE:
        share = float(change[len(best)])
        there = wide.build(wide.to_values(v))
        return share * distance(there, here), v
    low, high = wide.bounds()
    v = np.clip(v + change, low, high)
    # found depths follow the lens, and would hide a part of the change
    plane = replace(wide, depths=None)
    there = plane.build(plane.to_values(v))
    return distance(there, replace(space, depths=None).build(values)), v


def _drift(space: ParameterSpace, best: Vector, fit: LinearFit) -> tuple[float, float]:
    """Return the significant change of size and phase over the recording [px rms]."""
    change, std = _drifts(space, best, fit)
    significant = np.where(np.abs(change) > SIGNIFICANT * std, change, 0.0)
    # size and phase of each prism in turn: of the prism for which they change most
    size = max(significant[0::2].tolist(), key=abs, default=0.0)
    phase = max(significant[1::2].tolist(), key=abs, default=0.0)
    return size, phase


def _clock_bound(space: ParameterSpace, best: Vector, fit: LinearFit) -> dict[str, float]:
    """Return by how much events may still move because an encoder's clock or scale is wrong [px rms], by its words."""
    kind = MODELS[space.model]
    change, std = _drifts(space, best, fit)
    if not len(change) or not (kind.PRISM or kind.ANGLES > 1):
        return {}
    bounds = (np.abs(change) + BOUND * std) / DRIFT_SHARE
    return {CLOCK: float(bounds[1::2].max())}


def _drifts(space: ParameterSpace, best: Vector, fit: LinearFit) -> tuple[Vector, Vector]:
    """Return the changes of size and phase of each prism over the recording, and their standard deviations [px rms].

    Both are empty if they were not examined.
    """
    late = tuple(name for name in fit.names if name.startswith("late "))
    if len(late) < 2:
        return np.zeros(0), np.zeros(0)
    count = len(space.names)
    which = [space.names.index(name.removeprefix("late ")) for name in late]
    estimate = fit.fit((*space.names, *late))
    along = np.array([direction[which] for direction in size_and_phase_directions(space, best)])
    change = along @ estimate.change[count:]
    covariance = along @ estimate.covariance[count:, count:] @ along.T
    return change, np.sqrt(np.diag(covariance))
