"""Decoder of the bytes of event files, for bytes that are in memory, on a CPU or a GPU."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.io.aedat import aedat3, aedat4_events
from amiwarp.io.aedat.aedat2_decoder import Aedat2Decoder
from amiwarp.io.aedat.aedat2_header import CHIPS
from amiwarp.io.decoding import words_on
from amiwarp.io.prophesee.dat_decoder import DatDecoder
from amiwarp.schema.calls import guarded
from amiwarp.validation import instance, one_of

if TYPE_CHECKING:
    from amiwarp.events.device_events import DeviceEvents

FORMATS = ("dat1", "dat2", "aedat2", "aedat3", "aedat4")
"""Formats whose bytes are decoded."""
RECORD_BYTES = 8
"""Size of a record of DAT and AEDAT 2.0."""
MOST_PACKETS = 1 << 12
"""Number of packets for which there is room at first."""


@guarded
class BytesDecoder:
    """Decoder of the events in the bytes of DAT and AEDAT files, in pieces, on a CPU or a GPU.

    Bytes on a GPU give events there; no event is decoded on the host. Words of EVT are decoded by
    :class:`amiwarp.EvtDecoder`, and files are read by :func:`amiwarp.open_recording`, which also checks, repairs and
    counts.

    Parameters
    ----------
    format : {"dat1", "dat2", "aedat2", "aedat3", "aedat4"}
        Format of the bytes, see :meth:`decode`.
    chip : str, optional
        Camera of AEDAT 2.0, as ``open_recording`` takes it: "dvs128", "davis128", "davis208", "davis240", "davis346",
        "davis640" or "tmpdiff128". Other formats need none.
    device : str or warp.Device, optional
        Device to decode on, by default the CPU.

    Raises
    ------
    AmiwarpError
        If an argument is not usable.

    Examples
    --------
    >>> import numpy as np
    >>> decoder = amiwarp.BytesDecoder("dat2")
    >>> records = np.array([[1000, 5 | 7 << 14 | 1 << 28]], np.uint32)  # a time; column, row and polarity
    >>> events = decoder.decode(records.tobytes())
    >>> events.x.numpy().tolist(), events.y.numpy().tolist(), events.t.numpy().tolist()
    ([5], [7], [1000])
    """

    def __init__(self, format: str, *, chip: str | None = None, device: Any = None) -> None:
        import warp as wp

        from amiwarp.kernels.quiet_start import start_once

        start_once()
        self._format = one_of(format, FORMATS, "format of the bytes")
        self._device = wp.get_device("cpu" if device is None else device)
        if self._format == "aedat2" and chip is None:
            raise AmiwarpError(
                f"format aedat2 needs a chip; give one of {', '.join(CHIPS)}", ErrorCode.OPTIONS
            )
        if self._format != "aedat2" and chip is not None:
            raise AmiwarpError(
                f"format {self._format} needs no chip; leave it out", ErrorCode.OPTIONS
            )
        self._dat: DatDecoder | None = None
        self._aedat2: Aedat2Decoder | None = None
        if self._format in ("dat1", "dat2"):
            self._dat = DatDecoder(self._format[-1], self._device)
        elif chip is not None:
            name = one_of(instance(chip, str, "chip").lower(), CHIPS, "chip")
            self._aedat2 = Aedat2Decoder(CHIPS[name], self._device)
        self._source: int | None = None

    def decode(self, data: Any) -> DeviceEvents:
        """Return the events in the bytes that follow the bytes of the last call.

        Parameters
        ----------
        data : bytes or array
            What follows the header of a file. DAT (versions 1 and 2) and AEDAT 2.0: whole records of 8 bytes.
            AEDAT 3.1: whole packets with their headers. AEDAT 4: whole packets of one stream of events, without their
            headers of 8 bytes, and without their compression. Bytes, or a contiguous array of bytes of NumPy, Warp,
            PyTorch, CuPy, JAX or any other library with DLPack, shape (n,). An array on the decoder's device is not
            copied, unless it begins within a word.

        Returns
        -------
        events : DeviceEvents
            The events on the decoder's device, in the order of the bytes. Times [us] are as in the file, but times of
            DAT and AEDAT 2.0 run on where their 32 bits wrap. Neither order nor places are checked: a pixel outside the
            frame is a large number. Of AEDAT 3.1, the events of the first source are returned, without invalid ones.
            Edges, frames and samples are left out.

        Raises
        ------
        AmiwarpError
            If the data have another type, do not end with a whole record, or hold a packet that is damaged or cut off.
        """
        if self._format in ("aedat3", "aedat4"):
            packets = words_on(
                self._device,
                data,
                word=np.dtype("<u1"),
                what="packets",
                version=self._format,
                record=1,
            )
            if self._format == "aedat3":
                return self._decode_aedat3(packets)
            return self._decode_aedat4(packets)
        records = words_on(
            self._device,
            data,
            word=np.dtype("<u4"),
            what="records",
            version=self._format,
            record=RECORD_BYTES,
        )
        if self._dat is not None:
            return self._dat.decode(records)
        assert self._aedat2 is not None
        events, _ = self._aedat2.decode(records)
        return events

    def _decode_aedat3(self, data: Any) -> DeviceEvents:
        """Return the events of packets of AEDAT 3.1."""
        from amiwarp.kernels import aedat3 as kernels

        packets = self._listed(data, kernels.list_packets, kernels.Packet)
        packets = packets[packets["kind"] == aedat3.POLARITY]
        if self._source is None and packets.size:
            self._source = int(packets["source"][0])
        packets = packets[packets["source"] == self._source]
        first_address = np.uint64(data.ptr or 0)
        addresses = first_address + packets["start"].astype(np.uint64)
        counts = packets["events"].astype(np.int64)
        # The stored times have 31 bits. A packet says how often they have wrapped.
        wrapped_us = packets["overflow"].astype(np.int64) << 31
        return aedat3.decode_packets(addresses, counts, wrapped_us, self._device)

    def _decode_aedat4(self, data: Any) -> DeviceEvents:
        """Return the events of packets of AEDAT 4."""
        from amiwarp.kernels import aedat4 as kernels
        from amiwarp.kernels.raw_numbers import Span

        packets = self._listed(data, kernels.list_packets, Span)
        decoded = aedat4_events.decode_packets(packets, self._device)
        damaged = np.flatnonzero(decoded.counts < 0)
        if damaged.size:
            address = packets["address"][damaged[0]]
            raise self._damaged(int(address) - int(data.ptr))
        return decoded.events

    def _listed(self, data: Any, kernel: Any, kind: Any) -> NDArray[Any]:
        """Return the packets in some bytes, as a kernel lists them."""
        import warp as wp

        from amiwarp.kernels.loading import load

        load(kernel, self._device)
        capacity = MOST_PACKETS
        while True:
            packets = wp.empty(capacity, dtype=kind, device=self._device)
            result = wp.empty(2, dtype=int, device=self._device)
            wp.launch(kernel, 1, [data, capacity], [packets, result], device=self._device)
            count, wrong = result.numpy().tolist()
            if wrong >= 0:
                raise self._damaged(wrong)
            if count <= capacity:
                return np.asarray(packets.numpy()[:count])
            capacity = count

    def _damaged(self, offset: int) -> AmiwarpError:
        """Return the error to raise for a packet at a position."""
        return AmiwarpError(
            f"byte {offset} of the data does not begin a whole packet of {self._format}; give whole packets, "
            "and leave out "
            "damaged ones"
        )
