"""``amiwarp view``: event clouds before and after compensation, in a window, in a browser or as a picture."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from amiwarp.cli import say
from amiwarp.cli.console import choose_device, report
from amiwarp.cli.inputs import CameraOptions, NominalPrismOptions, complete, span
from amiwarp.cli.options import OUTPUT, OUTPUT_FOLDER, Common
from amiwarp.cli.rig import parse_size
from amiwarp.cli.streams import SourceOptions, check_angles
from amiwarp.errors import AmiwarpError
from amiwarp.io import open_recording
from amiwarp.viewer.choices import Axis, Colour, View
from amiwarp.viewer.hosts import warning

if TYPE_CHECKING:
    from amiwarp.events.recording import Recording
    from amiwarp.viewer.inspector import Inspector

EXAMPLE = "amiwarp view recording.h5 --calibration calibration.json"

_PICTURE = "Picture"
LEAST_PX, MOST_PX = 100, 8000


@dataclass(frozen=True)
class PictureOptions:
    """Of a picture that is written in place of a page."""

    screenshot: Annotated[
        Path | None,
        typer.Option(help="Write a picture of both clouds (.png) and end.", rich_help_panel=_PICTURE),
        OUTPUT,
    ] = None
    view: Annotated[View, typer.Option(help="Where the camera stands.", rich_help_panel=_PICTURE)] = View.FREE
    colour: Annotated[Colour, typer.Option(help="What colours tell.", rich_help_panel=_PICTURE)] = Colour.POLARITY
    axis: Annotated[
        Axis | None, typer.Option(help="Third axis. Default: the angle, where there is one.", rich_help_panel=_PICTURE)
    ] = None
    dark: Annotated[bool, typer.Option("--dark", help="On a dark ground.", rich_help_panel=_PICTURE)] = False
    overlaid: Annotated[bool, typer.Option("--overlaid", help="Both in one frame.", rich_help_panel=_PICTURE)] = False
    size: Annotated[str, typer.Option(help="Of the picture (px).", rich_help_panel=_PICTURE)] = "1400x620"

    def write(self, first: Inspector, path: Path) -> dict[str, Any]:
        """What is drawn, for ``--json``. Raises :class:`AmiwarpError` for a format or a size that cannot be."""
        from amiwarp.viewer.app import save_screenshot
        from amiwarp.viewer.scene import Look

        if path.suffix.lower() != ".png":
            raise AmiwarpError(f"{path}: pictures are written as .png")
        third = self.axis or (Axis.ANGLE if first.has_encoder or first.knobs.rpm else Axis.TIME)
        width, height = parse_size(self.size)
        if min(width, height) < LEAST_PX or max(width, height) > MOST_PX:
            raise AmiwarpError(f"--size {self.size!r}: pictures have {LEAST_PX} to {MOST_PX} pixels a side")
        look = Look(self.colour, third, dark=self.dark, overlaid=self.overlaid)
        save_screenshot(first, path, view=self.view, look=look, size=(width, height))
        shown = first.show()
        return {
            "file": str(path), "events": shown.span.count, "drawn": len(shown.events),
            "sharpness_before": shown.sharpness_before, "sharpness_after": shown.sharpness_after,
            "notes": list(first.notes),
        }  # fmt: skip


def run(
    recording: Annotated[
        Path,
        typer.Argument(help="Recording of any format that can be read; with --live a source as of 'amiwarp live'."),
    ],
    *,
    live: Annotated[bool, typer.Option("--live", help="Follow a stream: its last two seconds.")] = False,
    controller: Annotated[
        str | None,
        typer.Option(help="With --live: serial port of the prism's controller, USB id, or 'find'. Default: none."),
    ] = None,
    calibration: Annotated[Path | None, typer.Option(help="What 'amiwarp calibrate' wrote.")] = None,
    web: Annotated[bool, typer.Option("--web", help="Serve the page and print its address; open no window.")] = False,
    host: Annotated[str, typer.Option(help="Interface to serve on; the address carries a secret token.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port to serve on; 0: a free one.")] = 0,
    out_dir: Annotated[
        Path | None,
        typer.Option(help="Folder of what the page exports. Default: the recording's, of a stream the current one."),
        OUTPUT_FOLDER,
    ] = None,
    window: Annotated[
        str | None,
        typer.Option(help="Only these seconds of the recording. Default: one turn in its middle.", metavar="START:END"),
    ] = None,
    model: Annotated[
        str | None, typer.Option(help="circle, exact, radial or ellipse. Default: as calibrated, or exact.")
    ] = None,
    picture: PictureOptions,
    camera: CameraOptions,
    prism: NominalPrismOptions,
    common: Common,
) -> None:
    """Look at events in x, y and prism angle, as recorded and compensated, and turn the prism's knobs."""
    from amiwarp.viewer.app import export_folder, has_display, open_window, serve_panel
    from amiwarp.viewer.scene import check_display

    device = choose_device(common.device)
    check_display()

    with contextlib.ExitStack() as held:
        latest = held.enter_context(_following(str(recording), controller)) if live else None

        def make() -> Inspector:
            return inspector(recording, calibration, window, model, camera, prism, device, latest)

        waiting = [make()]  # what is wrong is said here, not in the page
        if picture.screenshot is not None:
            data = {**picture.write(waiting[0], picture.screenshot), "device": device}
            report(common, data, _lines(data))
            return
        folder, in_browser = export_folder(None if live else recording, out_dir), web or not has_display()

        def ready(url: str) -> None:
            if in_browser and (text := warning(host)) is not None:
                say(text)
            report(common, {"url": url}, [f"{recording.name}: {url}", "Ctrl-C ends it"])

        def tab() -> Inspector:
            return waiting.pop() if waiting else make()

        if in_browser:
            serve_panel(tab, folder, host=host, port=port, ready=ready)
        else:
            open_window(tab, folder, ready)


