"""Commands ``demo``, ``warm-up`` and ``design``."""

from __future__ import annotations

import contextlib
import json
import math
import time
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from amiwarp.cli import common as cli
from amiwarp.io.output_formats import make_folder
from amiwarp.io.outputs import check_output, own_folder, write_csv, write_text
from amiwarp.optics.camera import Camera
from amiwarp.optics.prism import Prism
from amiwarp.studies.design_options import FaultOptions, GridOptions, LimitOptions, OpticsOptions
from amiwarp.studies.design_results import (
    calibration_lines,
    comparison_lines,
    comparison_summary,
    design_lines,
    design_summary,
    failed_names,
)
from amiwarp.tasks import part

if TYPE_CHECKING:
    from amiwarp.studies.optics_comparison import Comparison
    from amiwarp.studies.stability.optic_map import RigOnMap


OWN_FOLDER = Path("amiwarp-demo")
"""Default folder for the demo's files. Files of an earlier demo in it are replaced."""


def run_demo(
    *,
    out: Annotated[
        Path,
        typer.Option(help="Folder for the recording, calibration, picture and figure."),
        cli.OUTPUT_FOLDER,
    ] = OWN_FOLDER,
    picture: Annotated[
        Path | None, typer.Option(help="Picture to use as the scene. Default: a map of the earth.")
    ] = None,
    size: Annotated[
        str, typer.Option(help="Size of the camera's image (px).", metavar="WIDTHxHEIGHT")
    ] = "480x360",
    duration: Annotated[float, typer.Option(help="Length of the recording (s).")] = 0.25,
    common: cli.Common,
) -> None:
    """Simulate a recording, calibrate it without an initial guess, compensate it and reconstruct the picture.

    Takes about 10 s on two idle CPU cores, longer the first time, when kernels are compiled, and on a busy machine.
    """
    began = time.perf_counter()
    device = cli.choose_device(common.device)
    with cli.progress("starting") as advance:
        from amiwarp.studies import demo

        width, height = cli.parse_size(size)
        scene = demo.Demo(out, picture, width, height, duration, common.seed, device)
        with own_folder(out) if out == OWN_FOLDER else contextlib.nullcontext():
            outcome = demo.run_demo(scene, advance)
    data = asdict(outcome) | {"seconds": time.perf_counter() - began, "device": device}
    cli.report(common, data, demo_lines(data))


def demo_lines(data: dict[str, Any]) -> list[Any]:
    """Return the results of the demo as lines of text."""
    rows = [
        ("apex", f"{data['apex_deg']:.4f} deg found, {data['apex_true_deg']:.4f} deg true"),
        (
            "model error",
            f"{data['model_error_px']:.4f} px rms over image and turn, "
            f"{data['sharpness_model_error_px']:.4f} px by sharpness alone",
        ),
        ("phase error", f"{data['phase_error_deg']:+.3f} deg"),
        (
            "blur",
            f"{data['blur_before_px']:.2f} px before, {data['blur_after_px']:.2f} px after, "
            f"{data['blur_with_truth_px']:.2f} px with the true prism",
        ),
        (
            "picture",
            f"correlation {data['picture_correlation']:.3f} with the original, "
            f"PSNR {data['picture_psnr_db']:.1f} dB, from one turn",
        ),
        (
            "speed",
            f"simulated in {data['simulate_s']:.1f} s, calibrated in {data['calibrate_s']:.1f} s, "
            f"reconstructed in {data['reconstruct_s']:.1f} s, compensated at {data['compensate_mev_per_s']:.1f} Mev/s",
        ),
        *((f"{name} file", path) for name, path in data["files"].items()),
    ]
    notes = [f"note: {note}" for note in data["notes"]]
    return [
        cli.table(rows),
        *notes,
        f"{data['events']:,} events, {data['seconds']:.1f} s in all on {data['device']}",
    ]


def run_warm_up(*, common: cli.Common) -> None:
    """Compile the kernels of the ordinary commands in advance, for containers and continuous integration.

    Later commands find them in Warp's cache, which WARP_CACHE_PATH moves. A second call compiles nothing. Without
    --device, the kernels for the CPU are compiled, and if there is a GPU, those for cuda:0.
    """
    chosen = cli.choose_device(common.device)
    devices = [chosen] if common.device else sorted({"cpu", chosen})
    with cli.progress("starting", average_s=60.0) as advance:
        from amiwarp.studies.warm_up import warm_up

        result = warm_up(devices, advance)
    lines = [
        f"compiled {result.compiled} modules of kernels in {result.seconds:.1f} s for {' and '.join(devices)}",
        f"cache: {result.cache}, {result.cached} modules",
    ]
    cli.report(common, asdict(result) | {"devices": devices}, lines)


FOV_DEG = 60.0
"""Horizontal field of view that is assumed if no option describes the camera [deg]."""
DESIGN_SHARE = 0.2
"""Share of the study of wedges in the time of a comparison of optics, for the progress."""


