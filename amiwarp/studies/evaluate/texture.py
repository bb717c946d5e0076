"""Evaluation of texture stability: how evenly events cover the image, and how many there are."""

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, TypedDict

import numpy as np
from numpy.typing import NDArray

from amiwarp.events.recording import Events
from amiwarp.studies.evaluate import study
from amiwarp.studies.evaluate.claims import Claim, differences, judge, ranges
from amiwarp.studies.evaluate.study import CellResult, Chart, Condition, Settings, Stream, Table

# Evenness of events over the image: kernel density at each event's place, and its variance.

FINENESS = 2
"""Cells of the grid per pixel, along each axis. Pixel centres are centres of cells, so those of plain events are exact.

Other places are rounded to the cell, as if the Gaussian's variance were larger by 1 / (6 FINENESS²) px²: by 4 % for a
standard deviation of 1 px, by 0.5 % for 3 px.
"""
TRUNCATE = 5.0
"""Radius at which the Gaussian kernel ends [standard deviations]."""


def event_counts(x: NDArray[Any], y: NDArray[Any], size: tuple[int, int]) -> NDArray[np.float32]:
    """Return the number of events in each cell of a grid over the image, whose outermost cells are half outside.

    ``x``, ``y``: places [px], shape (n,); those outside the image are left out. ``size``: width and height [px].
    """
    columns, rows = (FINENESS * n + 1 for n in size)
    half = FINENESS // 2
    column, row = (np.rint(FINENESS * v.astype(np.float32)).astype(np.int32) + half for v in (x, y))
    inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
    cell = (row * columns + column)[inside]
    return np.asarray(np.bincount(cell, minlength=rows * columns).reshape(rows, columns), np.float32)


def density_variance(counts: NDArray[np.float32], h_px: float) -> float:
    """Return the variance of ρ / mean ρ, where ρ is the kernel density at each event: 0 for an even distribution.

    ``counts``: events in the cells of a grid, see :func:`event_counts`. ``h_px``: standard deviation of the Gaussian
    kernel. Each event contributes to its own density, as usual for kernel density estimates. Near the border the
    density is divided by the part of the kernel that lies in the image. NaN without events. For a Poisson process of λ
    events/px² the variance is about λ / (4πh²) / (λ + 1 / (2πh²))².
    """
    number = float(counts.sum(dtype=np.float64))
    if not number:
        return float("nan")
    mass = study.smoothed(counts, FINENESS * h_px, truncate=TRUNCATE, mirrored=False)
    density = mass / _inside_share(counts.shape, h_px)
    mean = float(np.sum(counts * density, dtype=np.float64)) / number
    return float(np.sum(counts * (density / mean - 1.0) ** 2, dtype=np.float64)) / number


@lru_cache(maxsize=16)
def _inside_share(shape: tuple[int, int], h_px: float) -> NDArray[np.float32]:
    """Return the part of the kernel around each cell that lies in the image."""
    cells = np.ones(shape, np.float32)
    for edge in (cells[0], cells[-1], cells[:, 0], cells[:, -1]):
        edge *= 0.5
    return study.smoothed(cells, FINENESS * h_px, truncate=TRUNCATE, mirrored=False)


# Evaluation.

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

H_PX, WINDOW_MS = 3.0, 33.0
"""Standard deviation of the kernel [px], and length of the window [ms], of the comparison with the paper."""
WIDTHS, WINDOWS = (1.0, 2.0, 3.0, 5.0, 8.0), (10.0, 20.0, 33.0, 66.0, 132.0)
"""Values of both in the sensitivity curves."""
REPEATS = 4
"""Largest number of windows of a recording."""
PAPER = {"paper, AMI-EV": 0.196, "paper, S-EV": 0.425}
"""Variances in the paper."""


class _Row(TypedDict):
    stream: Stream
    h: study.Amount
    window: study.Amount
    variance: study.Amount | None


class _Rate(TypedDict):
    stream: Stream
    rate: study.Amount


class Values(TypedDict):
    """What :func:`measure` returns."""

    rows: list[_Row]
    rates: list[_Rate]


def conditions(settings: Settings) -> list[Condition]:
    """Return the standard scenes, at rest and moving."""
    return settings.scenes()


def measure(streams: study.RecordedStreams, settings: Settings) -> dict[str, Any]:
    """Return the variance for each stream, kernel and window, and each stream's event rate [1/s]."""
    rows, rates = [], []
    for stream in streams.names_with_own(settings):
        for window_ms in WINDOWS:
            counts = [event_counts(e.x, e.y, streams.size) for e in _windows(streams, stream, window_ms)]
            for h_px in WIDTHS if window_ms == WINDOW_MS else (H_PX,):
                seen = [v for v in (density_variance(c, h_px) for c in counts) if np.isfinite(v)]
                variance = float(np.mean(seen)) if seen else None
                rows.append({"stream": stream.value, "h": h_px, "window": window_ms, "variance": variance})
    for stream in (s for s in (Stream.PLAIN, Stream.RAW) if s in streams.names):
        count = streams.count(stream, streams.start_us, streams.end_us)
        rates.append({"stream": stream.value, "rate": count / (streams.end_us - streams.start_us)})
    return {"rows": rows, "rates": rates}


