"""Calibration of the prism from a recording, to be read from top to bottom.

:func:`calibrate` runs a :class:`Calibrator`, and for the model ``auto`` lets a :class:`ModelChooser` choose among the
models. :func:`prepare` sets up an attempt: the encoder, the events and the parameter space. The attempt is made by the
stages of the settings; the photometric stage also corrects lens, prism and sensor, see ``photometric/steps.py``.
If it still says that something is wrong, :meth:`Calibrator.run` makes further attempts. With an encoder:

1. with counts that the encoder lost put back, or with the path between pulses that come once a turn found in the events
2. with an error of the encoder that repeats every turn corrected
3. without hot and flickering pixels, if no brightness map explains the events
4. then one of these: without the parts of the image in which something moves; or, if no map explains the events, with
   the encoder's direction or scale corrected, which ends in an error that says so, or with the camera's rotation free;
   or with the rotation free, if it explains much of the rest at a low cost. A camera that never rests is calibrated
   turn by turn. The rotation is dropped from the result

Without an encoder, an attempt also examines whether the prism's speed varies, and finds the path of its angle. Another
attempt corrects an error of the path that repeats every turn.
"""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, Unpack

import numpy as np
from numpy.typing import NDArray

from amiwarp.calib import checks, first_guess, plate
from amiwarp.calib.bad_pixels import MaskedEventSource, strange_pixels, stretch
from amiwarp.calib.calibration_events import CalibrationEvents, middle_time, rotation_window, thin
from amiwarp.calib.lost_counts import lost_counts, steps_in_events, steps_in_words, without_steps
from amiwarp.calib.model_choice import ModelChooser
from amiwarp.calib.parameters import (
    CHANGES,
    GROWTH,
    LINEAR_UNKNOWNS,
    MOTION,
    RATES,
    ParameterSpace,
    best_model,
    make_space,
    nominal,
    phase_names,
    units,
)
from amiwarp.calib.photometric import causes, limits
from amiwarp.calib.photometric.distances import px_per_rad, stated_px
from amiwarp.calib.photometric.equations import Problem
from amiwarp.calib.photometric.pairs import upload_ahead, van_der_corput
from amiwarp.calib.photometric.steps import refine, summarised
from amiwarp.calib.photometric.verdicts import harmonics_in_words
from amiwarp.calib.prism_path import GATE_PAIRS, GATE_TILES, LEAST_DEVIATION_PX, PathFit, speed_in_words, varying_paths
from amiwarp.calib.pulses import off_path, pulses_only, smooth_path
from amiwarp.calib.result import Calibration, PhotometricSummary, StageSummary, constant_speed
from amiwarp.calib.settings import AUTO, CalibrationOptions, Settings
from amiwarp.calib.sharpness_search import Search, bound_warnings
from amiwarp.calib.start_burst import reaching_back, without_start_burst
from amiwarp.calib.uneven_prism import uneven_in_words
from amiwarp.errors import AmiwarpError
from amiwarp.events.device_events import check_sensor
from amiwarp.events.encoder import Encoder, check_prisms
from amiwarp.events.recording import Events, MemoryEvents, Recording
from amiwarp.optics.camera import LENS, Camera, with_lens
from amiwarp.optics.models import MODELS, ExactModel, PlateModel, predicted_error, size_names
from amiwarp.optics.prism import Plate, Prism
from amiwarp.tasks import Progress
from amiwarp.validation import check_names, guarded


@guarded
def calibrate(
    recording: Recording,
    settings: Settings | None = None,
    *,
    device: Any = "cpu",
    progress: Progress | None = None,
    **changes: Unpack[CalibrationOptions],
) -> Calibration:
    """Find the prism's parameters in the recording itself.

    Parameters
    ----------
    recording : Recording
        The recording. Its camera must be known.
    settings : Settings, optional
        Settings of the calibration; by default ``Settings()``.
    device : str or warp.context.Device
        Device that computes, such as ``cpu`` or ``cuda:0``.
    progress : Progress, optional
        Function that is called with the current stage and the finished share.
    **changes : dict
        Fields of :class:`Settings` that replace those of ``settings``.

    Returns
    -------
    Calibration
        Parameters with their standard deviations, and how they were found.

    Raises
    ------
    AmiwarpError
        If the recording cannot determine the parameters: too few events, less than a quarter turn, an encoder that
        does not cover the events, no texture, edges in one direction only, or events that no brightness map explains.

    Notes
    -----
    The sharpness stage is contrast maximisation: it finds the parameters that make the image of warped events (IWE)
    sharpest. The photometric stage starts from its answer and finds the parameters for which one brightness map of the
    scene explains the events. If no map does, the camera may have rotated; its rotation is then calibrated too. The
    formulas and measured errors are in ``docs/explanation/calibration.md``.

    Examples
    --------
    >>> import numpy as np
    >>> blocks = np.random.default_rng(0).integers(0, 255, (30, 40), dtype=np.uint8)
    >>> texture = np.kron(blocks, np.ones((8, 8), np.uint8))
    >>> camera = amiwarp.Camera.from_fov(80, 60, 0.9)
    >>> recording = amiwarp.simulate(texture, camera, amiwarp.Prism(apex=0.03), duration_s=0.1, seed=0)
    >>> calibration = amiwarp.calibrate(recording, model="exact")
    >>> round(calibration.parameters["apex"], 3)
    0.03
    """
    check_names(changes, [entry.name for entry in fields(Settings)], "calibrate: setting ")
    given: dict[str, Any] = {**changes}  # one word may stand for a tuple of it
    settings = replace(settings or Settings(), **given)
    settings.check()
    best = best_model(recording) if settings.model == AUTO else settings.model
    if best is None:
        raise AmiwarpError(
            f"{recording.name}: has the angles of two motors, and names no optic; give model 'risley' (--model risley) "
            "for a pair of prisms, or model 'mirror' (--model mirror) for a mirror with two tilts"
        )
    if settings.model == AUTO and best == ExactModel.NAME and getattr(recording.prism, "second", None) is not None:
        raise AmiwarpError(
            f"{recording.name}: has two prisms, but the angle of one; give the second angle to 'amiwarp convert' by "
            "--second-encoder or --second-ratio, or leave the second prism out"
        )
    if best != ExactModel.NAME:
        settings = replace(settings, model=best)
    used, warnings = without_start_burst(recording)
    found = _calibration(used, settings, device, progress)
    if found.path is not None and recording.encoder is None and len(recording.events):
        found = replace(found, path=reaching_back(found.path, recording.events.t_first))
    return _warning(found, *warnings)


