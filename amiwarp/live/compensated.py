"""Iteration over the compensated packets of a live stream, for programs."""

from __future__ import annotations

import contextlib
import os
import queue
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from amiwarp.calib.result import Calibration
from amiwarp.compensation.recordings import check_size
from amiwarp.compensation.streams import Compensated
from amiwarp.errors import AmiwarpError
from amiwarp.live.link.link import Link
from amiwarp.live.queues import BackgroundLoop, Policy
from amiwarp.live.stream.packets import Source
from amiwarp.live.stream.session import Session, encoder_count
from amiwarp.live.stream.sources import open_source
from amiwarp.validation import guarded, real

MOST_PACKETS = 8
"""Largest number of compensated packets that wait for the program, each of at most one batch of the compensator."""
STEP_S = 0.1
"""Time between two checks whether the iteration was ended [s]."""


@contextlib.contextmanager
@guarded
def compensate_live(
    source: str | Path,
    calibration: Calibration,
    *,
    port: str | None = None,
    counts_per_turn: int | None = None,
    fast: bool = False,
    wait_for_source_s: float = 0.0,
    wait_ms: float = 10.0,
    policy: Policy = Policy.BLOCK,
    watch_s: float = 10.0,
    device: Any = "cpu",
    say: Callable[[str], None] = print,
) -> Iterator[Iterator[Compensated]]:
    """Compensate the events of a live stream, and iterate over them in a ``with`` block.

    This is ``amiwarp live`` for programs. The stream is opened when the block is entered. Background threads read and
    compensate it until the stream ends or the block is left: by ``break``, an error or Ctrl-C. Every event is in one
    packet, in order of time.

    Parameters
    ----------
    source : str or Path
        Source: ``camera:``, ``dv``, ``prophesee``, ``tcp:HOST:PORT``, ``unix:PATH``, ``-`` for standard input, or a
        file to replay. :class:`CameraSettings` continue the name of a camera: ``f"camera:evk4,{settings}"``.
    calibration : Calibration
        Calibration of the camera.
    port : str, optional
        Serial port of the prism's controller: name, USB id VID:PID, or ``find``. By default, the encoder samples of the
        source are used.
    counts_per_turn : int, optional
        Encoder counts per turn, if the controller sends lines of text.
    fast : bool, default False
        Whether to replay a file as fast as possible, not in real time.
    wait_for_source_s : float, default 0.0
        Longest wait for the sender of a socket, or for a camera, to return after the stream breaks off [s].
    wait_ms : float, default 10.0
        Longest wait for encoder samples [ms]; after it the angle is extrapolated.
    policy : Policy or str, default "block"
        Treatment of events that arrive faster than the program takes them: ``block``, ``drop-oldest`` or ``thin``.
    watch_s : float, default 10.0
        Interval between checks of the calibrated phase [s]; 0: no checks.
    device : str or warp.Device, default "cpu"
        Device that compensates.
    say : callable, default print
        Function that gets messages, such as those about a phase that changed.

    Yields
    ------
    iterator of Compensated
        The packets. The iterator raises an error of the source, such as a stream that breaks off, after the last one.

    Raises
    ------
    AmiwarpError
        When the block is entered: if the source or port cannot be opened, no encoder samples can come, or the
        calibration belongs to another sensor size.

    Examples
    --------
    >>> camera, prism = amiwarp.Camera.from_fov(64, 48, 1.0), amiwarp.Prism(0.035)
    >>> calibration = amiwarp.Calibration(
    ...     model_name="exact", camera=camera, prism=prism, parameters={"apex": 0.026, "phase": 0.4}, uncertainty={},
    ...     free=("apex", "phase"), sharpness_name="variance", sharpness_before=1.0, sharpness_after=2.0, stages=(),
    ...     events=300_000, seconds=1.5,
    ... )
    >>> source = amiwarp.MemoryEvents(amiwarp.Events.from_arrays([30, 31], [20, 21], [0, 50], [1, 0]), 64, 48)
    >>> encoder = amiwarp.Encoder.constant_speed(720.0, 0, 1000)
    >>> amiwarp.save_recording("live.h5", amiwarp.Recording(source, camera, encoder, prism))
    >>> with amiwarp.compensate_live("live.h5", calibration, fast=True) as packets:
    ...     sum(len(packet.events) for packet in packets)
    2
    """
    wait_us = round(1e3 * real(wait_ms, "wait_ms", 0.0, 1e6, " ms"))
    watch_s = real(watch_s, "watch_s", 0.0, 1e9, " s")
    wait_s = real(wait_for_source_s, "wait_for_source_s", 0.0, 1e9, " s")
    if counts_per_turn is not None and port is None:
        raise AmiwarpError("counts_per_turn is given without port; give the controller's port, or leave it out")
    with contextlib.ExitStack() as resources:
        link = None
        if port is not None:
            link = resources.enter_context(Link(None if port == "find" else port, counts_per_turn=counts_per_turn))
        opened = open_source(os.fspath(source), pace=None if fast else 1.0, wait_s=wait_s, say=say)
        try:
            if not encoder_count(opened, link):
                raise AmiwarpError(f"{opened.name}: contains no encoder samples; give the controller's port")
            check_size(calibration, opened.size, opened.name)
            packets = CompensatedPackets(opened)
            session = Session(
                opened, calibration, link=link, sinks=(packets.put,), watch_s=watch_s or None, wait_us=wait_us,
                policy=policy, device=device, say=say,
            )  # fmt: skip
        except BaseException:
            opened.close()
            raise
        packets.start(session)
        resources.enter_context(packets)
        yield packets


class CompensatedPackets(BackgroundLoop):
    """Iterator over the compensated packets of a session, which runs in a background thread."""

    def __init__(self, source: Source) -> None:
        self._source = source
        self._stop = threading.Event()
        self._packets: queue.Queue[Compensated | None] = queue.Queue(MOST_PACKETS)

    def start(self, session: Session) -> None:
        """Start the session, one of whose sinks is :meth:`put`."""
        self._session = session
        self._start_thread("amiwarp-live")

    def put(self, packet: Compensated | None) -> None:
        """Wait until there is room for a packet, and add it; None marks the end. Does nothing once closed."""
        while not self._ended.is_set():
            with contextlib.suppress(queue.Full):
                self._packets.put(packet, timeout=STEP_S)
                return

    def close(self) -> None:
        """End the session, drop the waiting packets, and wait for its threads. Raises its error, once."""
        self._stop.set()
        super().close()

    def __iter__(self) -> Iterator[Compensated]:
        return self

    def __next__(self) -> Compensated:
        while not self._ended.is_set():
            with contextlib.suppress(queue.Empty):
                packet = self._packets.get(timeout=STEP_S)
                if packet is not None:
                    return packet
                self.close()
        raise StopIteration

    def _run(self) -> None:
        try:
            status = self._session.run(self._stop, lambda _: None)
            problem = getattr(self._source, "problem", None)
            if problem is not None:
                raise AmiwarpError(
                    f"{self._source.name}: the stream broke off: {problem}; the iterator gave the {status.events:,} "
                    "events received until then"
                )
        finally:
            self.put(None)
