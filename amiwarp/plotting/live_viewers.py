"""Live streams to the viewers Rerun and Foxglove."""

from __future__ import annotations

import contextlib
import itertools
import queue
import uuid
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from amiwarp.compensation.streams import Compensated
from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events.recording import Events
from amiwarp.plotting.foxglove_messages import foxglove_messages, foxglove_module, foxglove_topics
from amiwarp.plotting.frames import (
    ANGLE_US,
    ANGLES,
    COMPENSATED,
    FRAME_US,
    RECORDED,
    Painter,
    Window,
)
from amiwarp.plotting.rerun_chunks import rerun_chunks, rerun_module
from amiwarp.tasks import BackgroundLoop

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
        self,
        send: Callable[[Window], None],
        end: Callable[[], None],
        size: tuple[int, int],
        frame_us: int = FRAME_US,
    ) -> None:
        """Start the thread. ``send`` is called with each window, and ``end`` at the end, both in the thread."""
        self._send = send
        self._end = end
        self._frame_us = frame_us
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
        self,
        t_us: NDArray[np.int64],
        angle: NDArray[np.float64],
        index_t_us: object = None,
        *,
        second: bool = False,
    ) -> None:
        """Add encoder samples, which the next frame of the sensor's events takes along."""
        kept = np.diff(t_us // ANGLE_US, prepend=-1) != 0
        first_name, second_name = ANGLES
        name = second_name if second else first_name
        self._angles.setdefault(name, []).append((t_us[kept], angle[kept]))

    def tick(self) -> None:
        """Do nothing: the thread needs no call."""

    def __call__(self, packet: Compensated) -> None:
        """Add compensated events."""
        self._add(COMPENSATED, packet.events)

    def close(self) -> None:
        """Send the waiting frames and those that are not complete, and end the thread."""
        for name, (start_us, held) in self._held.items():
            self._put(name, start_us, Events.concatenate(held))
        self._held = {}
        super().close()

    def _add(self, name: str, events: Events) -> None:
        """Hold events until events of the next window come."""
        window = events.t // self._frame_us
        edges = [0, *(np.flatnonzero(np.diff(window)) + 1).tolist(), len(events)]
        for start, stop in itertools.pairwise(edges):
            if start == stop:
                continue
            start_us, held = self._held.get(name, (int(window[start]), []))
            if start_us != window[start] or sum(map(len, held)) > MOST_EVENTS:
                self._put(name, start_us, Events.concatenate(held))
                start_us = int(window[start])
                held = []
            held.append(events[start:stop])
            self._held[name] = start_us, held

    def _put(self, name: str, start_us: int, events: Events) -> None:
        """Pass the events of a window to the thread, or drop them."""
        angles = {}
        if name == RECORDED:  # the thread that adds these events adds the encoder samples too
            held = self._angles
            self._angles = {}
            for one, parts in held.items():
                t, angle = zip(*parts, strict=True)
                angles[one] = np.concatenate(t), np.concatenate(angle)
        window = Window(start_us * self._frame_us, self._frame_us, {}, angles)
        try:
            self._jobs.put_nowait((window, {name: events}))
        except queue.Full:
            self._dropped[name] += 1

    def _run(self) -> None:
        while not (self._ended.is_set() and self._jobs.empty()):
            with contextlib.suppress(queue.Empty):
                window, events = self._jobs.get(timeout=POLL_S)
                frames = {name: self._paint(of_stream) for name, of_stream in events.items()}
                self._send(replace(window, frames=frames))
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
        raise AmiwarpError(
            f"--foxglove {address}: cannot listen there: {error}; choose another address",
            ErrorCode.UNREACHABLE,
        ) from error
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
        raise AmiwarpError(
            f"{option} {address!r} is not an address; give HOST:PORT, for example 127.0.0.1:8765"
        )
    return host, int(port)
