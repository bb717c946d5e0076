"""Fast pictures from pictures and the events between them: the events tell when the light of each pixel changes."""

from collections.abc import Iterator
from itertools import islice, pairwise

import numpy as np
from numpy.typing import NDArray

from amiwarp.choices import CONTRAST
from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events.recording import Events, EventSource
from amiwarp.simulation.picture_light import DARK
from amiwarp.simulation.pictures import Pictures
from amiwarp.simulation.translation.known_pictures import KnownPictures
from amiwarp.simulation.translation.mvsec import MvsecPictures
from amiwarp.simulation.translation.picture_pair import Interpolation, PicturePair, light_of

FAST_US = 1000
"""Time between two fast pictures [us]."""
READ_US = 20_000
"""Length of the time spans in which events are read [us]."""
FIT_PICTURES = 8
"""Largest number of pictures, after the first, to which the contrasts are fitted."""
FIT_CHANGE = 0.3
"""Smallest change of log intensity from the first picture that is used for the fit."""
CONTRAST_LIMITS = (0.02, 2.0)
"""Smallest and largest contrast that is believed [log intensity]."""
LARGEST_REST = 2.0
"""Largest change of log intensity between two pictures that the events leave unexplained at a known pixel [thresholds].

A pixel's unseen change is below one threshold at each of the two pictures.
"""
BAND = 0.75
"""Largest departure of the log intensity from what the events say [thresholds]: between two events it is not known."""


