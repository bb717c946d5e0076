"""Pictures of a stream from sums in phase: each from the newest part of a turn, with the sums before as its prior.

Brightness that changes differently from what the sums before say is marked as moved. It is kept out of the long waves
of the rest: at moved pixels these come from the gradient of the picture before. Repeated with every picture, this is
the least-squares picture of the gradients that are known.
"""

from __future__ import annotations

import math
import time
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from amiwarp.errors import AmiwarpError
from amiwarp.events.device_events import check_sensor
from amiwarp.events.encoder_stream import EncoderStream, check_prisms
from amiwarp.events.recording import Events
from amiwarp.imaging.phase import BINS, PhaseSums
from amiwarp.imaging.phase_ring import PhaseRing, PhaseUpdate
from amiwarp.optics.models.base import Model
from amiwarp.reconstruction.image_in_phase import AROUND_PX, mean_around
from amiwarp.reconstruction.phase_lag import lag_of
from amiwarp.reconstruction.phase_window import harmonics_for, picture_of
from amiwarp.reconstruction.picture import Picture
from amiwarp.reconstruction.picture_in_phase import joined_picture, motion_of, phase_picture
from amiwarp.schema.calls import guarded
from amiwarp.validation import TIME_LIMIT, real, whole

LAG_TURNS = 8
"""Number of turns after which the lag of events is found again: it changes with the speed of the optic."""
MOVED = 0.5
"""Misfit over which something has moved at a pixel."""
LEAST_EVENTS = 60
"""Number of events in the square around a pixel below which its misfit is weakened: some are few by chance."""
RIM_PX = 25
"""Side of the square around a moved pixel that counts as moved [px]: events show edges, not what lies between."""


@guarded
@dataclass(frozen=True, eq=False)
class LivePicture:
    """Picture of a stream; made by :class:`PhaseCamera`.

    Examples
    --------
    >>> camera, prism = amiwarp.Camera.from_fov(64, 48, 1.0), amiwarp.Prism(0.03)
    >>> view = amiwarp.PhaseCamera(amiwarp.ExactModel.from_prism(camera, prism, 0.0), amiwarp.EncoderStream())
    >>> [found.picture.log.shape for found in view.flush()]  # no event came
    []
    """

    picture: Picture
    """The picture, with the times of its newest part of a turn. Numbers of pairs are 0: there are no equations."""
    misfit: NDArray[np.float32]
    """Share of the brightness in the newest part that the sums before did not lead to expect, 0 to 1, over the pixels
    around, shape (height, width)."""
    moved: NDArray[np.bool_]
    """Whether something moved at the pixel or near it, shape (height, width). There, the picture is smeared."""
    turns: float
    """Length of the newest part [turns]."""
    events: int
    """Number of events in it."""

    @property
    def end_us(self) -> int:
        """Time after the last event of the picture [us]."""
        return self.picture.start_us + self.picture.length_us


