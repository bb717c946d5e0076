"""Sums of each pixel's events in phase with the optic: what a turn tells of the scene, without moving an event.

At rest, the log intensity that a pixel sees is a function of the optic's angle θ, and its events are the steps of this
function. So the sums over a whole turn

    A_m = 1 / (2π) Σ p exp(-i m θ)        p = +1 for ON, minus the ratio of the thresholds for OFF

are i m times its Fourier coefficients, in thresholds. ``docs/explanation/phase.md`` derives what follows from them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events import device_events
from amiwarp.events.device_events import DeviceEvents, device_for
from amiwarp.events.encoder import Encoder
from amiwarp.events.recording import Events
from amiwarp.imaging.phase_device import DeviceSums
from amiwarp.imaging.phase_tables import (
    EXTREME,
    LEAST_RATIO,
    MOST_EVENTS,
    angle_table,
    extreme_table,
    ratio_of_counts,
    scales_of,
)
from amiwarp.imaging.uploaded_events import upload_events
from amiwarp.kernels import phase as kernels
from amiwarp.kernels.launch import launch
from amiwarp.optics.orbit import LockedAngles
from amiwarp.schema.calls import guarded
from amiwarp.tasks import cpu_threads
from amiwarp.validation import array, real, whole

HARMONICS = 9
"""Number of harmonics of the angle. More of them change a picture of an orbit of 5 to 9 px by less than 0.001."""
BINS = 64
"""Number of bins of a turn. They leave out what changes within a 64th of a turn."""
MOST_BINS = 1024
"""Largest number of bins: the rows of both polarities fit into the bits of ``kernels.ROW_BITS``."""
MOST_HARMONICS = 64
BLOCK_BYTES = 1 << 18
"""Size of the integers of a block of lines, which fit into a core's cache."""
RANDOM_CHANGE = 4.0 * EXTREME + 3.0 * EXTREME**2
"""What each change of polarity adds to the expected square of a sum of random events, relative to an event: half of
these have another polarity than the event before, and half than the event after."""
MOST_COUNT = (1 << 15) - 1
"""Largest number of events of a polarity that a microcontroller counts at a pixel: changes of polarity, up to twice as
many, fit into 16 bits."""


