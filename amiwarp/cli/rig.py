"""Options for simulated recordings: camera, prism, motion of the prism, encoder and sensor."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from amiwarp.cli.inputs import numbers, read_camera
from amiwarp.errors import AmiwarpError
from amiwarp.io.input_files import text_lines
from amiwarp.optics.camera import Camera
from amiwarp.optics.prism import FlatSide, Prism
from amiwarp.simulation.motion import EncoderModel, PrismMotion

if TYPE_CHECKING:
    from amiwarp.simulation.sensor import SensorModel

MOST_SPEEDS = 1_000_000
"""Largest number of rows of a table of speeds."""

_CAMERA, _PRISM, _SENSOR, _ENCODER = "Camera", "Prism", "Sensor", "Encoder"


@dataclass(frozen=True)
class RigOptions:
    """Options for the camera and the prism of a simulation."""

    size: Annotated[
        str | None,
        typer.Option(
            help="Size of the camera's image (px). Default: 640x480; for 'amiwarp translate', its pictures' size.",
            metavar="WIDTHxHEIGHT",
            rich_help_panel=_CAMERA,
        ),
    ] = None
    fov_deg: Annotated[
        float | None,
        typer.Option(
            help="Horizontal field of view (deg). Default: 60 if --camera is not given.", rich_help_panel=_CAMERA
        ),
    ] = None
    camera: Annotated[
        Path | None,
        typer.Option(help="Camera intrinsics: JSON (including the size) or calib.txt.", rich_help_panel=_CAMERA),
    ] = None
    apex_deg: Annotated[float, typer.Option(help="True apex angle of the prism (deg).", rich_help_panel=_PRISM)] = 1.0
    nominal_apex_deg: Annotated[
        float | None,
        typer.Option(
            help="Nominal apex angle stored in the recording (deg). Default: the true apex angle.",
            rich_help_panel=_PRISM,
        ),
    ] = None
    index: Annotated[float, typer.Option(help="Refractive index of the prism.", rich_help_panel=_PRISM)] = 1.5168
    flat_side: Annotated[
        FlatSide, typer.Option(help="Side that the prism's flat face is on.", rich_help_panel=_PRISM)
    ] = FlatSide.SCENE
    rpm: Annotated[
        float, typer.Option(help="Speed of the prism (turns/min); negative: backwards.", rich_help_panel=_PRISM)
    ] = 720.0
    speed: Annotated[
        Path | None,
        typer.Option(
            help="Speed over time, instead of --rpm: CSV with 'seconds,rpm' on each line.", rich_help_panel=_PRISM
        ),
    ] = None
    phase_deg: Annotated[
        float, typer.Option(help="Azimuth of the prism at encoder angle 0 (deg).", rich_help_panel=_PRISM)
    ] = 0.0
    tilt_deg: Annotated[
        str,
        typer.Option(
            help="Tilt of the prism's rotation axis about the camera's x and y axes (deg).",
            metavar="X,Y",
            rich_help_panel=_PRISM,
        ),
    ] = "0,0"

    def build_camera(self, default: tuple[int, int] = (640, 480)) -> Camera:
        """Return the camera. ``default`` is the size of its image [px] if no option gives one."""
        width, height = default if self.size is None else parse_size(self.size)
        if self.camera is None:
            return Camera.from_fov(width, height, math.radians(60.0 if self.fov_deg is None else self.fov_deg))
        if self.fov_deg is not None:
            raise AmiwarpError("--fov-deg and --camera both describe the camera; give one of them")
        return read_camera(self.camera, width, height)

    def build_prism(self) -> Prism:
        """Return the prism with its true parameters."""
        return Prism(math.radians(self.apex_deg), self.index, self.flat_side)

    def build_nominal(self) -> Prism:
        """Return the nominal prism that is stored with the recording."""
        nominal = self.apex_deg if self.nominal_apex_deg is None else self.nominal_apex_deg
        return replace(self.build_prism(), apex=math.radians(nominal))

    def build_motion(self) -> PrismMotion:
        """Return the prism's motion: speed, phase and tilt."""
        x, y = (math.radians(v) for v in numbers(self.tilt_deg, 2, "--tilt-deg"))
        rpm: Any = self.rpm if self.speed is None else _read_speed(self.speed)
        return PrismMotion(rpm, math.radians(self.phase_deg), (x, y))


def parse_size(text: str) -> tuple[int, int]:
    """Convert a size such as ``640x480``. Raises :class:`AmiwarpError` if the text is not a size."""
    width, x, height = text.partition("x")
    if not (x and width.isdigit() and height.isdigit()):
        raise AmiwarpError(f"--size {text!r} is not a size; write it like 640x480")
    return int(width), int(height)


