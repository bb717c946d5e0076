"""Cameras by iniVation (DVXplorer, DAVIS), read through dv-processing 2.

Tested with a substitute for the library's cameras, whose methods are compared with the library, not yet with a camera.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from datetime import timedelta
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.recording import Events
from amiwarp.live.link.clocks import monotonic_us
from amiwarp.live.stream.camera_checks import (
    check_bias,
    check_bias_names,
    check_on_sensor,
    refuse_others,
)
from amiwarp.live.stream.camera_settings import CameraRequest, CameraSettings
from amiwarp.live.stream.camera_source import CameraSource, copied_events, library, opening
from amiwarp.live.stream.packets import IDLE_S, Packet, make_packet
from amiwarp.live.stream.sockets import Unreachable

POLL_S = 0.0005
"""Pause between two requests to the camera's library for events [s]."""
LARGEST_COARSE_FINE = (7 << 8) | 255
"""Largest value of a bias of a DAVIS: 256 times its coarse current, 0 .. 7, and its fine current, 0 .. 255."""
LARGEST_THRESHOLD = 255
"""Largest contrast threshold that is passed on to a DVXplorer. The camera's own limits are the library's to say."""
THRESHOLDS = ("ContrastThresholdOn", "ContrastThresholdOff")
"""Biases of a DVXplorer."""
DAVIS_KINDS = {
    "DAVIS240A": "Davis240",
    "DAVIS240B": "Davis240",
    "DAVIS240C": "Davis240",
    "DAVIS346": "Davis346",
    "CDAVIS": "CDavis",
}
"""Prefix of the library's methods for the biases of each sensor."""
ELSEWHERE = {"masked": "open a DAVIS346 as camera: through neuromorphic-drivers"}
"""How another driver reaches settings."""


@dataclass(frozen=True)
class _Bias:
    """How to read and set a bias."""

    get: Callable[[], int]
    set: Callable[[int], None]
    largest: int


class DvSource(CameraSource):
    """Source of events from a camera that dv-processing opens.

    No serial number means the first camera found.
    """

    def __init__(
        self,
        request: CameraRequest,
        say: Callable[[str], None] = lambda _: None,
        *,
        packet_us: int = 1000,
    ) -> None:
        super().__init__(request, say, packet_us=packet_us)
        dv = library("dv_processing", self.name, "pip install 'amiwarp[dv]'")
        with opening(self.name):
            found = [str(camera.serialNumber) for camera in dv.io.camera.discover()]
            if request.which not in found and (request.which or not found):
                raise Unreachable(
                    f"{self.name}: no such camera (found: {', '.join(found) or 'none'}); plug the camera in"
                )
            serial = request.which or found[0]
            self.name = request.name(serial)
            self._camera = dv.io.camera.open(serial)
            width, height = self._camera.getEventResolution()
        self.size = int(width), int(height)
        self._rising = dv.TriggerType.EXTERNAL_SIGNAL_RISING_EDGE
        try:
            with opening(self.name):
                model = str(self._camera.getCameraName()).removesuffix(f"_{serial}")
                self._camera.setTimeInterval(timedelta(microseconds=packet_us))
                self._opened(model, serial, self._apply(model), "reported by the camera")
        except BaseException:
            self.close()
            raise

    def packets(self) -> Iterator[Packet]:
        """Yield packets, see :meth:`CameraSource.packets`."""
        yielded_s = time.monotonic()
        while self.problem is None:
            store = None
            triggers = np.zeros(0, np.int64)
            running = False
            with self._stopping():
                running = self._camera.isRunning()
                store = self._camera.getNextEventBatch()
                triggers = self._triggers()
            if store is not None or triggers.size:
                yield self._make_packet(_dv_events(store), triggers)
                yielded_s = time.monotonic()
            elif self.problem is None and not running:
                self.problem = "the camera stopped; was it unplugged?"
            elif time.monotonic() - yielded_s >= IDLE_S:
                yield make_packet(monotonic_us())
                yielded_s = time.monotonic()
            else:
                time.sleep(POLL_S)

    def close(self) -> None:
        """Release the camera, see :meth:`Source.close`."""
        self._camera = None

    def _apply(self, model: str) -> CameraSettings:
        """Check the settings, give them to the camera, and return those that it then has."""
        camera = self._camera
        settings = self.settings
        biases = _biases(camera)
        detects = hasattr(camera, "setDetectorRunning")
        can = ("region", *(["biases"] if biases else []), *(["trigger"] if detects else []))
        refuse_others(self.name, model, settings, can, ELSEWHERE)
        check_on_sensor(self.name, settings, self.size, 0)
        check_bias_names(
            self.name, model, settings, {name: bias.get() for name, bias in biases.items()}
        )
        for name, value in settings.biases.items():
            check_bias(self.name, name, value, 0, biases[name].largest)
        for name, value in settings.biases.items():
            biases[name].set(value)
        if settings.region is not None:
            left, top, right, bottom = settings.region
            camera.setCropArea((left, top, right - left, bottom - top))
        if detects:
            on = settings.trigger is not False
            camera.setDetectorRisingEdges(on)
            camera.setDetectorFallingEdges(False)
            camera.setDetectorRunning(on)
        elif settings.counts_per_turn:
            raise AmiwarpError(
                f"{self.name}: {model} has no trigger input; leave counts_per_turn out"
            )
        return replace(
            settings,
            biases={name: bias.get() for name, bias in biases.items()},
            region=settings.region and _crop_area(camera),
            trigger=bool(camera.isDetectorRunning() and camera.getDetectorRisingEdges())
            if detects
            else None,
        )

    def _triggers(self) -> NDArray[np.int64]:
        batch = self._camera.getNextTriggerBatch() or ()
        return np.array(
            [trigger.timestamp for trigger in batch if trigger.type == self._rising], np.int64
        )


def _crop_area(camera: Any) -> tuple[int, int, int, int]:
    left, top, width, height = (int(value) for value in camera.getCropArea())
    return left, top, left + width, top + height


def _biases(camera: Any) -> Mapping[str, _Bias]:
    """Return the biases of a camera, by the library's names."""
    if hasattr(camera, "setContrastThresholdOn"):
        return {
            name: _Bias(
                getattr(camera, f"get{name}"), getattr(camera, f"set{name}"), LARGEST_THRESHOLD
            )
            for name in THRESHOLDS
        }
    kind = (
        DAVIS_KINDS.get(camera.getSensorModel().name) if hasattr(camera, "getSensorModel") else None
    )
    if kind is None:
        return {}
    members = getattr(camera, f"{kind}BiasCF").__members__
    read = getattr(camera, f"get{kind}BiasCoarseFine")
    write = getattr(camera, f"set{kind}BiasCoarseFine")
    return {
        name: _Bias(
            partial(_coarse_fine, read, bias),
            partial(_set_coarse_fine, write, bias),
            LARGEST_COARSE_FINE,
        )
        for name, bias in members.items()
    }


def _coarse_fine(read: Callable[[Any], tuple[int, int]], bias: Any) -> int:
    coarse, fine = read(bias)
    return coarse << 8 | fine


def _set_coarse_fine(write: Callable[[Any, int, int], None], bias: Any, value: int) -> None:
    write(bias, value >> 8, value & 255)


def _dv_events(store: Any) -> Events | None:
    if store is None:
        return None
    events = store.numpy()
    return copied_events(events["x"], events["y"], events["timestamp"], events["polarity"])
