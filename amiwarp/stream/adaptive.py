"""The prism's speed from the stream: as fast as the edges need it, no faster.

A window of events sees an edge where the image moves across it. The prism moves it, and so does the camera:
:class:`CoverageMeter` follows both and tells the share of the scene's edges that the window sees,
:class:`SpeedController` makes a speed of it. ``docs/adaptive.md`` says how well that works.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from amiwarp.errors import AmiwarpError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.encoder import Encoder
    from amiwarp.events import Events
    from amiwarp.optics import Model

DIRECTIONS = 18
"""Bins of edge directions over half a turn."""
SWING = 0.25
"""An edge moved across itself by s is seen with probability 1 - exp(-s / SWING), as found in simulations [px]."""
TOLD = 1.0
"""Swing from which a window tells how much texture there is in a direction [px]."""
SIDE = 192
"""Of the middle of the image that is looked at [px]."""
BLOCK = 4
"""Side of the blocks that have one edge direction each [px]."""
SLICE_US = 4_000
"""Of a window's end: so short that the camera's motion smears nothing, long enough for the next slice to look alike."""
LONGEST_US = 100_000
"""Between two slices that are compared."""
SLICE_EVENTS, WINDOW_EVENTS = 1 << 14, 1 << 15
"""More are thinned evenly."""
CLEAR = 8.0
"""Standard deviations by which two slices must agree on a shift; with less the camera counts as still."""
TEXTURE_S = 0.5
"""Memory of which edge directions the scene has [s]."""
ANGLES = 17
"""Places of the prism's path over a window."""
MEMORY_S, RISING_S = 0.25, 0.1
"""Of coverage and rate in the controller: windows see now these directions, now those. Shorter while the speed rises,
or what was unseen before would make it overshoot [s]."""
GAIN = 0.15
"""Relative change of the speed a second, for each factor e by which the unseen share is too large or too small."""
FASTEST_FALL, FASTEST_RISE, SLOWEST = 0.4, 1.0, 0.05
"""Relative changes a second."""
LIMITED_S = 1.5
"""In which the event rate comes nearer to its limit by a factor e."""
NEAR_LIMIT, BELOW_LIMIT = 0.9, 0.8
"""Shares of the largest event rate: down to the first falls a speed that was too much, under the second it may rise."""


def prism_path(model: Model, encoder: Encoder, start_us: int, end_us: int) -> NDArray[np.float64]:
    """Where the prism puts the image's middle at even times of a window, both ends included, shape (m, 2) [px].

    Raises :class:`AmiwarpError` where the encoder does not cover it, or the middle has no ray.
    """
    middle = np.array([[0.5 * (model.camera.width - 1), 0.5 * (model.camera.height - 1)]])
    times = np.rint(np.linspace(start_us, end_us, ANGLES)).astype(np.int64)
    path = model.deflect_points(np.repeat(middle, ANGLES, axis=0), encoder.angle_at(times))
    if not np.isfinite(path).all():
        raise AmiwarpError("the image's middle has no ray through the prism at some angle; check the model")
    return np.asarray(path, np.float64)