def _read_speed(path: Path) -> list[tuple[float, ...]]:
    rows = []
    for number, line in text_lines(path):
        if line.strip() and not line.startswith("#"):
            rows.append(numbers(line, 2, f"{path}: line {number}"))
        if len(rows) > MOST_SPEEDS:
            raise AmiwarpError(f"{path}: has over {MOST_SPEEDS} speeds; give fewer, which are interpolated")
    return rows


def _sensor(text: str) -> Any:
    return typer.Option(help=text, rich_help_panel=_SENSOR)


@dataclass(frozen=True)
class SensorOptions:
    """Options for the sensor's imperfections. Defaults are those of ``amiwarp.SensorModel``."""

    ideal: Annotated[
        bool,
        typer.Option("--ideal", help="Simulate a sensor without noise, mismatch and latency.", rich_help_panel=_SENSOR),
    ] = False
    sensor: Annotated[
        str | None,
        _sensor("Known camera whose sensor is simulated: dvxplorer, davis346 or gen4. Other options change it."),
    ] = None
    contrast_on: Annotated[float | None, _sensor("ON threshold: rise of log intensity.")] = None
    contrast_off: Annotated[float | None, _sensor("OFF threshold: fall of log intensity.")] = None
    mismatch: Annotated[float | None, _sensor("Relative standard deviation of the thresholds between pixels.")] = None
    refractory_us: Annotated[float | None, _sensor("Refractory period (us).")] = None
    latency_us: Annotated[float | None, _sensor("Mean latency of the time stamps (us).")] = None
    latency_jitter_us: Annotated[float | None, _sensor("Standard deviation of the latency (us).")] = None
    leak_hz: Annotated[float | None, _sensor("Rate of leak events per pixel (1/s).")] = None
    shot_noise_hz: Annotated[float | None, _sensor("Rate of random events per pixel (1/s).")] = None
    hot_fraction: Annotated[float | None, _sensor("Fraction of hot pixels (0 to 1).")] = None
    hot_hz: Annotated[float | None, _sensor("Additional event rate of a hot pixel (1/s).")] = None
    cutoff_hz: Annotated[
        float | None,
        _sensor("Bandwidth of the photoreceptor at white (Hz), proportional to the light; 0: unlimited."),
    ] = None
    shot_noise_dark: Annotated[
        float | None, _sensor("Rate of random events in the dark, relative to that at white (1 or more).")
    ] = None
    leak_jitter_fraction: Annotated[
        float | None, _sensor("Relative standard deviation of the time between leak events.")
    ] = None
    noise_rate_cov_decades: Annotated[
        float | None, _sensor("Spread of leak and random-event rates between pixels (standard deviation of log10).")
    ] = None
    row_us: Annotated[
        float | None, _sensor("Time to read out a row (us), one row after the other; 0: events are read out at once.")
    ] = None
    bus_rate_mev_s: Annotated[
        float | None, _sensor("Largest rate that the bus transmits (million events/s); 0: unlimited.")
    ] = None
    bus_queue: Annotated[float | None, _sensor("Number of events that wait for the bus; further events are lost.")] = (
        None
    )

    def build(self) -> SensorModel:
        """Return the sensor model that the options describe."""
        from amiwarp.simulation.sensor import SensorModel

        if self.ideal and self.sensor is not None:
            raise AmiwarpError("--ideal and --sensor both describe the sensor; give one of them")
        given: dict[str, Any] = {name: value for name, value in vars(self).items() if value is not None}
        ideal, preset = given.pop("ideal"), given.pop("sensor", None)
        sensor = SensorModel.preset(preset) if preset is not None else SensorModel()
        return replace(SensorModel.ideal() if ideal else sensor, **given)


def _encoder(text: str) -> Any:
    return typer.Option(help=text, rich_help_panel=_ENCODER)


@dataclass(frozen=True)
class EncoderModelOptions:
    """Options for the encoder's imperfections. Defaults are those of ``amiwarp.EncoderModel``."""

    counts_per_turn: Annotated[int | None, _encoder("Counts per turn; 0: no rounding to counts.")] = None
    rate_hz: Annotated[float | None, _encoder("Sample rate (Hz).")] = None
    jitter_us: Annotated[float | None, _encoder("Standard deviation of the sample times (us).")] = None
    clock_offset_us: Annotated[
        float | None, _encoder("Encoder clock minus camera clock (us); stored in the ground truth only.")
    ] = None
    dropouts_hz: Annotated[float | None, _encoder("Rate of drop-outs (1/s).")] = None
    dropout_us: Annotated[float | None, _encoder("Length of a drop-out, during which all samples are lost (us).")] = (
        None
    )

    def build(self) -> EncoderModel:
        """Return the encoder model that the options describe."""
        given: dict[str, Any] = {name: value for name, value in vars(self).items() if value is not None}
        if self.counts_per_turn == 0:
            given["counts_per_turn"] = None
        return EncoderModel(**given)
