"""Event Stream files by their specification, not with the package's own code."""

import struct

import numpy as np

from amiwarp import Events

ES_SIZE = 300, 260


def es_bytes(events: Events, kind: str, *, exposure: np.ndarray | None = None) -> bytes:
    """A file by the specification of Event Stream, with a reset between any two events."""
    shift, longest = (1, 127) if kind == "dvs" else (2, 63)
    out = b"Event Stream\2\0\0" + bytes([1 if kind == "dvs" else 2]) + struct.pack("<HH", *ES_SIZE)
    before = 0
    for k in range(len(events)):
        left = int(events.t[k]) - before
        before = int(events.t[k])
        while left >= longest:
            times = 1 if kind == "dvs" else min(3, left // longest)
            out += bytes([longest << shift | times])
            left -= longest * times
        on = int(events.p[k])
        bits = on if kind == "dvs" else on << 1 | int(exposure is not None and exposure[k])
        out += bytes([left << shift | bits])
        out += struct.pack("<HH", events.x[k], ES_SIZE[1] - 1 - int(events.y[k])) + bytes(
            [longest << shift]
        )
    return out
