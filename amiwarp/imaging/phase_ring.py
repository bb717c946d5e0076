"""Sums in phase of a stream: a ring with the events of the last turns by their angle, and sums of any part of it.

A turn is divided into bins. Each bin of the last turns has a plane with the numbers of events of all pixels. The sums
follow from the planes, so their time does not depend on the number of events, and each event is counted once.

Less than a turn mixes the harmonics. With the bins W of a window at the angles θ, its sums are B = G A, and

    G_mn = 1 / 64 Σ_W exp(i (n - m) θ)        m, n = -M to M

is the Gram matrix of the window, one for all pixels. Least squares with the weight λ for sums P that are expected give

    A = (G + λ)⁻¹ (B + λ P)

The sums below 0 are conjugates; A_0 is the change of the brightness from one turn to the next.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events import device_events
from amiwarp.events.encoder import Encoder
from amiwarp.events.recording import Events
from amiwarp.imaging.phase import BINS, HARMONICS, PhaseSums, shared_pairs
from amiwarp.imaging.phase_tables import EXTREME, LEAST_RATIO, bin_attenuation
from amiwarp.kernels import phase_ring as kernels
from amiwarp.kernels.launch import RecordedLaunch, launch
from amiwarp.schema.calls import guarded
from amiwarp.validation import array, real, whole

MOST_TURNS = 16
"""Largest number of turns that a ring keeps."""
LEAST_EVENTS = 60
"""Number of events in the square around a pixel below which its misfit is weakened: some are few by chance."""
EARLIER = 16
"""Number of bins before a part of a turn in which the polarity of the last event before it is looked up."""
WEIGHT_OF_PRIOR = 0.3
"""Weight λ of expected sums, relative to the sums of a whole turn."""
BACKWARDS = math.tau / 4.0
"""Angle by which an optic turns back before the ring starts anew [rad]. Less is jitter of its encoder."""
LEAST_MOTION = 1e-6
"""Smallest angle between the first and last event that shows the direction of the optic [rad]."""
BIN = math.tau / BINS
"""Angle of a bin [rad]."""


@dataclass(frozen=True, slots=True)
class RingPart:
    """Events of one bin of a turn, in one packet."""

    number: int
    """Number of the bin, counted from the angle 0 in the direction of the optic."""
    events: Events
    """The events."""


@dataclass(frozen=True, eq=False)
class PhaseUpdate:
    """Sums in phase, updated by the last part of a turn; made by :meth:`PhaseRing.update`.

    Examples
    --------
    >>> import numpy as np
    >>> ring = amiwarp.PhaseRing(4, 3, harmonics=2)
    >>> t = np.arange(0, 200_000, 100)
    >>> events = amiwarp.Events.from_arrays(0 * t + 1, 0 * t + 2, t, t % 200 == 0)
    >>> ring.add(events, amiwarp.Encoder.constant_speed(720.0, 0, 200_000))
    >>> ring.update(ring.sums(), 0.25).sums.turns
    0.25
    """

    sums: PhaseSums
    """The sums, for a whole turn. Events and :attr:`PhaseSums.turns` are of the part only."""
    change: NDArray[np.float32]
    """Squared difference from the expected sums, over all harmonics [thresholds²], shape (height, width)."""
    size: NDArray[np.float32]
    """Squared sums from the part of a turn alone [thresholds²], shape (height, width)."""
    noise: float
    """Mean square that an event at a random angle adds to both [thresholds²]."""


@guarded
class PhaseRing:
    """The events of the last turns of a stream, as counts of each pixel in the 64 bins of a turn.

    Its sums of whole turns equal :func:`phase_sums`.

    Parameters
    ----------
    width, height : int
        Sensor size [px].
    harmonics : int, optional
        Number of harmonics, 1 to 31.
    turns : int, optional
        Number of turns that are kept, 1 to 16, each in 128 bytes per pixel.
    extremes : bool, optional
        Add the extremes of the brightness, as :func:`phase_sums` does. The order of events within a bin is not known:
        where both polarities are in one bin, they are taken to change as seldom as they can.

    Raises
    ------
    AmiwarpError
        If a number is out of range.

    Examples
    --------
    >>> import numpy as np
    >>> ring = amiwarp.PhaseRing(4, 3, harmonics=2)
    >>> t = np.arange(0, 200_000, 100)
    >>> events = amiwarp.Events.from_arrays(0 * t + 1, 0 * t + 2, t, t % 200 == 0)
    >>> ring.add(events, amiwarp.Encoder.constant_speed(720.0, 0, 200_000))
    >>> ring.turns, ring.sums()
    (1.0, PhaseSums(4x3 px, 2 harmonics, 1 turns, 834 events))
    """

    def __init__(
        self,
        width: int,
        height: int,
        *,
        harmonics: int = HARMONICS,
        turns: int = 1,
        extremes: bool = True,
    ) -> None:
        self.extremes = extremes
        """Whether the extremes of the brightness are added."""
        self.width = whole(width, "width", 1, 1 << 15, " px")
        self.height = whole(height, "height", 1, 1 << 15, " px")
        self.harmonics = whole(harmonics, "harmonics", 1, (BINS - 1) // 2)
        self._kept = BINS * whole(turns, "turns", 1, MOST_TURNS)
        self._slots = self._kept + 1  # with the bin that is not complete
        self._on = np.zeros(self._slots, np.int64)
        self._off = np.zeros(self._slots, np.int64)
        self._began_us = np.zeros(self._slots, np.int64)
        self.direction = 0
        """Direction of the optic, 1 or -1; 0 before it is known."""
        self._first: int | None = None
        self.newest = 0
        """Number of the newest bin, which is not complete, counted from the angle 0 in the direction of the optic."""
        self._farthest = -math.inf
        self._make_planes()

    def _make_planes(self) -> None:
        """Make room for the counts of all bins."""
        self._planes = np.zeros((self._slots, self.width * self.height), np.uint16)
        inputs = [0, 0, 0, 0, self.width, 0, 0]
        self._count = RecordedLaunch(kernels.add_to_plane, inputs, [], device="cpu")

    def _clear_plane(self, slot: int) -> None:
        """Set the counts of a bin to 0."""
        self._planes[slot] = 0

    def _add_to_plane(self, slot: int, events: Events) -> None:
        """Add events to the counts of a bin."""
        columns = [
            np.ascontiguousarray(column, kind)
            for column, kind in ((events.x, np.uint16), (events.y, np.uint16), (events.p, np.uint8))
        ]
        for k, column in enumerate(columns):
            self._count.set(k, column.ctypes.data)
        self._count.set(3, len(events))
        self._count.set(5, self._planes[slot].ctypes.data)
        self._count.repeat()

    @property
    def bins(self) -> int:
        """Number of complete bins in a row before the newest one, at most as many as the ring keeps."""
        if self._first is None:
            return 0
        return min(self.newest - self._first - 1, self._kept)

    @property
    def turns(self) -> float:
        """Number of turns that the ring holds."""
        return max(self.bins, 0) / BINS

    def clear(self) -> None:
        """Forget all events, for example because the optic turns the other way."""
        self._first = None
        self._farthest = -math.inf
        self.direction = 0

    def split(self, events: Events, angles: Encoder | NDArray[np.float64]) -> list[RingPart]:
        """Return the parts of a packet, one for each bin, in the order of the angle.

        Parameters
        ----------
        events : Events
            Raw events, sorted by time, after the events before.
        angles : Encoder or ndarray
            Encoder that covers the events, or one unwrapped angle per event [rad], shape ``(n,)``.

        Returns
        -------
        list of RingPart
            The parts; none if the optic has not moved yet. If it turned back, the ring is cleared first.

        Raises
        ------
        AmiwarpError
            If the events are not sorted or lie outside the sensor, or the encoder does not cover them.
        """
        if not len(events):
            return []
        device_events.check_order(events)
        device_events.check_inside(events, self.width, self.height)
        places, angle = _corners(events, angles)
        moved = float(angle[-1] - angle[0])
        if self.direction * float(angle[-1]) < self._farthest - BACKWARDS:
            self.clear()
        if not self.direction:
            if abs(moved) < LEAST_MOTION:
                return []
            self.direction = 1 if moved > 0.0 else -1
        farthest = np.maximum.accumulate(np.append(self._farthest, self.direction * angle))[1:]
        self._farthest = float(farthest[-1])

        low = math.floor(farthest[0] / BIN)
        high = math.floor(farthest[-1] / BIN)
        edges = np.arange(low + 1, high + 1) * BIN
        if isinstance(angles, np.ndarray):
            starts = np.searchsorted(farthest, edges)
        else:
            starts = np.searchsorted(events.t, np.interp(edges, farthest, places))
        stops = [0, *starts.tolist(), len(events)]
        found = zip(range(low, high + 1), stops[:-1], stops[1:], strict=True)
        return [
            RingPart(number, events[start:stop]) for number, start, stop in found if stop > start
        ]

    def add_part(self, part: RingPart) -> None:
        """Count the events of a part. A later bin than before completes the bins before it.

        Parameters
        ----------
        part : RingPart
            A part by :meth:`split`.
        """
        if self._first is None or part.number - self.newest >= self._slots:
            self._first = part.number
            self.newest = part.number - 1
        for number in range(self.newest + 1, part.number + 1):
            slot = number % self._slots
            self._clear_plane(slot)
            self._on[slot] = 0
            self._off[slot] = 0
            self._began_us[slot] = part.events.t[0]
        self.newest = part.number

        slot = part.number % self._slots
        on = int(np.count_nonzero(part.events.p))
        self._on[slot] += on
        self._off[slot] += len(part.events) - on
        self._add_to_plane(slot, part.events)

    def add(self, events: Events, angles: Encoder | NDArray[np.float64]) -> None:
        """Count the events of a packet.

        Parameters
        ----------
        events : Events
            Raw events, sorted by time, after the events before.
        angles : Encoder or ndarray
            Encoder that covers the events, or one unwrapped angle per event [rad], shape ``(n,)``.

        Raises
        ------
        AmiwarpError
            As :meth:`split`.
        """
        for part in self.split(events, angles):
            self.add_part(part)

    def span_us(self, bins: int) -> tuple[int, int]:
        """Return the times at which the last complete bins begin and end.

        Parameters
        ----------
        bins : int
            Number of complete bins, at most :attr:`bins`.

        Returns
        -------
        tuple of int
            Time of the first event, and of the first event after them [us].
        """
        first = (self.newest - bins) % self._slots
        return int(self._began_us[first]), int(self._began_us[self.newest % self._slots])

    def sums(self, turns: float = 1.0, *, weights: Sequence[float] | None = None) -> PhaseSums:
        """Return the sums in phase over the last turns, or the last part of a turn.

        Parameters
        ----------
        turns : float, optional
            Number of turns up to the last complete bin: a whole number, or a part of one turn, which is rounded to
            64ths. A part of a turn leaves some of the sums unknown; these are near 0.
        weights : sequence of float, optional
            Weight of each of several turns, the newest first, such as ``[1, 0.5, 0.25]``. By default they are equal.

        Returns
        -------
        PhaseSums
            The sums, for a single whole turn.

        Raises
        ------
        AmiwarpError
            If the ring does not hold these turns, or a number is out of range.
        """
        numbers = self._last_bins(turns)
        shares = _shares(weights, max(1, len(numbers) // BINS))
        weight = 0.0 if len(numbers) >= BINS else WEIGHT_OF_PRIOR
        factors, _ = unmixing(self._angles(numbers[-BINS:]), self.harmonics, weight)
        shared = np.tile(factors, len(shares)) * np.repeat(shares[::-1], factors.shape[1])
        return self._weighted(numbers, shared, None).sums

    def update(
        self, prior: PhaseSums, turns: float, *, weight_of_prior: float = WEIGHT_OF_PRIOR
    ) -> PhaseUpdate:
        """Return earlier sums, updated by the last part of a turn.

        Parameters
        ----------
        prior : PhaseSums
            Sums that are expected, such as those up to the picture before.
        turns : float
            The part of a turn up to the last complete bin, at most 1, which is rounded to 64ths.
        weight_of_prior : float, optional
            Weight of the expected sums, relative to the sums of a whole turn, above 0.

        Returns
        -------
        PhaseUpdate
            The sums, and how much they have changed.

        Raises
        ------
        AmiwarpError
            If the ring does not hold this part, a number is out of range, or the prior has another shape.
        """
        numbers = self._last_bins(real(turns, "turns", 1.0 / BINS, 1.0))
        weight = real(weight_of_prior, "weight_of_prior", 1e-6, 1e6)
        if prior.values.shape != (self.harmonics, self.height, self.width):
            raise AmiwarpError(
                f"the prior has the shape {prior.values.shape}, the ring has {self.harmonics} harmonics of "
                f"{self.width}x{self.height} px; give sums of this ring"
            )
        factors, expected = unmixing(self._angles(numbers), self.harmonics, weight)
        return self._weighted(numbers, factors, (prior.values, expected))

    def _last_bins(self, turns: float) -> NDArray[np.int64]:
        """Return the numbers of the bins of the last turns; raise :class:`AmiwarpError` without them."""
        turns = real(turns, "turns", 1.0 / BINS, self._kept / BINS)
        bins = round(turns * BINS)
        if bins > BINS and bins % BINS:
            raise AmiwarpError(f"turns is {turns:g}; give a whole number, or a part of one turn")
        if bins > self.bins:
            raise AmiwarpError(
                f"the ring holds {self.turns:.3g} turns, not {turns:g}; add more events first"
            )
        return np.arange(self.newest - bins, self.newest)

    def _with_earlier(self, numbers: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the numbers of bins after some that tell the polarity before them, unless they are whole turns."""
        if not self.extremes or len(numbers) % BINS == 0:
            return numbers
        earlier = min(self.bins - len(numbers), EARLIER)
        return np.arange(numbers[0] - earlier, numbers[-1] + 1)

    def _angles(self, numbers: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the angles at the middles of bins [rad]."""
        return np.asarray(self.direction * (numbers + 0.5) * BIN, np.float64)

    def _weighted(
        self,
        numbers: NDArray[np.int64],
        factors: NDArray[np.complex128],
        prior: tuple[NDArray[np.complex64], NDArray[np.complex128]] | None,
    ) -> PhaseUpdate:
        """Return sums over bins, with a factor for each harmonic and bin, and over the prior with its factors."""
        pixels = self.width * self.height
        rows = [_rows(self.direction * factors)]
        expected = np.zeros((0, pixels, 2), np.float32)
        if prior is not None:
            values, of_prior = prior
            rows.append(_rows(of_prior))
            expected = values.view(np.float32).reshape(self.harmonics, pixels, 2)
        ratio = self._off_ratio()
        # NumPy's memory, which has large pages
        values_out = np.empty((self.harmonics, pixels), np.complex64)
        counts = wp.empty((3, pixels), dtype=int, device="cpu")
        changed = wp.empty((2, pixels), dtype=float, device="cpu")
        inputs = [
            wp.array(self._planes, dtype=wp.uint16, device="cpu", copy=False),
            wp.array(self._with_earlier(numbers) % self._slots, dtype=int, device="cpu"),
            wp.array(np.concatenate(rows), dtype=float, device="cpu"),
            ratio,
            EXTREME if self.extremes else 0.0,
            wp.array(expected, dtype=wp.vec2, device="cpu", copy=False),
        ]
        outputs = [shared_pairs(values_out), counts, changed]
        blocks = -(-pixels // kernels.BLOCK)
        launch(kernels.sum_planes, blocks, inputs, outputs, device="cpu", smallest=1)

        shape = (self.height, self.width)
        on, off, changes = counts.numpy().reshape(3, *shape)
        sums = PhaseSums(
            values_out.reshape(self.harmonics, *shape),
            on,
            off,
            len(numbers) / BINS,
            ratio,
            changes if self.extremes else None,
        )
        change, size = changed.numpy().reshape(2, *shape)
        return PhaseUpdate(sums, change, size, square_of_event(factors))

    def _off_ratio(self) -> float:
        """Return ON events divided by OFF events over the last whole turn, or what there is of it."""
        used = np.arange(self.newest - min(self.bins, BINS), self.newest) % self._slots
        on = int(self._on[used].sum())
        off = int(self._off[used].sum())
        if not on or not off:
            return 1.0
        return float(np.clip(on / off, LEAST_RATIO, 1.0 / LEAST_RATIO))


def _corners(
    events: Events, angles: Encoder | NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return times between which the angle changes evenly, and the angles there [rad]: of all events, or samples."""
    if isinstance(angles, np.ndarray):
        found = array(angles, "angles", "iuf").astype(np.float64)
        if found.shape != (len(events),) or not np.isfinite(found).all():
            raise AmiwarpError(
                f"angles have shape {found.shape}; expected a finite angle in rad for each of {len(events):,} events"
            )
        return events.t, found
    first = int(events.t[0])
    last = int(events.t[-1])
    samples = np.rint(angles.t - angles.clock_offset_us).astype(np.int64)
    inside = samples[(samples > first) & (samples < last)]
    times = np.concatenate([[first], inside, [last]])
    return times, angles.angle_at(times)


def _shares(weights: Sequence[float] | None, turns: int) -> NDArray[np.float64]:
    """Return the share of each turn, the newest first."""
    if weights is None:
        return np.full(turns, 1.0 / turns)
    if len(weights) != turns:
        raise AmiwarpError(f"{len(weights)} weights are given for {turns} turns; give one for each")
    shares = np.array([real(weight, "weights", 0.0) for weight in weights])
    if not shares.any():
        raise AmiwarpError("all weights are 0; give a weight above 0")
    return shares / shares.sum()


def _rows(factors: NDArray[np.complex128]) -> NDArray[np.float32]:
    """Return factors of each harmonic as rows for a kernel, filled up to a multiple of the columns it takes at once."""
    harmonics, count = factors.shape
    columns = -(-2 * harmonics // kernels.TOGETHER) * kernels.TOGETHER
    rows = np.zeros((count, columns), np.float32)
    rows[:, 0 : 2 * harmonics : 2] = factors.real.T
    rows[:, 1 : 2 * harmonics : 2] = factors.imag.T
    return rows


def square_of_event(factors: NDArray[np.complex128]) -> float:
    """Return the mean square that an event at a random angle adds to the sums, by its factors [thresholds²]."""
    return float((np.abs(factors) ** 2).sum(axis=0).mean())


def unmixing(
    angles: NDArray[np.float64], harmonics: int, weight: float
) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
    """Return the factors with which bins at some angles, and expected sums, make the sums of a whole turn.

    The first have the shape (harmonics, bins), the others (harmonics, 2 harmonics): for the real part and for the
    imaginary part of each expected sum.
    """
    order = np.arange(-harmonics, harmonics + 1)
    attenuation = bin_attenuation(order, BINS)
    waves = np.exp(-1j * np.outer(order, angles))
    gram = waves @ waves.conj().T / BINS
    inverse = np.linalg.inv(gram + weight * np.eye(len(order))) / attenuation[:, None]
    factors = inverse @ waves / math.tau
    expected = (weight * inverse * attenuation)[harmonics + 1 :]
    own = expected[:, harmonics + 1 :]
    conjugates = expected[:, :harmonics][:, ::-1]
    parts = np.stack([own + conjugates, 1j * (own - conjugates)], axis=2)
    return factors[harmonics + 1 :], parts.reshape(harmonics, 2 * harmonics)
