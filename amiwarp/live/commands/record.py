"""``amiwarp record``: recording of a live camera and encoder to a file that survives crashes."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Annotated

import typer

from amiwarp.cli import common as cli
from amiwarp.io.native.live_writer import LiveWriter
from amiwarp.live.commands.controller import controller_lines, controller_summary
from amiwarp.live.commands.session import (
    SecondRatio,
    SourceArgument,
    SourceOptions,
    StatusLine,
    check_angles,
    check_whole,
    lost_lines,
    recorded_from,
    session_summary,
    stopped_by_interrupt,
)


def run_record(
    source: SourceArgument,
    out: Annotated[Path, typer.Argument(help="Recording to write (.h5)."), cli.OUTPUT],
    *,
    stream: SourceOptions,
    second_ratio: SecondRatio = None,
    camera: cli.CameraOptions,
    prism: cli.NominalPrismOptions,
    common: cli.Common,
) -> None:
    """Record events and prism angles until the source ends, --seconds have passed, or Ctrl-C.

    If the stream breaks off, the command exits with code 1 and keeps the events received so far.

    During recording the file is called NAME.part.h5. It can be read at any time; after a crash it lacks at most the
    last second.
    """
    from amiwarp.live.stream.encoder_feed import clock_offset
    from amiwarp.live.stream.session import Session

    stop = threading.Event()
    with StatusLine() as line, stream.link() as link:
        opened = stream.open(source, line.say)
        encoders = check_angles(opened, link, second_ratio)
        width, height = opened.size
        writer = LiveWriter(
            out,
            width=width,
            height=height,
            camera=camera.build(width, height) or opened.camera,
            prism=prism.build(opened.prism),
            metadata=recorded_from(opened),
            encoders=encoders,
            clock_offset_us=clock_offset(opened, link),
        )
        # In this order, so that Ctrl-C leaves no unfinished file.
        with stopped_by_interrupt(stop), writer:
            session = Session(
                opened, link=link, second_ratio=second_ratio, raw=[writer], say=line.say
            )
            status = session.run(stop, line.update, seconds=stream.seconds)
        controller = None if link is None else controller_summary(link)
    data = {
        "file": str(out),
        **session_summary(status, opened),
        "controller": controller,
        "messages": list(line.messages),
    }
    lines = [
        f"{out}: {status.events:,} events in {status.seconds:.1f} s, {data['mev_per_s']:.3g} Mev/s",
        *lost_lines(data),
        *controller_lines(controller),
    ]
    if status.late:
        lines.append(f"{status.late:,} events arrived too late to be sorted by time")
    cli.report(common, data, lines)
    check_whole(opened, status)