@dataclass(slots=True, eq=False)
class SpeedController:
    """A speed from coverage and event rate. Raises :class:`AmiwarpError` for limits that leave no speed or no band.

    With coverage under :attr:`low` the speed rises, above :attr:`high` it falls, in either case until what is unseen
    is half-way between by ratio; otherwise it stays.
    """

    rpm: float = 720.0
    """The speed now: to start with, then what was last asked for [turns/min]."""
    least_rpm: float = 120.0
    most_rpm: float = 1440.0
    ramp_rpm_s: float = 600.0
    """What the motor follows [turns/min/s]."""
    most_mev_s: float = math.inf
    """What sensor, cable and computer carry [million events/s]; comes before coverage."""
    low: float = 0.999
    high: float = 0.9998
    """The band of coverage in which the speed stays as it is."""
    _t_us: int | None = field(default=None, init=False)
    _coverage: float = field(default=0.0, init=False)
    _rate: float = field(default=0.0, init=False)
    _way: int = field(default=0, init=False)

    def __post_init__(self) -> None:
        if not 0.0 < self.least_rpm <= self.rpm <= self.most_rpm < math.inf:
            given = f"{self.rpm:g} rpm to start with is not in {self.least_rpm:g} .. {self.most_rpm:g} rpm"
            raise AmiwarpError(f"adaptive speed: {given}; give limits above 0 around it")
        if not 0.0 < self.low < self.high < 1.0:
            raise AmiwarpError(f"adaptive speed: coverage from {self.low:g} to {self.high:g}; give 0 < low < high < 1")
        for name in ("ramp_rpm_s", "most_mev_s"):
            if not getattr(self, name) > 0.0:
                raise AmiwarpError(f"adaptive speed: {name} = {getattr(self, name):g}; give more than 0")

    def update(self, t_us: int, coverage: float, rate_mev_s: float) -> float | None:
        """The speed to ask for after a window that ended at ``t_us`` [turns/min]; None: leave it as it is.

        ``coverage``: :attr:`Coverage.share`; ``rate_mev_s``: million events a second. Raises :class:`AmiwarpError`
        where time does not advance, or for what is no share or no rate.
        """
        if not (0.0 <= coverage <= 1.0 and 0.0 <= rate_mev_s < math.inf):
            raise AmiwarpError(f"adaptive speed: coverage {coverage:g} at {rate_mev_s:g} Mev/s; give 0 .. 1 and a rate")
        if self._t_us is None:
            self._t_us, self._coverage, self._rate = t_us, coverage, rate_mev_s
            return None
        if t_us <= self._t_us:
            raise AmiwarpError(f"adaptive speed: window at {t_us} us after that at {self._t_us} us; give them in order")
        seconds = (t_us - self._t_us) * 1e-6
        new = 1.0 - math.exp(-seconds / (RISING_S if self._way > 0 else MEMORY_S))
        self._t_us = t_us
        self._coverage += new * (coverage - self._coverage)
        self._rate += new * (rate_mev_s - self._rate)
        self._way = self._next_way()
        if not self._way:
            return None
        change = GAIN * math.log(max(1.0 - self._coverage, 1e-6) / (1.0 - self._aim))
        allowed = math.log(NEAR_LIMIT / max(self._rate / self.most_mev_s, 1e-9)) / LIMITED_S
        change = min(change, allowed)
        change = max(change, SLOWEST) if self._way > 0 else min(change, -SLOWEST)
        change = min(max(change, -FASTEST_FALL), FASTEST_RISE)
        largest = self.ramp_rpm_s * seconds
        step = min(max(self.rpm * math.expm1(change * seconds), -largest), largest)
        before, self.rpm = self.rpm, min(max(self.rpm + step, self.least_rpm), self.most_rpm)
        return self.rpm if self.rpm != before else None

    @property
    def _aim(self) -> float:
        return 1.0 - math.sqrt((1.0 - self.low) * (1.0 - self.high))

    def _next_way(self) -> int:
        """1 to rise, -1 to fall, 0 to stay: what has begun goes on until it is enough."""
        rate, aim = self._rate / self.most_mev_s, self._aim
        if rate > (NEAR_LIMIT if self._way < 0 else 1.0) or self._coverage > (aim if self._way < 0 else self.high):
            return -1
        wanted = self._coverage < (aim if self._way > 0 else self.low)
        return int(wanted and rate < (NEAR_LIMIT if self._way > 0 else BELOW_LIMIT))


@dataclass(frozen=True, slots=True, eq=False)
class Coverage:
    """What a window of events saw."""

    share: float
    """Of the scene's edges that are seen, by their directions and what moved them, 0 .. 1."""
    drift: NDArray[np.float64]
    """The image's velocity by the camera's motion alone, shape (2,) [px/s]; 0 where none is clear."""
    swing: NDArray[np.float64]
    """How far edges were moved across themselves, by the direction of their normal, shape (n,) [px]."""
    texture: NDArray[np.float64]
    """Share of the edges in each direction over the last while, shape (n,), sum 1; even where there are none."""


