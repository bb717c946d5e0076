"""Checks of a camera's settings. What a camera cannot do is refused, with what can be done instead."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import fields

from amiwarp.errors import AmiwarpError
from amiwarp.live.stream.camera_settings import CameraSettings, joined

INSTEAD: Mapping[str, str] = {
    "biases": "leave them out",
    "region": "keep a part of the recording with 'amiwarp filter --region LEFT,TOP,RIGHT,BOTTOM'",
    "masked": "remove pixels from the recording with 'amiwarp filter --hot-pixels'",
    "most_per_s": "thin the recording with 'amiwarp filter --most-mev-s N', or let live drop events with --policy thin",
    "flicker_hz": "light the scene with daylight or lamps that do not flicker",
    "trigger": "relate the clocks by arrival times, or send the edges through the controller's --port",
}
"""What to do instead of a setting that a camera does not have."""
NAMES: Mapping[str, str] = {"most_per_s": "most_mev_s"}
"""Names of settings in the name of a source, where they differ from the names of the fields."""


def refuse_others(
    name: str,
    model: str,
    settings: CameraSettings,
    can: Collection[str],
    elsewhere: Mapping[str, str],
) -> None:
    """Raise :class:`AmiwarpError` for the first setting that is given, but not among those that the camera ``can``.

    ``elsewhere``: for some settings, how to reach them with another driver.
    """
    for setting in INSTEAD:
        # trigger=off is equal to 0 here: a trigger input that the driver does not switch on is off
        if setting not in can and getattr(settings, setting) not in (None, {}, (), 0):
            remedy = "; or ".join(filter(None, (elsewhere.get(setting), INSTEAD[setting])))
            raise AmiwarpError(
                f"{name}: {model} has no {NAMES.get(setting, setting)} through this driver; {remedy}"
            )


def check_on_sensor(
    name: str, settings: CameraSettings, size: tuple[int, int], most_masked: int
) -> None:
    """Raise :class:`AmiwarpError` for a region or a pixel outside the sensor, and for too many pixels."""
    width, height = size
    if settings.region is not None and (settings.region[2] > width or settings.region[3] > height):
        raise AmiwarpError(
            f"{name}: region {joined(settings.region)} is not within the sensor of {width}x{height} px; give "
            "LEFT:TOP:RIGHT:BOTTOM, right and bottom exclusive"
        )
    for x, y in settings.masked:
        if x >= width or y >= height:
            raise AmiwarpError(
                f"{name}: masked pixel {x}:{y} is outside the sensor of {width}x{height} px; correct it"
            )
    if len(settings.masked) > most_masked:
        raise AmiwarpError(
            f"{name}: {len(settings.masked)} masked pixels are more than the {most_masked} that the camera can mask; "
            "give the most active ones, and remove the others from the recording with 'amiwarp filter --hot-pixels'"
        )


def check_bias(name: str, bias: str, value: int, low: int, high: int) -> None:
    """Raise :class:`AmiwarpError` unless the value of a bias is within ``low`` .. ``high``."""
    if not low <= value <= high:
        raise AmiwarpError(f"{name}: bias {bias} = {value}; expected {low} .. {high}")


def check_bias_names(
    name: str, model: str, settings: CameraSettings, known: Mapping[str, int]
) -> None:
    """Raise :class:`AmiwarpError` for a bias that is not among the ``known`` ones, with their present values."""
    for bias in settings.biases:
        if bias not in known:
            listed = ", ".join(f"{known_bias} ({value})" for known_bias, value in known.items())
            raise AmiwarpError(
                f"{name}: {model} has no bias {bias!r}; its biases, with their values, are {listed}"
            )


def check_rate(name: str, most_per_s: int, low: int, high: int) -> None:
    """Raise :class:`AmiwarpError` unless the limit of the event rate [events/s] is within ``low`` .. ``high``."""
    if most_per_s and not low <= most_per_s <= high:
        raise AmiwarpError(
            f"{name}: most_mev_s = {most_per_s / 1e6:g}; the camera limits to {low / 1e6:g} .. {high / 1e6:g} million "
            "events per second"
        )


def check_band(name: str, band: tuple[int, int], low: int, high: int) -> None:
    """Raise :class:`AmiwarpError` unless a band of frequencies [Hz] is within ``low`` .. ``high``."""
    if not low <= band[0] < band[1] <= high:
        raise AmiwarpError(
            f"{name}: flicker_hz = {joined(band)}; the camera removes flicker of {low} .. {high} Hz"
        )


def difference(settings: CameraSettings, applied: CameraSettings) -> str:
    """Return which given settings the camera has otherwise than given; empty if none."""
    changes = []
    for field in fields(settings):
        given = getattr(settings, field.name)
        got = getattr(applied, field.name)
        if field.name != "biases" and given not in (None, (), 0) and given != got:
            one = CameraSettings(**{field.name: got})
            changes.append(str(one) or f"no {field.name}")
    changes += [
        f"{bias}={applied.biases.get(bias)}"
        for bias, value in settings.biases.items()
        if applied.biases.get(bias) != value
    ]
    return ", ".join(changes)
