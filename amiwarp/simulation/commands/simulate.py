"""``amiwarp simulate``: simulated recording of a picture or a world, with its ground truth."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from amiwarp.cli import common as cli
from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events import SensorKind
from amiwarp.io import open_recording, open_rig
from amiwarp.results.pixel_map import PixelMap
from amiwarp.simulation.choices import Optic
from amiwarp.simulation.commands.rig_options import (
    EncoderModelOptions,
    MirrorOptions,
    OpticOptions,
    RigOptions,
    SensorOptions,
    SteererOptions,
    VibrationOptions,
    build_optic,
    sensor_option,
)
from amiwarp.simulation.commands.world_options import WorldOptions
from amiwarp.simulation.description import Scene
from amiwarp.simulation.imu_model import ImuModel
from amiwarp.simulation.motion import CameraMotion
from amiwarp.simulation.worlds.world_scene import BLUR_PX, WorldScene

if TYPE_CHECKING:
    from amiwarp.simulation.simulator import Simulation


AVERAGE_S = 600.0
"""Time over which the speed of a simulation is averaged to predict its end [s]. A block of a slow world may take
minutes."""
WITH_RIG = ("out", "rig_file", "world", "trajectory", "duration", "seed", "json", "device", "force")
"""Parameters that may be given with ``--rig``; all others are in its file."""
UNITS = {
    SensorKind.EVENTS: "events",
    SensorKind.FRAMES: "frames",
    SensorKind.DEPTH: "depth images",
}
"""What each kind of sensor records."""
_in_scene = partial(typer.Option, rich_help_panel="Scene")


@dataclass(frozen=True)
class SceneOptions:
    """Options for the picture and the camera's rotation in front of it."""

    scene_fov_deg: Annotated[
        float | None,
        _in_scene(
            help="Horizontal extent of the picture (deg). Default: it fills the field of view at all times."
        ),
    ] = None
    blur_px: Annotated[float, _in_scene(help="Standard deviation of the optical blur (px).")] = (
        BLUR_PX
    )

    rotate_deg_s: Annotated[
        str,
        _in_scene(
            help="Angular velocity of the camera about its x, y and z axes (deg/s).",
            metavar="X,Y,Z",
        ),
    ] = "0,0,0"

    @property
    def rates(self) -> tuple[float, ...]:
        """Angular velocity of the camera [rad/s]."""
        return tuple(math.radians(v) for v in cli.numbers(self.rotate_deg_s, 3, "--rotate-deg-s"))

    @property
    def fov(self) -> float | None:
        """Horizontal angle that the picture spans [rad], or None for the default."""
        return (
            None
            if self.scene_fov_deg is None
            else cli.fov_from(self.scene_fov_deg, "--scene-fov-deg")
        )


def run_simulate(
    context: typer.Context,
    out: Annotated[
        Path,
        typer.Argument(help="Recording to write (.h5), or with --rig the folder of the rig."),
        cli.OUTPUT_EITHER,
    ],
    *,
    picture: Annotated[
        Path | None, typer.Option(help="Picture of the scene: JPEG, PNG, TIFF ...")
    ] = None,
    rig_file: Annotated[
        Path | None,
        typer.Option(
            "--rig",
            help="Rig of several cameras to simulate instead: a file (.toml) with its world, its motion and its "
            "cameras. --world, --trajectory, --duration and --seed replace what it says.",
        ),
    ] = None,
    duration: Annotated[
        float | None, typer.Option(help="Length of the recording (s). Default: 1, or the rig's.")
    ] = None,
    world: WorldOptions,
    scene: SceneOptions,
    vibration: VibrationOptions,
    mirror: MirrorOptions,
    steerer: SteererOptions,
    optic: OpticOptions,
    rig: RigOptions,
    sensor: SensorOptions,
    pixels: Annotated[
        Path | None,
        sensor_option(
            help="Thresholds of every pixel, hot and dead pixels: map from 'amiwarp pixels' (.npz)."
        ),
    ] = None,
    encoder: EncoderModelOptions,
    imu: Annotated[
        str | None,
        typer.Option(
            help="Gyroscope and accelerometer to simulate with the camera: bmi160, mpu6500 or ideal. Default: none."
        ),
    ] = None,
    imu_hz: Annotated[
        float | None,
        typer.Option(help="Samples of the IMU per second (Hz). Default: 200."),
    ] = None,
    common: cli.Common,
) -> None:
    """Simulate the recording of a picture or a world by an event camera behind the prism, with its ground truth.

    With --rig, several cameras see a world at the same time.
    A picture lies at infinity. A world is three-dimensional, and the camera moves through it: give --world room.
    With --optic vibration, the camera vibrates instead of the prism; with --optic mirror, it looks at
    a mirror; with --optic steerer, through a beam steerer.
    """
    from amiwarp.simulation.simulator import Simulation

    if rig_file is not None:
        check_options_of_rig(context, rig_file)
        chosen = {"duration_s": duration, "world": world.world, "trajectory": world.trajectory}
        if "seed" in cli.given_options(context):
            chosen["seed"] = common.seed
        write_rig(rig_file, out, chosen, common)
        return
    if (picture is None) == (world.world is None):
        raise typer.BadParameter("give one of them", param_hint="--picture, --world")
    world.check()
    duration = 1.0 if duration is None else duration
    device = cli.choose_device(common.device)
    simulation = Simulation(
        _scene(picture, world, scene, duration, common.seed),
        rig.build_camera(),
        build_optic(optic, rig, vibration, mirror, steerer, encoder),
        duration,
        motion=rig.build_motion(),
        camera_motion=CameraMotion(scene.rates),
        sensor=sensor.build(),
        pixels=None if pixels is None else PixelMap.load(pixels),
        encoder_model=encoder.build(),
        nominal_prism=rig.build_nominal() if optic.optic is Optic.WEDGE else None,
        seed=common.seed,
        device=device,
        imu=_imu(imu, imu_hz),
    )
    world.draw_preview(simulation)
    write(
        simulation.without_prism() if world.no_prism else simulation,
        out,
        common,
        truth_hz=world.truth_hz,
        truth_times_us=world.truth_times_us,
    )


