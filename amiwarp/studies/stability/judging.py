"""Judgement of a calibration of a simulated recording: errors, stated errors and outcome."""

import enum
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial
from math import tau as TWO_PI
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from amiwarp.brightness.sensor_timing import SensorTiming
from amiwarp.calib.calibration import calibrate
from amiwarp.calib.paper_method import calibrate_as_paper
from amiwarp.calib.presets import settings_to
from amiwarp.calib.settings import AUTO, STAGES, Settings
from amiwarp.choices import Sharpness
from amiwarp.errors import AmiwarpError
from amiwarp.optics.models.comparison import predicted_error
from amiwarp.optics.models.exact import ExactModel
from amiwarp.optics.models.registry import build_model
from amiwarp.results.calibration import Calibration
from amiwarp.studies.stability import placing_error
from amiwarp.studies.stability.causes import could_hide, names_cause
from amiwarp.studies.stability.condition import Cell, Condition, troubles_of
from amiwarp.studies.stability.recordings import OpticSample, SimulatedSample
from amiwarp.validation import real

# Methods, and cells: a condition, a seed, and the result of each calibration method on that recording.

OPTIC_LIMIT_PX = 0.02
"""Largest error of a successful calibration [px rms] of a condition that names an optic."""


LIMIT_PX = 0.1
"""Largest model error of a successful calibration [px rms], unless the model's best fit to the truth has a large error
itself."""


BEST_FIT = 1.5
"""Multiple of the error of the model's best fit to the truth that a successful calibration may have."""


LAG_STEPS = 4
"""Number of Gauss-Newton steps that find the lag of a calibration."""


STATED = ("apex", "phase", "size")
"""Quantities whose distance from the truth is measured in standard deviations that the calibration states.

The size is the size of the displacements in the image, which is proportional to the apex."""


JUDGED = 5_000
"""Number of events at which the error of a smaller model is measured: enough for an rms error accurate to 1 %."""


LARGEST_PX = 1e3
"""Largest model error that is stored [px rms]; a model without a valid position anywhere has this error too."""


MOST_DEVIATION = 1e9
"""Largest stored distance of a parameter from the truth [standard deviations]."""


class Outcome(enum.StrEnum):
    """Outcome of one calibration."""

    SUCCESS = "success"
    REFUSAL = "refusal"
    """Refusal: the method raised an error that names the cause."""
    NAMED = "named"
    """The result is wrong, and a warning names the cause, or it is stated that the cause could hide by as much.

    Only for conditions that name an optic."""
    SILENT = "silent failure"
    """Silent failure: the result is wrong and there was no error. A crash counts as a silent failure too.

    With an optic, a warning that names the cause makes it ``named`` instead."""
    FAILED = "failed"
    """The study failed: recording or comparison could not be made, or a worker died. It says nothing of the method."""


@dataclass(frozen=True)
class Method:
    """Calibration method. Without settings it is the paper's method."""

    name: str
    """Name of the method in reports."""
    settings: Settings | None
    """Settings of the calibration; None for the paper's method."""

    @property
    def model(self) -> str:
        """Name of the largest refraction model that the result can have."""
        if self.settings is None:
            return "circle"
        return "exact" if self.settings.model == AUTO else self.settings.model

    @property
    def identity(self) -> dict[str, Any]:
        """Settings that identify the method, as JSON data."""
        if self.settings is None:
            return {"method": "paper"}
        return settings_to(self.settings) | {"sharpness": self.settings.sharpness.value}

    def run(
        self, sample: SimulatedSample | OpticSample, condition: Condition, seed: int, device: str
    ) -> Calibration:
        """Calibrate a sample. Raises :class:`AmiwarpError` if the method refuses it."""
        if isinstance(sample, OpticSample):
            return self._run_optic(sample, condition, seed, device)
        if self.settings is None:
            return calibrate_as_paper(sample.recording, start=sample.hardware, device=device)
        start = sample.hardware if condition.start != "none" else {}
        photometric = self.settings.photometric
        if condition.timing_known:
            sensor = SensorTiming(condition.latency_us, condition.refractory_us)
            photometric = replace(photometric, sensor=sensor)
        settings = replace(self.settings, seed=seed, start=start, photometric=photometric)
        return calibrate(sample.recording, settings, device=device)

    def _run_optic(
        self, sample: OpticSample, condition: Condition, seed: int, device: str
    ) -> Calibration:
        """Calibrate a sample of any optic."""
        if self.settings is None:
            raise AmiwarpError(
                "the paper's method is compared where no optic is named; leave it out"
            )
        sensor = SensorTiming(refractory_us=condition.refractory_us)  # which is on data sheets
        photometric = replace(self.settings.photometric, sensor=sensor)
        settings = replace(
            self.settings, seed=seed, model=sample.rig.model, photometric=photometric
        )
        return calibrate(sample.recording, settings, device=device)


