"""Options of whatever makes recordings: camera, prism, its motion, its encoder, the sensor."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from amiwarp.cli.inputs import numbers, read_camera
from amiwarp.errors import AmiwarpError
from amiwarp.optics.camera import Camera
from amiwarp.optics.prism import FlatSide, Prism
from amiwarp.simulation.motion import EncoderModel, PrismMotion

if TYPE_CHECKING:
    from amiwarp.simulation.motion import EncoderModel, PrismMotion
    from amiwarp.simulation.simulator import SensorModel

_CAMERA, _PRISM, _SENSOR, _ENCODER = "Camera", "Prism", "Sensor", "Encoder"


@dataclass(frozen=True)
class RigOptions:
    """Camera and prism."""

    size: Annotated[
        str | None,
        typer.Option(
            help="Pixels of the camera. Default: 640x480, or those of a video.",
            metavar="WIDTHxHEIGHT",
            rich_help_panel=_CAMERA,
        ),
    ] = None
    fov_deg: Annotated[
        float | None,
        typer.Option(
            help="Horizontal field of view (deg). Default: 60, where --camera is not given.", rich_help_panel=_CAMERA
        ),
    ] = None
    camera: Annotated[
        Path | None,
        typer.Option(help="Intrinsics: JSON, which has the size too, or calib.txt.", rich_help_panel=_CAMERA),
    ] = None
    apex_deg: Annotated[float, typer.Option(help="The prism's true apex angle (deg).", rich_help_panel=_PRISM)] = 1.0
    nominal_apex_deg: Annotated[
        float | None,
        typer.Option(help="Apex angle that the recording names (deg). Default: the true one.", rich_help_panel=_PRISM),
    ] = None
    index: Annotated[float, typer.Option(help="Refractive index.", rich_help_panel=_PRISM)] = 1.5168
    flat_side: Annotated[FlatSide, typer.Option(help="Where the flat face looks.", rich_help_panel=_PRISM)] = (
        FlatSide.SCENE
    )
    rpm: Annotated[float, typer.Option(help="Speed, negative backwards (turns/min).", rich_help_panel=_PRISM)] = 720.0
    speed: Annotated[
        Path | None,
        typer.Option(help="Speed over time in place of --rpm: CSV, one 'seconds,rpm' a line.", rich_help_panel=_PRISM),
    ] = None
    phase_deg: Annotated[
        float, typer.Option(help="Azimuth of the prism where its encoder says 0 (deg).", rich_help_panel=_PRISM)
    ] = 0.0
    tilt_deg: Annotated[
        str, typer.Option(help="Tilt of the prism's axis (deg).", metavar="X,Y", rich_help_panel=_PRISM)
    ] = "0,0"

    def build_camera(self, default: tuple[int, int] = (640, 480)) -> Camera:
        """The camera; ``default``: its size where none is given."""
        width, height = default if self.size is None else parse_size(self.size)
        if self.camera is None:
            return Camera.from_fov(width, height, math.radians(60.0 if self.fov_deg is None else self.fov_deg))
        if self.fov_deg is not None:
            raise AmiwarpError("--fov-deg and --camera both give a camera; give one of them")
        return read_camera(self.camera, width, height)

    def build_prism(self) -> Prism:
        return Prism(math.radians(self.apex_deg), self.index, self.flat_side)

    def build_nominal(self) -> Prism:
        nominal = self.apex_deg if self.nominal_apex_deg is None else self.nominal_apex_deg
        return replace(self.build_prism(), apex=math.radians(nominal))

    def build_motion(self) -> PrismMotion:
        x, y = (math.radians(v) for v in numbers(self.tilt_deg, 2, "--tilt-deg"))
        rpm: Any = self.rpm if self.speed is None else _read_speed(self.speed)
        return PrismMotion(rpm, math.radians(self.phase_deg), (x, y))


def parse_size(text: str) -> tuple[int, int]:
    """``640x480`` as two numbers. Raises :class:`AmiwarpError`."""
    width, x, height = text.partition("x")
    if not (x and width.isdigit() and height.isdigit()):
        raise AmiwarpError(f"--size {text!r} is no size; write it like 640x480")
    return int(width), int(height)


def _read_speed(path: Path) -> list[tuple[float, ...]]:
    try:
        rows = [line for line in path.read_text().splitlines() if line.strip() and not line.startswith("#")]
    except (OSError, UnicodeDecodeError) as error:
        raise AmiwarpError(f"{path}: cannot be read: {error}") from error
    return [numbers(row, 2, f"{path}: line {k}") for k, row in enumerate(rows, 1)]


def _sensor(text: str) -> Any:
    return typer.Option(help=text, rich_help_panel=_SENSOR)


@dataclass(frozen=True)
class SensorOptions:
    """The sensor's faults; what is left out takes the default of ``amiwarp.simulation.simulator.SensorModel``."""

    ideal: Annotated[
        bool, typer.Option("--ideal", help="No noise, no mismatch, no latency.", rich_help_panel=_SENSOR)
    ] = False
    contrast_on: Annotated[float | None, _sensor("Rise of log intensity of an ON event.")] = None
    contrast_off: Annotated[float | None, _sensor("Fall of log intensity of an OFF event.")] = None
    mismatch: Annotated[float | None, _sensor("Relative scatter of the thresholds over pixels.")] = None
    refractory_us: Annotated[float | None, _sensor("Time for which a pixel is blind after an event.")] = None
    latency_us: Annotated[float | None, _sensor("Mean latency.")] = None
    latency_jitter_us: Annotated[float | None, _sensor("Its standard deviation.")] = None
    leak_hz: Annotated[float | None, _sensor("Leak events per pixel and second.")] = None
    shot_noise_hz: Annotated[float | None, _sensor("Random events per pixel and second.")] = None
    hot_fraction: Annotated[float | None, _sensor("Share of hot pixels.")] = None
    hot_hz: Annotated[float | None, _sensor("Additional events per hot pixel and second.")] = None

    def build(self) -> SensorModel:
        from amiwarp.simulation.simulator import SensorModel

        given = {name: value for name, value in vars(self).items() if name != "ideal" and value is not None}
        return replace(SensorModel.ideal() if self.ideal else SensorModel(), **given)


def _encoder(text: str) -> Any:
    return typer.Option(help=text, rich_help_panel=_ENCODER)


@dataclass(frozen=True)
class EncoderModelOptions:
    """The encoder's faults; what is left out takes the default of ``amiwarp.simulation.motion.EncoderModel``."""

    counts_per_turn: Annotated[int | None, _encoder("Resolution; 0 for none.")] = None
    rate_hz: Annotated[float | None, _encoder("Samples per second.")] = None
    jitter_us: Annotated[float | None, _encoder("Scatter of the samples' times.")] = None
    clock_offset_us: Annotated[float | None, _encoder("Encoder's clock minus the camera's; kept secret.")] = None
    dropouts_hz: Annotated[float | None, _encoder("Drop-outs per second.")] = None
    dropout_us: Annotated[float | None, _encoder("How long each loses all samples.")] = None

    def build(self) -> EncoderModel:
        given: dict[str, Any] = {name: value for name, value in vars(self).items() if value is not None}
        if self.counts_per_turn == 0:
            given["counts_per_turn"] = None
        return EncoderModel(**given)
