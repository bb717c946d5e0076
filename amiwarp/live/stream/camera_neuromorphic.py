"""Cameras by Prophesee, iniVation, CenturyArks and Lucid, read through neuromorphic-drivers.

Tested with a substitute for the library's compiled part, not yet with a camera. What the comments say of the library is
from the source of its drivers.
"""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import replace
from importlib import import_module
from typing import Any, get_args

import numpy as np

from amiwarp.errors import AmiwarpError
from amiwarp.events.recording import Events
from amiwarp.live.stream.camera_checks import (
    check_bias,
    check_bias_names,
    check_on_sensor,
    check_rate,
    refuse_others,
)
from amiwarp.live.stream.camera_settings import CameraRequest, CameraSettings
from amiwarp.live.stream.camera_source import CameraSource, copied_events, library, named, opening
from amiwarp.live.stream.packets import IDLE_S, NO_TIMES, Packet
from amiwarp.live.stream.sockets import Unreachable

RAW_PACKETS = 8
"""Largest number of USB packets, of 128 KiB each, that the camera's driver decodes at once: about a million events."""
RATE_US = 200
MOST_PER_PERIOD = (1 << 22) - 1
"""Period in which the rate limiter counts events, the longest that the driver documents [us], and its largest count."""
EVK4 = "PROPHESEE_EVK4"
EVK3 = "PROPHESEE_EVK3_HD"
DAVIS = "INIVATION_DAVIS346"
DVXPLORER = "INIVATION_DVXPLORER"
"""Names of the models that have more than biases."""
CAN = {
    EVK4: ("biases", "region", "masked", "most_per_s", "trigger"),
    EVK3: ("biases", "region", "most_per_s"),
    DAVIS: ("biases", "region", "masked"),
}
"""Settings of each model. CenturyArks' configuration has masks and a rate limiter, too, which its driver ignores."""
MOST_MASKED = {EVK4: 64, DAVIS: 8}
"""Number of single pixels that a model can mask."""
_PROPHESEE = "open it as prophesee: through OpenEB"
_INIVATION = "open it as dv: through dv-processing"
ELSEWHERE = {
    EVK4: {"flicker_hz": _PROPHESEE},
    EVK3: dict.fromkeys(("masked", "flicker_hz", "trigger"), _PROPHESEE),
    "CENTURYARKS_VGA": dict.fromkeys(
        ("region", "masked", "most_per_s", "flicker_hz", "trigger"), _PROPHESEE
    ),
    DAVIS: {"trigger": _INIVATION},
    DVXPLORER: dict.fromkeys(("region", "trigger"), _INIVATION),
}
"""How other drivers reach settings of a model."""


def list_cameras() -> list[Any]:
    """Return the cameras that neuromorphic-drivers finds, each with ``name``, ``connection``, ``serial`` and ``error``.

    Raises :class:`AmiwarpError` if the library is missing or cannot list the cameras.
    """
    remedy = "pip install 'amiwarp[camera]', or give dv or prophesee, which use other libraries"
    drivers = library("neuromorphic_drivers", "camera", remedy)
    with named("camera", "the cameras cannot be listed", Unreachable):
        return list(drivers.list_devices())


def _find_camera(which: str) -> Any:
    """Return the camera with the serial number ``which``, or the only one whose model's name contains it."""
    cameras = list_cameras()
    found = [
        device
        for device in cameras
        if which == device.serial or _squeezed(which) in _squeezed(device.name.value)
    ]
    name = f"camera:{which}"
    if not cameras:
        raise Unreachable(
            f"{name}: no camera is connected, or none that neuromorphic-drivers knows; plug it in"
        )
    if len(found) != 1:
        listed = ", ".join(
            f"camera:{device.serial} ({device.name.value})"
            if device.serial
            else f"{device.name.value} ({device.error})"
            for device in found or cameras
        )
        raise Unreachable(
            f"{name}: {len(found)} such cameras are connected; choose one of these: {listed}"
        )
    if found[0].serial is None:
        remedy = "on Linux, 'neuromorphic-drivers-install-udev-rules' gives access rights"
        raise Unreachable(
            f"{name}: {found[0].name.value} cannot be opened: {found[0].error}; {remedy}"
        )
    return found[0]


