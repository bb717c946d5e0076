"""Lens calibration from a board: ``amiwarp lens`` and ``amiwarp board``."""

from __future__ import annotations

import math
import threading
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from amiwarp.cli import common as cli
from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.io import open_recording
from amiwarp.io.camera_files import save_camera
from amiwarp.io.output_formats import check_ending
from amiwarp.live.commands.session import (
    SourceOptions,
    StatusLine,
    check_angles,
    check_whole,
    stopped_by_interrupt,
)
from amiwarp.live.queues import Policy

if TYPE_CHECKING:
    from amiwarp.lens.board import Board
    from amiwarp.lens.live import LiveLens
    from amiwarp.lens.result import LensCalibration
    from amiwarp.live.stream.session_status import SessionStatus

_BOARD = "Board"


@dataclass(frozen=True)
class BoardOptions:
    """Options that describe the printed board."""

    board: Annotated[
        str,
        typer.Option(
            help="Numbers of inner corners of the board: squares minus 1.",
            metavar="COLUMNSxROWS",
            rich_help_panel=_BOARD,
        ),
    ] = "9x6"
    square_mm: Annotated[
        float, typer.Option(min=0.1, max=1e5, help="Side of a square (mm).", rich_help_panel=_BOARD)
    ] = 30.0
    charuco: Annotated[
        str | None,
        typer.Option(
            help="OpenCV's dictionary of the markers of a ChArUco board, such as DICT_4X4_100. Default: a chessboard.",
            rich_help_panel=_BOARD,
        ),
    ] = None

    def build(self) -> Board:
        """Return the board; raise :class:`AmiwarpError` for a value out of range."""
        from amiwarp.lens.board import Board

        return Board(
            *cli.parse_size(self.board, "--board", "9x6"), self.square_mm * 1e-3, self.charuco
        )


def run_board(
    out: Annotated[Path, typer.Argument(help="File to write (.pdf or .svg)."), cli.OUTPUT],
    *,
    board: BoardOptions,
    common: cli.Common,
) -> None:
    """Write a chessboard or ChArUco board in its true size, to print for a lens calibration."""
    made = board.build()
    made.save(out)
    width, height = (1e3 * side for side in made.size_m)
    data = {"file": str(out), "width_mm": width, "height_mm": height}
    cli.report(
        common,
        data,
        [
            f"{out}: {width:g} x {height:g} mm with its margin; print it at 100 % and glue it to a flat plate"
        ],
    )


def run_lens(
    recordings: Annotated[
        list[Path],
        typer.Argument(
            help="Recordings of the board: one per pose, or with several still poses each. With --live: a source as "
            "for 'amiwarp live'."
        ),
    ],
    out: Annotated[
        Path, typer.Argument(help="Camera file to write (.json, or .yaml for ROS)."), cli.OUTPUT
    ],
    *,
    board: BoardOptions,
    fov_deg: Annotated[
        float | None,
        typer.Option(
            help="Rough horizontal field of view (deg), right within 20 %. Default: the recording's, or 60."
        ),
    ] = None,
    fisheye: Annotated[
        bool, typer.Option("--fisheye", help="Fit OpenCV's fisheye lens model.")
    ] = False,
    live: Annotated[
        bool,
        typer.Option(
            "--live",
            help="Take the poses from a live stream, say what is missing, end when it is enough.",
        ),
    ] = False,
    calibration: Annotated[
        Path | None,
        typer.Option(help="Calibration of the prism to write (.json), for 'amiwarp compensate'."),
        cli.OUTPUT,
    ] = None,
    figure: Annotated[
        Path | None,
        typer.Option(
            help="Picture of corners, residuals and coverage to write (.png, .svg or .pdf)."
        ),
        cli.OUTPUT,
    ] = None,
    stream: SourceOptions,
    prism: cli.NominalPrismOptions,
    layout: cli.FileOptions,
    common: cli.Common,
) -> None:
    """Calibrate the camera's lens, and the prism with it, from a printed board that stands still.

    With --live, hold the board still for half a second, move it, and so on. Ctrl-C ends earlier, with the poses so far.
    """
    from amiwarp.lens.calibration import calibrate_lens

    check_ending(out, "cameras are written", [".json", ".yaml", ".yml"])
    if calibration is not None:
        check_ending(calibration, "calibrations are written", [".json"])
    if figure is not None:
        check_ending(figure, "figures are written", [".png", ".svg", ".pdf"])
    device = cli.choose_device(common.device)
    made = board.build()
    fov = None if fov_deg is None else cli.fov_from(fov_deg, "--fov-deg")
    messages = dict[str, Any]()
    if live:
        if len(recordings) != 1:
            raise AmiwarpError(
                f"--live takes one source, and {len(recordings)} are given; see 'amiwarp live --help'",
                ErrorCode.OPTIONS,
            )
        poses, printed = _watch(
            str(recordings[0]), made, stream, prism, fov=fov, fisheye=fisheye, device=device
        )
        messages["messages"] = printed
        with cli.progress("lens") as show:
            found = poses.calibrate(show)
    else:
        if stream != SourceOptions():
            raise AmiwarpError(
                "--port, --counts-per-turn, --fast, --seconds and --wait-for-source belong to --live",
                ErrorCode.OPTIONS,
            )
        opened = [open_recording(path, **layout.given()) for path in recordings]
        given = [replace(recording, prism=prism.build(recording.prism)) for recording in opened]
        with cli.progress("lens") as show:
            found = calibrate_lens(
                given, made, fov=fov, fisheye=fisheye, device=device, progress=show
            )
    save_camera(out, found.camera)
    if calibration is not None:
        found.prism.save(calibration)
    if figure is not None:
        from amiwarp.lens.figure import save_figure

        save_figure(found, figure)
    cli.report(common, {**_data(found, out), **messages}, _lines(found, out))


