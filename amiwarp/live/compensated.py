"""Iteration over the compensated packets of a live stream, for programs."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from amiwarp.imaging.filters import EventFilter
from amiwarp.live.items import LivePackets, closed_on_error, open_rig
from amiwarp.live.queues import Policy
from amiwarp.live.stream.session import Session
from amiwarp.results.calibration import Calibration
from amiwarp.schema.calls import guarded
from amiwarp.validation import real


@contextlib.contextmanager
@guarded
def compensate_live(
    source: str | Path,
    calibration: Calibration,
    *,
    port: str | None = None,
    counts_per_turn: int | None = None,
    filter: EventFilter | None = None,
    undistort: bool = False,
    fast: bool = False,
    wait_for_source_s: float = 0.0,
    wait_ms: float = 10.0,
    policy: Policy = Policy.BLOCK,
    watch_s: float = 10.0,
    device: Any = "cpu",
    say: Callable[[str], None] = print,
) -> Iterator[LivePackets]:
    """Compensate the events of a live stream, and iterate over them in a ``with`` block.

    This is ``amiwarp live`` for programs. The stream is opened when the block is entered. Background threads read and
    compensate it until the stream ends or the block is left: by ``break``, an error or Ctrl-C. Every event is in one
    packet, in order of time.

    Parameters
    ----------
    source : str or Path
        Source: ``camera:``, ``dv``, ``prophesee``, ``tcp:HOST:PORT``, ``unix:PATH``, ``shm:NAME``, ``udp:HOST:PORT``,
        ``-`` for standard input, or a file to replay. :class:`CameraSettings` continue the name of a camera:
        ``f"camera:evk4,{settings}"``.
    calibration : Calibration
        Calibration of the camera.
    port : str, optional
        Serial port of the prism's controller: name, USB id VID:PID, or ``find``. By default, the encoder samples of the
        source are used.
    counts_per_turn : int, optional
        Encoder counts per turn, if the controller sends lines of text.
    filter : EventFilter, optional
        The events of the sensor that are compensated, by default all.
    undistort : bool, default False
        Whether to remove the distortion of the calibrated lens at the end, as :meth:`Camera.undistort` does.
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
    LivePackets
        Iterator over the packets, with the counts of each stage. It raises an error of the source, such as a stream
        that breaks off, after the last one.

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
    with contextlib.ExitStack() as resources:
        opened, link = open_rig(
            resources,
            source,
            calibration,
            port=port,
            counts_per_turn=counts_per_turn,
            fast=fast,
            wait_for_source_s=wait_for_source_s,
            say=say,
        )
        packets = LivePackets(opened)
        with closed_on_error(opened):
            session = Session(
                opened,
                calibration,
                link=link,
                chosen=filter,
                undistort=calibration.model.camera if undistort else None,
                sinks=(packets.put,),
                watch_s=watch_s or None,
                wait_us=wait_us,
                policy=policy,
                device=device,
                say=say,
            )
        packets.start(session)
        resources.enter_context(packets)
        yield packets
