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

    from amiwarp.events.encoder import Encoder
    from amiwarp.events.events import Events
    from amiwarp.optics.models import Model

DIRECTIONS = 18
"""Bins of edge directions over half a turn."""
_BINS = (np.arange(DIRECTIONS) + 0.5) * (math.pi / DIRECTIONS)
NORMALS = np.stack([np.cos(_BINS), np.sin(_BINS)])
"""Of edges in the bins' middles, shape (2, DIRECTIONS)."""
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
PHASES, ORBIT = 8, 1024
"""Of the prism at which a window to come may begin, and places of its orbit."""
SPEEDS = 32
"""Between the limits, for which coverage is foretold."""
MEMORY_S = 0.25
"""Of what is foretold and of the rate, in the controller: windows see now these directions, now those [s]."""
FOLLOW_S, LIMITED_S = 0.2, 1.5
"""In which the speed comes nearer by a factor e to that which is enough, and to where the event rate has its limit."""
THERE = 0.01
"""Relative distance from the speed that is enough at which it has been reached."""
NEAR_LIMIT, BELOW_LIMIT = 0.9, 0.8
"""Shares of the largest event rate: down to the first falls a speed that was too much, under the second it may rise."""


def prism_path(model: Model, encoder: Encoder, start_us: int, end_us: int) -> NDArray[np.float64]:
    """Where the prism puts the image's middle at even times of a window, both ends included, shape (m, 2) [px].

    Raises :class:`AmiwarpError` where the encoder does not cover it, or the middle has no ray.
    """
    times = np.rint(np.linspace(start_us, end_us, ANGLES)).astype(np.int64)
    return _middle(model, np.asarray(encoder.angle_at(times), np.float64))


def prism_orbit(model: Model) -> NDArray[np.float64]:
    """Where the prism puts the image's middle at even angles of a turn, shape (n, 2) [px].

    Raises :class:`AmiwarpError` where it has no ray.
    """
    return _middle(model, np.linspace(0.0, math.tau, ORBIT, endpoint=False))


def _middle(model: Model, angles: NDArray[np.float64]) -> NDArray[np.float64]:
    middle = np.array([[0.5 * (model.camera.width - 1), 0.5 * (model.camera.height - 1)]])
    path = model.deflect_points(np.repeat(middle, len(angles), axis=0), angles)
    if not np.isfinite(path).all():
        raise AmiwarpError("the image's middle has no ray through the prism at some angle; check the model")
    return np.asarray(path, np.float64)


def _drifted(drift: NDArray[np.float64], turn: NDArray[np.float64], seconds: float) -> NDArray[np.float64]:
    """Where a drift that changes evenly takes the image over a window, shape (ANGLES, 2) [px]."""
    along = np.linspace(0.0, 1.0, ANGLES)[:, None]
    return np.asarray(seconds * (along * drift + 0.5 * (along * along - along) * turn))


def _seen(swing: NDArray[np.float64]) -> NDArray[np.float64]:
    """Share of edges with a swing [px] that are seen."""
    return np.asarray(-np.expm1(-swing / SWING))


@dataclass(frozen=True, slots=True, eq=False)
class Coverage:
    """What a window of events saw."""

    share: float
    """Of the scene's edges that are seen, by their directions and what moved them, 0 .. 1."""
    drift: NDArray[np.float64]
    """The image's velocity by the camera's motion alone, shape (2,) [px/s]; 0 where none is clear."""
    turn: NDArray[np.float64]
    """By how much the drift changes over the window, shape (2,) [px/s]; 0 where that is not known."""
    swing: NDArray[np.float64]
    """How far edges were moved across themselves, by the direction of their normal, shape (n,) [px]."""
    texture: NDArray[np.float64]
    """Share of the edges in each direction over the last while, shape (n,), sum 1; even where there are none."""

    def foretold(self, rpm: NDArray[np.float64], orbit: NDArray[np.float64], seconds: float) -> NDArray[np.float64]:
        """Share that such a window would see at other speeds, in the worst of the prism's phases, shape (n,).

        ``rpm``: shape (n,); ``orbit``: see :func:`prism_orbit`; ``seconds``: the window's length.
        """
        along = np.linspace(0.0, 1.0, ANGLES)
        turns = (seconds / 60.0) * rpm[:, None, None] * along + np.arange(PHASES)[:, None] / PHASES
        way = orbit[np.rint(turns * len(orbit)).astype(np.int64) % len(orbit)] + _drifted(
            self.drift, self.turn, seconds
        )
        return np.asarray((_seen(np.ptp(way @ NORMALS, axis=2)) @ self.texture).min(axis=1))