def _watch(
    source: str,
    board: Board,
    stream: SourceOptions,
    prism: cli.NominalPrismOptions,
    *,
    fov: float | None,
    fisheye: bool,
    device: str,
) -> tuple[LiveLens, list[str]]:
    """Collect poses from a stream until they are enough, it ends, or Ctrl-C. Return them, and what was said."""
    from amiwarp.lens.calibration import LEAST_POSES, first_camera
    from amiwarp.lens.live import LiveLens, StillSpans
    from amiwarp.live.stream.recent_events import FIRST_S
    from amiwarp.live.stream.session import Session

    stop = threading.Event()
    # A late message would tell of a pose long gone
    policy = Policy.BLOCK if stream.fast else Policy.DROP_OLDEST
    with StatusLine() as line, stream.link() as link:
        opened = stream.open(source, line.say)
        if check_angles(opened, link) == 2:
            raise AmiwarpError(
                f"{source}: a lens is calibrated with one prism, the stream comes from a pair of them"
            )
        poses = LiveLens(
            board, first_camera(opened.size, opened.camera, fov, fisheye=fisheye), device, line.say
        )
        spans = StillSpans(opened.name, opened.size, prism.build(opened.prism), poses.add)

        def update(status: SessionStatus) -> None:
            line.update(status)
            if poses.enough or (not spans.turns and status.seconds > FIRST_S):
                stop.set()

        line.say(
            "hold the board still for half a second, move it, and so on; Ctrl-C ends with the poses so far"
        )
        with stopped_by_interrupt(stop):
            try:
                session = Session(opened, link=link, raw=[spans], policy=policy, say=line.say)
                check_whole(opened, session.run(stop, update, seconds=stream.seconds))
            except AmiwarpError as error:
                if len(poses.poses) < LEAST_POSES:
                    raise
                line.say(str(error))
            spans.finish()
    return poses, list(line.messages)


def _data(found: LensCalibration, out: Path) -> dict[str, Any]:
    """Return the result for ``--json``."""
    from amiwarp.lens.projection import lens_values

    return {
        "file": str(out),
        "camera": lens_values(found.camera, found.uncertainty),
        "camera_std": dict(found.uncertainty),
        "prism": dict(found.prism.parameters),
        "prism_std": dict(found.prism.uncertainty),
        "reprojection_px": found.rms,
        "poses": [
            {"name": p.name, "corners": len(p.corners.ids), "reprojection_px": p.rms}
            for p in found.poses
        ],
        "left_out": dict(found.left_out),
        "coverage": found.coverage.tolist(),
        "notes": found.notes,
        "advice": found.advice,
        "seconds": found.seconds,
    }


def _lines(found: LensCalibration, out: Path) -> list[Any]:
    """Return the lines that are printed."""
    data = _data(found, out)
    rows = [
        (name, f"{value:.6g}", f"± {data['camera_std'][name]:.2g}")
        for name, value in data["camera"].items()
    ]
    for name, std in data["prism_std"].items():
        value = data["prism"][name]
        unit = ""
        if name != "index":
            value = math.degrees(value)
            std = math.degrees(std)
            unit = " deg"
        rows.append((name, f"{value:.6g}{unit}", f"± {std:.2g}{unit}"))
    lines: list[Any] = [cli.table(rows)]
    lines += [f"left out: {name}: {why}" for name, why in found.left_out.items()]
    lines += [*found.notes, *(f"to improve: {text}" for text in found.advice)]
    corners = sum(len(p.corners.ids) for p in found.poses)
    return [
        *lines,
        f"{out}: {len(found.poses)} poses, {corners} corners, reprojection {found.rms:.3f} px rms",
    ]