class EventPictures(KnownPictures):
    """Pictures of a sequence, and fast pictures in between that follow the events (:class:`amiwarp.Frames`).

    Between the pictures k and k + 1, the log intensity of each pixel is integrated from the events forward from picture
    k and backward from picture k + 1, and the two are blended linearly in time. This is right up to a threshold. The
    pictures interpolated by motion are used within that band, since they have no steps. Pixels are known where the
    events explain the change between two pictures.
    """

    def __init__(
        self,
        pictures: Pictures | MvsecPictures,
        events: EventSource,
        start_us: int,
        way: Interpolation = Interpolation.AUTO,
    ) -> None:
        """Fit the contrasts. ``start_us``: time of the first picture on the events' clock [us]."""
        if pictures.size != events.size:
            width, height = pictures.size
            of_events = "{}x{} px".format(*events.size)
            raise AmiwarpError(
                f"the pictures have {width}x{height} px, the events {of_events}; give pictures of the camera that "
                "recorded the events"
            )
        end_us = start_us + pictures.duration_us
        if not len(events) or events.t_last < start_us or events.t_first > end_us:
            raise AmiwarpError(
                f"no events between {start_us} and {end_us:.0f} us, the times of the "
                "pictures; give times.csv with times on the clock of the events",
                ErrorCode.CONTENT_MISSING,
            )
        self._pictures = pictures
        self._events = events
        self._start_us = start_us
        self._way = way
        super().__init__()
        self.contrasts = self._fit_contrasts()
        """Fitted contrasts of ON and OFF events [log intensity]."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of each picture [px]."""
        return self._pictures.size

    @property
    def interval_us(self) -> float:
        """Smallest time between two pictures [us]."""
        return min(FAST_US, self._pictures.interval_us)

    @property
    def duration_us(self) -> float:
        """Duration of the pictures [us]."""
        return self._pictures.duration_us

    def read(self) -> Iterator[tuple[int, NDArray[np.float32]]]:
        """Yield time [us], 0 at the first picture, and linear luminance, shape (height, width)."""
        self._known.clear()
        last: tuple[int, NDArray[np.float32]] | None = None
        for t, light in self._pictures.read():
            if last is not None:
                last_t, last_light = last
                pair = PicturePair(last_light, light, self._way)
                yield from self._between(last_t, t, pair)
            yield t, light
            last = (t, light)

    def _between(
        self, start: int, stop: int, pair: PicturePair
    ) -> Iterator[tuple[int, NDArray[np.float32]]]:
        """Yield time and linear luminance between two pictures."""
        on, off = self.contrasts
        first, second = pair.logs
        # What the events leave unexplained
        on_counts, off_counts = self._counts(start, stop)
        rest = second - first - (on * on_counts - off * off_counts)
        known = np.abs(rest) < LARGEST_REST * max(on, off)
        self._known.append((start, known))

        band = np.float32(BAND * 0.5 * (on + off))
        change = np.zeros_like(first)
        for t, events in self._spans([*range(start, stop, FAST_US), stop]):
            change += self._change(events)
            share = (t - start) / (stop - start)
            integrated = first + change + np.float32(share) * rest
            if t < stop:  # the light at the end is the second picture itself
                by_motion = pair.at(share)
                log = integrated + np.clip(by_motion - integrated, -band, band)
                yield t, light_of(log)

    def _spans(self, times: list[int]) -> Iterator[tuple[int, Events]]:
        """Yield end and events of each span between successive times [us]."""
        spans_together = max(1, READ_US // FAST_US)
        for k in range(0, len(times) - 1, spans_together):
            some = times[k : k + spans_together + 1]
            on_clock = np.array(some) + self._start_us  # of the events
            events = self._events.between(int(on_clock[0]), int(on_clock[-1]))
            edges = np.searchsorted(events.t, on_clock).tolist()
            for end, (first, stop) in zip(some[1:], pairwise(edges), strict=True):
                yield end, events[first:stop]

    def _change(self, events: Events) -> NDArray[np.float32]:
        """Return the change of log intensity of each pixel, shape (height, width)."""
        on, off = self.contrasts
        width, height = self.size
        pixel = events.y.astype(np.int64) * width + events.x
        of_event = np.where(events.p == 1, on, -off)
        change = np.bincount(pixel, of_event, minlength=width * height)
        return change.astype(np.float32).reshape(height, width)

    def _counts(self, start: int, stop: int) -> NDArray[np.float32]:
        """Return the numbers of ON and of OFF events of each pixel between two times, shape (2, height, width)."""
        width, height = self.size
        pixels = width * height
        on = np.zeros(pixels, np.int64)
        off = np.zeros(pixels, np.int64)
        for begin in range(start, stop, READ_US):
            end = min(begin + READ_US, stop)
            events = self._events.between(begin + self._start_us, end + self._start_us)
            pixel = events.y.astype(np.int64) * width + events.x
            on += np.bincount(pixel[events.p == 1], minlength=pixels)
            off += np.bincount(pixel[events.p == 0], minlength=pixels)
        return np.stack([on, off]).reshape(2, height, width).astype(np.float32)

    def _fit_contrasts(self) -> tuple[float, float]:
        """Return the contrasts c for which ΔL = c_on N_on - c_off N_off holds from the first picture to later ones.

        Events are whole numbers, so a least-squares fit to them would find contrasts that are too small. The rises and
        the falls of log intensity are the instruments instead (two equations, summed over pixels). Pixels that the
        first fit does not explain are left out of the second.
        """
        contrasts = self._fit(np.full(2, np.inf))
        if not contrasts.any():  # nothing changes between the pictures
            return CONTRAST, CONTRAST
        on, off = self._fit(contrasts).tolist()
        low, high = CONTRAST_LIMITS
        if not (low <= min(on, off) and max(on, off) <= high):
            raise AmiwarpError(
                f"the pictures do not change as the events say: the fitted contrasts are {on:.3g} (ON) and {off:.3g} "
                "(OFF); check that pictures and events have one clock and one camera, or translate the pictures "
                "without the events"
            )
        return on, off

    def _fit(self, guess: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the contrasts that fit the pixels explained by a guess; zeros if nothing changes."""
        first: NDArray[np.float32] | None = None
        counts = np.zeros((2, *self.size[::-1]))
        last = 0
        left = np.zeros((2, 2))
        right = np.zeros(2)
        for t, light in islice(self._pictures.read(), FIT_PICTURES + 1):
            log = np.log(light + np.float32(DARK)).astype(np.float64)
            if first is None:
                first = log
            counts = counts + self._counts(last, t)
            last = t

            # A pixel with a change of 0 has no weight in the equations below.
            change = (log - first).ravel()
            signed = counts.reshape(2, -1).T * np.array([1.0, -1.0])
            change[np.abs(change) < FIT_CHANGE] = 0.0
            if np.isfinite(guess).all():
                unexplained = np.abs(change - signed @ guess)
                change[unexplained > LARGEST_REST * np.abs(guess).max()] = 0.0

            rises = np.maximum(change, 0.0)
            falls = np.minimum(change, 0.0)
            instruments = np.stack([rises, falls])
            left += instruments @ signed
            right += instruments @ change
        contrasts, *_ = np.linalg.lstsq(left, right, rcond=None)
        return np.asarray(contrasts)
