"""``amiwarp compensate``: a recording and its calibration into a recording without the prism's motion."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from amiwarp.cli.console import choose_device, progress, report
from amiwarp.cli.options import OUTPUT, Common
from amiwarp.errors import AmiwarpError
from amiwarp.imaging.choices import Layers
from amiwarp.io import open_recording

if TYPE_CHECKING:
    from amiwarp.events.recording import Recording
    from amiwarp.imaging.export import IweFiles

EXAMPLE = "amiwarp compensate recording.h5 compensated.h5 --calibration calibration.json --iwe iwe.png"

_IWE = "Image of warped events"


@dataclass(frozen=True)
class IweOptions:
    """The image of warped events, written along the way."""

    iwe: Annotated[
        list[Path] | None,
        typer.Option(
            help="Image of the compensated events: .png to look at, .npy with the counts; can be given twice.",
            metavar="<path>",
            rich_help_panel=_IWE,
        ),
        OUTPUT,
    ] = None
    iwe_window_ms: Annotated[
        float | None,
        typer.Option(
            min=0.001, help="One image for each window of time: NAME_00000.png ..., or one stack in .npy.",
            rich_help_panel=_IWE,
        ),
    ] = None  # fmt: skip
    iwe_layers: Annotated[
        Layers,
        typer.Option(help="merged: all events; signed: ON minus OFF; polarity: both, apart.", rich_help_panel=_IWE),
    ] = Layers.MERGED

    def build(self, recording: Recording, device: str) -> IweFiles | None:
        if not self.iwe:
            if self.iwe_window_ms is not None or self.iwe_layers is not Layers.MERGED:
                raise AmiwarpError("--iwe-window-ms and --iwe-layers describe an image; give --iwe too")
            return None
        from amiwarp.imaging.export import IweFiles

        window_us = None if self.iwe_window_ms is None else max(1, round(self.iwe_window_ms * 1000.0))
        return IweFiles(self.iwe, recording.events, window_us=window_us, layers=self.iwe_layers, device=device)


def run(
    recording: Annotated[Path, typer.Argument(help="Recording of any format that can be read.")],
    out: Annotated[Path, typer.Argument(help="Compensated recording to write (.h5)."), OUTPUT],
    *,
    calibration: Annotated[Path, typer.Option(help="What 'amiwarp calibrate' wrote.")],
    preset: Annotated[
        Path | None,
        typer.Option(help="The model that 'amiwarp chart' chose, of the same prism. Default: as calibrated."),
    ] = None,
    iwe: IweOptions,
    common: Common,
) -> None:
    """Move every event to where it would be without the prism: sub-pixel, in order, none dropped, constant memory.

    A PNG shows counts from 0 (black) to their 99.5th percentile over pixels with events (white), with gamma 0.5.
    """
    from amiwarp.calib import Calibration
    from amiwarp.calib.presets import Preset, simplified
    from amiwarp.compensation.recordings import compensate

    device = choose_device(common.device)
    found = Calibration.load(calibration)
    if preset is not None:
        found = simplified(found, Preset.load(preset, "compensation").settings["model"])
    opened = open_recording(recording)
    files = iwe.build(opened, device)
    with progress("compensating") as advance:
        if files is None:
            done = compensate(opened, found, out, device=device, progress=advance)
        else:
            with files:
                done = compensate(opened, found, out, device=device, progress=advance, on_block=files.add)
    data: dict[str, Any] = {
        "file": str(out),
        "model": found.model_name,
        "events": done.events,
        "outside": done.outside,
        "seconds": done.seconds,
        "mev_per_s": done.mev_per_s,
        "device": device,
        "iwe": [] if files is None else [str(path) for path in files.written],
    }
    report(common, data, _lines(data))


def _lines(d: dict[str, Any]) -> list[str]:
    images = d["iwe"] if len(d["iwe"]) <= 3 else [f"{d['iwe'][0]} .. {d['iwe'][-1]} ({len(d['iwe'])} files)"]
    speed = f"{d['seconds']:.2f} s, {d['mev_per_s']:.3g} Mev/s by the {d['model']} model on {d['device']}"
    return [f"{d['file']}: {d['events']:,} events ({d['outside']:,} outside the image), {speed}", *images]
