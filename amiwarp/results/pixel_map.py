"""Maps of a sensor's pixels: their thresholds, and the hot and dead ones among them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.io.array_maps import ArrayMap
from amiwarp.optics.camera import LARGEST_SIZE
from amiwarp.schema.calls import guarded
from amiwarp.validation import array

THRESHOLDS = (0.1, 10.0)
"""Range of relative thresholds that a map may hold. Beyond it a pixel does not work."""
FASTEST_HZ = 1e6
"""Largest rate of a hot pixel [1/s]: events have times in microseconds."""
KINDS = {
    "on": "f",
    "off": "f",
    "on_std": "f",
    "off_std": "f",
    "on_pairs": "iu",
    "off_pairs": "iu",
    "hot_hz": "f",
    "dead": "b",
}
"""Arrays of a map and the kinds of their data types."""
RANGES = {
    "on": THRESHOLDS,
    "off": THRESHOLDS,
    "on_std": (0.0, 1e6),
    "off_std": (0.0, 1e6),
    "on_pairs": (0, 2**31 - 1),
    "off_pairs": (0, 2**31 - 1),
    "hot_hz": (0.0, FASTEST_HZ),
    "dead": (0, 1),
}
"""Smallest and largest value of each array."""
MAY_BE_NAN = ("on", "off", "on_std", "off_std")
"""Arrays in which NaN stands for an unknown value."""
TYPES = {"f": np.float32, "iu": np.int32, "b": np.bool_}


@guarded
@dataclass(frozen=True, eq=False)
class PixelMap(ArrayMap):
    """Thresholds of every pixel, and the hot and dead pixels of a sensor.

    Thresholds are relative to the median of their polarity: the events alone do not tell the contrast in the scene.
    Multiply them by the contrast threshold of the sensor, if it is known. All arrays have the shape (height, width).

    Raises
    ------
    AmiwarpError
        If the arrays have different shapes, or a value is out of range.

    Examples
    --------
    >>> import numpy as np
    >>> ones, none = np.ones((3, 4), np.float32), np.zeros((3, 4), np.float32)
    >>> pixels = amiwarp.PixelMap(ones, ones, none, none, none.astype(int), none.astype(int), none, none > 0)
    >>> pixels
    PixelMap(4 x 3 px, 12 with an ON threshold, 12 with an OFF threshold, 0 hot, 0 dead)
    """

    _WHAT = "pixel map"
    _COMMAND = "amiwarp pixels"
    _KINDS = KINDS
    on: NDArray[np.float32]
    """ON threshold, relative to the median of all pixels; NaN if it is not known."""
    off: NDArray[np.float32]
    """OFF threshold, relative to the median of all pixels; NaN if it is not known."""
    on_std: NDArray[np.float32]
    """Standard deviation of :attr:`on`; NaN if it is not known."""
    off_std: NDArray[np.float32]
    """Standard deviation of :attr:`off`; NaN if it is not known."""
    on_pairs: NDArray[np.int32]
    """Number of pairs of events from which the ON threshold comes."""
    off_pairs: NDArray[np.int32]
    """Number of pairs of events from which the OFF threshold comes."""
    hot_hz: NDArray[np.float32]
    """Rate of the random events of a hot pixel [1/s], 0 for all others."""
    dead: NDArray[np.bool_]
    """Whether a pixel is dead: it never fires, where a working one would."""

    def __post_init__(self) -> None:
        for name, kinds in KINDS.items():
            values = array(getattr(self, name), f"pixel map's {name}", "iufb")
            if values.ndim != 2 or not all(1 <= n <= LARGEST_SIZE for n in values.shape):
                raise AmiwarpError(
                    f"pixel map's {name} has shape {values.shape}; expected (height, width)"
                )
            if values.shape != np.shape(self.on):
                given = f"shape {values.shape}, on {np.shape(self.on)}"
                raise AmiwarpError(f"pixel map's {name} has {given}; give arrays of one shape")
            low, high = RANGES[name]
            wrong = ~((values >= low) & (values <= high))
            if name in MAY_BE_NAN:
                wrong &= ~np.isnan(values)
            if wrong.any():
                given = f"{values[wrong][0]:g}"
                raise AmiwarpError(
                    f"pixel map's {name} holds {given}; expected {low:g} .. {high:g}"
                )
            object.__setattr__(self, name, values.astype(TYPES[kinds], copy=False))

    def __repr__(self) -> str:
        return f"PixelMap({self.size[0]} x {self.size[1]} px, {self})"

    def __str__(self) -> str:
        """Return, for example, ``9216 with an ON threshold, 9180 with an OFF threshold, 10 hot, 2 dead``."""
        known = [int(np.isfinite(values).sum()) for values in (self.on, self.off)]
        thresholds = f"{known[0]} with an ON threshold, {known[1]} with an OFF threshold"
        return f"{thresholds}, {int(self.hot.sum())} hot, {int(self.dead.sum())} dead"

    @property
    def size(self) -> tuple[int, int]:
        """Width and height [px]."""
        height, width = self.on.shape
        return width, height

    @property
    def hot(self) -> NDArray[np.bool_]:
        """Whether a pixel is hot: it fires at random, shape (height, width)."""
        return self.hot_hz > 0.0