_SHARP = Settings(model="exact", stages=STAGES[:1])


METHODS = (
    Method("default", Settings()),
    Method("paper", None),
    Method("sharpness", _SHARP),
    Method("circle", Settings(model="circle")),
    Method("gradient", replace(_SHARP, sharpness=Sharpness.GRADIENT)),
    Method("entropy", replace(_SHARP, sharpness=Sharpness.ENTROPY)),
    Method("J by DIRECT", replace(_SHARP, sharpness=Sharpness.PAPER_J)),
    Method(
        "CRS + Sbplx", replace(_SHARP, global_algorithm="GN_CRS2_LM", local_algorithm="LN_SBPLX")
    ),
)
"""All methods of the study: sharpness measures, models and algorithms, with and without the photometric stage.

The paper's method and the default are always run.
"""


@dataclass(frozen=True)
class Result:
    """Result of one calibration method on one recording."""

    outcome: Outcome
    """Outcome: success, refusal or silent failure."""
    error_px: Annotated[float, partial(real, low=0.0, high=LARGEST_PX)] | None
    """Model error relative to the ground truth [px rms]; None if the method refused the recording, or the study failed.
    """
    limit_px: Annotated[float, partial(real, low=0.0, high=LARGEST_PX)]
    """Largest model error with which this calibration counts as a success [px rms]."""
    seconds: Annotated[float, partial(real, low=0.0, high=1e9)]
    """Run time of the calibration [s]."""
    message: str = ""
    """Error message of a refusal or of what failed, or warnings of the calibration."""
    machine: str = ""
    """Description of the machine that ran the calibration."""
    deviations: dict[str, Annotated[float, partial(real, low=0.0, high=MOST_DEVIATION)]] = field(
        default_factory=dict
    )
    """Distances of the quantities :data:`STATED` from the truth, in standard deviations that the calibration states;
    empty for a circle and for a refused recording."""
    stated_px: Annotated[float, partial(real, low=0.0, high=LARGEST_PX)] | None = None
    """Standard deviation of the motion that the calibration states [px rms]; None if it states none, and for conditions
    that name no optic."""

    def __post_init__(self) -> None:
        """Raise :class:`AmiwarpError` for an outcome that does not follow from the error."""
        within = self.error_px is not None and self.error_px <= self.limit_px
        is_success = self.outcome is Outcome.SUCCESS
        without_error = self.outcome in (Outcome.REFUSAL, Outcome.FAILED)
        has_wrong_error = without_error and self.error_px is not None
        if within != is_success or has_wrong_error:
            raise AmiwarpError(
                f"outcome {self.outcome} does not fit error_px = {self.error_px} and {self.limit_px}"
            )


def failed_result(message: str, seconds: float) -> Result:
    return Result(Outcome.FAILED, None, LIMIT_PX, seconds, message)


