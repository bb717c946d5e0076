"""Settings of a camera: one description for all drivers, from the text of a source or from Python."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.io import open_recording
from amiwarp.optics.camera import LARGEST_SIZE
from amiwarp.schema.calls import guarded
from amiwarp.validation import instance, shown, vector, whole

LARGEST_BIAS = 1 << 31
"""Largest magnitude of a bias. What a camera accepts is less, and its driver's to say."""
LARGEST_PER_S = 10**12
"""Largest accepted limit of the event rate [events/s]."""
LARGEST_HZ = 1_000_000
"""Largest accepted frequency of flicker [Hz]."""
LARGEST_COUNTS = 1 << 31
"""Largest number of trigger edges per turn."""
SAVED = "camera_settings"
"""Name of the settings in the metadata of a recording."""


@guarded
@dataclass(frozen=True)
class CameraSettings:
    """Settings of a camera. What is not given stays as the camera's driver has it.

    Each setting is refused, before the camera delivers anything, if the camera or its driver cannot do it. The text of
    the settings continues the name of a source: ``f"camera:evk4,{settings}"``.

    Raises
    ------
    AmiwarpError
        If a value is out of its range.

    Examples
    --------
    >>> settings = amiwarp.CameraSettings(biases={"diff_on": 20}, region=(320, 180, 960, 540), most_per_s=10_000_000)
    >>> str(settings)
    'diff_on=20,region=320:180:960:540,most_mev_s=10'
    """

    biases: Mapping[str, int] = field(default_factory=dict)
    """Values of biases, by the driver's names and in its units."""
    region: tuple[int, int, int, int] | None = None
    """Left, top, right and bottom of the part of the sensor that sends events [px]. Right and bottom are exclusive."""
    masked: tuple[tuple[int, int], ...] = ()
    """Pixels that send no events, each as x and y [px]."""
    most_per_s: int = 0
    """Largest event rate [events/s]. The camera drops events beyond it. 0: no limit."""
    flicker_hz: tuple[int, int] | None = None
    """Lowest and highest frequency of the flicker that the camera removes [Hz]."""
    trigger: bool | None = None
    """Whether edges at the trigger input are received; None: if the driver switches the input on."""
    counts_per_turn: int = 0
    """Rising edges at the trigger input per turn of the prism, if they are counts of its encoder; negative: backwards.
    0: edges are triggers only."""

    def __post_init__(self) -> None:
        biases = {
            name: whole(value, f"bias {name}", -LARGEST_BIAS, LARGEST_BIAS)
            for name, value in self.biases.items()
        }
        for name in biases:
            if not name.isidentifier() or name in FORMS:
                raise AmiwarpError(
                    f"bias {name!r} is no name of a bias; give a name of the camera's driver"
                )
        object.__setattr__(self, "biases", biases)
        if self.region is not None:
            left, top, right, bottom = region = vector(self.region, 4, "region", _pixel)
            if not (left < right and top < bottom):
                raise AmiwarpError(
                    f"region is {self.region}; give left, top, right and bottom [px] of a part"
                )
            object.__setattr__(self, "region", region)
        if (
            not isinstance(self.masked, list | tuple | np.ndarray)
            or getattr(self.masked, "ndim", 1) == 0
        ):
            raise AmiwarpError(
                f"masked is {shown(self.masked)}; expected pixels, each as x and y [px]"
            )
        masked = tuple(vector(pixel, 2, "masked", _pixel) for pixel in self.masked)
        # A pixel given twice would waste a register
        object.__setattr__(self, "masked", tuple(dict.fromkeys(masked)))
        object.__setattr__(
            self, "most_per_s", whole(self.most_per_s, "most_per_s", 0, LARGEST_PER_S, " events/s")
        )
        if self.flicker_hz is not None:
            low, high = band = vector(self.flicker_hz, 2, "flicker_hz", _frequency)
            if not low < high:
                raise AmiwarpError(
                    f"flicker_hz is {self.flicker_hz}; give the lowest and the highest frequency [Hz]"
                )
            object.__setattr__(self, "flicker_hz", band)
        if self.trigger is not None:
            instance(self.trigger, bool, "trigger")
        counts = whole(self.counts_per_turn, "counts_per_turn", -LARGEST_COUNTS, LARGEST_COUNTS)
        object.__setattr__(self, "counts_per_turn", counts)
        if counts and self.trigger is False:
            raise AmiwarpError(
                "counts_per_turn counts edges at the trigger input; leave it out, or set the trigger on",
                ErrorCode.OPTIONS,
            )

    def __str__(self) -> str:
        """Return the settings as the name of a source has them."""
        parts = [f"{name}={value}" for name, value in self.biases.items()]
        if self.region is not None:
            parts.append(f"region={joined(self.region)}")
        if self.masked:
            parts.append("masked=" + "+".join(map(joined, self.masked)))
        if self.most_per_s:
            parts.append(f"most_mev_s={self.most_per_s / 1e6:.16g}")
        if self.flicker_hz is not None:
            parts.append(f"flicker_hz={joined(self.flicker_hz)}")
        if self.trigger is not None:
            parts.append(f"trigger={'on' if self.trigger else 'off'}")
        if self.counts_per_turn:
            parts.append(f"counts_per_turn={self.counts_per_turn}")
        return ",".join(parts)


