"""Cameras without hardware for dv-processing: classes with as much of the library's methods as amiwarp calls."""

from __future__ import annotations

import contextlib
import enum
import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from datetime import timedelta
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

ROWS = np.dtype(
    {
        "names": ["timestamp", "x", "y", "polarity"],
        "formats": ["<i8", "<i2", "<i2", "i1"],
        "offsets": [0, 8, 10, 12],
        "itemsize": 16,
    }
)
"""Rows of ``EventStore.numpy()``."""

TriggerType = enum.Enum(
    "TriggerType",
    [
        "TIMESTAMP_RESET",
        "EXTERNAL_SIGNAL_RISING_EDGE",
        "EXTERNAL_SIGNAL_FALLING_EDGE",
        "EXTERNAL_SIGNAL_PULSE",
    ],
)
"""The first kinds of triggers of the library."""


@dataclass
class DvPart:
    """What the camera holds for one request: rows of events (t, x, y, on), and edges as time and whether rising."""

    events: NDArray[Any] | None = None
    edges: Iterable[tuple[int, bool]] = ()


@dataclass
class StubDv:
    """Camera on a bus that does not exist."""

    serial: str = "DX0"
    model: str = "DVXplorer"
    size: tuple[int, int] = (640, 480)
    parts: list[list[DvPart | Exception | None]] = field(default_factory=list)
    """What the camera delivers, one list for each time that it is opened. Exceptions are raised."""
    most_openings: int = 100
    """Number of times that the camera can be opened; it is gone afterwards."""
    opened: list[Any] = field(default_factory=list)
    """The devices, one for each opening."""


class CameraInputBase:
    """What all cameras of the library have."""

    def __init__(self, camera: StubDv) -> None:
        self._camera = camera
        self._crop = (0, 0, *camera.size)
        self._parts = iter(camera.parts.pop(0) if camera.parts else ())
        self._next: DvPart | Exception | None = None
        self._ended = False
        self._edges: list[Any] = []
        self.interval = timedelta(0)

    def getCameraName(self) -> str:
        return f"{self._camera.model}_{self._camera.serial}"

    def getEventResolution(self) -> tuple[int, int]:
        return self._camera.size

    def setTimeInterval(self, timeInterval: timedelta) -> None:
        self.interval = timeInterval

    def setCropArea(self, cropAreaEvents: tuple[int, int, int, int]) -> None:
        self._crop = cropAreaEvents

    def getCropArea(self) -> tuple[int, int, int, int]:
        return self._crop

    def isRunning(self) -> bool:
        if self._next is None and not self._ended:
            try:
                self._next = next(self._parts)
            except StopIteration:
                self._ended = True
        return not self._ended

    def getNextEventBatch(self) -> Any:
        part = self._next
        self._next = None
        if isinstance(part, Exception):
            raise part
        self._edges = (
            [] if part is None else [edge for edge in part.edges if self._detects(edge[1])]
        )
        if part is None or part.events is None:
            return None
        left, top, width, height = self._crop
        x = part.events["x"].astype(int)
        y = part.events["y"].astype(int)
        kept = part.events[(x >= left) & (x < left + width) & (y >= top) & (y < top + height)]
        rows = np.zeros(len(kept), ROWS)
        for name, source in (("timestamp", "t"), ("x", "x"), ("y", "y"), ("polarity", "on")):
            rows[name] = kept[source]
        return SimpleNamespace(numpy=lambda: rows)

    def getNextTriggerBatch(self) -> Any:
        kinds = TriggerType.EXTERNAL_SIGNAL_FALLING_EDGE, TriggerType.EXTERNAL_SIGNAL_RISING_EDGE
        return [
            SimpleNamespace(timestamp=t, type=kinds[rising]) for t, rising in self._edges
        ] or None

    def _detects(self, rising: bool) -> bool:
        return False


class DetectorInput(CameraInputBase):
    """Camera with a trigger input, which is off at first."""

    def __init__(self, camera: StubDv) -> None:
        super().__init__(camera)
        self._running = False
        self._rising = False
        self._falling = True

    def setDetectorRunning(self, run: bool) -> None:
        self._running = run

    def setDetectorRisingEdges(self, detectRising: bool) -> None:
        self._rising = detectRising

    def setDetectorFallingEdges(self, detectFalling: bool) -> None:
        self._falling = detectFalling

    def isDetectorRunning(self) -> bool:
        return self._running

    def getDetectorRisingEdges(self) -> bool:
        return self._rising

    def _detects(self, rising: bool) -> bool:
        return self._running and (self._rising if rising else self._falling)


class DVXplorer(DetectorInput):
    """A DVXplorer, whose thresholds end at 17."""

    def __init__(self, camera: StubDv) -> None:
        super().__init__(camera)
        self._on = 9
        self._off = 10

    def setContrastThresholdOn(self, contrastThresholdOn: int) -> None:
        self._on = min(contrastThresholdOn, 17)

    def setContrastThresholdOff(self, contrastThresholdOff: int) -> None:
        self._off = min(contrastThresholdOff, 17)

    def getContrastThresholdOn(self) -> int:
        return self._on

    def getContrastThresholdOff(self) -> int:
        return self._off


class DAVIS(DetectorInput):
    """A DAVIS346."""

    SensorModel = enum.Enum("SensorModel", ["DAVIS240C", "DAVIS346"])
    Davis346BiasCF = enum.Enum("Davis346BiasCF", ["Diff", "On", "Off", "Refractory"])

    def __init__(self, camera: StubDv) -> None:
        super().__init__(camera)
        self._biases = dict.fromkeys(self.Davis346BiasCF, (4, 39))

    def getSensorModel(self) -> Any:
        return self.SensorModel.DAVIS346

    def getDavis346BiasCoarseFine(self, bias: Any) -> tuple[int, int]:
        return self._biases[bias]

    def setDavis346BiasCoarseFine(self, bias: Any, coarse: int, fine: int) -> None:
        self._biases[bias] = coarse, fine


class DVXplorerM(CameraInputBase):
    """A DVXplorer Micro or S, without a trigger input; its thresholds are left out here."""


CLASSES = {"DVXplorer": DVXplorer, "DAVIS346": DAVIS, "DVXplorerM": DVXplorerM}
"""Class of each model."""


@contextlib.contextmanager
def dv_connected(*cameras: StubDv) -> Iterator[None]:
    """Let dv-processing find these cameras in a ``with`` block."""

    def present() -> list[StubDv]:
        return [camera for camera in cameras if len(camera.opened) < camera.most_openings]

    def open_camera(serialNumber: str) -> CameraInputBase:
        camera = next(camera for camera in present() if camera.serial == serialNumber)
        device = CLASSES[camera.model](camera)
        camera.opened.append(device)
        return device

    module = ModuleType("dv_processing")
    content: dict[str, Any] = {
        "TriggerType": TriggerType,
        "io": SimpleNamespace(
            camera=SimpleNamespace(
                discover=lambda: [
                    SimpleNamespace(serialNumber=camera.serial) for camera in present()
                ],
                open=open_camera,
            )
        ),
    }
    module.__dict__.update(content)
    kept = sys.modules.get("dv_processing")
    sys.modules["dv_processing"] = module
    try:
        yield
    finally:
        del sys.modules["dv_processing"]
        if kept is not None:
            sys.modules["dv_processing"] = kept
