"""Decoder of the packets of events in AEDAT 4 files, once their compression is undone, on a CPU or a GPU."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from amiwarp.io.decoding import address_of, cut_into_blocks, new_rows, sums_before

if TYPE_CHECKING:
    from amiwarp.events.device_events import DeviceEvents

EVENT_BYTES = 16
"""Size of an event."""


class PacketEvents(NamedTuple):
    """Events of some packets."""

    events: DeviceEvents
    """The events, on the device of the packets."""
    counts: NDArray[np.int64]
    """Number of events of each packet; -1 if it is damaged."""
    surveys: NDArray[Any]
    """What blocks of the events hold, see :class:`amiwarp.kernels.event_survey.Survey`."""
    earliest: NDArray[np.int64]
    """Least time of each block [us]."""


def packets_in_memory(contents: list[bytes]) -> NDArray[Any]:
    """Return where some packets lie in memory. They must be kept as long as this is used."""
    from amiwarp.kernels.raw_numbers import Span

    packets = new_rows(len(contents), Span)
    packets["address"] = [address_of(content) for content in contents]
    packets["size"] = [len(content) for content in contents]
    return packets


def find_events(packets: NDArray[Any], device: Any) -> NDArray[Any]:
    """Return where the events of some packets begin, and how many there are, -1 in a damaged packet."""
    import warp as wp

    from amiwarp.kernels import aedat4
    from amiwarp.kernels.launch import launch
    from amiwarp.kernels.raw_numbers import Span

    places = wp.empty(packets.size, dtype=aedat4.Found, device=device)
    launch(
        aedat4.find_events,
        packets.size,
        [wp.array(packets, dtype=Span, device=device)],
        [places],
        device=device,
        smallest=64,
    )
    return np.asarray(places.numpy())


def decode_packets(packets: NDArray[Any], device: Any) -> PacketEvents:
    """Return the events of some packets in the memory of a device."""
    import warp as wp

    from amiwarp.events.device_events import DeviceEvents
    from amiwarp.kernels import aedat4
    from amiwarp.kernels.event_arrays import new_event_arrays
    from amiwarp.kernels.event_survey import Survey
    from amiwarp.kernels.launch import launch

    device = wp.get_device(device)
    places = find_events(packets, device)
    counts = places["count"].astype(np.int64)

    # Blocks of events of one packet.
    present = np.maximum(counts, 0)
    packet, before, held = cut_into_blocks(present, device)
    blocks = new_rows(packet.size, aedat4.Block)
    offset = places["start"][packet] + EVENT_BYTES * before
    blocks["address"] = packets["address"][packet] + offset.astype(np.uint64)
    blocks["count"] = held
    blocks["place"] = sums_before(present)[packet] + before

    arrays = new_event_arrays(int(present.sum()), device)
    surveys = wp.empty(blocks.size, dtype=Survey, device=device)
    earliest = wp.empty(blocks.size, dtype=wp.int64, device=device)
    launch(
        aedat4.unpack_events,
        blocks.size,
        [wp.array(blocks, dtype=aedat4.Block, device=device)],
        [arrays, surveys, earliest],
        device=device,
        smallest=1,
    )
    return PacketEvents(
        events=DeviceEvents(arrays.x, arrays.y, arrays.t, arrays.p),
        counts=counts,
        surveys=surveys.numpy(),
        earliest=earliest.numpy(),
    )
