"""``amiwarp design``: comparison of prisms and speeds for a camera, with a recommendation."""

from __future__ import annotations

import csv
import io
import json
import math
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from amiwarp.cli.console import choose_device, plain, progress, report, table
from amiwarp.cli.options import OUTPUT_FOLDER, CameraOptions, Common, numbers, parse_size
from amiwarp.io.files import check_output, write_text
from amiwarp.io.formats import make_folder
from amiwarp.optics.camera import Camera
from amiwarp.optics.prism import FlatSide, Prism

if TYPE_CHECKING:
    from amiwarp.studies.design import Choice, Design, Limits, Timing

EXAMPLE = "amiwarp design --size 640x480 --fov-deg 60 --tolerance-px 0.5 --out amiwarp-design"
FOV_DEG = 60.0
"""Horizontal field of view that is assumed if no option describes the camera [deg]."""
_in_camera = partial(typer.Option, rich_help_panel="Camera")
_in_limits = partial(typer.Option, rich_help_panel="Limits")
_in_faults = partial(typer.Option, rich_help_panel="Faults")
_in_prism = partial(typer.Option, rich_help_panel="Prism")


@dataclass(frozen=True)
class GridOptions:
    """Options for the prisms and speeds to compare."""

    apex_deg: Annotated[str, _in_prism(help="Apex angles to compare (deg).", metavar="A,B,...")] = "0.25,0.5,1,2,4"
    rpm: Annotated[str, _in_prism(help="Speeds to compare (turns/min).", metavar="A,B,...")] = "180,360,720,1440,2880"
    index: Annotated[float, _in_prism(help="Refractive index of the prism.")] = 1.5168
    flat_side: Annotated[FlatSide, _in_prism(help="Direction that the prism's flat face points to.")] = FlatSide.SCENE

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


def run(
    *,
    out: Annotated[Path, typer.Option(help="Folder for the chart and the tables."), OUTPUT_FOLDER] = Path(
        "amiwarp-design"
    ),
    size: Annotated[
        str | None,
        _in_camera(
            help="Size of the camera's image (px). Default: 640x480, or the size in --camera.", metavar="WIDTHxHEIGHT"
        ),
    ] = None,
    camera: CameraOptions,
    grid: GridOptions,
    limits: LimitOptions,
    faults: FaultOptions,
    picture: Annotated[Path | None, typer.Option(help="Picture of the scene. Default: a map of the earth.")] = None,
    common: Common,
) -> None:  # fmt: skip
    """Compare prisms and speeds for a camera, and recommend one with the reasons.

    Event rates are predicted from simulations of small parts of the image. Blur, window and models are predicted from
    the optics.
    """
    seen = _camera(camera, size)
    glass = Prism(0.0, grid.index, grid.flat_side)
    device = choose_device(common.device)
    from amiwarp.simulation.description import Scene
    from amiwarp.simulation.sensor import SensorModel
    from amiwarp.studies.demo import earth
    from amiwarp.studies.design import design
    from amiwarp.studies.design.drawing import draw

    make_folder(out)
    files = {kind: str(out / f"design.{kind}") for kind in ("png", "svg", "json", "csv")}
    for path in files.values():
        check_output(Path(path))
    sensor = SensorModel(contrast_on=faults.contrast, contrast_off=faults.contrast)
    scene = Scene.from_picture(picture or earth())
    with progress("starting") as advance:
        made = design(
            seen, scene, glass, apexes=grid.apexes, rpms=grid.rpms, timing=faults.timing(), limits=limits.build(),
            sensor=sensor, seed=common.seed, device=device, progress=advance,
        )  # fmt: skip
    data = summary(made)
    write_text(Path(files["json"]), json.dumps(plain(data), indent=1, allow_nan=False) + "\n")
    write_text(Path(files["csv"]), _csv(data["choices"]))
    draw(out / "design", made)
    report(common, {**data, "files": files, "device": device}, lines(made, files))


def _camera(options: CameraOptions, size: str | None) -> Camera:
    width, height = parse_size(size or "640x480")
    found = options.build(width, height, fixed=size is not None)
    return found or Camera.from_fov(width, height, math.radians(FOV_DEG))


def _list(text: str, name: str) -> tuple[float, ...]:
    return numbers(text, text.count(",") + 1, name)


def summary(design: Design) -> dict[str, Any]:
    """Return all results of the study for JSON, with angles in degrees."""
    from amiwarp.studies.design.choice import headline, reasons

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


def _csv(rows: list[dict[str, Any]]) -> str:
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows({**row, "misses": "+".join(row["misses"])} for row in rows)
    return text.getvalue()


def lines(design: Design, files: dict[str, str]) -> list[Any]:
    """Return the results as tables and lines of text."""
    from amiwarp.studies.design.choice import degrees, headline, rate, reasons

    rows = [
        (degrees(c.orbit.apex), f"{c.rpm:g}", rate(c.events_per_s), f"{c.orbit.radius:.1f} px", f"{c.error_px:.3f} px",
         c.model, f"{c.window_ms:.1f} ms", "recommended" if c is design.chosen else ", ".join(c.misses))
        for c in design.choices
    ]  # fmt: skip
    shown = table(rows, "apex", "rpm", "events", "orbit", "error", "model", "window", "misses")
    said = [tuple(line.split(": ", 1)) for line in reasons(design)]
    return [shown, "", headline(design), table(said), "", *files.values()]
