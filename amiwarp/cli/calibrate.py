"""``amiwarp calibrate``: the prism's parameters from the recording itself."""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from amiwarp.cli.console import choose_device, progress, report, table
from amiwarp.cli.inputs import CameraOptions, NominalPrismOptions, complete, interval, number, span
from amiwarp.cli.options import OUTPUT, Common
from amiwarp.errors import AmiwarpError
from amiwarp.events.events import MemoryEvents
from amiwarp.imaging.choices import Sharpness
from amiwarp.io import open_recording
from amiwarp.io.output import check_output

if TYPE_CHECKING:
    from amiwarp.calib import Calibration
    from amiwarp.calib.photometric.stage import PhotometricSettings
    from amiwarp.calib.result import ModelChoice
    from amiwarp.events.recording import Recording

EXAMPLE = "amiwarp calibrate recording.h5 calibration.json --figure calibration.png"

_SEARCH, _PARAMETERS = "Search", "Parameters"


class Method(enum.StrEnum):
    """Whose way to calibrate."""

    AMIWARP = "amiwarp"
    PAPER = "paper"


@dataclass(frozen=True)
class SearchOptions:
    """How to search; what is left out takes the default of ``amiwarp.calib.Settings``."""

    model: Annotated[
        str | None,
        typer.Option(
            help="circle, exact, radial or ellipse; auto (default): the smallest that keeps the budget.",
            rich_help_panel=_SEARCH,
        ),
    ] = None
    budget_px: Annotated[
        float | None,
        typer.Option(
            help="Error of a model that counts as none, for --model auto. Default: a tenth of the blur that "
            "quantisation and timing leave anyway.",
            rich_help_panel=_SEARCH,
        ),
    ] = None
    sharpness: Annotated[
        Sharpness | None, typer.Option(help="What is maximised. Default: variance.", rich_help_panel=_SEARCH)
    ] = None
    global_algorithm: Annotated[
        str | None,
        typer.Option(help="NLopt's name, as GN_DIRECT_L; none starts at --start at once.", rich_help_panel=_SEARCH),
    ] = None
    local_algorithm: Annotated[
        str | None, typer.Option(help="NLopt's name, as LN_BOBYQA.", rich_help_panel=_SEARCH)
    ] = None
    global_evaluations: Annotated[
        int | None, typer.Option(min=1, help="Budget of the global search.", rich_help_panel=_SEARCH)
    ] = None
    local_evaluations: Annotated[
        int | None, typer.Option(min=1, help="Budget of each local search.", rich_help_panel=_SEARCH)
    ] = None
    tolerance_px: Annotated[
        float | None,
        typer.Option(min=0.0, help="The local search ends when its steps are smaller.", rich_help_panel=_SEARCH),
    ] = None
    smoothing_px: Annotated[
        float | None, typer.Option(min=0.0, help="Smoothing of the fine image.", rich_help_panel=_SEARCH)
    ] = None
    per_polarity: Annotated[
        bool, typer.Option("--per-polarity", help="ON and OFF events in images apart.", rich_help_panel=_SEARCH)
    ] = False
    events: Annotated[
        int | None, typer.Option(min=1, help="At most so many events, thinned evenly.", rich_help_panel=_SEARCH)
    ] = None
    fold: Annotated[
        int | None,
        typer.Option(
            min=0, help="Join a pixel's events within one of so many angles a turn. Default: 0, none.",
            rich_help_panel=_SEARCH,
        ),
    ] = None  # fmt: skip
    stages: Annotated[
        str | None,
        typer.Option(help="sharpness: without the photometric stage. Default: both.", rich_help_panel=_SEARCH),
    ] = None
    photometric_algorithm: Annotated[
        str | None,
        typer.Option(help="gauss-newton (default), or NLopt's name, as LN_BOBYQA.", rich_help_panel=_SEARCH),
    ] = None
    latency_us: Annotated[
        float, typer.Option(min=0.0, help="Known delay of the sensor's time stamps.", rich_help_panel=_SEARCH)
    ] = 0.0
    refractory_us: Annotated[
        float, typer.Option(min=0.0, help="Known refractory time of the sensor.", rich_help_panel=_SEARCH)
    ] = 0.0

    def changes(self, base: PhotometricSettings) -> dict[str, Any]:
        """Fields of the settings that were given; ``base``: those of the photometric stage that were not."""
        from amiwarp.brightness.event_pairs import SensorTiming

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
    """What is free, where it starts and how far it may go."""

    free: Annotated[
        str | None,
        typer.Option(
            help="Names separated by commas: apex (or deflection), phase, clock_offset, rpm, tilt_x, tilt_y, index, "
            "focal_length; motion (or rate_x, rate_y, rate_z) and change_x, change_y, change_z for a camera that "
            "turns; off_ratio and leak of the sensor. Default: apex,phase, and rpm without an encoder.",
            rich_help_panel=_PARAMETERS,
        ),
    ] = None
    start: Annotated[
        list[str] | None,
        typer.Option(
            help="Known value, free or not, as apex=1.1deg or clock_offset=-250us; can be given more than once.",
            metavar="NAME=VALUE",
            rich_help_panel=_PARAMETERS,
        ),
    ] = None
    bound: Annotated[
        list[str] | None,
        typer.Option(
            help="Bounds of a free parameter, as phase=-10:10deg; can be given more than once.",
            metavar="NAME=LOW:HIGH",
            rich_help_panel=_PARAMETERS,
        ),
    ] = None
    rpm: Annotated[
        float | None,
        typer.Option(
            help="Speed (turns/min) where there is no encoder, negative backwards; it is refined. "
            "Default: found in the events.",
            rich_help_panel=_PARAMETERS,
        ),
    ] = None

    def changes(self) -> dict[str, Any]:
        """Fields of the settings that were given. Raises :class:`AmiwarpError` for names and values that are none."""
        start = {name: number(text, unit, f"--start {name}") for name, unit, text in map(_named, self.start or ())}
        bounds = {name: interval(text, unit, f"--bound {name}") for name, unit, text in map(_named, self.bound or ())}
        if self.rpm is not None:
            start["rpm"] = self.rpm
        free = None if self.free is None else tuple(name.strip() for name in self.free.split(",") if name.strip())
        return {"start": start, "bounds": bounds} | ({} if free is None else {"free": free})


