"""Command ``amiwarp view``: event clouds before and after compensation, in a window, a browser or a picture."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from amiwarp.choices import OPTICAL_MODELS, Axis, Colour, View
from amiwarp.cli import common as cli
from amiwarp.cli import say
from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events.recording import Recording
from amiwarp.io import open_recording
from amiwarp.io.output_formats import check_ending
from amiwarp.io.rig_files import is_rig, open_rig
from amiwarp.live.commands.session import SourceOptions, check_angles
from amiwarp.viewer.captions import beside_rows
from amiwarp.viewer.host_names import is_local
from amiwarp.viewer.look import PICTURE_PX

if TYPE_CHECKING:
    from amiwarp.viewer.inspector import Inspector
    from amiwarp.viewer.library import Library
    from amiwarp.viewer.look import Look
    from amiwarp.viewer.publish import Page
    from amiwarp.viewer.rig_pictures import ShownRig
    from amiwarp.viewer.view_state import ViewState

_LOOK = "Window and picture"
_SERVER = "Server"
LEAST_PX = 100
MOST_PX = 8000
"""Smallest and largest width or height of a window or a screenshot [px]."""
LEAST_MM = 40
MOST_MM = 1000
LEAST_DPI = 50
MOST_DPI = 1200
"""Smallest and largest width or height of a figure [mm], and smallest and largest resolution [1/inch]."""
LARGEST_OFFSET_S = 1e6
"""Largest distance in time between two recordings on one axis [s]."""
LEAST_MOTION = 0.05
"""Diameter of the orbit of a scene point, as a share of the image's width, from which a screenshot shows the whole
image. The clouds of a smaller one look alike before and after compensation."""


@dataclass(frozen=True)
class LookOptions:
    """Options of the window, and of a screenshot that is written instead of opening it."""

    screenshot: Annotated[
        Path | None,
        typer.Option(
            help="Write a picture of both event clouds (.png), a figure for print (.svg, .pdf, or .png with --dpi or a "
            "size in mm) or both clouds for ParaView (.vtp), and exit.",
            rich_help_panel=_LOOK,
        ),
        cli.OUTPUT,
    ] = None
    region: Annotated[
        str | None,
        typer.Option(
            help="Region of a screenshot (px; right and bottom exclusive), 'whole' for the whole image, or 'suggested' "
            "for the one in which compensation gains most. Default: whole, or suggested if the prism's motion is "
            "too small to be seen in the whole image.",
            metavar="LEFT,TOP,RIGHT,BOTTOM",
            rich_help_panel=_LOOK,
        ),
    ] = None
    view: Annotated[View, typer.Option(help="Viewpoint.", rich_help_panel=_LOOK)] = View.FREE
    colour: Annotated[
        Colour,
        typer.Option(
            help="Quantity shown by colour. Cause, instance and depth need a simulated recording with ground truth.",
            rich_help_panel=_LOOK,
        ),
    ] = Colour.POLARITY
    axis: Annotated[
        Axis | None,
        typer.Option(
            help="Third axis of the plot. Default: the prism angle if known, otherwise the time.",
            rich_help_panel=_LOOK,
        ),
    ] = None
    dark: Annotated[
        bool, typer.Option("--dark", help="Use a dark background.", rich_help_panel=_LOOK)
    ] = False
    overlaid: Annotated[
        bool,
        typer.Option("--overlaid", help="Draw both clouds in one frame.", rich_help_panel=_LOOK),
    ] = False
    size: Annotated[
        str | None,
        typer.Option(
            help="Size of the window or the picture (px), or of a figure (px, or mm if it ends in mm). Default: "
            "1500x950 or the largest that fits the screen, 1400x620 for a picture, and 180x130mm for a figure.",
            metavar="WIDTHxHEIGHT[mm]",
            rich_help_panel=_LOOK,
        ),
    ] = None
    dpi: Annotated[
        int | None,
        typer.Option(
            help=f"Pixels per inch of a figure for print, {LEAST_DPI} to {MOST_DPI}. Default: 300.",
            rich_help_panel=_LOOK,
        ),
    ] = None

    def look(self, inspector: Inspector) -> Look:
        """Return the style in which the clouds are drawn."""
        from amiwarp.viewer.look import Look

        turns = math.isfinite(inspector.turn_us)
        third = self.axis or (Axis.ANGLE if turns else Axis.TIME)
        return Look(self.colour, third, dark=self.dark, overlaid=self.overlaid)

    def pixels(self, usual: tuple[int, int]) -> tuple[int, int]:
        """Return width and height [px], by default the ``usual`` ones.

        Raises :class:`AmiwarpError` for a size out of range.
        """
        width, height = usual if self.size is None else cli.parse_size(self.size)
        if min(width, height) < LEAST_PX or max(width, height) > MOST_PX:
            raise AmiwarpError(
                f"--size {self.size!r}: width and height must be {LEAST_PX} to {MOST_PX} px"
            )
        return width, height

    def is_figure(self, path: Path) -> bool:
        """Return whether a figure for print is wanted."""
        in_mm = self.size is not None and self.size.endswith("mm")
        return path.suffix.lower() in (".svg", ".pdf") or self.dpi is not None or in_mm

    def page(self) -> Page:
        """Return size and resolution of a figure. Raises :class:`AmiwarpError` for values out of range."""
        from amiwarp.viewer.publish import DPI, Page

        dpi = DPI if self.dpi is None else self.dpi
        if not LEAST_DPI <= dpi <= MOST_DPI:
            raise AmiwarpError(f"--dpi {dpi}: give {LEAST_DPI} to {MOST_DPI} pixels per inch")
        if self.size is None:
            return Page(dpi=dpi)
        if not self.size.endswith("mm"):
            return Page.of_pixels(*self.pixels(PICTURE_PX), dpi)
        width, height = cli.parse_size(self.size.removesuffix("mm"), example="180x130mm")
        if min(width, height) < LEAST_MM or max(width, height) > MOST_MM:
            raise AmiwarpError(
                f"--size {self.size!r}: width and height must be {LEAST_MM} to {MOST_MM} mm"
            )
        return Page(width, height, dpi)

    def write(self, inspector: Inspector, path: Path) -> dict[str, Any]:
        """Write the picture; return a description of its content for ``--json``. An unknown phase is estimated first.

        Raises :class:`AmiwarpError` for an unknown format, or a size out of range.
        """
        from amiwarp.viewer.first_phase import estimate_phase
        from amiwarp.viewer.layout import what_is_missing
        from amiwarp.viewer.publish import FIGURE_ENDINGS, save_clouds, save_figure
        from amiwarp.viewer.screenshot import save_screenshot

        ending = check_ending(path, "pictures are written", [*FIGURE_ENDINGS, ".vtp"])
        self._check_style(path)
        page = self.page() if self.is_figure(path) else None
        size = PICTURE_PX if page is not None else self.pixels(PICTURE_PX)
        estimate_phase(inspector)
        look = self.look(inspector)
        view = self.view
        against = None
        notes: list[str] = []
        bookmark = self._apply_bookmark(inspector)
        if bookmark is not None:
            state, wrong = bookmark
            look = replace(look, colour=state.colour, axis=state.axis, overlaid=state.overlaid)
            view = state.view
            against = state.against
            notes += wrong
        if self.region is not None or not inspector.bookmark:
            notes += self._choose_region(inspector)

        shown = inspector.show(against=against)
        drawn = len(shown.events)
        if ending == ".vtp":
            drawn = save_clouds(inspector, path)
        elif page is not None:
            drawn = save_figure(inspector, path, page, view=view, look=look, against=against)
        else:
            save_screenshot(inspector, path, view=view, look=look, size=size, against=against)
        missing = what_is_missing(inspector) if inspector.has_optic else []
        return {
            "file": str(path),
            "events": shown.span.count,
            "drawn": drawn,
            "sharpness_before": shown.sharpness_before,
            "sharpness_after": shown.sharpness_after if math.isfinite(inspector.turn_us) else None,
            "beside": [
                f"{name}: {', '.join(figures)}" for name, *figures in beside_rows(inspector, shown)
            ],
            "region": list(shown.region),
            "notes": [*missing, *notes],
        }

    def _check_style(self, path: Path) -> None:
        """Raise :class:`AmiwarpError` for options that do not apply to the kind of file."""
        if path.suffix.lower() == ".vtp" and (self.size, self.dpi) != (None, None):
            raise AmiwarpError(
                f"{path}: a .vtp holds points, which have no size; leave --size and --dpi out",
                ErrorCode.OPTIONS,
            )
        if self.is_figure(path) and self.dark:
            raise AmiwarpError(
                f"{path}: a figure for print has a light background; leave --dark out",
                ErrorCode.OPTIONS,
            )

    def _apply_bookmark(self, inspector: Inspector) -> tuple[ViewState, tuple[str, ...]] | None:
        """Show the bookmark that the inspector names; return its state and what is wrong with it, or None."""
        from amiwarp.viewer.address import load_bookmark
        from amiwarp.viewer.bookmarks import Bookmarks
        from amiwarp.viewer.view_state import apply_state, current_state

        if inspector.path is None or not inspector.bookmark:
            return None
        bookmarks = Bookmarks(inspector.path)
        first = current_state(inspector)
        state, wrong = load_bookmark(bookmarks, inspector.bookmark, inspector, first)
        apply_state(inspector, state)
        return state, wrong

    def _choose_region(self, inspector: Inspector) -> list[str]:
        """Show the wanted region; return a note if it was chosen because the motion is small.

        Raises :class:`AmiwarpError` for a region that is not one of the image.
        """
        width, height = inspector.recording.events.size
        region = None
        notes = []
        if self.region == "suggested":
            region = inspector.suggest_region()
        elif self.region is None:
            alone = inspector.beside is None and inspector.depth is None
            orbit_px = inspector.orbit_px
            if alone and math.isfinite(inspector.turn_us) and 2.0 * orbit_px < LEAST_MOTION * width:
                region = inspector.suggest_region()
                notes = [
                    f"the prism moves the image by only ±{orbit_px:.1f} px of {width}: the suggested region is shown; "
                    "--region whole shows all"
                ]
        elif self.region != "whole":
            region = cli.parse_region(self.region)
            left, top, right, bottom = region
            if not (0 <= left < right <= width and 0 <= top < bottom <= height):
                raise AmiwarpError(
                    f"--region {self.region}: is no part of the image of {width}x{height} px; give "
                    f"LEFT,TOP,RIGHT,BOTTOM within 0,0,{width},{height}"
                )
        if region is not None:
            loaded = inspector.loaded.span
            inspector.open(
                loaded.start_us, loaded.length_us, replace(inspector.selection, region=region)
            )
        return notes


@dataclass(frozen=True)
class StreamOptions:
    """Options for following a live stream."""

    live: Annotated[
        bool, typer.Option("--live", help="Show the last two seconds of a live stream.")
    ] = False
    controller: Annotated[
        str | None,
        typer.Option(
            help="Serial port of the prism's controller for --live: name, USB id VID:PID, or 'find'. Default: none."
        ),
    ] = None

    @contextlib.contextmanager
    def follow(self, source: str) -> Iterator[Callable[[], Recording] | None]:
        """Follow a stream while the ``with`` block runs; yield a function that returns the stream's last seconds.

        Waits until the stream holds one turn of the prism. Without ``--live``, yields None.
        """
        if not self.live:
            if self.controller is not None:
                raise AmiwarpError(
                    "--controller applies to a live stream; give --live too", ErrorCode.OPTIONS
                )
            yield None
            return
        from amiwarp.live.stream.recent_events import LiveSource, RecentEvents, followed
        from amiwarp.live.stream.sources import open_source, reopen_source

        messages: list[str] = []

        def show_message(text: str) -> None:
            # The page shows only the latest message, the terminal all of them.
            messages[:] = [text]
            say(text)

        with SourceOptions(port=self.controller).link() as link:
            stream = open_source(source, say=show_message)
            check_angles(stream, link)
            recent = RecentEvents(stream)
            with followed(stream, link, recent, show_message, partial(reopen_source, source)):
                yield LiveSource(recent, messages)


@dataclass(frozen=True)
class PageOptions:
    """Options of the inspector's page."""

    web: Annotated[
        bool,
        typer.Option(
            "--web",
            help="Serve the page for a browser and print its address.",
            rich_help_panel=_SERVER,
        ),
    ] = False
    host: Annotated[
        str,
        typer.Option(
            help="Network address to serve on. The printed URL holds a secret token.",
            rich_help_panel=_SERVER,
        ),
    ] = "127.0.0.1"
    port: Annotated[
        int,
        typer.Option(
            min=0, max=65535, help="Port to serve on; 0 for any free port.", rich_help_panel=_SERVER
        ),
    ] = 0

    def serve(
        self,
        new_inspector: Callable[[], Inspector],
        library: Library | None,
        *,
        name: str,
        common: cli.Common,
    ) -> None:
        """Serve the inspector's page for a browser until interrupted.

        ``library``: other recordings that the page may open; ``name``: name of the recording.
        """
        from amiwarp.viewer.serve_panel import serve_panel

        def ready(url: str) -> None:
            warning = exposure_warning(self.host)
            if warning is not None:
                say(warning)
            cli.report(common, {"url": url}, [f"{name}: {url}", "stop with Ctrl-C"])

        serve_panel(new_inspector, library, host=self.host, port=self.port, ready=ready)


