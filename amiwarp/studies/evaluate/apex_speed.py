"""Evaluation of apex and speed: blur of edges for several bandwidths, timing errors and models, and event rate."""

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from typing import Any, Literal, TypedDict

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.imaging.metrics import edge_blur
from amiwarp.optics.camera import Camera
from amiwarp.optics.models.base import Model
from amiwarp.optics.models.circle import CircleModel
from amiwarp.optics.models.comparison import ModelError, predicted_error, rms
from amiwarp.optics.models.exact import ExactModel
from amiwarp.optics.prism import Prism
from amiwarp.studies.evaluate.claims import (
    Claim,
    differences,
    judge,
    judge_number,
    untestable,
    untestable_as_stated,
)
from amiwarp.studies.evaluate.conditions import (
    BANDWIDTH,
    DISCS,
    IDEAL,
    INDEX,
    LIMITS,
    Condition,
    Settings,
)
from amiwarp.studies.evaluate.discs import BACKGROUND, DiscTarget, robust_spread
from amiwarp.studies.evaluate.event_images import thinned
from amiwarp.studies.evaluate.results import (
    Amount,
    CellResult,
    Chart,
    ChartKind,
    Count,
    Table,
    Value,
    finite,
    grouped,
    rows_of,
    where,
)
from amiwarp.studies.evaluate.streams import Stream, Streams

TITLE = "Apex angle and speed"
PROTOCOL = (
    "A camera at rest sees bright and dark discs, whose edges are known, through one turn of the prism. Blur is half "
    "the range that holds the middle 68 % of the events' distances from the true edges, up to 18 px, so that it does "
    "not saturate; edge blur is the paper's measure, the standard deviation of events across edges that are found in "
    "the events themselves (amiwarp.edge_blur). The events are compensated by the true model, so that no error of a "
    "calibration adds to it. The constant delay of the sensor shifts the phase and is removed as a calibration would: "
    "by the delay up to 8 ms at which the blur is smallest. Bandwidth is the photoreceptors' at white; a "
    "darker pixel is slower in proportion, so that 100 Hz is also a sensor of 1000 Hz in a tenth of the light. To "
    "find what limits the speed, an ideal sensor is given one limit of the DVXplorer's model at a time. Errors of "
    "synchronisation are added to the encoder's times of the same recordings: independent errors of its samples, a "
    "slow wander with knots every 20 ms, a constant offset that a calibration at 720 rpm has absorbed, and the offset "
    "that a clock's drift makes after the calibration (1 ms is 17 ppm of a minute). The displacement error is the rms "
    "distance of the compensated events from where the true model at the true angle puts them. It is also given for "
    "the paper's circle, whose deflection fits the true model best. An error surges above 720 rpm if its relative "
    "growth from 720 to 1440 rpm is larger, by more than 10 percentage points, than that from 360 to 720 rpm: for an "
    "error in proportion to the speed, both are 100 %."
)
DIFFERENCES = (
    "The paper measures one sensor, whose bandwidth and light it does not state, with events of real edges; a motor "
    "that vibrates more at high speed would blur them too, and is not simulated. Here the bandwidth is varied; the "
    "other values come from the DVXplorer's model. The paper's measure leaves out events over 3 px from an edge, so "
    "it saturates near 1 px."
)
VERSION = 4
NEEDS_TRUTH = True

