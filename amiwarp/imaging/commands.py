"""Command ``filter``: part of the events of a recording; ``export-c`` has a file of its own."""

import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from amiwarp.cli import common as cli
from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.imaging.c_command import run_export_c as run_export_c
from amiwarp.io import open_recording
from amiwarp.io.assumptions import assumed_texts
from amiwarp.io.output_formats import EXTENSION_HELP

_in_filter = partial(
    typer.Option, rich_help_panel="Filter, in the order in which the parts are applied"
)

MOST_HOT = 12
"""Largest number of hot pixels that are printed. ``--json`` has all."""


@dataclass(frozen=True)
class FilterOptions:
    """Options of the parts of a filter."""

    window: Annotated[
        str | None,
        _in_filter(
            help="Keep the events of this time (s from the first event); both ends are optional.",
            metavar="START:END",
        ),
    ] = None
    region: Annotated[
        str | None,
        _in_filter(
            help="Keep the events of a part of the image (px). Right and bottom are exclusive.",
            metavar="LEFT,TOP,RIGHT,BOTTOM",
        ),
    ] = None
    only: Annotated[
        Literal["on", "off"] | None, _in_filter(help="Keep the events of one polarity.")
    ] = None
    hot_pixels: Annotated[
        bool,
        _in_filter(
            "--hot-pixels",
            help="Remove and list pixels that fire far more often than those around them.",
        ),
    ] = False
    refractory_us: Annotated[
        int,
        _in_filter(
            min=0,
            help="Remove events within this time after the last kept one of their pixel (us).",
        ),
    ] = 0
    background_ms: Annotated[
        float | None,
        _in_filter(
            min=0.001,
            help="Remove events as noise if no neighbour fired within this time before (ms), such as 10.",
        ),
    ] = None
    most_mev_s: Annotated[
        float | None,
        _in_filter(
            min=1e-6, help="Largest rate (million events/s); more events are removed evenly."
        ),
    ] = None
    every: Annotated[
        int, _in_filter(min=1, help="Of the events that are left, keep every n-th.")
    ] = 1


def run_filter(
    source: Annotated[
        Path, typer.Argument(help="Recording in any supported format, with a prism or without.")
    ],
    out: Annotated[
        Path,
        typer.Argument(help=f"File to write. Its extension gives the format: {EXTENSION_HELP}."),
        cli.OUTPUT,
    ],
    *,
    parts: FilterOptions,
    layout: cli.FileOptions,
    format: cli.Format = None,
    topic: cli.Topic = None,
    common: cli.Common,
) -> None:
    """Keep part of a recording: time, region, polarity; remove hot pixels, noise, and events beyond a rate.

    Prints the number of events that each part has removed, and the rates before and after. In amiwarp's format,
    encoder, camera, prism, ground truth, IMU samples and frames are kept; with --window, the IMU samples and frames
    within it.
    """
    from amiwarp.imaging.filters import EventFilter, filter_recording, find_hot_pixels

    began = time.perf_counter()
    if parts == FilterOptions():
        raise AmiwarpError(
            "no filter is chosen; give --window, --background-ms or another one, see --help",
            ErrorCode.OPTIONS,
        )
    recording = open_recording(source, topic=topic, **layout.given())
    events = recording.events
    background_us = 0
    if parts.background_ms is not None:
        background_us = cli.microseconds(parts.background_ms, "ms", "--background-ms")
    chosen = EventFilter(
        window=None
        if parts.window is None
        else cli.span(parts.window, events.t_first, events.t_last),
        region=None if parts.region is None else cli.parse_region(parts.region),
        polarity=None if parts.only is None else int(parts.only == "on"),
        hot_pixels=find_hot_pixels(events, events.size) if parts.hot_pixels else None,
        refractory_us=parts.refractory_us,
        background_us=background_us,
        most_per_s=0.0 if parts.most_mev_s is None else 1e6 * parts.most_mev_s,
        every=parts.every,
    )
    with cli.progress("filtering") as advance:
        summary = filter_recording(recording, out, chosen, format=format, progress=advance)
    seconds = time.perf_counter() - began
    data: dict[str, Any] = {"file": str(out), **asdict(summary), "seconds": seconds}
    data["assumptions"] = assumed_texts(recording.metadata)
    cli.report(common, data, _lines(data))


def _lines(data: dict[str, Any]) -> Iterator[str]:
    from amiwarp.imaging.filters import NAMES

    rate = data["events"] / max(data["seconds"], 1e-9) / 1e6
    share = 100.0 * data["kept"] / data["events"]
    kept = f"{data['kept']:,} of {data['events']:,} events ({share:.3g} %)"
    yield f"{data['file']}: {kept}, {data['seconds']:.2f} s, {rate:.3g} Mev/s"
    for name, count in data["removed"].items():
        yield f"removed by {NAMES[name]}: {count:,}"
    records = [f"{count:,} {RECORD_NAMES[name]}" for name, count in data["removed_records"].items()]
    if records:
        yield f"removed by time: {', '.join(records)}"
    before = 1e6 * data["events"] / max(data["duration_us"], 1)
    after = 1e6 * data["kept"] / max(data["kept_us"], 1)
    yield f"rate: {before:,.0f} events/s before, {after:,.0f} events/s after"
    if data["hot_pixels"]:
        listed = ", ".join(f"({x}, {y}) {count:,}" for x, y, count in data["hot_pixels"][:MOST_HOT])
        more = len(data["hot_pixels"]) - MOST_HOT
        yield f"hot pixels: {listed}" + (f" and {more} more" if more > 0 else "")
    yield from cli.assumption_lines(data["assumptions"])
    if data["left_out"]:
        yield f"note: the format leaves out: {', '.join(data['left_out'])}"
    yield from cli.time_notes(data)


RECORD_NAMES = {"imu_samples": "IMU samples", "frames": "frames"}
"""Names of the records of other sensors."""