def _imu(name: str | None, rate_hz: float | None) -> ImuModel | None:
    """Return the IMU that the options describe."""
    if name is None:
        if rate_hz is not None:
            raise AmiwarpError(
                "--imu-hz is the rate of an IMU; give --imu, or remove --imu-hz", ErrorCode.OPTIONS
            )
        return None
    model = ImuModel.preset(name)
    return model if rate_hz is None else replace(model, rate_hz=rate_hz)


def _scene(
    picture: Path | None, world: WorldOptions, scene: SceneOptions, duration: float, seed: int
) -> Scene | WorldScene:
    """Return the scene of the simulation: a picture or a world."""

    if picture is not None:
        return Scene.from_picture(picture, fov=scene.fov, blur=scene.blur_px)
    if scene.fov is not None or any(scene.rates):
        raise AmiwarpError(
            "--scene-fov-deg and --rotate-deg-s apply to a picture; give --trajectory for a world",
            ErrorCode.OPTIONS,
        )
    return world.build_scene(duration, seed=seed, blur=scene.blur_px)


def write(
    simulation: Simulation,
    out: Path,
    common: cli.Common,
    *,
    truth_hz: float | None = None,
    truth_times_us: tuple[float, ...] | None = None,
) -> None:
    """Run a simulation, write its recording to ``out`` and print the result."""
    began = time.perf_counter()
    with cli.progress("simulating", average_s=AVERAGE_S) as advance:
        simulation.write(out, truth_hz=truth_hz, truth_times_us=truth_times_us, progress=advance)
    seconds = time.perf_counter() - began
    data: dict[str, Any] = {
        "file": str(out),
        "events": len(open_recording(out).events),
        "duration_s": simulation.duration_s,
        "seconds": seconds,
        "times_real_time": seconds / simulation.duration_s,
        "device": simulation.device,
    }
    cli.report(common, data, [_line(data)])


def check_options_of_rig(context: typer.Context, rig_file: Path) -> None:
    """Raise :class:`AmiwarpError` for an option that does not apply to a rig."""
    for name in cli.given_options(context):
        if name not in WITH_RIG:
            option = f"--{name.replace('_', '-')}"
            raise AmiwarpError(
                f"{option} does not apply to --rig; write it into {rig_file}, or remove {option}",
                ErrorCode.OPTIONS,
            )


def write_rig(rig_file: Path, out: Path, chosen: Mapping[str, Any], common: cli.Common) -> None:
    """Simulate the rig of a file to the folder ``out`` and print the result.

    ``chosen``: arguments of :func:`load_rig` that replace what the file says.
    """
    from amiwarp.simulation.rigs.rig_specification import load_rig

    rig = load_rig(rig_file, device=cli.choose_device(common.device), **chosen)
    began = time.perf_counter()
    with cli.progress("simulating", average_s=AVERAGE_S) as advance:
        rig.write(out, progress=advance)
    recorded = open_rig(out)
    counts = {}
    for name, sensor in recorded.sensors.items():
        kept = {
            SensorKind.EVENTS: sensor.recording.events,
            SensorKind.FRAMES: sensor.recording.frames,
            SensorKind.DEPTH: sensor.recording.depth,
        }
        counts[name] = {"kind": sensor.kind.value, "count": len(kept[sensor.kind] or ())}
    seconds = time.perf_counter() - began
    data: dict[str, Any] = {
        "folder": str(out),
        "world": rig.world.name,
        "seed": rig.seed,
        "duration_s": rig.duration_s,
        "sensors": counts,
        "seconds": seconds,
        "device": rig.device,
    }
    lines = [
        f"{out}: {len(counts)} sensors in the world {rig.world.name}, seed {rig.seed}, {rig.duration_s:.6g} s "
        f"simulated in {seconds:.2f} s on {rig.device}"
    ]
    for name, sensor in recorded.sensors.items():
        lines.append(f"  {name}: {counts[name]['count']:,} {UNITS[sensor.kind]}")
    cli.report(common, data, lines)


def _line(data: dict[str, Any]) -> str:
    rate = data["events"] / max(data["seconds"], 1e-9) / 1e6
    return (
        f"{data['file']}: {data['events']:,} events, {data['duration_s']:.6g} s simulated in {data['seconds']:.2f} s "
        f"({data['times_real_time']:.3g} x real time, {rate:.3g} Mev/s on {data['device']})"
    )
