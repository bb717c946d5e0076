"""From options to cameras, prisms and numbers with units."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from amiwarp.errors import AmiwarpError
from amiwarp.io.files import errors_name
from amiwarp.io.json_files import read_json
from amiwarp.io.text import read_calib
from amiwarp.optics.camera import Camera
from amiwarp.optics.prism import FlatSide, NominalPrism, UnsizedPrism

if TYPE_CHECKING:
    from amiwarp.events.recording import Recording

_CAMERA = "Camera"
_PRISM = "Prism"


@dataclass(frozen=True)
class CameraOptions:
    """The camera, where the recording does not tell."""

    fov_deg: Annotated[
        float | None,
        typer.Option(help="Horizontal field of view of an ideal camera (deg).", rich_help_panel=_CAMERA),
    ] = None
    camera: Annotated[
        Path | None,
        typer.Option(
            help="Intrinsics: JSON (width, height, fx, fy, cx, cy, distortion), a calibration, or calib.txt "
            "(fx fy cx cy k1 k2 p1 p2 k3).",
            rich_help_panel=_CAMERA,
        ),
    ] = None

    def build(self, width: int, height: int, *, fixed: bool = True) -> Camera | None:
        """The camera that the options describe, or None.

        Raises :class:`AmiwarpError` for one of another size where that is ``fixed``.
        """
        if self.camera is not None and self.fov_deg is not None:
            raise AmiwarpError("--fov-deg and --camera both give a camera; give one of them")
        if self.fov_deg is not None:
            return Camera.from_fov(width, height, math.radians(self.fov_deg))
        if self.camera is None:
            return None
        camera = read_camera(self.camera, width, height)
        if fixed and (camera.width, camera.height) != (width, height):
            given = f"{camera.width}x{camera.height}, the events are {width}x{height}"
            raise AmiwarpError(f"{self.camera}: is for {given}; give this camera's intrinsics")
        return camera


def read_camera(path: Path, width: int, height: int) -> Camera:
    """The camera of a JSON file, a calibration's included, or of a ``calib.txt``; the size is for the latter.

    Raises :class:`AmiwarpError` naming file and field.
    """
    from amiwarp.calib.result import camera_from_json

    if path.suffix.lower() != ".json":
        return read_calib(path, width, height)
    data = read_json(path, "a camera")
    with errors_name(path, lambda: "is no camera"):
        return camera_from_json(data["camera"], "camera") if "camera" in data else camera_from_json(data)


@dataclass(frozen=True)
class NominalPrismOptions:
    """The prism as its data sheet has it."""

    nominal_apex_deg: Annotated[
        float | None, typer.Option(help="Apex angle that the data sheet gives (deg).", rich_help_panel=_PRISM)
    ] = None
    index: Annotated[float | None, typer.Option(help="Refractive index.", rich_help_panel=_PRISM)] = None
    flat_side: Annotated[FlatSide | None, typer.Option(help="Where the flat face looks.", rich_help_panel=_PRISM)] = (
        None
    )

    def build(self, known: NominalPrism | None) -> NominalPrism | None:
        """Return ``known`` with what is given over it; None where nothing is known or given.

        An apex that nobody gave stays unknown.
        """
        given = {"index": self.index, "flat_side": self.flat_side}
        changes: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
        prism = replace(known or UnsizedPrism(), **changes)
        if self.nominal_apex_deg is not None:
            return UnsizedPrism(prism.index, prism.flat_side).with_apex(math.radians(self.nominal_apex_deg))
        return prism if changes else known


def complete(recording: Recording, camera: CameraOptions, prism: NominalPrismOptions | None = None) -> Recording:
    """The recording with camera and prism as the options say; what they leave open stays as recorded.

    An option wins over the file: whoever gives it knows better.
    """
    changes: dict[str, Any] = {"camera": camera.build(*recording.events.size) or recording.camera}
    if prism is not None:
        changes["prism"] = prism.build(recording.prism)
    return replace(recording, **changes)


SCALES = {
    "deg": math.pi / 180.0,
    "rad": 1.0,
    "us": 1.0,
    "ms": 1e3,
    "rpm": 1.0,
    "deg/s": math.pi / 180.0,
    "rad/s": 1.0,
    "deg/s2": math.pi / 180.0,
    "rad/s2": 1.0,
    "px": 1.0,
}
"""Suffixes of values on the command line; what they come to [rad, us, 1/min]."""
FORMS = {
    "rad": (("deg", "rad"), "1.2deg or 0.02rad"),
    "us": (("us", "ms"), "250us or 0.25ms"),
    "1/min": (("rpm",), "720rpm"),
    "rad/s": (("deg/s", "rad/s"), "30deg/s or 0.5rad/s"),
    "rad/s2": (("deg/s2", "rad/s2"), "30deg/s2 or 0.5rad/s2"),
    "px": (("px",), "554px"),
    "1": ((), "1.5168"),
}
"""Of each unit the suffixes that fit, and an example."""


def number(text: str, unit: str, name: str) -> float:
    """A value such as ``1.2deg``; angles other than 0 need their unit. Raises :class:`AmiwarpError`.

    ``unit``: the parameter's own, as in ``amiwarp.calib.parameters.UNITS``.
    """
    form, suffix = FORMS[unit][1], _suffix(text, unit)
    try:
        value = float(text.strip().removesuffix(suffix))
    except ValueError:
        value = math.nan
    if not math.isfinite(value) or (value and unit.startswith("rad") and not suffix):
        raise AmiwarpError(f"{name}: {text!r} is not a value; write it like {form}")
    return value * SCALES.get(suffix, 1.0)


def interval(text: str, unit: str, name: str) -> tuple[float, float]:
    """``LOW:HIGH`` such as ``-10:10deg``: the lower end takes the unit of the upper one if it has none.

    ``unit`` as of :func:`number`. Raises :class:`AmiwarpError`.
    """
    low, colon, high = text.partition(":")
    if not colon:
        raise AmiwarpError(f"{name}: {text!r} has no colon; write LOW:HIGH, as 0:{FORMS[unit][1].partition(' ')[0]}")
    shared = "" if _suffix(low, unit) else _suffix(high, unit)
    return number(low.strip() + shared, unit, name), number(high, unit, name)


def _suffix(text: str, unit: str) -> str:
    return next((k for k in FORMS[unit][0] if text.strip().endswith(k)), "")


def numbers(text: str, count: int, name: str) -> tuple[float, ...]:
    """Values separated by commas. Raises :class:`AmiwarpError` unless there are ``count``."""
    try:
        values = tuple(float(word) for word in text.split(","))
    except ValueError:
        values = ()
    if len(values) != count or not all(map(math.isfinite, values)):
        raise AmiwarpError(f"{name}: {text!r} is not {count} numbers separated by commas")
    return values


def span(text: str, first: int, last: int) -> tuple[int, int]:
    """``START:END`` seconds after ``first`` as times on its clock [us]; either may be left out. ``last``: the end.

    Raises :class:`AmiwarpError` for what is no span of time.
    """
    start, colon, end = text.partition(":")
    try:
        low = first + round(float(start) * 1e6) if start.strip() else first
        high = first + round(float(end) * 1e6) if end.strip() else last + 1
    except (ValueError, OverflowError):
        low, high = 0, 0
    if not colon or not low < high:
        raise AmiwarpError(f"--window {text!r} is no span of time; write START:END in seconds, as 0.5:2")
    return low, high
