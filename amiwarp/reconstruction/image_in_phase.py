"""What sums in phase tell of each pixel: picture, edges, thresholds, and what no still scene explains."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from amiwarp.imaging.phase import PhaseSums
from amiwarp.io.output_formats import check_ending
from amiwarp.io.outputs import NewFile
from amiwarp.kernels.phase_misfit import AROUND
from amiwarp.optics.models.base import Model
from amiwarp.reconstruction.picture_in_phase import scene_of_sums
from amiwarp.schema.calls import guarded

FEWEST_EVENTS = 20
"""Fewest events in the square around a pixel: with fewer its misfit is unknown."""


@guarded
@dataclass(frozen=True, eq=False)
class PhaseImage:
    """What one or more whole turns tell of each pixel; made by :func:`phase_image`."""

    log: NDArray[np.float32]
    """Log intensity of the scene [ON thresholds], median 0, shape (height, width)."""
    gradient: NDArray[np.float32]
    """Gradient of the log intensity along x and y [ON thresholds/px], smoothed by the orbit, shape (2, height, width).
    Of motions that are no orbit, the gradient of the picture. An edge is perpendicular to it."""
    threshold_ratio: NDArray[np.float32]
    """OFF threshold divided by the ON threshold, shape (height, width); NaN without OFF events."""
    misfit: NDArray[np.float32]
    """Share of the brightness over a turn that neither a still scene nor noise explains, 0 to 1, over the pixels
    around, shape (height, width): what moved. NaN if there are hardly any events."""
    events: NDArray[np.int32]
    """Number of events, shape (height, width)."""
    turns: float
    """Number of turns."""
    lag: float = 0.0
    """Angle of the sums by which the optic has moved on before an event is seen [rad]."""
    flicker: NDArray[np.float32] | None = None
    """Amplitude of the brightness at the frequency of a lamp [ON thresholds], shape (height, width), if it was asked
    for."""

    def save(self, path: Path, *, overwrite: bool = False) -> None:
        """Write the arrays to a NumPy archive (.npz).

        Parameters
        ----------
        path : Path
            File to write.
        overwrite : bool, default False
            Replace an existing file.

        Raises
        ------
        AmiwarpError
            If the ending is another one, or the file exists.
        """
        check_ending(path, "images in phase are written", [".npz"])
        arrays: dict[str, Any] = {
            "log": self.log,
            "gradient": self.gradient,
            "threshold_ratio": self.threshold_ratio,
            "misfit": self.misfit,
            "events": self.events,
            "turns": np.float64(self.turns),
            "lag": np.float64(self.lag),
        }
        if self.flicker is not None:
            arrays["flicker"] = self.flicker
        with NewFile(path, overwrite=overwrite) as new, new.part.open("wb") as file:
            np.savez_compressed(file, **arrays)


@guarded
def phase_image(sums: PhaseSums, model: Model) -> PhaseImage:
    """Return what sums in phase tell of each pixel.

    Parameters
    ----------
    sums : PhaseSums
        Sums of whole turns in phase with the angle of the optic.
    model : Model
        Optical model of the same image size, as in :func:`phase_picture`.

    Returns
    -------
    PhaseImage
        Picture, gradient, thresholds and misfit.

    Raises
    ------
    AmiwarpError
        As :func:`phase_picture`.

    Examples
    --------
    >>> camera, prism = amiwarp.Camera.from_fov(32, 24, 1.0), amiwarp.Prism(0.03)
    >>> events = amiwarp.Events.from_arrays([5], [5], [0], [1])
    >>> sums = amiwarp.phase_sums(events, amiwarp.Encoder.constant_speed(720.0, 0, 1000), 32, 24)
    >>> amiwarp.phase_image(sums, amiwarp.ExactModel.from_prism(camera, prism, 0.0)).gradient.shape
    (2, 24, 32)
    """
    scene = scene_of_sums(sums, model, None, with_rest=True)
    assert scene.rest is not None
    return PhaseImage(
        log=scene.log,
        gradient=scene.gradient,
        threshold_ratio=sums.threshold_ratio,
        misfit=_misfit(sums, scene.rest),
        events=sums.on + sums.off,
        turns=sums.turns,
        lag=scene.lag,
    )


def _misfit(sums: PhaseSums, rest: NDArray[np.complex64]) -> NDArray[np.float32]:
    """Return the share of the squared sums around each pixel that neither the scene nor noise explains."""
    random = sums.harmonics * sums.random_square
    left = mean_around((np.abs(rest) ** 2).sum(axis=0) - random)
    whole = mean_around((np.abs(sums.values) ** 2).sum(axis=0))
    counts = mean_around((sums.on + sums.off).astype(np.float32))
    share = np.full(left.shape, np.nan, np.float32)
    enough = (counts * AROUND**2 >= FEWEST_EVENTS) & (whole > 0.0)
    np.divide(left, whole, out=share, where=enough)
    return np.clip(share, 0.0, 1.0)


def mean_around(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the mean of the values around each pixel."""
    return np.asarray(ndimage.uniform_filter(values, AROUND, mode="nearest"), np.float32)
