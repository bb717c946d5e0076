"""Steps of the stage for errors of the optic's angles: what repeats every turn, and delays of the read-out.

What an angle's sensor or command gets wrong is a function of that angle: an encoder off centre, a motor that ripples
between index pulses, a mirror that does not follow its command in proportion. It is described by harmonics of the
angle, for each angle of the model alike. A tilt with a cubic error, cos u + k cos³ u, is a larger tilt by the angle
u + k/2 sin 2u, to first order in k; one with a square error the tilt by u + k sin u.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Container, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.calib.photometric.answers import AnswerSearch
from amiwarp.calib.photometric.causes import ASPECT, INDEX, SCREENED, SEAT
from amiwarp.calib.photometric.consistency import LEAST_MOVE_PX, testable
from amiwarp.calib.photometric.cost import Cost
from amiwarp.calib.photometric.derivatives import by_cause, by_rotation, orbit_of, shifted, slopes
from amiwarp.calib.photometric.distances import px_per_rad
from amiwarp.calib.photometric.findings import AngleError
from amiwarp.calib.photometric.linear_fit import SIGNIFICANT, LinearFit, linear_fit, telling
from amiwarp.calib.photometric.refinement import Refinement
from amiwarp.calib.photometric.verdicts import refused
from amiwarp.optics.models.base import Model
from amiwarp.optics.models.registry import MODELS

if TYPE_CHECKING:
    from amiwarp.results.parameters import ParameterSpace

    Vector = NDArray[np.float64]

LOW = (1, 2)
"""Harmonics that the error of an angle is examined for in each answer."""
HIGH = (3, 4)
"""Further harmonics that are examined where residuals are left in sectors of an angle."""
SKEW = ("skew x", "skew y")
"""Names of the unknown changes of the prism's angle from column to column and from row to row [rad/px]."""
LEAST_ANGLE_GAIN = 0.01
"""Smallest share that an error of an angle must remove. Right angles leave 0.003 at most."""
CERTAIN = 7.0
LEAST_CERTAIN_PX = 0.015
"""Number of standard deviations above which an error of an angle is certain, and how far it must move events then, by a
linearised fit [px rms]. Much noise makes the share of the residuals small: at a cost of 0.26, errors of both encoders
that left 0.08 px had shares of 0.007 and 0.002, at 11 and 8 standard deviations. Right angles moved events by up to
0.007 px, in a coarse map of a small image."""
LEAST_SEEN_GAIN = 0.004
"""Share that decides, at a first look at the gradient alone, whether the angles are examined."""
FIRST_LOOK = 0.5
"""Share of what is asked of an error of the angle that it must have before all that may look like it is examined."""
LEAST_HIGH_GAIN = 0.001
LEAST_HIGH_PX = 0.005
"""Smallest share that a further harmonic must remove, and how far it must move events by a linearised fit [px rms]. The
interpolation of the map repeats four times a turn too: a right encoder at 160x120 seemed to move them by 0.001 px."""
MOST_ANGLE_FITS = 6
"""Largest number of linearised fits of the errors of the angles."""
FIRST_SHARE = 0.5
LEAST_SHARE = 0.25
"""Share of the error that the first linearised fit is taken to find, and the least share of a later one."""
LEAST_ANGLE_PX = 0.003
"""Length of a correction of the angles below which the search ends [px rms]."""


def harmonics_of(angle: int, harmonics: Sequence[int] = LOW) -> tuple[str, ...]:
    """Return the names of the unknown factors of cos k e and sin k e in the error of an angle e, for harmonics k.

    The angle is given by its number.
    """
    names: list[str] = []
    for k in harmonics:
        names += [f"cos {k} of angle {angle}", f"sin {k} of angle {angle}"]
    return tuple(names)


def examined_errors(kind: type[Model]) -> tuple[tuple[str, ...], ...]:
    """Return the names of the errors of a model's angles that the events tell, in groups that count together."""
    harmonics = tuple(harmonics_of(k) for k in range(kind.ANGLES))
    if kind.ANGLES > 1:
        return harmonics
    if kind.PRISM:
        return (*harmonics, SKEW)
    # harmonics of a vibration's angle look like harmonics of its motion
    return (SKEW,)


def examine_the_angles(state: Refinement) -> Refinement:
    """Note errors of the angles, and end unless there is but a small delay of the read-out."""
    if not state.are_angles_examined:
        return state
    search = state.search
    v = state.answer.x
    errors = find_angle_errors(search, v)
    if errors is None:
        return state
    found = _as_finding(state, errors)
    state = state.noticing(found)
    if refused(found):
        return state.ending()
    search.cost.renew(v)
    return state