@dataclass(frozen=True)
class StartOptions:
    """Options of the parameters and the time window that the inspector shows first."""

    calibration: Annotated[
        Path | None, typer.Option(help="Calibration file from 'amiwarp calibrate' (.json).")
    ] = None
    window: Annotated[
        str | None,
        typer.Option(
            help="Time window to show (s from the first event). Default: one turn in the middle of the recording.",
            metavar="START:END",
        ),
    ] = None
    model: Annotated[
        str | None,
        typer.Option(
            help=f"Prism model: {', '.join(OPTICAL_MODELS[:-1])} or {OPTICAL_MODELS[-1]}. Default: the calibrated "
            "model, or exact.",
        ),
    ] = None
    beside: Annotated[
        list[Path] | None,
        typer.Option(
            help="Another recording with as many pixels, on the same time axis. The left cloud shows it, as recorded. "
            "Can be given several times: then page and window choose among them. Default: none.",
            metavar="<path>",
        ),
    ] = None
    beside_offset: Annotated[
        list[float] | None,
        typer.Option(
            help="Time of the first event of a --beside recording after this recording's first event (s). Give it once "
            "for each --beside, in their order. Default: 0, both start together.",
        ),
    ] = None
    bookmark: Annotated[
        str | None,
        typer.Option(
            help="Name of a view that was saved in the inspector. It is in RECORDING.view.json beside the recording. "
            "Default: none."
        ),
    ] = None
    sensor: Annotated[
        str | None,
        typer.Option(
            help="Sensor of a rig that is shown in full. Default: the one called left, or the first with events."
        ),
    ] = None
    depth: Annotated[
        Path | None,
        typer.Option(
            help="Depth map from 'amiwarp depth' (.npz), for a recording behind a rotating tilted plate: it is shown, "
            "and events are compensated at its depths. Default: none."
        ),
    ] = None

    def build(
        self,
        recording: Recording,
        device: str,
        latest: Callable[[], Recording] | None,
        most_points: int | None,
    ) -> Inspector:
        """Return an inspector of a recording.

        ``latest``: function that returns the latest events of a live stream, or None. ``most_points``: largest number
        of points in each cloud, or None.
        """
        from amiwarp.optics.models.registry import MODELS
        from amiwarp.results.calibration import Calibration
        from amiwarp.results.depth_map import DepthMap
        from amiwarp.viewer.inspector import Inspector

        calibration = None if self.calibration is None else Calibration.load(self.calibration)
        inspector = Inspector(
            recording, calibration, device=device, latest=latest, most_points=most_points
        )
        if self.model is not None:
            if self.model not in MODELS:
                raise AmiwarpError(
                    f"--model {self.model!r} is unknown; choose among {', '.join(MODELS)}"
                )
            inspector.use_model(self.model)
        if self.window is not None:
            events = inspector.recording.events
            start_us, stop_us = cli.span(self.window, events.t_first, events.t_last)
            inspector.window = start_us, stop_us - start_us
        for path, offset_s in zip(self.beside or (), self._offsets(), strict=True):
            inspector.put_beside(open_recording(path), round(offset_s * 1e6))
        if self.depth is not None:
            inspector.use_depths(DepthMap.load(self.depth))
        return inspector

    def _offsets(self) -> list[float]:
        """Return the offset of each recording beside [s]. Raises :class:`AmiwarpError` if there are more or fewer."""
        others = len(self.beside or ())
        offsets = self.beside_offset
        if offsets is None:
            return [0.0] * others
        if len(offsets) != others or not all(abs(offset) <= LARGEST_OFFSET_S for offset in offsets):
            given = ", ".join(f"{offset:g}" for offset in offsets)
            raise AmiwarpError(
                f"--beside-offset {given}: give one for each of the {others} --beside recordings, "
                f"-{LARGEST_OFFSET_S:g} to {LARGEST_OFFSET_S:g} s"
            )
        return offsets

    def chosen_bookmark(self, recording: Path) -> str:
        """Return the name of the bookmark to show first; empty for none, also if the file of bookmarks is damaged.

        A damaged or foreign file is named in a message. Raises :class:`AmiwarpError` for a name that the file does not
        hold.
        """
        from amiwarp.viewer.bookmarks import Bookmarks

        try:
            names = Bookmarks(recording).names()
        except AmiwarpError as error:
            say(f"{error}; the recording is shown without bookmarks")
            return ""
        if self.bookmark is not None and self.bookmark not in names:
            remedy = "save a view in the inspector first"
            if names:
                remedy = f"choose among {', '.join(names)}"
            raise AmiwarpError(
                f"--bookmark {self.bookmark!r}: {Bookmarks(recording).path} does not hold it; {remedy}"
            )
        return self.bookmark or ""