def _named(text: str) -> tuple[str, str, str]:
    from amiwarp.calib.parameters import UNITS

    name, equals, value = text.partition("=")
    name = name.strip()
    if not equals or name not in UNITS:
        raise AmiwarpError(f"{text!r} names no parameter; write NAME=VALUE with one of {', '.join(UNITS)}")
    return name, UNITS[name], value


def run(
    recording: Annotated[Path, typer.Argument(help="Recording of any format that can be read.")],
    out: Annotated[
        Path | None,
        typer.Argument(help="Calibration to write; default: NAME.calibration.json beside the recording."),
        OUTPUT,
    ] = None,
    *,
    method: Annotated[
        Method,
        typer.Option(
            help="paper: He et al.'s, to compare with: a circle, their cost J, a grid about the nominal prism."
        ),
    ] = Method.AMIWARP,
    preset: Annotated[
        Path | None, typer.Option(help="Settings that 'amiwarp chart' chose; options given beside it win.")
    ] = None,
    figure: Annotated[
        Path | None, typer.Option(help="Draw the cost surface, and the events' image before and after (.png)."), OUTPUT
    ] = None,
    window: Annotated[
        str | None, typer.Option(help="Only these seconds of the recording.", metavar="START:END")
    ] = None,
    search: SearchOptions,
    parameters: ParameterOptions,
    camera: CameraOptions,
    prism: NominalPrismOptions,
    common: Common,
) -> None:
    """Find the prism's parameters: those that make the image of the events sharpest. No guess is needed."""
    from amiwarp.calib import Settings, calibrate
    from amiwarp.calib.paper_method import calibrate_as_paper
    from amiwarp.calib.presets import Preset

    device = choose_device(common.device)
    base = Settings() if preset is None else Preset.load(preset, "calibration").calibration_settings()
    settings = replace(base, seed=common.seed, **search.changes(base.photometric), **parameters.changes())
    opened = complete(open_recording(recording), camera, prism)
    opened = cut(opened, window) if window else opened
    out = out or recording.with_name(f"{recording.stem}.calibration.json")
    check_output(out)
    if figure is not None and figure.suffix.lower() != ".png":
        raise AmiwarpError(f"{figure}: figures are written as .png")
    with progress("calibrating") as advance:
        if method is Method.PAPER:
            check_paper(search, parameters, preset)
            found = calibrate_as_paper(opened, start=settings.start, device=device, progress=advance)
        else:
            found = calibrate(opened, settings, device=device, progress=advance)
    found.save(out)
    if figure is not None:
        from amiwarp.plotting.figures import draw_calibration

        draw_calibration(figure, opened, found, device=device)
    data = summary(found) | {"file": str(out), "figure": None if figure is None else str(figure), "device": device}
    report(common, data, lines(found, data))


