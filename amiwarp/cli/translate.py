"""``amiwarp translate``: conversion of a video or a folder of pictures to a simulated recording."""

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
    source: Annotated[
        Path, typer.Argument(help="Video, folder of pictures (with times.csv: file, t_us) or .npy stack.")
    ],
    out: Annotated[Path, typer.Argument(help="Recording to write (.h5)."), OUTPUT],
    *,
    fps: Annotated[
        float | None,
        typer.Option(
            help="Pictures per second. Needed for a stack or a folder without times.csv; overrides the rate of a video."
        ),
    ] = None,
    duration: Annotated[
        float | None, typer.Option(help="Length of the recording (s). Default: length of the pictures.")
    ] = None,
    rig: RigOptions,
    sensor: SensorOptions,
    encoder: EncoderModelOptions,
    common: Common,
) -> None:
    """Simulate the recording of a video or a picture sequence by an event camera behind the prism.

    The camera has the size of the pictures unless --size or --camera gives another one.
    """
    from amiwarp.simulation.sequences import open_pictures
    from amiwarp.simulation.translator import translation

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