class CoverageMeter:
    """Edge directions seen, window by window."""

    def __init__(self, width: int, height: int) -> None:
        self._corner = np.array([(width - SIDE) // 2, (height - SIDE) // 2], np.float32)
        angle = (np.arange(DIRECTIONS) + 0.5) * (math.pi / DIRECTIONS)
        self._normals = np.stack([np.cos(angle), np.sin(angle)])
        self._texture = np.full(DIRECTIONS, np.nan)
        self._end_us = -(1 << 62)
        self._before: tuple[float, NDArray[np.complex64]] | None = None
        along = np.exp(-2.0 * (math.pi * np.fft.fftfreq(SIDE)) ** 2).astype(np.float32)
        self._smooth = along[:, None] * along[None, : SIDE // 2 + 1]

    def __call__(self, events: Events, start_us: int, end_us: int, path: NDArray[np.float64]) -> Coverage:
        """The next window's.

        ``events``: compensated, in order, those of ``start_us`` .. ``end_us``; ``path``: see :func:`prism_path`.
        Raises :class:`AmiwarpError` for windows that are empty or not in order.
        """
        if not self._end_us <= start_us < end_us:
            given = f"window {start_us} .. {end_us} us after one that ended at {self._end_us} us"
            raise AmiwarpError(f"coverage: {given}; give windows one after the other")
        self._end_us = end_us
        seconds = (end_us - start_us) * 1e-6
        drift = self._drift(events, end_us)
        way = path + np.linspace(0.0, seconds, len(path))[:, None] * drift
        across = way @ self._normals
        swing = np.ptp(across, axis=0)
        self._learn(events, (start_us + end_us) // 2, drift, seconds, across)
        known = np.isfinite(self._texture)
        weight = np.where(known, self._texture, self._texture[known].mean() if known.any() else 1.0)
        weight = weight / weight.sum() if weight.sum() > 0.0 else np.full(DIRECTIONS, 1.0 / DIRECTIONS)
        share = max(0.0, 1.0 - float(weight @ np.exp(-swing / SWING)))
        return Coverage(share, drift, swing, weight)

    def _drift(self, events: Events, end_us: int) -> NDArray[np.float64]:
        """Velocity of the image without the prism [px/s]: the shift of this window's end from the last window's."""
        from scipy import fft

        first = int(np.searchsorted(events.t, end_us - SLICE_US))
        some = slice(first, None, 1 + (len(events) - first) // SLICE_EVENTS)
        image = self._image(events.x[some], events.y[some])
        spectrum = fft.rfft2(np.minimum(image, 3.0) - image.mean())
        middle = end_us - 0.5 * SLICE_US
        before, self._before = self._before, (middle, spectrum)
        if before is None or middle - before[0] > LONGEST_US:
            return np.zeros(2)
        cross = spectrum * np.conj(before[1])
        cross *= self._smooth / np.sqrt(np.abs(cross) + 1e-6)
        likeness = fft.irfft2(cross, (SIDE, SIDE))
        row, column = divmod(int(likeness.argmax()), SIDE)
        if likeness[row, column] < CLEAR * likeness.std():
            return np.zeros(2)
        shift = [
            _signed(column + _summit(likeness[row, (column + np.arange(-1, 2)) % SIDE])),
            _signed(row + _summit(likeness[(row + np.arange(-1, 2)) % SIDE, column])),
        ]
        return np.array(shift) * (1e6 / (middle - before[0]))

    def _learn(
        self, events: Events, middle_us: int, drift: NDArray[np.float64], seconds: float, across: NDArray[np.float64]
    ) -> None:
        """Which directions the window's edges have; a direction that nothing moved across itself keeps what it had."""
        step = 1 + len(events) // WINDOW_EVENTS
        some = events[::step]
        later = (some.t - middle_us).astype(np.float32) * np.float32(1e-6)
        image = self._image(some.x - later * np.float32(drift[0]), some.y - later * np.float32(drift[1]))
        amount = step * _edges(image) / np.maximum(np.abs(np.diff(across, axis=0)).sum(axis=0), TOLD)
        moved = np.ptp(across, axis=0) >= TOLD
        old = np.where(np.isfinite(self._texture), self._texture, amount)
        share = 1.0 - math.exp(-seconds / TEXTURE_S)
        self._texture = np.where(moved, old + share * (amount - old), self._texture)

    def _image(self, x: NDArray[Any], y: NDArray[Any]) -> NDArray[np.float32]:
        """Events per pixel of the image's middle, shape (SIDE, SIDE)."""
        column, row = x - (self._corner[0] - 0.5), y - (self._corner[1] - 0.5)
        inside = (column >= 0.0) & (column < SIDE) & (row >= 0.0) & (row < SIDE)
        place = row[inside].astype(np.int64) * SIDE + column[inside].astype(np.int64)
        return np.bincount(place, minlength=SIDE * SIDE).astype(np.float32).reshape(SIDE, SIDE)


def _edges(image: NDArray[np.float32]) -> NDArray[np.float64]:
    """How much edge there is by the direction of its normal, shape (n,): blocks by their structure tensors.

    Each counts by the root of the difference of the tensor's eigenvalues, so that specks count for nothing.
    """
    padded = np.zeros((SIDE + 2, SIDE + 2), np.float32)
    padded[1:-1, 1:-1] = image
    rows = padded[:-2] + 2.0 * padded[1:-1] + padded[2:]
    columns = padded[:, :-2] + 2.0 * padded[:, 1:-1] + padded[:, 2:]
    gx, gy = rows[:, 2:] - rows[:, :-2], columns[2:] - columns[:-2]
    half, skew = 0.5 * _blocks(gx * gx - gy * gy), _blocks(gx * gy)
    angle = 0.5 * np.arctan2(skew, half) % math.pi
    place = np.minimum((angle * (DIRECTIONS / math.pi)).astype(np.int64), DIRECTIONS - 1)
    amount = np.sqrt(2.0 * np.hypot(half, skew))
    return np.asarray(np.bincount(place.ravel(), amount.ravel(), DIRECTIONS), np.float64)


def _blocks(image: NDArray[np.float32]) -> NDArray[np.float32]:
    """Sums over blocks."""
    rows = np.add.reduce([image[k::BLOCK] for k in range(BLOCK)])
    return np.asarray(np.add.reduce([rows[:, k::BLOCK] for k in range(BLOCK)]))


def _summit(values: NDArray[np.float32]) -> float:
    """Where the parabola through three values has its top, from the middle one."""
    left, middle, right = values.tolist()
    bend = left - 2.0 * middle + right
    return 0.5 * (left - right) / bend if bend < 0.0 else 0.0


def _signed(shift: float) -> float:
    """A shift on the ring of SIDE pixels, the short way."""
    return (shift + SIDE / 2) % SIDE - SIDE / 2
