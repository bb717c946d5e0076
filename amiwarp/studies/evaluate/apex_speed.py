"""Evaluation of apex and speed: blur of edges and event rate, for sensors of several bandwidths."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal, TypedDict

import numpy as np

from amiwarp.errors import AmiwarpError
from amiwarp.imaging.metrics import edge_blur
from amiwarp.studies.evaluate import study
from amiwarp.studies.evaluate.claims import Claim, differences, judge
from amiwarp.studies.evaluate.study import CellResult, Chart, Condition, Settings, Stream, Streams, Table

TITLE = "Apex angle and speed"
PROTOCOL = (
    "A camera at rest sees bright and dark discs, whose edges are known, through one turn of the prism. Blur is half "
    "the range that holds the middle 68 % of the events' distances from the true edges, up to 18 px, so that it does "
    "not saturate; edge blur is the paper's measure, the standard deviation of events across edges that are found in "
    "the events themselves (amiwarp.edge_blur). The events are compensated by the true model, so that no error of a "
    "calibration adds to it. The constant delay of the sensor shifts the phase and is removed as a calibration would: "
    "by the delay up to 8 ms at which the blur is smallest. Bandwidth is that of the photoreceptors at white; a "
    "darker pixel is slower in proportion, so that 100 Hz is also a sensor of 1000 Hz in a tenth of the light. To "
    "find what limits the speed, an ideal sensor is given one limit of the DVXplorer's model at a time."
)
DIFFERENCES = (
    "The paper measures one sensor, whose bandwidth and light it does not state, with events of real edges; a motor "
    "that vibrates more at high speed would blur them too, and is not simulated. Here the bandwidth is varied; the "
    "other values are those of the DVXplorer's model. The paper's measure leaves out events over 3 px from an edge, so "
    "it saturates near 1 px."
)
VERSION = 2
NEEDS_TRUTH = True

APEX_DEG = (0.5, 1.0, 2.0)
"""Apex angles [deg]."""
SPEEDS, QUICK_SPEEDS = (180.0, 360.0, 720.0, 1440.0, 2880.0), (360.0, 720.0, 1440.0)
"""Speeds of the prism [turns/min]."""
BANDWIDTHS, QUICK_BANDWIDTHS = (0.0, 1000.0, 300.0, 100.0), (0.0, 1000.0, 100.0)
"""Bandwidths of the photoreceptors at white [Hz]; 0 for unlimited."""
USUAL_DEG, USUAL_HZ = 0.5, 1000.0
"""Apex angle [deg] and bandwidth [Hz] of the sensors with one limit."""
DELAYS_US, COARSE = np.arange(0, 8001, 100), 10
"""Delays that are tried [us]; of each ``COARSE`` of them one at first."""
BLUR_EVENTS, MOST_EVENTS = 30_000, 200_000
"""Largest number of events of which the blur is measured, and the edge blur."""
USUAL_RPM = 720.0
"""Speed above which the paper reports a surge [turns/min]."""
SURGE = 1.25
"""Smallest increase of the blur above :data:`USUAL_RPM` that counts as a surge."""


class _Row(TypedDict):
    degrees: study.Amount
    blur: study.Amount | None
    delay: study.Count
    edge_blur: study.Amount | None
    mev_per_s: study.Amount


class _Light(TypedDict):
    degrees: study.Amount
    light: Literal["bright", "dark"]
    blur: study.Amount | None
    own_delay: study.Count
    own_blur: study.Amount | None


class Values(TypedDict):
    """What :func:`measure` returns."""

    rows: list[_Row]
    light: list[_Light]


def conditions(settings: Settings) -> list[Condition]:
    """Return a turn of the prism for each apex, speed and bandwidth, and for sensors with one limit."""
    speeds, bandwidths = (QUICK_SPEEDS, QUICK_BANDWIDTHS) if settings.quick else (SPEEDS, BANDWIDTHS)
    size = replace(settings, width=min(settings.width, 320), height=min(settings.height, 240))
    grid: list[dict[str, Any]] = [{"apex": a, "cutoff_hz": hz} for a in APEX_DEG for hz in bandwidths]
    grid += [{"apex": USUAL_DEG, "only": limit} for limit in (study.IDEAL, *study.LIMITS)]
    grid.append({"apex": USUAL_DEG, "only": study.BANDWIDTH, "cutoff_hz": min(bandwidths[1:])})
    return [
        replace(condition, rpm=rpm, duration_s=60.0 / rpm)
        for values in grid
        for rpm in speeds
        for condition in size.conditions(
            world=study.DISCS, trajectory="still", **{**values, "apex": float(np.radians(values["apex"]))}
        )
    ]


def measure(streams: Streams, settings: Settings) -> dict[str, Any]:
    """Return blur [px], the delay that was removed [us], edge blur [px] and event rate [Mev/s].

    The blur is also given for the edges of bright and of dark discs alone, with the delay of both and with their own.
    """
    discs = study.DiscTarget.of_seed(streams.size, streams.condition.seed)
    blur = {delay: _blur(streams, discs, delay) for delay in DELAYS_US[::COARSE].tolist()}
    for name in ("all", "bright", "dark"):
        rough = min(blur, key=lambda d: blur[d][name])
        for delay in DELAYS_US[np.abs(DELAYS_US - rough) < 100 * COARSE].tolist():
            if delay not in blur:
                blur[delay] = _blur(streams, discs, delay)
    best = {name: min(blur, key=lambda d: blur[d][name]) for name in ("all", "bright", "dark")}
    known = {"degrees": round(float(np.degrees(streams.condition.apex)), 3)}
    count = streams.count(Stream.RAW, 0, streams.end_us)
    row = {"blur": _finite(blur[best["all"]]["all"]), "delay": best["all"],
           "edge_blur": _edge_blur(streams, best["all"]), "mev_per_s": count / streams.end_us}  # fmt: skip
    light = [known | {"light": name, "blur": _finite(blur[best["all"]][name]), "own_delay": best[name],
                      "own_blur": _finite(blur[best[name]][name])} for name in ("bright", "dark")]  # fmt: skip
    return {"rows": [known | row], "light": light}


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None


def _blur(streams: Streams, discs: study.DiscTarget, delay_us: int) -> dict[str, float]:
    """Return the blur of all edges, and of those of bright and of dark discs, of events that are ``delay_us`` late."""
    distance, luminance = discs.distances(streams.compensated_late(delay_us, BLUR_EVENTS))
    bright = luminance > study.BACKGROUND
    return {
        "all": study.robust_spread(distance, luminance),
        "bright": study.robust_spread(distance[bright], luminance[bright]),
        "dark": study.robust_spread(distance[~bright], luminance[~bright]),
    }


def _edge_blur(streams: Streams, delay_us: int) -> float | None:
    """Return the paper's measure, or None if there are no edges."""
    try:
        return edge_blur(streams.compensated_late(delay_us, MOST_EVENTS), *streams.size)
    except AmiwarpError:
        return None


