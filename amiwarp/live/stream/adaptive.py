"""Adaptive prism speed: as fast as the scene's edges need, no faster.

A window of events shows an edge only if the image moves across it, by the prism or by the camera's own motion.
:class:`CoverageMeter` estimates both motions and the share of the scene's edges that a window shows (the coverage).
:class:`SpeedController` derives the prism's speed from it. ``docs/explanation/adaptive-speed.md`` shows the results.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.encoder import Encoder, EncoderStream
from amiwarp.events.recording import Events, held_bytes

if TYPE_CHECKING:
    from amiwarp.compensation.streams import Compensated
    from amiwarp.optics.models import Model


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
SLICE_EVENTS, WINDOW_EVENTS = 1 << 14, 1 << 15
"""Largest number of events of a slice and of a window that are used. Events above these numbers are thinned evenly."""
CLEAR_STD = 8.0
"""Height of the correlation peak of two slices below which the camera is considered still [standard deviations]."""
TEXTURE_S = 0.5
"""Time constant with which the amounts of edges in each direction are averaged [s]."""
ANGLES = 17
"""Number of points of the prism's path that are computed per window."""
PHASES, ORBIT = 8, 1024
"""Number of prism phases for which a window is predicted, and number of points that sample the prism's orbit."""
SPEEDS = 32
"""Number of prism speeds between the lowest and the highest for which the coverage is predicted."""
MEMORY_S = 0.25
"""Time constant of the average of coverage predictions and of the event rate [s]. Edge directions vary between windows.
"""
FOLLOW_S, LIMITED_S = 0.2, 1.5
"""Time constants of the speed's approach to the sufficient speed, and to the speed that the event rate allows [s]."""
SPEED_TOLERANCE = 0.01
"""Relative difference from the sufficient speed below which the speed is not changed further."""
NEAR_LIMIT, BELOW_LIMIT = 0.9, 0.8
"""Shares of the largest event rate at which its limitation of the prism speed ends, and below which the speed may rise.

Once the event rate exceeds the largest rate, the speed is lowered until the event rate falls to the first share. The
speed may rise only while the event rate is below the second share.
"""


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
        raise AmiwarpError("the image centre has no ray through the prism at some angle; check the model")
    return np.asarray(path, np.float64)


def _drift_path(drift: NDArray[np.float64], drift_change: NDArray[np.float64], seconds: float) -> NDArray[np.float64]:
    """Return the image's displacement over a window by a linearly changing drift, shape (ANGLES, 2) [px]."""
    along = np.linspace(0.0, 1.0, ANGLES)[:, None]
    return np.asarray(seconds * (along * drift + 0.5 * (along * along - along) * drift_change))


def _seen_share(travel: NDArray[np.float64]) -> NDArray[np.float64]:
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

    def predict(self, rpm: NDArray[np.float64], orbit: NDArray[np.float64], seconds: float) -> NDArray[np.float64]:
        """Return the coverage that a window would have at other prism speeds, for the worst prism phase, shape (n,).

        ``rpm``: speeds [turns/min], shape (n,). ``orbit``: see :func:`prism_orbit`. ``seconds``: length of the window.
        """
        along = np.linspace(0.0, 1.0, ANGLES)
        turns = (seconds / 60.0) * rpm[:, None, None] * along + np.arange(PHASES)[:, None] / PHASES
        path = orbit[np.rint(turns * len(orbit)).astype(np.int64) % len(orbit)] + _drift_path(
            self.drift, self.drift_change, seconds
        )
        return np.asarray((_seen_share(np.ptp(path @ NORMALS, axis=2)) @ self.texture).min(axis=1))


