"""Pictures of a stream from sums in phase: each from the newest part of a turn, with the sums before as its prior.

Brightness that changes differently from what the sums before say is marked as moved. It is kept out of the long waves
of the rest: at moved pixels these come from the gradient of the picture before. Repeated with every picture, this is
the least-squares picture of the gradients that are known.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.device_events import check_sensor
from amiwarp.events.encoder import check_prisms
from amiwarp.events.encoder_stream import EncoderStream
from amiwarp.events.recording import Events
from amiwarp.imaging.phase import BINS
from amiwarp.imaging.phase_ring import BIN
from amiwarp.optics.models.base import Model
from amiwarp.reconstruction.phase_window import harmonics_for, picture_of
from amiwarp.reconstruction.picture import Picture
from amiwarp.reconstruction.stream_pictures import pictures_on
from amiwarp.schema.calls import guarded
from amiwarp.validation import TIME_LIMIT, real, whole

GATHERED = 1 << 15
"""Number of events that are counted together, unless a picture is due: each count takes some time of its own."""
GATHERED_US = 5_000
"""Longest time of them [us]."""
LAG_TURNS = 8
"""Number of turns after which the lag of events is found again: it changes with the speed of the optic."""


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
    device : str or warp.Device, default "cpu"
        Device that counts the events and makes the pictures, such as ``"cuda"``.

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
        device: Any = "cpu",
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
        count = harmonics_for(model) if harmonics is None else harmonics
        self._pictures = pictures_on(wp.get_device(device), model, count)
        self._ring = self._pictures.ring
        self._queue: deque[tuple[Events, int]] = deque()
        self.waiting = 0
        """Number of events in the queue, which wait for encoder samples."""
        self._gathered: list[Events] = []
        self._last_us = -(2**62)
        self._awaits_turn = True
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
        for events in self._ready(now_us):
            known = self._with_angle(events)
            if len(known):
                self._gathered.append(known)
        if not self._gathered:
            return []
        first_us = int(self._gathered[0].t[0])
        until_us = int(self._gathered[-1].t[-1])
        count = sum(len(events) for events in self._gathered)
        enough = count >= GATHERED or until_us - first_us >= GATHERED_US
        if not enough and not self._may_be_due(until_us):
            return []
        known = Events.concatenate(self._gathered)
        self._gathered = []
        out: list[LivePicture] = []
        begun: deque[Callable[[], LivePicture]] = deque()
        encoder = self.encoder.over(first_us, until_us)
        for part in self._ring.split(known, encoder):
            self._ring.add_part(part)
            begins_us = int(part.events.t[0])
            if not self._is_due(begins_us):
                continue
            if newest and begins_us + self._interval_us() <= until_us:
                self.skipped += 1
                continue
            # On a GPU a picture is begun before the one before it is waited for
            begun.append(self._begin())
            if len(begun) > 1:
                out.append(begun.popleft()())
        return out + [finish() for finish in begun]

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

    def _may_be_due(self, until_us: int) -> bool:
        """Return whether a picture may be due in the events up to ``until_us``: if not, they can wait for more."""
        ring = self._ring
        if ring.bins < BINS:
            return True
        if self._step_us is not None:
            return until_us >= self._due_us
        angle = self.encoder.over(until_us, until_us).angle_at(np.array([until_us]))
        return math.floor(ring.direction * float(angle[0]) / BIN) >= self._next_bin

    def _is_due(self, now_us: int) -> bool:
        """Return whether a picture is due after the last complete bin, and note when the next one is."""
        ring = self._ring
        if ring.bins < BINS:  # also after the optic turned back
            self._awaits_turn = True
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

    def _begin(self) -> Callable[[], LivePicture]:
        """Begin with the picture up to the last complete bin, and return what waits for it."""
        began = time.perf_counter()
        ring = self._ring
        first = self._awaits_turn
        bins = BINS if first else min(max(ring.newest - self._drawn_bin, self._bins), BINS)
        find_lag = first or ring.newest - self._lag_bin >= LAG_TURNS * BINS
        if find_lag:
            self._lag_bin = ring.newest
        wait = self._pictures.begin(bins, first=first, find_lag=find_lag)
        self._awaits_turn = False
        self._drawn_bin = ring.newest
        start_us, end_us = ring.span_us(bins)

        def finish() -> LivePicture:
            made = wait()
            length_us = end_us - start_us
            picture = picture_of(made.log, made.known, made.off_ratio, start_us, length_us, began)
            return LivePicture(picture, made.misfit, made.moved, bins / BINS, made.events)

        return finish
