"""Command ``calibrate``."""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from amiwarp.choices import OPTICAL_MODELS, SearchCost, Sharpness
from amiwarp.cli import common as cli
from amiwarp.cli.common import span
from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events.axes import read_axes
from amiwarp.events.recording import MemoryEvents, Recording
from amiwarp.io import open_recording
from amiwarp.io.output_formats import check_ending
from amiwarp.io.outputs import check_output

if TYPE_CHECKING:
    from amiwarp.calib.settings import PhotometricSettings
    from amiwarp.results.calibration import Calibration, ModelCandidate, ModelChoice


# ``amiwarp calibrate``: estimation of the prism's parameters from a recording.

_SEARCH = "Search"
_PARAMETERS = "Parameters"


class CalibrationMethod(enum.StrEnum):
    """Method of the calibration: amiwarp's own, or the paper's."""

    AMIWARP = "amiwarp"
    PAPER = "paper"


@dataclass(frozen=True)
class SearchOptions:
    """Options for the search of the calibration. Defaults are those of ``amiwarp.Settings``."""

    model: Annotated[
        str | None,
        typer.Option(
            help=f"Optical model: {', '.join(OPTICAL_MODELS)}, or auto: that of the recording's optic, for one prism "
            "the smallest within --budget-px. Default: auto.",
            rich_help_panel=_SEARCH,
        ),
    ] = None
    budget_px: Annotated[
        float | None,
        typer.Option(
            help="Largest model error that --model auto accepts (px). Default: a tenth of the blur from quantisation "
            "and timing.",
            rich_help_panel=_SEARCH,
        ),
    ] = None
    sharpness: Annotated[
        Sharpness | None,
        typer.Option(
            help="Sharpness measure to maximise. Default: variance.", rich_help_panel=_SEARCH
        ),
    ] = None
    cost: Annotated[
        SearchCost | None,
        typer.Option(
            help="What the search optimises: sharpness, or phase, the cost of sums of events in phase with the prism, "
            "which needs an encoder and a whole turn. Default: sharpness.",
            rich_help_panel=_SEARCH,
        ),
    ] = None
    global_algorithm: Annotated[
        str | None,
        typer.Option(
            help="Global search: an NLopt algorithm such as GN_DIRECT_L; phase, over sums in phase; or none, search "
            "locally from --start. Default: auto, on CPUs phase where it tells the motion, else GN_DIRECT_L.",
            rich_help_panel=_SEARCH,
        ),
    ] = None
    local_algorithm: Annotated[
        str | None,
        typer.Option(
            help="NLopt algorithm of the local search, such as LN_BOBYQA.", rich_help_panel=_SEARCH
        ),
    ] = None
    global_evaluations: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Largest number of evaluations in the global search.",
            rich_help_panel=_SEARCH,
        ),
    ] = None
    local_evaluations: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Largest number of evaluations in each local search.",
            rich_help_panel=_SEARCH,
        ),
    ] = None
    tolerance_px: Annotated[
        float | None,
        typer.Option(
            min=0.0,
            help="Smallest step of the local search, as motion of events (px).",
            rich_help_panel=_SEARCH,
        ),
    ] = None
    smoothing_px: Annotated[
        float | None,
        typer.Option(
            min=0.0, help="Smoothing of the local search's image (px).", rich_help_panel=_SEARCH
        ),
    ] = None
    per_polarity: Annotated[
        bool,
        typer.Option(
            "--per-polarity",
            help="Use separate images for ON and OFF events.",
            rich_help_panel=_SEARCH,
        ),
    ] = False
    events: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Largest number of events to use; more are thinned evenly.",
            rich_help_panel=_SEARCH,
        ),
    ] = None
    fold: Annotated[
        int | None,
        typer.Option(
            min=0,
            help="Number of angle bins per turn; events of one pixel in the same bin are joined. Default: 0 (off).",
            rich_help_panel=_SEARCH,
        ),
    ] = None
    stages: Annotated[
        str | None,
        typer.Option(
            help="Stages to run: sharpness, or sharpness,photometric. Default: both stages.",
            rich_help_panel=_SEARCH,
        ),
    ] = None
    photometric_algorithm: Annotated[
        str | None,
        typer.Option(
            help="Algorithm of the photometric stage: gauss-newton, or an NLopt algorithm such as LN_BOBYQA. "
            "Default: gauss-newton.",
            rich_help_panel=_SEARCH,
        ),
    ] = None
    latency_us: Annotated[
        float,
        typer.Option(
            min=0.0, help="Known delay of the sensor's time stamps (us).", rich_help_panel=_SEARCH
        ),
    ] = 0.0
    refractory_us: Annotated[
        float | None,
        typer.Option(
            min=0.0,
            help="Known refractory period of the sensor (us); 0 if it has none. Default: not known.",
            rich_help_panel=_SEARCH,
        ),
    ] = None

    def changes(self, base: PhotometricSettings) -> dict[str, Any]:
        """Return the fields of the settings that options set.

        ``base`` provides the photometric settings without an option.
        """
        from amiwarp.brightness.sensor_timing import SensorTiming

        given = {
            name: value
            for name, value in vars(self).items()
            if value is not None and value is not False
        }
        if (given.get("global_algorithm") or "").lower() == "none":
            given["global_algorithm"] = None
        if self.stages is not None:
            given["stages"] = tuple(name.strip() for name in self.stages.split(","))
        sensor = SensorTiming(given.pop("latency_us"), given.pop("refractory_us", None))
        algorithm = given.pop("photometric_algorithm", None)
        photometric = replace(base, sensor=sensor, algorithm=algorithm or base.algorithm)
        return given | {"photometric": photometric}


