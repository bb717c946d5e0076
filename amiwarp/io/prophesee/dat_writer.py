"""Writer of Prophesee's DAT files, version 2, of CD events: a header, then 8 bytes for each event."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from amiwarp.events.recording import Events
from amiwarp.io.output_formats import LONGEST_DAT_US, Outline, origin_of

DAT_KIND = bytes([0x0C, 8])
"""Type of the events, CD, and their size [bytes], between the header and the events."""


def write_dat(part: Path, blocks: Iterable[Events], about: Outline) -> None:
    """Write all events into a DAT file."""
    origin = origin_of(about, LONGEST_DAT_US)
    header = [
        "Data file containing CD events.",
        "Version 2",
        f"Height {about.height}",
        f"Width {about.width}",
    ]
    if origin:
        header.append(f"T0 {origin}")
    with part.open("xb") as file:
        file.write("".join(f"% {line}\n" for line in header).encode())
        file.write(DAT_KIND)
        for events in blocks:
            words = np.empty((len(events), 2), "<u4")
            words[:, 0] = events.t - origin
            words[:, 1] = (
                events.x | events.y.astype(np.uint32) << 14 | events.p.astype(np.uint32) << 28
            )
            file.write(words.data)
