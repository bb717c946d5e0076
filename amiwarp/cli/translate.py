"""``amiwarp translate``: a video, or a folder of pictures, into the recording of a camera behind the prism."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from amiwarp.cli.console import choose_device
from amiwarp.cli.options import OUTPUT, Common
from amiwarp.cli.rig import EncoderModelOptions, RigOptions, SensorOptions
from amiwarp.cli.simulate import write
from amiwarp.optics.camera import Camera

EXAMPLE = "amiwarp translate video.mp4 recording.h5 --apex-deg 1 --rpm 720"


def run(
    source: Annotated[Path, typer.Argument(help="Video, folder of pictures (times.csv: file, t_us) or .npy stack.")],
    out: Annotated[Path, typer.Argument(help="Recording to write (.h5)."), OUTPUT],
    *,
    fps: Annotated[
        float | None, typer.Option(help="Pictures per second, where the source does not tell or tells wrong.")
    ] = None,
    duration: Annotated[float | None, typer.Option(help="Length (s). Default: that of the pictures.")] = None,
    rig: RigOptions,
    sensor: SensorOptions,
    encoder: EncoderModelOptions,
    common: Common,
) -> None:
    """Make a recording of pictures in time as an event camera behind the prism would see them.

    The camera has the pictures' size unless --size or --camera say otherwise.
    """
    from amiwarp.simulation.translator import open_pictures, translation

    device = choose_device(common.device)
    pictures = open_pictures(source, fps=fps)
    camera: Camera = rig.build_camera(pictures.size)
    simulation = translation(
        pictures,
        rig.build_prism(),
        camera=camera,
        duration_s=duration,
        motion=rig.build_motion(),
        sensor=sensor.build(),
        encoder=encoder.build(),
        nominal_prism=rig.build_nominal(),
        seed=common.seed,
        device=device,
    )
    write(simulation, out, common)
