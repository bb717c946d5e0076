"""Events for the viewers Rerun and Foxglove: files that they open, and streams to them while they run.

Both show frames, the images of the events of one time window each, as recorded and compensated, and the prism's angle.
"""

from __future__ import annotations

import contextlib
import io
import itertools
import json
import math
import queue
import uuid
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.calib.result import Calibration
from amiwarp.choices import Layers
from amiwarp.compensation.recordings import BlockCompensator, check_size
from amiwarp.compensation.streams import Compensated
from amiwarp.errors import AmiwarpError, optional_module
from amiwarp.events.encoder import Encoder
from amiwarp.events.recording import Events, Recording
from amiwarp.imaging.export import to_picture
from amiwarp.imaging.iwe import CanvasShape, Votes
from amiwarp.imaging.palette import OFF_ON_BLACK, ON_ON_BLACK
from amiwarp.io.export import check_limits
from amiwarp.io.files import NewFile, errors_name
from amiwarp.io.formats import LIMITS, Codec, Limits, Outline, OutputFormat
from amiwarp.io.ros_writer import MESSAGE, TOPIC, PacketEncoder
from amiwarp.live.queues import BackgroundLoop
from amiwarp.tasks import Progress

# Frames, and the prism's angles, as both viewers get them.

FRAME_US = 33_333
"""Default length of the time window of a frame [us]."""
MOST_POINTS = 10_000
"""Largest number of points in the cloud of a frame; more events are thinned evenly."""
ANGLE_US = 1000
"""Interval between two prism angles of a recording [us]."""
RECORDED, COMPENSATED = "recorded", "compensated"
"""Names of the two streams of frames."""


@dataclass(frozen=True, slots=True)
class Frame:
    """Events of a time window, and their image."""

    events: Events
    png: bytes
    """Image with OFF in blue and ON in orange, as a PNG file."""


@dataclass(frozen=True, slots=True)
class Window:
    """Time window with a frame of each stream, and with prism angles."""

    t: int
    """Start [us]."""
    length_us: int
    """Length [us]."""
    frames: Mapping[str, Frame]
    """Frames by the name of their stream."""
    angles: Mapping[str, tuple[NDArray[np.int64], NDArray[np.float64]]] = field(default_factory=dict)
    """Times [us] and prism angles [rad] by name, each of shape ``(n,)``."""


ANGLES = ("angle", "second_angle")
"""Names of the angles of the first and of the second prism, or of a mirror's two."""


class Painter:
    """Image of the events of a frame, on a canvas that is allocated once."""

    def __init__(self, size: tuple[int, int], device: Any) -> None:
        """Take the width and height of the sensor [px]."""
        self._votes = Votes(CanvasShape(*size, per_polarity=True), device)

    def __call__(self, events: Events) -> Frame:
        """Return the frame of events, raw or compensated."""
        from PIL import Image

        self._votes.add_unmoved(events)
        picture, buffer = to_picture(self._votes.take(), Layers.POLARITY), io.BytesIO()
        Image.fromarray(picture).save(buffer, "PNG", compress_level=1)  # ten times as fast as the best level
        return Frame(events, buffer.getvalue())


def windows(
    recording: Recording, compensate: BlockCompensator | None, encoder: Encoder | None, length_us: int, device: Any
) -> Iterator[Window]:
    """Yield the time windows with events, and an empty one at the start of each gap."""
    source = recording.events
    paint, first, last = Painter(source.size, device), source.t_first, -1
    names = [RECORDED] if compensate is None else [RECORDED, COMPENSATED]
    for events in source.blocks(duration_us=length_us):
        at = (int(events.t[0]) - first) // length_us
        if last + 1 < at:
            yield Window(first + (last + 1) * length_us, length_us, {name: paint(Events.empty()) for name in names})
        last, start = at, first + at * length_us
        frames = {RECORDED: paint(events)}
        if compensate is not None:
            frames[COMPENSATED] = paint(compensate(events)[0])
        yield Window(start, length_us, frames, _angles(encoder, start, start + length_us))