def _calibration(recording: Recording, settings: Settings, device: Any, progress: Progress | None) -> Calibration:
    """Return the calibration of a recording with checked settings."""
    if isinstance(recording.prism, Plate) or settings.model == PlateModel.NAME:
        return _plate(recording, settings, device, progress)
    if settings.model != AUTO:
        return Calibrator(recording, settings, device, progress).run()
    chooser = ModelChooser(recording, settings, device)
    exact = Calibrator(recording, chooser.settings, device, progress, meanwhile=chooser.prepare).run()
    return chooser.choose(exact, lambda again, freed: Calibrator(again, freed, device, progress, path=exact.path).run())


def _plate(recording: Recording, settings: Settings, device: Any, progress: Progress | None) -> Calibration:
    """Return the calibration of a plate: its phase, and the mean inverse depth of the scene."""
    began, name = time.perf_counter(), recording.name
    if not isinstance(recording.prism, Plate):
        raise AmiwarpError(f"{name}: the plate is unknown; give its --thickness-mm and --plate-tilt-deg")
    if settings.model != PlateModel.NAME:
        raise AmiwarpError(
            f"{name}: the glass is a plate, the model {settings.model!r}; give model 'plate', or a prism"
        )
    if recording.encoder is None:
        raise AmiwarpError(f"{name}: a plate's phase needs the encoder, which the recording lacks; add its log")
    found = Calibrator(recording, replace(settings, stages=("sharpness",)), device, progress).run()
    if "photometric" in settings.stages:

        def report(share: float) -> None:
            if progress is not None:
                progress("photometric", share)

        found = plate.refine_phase(found, recording, device, report)
    return replace(found, seconds=time.perf_counter() - began)


LEAST_BAD_SHARE = 0.01
"""Share of the events on hot or flickering pixels above which these pixels are masked."""
LARGEST_STRAIGHT_COST_RATIO = 1.05
"""Largest ratio of the photometric cost with a corrected encoder to that without, if the corrected answer is not
accepted with a low cost. A right answer may cost more by as much: two maps of the same scene differ so, and one of four
turns may no longer be whole at the corrected speed."""
LEAST_LONGER = 1.5
"""Length of a recording from which on its ends can confirm the answer of its middle, as a multiple of the length of a
calm span. Each end then begins half a turn from the middle span."""
QUADRATURE, NEAR_QUADRATURE = (0.25, 0.5, 2.0, 4.0), 0.03
"""Scales of a quadrature encoder of which other edges are counted than stated, and how near a found one must be."""
LEAST_GROWTH_DEVIATIONS = 5.0
"""Smallest growth of the image that is taken for one [standard deviations]."""
DOUBTFUL_PATH_RATIO = 0.9
"""Ratio of the costs with and without a path between pulses up to which the speed between them is said to vary, even if
the path does not explain the events. It was 0.85 where a speed that hunted by 3 % left 0.16 px."""
DOUBTFUL_PATH = (
    "the encoder gives pulses only, and the speed between them seems to vary in a way that could not be found: the "
    "result may be off by a tenth of a pixel or more; let the motor turn more steadily, hold the camera still, or use "
    "an encoder with more samples a turn"
)
GRADUAL_US = 5000
"""Duration of a step of an encoder's angle from which on the events must tell how it came about [us]."""
LEAST_SCALE_ERROR = 0.003
"""Smallest relative error of an encoder's scale that is reported. Three turns measure the scale to about 0.001."""


@dataclass(frozen=True)
class Attempt:
    """Outcome of one attempt: a calibration, or the error that ended it."""

    calibration: Calibration | None
    error: AmiwarpError | None = None
    search: Search | None = None
    """The last sharpness search that was begun."""

    @property
    def photometric(self) -> PhotometricSummary | None:
        """Result of the photometric stage; None if it did not run."""
        return None if self.calibration is None else self.calibration.photometric

    @property
    def accepted(self) -> bool:
        """Whether the photometric stage accepted its result."""
        return self.photometric is not None and self.photometric.accepted

    @property
    def cost(self) -> float:
        """Cost of the photometric stage, relative to that without a map; 1 if the stage did not run."""
        return 1.0 if self.photometric is None else self.photometric.cost

    @property
    def unexplained(self) -> bool:
        """Whether the photometric cost is so high that the camera may have rotated."""
        if self.photometric is None:
            return isinstance(self.error, checks.NoSharpOptimumError)
        return self.cost > limits.LARGEST_STILL_COST

    @property
    def doubtful(self) -> bool:
        """Whether there is any sign that something is wrong."""
        return not self.accepted or self.photometric is None or bool(self.photometric.warnings) or self.camera_turned

    @property
    def moving(self) -> NDArray[np.bool_]:
        """Parts of the image in which something moves while others are still, shape (rows, columns); empty for none."""
        return np.array(() if self.photometric is None else self.photometric.moving, np.bool_)

    @property
    def camera_turned(self) -> bool:
        """Whether a rotation of the camera explains much of the photometric residual."""
        return self.photometric is not None and self.photometric.rotation_gain > limits.LARGEST_ROTATION_GAIN

    def found(self) -> Calibration:
        """Return the calibration, or raise the error."""
        if self.calibration is None:
            assert self.error is not None
            raise self.error
        return self.calibration


