"""Picture of the scene over a time window: a value, with the numbers that tell how good it is."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import warp as wp

from amiwarp.events.device_events import wait
from amiwarp.kernels import known_nodes as kernels
from amiwarp.schema.calls import guarded
from amiwarp.validation import real

ARRAYS = ("log", "known", "unknowns")
"""Names of the arrays of a picture."""


@guarded
@dataclass(frozen=True, eq=False)
class Picture:
    """Picture of the scene over a time window, without the prism.

    Its arrays are NumPy arrays, or Warp arrays on a device if the events are there (:class:`DeviceMemoryEvents`). Their
    values are not checked. PyTorch, CuPy and JAX read Warp arrays through DLPack without a copy.

    Examples
    --------
    >>> import numpy as np
    >>> picture = amiwarp.Picture(
    ...     log=np.array([[0.0, 2.0]], np.float32), known=np.array([[True, True]]), start_us=0, length_us=1000, pairs=2,
    ...     off_excess=0.0, smoothness=0.02, residual=0.1, hot=0, seconds=0.0, unknowns=np.zeros(2, np.float32))
    >>> picture.intensity(0.5).round(2)
    array([[1.  , 2.72]], dtype=float32)
    """

    log: Any
    """Log intensity in units of the ON threshold, median 0, float32, shape (height, width); NaN where it is not filled.

    Events determine it up to one constant per connected region of :attr:`known`; the fill joins the regions.
    """
    known: Any
    """Whether events determine the pixel, bool, shape (height, width)."""
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
    unknowns: Any
    """Solution of the whole map with its margin, flattened, followed by the sensor's unknowns, float32, shape (n,). The
    next window can start from it."""

    def __repr__(self) -> str:
        height, width = self.log.shape
        span = f"t {self.start_us} .. {self.start_us + self.length_us} us"
        return f"Picture({width}x{height} px, {span}, {self.pairs:,} pairs, residual {self.residual:.3g})"

    def to_host(self) -> Picture:
        """Return the picture in NumPy arrays: copies from a GPU, views on a CPU.

        Returns
        -------
        Picture
            The picture; this one if its arrays are NumPy arrays.
        """
        if not isinstance(self.log, wp.array):
            return self
        arrays = {name: getattr(self, name).numpy() for name in ARRAYS}
        return replace(self, **arrays)

    def intensity(self, contrast: float = 0.25) -> Any:
        """Return relative linear intensity, 1 at the median.

        Parameters
        ----------
        contrast : float, optional
            ON threshold [log intensity].

        Returns
        -------
        ndarray or warp.array
            Intensity, float32, shape ``(height, width)``; NaN where the picture is not filled. It is where the picture
            is.
        """
        contrast = real(contrast, "contrast", 0.0, 10.0)
        if isinstance(self.log, wp.array):
            out = wp.empty_like(self.log)
            wp.launch(
                kernels.exponentiate,
                out.shape,
                inputs=[self.log, contrast],
                outputs=[out],
                device=out.device,
            )
            wait(out.device)
            return out
        return np.exp(np.float32(contrast) * self.log)


def upload_picture(picture: Picture, device: Any) -> Picture:
    """Return the picture in Warp arrays on a device."""
    arrays = {name: wp.array(getattr(picture, name), device=device) for name in ARRAYS}
    found = replace(picture, **arrays)
    wait(found.log.device)
    return found
