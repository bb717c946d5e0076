"""Command ``compensate``."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from amiwarp.choices import Layers
from amiwarp.cli import common as cli
from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events.recording import Recording
from amiwarp.io import open_recording
from amiwarp.io.output_formats import COMPENSATED_HELP, Codec

if TYPE_CHECKING:
    from amiwarp.imaging.export import IweFiles


_in_iwe = partial(typer.Option, rich_help_panel="Image of warped events")


@dataclass(frozen=True)
class IweOptions:
    """Options for images of warped events (IWE) that are written during the compensation."""

    iwe: Annotated[
        list[Path] | None,
        _in_iwe(
            help="Image of warped events (IWE) to write: .png for viewing, .npy with the counts. Can be given twice.",
            metavar="<path>",
        ),
        cli.OUTPUT,
    ] = None
    iwe_window_ms: Annotated[
        float | None,
        _in_iwe(
            min=0.001,
            help="Write one image per time window of this length (ms): NAME_00000.png ..., or one stack in .npy.",
        ),
    ] = None
    iwe_layers: Annotated[
        Layers,
        _in_iwe(
            help="Use of polarity. merged: ignored; signed: ON minus OFF; polarity: ON and OFF in separate layers."
        ),
    ] = Layers.MERGED

    def build(self, recording: Recording, device: str) -> IweFiles | None:
        """Return the writer of the images, or None if no image is requested."""
        if not self.iwe:
            if self.iwe_window_ms is not None or self.iwe_layers is not Layers.MERGED:
                raise AmiwarpError(
                    "--iwe-window-ms and --iwe-layers apply to --iwe; give --iwe too",
                    ErrorCode.OPTIONS,
                )
            return None
        from amiwarp.imaging.export import IweFiles

        window_us = None
        if self.iwe_window_ms is not None:
            window_us = cli.microseconds(self.iwe_window_ms, "ms", "--iwe-window-ms")
        return IweFiles(
            self.iwe, recording.events, window_us=window_us, layers=self.iwe_layers, device=device
        )


def run_compensate(
    recording: Annotated[Path, typer.Argument(help="Recording in any supported format.")],
    out: Annotated[
        Path,
        typer.Argument(
            help=f"Compensated recording to write. Its extension gives the format: {COMPENSATED_HELP}."
        ),
        cli.OUTPUT,
    ],
    *,
    calibration: Annotated[
        Path, typer.Option(help="Calibration file from 'amiwarp calibrate' (.json).")
    ],
    preset: Annotated[
        Path | None,
        typer.Option(
            help="Preset from 'amiwarp chart': sets the prism model to use. Default: the calibrated model."
        ),
    ] = None,
    depth: Annotated[
        Path | None,
        typer.Option(
            help="Depth map from 'amiwarp depth' (.npz), for a rotating tilted plate. Default: a plane at the "
            "calibrated depth."
        ),
    ] = None,
    format: cli.Format = None,
    codec: cli.HdfCodec = Codec.BLOSC,
    round: cli.Round = None,
    encoder: cli.EncoderOptions,
    topic: cli.Topic = None,
    iwe: IweOptions,
    layout: cli.FileOptions,
    common: cli.Common,
) -> None:
    """Compensate the prism's motion: move every event to its position without the prism.

    Positions are sub-pixel, and all events are kept, in order; --round gives whole pixels and drops events outside the
    image. Memory use does not depend on the length of the recording. From a ROS bag to one of the same version of ROS,
    all other topics are copied.

    A PNG shows counts from 0 (black) to their 99.5th percentile over pixels with events (white), with gamma 0.5.
    """
    from amiwarp.calib.presets import Preset, simplified
    from amiwarp.compensation.recordings import compensate
    from amiwarp.results.calibration import Calibration
    from amiwarp.results.depth_map import DepthMap

    device = cli.choose_device(common.device)
    calibrated = Calibration.load(calibration)
    if preset is not None:
        model_name = Preset.load(preset, "compensation").settings["model"]
        calibrated = simplified(calibrated, model_name)
    log = encoder.build(recording, topic, layout.chip)
    opened = open_recording(recording, topic=topic, **layout.given())
    if log is not None:
        opened = replace(opened, encoder=log)
    depths = None if depth is None else DepthMap.load(depth)
    files = iwe.build(opened, device)
    with cli.progress("compensating") as advance, files or contextlib.nullcontext():
        done = compensate(
            opened,
            calibrated,
            out,
            depth=depths,
            device=device,
            progress=advance,
            on_block=None if files is None else files.add,
            format=format,
            codec=codec,
            rounding=round,
            seed=common.seed,
        )
    data: dict[str, Any] = {
        "file": str(out),
        "model": calibrated.model_name,
        "events": done.events,
        "outside": done.outside,
        "format": done.format,
        "rounding": done.rounding,
        "dropped": done.dropped,
        "left_out": list(done.left_out),
        "subtracted_us": done.subtracted_us,
        "seconds": done.seconds,
        "mev_per_s": done.mev_per_s,
        "device": device,
        "iwe": [] if files is None else [str(path) for path in files.written],
    }
    cli.report(common, data, _compensated_lines(data))


def _compensated_lines(data: dict[str, Any]) -> list[str]:
    """Return the result of the command as lines of text."""
    events = f"{data['events']:,} events ({data['outside']:,} outside the image)"
    speed = f"{data['seconds']:.2f} s, {data['mev_per_s']:.3g} Mev/s"
    means = f"by the {data['model']} model on {data['device']}"
    images = data["iwe"]
    if len(images) > 3:
        images = [f"{images[0]} .. {images[-1]} ({len(images)} files)"]
    return [f"{data['file']}: {events}, {speed} {means}", *cli.format_notes(data), *images]