def examine_accepted_angles(state: Refinement) -> Refinement:
    """Examine the angles unless the answer is refused, after lens and prism were corrected."""
    if state.refusal:
        return state
    return examine_the_angles(state)


def _as_finding(state: Refinement, errors: dict[str, float]) -> AngleError:
    """Return errors of the angles, given by name, as a finding."""
    harmonics = harmonics_in(state.space, errors)

    # A change of the angle from column to column, and from row to row, is a delay of their read-out.
    skew = {name: errors.get(name, 0.0) for name in SKEW}
    rad_per_us = state.problem.direction * state.problem.rad_per_us
    late_x, late_y = (-each / rad_per_us for each in skew.values())
    return AngleError(
        model=state.space.model,
        harmonics=harmonics if any(harmonics) else (),
        late_us=(late_x, late_y),
        late_px=moved_px(state.space, state.answer.x, skew),
    )


def harmonics_in(space: ParameterSpace, errors: Mapping[str, float]) -> tuple[float, ...]:
    """Return the factors of the harmonics among errors of the angles, given by name, for each angle in turn.

    All angles have as many: the first two, or up to the highest one that is not 0.
    """
    angles = range(MODELS[space.model].ANGLES)
    highest = max(LOW)
    for k in HIGH:
        if any(errors.get(name) for angle in angles for name in harmonics_of(angle, (k,))):
            highest = k
    factors: list[float] = []
    for angle in angles:
        for name in harmonics_of(angle, range(1, highest + 1)):
            factors.append(errors.get(name, 0.0))
    return tuple(factors)


def sum_of_harmonics(
    known: Sequence[float], more: Sequence[float], angles: int
) -> tuple[float, ...]:
    """Return the sum of two corrections of angles, in the form of :attr:`Calibration.harmonics`.

    One of them may have more harmonics than the other.
    """
    of_angle = max(len(known), len(more)) // angles
    total = np.zeros((angles, of_angle))
    for factors in (known, more):
        count = len(factors) // angles
        total[:, :count] += np.reshape(factors, (angles, count))
    return tuple(total.ravel().tolist())


def find_angle_errors(search: AnswerSearch, v: Vector) -> dict[str, float] | None:
    """Return the corrections of the angles that the events ask for, by name; None for none.

    The pairs' angles are the given ones again afterwards; the map is left at the corrected ones.
    """
    cost = search.cost
    cost.converge(v)
    found = fit_angles(cost, v)
    if found is None or moved_px(cost.space, v, found) < LEAST_MOVE_PX:
        return None
    return _whole_errors(search, v, found)


def find_high_harmonics(search: AnswerSearch, v: Vector) -> tuple[float, ...]:
    """Return the corrections of the angles if one of them has a third or fourth harmonic; empty if none has.

    They have the form of :attr:`Calibration.harmonics`. The map must be solved at ``v``, and is so afterwards.
    """
    found = _fit_high_harmonics(search.cost, v)
    if found is None:
        return ()
    errors = _whole_errors(search, v, found)
    search.cost.renew(v)
    return harmonics_in(search.space, errors)


def _whole_errors(search: AnswerSearch, v: Vector, found: dict[str, float]) -> dict[str, float]:
    """Return the whole errors of the angles, of which a first linearised fit found a part, by name.

    A linearised fit finds a share of the errors only, because the map absorbs the other part; the next fit tells how
    large the share was.
    """
    cost = search.cost
    names = tuple(found)
    angles = MODELS[cost.space.model].ANGLES
    azimuth = cost.brightness.pairs.arrays.azimuth
    given = wp.clone(azimuth)
    patterns = {}
    for name, pattern in patterns_of(cost, _harmonics_among(names)).items():
        patterns[name] = pattern.numpy().reshape(2, -1)
    total = np.zeros(len(names))
    share = FIRST_SHARE
    at = v
    try:
        for _ in range(MOST_ANGLE_FITS):
            # Correct the angles by the whole error, of which the fit finds a share.
            change = np.array(list(found.values()))
            step = change / share
            total += step
            errors = dict(zip(names, total.tolist(), strict=True))
            azimuth.assign(bent(given.numpy(), errors, patterns, angles))
            cost.renew(at)
            at = search.descend(at).x
            if moved_px(cost.space, at, found) / share < LEAST_ANGLE_PX:
                break

            # What the next fit still finds tells how large the share was.
            cost.converge(at)
            again = fit_angles(cost, at, names)
            assert again is not None
            found = again
            left = np.array(list(found.values()))
            share_found = (change - left) @ step / (step @ step)
            share = float(np.clip(share_found, LEAST_SHARE, 1.0))
    finally:
        azimuth.assign(given)
    return dict(zip(names, total.tolist(), strict=True))


