"""Commands ``demo``, ``warm-up``, ``dataset``, ``export``, ``chart``, ``design``, ``stability`` and ``evaluate``."""

from __future__ import annotations

import contextlib
import json
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from amiwarp.cli import common as cli
from amiwarp.cli import say
from amiwarp.errors import AmiwarpError
from amiwarp.io import open_recording
from amiwarp.io.files import check_output, only_writer, own_folder, write_csv, write_text
from amiwarp.io.formats import make_folder
from amiwarp.optics.camera import Camera
from amiwarp.optics.prism import FlatSide, Prism
from amiwarp.tasks import cpu_threads, part

if TYPE_CHECKING:
    from amiwarp.studies.chart import Charts
    from amiwarp.studies.chart.measurement import Row
    from amiwarp.studies.dataset.making import DatasetPlan, DatasetSummary
    from amiwarp.studies.design import Choice, Design, Limits, Timing
    from amiwarp.studies.evaluate.evaluation import EvaluationSummary
    from amiwarp.studies.optics_comparison import Compared, Comparison
    from amiwarp.studies.stability.cells import Axis, Cell, Method, Store, Stored
    from amiwarp.studies.stability.report import Atlas


# ``amiwarp demo``: simulation, calibration, compensation and reconstruction of one picture.

OWN_FOLDER = Path("amiwarp-demo")
"""Default folder for the demo's files. Files of an earlier demo in it are replaced."""


