"""Writers of Prophesee's RAW files in EVT 3.0 and 2.1."""

from collections.abc import Iterable
from pathlib import Path

from amiwarp.events.recording import Events
from amiwarp.io.output_formats import LONGEST_EVT21_US, Outline, origin_of
from amiwarp.io.prophesee.evt3_encoder import Evt3Encoder
from amiwarp.io.prophesee.evt21_encoder import Evt21Encoder


def _raw_header(about: Outline, version: str, name: str, origin: int, more: str = "") -> bytes:
    """Return the header of a RAW file, with the lines that Prophesee's own programs need."""
    lines = [
        "camera_integrator_name Prophesee",
        f"evt {version}",
        f"format {name};height={about.height};width={about.width}{more}",
        f"geometry {about.width}x{about.height}",
        "plugin_integrator_name Prophesee",
        "plugin_name hal_plugin_prophesee",
    ]
    if origin:
        lines.append(f"t0 {origin}")
    lines.append("end")
    return "".join(f"% {line}\n" for line in lines).encode()


def write_evt3(part: Path, blocks: Iterable[Events], about: Outline) -> None:
    """Write all events into a RAW file in EVT 3.0."""
    origin = origin_of(about)
    encoder = Evt3Encoder(origin)
    with part.open("xb") as file:
        file.write(_raw_header(about, "3.0", "EVT3", origin))
        for events in blocks:
            file.write(encoder.encode(events).astype("<u2").data)


def write_evt21(part: Path, blocks: Iterable[Events], about: Outline) -> None:
    """Write all events into a RAW file in EVT 2.1."""
    origin = origin_of(about, LONGEST_EVT21_US)
    encoder = Evt21Encoder(origin)
    with part.open("xb") as file:
        file.write(_raw_header(about, "2.1", "EVT21", origin, ";endianness=little"))
        for events in blocks:
            file.write(encoder.encode(events).astype("<u8").data)