def tables(results: Sequence[CellResult]) -> list[Table]:
    """Return blur, edge blur, delay and event rate over speed, apex and bandwidth; and the blur of single limits."""
    rows = _rows(results, "rows")
    whole = [r for r in rows if r["only"] is None]
    columns = ("apex", "bandwidth", "speed [rpm]")

    def over_speed(name: str, title: str, value: str, label: str, caption: str) -> Table:
        chart = Chart("speed [rpm]", label, "bandwidth", "std", panels=("apex",), log_x=True)
        return Table(name, title, (*columns, "seeds", label, "std"),
                     study.grouped(whole, ("apex_name", "bandwidth", "rpm"), [value]), caption, chart)  # fmt: skip

    return [
        over_speed("apex_speed_blur", "Blur of edges over speed", "blur", "blur [px]",
                   "Distance of events from the true edges, compensated by the true model with the best delay."),
        over_speed("apex_speed_edge_blur", "The paper's measure of blur over speed", "edge_blur", "edge blur [px]",
                   "Edges are found in the events themselves, and events more than 3 px away do not count."),
        Table("apex_speed_limits", "Blur of a sensor with one limit only (apex 0.5°)",
              ("limit", "speed [rpm]", "seeds", "blur [px]", "std"), _limits(rows),
              f"An ideal sensor (limit: {study.IDEAL}) with one limit of the DVXplorer's model, or with a lower "
              "bandwidth; and the model with all limits.",
              Chart("speed [rpm]", "blur [px]", "limit", "std", log_x=True)),
        Table("apex_speed_light", "Blur and delay of bright and dark edges (apex 0.5°)",
              ("bandwidth", "edges of discs", "speed [rpm]", "seeds", "blur [px]", "std", "own delay [us]",
               "std of delay", "blur with own delay [px]", "std of blur"),
              study.grouped([r for r in _rows(results, "light") if r["only"] is None and r["degrees"] == USUAL_DEG],
                      ("bandwidth", "light", "rpm"), ["blur", "own_delay", "own_blur"]),
              "One phase for all pixels removes the mean delay, not its difference between bright and dark pixels.",
              Chart("speed [rpm]", "blur [px]", "edges of discs", "std", panels=("bandwidth",), log_x=True)),
        over_speed("apex_speed_delay", "Delay of the sensor over speed", "delay", "delay [us]",
                   "Delay at which the blur is smallest."),
        over_speed("apex_speed_rate", "Event rate over speed", "mev_per_s", "rate [Mev/s]",
                   "A limited bandwidth loses events at high speed."),
    ]  # fmt: skip


