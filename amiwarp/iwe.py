"""The image of warped events (IWE): events voted into pixels after compensation, or as they are."""

from __future__ import annotations

import enum
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from amiwarp.errors import AmiwarpError
from amiwarp.optics import wrap_angle
from amiwarp.turning import Turning

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.encoder import Encoder
    from amiwarp.events import Events
    from amiwarp.optics import Model

MAX_PENDING = 1 << 23
"""Full votes that fit a 32-bit pixel: 2**31 / 256. Before more events than this came, votes are moved on."""
PIECE = 1 << 22
"""Events that are put on the device at a time."""


class Vote(enum.Enum):
    """How an event's vote is shared among pixels."""

    NEAREST = "nearest"
    BILINEAR = "bilinear"


@dataclass(frozen=True, slots=True)
class CanvasShape:
    """Where votes go: the sensor's image grown by ``pad`` px on each side, then scaled."""

    width: int
    """Sensor width [px]."""
    height: int
    """Sensor height [px]."""
    pad: int = 0
    """Border [sensor px] so that no event leaves the image."""
    scale: float = 1.0
    """Canvas pixels per sensor pixel."""
    per_polarity: bool = False
    """Two layers, OFF then ON, in place of one."""
    vote: Vote = Vote.BILINEAR
    dither: bool = False
    """Put each event somewhere in its pixel, not at its centre: nothing is won then by events on the pixel grid."""

    @property
    def shape(self) -> tuple[int, int, int]:
        """(layers, rows, columns)."""
        rows = max(1, round((self.height + 2 * self.pad) * self.scale))
        columns = max(1, round((self.width + 2 * self.pad) * self.scale))
        return (2 if self.per_polarity else 1, rows, columns)

    def params(self) -> Any:
        from amiwarp.kernels.iwe import Canvas

        c = Canvas()
        c.pad, c.scale = float(self.pad), self.scale
        c.per_polarity, c.nearest = int(self.per_polarity), int(self.vote is Vote.NEAREST)
        c.dither = int(self.dither)
        return c


class Votes:
    """Vote buffers of a canvas on a device, allocated once: one image per CPU slice, one on CUDA."""

    def __init__(self, canvas: CanvasShape, device: Any) -> None:
        import warp as wp

        from amiwarp.kernels.launch import slice_count

        self.canvas = canvas
        self.device = wp.get_device(device)
        self._count = slice_count(self.device)
        self._buffer = wp.zeros((self._count, *canvas.shape), dtype=wp.int32, device=self.device)
        self.images = [self._buffer[k] for k in range(self._count)]
        self.flat = self._buffer.reshape((self._count, int(np.prod(canvas.shape))))
        self._total = wp.zeros(self.flat.shape[1], dtype=wp.int64, device=self.device)
        self._params = canvas.params()
        self.pending = 0

    def clear(self) -> None:
        self._buffer.zero_()
        self.pending = 0

    def add_events(
        self, model: Model, events: Any, count: int, *, drift: float = 0.0, turning: Turning | None = None
    ) -> None:
        """Votes ``count`` events (an ``EventArrays`` on the same device) after compensation by ``model``.

        ``turning`` is taken back where the events were given their times.
        """
        from amiwarp.kernels.iwe import vote_events
        from amiwarp.kernels.launch import launch_slices
        from amiwarp.optics import model_camera

        inputs = [model.params(self.device), model_camera(model, self.device), events, drift]
        inputs += [(turning or Turning()).params(), self._params]
        self._reserve(count)
        launch_slices(vote_events, count, inputs, self.images, device=self.device)

    def add_points(self, xy: Any, p: Any) -> None:
        """Votes points as they are: ``xy`` a Warp array of vec2 [px], ``p`` of uint8."""
        from amiwarp.kernels.iwe import vote_points
        from amiwarp.kernels.launch import launch_slices

        self._reserve(len(xy))
        launch_slices(vote_points, len(xy), [xy, p, self._params], self.images, device=self.device)

    def add_as_they_are(self, events: Events) -> None:
        """Votes events where they are, raw or compensated before; NaN coordinates vote nowhere."""
        import warp as wp

        xy = wp.array(np.stack([events.x, events.y], axis=1).astype(np.float32), dtype=wp.vec2, device=self.device)
        self.add_points(xy, wp.array(events.p, dtype=wp.uint8, device=self.device))

    def _reserve(self, count: int) -> None:
        """Makes room: no pixel of 32 bits can overflow, even if every event hit the same one."""
        if count >= MAX_PENDING:
            raise AmiwarpError(
                f"{count} events at once could overflow a pixel of the image; vote at most {MAX_PENDING - 1}"
            )
        if self.pending + count >= MAX_PENDING:
            self._flush()
        self.pending += count

    def _flush(self) -> None:
        from amiwarp.kernels.iwe import gather_votes
        from amiwarp.kernels.launch import launch

        launch(gather_votes, self.flat.shape[1], [self.flat], [self._total], device=self.device)
        self.clear()

    def take(self) -> NDArray[np.float32]:
        """The image so far [events], shape (layers, rows, columns); the canvas is empty afterwards."""
        self._flush()
        image = self._total.numpy().reshape(self.canvas.shape) / 256.0
        self._total.zero_()
        return image.astype(np.float32)


