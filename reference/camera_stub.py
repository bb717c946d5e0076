"""Cameras without hardware: neuromorphic-drivers' own Python code above a substitute for its compiled part."""

from __future__ import annotations

import contextlib
import importlib
import sys
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

PACKAGE = "neuromorphic_drivers"
POLARITY = np.dtype([("t", "<u8"), ("x", "<u2"), ("y", "<u2"), ("on", "?")])
"""Rows of ``polarity_events``, as the package's README states."""
TRIGGER = np.dtype([("t", "<u8"), ("id", "<u1"), ("rising", "?")])
"""Rows of ``trigger_events`` of Prophesee's cameras, as the package's README states."""
DAVIS_TRIGGER = np.dtype([("t", "<u8"), ("id", "<u1"), ("polarity", "<u1")])
"""Rows of ``trigger_events`` of iniVation's cameras; the polarities are described in the package's ``packet.py``."""


@dataclass
class Part:
    """What one call of ``__next__`` delivers. Without rows, the call returns after its time-out."""

    events: NDArray[Any] | None = None
    triggers: NDArray[Any] | None = None
    dropped: int = 0
    """Number of USB packets dropped since the device was opened."""


@dataclass
class StubCamera:
    """Camera on a bus that does not exist."""

    serial: str | None = "00051497"
    name: str = "Prophesee EVK4"
    parts: list[Iterable[Part | Exception]] = field(default_factory=list)
    """What the camera delivers, one item for each time that it is opened. Exceptions are raised."""
    error: str | None = None
    most_openings: int = 100
    """Number of times that the camera can be opened; it is gone afterwards."""
    limits: dict[str, tuple[int, int]] = field(default_factory=dict)
    """Limits of biases, by their names."""
    exchanges_axes: bool = False
    """Whether a DAVIS346 reports that it exchanges rows and columns."""
    filters: bool = True
    """Whether the camera has the filters that regions and masks set. Without them, the driver ignores both."""
    opened: list[dict[str, Any]] = field(default_factory=list)
    """Arguments of each opening, with the configuration as the package's object."""
    closed: int = 0


class StubDevice:
    """As much of the compiled ``Device`` as the package's ``Device`` and amiwarp call."""

    cameras: list[StubCamera]

    def __new__(
        cls, raw: Any, iterator_maximum_raw_packets: Any, device_type: Any, configuration: Any, serial: Any,
        address: Any, ring_configuration: Any, iterator_timeout: Any,
    ) -> StubDevice:  # fmt: skip
        for camera in cls.cameras:
            package = sys.modules[PACKAGE]
            name = package.Name(camera.name)
            present = len(camera.opened) < camera.most_openings
            if (
                present
                and serial == camera.serial
                and device_type == name.name.lower()
                and not raw
                and address is None
            ):
                self = super().__new__(cls)
                camera.opened.append({
                    "configuration": package.deserialize_configuration(name, configuration),
                    "maximum": iterator_maximum_raw_packets, "timeout": iterator_timeout, "ring": ring_configuration,
                })  # fmt: skip
                self._camera, self._name = camera, name
                self._configuration = camera.opened[-1]["configuration"]
                self._parts = iter(camera.parts.pop(0) if camera.parts else ())
                self._timeout = iterator_timeout
                return self
        raise RuntimeError("device with serial not found")

    def __exit__(self, *_: object) -> None:
        self._camera.closed += 1

    def __next__(self) -> tuple[Any, ...]:
        part = next(self._parts, None)
        if isinstance(part, Exception):
            raise part
        now = time.time()
        packet: Any = SimpleNamespace(
            polarity_events=None, trigger_events=None, polarity_events_overflow_indices=None,
            trigger_events_overflow_indices=None,
        )  # fmt: skip
        if part is None or (part.events is None and part.triggers is None):
            time.sleep(self._timeout if part is None else 0.0)
            return now, None, packet
        if part.events is not None:
            sent = sends(self._configuration, part.events["x"], part.events["y"])
            packet.polarity_events = part.events[sent] if self._camera.filters else part.events
        if getattr(self._configuration, "enable_external_trigger", True):
            packet.trigger_events = part.triggers
        return now, (now, 0, 1, False, [], 0, part.dropped), packet

    def name(self) -> str:
        return self._camera.name

    def orientation(self) -> Any:
        return SimpleNamespace(dvs_invert_xy=self._camera.exchanges_axes)

    def biases_bounds(self) -> bytes:
        package = sys.modules[PACKAGE]
        module = getattr(package, self._name.name.lower())
        bounds = {name: module.Bounds(*limits) for name, limits in self._camera.limits.items()}
        return package.serde.bincode.serialize(module.BiasesBounds(**bounds), module.BiasesBounds)


def sends(configuration: Any, x: NDArray[Any], y: NDArray[Any]) -> NDArray[np.bool_]:
    """Return which pixels send events, by what the package's drivers write to the registers of each sensor.

    Prophesee's sensors: a bit of a mask silences a column or a row, and rows are counted from the bottom, as are those
    of the mask's single pixels. DAVIS346: the region's last column and row are included, which are one too many.
    """
    sent = np.ones(x.shape, bool)
    for silenced, at in (("x_mask", x), ("y_mask", 719 - y.astype(np.int64))):
        words = np.array(getattr(configuration, silenced, ()), np.uint64)
        if words.any():
            sent &= (words[at // 64] >> (at % 64).astype(np.uint64) & np.uint64(1)) == 0
    code = np.array(configuration_codes(getattr(configuration, "pixel_mask", ())), np.int64)
    if code.any():
        row = y.astype(np.int64)
        number = 1 + x + (719 - row) * 1280 if len(code) == 64 else 1 + x + row * 346
        sent &= ~np.isin(number, code)
    region = getattr(configuration, "region_of_interest", None)
    if region is not None:
        sent &= (x >= region.left) & (x <= region.left + region.width)
        sent &= (y >= region.top) & (y <= region.top + region.height)
    return sent


def configuration_codes(words: Any) -> list[int]:
    """Return the numbers of the pixels in a mask: eight words of one each, or 21 of three and one bit of the last."""
    if len(words) != 21:
        return [int(word) for word in words]
    codes = [int(word) >> (21 * k) & ((1 << 21) - 1) for word in words for k in range(3)]
    return [*codes, sum((int(word) >> 63) << bit for bit, word in enumerate(words))]


@contextlib.contextmanager
def connected(*cameras: StubCamera) -> Iterator[None]:
    """Let neuromorphic-drivers find these cameras in a ``with`` block."""
    importlib.import_module(PACKAGE)
    kept = {
        name: module for name, module in sys.modules.items() if name.partition(".")[0] == PACKAGE
    }
    extension: Any = ModuleType(f"{PACKAGE}.{PACKAGE}")
    extension.Device = type("Device", (StubDevice,), {"cameras": list(cameras)})
    extension.list_devices = lambda: [
        (each.name, "USB 3.0 SuperSpeed (5.0 Gb/s)", "1:2", each.serial, each.error)
        for each in cameras
    ]
    for name in kept:
        del sys.modules[name]
    sys.modules[extension.__name__] = extension
    try:
        importlib.import_module(PACKAGE)
        yield
    finally:
        for name in [name for name in sys.modules if name.partition(".")[0] == PACKAGE]:
            del sys.modules[name]
        sys.modules.update(kept)