APEX_DEG = (0.5, 1.0, 2.0)
"""Apex angles [deg]."""
SPEEDS = (180.0, 360.0, 720.0, 1440.0, 2880.0)
QUICK_SPEEDS = (360.0, 720.0, 1440.0)
"""Speeds of the prism [turns/min]."""
BANDWIDTHS = (0.0, 1000.0, 300.0, 100.0)
QUICK_BANDWIDTHS = (1000.0, 100.0)
"""Bandwidths of the photoreceptors at white [Hz]; 0 for unlimited."""
SENSORS = (IDEAL, *LIMITS)
QUICK_SENSORS = (IDEAL, BANDWIDTH)
"""Single limits of the sensors at the usual apex angle."""
WHOLE = (640, 480)
"""Width and height of the whole sensor [px]."""
USUAL_DEG = 0.5
USUAL_HZ = 1000.0
"""Apex angle [deg] and bandwidth [Hz] of the sensors with one limit."""
DELAYS_US = np.arange(0, 8001, 100)
COARSE = 10
"""Delays that are tried [us]; of each ``COARSE`` of them one at first."""
BLUR_EVENTS = 30_000
MOST_EVENTS = 200_000
"""Largest number of events of which the blur is measured, and the edge blur."""
NONE = "none"
SAMPLES = "error of each sample"
WANDER = "slow wander"
OFFSET = "offset, calibrated at 720 rpm"
DRIFT = "drift"
"""Kinds of timing errors of the encoder."""
ERRORS_US = (250.0, 500.0, 1000.0, 2000.0)
QUICK_ERRORS_US = (1000.0,)
"""Sizes of the timing errors: their rms [us]."""
USUAL_US = 1000.0
"""Size of the timing error in the verdicts [us]."""
TIMING_ERRORS = f"timing errors of {USUAL_US * 1e-3:g} ms"
"""The timing error of the verdicts in words."""
WANDER_US = 20_000.0
"""Time between the knots of a slow wander [us]."""
EXACT = "exact model"
CIRCLE = "circle"
"""Models that compensate: the true one, and the paper's."""
CIRCLE_PX = 2.0
"""Error of the circle in a field of view of 90° that the paper states [px]."""
PRACTICAL_PX = 2.0
"""Largest compensation error that the paper states for its system [px]."""
USUAL_RPM = 720.0
"""Speed above which the paper reports a surge [turns/min]."""
SURGE = 0.1
"""Least amount by which the relative growth of an error above :data:`USUAL_RPM`, per doubling, exceeds that below."""
ERROR_VALUES = ("displacement", "blur", "edge_blur")
ERROR_COLUMNS = (
    "displacement [px]",
    "std of displacement",
    "blur [px]",
    "std",
    "edge blur [px]",
    "std of edge blur",
)
"""Values of a row of errors, and the columns of their mean and standard deviation in tables."""
FIELDS = {
    "90° across the width": 90.0,
    "90° across the diagonal": float(np.degrees(2.0 * np.arctan(WHOLE[0] / np.hypot(*WHOLE)))),
}
"""Fields of view of 90° [deg, across the width]: the paper does not say across what."""


class _Row(TypedDict):
    degrees: Amount
    blur: Amount | None
    delay: Count
    edge_blur: Amount | None
    mev_per_s: Amount


class _Light(TypedDict):
    degrees: Amount
    light: Literal["bright", "dark"]
    blur: Amount | None
    own_delay: Count
    own_blur: Amount | None


class _Error(TypedDict):
    degrees: Amount
    model: Literal["exact model", "circle"]
    timing: Literal[
        "none", "error of each sample", "slow wander", "offset, calibrated at 720 rpm", "drift"
    ]
    error_us: Amount
    displacement: Amount
    blur: Amount | None
    edge_blur: Amount | None


class Values(TypedDict):
    """What :func:`measure` returns."""

    rows: list[_Row]
    light: list[_Light]
    errors: list[_Error]


def conditions(settings: Settings) -> list[Condition]:
    """Return a turn of the prism for each apex, speed and bandwidth, and for sensors with one limit.

    At the usual speed and bandwidth there is also the whole sensor, at whose border the circle is worst.
    """
    speeds = QUICK_SPEEDS if settings.quick else SPEEDS
    bandwidths = QUICK_BANDWIDTHS if settings.quick else BANDWIDTHS
    limits = QUICK_SENSORS if settings.quick else SENSORS
    size = replace(settings, width=min(settings.width, 320), height=min(settings.height, 240))
    grid: list[dict[str, Any]] = []
    for degrees in APEX_DEG:
        for hz in bandwidths:
            grid.append({"apex": degrees, "cutoff_hz": hz})
    for limit in limits:
        grid.append({"apex": USUAL_DEG, "only": limit})
    grid.append({"apex": USUAL_DEG, "only": BANDWIDTH, "cutoff_hz": min(bandwidths[1:])})

    turns = []
    for values in grid:
        apex = float(np.radians(values["apex"]))
        for rpm in speeds:
            of_seeds = size.conditions(world=DISCS, trajectory="still", **{**values, "apex": apex})
            for condition in of_seeds:
                turns.append(replace(condition, rpm=rpm, duration_s=60.0 / rpm))
    usual = [c for c in turns if (c.only, c.cutoff_hz, c.rpm) == (None, USUAL_HZ, USUAL_RPM)]
    width, height = WHOLE
    return turns + [replace(condition, width=width, height=height) for condition in usual]


