"""Lens calibration from a board: ``amiwarp lens`` and ``amiwarp board``."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from amiwarp.cli.console import choose_device, progress, report, table
from amiwarp.cli.options import OUTPUT, Common, NominalPrismOptions, parse_size
from amiwarp.io import open_recording
from amiwarp.io.camera_files import save_camera
from amiwarp.io.formats import check_ending

if TYPE_CHECKING:
    from amiwarp.lens.board import Board
    from amiwarp.lens.calibration import LensCalibration

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
    square_mm: Annotated[float, typer.Option(help="Side of a square (mm).", rich_help_panel=_BOARD)] = 30.0
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

        return Board(*parse_size(self.board, "--board", "9x6"), self.square_mm * 1e-3, self.charuco)


def run_board(
    out: Annotated[Path, typer.Argument(help="File to write (.pdf or .svg)."), OUTPUT],
    *,
    board: BoardOptions,
    common: Common,
) -> None:
    """Write a chessboard or ChArUco board in its true size, to print for a lens calibration."""
    made = board.build()
    made.save(out)
    width, height = (1e3 * side for side in made.size_m)
    data = {"file": str(out), "width_mm": width, "height_mm": height}
    report(
        common,
        data,
        [f"{out}: {width:g} x {height:g} mm with its margin; print it at 100 % and glue it to a flat plate"],
    )


def run_lens(
    recordings: Annotated[
        list[Path], typer.Argument(help="Recordings of the board: one per pose, or with several still poses each.")
    ],
    out: Annotated[Path, typer.Argument(help="Camera file to write (.json, or .yaml for ROS)."), OUTPUT],
    *,
    board: BoardOptions,
    fov_deg: Annotated[
        float | None,
        typer.Option(help="Rough horizontal field of view (deg), right within 20 %. Default: the recording's, or 60."),
    ] = None,
    fisheye: Annotated[bool, typer.Option("--fisheye", help="Fit OpenCV's fisheye lens model.")] = False,
    calibration: Annotated[
        Path | None, typer.Option(help="Calibration of the prism to write (.json), for 'amiwarp compensate'."), OUTPUT
    ] = None,
    figure: Annotated[
        Path | None,
        typer.Option(help="Picture of corners, residuals and coverage to write (.png, .svg or .pdf)."),
        OUTPUT,
    ] = None,
    prism: NominalPrismOptions,
    common: Common,
) -> None:
    """Calibrate the camera's lens, and the prism with it, from a printed board that stands still."""
    from amiwarp.lens.calibration import calibrate_lens

    check_ending(out, "cameras are written", [".json", ".yaml", ".yml"])
    if calibration is not None:
        check_ending(calibration, "calibrations are written", [".json"])
    if figure is not None:
        check_ending(figure, "figures are written", [".png", ".svg", ".pdf"])
    device, made = choose_device(common.device), board.build()
    opened = [open_recording(path) for path in recordings]
    given = [replace(recording, prism=prism.build(recording.prism)) for recording in opened]
    with progress("lens") as show:
        fov = None if fov_deg is None else math.radians(fov_deg)
        found = calibrate_lens(given, made, fov=fov, fisheye=fisheye, device=device, progress=show)
    save_camera(out, found.camera)
    if calibration is not None:
        found.prism.save(calibration)
    if figure is not None:
        from amiwarp.lens.figure import save_figure

        save_figure(found, figure)
    report(common, _data(found, out), _lines(found, out))


def _data(found: LensCalibration, out: Path) -> dict[str, Any]:
    """Return the result for ``--json``."""
    from amiwarp.lens.corner_fit import lens_values

    return {
        "file": str(out), "camera": lens_values(found.camera, found.uncertainty), "camera_std": dict(found.uncertainty),
        "prism": dict(found.prism.parameters), "prism_std": dict(found.prism.uncertainty), "reprojection_px": found.rms,
        "poses": [{"name": p.name, "corners": len(p.corners.ids), "reprojection_px": p.rms} for p in found.poses],
        "left_out": dict(found.left_out), "coverage": found.coverage.tolist(), "notes": found.notes,
        "advice": found.advice, "seconds": found.seconds,
    }  # fmt: skip


def _lines(found: LensCalibration, out: Path) -> list[Any]:
    """Return the lines that are printed."""
    data = _data(found, out)
    rows = [(name, f"{value:.6g}", f"± {data['camera_std'][name]:.2g}") for name, value in data["camera"].items()]
    for name, std in data["prism_std"].items():
        value, unit = data["prism"][name], ""
        if name != "index":
            value, std, unit = math.degrees(value), math.degrees(std), " deg"
        rows.append((name, f"{value:.6g}{unit}", f"± {std:.2g}{unit}"))
    lines: list[Any] = [table(rows)]
    lines += [f"left out: {name}: {why}" for name, why in found.left_out.items()]
    lines += [*found.notes, *(f"to improve: {text}" for text in found.advice)]
    corners = sum(len(p.corners.ids) for p in found.poses)
    return [*lines, f"{out}: {len(found.poses)} poses, {corners} corners, reprojection {found.rms:.3f} px rms"]