def upload_events(
    events: Events,
    theta: NDArray[np.float64],
    device: Any,
    *,
    slope: NDArray[np.float64] | None = None,
    middle_us: int | None = None,
) -> Any:
    """Events and their angles [rad] as an ``EventArrays`` on ``device``; pixels must be whole (uint16).

    ``middle_us``: where given, the events get their times from it, so that the camera's turning can be taken back.
    """
    import warp as wp

    from amiwarp.kernels.iwe import EventArrays

    if events.x.dtype != np.uint16:
        raise AmiwarpError(
            f"event coordinates are {events.x.dtype}, already compensated; give events from a sensor (uint16)"
        )
    e = EventArrays()
    e.x = wp.array(events.x, dtype=wp.uint16, device=device)
    e.y = wp.array(events.y, dtype=wp.uint16, device=device)
    e.p = wp.array(events.p, dtype=wp.uint8, device=device)
    e.theta = wp.array(wrap_angle(theta).astype(np.float32), dtype=float, device=device)
    e.slope = wp.array([] if slope is None else slope.astype(np.float32), dtype=float, device=device)
    time = np.zeros(0, np.float32) if middle_us is None else ((events.t - middle_us) * 1e-6).astype(np.float32)
    e.time = wp.array(time, dtype=float, device=device)
    return e


def iwe(
    events: Events,
    width: int,
    height: int,
    *,
    model: Model | None = None,
    encoder: Encoder | None = None,
    turning: Turning | None = None,
    pad: int = 0,
    per_polarity: bool = False,
    vote: Vote = Vote.BILINEAR,
    device: Any = "cpu",
) -> NDArray[np.float32]:
    """Image of warped events [events per pixel].

    With ``model`` and ``encoder`` the events are compensated on the way, and the camera's ``turning`` is taken back if
    it is given; without, they are voted where they are.
    Shape (height + 2 pad, width + 2 pad), or (2, …) with OFF then ON where ``per_polarity``.
    """
    if (model is None) != (encoder is None):
        raise AmiwarpError("give both a model and an encoder to compensate the events, or neither")
    votes = Votes(CanvasShape(width, height, pad, 1.0, per_polarity, vote), device)
    for start in range(0, len(events), PIECE):
        piece = events[start : start + PIECE]
        if model is not None and encoder is not None:
            middle = None if turning is None else turning.middle_us
            arrays = upload_events(piece, encoder.angle_at(piece.t), device, middle_us=middle)
            votes.add_events(model, arrays, len(piece), turning=turning)
        else:
            votes.add_as_they_are(piece)
    image = votes.take()
    return image if per_polarity else image[0]
