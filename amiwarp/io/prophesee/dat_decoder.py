"""Decoder of the records of Prophesee's DAT, on a CPU or a GPU."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.io.decoding import records_per_thread, sums_before

if TYPE_CHECKING:
    from amiwarp.events.device_events import DeviceEvents
    from amiwarp.kernels.dat import Layout


class DatDecoder:
    """Decoder of the records of one file or stream, in pieces. Times run on where the stored 32 bits wrap."""

    def __init__(self, version: str, device: Any) -> None:
        import warp as wp

        self._device = wp.get_device(device)
        self._layout = _layout(version)
        self._last = -1
        """Time of the last record as stored [us]."""
        self._wraps = 0

    def decode(self, words: Any) -> DeviceEvents:
        """Return the events of the records that follow the last call's. ``words``: a Warp array of uint32."""
        import warp as wp

        from amiwarp.events.device_events import DeviceEvents
        from amiwarp.kernels.dat import decode_dat
        from amiwarp.kernels.event_arrays import new_event_arrays
        from amiwarp.kernels.launch import launch

        device = self._device
        count = words.shape[0] // 2
        length = records_per_thread(device)
        blocks = -(-count // length)
        arrays = new_event_arrays(count, device)
        wraps = wp.empty(blocks, dtype=int, device=device)

        def decode(turns: NDArray[np.int64]) -> NDArray[np.int64]:
            """Decode all blocks, before which the time has wrapped so often, and return how often it wraps in each."""
            turns_on_device = wp.array(turns, dtype=int, device=device)
            inputs = [words, length, self._layout, self._last, turns_on_device]
            launch(decode_dat, blocks, inputs, [arrays, wraps], device=device, smallest=1)
            return np.asarray(wraps.numpy().astype(np.int64))

        turns = np.full(blocks, self._wraps)
        wraps_in_block = decode(turns)
        # The blocks behind a wrap were wrong. This is rare, because the time wraps after 71 min.
        if wraps_in_block[:-1].any():
            decode(turns + sums_before(wraps_in_block))
        if count:
            self._wraps += int(wraps_in_block.sum())
            self._last = int(arrays.t[count - 1 :].numpy()[0]) % 2**32
        return DeviceEvents(arrays.x, arrays.y, arrays.t, arrays.p)


def _layout(version: str) -> Layout:
    """Return the bits of the second word, according to Prophesee's documentation of the format."""
    from amiwarp.kernels.dat import Layout

    layout = Layout()
    if version == "1":
        layout.x_mask = 0x1FF
        layout.y_mask = 0xFF
        layout.y_shift = 9
        layout.p_shift = 17
    else:
        layout.x_mask = 0x3FFF
        layout.y_mask = 0x3FFF
        layout.y_shift = 14
        layout.p_shift = 28
    return layout
