"""Decoder of Prophesee's EVT words, for files and streams that arrive in pieces, on a CPU or a GPU."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.io.decoding import words_on
from amiwarp.schema.calls import guarded
from amiwarp.validation import one_of

if TYPE_CHECKING:
    from amiwarp.events.device_events import DeviceEvents

WORD_TYPES = {"2.0": "<u4", "2.1": "<u8", "3.0": "<u2"}
"""Type of a word by the version of EVT."""

CPU_WORDS = 1 << 14
"""Number of words that one thread decodes on a CPU."""

CUDA_WORDS = 1 << 12
"""Number of words that one thread decodes on CUDA."""

GROUP_BLOCKS = 256
"""Number of blocks that one thread links."""


@dataclass(frozen=True, slots=True, eq=False)
class Triggers:
    """Edges of external triggers."""

    channel: NDArray[np.uint8]
    """Number of the input, shape ``(n,)``."""
    t: NDArray[np.int64]
    """Time [us], shape ``(n,)``."""
    rising: NDArray[np.uint8]
    """1 for a rising edge, 0 for a falling one, shape ``(n,)``."""


@guarded
class EvtDecoder:
    """Decoder of the words of one stream in Prophesee's EVT 2.0, 2.1 or 3.0, in pieces, on a CPU or a GPU.

    Words on a GPU give events there; nothing is decoded on the host. Files are read by :func:`amiwarp.open_recording`.

    Parameters
    ----------
    version : {"2.0", "2.1", "3.0"}
        Version of EVT.
    swapped : bool, default False
        Whether the 32-bit halves of EVT 2.1 words are swapped, as the IMX636 sends them (``endianness=legacy``).
    device : str or warp.Device, optional
        Device to decode on, by default the CPU.

    Raises
    ------
    AmiwarpError
        If the version is unknown, or ``swapped`` is set for another version than 2.1.

    Notes
    -----
    The words are described at https://docs.prophesee.ai/stable/data/encoding_formats/index.html.

    Examples
    --------
    >>> import numpy as np
    >>> decoder = amiwarp.EvtDecoder("3.0")
    >>> words = np.array([0x8001, 0x6002, 0x0007, 0x2805], np.uint16)  # two of the time, a row, an event
    >>> events, triggers = decoder.decode(words)
    >>> events.x.numpy().tolist(), events.y.numpy().tolist(), events.t.numpy().tolist()
    ([5], [7], [4098])
    """

    def __init__(self, version: str, *, swapped: bool = False, device: Any = None) -> None:
        import warp as wp

        from amiwarp.kernels.quiet_start import start_once

        start_once()
        self._version = one_of(version, WORD_TYPES, "version of EVT")
        if swapped and self._version != "2.1":
            raise AmiwarpError(
                f"swapped is {swapped} for EVT {self._version}, but only words of EVT 2.1 have halves to swap; leave "
                "swapped out"
            )
        self._swapped = swapped
        self._device = wp.get_device("cpu" if device is None else device)
        self._state: wp.array | None = None
        self._untimed = 0
        self._unknown = 0

    @property
    def untimed(self) -> int:
        """Number of events and edges so far that came before the first time word. They have no time and are dropped."""
        return self._untimed

    @property
    def unknown(self) -> int:
        """Number of words so far whose type the format does not define, as of damaged data. They are passed over."""
        return self._unknown

    def decode(self, data: Any) -> tuple[DeviceEvents, Triggers]:
        """Return the events and the edges of the words that follow the words of the last call.

        Parameters
        ----------
        data : bytes or array
            Whole words, little-endian: bytes, or a contiguous array of NumPy, Warp, PyTorch, CuPy, JAX or any other
            library with DLPack, of bytes or of integers of a word's size, shape (n,). An array on the decoder's device
            is not copied, unless it begins within a word.

        Returns
        -------
        events : DeviceEvents
            The events on the decoder's device, in the order of the words. Times [us] are the sensor's, without wraps;
            they are not checked, and a camera may send a few that step back.
        triggers : Triggers
            The edges of external triggers, in host memory.

        Raises
        ------
        AmiwarpError
            If the data does not end with a whole word or has another type.
        """
        import warp as wp

        from amiwarp.events.device_events import DeviceEvents
        from amiwarp.kernels import evt, evt2, evt3
        from amiwarp.kernels.event_arrays import new_event_arrays
        from amiwarp.kernels.launch import launch

        device = self._device
        word = np.dtype(WORD_TYPES[self._version])
        words = words_on(
            device,
            data,
            word=word,
            what="EVT words",
            version=f"EVT {self._version}",
            record=word.itemsize,
        )
        block_words = CPU_WORDS if device.is_cpu else CUDA_WORDS
        blocks = math.ceil(words.shape[0] / block_words)
        inputs_of_words = [words, block_words]
        if self._version == "3.0":
            survey = evt3.survey_evt3
            decode = evt3.decode_evt3
            clock_bits = 12
        else:
            survey = evt2.survey_evt2
            decode = evt2.decode_evt2
            inputs_of_words.append(int(self._swapped))
            clock_bits = 28

        # First pass: what each block changes. So its state at the start and the place of its first event are known.
        changes = wp.empty(blocks, dtype=evt.Change, device=device)
        launch(survey, blocks, inputs_of_words, [changes], device=device, smallest=1)
        links = self._link(changes, clock_bits)
        self._untimed += int(links.totals["untimed"])
        self._unknown += int(links.totals["unknown"])

        # Second pass: the events.
        events = new_event_arrays(int(links.totals["event"]), device)
        edges = self._new_edges(int(links.totals["trigger"]))
        inputs = [*inputs_of_words, links.states, links.places]
        launch(decode, blocks, inputs, [events, edges], device=device, smallest=1)
        self._state = wp.clone(links.end)  # the view would keep the states of all groups in memory
        triggers = Triggers(
            channel=edges.channel.numpy(), t=edges.t.numpy(), rising=edges.rising.numpy()
        )
        return DeviceEvents(events.x, events.y, events.t, events.p), triggers

    def _new_edges(self, count: int) -> Any:
        """Return arrays for the edges of external triggers on the device."""
        import warp as wp

        from amiwarp.kernels import evt

        edges = evt.TriggerArrays()
        edges.channel = wp.empty(count, dtype=wp.uint8, device=self._device)
        edges.t = wp.empty(count, dtype=wp.int64, device=self._device)
        edges.rising = wp.empty(count, dtype=wp.uint8, device=self._device)
        return edges

    def _link(self, changes: Any, clock_bits: int) -> _Links:
        """Link blocks of words, in groups, so that many threads work.

        ``changes``: what each block changes, as a Warp array; ``clock_bits``: number of bits of a time word.
        """
        import warp as wp

        from amiwarp.kernels import evt
        from amiwarp.kernels.launch import launch
        from amiwarp.kernels.loading import load

        device = self._device
        blocks = changes.shape[0]
        groups = math.ceil(blocks / GROUP_BLOCKS)
        group_changes = wp.empty(groups, dtype=evt.Change, device=device)
        inputs = [changes, GROUP_BLOCKS, clock_bits]
        launch(evt.merge_blocks, groups, inputs, [group_changes], device=device, smallest=1)

        group_states = wp.zeros(groups + 1, dtype=evt.State, device=device)
        if self._state is not None:
            wp.copy(group_states, self._state, count=1)
        group_places = wp.empty(groups + 1, dtype=evt.Place, device=device)
        load(evt.link_groups, device)
        outputs = [group_states, group_places]
        wp.launch(evt.link_groups, 1, [group_changes, clock_bits], outputs, device=device)

        states = wp.empty(blocks, dtype=evt.State, device=device)
        places = wp.empty(blocks, dtype=evt.Place, device=device)
        inputs = [changes, GROUP_BLOCKS, clock_bits, group_states, group_places]
        launch(evt.link_blocks, groups, inputs, [states, places], device=device, smallest=1)
        totals = group_places[groups:].numpy()[0]
        return _Links(states, places, group_states[groups:], totals)


class _Links(NamedTuple):
    """What the words of blocks mean for the blocks after them, as Warp arrays."""

    states: Any
    """State at the start of each block."""
    places: Any
    """Numbers of the first event and edge of each block."""
    end: Any
    """State after the last block, one element."""
    totals: Any
    """Numbers of events, of edges, and of words that were dropped or passed over, as a NumPy record."""