def _windows(streams: study.RecordedStreams, stream: Stream, window_ms: float) -> list[Events]:
    """Return the events of up to :data:`REPEATS` windows, spread over the recording.

    Windows of the stream with the same count are left out if the plain event camera recorded too few events.
    """
    length = min(round(window_ms * 1e3), streams.end_us - streams.start_us)
    number = min(REPEATS, (streams.end_us - streams.start_us) // length)
    starts = np.linspace(streams.start_us, streams.end_us - length, number).astype(np.int64)
    found = [(int(t), streams.window(stream, int(t), int(t) + length)) for t in starts]
    if stream is not Stream.SAME_COUNT:
        return [events for _, events in found]
    return [e for t, e in found if len(e) >= study.ENOUGH * streams.count(Stream.RAW, t, t + length)]


def tables(results: Sequence[CellResult]) -> list[Table]:
    """Return the variances of the paper's protocol, both sensitivity curves, and the event rates."""
    rows, rates = study.rows_of(results, "rows"), study.rows_of(results, "rates")
    by = ("scene", "camera", "stream")
    names = ("scene", "camera", "stream")
    variance = ("seeds", "variance of ρ / mean ρ", "std")

    def chart(x: str, **extra: Any) -> Chart:
        return Chart(x, variance[1], "stream", "std", panels=("scene", "camera"), marks=PAPER, **extra)

    standard = [r for r in rows if (r["h"], r["window"]) == (H_PX, WINDOW_MS)]
    kernel, window = ([r for r in rows if r[o] == v] for o, v in (("window", WINDOW_MS), ("h", H_PX)))
    return [
        Table("texture", "Variance of the event density, h = 3 px, 33 ms", (*names, *variance),
              study.grouped(standard, by, ["variance"]), "Lower is more even. At rest the S-EV records noise only, "
              "which is even, and never as many events as the AMI-EV. Raw and compensated events of the AMI-EV differ "
              "little: the measure does not show the compensation. A self-calibrated stream has fewer seeds where the "
              "calibration refused the others.",
              Chart("camera", variance[1], "stream", "std", panels=("scene",), marks=PAPER, kind=study.ChartKind.BARS)),
        Table("texture_kernel", "Variance over the kernel's width, windows of 33 ms", (*names, "h [px]", *variance),
              study.grouped(kernel, (*by, "h"), ["variance"]), "A wide kernel hides blur; a narrow one counts noise.",
              chart("h [px]")),
        Table("texture_window", "Variance over the length of the window, h = 3 px",
              (*names, "window [ms]", *variance), study.grouped(window, (*by, "window"), ["variance"]),
              "A quarter turn at 720 rpm takes 21 ms.", chart("window [ms]", log_x=True)),
        Table("event_rate", "Event rate", (*names, "seeds", "rate [Mev/s]", "std"), study.grouped(rates, by, ["rate"]),
              "Events of the whole recording over its duration."),
    ]  # fmt: skip


def claims(results: Sequence[CellResult]) -> list[Claim]:
    """Return the verdicts on the evenness, on its dependence on the camera's motion, and on their robustness."""
    rows = [r for r in study.rows_of(results, "rows") if r["camera"] != "recording"]
    standard = [r for r in rows if (r["h"], r["window"]) == (H_PX, WINDOW_MS)]
    moving, ami = [r for r in standard if r["camera"] != "still"], {"stream": Stream.CALIBRATED}
    what = f"the variance of '{Stream.CALIBRATED}' less that of "

    def less(number: int | None, text: str, rows: list[dict[str, Any]], other: Stream) -> Claim:
        return judge(number, text, differences(rows, "variance", ami, {"stream": other}), f"{what}'{other}'", below=0.0)

    # at rest the S-EV records noise alone, which is even
    spread = differences(ranges(moving, "variance"), "variance", ami, {"stream": Stream.PLAIN}, by=("scene",))
    return [
        less(1, "The density of events is more even than the S-EV's (moving camera; at rest an S-EV records noise "
             "alone: see the table).", moving, Stream.PLAIN),
        judge(1, "It depends less on the camera's motion.", spread, "the range of the variance over the camera's "
              f"motions of '{Stream.CALIBRATED}' less that of '{Stream.PLAIN}'", below=0.0),
        *(less(None, f"More even with h = {h:g} px and windows of {window:g} ms.",
               [r for r in rows if (r["h"], r["window"]) == (h, window) and r["camera"] != "still"], Stream.PLAIN)
          for h, window in ((WIDTHS[0], WINDOW_MS), (WIDTHS[-1], WINDOW_MS), (H_PX, WINDOWS[0]), (H_PX, WINDOWS[-1]))),
        less(None, "More even than an S-EV with as many events.", moving, Stream.SAME_COUNT),
    ]  # fmt: skip
