"""Calibration and its use: ``amiwarp calibrate``, ``compensate``, ``reconstruct`` and ``pixels``."""

from __future__ import annotations

import contextlib
import enum
import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from amiwarp.choices import CONTRAST, OPTICAL_MODELS, Fill, Layers, Sharpness, Tone
from amiwarp.cli import common as cli
from amiwarp.cli.common import span
from amiwarp.errors import AmiwarpError
from amiwarp.events.recording import MemoryEvents, Recording
from amiwarp.io import open_recording
from amiwarp.io.files import check_output
from amiwarp.io.formats import COMPENSATED_HELP, Codec, check_ending
from amiwarp.optics.camera import CameraRotation
from amiwarp.tasks import Progress

if TYPE_CHECKING:
    from amiwarp.calib.result import Calibration, ModelCandidate, ModelChoice
    from amiwarp.calib.settings import PhotometricSettings
    from amiwarp.imaging.export import IweFiles
    from amiwarp.reconstruction.picture import Picture, Reconstruction

# ``amiwarp calibrate``: estimation of the prism's parameters from a recording.

_SEARCH, _PARAMETERS = "Search", "Parameters"


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
        typer.Option(help="Sharpness measure to maximise. Default: variance.", rich_help_panel=_SEARCH),
    ] = None
    global_algorithm: Annotated[
        str | None,
        typer.Option(
            help="NLopt algorithm of the global search, such as GN_DIRECT_L. none: search locally from --start.",
            rich_help_panel=_SEARCH,
        ),
    ] = None
    local_algorithm: Annotated[
        str | None,
        typer.Option(help="NLopt algorithm of the local search, such as LN_BOBYQA.", rich_help_panel=_SEARCH),
    ] = None
    global_evaluations: Annotated[
        int | None,
        typer.Option(min=1, help="Largest number of evaluations in the global search.", rich_help_panel=_SEARCH),
    ] = None
    local_evaluations: Annotated[
        int | None,
        typer.Option(min=1, help="Largest number of evaluations in each local search.", rich_help_panel=_SEARCH),
    ] = None
    tolerance_px: Annotated[
        float | None,
        typer.Option(
            min=0.0, help="Smallest step of the local search, as motion of events (px).", rich_help_panel=_SEARCH
        ),
    ] = None
    smoothing_px: Annotated[
        float | None, typer.Option(min=0.0, help="Smoothing of the local search's image (px).", rich_help_panel=_SEARCH)
    ] = None
    per_polarity: Annotated[
        bool, typer.Option("--per-polarity", help="Use separate images for ON and OFF events.", rich_help_panel=_SEARCH)
    ] = False
    events: Annotated[
        int | None,
        typer.Option(min=1, help="Largest number of events to use; more are thinned evenly.", rich_help_panel=_SEARCH),
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
            help="Stages to run: sharpness, or sharpness,photometric. Default: both stages.", rich_help_panel=_SEARCH
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
        float, typer.Option(min=0.0, help="Known delay of the sensor's time stamps (us).", rich_help_panel=_SEARCH)
    ] = 0.0
    refractory_us: Annotated[
        float, typer.Option(min=0.0, help="Known refractory period of the sensor (us).", rich_help_panel=_SEARCH)
    ] = 0.0

    def changes(self, base: PhotometricSettings) -> dict[str, Any]:
        """Return the fields of the settings that options set.

        ``base`` provides the photometric settings without an option.
        """
        from amiwarp.brightness.solver import SensorTiming

        given = {name: value for name, value in vars(self).items() if value is not None and value is not False}
        if (given.get("global_algorithm") or "").lower() == "none":
            given["global_algorithm"] = None
        if self.stages is not None:
            given["stages"] = tuple(name.strip() for name in self.stages.split(","))
        sensor = SensorTiming(given.pop("latency_us"), given.pop("refractory_us"))
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
        start = {name: cli.number(text, unit, f"--start {name}") for name, unit, text in map(_named, self.start or ())}
        bounds = {
            name: cli.interval(text, unit, f"--bound {name}") for name, unit, text in map(_named, self.bound or ())
        }
        if self.rpm is not None:
            start["rpm"] = self.rpm
        free = None if self.free is None else tuple(name.strip() for name in self.free.split(",") if name.strip())
        return {"start": start, "bounds": bounds} | ({} if free is None else {"free": free})