def inspector(
    path: Path,
    calibration: Path | None,
    window: str | None,
    model: str | None,
    camera: CameraOptions,
    prism: NominalPrismOptions,
    device: str,
    latest: Callable[[], Recording] | None = None,
) -> Inspector:
    """The recording with what the options add, at its first window."""
    from amiwarp.calib import Calibration
    from amiwarp.optics.models import MODELS
    from amiwarp.viewer.inspector import Inspector

    found = None if calibration is None else Calibration.load(calibration)
    opened = open_recording(path) if latest is None else latest()
    made = Inspector(complete(opened, camera, prism), found, device=device, latest=latest)
    if model is not None:
        if model not in MODELS:
            raise AmiwarpError(f"--model {model!r} is unknown; choose among {', '.join(MODELS)}")
        made.set(replace(made.knobs, model=model))
    if window is not None:
        first, last = made.recording.events.t_first, made.recording.events.t_last
        low, high = span(window, first, last)
        made.window = low, high - low
    return made


@contextlib.contextmanager
def _following(spec: str, controller: str | None) -> Iterator[Callable[[], Recording]]:
    """What a stream's last seconds are by now; waits for the first turn."""
    from amiwarp.live.stream.opening import open_source
    from amiwarp.live.stream.recent_events import RecentEvents, followed

    with SourceOptions(port=controller).link() as link:
        source = open_source(spec)
        check_angles(source, link)
        ring = RecentEvents(source)
        with followed(source, link, ring, say):
            recording = ring.recording()
            assert recording is not None
            yield lambda: ring.recording() or recording


def _lines(d: dict[str, Any]) -> list[str]:
    gain = f"sharpness {d['sharpness_before']:.3f} as recorded, {d['sharpness_after']:.3f} compensated"
    return [*d["notes"], f"{d['file']}: {d['events']:,} events, {d['drawn']:,} drawn; {gain}"]