def _limits(rows: Sequence[dict[str, Any]]) -> list[tuple[study.Value, ...]]:
    """Return the blur over limit and speed; all limits together last."""
    bandwidth = study.BANDWIDTH
    chosen = [r | {"limit": f"bandwidth {r['cutoff_hz'] or USUAL_HZ:g} Hz" if r["only"] == bandwidth else r["only"]}
              for r in rows if r["only"] is not None]  # fmt: skip
    chosen += [r | {"limit": "all"} for r in rows
               if (r["only"], r["cutoff_hz"], r["degrees"]) == (None, USUAL_HZ, USUAL_DEG)]  # fmt: skip
    return study.grouped(chosen, ("limit", "rpm"), ["blur"])


def _rows(results: Sequence[CellResult], name: str) -> list[dict[str, Any]]:
    """Return rows with the names of apex and bandwidth; those without events are left out."""
    rows = [r for r in study.rows_of(results, name) if r["blur"] is not None]
    return [{**r, "bandwidth": _name(r["cutoff_hz"]), "apex_name": f"apex {r['degrees']:g}°"} for r in rows]


def _name(cutoff_hz: float | None) -> str:
    return f"{cutoff_hz:g} Hz" if cutoff_hz else "unlimited"


def claims(results: Sequence[CellResult]) -> list[Claim]:
    """Return the verdicts on the surge above 720 rpm, and on the error and the number of events of a prism of 2 deg."""
    rows = [r for r in _rows(results, "rows") if r["only"] is None]
    bandwidths = sorted({r["cutoff_hz"] for r in rows}, key=lambda hz: hz or np.inf, reverse=True)
    usual = [r for r in rows if (r["rpm"], r["cutoff_hz"]) == (USUAL_RPM, 0.0)]
    large, small = {"degrees": 2.0}, {"degrees": 0.5}
    return [
        *(judge(13, f"The error surges above 720 rpm (apex 0.5°, bandwidth {_name(hz)}).",
                differences([r for r in rows if (r["cutoff_hz"], r["degrees"]) == (hz, 0.5)], "blur",
                            {"rpm": 2 * USUAL_RPM}, {"rpm": USUAL_RPM}, by=("apex_name",), relative=True),
                "the blur at 1440 rpm relative to that at 720 rpm", above=SURGE - 1.0) for hz in bandwidths),
        judge(14, "The error of a prism of 2° is larger than that of 0.5° (720 rpm).",
              differences(usual, "blur", large, small, by=("rpm",)), "the blur at 2° less that at 0.5°", above=0.0,
              unit="px"),
        judge(14, "A prism of 2° gives more events.", differences(usual, "mev_per_s", large, small, by=("rpm",)),
              "the event rate at 2° less that at 0.5°", above=0.0, unit="Mev/s"),
    ]  # fmt: skip
