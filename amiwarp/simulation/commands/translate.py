"""``amiwarp translate``: conversion of pictures and of recordings without a prism to recordings through the prism."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from amiwarp.cli import common as cli
from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events.recording import Recording
from amiwarp.io import open_recording
from amiwarp.simulation.commands.rig_options import EncoderModelOptions, RigOptions, SensorOptions
from amiwarp.simulation.commands.simulate import write
from amiwarp.simulation.worlds.world_scene import BLUR_PX


def run_translate(
    source: Annotated[
        Path,
        typer.Argument(
            help="Video, folder of pictures (with times.csv: file, t_us) or .npy stack; or a recording of an event "
            "camera without a prism."
        ),
    ],
    out: Annotated[Path, typer.Argument(help="Recording to write (.h5)."), cli.OUTPUT],
    *,
    events: Annotated[
        Path | None,
        typer.Option(help="Recording of the events between the pictures, by the same camera."),
    ] = None,
    dataset: Annotated[
        str | None,
        typer.Option(
            help="Data set that SOURCE belongs to: n-caltech101 or mvsec.", metavar="NAME"
        ),
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
        typer.Option(
            help="Horizontal extent of the pictures (deg). Default: they fill the view through the prism."
        ),
    ] = None,
    blur_px: Annotated[
        float,
        typer.Option(
            help="Standard deviation of the optical blur (px). 0 for pictures of a camera with the same resolution, "
            "which has blurred them already."
        ),
    ] = BLUR_PX,
    duration: Annotated[
        float | None,
        typer.Option(help="Length of the recording (s). Default: length of the source."),
    ] = None,
    rig: RigOptions,
    sensor: SensorOptions,
    encoder: EncoderModelOptions,
    layout: cli.LayoutOptions,
    common: cli.Common,
) -> None:
    """Simulate the recording of an event camera behind the prism from a video, pictures, or a plain event recording.

    Pictures alone, pictures with --events, or the events of a recording alone tell the brightness of the scene. The
    camera has the size of the source unless --size or --camera gives another one.
    """
    from amiwarp.simulation.translation.datasets import DataSet
    from amiwarp.simulation.translation.picture_pair import Interpolation
    from amiwarp.simulation.translation.translator import translation
    from amiwarp.simulation.translation.translator_input import translator_input
    from amiwarp.validation import choice

    device = cli.choose_device(common.device)
    name = None if dataset is None else choice(DataSet, dataset, "--dataset")
    kind = choice(Interpolation, interpolation, "--interpolation")
    pictures: Path | Recording = source
    events_between: Path | Recording | None = events
    if layout.given():
        opened = open_recording(source if events is None else events, **layout.given())
        pictures, events_between = (opened, None) if events is None else (source, opened)
    with cli.progress("reading") as advance:
        read = translator_input(
            pictures,
            events=events_between,
            dataset=name,
            interpolation=kind,
            fps=fps,
            device=device,
            progress=advance,
        )
    if duration is None and not read.duration_us:
        raise AmiwarpError(
            f"{source}: does not state its duration; give --duration", ErrorCode.CONTENT_MISSING
        )
    has_camera = rig.size is not None or rig.fov_deg is not None or rig.camera is not None
    simulation = translation(
        read,
        rig.build_prism(),
        fov=None if picture_fov_deg is None else cli.fov_from(picture_fov_deg, "--picture-fov-deg"),
        blur=blur_px,
        camera=rig.build_camera(read.frames.size) if has_camera else None,
        duration_s=duration,
        motion=rig.build_motion(),
        sensor=sensor.build(),
        encoder=encoder.build(),
        nominal_prism=rig.build_nominal(),
        seed=common.seed,
        device=device,
    )
    write(simulation, out, common)
