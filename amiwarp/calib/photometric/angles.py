"""Steps of the stage for errors of the prism's angle: what repeats every turn, and delays of the read-out."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
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
from amiwarp.optics.camera import Camera
from amiwarp.optics.models import MODELS

if TYPE_CHECKING:
    Vector = NDArray[np.float64]

HARMONICS = ("cos 1", "sin 1", "cos 2", "sin 2")
"""Names of the unknown factors of cos e, sin e, cos 2e and sin 2e in the error of the encoder's angle e."""
SKEW = ("skew x", "skew y")
"""Names of the unknown changes of the prism's angle from column to column and from row to row [rad/px]."""
PATTERNS = (*HARMONICS, *SKEW)
"""Names of all errors of the prism's angle that are examined, in the order of ``PairSet.angle_patterns``."""
LEAST_ANGLE_GAIN = 0.01
"""Smallest share that an error of the prism's angle must remove. Right angles leave 0.003 at most."""
FIRST_LOOK = 0.5
"""Share of what is asked of an error of the angle that it must have before all that may look like it is examined."""
MOST_ANGLE_FITS = 6
"""Largest number of linearised fits of the errors of the angle."""
FIRST_SHARE, LEAST_SHARE = 0.5, 0.25
"""Share of the error that the first linearised fit is taken to find, and the least share of a later one."""
LEAST_ANGLE_PX = 0.003
"""Length of a correction of the angle below which the search ends [px rms]."""


def examine_the_angle_first(state: Refinement) -> Refinement:
    """End if the angles have an error, so that it is corrected before lens and prism are examined."""
    return state if state.problem.angles_hold else _without_angle_error(state)


def examine_the_angle_last(state: Refinement) -> Refinement:
    """Refuse the answer if its angles have an error although lens and prism were corrected first."""
    return _without_angle_error(state) if state.problem.angles_hold and not state.refusal else state


def _without_angle_error(state: Refinement) -> Refinement:
    """Note an error of the angles, and end unless it is but a small delay of the read-out."""
    if not state.are_angles_examined:
        return state
    search = state.search
    v = state.answer.x
    error = find_angle_error(search, v)
    if error is None:
        return state
    x_us, y_us = -error[4:] / (state.problem.direction * state.problem.rad_per_us)
    found = AngleError(
        harmonics=tuple(error[:4].tolist()) if error[:4].any() else (),
        late_us=(float(x_us), float(y_us)),
        late_px=skew_px(state.space.camera, error, px_per_rad(state.space, v)),
    )
    state = state.noticing(found)
    if refused(found):
        return state.ending()
    search.cost.renew(v)
    return state


def find_angle_error(search: AnswerSearch, v: Vector) -> Vector | None:
    """Return the correction of the prism's angle that the events ask for; None for none.

    It is the factors of :data:`PATTERNS`, shape (6,). A linearised fit finds a share of the error only, because the map
    absorbs the other part; the next fit tells how large the share was. The pairs' angles are the given ones again
    afterwards; the map is left at the corrected ones.
    """
    cost = search.cost
    camera = cost.space.camera
    cost.converge(v)
    found = fit_angles(cost, v)
    if found is None or found.moved_px < LEAST_MOVE_PX:
        return None
    pairs = cost.brightness.pairs
    waves = pairs.angle_patterns(_middle(camera)).numpy().reshape(6, 2, -1)
    angle = np.arctan2(waves[1], waves[0])
    azimuth = pairs.arrays.azimuth
    given = wp.clone(azimuth)
    total = np.zeros(6)
    share = FIRST_SHARE
    at = v
    try:
        for _ in range(MOST_ANGLE_FITS):
            step = found.change / share
            total += step
            bent = angle + np.tensordot(total, waves, 1)
            azimuth.assign(np.stack([np.cos(bent), np.sin(bent)], axis=1).astype(np.float32).ravel())
            cost.renew(at)
            at = search.descend(at).x
            if found.moved_px / share < LEAST_ANGLE_PX:
                break
            cost.converge(at)
            before = found
            again = fit_angles(cost, at, found.names)
            assert again is not None
            found = again
            share = float(np.clip((before.change - found.change) @ step / (step @ step), LEAST_SHARE, 1.0))
    finally:
        azimuth.assign(given)
    return total


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
    angles = _by_patterns(cost, best)
    groups = [{name: angles[name] for name in group} for group in (HARMONICS, SKEW) if angles.keys() >= {*group}]
    if not angles or not (names or telling(cost, groups, LEAST_ANGLE_GAIN)):
        return None
    given = slopes(cost, cost.space, best, cost.space.names)
    if not names and not _told(linear_fit(cost, given | angles), [*given], groups, FIRST_LOOK):
        return None
    given |= by_rotation(cost, best)
    given |= by_cause(cost, best, ASPECT) if ASPECT in testable(cost.space) else {}
    others: dict[str, Any] = {}
    if not names:
        # cylinder power stands for wobble too, which has nearly the same effect
        for cause in (c for c in testable(cost.space) if c in SCREENED and c not in (INDEX, SEAT)):
            others |= {n: x for n, x in by_cause(cost, best, cause).items() if n not in given}
    fit = linear_fit(cost, given | angles | others)
    names = names or _told(fit, [*given, *others], groups)
    if not names:
        return None
    found = dict(zip(names, fit.fit((*given, *names)).change[len(given) :].tolist(), strict=True))
    change = np.array([found.get(name, 0.0) for name in PATTERNS])
    return AngleFit(names, change, px_per_rad(cost.space, best) * rms_angle(cost.space.camera, change))


def _by_patterns(cost: Cost, best: Vector) -> dict[str, Any]:
    """Return the derivatives of the residuals by patterns of the prism's angle, for a still camera."""
    pairs = cost.brightness.pairs
    one_angle = MODELS[cost.space.model].ANGLES == 1
    drifts = bool(pairs.arrays.slope.shape[0])
    if cost.space.moving or drifts or not (one_angle and orbit_of(cost.space)):
        return {}
    rows = pairs.angle_patterns(_middle(cost.space.camera))
    # harmonics of a vibration's angle look like those of its motion
    examined = PATTERNS if MODELS[cost.space.model].PRISM else SKEW
    return {name: shifted(cost, best, rows[PATTERNS.index(name)]) for name in examined}


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


def skew_px(camera: Camera, error: Vector, px_per_rad: float) -> float:
    """Return how far the delay of the read-out in an ``error`` of the angle moves events [px rms]."""
    return px_per_rad * rms_angle(camera, np.append(np.zeros(4), error[4:]))


def _middle(camera: Camera) -> tuple[float, float]:
    return 0.5 * camera.width, 0.5 * camera.height
