"""Photometric stage: the parameters for which one brightness map of the scene explains the events.

Sharpness is biased by the sensor's hysteresis. This stage models the hysteresis by its equations, see
:mod:`amiwarp.brightness.solver`. For given parameters the map is the solution of a linear least-squares problem. The
parameters minimise its robust residual. :func:`refine` searches for the answer, and then takes the :data:`STEPS` that
apply.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from amiwarp.calib.photometric.angles import examine_accepted_angles, examine_the_angles
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
from amiwarp.optics.models.registry import MODELS
from amiwarp.results.calibration import PhotometricSummary, StageSummary
from amiwarp.results.parameters import ParameterSpace

Condition = Callable[[Problem], bool]
"""Whether a step applies to a model and a recording. What the events tell is for the step itself."""


def always(problem: Problem) -> bool:
    """Return that a step applies to all models and recordings."""
    return True


def camera_is_fast(problem: Problem) -> bool:
    """Return whether the camera is in fast motion."""
    return problem.fast


def camera_moves(problem: Problem) -> bool:
    """Return whether the camera's motion is free or known."""
    return problem.sharp.full_space.moving


def angles_hold(problem: Problem) -> bool:
    """Return whether camera and prism are corrected before an error of the angles is looked for."""
    return problem.angles_hold


def angles_are_doubted(problem: Problem) -> bool:
    """Return whether an error of the angles is looked for before camera and prism are corrected."""
    return not problem.angles_hold


def pixels_are_blind(problem: Problem) -> bool:
    """Return whether the image moves so fast that pixels miss events: behind a mirror, or of a vibrating camera."""
    return not MODELS[problem.sharp.space.model].PRISM


def vibration_is_unmeasured(problem: Problem) -> bool:
    """Return whether a camera vibrates without an encoder, so that all of its motion is found in the events."""
    return pixels_are_blind(problem) and problem.recording.encoder is None


STEPS: tuple[tuple[Condition, Step], ...] = (
    (camera_is_fast, follow_a_fast_camera),
    (camera_moves, follow_a_slow_camera),
    (always, give_up_a_worse_answer),
    (always, refuse_moving_parts),
    (always, see_what_can_be_examined),
    (angles_are_doubted, examine_the_angles),
    (always, estimate_the_timing),
    (always, find_the_refractory_period),
    (always, find_slow_pixels),
    (vibration_is_unmeasured, refuse_unsteady_motion),
    (pixels_are_blind, bound_what_blind_pixels_hide),
    (always, correct_camera_and_prism),
    (always, judge_the_consistency),
    (always, name_the_corrections),
    (always, note_what_sectors_leave),
    (pixels_are_blind, weigh_the_refractory_doubt),
    (always, count_lost_events),
    (angles_hold, examine_accepted_angles),
)
"""The stage, in order: to what each step applies, and the step. If nothing is to be done, it returns the same state."""


def refine(problem: Problem) -> Refinement:
    """Run the photometric stage. Raises :class:`AmiwarpError` for too few pairs of events."""
    state = first_answer(problem, problem.settings.sensor)
    for applies, step in STEPS:
        if applies(problem):
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
