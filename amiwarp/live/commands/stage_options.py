"""Options of ``amiwarp live`` for the stages of a stream: the filter of its events, and undistortion."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from amiwarp.cli import common as cli
from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.io import open_recording
from amiwarp.io.camera_files import load_camera

if TYPE_CHECKING:
    from amiwarp.imaging.filters import EventFilter
    from amiwarp.live.stream.session_status import StageStatus
    from amiwarp.optics.camera import Camera
    from amiwarp.results.calibration import Calibration

_in_stages = partial(
    typer.Option, rich_help_panel="Stages between the source and the outputs, in their order"
)


@dataclass(frozen=True)
class StageOptions:
    """Options of the stages, as ``amiwarp filter`` has them for files."""

    region: Annotated[
        str | None,
        _in_stages(
            help="Keep the events of a part of the image (px). Right and bottom are exclusive.",
            metavar="LEFT,TOP,RIGHT,BOTTOM",
        ),
    ] = None
    only: Annotated[
        Literal["on", "off"] | None, _in_stages(help="Keep the events of one polarity.")
    ] = None
    hot_pixels: Annotated[
        Path | None,
        _in_stages(
            help="Remove the events of the pixels that fire far more often than those around them in this recording of "
            "the same camera."
        ),
    ] = None
    refractory_us: Annotated[
        int,
        _in_stages(
            min=0,
            help="Remove events within this time after the last kept one of their pixel (us).",
        ),
    ] = 0
    background_ms: Annotated[
        float | None,
        _in_stages(
            min=0.001,
            help="Remove events as noise if no neighbour fired within this time before (ms), such as 10.",
        ),
    ] = None
    max_rate: Annotated[
        float | None,
        _in_stages(
            min=1e-6, help="Largest rate (million events/s); more events are removed evenly."
        ),
    ] = None
    undistort: Annotated[
        Path | None,
        _in_stages(
            help="Camera file, or calibration, with the lens whose distortion is removed. A pinhole camera with the "
            "same focal lengths and principal point would see the events so."
        ),
    ] = None

    def build_filter(self, size: tuple[int, int]) -> EventFilter | None:
        """Return the filter of the events of a sensor; None if the options keep all events."""
        from amiwarp.imaging.filters import EventFilter, find_hot_pixels

        background_us = 0
        if self.background_ms is not None:
            background_us = cli.microseconds(self.background_ms, "ms", "--background-ms")
        hot = None
        if self.hot_pixels is not None:
            events = open_recording(self.hot_pixels).events
            if tuple(events.size) != size:
                raise AmiwarpError(
                    f"--hot-pixels {self.hot_pixels}: is of {events.size[0]}x{events.size[1]} pixels, the source of "
                    f"{size[0]}x{size[1]}; give a recording of the same camera"
                )
            hot = find_hot_pixels(events, size)
        chosen = EventFilter(
            region=None if self.region is None else cli.parse_region(self.region),
            polarity=None if self.only is None else int(self.only == "on"),
            hot_pixels=hot,
            refractory_us=self.refractory_us,
            background_us=background_us,
            most_per_s=0.0 if self.max_rate is None else 1e6 * self.max_rate,
        )
        is_given = hot is not None or chosen != EventFilter()
        return chosen if is_given else None

    def build_lens(self, size: tuple[int, int], calibration: Calibration | None) -> Camera | None:
        """Return the camera whose distortion is removed; None without ``--undistort``."""
        if self.undistort is None:
            return None
        camera = load_camera(self.undistort, size)
        if (camera.width, camera.height) != size:
            raise AmiwarpError(
                f"--undistort {self.undistort}: is a camera of {camera.width}x{camera.height} pixels, the source has "
                f"{size[0]}x{size[1]}; give the file of this camera"
            )
        if calibration is not None and camera != calibration.model.camera:
            raise AmiwarpError(
                f"--undistort {self.undistort}: is another camera than the calibration's; give the calibration itself",
                ErrorCode.OPTIONS,
            )
        return camera


def stage_lines(stages: list[StageStatus]) -> list[str]:
    """Return a line for each stage: numbers of events before and after, reasons, and latency."""
    lines = []
    for stage in stages:
        text = f"{stage.name}: {stage.received:,} → {stage.passed:,} events"
        reasons = [f"{count:,} removed by {name}" for name, count in stage.removed.items() if count]
        reasons += [f"{count:,} {name}" for name, count in stage.marked.items() if count]
        if reasons:
            text += f" ({', '.join(reasons)})"
        if stage.latency_ms is not None:
            median, slow = stage.latency_ms
            text += f", {median:.1f} ms after the event (99 %: {slow:.1f} ms)"
        lines.append(text)
    return lines


def stage_summary(stage: StageStatus) -> dict[str, Any]:
    """Return the counts of a stage for ``--json``."""
    return {
        "name": stage.name,
        "received": stage.received,
        "passed": stage.passed,
        "removed": stage.removed,
        "marked": stage.marked,
        "latency_ms": stage.latency_ms,
    }
