"""``amiwarp translate``: conversion of pictures and of recordings without a prism to recordings through the prism."""

import math
from pathlib import Path
from typing import Annotated

import typer

from amiwarp.cli.console import choose_device, progress
from amiwarp.cli.options import OUTPUT, Common, EncoderModelOptions, RigOptions, SensorOptions
from amiwarp.cli.simulate import write

EXAMPLE = "amiwarp translate video.mp4 recording.h5 --apex-deg 1 --rpm 720"


def run(
    source: Annotated[
        Path,
        typer.Argument(
            help="Video, folder of pictures (with times.csv: file, t_us) or .npy stack; or a recording of an event "
            "camera without a prism."
        ),
    ],
    out: Annotated[Path, typer.Argument(help="Recording to write (.h5)."), OUTPUT],
    *,
    events: Annotated[
        Path | None, typer.Option(help="Recording of the events between the pictures, by the same camera.")
    ] = None,
    dataset: Annotated[
        str | None, typer.Option(help="Data set that SOURCE belongs to: n-caltech101 or mvsec.", metavar="NAME")
    ] = None,
    interpolation: Annotated[
        str,
        typer.Option(
            help="Light between two pictures: motion (it follows the motion), blend (it fades over), or auto "
            "(motion if pictures move by more than a pixel).",
            metavar="auto|motion|blend",
        ),
    ] = "auto",
    fps: Annotated[
        float | None,
        typer.Option(
            help="Pictures per second. Needed for a stack or a folder without times.csv; overrides the rate of a video."
        ),
    ] = None,
    picture_fov_deg: Annotated[
        float | None,
        typer.Option(help="Horizontal extent of the pictures (deg). Default: they fill the view through the prism."),
    ] = None,
    duration: Annotated[
        float | None, typer.Option(help="Length of the recording (s). Default: length of the source.")
    ] = None,
    rig: RigOptions,
    sensor: SensorOptions,
    encoder: EncoderModelOptions,
    common: Common,
) -> None:
    """Simulate the recording of an event camera behind the prism from a video, pictures, or a plain event recording.

    Pictures alone, pictures with --events, or the events of a recording alone tell the brightness of the scene. The
    camera has the size of the source unless --size or --camera gives another one.
    """
    from amiwarp.translation.sources import DataSet, Interpolation
    from amiwarp.translation.translator import translation, translator_input
    from amiwarp.validation import choice

    device = choose_device(common.device)
    name = None if dataset is None else choice(DataSet, dataset, "--dataset")
    way = choice(Interpolation, interpolation, "--interpolation")
    with progress("reading") as advance:
        given = translator_input(
            source, events=events, dataset=name, interpolation=way, fps=fps, device=device, progress=advance
        )
    chosen = rig.size is None and rig.fov_deg is None and rig.camera is None
    simulation = translation(
        given,
        rig.build_prism(),
        fov=None if picture_fov_deg is None else math.radians(picture_fov_deg),
        camera=None if chosen else rig.build_camera(given.frames.size),
        duration_s=duration,
        motion=rig.build_motion(),
        sensor=sensor.build(),
        encoder=encoder.build(),
        nominal_prism=rig.build_nominal(),
        seed=common.seed,
        device=device,
    )
    write(simulation, out, common)
