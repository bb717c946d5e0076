"""Evaluation of apex and speed: blur of edges and event rate, for sensors of several bandwidths."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from amiwarp.errors import AmiwarpError
from amiwarp.imaging.metrics import edge_blur
from amiwarp.studies.evaluate.conditions import Condition, Stream, Streams
from amiwarp.studies.evaluate.results import CellResult, Chart, Claim, Settings, Table, grouped, rows_of

TITLE = "Apex angle and speed"
PROTOCOL = (
    "The blur is the standard deviation of events across edges, which are found in the image of the compensated "
    "events (amiwarp.edge_blur), over one turn of the prism and a camera at rest. The events are compensated by the "
    "true model, so that no error of a calibration adds to it. The constant delay of the sensor shifts the phase and "
    "is removed as a calibration would: by the delay, of 41 between 0 and 4 ms, at which the blur is smallest. "
    "Bandwidth is that of the photoreceptors at white; a darker pixel is slower in proportion."
)
DIFFERENCES = (
    "The paper measures one sensor, whose bandwidth it does not state, with events of real edges. Here the bandwidth "
    "is varied, the scene is the simulated room, and the sensor otherwise the DVXplorer's model. Edges are found in "
    "the compensated events themselves, and events more than 3 px away do not count, so a blur of more than about 1 "
    "px is understated."
)
NEEDS_TRUTH = True

APEX_DEG = (0.5, 1.0, 2.0)
"""Apex angles [deg]."""
SPEEDS, QUICK_SPEEDS = (180.0, 360.0, 720.0, 1080.0, 1440.0), (360.0, 720.0, 1440.0)
"""Speeds of the prism [turns/min]."""
BANDWIDTHS, QUICK_BANDWIDTHS = (0.0, 3000.0, 1000.0, 300.0), (0.0, 300.0)
"""Bandwidths of the photoreceptors at white [Hz]; 0 for unlimited."""
DELAYS_US, COARSE = np.arange(0, 4001, 100), 5
"""Delays that are tried [us]; of each ``COARSE`` of them one at first."""
MOST_EVENTS = 200_000
"""Largest number of events of which the blur is measured."""
USUAL_RPM = 720.0
"""Speed above which the paper reports a surge [turns/min]."""
SURGE = 1.25
"""Smallest increase of the blur above :data:`USUAL_RPM` that counts as a surge."""


def conditions(settings: Settings) -> list[Condition]:
    """Return a turn of the prism at rest for each apex, speed and bandwidth."""
    speeds, bandwidths = (QUICK_SPEEDS, QUICK_BANDWIDTHS) if settings.quick else (SPEEDS, BANDWIDTHS)
    size = replace(settings, width=min(settings.width, 320), height=min(settings.height, 240))
    return [
        replace(condition, duration_s=60.0 / rpm)
        for degrees in APEX_DEG
        for rpm in speeds
        for cutoff in bandwidths
        for condition in size.conditions(
            world="room", trajectory="still", apex=float(np.radians(degrees)), rpm=rpm, cutoff_hz=cutoff
        )
    ]


def measure(streams: Streams, settings: Settings) -> dict[str, Any]:
    """Return blur [px], the delay that was removed [us], and event rate [Mev/s]."""
    count = streams.count(Stream.RAW, 0, streams.end_us)
    blur: dict[int, float] = {}
    for delay in DELAYS_US[::COARSE]:
        blur[int(delay)] = _blur(streams, int(delay))
    rough = min(blur, key=blur.__getitem__)
    for delay in DELAYS_US[(rough - 500 < DELAYS_US) & (rough + 500 > DELAYS_US)]:
        blur.setdefault(int(delay), _blur(streams, int(delay)))
    best = min(blur, key=blur.__getitem__)
    row = {"blur": blur[best], "delay": best, "uncorrected": blur[0], "mev_per_s": count / streams.end_us}
    return {"rows": [row | {"degrees": round(float(np.degrees(streams.condition.apex)), 3)}]}


def _blur(streams: Streams, delay_us: int) -> float:
    """Return the blur after compensation with the true model, of events that are ``delay_us`` late; NaN if unknown."""
    xy = streams.compensated_late(delay_us, MOST_EVENTS)
    try:
        return edge_blur(xy, *streams.size)
    except AmiwarpError:
        return float("inf")


def tables(results: Sequence[CellResult]) -> list[Table]:
    """Return blur and event rate over speed, apex and bandwidth."""
    rows = [{**r, "bandwidth": _name(r["cutoff_hz"]), "apex_name": f"apex {r['degrees']:g}°"} for r in _rows(results)]
    by, names = ("apex_name", "bandwidth", "rpm"), ("apex", "bandwidth", "speed [rpm]", "seeds")

    def table(name: str, title: str, value: str, label: str, caption: str) -> Table:
        chart = Chart("speed [rpm]", label, "bandwidth", "std", panels=("apex",))
        return Table(name, title, (*names, label, "std"), grouped(rows, by, [value]), caption, chart)

    return [
        table("apex_speed_blur", "Blur of edges over speed", "blur", "blur [px]",
              "Compensated by the true model, with the best delay."),
        table("apex_speed_delay", "Delay of the sensor over speed", "delay", "delay [us]",
              "Delay at which the blur is smallest. Compensation with one phase for all pixels removes the mean delay, "
              "not its spread between bright and dark pixels."),
        table("apex_speed_rate", "Event rate over speed", "mev_per_s", "rate [Mev/s]",
              "A limited bandwidth loses events at high speed."),
    ]  # fmt: skip


def _rows(results: Sequence[CellResult]) -> list[dict[str, Any]]:
    return [r for r in rows_of(results, "rows") if np.isfinite(r["blur"])]


def _name(cutoff_hz: float | None) -> str:
    return f"{cutoff_hz:g} Hz" if cutoff_hz else "unlimited"


def claims(results: Sequence[CellResult]) -> list[Claim]:
    """Return the verdicts on the surge above 720 rpm: for each bandwidth, and whether 2 deg is worse."""
    rows = _rows(results)
    found = []
    for cutoff in sorted({r["cutoff_hz"] for r in rows}, key=lambda hz: hz or np.inf, reverse=True):
        below, above = (
            _mean(rows, "blur", cutoff_hz=cutoff, rpm=rpm, degrees=0.5) for rpm in (USUAL_RPM, 2 * USUAL_RPM)
        )
        known = below is not None and above is not None
        ours = f"{below:.2f} px at 720 rpm, {above:.2f} px at 1440 rpm" if known else "no result"
        found.append(Claim.judge(
            f"The error surges above 720 rpm (apex 0.5°, bandwidth {_name(cutoff)}).", "curve", ours,
            above > SURGE * below if below is not None and above is not None else None,
            f"the mean blur at 1440 rpm is more than {SURGE:g} times that at 720 rpm",
        ))  # fmt: skip
    small, large = (_mean(rows, "mev_per_s", rpm=USUAL_RPM, degrees=d, cutoff_hz=0.0) for d in (0.5, 2.0))
    known = small is not None and large is not None
    found.append(Claim.judge(
        "A prism of 2° is impractical: it gives too many events.", "text",
        f"{large:.2f} Mev/s at 2°, {small:.2f} at 0.5°" if known else "no result",
        large > 2.0 * small if small is not None and large is not None else None,
        "the event rate at 2° is more than twice that at 0.5° (720 rpm, unlimited bandwidth)",
    ))  # fmt: skip
    return found


def _mean(rows: Sequence[dict[str, Any]], name: str, **where: float) -> float | None:
    """Return the mean of a column over the rows with the given values, or None without any."""
    given = [r[name] for r in rows if all(r[k] == v for k, v in where.items())]
    return float(np.mean(given)) if given else None