@guarded
class PhaseCamera:
    """Pictures of a stream from sums in phase: put packets as they arrive, take the pictures that are ready.

    The first picture comes after a whole turn. A packet waits until the encoder samples cover it; if it has waited for
    too long, or too much waits, its angles are extrapolated. Events before the first sample are left out. No event is
    moved. Use one camera from one thread only.

    Parameters
    ----------
    model : Model
        Optical model of the prism, with one angle.
    encoder : EncoderStream
        Encoder samples; the caller appends to it.
    turns : float, optional
        Shortest part of a turn for a picture, 1/64 to 1. Without ``rate_hz`` there is a picture after each of them.
    rate_hz : float, optional
        Number of pictures per second of the stream [Hz].
    harmonics : int, optional
        Number of harmonics; by default one and a half for each pixel of the mean radius of the orbit, at least 5.
    wait_us : int, optional
        Longest wait of a packet for encoder samples, by the caller's clock [us].
    start_us : int, optional
        The same while fewer than two encoder samples have arrived [us].
    most_waiting : int, optional
        Largest number of events that wait.

    Raises
    ------
    AmiwarpError
        If a number is out of range, the model or the encoder has two angles, or the model moves pixels along a line.

    Examples
    --------
    >>> import numpy as np
    >>> camera, prism = amiwarp.Camera.from_fov(64, 48, 1.0), amiwarp.Prism(0.03)
    >>> encoder = amiwarp.EncoderStream()
    >>> view = amiwarp.PhaseCamera(amiwarp.ExactModel.from_prism(camera, prism, 0.0), encoder, turns=0.5)
    >>> _ = encoder.append([0, 200_000], [0.0, 15.08])  # 720 turns a minute
    >>> t = np.arange(0, 200_000, 20)
    >>> view.put(amiwarp.Events.from_arrays(t % 64, t % 48, t, t % 40 == 0), now_us=0)
    >>> [(found.turns, found.picture.log.shape) for found in view.take(now_us=0)]
    [(1.0, (48, 64)), (0.5, (48, 64)), (0.5, (48, 64))]
    """

    def __init__(
        self,
        model: Model,
        encoder: EncoderStream,
        *,
        turns: float = 0.25,
        rate_hz: float | None = None,
        harmonics: int | None = None,
        wait_us: int = 10_000,
        start_us: int = 5_000_000,
        most_waiting: int = 1 << 24,
    ) -> None:
        check_prisms(encoder, model.ANGLES)
        self.model = model
        self.encoder = encoder
        self.wait_us = whole(wait_us, "wait_us", 0, TIME_LIMIT >> 1, " us")  # less than in flush
        self.start_us = whole(start_us, "start_us", 0, TIME_LIMIT >> 1, " us")
        self.most_waiting = whole(most_waiting, "most_waiting", 0, TIME_LIMIT, " events")
        self._bins = max(1, round(BINS * real(turns, "turns", 1.0 / BINS, 1.0)))
        self._step_us = None
        if rate_hz is not None:
            self._step_us = 1e6 / real(rate_hz, "rate_hz", 0.001, 1e5, " Hz")
        camera = model.camera
        count = harmonics_for(model) if harmonics is None else harmonics
        self._ring = PhaseRing(camera.width, camera.height, harmonics=count)
        # Refuses the model, or loads kernels and tables before the stream needs them
        motion_of(_nothing(self._ring), model)
        phase_picture(_nothing(self._ring), model)
        self._queue: deque[tuple[Events, int]] = deque()
        self.waiting = 0
        """Number of events in the queue, which wait for encoder samples."""
        self._last_us = -(2**62)
        self._before: tuple[PhaseSums, NDArray[np.float32]] | None = None
        self._lag = 0.0
        self._lag_bin = 0
        self._drawn_bin = 0
        self._next_bin = 0
        self._due_us = 0.0
        self.skipped = 0
        """Number of pictures that :meth:`take` left out, because there was a newer one already."""
        self.left_out = 0
        """Number of events without an angle, which are in no picture."""

    def put(self, events: Events, now_us: int) -> None:
        """Queue a packet. The packet is kept, not copied.

        Parameters
        ----------
        events : Events
            Events with whole pixel coordinates (uint16), sorted by time, not earlier than those before.
        now_us : int
            Current time of the caller's clock [us], from which the packet waits.

        Raises
        ------
        AmiwarpError
            If the coordinates are not whole pixels, or the packet starts before the end of the last. Nothing is queued
            then.
        """
        check_sensor(events)
        if not len(events):
            return
        if int(events.t[0]) < self._last_us:
            raise AmiwarpError(
                f"a packet starts at {events.t[0]} us, the previous one ended at {self._last_us} us; sort the packets "
                "by time"
            )
        self._last_us = int(events.t[-1])
        self.waiting += len(events)
        self._queue.append((events, now_us))

    def take(self, now_us: int, *, newest: bool = False) -> list[LivePicture]:
        """Return the pictures that are ready.

        Parameters
        ----------
        now_us : int
            Current time of the caller's clock [us].
        newest : bool, optional
            Leave out pictures that are followed by another one in the events that are ready. The next picture then has
            their events too.

        Returns
        -------
        list of LivePicture
            Pictures in the order of time.

        Raises
        ------
        AmiwarpError
            If a packet is not sorted or has events outside the sensor.
        """
        packets = self._ready(now_us)
        until_us = int(packets[-1].t[-1]) if packets else 0
        out: list[LivePicture] = []
        for events in packets:
            known = self._with_angle(events)
            if not len(known):
                continue
            encoder = self.encoder.over(int(known.t[0]), int(known.t[-1]))
            for part in self._ring.split(known, encoder):
                self._ring.add_part(part)
                first_us = int(part.events.t[0])
                if not self._is_due(first_us):
                    continue
                if newest and first_us + self._interval_us() <= until_us:
                    self.skipped += 1
                else:
                    out.append(self._draw())
        return out

    def flush(self) -> list[LivePicture]:
        """Return the pictures of all events that still wait, with extrapolated angles if necessary.

        Returns
        -------
        list of LivePicture
            Pictures in the order of time.
        """
        return self.take(2**62)

    def _ready(self, now_us: int) -> list[Events]:
        """Remove the packets from the queue that encoder samples cover or that waited too long."""
        covered = self.encoder.last
        patience = self.start_us if covered is None else self.wait_us
        found: list[Events] = []
        while self._queue:
            events, put_us = self._queue[0]
            known = covered is not None and int(events.t[-1]) <= covered
            overdue = now_us - put_us >= patience
            if not (known or overdue or self.waiting > self.most_waiting):
                break
            found.append(events)
            self.waiting -= len(events)
            self._queue.popleft()
        return found

    def _with_angle(self, events: Events) -> Events:
        """Return the events from the first encoder sample on."""
        first = self.encoder.first
        unknown = len(events) if first is None else int(np.searchsorted(events.t, first))
        self.left_out += unknown
        return events[unknown:]

    def _is_due(self, now_us: int) -> bool:
        """Return whether a picture is due after the last complete bin, and note when the next one is."""
        ring = self._ring
        if ring.bins < BINS:  # also after the optic turned back
            self._before = None
            self._next_bin = ring.newest
            self._due_us = now_us
            return False
        if self._step_us is None:
            if ring.newest < self._next_bin:
                return False
            self._next_bin = ring.newest + self._bins
            return True
        if now_us < self._due_us or ring.newest == self._drawn_bin:
            return False
        behind = math.floor((now_us - self._due_us) / self._step_us)
        self._due_us += (behind + 1) * self._step_us
        return True

    def _interval_us(self) -> float:
        """Return the time from a picture to the next one [us]."""
        if self._step_us is not None:
            return self._step_us
        start_us, end_us = self._ring.span_us(self._bins)
        return float(end_us - start_us)

    def _draw(self) -> LivePicture:
        """Return the picture up to the last complete bin."""
        began = time.perf_counter()
        bins = BINS
        if self._before is None:
            sums = self._ring.sums()
            self._find_lag(sums)
            log = phase_picture(sums, self.model, lag=self._lag)
            misfit = np.zeros(log.shape, np.float32)
            moved = np.zeros(log.shape, np.bool_)
            ground = log
        else:
            bins = min(max(self._ring.newest - self._drawn_bin, self._bins), BINS)
            prior, ground = self._before
            update = self._ring.update(prior, bins / BINS)
            sums = update.sums
            misfit = _misfit(update)
            moved = ndimage.maximum_filter(misfit > MOVED, RIM_PX)
            if self._ring.newest - self._lag_bin >= LAG_TURNS * BINS:
                self._find_lag(sums)
            log = phase_picture(sums, self.model, lag=self._lag)
            if moved.any():
                ground = self._without_moved(log, sums, moved, ground)
                log = np.where(moved, log, ground)
                log -= np.median(log)
            else:
                ground = log
        self._before = sums, ground
        self._drawn_bin = self._ring.newest
        start_us, end_us = self._ring.span_us(bins)
        known = sums.values[0] != 0
        length_us = end_us - start_us
        picture = picture_of(log, known, sums.off_ratio, start_us, length_us, began)
        return LivePicture(picture, misfit, moved, bins / BINS, sums.events)

    def _find_lag(self, sums: PhaseSums) -> None:
        """Find the lag of events anew."""
        self._lag = lag_of(sums, self.model)
        self._lag_bin = self._ring.newest

    def _without_moved(
        self,
        log: NDArray[np.float32],
        sums: PhaseSums,
        moved: NDArray[np.bool_],
        before: NDArray[np.float32],
    ) -> NDArray[np.float32]:
        """Return the picture with the gradient of the picture before in the long waves of what moved."""
        rows, columns = np.gradient(before)
        slopes = motion_of(sums, self.model).gradient(sums.values[0], self._lag)
        wrong = np.where(moved, columns + 1j * rows - slopes, 0.0)
        nothing = np.zeros_like(log)
        return log + joined_picture(nothing, wrong.astype(np.complex64), self.model)


def _nothing(ring: PhaseRing) -> PhaseSums:
    """Return the sums of no events."""
    shape = (ring.height, ring.width)
    none = np.zeros(shape, np.int32)
    return PhaseSums(np.zeros((ring.harmonics, *shape), np.complex64), none, none, 1.0, 1.0)


def _misfit(update: PhaseUpdate) -> NDArray[np.float32]:
    """Return the share of the newest brightness around each pixel that was not expected, 0 where nothing happens.

    Events at random angles add the same to the squares of the change and of the newest part; the expected sums have as
    much noise.
    """
    events = update.sums.on + update.sums.off_ratio**2 * update.sums.off
    noise = update.noise * events.astype(np.float32)
    change = mean_around(update.change - 2.0 * noise)
    size = mean_around(update.size - noise)
    least = update.noise * LEAST_EVENTS / AROUND_PX**2
    return np.clip(0.5 * change / np.maximum(size, least), 0.0, 1.0)