def judge(cell: Cell, method: Method, sample: SimulatedSample | OpticSample, device: str) -> Result:
    """Run one method on a recording, and compare its result with the ground truth."""
    if isinstance(sample, OpticSample):
        limit = OPTIC_LIMIT_PX
    else:
        limit = max(LIMIT_PX, BEST_FIT * best_fit(cell.condition, method.model))
    began = time.perf_counter()
    try:
        calibration = method.run(sample, cell.condition, cell.seed, device)
    except AmiwarpError as error:
        seconds = time.perf_counter() - began
        return Result(Outcome.REFUSAL, None, limit, seconds, str(error))
    except MemoryError:  # says something of the machine, not of the method
        raise
    except Exception as error:  # a crash is no clear error, so it is no refusal
        seconds = time.perf_counter() - began
        return Result(Outcome.SILENT, None, limit, seconds, f"crashed: {error!r}")
    seconds = time.perf_counter() - began

    if isinstance(sample, OpticSample):
        return judge_optic(cell.condition, sample, calibration, seconds)
    error_px = compare(calibration, sample).rms
    outcome = Outcome.SUCCESS if error_px <= limit else Outcome.SILENT
    away = {}
    if method.model == "exact":
        away = deviations(calibration, cell.condition, sample)
    message = "; ".join(calibration.warnings)
    stored_px = min(error_px, LARGEST_PX)
    return Result(outcome, stored_px, limit, seconds, message, deviations=away)


def judge_optic(
    condition: Condition, sample: OpticSample, calibration: Calibration, seconds: float
) -> Result:
    """Compare a calibration of any optic with the truth."""
    stage = calibration.photometric
    if stage is not None and not stage.accepted:
        return Result(Outcome.REFUSAL, None, OPTIC_LIMIT_PX, seconds, stage.verdict)
    error_px = placing_error.error_px(sample.rig, sample.recording, calibration)
    error_px = min(error_px, LARGEST_PX)

    hiding: list[str] = []
    stated_px = None
    if stage is not None:
        hiding = could_hide(stage.hidden_px, error_px)
        if stage.deviation_px is not None:
            stated_px = min(stage.deviation_px, LARGEST_PX)

    outcome = Outcome.SILENT
    messages = [*calibration.warnings, *hiding]
    if error_px <= OPTIC_LIMIT_PX:
        outcome = Outcome.SUCCESS
        messages = [*calibration.warnings]
    elif names_cause(messages, troubles_of(condition)):
        outcome = Outcome.NAMED
    message = "; ".join(messages)
    return Result(outcome, error_px, OPTIC_LIMIT_PX, seconds, message, stated_px=stated_px)


def deviations(
    calibration: Calibration, condition: Condition, sample: SimulatedSample
) -> dict[str, float]:
    """Return the distance of each parameter of :data:`STATED` from the truth [stated standard deviations].

    Quantities without a stated standard deviation are left out; so is the phase if the sensor's timing is part of it.
    """
    exact = calibration.exact
    difference = compare(exact, sample)
    apex = exact.parameters["apex"]
    away = {
        "apex": apex - sample.truth.prism.apex,
        "phase": difference.lag,
        "size": difference.gain,
    }

    stated = {"apex": exact.uncertainty.get("apex", 0.0)}
    if condition.timing_known:
        stated["phase"] = exact.uncertainty.get("phase", 0.0)
    if apex:
        stated["size"] = stated["apex"] / apex
    return {
        name: min(abs(away[name]) / deviation, MOST_DEVIATION)
        for name, deviation in stated.items()
        if deviation > 0.0
    }


@dataclass(frozen=True)
class Difference:
    """Difference of a calibration from the truth, over the image and a turn."""

    rms: float
    """Difference of the compensated positions without the lag [px rms]; infinite if none is valid."""
    lag: float
    """Constant angle by which the calibration is behind the truth [rad]."""
    gain: float
    """Relative error of the size of the displacements."""


