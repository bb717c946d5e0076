"""Steps of the stage for errors of the optic's angles: what repeats every turn, and delays of the read-out.

What an angle's sensor or command gets wrong is a function of that angle: an encoder off centre, a motor that ripples
between index pulses, a mirror that does not follow its command in proportion. It is described by harmonics of the
angle, for each angle of the model alike. A tilt with a cubic error, cos u + k cos³ u, is a larger tilt by the angle
u + k/2 sin 2u, to first order in k; one with a square error the tilt by u + k sin u.
"""

from __future__ import annotations

import math
from collections.abc import Container, Iterable, Sequence
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

HARMONICS = ("cos 1", "sin 1", "cos 2", "sin 2")
"""Names of the unknown factors of cos e, sin e, cos 2e and sin 2e in the error of an angle e."""
SKEW = ("skew x", "skew y")
"""Names of the unknown changes of the prism's angle from column to column and from row to row [rad/px]."""
LEAST_ANGLE_GAIN = 0.01
"""Smallest share that an error of an angle must remove. Right angles leave 0.003 at most."""
FIRST_LOOK = 0.5
"""Share of what is asked of an error of the angle that it must have before all that may look like it is examined."""
MOST_ANGLE_FITS = 6
"""Largest number of linearised fits of the errors of the angles."""
FIRST_SHARE = 0.5
LEAST_SHARE = 0.25
"""Share of the error that the first linearised fit is taken to find, and the least share of a later one."""
LEAST_ANGLE_PX = 0.003
"""Length of a correction of the angles below which the search ends [px rms]."""


def harmonics_of(angle: int) -> tuple[str, ...]:
    """Return the names of the harmonics in the error of an angle of the model, by its number."""
    return tuple(f"{name} of angle {angle}" for name in HARMONICS)


def examined_errors(kind: type[Model]) -> tuple[tuple[str, ...], ...]:
    """Return the names of the errors of a model's angles that the events tell, in groups that count together."""
    harmonics = tuple(harmonics_of(k) for k in range(kind.ANGLES))
    if kind.ANGLES > 1:
        return harmonics
    if kind.PRISM:
        return (*harmonics, SKEW)
    # harmonics of a vibration's angle look like harmonics of its motion
    return (SKEW,)


def examine_the_angles_first(state: Refinement) -> Refinement:
    """End if the angles have an error, so that it is corrected before lens and prism are examined."""
    if state.problem.angles_hold:
        return state
    return _without_angle_errors(state)


def examine_the_angles_last(state: Refinement) -> Refinement:
    """Refuse the answer if its angles have an error although lens and prism were corrected first."""
    if state.refusal or not state.problem.angles_hold:
        return state
    return _without_angle_errors(state)


def _without_angle_errors(state: Refinement) -> Refinement:
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


def _as_finding(state: Refinement, errors: dict[str, float]) -> AngleError:
    """Return errors of the angles, given by name, as a finding."""
    harmonics: list[float] = []
    for angle in range(MODELS[state.space.model].ANGLES):
        for name in harmonics_of(angle):
            harmonics.append(errors.get(name, 0.0))

    # A change of the angle from column to column, and from row to row, is a delay of their read-out.
    skew = {name: errors.get(name, 0.0) for name in SKEW}
    rad_per_us = state.problem.direction * state.problem.rad_per_us
    late_x, late_y = (-each / rad_per_us for each in skew.values())
    return AngleError(
        model=state.space.model,
        harmonics=tuple(harmonics) if any(harmonics) else (),
        late_us=(late_x, late_y),
        late_px=moved_px(state.space, state.answer.x, skew),
    )


def find_angle_errors(search: AnswerSearch, v: Vector) -> dict[str, float] | None:
    """Return the corrections of the angles that the events ask for, by name; None for none.

    A linearised fit finds a share of the errors only, because the map absorbs the other part; the next fit tells how
    large the share was. The pairs' angles are the given ones again afterwards; the map is left at the corrected ones.
    """
    cost = search.cost
    cost.converge(v)
    found = fit_angles(cost, v)
    if found is None or moved_px(cost.space, v, found) < LEAST_MOVE_PX:
        return None
    names = tuple(found)
    angles = MODELS[cost.space.model].ANGLES
    azimuth = cost.brightness.pairs.arrays.azimuth
    given = wp.clone(azimuth)
    patterns = {}
    for name, pattern in patterns_of(cost).items():
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


def patterns_of(cost: Cost) -> dict[str, Any]:
    """Return the change of an angle at both events of each pair for each unit of an error, by name.

    They are on the device, each of shape (2 · padded pairs,).
    """
    pairs = cost.brightness.pairs
    camera = cost.space.camera
    angles = MODELS[cost.space.model].ANGLES
    if angles == 1:
        middle = (0.5 * camera.width, 0.5 * camera.height)
        rows = pairs.angle_patterns(middle)
        names = (*harmonics_of(0), *SKEW)
        return {name: rows[k] for k, name in enumerate(names)}
    found: dict[str, Any] = {}
    # First and second events, both angles
    stored = pairs.arrays.azimuth.numpy().reshape(2, angles, -1)
    for k in range(angles):
        angle = stored[:, k].astype(np.float64)
        twice = 2.0 * angle
        waves = (np.cos(angle), np.sin(angle), np.cos(twice), np.sin(twice))
        for name, wave in zip(harmonics_of(k), waves, strict=True):
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
    errors = _by_errors(cost, best)
    if not errors:
        return None
    groups = []
    for group in examined_errors(MODELS[space.model]):
        if errors.keys() >= set(group):
            groups.append({name: errors[name] for name in group})

    # Two quick looks, because most angles are right.
    if not names and not telling(cost, groups, LEAST_ANGLE_GAIN):
        return None
    given = slopes(cost, space, best, space.names)
    if not names:
        quick = linear_fit(cost, given | errors)
        if not _told(quick, list(given), groups, FIRST_LOOK):
            return None

    # Beyond what a rotation of the camera, or a wrong camera or prism explains.
    given |= by_rotation(cost, best)
    if set(ASPECT.names).isdisjoint(space.names):
        given |= by_cause(cost, best, ASPECT)
    others: dict[str, Any] = {}
    if not names:
        others = _by_camera_and_prism(cost, best, given)
    fit = linear_fit(cost, given | errors | others)
    names = names or _told(fit, [*given, *others], groups)
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


def _by_errors(cost: Cost, best: Vector) -> dict[str, Any]:
    """Return the derivatives of the residuals by errors of the angles, by name, for a still camera."""
    space = cost.space
    drifts = cost.brightness.pairs.arrays.slope.shape[0] > 0
    if space.moving or drifts or not orbit_of(space):
        return {}
    patterns = patterns_of(cost)
    columns = {}
    for group in examined_errors(MODELS[space.model]):
        for name in group:
            columns[name] = shifted(cost, best, patterns[name], _angle_of(name))
    return columns


def _told(
    fit: LinearFit,
    others: Sequence[str],
    groups: Sequence[Iterable[str]],
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
        _, significance, gain = fit.adding((*others, *rest), tuple(group))
        if significance >= share * SIGNIFICANT and gain >= share * LEAST_ANGLE_GAIN:
            names += group
    return tuple(names)