def measure(streams: Streams, settings: Settings) -> dict[str, Any]:
    """Return blur [px], the delay that was removed [us], edge blur [px] and event rate [Mev/s].

    The blur is also given for the edges of bright and of dark discs alone, with the delay of both and with their own;
    and, for the usual sensor, under timing errors and with the paper's circle.
    """
    turn = _TurnEvents(streams)
    blur = {delay: turn.blur(delay) for delay in DELAYS_US[::COARSE].tolist()}
    for name in ("all", "bright", "dark"):
        rough = min(blur, key=lambda deflection: blur[deflection][name])
        for delay in DELAYS_US[np.abs(DELAYS_US - rough) < 100 * COARSE].tolist():
            if delay not in blur:
                blur[delay] = turn.blur(delay)
    best = {
        name: min(blur, key=lambda deflection: blur[deflection][name])
        for name in ("all", "bright", "dark")
    }
    delay = best["all"]

    condition = streams.condition
    known = {"degrees": round(float(np.degrees(condition.apex)), 3)}
    count = streams.count(Stream.RAW, 0, streams.end_us)
    row = {
        "blur": finite(blur[delay]["all"]),
        "delay": delay,
        "edge_blur": turn.edge_blur(delay),
        "mev_per_s": count / streams.end_us,
    }
    light = []
    for name in ("bright", "dark"):
        own_delay = best[name]
        of_light = {
            "light": name,
            "blur": finite(blur[delay][name]),
            "own_delay": own_delay,
            "own_blur": finite(blur[own_delay][name]),
        }
        light.append(known | of_light)

    errors = []
    is_usual = condition.only is None and condition.cutoff_hz == USUAL_HZ
    if is_usual:
        sizes_us = QUICK_ERRORS_US if settings.quick else ERRORS_US
        errors = turn.errors(delay, sizes_us)
    return {"rows": [known | row], "light": light, "errors": [known | error for error in errors]}


