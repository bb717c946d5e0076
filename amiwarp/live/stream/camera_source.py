"""What the sources of all camera drivers share: names, settings, trigger edges, and the end of a stream."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events.recording import Events, MetadataValue
from amiwarp.live.link.clocks import monotonic_us
from amiwarp.live.stream.camera_checks import difference
from amiwarp.live.stream.camera_settings import SAVED, CameraRequest, CameraSettings
from amiwarp.live.stream.packets import Packet, make_packet
from amiwarp.live.stream.sockets import Unreachable
from amiwarp.optics.camera import Camera
from amiwarp.optics.prism import NominalPrism


class CameraSource:
    """Source of events from a camera. Each driver has a class of its own, which opens the camera in its constructor.

    Raises :class:`Unreachable` if the camera is not there, and :class:`AmiwarpError` for a missing library and for
    settings that the camera does not have.
    """

    camera: Camera | None = None
    """Camera intrinsics: None, because the device does not store its calibration."""
    prism: NominalPrism | None = None
    size: tuple[int, int]

    def __init__(
        self,
        request: CameraRequest,
        say: Callable[[str], None] = lambda _: None,
        *,
        packet_us: int = 1000,
    ) -> None:
        self.request = request
        self._say = say
        self._packet_us = packet_us
        self.settings = request.settings
        self.encoders = int(self.settings.counts_per_turn != 0)
        self.name = request.name()
        """Name of the camera, with its serial number once it is open, and with its settings."""
        self.serial = request.which
        """Serial number, once the camera is open."""
        self.metadata: dict[str, MetadataValue] = {}
        """What a recording shall store about the camera."""
        self.problem: str | None = None
        """Why the camera stopped, in one line; None while it runs."""
        self.lost: int | None = None
        """Number of USB packets that were lost, because the computer was too slow; None if the library tells none."""
        self._count = 0
        """Number of rising edges at the trigger input so far, if they are counts of an encoder."""

    def packets(self) -> Iterator[Packet]:
        """Yield packets, see :meth:`Source.packets`. Ends when the camera stops; :attr:`problem` then says why."""
        raise NotImplementedError

    def close(self) -> None:
        """Release the camera, see :meth:`Source.close`."""
        raise NotImplementedError

    def reopened(self) -> CameraSource:
        """Return a new source of the same camera, with the same settings, after this one was closed."""
        return type(self)(
            replace(self.request, which=self.serial), self._say, packet_us=self._packet_us
        )

    def _opened(self, model: str, serial: str, applied: CameraSettings, reported: str) -> None:
        """Note the camera that was opened, and its settings.

        ``applied``: the settings that the camera has; ``reported``: where they are from, for the recording.
        """
        self.serial = serial
        self.name = self.request.name(serial)
        self.metadata = {"camera_name": model, SAVED: str(applied), f"{SAVED}_from": reported}
        changed = difference(self.settings, applied)
        if changed:
            self._say(f"{self.name}: the camera has {changed}")

    def _make_packet(self, events: Events | None, rising: NDArray[np.int64]) -> Packet:
        """Return the packet of events and of rising edges at the trigger input [us]."""
        now = monotonic_us()
        counts = self.settings.counts_per_turn
        if self.settings.trigger is False:
            rising = rising[:0]
        if not counts:
            return make_packet(now, events, rising)
        numbers = np.arange(self._count, self._count + rising.size, dtype=np.float64)
        angle = numbers * (math.tau / counts)
        self._count += rising.size
        return make_packet(now, events, rising, rising, angle)

    @contextlib.contextmanager
    def _stopping(self) -> Iterator[None]:
        """Let an error of the library end the stream with its :attr:`problem` set."""
        try:
            with named(self.name, "the camera stopped"):
                yield
        except AmiwarpError as error:
            self.problem = str(error).removeprefix(f"{self.name}: ")


def library(name: str, camera: str, remedy: str) -> Any:
    """Import a module of a camera's library. Raises :class:`AmiwarpError` if it is missing."""
    try:
        return import_module(name)
    except ImportError as error:
        raise AmiwarpError(
            f"{camera}: needs the library {name.partition('.')[0]} ({error}); {remedy}",
            ErrorCode.PACKAGE_MISSING,
        ) from error


@contextlib.contextmanager
def named(camera: str, doing: str, kind: type[AmiwarpError] = AmiwarpError) -> Iterator[None]:
    """Turn any exception of a camera's library into an :class:`AmiwarpError` of one line."""
    try:
        yield
    except (AmiwarpError, KeyboardInterrupt, SystemExit, GeneratorExit):
        raise
    except BaseException as error:
        lines = [line for line in str(error).splitlines() if line.strip()] or [type(error).__name__]
        raise kind(
            f"{camera}: {doing}: {lines[0][:200]}; check cable, power and access rights"
        ) from error


def opening(camera: str) -> contextlib.AbstractContextManager[None]:
    """Turn any exception of a camera's library into :class:`Unreachable`, so that opening can be tried again."""
    return named(camera, "cannot be opened", Unreachable)


def copied_events(x: Any, y: Any, t: Any, p: Any) -> Events:
    """Copy the columns of a library's rows into new events, because the library reuses its memory."""
    return Events(
        x.astype(np.uint16), y.astype(np.uint16), t.astype(np.int64), (p > 0).astype(np.uint8)
    )
