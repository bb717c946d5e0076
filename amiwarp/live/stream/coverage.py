"""Coverage of a window of events: the share of the scene's edges that it shows.

A window shows an edge only if the image moves across it, by the prism or by the camera's own motion.
:class:`CoverageMeter` estimates both motions, and the amounts of edges in each direction.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.encoder import Encoder
from amiwarp.events.recording import Events

if TYPE_CHECKING:
    from amiwarp.optics.models.base import Model


DIRECTIONS = 18
"""Number of bins of edge directions over 180 degrees."""
_BINS = (np.arange(DIRECTIONS) + 0.5) * (math.pi / DIRECTIONS)
NORMALS = np.stack([np.cos(_BINS), np.sin(_BINS)])
"""Unit vectors across the edges of each direction bin, shape (2, DIRECTIONS)."""
SEEN_TRAVEL = 0.25
"""Scale of the distance that an edge must move across itself to be seen [px].

An edge that moves by s is seen with probability 1 - exp(-s / SEEN_TRAVEL), as found in simulations.
"""
TEXTURE_TRAVEL = 1.0
"""Distance that edges of a direction must move across themselves in a window before it updates the amount of such edges
[px]."""
PATCH_SIDE = 192
"""Side of the central image patch that is analysed [px]."""
BLOCK = 4
"""Side of the square blocks of pixels in each of which one edge direction is found [px]."""
SLICE_US = 4_000
"""Duration of the slice of events at a window's end [us].

It is short enough to avoid motion blur by the camera, and long enough for two slices to be similar.
"""
SLICE_GAP_US = 100_000
"""Longest time between two slices whose shift is measured [us]."""
SLICE_EVENTS = 1 << 14
WINDOW_EVENTS = 1 << 15
"""Largest number of events of a slice and of a window that are used. Events above these numbers are thinned evenly."""
CLEAR_STD = 8.0
"""Height of the correlation peak of two slices below which the camera is considered still [standard deviations]."""
TEXTURE_S = 0.5
"""Time constant with which the amounts of edges in each direction are averaged [s]."""
ANGLES = 17
"""Number of points of the prism's path that are computed per window."""
PHASES = 8
ORBIT = 1024
"""Number of prism phases for which a window is predicted, and number of points that sample the prism's orbit."""


def prism_path(model: Model, encoder: Encoder, start_us: int, end_us: int) -> NDArray[np.float64]:
    """Return where the prism moves the image centre, at regular times of a window, shape (m, 2) [px].

    Both ends are included. Raises :class:`AmiwarpError` if the encoder does not cover the window, or if the image
    centre has no ray.
    """
    times = np.rint(np.linspace(start_us, end_us, ANGLES)).astype(np.int64)
    return _middle(model, np.asarray(encoder.angle_at(times), np.float64))


def prism_orbit(model: Model) -> NDArray[np.float64]:
    """Return where the prism moves the image centre, at regular angles of a turn, shape (n, 2) [px].

    Raises :class:`AmiwarpError` if the image centre has no ray.
    """
    return _middle(model, np.linspace(0.0, math.tau, ORBIT, endpoint=False))


def _middle(model: Model, angles: NDArray[np.float64]) -> NDArray[np.float64]:
    middle = np.array([[0.5 * (model.camera.width - 1), 0.5 * (model.camera.height - 1)]])
    path = model.deflect_points(np.repeat(middle, len(angles), axis=0), angles)
    if not np.isfinite(path).all():
        raise AmiwarpError(
            "the image centre has no ray through the prism at some angle; check the model"
        )
    return np.asarray(path, np.float64)


def _drift_path(
    drift: NDArray[np.float64], drift_change: NDArray[np.float64], seconds: float
) -> NDArray[np.float64]:
    """Return the image's displacement over a window by a linearly changing drift, shape (ANGLES, 2) [px]."""
    along = np.linspace(0.0, 1.0, ANGLES)[:, None]
    return np.asarray(seconds * (along * drift + 0.5 * (along * along - along) * drift_change))