def _angles(encoder: Encoder | None, start: int, stop: int) -> dict[str, tuple[NDArray[np.int64], NDArray[np.float64]]]:
    """Return times [us] from ``start`` to ``stop`` and the prism angles [rad] there, by name."""
    if encoder is None:
        return {}
    begin, end = encoder.coverage
    t = np.arange(start, stop, ANGLE_US, dtype=np.int64)
    t = t[(begin <= t) & (t <= end)]
    columns = encoder.angles_at(t).T if encoder.second is not None else [encoder.angle_at(t)]
    return {name: (t, angle) for name, angle in zip(ANGLES, columns, strict=False)}


# Rerun: chunks of columns, which a file holds and a viewer receives.

TIMELINE = "sensor_time"
"""Timeline of Rerun, in the sensor's time."""


def rerun_module() -> Any:
    """Import Rerun. Raises :class:`AmiwarpError` if it is missing."""
    for name in ("rerun.chunk", "rerun"):
        module = optional_module(name, "rerun", "Rerun needs its library")
    return module


def rerun_chunks(window: Window) -> Iterator[Any]:
    """Yield the content of a window for Rerun: images and point clouds of the frames, and angles [deg]."""
    rerun = rerun_module()

    def chunk(entity: str, t: Any, columns: Any) -> Any:
        time = rerun.TimeColumn(TIMELINE, duration=np.asarray(t, "timedelta64[us]"))
        return rerun.chunk.Chunk.from_columns(entity, [time], columns)

    for name, frame in window.frames.items():
        image = rerun.EncodedImage.columns(blob=[frame.png], media_type=["image/png"])
        yield chunk(f"/{name}/image", [window.t], image)
        positions, colours = points(window, frame.events)
        cloud = rerun.Points3D.columns(positions=positions, colors=colours)
        yield chunk(f"/{name}/points", [window.t], cloud.partition([len(positions)]))
    for name, (t, angle) in window.angles.items():
        if len(t):
            yield chunk(f"/prism/{name}", t, rerun.Scalars.columns(scalars=_degrees(angle)))


def points(window: Window, events: Events) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Return the points of a cloud, shape ``(n, 3)``, and their colours as RGB, shape ``(n, 3)``.

    The coordinates are x and y [px], and the share of the window that has passed times 100.
    """
    events = events[:: max(1, -(-len(events) // MOST_POINTS))]
    passed = (events.t - window.t) * (100.0 / window.length_us)
    places = np.stack([events.x, events.y, passed], axis=1).astype(np.float32)
    palette = np.rint(255.0 * np.array([OFF_ON_BLACK, ON_ON_BLACK])).astype(np.uint8)
    known = np.isfinite(places).all(axis=1)
    return places[known], palette[events.p[known].astype(np.intp)]


def _degrees(angle: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return angles [rad] within a turn, in degrees."""
    return np.degrees(np.mod(angle, 2.0 * math.pi))


def write_rerun(part: Path, content: Iterable[Window], about: Outline) -> None:
    """Write windows to a file for Rerun."""
    rerun = rerun_module()
    failed: list[BaseException] = []

    def chunks() -> Iterator[Any]:
        try:
            for window in content:
                yield from rerun_chunks(window)
        except BaseException as error:  # Rerun raises its own error instead
            failed.append(error)
            raise

    try:
        stream = rerun.chunk.LazyChunkStream.from_iter(chunks())
        # Rerun joins recordings with the same id.
        stream.write_rrd(part, application_id="amiwarp", recording_id=f"{about.path.stem}-{uuid.uuid4().hex[:8]}")
    except RuntimeError as error:
        raise failed[0] if failed else AmiwarpError(f"Rerun cannot write it: {error}; choose another place") from error


# Foxglove: messages of topics, which an MCAP file holds and a server sends.

ANGLE_SCHEMA = {"title": "amiwarp.PrismAngle", "type": "object", "properties": {"degrees": {"type": "number"}}}
"""JSON schema of the messages with a prism angle. Foxglove has no message for a number."""


def foxglove_module() -> Any:
    """Import Foxglove's library. Raises :class:`AmiwarpError` if it is missing."""
    for name in ("foxglove.messages", "foxglove"):
        module = optional_module(name, "foxglove", "Foxglove needs its library")
    return module


