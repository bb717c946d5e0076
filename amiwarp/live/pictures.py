"""Iteration over pictures of a live stream, for programs."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from amiwarp.live.items import LiveItems, closed_on_error, open_rig
from amiwarp.live.queues import Policy
from amiwarp.live.stream.encoder_feed import event_encoder
from amiwarp.live.stream.picture_stream import PictureStream
from amiwarp.live.stream.session import Session
from amiwarp.reconstruction.phase_camera import LivePicture, PhaseCamera
from amiwarp.results.calibration import Calibration
from amiwarp.schema.calls import guarded
from amiwarp.validation import real


@contextlib.contextmanager
@guarded
def pictures_live(
    source: str | Path,
    calibration: Calibration,
    *,
    turns: float = 0.25,
    rate_hz: float | None = None,
    port: str | None = None,
    counts_per_turn: int | None = None,
    fast: bool = False,
    wait_for_source_s: float = 0.0,
    wait_ms: float = 10.0,
    policy: Policy = Policy.BLOCK,
    device: Any = "cpu",
    say: Callable[[str], None] = print,
) -> Iterator[Iterator[LivePicture]]:
    """Make pictures of a live stream, and iterate over them in a ``with`` block.

    This is ``amiwarp live --picture`` for programs. The stream is opened when the block is entered. Background threads
    read it until it ends or the block is left: by ``break``, an error or Ctrl-C. Pictures for which the computer, or
    the program, is too slow are left out; a file that is replayed with ``fast`` waits for them instead.

    Parameters
    ----------
    source : str or Path
        Source, as for :func:`compensate_live`.
    calibration : Calibration
        Calibration of the camera, of an optic with one angle.
    turns : float, optional
        Shortest part of a turn for a picture, as for :class:`PhaseCamera`.
    rate_hz : float, optional
        Number of pictures per second of the stream [Hz]; by default one after each ``turns``.
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
        Treatment of events that arrive faster than they are counted: ``block``, ``drop-oldest`` or ``thin``.
    device : str or warp.Device, default "cpu"
        Device that makes the pictures, as for :class:`PhaseCamera`.
    say : callable, default print
        Function that gets messages, such as those about the clocks of controller and camera.

    Yields
    ------
    iterator of LivePicture
        The pictures. The iterator raises an error of the source, such as a stream that breaks off, after the last one.

    Raises
    ------
    AmiwarpError
        When the block is entered: if the source or port cannot be opened, no encoder samples can come, the calibration
        belongs to another sensor size or to an optic with two angles, or a number is out of range.

    Examples
    --------
    >>> camera, prism = amiwarp.Camera.from_fov(64, 48, 1.0), amiwarp.Prism(0.035)
    >>> calibration = amiwarp.Calibration(
    ...     model_name="exact", camera=camera, prism=prism, parameters={"apex": 0.026, "phase": 0.4}, uncertainty={},
    ...     free=("apex", "phase"), sharpness_name="variance", sharpness_before=1.0, sharpness_after=2.0, stages=(),
    ...     events=300_000, seconds=1.5,
    ... )
    >>> import numpy as np
    >>> t = np.arange(0, 200_000, 100)
    >>> source = amiwarp.MemoryEvents(amiwarp.Events.from_arrays(t % 64, t % 48, t, t % 200 == 0), 64, 48)
    >>> encoder = amiwarp.Encoder.constant_speed(720.0, 0, 200_000)
    >>> amiwarp.save_recording("pictures.h5", amiwarp.Recording(source, camera, encoder, prism))
    >>> with amiwarp.pictures_live("pictures.h5", calibration, fast=True) as pictures:
    ...     [found.turns for found in pictures]
    [1.0, 0.25, 0.25, 0.25, 0.25, 0.25]
    """
    wait_us = round(1e3 * real(wait_ms, "wait_ms", 0.0, 1e6, " ms"))
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
        with closed_on_error(opened):
            camera = PhaseCamera(
                calibration.model,
                event_encoder(opened, calibration, link),
                turns=turns,
                rate_hz=rate_hz,
                wait_us=wait_us,
                device=device,
            )
            pictures: LiveItems[LivePicture] = LiveItems(opened)
            drawn = PictureStream(camera, pictures.put, newest=not fast)
            resources.callback(drawn.close)
            session = Session(opened, link=link, raw=(drawn,), policy=policy, say=say)
        pictures.start(session, drawn.close)
        resources.enter_context(pictures)
        yield pictures
