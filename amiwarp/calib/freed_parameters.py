"""Decision which of clock offset, tilt and index to calibrate: those that size and phase cannot imitate."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from amiwarp.calib.groundwork import TILT
from amiwarp.calib.photometric.descent import LEAST_CURVATURE, UNDETERMINED_PX
from amiwarp.calib.timing_blur import motion_per_angle
from amiwarp.calib.trial import LARGEST_MOTION_PX, SIGNIFICANT_STD, Trial, in_pixels, largest_tilt
from amiwarp.events.recording import Recording
from amiwarp.results.calibration import Calibration, FreedParameter
from amiwarp.results.parameters import MOTION

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
    photometric = exact.photometric
    if photometric is not None and set(MOTION) & set(photometric.sharpness_parameters):
        return ()
    names = []
    for group in GROUPS.values():
        names += [name for name in group if name not in exact.parameters]
    if recording.encoder is None and "clock_offset" in names:
        names.remove("clock_offset")
    return tuple(names)


def judge_parameters(trial: Trial, names: tuple[str, ...]) -> tuple[FreedParameter, ...]:
    """Decide for each group of the parameters ``names`` whether to free it, and whether a free rpm is determined."""
    found = [
        _judge(trial, group) for group, members in GROUPS.items() if set(members) <= set(names)
    ]
    if "rpm" in trial.exact.uncertainty:
        found.append(_free_speed(trial))
    return tuple(found)


def _free_speed(trial: Trial) -> FreedParameter:
    """Return whether the speed is determined that was free because there is no encoder."""
    rad_per_us = trial.exact.uncertainty["rpm"] * (math.tau / 60e6)
    # over the times of the events, which are spread evenly
    angle = rad_per_us * trial.duration_us / math.sqrt(12.0)
    std_px = angle * motion_per_angle(trial.path)
    determined = std_px <= UNDETERMINED_PX
    verdict = "free: there is no encoder"
    if not determined:
        verdict = f"{verdict}; not determined: {REMEDY['rpm']}"
    return FreedParameter(
        name="rpm",
        freed=True,
        determined=determined,
        std_px=std_px,
        gain_px=None,
        verdict=verdict,
    )


def _judge(trial: Trial, group: str) -> FreedParameter:
    """Decide whether to free a group: it must be determined, and held-out turns must become sharper with it."""
    space = trial.space
    members = GROUPS[group]
    if not set(members) <= set(space.names):
        return _no_tilt(trial.exact)
    if not set(members) <= set(trial.tested):
        most = min(trial.motion_range(n) for n in members)
        return _undetermined(
            group, None, f"independently of apex and phase it moves events by at most {most:.2g} px"
        )

    # Whether the events determine the group next to size and phase.
    which = [0, 1, *(trial.tested.index(n) for n in members)]
    rows = [space.names.index(n) for n in members]
    longer = np.abs(trial.directions[rows, rows])
    quadratic = trial.quadratic.restricted_to(which)
    std = float((quadratic.deviations()[2:] * longer).max())
    share = float(1.0 / longer.max() ** 2)
    if not (std <= UNDETERMINED_PX and share >= LEAST_CURVATURE):
        how = f"± {std:.2g} px" if std < LARGEST_MOTION_PX else f"over ± {LARGEST_MOTION_PX:g} px"
        return _undetermined(group, std, f"{how}, {share:.1g} of the largest curvature")

    # Whether held-out turns are sharper with it.
    held = trial.test.of_parts(space, trial.sharpest([0, 1]))
    freed = trial.test.of_parts(space, trial.sharpest(which))
    _, _, gain = trial.as_motion(freed - held)
    moved = float(np.linalg.norm(quadratic.step_to_maximum()[2:]))
    wins = gain[0] > 0.0 and moved > trial.budget_px
    worth = f"{max(gain[0], 0.0):.3f} to {in_pixels(max(gain[1], 0.0))}"
    evidence = (
        f"it moves events by {moved:.3f} px; the gain on held-out turns is equivalent to {worth}"
    )
    return FreedParameter(
        name=group,
        freed=wins,
        determined=True,
        std_px=std,
        gain_px=gain,
        verdict=f"{'freed' if wins else 'held'}: {evidence}",
    )


def _no_tilt(exact: Calibration) -> FreedParameter:
    """Return the decision on a tilt that the photometric stage has ruled out."""
    assert exact.photometric is not None
    assert exact.photometric.center_px is not None
    verdict = f"held: the photometric stage finds that it moves events by at most {largest_tilt(exact):.3f} px"
    std = exact.photometric.center_px[1]
    return FreedParameter(
        name="tilt", freed=False, determined=True, std_px=std, gain_px=None, verdict=verdict
    )


def _undetermined(group: str, std_px: float | None, why: str) -> FreedParameter:
    """Return the decision to hold a group that the recording does not determine."""
    verdict = f"not determined ({why}): {REMEDY[group]}"
    return FreedParameter(
        name=group, freed=False, determined=False, std_px=std_px, gain_px=None, verdict=verdict
    )


def held_instead(parameter: FreedParameter, why: str) -> FreedParameter:
    """Return the decision for a parameter, not to free it after all; one that was not freed remains as it is."""
    if parameter.name not in GROUPS or not parameter.freed:
        return parameter
    return replace(parameter, freed=False, verdict=f"held: {why}")


def confirmed_freedom(
    trial: Trial, parameter: FreedParameter, again: Calibration
) -> FreedParameter:
    """Keep a parameter free only if the second calibration changed it significantly and beyond the error budget."""
    if parameter.name not in GROUPS or not parameter.freed:
        return parameter
    start = {**trial.space.start, "clock_offset": trial.encoder.clock_offset_us}
    moved = 0.0
    significant = False
    for name in GROUPS[parameter.name]:
        k = trial.space.names.index(name)
        shift = again.parameters[name] - start[name]
        moved = math.hypot(moved, shift * trial.space.pixels[name] / float(trial.directions[k, k]))
        # a parameter that the photometric stage did not determine has no standard deviation
        significant |= abs(shift) > SIGNIFICANT_STD * again.uncertainty.get(name, math.inf)
    if significant and moved > trial.budget_px:
        return parameter
    why = f"a calibration with it free moved events by {moved:.3f} px, not significantly over the budget"
    return held_instead(parameter, why)