class _TurnEvents:
    """Events of a turn of a prism of constant speed before the discs, and what a compensation makes of them."""

    def __init__(self, streams: Streams) -> None:
        self._streams = streams
        self._discs = DiscTarget.of_seed(streams.size, streams.condition.seed)
        encoder = streams.recording.encoder
        assert encoder is not None
        source = streams.recording.events
        self._events = thinned(source.slice(0, len(source)), MOST_EVENTS)
        self._angle = encoder.angle_at(self._events.t)
        self._interval_us = encoder.interval_us

    def places(
        self, late_us: float | NDArray[np.float64], most: int, model: Model | None = None
    ) -> NDArray[Any]:
        """Return where a model puts the events if they are late by ``late_us``, shape (n, 2), by default the true one.

        At most ``most`` events are used. ``late_us``: delay of all, or of each event [us].
        """
        rad_per_s = np.radians(6.0 * self._streams.condition.rpm)
        angle = self._angle - rad_per_s * np.asarray(late_us) * 1e-6
        step = max(1, -(-len(angle) // most))
        xy = np.stack([self._events.x, self._events.y], axis=1)[::step].astype(np.float32)
        return np.asarray((model or self._streams.true_model).compensate_points(xy, angle[::step]))

    def blur(
        self,
        late_us: float | NDArray[np.float64],
        model: Model | None = None,
        most: int = BLUR_EVENTS,
    ) -> dict[str, float]:
        """Return the blur of all edges, and of the edges of bright and of dark discs [px]; inf without events."""
        xy = self.places(late_us, most, model)
        xy = xy[np.isfinite(xy).all(axis=1)]
        distance, luminance = self._discs.distances(xy)
        bright = luminance > BACKGROUND
        dark = ~bright
        return {
            "all": robust_spread(distance, luminance),
            "bright": robust_spread(distance[bright], luminance[bright]),
            "dark": robust_spread(distance[dark], luminance[dark]),
        }

    def edge_blur(
        self, late_us: float | NDArray[np.float64], model: Model | None = None
    ) -> float | None:
        """Return the paper's measure [px], or None if there are no edges."""
        xy = self.places(late_us, MOST_EVENTS, model)
        try:
            return edge_blur(xy[np.isfinite(xy).all(axis=1)], *self._streams.size)
        except AmiwarpError:
            return None

    def errors(self, delay_us: float, sizes_us: Sequence[float]) -> list[dict[str, Any]]:
        """Return displacement error, blur and edge blur [px] of both models, without and with timing errors."""
        circle = best_circle(self._streams.true_model)
        true = self.places(delay_us, MOST_EVENTS)
        cases = [
            (NONE, 0.0),
            *((kind, us) for kind in (SAMPLES, WANDER, OFFSET, DRIFT) for us in sizes_us),
        ]
        rows = []
        for kind, us in cases:
            late = delay_us + self._timing(kind, us)
            for name, model in ((EXACT, self._streams.true_model), (CIRCLE, circle)):
                rows.append(
                    {
                        "model": name,
                        "timing": kind,
                        "error_us": us,
                        "displacement": rms(self.places(late, MOST_EVENTS, model) - true),
                        "blur": finite(self.blur(late, model)["all"]),
                        "edge_blur": self.edge_blur(late, model),
                    }
                )
        return rows

    def _timing(self, kind: str, us: float) -> NDArray[np.float64]:
        """Return the timing error of each event [us], shape (n,): those drawn at random have the rms ``us``."""
        t = (self._events.t - self._events.t[0]).astype(np.float64)
        if kind == OFFSET:
            # The calibrated phase has absorbed the angle that the prism turns by at the usual speed.
            absorbed = USUAL_RPM / self._streams.condition.rpm
            return np.full(len(t), us * (1.0 - absorbed))
        if kind not in (SAMPLES, WANDER):
            return np.full(len(t), us)
        interval_us = self._interval_us if kind == SAMPLES else WANDER_US
        knots = np.arange(0.0, t[-1] + 2.0 * WANDER_US, interval_us)
        drawn = np.random.default_rng([self._streams.condition.seed, 2]).normal(size=len(knots))
        error = np.interp(t, knots, drawn)
        return np.asarray(us * error / np.sqrt(np.mean(error**2)))


def best_circle(true: Model) -> CircleModel:
    """Return the paper's circle whose deflection fits the true model best, over the image and a turn."""
    from scipy.optimize import minimize_scalar

    assert isinstance(true, ExactModel)
    middle = true.prism.deflection

    def circle(deflection: float) -> CircleModel:
        return CircleModel(true.camera, deflection, true.phase, true.prism.flat_side)

    def error(deflection: float) -> float:
        return predicted_error(circle(deflection), true, grid=12).rms

    bounds = (0.8 * middle, 1.3 * middle)
    tolerance = 1e-4 * middle
    optimum = minimize_scalar(error, bounds=bounds, method="bounded", options={"xatol": tolerance})
    return circle(optimum.x)


@cache
def circle_error(degrees: float, fov_deg: float) -> ModelError:
    """Return how far the best circle is from the true model of an apex angle, over the whole sensor."""
    camera = Camera.from_fov(*WHOLE, float(np.radians(fov_deg)))
    true = ExactModel.from_prism(camera, Prism(float(np.radians(degrees)), INDEX), 0.0)
    return predicted_error(best_circle(true), true)


def tables(results: Sequence[CellResult]) -> list[Table]:
    """Return blur, edge blur, delay and event rate over speed, apex and bandwidth; and the blur of single limits."""
    rows = _rows(results, "rows", cropped=True)
    all_limits = where(rows, only=None)
    light = where(_rows(results, "light", cropped=True), only=None, degrees=USUAL_DEG)
    errors = _rows(results, "errors")
    return [
        _speed_table(
            all_limits,
            "apex_speed_blur",
            "Blur of edges over speed",
            "blur",
            "blur [px]",
            "Distance of events from the true edges, compensated by the true model with the best delay.",
        ),
        _speed_table(
            all_limits,
            "apex_speed_edge_blur",
            "The paper's measure of blur over speed",
            "edge_blur",
            "edge blur [px]",
            "Edges are found in the events themselves, and events more than 3 px away do not count.",
        ),
        _limits_table(rows),
        _light_table(light),
        *_timing_tables(errors),
        _models_table(errors),
        _circle_table(has_models=bool(_whole_sensor(errors))),
        _speed_table(
            all_limits,
            "apex_speed_delay",
            "Delay of the sensor over speed",
            "delay",
            "delay [us]",
            "Delay at which the blur is smallest.",
        ),
        _speed_table(
            all_limits,
            "apex_speed_rate",
            "Event rate over speed",
            "mev_per_s",
            "rate [Mev/s]",
            "A limited bandwidth loses events at high speed.",
        ),
    ]


def _speed_table(
    rows: Sequence[dict[str, Any]], name: str, title: str, value: str, label: str, caption: str
) -> Table:
    """Return a table of a value, whose column is called ``label``, over apex, bandwidth and speed."""
    return Table(
        name,
        title,
        ("apex", "bandwidth", "speed [rpm]", "seeds", label, "std"),
        grouped(rows, ("apex_name", "bandwidth", "rpm"), [value]),
        caption,
        Chart("speed [rpm]", label, "bandwidth", "std", panels=("apex",), log_x=True),
    )


def _limits_table(rows: Sequence[dict[str, Any]]) -> Table:
    """Return the table of the blur over limit and speed; all limits together last."""
    single = []
    together = []
    for row in rows:
        limit = row["only"]
        if limit is None:
            if row["cutoff_hz"] == USUAL_HZ and row["degrees"] == USUAL_DEG:
                together.append(row | {"limit": "all"})
            continue
        if limit == BANDWIDTH:
            limit = f"bandwidth {row['cutoff_hz'] or USUAL_HZ:g} Hz"
        single.append(row | {"limit": limit})
    return Table(
        "apex_speed_limits",
        "Blur of a sensor with one limit only (apex 0.5°)",
        ("limit", "speed [rpm]", "seeds", "blur [px]", "std"),
        grouped([*single, *together], ("limit", "rpm"), ["blur"]),
        f"An ideal sensor (limit: {IDEAL}) with one limit of the DVXplorer's model, or with a lower "
        "bandwidth; and the model with all limits.",
        Chart("speed [rpm]", "blur [px]", "limit", "std", log_x=True),
    )


def _light_table(rows: Sequence[dict[str, Any]]) -> Table:
    """Return the table of blur and delay of bright and of dark edges over bandwidth and speed."""
    columns = (
        "bandwidth",
        "edges of discs",
        "speed [rpm]",
        "seeds",
        "blur [px]",
        "std",
        "own delay [us]",
        "std of delay",
        "blur with own delay [px]",
        "std of blur",
    )
    return Table(
        "apex_speed_light",
        "Blur and delay of bright and dark edges (apex 0.5°)",
        columns,
        grouped(rows, ("bandwidth", "light", "rpm"), ["blur", "own_delay", "own_blur"]),
        "One phase for all pixels removes the mean delay, not its difference between bright and dark pixels.",
        Chart(
            "speed [rpm]", "blur [px]", "edges of discs", "std", panels=("bandwidth",), log_x=True
        ),
    )


def _timing_tables(errors: Sequence[dict[str, Any]]) -> list[Table]:
    """Return the tables of the true model with timing errors: over their kind and size, and how the error surges."""
    true_model = [r for r in _with_sizes(errors) if _is_cropped(r) and r["model"] == EXACT]
    usual_size = [r for r in true_model if r["error_us"] in (0.0, USUAL_US)]
    wander = [r for r in true_model if r["timing"] in (NONE, WANDER)]
    surges = [
        surge | {"measure": _in_words(measure), "ms": surge["error_us"] * 1e-3}
        for measure in ("edge_blur", "blur")
        for surge in surge_of(wander, measure)
    ]
    surge_columns = (
        "measure",
        "apex",
        "rms timing error [ms]",
        "seeds",
        "growth 360 to 720 rpm",
        "std of growth below",
        "growth 720 to 1440 rpm",
        "std of growth above",
        "surge",
        "std",
    )
    return [
        Table(
            "apex_speed_timing",
            "Error over speed with timing errors of 1 ms",
            ("apex", "timing error", "speed [rpm]", "seeds", *ERROR_COLUMNS),
            grouped(usual_size, ("apex_name", "timing", "rpm"), ERROR_VALUES),
            f"True model, {USUAL_HZ:g} Hz. Displacement: rms distance from the places without the timing error.",
            Chart("speed [rpm]", "blur [px]", "timing error", "std", panels=("apex",), log_x=True),
        ),
        Table(
            "apex_speed_timing_size",
            "Error over speed with a slow wander of the encoder's clock",
            ("apex", "rms timing error", "speed [rpm]", "seeds", *ERROR_COLUMNS),
            grouped(wander, ("apex_name", "size", "rpm"), ERROR_VALUES),
            f"True model, {USUAL_HZ:g} Hz.",
            Chart(
                "speed [rpm]", "blur [px]", "rms timing error", "std", panels=("apex",), log_x=True
            ),
        ),
        Table(
            "apex_speed_surge",
            "Surge of the error above 720 rpm over the timing error (slow wander)",
            surge_columns,
            grouped(surges, ("measure", "apex_name", "ms"), ["below", "above", "surge"]),
            f"The error surges if the second growth is larger by more than {SURGE:g}.",
            Chart(
                "rms timing error [ms]",
                "surge",
                "apex",
                "std",
                panels=("measure",),
                marks={"surge": SURGE},
            ),
        ),
    ]


def _models_table(errors: Sequence[dict[str, Any]]) -> Table:
    """Return the table of both models over the whole sensor, with and without timing errors."""
    rows = []
    for row in _whole_sensor(_with_sizes(errors)):
        timing = f"{row['timing']} of {row['size']}" if row["error_us"] else "no timing error"
        rows.append(row | {"timing": timing})
    return Table(
        "apex_speed_models",
        "Error of the circle and of the exact model over the whole sensor",
        ("apex", "timing error", "model", "seeds", *ERROR_COLUMNS),
        grouped(rows, ("apex_name", "timing", "model"), ERROR_VALUES),
        "640x480 px, 720 rpm. Displacement: rms distance of the events from their places by the true model.",
        Chart(
            "apex",
            "displacement [px]",
            "model",
            "std of displacement",
            panels=("timing error",),
            kind=ChartKind.BARS,
            marks={"the paper's system": PRACTICAL_PX},
        ),
    )


def _circle_table(*, has_models: bool) -> Table:
    """Return the table of the best circle's distance from exact refraction; empty unless models were compared."""
    rows: list[tuple[Value, ...]] = []
    if has_models:
        for degrees in APEX_DEG:
            for fov_deg in (60.0, FIELDS["90° across the diagonal"], 90.0):
                error = circle_error(degrees, fov_deg)
                rows.append((f"apex {degrees:g}°", f"{fov_deg:.3g}°", error.rms, error.worst))
    return Table(
        "apex_speed_circle",
        "Distance of the best circle from exact refraction, computed",
        ("apex", "field of view", "rms [px]", "largest [px]"),
        rows,
        "Over 640x480 px and a turn. The field of view is that across the width; 77.3° are 90° across the "
        "diagonal. The paper states 2 px in 90°, without apex angle and focal length.",
    )


def _is_cropped(row: dict[str, Any]) -> bool:
    """Return whether a row belongs to the middle of the sensor."""
    return (row["width"], row["height"]) != WHOLE


def _rows(
    results: Sequence[CellResult], name: str, *, cropped: bool = False
) -> list[dict[str, Any]]:
    """Return rows with the names of apex and bandwidth; those without events are left out.

    With ``cropped``, rows of the whole sensor are left out, too.
    """
    named = []
    for row in rows_of(results, name):
        if row["blur"] is None or (cropped and not _is_cropped(row)):
            continue
        names = {
            "bandwidth": _bandwidth_name(row["cutoff_hz"]),
            "apex_name": f"apex {row['degrees']:g}°",
        }
        named.append({**row, **names})
    return named


def _bandwidth_name(cutoff_hz: float | None) -> str:
    return f"{cutoff_hz:g} Hz" if cutoff_hz else "unlimited"


def _with_sizes(errors: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the rows of errors with the size of the timing error in words."""
    return [row | {"size": f"{row['error_us'] * 1e-3:g} ms"} for row in errors]


def claims(results: Sequence[CellResult]) -> list[Claim]:
    """Return the verdicts on the surge above 720 rpm and its cause, on 2 deg, and on apex and speed in general."""
    rows = where(_rows(results, "rows", cropped=True), only=None)
    errors = _rows(results, "errors")
    return [
        *_surge_claims(rows, errors),
        *_accuracy_claims(errors),
        *_circle_claims(has_errors=bool(errors)),
        *_large_apex_claims(errors),
        *_rate_claims(rows),
    ]


def _surge_claims(rows: Sequence[dict[str, Any]], errors: Sequence[dict[str, Any]]) -> list[Claim]:
    """Judge whether errors surge above 720 rpm: with timing errors, without, and by a sensor's bandwidth alone."""
    true_model = [r for r in errors if _is_cropped(r) and r["model"] == EXACT]
    with_errors = where(true_model, timing=WANDER, error_us=USUAL_US)
    without = where(true_model, timing=NONE, error_us=0.0)
    cases = [(measure, degrees) for measure in ("edge_blur", "blur") for degrees in (0.5, 1.0)]
    verdicts = [
        untestable(
            13,
            "The error surges dramatically above 720 rpm, because of synchronisation errors, and more with "
            "a larger apex.",
            "the paper states neither how large the synchronisation errors are nor from which "
            f"growth on an error surges dramatically; see the checks for {TIMING_ERRORS}, our choice",
        )
    ]
    for measure, degrees in cases:
        verdicts.append(_cause_of_surge(with_errors, without, degrees, measure))
    for measure, degrees in cases:
        text = (
            f"With {TIMING_ERRORS} rms, the {_in_words(measure)} surges by more than {SURGE:.0%} "
            f"(apex {degrees:g}°)."
        )
        verdicts.append(_surges(text, where(with_errors, degrees=degrees), measure, above=SURGE))
    for measure, degrees in cases:
        text = (
            f"Without timing errors, the {_in_words(measure)} does not surge by more than {SURGE:.0%} "
            f"(apex {degrees:g}°)."
        )
        verdicts.append(_surges(text, where(without, degrees=degrees), measure, below=SURGE))
    verdicts.append(_growth_with_apex(with_errors))

    bandwidths = {row["cutoff_hz"] for row in rows} - {USUAL_HZ}
    for hz in sorted(bandwidths, key=lambda hz: hz or np.inf):
        text = f"The blur surges above 720 rpm without timing errors (apex 0.5°, bandwidth {_bandwidth_name(hz)})."
        of_sensor = where(rows, cutoff_hz=hz, degrees=0.5)
        verdicts.append(_surges(text, of_sensor, "blur", above=SURGE))
    return verdicts


def _surges(
    text: str,
    rows: Sequence[dict[str, Any]],
    measure: str,
    *,
    above: float = -math.inf,
    below: float = math.inf,
) -> Claim:
    """Judge the surge of a measure of one apex against a limit."""
    surges = differences(surge_of(rows, measure), "surge", {}, by=("apex_name",))
    rule = f"the {_growth_in_words(measure)}"
    return judge(None, text, surges, rule, above=above, below=below)


def _cause_of_surge(
    with_errors: Sequence[dict[str, Any]],
    without: Sequence[dict[str, Any]],
    degrees: float,
    measure: str,
) -> Claim:
    """Judge whether timing errors enlarge the surge of a measure, at an apex [deg]."""
    surges = [
        surge | {"kind": kind}
        for kind, rows in (("with", with_errors), ("without", without))
        for surge in surge_of(where(rows, degrees=degrees), measure)
    ]
    growths = f"growth of the {_in_words(measure)} above 720 rpm relative to that below"
    return judge(
        None,
        f"{TIMING_ERRORS.capitalize()} rms enlarge the {growths} (apex {degrees:g}°).",
        differences(surges, "surge", {"kind": "with"}, {"kind": "without"}, by=("apex_name",)),
        f"the {_growth_in_words(measure)}, with timing errors less without,",
        above=0.0,
    )


def _growth_with_apex(with_errors: Sequence[dict[str, Any]]) -> Claim:
    """Judge whether the edge blur grows more above 720 rpm at 1 deg than at 0.5 deg."""
    fast = {"rpm": 2 * USUAL_RPM}
    slow = {"rpm": USUAL_RPM}
    growths = []
    by_degrees = differences(with_errors, "edge_blur", fast, slow, by=("degrees",))
    for degrees, of_seeds in by_degrees.items():
        for seed, growth in of_seeds.items():
            growths.append({"degrees": float(degrees), "seed": seed, "growth": growth})
    return judge(
        None,
        f"With {TIMING_ERRORS} rms, the edge blur grows more at 1° than at 0.5° (720 to 1440 rpm).",
        differences(growths, "growth", {"degrees": 1.0}, {"degrees": 0.5}, by=()),
        "the growth of the edge blur at 1° less that at 0.5°",
        above=0.0,
        unit="px",
    )


def _accuracy_claims(errors: Sequence[dict[str, Any]]) -> list[Claim]:
    """Judge the error of a system as the paper's; its speed on an onboard computer cannot be judged."""
    with_errors = _whole_sensor(errors, USUAL_US)
    verdicts = [
        untestable(
            11,
            "Events are compensated with an error of about 1.5 to 2.0 px.",
            "this is the error of the paper's rig, whose timing errors are not stated; see the checks for 1 ms",
        )
    ]
    for degrees in APEX_DEG:
        circle = {"degrees": degrees, "model": CIRCLE}
        claim = judge(
            None,
            f"The error of a system as the paper's, with the circle and {TIMING_ERRORS}, is at most "
            f"{PRACTICAL_PX:g} px (rms, apex {degrees:g}°, 720 rpm, whole sensor).",
            differences(with_errors, "displacement", circle, by=()),
            "the rms displacement error",
            below=PRACTICAL_PX,
            unit="px",
        )
        verdicts.append(claim)
    on_board = untestable(
        11,
        "Compensation runs in real time on an onboard computer.",
        "no onboard computer was at hand: the documentation states the rate on two cores of a server",
    )
    return [*verdicts, on_board]


def _circle_claims(*, has_errors: bool) -> list[Claim]:
    """Judge the circle's error in 90 deg by all readings of what the paper states; by none without results."""
    readings = []
    for degrees in (USUAL_DEG, 1.0) if has_errors else ():
        for field, fov_deg in FIELDS.items():
            error = circle_error(degrees, fov_deg)
            for extent, value, measure in (
                ("in the rms", error.rms, "rms error"),
                ("everywhere in the image", error.worst, "largest error"),
            ):
                reading = judge_number(
                    None,
                    f"The circle's error is within {CIRCLE_PX:g} px {extent} (apex {degrees:g}°, {field}).",
                    value,
                    f"the {measure} over 640x480 px and a turn",
                    below=CIRCLE_PX,
                    unit="px",
                )
                readings.append(reading)
    return untestable_as_stated(
        12,
        f"The circle's error is within {CIRCLE_PX:g} px in a field of view of 90°.",
        "the apex angle, along which axis the 90° are, and whether the error is the rms or the "
        "largest one",
        readings,
    )


def _large_apex_claims(errors: Sequence[dict[str, Any]]) -> list[Claim]:
    """Judge the error of 2 deg, with both models, against the error of 1 deg with the circle."""
    verdicts = [
        untestable(
            14,
            "The compensation error of 2° is too high to be practical.",
            "the paper states no error at which a prism is not practical; see the checks",
        )
    ]
    timings = (("without timing errors", 0.0), ("with timing errors of 1 ms", USUAL_US))
    for number, model, name, relation, low, high in (
        (15, CIRCLE, "the circle", "larger", 0.0, np.inf),
        (None, EXACT, "exact refraction", "smaller", -np.inf, 0.0),
    ):
        for timing, error_us in timings:
            two_degrees = {"degrees": 2.0, "model": model}
            one_degree = {"degrees": 1.0, "model": CIRCLE}
            rows = _whole_sensor(errors, error_us)
            claim = judge(
                number,
                f"With {name}, {timing}, the error of 2° is {relation} than the error of 1° with the circle "
                "(720 rpm, whole sensor).",
                differences(rows, "displacement", two_degrees, one_degree, by=()),
                "the difference of the rms displacement errors",
                above=low,
                below=high,
                unit="px",
            )
            verdicts.append(claim)
    return verdicts


def _rate_claims(rows: Sequence[dict[str, Any]]) -> list[Claim]:
    """Judge whether a larger apex and a higher speed give more events and more error."""
    usual_speed = where(rows, rpm=USUAL_RPM, cutoff_hz=USUAL_HZ)
    usual_apex = where(rows, degrees=USUAL_DEG, cutoff_hz=USUAL_HZ)
    verdicts = []
    for degrees in (1.0, 0.5):
        claim = judge(
            14,
            f"A prism of 2° gives more events than one of {degrees:g}° (720 rpm).",
            differences(
                usual_speed, "mev_per_s", {"degrees": 2.0}, {"degrees": degrees}, by=("rpm",)
            ),
            f"the event rate at 2° less that at {degrees:g}°",
            above=0.0,
            unit="Mev/s",
        )
        verdicts.append(claim)
    for value, amount, name, unit in (
        ("mev_per_s", "events", "event rate", "Mev/s"),
        ("edge_blur", "error", "edge blur", "px"),
    ):
        by_apex = differences(usual_speed, value, {"degrees": 1.0}, {"degrees": 0.5}, by=("only",))
        by_speed = differences(
            usual_apex, value, {"rpm": 2 * USUAL_RPM}, {"rpm": USUAL_RPM}, by=("only",)
        )
        for change, growth, sides in (
            ("A larger apex (720 rpm)", by_apex, "at 1° less that at 0.5°"),
            ("A higher speed (apex 0.5°)", by_speed, "at 1440 rpm less that at 720 rpm"),
        ):
            text = f"{change} gives more {amount}."
            rule = f"the {name} {sides}"
            verdicts.append(judge(15, text, growth, rule, above=0.0, unit=unit))
    return verdicts


def _in_words(measure: str) -> str:
    """Return a measure in words."""
    return measure.replace("_", " ")


def _growth_in_words(measure: str) -> str:
    """Return in words what a surge of a measure is."""
    return f"relative growth of the {_in_words(measure)} from 720 to 1440 rpm less that from 360 to 720 rpm"


def surge_of(rows: Sequence[dict[str, Any]], measure: str) -> list[dict[str, Any]]:
    """Return the surge of a measure above 720 rpm for each apex, timing error and seed: see :data:`SURGE`."""
    rows_by_speed: dict[tuple[Any, ...], dict[float, dict[str, Any]]] = {}
    for row in rows:
        case = (row["apex_name"], row.get("timing"), row.get("error_us"), row["seed"])
        if row[measure] is not None:
            rows_by_speed.setdefault(case, {})[row["rpm"]] = row
    surges = []
    for speeds in rows_by_speed.values():
        if {USUAL_RPM / 2.0, USUAL_RPM, 2.0 * USUAL_RPM} <= set(speeds):
            low = speeds[USUAL_RPM / 2.0][measure]
            usual = speeds[USUAL_RPM][measure]
            high = speeds[2.0 * USUAL_RPM][measure]
            below = usual / low - 1.0
            above = high / usual - 1.0
            growths = {"below": below, "above": above, "surge": above - below}
            surges.append(speeds[USUAL_RPM] | growths)
    return surges


def _whole_sensor(rows: Sequence[dict[str, Any]], *sizes_us: float) -> list[dict[str, Any]]:
    """Return the errors of the whole sensor without timing errors, and with a slow wander of the usual size.

    ``sizes_us``: sizes of the timing errors, by default both.
    """
    kinds = [(NONE if us == 0.0 else WANDER, us) for us in sizes_us or (0.0, USUAL_US)]
    return [r for r in rows if not _is_cropped(r) and (r["timing"], r["error_us"]) in kinds]