@dataclass(slots=True, eq=False)
class SpeedController:
    """Derives the prism's speed from coverage and event rate.

    It predicts the coverage at the worst prism phase for all speeds. If the prediction for the present speed is below
    :attr:`low` or above :attr:`high`, the controller moves to the lowest speed whose unseen share is at most the
    geometric mean of the two limits' unseen shares, or else to the speed with the best coverage. Raises
    :class:`AmiwarpError` for empty ranges of speed or coverage.
    """

    orbit: NDArray[np.float64]
    """Path of the image centre over a turn of the prism, see :func:`prism_orbit`."""
    rpm: float = 720.0
    """Present prism speed: the initial speed, later the last commanded one [turns/min]."""
    least_rpm: float = 120.0
    """Lowest prism speed that is commanded [turns/min]."""
    most_rpm: float = 1440.0
    """Highest prism speed that is commanded [turns/min]."""
    ramp_rpm_s: float = 600.0
    """Rate at which the motor can change its speed [turns/min/s]."""
    most_mev_s: float = math.inf
    """Largest event rate that sensor, cable and computer can handle [million events/s]. It has priority over coverage.
    """
    low: float = 0.9988
    """Lower limit of the predicted coverage. Below it, the speed changes."""
    high: float = 0.9996
    """Upper limit of the predicted coverage. Above it, the speed changes."""
    _t_us: int | None = field(default=None, init=False)
    _speeds: NDArray[np.float64] = field(init=False)
    _unseen: NDArray[np.float64] = field(init=False)
    _rate: float = field(default=0.0, init=False)
    _moving: bool = field(default=False, init=False)
    _limited: bool = field(default=False, init=False)

    def __post_init__(self) -> None:
        if not 0.0 < self.least_rpm <= self.rpm <= self.most_rpm < math.inf:
            given = f"{self.rpm:g} rpm to start with is not in {self.least_rpm:g} .. {self.most_rpm:g} rpm"
            raise AmiwarpError(f"adaptive speed: {given}; give limits above 0 that include the initial speed")
        if not 0.0 < self.low < self.high < 1.0:
            given = f"coverage limits low = {self.low:g} and high = {self.high:g}"
            raise AmiwarpError(f"adaptive speed: {given}; give 0 < low < high < 1")
        for name in ("ramp_rpm_s", "most_mev_s"):
            if not getattr(self, name) > 0.0:
                raise AmiwarpError(f"adaptive speed: {name} = {getattr(self, name):g}; give a number above 0")
        self._unseen, self._speeds = np.zeros(SPEEDS), np.geomspace(self.least_rpm, self.most_rpm, SPEEDS)

    def update(self, start_us: int, end_us: int, coverage: Coverage, rate_mev_s: float) -> float | None:
        """Return the prism speed to command after a window of events [turns/min]; None to keep the speed.

        ``start_us``, ``end_us``: window [us]; ``rate_mev_s``: event rate [million events/s]. Raises
        :class:`AmiwarpError` for windows out of order, or for a rate that is negative or not finite.
        """
        if not 0.0 <= rate_mev_s < math.inf:
            raise AmiwarpError(f"adaptive speed: {rate_mev_s:g} Mev/s; give a finite rate of 0 or more")
        first = self._t_us is None
        if not start_us < end_us or (self._t_us is not None and start_us < self._t_us):
            given = f"window {start_us} .. {end_us} us after one that ended at {self._t_us} us"
            raise AmiwarpError(f"adaptive speed: {given}; pass the windows of events in order of time")
        seconds = (end_us - (start_us if self._t_us is None else self._t_us)) * 1e-6
        self._t_us = end_us
        new = 1.0 if first else 1.0 - math.exp(-seconds / MEMORY_S)
        unseen = 1.0 - coverage.predict(self._speeds, self.orbit, (end_us - start_us) * 1e-6)
        self._unseen += new * (unseen - self._unseen)
        self._rate += new * (rate_mev_s - self._rate)
        return None if first else self._step(seconds)

    def _step(self, seconds: float) -> float | None:
        """Move the present speed one step of ``seconds`` towards the sufficient speed."""
        rate, time_constant = self._rate / self.most_mev_s, FOLLOW_S
        self._limited = rate > (NEAR_LIMIT if self._limited else 1.0)
        logs = np.log(np.maximum(self._unseen, 1e-12))  # interpolate geometrically between speeds
        now = math.exp(np.interp(math.log(self.rpm), np.log(self._speeds), logs))
        self._moving = self._moving or not 1.0 - self.high <= now <= 1.0 - self.low
        sufficient = self._sufficient_speed(logs) if self._moving else self.rpm
        if self._limited:
            sufficient, time_constant = min(sufficient, self.rpm * NEAR_LIMIT / rate), LIMITED_S
        elif sufficient > self.rpm and rate > BELOW_LIMIT:
            sufficient = self.rpm
        if abs(sufficient / self.rpm - 1.0) < SPEED_TOLERANCE:
            self._moving = False
            return None
        largest = self.ramp_rpm_s * seconds
        step = min(max((sufficient - self.rpm) * -math.expm1(-seconds / time_constant), -largest), largest)
        previous, self.rpm = self.rpm, min(max(self.rpm + step, self.least_rpm), self.most_rpm)
        return self.rpm if self.rpm != previous else None

    def _sufficient_speed(self, logs: NDArray[np.float64]) -> float:
        """Return the lowest speed with an acceptable unseen share, interpolated; if there is none, the best speed."""
        aim = 0.5 * math.log((1.0 - self.low) * (1.0 - self.high))
        good = np.flatnonzero(logs <= aim)
        k = int(good[0]) if len(good) else int(logs.argmin())
        if k == 0 or not len(good):
            return float(self._speeds[k])
        above, below = logs[k - 1 : k + 1]
        part = (above - aim) / (above - below)
        return float(self._speeds[k - 1] * (self._speeds[k] / self._speeds[k - 1]) ** part)


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

    def __call__(self, events: Events, start_us: int, end_us: int, path: NDArray[np.float64]) -> Coverage:
        """Return the coverage of the next window.

        ``events``: compensated events from ``start_us`` to ``end_us`` [us], in order. ``path``: see
        :func:`prism_path`. Raises :class:`AmiwarpError` for empty windows, or windows out of order.
        """
        if not self._end_us <= start_us < end_us:
            given = f"window {start_us} .. {end_us} us after one that ended at {self._end_us} us"
            raise AmiwarpError(f"coverage: {given}; pass the windows of events in order of time")
        seconds, follows = (end_us - start_us) * 1e-6, start_us - self._end_us < SLICE_US
        previous, found = self._last_drift, self._drift(events, end_us)
        drift_change = found - previous if follows and previous is not None and found is not None else np.zeros(2)
        drift = np.zeros(2) if found is None else found
        self._end_us, self._last_drift = end_us, found
        across = (path + _drift_path(drift, drift_change, seconds)) @ NORMALS
        travel = np.ptp(across, axis=0)
        self._update_texture(events, (start_us + end_us) // 2, drift, seconds, across)
        known = np.isfinite(self._texture)
        weight = np.where(known, self._texture, self._texture[known].mean() if known.any() else 1.0)
        weight = weight / weight.sum() if weight.sum() > 0.0 else np.full(DIRECTIONS, 1.0 / DIRECTIONS)
        return Coverage(
            share=float(_seen_share(travel) @ weight),
            drift=drift,
            drift_change=drift_change,
            travel=travel,
            texture=weight,
        )

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
        previous, self._previous_slice = self._previous_slice, (middle, spectrum)
        if previous is None or middle - previous[0] > SLICE_GAP_US:
            return None
        cross = spectrum * np.conj(previous[1])
        cross *= self._smooth / np.sqrt(np.abs(cross) + 1e-6)
        correlation = fft.irfft2(cross, (PATCH_SIDE, PATCH_SIDE))
        row, column = divmod(int(correlation.argmax()), PATCH_SIDE)
        if correlation[row, column] < CLEAR_STD * correlation.std():
            return None
        shift = [
            _wrapped_shift(column + _peak_offset(correlation[row, (column + np.arange(-1, 2)) % PATCH_SIDE])),
            _wrapped_shift(row + _peak_offset(correlation[(row + np.arange(-1, 2)) % PATCH_SIDE, column])),
        ]
        return np.array(shift) * (1e6 / (middle - previous[0]))

    def _update_texture(
        self, events: Events, middle_us: int, drift: NDArray[np.float64], seconds: float, across: NDArray[np.float64]
    ) -> None:
        """Update the amount of edges in each direction.

        Directions in which edges did not move across themselves keep their value.
        """
        step = 1 + len(events) // WINDOW_EVENTS
        thinned = events[::step]
        later = (thinned.t - middle_us).astype(np.float32) * np.float32(1e-6)
        image = self._image(thinned.x - later * np.float32(drift[0]), thinned.y - later * np.float32(drift[1]))
        amount = (
            step * _edge_directions(image) / np.maximum(np.abs(np.diff(across, axis=0)).sum(axis=0), TEXTURE_TRAVEL)
        )
        moved = np.ptp(across, axis=0) >= TEXTURE_TRAVEL
        old = np.where(np.isfinite(self._texture), self._texture, amount)
        share = 1.0 - math.exp(-seconds / TEXTURE_S)
        self._texture = np.where(moved, old + share * (amount - old), self._texture)

    def _image(self, x: NDArray[Any], y: NDArray[Any]) -> NDArray[np.float32]:
        """Return the number of events per pixel of the central patch, shape (PATCH_SIDE, PATCH_SIDE)."""
        column, row = x - (self._corner[0] - 0.5), y - (self._corner[1] - 0.5)
        inside = (column >= 0.0) & (column < PATCH_SIDE) & (row >= 0.0) & (row < PATCH_SIDE)
        place = row[inside].astype(np.int64) * PATCH_SIDE + column[inside].astype(np.int64)
        return np.bincount(place, minlength=PATCH_SIDE * PATCH_SIDE).astype(np.float32).reshape(PATCH_SIDE, PATCH_SIDE)


def _edge_directions(image: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return the amount of edges by the direction of their normal, shape (n,), from structure tensors of blocks.

    A block counts with the square root of the difference of its tensor's eigenvalues, so that isolated points, which
    have no direction, count nothing.
    """
    padded = np.zeros((PATCH_SIDE + 2, PATCH_SIDE + 2), np.float32)
    padded[1:-1, 1:-1] = image
    rows = padded[:-2] + 2.0 * padded[1:-1] + padded[2:]
    columns = padded[:, :-2] + 2.0 * padded[:, 1:-1] + padded[:, 2:]
    gx, gy = rows[:, 2:] - rows[:, :-2], columns[2:] - columns[:-2]
    half, skew = 0.5 * _block_sums(gx * gx - gy * gy), _block_sums(gx * gy)
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


# Adaptive speed in a session: measures windows of compensated events and commands the motor.

WINDOW_US, MOST_WINDOWS = 33_333, 10
"""Length of a window of events [us], and largest number of windows measured at once. Older windows are skipped as
outdated."""
MOST_BYTES = 1 << 26
"""Memory limit of the unfinished window's packets [bytes]. Beyond it, the window's oldest packets are left out."""


class SpeedKeeper:
    """Measures the coverage of each window of events and commands a new prism speed if needed.

    A background thread waits for the controller's answer. ``set_speed`` is called with speed [rpm] and ramp [rpm/s],
    like :meth:`Link.set_speed`. ``say`` is called with the messages of its errors.
    """

    def __init__(
        self,
        model: Model,
        controller: SpeedController,
        set_speed: Callable[[float, float], None],
        say: Callable[[str], None],
    ) -> None:
        self.controller = controller
        self._model, self._set_speed, self._say = model, set_speed, say
        self._meter = CoverageMeter(model.camera.width, model.camera.height)
        self._packets: deque[Events] = deque()
        self.held_bytes = 0
        """Memory of the packets of the unfinished window [bytes]."""
        self._window_start_us: int | None = None
        self._command_thread: threading.Thread | None = None  # a daemon: no exit waits for an answer that never comes
        self._commanded_rpm = controller.rpm
        self.coverage: float | None = None
        """Share of the scene's edges that the last window showed, 0 to 1; None before the first window."""

    def put(self, packets: list[Compensated], encoder: EncoderStream) -> None:
        """Add compensated packets, in order of time, and measure the windows that are complete."""
        self._window_start_us = int(packets[0].events.t[0]) if self._window_start_us is None else self._window_start_us
        for packet in packets:
            self._packets.append(packet.events)
            self.held_bytes += held_bytes(packet.events)
            while self.held_bytes > MOST_BYTES and len(self._packets) > 1:
                self.held_bytes -= held_bytes(self._packets.popleft())
        last = int(self._packets[-1].t[-1])
        windows = (last - self._window_start_us) // WINDOW_US
        if windows < 1:
            return
        events = Events.concatenate(list(self._packets))
        self._window_start_us += WINDOW_US * max(0, windows - MOST_WINDOWS)
        while last - self._window_start_us >= WINDOW_US:
            end = self._window_start_us + WINDOW_US
            first, after = np.searchsorted(events.t, [self._window_start_us, end])
            self._measure(events[first:after], self._window_start_us, end, encoder)
            events, self._window_start_us = events[after:], end
        self._packets, self.held_bytes = deque([events]), held_bytes(events)

    def _measure(self, events: Events, start: int, end: int, encoder: EncoderStream) -> None:
        if encoder.first is None:
            return
        samples = encoder.over(start, end)
        if not samples.covers(start, end):  # the window begins before the first encoder sample
            return
        path = prism_path(self._model, samples, start, end)
        coverage = self._meter(events, start, end, path)
        self.coverage = coverage.share
        self.controller.update(start, end, coverage, len(events) / (end - start))
        rpm = self.controller.rpm
        # While a command waits for its answer, a further change of speed waits for the next window.
        if rpm != self._commanded_rpm and (self._command_thread is None or not self._command_thread.is_alive()):
            self._commanded_rpm = rpm
            self._command_thread = threading.Thread(
                target=self._command, args=(rpm,), name="amiwarp-speed", daemon=True
            )
            self._command_thread.start()

    def _command(self, rpm: float) -> None:
        try:
            self._set_speed(rpm, self.controller.ramp_rpm_s)
        except AmiwarpError as error:
            self._say(str(error))

    def close(self) -> None:
        """Wait for the controller's answer to the last command."""
        if self._command_thread is not None:
            self._command_thread.join()
