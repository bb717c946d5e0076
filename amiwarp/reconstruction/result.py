"""Reconstructed picture of a scene."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Picture:
    """Picture of the scene over a time window, without the prism.

    Examples
    --------
    >>> import numpy as np
    >>> picture = amiwarp.Picture(
    ...     log=np.array([[0.0, 2.0]], np.float32), known=np.array([[True, True]]), start_us=0, length_us=1000, pairs=2,
    ...     off_excess=0.0, smoothness=0.02, residual=0.1, hot=0, seconds=0.0, unknowns=np.zeros(2, np.float32))
    >>> picture.intensity(0.5).round(2)
    array([[1.  , 2.72]], dtype=float32)
    """

    log: NDArray[np.float32]
    """Log intensity in units of the ON threshold, median 0, shape (height, width); NaN where it is not filled.

    Events determine it up to one constant per connected region of :attr:`known`; the fill joins the regions.
    """
    known: NDArray[np.bool_]
    """Whether events determine the pixel, shape (height, width)."""
    start_us: int
    """Start of the time window [us]."""
    length_us: int
    """Length of the time window [us]."""
    pairs: int
    """Number of equations from pairs of two events."""
    off_excess: float
    """Assumed ratio of the OFF to the ON threshold, minus 1."""
    smoothness: float
    """Weight of the smoothness prior, chosen by equations that were held out of the fit."""
    residual: float
    """Median absolute residual of the equations [ON thresholds]. Near 1, the optical model or the motion is wrong."""
    hot: int
    """Number of hot pixels that were excluded."""
    seconds: float
    """Computing time of the picture [s]."""
    unknowns: NDArray[np.float32] = field(repr=False)
    """Solution of the whole map with its margin, flattened, followed by the sensor's unknowns, shape (n,). The next
    window can start from it."""

    def intensity(self, contrast: float = 0.25) -> NDArray[np.float32]:
        """Return relative linear intensity, 1 at the median.

        Parameters
        ----------
        contrast : float, optional
            ON threshold [log intensity].

        Returns
        -------
        ndarray
            Intensity, float32, shape ``(height, width)``; NaN where the picture is not filled.
        """
        return np.exp(np.float32(contrast) * self.log)
