"""``amiwarp convert``: conversion of recordings to the native format and to others."""

import math
import time
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from amiwarp.cli.console import progress, report
from amiwarp.cli.options import OUTPUT, CameraOptions, Common, NominalPrismOptions, Topic
from amiwarp.errors import AmiwarpError
from amiwarp.events.encoder import Encoder
from amiwarp.io import convert, open_recording, read_encoder_csv, read_encoder_triggers
from amiwarp.io.formats import EXTENSION_HELP, LIMITS, Codec, OutputFormat, Rounding

EXAMPLE = "amiwarp convert events.raw recording.h5 --encoder encoder.csv --counts-per-turn 4096 --fov-deg 60"

Format = Annotated[
    OutputFormat | None, typer.Option(help="Format to write, if not that of the extension: dsec.", show_default=False)
]
"""Option that chooses a format whose extension means another one."""
HdfCodec = Annotated[Codec, typer.Option(help="Compression of HDF5. Programs without HDF5's Blosc filter read gzip.")]
"""Option for the compression of HDF5."""
Round = Annotated[
    Rounding | None,
    typer.Option(
        help="Round compensated events to whole pixels, as RAW, AEDAT 4, DSEC and ROS 2 need. nearest: to the nearest "
        "pixel; dithered: up or down at random (--seed), unbiased. Events outside the image are dropped.",
        show_default=False,
    ),
]
"""Option for the rounding of compensated events."""

_in_panel = partial(typer.Option, rich_help_panel="Encoder")


@dataclass(frozen=True)
class EncoderOptions:
    """Options for a log of the prism's encoder."""

    encoder: Annotated[
        Path | None,
        _in_panel(help="Encoder log: CSV with the header t_us,angle_deg or t_us,count, and optionally index (0 or 1)."),
    ] = None
    encoder_from: Annotated[
        str | None,
        _in_panel(
            help="Take the encoder from the trigger edges in the recording: triggers:CHANNEL. Each rising edge is one "
            "count; by default it is the index pulse, one per turn.",
            metavar="triggers:CHANNEL",
        ),
    ] = None
    counts_per_turn: Annotated[int | None, _in_panel(min=1, help="Encoder counts per turn.")] = None
    counter_bits: Annotated[
        int | None,
        _in_panel(
            min=0,
            max=64,
            help="Width of the encoder's counter (bits); 0: the counter restarts at every turn. "
            "Default: inferred from the counts.",
        ),
    ] = None
    direction: Annotated[Literal["1", "-1"], _in_panel(help="Counting direction; -1: backwards.")] = "1"

    def build(self, source: Path, topic: str | None) -> Encoder | None:
        """Return the encoder of the log or of the recording's triggers, or None if neither is given."""
        if self.encoder_from is not None:
            return self._from_triggers(self.encoder_from, source, topic)
        if self.encoder is None:
            if self != EncoderOptions():
                what = "--counts-per-turn, --counter-bits and --direction describe an encoder log"
                raise AmiwarpError(f"{what}; give --encoder or --encoder-from too")
            return None
        return read_encoder_csv(
            self.encoder,
            counts_per_turn=self.counts_per_turn,
            counter_bits=self.counter_bits,
            direction=int(self.direction),
        )

    def _from_triggers(self, text: str, source: Path, topic: str | None) -> Encoder:
        kind, colon, channel = text.partition(":")
        if kind != "triggers" or (colon and not channel.isdecimal()):
            raise AmiwarpError(f"--encoder-from {text!r} is unknown; write triggers:CHANNEL, for example triggers:0")
        if self.encoder is not None or self.counter_bits is not None:
            raise AmiwarpError("--encoder and --counter-bits describe an encoder log; leave them or --encoder-from out")
        return read_encoder_triggers(
            source, int(channel or 0), counts_per_turn=self.counts_per_turn or 1, direction=int(self.direction),
            topic=topic,
        )  # fmt: skip


def run(
    source: Annotated[Path, typer.Argument(help="Recording in any supported format.")],
    out: Annotated[
        Path, typer.Argument(help=f"File to write. Its extension gives the format: {EXTENSION_HELP}."), OUTPUT
    ],
    *,
    format: Format = None,
    codec: HdfCodec = Codec.BLOSC,
    round: Round = None,
    encoder: EncoderOptions,
    camera: CameraOptions,
    prism: NominalPrismOptions,
    topic: Topic = None,
    common: Common,
) -> None:
    """Convert a recording to amiwarp's HDF5 format, and add the encoder, camera and prism given by options.

    Other formats hold the events only; the command lists what it leaves out. From a ROS 2 bag to a ROS 2 bag, all other
    topics are copied. Memory use does not depend on the length of the recording.
    """
    began = time.perf_counter()
    log = encoder.build(source, topic)
    lens = wedge = None
    if camera != CameraOptions() or prism != NominalPrismOptions():  # opening may read the whole file
        recording = open_recording(source, topic=topic)
        # If the file does not hold the sensor's size, the camera's size is used.
        lens = camera.build(*recording.events.size, fixed=getattr(recording.events, "size_is_known", True))
        wedge = prism.build(recording.prism)
    with progress("converting") as advance:
        summary = convert(
            source, out, encoder=log, camera=lens, prism=wedge, topic=topic, format=format, codec=codec,
            progress=advance, rounding=round, seed=common.seed,
        )  # fmt: skip
    seconds = time.perf_counter() - began
    data: dict[str, Any] = {"file": str(out), **asdict(summary), "seconds": seconds}
    data |= {f"{name}_us": data.pop(name) for name in ("t_first", "t_last")}
    slip = data.pop("index_slip")
    data["slip_deg"] = None if slip is None else math.degrees(slip)
    report(common, data, _lines(data))


def format_notes(d: dict[str, Any]) -> list[str]:
    """Return what the format of the output has changed and left out."""
    lines = []
    if d["rounding"] is not None:
        lines.append(f"note: rounded to whole pixels ({d['rounding']}); {d['dropped']:,} events outside are dropped")
    if d["left_out"]:
        lines.append(f"note: {LIMITS[d['format']].label} does not hold, and leaves out: {', '.join(d['left_out'])}")
    return lines


def _lines(d: dict[str, Any]) -> list[str]:
    rate = d["events"] / max(d["seconds"], 1e-9) / 1e6
    lines = [
        f"{d['file']}: {d['events']:,} events, {d['width']} x {d['height']}, {d['seconds']:.2f} s, {rate:.3g} Mev/s"
    ]
    lines += [f"note: {name}: {count:,}" for name, count in d["repairs"].items()]
    if d["encoder_covers"] is False:
        lines.append("warning: the encoder samples do not cover all events")
    if d["encoder_gaps"]:
        first = d["encoder_gaps"][0]
        lines.append(
            f"warning: the encoder has {len(d['encoder_gaps'])} gaps, the first at {first[0]} .. {first[1]} us"
        )
    lines += format_notes(d)
    if d["slip_deg"] is not None:
        lines.append(f"encoder slips up to {d['slip_deg']:.3g} deg at its index pulses")
    return lines
