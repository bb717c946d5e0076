"""``amiwarp record``: recording of a live camera and encoder to a file that survives crashes."""

import threading
from pathlib import Path
from typing import Annotated

import typer

from amiwarp.cli.console import report
from amiwarp.cli.live import SourceOptions, StatusLine, check_angles, check_whole, stopped_by_interrupt, summary
from amiwarp.cli.options import OUTPUT, CameraOptions, Common, NominalPrismOptions
from amiwarp.io.native_writer import LiveWriter
from amiwarp.live.stream.camera_clock import clock_offset

EXAMPLE = "amiwarp record dv recording.h5 --port find --seconds 10"


def run(
    source: Annotated[
        str,
        typer.Argument(
            help="Source: dv, prophesee, tcp:HOST:PORT, unix:PATH, '-' for standard input, or a file to replay."
        ),
    ],
    out: Annotated[Path, typer.Argument(help="Recording to write (.h5)."), OUTPUT],
    *,
    stream: SourceOptions,
    camera: CameraOptions,
    prism: NominalPrismOptions,
    common: Common,
) -> None:
    """Record events and prism angles until the source ends, --seconds have passed, or Ctrl-C.

    If the stream breaks off, the command exits with code 1 and keeps the events received so far.

    During recording the file is called NAME.part.h5. It can be read at any time; after a crash it lacks at most the
    last second.
    """
    from amiwarp.live.stream.session import Session

    stop = threading.Event()
    with StatusLine(stop, stream.seconds) as line, stream.link() as link:
        opened = stream.open(source, line.say)
        check_angles(opened, link)
        width, height = opened.size
        writer = LiveWriter(
            out, width=width, height=height, camera=camera.build(width, height) or opened.camera,
            prism=prism.build(opened.prism), metadata={"recorded_from": opened.name},
            clock_offset_us=clock_offset(opened, link),
        )  # fmt: skip
        with stopped_by_interrupt(stop), writer:  # in this order, so that Ctrl-C leaves no unfinished file
            status = Session(opened, link=link, raw=[writer], say=line.say).run(stop, line.update)
    data = {"file": str(out), **summary(status, opened), "messages": list(line.messages)}
    text = f"{out}: {status.events:,} events in {status.seconds:.1f} s, {data['mev_per_s']:.3g} Mev/s"
    report(
        common,
        data,
        [text, *([f"{status.late:,} events arrived too late to be sorted by time"] if status.late else [])],
    )
    check_whole(opened, status)
