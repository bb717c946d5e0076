"""Base class of pictures that note which of their pixels are known."""

import numpy as np
from numpy.typing import NDArray


class KnownPictures:
    """Pictures that note which of their pixels are known while they are read (base class)."""

    def __init__(self) -> None:
        self._known: list[tuple[int, NDArray[np.bool_]]] = []

    def take_known(self) -> list[tuple[int, NDArray[np.bool_]]]:
        """Return, and forget, the masks of known pixels of the pictures read so far, with their times."""
        taken = self._known
        self._known = []
        return taken