@dataclass(frozen=True, eq=False)
class PhaseSums:
    """Sums of each pixel's events in phase with an angle; made by :func:`phase_sums`.

    Examples
    --------
    >>> import numpy as np
    >>> events = amiwarp.Events.from_arrays([1, 1], [0, 0], [0, 10], [1, 0])
    >>> sums = amiwarp.phase_sums(events, np.array([0.0, np.pi]), 2, 1, harmonics=1)
    >>> sums.harmonics, abs(sums.values[0, 0]).round(3)
    (1, array([0.   , 0.573], dtype=float32))
    """

    values: NDArray[np.complex64]
    """Sums A_1, A_2, … [thresholds], for a single turn: divided by :attr:`turns`. Shape (harmonics, height, width). The
    sums below 0 are their conjugates."""
    on: NDArray[np.int32]
    """Number of ON events, shape (height, width)."""
    off: NDArray[np.int32]
    """Number of OFF events, shape (height, width)."""
    turns: float
    """Number of turns over which the events were summed."""
    off_ratio: float
    """OFF threshold divided by the ON threshold, with which OFF events were weighted."""
    changes: NDArray[np.int32] | None = None
    """Number of changes of polarity, shape (height, width), if the extremes between them were added to the sums."""
    weighted_noise: NDArray[np.float32] | None = None
    """Expected square of each sum of random events, shape (height, width), if the sums are a weighted mean."""
    locked: LockedAngles | None = None
    """How the second angle of an optic follows the first one: the angle of the sums is the first one, divided by
    :attr:`LockedAngles.turns`. None for one angle."""

    @classmethod
    @guarded
    def from_integers(
        cls,
        integers: NDArray[np.integer[Any]],
        *,
        turns: float,
        off_ratio: float,
        bins: int = BINS,
        direction: int = 1,
    ) -> PhaseSums:
        """Return the sums whose integers a microcontroller has added up, with the C of ``amiwarp export-c``.

        Parameters
        ----------
        integers : ndarray
            Integers of each pixel: numbers of OFF events, ON events and changes of polarity, then sums of cosine and
            sine of each harmonic, in units of 1/4096. Shape (height, width, 3 + 2 harmonics).
        turns : float
            Number of turns over which the events were summed.
        off_ratio : float
            OFF threshold divided by the ON threshold, as in the C.
        bins : int, optional
            Number of bins of a turn, as in the C.
        direction : int, optional
            Sign of the speed of the angle, 1 or -1.

        Returns
        -------
        PhaseSums
            The sums, bit for bit as :func:`phase_sums` gives them with these settings.

        Raises
        ------
        AmiwarpError
            If shape or numbers are out of range, the events of a pixel cannot have given its integers, as after
            a wrong ``off_ratio`` or order of bytes, or a pixel has as many events as it takes, and may have lost some.

        Examples
        --------
        >>> import numpy as np
        >>> integers = np.zeros((1, 2, 5), np.int32)
        >>> integers[0, 1] = [0, 1, 0, 4091, 201]
        >>> amiwarp.PhaseSums.from_integers(integers, turns=1.0, off_ratio=1.0)
        PhaseSums(2x1 px, 1 harmonics, 1 turns, 1 events)
        """
        bins = whole(bins, "bins", 3, MOST_BINS)
        turns = real(turns, "turns", 1e-3, 1e6)
        off_ratio = real(off_ratio, "off_ratio", LEAST_RATIO, 1.0 / LEAST_RATIO)
        if direction not in (-1, 1):
            raise AmiwarpError(f"direction is {direction!r}; give 1 or -1")
        found = _checked_integers(integers, bins, off_ratio)
        off, on, changes = (np.ascontiguousarray(found[:, :, k]) for k in range(3))
        harmonics = (found.shape[2] - 3) // 2
        scales = wp.array(scales_of(harmonics, bins, turns, direction), dtype=float, device="cpu")
        values = np.empty((harmonics, *on.shape), np.complex64)
        sums = _shared(found[:, :, 3:].reshape(on.size, 2 * harmonics))
        outputs = [shared_pairs(values.reshape(harmonics, on.size))]
        launch(kernels.complex_sums, on.size, [sums, scales], outputs, device="cpu")
        return cls(values, on, off, turns, off_ratio, changes)

    @property
    def harmonics(self) -> int:
        """Number of harmonics."""
        return len(self.values)

    @property
    def events(self) -> int:
        """Number of events."""
        return int(self.on.sum(dtype=np.int64) + self.off.sum(dtype=np.int64))

    def __repr__(self) -> str:
        count, height, width = self.values.shape
        return f"PhaseSums({width}x{height} px, {count} harmonics, {self.turns:.3g} turns, {self.events:,} events)"

    @property
    def threshold_ratio(self) -> NDArray[np.float32]:
        """OFF threshold divided by the ON threshold of each pixel, shape (height, width); NaN without OFF events.

        At rest a pixel's brightness is the same after a whole turn, so that its ON and OFF steps cancel.
        """
        ratio = np.full(self.on.shape, np.nan, np.float32)
        np.divide(self.on, self.off, out=ratio, where=self.off > 0)
        return ratio

    @property
    def random_square(self) -> NDArray[np.float32]:
        """Expected square of each sum if all events were at random angles [thresholds²], shape (height, width)."""
        if self.weighted_noise is not None:
            return self.weighted_noise
        weights = self.on + self.off_ratio**2 * self.off
        if self.changes is not None:
            weights = weights + RANDOM_CHANGE * self.changes
        return (weights / (math.tau * self.turns) ** 2).astype(np.float32)

    @property
    def strength(self) -> NDArray[np.float32]:
        """Rms of the brightness over a turn, without its mean [thresholds], shape (height, width).

        Hot pixels and noise hardly count: their events come at any angle.
        """
        order = np.arange(1, self.harmonics + 1, dtype=np.float32)[:, None, None]
        coefficients = np.abs(self.values) / order
        return np.sqrt(2.0 * (coefficients**2).sum(axis=0)).astype(np.float32)


