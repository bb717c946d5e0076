"""``amiwarp simulate``: simulated recording of a picture or a world, with its ground truth."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from amiwarp.cli.console import choose_device, progress, report
from amiwarp.cli.options import OUTPUT, Common, EncoderModelOptions, RigOptions, SensorOptions, WorldOptions, numbers
from amiwarp.errors import AmiwarpError
from amiwarp.io import open_recording
from amiwarp.simulation.description import CameraMotion, Scene
from amiwarp.simulation.worlds.world import WorldScene

if TYPE_CHECKING:
    from amiwarp.simulation.simulator import Simulation

EXAMPLE = "amiwarp simulate recording.h5 --picture photo.jpg --duration 0.5 --apex-deg 1 --rpm 720"

AVERAGE_S = 600.0
"""Time over which the speed of a simulation is averaged to predict its end [s]. A block of a slow world may take
minutes."""


_in_scene = partial(typer.Option, rich_help_panel="Scene")


@dataclass(frozen=True)
class SceneOptions:
    """Options for the picture and the camera's rotation in front of it."""

    scene_fov_deg: Annotated[
        float | None,
        _in_scene(help="Horizontal extent of the picture (deg). Default: it fills the field of view at all times."),
    ] = None
    blur_px: Annotated[float, _in_scene(help="Standard deviation of the optical blur (px).")] = 0.5

    rotate_deg_s: Annotated[
        str, _in_scene(help="Angular velocity of the camera about its x, y and z axes (deg/s).", metavar="X,Y,Z")
    ] = "0,0,0"

    @property
    def rates(self) -> tuple[float, ...]:
        """Angular velocity of the camera [rad/s]."""
        return tuple(math.radians(v) for v in numbers(self.rotate_deg_s, 3, "--rotate-deg-s"))

    @property
    def fov(self) -> float | None:
        """Horizontal angle that the picture spans [rad], or None for the default."""
        return None if self.scene_fov_deg is None else math.radians(self.scene_fov_deg)


def run(
    out: Annotated[Path, typer.Argument(help="Recording to write (.h5)."), OUTPUT],
    *,
    picture: Annotated[Path | None, typer.Option(help="Picture of the scene: JPEG, PNG, TIFF ...")] = None,
    duration: Annotated[float, typer.Option(help="Length of the recording (s).")] = 1.0,
    world: WorldOptions,
    scene: SceneOptions,
    rig: RigOptions,
    sensor: SensorOptions,
    encoder: EncoderModelOptions,
    common: Common,
) -> None:
    """Simulate the recording of a picture or a world by an event camera behind the prism, with its ground truth.

    A picture lies at infinity. A world is three-dimensional, and the camera moves through it: give --world room.
    """
    from amiwarp.simulation.simulator import Simulation

    if (picture is None) == (world.world is None):
        raise typer.BadParameter("give one of them", param_hint="--picture, --world")
    world.check()
    device = choose_device(common.device)
    simulation = Simulation(
        _scene(picture, world, scene, duration, common.seed),
        rig.build_camera(),
        rig.build_prism(),
        duration,
        motion=rig.build_motion(),
        camera_motion=CameraMotion(scene.rates),
        sensor=sensor.build(),
        encoder_model=encoder.build(),
        nominal_prism=rig.build_nominal(),
        seed=common.seed,
        device=device,
    )
    world.draw_preview(simulation)
    write(simulation.without_prism() if world.no_prism else simulation, out, common, truth_hz=world.truth_hz)


def _scene(
    picture: Path | None, world: WorldOptions, scene: SceneOptions, duration: float, seed: int
) -> Scene | WorldScene:
    """Return the scene of the simulation: a picture or a world."""
    from amiwarp.simulation.description import Scene

    if picture is not None:
        return Scene.from_picture(picture, fov=scene.fov, blur=scene.blur_px)
    if scene.fov is not None or any(scene.rates):
        raise AmiwarpError("--scene-fov-deg and --rotate-deg-s apply to a picture; give --trajectory for a world")
    return world.build_scene(duration, seed=seed, blur=scene.blur_px)


def write(simulation: Simulation, out: Path, common: Common, *, truth_hz: float | None = None) -> None:
    """Run a simulation, write its recording to ``out`` and print the result."""
    began = time.perf_counter()
    with progress("simulating", average_s=AVERAGE_S) as advance:
        simulation.write(out, truth_hz=truth_hz, progress=advance)
    seconds = time.perf_counter() - began
    data: dict[str, Any] = {
        "file": str(out),
        "events": len(open_recording(out).events),
        "duration_s": simulation.duration_s,
        "seconds": seconds,
        "times_real_time": seconds / simulation.duration_s,
        "device": simulation.device,
    }
    report(common, data, [_line(data)])


def _line(d: dict[str, Any]) -> str:
    rate = d["events"] / max(d["seconds"], 1e-9) / 1e6
    return (
        f"{d['file']}: {d['events']:,} events, {d['duration_s']:.6g} s simulated in {d['seconds']:.2f} s "
        f"({d['times_real_time']:.3g} x real time, {rate:.3g} Mev/s on {d['device']})"
    )