def compare(calibration: Calibration, sample: SimulatedSample) -> Difference:
    """Compare a calibration, the path that it gives the prism included, with the truth."""
    events = sample.recording.events
    xy, t = _places(calibration, sample)
    target = sample.truth.compensate_points(xy, sample.motion.angle(t))
    encoder = calibration.encoder_for(sample.plain, events.t_first, events.t_last)
    encoder = encoder.with_clock_offset(0.0)
    theta = encoder.angle_at(np.clip(t, *encoder.coverage))
    model = calibration.model

    def away(lag: float) -> NDArray[np.float64]:
        return model.compensate_points(xy, theta + lag) - target

    def rms(lag: float) -> float:
        return float(np.sqrt(np.nanmean((away(lag) ** 2).sum(axis=1))))

    if not np.isfinite(away(0.0)).all(axis=1).any():
        return Difference(math.inf, 0.0, 0.0)

    # Gauss-Newton steps; the best of them counts, as the last need not be it.
    lag = 0.0
    lags = [lag]
    for _ in range(LAG_STEPS):
        slope = (away(lag + 0.01) - away(lag - 0.01)) / 0.02
        square = float(np.nansum(slope**2))
        if square:
            lag = lag - float(np.nansum(away(lag) * slope)) / square
        lags.append(lag)
    best = min(lags, key=rms)

    moved = target - xy
    gain = float(np.nansum(away(best) * moved) / np.nansum(moved**2))
    return Difference(rms(best), best, gain)


def _places(
    calibration: Calibration, sample: SimulatedSample
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return pixels [px] and times [us] at which a calibration is compared: over the image, and over a turn.

    They are times of events if a smaller model was selected because it suffices there. Without an encoder, the times
    cover the whole recording.
    """
    events = sample.recording.events
    if calibration.ladder is not None and calibration.model_name != "exact":
        step = max(1, len(events) // JUDGED)
        some = events.slice(0, len(events))[::step]
        return np.stack([some.x, some.y], axis=1).astype(np.float64), some.t

    # Times at which the prism has evenly spaced angles
    if sample.plain is None:
        times = np.linspace(events.t_first, events.t_last, 20_000)
        angle = sample.motion.angle(times)
        wanted = np.linspace(angle[0], angle[-1], 97)
    else:
        times = np.linspace(0.0, sample.plain.t[-1] - 1000.0, 20_000)
        angle = sample.motion.angle(times)
        wanted = np.arange(36) * (TWO_PI / 36)
    t = np.rint(np.interp(wanted, angle, times))

    camera = sample.truth.camera
    x = np.linspace(0.0, camera.width - 1.0, 32)
    y = np.linspace(0.0, camera.height - 1.0, 24)
    every = np.stack(np.meshgrid(x, y, t, indexing="ij"), axis=-1).reshape(-1, 3)
    return every[:, :2], every[:, 2].astype(np.int64)


@cache
def best_fit(condition: Condition, model: str) -> float:
    """Return the error of the best fit of ``model`` to the true model [px rms].

    It is 0 for the exact model: a wrong camera or prism that the recording states is no excuse.
    """
    if model != "circle":
        return 0.0
    truth = ExactModel(condition.camera, condition.prism)

    def error(parameters: NDArray[np.float64]) -> float:
        scale, phase = parameters.tolist()
        values = {"deflection": condition.prism.deflection * abs(scale), "phase": phase}
        fitted = build_model(model, condition.camera, condition.prism, values)
        return predicted_error(fitted, truth, grid=8).rms

    best = minimize(error, [1.0, 0.0], method="Nelder-Mead", options={"maxfev": 80})
    return float(best.fun)


QUICK_METHODS = ("default", "paper", "sharpness")
"""Names of the methods of a quick run."""


def chosen(names: Sequence[str] = ()) -> tuple[Method, ...]:
    """Return methods by their names; the default and the paper's method are always included."""
    if not names:
        return METHODS
    wanted = (*names, "default", "paper")
    return tuple(method for method in METHODS if method.name in wanted)
