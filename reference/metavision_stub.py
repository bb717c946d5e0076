"""Cameras without hardware for OpenEB and the Metavision SDK.

Modules and classes have the names and arguments of OpenEB's Python bindings (``hal/python/bindings``) and of its
``metavision_core.event_io``. They could not be compared with the library, which is not on PyPI.
"""

from __future__ import annotations

import contextlib
import enum
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

EVENT_CD = np.dtype([("x", "<u2"), ("y", "<u2"), ("p", "<i2"), ("t", "<i8")])
"""Rows of events of the library."""
EVENT_EXT_TRIGGER = np.dtype([("p", "<i2"), ("t", "<i8"), ("id", "<i2")])
"""Rows of trigger edges of the library: p is 1 for a rising one."""
RATE_US = 200
"""Period of the rate controller [us]."""


@dataclass
class MetavisionPart:
    """One slice of events, as rows (t, x, y, on), and the edges that came with it, as time and whether rising."""

    events: NDArray[Any]
    edges: tuple[tuple[int, bool], ...] = ()


@dataclass
class StubMetavision:
    """Camera on a bus that does not exist."""

    serial: str = "00051497"
    size: tuple[int, int] = (1280, 720)
    parts: list[list[MetavisionPart | Exception]] = field(default_factory=list)
    """What the camera delivers, one list for each time that it is opened. Exceptions are raised."""
    lacks: tuple[str, ...] = ()
    """Getters of facilities that this camera does not have."""
    most_openings: int = 100
    """Number of times that the camera can be opened; it is gone afterwards."""
    opened: list[Any] = field(default_factory=list)
    """The devices, one for each opening."""


class LLBiases:
    """``I_LL_Biases``: two biases can be set, one cannot."""

    def __init__(self) -> None:
        self.values = {"bias_diff": 0, "bias_diff_on": 0, "bias_fo": 0}

    def set(self, bias_name: str, bias_value: int) -> bool:
        self.values[bias_name] = bias_value
        return True

    def get_all_biases(self) -> dict[str, int]:
        return dict(self.values)

    def get_bias_info(self, bias_name: str) -> Any:
        return SimpleNamespace(
            get_bias_allowed_range=lambda: (-85, 140),
            is_modifiable=lambda: bias_name != "bias_diff",
        )


class Roi:
    """``I_ROI``: the library has no method that reports the window."""

    class Mode(enum.Enum):
        """Whether the window is kept or left out."""

        ROI = 0
        RONI = 1

    @dataclass
    class Window:
        """Part of the sensor."""

        x: int
        y: int
        width: int
        height: int

    def __init__(self) -> None:
        self.window = Roi.Window(0, 0, 0, 0)
        self.on = False
        self.mode = Roi.Mode.RONI

    def set_mode(self, mode: Mode) -> bool:
        self.mode = mode
        return True

    def set_window(self, roi: Window) -> bool:
        self.window = roi
        return True

    def enable(self, enable: bool) -> bool:
        self.on = enable
        return True


class PixelMask:
    """``I_PixelMask``: one register of a masked pixel."""

    def __init__(self) -> None:
        self._mask = (0, 0, False)

    def set_mask(self, x: int, y: int, enabled: bool) -> bool:
        self._mask = x, y, enabled
        return True

    def get_mask(self) -> tuple[int, int, bool]:
        return self._mask


class DigitalEventMask:
    """``I_DigitalEventMask``."""

    def __init__(self) -> None:
        self._masks = [PixelMask() for _ in range(64)]

    def get_pixel_masks(self) -> list[PixelMask]:
        return self._masks


class ErcModule:
    """``I_ErcModule``: counts events in periods of 200 us."""

    def __init__(self) -> None:
        self._count = 4000
        self._on = False

    def enable(self, b: bool) -> bool:
        self._on = b
        return True

    def is_enabled(self) -> bool:
        return self._on

    def set_cd_event_rate(self, events_per_sec: int) -> bool:
        self._count = events_per_sec * RATE_US // 1_000_000
        return True

    def get_cd_event_rate(self) -> int:
        return self._count * 1_000_000 // RATE_US

    def get_min_supported_cd_event_rate(self) -> int:
        return 0

    def get_max_supported_cd_event_rate(self) -> int:
        return 3_200_000_000


class AntiFlicker:
    """``I_AntiFlickerModule``."""

    class AntiFlickerMode(enum.Enum):
        """Whether the band is removed or kept."""

        BandStop = 0
        BandPass = 1

    def __init__(self) -> None:
        self._band = (50, 520)
        self._on = False
        self.mode = AntiFlicker.AntiFlickerMode.BandPass

    def enable(self, b: bool) -> bool:
        self._on = b
        return True

    def is_enabled(self) -> bool:
        return self._on

    def set_filtering_mode(self, mode: AntiFlickerMode) -> bool:
        self.mode = mode
        return True

    def set_frequency_band(self, min_freq: int, max_freq: int) -> bool:
        self._band = min_freq, max_freq
        return True

    def get_band_low_frequency(self) -> int:
        return self._band[0]

    def get_band_high_frequency(self) -> int:
        return self._band[1]

    def get_min_supported_frequency(self) -> int:
        return 50

    def get_max_supported_frequency(self) -> int:
        return 520


