"""Tiles: the rectangular parts of a brightness map."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class Tiles:
    """Rectangular parts of the map, all of the same size, with nodes ``1 / density`` px apart."""

    origin: NDArray[np.float32]
    """Pixel coordinates (x, y) of each tile's first node [px], shape (tiles, 2)."""
    rows: int
    """Number of rows of nodes per tile."""
    columns: int
    """Number of columns of nodes per tile."""
    density: float = 2.0
    """Map nodes per pixel along each axis."""

    @property
    def nodes(self) -> int:
        """Total number of map nodes."""
        return len(self.origin) * self.rows * self.columns

    def at_density(self, density: float) -> Tiles:
        """Return tiles of the same place and size with another number of nodes per pixel along each axis."""
        rows = math.ceil((self.rows - 1) * density / self.density) + 1
        columns = math.ceil((self.columns - 1) * density / self.density) + 1
        return replace(self, rows=rows, columns=columns, density=density)