def _harmonics_among(names: Sequence[str]) -> tuple[int, ...]:
    """Return the harmonics whose patterns errors of the angles need, given by name."""
    some_high = any(name in harmonics_of(_angle_of(name), HIGH) for name in names)
    return (*LOW, *HIGH) if some_high else LOW


def patterns_of(cost: Cost, harmonics: Sequence[int] = LOW) -> dict[str, Any]:
    """Return the change of an angle at both events of each pair for each unit of an error, by name.

    They are on the device, each of shape (2 · padded pairs,).
    """
    pairs = cost.brightness.pairs
    camera = cost.space.camera
    angles = MODELS[cost.space.model].ANGLES
    found: dict[str, Any] = {}
    # First and second events, both angles, or cosine and sine of one
    stored = pairs.arrays.azimuth.numpy().reshape(2, 2, -1).astype(np.float64)
    of_angles = [stored[:, k] for k in range(angles)]
    if angles == 1:
        middle = (0.5 * camera.width, 0.5 * camera.height)
        rows = pairs.angle_patterns(middle)
        for k, name in enumerate((*harmonics_of(0), *SKEW)):
            found[name] = rows[k]
        of_angles = [np.arctan2(stored[:, 1], stored[:, 0])]
    for k, angle in enumerate(of_angles):
        for harmonic in harmonics:
            multiple = harmonic * angle
            waves = (np.cos(multiple), np.sin(multiple))
            for name, wave in zip(harmonics_of(k, (harmonic,)), waves, strict=True):
                if name in found:
                    continue
                values = wave.ravel().astype(np.float32)
                found[name] = wp.array(values, dtype=float, device=pairs.device)
    return found


def bent(
    stored: Vector,
    errors: dict[str, float],
    patterns: dict[str, Vector],
    angles: int,
) -> NDArray[np.float32]:
    """Return what is stored for the events of pairs after their angles have changed by errors, given by name.

    ``stored`` and the result have the form of the pairs' ``azimuth``, shape (4 · padded pairs,).
    """
    # Two angles are stored as they are, one as its cosine and sine.
    parts = stored.reshape(2, 2, -1)
    if angles > 1:
        given = parts.swapaxes(0, 1)
    else:
        cos = parts[:, 0]
        sin = parts[:, 1]
        given = np.arctan2(sin, cos)[None]
    changed = np.array(given, np.float64)  # shape (angles, 2, padded pairs)
    for name, factor in errors.items():
        changed[_angle_of(name)] += factor * patterns[name]
    if angles == 1:
        (angle,) = changed
        changed = np.stack([np.cos(angle), np.sin(angle)])
    return changed.swapaxes(0, 1).astype(np.float32).ravel()


def _angle_of(name: str) -> int:
    """Return the number of the angle that has an error of this name."""
    if name in SKEW:
        return 0
    _, _, number = name.rpartition(" ")
    return int(number)


def moved_px(space: ParameterSpace, v: Vector, errors: dict[str, float]) -> float:
    """Return how far errors of the angles, given by name, move events at a search vector [px rms]."""
    camera = space.camera
    # Root mean squares of the patterns: positions over the image, or a harmonic over a turn.
    pattern_rms = {
        SKEW[0]: camera.width / math.sqrt(12.0),
        SKEW[1]: camera.height / math.sqrt(12.0),
    }
    each = []
    for name, factor in errors.items():
        of_pattern = pattern_rms.get(name, math.sqrt(0.5))
        each.append(px_per_rad(space, v, _angle_of(name)) * factor * of_pattern)
    return math.hypot(*each)


def fit_angles(cost: Cost, best: Vector, names: tuple[str, ...] = ()) -> dict[str, float] | None:
    """Return the corrections ``names`` of the angles at ``best`` [px]; without names, those that are significant.

    None if there are none, or if they cannot be examined. What a slow rotation of the camera or a wrong camera or prism
    explains does not count.
    """
    space = cost.space
    errors = _by_errors(cost, best, _harmonics_among(names))
    if not errors:
        return None
    groups = []
    for group in examined_errors(MODELS[space.model]):
        if errors.keys() >= set(group):
            groups.append({name: errors[name] for name in group})

    # Two quick looks, because most angles are right.
    if not names and not telling(cost, groups, LEAST_SEEN_GAIN):
        return None
    given = slopes(cost, space, best, space.names)
    if not names:
        quick = linear_fit(cost, given | errors)
        if not _told(cost, best, quick, list(given), groups, FIRST_LOOK):
            return None

    # Beyond what a rotation of the camera, or a wrong camera or prism explains.
    given |= by_rotation(cost, best)
    if set(ASPECT.names).isdisjoint(space.names):
        given |= by_cause(cost, best, ASPECT)
    others: dict[str, Any] = {}
    if not names:
        others = _by_camera_and_prism(cost, best, given)
    fit = linear_fit(cost, given | errors | others)
    names = names or _told(cost, best, fit, [*given, *others], groups)
    if not names:
        return None
    estimate = fit.fit((*given, *names))
    changes = estimate.change[len(given) :]
    return dict(zip(names, changes.tolist(), strict=True))


