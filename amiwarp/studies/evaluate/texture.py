"""Evaluation of texture stability: how evenly events cover the image, and how many there are."""

from collections.abc import Sequence
from typing import Any, TypedDict

import numpy as np

from amiwarp.events.recording import Events
from amiwarp.studies.evaluate.claims import Claim, differences, judge, ranges
from amiwarp.studies.evaluate.conditions import Condition, Settings
from amiwarp.studies.evaluate.evenness import density_variance, event_counts
from amiwarp.studies.evaluate.results import (
    Amount,
    CellResult,
    Chart,
    ChartKind,
    Table,
    grouped,
    rows_of,
    where,
)
from amiwarp.studies.evaluate.streams import ENOUGH, RecordedStreams, Stream

TITLE = "Texture stability"
PROTOCOL = (
    "The events of a window are a sample of points in the image. A Gaussian kernel of standard deviation h estimates "
    "their density ρ at the place of each event; places are rounded to half pixels. The measure is "
    "the variance of ρ / mean ρ over the events, averaged over up to four windows of a recording. Lower "
    "is more even. Random noise is as even as can be, so the measure says nothing about a camera that records noise "
    "alone, as an S-EV at rest. It cannot see compensation: raw and compensated events have nearly the same variance, "
    "see both in the table. The paper's values are marked at h = 3 px and windows of 33 ms, our choice."
)
DIFFERENCES = (
    "The paper's main text gives neither kernel width nor window nor normalisation, and its scenes are real. Absolute"
    " values therefore cannot be compared; the ranking can."
)
VERSION = 3
NEEDS_TRUTH = False

H_PX = 3.0
WINDOW_MS = 33.0
"""Standard deviation of the kernel [px], and length of the window [ms], of the comparison with the paper."""
WIDTHS = (1.0, 2.0, 3.0, 5.0, 8.0)
WINDOWS = (10.0, 20.0, 33.0, 66.0, 132.0)
"""Values of both in the sensitivity curves."""
REPEATS = 4
"""Largest number of windows of a recording."""
PAPER = {"paper, AMI-EV": 0.196, "paper, S-EV": 0.425}
"""Variances in the paper."""


class _Row(TypedDict):
    stream: Stream
    h: Amount
    window: Amount
    variance: Amount | None


class _Rate(TypedDict):
    stream: Stream
    rate: Amount


class Values(TypedDict):
    """What :func:`measure` returns."""

    rows: list[_Row]
    rates: list[_Rate]


def conditions(settings: Settings) -> list[Condition]:
    """Return the standard scenes, at rest and moving."""
    return settings.scenes()


def measure(streams: RecordedStreams, settings: Settings) -> dict[str, Any]:
    """Return the variance for each stream, kernel and window, and each stream's event rate [1/s]."""
    rows = []
    rates = []
    for stream in streams.names_with_own(settings):
        for window_ms in WINDOWS:
            counts = [
                event_counts(events.x, events.y, streams.size)
                for events in _windows(streams, stream, window_ms)
            ]
            for h_px in WIDTHS if window_ms == WINDOW_MS else (H_PX,):
                of_windows = [density_variance(of_window, h_px) for of_window in counts]
                finite = [variance for variance in of_windows if np.isfinite(variance)]
                variance = float(np.mean(finite)) if finite else None
                rows.append(
                    {"stream": stream.value, "h": h_px, "window": window_ms, "variance": variance}
                )
    for stream in (s for s in (Stream.PLAIN, Stream.RAW) if s in streams.names):
        count = streams.count(stream, streams.start_us, streams.end_us)
        rates.append({"stream": stream.value, "rate": count / (streams.end_us - streams.start_us)})
    return {"rows": rows, "rates": rates}


