"""Device memory of the maps that a simulation looks up."""

from __future__ import annotations

from typing import Any

import warp as wp


class MapSlots:
    """Slots for maps in arrays that grow: slot k of an array begins at index ``k * texels``."""

    def __init__(self, texels: int, *dtypes: Any, device: Any) -> None:
        """``dtypes``: one array of each type, with ``texels`` elements per map."""
        self._texels, self._free = texels, list[int]()
        self.arrays = [wp.empty(0, dtype=dtype, device=device) for dtype in dtypes]
        """The arrays; others after :meth:`take` when they have grown."""

    def take(self) -> int:
        """Return a free slot; double their number if there is none."""
        if not self._free:
            held = len(self.arrays[0]) // self._texels
            slots = 2 * held or 1
            for k, array in enumerate(self.arrays):
                self.arrays[k] = wp.empty(slots * self._texels, dtype=array.dtype, device=array.device)
                wp.copy(self.arrays[k], array, count=len(array))
            self._free.extend(range(held, slots))
        return self._free.pop()

    def give_back(self, slot: int) -> None:
        """Make a slot free again."""
        self._free.append(slot)
