"""Decoder of Prophesee's EVT words, for files and streams that arrive in pieces, on a CPU or a GPU."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import warp as wp

WORD_TYPES = {"2.0": "<u4", "2.1": "<u8", "3.0": "<u2"}
"""Type of a word by the version of EVT."""
BLOCK_WORDS = {True: 1 << 14, False: 1 << 12}
"""Number of words that one thread decodes, on a CPU (True) and on CUDA (False)."""
GROUP_BLOCKS = 256
"""Number of blocks that one thread links."""


class Triggers(NamedTuple):
    """Edges of external triggers, arrays of shape ``(n,)``."""

    channel: NDArray[np.uint8]
    """Number of the input."""
    t: NDArray[np.int64]
    """Time [us]."""
    rising: NDArray[np.uint8]
    """1 for a rising edge, 0 for a falling one."""


class EventColumns(NamedTuple):
    """Events, arrays of shape ``(n,)``."""

    x: NDArray[np.uint16]
    """Column [px]."""
    y: NDArray[np.uint16]
    """Row [px]."""
    t: NDArray[np.int64]
    """Time [us]."""
    p: NDArray[np.uint8]
    """Polarity: 1 is ON, 0 is OFF."""


@dataclass
class EvtDecoder:
    """Decoder of the words of one stream, in their order."""

    version: str
    """Version of EVT: "2.0", "2.1" or "3.0"."""
    swapped: bool = False
    """Whether the 32-bit halves of EVT 2.1 words are swapped, as the IMX636 sends them (``endianness=legacy``)."""
    device: Any = "cpu"
    """Warp device that decodes."""
    untimed: int = 0
    """Number of events and edges so far that came before the first time word. They have no time and are dropped."""
    _state: "wp.array | None" = None
    """State after the last word, on the device."""

    def decode(self, words: NDArray[Any]) -> tuple[EventColumns, Triggers]:
        """Return the events and the triggers of the words that follow those of the last call, shape ``(n,)``."""
        events, triggers = self.decode_on_device(words)
        columns = EventColumns(*(getattr(events, name).numpy() for name in EventColumns._fields))
        edges = Triggers(*(getattr(triggers, name).numpy() for name in Triggers._fields))
        return columns, edges

    def decode_on_device(self, words: Any) -> tuple[Any, Any]:
        """Return events and triggers on the device: ``EventArrays`` and ``TriggerArrays`` of the kernels.

        ``words``: array of NumPy or Warp. An array on the device is not copied.
        """
        import warp as wp

        from amiwarp.kernels import evt
        from amiwarp.kernels.launch import launch, load, start_once

        start_once()

        device = wp.get_device(self.device)
        if isinstance(words, np.ndarray):
            given = np.ascontiguousarray(words, WORD_TYPES[self.version])
            words = wp.array(given, dtype=wp.dtype_from_numpy(given.dtype), device=device, copy=not device.is_cpu)
        length = BLOCK_WORDS[device.is_cpu]
        blocks = -(-words.shape[0] // length)
        if self.version == "3.0":
            survey, decode = evt.survey_evt3, evt.decode_evt3
            layout = [words, length]
            bits = 12
        else:
            survey, decode = evt.survey_evt2, evt.decode_evt2
            layout = [words, length, int(self.swapped)]
            bits = 28

        # First pass: what each block changes, then the state at its start and the place of its first event.
        changes = wp.empty(blocks, dtype=evt.Change, device=device)
        launch(survey, blocks, layout, [changes], device=device, smallest=1)
        groups = -(-blocks // GROUP_BLOCKS)
        group_changes = wp.empty(groups, dtype=evt.Change, device=device)
        launch(evt.merge_blocks, groups, [changes, GROUP_BLOCKS, bits], [group_changes], device=device, smallest=1)
        group_states = wp.zeros(groups + 1, dtype=evt.State, device=device)
        if self._state is not None:
            wp.copy(group_states, self._state, count=1)
        group_places = wp.empty(groups + 1, dtype=evt.Place, device=device)
        load(evt.link_groups, device)
        wp.launch(evt.link_groups, 1, [group_changes, bits], [group_states, group_places], device=device)
        states = wp.empty(blocks, dtype=evt.State, device=device)
        places = wp.empty(blocks, dtype=evt.Place, device=device)
        inputs = [changes, GROUP_BLOCKS, bits, group_states, group_places]
        launch(evt.link_blocks, groups, inputs, [states, places], device=device, smallest=1)

        # Second pass: the events.
        total = group_places[groups:].numpy()[0]
        events, edges = int(total["event"]), int(total["trigger"])
        self.untimed += int(total["untimed"])
        event_arrays = evt.EventArrays()
        event_arrays.x = wp.empty(events, dtype=wp.uint16, device=device)
        event_arrays.y = wp.empty(events, dtype=wp.uint16, device=device)
        event_arrays.t = wp.empty(events, dtype=wp.int64, device=device)
        event_arrays.p = wp.empty(events, dtype=wp.uint8, device=device)
        trigger_arrays = evt.TriggerArrays()
        trigger_arrays.channel = wp.empty(edges, dtype=wp.uint8, device=device)
        trigger_arrays.t = wp.empty(edges, dtype=wp.int64, device=device)
        trigger_arrays.rising = wp.empty(edges, dtype=wp.uint8, device=device)
        inputs = [*layout, states, places]
        launch(decode, blocks, inputs, [event_arrays, trigger_arrays], device=device, smallest=1)
        self._state = wp.clone(group_states[groups:])
        return event_arrays, trigger_arrays