@dataclass(slots=True, eq=False)
class SpeedController:
    """A speed from coverage and event rate. Raises :class:`AmiwarpError` for limits that leave no speed or no band.

    What a window would see at the worst of the prism's phases is foretold for all speeds. Where that is under
    :attr:`low` or above :attr:`high` for the speed now, it goes to the lowest one for which what is unseen is half-way
    between by ratio, or to the best there is.
    """

    orbit: NDArray[np.float64]
    """See :func:`prism_orbit`."""
    rpm: float = 720.0
    """The speed now: to start with, then what was last asked for [turns/min]."""
    least_rpm: float = 120.0
    most_rpm: float = 1440.0
    ramp_rpm_s: float = 600.0
    """What the motor follows [turns/min/s]."""
    most_mev_s: float = math.inf
    """What sensor, cable and computer carry [million events/s]; comes before coverage."""
    low: float = 0.9988
    high: float = 0.9996
    """The band of coverage in which the speed stays as it is."""
    _t_us: int | None = field(default=None, init=False)
    _speeds: NDArray[np.float64] = field(init=False)
    _unseen: NDArray[np.float64] = field(init=False)
    _rate: float = field(default=0.0, init=False)
    _moving: bool = field(default=False, init=False)
    _limited: bool = field(default=False, init=False)

    def __post_init__(self) -> None:
        if not 0.0 < self.least_rpm <= self.rpm <= self.most_rpm < math.inf:
            given = f"{self.rpm:g} rpm to start with is not in {self.least_rpm:g} .. {self.most_rpm:g} rpm"
            raise AmiwarpError(f"adaptive speed: {given}; give limits above 0 around it")
        if not 0.0 < self.low < self.high < 1.0:
            raise AmiwarpError(f"adaptive speed: coverage from {self.low:g} to {self.high:g}; give 0 < low < high < 1")
        for name in ("ramp_rpm_s", "most_mev_s"):
            if not getattr(self, name) > 0.0:
                raise AmiwarpError(f"adaptive speed: {name} = {getattr(self, name):g}; give more than 0")
        self._unseen, self._speeds = np.zeros(SPEEDS), np.geomspace(self.least_rpm, self.most_rpm, SPEEDS)

    def update(self, start_us: int, end_us: int, coverage: Coverage, rate_mev_s: float) -> float | None:
        """The speed to ask for after a window [us] [turns/min]; None: leave it as it is.

        ``rate_mev_s``: million events a second. Raises :class:`AmiwarpError` where windows are not in order, or for
        what is no rate.
        """
        if not 0.0 <= rate_mev_s < math.inf:
            raise AmiwarpError(f"adaptive speed: {rate_mev_s:g} Mev/s; give a rate")
        first = self._t_us is None
        if not start_us < end_us or (self._t_us is not None and start_us < self._t_us):
            given = f"window {start_us} .. {end_us} us after one that ended at {self._t_us} us"
            raise AmiwarpError(f"adaptive speed: {given}; give windows one after the other")
        seconds = (end_us - (start_us if self._t_us is None else self._t_us)) * 1e-6
        self._t_us = end_us
        new = 1.0 if first else 1.0 - math.exp(-seconds / MEMORY_S)
        unseen = 1.0 - coverage.foretold(self._speeds, self.orbit, (end_us - start_us) * 1e-6)
        self._unseen += new * (unseen - self._unseen)
        self._rate += new * (rate_mev_s - self._rate)
        return None if first else self._step(seconds)

    def _step(self, seconds: float) -> float | None:
        """Towards where it should be."""
        rate, within = self._rate / self.most_mev_s, FOLLOW_S
        self._limited = rate > (NEAR_LIMIT if self._limited else 1.0)
        logs = np.log(np.maximum(self._unseen, 1e-12))  # between two speeds it goes evenly by ratio
        now = math.exp(np.interp(math.log(self.rpm), np.log(self._speeds), logs))
        self._moving = self._moving or not 1.0 - self.high <= now <= 1.0 - self.low
        enough = self._enough(logs) if self._moving else self.rpm
        if self._limited:
            enough, within = min(enough, self.rpm * NEAR_LIMIT / rate), LIMITED_S
        elif enough > self.rpm and rate > BELOW_LIMIT:
            enough = self.rpm
        if abs(enough / self.rpm - 1.0) < THERE:
            self._moving = False
            return None
        largest = self.ramp_rpm_s * seconds
        step = min(max((enough - self.rpm) * -math.expm1(-seconds / within), -largest), largest)
        before, self.rpm = self.rpm, min(max(self.rpm + step, self.least_rpm), self.most_rpm)
        return self.rpm if self.rpm != before else None

    def _enough(self, logs: NDArray[np.float64]) -> float:
        """The lowest speed with what may be unseen, between those looked at; the best where there is none."""
        aim = 0.5 * math.log((1.0 - self.low) * (1.0 - self.high))
        good = np.flatnonzero(logs <= aim)
        k = int(good[0]) if len(good) else int(logs.argmin())
        if k == 0 or not len(good):
            return float(self._speeds[k])
        above, below = logs[k - 1 : k + 1]
        part = (above - aim) / (above - below)
        return float(self._speeds[k - 1] * (self._speeds[k] / self._speeds[k - 1]) ** part)


