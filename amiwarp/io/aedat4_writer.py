"""Writer of iniVation's AEDAT 4.0 files, with faery: one stream of events, compressed by LZ4."""

from __future__ import annotations

import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from amiwarp.errors import AmiwarpError
from amiwarp.events.events import Events
from amiwarp.io.aedat import open_aedat4
from amiwarp.io.output_formats import Outline

PACKET_EVENT = np.dtype([("t", "<u8"), ("x", "<u2"), ("y", "<u2"), (("p", "on"), "?")])
"""Events as faery takes them."""


LAST_BYTES = 1 << 16
"""Free disk space that is needed when the file is closed [bytes]."""


def write_aedat4(part: Path, blocks: Iterable[Events], about: Outline) -> None:
    """Write all events, then count them in the file."""
    from faery.extension import aedat

    written = 0
    with aedat.Encoder(part, _description(about), ("lz4", 1)) as encoder:
        for events in blocks:
            packet = np.empty(len(events), PACKET_EVENT)
            for name in ("t", "x", "y", "p"):
                packet[name] = getattr(events, name)
            encoder.write(0, packet)
            written += len(events)
    try:
        count = len(open_aedat4(part).events) if written else 0
    except AmiwarpError:  # the file is truncated
        count = 0
    # The encoder does not report whether it could write its last bytes.
    if count != written or shutil.disk_usage(part.parent).free < LAST_BYTES:
        raise AmiwarpError(f"the disk is full: {count} of {written} events could be written; free some space")


def _description(about: Outline) -> list[Any]:
    """Return the description of the stream in the header, as iniVation's recorder writes it."""
    from faery.extension import aedat

    attribute, node = aedat.DescriptionAttribute, aedat.DescriptionNode
    size = {"sizeX": about.width, "sizeY": about.height}
    texts = {
        "compression": "LZ4",
        "originalModuleName": "amiwarp",
        "originalOutputName": "events",
        "typeDescription": "Array of events (polarity ON/OFF).",
        "typeIdentifier": "EVTS",
    }
    root = "/mainloop/Recorder/outInfo/"
    attributes = {name: attribute("int", value) for name, value in size.items()}
    attributes["source"] = attribute("string", "amiwarp")
    info = node("info", f"{root}0/info/", attributes, [])
    stream = {name: attribute("string", text) for name, text in texts.items()}
    return [node("outInfo", root, {}, [node("0", f"{root}0/", stream, [info])])]
