"""Iteration over the events of a live stream of a plain camera, for programs."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator
from pathlib import Path

from amiwarp.errors import AmiwarpError
from amiwarp.imaging.filters import EventFilter
from amiwarp.live.items import LivePackets, closed_on_error
from amiwarp.live.queues import Policy
from amiwarp.live.stream.session import Session
from amiwarp.live.stream.sources import open_source
from amiwarp.optics.camera import Camera
from amiwarp.schema.calls import guarded
from amiwarp.validation import real


@contextlib.contextmanager
@guarded
def stream_live(
    source: str | Path,
    *,
    filter: EventFilter | None = None,
    undistort: Camera | None = None,
    fast: bool = False,
    wait_for_source_s: float = 0.0,
    policy: Policy = Policy.BLOCK,
    say: Callable[[str], None] = print,
) -> Iterator[LivePackets]:
    """Filter and undistort the events of a live stream, and iterate over them in a ``with`` block.

    This is ``amiwarp live`` without a calibration, for programs: nothing is compensated. The stream is opened when the
    block is entered. Background threads read it until it ends or the block is left: by ``break``, an error or Ctrl-C.
    Packets that end anywhere give the events of the filtered and undistorted file.

    Parameters
    ----------
    source : str or Path
        Source, as for :func:`compensate_live`.
    filter : EventFilter, optional
        The events of the sensor that are kept, by default all.
    undistort : Camera, optional
        The camera with the lens whose distortion is removed, as :meth:`Camera.undistort` does; by default none.
    fast : bool, default False
        Whether to replay a file as fast as possible, not in real time.
    wait_for_source_s : float, default 0.0
        Longest wait for the sender of a socket, or for a camera, to return after the stream breaks off [s].
    policy : Policy or str, default "block"
        Treatment of events that arrive faster than the program takes them: ``block``, ``drop-oldest`` or ``thin``.
    say : callable, default print
        Function that gets messages, such as those about lost USB packets.

    Yields
    ------
    LivePackets
        Iterator over the packets. It raises an error of the source, such as a stream that breaks off, after the last
        one. Packets have the type that :func:`compensate_live` gives, so that a program serves both kinds of cameras:
        whole pixels without flags, or undistorted places, with the flag 1 for events outside the image.

    Raises
    ------
    AmiwarpError
        When the block is entered: if the source cannot be opened, or is of another size than the filter or the camera.

    Examples
    --------
    >>> events = amiwarp.Events.from_arrays([30, 31, 30], [20, 21, 20], [0, 50, 60], [1, 0, 1])
    >>> recording = amiwarp.Recording(amiwarp.MemoryEvents(events, 64, 48))
    >>> amiwarp.save_recording("stream.h5", recording)
    >>> calm = amiwarp.EventFilter(refractory_us=1000)
    >>> with amiwarp.stream_live("stream.h5", filter=calm, fast=True) as packets:
    ...     sum(len(packet.events) for packet in packets)
    2
    >>> packets.stages[-1].removed
    {'refractory period': 1}
    """
    wait_s = real(wait_for_source_s, "wait_for_source_s", 0.0, 1e9, " s")
    opened = open_source(os.fspath(source), pace=None if fast else 1.0, wait_s=wait_s, say=say)
    packets = LivePackets(opened)
    with closed_on_error(opened):
        if undistort is not None:
            _check_camera(undistort, opened.size, opened.name)
        session = Session(
            opened,
            chosen=filter,
            undistort=undistort,
            sinks=(packets.put,),
            policy=policy,
            say=say,
        )
    packets.start(session)
    with packets:
        yield packets


def _check_camera(camera: Camera, size: tuple[int, int], name: str) -> None:
    """Raise :class:`AmiwarpError` for a camera of another size than the source's."""
    if (camera.width, camera.height) != tuple(size):
        raise AmiwarpError(
            f"{name}: is of {size[0]}x{size[1]} pixels, the camera of undistort has {camera.width}x{camera.height}; "
            "give the camera of this source"
        )