class CoverageMeter:
    """Edge directions seen, window by window."""

    def __init__(self, width: int, height: int) -> None:
        self._corner = np.array([(width - SIDE) // 2, (height - SIDE) // 2], np.float32)
        self._texture = np.full(DIRECTIONS, np.nan)
        self._end_us = -(1 << 62)
        self._last: NDArray[np.float64] | None = None
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
        seconds, follows = (end_us - start_us) * 1e-6, start_us - self._end_us < SLICE_US
        before, found = self._last, self._drift(events, end_us)
        turn = found - before if follows and before is not None and found is not None else np.zeros(2)
        drift = np.zeros(2) if found is None else found
        self._end_us, self._last = end_us, found
        across = (path + _drifted(drift, turn, seconds)) @ NORMALS
        swing = np.ptp(across, axis=0)
        self._learn(events, (start_us + end_us) // 2, drift, seconds, across)
        known = np.isfinite(self._texture)
        weight = np.where(known, self._texture, self._texture[known].mean() if known.any() else 1.0)
        weight = weight / weight.sum() if weight.sum() > 0.0 else np.full(DIRECTIONS, 1.0 / DIRECTIONS)
        return Coverage(float(_seen(swing) @ weight), drift, turn, swing, weight)

    def _drift(self, events: Events, end_us: int) -> NDArray[np.float64] | None:
        """Velocity of the image without the prism [px/s]: the shift of this window's end from the last window's.

        None where none is clear.
        """
        from scipy import fft

        first = int(np.searchsorted(events.t, end_us - SLICE_US))
        some = slice(first, None, 1 + (len(events) - first) // SLICE_EVENTS)
        image = self._image(events.x[some], events.y[some])
        spectrum = fft.rfft2(np.minimum(image, 3.0) - image.mean())
        middle = end_us - 0.5 * SLICE_US
        before, self._before = self._before, (middle, spectrum)
        if before is None or middle - before[0] > LONGEST_US:
            return None
        cross = spectrum * np.conj(before[1])
        cross *= self._smooth / np.sqrt(np.abs(cross) + 1e-6)
        likeness = fft.irfft2(cross, (SIDE, SIDE))
        row, column = divmod(int(likeness.argmax()), SIDE)
        if likeness[row, column] < CLEAR * likeness.std():
            return None
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