def run_demo(
    *,
    out: Annotated[
        Path, typer.Option(help="Folder for the recording, calibration, picture and figure."), cli.OUTPUT_FOLDER
    ] = OWN_FOLDER,
    picture: Annotated[
        Path | None, typer.Option(help="Picture to use as the scene. Default: a map of the earth.")
    ] = None,
    size: Annotated[str, typer.Option(help="Size of the camera's image (px).", metavar="WIDTHxHEIGHT")] = "480x360",
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


def demo_lines(d: dict[str, Any]) -> list[Any]:
    """Return the results of the demo as lines of text."""
    rows = [
        ("apex", f"{d['apex_deg']:.4f} deg found, {d['apex_true_deg']:.4f} deg true"),
        ("model error", f"{d['model_error_px']:.4f} px rms over image and turn, "
                        f"{d['sharpness_model_error_px']:.4f} px by sharpness alone"),
        ("phase error", f"{d['phase_error_deg']:+.3f} deg"),
        ("blur", f"{d['blur_before_px']:.2f} px before, {d['blur_after_px']:.2f} px after, "
                 f"{d['blur_with_truth_px']:.2f} px with the true prism"),
        ("picture", f"correlation {d['picture_correlation']:.3f} with the original, "
                    f"PSNR {d['picture_psnr_db']:.1f} dB, from one turn"),
        ("speed", f"simulated in {d['simulate_s']:.1f} s, calibrated in {d['calibrate_s']:.1f} s, "
                  f"reconstructed in {d['reconstruct_s']:.1f} s, compensated at {d['compensate_mev_per_s']:.1f} Mev/s"),
        *((f"{name} file", path) for name, path in d["files"].items()),
    ]  # fmt: skip
    notes = [f"note: {note}" for note in d["notes"]]
    return [cli.table(rows), *notes, f"{d['events']:,} events, {d['seconds']:.1f} s in all on {d['device']}"]


# ``amiwarp warm-up``: kernels compiled in advance.


def run_warm_up(*, common: cli.Common) -> None:
    """Compile the kernels of the ordinary commands in advance, for containers and continuous integration.

    Later commands find them in Warp's cache, which WARP_CACHE_PATH moves. A second call compiles nothing. Without
    --device, the kernels for the CPU are compiled, and if there is a GPU, those for cuda:0.
    """
    chosen = cli.choose_device(common.device)
    devices = [chosen] if common.device else sorted({"cpu", chosen})
    with cli.progress("starting", average_s=60.0) as advance:
        from amiwarp.studies.demo import warm_up

        done = warm_up(devices, advance)
    what = f"compiled {done.compiled} modules of kernels in {done.seconds:.1f} s for {' and '.join(devices)}"
    cli.report(common, asdict(done) | {"devices": devices}, [what, f"cache: {done.cache}, {done.cached} modules"])


# ``amiwarp dataset``: thousands of simulated recordings from a specification, with a manifest.

Scheduler = Annotated[str | None, typer.Option(help="Address of a Dask scheduler. Default: processes of this machine.")]
LocalWorkers = Annotated[
    int | None,
    typer.Option(
        min=1, help="Number of local processes. Default: up to four for each GPU, or one for each core without GPU."
    ),
]
AVERAGE_S = 600.0
"""Time over which the speed is averaged [s]; recordings differ in length."""
SHOWN = 5
"""Number of failures that are printed; a file of the study lists all."""


def failed_lines(failed: Mapping[str, str], listed_in: Path) -> list[str]:
    """Return a line of text for each of the first failures of a study, and the file that lists all."""
    lines = [f"failed: {name}: {error}" for name, error in list(failed.items())[:SHOWN]]
    if len(failed) > SHOWN:
        lines.append(f"... and {len(failed) - SHOWN:,} more failures, in {listed_in}")
    return lines


def run_dataset(
    specification: Annotated[Path, typer.Argument(help="Specification of the data set (.toml).")],
    out: Annotated[
        Path, typer.Argument(help="Folder of the data set. An existing one is continued."), cli.OUTPUT_FOLDER
    ],
    *,
    dry_run: Annotated[
        bool,
        typer.Option("--dry-run", help="Only estimate the number of recordings, their size and the time; make none."),
    ] = False,
    scheduler: Scheduler = None,
    workers: LocalWorkers = None,
    common: cli.Common,
) -> None:
    """Make thousands of simulated recordings from a specification, with labels, splits and a manifest.

    Every combination of source, prism, speed, sensor, seed and trajectory is one recording. Finished recordings are
    kept: the same command continues a stopped run. A recording that fails is reported and does not stop the others.
    --device cuda uses all GPUs, and is the default if there is one.
    """
    from amiwarp.studies.dataset import making

    device = common.device or _default_device()
    if dry_run:
        if scheduler is not None:
            raise AmiwarpError("--dry-run samples on this machine; leave --scheduler out, and give --workers instead")
        with cli.progress("sampling") as advance:
            plan = making.plan_dataset(specification, out, workers=workers, device=device, progress=advance)
        lines = [*(f"sample failed: {file}: {error}" for file, error in plan.failed.items()), *_plan_lines(plan)]
        cli.report(common, asdict(plan) | {"seconds": plan.seconds}, lines)
        return
    try:
        with cli.progress("starting workers", average_s=AVERAGE_S) as advance:
            done = making.make_dataset(
                specification, out, scheduler=scheduler, workers=workers, device=device, progress=advance
            )
    except KeyboardInterrupt:
        say(f"amiwarp: finished recordings are kept in {out}; run the same command again to continue")
        raise
    cli.report(common, asdict(done) | {"folder": str(out), "device": device}, _dataset_lines(done, out))
    if done.failed:
        raise typer.Exit(1)


def _default_device() -> str:
    """Return all GPUs, or the CPU."""
    from amiwarp.kernels.launch import start_quietly
    from amiwarp.studies.cluster import ANY_GPU, gpu_count

    return ANY_GPU if gpu_count(start_quietly()) else "cpu"


def _plan_lines(plan: DatasetPlan) -> list[str]:
    from amiwarp.studies.dataset.making import duration_text

    by = ", ".join(f"{count:,} of {kind}" for kind, count in plan.sources.items())
    lines = [
        f"{plan.recordings:,} recordings ({by}), {plan.missing:,} of them missing",
        "splits: " + ", ".join(f"{name} {count:,}" for name, count in plan.splits.items()),
    ]
    if plan.missing:
        lines += [
            f"about {plan.events:.3g} events and {plan.size_bytes / 1e9:.3g} GB to write",
            f"about {duration_text(plan.seconds)} (± {100 * plan.uncertainty:.0f} %) with {plan.workers} workers on "
            f"{plan.device} once the workers have started, estimated from {plan.samples} samples",
        ]
    return lines


def _dataset_lines(done: DatasetSummary, out: Path) -> list[str]:
    lines = failed_lines(done.failed, out / "manifest.json")
    lines += cli.made_again(done.damaged)
    if done.not_in_specification:
        lines.append(
            f"{len(done.not_in_specification):,} recordings in {out} are not in the specification, such as "
            f"{done.not_in_specification[0]}; they are kept, and left out of the manifest"
        )
    splits = ", ".join(f"{name} {count:,}" for name, count in done.splits.items())
    lines.append(
        f"{out}: {done.made + done.kept:,} of {done.recordings:,} recordings ({splits}), {done.kept:,} of them kept"
    )
    if done.made:
        lines.append(_dataset_speed(done))
    return lines


def _dataset_speed(done: DatasetSummary) -> str:
    per_s = done.made / done.seconds
    return (
        f"{done.made:,} made in {done.seconds:,.1f} s: {per_s:.3g} per second, {done.events / done.seconds / 1e6:.3g} "
        f"Mev/s, {done.size_bytes / 1e9:.3g} GB, {done.workers} workers"
    )


# ``amiwarp export``: a data set in the layouts of other libraries.


def run_export(
    dataset: Annotated[Path, typer.Argument(help="Folder of the data set, which 'amiwarp dataset' made.")],
    out: Annotated[Path, typer.Argument(help="Folder to write."), cli.OUTPUT_FOLDER],
    *,
    to: Annotated[
        str, typer.Option(help="Layout: webdataset (tar files) or parquet (a folder for Hugging Face's datasets).")
    ],
    shard_mb: Annotated[
        float, typer.Option(min=0.001, help="Size from which on the next file begins, before compression (MB).")
    ] = 256.0,
    common: cli.Common,
) -> None:
    """Export a data set to tar files for WebDataset, or to Parquet files for Hugging Face's datasets.

    Events and labels are exported. Encoder, camera, prism and ground truth are left out. With --force, the files of an
    earlier export in the folder are replaced.
    """
    from amiwarp.studies.dataset.export import export_dataset

    with cli.progress("reading the manifest") as advance:
        done = export_dataset(dataset, out, to, shard_mb=shard_mb, progress=advance)
    splits = ", ".join(f"{name} {count:,}" for name, count in done.splits.items())
    line = (
        f"{out}: {sum(done.splits.values()):,} recordings ({splits}) with {done.events:,} events in "
        f"{len(done.files):,} files, {done.size_bytes / 1e9:.3g} GB, {done.seconds:.1f} s"
    )
    cli.report(common, asdict(done) | {"folder": str(out)}, [line])


# ``amiwarp chart``: charts of speed against error on this machine, and settings for a budget.


def run_chart(
    recording: Annotated[
        Path | None, typer.Argument(help="Recording with ground truth. Default: simulated, 10 million events.")
    ] = None,
    *,
    out: Annotated[Path, typer.Option(help="Folder for charts, tables and presets."), cli.OUTPUT_FOLDER] = Path(
        "amiwarp-chart"
    ),
    picture: Annotated[
        Path | None, typer.Option(help="Picture of the simulated scene. Default: a map of the earth.")
    ] = None,
    budget_px: Annotated[
        float | None, typer.Option(min=0.0, help="Error limit (px): choose the fastest settings within it.")
    ] = None,
    budget_ms: Annotated[
        float | None, typer.Option(min=0.0, help="Time limit (ms): choose the most accurate calibration within it.")
    ] = None,
    quick: Annotated[bool, typer.Option("--quick", help="Measure a few settings once each, as a short trial.")] = False,
    common: cli.Common,
) -> None:
    """Measure speed and error of the settings on a recording with ground truth, and draw both Pareto fronts.

    A setting that fails is reported and does not stop the others. With a budget, the chosen settings are written to
    preset_calibration.json and preset_compensation.json. Pass these files to calibrate and compensate with --preset.
    """
    if budget_px is not None and budget_ms is not None:
        raise AmiwarpError("--budget-px and --budget-ms are two budgets; give one of them")
    if recording is not None and picture is not None:
        raise AmiwarpError("a recording and --picture both provide the events to measure on; give one of them")
    device = cli.choose_device(common.device)
    from amiwarp.studies.chart import make, simulated

    if budget_px is not None or budget_ms is not None:
        for kind in ("calibration", "compensation"):
            if out.is_dir():
                check_output(out / f"preset_{kind}.json")

    with cli.progress("starting") as advance:
        if recording is not None:
            opened = open_recording(recording)
        else:
            opened = simulated(picture, seed=common.seed, device=device, quick=quick,
                               progress=part(advance, 0.0, 0.0))  # fmt: skip
        charts = make(opened, out, device=device, seed=common.seed, quick=quick,
                      progress=advance)  # fmt: skip
    answers = charts.answer(out, budget_px=budget_px, budget_ms=budget_ms)
    cli.report(common, chart_summary(charts, answers, out) | {"device": device}, chart_lines(charts, answers, out))
    if not (charts.compensation or charts.calibration):
        raise typer.Exit(1)


def chart_summary(charts: Charts, answers: dict[str, Row | None], out: Path) -> dict[str, Any]:
    """Return the Pareto fronts, the default settings and the chosen settings for JSON.

    The full tables are in the files.
    """
    from amiwarp.studies.chart.measurement import fronts

    def fields(row: Row) -> dict[str, Any]:
        return {"label": row.label, "job": row.job, "mev_per_s": row.mev_per_s, "ms": row.seconds * 1e3,
                "error_px": row.error_px, "settings": dict(row.settings)}  # fmt: skip

    rows = {"compensation": charts.compensation, "calibration": charts.calibration}
    return {
        "fronts": {name: {job: [fields(r) for r in chosen] for job, chosen in fronts(all_)}
                   for name, all_ in rows.items()},
        "defaults": {name: [fields(r) for r in all_ if r.default] for name, all_ in rows.items()},
        "answers": {kind: None if row is None else {**fields(row), "file": str(out / f"preset_{kind}.json")}
                    for kind, row in answers.items()},
        "files": {name: str(path) for name, path in charts.files.items()},
        "notes": list(charts.notes),
        "failed": dict(charts.failed),
    }  # fmt: skip


def chart_lines(charts: Charts, answers: dict[str, Row | None], out: Path) -> list[Any]:
    """Return the results as tables and lines of text."""
    from amiwarp.studies.chart.measurement import beaten_by, fronts, told_apart

    shown: list[Any] = []
    for rows in (charts.compensation, charts.calibration):
        for job, chosen in fronts(rows):
            default = [r for r in rows if r.default and r.job == job and r not in chosen]
            listed = [(_setting(r), *_setting_speed(r)) for r in [*told_apart(chosen), *default]]
            shown += [cli.table(listed, f"front, {job}", "speed", "error"), ""]
            shown += [f"faster or more accurate than the default: {', '.join(b.label for b in better)}"
                      for r in rows if r.default and r.job == job and (better := beaten_by(r, rows))]  # fmt: skip
    shown += [f"note: {note}" for note in charts.notes]
    for kind, row in answers.items():
        if row is None:
            shown.append(f"{kind}: no measured setting is within the budget; see the front above")
        else:
            speed, error = _setting_speed(row)
            file = out / f"preset_{kind}.json"
            shown.append(
                f"{kind} within the budget: {row.label}, {speed}, {error} measured; use it with --preset {file}"
            )
    shown += failed_lines(charts.failed, charts.files["data"])
    shown += [f"{name}: {path}" for name, path in charts.files.items()]
    measured = len(charts.compensation) + len(charts.calibration)
    if charts.failed:
        shown.append(f"{measured:,} settings measured; {len(charts.failed):,} failed")
    return shown


def _setting(row: Row) -> str:
    return f"{row.label} (default)" if row.default and row.label != "default" else row.label


def _setting_speed(row: Row) -> tuple[str, str]:
    speed = f"{row.seconds * 1e3:,.0f} ms" if row.chart == "calibration" else f"{row.mev_per_s:.3g} Mev/s"
    return speed, f"{row.error_px:.3g} px"


# ``amiwarp design``: comparison of prisms and speeds for a camera, with a recommendation.

FOV_DEG = 60.0
"""Horizontal field of view that is assumed if no option describes the camera [deg]."""
_in_limits = partial(typer.Option, rich_help_panel="Limits")
_in_faults = partial(typer.Option, rich_help_panel="Faults")
_in_optics = partial(typer.Option, rich_help_panel="Other optics")
DESIGN_SHARE = 0.2
"""Share of the study of wedges in the time of a comparison of optics, for the progress."""
DEPTHS_M = "0.5,1,2"
"""Depths of the scene for a plate, unless others are given [m]."""


@dataclass(frozen=True)
class GridOptions:
    """Options for the prisms and speeds to compare."""

    apex_deg: Annotated[str, cli.in_prism(help="Apex angles to compare (deg).", metavar="A,B,...")] = "0.25,0.5,1,2,4"
    rpm: Annotated[str, cli.in_prism(help="Speeds to compare (turns/min).", metavar="A,B,...")] = (
        "180,360,720,1440,2880"
    )
    index: Annotated[float, cli.in_prism(help="Refractive index of the prism.")] = 1.5168
    flat_side: Annotated[FlatSide, cli.in_prism(help="Direction that the prism's flat face points to.")] = (
        FlatSide.SCENE
    )

    @property
    def apexes(self) -> list[float]:
        """Apex angles to compare [rad]."""
        return [math.radians(v) for v in _list(self.apex_deg, "--apex-deg")]

    @property
    def rpms(self) -> list[float]:
        """Speeds to compare [turns/min]."""
        return list(_list(self.rpm, "--rpm"))


@dataclass(frozen=True)
class LimitOptions:
    """Options for the limits that prism and speed must meet."""

    tolerance_px: Annotated[
        float, _in_limits(help="Largest standard deviation across an edge after compensation (px).")
    ] = 0.5
    window_ms: Annotated[float, _in_limits(help="Time within which edges of every direction must be seen (ms).")] = 33.4
    bandwidth_mev_s: Annotated[
        float | None, _in_limits(help="Largest event rate of sensor and cable (million events/s). Default: any.")
    ] = None
    budget_px: Annotated[
        float | None,
        _in_limits(
            help="Largest error of the prism model (px rms). Default: a tenth of the blur from pixels, clock and "
            "encoder."
        ),
    ] = None

    def build(self) -> Limits:
        """Return the limits that the options set for the study."""
        from amiwarp.studies.design import Limits

        most = None if self.bandwidth_mev_s is None else self.bandwidth_mev_s * 1e6
        return Limits(self.tolerance_px, self.window_ms, most, self.budget_px)


@dataclass(frozen=True)
class FaultOptions:
    """Options for the errors of event times and encoder angles."""

    clock_us: Annotated[
        float, _in_faults(help="Standard deviation of the event times, from readout and jitter (us).")
    ] = 60.0
    encoder_deg: Annotated[float, _in_faults(help="Standard deviation of the encoder's angle (deg).")] = 0.1
    contrast: Annotated[float, _in_faults(help="Contrast threshold (log intensity).")] = 0.25

    def timing(self) -> Timing:
        """Return the errors of event times and encoder angles."""
        from amiwarp.studies.design import Timing

        return Timing(self.clock_us, math.radians(self.encoder_deg))


@dataclass(frozen=True)
class OpticsOptions:
    """Options for the comparison with other optics."""

    compare: Annotated[
        bool,
        _in_optics(
            "--compare",
            help="Compare the recommended wedge with a pair of wedges, a mirror with two tilts, a vibrating camera "
            "and a rotating tilted plate that move the image as far.",
        ),
    ] = False
    depth_m: Annotated[
        str | None,
        _in_optics(help=f"Depths of the scene for the plate (m). Default: {DEPTHS_M}.", metavar="A,B,..."),
    ] = None

    @property
    def depths(self) -> list[float]:
        """Depths of the scene for the plate [m]."""
        return list(_list(self.depth_m or DEPTHS_M, "--depth-m"))

    def check(self) -> None:
        """Raise :class:`AmiwarpError` if the options contradict each other."""
        if self.depth_m is not None and not self.compare:
            raise AmiwarpError("--depth-m applies to the comparison of optics; give --compare, or remove --depth-m")


def run_design(
    *,
    out: Annotated[Path, typer.Option(help="Folder for the chart and the tables."), cli.OUTPUT_FOLDER] = Path(
        "amiwarp-design"
    ),
    size: Annotated[
        str | None,
        cli.in_camera(
            help="Size of the camera's image (px). Default: 640x480, or the size in --camera.", metavar="WIDTHxHEIGHT"
        ),
    ] = None,
    camera: cli.CameraOptions,
    grid: GridOptions,
    limits: LimitOptions,
    faults: FaultOptions,
    optics: OpticsOptions,
    picture: Annotated[Path | None, typer.Option(help="Picture of the scene. Default: a map of the earth.")] = None,
    common: cli.Common,
) -> None:  # fmt: skip
    """Compare prisms and speeds for a camera, and recommend one with the reasons.

    Event rates are predicted from simulations of small parts of the image. Blur, window and models are predicted from
    the optics. With --compare, other optics are compared with the recommended wedge too. A prism, a simulation or an
    optic that fails is reported and does not stop the others.
    """
    optics.check()
    seen = _camera_of_design(camera, size)
    glass = Prism(0.0, grid.index, grid.flat_side)
    device = cli.choose_device(common.device)
    from amiwarp.plotting.figures import save_png_and_svg
    from amiwarp.simulation.description import Scene
    from amiwarp.simulation.sensor_model import SensorModel
    from amiwarp.studies.demo import earth
    from amiwarp.studies.design import chart, design

    make_folder(out)
    kinds = ("png", "svg", "json", "csv")
    files = {kind: str(out / f"design.{kind}") for kind in kinds}
    if optics.compare:
        files |= {f"optics_{kind}": str(out / f"optics.{kind}") for kind in kinds}
    for path in files.values():
        check_output(Path(path))
    sensor = SensorModel(contrast_on=faults.contrast, contrast_off=faults.contrast)
    scene = Scene.from_picture(picture or earth())
    compared = None
    with cli.progress("starting") as advance:
        made = design(
            seen, scene, glass, apexes=grid.apexes, rpms=grid.rpms, timing=faults.timing(), limits=limits.build(),
            sensor=sensor, seed=common.seed, device=device,
            progress=part(advance, 0.0, DESIGN_SHARE if optics.compare else 1.0),
        )  # fmt: skip
        if optics.compare:
            from amiwarp.studies.optics_comparison import compare

            compared = compare(made, scene, depths=optics.depths, sensor=sensor, seed=common.seed, device=device,
                               progress=part(advance, DESIGN_SHARE, 1.0))  # fmt: skip
    data = design_summary(made)
    write_text(Path(files["json"]), json.dumps(cli.plain(data), indent=1, allow_nan=False) + "\n")
    _write_csv(files["csv"], data["choices"])
    save_png_and_svg(chart(made), out / "design")
    if compared is None:
        cli.report(common, {**data, "files": files, "device": device}, design_lines(made, files))
        return
    from amiwarp.studies import optics_comparison

    optics_data = comparison_summary(compared)
    write_text(Path(files["optics_json"]), json.dumps(cli.plain(optics_data), indent=1, allow_nan=False) + "\n")
    _write_csv(files["optics_csv"], optics_data["optics"])
    save_png_and_svg(optics_comparison.chart(compared), out / "optics")
    lines = [*design_lines(made, {}), *comparison_lines(compared), "", *files.values()]
    lines += _failed_names({**made.failed, **compared.failed})
    cli.report(common, {**data, "comparison": optics_data, "files": files, "device": device}, lines)


def _camera_of_design(options: cli.CameraOptions, size: str | None) -> Camera:
    width, height = cli.parse_size(size or "640x480")
    found = options.build(width, height, fixed=size is not None)
    return found or Camera.from_fov(width, height, math.radians(FOV_DEG))


def _list(text: str, name: str) -> tuple[float, ...]:
    return cli.numbers(text, text.count(",") + 1, name)


def design_summary(design: Design) -> dict[str, Any]:
    """Return all results of the study for JSON, with angles in degrees."""
    from amiwarp.studies.design import headline, reasons

    camera, volume = design.camera, design.volume
    return {
        "format": "amiwarp-design",
        "version": 1,
        "camera": {name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")},
        "prism": {"index": design.glass.index, "flat_side": design.glass.flat_side.value},
        "limits": {
            "tolerance_px": design.limits.tolerance_px,
            "window_ms": design.limits.window_ms,
            "bandwidth_mev_s": None if design.limits.bandwidth is None else design.limits.bandwidth / 1e6,
            "budget_px": design.limits.budget_px,
        },
        "faults": {"clock_us": design.timing.clock_us, "encoder_deg": math.degrees(design.timing.encoder)},
        "volume": {
            "apex_deg": [math.degrees(apex) for apex in volume.apexes],
            "rpm": volume.rpms.tolist(),
            "yields": volume.yields.tolist(),
            "uncertainty": volume.uncertainty,
            "texture_per_px": volume.texture,
            "contrast": volume.contrast,
            "noise_hz": volume.noise_hz,
            "simulated_pixels": volume.simulated,
        },
        "choices": [_fields(c) for c in design.choices],
        "recommended": None if design.chosen is None else _fields(design.chosen),
        "headline": headline(design),
        "reasons": reasons(design),
        "failed": design.failed,
    }


def _fields(c: Choice) -> dict[str, Any]:
    return {
        "apex_deg": math.degrees(c.orbit.apex),
        "rpm": c.rpm,
        "deflection_deg": math.degrees(c.orbit.deflection),
        "radius_px": c.orbit.radius,
        "smallest_radius_px": c.orbit.smallest,
        "swing_px": c.orbit.swing,
        "events_per_s": c.events_per_s,
        "window_ms": c.window_ms,
        "clock_px": c.clock_px,
        "encoder_px": c.encoder_px,
        "blur_px": c.blur_px,
        "budget_px": c.budget_px,
        "model": c.model,
        "error_px": c.error_px,
        **{f"{name}_error_px": error for name, error in c.orbit.errors.items()},
        "misses": list(c.misses),
    }


def _write_csv(path: str, rows: list[dict[str, Any]]) -> None:
    write_csv(Path(path), rows[0], ({**row, "misses": "+".join(row["misses"])}.values() for row in rows))


def design_lines(design: Design, files: dict[str, str]) -> list[Any]:
    """Return the results as tables and lines of text."""
    from amiwarp.studies.design import degrees, headline, rate, reasons

    rows = [
        (degrees(c.orbit.apex), f"{c.rpm:g}", rate(c.events_per_s), f"{c.orbit.radius:.1f} px", f"{c.error_px:.3f} px",
         c.model, f"{c.window_ms:.1f} ms", "recommended" if c is design.chosen else ", ".join(c.misses))
        for c in design.choices
    ]  # fmt: skip
    shown = cli.table(rows, "apex", "rpm", "events", "orbit", "error", "model", "window", "misses")
    said = [tuple(line.split(": ", 1)) for line in reasons(design)]
    return [shown, "", headline(design), cli.table(said), "", *files.values(), *_failed_names(design.failed)]


def _failed_names(failed: Mapping[str, str]) -> list[str]:
    """Return a line of text with the names of what failed in a study; none if nothing did."""
    return [f"failed, and left out: {'; '.join(failed)}"] if failed else []


def comparison_summary(comparison: Comparison) -> dict[str, Any]:
    """Return all results of the comparison of optics for JSON, with angles in degrees."""
    from amiwarp.studies.optics_comparison import reasons

    return {
        "format": "amiwarp-optics",
        "version": 1,
        "reference": {
            "apex_deg": math.degrees(comparison.reference.orbit.apex),
            "rpm": comparison.reference.rpm,
            "misses": list(comparison.reference.misses),
        },
        "window_ms": comparison.design.limits.window_ms,
        "optics": [_optic_fields(r) for r in comparison.results],
        "recommended": {a.task: None if a.chosen is None else a.chosen.setting.name for a in comparison.advice},
        "reasons": reasons(comparison),
        "failed": dict(comparison.failed),
    }


def _optic_fields(r: Compared) -> dict[str, Any]:
    glass, drive, state = r.setting.NEEDS[r.setting.kind]
    covered = r.coverage
    return {
        "optic": r.setting.name,
        "size": r.setting.size,
        "turns_per_s": r.setting.hz,
        "radius_px": r.radius,
        "smallest_radius_px": r.smallest,
        "swing_px": covered.swing,
        "complete_ms": r.complete_ms,
        "left_out_share": covered.left_out,
        "least_moved_edges_deg": math.degrees(covered.blind),
        "clock_px": r.clock_px,
        "angle_px": r.encoder_px,
        "blur_px": r.blur_px,
        "events_per_s": r.events_per_s,
        "simulated_events_per_s": r.simulated_per_s,
        "simulation_uncertainty": r.uncertainty,
        "law_deviation": r.deviation,
        "events_per_s_px": r.events_per_s_px,
        "depth_m": 1.0 / r.setting.inverse_depth if r.setting.inverse_depth else None,
        "depth_determined": r.depth_deviation is not None,
        "depth_deviation": r.depth_deviation,
        "glass": glass,
        "drive": drive,
        "state_from": state,
        "misses": list(r.misses),
    }


def comparison_lines(comparison: Comparison) -> list[Any]:
    """Return the comparison of optics as tables of text."""
    from amiwarp.studies.design import rate
    from amiwarp.studies.optics_comparison import reasons

    rows = [
        (r.setting.name, r.setting.size, f"{r.setting.hz:g}/s", f"{r.radius:.2f} px", f"{r.coverage.swing:.2f} px",
         f"{r.complete_ms:.1f} ms" if math.isfinite(r.complete_ms) else "never", f"{r.blur_px:.3f} px",
         rate(r.events_per_s), f"{100 * r.deviation:+.0f} ± {100 * r.uncertainty:.1g} %",
         "not determined" if r.depth_deviation is None else f"± {100 * r.depth_deviation:.2g} %", ", ".join(r.misses))
        for r in comparison.results
    ]  # fmt: skip
    heads = (
        "optic",
        "size",
        "turns",
        "motion",
        "edges",
        "all edges",
        "blur",
        "events",
        "to simulation",
        "depth",
        "misses",
    )
    said = [tuple(line.split(": ", 1)) for line in reasons(comparison)]
    return [cli.table(rows, *heads), "", cli.table(said)]


# ``amiwarp stability``: limits and failures of the calibration, on simulated recordings with ground truth.

SEEDS, QUICK_SEEDS = 20, 1
"""Number of recordings per value of an axis, by default and with ``--quick``."""
QUICK_MINUTES = 9.0
"""Time limit of a run with ``--quick`` [min]."""


def run_stability(
    *,
    out: Annotated[
        Path, typer.Option(help="Folder for the results of single runs (cells), figures and tables."), cli.OUTPUT_FOLDER
    ] = Path("amiwarp-atlas"),
    quick: Annotated[
        bool, typer.Option("--quick", help="Use three values per axis, three methods and one seed: within ten minutes.")
    ] = False,
    axes: Annotated[
        list[str] | None, typer.Option(help="Axis to vary. Can be repeated. Default: all axes.", metavar="NAME")
    ] = None,
    methods: Annotated[
        list[str] | None,
        typer.Option(
            help="Method to run in addition to 'default' and 'paper'. Can be repeated. "
            "Default: all methods; with --quick, only 'sharpness'.",
            metavar="NAME",
        ),
    ] = None,
    seeds: Annotated[
        int | None, typer.Option(min=1, help=f"Recordings per value. Default: {SEEDS}, with --quick {QUICK_SEEDS}.")
    ] = None,
    draws: Annotated[
        int | None,
        typer.Option(
            min=0,
            help="Recordings with random combinations of mild troubles, by which the stated deviations are judged. "
            "Default: 300, none with --quick or --axes.",
        ),
    ] = None,
    minutes: Annotated[
        float | None,
        typer.Option(
            min=0.0,
            help="Time limit (min). The same command continues later. "
            f"Default: none, with --quick {QUICK_MINUTES:.0f}.",
        ),
    ] = None,
    scheduler: Annotated[
        str | None, typer.Option(help="Address of a Dask scheduler. Default: one local process per core.")
    ] = None,
    redraw: Annotated[
        bool, typer.Option("--redraw", help="Only draw figures and tables from the existing cells; run nothing.")
    ] = False,
    common: cli.Common,
) -> None:
    """Calibrate simulated recordings under growing disturbances, and draw where calibration works and fails.

    Each axis varies one disturbance, such as noise. A cell holds one recording and the results of all methods on it.
    Finished cells are saved in OUT/cells: the same command continues a stopped run and skips finished cells. A cell
    that fails is reported, does not stop the others, and is run again by the same command.
    """
    device = cli.choose_device(common.device)
    from amiwarp.studies.stability.cells import DRAWS, Store, cells_of, identity
    from amiwarp.studies.stability.report import aggregate, draw, load

    chosen_axes, chosen_methods = _axes(axes or (), quick), _methods(methods or (), quick)
    cells_in = out / "cells"
    make_folder(cells_in)
    with only_writer(out):
        earlier = any(cells_in.iterdir())  # existing figures were drawn from these cells and may be replaced
        began = time.perf_counter()
        new = left = 0
        store = Store(cells_in)
        if redraw:
            cells = load(store)
        else:
            of_each = seeds or (QUICK_SEEDS if quick else SEEDS)
            limit = QUICK_MINUTES if quick and minutes is None else minutes
            if draws is None:
                draws = 0 if quick or axes else DRAWS
            wanted = cells_of(chosen_axes, of_each, first=common.seed, draws=draws)
            cells, new = _run_cells(wanted, chosen_methods, store, device, scheduler, limit)
            left = sum(not {identity(m) for m in chosen_methods} <= c.results.keys() for c in cells)
        took = time.perf_counter() - began
        atlas = aggregate(cells, chosen_axes, chosen_methods, _about(cells))
        with cli.progress("drawing"), own_folder(out) if earlier else contextlib.nullcontext():
            files = atlas.write(out) | draw(atlas, out)
    speed = {"cells": atlas.cells, "new_cells": new, "cells_left": left, "seconds": took, "cells_per_s": new / took}
    speed |= {"cells_failed": atlas.failed_cells}
    data = {"aims": atlas.aims.to_json(), "files": {name: str(path) for name, path in files.items()}, **speed}
    damaged = [f"damaged, and left out: {what}" for what in store.damaged] if redraw else cli.made_again(store.damaged)
    shown = [*damaged, *stability_lines(atlas, files, new, left, took)]
    failed = [asdict(failure) for failure in atlas.failures]
    cli.report(common, data | {"device": device, "damaged": store.damaged, "failed": failed}, shown)
    if not atlas.measured:
        raise typer.Exit(1)


def _axes(names: Sequence[str], quick: bool) -> tuple[Axis, ...]:
    from amiwarp.studies.stability.cells import AXES, quick_axes

    known = quick_axes() if quick else AXES
    _check_known("axis", names, [a.name for a in known])
    return tuple(a for a in known if not names or a.name in names)


def _methods(names: Sequence[str], quick: bool) -> tuple[Method, ...]:
    from amiwarp.studies.stability.cells import METHODS, QUICK_METHODS, chosen

    _check_known("method", names, [m.name for m in METHODS])
    return chosen(QUICK_METHODS if quick and not names else names)


def _check_known(what: str, names: Sequence[str], known: Sequence[str]) -> None:
    """Raise :class:`AmiwarpError` for a name that is not known."""
    for name in names:
        if name not in known:
            raise AmiwarpError(f"unknown {what} {name!r}; choose among {', '.join(known)}")


def _run_cells(
    wanted: Sequence[Cell], methods: Sequence[Method], store: Store, device: str, scheduler: str | None,
    minutes: float | None,
) -> tuple[list[Stored], int]:  # fmt: skip
    """Run all missing cells (single recordings). Return all cells and the number of new cells."""
    from amiwarp.studies.cluster import start_workers
    from amiwarp.studies.stability.cells import run

    end = None if minutes is None else time.monotonic() + 60.0 * minutes
    new = 0

    def count(what: str, share: float) -> None:
        nonlocal new
        new += 1
        advance(what, share)

    try:
        with (
            cli.progress("starting workers") as advance,
            start_workers("amiwarp stability", "cluster", scheduler, cpu_threads(), device) as workers,
        ):
            cells = run(wanted, methods, store, workers, device=device, progress=count,
                        until=None if end is None else lambda: time.monotonic() > end)  # fmt: skip
    except KeyboardInterrupt:
        say(f"amiwarp: finished cells are kept in {store.folder}; run the same command again to continue")
        raise
    return cells, new


def _about(cells: Sequence[Stored]) -> dict[str, Any]:
    from amiwarp.studies.cluster import versions

    machines = sorted({r.machine for c in cells for r in c.results.values() if r.machine})
    return {"date": time.strftime("%Y-%m-%d"), "machine": ", ".join(machines), "versions": versions(())}


def stability_lines(atlas: Atlas, files: dict[str, Path], new: int, left: int, took: float) -> list[Any]:
    """Return the results as tables and lines of text: where each method works, the aims, the files and the speed."""
    from amiwarp.studies.stability.report import STATED_HEADINGS, summary

    shown: list[Any] = [cli.table(summary(atlas), "works at", *atlas.methods), "", *atlas.aims.lines(), ""]
    if atlas.stated:
        shown += [cli.table([d.row() for d in atlas.stated], *STATED_HEADINGS), ""]
    listed = ("overview", "pages", "summary", "data", "table")
    shown += [f"{name}: {files[name]}" for name in listed]
    failed = {f"{f.where}, seed {f.name.rpartition('_')[2]}, {', '.join(f.methods)}": f.message for f in atlas.failures}
    shown += failed_lines(failed, files["summary"])
    speed = f"{new:,} cells in {took:,.0f} s, {new / took:.3g} per second; " if new else ""
    without = f"; {atlas.failed_cells:,} failed: run the same command again to try them again" if failed else ""
    if left:
        shown.append(f"{left:,} cells remain after the time limit; run the same command again to continue")
    return [*shown, f"{speed}{atlas.cells:,} cells in all, in {files['data'].parent / 'cells'}{without}"]


# ``amiwarp evaluate``: the AMI-EV against a plain event camera, as its paper evaluates it, on simulated worlds.


def run_evaluate(
    *,
    out: Annotated[
        Path, typer.Option(help="Folder for the report. An existing one is continued."), cli.OUTPUT_FOLDER
    ] = Path("amiwarp-evaluation"),
    only: Annotated[
        str | None,
        typer.Option(
            help="Evaluations to run, such as texture,flow. Default: all.",
            metavar="NAME,...",
        ),
    ] = None,
    full: Annotated[
        bool,
        typer.Option(
            "--full/--quick",
            help="Full study: 320x240, ten seeds, all values; or quick: 240x180, two seeds, a sample of each.",
        ),
    ] = False,
    seeds: Annotated[int | None, typer.Option(min=1, help="Number of seeds instead.")] = None,
    recording: Annotated[
        list[Path] | None,
        typer.Option(
            help="Recording of your own, for the evaluations that need no ground truth: texture and event rate. Can be "
            "repeated. Simulated worlds are then left out, unless --only is given."
        ),
    ] = None,
    scheduler: Scheduler = None,
    workers: LocalWorkers = None,
    common: cli.Common,
) -> None:
    """Check the AMI-EV paper's results: compare with a plain event camera on simulated worlds, and write a report.

    The report is OUT/report.html, with its tables and figures next to it. Finished cells are saved in OUT/cells: the
    same command continues a stopped run. A cell that fails is reported, does not stop the others, and is run again by
    the same command. --device cuda uses all GPUs.
    """
    from amiwarp.studies.cluster import ANY_GPU
    from amiwarp.studies.evaluate.evaluation import evaluate

    device = common.device if common.device == ANY_GPU else cli.choose_device(common.device)

    names = tuple(name.strip() for name in only.split(",") if name.strip()) if only else ()
    try:
        with cli.progress("starting workers", average_s=AVERAGE_S) as advance:
            done = evaluate(
                out, only=names, full=full, seeds=seeds, recordings=recording or (), scheduler=scheduler,
                workers=workers, device=device, seed=common.seed, progress=advance,
            )  # fmt: skip
    except KeyboardInterrupt:
        say(f"amiwarp: finished cells are kept in {out}; run the same command again to continue")
        raise
    files = {name: str(path) for name, path in done.files.items()}
    cli.report(common, asdict(done) | {"files": files, "device": device}, _evaluate_lines(done))
    if done.failed == done.cells:
        raise typer.Exit(1)


def _evaluate_lines(done: EvaluationSummary) -> list[str]:
    verdicts = ", ".join(f"{count} {verdict}" for verdict, count in done.verdicts.items())
    lines = [f"claims: {verdicts or 'none'}"]
    lines += failed_lines(done.failures, done.files["report"])
    lines += cli.made_again(done.damaged)
    lines += [f"{name}: {path}" for name, path in done.files.items()]
    last = (
        f"{done.new_cells:,} of {done.cells:,} cells in {done.seconds:,.0f} s, {done.processor_seconds:,.0f} s of "
        "processor time"
    )
    if done.failed:
        last += f"; {done.failed:,} failed: run the same command again to try them again"
    return [*lines, last]