@dataclass(frozen=True)
class ParameterOptions:
    """Options for the parameters: which are estimated, their start values and bounds."""

    free: Annotated[
        str | None,
        typer.Option(
            help="Parameters to estimate, separated by commas: apex (or deflection), phase, clock_offset, rpm, tilt_x, "
            "tilt_y, cylinder_x, cylinder_y, wobble_x, wobble_y, index, focal_length; of a pair of prisms also "
            "second_apex, second_phase, ratio; of a plate phase, inverse_depth, wedge_x, wedge_y; of a vibration "
            "amplitude, phase, rpm, backward_x, backward_y, roll_x, roll_y, second_x, second_y, second_backward_x, "
            "second_backward_y, third_x, third_y, third_backward_x, third_backward_y; of a mirror amplitude, "
            "phase, direction, second_amplitude, second_phase, second_direction, fold, incidence; "
            "motion (or rate_x, rate_y, rate_z) and change_x, change_y, change_z for a rotating camera, growth for one "
            "that moves forward; off_ratio and leak of the sensor. "
            "Default: apex,phase, and rpm without an encoder; all of a mirror; all of a vibration, its third harmonic "
            "where the events ask for it.",
            rich_help_panel=_PARAMETERS,
        ),
    ] = None
    start: Annotated[
        list[str] | None,
        typer.Option(
            help="Start value of an estimated parameter, or known value of another one, such as apex=1.1deg or "
            "clock_offset=-250us. Can be repeated.",
            metavar="NAME=VALUE",
            rich_help_panel=_PARAMETERS,
        ),
    ] = None
    bound: Annotated[
        list[str] | None,
        typer.Option(
            help="Bounds of an estimated parameter, such as phase=-10:10deg. Can be repeated.",
            metavar="NAME=LOW:HIGH",
            rich_help_panel=_PARAMETERS,
        ),
    ] = None
    rpm: Annotated[
        float | None,
        typer.Option(
            help="Start value of the prism's speed without an encoder (turns/min); negative: backwards. "
            "Default: estimated from the events.",
            rich_help_panel=_PARAMETERS,
        ),
    ] = None

    def changes(self) -> dict[str, Any]:
        """Return the fields of the settings that options set.

        Raises :class:`AmiwarpError` for unknown parameters and values that cannot be read.
        """
        start = {
            name: cli.number(text, unit, f"--start {name}")
            for name, unit, text in map(_named, self.start or ())
        }
        bounds = {
            name: cli.interval(text, unit, f"--bound {name}")
            for name, unit, text in map(_named, self.bound or ())
        }
        if self.rpm is not None:
            start["rpm"] = self.rpm
        free = (
            None
            if self.free is None
            else tuple(name.strip() for name in self.free.split(",") if name.strip())
        )
        return {"start": start, "bounds": bounds} | ({} if free is None else {"free": free})


def _named(text: str) -> tuple[str, str, str]:
    from amiwarp.results.parameters import units

    known = units()
    name, equals, value = text.partition("=")
    name = name.strip()
    if not equals or name not in known:
        raise AmiwarpError(
            f"{text!r} does not name a parameter; write NAME=VALUE with NAME one of {', '.join(known)}"
        )
    return name, known[name], value