def _pixel(value: object, what: str) -> int:
    return whole(value, what, 0, LARGEST_SIZE, " px")


def _frequency(value: object, what: str) -> int:
    return whole(value, what, 1, LARGEST_HZ, " Hz")


def joined(values: tuple[int, ...]) -> str:
    """Return numbers as the name of a source has them."""
    return ":".join(map(str, values))


@dataclass(frozen=True)
class CameraRequest:
    """Which camera to open, and how."""

    kind: str
    """Driver: ``camera``, ``dv`` or ``prophesee``."""
    which: str
    """Serial number, or with ``camera`` a part of the model's name; empty: the only camera, or the first one found."""
    settings: CameraSettings
    given: str
    """The settings as they were given, for messages."""

    def name(self, serial: str = "") -> str:
        """Return the name of the camera with this serial number, and with these settings, for messages."""
        return ",".join(
            part for part in (f"{self.kind}:{serial or self.which}", self.given) if part
        )


def parse_camera(spec: str) -> CameraRequest:
    """Return the camera and the settings in the name of a source.

    Raises :class:`AmiwarpError` for settings that cannot be read.
    """
    kind, _, rest = spec.partition(":")
    parts = [part.strip() for part in rest.split(",")]
    which = "" if "=" in parts[0] else parts.pop(0)
    try:
        return CameraRequest(kind, which, _parse_settings(parts), ",".join(parts))
    except AmiwarpError as error:
        raise AmiwarpError(f"{spec}: {error}") from error


def _parse_settings(parts: Sequence[str]) -> CameraSettings:
    """Return the settings of these texts NAME=VALUE. A later one replaces an earlier one."""
    values: dict[str, Any] = {}
    biases: dict[str, int] = {}
    for part in parts:
        name, _, value = part.partition("=")
        if name == "settings":
            saved = saved_settings(value)
            values |= {field.name: getattr(saved, field.name) for field in fields(saved)}
            biases |= saved.biases
            continue
        field_name, read, form = FORMS.get(
            name, ("", _number, "NAME=WHOLE_NUMBER, as in diff_on=20")
        )
        try:
            content = read(value)
        except (ValueError, OverflowError) as error:
            raise AmiwarpError(f"setting {part!r}; write {form}") from error
        if field_name:
            values[field_name] = content
        else:
            biases[name] = content
    return CameraSettings(**(values | {"biases": biases}))


def saved_settings(path: str) -> CameraSettings:
    """Return the settings that a recording stores. Raises :class:`AmiwarpError` if it has none."""
    text = open_recording(path).metadata.get(SAVED)
    if not isinstance(text, str):
        raise AmiwarpError(
            f"{path}: stores no settings of a camera; give a recording that 'amiwarp record' made of one",
            ErrorCode.CONTENT_MISSING,
        )
    return _parse_settings(text.split(",") if text else ())


def _number(text: str) -> int:
    return int(text, 0)


def _counts(text: str) -> int:
    counts = _number(text)
    if not counts:
        raise ValueError(text)
    return counts


def _numbers(text: str) -> tuple[int, ...]:
    return tuple(int(number) for number in text.split(":"))


def _pixels(text: str) -> tuple[tuple[int, ...], ...]:
    return tuple(_numbers(pixel) for pixel in text.split("+"))


def _per_s(text: str) -> int:
    rate = round(float(text) * 1e6)
    if rate < 1:
        raise ValueError(text)
    return rate


def _switch(text: str) -> bool:
    if text not in ("on", "off"):
        raise ValueError(text)
    return text == "on"


FORMS: Mapping[str, tuple[str, Callable[[str], Any], str]] = {
    "region": (
        "region",
        _numbers,
        "region=LEFT:TOP:RIGHT:BOTTOM, in pixels, right and bottom exclusive",
    ),
    "masked": ("masked", _pixels, "masked=X:Y+X:Y, the pixels that shall send no events"),
    "most_mev_s": (
        "most_per_s",
        _per_s,
        "most_mev_s=NUMBER, the largest rate in million events per second",
    ),
    "flicker_hz": (
        "flicker_hz",
        _numbers,
        "flicker_hz=LOWEST:HIGHEST, the frequencies to remove, in Hz",
    ),
    "trigger": ("trigger", _switch, "trigger=on or trigger=off"),
    "counts_per_turn": (
        "counts_per_turn",
        _counts,
        "counts_per_turn=WHOLE_NUMBER, negative for backwards",
    ),
}
"""Settings in the name of a source that are no biases: field, function that reads the value, and how to write it."""