class TriggerIn:
    """``I_TriggerIn``: off at first."""

    Channel = enum.Enum("Channel", ["MAIN", "AUX", "LOOPBACK"])

    def __init__(self) -> None:
        self._on: set[Any] = set()

    def enable(self, channel: Any) -> bool:
        self._on.add(channel)
        return True

    def disable(self, channel: Any) -> bool:
        self._on.discard(channel)
        return True

    def is_enabled(self, channel: Any) -> bool:
        return channel in self._on


FACILITIES = {
    "get_i_ll_biases": LLBiases,
    "get_i_roi": Roi,
    "get_i_digital_event_mask": DigitalEventMask,
    "get_i_erc_module": ErcModule,
    "get_i_antiflicker_module": AntiFlicker,
    "get_i_trigger_in": TriggerIn,
}
"""Class of the facility that each method of the device returns."""


class Device:
    """Device of the library. It has a method for each facility, which returns None if the camera lacks it."""

    def __init__(self, camera: StubMetavision) -> None:
        self._camera = camera
        self.parts = iter(camera.parts.pop(0) if camera.parts else ())
        self.facilities = {
            name: None if name in camera.lacks else kind() for name, kind in FACILITIES.items()
        }
        for name, facility in self.facilities.items():
            setattr(self, name, lambda facility=facility: facility)

    def get_i_geometry(self) -> Any:
        width, height = self._camera.size
        return SimpleNamespace(get_width=lambda: width, get_height=lambda: height)

    def get_i_hw_identification(self) -> Any:
        return SimpleNamespace(
            get_serial=lambda: self._camera.serial,
            get_sensor_info=lambda: SimpleNamespace(name="IMX636"),
        )

    def sends(self, x: NDArray[Any], y: NDArray[Any]) -> NDArray[np.bool_]:
        """Return which pixels send events."""
        sent = np.ones(x.shape, bool)
        roi = self.facilities["get_i_roi"]
        masks = self.facilities["get_i_digital_event_mask"]
        if isinstance(roi, Roi) and roi.on:
            window = roi.window
            sent &= (x >= window.x) & (x < window.x + window.width)
            sent &= (y >= window.y) & (y < window.y + window.height)
            sent = sent if roi.mode is Roi.Mode.ROI else ~sent
        if isinstance(masks, DigitalEventMask):
            for mask in masks.get_pixel_masks():
                left, top, enabled = mask.get_mask()
                sent &= np.logical_or(not enabled, (x != left) | (y != top))
        return sent


class Reader:
    """Reader of an iterator, which keeps the edges until they are cleared."""

    def __init__(self) -> None:
        self.edges = np.zeros(0, EVENT_EXT_TRIGGER)

    def get_ext_trigger_events(self) -> NDArray[Any]:
        return self.edges

    def clear_ext_trigger_events(self) -> None:
        self.edges = self.edges[:0]


class EventsIterator:
    """``EventsIterator``: slices of events, until the camera is gone."""

    def __init__(self, device: Device, delta_t: int) -> None:
        self.reader = Reader()
        self.delta_t = delta_t
        self._device = device

    @classmethod
    def from_device(cls, device: Device, delta_t: int = 10_000) -> EventsIterator:
        return cls(device, delta_t)

    def __iter__(self) -> Iterator[NDArray[Any]]:
        trigger = self._device.facilities["get_i_trigger_in"]
        for part in self._device.parts:
            if isinstance(part, Exception):
                raise part
            if isinstance(trigger, TriggerIn) and trigger.is_enabled(TriggerIn.Channel.MAIN):
                edges = [(int(rising), t, 0) for t, rising in part.edges]
                self.reader.edges = np.concatenate(
                    [self.reader.edges, np.array(edges, EVENT_EXT_TRIGGER)]
                )
            kept = part.events[
                self._device.sends(part.events["x"].astype(int), part.events["y"].astype(int))
            ]
            rows = np.zeros(len(kept), EVENT_CD)
            for name, source in (("t", "t"), ("x", "x"), ("y", "y"), ("p", "on")):
                rows[name] = kept[source]
            yield rows


@contextlib.contextmanager
def metavision_connected(*cameras: StubMetavision) -> Iterator[None]:
    """Let the library find these cameras in a ``with`` block."""

    def initiate_device(path: str) -> Device:
        for camera in cameras:
            if len(camera.opened) < camera.most_openings and path in ("", camera.serial):
                camera.opened.append(Device(camera))
                return camera.opened[-1]
        raise OSError(f"Failed to open camera {path} !")

    modules: dict[str, dict[str, Any]] = {
        "metavision_core": {},
        "metavision_core.event_io": {"EventsIterator": EventsIterator},
        "metavision_core.event_io.raw_reader": {"initiate_device": initiate_device},
        "metavision_hal": {
            "I_TriggerIn": TriggerIn,
            "I_ROI": Roi,
            "I_AntiFlickerModule": AntiFlicker,
        },
    }
    kept = {name: sys.modules.get(name) for name in modules}
    for name, content in modules.items():
        module = ModuleType(name)
        module.__dict__.update(content)
        sys.modules[name] = module
    try:
        yield
    finally:
        for name, before in kept.items():
            if before is None:
                del sys.modules[name]
            else:
                sys.modules[name] = before