def _squeezed(name: str) -> str:
    """Return the letters and digits of a name in lower case."""
    return "".join(filter(str.isalnum, name)).lower()


class NeuromorphicSource(CameraSource):
    """Source of events from a camera that neuromorphic-drivers opens.

    The library puts the times of a device on one clock of 64 bits.
    """

    def __init__(
        self,
        request: CameraRequest,
        say: Callable[[str], None] = lambda _: None,
        *,
        packet_us: int = 1000,
    ) -> None:
        super().__init__(request, say, packet_us=packet_us)
        self.lost = 0
        found = _find_camera(request.which)
        drivers = import_module("neuromorphic_drivers")
        model = found.name.value
        settings = self.settings
        self.name = request.name(found.serial)
        self._model = found.name.name
        configuration = _configuration(self.name, found.name, drivers, settings)
        with opening(self.name):
            self._device = drivers.open(
                configuration,
                iterator_timeout=IDLE_S,
                serial=found.serial,
                iterator_maximum_raw_packets=RAW_PACKETS,
            )
        try:
            with opening(self.name):
                properties = self._device.properties()
                bounds = self._device.biases_bounds()
            self.size = int(properties.width), int(properties.height)
            for bias, value in settings.biases.items():
                # Limits of the device; equal if they are unknown
                limits = getattr(bounds, bias, None)
                if limits is not None and limits.minimum < limits.maximum:
                    check_bias(self.name, bias, value, limits.minimum, limits.maximum)
            self._check_axes()
        except BaseException:
            self.close()
            raise
        self._opened(
            model, found.serial, _sent(configuration, settings), "as sent: the driver reports none"
        )
        if settings.counts_per_turn and self._model in (DAVIS, DVXPLORER):
            say(
                f"{self.name}: as far as is known, this driver leaves the trigger input off; {_INIVATION}"
            )

    def packets(self) -> Iterator[Packet]:
        """Yield packets, see :meth:`CameraSource.packets`."""
        try:
            while True:
                with self._stopping():
                    status, packet = next(self._device)
                if self.problem is not None:
                    return
                self._count_lost(status.ring)
                yield self._packet(packet)
        finally:
            if self.lost:
                self._say(f"{self.name}: {self.lost:,} USB packets with events were lost")

    def close(self) -> None:
        """Release the camera, see :meth:`Source.close`."""
        with contextlib.suppress(Exception):  # a camera that was unplugged
            self._device.close()

    def _check_axes(self) -> None:
        """Refuse a region and a mask if the camera exchanges rows and columns, which the driver forgets for them."""
        settings = self.settings
        if (
            self._model == DAVIS
            and (settings.region or settings.masked)
            and self._device.orientation().dvs_invert_xy
        ):
            raise AmiwarpError(
                f"{self.name}: this camera exchanges rows and columns, for which the driver sets neither region nor "
                f"mask right; {_INIVATION}"
            )

    def _count_lost(self, ring: Any) -> None:
        """Note how many USB packets are lost so far, and say when the first ones are."""
        lost = self.lost if ring is None else int(ring.dropped_packets)
        if lost and not self.lost:
            self._say(f"{self.name}: this computer is too slow: USB packets with events are lost")
        self.lost = lost

    def _packet(self, packet: Any) -> Packet:
        rows = packet.polarity_events
        edges = packet.trigger_events
        events = (
            None if rows is None else copied_events(rows["x"], rows["y"], rows["t"], rows["on"])
        )
        if events is not None and self._model == DAVIS:
            events = _without_others(events, self.settings)
        if edges is None:
            return self._make_packet(events, NO_TIMES)
        # The polarity of an edge of the DAVIS346 is 0 for a falling edge, 1 for a rising one, and 2 for a pulse.
        rising = edges["rising" if "rising" in edges.dtype.names else "polarity"] > 0
        return self._make_packet(events, edges["t"][rising].astype(np.int64))