def run_view(
    recording: Annotated[
        Path,
        typer.Argument(
            help="Recording in any supported format, or the folder of a rig. With --live: a source as for 'amiwarp "
            "live'."
        ),
    ],
    *,
    stream: StreamOptions,
    start: StartOptions,
    page: PageOptions,
    look: LookOptions,
    camera: cli.CameraOptions,
    prism: cli.NominalPrismOptions,
    layout: cli.LayoutOptions,
    common: cli.Common,
) -> None:
    """Show events in x, y and prism angle, recorded and compensated, and adjust the prism's parameters by hand.

    Of a rig, one event camera is shown so, the others next to it. With --web, the page shows the frames, depth maps and
    events of all sensors at the time of the window, too.
    """
    from amiwarp.viewer.inspector import WINDOW_POINTS, Inspector
    from amiwarp.viewer.library import Library
    from amiwarp.viewer.serve import check_libraries

    _check_together(stream, start, page, look, layout)
    rig = None
    if not stream.live and is_rig(recording):
        rig = _rig_of(recording, start, layout)
    elif start.sensor is not None:
        raise AmiwarpError(f"{recording}: is no rig; leave out --sensor", ErrorCode.OPTIONS)
    if page.web:
        check_libraries()
    bookmark = "" if stream.live or rig is not None else start.chosen_bookmark(recording)
    device = cli.choose_device(common.device)
    with stream.follow(str(recording)) as latest:

        def new_inspector() -> Inspector:
            if rig is not None:
                opened = rig.rig[rig.main].recording
            elif latest is None:
                opened = open_recording(recording, **layout.given())
                _check_whole_pixels(opened, recording)
            else:
                opened = latest()
            inspector = start.build(
                cli.complete(opened, camera, prism),
                device,
                latest,
                None if page.web else WINDOW_POINTS,
            )
            inspector.path = None if stream.live or rig is not None else recording
            if rig is not None:
                inspector.show_rig(rig)
            inspector.bookmark = bookmark
            return inspector

        # Created before the page opens, so that bad input is reported at once.
        first = new_inspector()
        if look.screenshot is not None:
            data = {**look.write(first, look.screenshot), "device": device}
            cli.report(common, data, _lines(data))
            return
        if not page.web:
            _open_window(first, look)
            return

        def open_other(path: Path) -> Inspector:
            opened = open_recording(path, **(layout.given() if path == recording else {}))
            return Inspector(cli.complete(opened, camera, prism), device=device)

        library = None if stream.live or rig is not None else Library(recording.parent, open_other)
        unused = [first]

        def inspector_of_tab() -> Inspector:
            return unused.pop() if unused else new_inspector()

        page.serve(inspector_of_tab, library, name=recording.name, common=common)


