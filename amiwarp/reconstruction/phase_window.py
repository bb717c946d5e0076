"""Pictures and images in phase of time windows of a recording: whole turns, summed."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from amiwarp.compensation.recordings import check_size
from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events.device_events import device_of, read_between
from amiwarp.events.encoder import Encoder
from amiwarp.events.encoder_speed import turn_between
from amiwarp.events.recording import EventSource, Recording
from amiwarp.imaging.phase import BINS, PhaseSums, phase_sums
from amiwarp.imaging.windows import turn_edges, turn_end
from amiwarp.optics.models.base import Model
from amiwarp.optics.orbit import LockedAngles, image_grid, orbits_of
from amiwarp.reconstruction.device_windows import DeviceWindows, Drawing
from amiwarp.reconstruction.locked_angles import MotionPeriod
from amiwarp.reconstruction.phase_paths import is_orbit, path_plan_of, radius_of_paths
from amiwarp.reconstruction.picture import Picture
from amiwarp.reconstruction.picture_in_phase import phase_picture, pixel_motion
from amiwarp.reconstruction.windows import window_count, window_span
from amiwarp.results.calibration import Calibration
from amiwarp.schema.calls import guarded

HARMONICS_PER_PX = 1.3
"""Number of harmonics for each pixel of the orbit's mean radius. Each takes its share of the time. With an orbit of
7 px, 9 harmonics correlate with the scene's detail by 0.989, and 11 by 0.991; if half of the events are noise, by 0.982
and 0.986."""
FEWEST_HARMONICS = 6
MOST_HARMONICS = 31
"""Limits of the number of harmonics: small orbits need some, and 64 bins hold no more."""
MOST_HARMONICS_OF_PATHS = 63
"""Limit of the number of harmonics of a motion over some turns."""
MORE_BINS = 256
"""Number of bins that hold these."""
LEAST_TURN = 0.98
"""Shortest window that counts as a whole turn [turns]. It is lengthened to a turn."""


class _Started(NamedTuple):
    """Picture of a window that a device makes."""

    drawing: Drawing
    start_us: int
    length_us: int
    began: float
    """When its work began, by the clock of the host [s]."""


def picture_of(
    log: NDArray[np.float32],
    known: NDArray[np.bool_],
    off_ratio: float,
    start_us: int,
    length_us: int,
    began: float,
) -> Picture:
    """Return the picture of a window, which took the time since ``began``."""
    return Picture(
        log=log,
        known=known,
        start_us=start_us,
        length_us=length_us,
        pairs=0,
        off_excess=off_ratio - 1.0,
        smoothness=0.0,
        residual=0.0,
        hot=0,
        seconds=time.perf_counter() - began,
        unknowns=np.zeros(0, np.float32),
    )


@guarded
class PhaseReconstruction:
    """Pictures of a still scene from sums in phase, for windows of whole turns of one recording.

    Parameters
    ----------
    recording : Recording
        Recording with events.
    calibration : Calibration
        Calibration of the same sensor size. It provides model and encoder. Two angles of an optic must come back
        together after at most 8 turns.
    device : str or warp.Device, optional
        Device on which events are summed and pictures are made, by default the events' device or the CPU. On CUDA a
        picture is copied to the host only when it is finished.

    Raises
    ------
    AmiwarpError
        If the recording has no events, the sensor sizes differ, there is no encoder, the motion of two angles does not
        repeat, the model moves nothing, or the calibration says that the camera rotates.

    Examples
    --------
    >>> import numpy as np
    >>> picture = np.random.default_rng(0).random((64, 64)).astype(np.float32)
    >>> camera, prism = amiwarp.Camera.from_fov(64, 48, 1.0), amiwarp.Prism(0.03)
    >>> recording = amiwarp.simulate(picture, camera, prism, duration_s=0.2)
    >>> found = amiwarp.calibrate(recording, amiwarp.Settings(stages=("sharpness",), model="circle"))
    >>> work = amiwarp.PhaseReconstruction(recording, found)
    >>> work.window(*work.span(turns=1.0)).log.shape
    (48, 64)
    """

    def __init__(
        self, recording: Recording, calibration: Calibration, *, device: Any = None
    ) -> None:
        if not len(recording.events):
            raise AmiwarpError(
                f"{recording.name}: has no events; give a recording with events",
                ErrorCode.CONTENT_MISSING,
            )
        check_size(calibration, recording.events.size, recording.name)
        rotation = calibration.camera_rotation
        if rotation is not None and rotation.moves:
            raise AmiwarpError(
                f"{recording.name}: the calibration says that the camera rotates; sums in phase need a still camera, "
                "use the method 'solver'"
            )
        self.recording = recording
        self.model: Model = calibration.model
        first_us = recording.events.t_first
        last_us = recording.events.t_last
        encoder = calibration.encoder_for(recording.encoder, first_us, last_us)
        if encoder is None:
            raise AmiwarpError(
                f"{recording.name}: give a recording with an encoder", ErrorCode.CONTENT_MISSING
            )
        self._period = MotionPeriod.of(self.model, encoder, first_us, last_us)
        self.encoder = self._period.encoder
        """Encoder of the sums' angle: of two angles, of the motion's period, which may take some turns."""
        self.turn_us = turn_between(self.encoder, first_us, last_us)
        half_us = round(0.5 * (self.turn_us or 0.0))
        middle_us = (first_us + last_us) // 2
        locked = self._period.locked(middle_us - half_us, middle_us + half_us)
        self.harmonics = harmonics_for(self.model, locked)
        # Refuses an optic that moves nothing
        if is_orbit(self.model):
            pixel_motion(self.model)
        else:
            path_plan_of(self.model, locked, self.harmonics)
        self.device = device_of(recording.events, device)
        self._on_device: DeviceWindows | None = None

    def span(
        self, start_us: int | None = None, length_us: int | None = None, turns: float | None = None
    ) -> tuple[int, int]:
        """Return start and length of a time window.

        Parameters
        ----------
        start_us : int, optional
            Start [us]; by default one turn after the first event, or as late as possible.
        length_us : int, optional
            Length [us]; by default one turn.
        turns : float, optional
            Length [turns], instead of ``length_us``.

        Returns
        -------
        tuple of int
            Start and length [us].

        Raises
        ------
        AmiwarpError
            If the window has no events, or both lengths are given.
        """
        return window_span(self.recording, self.turn_us, start_us, length_us, turns)

    def sums(self, start_us: int, length_us: int) -> PhaseSums:
        """Sum the events of the whole turns of a window in phase with the optic.

        Parameters
        ----------
        start_us : int
            Start [us].
        length_us : int
            Length [us]. The end moves to the end of the last whole turn.

        Returns
        -------
        PhaseSums
            The sums.

        Raises
        ------
        AmiwarpError
            If the window is shorter than a turn, or has no events.
        """
        sums, stop_us = sums_of_turns(
            self.recording.events,
            self.encoder,
            start_us,
            length_us,
            harmonics=self.harmonics,
            device=self.device,
        )
        if not sums.events:
            raise self._no_events(start_us, stop_us)
        return replace(sums, locked=self._period.locked(start_us, stop_us))

    def _no_events(self, start_us: int, stop_us: int) -> AmiwarpError:
        """Return the error for a window without events."""
        where = f"{start_us} .. {stop_us} us"
        return AmiwarpError(
            f"{self.recording.name}: no events in {where}; give another window",
            ErrorCode.CONTENT_MISSING,
        )

    def window(self, start_us: int, length_us: int) -> Picture:
        """Make the picture of the whole turns of a window.

        Parameters
        ----------
        start_us : int
            Start [us].
        length_us : int
            Length [us], at least a turn.

        Returns
        -------
        Picture
            The picture. Its numbers of pairs and hot pixels, smoothness and residual are 0: there are no equations of
            pairs.

        Raises
        ------
        AmiwarpError
            If the window is shorter than a turn, or has no events.
        """
        if self._is_on_device:
            return self._finished(self._started(start_us, length_us))
        began = time.perf_counter()
        sums = self.sums(start_us, length_us)
        log = phase_picture(sums, self.model)
        known = (sums.on + sums.off) > 0
        return picture_of(log, known, sums.off_ratio, start_us, length_us, began)

    @property
    def _is_on_device(self) -> bool:
        """Whether a GPU makes the whole picture; of motions that are no orbit it sums the events only."""
        return bool(self.device.is_cuda) and is_orbit(self.model)

    def _started(self, start_us: int, length_us: int) -> _Started:
        """Begin with the picture of a window on the device."""
        began = time.perf_counter()
        if self._on_device is None:
            self._on_device = DeviceWindows(
                self.recording.events, self.encoder, self.model, self.harmonics, self.device
            )
        stop_us, turns = whole_turns(self.encoder, start_us, length_us)
        drawing = self._on_device.start(start_us, stop_us, turns)
        if drawing is None:
            raise self._no_events(start_us, stop_us)
        return _Started(drawing, start_us, length_us, began)

    def _finished(self, started: _Started) -> Picture:
        """Return a picture when it is made."""
        assert self._on_device is not None
        drawn = self._on_device.finish(started.drawing)
        if drawn.full:
            self.sums(started.start_us, started.length_us)  # names the pixel
        return picture_of(
            drawn.log,
            drawn.known,
            drawn.off_ratio,
            started.start_us,
            started.length_us,
            started.began,
        )

    def _streamed(self, starts: Iterable[int], length_us: int) -> Iterator[Picture]:
        """Yield the pictures of windows on the device. The next one is begun before one is waited for."""
        before: _Started | None = None
        for start_us in starts:
            try:
                started = self._started(start_us, length_us)
            except AmiwarpError:
                # The pictures before it are good
                if before is not None:
                    yield self._finished(before)
                raise
            if before is not None:
                yield self._finished(before)
            before = started
        if before is not None:
            yield self._finished(before)

    def windows(self, start_us: int, length_us: int, *, step_us: float) -> Iterator[Picture]:
        """Yield pictures of sliding windows, up to the last complete one.

        Parameters
        ----------
        start_us : int
            Start of the first window [us].
        length_us : int
            Length of each window [us], at least a turn.
        step_us : float
            Distance between the starts of windows [us].

        Yields
        ------
        Picture
            Picture of each window.
        """
        count = self.count(start_us, length_us, step_us=step_us)
        # One at a time: a recording may have any number of windows
        starts = (start_us + round(k * step_us) for k in range(count))
        if self._is_on_device:
            yield from self._streamed(starts, length_us)
            return
        for first_us in starts:
            yield self.window(first_us, length_us)

    def count(self, start_us: int, length_us: int, *, step_us: float) -> int:
        """Return the number of pictures that :meth:`windows` yields.

        Parameters
        ----------
        start_us : int
            Start of the first window [us].
        length_us : int
            Length of each window [us].
        step_us : float
            Distance between the starts of windows [us].

        Returns
        -------
        int
            Number of pictures, at least 1.
        """
        return window_count(self.recording, start_us, length_us, step_us)


def sums_of_turns(
    source: EventSource,
    encoder: Encoder,
    start_us: int,
    length_us: int,
    *,
    harmonics: int,
    device: Any,
) -> tuple[PhaseSums, int]:
    """Return the sums of the whole turns that begin at ``start_us`` within a window, and where they end [us].

    Raises :class:`AmiwarpError` as :func:`whole_turns`.
    """
    stop_us, turns = whole_turns(encoder, start_us, length_us)
    events = read_between(source, start_us, stop_us)
    width, height = source.size
    bins = BINS if harmonics <= MOST_HARMONICS else MORE_BINS
    sums = phase_sums(
        events,
        encoder,
        width,
        height,
        turns=float(turns),
        harmonics=harmonics,
        bins=bins,
        device=device,
    )
    return sums, stop_us


def harmonics_for(model: Model, locked: LockedAngles | None = None) -> int:
    """Return the number of harmonics that a picture through an optic needs."""
    if is_orbit(model):
        radius = orbits_of(model, image_grid(model.camera, 5, 5)).radius
        most = MOST_HARMONICS
    else:
        radius = radius_of_paths(model, locked)
        most = MOST_HARMONICS_OF_PATHS
    return int(np.clip(math.ceil(HARMONICS_PER_PX * radius), FEWEST_HARMONICS, most))


@guarded
def whole_turns(encoder: Encoder, start_us: int, length_us: int) -> tuple[int, int]:
    """Return the end of the whole turns that begin at ``start_us`` within a window [us], and their number.

    Raises :class:`AmiwarpError` if the window is shorter than a turn, or the encoder ends before the turn does.
    """
    ends = encoder.angle_at(np.array([start_us, start_us + length_us]))
    swept = abs(float(ends[1] - ends[0])) / math.tau
    turns = math.floor(swept + 1.0 - LEAST_TURN)
    if turns < 1:
        raise AmiwarpError(
            f"the window {start_us} .. {start_us + length_us} us has {swept:.2f} turns of the optic; sums in phase "
            "need a whole turn: give a longer window, or use the method 'solver'"
        )
    # The last turn may end a little after the window does.
    longest_us = round(length_us * max(1.0, turns / swept) * (2.0 - LEAST_TURN))
    limit_us = min(encoder.coverage[1], start_us + longest_us)
    end_us = turn_end(encoder, start_us, float(ends[0]), limit_us, turns)
    if end_us is not None:
        return end_us, turns
    edges = turn_edges(encoder, start_us, limit_us, 1.0, incomplete=False)
    if len(edges) <= turns:
        raise AmiwarpError(
            f"the encoder ends at {encoder.coverage[1]} us, before the turn that begins at {start_us} us is complete; "
            "give an earlier window"
        )
    return int(edges[turns]), turns
