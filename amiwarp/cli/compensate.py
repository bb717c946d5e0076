"""``amiwarp compensate``: motion compensation of a recording with its calibration."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from amiwarp.choices import Layers
from amiwarp.cli.console import choose_device, progress, report
from amiwarp.cli.convert import EncoderOptions, Format, HdfCodec, Round, format_notes
from amiwarp.cli.options import OUTPUT, Common, Topic
from amiwarp.errors import AmiwarpError
from amiwarp.events.recording import Recording
from amiwarp.io import open_recording
from amiwarp.io.formats import COMPENSATED_HELP, Codec

if TYPE_CHECKING:
    from amiwarp.imaging.export import IweFiles

EXAMPLE = "amiwarp compensate recording.h5 compensated.h5 --calibration calibration.json --iwe iwe.png"

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
        OUTPUT,
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
                raise AmiwarpError("--iwe-window-ms and --iwe-layers apply to --iwe; give --iwe too")
            return None
        from amiwarp.imaging.export import IweFiles

        window_us = None if self.iwe_window_ms is None else max(1, round(self.iwe_window_ms * 1000.0))
        return IweFiles(self.iwe, recording.events, window_us=window_us, layers=self.iwe_layers, device=device)


def run(
    recording: Annotated[Path, typer.Argument(help="Recording in any supported format.")],
    out: Annotated[
        Path,
        typer.Argument(help=f"Compensated recording to write. Its extension gives the format: {COMPENSATED_HELP}."),
        OUTPUT,
    ],
    *,
    calibration: Annotated[Path, typer.Option(help="Calibration file from 'amiwarp calibrate' (.json).")],
    preset: Annotated[
        Path | None,
        typer.Option(help="Preset from 'amiwarp chart': sets the prism model to use. Default: the calibrated model."),
    ] = None,
    format: Format = None,
    codec: HdfCodec = Codec.BLOSC,
    round: Round = None,
    encoder: EncoderOptions,
    topic: Topic = None,
    iwe: IweOptions,
    common: Common,
) -> None:
    """Compensate the prism's motion: move every event to its position without the prism.

    Positions are sub-pixel, and all events are kept, in order; --round gives whole pixels and drops events outside the
    image. Memory use does not depend on the length of the recording. From a ROS 2 bag to a ROS 2 bag, all other topics
    are copied.

    A PNG shows counts from 0 (black) to their 99.5th percentile over pixels with events (white), with gamma 0.5.
    """
    from amiwarp.calib import Calibration
    from amiwarp.calib.presets import Preset, simplified
    from amiwarp.compensation.recordings import compensate

    device = choose_device(common.device)
    found = Calibration.load(calibration)
    if preset is not None:
        found = simplified(found, Preset.load(preset, "compensation").settings["model"])
    log = encoder.build(recording, topic)
    opened = open_recording(recording, topic=topic)
    opened = opened if log is None else replace(opened, encoder=log)
    files = iwe.build(opened, device)
    with progress("compensating") as advance, files or contextlib.nullcontext():
        done = compensate(
            opened, found, out, device=device, progress=advance, on_block=None if files is None else files.add,
            format=format, codec=codec, rounding=round, seed=common.seed,
        )  # fmt: skip
    data: dict[str, Any] = {
        "file": str(out),
        "model": found.model_name,
        "events": done.events,
        "outside": done.outside,
        "format": done.format,
        "rounding": done.rounding,
        "dropped": done.dropped,
        "left_out": list(done.left_out),
        "seconds": done.seconds,
        "mev_per_s": done.mev_per_s,
        "device": device,
        "iwe": [] if files is None else [str(path) for path in files.written],
    }
    report(common, data, _lines(data))


def _lines(d: dict[str, Any]) -> list[str]:
    images = d["iwe"] if len(d["iwe"]) <= 3 else [f"{d['iwe'][0]} .. {d['iwe'][-1]} ({len(d['iwe'])} files)"]
    speed = f"{d['seconds']:.2f} s, {d['mev_per_s']:.3g} Mev/s by the {d['model']} model on {d['device']}"
    return [
        f"{d['file']}: {d['events']:,} events ({d['outside']:,} outside the image), {speed}",
        *format_notes(d),
        *images,
    ]
