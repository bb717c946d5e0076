"""``amiwarp render``: film of the events of a recording."""

import time
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from amiwarp.choices import FilmMode
from amiwarp.cli import common as cli
from amiwarp.io import open_recording
from amiwarp.io.assumptions import assumed_texts

_in_frames = partial(typer.Option, rich_help_panel="Frames")


@dataclass(frozen=True)
class FrameOptions:
    """Options for what the frames show."""

    mode: Annotated[
        FilmMode,
        _in_frames(
            help="counts: numbers of OFF and ON events; surface: latest events, which fade (time surface)."
        ),
    ] = FilmMode.COUNTS
    fps: Annotated[
        float, _in_frames(min=0.1, max=1000.0, help="Frames per second of the film.")
    ] = 30.0
    speed: Annotated[
        float | None,
        _in_frames(
            help="Speed relative to real time; 0.01: a hundred times slower. Default: 1.",
            show_default=False,
        ),
    ] = None
    frame_ms: Annotated[
        float | None,
        _in_frames(
            min=0.001,
            help="Time of the events in a frame of counts (ms). Without --speed, such frames follow one another. "
            "Default: the time since the frame before.",
            show_default=False,
        ),
    ] = None
    events: Annotated[
        int | None,
        _in_frames(
            min=1,
            help="Number of events in a frame of counts, instead of a time.",
            show_default=False,
        ),
    ] = None
    decay_ms: Annotated[
        float | None,
        _in_frames(
            min=0.001,
            help="Time constant of the time surface (ms). Default: three frames.",
            show_default=False,
        ),
    ] = None
    window: Annotated[
        str | None,
        _in_frames(
            help="Show the events of this time (s from the first event); both ends are optional.",
            metavar="START:END",
        ),
    ] = None
    scale: Annotated[
        int | None,
        _in_frames(
            min=1,
            max=64,
            help="Whole number by which the picture is enlarged. Default: the least for a width of 960 px.",
            show_default=False,
        ),
    ] = None
    caption: Annotated[
        bool,
        _in_frames(
            "--caption/--no-caption", help="Write time, event rate and colours below the picture."
        ),
    ] = True


def run_render(
    source: Annotated[
        Path, typer.Argument(help="Recording in any supported format, with a prism or without.")
    ],
    out: Annotated[
        Path, typer.Argument(help="Film to write: .mp4, or .gif for short ones."), cli.OUTPUT
    ],
    *,
    frames: FrameOptions,
    layout: cli.FileOptions,
    topic: cli.Topic = None,
    common: cli.Common,
) -> None:
    """Write a film of a recording's events, with a prism or without, also in slow motion.

    OFF events are blue, ON events are orange. Memory use does not depend on the length of the recording.
    """
    from amiwarp.plotting.film import render
    from amiwarp.reconstruction.film_files import check_film

    check_film(out, fps=frames.fps)  # before the recording is read
    began = time.perf_counter()
    device = cli.choose_device(common.device)
    recording = open_recording(source, topic=topic, **layout.given())
    events = recording.events
    window = None
    if frames.window is not None:
        ends = (events.t_first, events.t_last) if len(events) else (0, 0)
        window = cli.span(frames.window, *ends)
    with cli.progress("rendering") as advance:
        summary = render(
            recording,
            out,
            mode=frames.mode,
            fps=frames.fps,
            speed=frames.speed,
            frame_us=None
            if frames.frame_ms is None
            else cli.microseconds(frames.frame_ms, "ms", "--frame-ms"),
            events=frames.events,
            decay_us=None if frames.decay_ms is None else 1e3 * frames.decay_ms,
            window=window,
            scale=frames.scale,
            caption=frames.caption,
            device=device,
            progress=advance,
        )
    seconds = time.perf_counter() - began
    data: dict[str, Any] = {
        "file": str(out),
        **asdict(summary),
        "device": device,
        "seconds": seconds,
    }
    data["assumptions"] = assumed_texts(recording.metadata)
    cli.report(common, data, [_summary_line(data), *cli.assumption_lines(data["assumptions"])])


def _summary_line(data: dict[str, Any]) -> str:
    """Return size, length and speed of a film, and how fast it was made, in a line."""
    speed_text = "" if data["speed"] is None else f" at {data['speed']:.4g} of real time"
    film = (
        f"{data['frames']:,} frames of {data['width']} x {data['height']} px, "
        f"{data['frames'] / data['fps']:.4g} s{speed_text}"
    )
    rate = data["events"] / max(data["seconds"], 1e-9) / 1e6
    work = f"{data['frames'] / max(data['seconds'], 1e-9):.3g} frames/s, {rate:.3g} Mev/s on {data['device']}"
    return f"{data['file']}: {film}; {data['events']:,} events in {data['seconds']:.2f} s, {work}"
