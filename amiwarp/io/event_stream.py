"""Reader of Event Stream files (.es), with faery: events of DVS files, and change detections of ATIS files."""

from collections.abc import Iterator
from functools import partial
from pathlib import Path

from amiwarp.errors import AmiwarpError
from amiwarp.events.recording import Recording
from amiwarp.io.file_scan import FileEvents, Packet
from amiwarp.io.input_files import errors_name
from amiwarp.io.reading_process import Reply, noting_progress, packets, run


def open_es(path: Path) -> Recording:
    """Open an Event Stream file. Its rows are counted from the bottom, so they are flipped."""
    with errors_name(path, lambda: "reading the header"):
        width, height = run(read_head, path.absolute())
    source = partial(packets, read_packets, path.absolute(), height)
    events = FileEvents(path, source, size=(width, height))
    return Recording(events=events, metadata={"format": "es", **events.metadata}, name=path.stem)


def read_head(path: str) -> Reply:
    """Return width and height of the sensor. Called in the reading process."""
    from faery.extension import es

    with es.Decoder(path, 0) as decoder:
        kind, size = decoder.event_type, decoder.dimensions
        if kind not in ("dvs", "atis") or size is None:
            raise AmiwarpError(f"holds {kind} events; expected dvs or atis")
        return (int(size[0]), int(size[1])), []


def read_packets(notes: dict[str, int], path: str, height: int) -> Iterator[Packet]:
    """Yield packets of events. Called in the reading process."""
    from faery.extension import es

    with es.Decoder(path, 0) as decoder:
        atis = decoder.event_type == "atis"
        for packet in noting_progress(decoder, path, notes):
            events = packet[~packet["exposure"].astype(bool)] if atis else packet
            yield events["x"], height - 1 - events["y"], events["t"], events["polarity" if atis else "p"]