def _named(text: str) -> tuple[str, str, str]:
    from amiwarp.calib.parameters import units

    known = units()
    name, equals, value = text.partition("=")
    name = name.strip()
    if not equals or name not in known:
        raise AmiwarpError(f"{text!r} does not name a parameter; write NAME=VALUE with NAME one of {', '.join(known)}")
    return name, known[name], value


def run_calibrate(
    recording: Annotated[Path, typer.Argument(help="Recording in any supported format.")],
    out: Annotated[
        Path | None,
        typer.Argument(help="Calibration file to write. Default: NAME.calibration.json next to the recording."),
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
        Path | None, typer.Option(help="Preset with settings from 'amiwarp chart'. Other options override it.")
    ] = None,
    figure: Annotated[
        Path | None,
        typer.Option(help="Figure to write: cost surface, and image of the events before and after (.png)."),
        cli.OUTPUT,
    ] = None,
    window: Annotated[
        str | None,
        typer.Option(
            help="Time window to use (s from the first event). Default: the whole recording.", metavar="START:END"
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
    base = Settings() if preset is None else Preset.load(preset, "calibration").calibration_settings()
    settings = replace(base, seed=common.seed, **search.changes(base.photometric), **parameters.changes())
    opened = cli.complete(open_recording(recording, **layout.given()), camera, prism)
    opened = cut(opened, window) if window else opened
    out = out or recording.with_name(f"{recording.stem}.calibration.json")
    check_ending(out, "calibrations are written", [".json"])
    check_output(out)
    if figure is not None:
        check_ending(figure, "figures are written", [".png"])
    with cli.progress("calibrating") as advance:
        if method is CalibrationMethod.PAPER:
            check_paper(search, parameters, preset)
            found = calibrate_as_paper(opened, start=settings.start, device=device, progress=advance)
        else:
            found = calibrate(opened, settings, device=device, progress=advance)
    found.save(out)
    if figure is not None:
        from amiwarp.plotting.figures import draw_calibration

        draw_calibration(figure, opened, found, device=device)
    data = calibration_summary(found) | {
        "file": str(out),
        "figure": None if figure is None else str(figure),
        "device": device,
    }
    cli.report(common, data, calibration_lines(found, data))


def check_paper(search: SearchOptions, parameters: ParameterOptions, preset: Path | None) -> None:
    """Raise :class:`AmiwarpError` if settings other than the start phase are given for the paper's method."""
    if search != SearchOptions() or preset is not None or replace(parameters, start=None) != ParameterOptions():
        raise AmiwarpError("--method paper accepts no search options except --start phase=…; remove the other options")


def cut(recording: Recording, window: str) -> Recording:
    """Return the part of the recording in a time window: ``START:END`` [s from the first event]; both are optional.

    Raises :class:`AmiwarpError` if the text is not a time span, or no event is in it.
    """
    first, last = recording.events.t_first, recording.events.t_last
    low, high = span(window, first, last)
    events = recording.events.between(low, high)
    if not len(events):
        raise AmiwarpError(
            f"{recording.name}: no events in the window {window} s; the recording is {(last - first) * 1e-6:.6g} s long"
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
        (s["name"], s["algorithm"], str(s["evaluations"]), f"{s['seconds']:.2f} s", f"{s['sharpness']:.5g}", s["ended"])
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
        (r.model, r.numbers, f"{r.predicted_px:.4f} px", *(_held_out(r) if measured else ()),
         ("chosen: " if r.chosen else "") + r.verdict)
        for r in ladder.rungs
    ]  # fmt: skip
    held_out = ("held-out sharpness", "loss", "loss as motion", "time per event") if measured else ()
    agreement = f"predicted errors and held-out sharpness {'agree' if ladder.agreed else 'do not agree'}"
    freed = [(p.name, "" if p.std_px is None else f"{p.std_px:.2g} px", p.verdict) for p in ladder.parameters]
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
    return [f"the exact model's apex: {math.degrees(ladder.exact['apex']):.6g} ± {math.degrees(std):.2g} deg"]


def _held_out(r: ModelCandidate) -> tuple[str, ...]:
    """Return a model's results on held-out turns as text; empty if it was not measured."""
    from amiwarp.calib.model_choice import in_pixels

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
    said = [f"photometric: {p.verdict}; {p.pairs:,} pairs, {p.moved_px:.3f} px from the result of the sharpness stage"]
    if p.deviation_px is not None:
        said.append(f"the events determine their motion within ± {p.deviation_px:.2g} px rms, a constant lag apart")
    if p.hidden_px:
        bounds = sorted(p.hidden_px.items(), key=lambda each: -each[1])
        could = ", ".join(f"{words} {px:.2g} px" for words, px in bounds)
        said.append(f"what was looked for and could still hide in it, at most: {could}")
    return said


def _shown(entry: dict[str, Any]) -> tuple[str, str, str]:
    angle = entry["unit"].startswith("rad")
    scale = 180.0 / math.pi if angle else 1.0
    std = "" if entry["free"] else "given"
    if "std" in entry:
        whole_turn = entry["unit"] == "rad" and entry["std"] > math.pi
        std = "undetermined" if whole_turn else f"{entry['std'] * scale:.2g}"
    return f"{entry['value'] * scale:.6g}", std, entry["unit"].replace("rad", "deg")


# ``amiwarp compensate``: motion compensation of a recording with its calibration.

_in_iwe = partial(typer.Option, rich_help_panel="Image of warped events")


@dataclass(frozen=True)
class IweOptions:
    """Options for images of warped events (IWE) that are written during the compensation."""

    iwe: Annotated[
        list[Path] | None,
        _in_iwe(
            help="Image of warped events (IWE) to write: .png for viewing, .npy with the counts. Can be given twice.",
            metavar="<path>",
        ),
        cli.OUTPUT,
    ] = None
    iwe_window_ms: Annotated[
        float | None,
        _in_iwe(
            min=0.001,
            help="Write one image per time window of this length (ms): NAME_00000.png ..., or one stack in .npy.",
        ),
    ] = None
    iwe_layers: Annotated[
        Layers,
        _in_iwe(
            help="Use of polarity. merged: ignored; signed: ON minus OFF; polarity: ON and OFF in separate layers."
        ),
    ] = Layers.MERGED

    def build(self, recording: Recording, device: str) -> IweFiles | None:
        """Return the writer of the images, or None if no image is requested."""
        if not self.iwe:
            if self.iwe_window_ms is not None or self.iwe_layers is not Layers.MERGED:
                raise AmiwarpError("--iwe-window-ms and --iwe-layers apply to --iwe; give --iwe too")
            return None
        from amiwarp.imaging.export import IweFiles

        window_us = (
            None if self.iwe_window_ms is None else cli.microseconds(self.iwe_window_ms, "ms", "--iwe-window-ms")
        )
        return IweFiles(self.iwe, recording.events, window_us=window_us, layers=self.iwe_layers, device=device)


def run_compensate(
    recording: Annotated[Path, typer.Argument(help="Recording in any supported format.")],
    out: Annotated[
        Path,
        typer.Argument(help=f"Compensated recording to write. Its extension gives the format: {COMPENSATED_HELP}."),
        cli.OUTPUT,
    ],
    *,
    calibration: Annotated[Path, typer.Option(help="Calibration file from 'amiwarp calibrate' (.json).")],
    preset: Annotated[
        Path | None,
        typer.Option(help="Preset from 'amiwarp chart': sets the prism model to use. Default: the calibrated model."),
    ] = None,
    depth: Annotated[
        Path | None,
        typer.Option(
            help="Depth map from 'amiwarp depth' (.npz), for a rotating tilted plate. Default: a plane at the "
            "calibrated depth."
        ),
    ] = None,
    format: cli.Format = None,
    codec: cli.HdfCodec = Codec.BLOSC,
    round: cli.Round = None,
    encoder: cli.EncoderOptions,
    topic: cli.Topic = None,
    iwe: IweOptions,
    layout: cli.FileOptions,
    common: cli.Common,
) -> None:
    """Compensate the prism's motion: move every event to its position without the prism.

    Positions are sub-pixel, and all events are kept, in order; --round gives whole pixels and drops events outside the
    image. Memory use does not depend on the length of the recording. From a ROS bag to one of the same version of ROS,
    all other topics are copied.

    A PNG shows counts from 0 (black) to their 99.5th percentile over pixels with events (white), with gamma 0.5.
    """
    from amiwarp.calib.presets import Preset, simplified
    from amiwarp.calib.result import Calibration
    from amiwarp.compensation.recordings import compensate
    from amiwarp.io.depth_map import DepthMap

    device = cli.choose_device(common.device)
    found = Calibration.load(calibration)
    if preset is not None:
        found = simplified(found, Preset.load(preset, "compensation").settings["model"])
    log = encoder.build(recording, topic)
    opened = open_recording(recording, topic=topic, **layout.given())
    opened = opened if log is None else replace(opened, encoder=log)
    depths = None if depth is None else DepthMap.load(depth)
    files = iwe.build(opened, device)
    with cli.progress("compensating") as advance, files or contextlib.nullcontext():
        done = compensate(
            opened, found, out, depth=depths, device=device, progress=advance,
            on_block=None if files is None else files.add, format=format, codec=codec, rounding=round,
            seed=common.seed,
        )  # fmt: skip
    data: dict[str, Any] = {
        "file": str(out),
        "model": found.model_name,
        "events": done.events,
        "outside": done.outside,
        "format": done.format,
        "rounding": done.rounding,
        "dropped": done.dropped,
        "left_out": list(done.left_out),
        "subtracted_us": done.subtracted_us,
        "seconds": done.seconds,
        "mev_per_s": done.mev_per_s,
        "device": device,
        "iwe": [] if files is None else [str(path) for path in files.written],
    }
    cli.report(common, data, _compensated_lines(data))


def _compensated_lines(d: dict[str, Any]) -> list[str]:
    images = d["iwe"] if len(d["iwe"]) <= 3 else [f"{d['iwe'][0]} .. {d['iwe'][-1]} ({len(d['iwe'])} files)"]
    speed = f"{d['seconds']:.2f} s, {d['mev_per_s']:.3g} Mev/s by the {d['model']} model on {d['device']}"
    return [
        f"{d['file']}: {d['events']:,} events ({d['outside']:,} outside the image), {speed}",
        *cli.format_notes(d),
        *images,
    ]


# ``amiwarp reconstruct``: reconstruction of a picture or a video of the scene from events.

_in_window = partial(typer.Option, rich_help_panel="Window")
_in_picture = partial(typer.Option, rich_help_panel="Picture")


@dataclass(frozen=True)
class WindowOptions:
    """Options for the time window whose events are used."""

    start: Annotated[
        float | None,
        _in_window(
            help="Start of the window (s from the first event). Default: one turn, less in short recordings; 0 for a "
            "video."
        ),
    ] = None
    length: Annotated[float | None, _in_window(min=1e-6, help="Length of the window (s).")] = None
    turns: Annotated[
        float | None, _in_window(min=0.25, help="Length of the window (turns of the prism), at least 0.25. Default: 1.")
    ] = None
    fps: Annotated[
        float | None, _in_window(min=0.01, max=100_000.0, help="Frames per second of a video. Default: 25.")
    ] = None
    omega: Annotated[
        str | None,
        _in_window(
            help="Angular velocity of the camera about its x, y and z axes (rad/s), such as 0,0.6,0. "
            "Default: from the calibration.",
            metavar="X,Y,Z",
        ),
    ] = None

    def span(self, recording: Recording, turn_us: float | None, *, video: bool) -> tuple[int, int]:
        """Return the start and the length of the time window [us]. A video begins with the recording.

        ``turn_us``: duration of a turn [us], None if nothing turns.
        """
        from amiwarp.reconstruction.picture import window_span

        after = 0.0 if self.start is None and video else self.start
        start = None if after is None else recording.events.t_first + cli.microseconds(after, "s", "--start")
        length = None if self.length is None else cli.microseconds(self.length, "s", "--length")
        return window_span(recording, turn_us, start, length, self.turns)

    def camera_rotation(self) -> CameraRotation | None:
        """Return the camera's rotation given by an option, or None."""
        if self.omega is None:
            return None
        x, y, z = cli.numbers(self.omega, 3, "--omega")
        return CameraRotation((x, y, z))


@dataclass(frozen=True)
class PictureOptions:
    """Options for the content and the format of the picture."""

    fill: Annotated[
        Fill,
        _in_picture(
            help="Filling of pixels that no event determines. none: black; smooth: smooth surface; edge: flat areas "
            "with sharp edges."
        ),
    ] = Fill.SMOOTH
    tone: Annotated[
        Tone,
        _in_picture(
            help="Grey values. mapped: contrast stretched, gamma 2.2; linear: proportional to intensity. Of a network, "
            "mapped: contrast stretched; linear: its values from 0 to 1."
        ),
    ] = Tone.MAPPED
    bits: Annotated[int, _in_picture(help="Bits per pixel of a .png: 8 or 16. A .tif has 16.")] = 8
    contrast: Annotated[
        float,
        _in_picture(
            min=0.01, max=10.0, help="ON threshold of the sensor (log intensity), which scales the brightness."
        ),
    ] = CONTRAST
    mask: Annotated[
        Path | None,
        _in_picture(help="Mask of the pixels that events determine, to write (.png).", metavar="<path>"),
        cli.OUTPUT,
    ] = None


_in_network = partial(typer.Option, rich_help_panel="Network")


@dataclass(frozen=True)
class NetworkOptions:
    """Options for the reconstruction by a network."""

    network: Annotated[
        Path | None,
        _in_network(
            help="Network to use instead of the solver: 'quarter-turn' for amiwarp's own, which makes a picture of the "
            "compensated events of a quarter turn, or a TorchScript (.pt) or ONNX (.onnx) file of a network that takes "
            "normalised voxel grids, such as E2VID. Needs the extra torch or onnx.",
            metavar="quarter-turn|<path>",
        ),
    ] = None
    bins: Annotated[int, _in_network(min=1, help="Time bins of the network's voxel grids.")] = 5
    multiple: Annotated[
        int, _in_network(min=1, help="The network's height and width are multiples of this number (px).")
    ] = 8


def run_reconstruct(
    recording: Annotated[Path, typer.Argument(help="Recording in any supported format.")],
    out: Annotated[
        Path, typer.Argument(help="File to write: .png, .tif (16 bit), .npy (log intensity) or .mp4."), cli.OUTPUT
    ],
    *,
    calibration: Annotated[
        Path | None,
        typer.Option(
            help="Calibration file from 'amiwarp calibrate' (.json). May be left out with --network: the network then "
            "takes the events as recorded."
        ),
    ] = None,
    window: WindowOptions,
    picture: PictureOptions,
    by: NetworkOptions,
    layout: cli.FileOptions,
    common: cli.Common,
) -> None:
    """Reconstruct a picture of the scene from the events of a window, or a video from a sliding window.

    A window needs at least a quarter turn of the prism. Intensity is relative, because events do not hold absolute
    brightness. With --network, the windows of a video follow one another by default, and up to 24 windows before that
    of a picture give a recurrent network its states.
    """
    from amiwarp.calib.result import Calibration
    from amiwarp.reconstruction.picture import MASK_SUFFIXES, VIDEO, Reconstruction, check_path

    check_path(out)
    if picture.mask is not None:
        check_path(picture.mask, MASK_SUFFIXES)
    video = out.suffix.lower() == VIDEO
    if video and (picture.mask is not None or picture.bits != 8):
        raise AmiwarpError("--mask and --bits apply to a single picture; leave them out for a video")
    if out.suffix.lower() == ".npy" and (picture.bits, picture.tone) != (8, Tone.MAPPED):
        raise AmiwarpError(f"{out}: --bits and --tone apply to .png, .tif and .mp4; leave them out for .npy")
    if str(by.network) in ("None", OWN_NETWORK) and replace(by, network=None) != NetworkOptions():
        raise AmiwarpError("--bins and --multiple apply to a network in a file; give it by --network")
    if not video and window.fps is not None:
        raise AmiwarpError(f"{out}: --fps applies to a video; give a name that ends in {VIDEO}")
    device = cli.choose_device(common.device)
    given = None if calibration is None else Calibration.load(calibration)
    began = time.perf_counter()
    if by.network is not None:
        data = _by_network(open_recording(recording, **layout.given()), given, out, window, picture, by, device)
        data = {"file": str(out), **data, "seconds": time.perf_counter() - began, "device": device}
        cli.report(common, data, [_network_line(data)])
        return
    if given is None:
        raise AmiwarpError(f"{out}: --calibration is missing; give a calibration file, or a network by --network")
    work = Reconstruction(
        open_recording(recording, **layout.given()),
        given,
        camera_rotation=window.camera_rotation(),
        fill=picture.fill,
        device=device,
    )
    start, length = window.span(work.recording, work.turn_us, video=video)
    began = time.perf_counter()
    with cli.progress("reconstructing") as advance:
        if video:
            data = _video(work, out, (start, length), window.fps or 25.0, picture, advance)
        else:
            data = _still(work.window(start, length), out, picture)
    seconds = time.perf_counter() - began
    data = {"file": str(out), "start_us": start, "length_us": length, **data, "seconds": seconds, "device": device}
    cli.report(common, data, [_reconstructed_line(data)])


def _still(found: Picture, out: Path, options: PictureOptions) -> dict[str, Any]:
    from amiwarp.reconstruction.picture import save_mask, save_picture

    known = float(found.known.mean())
    if known < LEAST_KNOWN:
        raise AmiwarpError(
            f"{out}: the events determine {100.0 * known:.1f} % of the picture; calibrate this recording, if the "
            "calibration is that of another one, or give a longer --length"
        )
    save_picture(found, out, tone=options.tone, bits=options.bits, contrast=options.contrast)
    if options.mask is not None:
        save_mask(found, options.mask)
    return {
        "frames": 1,
        "pairs": found.pairs,
        "known": float(found.known.mean()),
        "residual": found.residual,
        "smoothness": found.smoothness,
        "off_excess": found.off_excess,
        "hot_pixels": found.hot,
    }


def _video(
    work: Reconstruction, out: Path, span: tuple[int, int], fps: float, options: PictureOptions, advance: Progress
) -> dict[str, Any]:
    from amiwarp.reconstruction.picture import save_video

    step = 1e6 / fps
    count = work.count(*span, step_us=step)
    pairs: list[int] = []

    def pictures() -> Iterator[Picture]:
        for found in work.windows(*span, step_us=step):
            yield found
            pairs.append(found.pairs)
            advance("reconstructing", len(pairs) / count)

    frames = save_video(pictures(), out, fps=fps, tone=options.tone, contrast=options.contrast)
    return {"frames": frames, "fps": fps, "pairs": sum(pairs)}


def _reconstructed_line(d: dict[str, Any]) -> str:
    speed = f"{d['pairs'] / 1e6:.2f} million pairs of events in {d['seconds']:.2f} s on {d['device']}"
    window = f"{d['length_us'] / 1e3:.1f} ms"
    if "fps" in d:
        return f"{d['file']}: {d['frames']} frames of {window} at {d['fps']:g}/s, {speed}"
    return f"{d['file']}: {window}, {speed}; {100.0 * d['known']:.0f} % of the picture determined by events"


OWN_NETWORK = "quarter-turn"
"""Value of ``--network`` for amiwarp's own network."""
LEAST_KNOWN = 0.005
"""Share of a picture that events must determine for it to be written."""
EARLIER_WINDOWS = 24
"""Largest number of windows before a picture's from which a network has its states."""


def _by_network(
    recording: Recording, calibration: Calibration | None, out: Path, window: WindowOptions, picture: PictureOptions,
    by: NetworkOptions, device: str,
) -> dict[str, Any]:  # fmt: skip
    """Write a picture or a video that a network makes, and return the facts about it."""
    from amiwarp.compensation.recordings import check_size
    from amiwarp.events.encoder import turn_between
    from amiwarp.imaging.networks import Network
    from amiwarp.imaging.tensors import ToTensor, Windows, voxel_grid
    from amiwarp.reconstruction.picture import VIDEO, save_network_picture, save_network_video

    if picture.mask is not None or picture.fill is not Fill.SMOOTH or window.omega is not None:
        raise AmiwarpError("--mask, --fill and --omega apply to the solver; leave them out with --network")
    if picture.contrast != CONTRAST and str(by.network) != OWN_NETWORK:
        raise AmiwarpError(f"--contrast applies to the solver and to the network {OWN_NETWORK}; leave it out")
    events = recording.events
    if not len(events):
        raise AmiwarpError(f"{recording.name}: has no events; give a recording with events")
    assert by.network is not None
    own = str(by.network) == OWN_NETWORK
    if own and calibration is None:
        raise AmiwarpError(f"{out}: --calibration is missing; amiwarp's own network takes compensated events")
    network = (
        Network.quarter_turn(device)
        if own
        else Network(
            by.network, ToTensor(voxel_grid, bins=by.bins, normalize=True), multiple=by.multiple, device=device
        )
    )
    optic: dict[str, Any] = {}
    encoder = recording.encoder
    if calibration is not None:
        check_size(calibration, events.size, recording.name)
        encoder = calibration.encoder_for(encoder, events.t_first, events.t_last)
        optic = {"model": calibration.model, "encoder": encoder}
    turn_us = None if encoder is None else turn_between(encoder, events.t_first, events.t_last)
    video, fps = out.suffix.lower() == VIDEO, window.fps or 25.0
    if window.length is None and window.turns is None and (own or video):
        window = replace(window, turns=0.25) if own else replace(window, length=1.0 / fps)
    start, length = window.span(recording, turn_us, video=video)
    if video:
        count = max(1, math.floor((events.t_last + 1 - start - length) * fps / 1e6) + 1)
        starts = start + np.rint(np.arange(count) * (1e6 / fps)).astype(np.int64)
    else:
        earlier = 0 if own else min(EARLIER_WINDOWS, (start - events.t_first) // length)
        starts = start - length * np.arange(earlier, -1, -1, dtype=np.int64)
    first, after = (np.array([events.find(int(t)) for t in times]) for times in (starts, starts + length))
    cut = Windows(first, after, starts, starts + length)
    with cli.progress("reconstructing") as advance:

        def images() -> Iterator[Any]:
            for k, image in enumerate(network.over(recording, cut, **optic)):
                if len(image) != 1:
                    raise AmiwarpError(f"{by.network}: makes {len(image)} channels; give a network that makes pictures")
                yield _own_picture(image[0], out, picture) if own else image[0]
                advance("reconstructing", (k + 1) / len(cut))

        if video:
            save_network_video(images(), out, fps=fps, tone=picture.tone)
        else:
            *_, last = images()
            save_network_picture(last, out, tone=picture.tone, bits=picture.bits)
    facts = {"frames": len(cut), "fps": fps} if video else {"frames": 1}
    return {
        "start_us": start, "length_us": length, **facts, "network": str(by.network), "windows": len(cut),
        "events": int((after - first).sum()),
    }  # fmt: skip


def _own_picture(log: Any, out: Path, picture: PictureOptions) -> Any:
    """Return what a file shows of log intensity in thresholds: that in natural units, or a picture like a camera's."""
    from amiwarp.reconstruction.picture import BRIGHT, GAMMA

    log = picture.contrast * log
    if out.suffix.lower() == ".npy":
        return log
    if picture.tone is Tone.LINEAR:
        return np.exp(log - np.percentile(log, BRIGHT))
    return np.exp((log - np.median(log)) / GAMMA)


def _network_line(d: dict[str, Any]) -> str:
    speed = f"{d['events'] / 1e6:.2f} million events in {d['seconds']:.2f} s on {d['device']} by {d['network']}"
    window = f"{d['length_us'] / 1e3:.1f} ms"
    if "fps" in d:
        return f"{d['file']}: {d['frames']} frames of {window} at {d['fps']:g}/s, {speed}"
    earlier = f" after {d['windows'] - 1} earlier windows" if d["windows"] > 1 else ""
    return f"{d['file']}: {window}{earlier}, {speed}"


# ``amiwarp pixels``: thresholds of every pixel, hot and dead pixels.

MOST_NAMED = 20
"""Largest number of hot or dead pixels that are named in text; JSON names all."""


def run_pixels(
    recording: Annotated[Path, typer.Argument(help="Recording in any supported format.")],
    calibration: Annotated[Path, typer.Argument(help="Calibration file from 'amiwarp calibrate' (.json).")],
    out: Annotated[Path, typer.Argument(help="Map of the pixels to write (.npz)."), cli.OUTPUT],
    *,
    start: Annotated[
        float | None, _in_window(min=0.0, help="Start of the used time (s from the first event). Default: one turn.")
    ] = None,
    length: Annotated[
        float | None, _in_window(min=1e-6, help="Length of the used time (s). Default: until the end.")
    ] = None,
    refractory_us: Annotated[
        float | None,
        typer.Option(min=0.0, help="Refractory period of the sensor (us). Default: that of the calibration."),
    ] = None,
    layout: cli.FileOptions,
    common: cli.Common,
) -> None:
    """Measure the ON and OFF threshold of every pixel, and find hot and dead pixels, from a calibrated recording.

    Thresholds are relative to their median. Scene and camera must be still, or rotate as calibrated. A threshold needs
    20 pairs of events, so a longer recording reaches pixels that see less texture.
    """
    from amiwarp.brightness.solver import SensorTiming
    from amiwarp.calib.result import Calibration
    from amiwarp.reconstruction.pixels import pixel_thresholds

    check_ending(out, "pixel maps are written", [".npz"])
    device = cli.choose_device(common.device)
    source = open_recording(recording, **layout.given())
    first = source.events.t_first if len(source.events) else 0
    began = time.perf_counter()
    with cli.progress("measuring the pixels") as advance:
        found = pixel_thresholds(
            source,
            Calibration.load(calibration),
            sensor=None if refractory_us is None else SensorTiming(refractory_us=refractory_us),
            start_us=None if start is None else first + cli.microseconds(start, "s", "--start"),
            length_us=None if length is None else cli.microseconds(length, "s", "--length"),
            device=device,
            progress=advance,
        )
    found.save(out)
    data: dict[str, Any] = {"file": str(out), "width": found.size[0], "height": found.size[1]}
    for name in ("on", "off"):
        values, std = getattr(found, name), getattr(found, f"{name}_std")
        known = np.isfinite(values)
        data[name] = {
            "known": int(known.sum()),
            "mismatch": math.sqrt(max(0.0, float(np.var(values[known]) - np.mean(std[known] ** 2))))
            if known.any()
            else None,
            "std": float(np.median(std[known])) if known.any() else None,
            "pairs": int(getattr(found, f"{name}_pairs").sum()),
        }
    for name in ("hot", "dead"):
        y, x = np.nonzero(getattr(found, name))
        data[name] = np.stack([x, y], axis=1).tolist()
    cli.report(common, {**data, "seconds": time.perf_counter() - began, "device": device}, _pixel_lines(data))


def _pixel_lines(data: dict[str, Any]) -> list[str]:
    lines = [data["file"]]
    for name in ("on", "off"):
        one = data[name]
        if one["known"]:
            lines.append(
                f"{name.upper()} threshold of {one['known']:,} pixels, each ± {100 * one['std']:.1f} %; they differ by "
                f"{100 * one['mismatch']:.1f} %"
            )
    for name in ("hot", "dead"):
        pixels = data[name]
        named = " ".join(f"({x}, {y})" for x, y in pixels[:MOST_NAMED]) + (" ..." if len(pixels) > MOST_NAMED else "")
        lines.append(f"{len(pixels)} {name} pixel{'' if len(pixels) == 1 else 's'} {named}".rstrip())
    return lines


# ``amiwarp depth``: inverse depth of every edge, from a camera at rest behind a rotating tilted plate.


def run_depth(
    recording: Annotated[Path, typer.Argument(help="Recording in any supported format.")],
    calibration: Annotated[Path, typer.Argument(help="Calibration file from 'amiwarp calibrate' (.json).")],
    out: Annotated[Path, typer.Argument(help="Map of inverse depth to write (.npz)."), cli.OUTPUT],
    *,
    ply: Annotated[Path | None, typer.Option(help="Point cloud to write (.ply)."), cli.OUTPUT] = None,
    figure: Annotated[
        Path | None, typer.Option(help="Figure of the depths and their deviations to write (.png)."), cli.OUTPUT
    ] = None,
    nearest_m: Annotated[float, typer.Option(help="Smallest depth that is tried (m).")] = 0.25,
    layout: cli.FileOptions,
    common: cli.Common,
) -> None:
    """Find the depth of every edge from a camera at rest behind a rotating tilted plate, with its uncertainty.

    Scene and camera must be still. Depths are unknown where the events do not determine them to 10 %.
    """
    from amiwarp.calib.result import Calibration
    from amiwarp.reconstruction.depth_at_rest import depth

    check_ending(out, "depth maps are written", [".npz"])
    for path, what, ending in ((ply, "points are written", ".ply"), (figure, "figures are written", ".png")):
        if path is not None:
            check_ending(path, what, [ending])
    device = cli.choose_device(common.device)
    began = time.perf_counter()
    with cli.progress("finding depths") as advance:
        found = depth(
            open_recording(recording, **layout.given()), Calibration.load(calibration), nearest_m=nearest_m,
            device=device, progress=advance,
        )  # fmt: skip
    found.save(out)
    if ply is not None:
        found.save_points(ply)
    if figure is not None:
        from amiwarp.plotting.figures import draw_depths

        draw_depths(figure, found)
    depths = 1.0 / found.inverse_depth[found.known]
    height, width = found.inverse_depth.shape
    data: dict[str, Any] = {
        "file": str(out), "width": width, "height": height, "known": int(found.known.sum()),
        "depth_m": [float(x) for x in np.percentile(depths, [5, 50, 95])],
        "relative_std": float(np.median((found.std / found.inverse_depth)[found.known])),
        "ply": None if ply is None else str(ply), "figure": None if figure is None else str(figure),
        "seconds": time.perf_counter() - began, "device": device,
    }  # fmt: skip
    near, middle, far = data["depth_m"]
    cli.report(common, data, [
        f"{out}: {data['known']:,} of {width * height:,} pixels with a known depth, {near:.3g} to {far:.3g} m (median "
        f"{middle:.3g} m), to {100 * data['relative_std']:.2g} %, in {data['seconds']:.1f} s on {device}"
    ])  # fmt: skip
