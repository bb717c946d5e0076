"""Grey pictures of a stream: by our own reconstruction, or by a given function such as a learned one."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.encoder import Encoder
from amiwarp.events.events import Events
from amiwarp.optics.camera_rotation import CameraRotation
from amiwarp.optics.exact_model import ExactModel
from amiwarp.optics.prism import Prism
from amiwarp.reconstruction.picture import Reconstruction
from amiwarp.studies.evaluate.conditions import Stream, Streams
from amiwarp.studies.evaluate.contrast_motion import estimate_rotation

if TYPE_CHECKING:
    from amiwarp.events.recording import Recording

Reconstructor = Callable[[Events], NDArray[Any]]
"""Function that returns the picture of a window's events, shape (height, width), in any unit of log intensity. The
events are compensated, with float32 coordinates, or those of a plain camera."""


@dataclass(frozen=True, slots=True)
class Window:
    """Time window of a picture."""

    start_us: int
    """Start [us]."""
    end_us: int
    """End [us]."""

    @property
    def middle_us(self) -> int:
        """Middle, the time that the picture shows [us]."""
        return (self.start_us + self.end_us) // 2


@dataclass
class PictureMaker:
    """Makes the pictures of a stream. Without ``reconstructor``, our own reconstruction makes them."""

    streams: Streams
    """Streams of a recording."""
    stream: Stream
    """Stream; our own reconstruction refuses that of equal count, because it needs all events of a pixel."""
    reconstructor: Reconstructor | None = None
    """Function that makes a picture of events, or None."""
    _work: Reconstruction | None = field(init=False, default=None)

    def __post_init__(self) -> None:
        if self.reconstructor is None:
            recording, model, encoder = own_inputs(self.streams, self.stream)
            if len(recording.events):
                self._work = Reconstruction(
                    recording, model=model, encoder=encoder, camera_rotation=self._rotation(),
                    device=self.streams.device,
                )  # fmt: skip

    def _rotation(self) -> CameraRotation:
        """Return the camera's mean rotation, as found in the middle of the recording."""
        if not self.streams.simulation.scene.trajectory.moves:  # type: ignore[union-attr]  # a world
            return CameraRotation()
        middle, half = (self.streams.start_us + self.streams.end_us) // 2, 25_000
        return estimate_rotation(self.streams.window(self.stream, middle - half, middle + half), self.streams.camera)

    def pictures(self, windows: Sequence[Window]) -> Iterator[NDArray[np.float64]]:
        """Yield the picture of each window, shape (height, width); uniform before there are enough events."""
        last = None
        width, height = self.streams.size
        for window in windows:
            if self.reconstructor is not None:
                events = self.streams.window(self.stream, window.start_us, window.end_us)
                yield np.asarray(self.reconstructor(events), np.float64)
                continue
            if self._work is not None:
                with contextlib.suppress(AmiwarpError):  # no pixel fires twice: the picture before stays
                    last = self._work.window(window.start_us, window.end_us - window.start_us, last=last)
            yield np.zeros((height, width)) if last is None else last.log.astype(np.float64)


def own_inputs(streams: Streams, stream: Stream) -> tuple[Recording, Any, Encoder]:
    """Return recording, model and encoder for our own reconstruction of a stream."""
    nothing = ExactModel(streams.camera, Prism(0.0))
    resting = Encoder.constant_speed(0.0, streams.start_us - 1_000_000, streams.end_us + 1_000_000)
    if stream is Stream.PLAIN:
        return streams.plain, nothing, resting
    recording = streams.recording
    if stream is Stream.RAW:
        return recording, nothing, resting
    assert recording.encoder is not None
    if stream is Stream.TRUE:
        return recording, streams.true_model, recording.encoder
    if stream is not Stream.CALIBRATED or streams.calibration is None:
        raise AmiwarpError(f"stream {stream.value!r} has no reconstruction; choose another stream")
    found, events = streams.calibration, recording.events
    return recording, found.model, found.encoder_for(recording.encoder, events.t_first, events.t_last)


def reconstructed_streams(streams: Streams) -> list[Stream]:
    """Return the streams of which our own reconstruction makes pictures."""
    return [stream for stream in streams.names if stream is not Stream.SAME_COUNT]