@dataclass(frozen=True)
class Calibrator:
    """Calibration of one model from one recording, by sharpness and then photometrically."""

    recording: Recording
    settings: Settings
    device: Any
    progress: Progress | None
    harmonics: tuple[float, ...] | None = None
    """Correction of the recording's encoder that is in its angles already, as in :attr:`Calibration.harmonics`."""
    meanwhile: Callable[[Calibration], Iterator[None]] | None = None
    """Function that gets the answer of the first attempt's sharpness stage and returns other work. Some of its steps
    are taken while a GPU works on the photometric stage, those that are left after the stage."""
    path: Encoder | None = None
    """Path of the prism's angle that was found before, if the recording has no encoder."""
    mended: Encoder | None = None
    """Angles in place of those of the recording's encoder, if they were wrong; they are in the recording already."""
    mended_words: str = ""
    """What was wrong with them, in words."""

    def run(self) -> Calibration:
        """Return the calibration of ``settings.model``; raise :class:`AmiwarpError` as :func:`calibrate` does.

        If the first attempt shows that something is wrong, further ones are made, see the top of this file.
        """
        began = time.perf_counter()
        tried = self.attempt()
        if "photometric" not in self.settings.stages:
            return self._told(tried.found())
        recording, calibrator = self.recording, replace(self, meanwhile=None)
        if recording.encoder is not None:
            calibrator, tried = calibrator.with_mended_encoder(tried)
            calibrator, tried = calibrator.with_straight_angles(tried)
            if tried.unexplained:
                calibrator, tried = calibrator.without_bad_pixels(tried)
            if tried.moving.any():
                tried = calibrator.without_moving_parts(tried)
            elif tried.unexplained:
                tried = calibrator.explained(tried)
            elif self.settings.free is None and tried.camera_turned:
                tried = calibrator.with_rotation(tried)
        elif MODELS[self.settings.model].PRISM:
            tried = calibrator.with_straight_path(tried)
        else:
            tried = calibrator.at_found_speed(tried)
        found = self._told(replace(tried.found(), harmonics=calibrator.harmonics))
        if calibrator.mended is not None:
            found = replace(found, path=calibrator.mended)
        if calibrator.mended_words:
            found = _warning(found, calibrator.mended_words)
        if not tried.accepted:  # the answer of sharpness alone may be off by tenths of a pixel
            reasons = [w for w in found.warnings if "photometric" in w]
            raise AmiwarpError(
                f"{recording.name}: {'; '.join(reasons)}; the result of the sharpness stage alone may be off by "
                "several tenths of a pixel: accept it with --stages sharpness, or record a scene that stays still"
            )
        found = _warning(found, *uneven_in_words(found, self.settings.free))
        given = {*self.settings.bounds, *self.settings.start}
        if isinstance(recording.prism, Prism) and not size_names() & given:
            found = calibrator.with_order_examined(found)
            checks.check_nominal(found.model_name, found.parameters, recording.prism, recording.name)
        return replace(found, seconds=time.perf_counter() - began)

    def attempt(self, rival: Attempt | None = None, *, angles_hold: bool = False, fast: bool = False) -> Attempt:
        """Calibrate once by the stages of the settings, with the free parameters that they name.

        The attempt fails early if its image is not clearly sharper than that of a ``rival``, another attempt, or if it
        does not come to a clearly lower cost. With ``angles_hold``, lens and prism are corrected before an error of the
        prism's angles is looked for; with such an error, the answer is rejected. With ``fast``, for a camera in fast
        motion, the photometric stage ends with its first answer.
        """
        began, search = time.perf_counter(), None
        try:
            recording = rotation_window(self.recording, self.settings)
            searches = prepare(recording, self.settings, self.path, device=self.device, progress=self.progress)
            with upload_ahead(recording, searches[0]) as ahead:
                for search in searches:
                    search.run()
                search = _in_larger_sense(recording, max(searches, key=lambda s: s.score))
                if recording.encoder is None and self.path is None and _path_is_examined(search):
                    search = _with_path(recording, search)
                if rival is not None and rival.search is not None:
                    checks.check_sharper(search.gain_over(rival.search), recording.name)
                found = _sharpest(recording, search, *search.check_answer(recording.name))
                space, values = search.space, found.parameters
                if "photometric" in self.settings.stages:
                    problem = Problem(
                        recording,
                        search,
                        angles_hold=angles_hold,
                        fast=fast,
                        most_cost=math.inf if rival is None else limits.LARGEST_COST_RATIO * rival.cost,
                        ahead=ahead,
                        meanwhile=iter(()) if self.meanwhile is None else self.meanwhile(found),
                    )
                    try:
                        refined = summarised(refine(problem))
                        for _ in problem.meanwhile:
                            pass
                    except AmiwarpError as error:
                        found = _warning(found, f"the photometric stage failed: {error}")
                    else:
                        found = _refined(search, found, *refined)
                        if refined[0].accepted:
                            space, values = refined[-1], refined[0].parameters
                found = _warning(found, *bound_warnings(space, values))
        except AmiwarpError as error:
            return Attempt(None, error, search)
        return Attempt(replace(found, seconds=time.perf_counter() - began), search=search)

    def with_mended_encoder(self, tried: Attempt) -> tuple[Calibrator, Attempt]:
        """Put back counts that the encoder lost, or find the path between pulses that come once a turn.

        Return the calibrator of the mended recording, and its attempt; both unchanged if the events do not confirm it.
        """
        encoder = self.recording.encoder
        assert encoder is not None
        if MODELS[self.settings.model].ANGLES > 1 or tried.search is None or not tried.search.space.sized:
            return self, tried
        try:
            calibrator = self._between_pulses(tried.search) if pulses_only(encoder) else self._with_all_counts(tried)
        except AmiwarpError:  # the events do not determine the path
            return self, tried
        if calibrator is None:
            return self, tried
        again = calibrator.attempt()
        holds = again.accepted and again.cost < tried.cost and not (again.unexplained or again.camera_turned)
        if again.calibration is not None and (holds or again.cost <= limits.LARGEST_COST_RATIO * tried.cost):
            return calibrator, again
        if pulses_only(encoder) and again.accepted and again.cost <= DOUBTFUL_PATH_RATIO * tried.cost:
            return replace(self, mended_words=DOUBTFUL_PATH), tried
        return self, tried

    def _with_all_counts(self, tried: Attempt) -> Calibrator | None:
        """Return the calibrator of the recording without the steps of its encoder; None if there are none.

        The index pulses, the encoder's samples and, if something is wrong or there is no index, the events tell them.
        """
        recording, encoder = self.recording, self.recording.encoder
        assert encoder is not None
        steps = lost_counts(encoder)
        told_by_index = bool(steps) and encoder.index_t is not None
        if not told_by_index and (steps or tried.doubtful):
            steps = steps_in_events(recording, encoder) or steps
        if not steps:
            return None
        mended = without_steps(encoder, steps)
        if any(step.last_us - step.first_us > GRADUAL_US for step in steps):
            mended = self._on(mended)._fitted()
        said = steps_in_words(steps, recording.events.t_first + round(encoder.clock_offset_us))
        shown = "its index pulses" if told_by_index else "the events"
        words = (
            f"{said}, as {shown} show: it lost counts, or slipped. They were put back for this recording only: check "
            "its cable, supply and coupling"
        )
        return self._on(mended, words)

    def _between_pulses(self, search: Search) -> Calibrator | None:
        """Return the calibrator of the recording with a path between its pulses; None if they are evenly spaced.

        ``search`` is that of an attempt at the pulses' angles.
        """
        source, encoder = self.recording.events, self.recording.encoder
        assert encoder is not None
        path = smooth_path(encoder)
        recording, start = replace(self.recording, encoder=path), _search_on(path, search)
        t = start.calibration_events.events.t
        px = px_per_rad(start.space, start.space.to_vector(start.best))
        bent_px = px * float(np.std(path.angle_at(t) - encoder.angle_at(t)))
        if bent_px < LEAST_DEVIATION_PX and not PathFit(recording, start, GATE_PAIRS, GATE_TILES).deviates():
            return None
        path, _ = PathFit(recording, start).run()
        off = off_path(encoder, path, source.t_first, source.t_last)
        path = replace(path, angle=path.angle - float(np.mean(off)))
        jitter_us = float(np.std(off)) / abs(encoder.rpm) * 60e6 / math.tau
        said = (
            "the encoder gives pulses only: the angle between them was found in the events. The speed "
            f"{speed_in_words(path)}, and the pulses came {jitter_us:.0f} us rms early or late. This holds for this "
            "recording only; if the camera moved, which looks the same, hold it still"
        )
        return self._on(path, said)

    def _on(self, encoder: Encoder, said: str = "") -> Calibrator:
        """Return the calibrator with other angles in place of those of the recording's encoder, and why."""
        recording = replace(self.recording, encoder=encoder)
        return replace(self, recording=recording, mended=encoder, mended_words=said, meanwhile=None)

    def _fitted(self) -> Encoder:
        """Return the recording's encoder, corrected by the path that the events tell."""
        search = prepare(self.recording, self.settings, device=self.device, progress=self.progress)[0]
        search.run()
        return PathFit(self.recording, search).run()[0]

    def with_order_examined(self, found: Calibration) -> Calibration:
        """Return the calibration, with a warning if the encoders of two prisms seem to be swapped.

        Raises :class:`AmiwarpError` for it if the prisms are far from their nominal sizes.
        """
        recording, encoder = self.recording, self.recording.encoder
        nominal_prism = recording.prism
        if not isinstance(nominal_prism, Prism) or encoder is None or encoder.second is None:
            return found
        if not checks.look_swapped(found.parameters, nominal_prism):
            return found
        exchanged = encoder.second.with_second(replace(encoder, second=None))
        again = replace(self, recording=replace(recording, encoder=exchanged)).attempt()
        if not again.accepted or checks.look_swapped(again.found().parameters, nominal_prism):
            return found
        said = checks.swapped_encoders(found.parameters, again.found().parameters, nominal_prism)
        if checks.pair_is_far(found.parameters, nominal_prism):
            raise AmiwarpError(f"{recording.name}: {said}")
        return _warning(found, said)

    def with_straight_angles(self, tried: Attempt) -> tuple[Calibrator, Attempt]:
        """Correct an error of the encoder that repeats every turn, if the events ask for it, and calibrate again.

        Return the calibrator of the corrected recording, and its attempt.
        """
        encoder, found = self.recording.encoder, tried.photometric
        harmonics = () if found is None else found.harmonics
        assert encoder is not None
        if not harmonics:
            return self, tried
        straight = replace(self.recording, encoder=encoder.with_harmonics(harmonics))
        calibrator = replace(self, recording=straight, harmonics=harmonics)
        again = calibrator.attempt()
        holds = again.accepted and again.cost <= limits.LARGEST_STILL_COST
        if again.calibration is None or not (holds or again.cost <= LARGEST_STRAIGHT_COST_RATIO * tried.cost):
            return self, tried
        assert found is not None
        assert again.photometric is not None
        if {*again.photometric.parameters} - {*found.parameters}:  # a very wrong camera looks like both errors
            rival = self.attempt(angles_hold=True)
            if rival.accepted and rival.cost <= again.cost:
                return self, rival
        said = f"{harmonics_in_words(MODELS[self.settings.model], harmonics)}: it was corrected"
        return calibrator, Attempt(_warning(again.calibration, said))

    def with_straight_path(self, tried: Attempt) -> Attempt:
        """Correct an error of the path that repeats every turn, if the events ask for it, and calibrate again."""
        found = tried.calibration
        if found is None or found.path is None or found.photometric is None or not found.photometric.harmonics:
            return tried
        path = found.path.with_harmonics(found.photometric.harmonics)
        zero = float(path.angle_at([middle_time(self.recording)])[0])
        again = replace(self, path=replace(path, angle=path.angle - zero)).attempt()
        return tried if again.calibration is None or again.cost > tried.cost else again

    def at_found_speed(self, tried: Attempt) -> Attempt:
        """Calibrate again at the speed that was found: known angles let the sensor's timing be examined."""
        found = tried.calibration
        if found is None or found.zero_us is None or not tried.accepted or "rpm" not in found.free:
            return tried
        held = {} if self.settings.free else causes.doubtful_harmonic(found.parameters, found.uncertainty)
        known = {n: x for n, x in found.parameters.items() if n != "rpm"}
        free = tuple(n for n in found.free if n != "rpm" and n not in held)
        settings = replace(self.settings, free=free, start={**known, **held}, global_algorithm=None)
        events = self.recording.events
        path = constant_speed(found.parameters["rpm"], events.t_first, events.t_last, found.zero_us)
        again = replace(self, settings=settings, path=path).attempt()
        if again.calibration is None:
            return again
        speed, std = found.parameters["rpm"], found.uncertainty["rpm"]
        calibration = replace(
            again.calibration, path=None, free=(*again.calibration.free, "rpm"),
            parameters={**again.calibration.parameters, "rpm": speed},
            uncertainty={**again.calibration.uncertainty, "rpm": std},
            stages=(*found.stages, *again.calibration.stages),
        )  # fmt: skip
        return replace(again, calibration=calibration)

    def _told(self, found: Calibration) -> Calibration:
        """Return the calibration, with warnings of an assumed sensor size and of a speed that is not constant."""
        found = _warning(found, *checks.size_warnings(self.recording))
        if found.path is None or self.path is not None:
            return found
        said = f"the prism's speed is not constant: it {speed_in_words(found.path)}"
        said += "; if the camera or the scene moved, which looks the same, hold it still, or use an encoder"
        return _warning(found, f"{said}; the path that was found holds for this recording only")

    def without_bad_pixels(self, tried: Attempt) -> tuple[Calibrator, Attempt]:
        """Mask hot and flickering pixels if they have a notable share of the events, and calibrate without them.

        Return the calibrator of the masked recording, and its attempt unless only the first one was accepted.
        Raises :class:`AmiwarpError` if most pixels flicker.
        """
        source, encoder = self.recording.events, self.recording.encoder
        assert encoder is not None
        mask, summary = strange_pixels(stretch(source, encoder), encoder, source.size)
        if summary.share < LEAST_BAD_SHARE:
            return self, tried
        checks.check_light(mask, summary, self.recording.name)
        cleaned = replace(self, recording=replace(self.recording, events=MaskedEventSource(source, mask)))
        again = cleaned.attempt()
        if tried.accepted and not again.accepted:
            return cleaned, tried
        if again.calibration is None:
            return cleaned, again
        return cleaned, Attempt(_warning(again.calibration, str(summary)))

    def without_moving_parts(self, tried: Attempt) -> Attempt:
        """Calibrate from the parts of the image in which nothing moves."""
        source = self.recording.events
        (width, height), (rows, columns) = source.size, tried.moving.shape
        mask = tried.moving[np.arange(height) * rows // height][:, np.arange(width) * columns // width]
        again = replace(self, recording=replace(self.recording, events=MaskedEventSource(source, mask))).attempt()
        said = f"something moves: {100 * mask.mean():.0f} % of the view are left out"
        if again.accepted and not again.unexplained:
            return Attempt(_warning(again.found(), said))
        return Attempt(None, AmiwarpError(f"{self.recording.name}: {said}, but the rest does not determine the prism; "
                                          "record a scene that stays still"))  # fmt: skip

    def explained(self, tried: Attempt) -> Attempt:
        """Return the attempt with a free camera rotation, the error of a wrong encoder, or ``tried`` unchanged.

        The encoder's direction and scale are examined first, because they take few searches. If a correction of them
        leaves a high cost, the cause with the lower cost is taken.
        """
        wrong = self.with_other_encoder(tried)
        if wrong is not None and wrong[0] <= limits.LARGEST_STILL_COST:
            return Attempt(None, wrong[1])
        moving = tried if self.settings.free is not None else self.with_rotation(tried)
        if wrong is None or (moving is not tried and moving.cost <= wrong[0]):
            return moving
        return Attempt(None, wrong[1])

    def with_other_encoder(self, tried: Attempt) -> tuple[float, AmiwarpError] | None:
        """Return the photometric cost with the encoder's direction or scale corrected, and the error that says so.

        The events of a still scene repeat every turn of the prism. If they repeat at another encoder angle, the
        encoder's scale may be wrong. None if no correction lowers the cost enough.
        """
        encoder, name = self.recording.encoder, self.recording.name
        assert encoder is not None
        turns = [-1.0]
        with contextlib.suppress(AmiwarpError):  # the events do not repeat: the scene or the camera moves
            found = first_guess.encoder_turns_per_period(self.recording, encoder)
            turns += [*(q for q in QUADRATURE if abs(found / q - 1.0) < NEAR_QUADRATURE), found]
        for each in turns:
            if abs(each - 1.0) < LEAST_SCALE_ERROR:
                continue
            corrected = replace(encoder, angle=encoder.angle / each, index_t=None)
            again = replace(self, recording=replace(self.recording, encoder=corrected)).attempt(tried)
            # a slipping index remains as an error that repeats every turn
            explains = again.accepted or (again.photometric is not None and again.photometric.harmonics)
            if not explains or again.cost > limits.LARGEST_COST_RATIO * tried.cost:
                continue
            if each < 0.0:
                return again.cost, checks.wrong_direction(name, tried.cost, again.cost)
            return again.cost, checks.wrong_scale(name, each, "the events repeat", tried.cost, again.cost)
        return None

    def with_rotation(self, tried: Attempt) -> Attempt:
        """Return the attempt with a free camera rotation if that lowers the photometric cost enough; else ``tried``.

        It uses two turns of the prism: the calmest ones, if these are clearly calmer than those in the middle of the
        recording. A camera that never rests must give about the same answer at other times. Otherwise the answer is
        the mean of many turns, or an error if the recording is too short for it, or no motion explains its turns.
        """
        encoder, name = self.recording.encoder, self.recording.name
        assert encoder is not None
        rival = None if tried.camera_turned else tried  # a slow rotation hardly blurs the image
        repetition, span = 1.0, None
        if MODELS[self.settings.model].ANGLES == 1:  # with two angles, a still scene does not repeat every turn
            repetition, span = first_guess.calmest_span(self.recording, encoder)
        restless, calm = repetition < first_guess.LEAST_REPETITION, repetition >= first_guess.LEAST_CALM
        turns = self._turns()
        many = len(turns) >= LEAST_TURNS
        too_fast = Attempt(None, checks.moves_too_fast(name, repetition, short=not many))
        if restless and many:
            return self.turn_by_turn(tried, turns) or (tried if tried.accepted else too_fast)
        again = self._turning(rival) if span is None else self._turning_in(span)
        growing = self._growing(tried, again) if calm and span is None else None
        if growing is not None:
            return growing
        if not again.accepted or again.cost > limits.LARGEST_COST_RATIO * tried.cost:
            # a rotation makes the image sharper, or the attempt would have failed
            if restless and not tried.accepted and rival is not None and again.calibration is not None:
                return too_fast
            moves = many and not calm and not tried.accepted
            return (self.turn_by_turn(tried, turns) or too_fast) if moves else tried
        apart_px = CONFIRMED_PX if many else limits.LARGEST_INCONSISTENCY_PX  # two wrong answers may be alike by chance
        if (not calm or (many and again.unexplained)) and not self._confirmed(again, apart_px):
            mean = self.turn_by_turn(tried, turns) if many else None
            if mean is not None or not calm:
                return mean or too_fast
        speed = math.degrees(math.hypot(*(again.found().parameters[n] for n in RATES)))
        said = f"the camera turned at {speed:.1f} deg/s; its rotation was calibrated together with the prism"
        if span is not None:
            since = ((t - self.recording.events.t_first) * 1e-6 for t in span)
            said += ", from {:.2f} to {:.2f} s, where the camera is calmest".format(*since)
        return Attempt(_warning(_without_motion(again.found()), said))

    def _growing(self, tried: Attempt, turning: Attempt) -> Attempt | None:
        """Return the attempt with a growing image, if that explains the events better than a rotation; else None.

        ``turning`` is the attempt with a free rotation, of the same two turns. Those hold less of any slow change than
        the whole recording, so that a rotation seems to explain it.
        """
        encoder = self.recording.encoder
        assert encoder is not None
        free = (*MODELS[self.settings.model].freed(encoder.ratio), GROWTH)
        growing = replace(self, settings=replace(self.settings, free=free)).attempt()
        most_cost = limits.LARGEST_COST_RATIO * tried.cost
        if not growing.accepted or growing.cost > min(most_cost, turning.cost if turning.accepted else math.inf):
            return None
        found = growing.found()
        growth, std = found.parameters[GROWTH], found.uncertainty[GROWTH]
        if abs(growth) < LEAST_GROWTH_DEVIATIONS * std:
            return None
        how = "grew" if growth > 0.0 else "shrank"
        said = (
            f"the image {how} by {100.0 * abs(growth):.2g} % a second, which was calibrated together with the prism: "
            "the focal length drifts, or the camera moves along its axis"
        )
        return Attempt(_warning(_without_motion(found), said))

    def _turns(self) -> list[tuple[int, int]]:
        """Return the time spans [us] of :meth:`turn_by_turn`, which begin one turn after another, about the middle.

        All begin at the same angle of the prism. Then a motion of any frequency but the prism's changes the answers by
        an oscillation, which a weighted mean of them removes.
        """
        source, encoder = self.recording.events, self.recording.encoder
        assert encoder is not None
        if MODELS[self.settings.model].ANGLES > 1 or not encoder.rpm:
            return []
        turn_us = 60e6 / abs(encoder.rpm)
        longest = source.t_last - source.t_first - WINDOW_TURNS * turn_us
        count = min(MOST_TURNS, math.floor(longest / turn_us) + 1)
        left = longest - (count - 1) * turn_us
        starts = [source.t_first + int(0.5 * left + turn_us * k) for k in range(count)]
        return [(start, start + int(WINDOW_TURNS * turn_us)) for start in starts]

    def turn_by_turn(self, tried: Attempt, turns: list[tuple[int, int]]) -> Attempt | None:
        """Return the mean of the answers of single turns of the prism, or the error that it is too uncertain.

        None if no motion of the camera explains the events of single turns. ``turns`` are at least :data:`LEAST_TURNS`
        time spans [us].

        The camera's own motion changes the orbit by a different amount in each turn, unless it is in step with the
        prism, so the mean of these changes vanishes. Within a turn, the camera's angular velocity is taken as linear in
        time and the growth of the image as steady; the scene of each tile moves on a path beyond that.
        """
        most_cost = min(LARGEST_FAST_COST, limits.LARGEST_COST_RATIO * tried.cost)
        single = replace(self, progress=None)
        answers: dict[int, Mapping[str, float]] = {}  # not the attempts, which hold events and images
        best: Attempt | None = None
        costs: list[float] = []
        for k in van_der_corput(len(turns)):
            answer = single._turning_in(turns[k], fast=True)
            costs.append(answer.cost)
            if answer.accepted:
                answers[k] = answer.found().parameters
                best = answer if best is None or answer.cost < best.cost else best
            if self.progress is not None:
                self.progress("calibrating, turn by turn", len(costs) / len(turns))
            few = len(answers) < LEAST_ANSWERED * len(costs)
            if len(costs) >= LEAST_JUDGED and (few or np.median(costs) > most_cost):
                return None
        assert best is not None
        mean, stated_px = _mean(best, answers, len(turns), float(np.median(costs)))
        if stated_px > LARGEST_MEAN_PX:
            return Attempt(None, checks.scatters(self.recording.name, len(answers), stated_px, LARGEST_MEAN_PX))
        said = f"the camera never rests: the answer is the mean of those of {len(answers)} turns, ± {stated_px:.2f} px"
        return Attempt(_warning(mean, said))

    def _turning(self, rival: Attempt | None, *, fast: bool = False) -> Attempt:
        """Return the attempt with a free camera rotation, in the middle of the recording."""
        encoder = self.recording.encoder
        assert encoder is not None
        free = (*MODELS[self.settings.model].freed(encoder.ratio), "motion", *((*CHANGES, GROWTH) if fast else ()))
        return replace(self, settings=replace(self.settings, free=free)).attempt(rival, fast=fast)

    def _turning_in(self, span: tuple[int, int], *, fast: bool = False) -> Attempt:
        """Return the attempt with a free camera rotation in a time span [us]."""
        source = self.recording.events
        events = MemoryEvents(source.between(*span), *source.size)
        return replace(self, recording=replace(self.recording, events=events))._turning(None, fast=fast)

    def _confirmed(self, turning: Attempt, apart_px: float) -> bool:
        """Return whether the answer of the last or the first turns is at most ``apart_px`` from that of the middle.

        A motion with frequencies near that of the prism changes the orbit by another amount at each time. Where there
        is no other answer, a low cost must do.
        """
        source, encoder = self.recording.events, self.recording.encoder
        assert encoder is not None
        length = int(first_guess.CALM_TURNS * 60e6 / abs(encoder.rpm))
        if source.t_last - source.t_first >= LEAST_LONGER * length:
            for span in (source.t_last - length, source.t_last), (source.t_first, source.t_first + length):
                other = self._turning_in(span)
                if other.accepted:
                    return predicted_error(turning.found().model, other.found().model, grid=8).rms <= apart_px
        return not turning.unexplained


# Calibration turn by turn, of a camera that never rests.

WINDOW_TURNS = 1.5
"""Length of each part of the recording that gives an answer [turns]. In longer ones, the velocity is less linear. In
shorter ones, the map follows the few events, and orbits come out too large: by 0.013 px with 1.05 turns of 160×120 px,
by 0.008 px with 2.1."""
MOST_TURNS, LEAST_TURNS = 48, 16
"""Largest and smallest number of these parts, which begin one turn after another."""
LEAST_JUDGED = 8
"""Number of parts from which on the recording may be given up."""
LEAST_ANSWERED = 0.75
"""Smallest share of the parts with an accepted answer."""
LARGEST_FAST_COST = 0.35
"""Largest median of the costs. It is about 0.18 for a rotation alone, and 0.27 in a street at 13 m/s."""
NEAR_OSCILLATIONS = (2, 3)
"""Numbers of oscillations over all turns whose amplitudes tell the error of the weighted mean. Slower ones change the
mean itself."""
PARALLAX_PX, ROTATION_COST = 0.25, 0.1
"""Error of size and phase that parallax leaves, however many turns are averaged [px per cost above a rotation's]. In
five worlds the error was 0.02 to 0.03 px at a cost of 0.19, and 0.03 to 0.04 at 0.26."""
CONFIRMED_PX, LARGEST_MEAN_PX = 0.03, 0.1
"""Largest distance of two answers of two turns that confirm each other where the mean of many turns is possible, and
largest stated error of that mean [px rms]."""


def mean_of_turns(
    each: NDArray[np.float64], share: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the weighted mean of the answers of turns, shape (n,), and its covariance, shape (n, n).

    ``each`` holds their search vectors, shape (turns, n), and ``share`` their times as shares of the recording, 0 to 1.

    A camera that moves at the frequency f changes the answers by an oscillation at f minus the prism's frequency. A
    Hann window removes it unless it is slower than two oscillations over all turns (Harris 1978). What the answers do
    at the next frequencies tells the error of the mean.
    """
    weight = np.sin(math.pi * share) ** 2
    weight /= weight.sum()
    mean = weight @ each
    oscillations = np.exp(2j * math.pi * np.outer(NEAR_OSCILLATIONS, share))
    amplitudes = oscillations @ (weight[:, None] * (each - mean))
    return mean, np.real(amplitudes.T @ amplitudes.conj()) / len(NEAR_OSCILLATIONS)


def _mean(
    best: Attempt, answers: Mapping[int, Mapping[str, float]], count: int, cost: float
) -> tuple[Calibration, float]:
    """Return the mean of the answers of ``count`` successive turns, by number of the turn, and its error [px rms].

    ``best`` is the attempt with the lowest cost, of which the rest of the calibration is taken; ``cost`` the median.
    The camera's motion, which each turn has its own of, is left out.
    """
    assert best.search is not None
    assert best.photometric is not None
    space = best.search.full_space.without(MOTION)
    each = np.array([space.to_vector(parameters) for parameters in answers.values()])
    v, scatter = mean_of_turns(each, (np.array([*answers]) + 0.5) / count)
    parallax_px = PARALLAX_PX * max(0.0, cost - ROTATION_COST)
    covariance = scatter + parallax_px**2 * np.eye(each.shape[1])
    values = {n: x for n, x in space.to_values(v).items() if n not in MOTION}  # the rotation's are those of the start
    stds = space.deviations(v, covariance)
    photometric = replace(
        best.photometric, parameters=values, uncertainty=stds, cost=cost, warnings=(),
        verdict=f"mean of the answers of {len(each)} turns",
    )  # fmt: skip
    found = replace(
        best.found(), parameters=values, uncertainty=stds, free=space.names, photometric=photometric, middle_us=None,
        warnings=(),
    )  # fmt: skip
    return found, stated_px(space, v, covariance)


def _without_motion(found: Calibration) -> Calibration:
    """Return the calibration with the prism's parameters only: the camera's motion holds for two turns."""
    return replace(
        found,
        parameters={n: x for n, x in found.parameters.items() if n not in MOTION},
        uncertainty={n: x for n, x in found.uncertainty.items() if n not in MOTION},
        free=tuple(n for n in found.free if n not in MOTION),
        middle_us=None,
    )


def _warning(found: Calibration, *said: str) -> Calibration:
    """Return the calibration with more warnings."""
    return replace(found, warnings=(*found.warnings, *said))


def _sharpest(
    recording: Recording, search: Search, warnings: tuple[str, ...], uncertainty: dict[str, float]
) -> Calibration:
    """Return the calibration by the sharpness stage that ``search`` ran. Its time is not set."""
    settings, space, best = search.settings, search.space, search.best
    still = {**MODELS[space.model].still_values(best), **{n: 0.0 for n in MOTION if n in best}}
    return Calibration(
        model_name=settings.model,
        camera=space.camera,
        prism=space.prism,
        parameters=best,
        uncertainty=uncertainty,
        free=space.names,
        sharpness_name=settings.sharpness.value,
        sharpness_before=search.fine.values(still),
        sharpness_after=search.score,
        stages=tuple(search.stages),
        zero_us=zero_time(recording, search),
        path=path_of(recording, search),
        middle_us=space.middle_us if space.moving else None,
        events=len(search.calibration_events.events),
        seconds=0.0,
        warnings=warnings,
    )


def _refined(
    search: Search, sharp: Calibration, found: PhotometricSummary, summary: StageSummary, space: ParameterSpace
) -> Calibration:
    """Return the photometric stage's result, or ``sharp``, the sharpness stage's, with a warning that says why."""
    held = [f"the events do not determine {', '.join(found.held)}: the photometric stage left it unchanged"]
    result = _warning(sharp, *(held if found.held else ()), *found.warnings)
    result = replace(result, stages=(*result.stages, summary), photometric=found)
    if not found.accepted:
        return _warning(result, f"photometric stage: {found.verdict}")
    lens = {n: x for n, x in found.parameters.items() if n in LENS and n not in search.full_space.names}
    return replace(
        result,
        camera=with_lens(result.camera, lens),
        prism=space.prism,
        parameters={n: x for n, x in found.parameters.items() if n not in lens},
        uncertainty={n: x for n, x in found.uncertainty.items() if n not in lens},
        free=tuple(n for n in space.names if n not in lens),
        sharpness_after=search.sharpness_in(space, found.parameters),
    )


# Preparation of an attempt: the encoder, the events and the parameter space for a recording.


def prepare(
    recording: Recording,
    settings: Settings,
    path: Encoder | None = None,
    *,
    device: Any = "cpu",
    progress: Progress | None = None,
) -> list[Search]:
    """Return the searches for a recording: one, or one for each sense of rotation if the prism's speed is unknown.

    ``path`` is the path of the prism's angle that was found before, if the recording has no encoder.

    For the model ``auto`` the search is that of the exact model, to which the smaller models are fitted later.
    Raises :class:`AmiwarpError` if the recording does not suit a calibration.
    """
    if settings.model == AUTO:
        settings = replace(settings, model="exact")
    name, camera = recording.name, _camera(recording)
    checks.check_events(len(recording.events), name)
    encoders, free = _encoders(recording, settings, path)
    events = thin(recording, settings.events)
    if isinstance(recording.events, MaskedEventSource) and len(events) < settings.events:
        checks.check_unmasked_events(len(events), recording.events.mask, name)
    searches = []
    for encoder in encoders:
        kind = MODELS[settings.model]
        check_prisms(encoder, kind.ANGLES)
        checks.check_coverage(encoder, int(events.t[0]), int(events.t[-1]), name)
        checks.check_pulses(encoder, name)
        space = _space(recording, camera, encoder, events, settings, free)
        calibration_events = _calibration_events(events, encoder, space, middle_time(recording), settings.fold)
        if space.sized:
            angles = encoder.angles_at(events.t[:: max(1, len(events) // 10_000)]).reshape(-1, kind.ANGLES)
            for k, which in enumerate(("the prism", "the second prism")[: kind.ANGLES]):
                checks.check_turned(angles[:, k], name, which)
        searches.append(Search(space, calibration_events, settings, device, progress))
    return searches


def zero_time(recording: Recording, search: Search) -> int | None:
    """Return the time at which the prism's angle of a calibration without an encoder is 0 [us]; else None."""
    return middle_time(recording) if recording.encoder is None and search.space.sized else None


def path_of(recording: Recording, search: Search) -> Encoder | None:
    """Return the path of the prism's angle that a search without an encoder follows; None for an encoder or a speed."""
    return search.calibration_events.encoder if recording.encoder is None and _on_path(search) else None


def _on_path(search: Search) -> bool:
    """Return whether the search for a recording without an encoder has a path, not a constant speed."""
    return search.space.sized and "rpm" not in search.space.start


def _path_is_examined(search: Search) -> bool:
    """Return whether the path of the prism's angle is examined: for a still camera, if no speed is given."""
    space, settings = search.space, search.settings
    given = "rpm" in settings.start or "rpm" in (settings.free or ())
    steady = not MODELS[space.model].PRISM  # ripple within a turn looks like harmonics of a vibration
    return space.cartesian and not space.moving and not (given or steady) and "photometric" in settings.stages


def _with_path(recording: Recording, search: Search) -> Search:
    """Return the search with the path of the prism's angle, or unchanged if a constant speed explains the events."""
    varies, encoder = _on_path(search), search.calibration_events.encoder
    if not varies:
        first, last = recording.events.t_first, recording.events.t_last
        encoder = constant_speed(search.best["rpm"], first, last, middle_time(recording))
    try:
        start = _search_on(encoder, search)
        if not varies and not PathFit(recording, start, GATE_PAIRS, GATE_TILES).deviates():
            return search
        path, deviation_px = PathFit(recording, start).run()
    except AmiwarpError:
        if varies:
            raise
        return search
    if not varies and deviation_px < LEAST_DEVIATION_PX:
        return search
    found = _search_on(path, search)
    found.run(found.best)
    return found


def _in_larger_sense(recording: Recording, search: Search) -> Search:
    """Return the search in the sense of rotation in which the size is that of the larger circle, if there are two."""
    best, space = search.best, search.space
    values = MODELS[space.model].reversed_values(best)
    if values is None or "rpm" not in space.names or values[space.size_name] <= best[space.size_name]:
        return search
    rpm = -best["rpm"]
    again = prepare(recording, replace(search.settings, start={**search.settings.start, "rpm": rpm}), path=None,
                    device=search.device, progress=search.progress)[0]  # fmt: skip
    again.run({**again.space.start, **values, "rpm": rpm})
    again.stages = search.stages + again.stages
    return again


def _search_on(path: Encoder, search: Search) -> Search:
    """Return a search like another one, at its answer, for a path of the prism's angle."""
    space, events = search.full_space, search.calibration_events
    best = {n: x for n, x in search.best.items() if n != "rpm"}
    if not _on_path(search):
        space = space.without(("rpm",))
        space = replace(space, start={n: x for n, x in space.start.items() if n != "rpm"}, undrifted={})
    found = Search(
        space, CalibrationEvents(events.events, path, None, events.fold), search.settings, search.device,
        search.progress,
    )  # fmt: skip
    found.best, found.stages = best, search.stages
    return found


def _camera(recording: Recording) -> Camera:
    if recording.camera is None:
        raise AmiwarpError(
            f"{recording.name}: the camera is unknown; give --camera or --fov-deg, or in Python "
            "dataclasses.replace(recording, camera=amiwarp.Camera.from_fov(width, height, radians))"
        )
    return recording.camera


def _encoders(recording: Recording, settings: Settings, path: Encoder | None) -> tuple[list[Encoder], tuple[str, ...]]:
    """Return the encoders to try and the free parameters.

    Without an encoder these are the known path, or constant speeds: the given one, or the one found in the events with
    either sign. If the events show that the speed varies much, they are paths with either sense of rotation.
    """
    check_sensor(recording.events[:1])
    kind, encoder = MODELS[settings.model], recording.encoder
    free = kind.freed(None if encoder is None else encoder.ratio) if settings.free is None else settings.free
    free = tuple(n for n in free if n not in LINEAR_UNKNOWNS)
    if not {*size_names(), "phase"} & set(free) and settings.start.get(kind.SIZE) == 0.0:
        return [constant_speed(0.0, recording.events.t_first, recording.events.t_last, middle_time(recording))], free
    if recording.encoder is not None:
        if "rpm" in free or "rpm" in settings.start:
            raise AmiwarpError(
                f"{recording.name}: the encoder gives the rpm; remove rpm from the settings, or free clock_offset"
            )
        return [recording.encoder], free
    if "clock_offset" in free or "clock_offset" in settings.start:
        raise AmiwarpError(
            f"{recording.name}: the recording has no encoder, so clock_offset is part of the phase; remove "
            "clock_offset from the settings"
        )
    if path is not None:
        return [path], free
    rpm = settings.start.get("rpm")
    if rpm is None and "rpm" not in free and (paths := varying_paths(recording)):
        return paths, free
    if rpm is None:
        found = first_guess.estimate_rpm(recording, kind.TIME_BIN_US, kind.MOVER)
        # a motion that can be described by either sense is searched in one
        speeds = [found, -found] if kind.reversed_values(dict.fromkeys(kind.FREE, 0.0)) is None else [found]
    else:
        speeds = [rpm]
    first, last = recording.events.t_first, recording.events.t_last
    encoders = [constant_speed(s, first, last, middle_time(recording)) for s in speeds]
    return encoders, free if "rpm" in free else (*free, "rpm")


def _space(
    recording: Recording,
    camera: Camera,
    encoder: Encoder,
    events: Events,
    settings: Settings,
    free: tuple[str, ...],
) -> ParameterSpace:
    """Return the space of the free parameters, started at estimates from the encoder and the events."""
    duration = int(events.t[-1]) - int(events.t[0])
    turned = float(np.ptp(encoder.angle_at(events.t[[0, -1]])))
    start = dict(settings.start)
    if "rpm" in free:
        start["rpm"] = encoder.rpm
    if "clock_offset" in free:
        start.setdefault("clock_offset", encoder.clock_offset_us)
    if encoder.ratio is not None:
        start["ratio"] = encoder.ratio
    if ("motion" in free or set(RATES) & set(free)) and turned > 0.0 and not set(RATES) & set(start):
        found = dict(zip(RATES, first_guess.estimate_rates(events, encoder, camera), strict=True))
        start |= {n: rate for n, rate in found.items() if "motion" in free or n in free}
    prism = nominal(recording.prism, MODELS[settings.model])
    space = make_space(
        settings.model, camera, prism, free=free, start=start, bounds=settings.bounds,
        rad_per_us=turned / max(duration, 1), duration_us=float(duration), middle_us=middle_time(recording),
    )  # fmt: skip
    for name in sorted(settings.start.keys() - settings.bounds.keys() - phase_names()):
        if (given := start[name]) != space.start[name]:
            span = f"{space.low[name]:.6g} .. {space.high[name]:.6g} {units()[name]}"
            raise AmiwarpError(f"start of {name} = {given:.6g} is not in {span}; give its bounds too (--bound)")
    return space


def _calibration_events(
    events: Events, encoder: Encoder, space: ParameterSpace, middle: int, fold: int
) -> CalibrationEvents:
    """Return the calibration events with their encoder and the angles' derivative by a free clock offset or rpm."""
    if fold and (space.moving or {"clock_offset", "rpm"} & set(space.names)):
        raise AmiwarpError(
            f"fold = {fold} with {', '.join(space.names)} free: folding discards the events' times; set fold to 0"
        )
    if "clock_offset" in space.start:
        encoder = encoder.with_clock_offset(space.start["clock_offset"])
    if "clock_offset" in space.names:
        return CalibrationEvents(events, encoder, lambda t: encoder.speed_at(t) * 1e-6)
    if "rpm" in space.names:
        return CalibrationEvents(events, encoder, lambda t: (t - middle).astype(np.float64) * (2.0 * math.pi / 60e6))
    return CalibrationEvents(events, encoder, None, fold)