def _check_whole_pixels(opened: Recording, path: Path) -> None:
    """Raise :class:`AmiwarpError` if the events of a recording were moved, so that no parameters can move them."""
    if len(opened.events) and not opened.events.slice(0, 1).whole_pixels:
        raise AmiwarpError(
            f"{path}: its events are already compensated or undistorted; show them beside the recording that they come "
            f"from, with amiwarp view RECORDING --beside {path.name}",
            ErrorCode.CONTENT_MISSING,
        )


def _rig_of(folder: Path, start: StartOptions, layout: cli.LayoutOptions) -> ShownRig:
    """Return the rig of a folder with the sensor to show. Raises :class:`AmiwarpError` for options of recordings."""
    from amiwarp.viewer.rig_pictures import ShownRig, main_sensor

    if start.beside or start.bookmark is not None or layout.given():
        raise AmiwarpError(
            f"{folder}: is a rig; leave out --beside, --bookmark and the options for the layout of a file",
            ErrorCode.OPTIONS,
        )
    rig = open_rig(folder)
    return ShownRig(rig, main_sensor(rig, start.sensor))


def _check_together(
    stream: StreamOptions,
    start: StartOptions,
    page: PageOptions,
    look: LookOptions,
    layout: cli.LayoutOptions,
) -> None:
    """Raise :class:`AmiwarpError` for options that do not go together, before anything is opened."""
    if look.screenshot is not None and page.web:
        raise AmiwarpError(
            "--screenshot and --web are both given; give one of them", ErrorCode.OPTIONS
        )
    if look.screenshot is None and look.region is not None:
        raise AmiwarpError(
            "--region applies to a picture; give --screenshot too, or draw the region in the window",
            ErrorCode.OPTIONS,
        )
    if look.screenshot is None and (look.dpi is not None or (look.size or "").endswith("mm")):
        raise AmiwarpError(
            "--dpi and a size in mm apply to a figure; give --screenshot too", ErrorCode.OPTIONS
        )
    if not page.web and page != PageOptions():
        raise AmiwarpError("--host and --port apply to the page; give --web too", ErrorCode.OPTIONS)
    if stream.live and layout.given():
        raise AmiwarpError(
            "--live shows a stream, to which the options for the layout of a file do not apply; leave them out"
        )
    if stream.live and start.bookmark is not None:
        raise AmiwarpError(
            "--bookmark is kept beside a file; leave it out with --live", ErrorCode.OPTIONS
        )


