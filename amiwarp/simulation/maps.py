"""What maps of pictures and maps of worlds share: their resolution, and device memory in slots."""

from typing import Any

import warp as wp


class MapSlots:
    """Arrays that are divided into slots for maps, and grow if all slots are taken.

    Slot k of an array begins at index ``k * texels``.
    """

    def __init__(self, texels: int, *dtypes: Any, device: Any) -> None:
        """Make one empty array of each type in ``dtypes``. A slot has ``texels`` elements."""
        self._texels = texels
        self._free = list[int]()
        self.arrays = [wp.empty(0, dtype=dtype, device=device) for dtype in dtypes]
        """Arrays of all slots. :meth:`take` replaces the arrays when they have to grow."""

    def take(self) -> int:
        """Return the number of a free slot. If no slot is free, double the number of slots."""
        if not self._free:
            held = len(self.arrays[0]) // self._texels
            slots = 2 * held or 1
            for k, array in enumerate(self.arrays):
                larger = wp.empty(slots * self._texels, dtype=array.dtype, device=array.device)
                wp.copy(larger, array, count=len(array))
                self.arrays[k] = larger
            self._free.extend(range(held, slots))
        return self._free.pop()

    def give_back(self, slot: int) -> None:
        """Make a slot available again."""
        self._free.append(slot)


TEXELS_PER_PIXEL = 1.75
"""Texels of a picture map per sensor pixel, along each axis."""
SMALLEST_COSINE = 0.25
"""Cosine of the largest angle between a line of sight and the axis of the picture.

The picture lies on a plane in front of the camera, so no picture exists beside or behind the camera.
"""