def _windows(streams: RecordedStreams, stream: Stream, window_ms: float) -> list[Events]:
    """Return the events of up to :data:`REPEATS` windows, spread over the recording.

    Windows of the stream with the same count are left out if the plain event camera recorded too few events.
    """
    duration_us = streams.end_us - streams.start_us
    length_us = min(round(window_ms * 1e3), duration_us)
    number = min(REPEATS, duration_us // length_us)
    starts = np.linspace(streams.start_us, streams.end_us - length_us, number).astype(np.int64)
    windows = []
    for start in starts.tolist():
        end = start + length_us
        events = streams.window(stream, start, end)
        if stream is Stream.SAME_COUNT:
            wanted = streams.count(Stream.RAW, start, end)
            if len(events) < ENOUGH * wanted:
                continue
        windows.append(events)
    return windows


def tables(results: Sequence[CellResult]) -> list[Table]:
    """Return the variances of the paper's protocol, both sensitivity curves, and the event rates."""
    rows = rows_of(results, "rows")
    rates = rows_of(results, "rates")
    names = ("scene", "camera", "stream")
    variance = ("seeds", "variance of ρ / mean ρ", "std")

    def chart(x: str, **extra: Any) -> Chart:
        return Chart(
            x, variance[1], "stream", "std", panels=("scene", "camera"), marks=PAPER, **extra
        )

    standard = where(rows, h=H_PX, window=WINDOW_MS)
    over_width = where(rows, window=WINDOW_MS)
    over_window = where(rows, h=H_PX)
    return [
        Table(
            "texture",
            "Variance of the event density, h = 3 px, 33 ms",
            (*names, *variance),
            grouped(standard, names, ["variance"]),
            "Lower is more even. At rest the S-EV records noise only, "
            "which is even, and never as many events as the AMI-EV. Raw and compensated events of the AMI-EV differ "
            "little: the measure does not show the compensation. A self-calibrated stream has fewer seeds where the "
            "calibration refused the others.",
            Chart(
                "camera",
                variance[1],
                "stream",
                "std",
                panels=("scene",),
                marks=PAPER,
                kind=ChartKind.BARS,
            ),
        ),
        Table(
            "texture_kernel",
            "Variance over the kernel's width, windows of 33 ms",
            (*names, "h [px]", *variance),
            grouped(over_width, (*names, "h"), ["variance"]),
            "A wide kernel hides blur; a narrow one counts noise.",
            chart("h [px]"),
        ),
        Table(
            "texture_window",
            "Variance over the length of the window, h = 3 px",
            (*names, "window [ms]", *variance),
            grouped(over_window, (*names, "window"), ["variance"]),
            "A quarter turn at 720 rpm takes 21 ms.",
            chart("window [ms]", log_x=True),
        ),
        Table(
            "event_rate",
            "Event rate",
            (*names, "seeds", "rate [Mev/s]", "std"),
            grouped(rates, names, ["rate"]),
            "Events of the whole recording over its duration.",
        ),
    ]


def claims(results: Sequence[CellResult]) -> list[Claim]:
    """Return the verdicts on the evenness, on its dependence on the camera's motion, and on their robustness."""
    moving = [
        row for row in rows_of(results, "rows") if row["camera"] not in ("recording", "still")
    ]
    standard = where(moving, h=H_PX, window=WINDOW_MS)
    verdicts = [
        _is_more_even(
            1,
            "The density of events is more even than the S-EV's (moving camera; at rest an S-EV records noise "
            "alone: see the table).",
            standard,
            Stream.PLAIN,
        ),
        judge(
            1,
            "It depends less on the camera's motion.",
            differences(
                ranges(standard, "variance"),
                "variance",
                {"stream": Stream.CALIBRATED},
                {"stream": Stream.PLAIN},
                by=("scene",),
            ),
            "the range of the variance over the camera's "
            f"motions of '{Stream.CALIBRATED}' less the same of '{Stream.PLAIN}'",
            below=0.0,
        ),
    ]
    for h_px, window_ms in (
        (WIDTHS[0], WINDOW_MS),
        (WIDTHS[-1], WINDOW_MS),
        (H_PX, WINDOWS[0]),
        (H_PX, WINDOWS[-1]),
    ):
        text = f"More even with h = {h_px:g} px and windows of {window_ms:g} ms."
        rows = where(moving, h=h_px, window=window_ms)
        verdicts.append(_is_more_even(None, text, rows, Stream.PLAIN))
    same_count = "More even than an S-EV with as many events."
    verdicts.append(_is_more_even(None, same_count, standard, Stream.SAME_COUNT))
    return verdicts


def _is_more_even(
    number: int | None, text: str, rows: Sequence[dict[str, Any]], than: Stream
) -> Claim:
    """Judge whether the density of the AMI-EV's events varies less than the density of another stream's."""
    return judge(
        number,
        text,
        differences(rows, "variance", {"stream": Stream.CALIBRATED}, {"stream": than}),
        f"the variance of '{Stream.CALIBRATED}' less the variance of '{than}'",
        below=0.0,
    )
