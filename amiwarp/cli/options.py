"""Groups of command line options that several commands use, as dataclasses: each group is defined once."""

from __future__ import annotations

import functools
import inspect
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import MISSING, dataclass, fields, is_dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import typer

from amiwarp.errors import AmiwarpError
from amiwarp.events.recording import Recording
from amiwarp.io import files as output
from amiwarp.io.camera_files import load_camera
from amiwarp.io.files import check_regular
from amiwarp.optics.camera import Camera
from amiwarp.optics.prism import FlatSide, NominalPrism, UnsizedPrism

Topic = Annotated[
    str | None, typer.Option(help="Topic of a ROS bag, or camera of an HDF5 file, if the file holds several.")
]
"""Option that chooses among several streams of events."""

_in_common = partial(typer.Option, rich_help_panel="Common")
_in_camera = partial(typer.Option, rich_help_panel="Camera")
_in_prism = partial(typer.Option, rich_help_panel="Prism")


@dataclass(frozen=True)
class CameraOptions:
    """Options for the camera. They override the camera in the recording."""

    fov_deg: Annotated[float | None, _in_camera(help="Horizontal field of view of an ideal pinhole camera (deg).")] = (
        None
    )
    camera: Annotated[
        Path | None,
        _in_camera(
            help="Camera intrinsics: JSON (width, height, fx, fy, cx, cy, distortion), a calibration file, YAML of ROS "
            "or Kalibr, or calib.txt (fx fy cx cy k1 k2 p1 p2 k3)."
        ),
    ] = None

    def build(self, width: int, height: int, *, fixed: bool = True) -> Camera | None:
        """Return the camera that the options describe, or None if no option is given.

        ``width`` and ``height`` are the size of the events [px]. Raises :class:`AmiwarpError` if that size is ``fixed``
        and the camera file has another one.
        """
        if self.camera is not None and self.fov_deg is not None:
            raise AmiwarpError("--fov-deg and --camera both describe the camera; give one of them")
        if self.fov_deg is not None:
            return Camera.from_fov(width, height, math.radians(self.fov_deg))
        if self.camera is None:
            return None
        camera = load_camera(self.camera, (width, height))
        if fixed and (camera.width, camera.height) != (width, height):
            sizes = f"{camera.width}x{camera.height} px, the events are {width}x{height} px"
            raise AmiwarpError(f"{self.camera}: the intrinsics are for {sizes}; give the intrinsics of this camera")
        return camera


@dataclass(frozen=True)
class NominalPrismOptions:
    """Options for the prism as its data sheet describes it."""

    nominal_apex_deg: Annotated[float | None, _in_prism(help="Apex angle from the prism's data sheet (deg).")] = None
    index: Annotated[float | None, _in_prism(help="Refractive index of the prism.")] = None
    flat_side: Annotated[FlatSide | None, _in_prism(help="Direction that the prism's flat face points to.")] = None

    def build(self, known: NominalPrism | None) -> NominalPrism | None:
        """Return the nominal prism ``known`` with the values that options give; None if neither exists.

        The apex stays unknown if neither ``known`` nor the options hold one.
        """
        given = {"index": self.index, "flat_side": self.flat_side}
        changes: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
        prism = replace(known or UnsizedPrism(), **changes)
        if self.nominal_apex_deg is not None:
            return UnsizedPrism(prism.index, prism.flat_side).with_apex(math.radians(self.nominal_apex_deg))
        return prism if changes else known


def complete(recording: Recording, camera: CameraOptions, prism: NominalPrismOptions | None = None) -> Recording:
    """Return the recording with the camera and the prism that the options give.

    Options override the recording. Values without an option stay as recorded.
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
"""Unit suffixes of values on the command line and their factors to [rad, us, 1/min, rad/s, rad/s2, px]."""
FORMS = {
    "rad": (("deg", "rad"), "1.2deg or 0.02rad"),
    "us": (("us", "ms"), "250us or 0.25ms"),
    "1/min": (("rpm",), "720rpm"),
    "rad/s": (("deg/s", "rad/s"), "30deg/s or 0.5rad/s"),
    "rad/s2": (("deg/s2", "rad/s2"), "30deg/s2 or 0.5rad/s2"),
    "px": (("px",), "554px"),
    "1": ((), "1.5168"),
}
"""Accepted suffixes of a parameter in each unit, and an example for error messages."""


def number(text: str, unit: str, name: str) -> float:
    """Convert a text such as ``1.2deg`` to a value in ``unit``. Angles other than 0 need a suffix.

    ``unit`` is one of ``amiwarp.calib.parameters.units()``; ``name`` is the option for error messages. Raises
    :class:`AmiwarpError` if the text is not such a value.
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
    """Convert ``LOW:HIGH`` such as ``-10:10deg`` to two values. LOW takes the suffix of HIGH if it has none.

    ``unit`` and ``name`` as for :func:`number`. Raises :class:`AmiwarpError` if the text is not an interval.
    """
    low, colon, high = text.partition(":")
    if not colon:
        raise AmiwarpError(
            f"{name}: {text!r} has no colon; write LOW:HIGH, for example 0:{FORMS[unit][1].partition(' ')[0]}"
        )
    shared = "" if _suffix(low, unit) else _suffix(high, unit)
    return number(low.strip() + shared, unit, name), number(high, unit, name)