def foxglove_topics() -> dict[str, tuple[str, Any]]:
    """Return the encoding of the messages and the schema of each topic of Foxglove."""
    foxglove = foxglove_module()
    image = foxglove.messages.CompressedImage.get_schema()
    text = json.dumps(ANGLE_SCHEMA).encode()
    angle = foxglove.Schema(name=ANGLE_SCHEMA["title"], encoding="jsonschema", data=text)
    return {
        **{f"/{name}/image": ("protobuf", image) for name in (RECORDED, COMPENSATED)},
        **{f"/prism/{name}": ("json", angle) for name in ANGLES},
    }


def foxglove_messages(window: Window) -> Iterator[tuple[str, int, bytes]]:
    """Yield the messages of a window for Foxglove: topic, time [ns] and data."""
    messages = foxglove_module().messages
    for name, frame in window.frames.items():
        stamp = messages.Timestamp(sec=window.t // 10**6, nsec=window.t % 10**6 * 1000)
        image = messages.CompressedImage(timestamp=stamp, frame_id="event_camera", data=frame.png, format="png")
        yield f"/{name}/image", 1000 * window.t, image.encode()
    for name, (times, angle) in window.angles.items():
        for t, degrees in zip(times.tolist(), _degrees(angle).tolist(), strict=True):
            yield f"/prism/{name}", 1000 * t, json.dumps({"degrees": degrees}).encode()


def write_foxglove(part: Path, content: Iterable[Window], about: Outline) -> None:
    """Write windows to an MCAP file for Foxglove, with the recorded events as packets of ROS 2 if they are whole."""
    foxglove_module()
    mcap = optional_module("mcap.writer", "foxglove", "Foxglove needs mcap")
    encoder = PacketEncoder(about)
    definition = encoder.store.generate_msgdef(MESSAGE, ros_version=2)[0].encode()
    with open(part, "wb") as file:
        writer = mcap.Writer(file)
        writer.start(library="amiwarp")
        channels: dict[str, int] = {}
        known = {topic: (kind, one.name, one.encoding, one.data) for topic, (kind, one) in foxglove_topics().items()}
        known[TOPIC] = ("cdr", MESSAGE, "ros2msg", definition)
        schemas: dict[str, int] = {}
        for window in content:
            events = window.frames[RECORDED].events
            packets = ((TOPIC, t, bytes(data)) for t, data in (encoder(events) if events.whole_pixels else ()))
            for topic, t, data in sorted(itertools.chain(foxglove_messages(window), packets), key=lambda one: one[1]):
                if topic not in channels:
                    kind, name, encoding, text = known[topic]
                    if name not in schemas:
                        schemas[name] = writer.register_schema(name, encoding, text)
                    channels[topic] = writer.register_channel(topic, kind, schemas[name])
                writer.add_message(channels[topic], log_time=t, publish_time=t, data=data)
        writer.finish()


# Files for the viewers.

VIEWERS: dict[str, tuple[Callable[[Path, Iterable[Window], Outline], None], Limits]] = {
    ".rrd": (write_rerun, Limits("a file for Rerun", t_first=-(2**52), t_last=2**52)),
    ".mcap": (write_foxglove, replace(LIMITS[OutputFormat.ROS2], label="a file for Foxglove")),
}
"""Function that writes the file of each viewer, and what it holds, by the extension of the file."""


@dataclass(frozen=True, slots=True)
class ViewerSummary:
    """Content of a file for a viewer."""

    events: int
    """Number of recorded events."""
    frames: int
    """Number of frames of each stream."""
    streams: tuple[str, ...]
    """Names of the streams of frames."""
    angles: int
    """Number of prism angles."""


def save_for_viewer(
    recording: Recording,
    path: Path,
    *,
    calibration: Calibration | None = None,
    frame_us: int = FRAME_US,
    device: Any = "cpu",
    progress: Progress | None = None,
) -> ViewerSummary:
    """Write frames of a recording, and the prism's angle, to a file for Rerun (.rrd) or for Foxglove (.mcap).

    Memory use does not depend on the length of the recording, but on the number of events in a frame.

    Parameters
    ----------
    recording : Recording
        Recording to show.
    path : Path
        File to write.
    calibration : Calibration, optional
        Calibration of the same camera and prism, for frames of the compensated events.
    frame_us : int
        Length of the time window of a frame [us].
    device : str or warp.Device, optional
        Device to compute on.
    progress : Progress, optional
        Called with the finished share.

    Returns
    -------
    ViewerSummary
        Content of the file.

    Raises
    ------
    AmiwarpError
        If a library is missing, the recording has no events, the calibration is for another sensor size, the encoder
        does not cover the events, or the file cannot be written or exists. No partial file remains.
    """
    source, encoder, compensate = recording.events, recording.encoder, None
    if not len(source):
        raise AmiwarpError(f"{recording.name}: holds no events to show; give a recording with events")
    ends = source.t_first, source.t_last
    if calibration is not None:
        check_size(calibration, source.size, recording.name)
        encoder = calibration.encoder_for(encoder, *ends)
        compensate = BlockCompensator(calibration.model, encoder, *ends, device)
    write, limits = VIEWERS[path.suffix.lower()]
    about = Outline(path, *source.size, *ends, Codec.BLOSC)
    check_limits(about, limits)
    done = frames = angles = 0

    def counted() -> Iterator[Window]:
        nonlocal done, frames, angles
        for window in windows(recording, compensate, encoder, frame_us, device):
            yield window
            done += len(window.frames[RECORDED].events)
            frames += 1
            angles += sum(len(t) for t, _ in window.angles.values())
            if progress is not None:
                progress("writing frames", done / len(source))

    with NewFile(path) as new, errors_name(path, lambda: f"writing {limits.label}"):
        write(new.part, counted(), about)
    streams = (RECORDED,) if compensate is None else (RECORDED, COMPENSATED)
    return ViewerSummary(done, frames, streams, angles)


# Live streams to the viewers.

MOST_WAITING = 8
"""Largest number of frames that wait for a viewer; further ones are dropped."""
MOST_EVENTS = 1 << 22
"""Largest number of events in a frame of a stream; further events of its window begin another frame."""
POLL_S = 0.1
"""Longest wait for a frame between two checks whether the stream has ended [s]."""
DRAIN_S = 2.0
"""Longest wait for the viewer at the end of the stream [s]."""


class LiveViewer(BackgroundLoop):
    """Sends frames and prism angles of a live stream to a viewer, in a background thread.

    It is a consumer of the sensor's events and of encoder samples, and a sink of compensated packets. It never waits:
    frames are dropped while :data:`MOST_WAITING` wait.
    """

    def __init__(
        self, send: Callable[[Window], None], end: Callable[[], None], size: tuple[int, int], frame_us: int = FRAME_US
    ) -> None:
        """Start the thread. ``send`` is called with each window, and ``end`` at the end, both in the thread."""
        self._send, self._end, self._frame_us = send, end, frame_us
        self._paint = Painter(size, "cpu")  # Warp's bookkeeping on CUDA allows one thread at a time
        self._paint(Events.empty())  # loads the kernels
        self._jobs: queue.Queue[tuple[Window, dict[str, Events]]] = queue.Queue(MOST_WAITING)
        self._held: dict[str, tuple[int, list[Events]]] = {}
        self._angles: dict[str, list[tuple[NDArray[np.int64], NDArray[np.float64]]]] = {}
        self._dropped = dict.fromkeys((RECORDED, COMPENSATED), 0)
        self._start_thread("amiwarp-viewer")

    @property
    def lost(self) -> int:
        """Number of frames that were dropped because the viewer, or this computer, is too slow."""
        return sum(self._dropped.values())

    def append(self, events: Events) -> None:
        """Add events of the sensor."""
        self._add(RECORDED, events)

    def append_encoder(
        self, t_us: NDArray[np.int64], angle: NDArray[np.float64], index_t_us: object = None, *, second: bool = False
    ) -> None:
        """Add encoder samples, which the next frame of the sensor's events takes along."""
        kept = np.diff(t_us // ANGLE_US, prepend=-1) != 0
        self._angles.setdefault(ANGLES[second], []).append((t_us[kept], angle[kept]))

    def tick(self) -> None:
        """Do nothing: the thread needs no call."""

    def __call__(self, packet: Compensated) -> None:
        """Add compensated events."""
        self._add(COMPENSATED, packet.events)

    def close(self) -> None:
        """Send the waiting frames and those that are not complete, and end the thread."""
        for name, (at, held) in self._held.items():
            self._put(name, at, Events.concatenate(held))
        self._held = {}
        super().close()

    def _add(self, name: str, events: Events) -> None:
        """Hold events until those of the next window come."""
        window = events.t // self._frame_us
        edges = [0, *(np.flatnonzero(np.diff(window)) + 1).tolist(), len(events)]
        for start, stop in itertools.pairwise(edges):
            if start == stop:
                continue
            at, held = self._held.get(name, (int(window[start]), []))
            if at != window[start] or sum(map(len, held)) > MOST_EVENTS:
                self._put(name, at, Events.concatenate(held))
                at, held = int(window[start]), []
            held.append(events[start:stop])
            self._held[name] = at, held

    def _put(self, name: str, at: int, events: Events) -> None:
        """Pass the events of a window to the thread, or drop them."""
        angles = {}
        if name == RECORDED:  # the thread that adds these events adds the encoder samples too
            held, self._angles = self._angles, {}
            for one, parts in held.items():
                t, angle = zip(*parts, strict=True)
                angles[one] = np.concatenate(t), np.concatenate(angle)
        try:
            self._jobs.put_nowait((Window(at * self._frame_us, self._frame_us, {}, angles), {name: events}))
        except queue.Full:
            self._dropped[name] += 1

    def _run(self) -> None:
        while not (self._ended.is_set() and self._jobs.empty()):
            with contextlib.suppress(queue.Empty):
                window, events = self._jobs.get(timeout=POLL_S)
                self._send(replace(window, frames={name: self._paint(one) for name, one in events.items()}))
        self._end()


def rerun_viewer(address: str, size: tuple[int, int], name: str) -> LiveViewer:
    """Return a consumer that sends a stream to a viewer of Rerun: ``spawn`` starts one, else its HOST:PORT."""
    rerun = rerun_module()
    stream = rerun.RecordingStream("amiwarp", recording_id=f"{name}-{uuid.uuid4().hex[:8]}")
    if address == "spawn":
        stream.spawn()
    else:
        host, port = _host_and_port(address, "--rerun")
        stream.connect_grpc(f"rerun+http://{host}:{port}/proxy")

    def end() -> None:
        with contextlib.suppress(RuntimeError):  # the viewer is gone
            stream.flush(timeout_sec=DRAIN_S)
        stream.disconnect()

    return LiveViewer(lambda window: stream.send_chunks(rerun_chunks(window)), end, size)


def foxglove_server(address: str, size: tuple[int, int]) -> LiveViewer:
    """Return a consumer that sends a stream to clients of Foxglove, which connect to ws://HOST:PORT."""
    foxglove = foxglove_module()
    host, port = _host_and_port(address, "--foxglove")
    context = foxglove.Context()
    try:
        server = foxglove.start_server(
            name="amiwarp", host=host, port=port, context=context, message_backlog_size=MOST_BACKLOG
        )
    except Exception as error:
        raise AmiwarpError(f"--foxglove {address}: cannot listen there: {error}; choose another address") from error
    channels = {
        topic: foxglove.Channel(topic, schema=schema, message_encoding=kind, context=context)
        for topic, (kind, schema) in foxglove_topics().items()
    }

    def send(window: Window) -> None:
        for topic, t, data in foxglove_messages(window):
            if t >= 0:  # Foxglove has no earlier times
                channels[topic].log(data, log_time=t)

    def end() -> None:
        server.stop()
        opened.clear()

    opened = [context]  # its channels close when nothing refers to it
    return LiveViewer(send, end, size)


MOST_BACKLOG = 256
"""Largest number of messages that wait for a client of Foxglove; then its oldest are dropped."""


def _host_and_port(address: str, option: str) -> tuple[str, int]:
    """Return the host and the port of an address. Raises :class:`AmiwarpError` if the text is none."""
    host, _, port = address.rpartition(":")
    if not host or not port.isdecimal() or int(port) > 65535:
        raise AmiwarpError(f"{option} {address!r} is not an address; give HOST:PORT, for example 127.0.0.1:8765")
    return host, int(port)