def check_paper(search: SearchOptions, parameters: ParameterOptions, preset: Path | None) -> None:
    """The paper's method has no settings but where it starts."""
    if search != SearchOptions() or preset is not None or replace(parameters, start=None) != ParameterOptions():
        raise AmiwarpError("--method paper takes no settings of the search but --start phase=…; leave the others out")


def cut(recording: Recording, window: str) -> Recording:
    """The recording's ``START:END`` seconds after its first event; either may be left out.

    Raises :class:`AmiwarpError` for a window that is none or holds no event.
    """
    first, last = recording.events.t_first, recording.events.t_last
    low, high = span(window, first, last)
    events = recording.events.between(low, high)
    if not len(events):
        raise AmiwarpError(
            f"{recording.name}: no events in the window {window} s; the recording has {(last - first) * 1e-6:.6g} s"
        )
    return replace(recording, events=MemoryEvents(events, *recording.events.size))


def summary(c: Calibration) -> dict[str, Any]:
    """What was found, angles in degrees beside radians; without the samples, which are in the file."""
    data = c.to_json()
    data["stages"] = [{k: v for k, v in stage.items() if k != "points"} for stage in data["stages"]]
    return data


def lines(c: Calibration, data: dict[str, Any]) -> list[Any]:
    """The tables for people."""
    rows = [(name, *_shown(entry)) for name, entry in data["parameters"].items()]
    stages = [
        (s["name"], s["algorithm"], str(s["evaluations"]), f"{s['seconds']:.2f} s", f"{s['sharpness']:.5g}", s["ended"])
        for s in data["stages"]
    ]
    sharp = data["sharpness"]
    return [
        table(rows, "parameter", "value", "± std", "unit"),
        "",
        table(stages, "stage", "algorithm", "evaluations", "time", "sharpness", "ended by"),
        "",
        *_ladder(c.ladder),
        f"sharpness ({sharp['kind']}): {sharp['before']:.5g} before, {sharp['after']:.5g} after",
        *_photometric(c),
        *(f"warning: {text}" for text in c.warnings),
        f"{data['file']}: {data['model']} model, {c.events:,} events, {c.seconds:.2f} s on {data['device']}",
    ]


def _ladder(ladder: ModelChoice | None) -> list[Any]:
    """Why this model, and what was freed."""
    if ladder is None:
        return []
    rungs = [
        (r.model, r.numbers, f"{r.predicted_px:.4f} px", f"{r.sharpness:.5g}", f"{r.loss:.2g} ± {r.loss_std:.1g}",
         _range(r.seen_px), f"{r.cost_ns:.3g} ns", ("chosen: " if r.chosen else "") + r.verdict)
        for r in ladder.rungs
    ]  # fmt: skip
    freed = [(p.name, "" if p.std_px is None else f"{p.std_px:.2g} px", p.verdict) for p in ladder.parameters]
    return [
        table(rungs, "model", "numbers", "predicted", "held out", "loss", "as motion", "per event", "verdict"),
        f"budget {ladder.budget_px:.3g} px; timing leaves {ladder.timing_px:.2g} px of blur; "
        f"the judges {'agree' if ladder.agreed else 'do not agree'}",
        *([table(freed, "parameter", "± std", "freed or why not")] if freed else []),
        *(_exact(ladder) if not any(r.chosen and r.model == "exact" for r in ladder.rungs) else []),
        "",
    ]


def _exact(ladder: ModelChoice) -> list[str]:
    """The prism itself, where the chosen model does not name its apex."""
    std = ladder.exact_uncertainty.get("apex", 0.0)
    return [f"the exact model's apex: {math.degrees(ladder.exact['apex']):.6g} ± {math.degrees(std):.2g} deg"]


def _range(px: tuple[float, float]) -> str:
    from amiwarp.calib.selection.trial import in_pixels

    low, high = (max(x, 0.0) for x in px)
    return f"{low:.3f} to {in_pixels(high)}"


def _photometric(c: Calibration) -> list[str]:
    if c.photometric is None or not c.photometric.accepted:
        return []
    p = c.photometric
    return [f"photometric: {p.verdict}; {p.pairs:,} pairs, {p.moved_px:.3f} px from the answer of sharpness"]


def _shown(entry: dict[str, Any]) -> tuple[str, str, str]:
    angle = entry["unit"].startswith("rad")
    scale = 180.0 / math.pi if angle else 1.0
    std = "" if entry["free"] else "given"
    if "std" in entry:
        whole_turn = entry["unit"] == "rad" and entry["std"] > math.pi
        std = "undetermined" if whole_turn else f"{entry['std'] * scale:.2g}"
    return f"{entry['value'] * scale:.6g}", std, entry["unit"].replace("rad", "deg")