def run_calibrate(
    recording: Annotated[Path, typer.Argument(help="Recording in any supported format.")],
    out: Annotated[
        Path | None,
        typer.Argument(
            help="Calibration file to write. Default: NAME.calibration.json next to the recording."
        ),
        cli.OUTPUT,
    ] = None,
    *,
    method: Annotated[
        CalibrationMethod,
        typer.Option(
            help="Calibration method. paper: the method of He et al. for comparison (circle model, their cost J, grid "
            "around the nominal prism)."
        ),
    ] = CalibrationMethod.AMIWARP,
    preset: Annotated[
        Path | None,
        typer.Option(help="Preset with settings from 'amiwarp chart'. Other options override it."),
    ] = None,
    figure: Annotated[
        Path | None,
        typer.Option(
            help="Figure to write: cost surface, and image of the events before and after (.png)."
        ),
        cli.OUTPUT,
    ] = None,
    window: Annotated[
        str | None,
        typer.Option(
            help="Time window to use (s from the first event). Default: the whole recording.",
            metavar="START:END",
        ),
    ] = None,
    imu_rotation: Annotated[
        str | None,
        typer.Option(
            help="Camera's x, y, z in the frame of the recording's gyroscope, such as -x,y,-z, or nine numbers of a "
            "rotation matrix, row by row. Default: as the recording says, else found in the events.",
            metavar="X,Y,Z",
        ),
    ] = None,
    search: SearchOptions,
    parameters: ParameterOptions,
    camera: cli.CameraOptions,
    prism: cli.NominalPrismOptions,
    layout: cli.FileOptions,
    common: cli.Common,
) -> None:
    """Find the prism's parameters by contrast maximisation: those that make the image of warped events sharpest.

    No initial guess is needed. A photometric stage refines the result.
    """
    from amiwarp.calib.calibration import calibrate
    from amiwarp.calib.paper_method import calibrate_as_paper
    from amiwarp.calib.presets import Preset
    from amiwarp.calib.settings import Settings

    device = cli.choose_device(common.device)
    base = (
        Settings() if preset is None else Preset.load(preset, "calibration").calibration_settings()
    )
    settings = replace(
        base, seed=common.seed, **search.changes(base.photometric), **parameters.changes()
    )
    opened = cli.complete(open_recording(recording, **layout.given()), camera, prism)
    opened = cut(opened, window) if window else opened
    if imu_rotation is not None:
        opened = with_axes(opened, imu_rotation)
    out = out or recording.with_name(f"{recording.stem}.calibration.json")
    check_ending(out, "calibrations are written", [".json"])
    check_output(out)
    if figure is not None:
        check_ending(figure, "figures are written", [".png"])
    with cli.progress("calibrating") as advance:
        if method is CalibrationMethod.PAPER:
            check_paper(search, parameters, preset)
            found = calibrate_as_paper(
                opened, start=settings.start, device=device, progress=advance
            )
        else:
            found = calibrate(opened, settings, device=device, progress=advance)
    found.save(out)
    if figure is not None:
        from amiwarp.plotting.calibration_figure import draw_calibration

        draw_calibration(figure, opened, found, device=device)
    data = calibration_summary(found) | {
        "file": str(out),
        "figure": None if figure is None else str(figure),
        "device": device,
    }
    cli.report(common, data, calibration_lines(found, data))


def with_axes(recording: Recording, text: str) -> Recording:
    """Return the recording with the axes of its gyroscope in the camera's frame, see :func:`read_axes`."""
    if recording.imu is None:
        raise AmiwarpError(
            f"{recording.name}: has no samples of a gyroscope; leave out --imu-rotation",
            ErrorCode.CONTENT_MISSING,
        )
    try:
        return replace(recording, imu=replace(recording.imu, to_camera=read_axes(text)))
    except AmiwarpError as error:
        raise AmiwarpError(f"--imu-rotation: {error}") from error


def check_paper(search: SearchOptions, parameters: ParameterOptions, preset: Path | None) -> None:
    """Raise :class:`AmiwarpError` if settings other than the start phase are given for the paper's method."""
    if (
        search != SearchOptions()
        or preset is not None
        or replace(parameters, start=None) != ParameterOptions()
    ):
        raise AmiwarpError(
            "--method paper accepts no search options except --start phase=…; remove the other options",
            ErrorCode.OPTIONS,
        )


def cut(recording: Recording, window: str) -> Recording:
    """Return the part of the recording in a time window: ``START:END`` [s from the first event]; both are optional.

    Raises :class:`AmiwarpError` if the text is not a time span, or no event is in it.
    """
    first = recording.events.t_first
    last = recording.events.t_last
    low, high = span(window, first, last)
    events = recording.events.between(low, high)
    if not len(events):
        raise AmiwarpError(
            f"{recording.name}: no events in the window {window} s; "
            f"the recording is {(last - first) * 1e-6:.6g} s long",
            ErrorCode.CONTENT_MISSING,
        )
    return replace(recording, events=MemoryEvents(events, *recording.events.size))


def calibration_summary(c: Calibration) -> dict[str, Any]:
    """Return the calibration as JSON, with angles in radians and degrees, but without the points of the search."""
    data = c.to_json()
    data["stages"] = [{k: v for k, v in stage.items() if k != "points"} for stage in data["stages"]]
    return data


