"""Cameras: iniVation's through dv-processing, Prophesee's through Metavision or OpenEB. Both libraries are optional.

Tested with substitutes for these libraries, not yet with cameras.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator
from datetime import timedelta
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np

from amiwarp.errors import AmiwarpError
from amiwarp.events.events import Events
from amiwarp.live.link.clocks import monotonic_us
from amiwarp.live.stream.packets import Packet, make_packet

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.optics.camera import Camera
    from amiwarp.optics.prism import NominalPrism

POLL_S = 0.0005
"""Pause between two requests to the camera's library for events [s]."""
IDLE_S = 0.05
"""Longest time without a packet [s]. After this time, an empty packet is delivered."""


def _library(name: str, camera: str, remedy: str) -> Any:
    try:
        return import_module(name)
    except ImportError as error:
        raise AmiwarpError(f"{camera}: needs the library {name.partition('.')[0]} ({error}); {remedy}") from error


@contextlib.contextmanager
def _named(camera: str, doing: str) -> Iterator[None]:
    """Turn any exception of a camera's library into an :class:`AmiwarpError` of one line."""
    try:
        yield
    except (AmiwarpError, KeyboardInterrupt, SystemExit, GeneratorExit):
        raise
    except BaseException as error:
        lines = [line for line in str(error).splitlines() if line.strip()] or [type(error).__name__]
        raise AmiwarpError(f"{camera}: {doing}: {lines[0][:200]}; check cable, power and access rights") from error


class _CameraSource:
    camera: Camera | None = None
    """Camera intrinsics: None, because the device does not store its calibration."""
    prism: NominalPrism | None = None
    has_encoder = False
    size: tuple[int, int]
    name: str


class DvSource(_CameraSource):
    """Source of events from an iniVation camera (DVXplorer, DAVIS), read through dv-processing 2.

    A serial number of None means the first camera found. Rising edges at its signal input become triggers. Raises
    :class:`AmiwarpError` if library or camera is missing.
    """

    def __init__(self, serial: str | None = None, *, packet_us: int = 1000) -> None:
        self.name = "dv" if serial is None else f"dv:{serial}"
        dv = _library("dv_processing", self.name, "pip install 'amiwarp[dv]'")
        with _named(self.name, "cannot be opened"):
            found = [str(camera.serialNumber) for camera in dv.io.camera.discover()]
            if serial not in found and (serial is not None or not found):
                raise AmiwarpError(
                    f"{self.name}: no such camera (found: {', '.join(found) or 'none'}); plug the camera in"
                )
            self._camera = dv.io.camera.open(serial or found[0])
            self.size = tuple(int(side) for side in self._camera.getEventResolution())  # type: ignore[assignment]
            self._camera.setTimeInterval(timedelta(microseconds=packet_us))
            if hasattr(self._camera, "setDetectorRunning"):
                self._camera.setDetectorRisingEdges(True)
                self._camera.setDetectorRunning(True)
        self._rising = dv.TriggerType.EXTERNAL_SIGNAL_RISING_EDGE

    def packets(self) -> Iterator[Packet]:
        """Yield packets, see :meth:`Source.packets`. Raises :class:`AmiwarpError` when the camera stops."""
        yielded_s = time.monotonic()
        while True:
            with _named(self.name, "stopped"):
                running = self._camera.isRunning()
                store, triggers = self._camera.getNextEventBatch(), self._triggers()
            if store is not None or triggers.size:
                yield make_packet(monotonic_us(), _dv_events(store), triggers)
                yielded_s = time.monotonic()
            elif not running:
                raise AmiwarpError(f"{self.name}: the camera stopped; was it unplugged?")
            elif time.monotonic() - yielded_s >= IDLE_S:
                yield make_packet(monotonic_us())
                yielded_s = time.monotonic()
            else:
                time.sleep(POLL_S)

    def close(self) -> None:
        """Release the camera, see :meth:`Source.close`."""
        self._camera = None

    def _triggers(self) -> NDArray[np.int64]:
        batch = self._camera.getNextTriggerBatch() or ()
        return np.array([trigger.timestamp for trigger in batch if trigger.type == self._rising], np.int64)


def _dv_events(store: Any) -> Events | None:
    if store is None:
        return None
    events = store.numpy()
    return _events(events["x"], events["y"], events["timestamp"], events["polarity"])


def _events(x: Any, y: Any, t: Any, p: Any) -> Events:
    """Copy the columns of a library's rows into new events, because the library reuses its memory."""
    return Events(x.astype(np.uint16), y.astype(np.uint16), t.astype(np.int64), (p > 0).astype(np.uint8))


class PropheseeSource(_CameraSource):
    """Source of events from a Prophesee camera, read through Metavision's or OpenEB's Python binding.

    A serial number of None means the first camera found. Rising edges at its main trigger input become triggers. While
    the camera sends nothing at all, the library blocks. Raises :class:`AmiwarpError` if library or camera is missing.
    """

    def __init__(self, serial: str | None = None, *, packet_us: int = 1000) -> None:
        self.name = "prophesee" if serial is None else f"prophesee:{serial}"
        remedy = "install OpenEB or the Metavision SDK (they are not on PyPI)"
        event_io = _library("metavision_core.event_io", self.name, remedy)
        raw_reader = _library("metavision_core.event_io.raw_reader", self.name, remedy)
        hal = _library("metavision_hal", self.name, remedy)
        with _named(self.name, "cannot be opened"):
            device = raw_reader.initiate_device(path=serial or "")
            if device is None:
                raise AmiwarpError(f"{self.name}: no such camera; plug the camera in")
            trigger_in = device.get_i_trigger_in()
            if trigger_in is not None:
                trigger_in.enable(hal.I_TriggerIn.Channel.MAIN)
            self._iterator = event_io.EventsIterator.from_device(device=device, delta_t=packet_us)
            height, width = self._iterator.get_size()
        self.size = (int(width), int(height))

    def packets(self) -> Iterator[Packet]:
        """Yield packets, see :meth:`Source.packets`. Raises :class:`AmiwarpError` when the camera stops."""
        slices = iter(self._iterator)
        while True:
            with _named(self.name, "stopped"):
                events = next(slices, None)
                triggers = self._triggers()
            if events is None:
                raise AmiwarpError(f"{self.name}: the camera stopped; was it unplugged?")
            now = monotonic_us()
            yield make_packet(now, _events(events["x"], events["y"], events["t"], events["p"]), triggers)

    def close(self) -> None:
        """Release the camera, see :meth:`Source.close`."""
        self._iterator = None

    def _triggers(self) -> NDArray[np.int64]:
        reader = self._iterator.reader
        edges = reader.get_ext_trigger_events()
        rising = np.array(edges["t"][edges["p"] == 1], np.int64) if len(edges) else np.zeros(0, np.int64)
        reader.clear_ext_trigger_events()
        return rising