def seen_share(travel: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the share of edges that are seen after a displacement across themselves [px]."""
    return np.asarray(-np.expm1(-travel / SEEN_TRAVEL))


@dataclass(frozen=True, slots=True, eq=False)
class Coverage:
    """Estimated coverage of one window of events: the share of the scene's edges that cause events in it.

    An edge causes events only if it moves across itself. The other fields are the estimates behind that share.
    """

    share: float
    """Share of the scene's edges that the window shows, 0 .. 1."""
    drift: NDArray[np.float64]
    """Image velocity caused by the camera's motion alone, shape (2,) [px/s]; 0 if there is no clear estimate."""
    drift_change: NDArray[np.float64]
    """Change of the drift over the window, shape (2,) [px/s]; 0 if unknown."""
    travel: NDArray[np.float64]
    """Displacement of edges across themselves during the window, for each edge direction, shape (n,) [px]."""
    texture: NDArray[np.float64]
    """Share of the scene's recent edges in each direction, shape (n,), sum 1; all equal if there are no edges."""

    def predict(
        self, rpm: NDArray[np.float64], orbit: NDArray[np.float64], seconds: float
    ) -> NDArray[np.float64]:
        """Return the coverage that a window would have at other prism speeds, for the worst prism phase, shape (n,).

        ``rpm``: speeds [turns/min], shape (n,). ``orbit``: see :func:`prism_orbit`. ``seconds``: length of the window.
        """
        # Axes: speed, phase, time within the window.
        along = np.linspace(0.0, 1.0, ANGLES)
        phase = np.arange(PHASES)[:, None] / PHASES
        turns = (seconds / 60.0) * rpm[:, None, None] * along + phase
        place = np.rint(turns * len(orbit)).astype(np.int64) % len(orbit)
        path = orbit[place] + _drift_path(self.drift, self.drift_change, seconds)
        travel = np.ptp(path @ NORMALS, axis=2)
        return np.asarray((seen_share(travel) @ self.texture).min(axis=1))


class CoverageMeter:
    """Measures the coverage of consecutive windows of events."""

    def __init__(self, width: int, height: int) -> None:
        self._corner = np.array([(width - PATCH_SIDE) // 2, (height - PATCH_SIDE) // 2], np.float32)
        self._texture = np.full(DIRECTIONS, np.nan)
        self._end_us = -(1 << 62)
        self._last_drift: NDArray[np.float64] | None = None
        self._previous_slice: tuple[float, NDArray[np.complex64]] | None = None
        along = np.exp(-2.0 * (math.pi * np.fft.fftfreq(PATCH_SIDE)) ** 2).astype(np.float32)
        self._smooth = along[:, None] * along[None, : PATCH_SIDE // 2 + 1]

    def __call__(
        self, events: Events, start_us: int, end_us: int, path: NDArray[np.float64]
    ) -> Coverage:
        """Return the coverage of the next window.

        ``events``: compensated events from ``start_us`` to ``end_us`` [us], in order. ``path``: see
        :func:`prism_path`. Raises :class:`AmiwarpError` for empty windows, or windows out of order.
        """
        if not self._end_us <= start_us < end_us:
            given = f"window {start_us} .. {end_us} us after one that ended at {self._end_us} us"
            raise AmiwarpError(f"coverage: {given}; pass the windows of events in order of time")
        seconds = (end_us - start_us) * 1e-6
        follows = start_us - self._end_us < SLICE_US
        previous = self._last_drift
        found = self._drift(events, end_us)
        drift = np.zeros(2) if found is None else found
        drift_change = np.zeros(2)
        if follows and previous is not None and found is not None:
            drift_change = found - previous
        self._end_us = end_us
        self._last_drift = found

        across = (path + _drift_path(drift, drift_change, seconds)) @ NORMALS
        travel = np.ptp(across, axis=0)
        self._update_texture(events, (start_us + end_us) // 2, drift, seconds, across)
        weight = self._weights()
        return Coverage(
            share=float(seen_share(travel) @ weight),
            drift=drift,
            drift_change=drift_change,
            travel=travel,
            texture=weight,
        )

    def _weights(self) -> NDArray[np.float64]:
        """Return the share of edges in each direction, sum 1. Directions not yet seen count as the mean of the rest."""
        known = np.isfinite(self._texture)
        usual = self._texture[known].mean() if known.any() else 1.0
        amounts = np.where(known, self._texture, usual)
        if not amounts.sum() > 0.0:
            return np.full(DIRECTIONS, 1.0 / DIRECTIONS)
        return np.asarray(amounts / amounts.sum())

    def _drift(self, events: Events, end_us: int) -> NDArray[np.float64] | None:
        """Return the image velocity without the prism [px/s], from the shift between the last slices of two windows.

        Returns None if there is no clear shift.
        """
        from scipy import fft

        first = int(np.searchsorted(events.t, end_us - SLICE_US))
        thinned = slice(first, None, 1 + (len(events) - first) // SLICE_EVENTS)
        image = self._image(events.x[thinned], events.y[thinned])
        spectrum = fft.rfft2(np.minimum(image, 3.0) - image.mean())
        middle = end_us - 0.5 * SLICE_US
        previous = self._previous_slice
        self._previous_slice = (middle, spectrum)
        if previous is None:
            return None
        previous_middle, previous_spectrum = previous
        if middle - previous_middle > SLICE_GAP_US:
            return None

        # The correlation of both slices, half whitened and smoothed.
        cross = spectrum * np.conj(previous_spectrum)
        cross *= self._smooth / np.sqrt(np.abs(cross) + 1e-6)
        correlation = fft.irfft2(cross, (PATCH_SIDE, PATCH_SIDE))
        row, column = divmod(int(correlation.argmax()), PATCH_SIDE)
        if correlation[row, column] < CLEAR_STD * correlation.std():
            return None

        # Its peak, to a fraction of a pixel.
        around = np.arange(-1, 2)
        along_row = correlation[row, (column + around) % PATCH_SIDE]
        along_column = correlation[(row + around) % PATCH_SIDE, column]
        x = _wrapped_shift(column + _peak_offset(along_row))
        y = _wrapped_shift(row + _peak_offset(along_column))
        return np.array([x, y]) * (1e6 / (middle - previous_middle))

    def _update_texture(
        self,
        events: Events,
        middle_us: int,
        drift: NDArray[np.float64],
        seconds: float,
        across: NDArray[np.float64],
    ) -> None:
        """Update the amount of edges in each direction.

        Directions in which edges did not move across themselves keep their value.
        """
        step = 1 + len(events) // WINDOW_EVENTS
        thinned = events[::step]
        later = (thinned.t - middle_us).astype(np.float32) * np.float32(1e-6)
        x = thinned.x - later * np.float32(drift[0])
        y = thinned.y - later * np.float32(drift[1])
        image = self._image(x, y)

        # An edge gives events in proportion to the way that it moves across itself.
        path_length = np.abs(np.diff(across, axis=0)).sum(axis=0)
        amount = step * _edge_directions(image) / np.maximum(path_length, TEXTURE_TRAVEL)
        moved = np.ptp(across, axis=0) >= TEXTURE_TRAVEL
        old = np.where(np.isfinite(self._texture), self._texture, amount)
        share = 1.0 - math.exp(-seconds / TEXTURE_S)
        self._texture = np.where(moved, old + share * (amount - old), self._texture)

    def _image(self, x: NDArray[Any], y: NDArray[Any]) -> NDArray[np.float32]:
        """Return the number of events per pixel of the central patch, shape (PATCH_SIDE, PATCH_SIDE)."""
        column = x - (self._corner[0] - 0.5)
        row = y - (self._corner[1] - 0.5)
        inside = (column >= 0.0) & (column < PATCH_SIDE) & (row >= 0.0) & (row < PATCH_SIDE)
        place = row[inside].astype(np.int64) * PATCH_SIDE + column[inside].astype(np.int64)
        counts = np.bincount(place, minlength=PATCH_SIDE * PATCH_SIDE)
        return counts.astype(np.float32).reshape(PATCH_SIDE, PATCH_SIDE)


def _edge_directions(image: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return the amount of edges by the direction of their normal, shape (n,), from structure tensors of blocks.

    A block counts with the square root of the difference of its tensor's eigenvalues, so that isolated points, which
    have no direction, count nothing.
    """
    padded = np.zeros((PATCH_SIDE + 2, PATCH_SIDE + 2), np.float32)
    padded[1:-1, 1:-1] = image
    rows = padded[:-2] + 2.0 * padded[1:-1] + padded[2:]
    columns = padded[:, :-2] + 2.0 * padded[:, 1:-1] + padded[:, 2:]
    gx = rows[:, 2:] - rows[:, :-2]
    gy = columns[2:] - columns[:-2]
    half = 0.5 * _block_sums(gx * gx - gy * gy)
    skew = _block_sums(gx * gy)
    angle = 0.5 * np.arctan2(skew, half) % math.pi
    place = np.minimum((angle * (DIRECTIONS / math.pi)).astype(np.int64), DIRECTIONS - 1)
    amount = np.sqrt(2.0 * np.hypot(half, skew))
    return np.asarray(np.bincount(place.ravel(), amount.ravel(), DIRECTIONS), np.float64)


def _block_sums(image: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the sums over square blocks of :data:`BLOCK` × :data:`BLOCK` pixels."""
    rows = np.add.reduce([image[k::BLOCK] for k in range(BLOCK)])
    return np.asarray(np.add.reduce([rows[:, k::BLOCK] for k in range(BLOCK)]))


def _peak_offset(values: NDArray[np.float32]) -> float:
    """Return the position of the maximum of the parabola through three values, relative to the middle one."""
    left, middle, right = values.tolist()
    bend = left - 2.0 * middle + right
    return 0.5 * (left - right) / bend if bend < 0.0 else 0.0


def _wrapped_shift(shift: float) -> float:
    """Return the shortest shift equivalent to ``shift`` modulo PATCH_SIDE [px]."""
    return (shift + PATCH_SIDE / 2) % PATCH_SIDE - PATCH_SIDE / 2
