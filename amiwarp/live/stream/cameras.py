"""Cameras: iniVation's through dv-processing, Prophesee's through Metavision or OpenEB, and the emulated one."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from datetime import timedelta
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.recording import Events, Recording
from amiwarp.live.link.clocks import monotonic_us
from amiwarp.live.link.emulator import Controller, Played
from amiwarp.live.stream.packets import Packet, encode_events, encode_hello, encode_triggers, make_packet
from amiwarp.live.stream.sockets import SocketSink
from amiwarp.optics.camera import Camera
from amiwarp.optics.prism import NominalPrism

# Cameras: iniVation's through dv-processing, Prophesee's through Metavision or OpenEB. Both libraries are optional.
#
# Tested with substitutes for these libraries, not yet with cameras.

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


# Emulated camera for the emulated controller: serves a recording's events, and a trigger for each sync pulse.

STEP_US, RETRY_S = 2000, 2e-4
"""Duration of an event packet [us], and interval between attempts to send while a client is slow [s]."""
LEAD_US = 1_000_000
"""Time from the first client's connection to the first event [us], in which sync pulses relate the clocks."""
NEVER_US = 1 << 60
"""Start time of an emulation that has not begun [us]."""


class EmulatedCamera:
    """Serves a recording's events at their recorded pace, and one trigger for each of the controller's sync pulses.

    Camera and ``rotor`` begin once the first client connects. If reading, sending or a client is slower than the
    recording, events are sent late, but none is lost. ``now_us``: emulation time [us], shared with the controller.
    Raises :class:`AmiwarpError` for a recording without encoder or events, or an address in use.
    """

    def __init__(
        self, recording: Recording, rotor: Played, controller: Controller, address: str, now_us: Callable[[], int]
    ) -> None:
        encoder, events = recording.encoder, recording.events
        if encoder is None or not len(events):
            raise AmiwarpError(
                f"{recording.name}: has no {'events' if encoder else 'encoder'}; give a recording with both"
            )
        self._events, self._rotor, self._controller, self._now_us = events, rotor, controller, now_us
        self._origin = round(int(encoder.t[0]) - encoder.clock_offset_us)
        """Time on the events' clock at which the rotor begins [us]."""
        rotor.begin(NEVER_US)
        self._start, self._pulses_until_us = NEVER_US, -1
        self.late_us = 0
        """Largest delay of sent events so far [us]."""
        self._sink = SocketSink(address, encode_hello(*events.size, recording.camera, recording.prism))
        self.address = self._sink.address
        self._ended = threading.Event()
        self.done = threading.Event()
        """Event that is set when all events were sent, or the recording cannot be read further."""
        self._failure: Exception | None = None
        self._thread = threading.Thread(target=self._run, name="amiwarp-camera", daemon=True)
        self._thread.start()

    def __enter__(self) -> EmulatedCamera:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Stop the emulation and end its stream. Raises the error of a failed recording."""
        self._ended.set()
        self._thread.join()
        failure, self._failure = self._failure, None
        if failure is not None:
            raise failure

    def _run(self) -> None:
        try:
            self._play()
        except Exception as error:
            self._failure = error
            self.done.set()

    def _play(self) -> None:
        with self._sink:
            while not self._sink.clients:
                if self._ended.wait(STEP_US * 1e-6):
                    return
                self._sink.tick()
            self._start = self._now_us() + LEAD_US
            self._rotor.begin(self._start)
            for block in self._events.blocks(duration_us=STEP_US):
                while (ahead_us := int(block.t[-1]) - self._time(self._now_us())) >= 0 or self._sink.waiting:
                    if self._pause(min(ahead_us, STEP_US) * 1e-6 if ahead_us > 0 else RETRY_S):
                        return
                self.late_us = max(self.late_us, -ahead_us)
                self._sink.send(encode_events(block))
            while self._sink.waiting:
                if self._pause(RETRY_S):
                    return
        self.done.set()

    def _pause(self, seconds: float) -> bool:
        """Wait, then send the new triggers and the waiting packets; return True if the camera was closed meanwhile."""
        if self._ended.wait(seconds):
            return True
        # Select pulses by time, not by number: after a reset the controller numbers them from 0 again.
        pulses = [world for _, world in list(self._controller.pulses) if world > self._pulses_until_us]
        if pulses:
            self._pulses_until_us = pulses[-1]
        self._sink.send(encode_triggers(np.array([self._time(world) for world in pulses], np.int64)))
        return False

    def _time(self, world_us: int) -> int:
        """Return the time on the camera's clock [us] for an emulation time [us]."""
        return world_us - self._start + self._origin