def _without_others(events: Events, settings: CameraSettings) -> Events:
    """Return the events within the region, without the events of the masked pixels.

    The driver of the DAVIS346 keeps one column and one row too many, and ignores both settings, without a word, if the
    camera's logic does not have the filters.
    """
    kept = np.ones(len(events), bool)
    if settings.region is not None:
        left, top, right, bottom = settings.region
        kept &= (events.x >= left) & (events.x < right) & (events.y >= top) & (events.y < bottom)
    for x, y in settings.masked:
        kept &= (events.x != x) | (events.y != y)
    return events if kept.all() else events[kept]


def _configuration(name: str, model: Any, drivers: Any, settings: CameraSettings) -> Any:
    """Return the configuration of the library for these settings, all of which are checked as far as they can be."""
    module = getattr(drivers, model.name.lower())
    kind = model.name
    properties = module.Properties()
    size = int(properties.width), int(properties.height)
    refuse_others(name, model.value, settings, CAN.get(kind, ("biases",)), ELSEWHERE.get(kind, {}))
    check_on_sensor(name, settings, size, MOST_MASKED.get(kind, 0))
    parts: dict[str, Any] = {"biases": _biases(name, model.value, module.Biases, settings)}
    if settings.region is not None:
        left, top, right, bottom = settings.region
        if kind == DAVIS:
            parts["region_of_interest"] = module.RegionOfInterest(
                left, top, right - left, bottom - top
            )
        else:
            mask = drivers.mask.RowColumnMask(width=size[0], height=size[1], set=True)
            # Rows of the library's masks are counted from the bottom, rows of its events from the top.
            mask.clear_rectangle(
                x=left, y=size[1] - bottom, width=right - left, height=bottom - top
            )
            parts |= {"x_mask": mask.x_mask(), "y_mask": mask.y_mask()}
    if settings.masked and kind == EVK4:
        pixels = drivers.PropheseeEvk4PixelMask()
        for index, (x, y) in enumerate(settings.masked):
            pixels.set(index, x, size[1] - 1 - y)
        parts["pixel_mask"] = pixels.pixel_mask()
    elif settings.masked:
        codes = [1 + x + size[0] * y for x, y in settings.masked]  # 0: the register masks nothing
        parts["pixel_mask"] = tuple(codes + [0] * (MOST_MASKED[kind] - len(codes)))
    if settings.most_per_s:
        check_rate(
            name, settings.most_per_s, 1_000_000 // RATE_US, MOST_PER_PERIOD * 1_000_000 // RATE_US
        )
        parts["rate_limiter"] = module.RateLimiter(
            RATE_US, settings.most_per_s * RATE_US // 1_000_000
        )
    if settings.trigger is not None and "trigger" in CAN.get(kind, ()):
        parts["enable_external_trigger"] = settings.trigger
    return module.Configuration(**parts)


def _biases(name: str, model: str, kind: Any, settings: CameraSettings) -> Any:
    """Return the biases of a camera model, with the biases of the settings instead of their defaults."""
    known: dict[str, Any] = {field.name: field for field in dataclasses.fields(kind)}
    check_bias_names(
        name, model, settings, {bias: int(field.default) for bias, field in known.items()}
    )
    for bias, value in settings.biases.items():
        # Of the type's NumPy and Python names; none for a switch
        whole = get_args(known[bias].type)
        low, high = (np.iinfo(whole[0]).min, np.iinfo(whole[0]).max) if whole else (0, 1)
        check_bias(name, bias, value, low, high)
    return kind(
        **{bias: type(known[bias].default)(value) for bias, value in settings.biases.items()}
    )


def _sent(configuration: Any, settings: CameraSettings) -> CameraSettings:
    """Return the settings that a configuration contains, with all biases."""
    limiter = getattr(configuration, "rate_limiter", None)
    rate = (
        0
        if limiter is None
        else limiter.maximum_events_per_period * 1_000_000 // limiter.reference_period_us
    )
    biases = {bias: int(value) for bias, value in dataclasses.asdict(configuration.biases).items()}
    trigger = getattr(configuration, "enable_external_trigger", settings.trigger)
    return replace(settings, biases=biases, most_per_s=rate, trigger=trigger)
