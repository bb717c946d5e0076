"""Clock offset, tilt, index and rpm: each freed only where the recording tells it from size and phase."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from amiwarp.calib.parameters import MOTION
from amiwarp.calib.photometric.gauss_newton import LEAST_CURVATURE, UNDETERMINED_PX
from amiwarp.calib.result import Calibration, FreedParameter
from amiwarp.calib.selection.trial import FARTHEST_PX, SURE, Trial, in_pixels

if TYPE_CHECKING:
    from amiwarp.calib.sharpness.search import Settings
    from amiwarp.events.recording import Recording

GROUPS = {"clock_offset": ("clock_offset",), "tilt": ("tilt_x", "tilt_y"), "index": ("index",)}
"""What may be freed, together where one alone makes no sense."""
REMEDY = {
    "clock_offset": "record at two speeds, or while the prism speeds up: at one speed it is part of the phase",
    "tilt": "record through a wider lens or a stronger prism, with edges near the image's border",
    "index": "through this lens it cannot be told from the apex: give it",
    "rpm": "record more turns of a still scene, or use an encoder",
}


def candidates(recording: Recording, exact: Calibration) -> tuple[str, ...]:
    """What may be freed: without an encoder the clock offset is phase, and a camera that turned blurs everything."""
    p = exact.photometric
    if p is not None and any(n in p.sharpness_parameters for n in MOTION):
        return ()
    names = [n for group in GROUPS.values() for n in group if n not in exact.parameters]
    return tuple(n for n in names if n != "clock_offset" or recording.encoder is not None)


def judge_parameters(trial: Trial) -> tuple[FreedParameter, ...]:
    """Whether each group of the trial's names is determined, and wins on held-out turns; and how good the rpm is."""
    found = [_judge(trial, group) for group, members in GROUPS.items() if set(members) <= set(trial.space.names)]
    if "rpm" in trial.exact.uncertainty:
        turn = trial.exact.uncertainty["rpm"] * (math.tau / 60e6) * trial.duration_us / math.sqrt(12.0)
        std = turn * trial.places.lever(trial.exact.model)
        sure = std <= UNDETERMINED_PX
        verdict = (
            "free: there is no encoder" if sure else f"free for want of an encoder, not determined: {REMEDY['rpm']}"
        )
        found.append(FreedParameter("rpm", True, sure, std, None, verdict))
    return tuple(found)


def _judge(trial: Trial, group: str) -> FreedParameter:
    space, members = trial.space, GROUPS[group]
    if not set(members) <= set(trial.tried):
        room = min(trial.room(n) for n in members)
        why = f"past apex and phase it moves events by at most {room:.2g} px"
        return FreedParameter(group, False, False, None, None, f"not determined ({why}): {REMEDY[group]}")
    which = [0, 1, *(trial.tried.index(n) for n in members)]
    places = [space.names.index(n) for n in members]
    longer = np.abs(trial.directions[places, places])
    std = float((trial.bend.of(which).deviations()[2:] * longer).max())
    share = float(1.0 / longer.max() ** 2)
    if not (std <= UNDETERMINED_PX and share >= LEAST_CURVATURE):
        how = f"± {std:.2g} px" if std < FARTHEST_PX else f"over ± {FARTHEST_PX:g} px"
        why = f"{how}, {share:.1g} of the largest curvature"
        return FreedParameter(group, False, False, std, None, f"not determined ({why}): {REMEDY[group]}")
    held, freed = (trial.test.each(space, trial.sharpest(k)) for k in ([0, 1], which))
    _, _, gain = trial.seen(freed - held)
    moved = float(np.linalg.norm(trial.bend.of(which).top()[2:]))
    wins = gain[0] > 0.0 and moved > trial.budget_px
    worth = f"{max(gain[0], 0.0):.3f} to {in_pixels(max(gain[1], 0.0))}"
    what = f"moved by {moved:.3f} px; held-out turns gain what {worth} are worth"
    return FreedParameter(group, wins, True, std, gain, f"{'freed' if wins else 'held'}: {what}")


def wanted(parameters: tuple[FreedParameter, ...]) -> tuple[str, ...]:
    """Names to free in a second calibration."""
    return tuple(n for p in parameters if p.freed and p.name in GROUPS for n in GROUPS[p.name])


def freed_settings(exact: Calibration, settings: Settings, names: tuple[str, ...]) -> Settings:
    """Of a second calibration, from the first one's answer, with more free."""
    start = {**settings.start, **exact.parameters}
    return replace(settings, free=(*exact.free, *names), start=start, global_algorithm=None)


def confirm(trial: Trial, parameters: tuple[FreedParameter, ...], again: Calibration) -> tuple[FreedParameter, ...]:
    """What was freed stays so where the second calibration moved it surely, and by more than the budget."""
    return tuple(p if p.name not in GROUPS or not p.freed else _confirmed(trial, p, again) for p in parameters)


def refused(parameters: tuple[FreedParameter, ...], why: str) -> tuple[FreedParameter, ...]:
    """All held: with them free there is no calibration."""
    held = (replace(p, freed=False, verdict=f"held: with it free, {why}") for p in parameters)
    return tuple(h if p.name in GROUPS and p.freed else p for p, h in zip(parameters, held, strict=True))


def _confirmed(trial: Trial, p: FreedParameter, again: Calibration) -> FreedParameter:
    start = {**trial.space.start, "clock_offset": trial.material.encoder.clock_offset_us}
    moved, sure = 0.0, False
    for name in GROUPS[p.name]:
        k = trial.space.names.index(name)
        shift = again.parameters[name] - start[name]
        moved = math.hypot(moved, shift * trial.space.pixels[name] / float(trial.directions[k, k]))
        # what the photometric stage found undetermined has no deviation
        sure |= abs(shift) > SURE * again.uncertainty.get(name, math.inf)
    if sure and moved > trial.budget_px:
        return p
    verdict = f"held: calibrated with it free, it moved events by {moved:.3f} px, not surely over the budget"
    return replace(p, freed=False, verdict=verdict)
