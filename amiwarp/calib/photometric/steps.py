"""Photometric stage: the parameters for which one brightness map of the scene explains the events.

Sharpness is biased by the sensor's hysteresis. This stage models the hysteresis by its equations, see
:mod:`amiwarp.brightness.solver`. For given parameters the map is the solution of a linear least-squares problem. The
parameters minimise its robust residual. :func:`refine` searches for the answer, and then takes :data:`STEPS`.
"""

from __future__ import annotations

from dataclasses import replace

from amiwarp.calib.photometric.angles import examine_the_angles_first, examine_the_angles_last
from amiwarp.calib.photometric.camera_motion import follow_a_fast_camera, follow_a_slow_camera
from amiwarp.calib.photometric.corrections import (
    correct_camera_and_prism,
    judge_the_consistency,
    name_the_corrections,
)
from amiwarp.calib.photometric.equations import Problem
from amiwarp.calib.photometric.fast_motion import (
    bound_what_blind_pixels_hide,
    weigh_the_refractory_doubt,
)
from amiwarp.calib.photometric.findings import (
    AngleError,
    MotionError,
    MovingParts,
    SectorError,
)
from amiwarp.calib.photometric.losses import (
    count_lost_events,
    give_up_a_worse_answer,
    refuse_moving_parts,
    see_what_can_be_examined,
)
from amiwarp.calib.photometric.refinement import Refinement, Step, first_answer
from amiwarp.calib.photometric.sectors import note_what_sectors_leave
from amiwarp.calib.photometric.steadiness import refuse_unsteady_motion
from amiwarp.calib.photometric.timing import (
    estimate_the_timing,
    find_slow_pixels,
    find_the_refractory_period,
)
from amiwarp.calib.photometric.verdicts import accepted_in_words, warnings
from amiwarp.results.calibration import PhotometricSummary, StageSummary
from amiwarp.results.parameters import ParameterSpace

STEPS: tuple[Step, ...] = (
    follow_a_fast_camera,
    follow_a_slow_camera,
    give_up_a_worse_answer,
    refuse_moving_parts,
    see_what_can_be_examined,
    examine_the_angles_first,
    estimate_the_timing,
    find_the_refractory_period,
    find_slow_pixels,
    refuse_unsteady_motion,
    bound_what_blind_pixels_hide,
    correct_camera_and_prism,
    judge_the_consistency,
    name_the_corrections,
    note_what_sectors_leave,
    weigh_the_refractory_doubt,
    count_lost_events,
    examine_the_angles_last,
)
"""The stage, in order. Each step returns the state unchanged if it does not apply."""


def refine(problem: Problem) -> Refinement:
    """Run the photometric stage. Raises :class:`AmiwarpError` for too few pairs of events."""
    state = first_answer(problem, problem.settings.sensor)
    for step in STEPS:
        state = step(state)
        if state.finished:
            break
    return state


def summarised(state: Refinement) -> tuple[PhotometricSummary, StageSummary, ParameterSpace]:
    """Return the result of the stage, the summary of the search, and the space of the result.

    Camera and prism of the space are the corrected ones.
    """
    answer = state.answer
    space = state.space
    check = state.check
    reason = state.refusal
    harmonics = [
        found.harmonics
        for found in state.findings
        if isinstance(found, AngleError | SectorError) and found.harmonics
    ]
    stated = [found for found in state.findings if isinstance(found, MotionError)]
    moving = [found.parts for found in state.findings if isinstance(found, MovingParts)]
    result = PhotometricSummary(
        accepted=not reason,
        verdict=reason or accepted_in_words(answer.optimum),
        parameters=answer.parameters,
        uncertainty={**state.rotation, **answer.uncertainty},
        sharpness_parameters=state.search.sharpest,
        moved_px=answer.moved_px,
        cost=answer.cost,
        cost_at_sharpness=answer.cost_at_sharpness,
        residual=answer.residual,
        pairs=len(state.equations.pairs),
        off_over_on=answer.off_over_on,
        leak=answer.leak,
        refractory_us=state.sensor.pause_us,
        time_constant_us=state.time_constant_us,
        rotation_gain=0.0 if check is None else check.rotation_gain,
        center_px=None if check is None else check.center_px,
        held=state.held,
        harmonics=harmonics[0] if harmonics else (),
        moving=moving[0] if moving else (),
        deviation_px=stated[0].deviation_px if stated else None,
        hidden_px={**stated[0].hidden_px, **state.hidden_px} if stated else {},
        warnings=warnings(state.findings),
    )
    summary = StageSummary.of(
        "photometric", answer.stage, space.names, map(space.to_values, answer.stage.points)
    )
    return result, summary, replace(space, names=(*space.names, *state.rotation))
