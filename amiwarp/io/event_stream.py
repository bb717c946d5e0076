"""Event Stream (.es) through faery: DVS files, and the change events of ATIS files."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path

from amiwarp.errors import AmiwarpError
from amiwarp.events import Recording
from amiwarp.io.files import errors_name
from amiwarp.io.scan import FileEvents, Packet


def open_es(path: Path) -> Recording:
    """Open an Event Stream file; its rows count from the bottom and are turned."""
    from faery.extension import es

    with errors_name(path, lambda: "reading the header"), es.Decoder(path, 0) as decoder:
        kind, size = decoder.event_type, decoder.dimensions
        if kind not in ("dvs", "atis") or size is None:
            raise AmiwarpError(f"{path}: holds {kind} events; expected dvs or atis")
    width, height = int(size[0]), int(size[1])
    events = FileEvents(path, partial(_packets, path, height), size=(width, height))
    return Recording(events=events, metadata={"format": "es", **events.repairs}, name=path.stem)


def _packets(path: Path, height: int, notes: dict[str, int]) -> Iterator[Packet]:
    from faery.extension import es

    with es.Decoder(path, 0) as decoder:
        atis = decoder.event_type == "atis"
        for packet in decoder:
            events = packet[~packet["exposure"].astype(bool)] if atis else packet
            yield events["x"], height - 1 - events["y"], events["t"], events["polarity" if atis else "p"]