@guarded
def phase_sums(
    events: Events | DeviceEvents,
    angles: Encoder | NDArray[np.float64],
    width: int,
    height: int,
    *,
    turns: float | None = None,
    direction: int = 0,
    off_ratio: float | None = None,
    harmonics: int = HARMONICS,
    bins: int = BINS,
    extremes: bool = True,
    device: Any = None,
) -> PhaseSums:
    """Sum the events of each pixel in phase with an angle.

    The sums mean something over whole turns: cut the events by :func:`windows` with ``turns``. Over several turns, what
    repeats in each turn remains, and all else averages out.

    Parameters
    ----------
    events : Events or DeviceEvents
        Raw events, sorted by time.
    angles : Encoder or ndarray
        Encoder that covers the events, or one unwrapped angle per event [rad], shape ``(n,)``. With the angles 2π f t
        of a lamp that flickers with the frequency f, the first sum is what flickers with it.
    width, height : int
        Sensor size [px].
    turns : float, optional
        Number of turns that the events cover. By default the angle from the first to the last event, to the next whole
        turn, at least 1.
    direction : int, optional
        Sign of the speed of the angle, 1 or -1: events tell the change in time, the sums the change with the angle. By
        default, 0, the sign of the angle from the first to the last event.
    off_ratio : float, optional
        OFF threshold divided by the ON threshold, 0.1 to 10. By default the number of ON events divided by the number
        of OFF events, because over a whole turn the steps of the brightness cancel; 1 without either.
    harmonics : int, optional
        Number of harmonics, 1 to 64 and less than half of ``bins``.
    bins : int, optional
        Number of bins of a turn, up to 1024.
    extremes : bool, optional
        Add the extremes of the brightness, for whole turns: where the polarity changes, it went beyond both events, on
        average by half a threshold. Without them, weak edges come out too weak.
    device : str or warp.Device, optional
        Device to compute on, by default the events' device or the CPU.

    Returns
    -------
    PhaseSums
        The sums, in host memory. They do not depend on the device, bit for bit.

    Raises
    ------
    AmiwarpError
        If a number is out of range, the encoder does not cover the events, an event lies outside the sensor, or a
        pixel has more than about 250,000 events.

    Examples
    --------
    >>> events = amiwarp.Events.from_arrays([0, 0], [0, 0], [0, 500], [1, 0])
    >>> encoder = amiwarp.Encoder.constant_speed(60_000.0, 0, 1000)
    >>> amiwarp.phase_sums(events, encoder, 4, 2)
    PhaseSums(4x2 px, 9 harmonics, 1 turns, 2 events)
    """
    width = whole(width, "width", 1, 1 << 15, " px")
    height = whole(height, "height", 1, 1 << 15, " px")
    bins = whole(bins, "bins", 3, MOST_BINS)
    harmonics = whole(harmonics, "harmonics", 1, min(MOST_HARMONICS, (bins - 1) // 2))
    device = wp.get_device(device_for(events, device))
    device_events.check_order(events)
    device_events.check_inside(events, width, height)
    if isinstance(angles, np.ndarray):
        angles = _checked_angles(angles, len(events))
    swept = _swept(events, angles)
    if turns is None:
        # 1e-9: a whole turn whose last digits are lost is one turn
        turns = float(max(1, math.ceil(abs(swept) / math.tau - 1e-9)))
    turns = real(turns, "turns", 1e-3, 1e6)
    direction = whole(direction, "direction", -1, 1) or (1 if swept >= 0.0 else -1)
    if off_ratio is not None:
        off_ratio = real(off_ratio, "off_ratio", LEAST_RATIO, 1.0 / LEAST_RATIO)
    if device.is_cuda:
        there = DeviceSums(width, height, harmonics, bins, device, extremes=extremes)
        there.sum(events, angles, turns=turns, direction=direction, off_ratio=off_ratio)
        return copied_sums(there)
    if off_ratio is None:
        off_ratio = _ratio_of_counts(events)

    table = angle_table(bins, harmonics, off_ratio)
    further = extreme_table(table) if extremes else np.zeros_like(table)
    weights = _Weights(
        wp.array(np.concatenate([table, further]), dtype=int, device=device),
        wp.array(scales_of(harmonics, bins, turns, direction), dtype=float, device=device),
    )
    uploaded = upload_events(events, angles, device)
    blocks = _by_lines(uploaded.arrays, len(events), width, height, weights)
    counts, values = _summed(blocks, width * height, weights)
    off, on, changes = counts.reshape(3, height, width)
    check_room(on, off, off_ratio)
    values = values.reshape(harmonics, height, width)
    return PhaseSums(values, on, off, turns, off_ratio, changes if extremes else None)


def sum_turns(
    there: DeviceSums, events: Events | DeviceEvents, encoder: Encoder, turns: float
) -> None:
    """Sum the events of whole turns on a device, as :func:`phase_sums` does, and with its checks."""
    device_events.check_order(events)
    device_events.check_inside(events, there.width, there.height)
    there.sum(events, encoder, turns=turns)


def copied_sums(sums: DeviceSums) -> PhaseSums:
    """Return the sums that are on a device, copied. Raises :class:`AmiwarpError` as :func:`check_room`."""
    off, on, changes = sums.counts.numpy()
    off_ratio, _ = sums.notes()
    check_room(on, off, off_ratio)
    values = sums.values.numpy().view(np.complex64)[:, :, :, 0]
    return PhaseSums(values, on, off, sums.turns, off_ratio, changes if sums.extremes else None)


@dataclass(frozen=True)
class _Weights:
    """What events add to their pixels, and how the integers become sums, on a device."""

    table: wp.array
    """As :func:`angle_table` gives it, and then :func:`extreme_table`."""
    scales: wp.array
    """Factor of the integers of each harmonic."""

    @property
    def bins(self) -> int:
        """Number of bins of a turn."""
        return len(self.table) // 4

    @property
    def columns(self) -> int:
        """Number of integers of a pixel."""
        return int(self.table.shape[1])


@dataclass(frozen=True)
class _Blocks:
    """Events ordered by blocks of pixels, on a device."""

    words: wp.array
    """Pixel in its block and row of the table of each event."""
    starts: wp.array
    """First word of each block, and number of words."""
    shares: wp.array
    """First block of each thread, and number of blocks."""
    pixels: int
    """Number of pixels of a block."""


def _checked_angles(angles: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """Return angles as float64 after checking that there is a finite one for each event."""
    found = array(angles, "angles", "iuf").astype(np.float64)
    if found.shape != (count,) or not np.isfinite(found).all():
        raise AmiwarpError(
            f"angles have shape {found.shape}; expected a finite angle in rad for each of {count:,} events"
        )
    return found


def _swept(events: Events | DeviceEvents, angles: Encoder | NDArray[np.float64]) -> float:
    """Return the angle from the first event to the last one [rad]; 0 without events."""
    if not len(events):
        return 0.0
    if isinstance(angles, np.ndarray):
        ends = angles[[0, -1]]
    else:
        ends = angles.angle_at(np.array(device_events.time_span(events)))
    return float(ends[1] - ends[0])


def _ratio_of_counts(events: Events | DeviceEvents) -> float:
    """Return the number of ON events divided by the number of OFF events; 1 without either."""
    polarities = events.p.numpy() if isinstance(events, DeviceEvents) else events.p
    on = int(np.count_nonzero(polarities))
    return ratio_of_counts(on, len(events) - on)


def _by_lines(arrays: Any, count: int, width: int, height: int, weights: _Weights) -> _Blocks:
    """Order events on a CPU by blocks of lines whose integers fit into a core's cache."""
    lines = max(1, BLOCK_BYTES // (4 * weights.columns * width))
    blocks = -(-height // lines)  # rounded up
    parts = cpu_threads()

    numbers = np.zeros((parts, blocks), np.int32)
    inputs = [arrays.y, lines, parts, count]
    launch(kernels.count_blocks, parts, inputs, [_shared(numbers)], device="cpu", smallest=1)

    # The words of a block lie together, in the order of the parts.
    ends = np.cumsum(numbers.T.ravel(), dtype=np.int32)
    places = np.ascontiguousarray((ends - numbers.T.ravel()).reshape(blocks, parts).T)
    starts = np.append(places[0], np.int32(count))
    words = np.empty(count, np.int32)
    inputs = [arrays, width, lines, parts, count, weights.bins]
    outputs = [_shared(places), _shared(words)]
    launch(kernels.order_by_blocks, parts, inputs, outputs, device="cpu", smallest=1)

    # Each thread has as many events as the others.
    shares = np.searchsorted(starts, np.arange(parts + 1) * (count / parts)).astype(np.int32)
    shares[0] = 0
    shares[-1] = blocks
    return _Blocks(_shared(words), _shared(starts), _shared(shares), lines * width)


def _summed(
    blocks: _Blocks, pixels: int, weights: _Weights
) -> tuple[NDArray[np.int32], NDArray[np.complex64]]:
    """Return numbers of OFF and ON events and of changes, shape (3, pixels), and sums, shape (harmonics, pixels)."""
    _, counts, values = _with_integers(blocks, pixels, weights)
    return counts, values


def _with_integers(
    blocks: _Blocks, pixels: int, weights: _Weights
) -> tuple[wp.array, NDArray[np.int32], NDArray[np.complex64]]:
    """Return the integers of each thread's last block, shape (threads pixels, columns), and for all pixels the numbers
    of OFF and ON events and of changes, shape (3, pixels), and the sums, shape (harmonics, pixels)."""
    device = weights.table.device
    threads = len(blocks.shares) - 1
    room = threads * blocks.pixels
    harmonics = len(weights.scales)
    sums = wp.empty((room, weights.columns + int(kernels.NOTES)), dtype=int, device=device)
    if device.is_cpu:
        # NumPy's memory, which has large pages
        counts = _shared(np.empty((3, pixels), np.int32))
        values = shared_pairs(np.empty((harmonics, pixels), np.complex64))
    else:
        counts = wp.empty((3, pixels), dtype=int, device=device)
        values = wp.empty((harmonics, pixels), dtype=wp.vec2, device=device)
    inputs = [blocks.words, blocks.starts, blocks.shares, weights.table, weights.scales]
    inputs.append(blocks.pixels)
    outputs = [sums, counts, values]
    launch(kernels.sum_blocks, threads, inputs, outputs, device=device, smallest=1)
    return sums, counts.numpy(), values.numpy().view(np.complex64).reshape(harmonics, pixels)


def integer_sums(
    arrays: Any, count: int, width: int, height: int, table: NDArray[np.int32]
) -> NDArray[np.int32]:
    """Return the integers of all pixels from events on the CPU, shape (height, width, 3 + 2 harmonics).

    ``table`` is :func:`angle_table`, then :func:`extreme_table`. There may be 2^20 pixels.
    """
    scales = np.ones((table.shape[1] - int(kernels.COUNTS)) // 2)
    weights = _Weights(_shared(table), wp.array(scales, dtype=float, device="cpu"))
    words = _shared(np.empty(count, np.int32))
    inputs = [arrays, width, height, 1, count, weights.bins]
    outputs = [_shared(np.zeros((1, 1), np.int32)), words]
    launch(kernels.order_by_blocks, 1, inputs, outputs, device="cpu", smallest=1)
    starts = _shared(np.array([0, count], np.int32))
    blocks = _Blocks(words, starts, _shared(np.array([0, 1], np.int32)), width * height)
    sums, counts, _ = _with_integers(blocks, width * height, weights)
    of_harmonics = sums.numpy()[:, int(kernels.COUNTS) : weights.columns]
    found = np.hstack([counts.T, of_harmonics])
    return found.reshape(height, width, -1)


def most_of_polarity(off_ratio: float) -> int:
    """Return the number of events of each polarity that a pixel takes on a microcontroller: its sums have room."""
    return min(MOST_COUNT, math.floor((MOST_EVENTS - 1) / (1.0 + off_ratio)))


def _checked_integers(
    integers: NDArray[np.integer[Any]], bins: int, off_ratio: float
) -> NDArray[np.int32]:
    """Return the integers of pixels as int32 after checking that events can have given them."""
    found = array(integers, "integers", "iu")
    columns = found.shape[-1] if found.ndim == 3 else 0
    most_harmonics = min(MOST_HARMONICS, (bins - 1) // 2)
    if not (5 <= columns <= 3 + 2 * most_harmonics and columns % 2 == 1 and found.size):
        raise AmiwarpError(
            f"integers have shape {found.shape}; expected (height, width, 3 + 2 harmonics), with at most "
            f"{most_harmonics} harmonics for {bins} bins"
        )
    # int64 has room for all that int32 and uint32 hold
    found = found.astype(np.int64)
    off = found[:, :, 0]
    on = found[:, :, 1]
    changes = found[:, :, 2]
    most = most_of_polarity(off_ratio)
    _refuse_pixel((off < 0) | (on < 0), found, "has a negative number of events")
    _refuse_pixel(
        (off >= most) | (on >= most),
        found,
        f"has {most:,} events of a polarity or more, and may have lost some; leave it out, or sum fewer turns",
    )
    # Around the turn, each change of polarity is followed by one back.
    impossible = (changes < 0) | (changes > 2 * np.minimum(off, on)) | (changes % 2 == 1)
    _refuse_pixel(impossible, found, "has a number of changes that its events cannot give")
    of_on = kernels.UNIT
    of_off = round(kernels.UNIT * off_ratio)
    of_change = round(EXTREME * of_on) + round(EXTREME * of_off)
    largest = of_on * on + of_off * off + of_change * changes
    _refuse_pixel(
        (np.abs(found[:, :, 3:]) > largest[:, :, None]).any(axis=2),
        found,
        f"has sums that its events cannot give; read them as the C wrote them; its off_ratio may not be {off_ratio:g}",
    )
    return found.astype(np.int32)


def _refuse_pixel(wrong: NDArray[np.bool_], integers: NDArray[np.int64], reason: str) -> None:
    """Raise :class:`AmiwarpError` with the first pixel that is wrong."""
    if wrong.any():
        y, x = np.unravel_index(int(np.argmax(wrong)), wrong.shape)
        first = ", ".join(str(value) for value in integers[y, x, :5])
        raise AmiwarpError(f"integers of pixel ({x}, {y}), {first} …: it {reason}")


def _shared(values: NDArray[Any]) -> wp.array:
    """Return a Warp array in the memory of a NumPy array."""
    return wp.array(values, device="cpu", copy=False)


def shared_pairs(values: NDArray[np.complex64]) -> wp.array:
    """Return complex numbers as a Warp array of pairs in the same memory, on the CPU."""
    pairs = values.view(np.float32).reshape(*values.shape, 2)
    return wp.array(pairs, dtype=wp.vec2, device="cpu", copy=False)


def check_room(on: NDArray[np.int32], off: NDArray[np.int32], off_ratio: float) -> None:
    """Raise :class:`AmiwarpError` if the sums of a pixel may have overflowed."""
    # as the largest entries of the table weigh them
    weights = on.astype(np.int64) + np.ceil(off_ratio * off).astype(np.int64)
    if weights.size and int(weights.max()) > MOST_EVENTS:
        y, x = np.unravel_index(int(np.argmax(weights)), weights.shape)
        raise AmiwarpError(
            f"pixel ({x}, {y}) has {int(on[y, x]) + int(off[y, x]):,} events, too many; remove hot pixels with "
            "'amiwarp filter --hot-pixels', or sum fewer turns"
        )


@guarded
def weighted_sums(parts: Sequence[PhaseSums], weights: Sequence[float]) -> PhaseSums:
    """Return the weighted mean of sums, such as the sums of successive turns with weights that decay.

    Parameters
    ----------
    parts : sequence of PhaseSums
        Sums of the same size with the same number of harmonics.
    weights : sequence of float
        Weight of each, at least 0, not all 0.

    Returns
    -------
    PhaseSums
        The mean sums, with the events and turns of all parts whose weight is not 0.

    Raises
    ------
    AmiwarpError
        If sizes or numbers differ, or the weights are not as described.

    Examples
    --------
    >>> import numpy as np
    >>> events = amiwarp.Events.from_arrays([1], [0], [0], [1])
    >>> one = amiwarp.phase_sums(events, np.array([0.0]), 2, 1, harmonics=1)
    >>> amiwarp.weighted_sums([one, one], [1.0, 0.5]).turns
    2.0
    """
    if not parts or len(parts) != len(weights):
        raise AmiwarpError(
            f"{len(parts)} sums are given with {len(weights)} weights; give a weight for each"
        )
    shapes = {part.values.shape for part in parts}
    if len(shapes) > 1:
        raise AmiwarpError(f"the sums have the shapes {sorted(shapes)}; give sums of one shape")
    if len({part.changes is None for part in parts}) > 1:
        raise AmiwarpError("some sums have extremes and some do not; give sums of one kind")
    shares = np.array([real(weight, "weights", 0.0) for weight in weights])
    if not shares.any():
        raise AmiwarpError("all weights are 0; give a weight above 0")
    shares /= shares.sum()
    used = [(part, share) for part, share in zip(parts, shares, strict=True) if share > 0.0]
    values = np.zeros_like(used[0][0].values)
    for part, share in used:
        values += np.float32(share) * part.values
    on = np.zeros_like(used[0][0].on)
    off = np.zeros_like(on)
    for part, _ in used:
        on += part.on
        off += part.off
    turns = float(sum(part.turns for part, _ in used))
    ratio = sum(float(share) * part.off_ratio for part, share in used)
    changes = [part.changes for part, _ in used if part.changes is not None]
    total = np.add.reduce(changes) if changes else None
    noise = sum(float(share) ** 2 * part.random_square for part, share in used)
    return PhaseSums(values, on, off, turns, ratio, total, np.asarray(noise, np.float32))