def _fit_high_harmonics(cost: Cost, best: Vector) -> dict[str, float] | None:
    """Return the corrections of the angles that have a third or fourth harmonic; None if none has.

    The first two harmonics of such an angle are corrected too: a part of them may be left. What a slow rotation of the
    camera, a wrong camera or prism, or another error of the angles explains does not count.
    """
    errors = _by_errors(cost, best, (*LOW, *HIGH))
    given = slopes(cost, cost.space, best, cost.space.names)
    given |= by_rotation(cost, best)
    if set(ASPECT.names).isdisjoint(cost.space.names):
        given |= by_cause(cost, best, ASPECT)
    others = _by_camera_and_prism(cost, best, given)
    fit = linear_fit(cost, given | errors | others)

    names: list[str] = []
    for angle in range(MODELS[cost.space.model].ANGLES):
        high: list[str] = []
        for harmonic in HIGH:
            group = harmonics_of(angle, (harmonic,))
            rest = tuple(name for name in fit.names if name not in group)
            estimate, significance, gain = fit.adding(rest, group)
            factors = estimate.change[-len(group) :].tolist()
            found_px = moved_px(cost.space, best, dict(zip(group, factors, strict=True)))
            is_there = significance >= SIGNIFICANT and gain >= LEAST_HIGH_GAIN
            if is_there and found_px >= LEAST_HIGH_PX:
                high += group
        if high:
            names += [*harmonics_of(angle), *high]
    if not names:
        return None
    estimate = fit.fit((*given, *names))
    changes = estimate.change[len(given) :]
    return dict(zip(names, changes.tolist(), strict=True))


def _by_camera_and_prism(cost: Cost, best: Vector, given: Container[str]) -> dict[str, Any]:
    """Return the derivatives of the residuals by what may be wrong about camera and prism, other than the given ones.

    Cylinder power stands for wobble too, which has nearly the same effect.
    """
    found: dict[str, Any] = {}
    for cause in testable(cost.space):
        if cause not in SCREENED or cause in (INDEX, SEAT):
            continue
        for name, column in by_cause(cost, best, cause).items():
            if name not in given:
                found[name] = column
    return found


def _by_errors(cost: Cost, best: Vector, harmonics: Sequence[int]) -> dict[str, Any]:
    """Return the derivatives of the residuals by errors of the angles, by name, for a still camera."""
    space = cost.space
    drifts = cost.brightness.pairs.arrays.slope.shape[0] > 0
    if space.moving or drifts or not orbit_of(space):
        return {}
    kind = MODELS[space.model]
    patterns = patterns_of(cost, harmonics)
    names: list[str] = []
    for group in examined_errors(kind):
        names += group
    high = [k for k in harmonics if k not in LOW]
    for angle in range(kind.ANGLES):
        if harmonics_of(angle) in examined_errors(kind):
            names += harmonics_of(angle, high)
    columns = {}
    for name in names:
        columns[name] = shifted(cost, best, patterns[name], _angle_of(name))
    return columns


def _told(
    cost: Cost,
    best: Vector,
    fit: LinearFit,
    others: Sequence[str],
    groups: Sequence[Collection[str]],
    share: float = 1.0,
) -> tuple[str, ...]:
    """Return the names of those groups of errors of the angles that are significant beyond the columns ``others``.

    ``share`` is a factor of what is asked of them.
    """
    names: list[str] = []
    for group in groups:
        rest: list[str] = []
        for other in groups:
            if other is not group:
                rest += other
        estimate, significance, gain = fit.adding((*others, *rest), tuple(group))
        changes = estimate.change[-len(group) :]
        found = dict(zip(group, changes.tolist(), strict=True))
        found_px = moved_px(cost.space, best, found)
        is_large = significance >= share * SIGNIFICANT and gain >= share * LEAST_ANGLE_GAIN
        is_certain = significance >= share * CERTAIN and found_px >= share * LEAST_CERTAIN_PX
        if is_large or is_certain:
            names += group
    return tuple(names)
