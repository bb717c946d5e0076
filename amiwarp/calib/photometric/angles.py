"""Steps of the stage for errors of the optic's angles: what repeats every turn, and delays of the read-out.

What an angle's sensor or command gets wrong is a function of that angle: an encoder off centre, a motor that ripples
between index pulses, a mirror that does not follow its command in proportion. It is described by harmonics of the
angle, for each angle of the model alike. A tilt with a cubic error, cos u + k cos³ u, is a larger tilt by the angle
u + k/2 sin 2u, to first order in k; one with a square error the tilt by u + k sin u.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
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
from amiwarp.optics.models import MODELS, Model

if TYPE_CHECKING:
    from amiwarp.calib.parameters import ParameterSpace

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
FIRST_SHARE, LEAST_SHARE = 0.5, 0.25
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
    # harmonics of a vibration's angle look like those of its motion
    return (*harmonics, SKEW) if kind.PRISM else (SKEW,)


def examine_the_angles_first(state: Refinement) -> Refinement:
    """End if the angles have an error, so that it is corrected before lens and prism are examined."""
    return state if state.problem.angles_hold else _without_angle_errors(state)


def examine_the_angles_last(state: Refinement) -> Refinement:
    """Refuse the answer if its angles have an error although lens and prism were corrected first."""
    return _without_angle_errors(state) if state.problem.angles_hold and not state.refusal else state


def _without_angle_errors(state: Refinement) -> Refinement:
    """Note errors of the angles, and end unless there is but a small delay of the read-out."""
    if not state.are_angles_examined:
        return state
    search = state.search
    v = state.answer.x
    errors = find_angle_errors(search, v)
    if errors is None:
        return state
    kind = MODELS[state.space.model]
    harmonics = tuple(errors.get(name, 0.0) for k in range(kind.ANGLES) for name in harmonics_of(k))
    skew = np.array([errors.get(name, 0.0) for name in SKEW])
    late_us = -skew / (state.problem.direction * state.problem.rad_per_us)
    found = AngleError(
        model=state.space.model,
        harmonics=harmonics if any(harmonics) else (),
        late_us=(float(late_us[0]), float(late_us[1])),
        late_px=moved_px(state.space, v, dict(zip(SKEW, skew.tolist(), strict=True))),
    )
    state = state.noticing(found)
    if refused(found):
        return state.ending()
    search.cost.renew(v)
    return state


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
    names = [*found]
    azimuth = cost.brightness.pairs.arrays.azimuth
    given = wp.clone(azimuth)
    patterns = {name: pattern.numpy().reshape(2, -1) for name, pattern in patterns_of(cost).items()}
    total = np.zeros(len(names))
    share = FIRST_SHARE
    at = v
    try:
        for _ in range(MOST_ANGLE_FITS):
            change = np.array([*found.values()])
            step = change / share
            total += step
            errors = dict(zip(names, total.tolist(), strict=True))
            azimuth.assign(bent(given.numpy(), errors, patterns, MODELS[cost.space.model].ANGLES))
            cost.renew(at)
            at = search.descend(at).x
            if moved_px(cost.space, at, found) / share < LEAST_ANGLE_PX:
                break
            cost.converge(at)
            again = fit_angles(cost, at, tuple(names))
            assert again is not None
            found = again
            left = np.array([*found.values()])
            share = float(np.clip((change - left) @ step / (step @ step), LEAST_SHARE, 1.0))
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
        rows = pairs.angle_patterns((0.5 * camera.width, 0.5 * camera.height))
        return {name: rows[k] for k, name in enumerate((*harmonics_of(0), *SKEW))}
    found: dict[str, Any] = {}
    stored = pairs.arrays.azimuth.numpy().reshape(2, angles, -1)  # first and second events, both angles
    for k in range(angles):
        angle = stored[:, k].astype(np.float64)
        waves = (np.cos(angle), np.sin(angle), np.cos(2.0 * angle), np.sin(2.0 * angle))
        for name, wave in zip(harmonics_of(k), waves, strict=True):
            found[name] = wp.array(wave.ravel().astype(np.float32), dtype=float, device=pairs.device)
    return found


def bent(stored: Vector, errors: dict[str, float], patterns: dict[str, Vector], angles: int) -> NDArray[np.float32]:
    """Return what is stored for the events of pairs after their angles have changed by errors, given by name.

    ``stored`` and the result have the form of the pairs' ``azimuth``, shape (4 · padded pairs,).
    """
    parts = stored.reshape(2, 2, -1)
    given = parts.swapaxes(0, 1) if angles > 1 else np.arctan2(parts[:, 1], parts[:, 0])[None]
    changed = np.array(given, np.float64)  # shape (angles, 2, padded pairs)
    for name, factor in errors.items():
        changed[_angle_of(name)] += factor * patterns[name]
    if angles == 1:
        changed = np.stack([np.cos(changed[0]), np.sin(changed[0])])
    return changed.swapaxes(0, 1).astype(np.float32).ravel()


def _angle_of(name: str) -> int:
    """Return the number of the angle that has an error of this name."""
    return 0 if name in SKEW else int(name.rpartition(" ")[2])


def moved_px(space: ParameterSpace, v: Vector, errors: dict[str, float]) -> float:
    """Return how far errors of the angles, given by name, move events at a search vector [px rms]."""
    camera = space.camera
    spread = {SKEW[0]: camera.width / math.sqrt(12.0), SKEW[1]: camera.height / math.sqrt(12.0)}
    each = [
        px_per_rad(space, v, _angle_of(name)) * factor * spread.get(name, math.sqrt(0.5))
        for name, factor in errors.items()
    ]
    return math.hypot(*each)


def fit_angles(cost: Cost, best: Vector, names: tuple[str, ...] = ()) -> dict[str, float] | None:
    """Return the corrections ``names`` of the angles at ``best`` [px]; without names, those that are significant.

    None if there are none, or if they cannot be examined. What a slow rotation of the camera or a wrong camera or prism
    explains does not count.
    """
    space = cost.space
    errors = _by_errors(cost, best)
    groups = [
        {name: errors[name] for name in group}
        for group in examined_errors(MODELS[space.model])
        if errors.keys() >= {*group}
    ]
    if not errors or not (names or telling(cost, groups, LEAST_ANGLE_GAIN)):
        return None
    given = slopes(cost, space, best, space.names)
    if not names and not _told(linear_fit(cost, given | errors), [*given], groups, FIRST_LOOK):
        return None
    given |= by_rotation(cost, best)
    if not set(ASPECT.names) & set(space.names):
        given |= by_cause(cost, best, ASPECT)
    others: dict[str, Any] = {}
    if not names:
        # cylinder power stands for wobble too, which has nearly the same effect
        for cause in (c for c in testable(space) if c in SCREENED and c not in (INDEX, SEAT)):
            others |= {n: x for n, x in by_cause(cost, best, cause).items() if n not in given}
    fit = linear_fit(cost, given | errors | others)
    names = names or _told(fit, [*given, *others], groups)
    if not names:
        return None
    return dict(zip(names, fit.fit((*given, *names)).change[len(given) :].tolist(), strict=True))


def _by_errors(cost: Cost, best: Vector) -> dict[str, Any]:
    """Return the derivatives of the residuals by errors of the angles, by name, for a still camera."""
    space = cost.space
    pairs = cost.brightness.pairs
    drifts = bool(pairs.arrays.slope.shape[0])
    if space.moving or drifts or not orbit_of(space):
        return {}
    patterns = patterns_of(cost)
    return {
        name: shifted(cost, best, patterns[name], _angle_of(name))
        for group in examined_errors(MODELS[space.model])
        for name in group
    }


def _told(
    fit: LinearFit, others: Sequence[str], groups: Sequence[Iterable[str]], share: float = 1.0
) -> tuple[str, ...]:
    """Return the names of those groups of errors of the angles that are significant beyond the columns ``others``.

    ``share`` is a factor of what is asked of them.
    """
    names: tuple[str, ...] = ()
    for group in groups:
        rest = (n for other in groups if other is not group for n in other)
        _, significance, gain = fit.adding((*others, *rest), (*group,))
        if significance >= share * SIGNIFICANT and gain >= share * LEAST_ANGLE_GAIN:
            names = (*names, *group)
    return names