def calibration_lines(c: Calibration, data: dict[str, Any]) -> list[Any]:
    """Return the calibration as tables and lines of text."""
    rows = [(name, *_shown(entry)) for name, entry in data["parameters"].items()]
    stages = [
        (
            s["name"],
            s["algorithm"],
            str(s["evaluations"]),
            f"{s['seconds']:.2f} s",
            f"{s['sharpness']:.5g}",
            s["ended"],
        )
        for s in data["stages"]
    ]
    sharp = data["sharpness"]
    return [
        cli.table(rows, "parameter", "value", "± std", "unit"),
        "",
        cli.table(stages, "stage", "algorithm", "evaluations", "time", "sharpness", "ended by"),
        "",
        *_ladder(c.ladder),
        f"sharpness ({sharp['kind']}): {sharp['before']:.5g} before, {sharp['after']:.5g} after",
        *_photometric(c),
        *_frequency(data["parameters"].get("rpm", {})),
        *(f"warning: {text}" for text in c.warnings),
        f"{data['file']}: {data['model']} model, {c.events:,} events, {c.seconds:.2f} s on {data['device']}",
    ]


def _ladder(ladder: ModelChoice | None) -> list[Any]:
    """Return a table that compares the models, and the check of additional parameters, as lines of text."""
    if ladder is None:
        return []
    measured = any(r.seen_px is not None for r in ladder.rungs)
    models = [
        (
            r.model,
            r.numbers,
            f"{r.predicted_px:.4f} px",
            *(_held_out(r) if measured else ()),
            ("chosen: " if r.chosen else "") + r.verdict,
        )
        for r in ladder.rungs
    ]
    held_out = (
        ("held-out sharpness", "loss", "loss as motion", "time per event") if measured else ()
    )
    agreement = (
        f"predicted errors and held-out sharpness {'agree' if ladder.agreed else 'do not agree'}"
    )
    freed = [
        (p.name, "" if p.std_px is None else f"{p.std_px:.2g} px", p.verdict)
        for p in ladder.parameters
    ]
    return [
        cli.table(models, "model", "parameters", "predicted error", *held_out, "verdict"),
        f"budget {ladder.budget_px:.3g} px; blur from timing {ladder.timing_px:.2g} px"
        + (f"; {agreement}" if measured else ""),
        *([cli.table(freed, "additional parameter", "± std", "verdict")] if freed else []),
        *(_exact(ladder) if not any(r.chosen and r.model == "exact" for r in ladder.rungs) else []),
        "",
    ]


def _exact(ladder: ModelChoice) -> list[str]:
    """Return a line of text with the apex of the exact model, for a chosen model that has no apex parameter."""
    std = ladder.exact_uncertainty.get("apex", 0.0)
    return [
        f"the exact model's apex: {math.degrees(ladder.exact['apex']):.6g} ± {math.degrees(std):.2g} deg"
    ]


def _held_out(r: ModelCandidate) -> tuple[str, ...]:
    """Return a model's results on held-out turns as text; empty if it was not measured."""
    from amiwarp.calib.trial import in_pixels

    if r.seen_px is None:
        return ("",) * 4
    low, high = (max(x, 0.0) for x in r.seen_px)
    lost = f"{r.loss:.2g} ± {r.loss_std:.1g}"
    return f"{r.sharpness:.5g}", lost, f"{low:.3f} to {in_pixels(high)}", f"{r.cost_ns:.3g} ns"


def _frequency(rpm: dict[str, Any]) -> list[str]:
    """Return a line of text with the frequency of a vibration, if it was calibrated."""
    if "hz" not in rpm:
        return []
    std = f" ± {rpm['std'] / 60.0:.2g}" if "std" in rpm else ""
    return [f"frequency: {abs(rpm['hz']):.7g}{std} Hz"]


def _photometric(c: Calibration) -> list[str]:
    if c.photometric is None or not c.photometric.accepted:
        return []
    p = c.photometric
    lines = [
        f"photometric: {p.verdict}; {p.pairs:,} pairs, {p.moved_px:.3f} px from the result of the sharpness stage"
    ]
    if p.deviation_px is not None:
        lines.append(
            f"the events determine their motion within ± {p.deviation_px:.2g} px rms, a constant lag apart"
        )
    if p.hidden_px:
        bounds = sorted(p.hidden_px.items(), key=lambda bound: -bound[1])
        could = ", ".join(f"{words} {px:.2g} px" for words, px in bounds)
        lines.append(f"what was looked for and could still hide in it, at most: {could}")
    return lines


def _shown(entry: dict[str, Any]) -> tuple[str, str, str]:
    angle = entry["unit"].startswith("rad")
    scale = 180.0 / math.pi if angle else 1.0
    std = "" if entry["free"] else "given"
    if "std" in entry:
        whole_turn = entry["unit"] == "rad" and entry["std"] > math.pi
        std = "undetermined" if whole_turn else f"{entry['std'] * scale:.2g}"
    return f"{entry['value'] * scale:.6g}", std, entry["unit"].replace("rad", "deg")
