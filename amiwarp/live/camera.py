"""Cameras for programs: plain events, without a prism."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import Any

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.live.stream.camera_settings import CameraSettings
from amiwarp.live.stream.cameras import CAMERAS
from amiwarp.live.stream.packets import Packet
from amiwarp.live.stream.sources import open_source
from amiwarp.schema.calls import guarded
from amiwarp.validation import real


class CameraPackets:
    """Iterator over the packets of an open camera, at least one every 50 ms.

    It raises :class:`AmiwarpError` after the last one if the camera stops.

    Parameters
    ----------
    source : Any
        What :func:`open_camera` opens.

    Examples
    --------
    >>> with amiwarp.open_camera("camera:") as camera:  # doctest: +SKIP
    ...     width, height = camera.size
    ...     first = next(camera)
    """

    def __init__(self, source: Any) -> None:  # users get it from open_camera, and make none
        self.size = source.size
        """Sensor size (width, height) [px]."""
        self.metadata = dict(getattr(source, "metadata", {}))
        """Model and settings of the camera, as a recording stores them."""
        self._source = source
        self._packets = source.packets()

    def __iter__(self) -> Iterator[Packet]:
        return self

    def __next__(self) -> Packet:
        packet = next(self._packets, None)
        if packet is not None:
            return packet
        problem = getattr(self._source, "problem", None)
        if problem is None:
            raise StopIteration
        raise AmiwarpError(
            f"{self._source.name}: the stream broke off: {problem}; open the camera again, or give wait_for_source_s",
            ErrorCode.UNREACHABLE,
        )

    @property
    def lost(self) -> int | None:
        """Number of USB packets that were lost so far, because this computer was too slow.

        None if the camera's library does not tell, as the libraries behind ``dv`` and ``prophesee``.
        """
        lost: int | None = self._source.lost
        return lost


@contextlib.contextmanager
@guarded
def open_camera(
    name: str,
    settings: CameraSettings | None = None,
    *,
    wait_for_source_s: float = 0.0,
    say: Callable[[str], None] = print,
) -> Iterator[CameraPackets]:
    """Open a camera in a ``with`` block, and receive its events as they are, without a prism or a calibration.

    Parameters
    ----------
    name : str
        Camera: ``camera:``, ``camera:SERIAL``, ``camera:MODEL``, ``dv``, ``dv:SERIAL``, ``prophesee`` or
        ``prophesee:SERIAL``, each also with settings as text, such as ``camera:evk4,diff_on=20``.
    settings : CameraSettings, optional
        Settings of the camera. They replace those in the name.
    wait_for_source_s : float, default 0.0
        Longest wait for the camera to return after its cable was pulled [s]. It then has the same settings again.
    say : callable, default print
        Function that gets messages, such as those about lost USB packets.

    Yields
    ------
    CameraPackets
        Iterator over :class:`Packet`, with the size and the settings of the camera. It raises an error when the camera
        stops, after the last packet.

    Raises
    ------
    AmiwarpError
        When the block is entered: if the camera cannot be opened, or does not have one of the settings.

    Examples
    --------
    >>> settings = amiwarp.CameraSettings(region=(320, 180, 960, 540), most_per_s=10_000_000)
    >>> with amiwarp.open_camera("camera:evk4", settings) as camera:  # doctest: +SKIP
    ...     for packet in camera:
    ...         print(len(packet.events), "events,", len(packet.triggers), "rising edges")
    """
    kind, colon, _ = name.partition(":")
    if kind not in CAMERAS:
        cameras = ", ".join(f"{prefix}:" for prefix in CAMERAS)
        raise AmiwarpError(f"name is {name!r}; give a camera: {cameras}")
    wait_s = real(wait_for_source_s, "wait_for_source_s", 0.0, 1e9, " s")
    text = "" if settings is None else str(settings)
    spec = ",".join(part for part in (name if colon else f"{name}:", text) if part)
    with contextlib.closing(open_source(spec, wait_s=wait_s, say=say)) as source:
        yield CameraPackets(source)