def run_design(
    *,
    out: Annotated[
        Path, typer.Option(help="Folder for the chart and the tables."), cli.OUTPUT_FOLDER
    ] = Path("amiwarp-design"),
    size: Annotated[
        str | None,
        cli.in_camera(
            help="Size of the camera's image (px). Default: 640x480, or the size in --camera.",
            metavar="WIDTHxHEIGHT",
        ),
    ] = None,
    camera: cli.CameraOptions,
    grid: GridOptions,
    limits: LimitOptions,
    faults: FaultOptions,
    optics: OpticsOptions,
    picture: Annotated[
        Path | None, typer.Option(help="Picture of the scene. Default: a map of the earth.")
    ] = None,
    common: cli.Common,
) -> None:
    """Compare prisms and speeds for a camera, and recommend one with the reasons.

    Event rates are predicted from simulations of small parts of the image. Blur, window and models are predicted from
    the optics. With --compare, other optics are compared with the recommended wedge too. A prism, a simulation or an
    optic that fails is reported and does not stop the others. With --optic, the outcomes of simulated calibrations near
    your rig are listed and drawn.
    """
    optics.check()
    viewer = _camera_of_design(camera, size)
    measured = _calibrations(optics, viewer, faults.contrast)
    glass = Prism(0.0, grid.index, grid.flat_side)
    device = cli.choose_device(common.device)
    from amiwarp.plotting.figures import save_png_and_svg
    from amiwarp.simulation.description import Scene
    from amiwarp.simulation.sensor_model import SensorModel
    from amiwarp.studies.demo import earth
    from amiwarp.studies.design import design
    from amiwarp.studies.design_chart import chart

    make_folder(out)
    files = _files_of_design(out, compare=optics.compare, calibrated=measured is not None)
    for path in files.values():
        check_output(Path(path))

    sensor = SensorModel(contrast_on=faults.contrast, contrast_off=faults.contrast)
    scene = Scene.from_picture(picture or earth())
    comparison = None
    with cli.progress("starting") as advance:
        recommended = design(
            viewer,
            scene,
            glass,
            apexes=grid.apexes,
            rpms=grid.rpms,
            timing=faults.timing(),
            limits=limits.build(),
            sensor=sensor,
            seed=common.seed,
            device=device,
            progress=part(advance, 0.0, DESIGN_SHARE if optics.compare else 1.0),
        )
        if optics.compare:
            from amiwarp.studies.optics_comparison import compare

            comparison = compare(
                recommended,
                scene,
                depths=optics.depths,
                sensor=sensor,
                seed=common.seed,
                device=device,
                progress=part(advance, DESIGN_SHARE, 1.0),
            )

    data = design_summary(recommended)
    _write_json(files["json"], data)
    _write_csv(files["csv"], data["choices"])
    save_png_and_svg(chart(recommended), out / "design")
    lines_of_rig: list[Any] = []
    if measured is not None:
        data["calibration"] = _write_calibrations(measured, out, files)
        lines_of_rig = ["", *calibration_lines(measured)]
    if comparison is None:
        lines = [*design_lines(recommended, files), *lines_of_rig]
    else:
        data["comparison"] = _write_comparison(comparison, out, files)
        lines = [
            *design_lines(recommended, {}),
            *comparison_lines(comparison),
            *lines_of_rig,
            "",
            *files.values(),
            *failed_names(
                {
                    name: why
                    for name, why in comparison.failed.items()
                    if name not in recommended.failed
                }
            ),
        ]
    cli.report(common, {**data, "files": files, "device": device}, lines)


def _write_calibrations(measured: RigOnMap, out: Path, files: dict[str, str]) -> dict[str, Any]:
    """Write what was measured about a rig as JSON and as a chart. Return the JSON data."""
    from amiwarp.plotting.figures import save_png_and_svg

    data = measured.summary()
    _write_json(files["calibration_json"], data)
    save_png_and_svg(measured.chart(), out / "calibration")
    return data


def _write_comparison(comparison: Comparison, out: Path, files: dict[str, str]) -> dict[str, Any]:
    """Write a comparison of optics as JSON, as a table and as a chart. Return the JSON data."""
    from amiwarp.plotting.figures import save_png_and_svg
    from amiwarp.studies import optics_comparison_chart

    data = comparison_summary(comparison)
    _write_json(files["optics_json"], data)
    _write_csv(files["optics_csv"], data["optics"])
    save_png_and_svg(optics_comparison_chart.chart(comparison), out / "optics")
    return data


def _files_of_design(out: Path, *, compare: bool, calibrated: bool) -> dict[str, str]:
    """Return the paths of the files that the command writes, by name."""
    kinds = ("png", "svg", "json", "csv")
    files = {kind: str(out / f"design.{kind}") for kind in kinds}
    if compare:
        files |= {f"optics_{kind}": str(out / f"optics.{kind}") for kind in kinds}
    if calibrated:
        # There is no table of it.
        files |= {f"calibration_{kind}": str(out / f"calibration.{kind}") for kind in kinds[:-1]}
    return files


def _calibrations(options: OpticsOptions, camera: Camera, contrast: float) -> RigOnMap | None:
    """Return what was measured about a rig with its view and threshold; None without an optic.

    Raises :class:`AmiwarpError` for an unknown optic or trouble.
    """
    if options.optic is None:
        return None
    from amiwarp.studies.stability.optic_map import RigOnMap, load_map

    optic_map = load_map()
    measured = {axis.field for axis in optic_map.of(options.optic)}
    troubles = {}
    if "fov_deg" in measured:
        troubles["fov_deg"] = 2.0 * math.degrees(math.atan(camera.width / 2.0 / camera.fx))
    if "contrast" in measured:
        troubles["contrast"] = contrast
    return RigOnMap(optic_map, options.optic, {**troubles, **options.troubles})


def _camera_of_design(options: cli.CameraOptions, size: str | None) -> Camera:
    width, height = cli.parse_size(size or "640x480")
    camera = options.build(width, height, fixed=size is not None)
    return camera or Camera.from_fov(width, height, math.radians(FOV_DEG))


def _write_json(path: str, data: dict[str, Any]) -> None:
    write_text(Path(path), json.dumps(cli.plain(data), indent=1, allow_nan=False) + "\n")


def _write_csv(path: str, rows: list[dict[str, Any]]) -> None:
    lines = []
    for row in rows:
        line = {**row, "misses": "+".join(row["misses"])}
        lines.append(line.values())
    write_csv(Path(path), rows[0], lines)
