"""Cameras by Prophesee, read through the Python bindings of OpenEB or the Metavision SDK.

Tested with a substitute for the library, with the names and signatures of OpenEB's bindings, not yet with a camera.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.live.stream.camera_checks import (
    check_band,
    check_bias,
    check_bias_names,
    check_on_sensor,
    check_rate,
    refuse_others,
)
from amiwarp.live.stream.camera_settings import CameraRequest, CameraSettings
from amiwarp.live.stream.camera_source import CameraSource, copied_events, library, opening
from amiwarp.live.stream.packets import NO_TIMES, Packet
from amiwarp.live.stream.sockets import Unreachable

FACILITIES = {
    "biases": "get_i_ll_biases",
    "region": "get_i_roi",
    "masked": "get_i_digital_event_mask",
    "most_per_s": "get_i_erc_module",
    "flicker_hz": "get_i_antiflicker_module",
    "trigger": "get_i_trigger_in",
}
"""Method of the library's device that returns the facility of each setting, or None if the camera has none."""


class PropheseeSource(CameraSource):
    """Source of events from a camera that OpenEB or the Metavision SDK opens.

    No serial number means the first camera found. While the camera sends nothing at all, the library blocks.
    """

    def __init__(
        self,
        request: CameraRequest,
        say: Callable[[str], None] = lambda _: None,
        *,
        packet_us: int = 1000,
    ) -> None:
        super().__init__(request, say, packet_us=packet_us)
        remedy = "install OpenEB or the Metavision SDK (they are not on PyPI)"
        event_io = library("metavision_core.event_io", self.name, remedy)
        raw_reader = library("metavision_core.event_io.raw_reader", self.name, remedy)
        self._hal = library("metavision_hal", self.name, remedy)
        with opening(self.name):
            device = raw_reader.initiate_device(path=request.which)
            if device is None:
                raise Unreachable(f"{self.name}: no such camera; plug the camera in")
            identity = device.get_i_hw_identification()
            geometry = device.get_i_geometry()
            serial = request.which or str(identity.get_serial())
            self.name = request.name(serial)
            self.size = int(geometry.get_width()), int(geometry.get_height())
            self._facilities = {
                name: getattr(device, getter)() for name, getter in FACILITIES.items()
            }
            model = str(identity.get_sensor_info().name)
            self._apply(model)  # before the stream begins
            self._iterator = event_io.EventsIterator.from_device(device=device, delta_t=packet_us)
            self._opened(
                model, serial, self._reported(), "reported by the camera; the region as sent"
            )

    def packets(self) -> Iterator[Packet]:
        """Yield packets, see :meth:`CameraSource.packets`."""
        slices = iter(self._iterator)
        while True:
            events = None
            rising = NO_TIMES
            with self._stopping():
                events = next(slices, None)
                rising = self._rising()
            if events is None:
                self.problem = self.problem or "the camera stopped; was it unplugged?"
                return
            yield self._make_packet(
                copied_events(events["x"], events["y"], events["t"], events["p"]), rising
            )

    def close(self) -> None:
        """Release the camera, see :meth:`Source.close`."""
        self._iterator = None
        self._facilities = {}  # they belong to the device

    def _apply(self, model: str) -> None:
        """Check the settings and give them to the camera."""
        can = [name for name, facility in self._facilities.items() if facility is not None]
        refuse_others(self.name, model, self.settings, can, {})
        masks = self._facilities["masked"].get_pixel_masks() if "masked" in can else ()
        self._check(model, can, len(masks))
        self._set_biases(model)
        self._set_region()
        for mask, (x, y) in zip(masks, self.settings.masked, strict=False):
            self._accepted("masked", mask.set_mask(x, y, True))
        self._set_limits()
        if "trigger" in can:
            trigger = self._facilities["trigger"]
            switch = trigger.disable if self.settings.trigger is False else trigger.enable
            self._accepted("trigger", switch(self._hal.I_TriggerIn.Channel.MAIN))

    def _check(self, model: str, can: list[str], most_masked: int) -> None:
        """Raise :class:`AmiwarpError` for settings out of the camera's ranges, before any is set.

        ``can``: names of the settings that the camera has; ``most_masked``: number of pixels that it can mask.
        """
        settings = self.settings
        check_on_sensor(self.name, settings, self.size, most_masked)
        if settings.most_per_s:
            limiter = self._facilities["most_per_s"]
            lowest = limiter.get_min_supported_cd_event_rate()
            highest = limiter.get_max_supported_cd_event_rate()
            check_rate(self.name, settings.most_per_s, lowest, highest)
        if settings.flicker_hz is not None:
            flicker_filter = self._facilities["flicker_hz"]
            lowest = flicker_filter.get_min_supported_frequency()
            highest = flicker_filter.get_max_supported_frequency()
            check_band(self.name, settings.flicker_hz, lowest, highest)
        if settings.counts_per_turn and "trigger" not in can:
            raise AmiwarpError(
                f"{self.name}: {model} has no trigger input; leave counts_per_turn out"
            )

    def _set_region(self) -> None:
        """Let only a part of the sensor send events, if the settings say so."""
        if self.settings.region is None:
            return
        left, top, right, bottom = self.settings.region
        roi = self._hal.I_ROI
        window = roi.Window(left, top, right - left, bottom - top)
        region = self._facilities["region"]
        self._accepted("region", region.set_mode(roi.Mode.ROI))
        self._accepted("region", region.set_window(window))
        self._accepted("region", region.enable(True))

    def _set_limits(self) -> None:
        """Limit the event rate and remove flicker, if the settings say so."""
        settings = self.settings
        if settings.most_per_s:
            limiter = self._facilities["most_per_s"]
            self._accepted("most_mev_s", limiter.set_cd_event_rate(settings.most_per_s))
            self._accepted("most_mev_s", limiter.enable(True))
        if settings.flicker_hz is not None:
            flicker_filter = self._facilities["flicker_hz"]
            band_stop = self._hal.I_AntiFlickerModule.AntiFlickerMode.BandStop
            self._accepted("flicker_hz", flicker_filter.set_frequency_band(*settings.flicker_hz))
            self._accepted("flicker_hz", flicker_filter.set_filtering_mode(band_stop))
            self._accepted("flicker_hz", flicker_filter.enable(True))

    def _set_biases(self, model: str) -> None:
        """Check the biases and set them. Their names may lack the library's prefix ``bias_``."""
        facility = self._facilities["biases"]
        known: dict[str, int] = {}
        if facility is not None:
            known = {str(name): int(value) for name, value in facility.get_all_biases().items()}
        given: dict[str, int] = {}
        for name, value in self.settings.biases.items():
            known_name = name if name in known else f"bias_{name.removeprefix('bias_')}"
            if given.setdefault(known_name, value) != value:
                raise AmiwarpError(
                    f"{self.name}: bias {known_name} is given as {given[known_name]} and as {value}; give it once"
                )
        self.settings = replace(self.settings, biases=given)
        check_bias_names(self.name, model, self.settings, known)
        for name, value in given.items():
            info = facility.get_bias_info(name)
            check_bias(self.name, name, value, *info.get_bias_allowed_range())
            if not info.is_modifiable():
                raise AmiwarpError(
                    f"{self.name}: bias {name} cannot be set, it is {known[name]}; leave it out"
                )
        for name, value in given.items():
            self._accepted(name, facility.set(name, value))

    def _accepted(self, setting: str, accepted: bool) -> None:
        """Raise :class:`AmiwarpError` if the library says that the camera did not take a setting."""
        if not accepted:
            raise AmiwarpError(
                f"{self.name}: the camera did not accept the setting {setting}; leave it out"
            )

    def _reported(self) -> CameraSettings:
        """Return the settings that the camera has. The library does not report the region."""
        facilities = self._facilities
        biases: dict[str, int] = {}
        bias_facility = facilities["biases"]
        if bias_facility is not None:
            for name, value in bias_facility.get_all_biases().items():
                if bias_facility.get_bias_info(name).is_modifiable():
                    biases[str(name)] = int(value)

        masked: tuple[tuple[int, int], ...] = ()
        if facilities["masked"] is not None:
            states = [mask.get_mask() for mask in facilities["masked"].get_pixel_masks()]
            masked = tuple((int(x), int(y)) for x, y, enabled in states if enabled)

        most_per_s = 0
        limiter = facilities["most_per_s"]
        if limiter is not None and limiter.is_enabled():
            most_per_s = int(limiter.get_cd_event_rate())

        flicker_hz = None
        flicker_filter = facilities["flicker_hz"]
        if flicker_filter is not None and flicker_filter.is_enabled():
            low = int(flicker_filter.get_band_low_frequency())
            high = int(flicker_filter.get_band_high_frequency())
            flicker_hz = (low, high)

        has_trigger = None
        trigger = facilities["trigger"]
        if trigger is not None:
            has_trigger = bool(trigger.is_enabled(self._hal.I_TriggerIn.Channel.MAIN))
        return replace(
            self.settings,
            biases=biases,
            masked=masked,
            most_per_s=most_per_s,
            flicker_hz=flicker_hz,
            trigger=has_trigger,
        )

    def _rising(self) -> NDArray[np.int64]:
        """Return the times of the rising edges since the last call, on the camera's clock [us], shape ``(n,)``."""
        reader = self._iterator.reader
        edges = reader.get_ext_trigger_events()
        rising = np.array(edges["t"][edges["p"] == 1], np.int64) if len(edges) else NO_TIMES
        reader.clear_ext_trigger_events()
        return rising