def _open_window(inspector: Inspector, look: LookOptions) -> None:
    """Show an inspector in a window until it is closed. Raises :class:`AmiwarpError` without a display."""
    from amiwarp.viewer import window
    from amiwarp.viewer.display import check_display

    check_display(
        "run with --web to serve the page for a browser, or with --screenshot to write a picture"
    )
    size = None if look.size is None else look.pixels(PICTURE_PX)
    window.Window(inspector, look=look.look(inspector), view=look.view, size=size).run()


def exposure_warning(host: str) -> str | None:
    """Return a warning for the user if other machines can connect to ``host``, else None."""
    if is_local(host):
        return None
    return (
        f"warning: served on {host} without encryption: everybody on the network who has the address can see the "
        "recording, control the inspector and open the recordings in its folder; if you are the only user, use an SSH "
        "tunnel"
    )


def _lines(picture: dict[str, Any]) -> list[str]:
    """Return the lines that are printed about a written picture; of two recordings, each with its own figures."""
    if picture["beside"]:
        return [*picture["notes"], *picture["beside"], picture["file"]]
    sharpness = f"sharpness {picture['sharpness_before']:.3f} as recorded"
    if picture["sharpness_after"] is not None:
        sharpness += f", {picture['sharpness_after']:.3f} compensated"
    numbers = f"{picture['events']:,} events, {picture['drawn']:,} drawn"
    return [*picture["notes"], f"{picture['file']}: {numbers}; {sharpness}"]