def _suffix(text: str, unit: str) -> str:
    return next((k for k in FORMS[unit][0] if text.strip().endswith(k)), "")


def numbers(text: str, count: int, name: str) -> tuple[float, ...]:
    """Convert ``count`` values separated by commas. Raises :class:`AmiwarpError` for another number of values."""
    try:
        values = tuple(float(word) for word in text.split(","))
    except ValueError:
        values = ()
    if len(values) != count or not all(map(math.isfinite, values)):
        raise AmiwarpError(f"{name}: {text!r} is not {count} numbers separated by commas")
    return values


def parse_size(text: str, name: str = "--size", example: str = "640x480") -> tuple[int, int]:
    """Convert a size such as ``640x480``. Raises :class:`AmiwarpError` if the text is not a size.

    ``name`` is the option, and ``example`` a value of it, for the message.
    """
    width, x, height = text.partition("x")
    if not (x and width.isdigit() and height.isdigit()):
        raise AmiwarpError(f"{name} {text!r} is not a size; write it like {example}")
    return int(width), int(height)


def span(text: str, first: int, last: int) -> tuple[int, int]:
    """Convert ``START:END`` [s after ``first``] to times on the clock of ``first`` and ``last`` [us].

    START defaults to ``first``, END to just after ``last``. Raises :class:`AmiwarpError` if the text is not a time
    span.
    """
    start, colon, end = text.partition(":")
    try:
        low = first + round(float(start) * 1e6) if start.strip() else first
        high = first + round(float(end) * 1e6) if end.strip() else last + 1
    except (ValueError, OverflowError):
        low, high = 0, 0
    if not colon or not low < high:
        raise AmiwarpError(f"--window {text!r} is not a time span; write START:END in seconds, for example 0.5:2")
    return low, high


OUTPUT = "output"
"""Mark in ``Annotated`` of an option that names a file to write. Paths without a mark are files to read."""
OUTPUT_FOLDER = "output folder"
"""Mark in ``Annotated`` of an option that names a folder to write to. The command itself checks the files in it."""

NO_FILE = "no file"
"""Mark in ``Annotated`` of an option with a path that is neither read nor written as a file."""

_FORCE = Annotated[bool, _in_common("--force", help="Replace existing output files. Input files are never replaced.")]


@dataclass(frozen=True)
class Common:
    """Options that every command has."""

    json: Annotated[bool, _in_common("--json", help="Print one JSON object on stdout and nothing else.")] = False
    device: Annotated[
        str | None,
        _in_common(help="Device that runs the kernels: cpu, cuda:0 ... Default: cuda:0 if present, otherwise cpu."),
    ] = None
    seed: Annotated[int, _in_common(min=0, max=2**31 - 1, help="Seed of the random number generators.")] = 0


def command(app: typer.Typer, function: Callable[..., None], *, name: str, example: str) -> None:
    """Register ``function`` as a subcommand. Each field of a dataclass parameter becomes an option."""
    hints = get_type_hints(function, include_extras=True)
    parameters: list[inspect.Parameter] = []
    groups: dict[str, tuple[type, list[str]]] = {}
    for parameter in inspect.signature(function).parameters.values():
        kind = hints[parameter.name]
        if is_dataclass(kind) and isinstance(kind, type):
            parameters += _option_parameters(kind)
            groups[parameter.name] = (kind, [f.name for f in fields(kind)])
        else:
            parameters.append(parameter.replace(annotation=kind, kind=inspect.Parameter.KEYWORD_ONLY))
    marks = {p.name: getattr(p.annotation, "__metadata__", ()) for p in parameters}
    writes = any(OUTPUT in mark or OUTPUT_FOLDER in mark for mark in marks.values())
    if writes:
        parameters.append(inspect.Parameter("force", inspect.Parameter.KEYWORD_ONLY, default=False, annotation=_FORCE))

    @functools.wraps(function)
    def run(**values: Any) -> None:
        force = writes and values.pop("force")
        paths = list(_paths(values))
        inputs = [path for name, path in paths if not {OUTPUT, OUTPUT_FOLDER, NO_FILE} & set(marks[name])]
        for path in inputs:
            if path.exists() and not path.is_dir():  # the command itself reports missing files and folders
                check_regular(path)
        outputs = [path for name, path in paths if OUTPUT in marks[name]]
        for key, (kind, names) in groups.items():
            values[key] = kind(**{n: values.pop(n) for n in names})
        with output.run(inputs, outputs, overwrite=force):
            function(**values)

    del run.__wrapped__  # otherwise Typer would read the signature of ``function``
    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    run.__annotations__ = {p.name: p.annotation for p in parameters}
    app.command(name, epilog=f"[bold]Example:[/bold] {example}", help=inspect.getdoc(function))(run)


def _paths(values: Mapping[str, Any]) -> Iterator[tuple[str, Path]]:
    """Yield every path among the values of the options, with the option's name."""
    for name, value in values.items():
        for one in value if isinstance(value, list | tuple) else [value]:
            if isinstance(one, Path):
                yield name, one


def _option_parameters(group: type) -> list[inspect.Parameter]:
    hints = get_type_hints(group, include_extras=True)
    keyword = inspect.Parameter.KEYWORD_ONLY
    return [
        inspect.Parameter(
            f.name,
            keyword,
            default=inspect.Parameter.empty if f.default is MISSING else f.default,
            annotation=hints[f.name],
        )
        for f in fields(group)
    ]
