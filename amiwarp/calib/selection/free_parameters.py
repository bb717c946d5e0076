"""Decision which of clock offset, tilt and index to calibrate: those that size and phase cannot imitate."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from amiwarp.calib.parameters import MOTION
from amiwarp.calib.photometric.gauss_newton import LEAST_CURVATURE, UNDETERMINED_PX
from amiwarp.calib.result import Calibration
from amiwarp.calib.selection.groundwork import TILT
from amiwarp.calib.selection.smaller_models import motion_per_angle
from amiwarp.calib.selection.trial import LARGEST_MOTION_PX, SIGNIFICANT_STD, Trial, in_pixels, largest_tilt
from amiwarp.calib.summaries import FreedParameter

if TYPE_CHECKING:
    from amiwarp.calib.sharpness.search import Settings
    from amiwarp.events.recording import Recording

GROUPS = {"clock_offset": ("clock_offset",), "tilt": TILT, "index": ("index",)}
"""Parameters that the automatic calibration may free, in groups that are freed together."""
REMEDY = {
    "clock_offset": "record at two speeds, or while the prism speeds up: at one speed it is part of the phase",
    "tilt": "record through a wider lens or a stronger prism, with edges near the image's border",
    "index": "give it: through this lens its effect is the same as that of the apex",
    "rpm": "record more turns of a still scene, or use an encoder",
}
"""Advice to the user for each group of parameters that a recording does not determine."""


def candidate_names(recording: Recording, exact: Calibration) -> tuple[str, ...]:
    """Return the names of the parameters that the automatic calibration may free.

    These are none if the camera rotated, which blurs the image. Without an encoder the clock offset is part of the
    phase.
    """
    p = exact.photometric
    if p is not None and any(n in p.sharpness_parameters for n in MOTION):
        return ()
    names = [n for group in GROUPS.values() for n in group if n not in exact.parameters]
    return tuple(n for n in names if n != "clock_offset" or recording.encoder is not None)


def judge_parameters(trial: Trial, names: tuple[str, ...]) -> tuple[FreedParameter, ...]:
    """Decide for each group of the parameters ``names`` whether to free it, and whether a free rpm is determined."""
    found = [_judge(trial, group) for group, members in GROUPS.items() if set(members) <= set(names)]
    if "rpm" in trial.exact.uncertainty:
        angle = trial.exact.uncertainty["rpm"] * (math.tau / 60e6) * trial.duration_us / math.sqrt(12.0)
        std = angle * motion_per_angle(trial.path)
        determined = std <= UNDETERMINED_PX
        verdict = (
            "free: there is no encoder" if determined else f"free: there is no encoder; not determined: {REMEDY['rpm']}"
        )
        found.append(
            FreedParameter(name="rpm", freed=True, determined=determined, std_px=std, gain_px=None, verdict=verdict)
        )
    return tuple(found)


def _judge(trial: Trial, group: str) -> FreedParameter:
    """Decide whether to free a group: it must be determined, and held-out turns must become sharper with it."""
    space, members = trial.space, GROUPS[group]
    if not set(members) <= set(space.names):
        return _no_tilt(trial.exact)
    if not set(members) <= set(trial.tested):
        most = min(trial.motion_range(n) for n in members)
        return _undetermined(group, None, f"independently of apex and phase it moves events by at most {most:.2g} px")
    which = [0, 1, *(trial.tested.index(n) for n in members)]
    rows = [space.names.index(n) for n in members]
    longer = np.abs(trial.directions[rows, rows])
    quadratic = trial.quadratic.restricted_to(which)
    std = float((quadratic.deviations()[2:] * longer).max())
    share = float(1.0 / longer.max() ** 2)
    if not (std <= UNDETERMINED_PX and share >= LEAST_CURVATURE):
        how = f"± {std:.2g} px" if std < LARGEST_MOTION_PX else f"over ± {LARGEST_MOTION_PX:g} px"
        return _undetermined(group, std, f"{how}, {share:.1g} of the largest curvature")
    held, freed = (trial.test.each(space, trial.sharpest(k)) for k in ([0, 1], which))
    _, _, gain = trial.as_motion(freed - held)
    moved = float(np.linalg.norm(quadratic.step_to_maximum()[2:]))
    wins = gain[0] > 0.0 and moved > trial.budget_px
    worth = f"{max(gain[0], 0.0):.3f} to {in_pixels(max(gain[1], 0.0))}"
    evidence = f"it moves events by {moved:.3f} px; the gain on held-out turns is equivalent to {worth}"
    return FreedParameter(
        name=group, freed=wins, determined=True, std_px=std, gain_px=gain,
        verdict=f"{'freed' if wins else 'held'}: {evidence}",
    )  # fmt: skip


def _no_tilt(exact: Calibration) -> FreedParameter:
    """Return the decision on a tilt that the photometric stage has ruled out."""
    assert exact.photometric is not None
    assert exact.photometric.center_px is not None
    verdict = f"held: the photometric stage finds that it moves events by at most {largest_tilt(exact):.3f} px"
    std = exact.photometric.center_px[1]
    return FreedParameter(name="tilt", freed=False, determined=True, std_px=std, gain_px=None, verdict=verdict)


def _undetermined(group: str, std_px: float | None, why: str) -> FreedParameter:
    verdict = f"not determined ({why}): {REMEDY[group]}"
    return FreedParameter(name=group, freed=False, determined=False, std_px=std_px, gain_px=None, verdict=verdict)


def freed_names(parameters: tuple[FreedParameter, ...]) -> tuple[str, ...]:
    """Return the names of the parameters to free in a second calibration."""
    return tuple(n for p in parameters if p.freed and p.name in GROUPS for n in GROUPS[p.name])


def freed_settings(exact: Calibration, settings: Settings, names: tuple[str, ...]) -> Settings:
    """Return the settings of a second calibration with more free parameters, started at the first one's values."""
    start = {**settings.start, **exact.parameters}
    return replace(settings, free=(*exact.free, *names), start=start, global_algorithm=None)


def confirm_freed(
    trial: Trial, parameters: tuple[FreedParameter, ...], again: Calibration
) -> tuple[FreedParameter, ...]:
    """Keep a parameter free only if the second calibration changed it significantly and beyond the error budget."""
    return tuple(p if p.name not in GROUPS or not p.freed else _confirmed(trial, p, again) for p in parameters)


def hold_all(parameters: tuple[FreedParameter, ...], why: str) -> tuple[FreedParameter, ...]:
    """Mark all parameters as not freed, because the second calibration failed for the reason ``why``."""
    held = (replace(p, freed=False, verdict=f"held: the calibration fails with it free: {why}") for p in parameters)
    return tuple(h if p.name in GROUPS and p.freed else p for p, h in zip(parameters, held, strict=True))


def _confirmed(trial: Trial, p: FreedParameter, again: Calibration) -> FreedParameter:
    start = {**trial.space.start, "clock_offset": trial.encoder.clock_offset_us}
    moved, significant = 0.0, False
    for name in GROUPS[p.name]:
        k = trial.space.names.index(name)
        shift = again.parameters[name] - start[name]
        moved = math.hypot(moved, shift * trial.space.pixels[name] / float(trial.directions[k, k]))
        # a parameter that the photometric stage did not determine has no standard deviation
        significant |= abs(shift) > SIGNIFICANT_STD * again.uncertainty.get(name, math.inf)
    if significant and moved > trial.budget_px:
        return p
    verdict = f"held: a calibration with it free moved events by {moved:.3f} px, not significantly over the budget"
    return replace(p, freed=False, verdict=verdict)
