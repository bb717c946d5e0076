"""What commands share: groups of options as dataclasses, choice of the device, progress bar, printed result."""

from __future__ import annotations

import contextlib
import functools
import inspect
import json
import math
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import MISSING, dataclass, fields, is_dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal, cast, get_type_hints

import rich.progress
import typer
from rich.console import Console
from rich.progress import BarColumn, TaskProgressColumn, TextColumn, TimeRemainingColumn
from rich.table import Table

from amiwarp.errors import AmiwarpError, ErrorCode, printable
from amiwarp.events.encoder import Encoder
from amiwarp.events.recording import Recording
from amiwarp.io import read_encoder_csv, read_encoder_triggers
from amiwarp.io.camera_files import load_camera
from amiwarp.io.inputs import check_regular
from amiwarp.io.output_formats import LIMITS, Codec, OutputFormat, Rounding
from amiwarp.io.outputs import protecting_files
from amiwarp.optics.camera import LEAST_FOV, Camera
from amiwarp.optics.prism import (
    LARGEST_APEX,
    LARGEST_PHASE,
    LARGEST_THICKNESS,
    STEEPEST_TILT,
    FlatSide,
    NominalPrism,
    Plate,
    Prism,
    UnsizedPrism,
)
from amiwarp.tasks import Progress
from amiwarp.validation import check_name_lengths, real

# Options that several commands use. A group of options is a dataclass.

Topic = Annotated[
    str | None,
    typer.Option(help="Topic of a ROS bag, or camera of an HDF5 file, if the file holds several."),
]
"""Option that chooses among several streams of events."""

# Options in a panel of the help.
_in_layout = partial(typer.Option, rich_help_panel="Layout of the file")
_in_common = partial(typer.Option, rich_help_panel="Common")
in_camera = partial(typer.Option, rich_help_panel="Camera")
in_prism = partial(typer.Option, rich_help_panel="Prism")
in_encoder = partial(typer.Option, rich_help_panel="Encoder")


@dataclass(frozen=True)
class LayoutOptions:
    """Options for what an event file does not state. They override what is assumed."""

    columns: Annotated[
        str | None,
        _in_layout(
            help="Columns of text, NumPy, HDF5, MATLAB and Parquet files: t=NAME,x=NAME,y=NAME,p=NAME, or their order, "
            "such as x,y,p,t (-: a column without use).",
            metavar="t=NAME,...",
        ),
    ] = None
    time_unit: Annotated[
        Literal["s", "ms", "us", "ns"] | None,
        _in_layout(help="Unit of time in such a file.", show_default=False),
    ] = None
    polarity: Annotated[
        str | None,
        _in_layout(
            help="Meaning of the polarities in such a file: 1=on,2=off.", metavar="VALUE=on|off,..."
        ),
    ] = None
    scale_xy: Annotated[
        int | None,
        _in_layout(
            min=1, help="Number by which x and y in such a file are divided: 32 for BS-ERGB."
        ),
    ] = None
    chip: Annotated[
        str | None,
        _in_layout(help="Chip of the camera, if an AEDAT 2.0 file does not state it: DVS128 ..."),
    ] = None
    sort: Annotated[
        bool,
        _in_layout(
            "--sort", help="Sort the events by time, up to 33 million, which are kept in memory."
        ),
    ] = False

    def given(self) -> dict[str, Any]:
        """Return the arguments of :func:`amiwarp.open_recording` that the options give."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return {name: value for name, value in values.items() if value not in (None, False)}


@dataclass(frozen=True)
class FileOptions(LayoutOptions):
    """Options for what an event file does not state, with the size of the sensor."""

    size: Annotated[
        str | None,
        _in_layout(
            help="Sensor size (px), which replaces the size in the file. Default: that of the file, or the smallest "
            "known sensor that holds all events.",
            metavar="WIDTHxHEIGHT",
        ),
    ] = None

    def given(self) -> dict[str, Any]:
        """Return the arguments of :func:`amiwarp.open_recording` that the options give."""
        values = super().given()
        return values if self.size is None else {**values, "size": parse_size(self.size)}


@dataclass(frozen=True)
class CameraOptions:
    """Options for the camera. They override the camera in the recording."""

    fov_deg: Annotated[
        float | None, in_camera(help="Horizontal field of view of an ideal pinhole camera (deg).")
    ] = None
    camera: Annotated[
        Path | None,
        in_camera(
            help="Camera intrinsics: JSON (width, height, fx, fy, cx, cy, distortion), a calibration file, YAML of "
            "ROS, OpenCV or Kalibr, or calib.txt (fx fy cx cy k1 k2 p1 p2 k3)."
        ),
    ] = None

    def build(self, width: int, height: int, *, fixed: bool = True) -> Camera | None:
        """Return the camera that the options describe, or None if no option is given.

        ``width`` and ``height`` are the size of the events [px]. Raises :class:`AmiwarpError` if that size is ``fixed``
        and the camera file has another one.
        """
        if self.camera is not None and self.fov_deg is not None:
            raise AmiwarpError(
                "--fov-deg and --camera both describe the camera; give one of them",
                ErrorCode.OPTIONS,
            )
        if self.fov_deg is not None:
            return Camera.from_fov(width, height, fov_from(self.fov_deg, "--fov-deg"))
        if self.camera is None:
            return None
        camera = load_camera(self.camera, (width, height))
        if fixed and (camera.width, camera.height) != (width, height):
            sizes = f"{camera.width}x{camera.height} px, the events are {width}x{height} px"
            raise AmiwarpError(
                f"{self.camera}: the intrinsics are for {sizes}; give the intrinsics of this camera"
            )
        return camera


@dataclass(frozen=True)
class NominalPrismOptions:
    """Options for the prism as its data sheet describes it."""

    nominal_apex_deg: Annotated[
        float | None, in_prism(help="Apex angle from the prism's data sheet (deg).")
    ] = None
    index: Annotated[float | None, in_prism(help="Refractive index of the prism.")] = None
    flat_side: Annotated[
        FlatSide | None, in_prism(help="Direction that the prism's flat face points to.")
    ] = None
    second_apex_deg: Annotated[
        float | None,
        in_prism(help="Apex angle of a second prism behind the first, a Risley pair (deg)."),
    ] = None
    thickness_mm: Annotated[
        float | None,
        in_prism(help="Thickness of a tilted plane-parallel plate instead of a prism (mm)."),
    ] = None
    plate_tilt_deg: Annotated[
        float | None,
        in_prism(help="Angle between the normal of the plate and the rotation axis (deg)."),
    ] = None

    def build(self, known: NominalPrism | None) -> NominalPrism | None:
        """Return the nominal prism ``known`` with the values that options give; None if neither exists.

        The apex stays unknown if neither ``known`` nor the options hold one.
        """
        if isinstance(known, Plate):
            return self._plate(known)
        if self.thickness_mm is not None or self.plate_tilt_deg is not None:
            return self._plate(None)
        changes: dict[str, Any] = {}
        if self.index is not None:
            changes["index"] = self.index
        if self.flat_side is not None:
            changes["flat_side"] = self.flat_side
        prism = replace(known or UnsizedPrism(), **changes)
        if self.nominal_apex_deg is not None:
            apex = apex_from(self.nominal_apex_deg, "--nominal-apex-deg")
            sized = UnsizedPrism(prism.index, prism.flat_side).with_apex(apex)
            prism = replace(sized, second=prism.second) if isinstance(prism, Prism) else sized
            changes["apex"] = sized.apex
        if self.second_apex_deg is not None:
            if not isinstance(prism, Prism):
                raise AmiwarpError(
                    "--second-apex-deg needs the apex of the first prism; give --nominal-apex-deg",
                    ErrorCode.OPTIONS,
                )
            second_apex = apex_from(self.second_apex_deg, "--second-apex-deg")
            second = Prism(second_apex, prism.index, prism.flat_side)
            return replace(prism, second=second)
        return prism if changes else known

    def _plate(self, known: Plate | None) -> Plate:
        """Return the plate ``known`` with the values that options give."""
        if self.nominal_apex_deg is not None or self.flat_side is not None:
            raise AmiwarpError(
                "--nominal-apex-deg and --flat-side are those of a prism; leave them out for a plate",
                ErrorCode.OPTIONS,
            )
        thickness = self.thickness_mm
        tilt = self.plate_tilt_deg
        if known is None and (thickness is None or tilt is None):
            raise AmiwarpError(
                "a plate needs --thickness-mm and --plate-tilt-deg; give both", ErrorCode.OPTIONS
            )
        plate = known or Plate(0.0, 0.0)
        return Plate(
            plate.thickness if thickness is None else thickness_from(thickness),
            plate.tilt if tilt is None else plate_tilt_from(tilt),
            plate.index if self.index is None else self.index,
        )


def complete(
    recording: Recording, camera: CameraOptions, prism: NominalPrismOptions | None = None
) -> Recording:
    """Return the recording with the camera and the prism that the options give.

    Options override the recording. Values without an option stay as recorded.
    """
    changes: dict[str, Any] = {"camera": camera.build(*recording.events.size) or recording.camera}
    if prism is not None:
        changes["prism"] = prism.build(recording.prism)
    return replace(recording, **changes)


@dataclass(frozen=True)
class EncoderOptions:
    """Options for a log of the prism's encoder."""

    encoder: Annotated[
        Path | None,
        in_encoder(
            help="Encoder log: CSV with the header t_us,angle_deg or t_us,count, and optionally index (0 or 1)."
        ),
    ] = None
    encoder_from: Annotated[
        str | None,
        in_encoder(
            help="Take the encoder from the trigger edges in the recording: triggers:CHANNEL. Each rising edge is one "
            "count; by default it is the index pulse, one per turn.",
            metavar="triggers:CHANNEL",
        ),
    ] = None
    counts_per_turn: Annotated[int | None, in_encoder(min=1, help="Encoder counts per turn.")] = (
        None
    )
    counter_bits: Annotated[
        int | None,
        in_encoder(
            min=0,
            max=64,
            help="Width of the encoder's counter (bits); 0: the counter restarts at every turn. "
            "Default: inferred from the counts.",
        ),
    ] = None
    direction: Annotated[
        Literal["1", "-1"], in_encoder(help="Counting direction; -1: backwards.")
    ] = "1"
    second_encoder: Annotated[
        Path | None,
        in_encoder(
            help="Encoder log of the second prism of a Risley pair, in the form of --encoder."
        ),
    ] = None
    second_ratio: Annotated[
        float | None,
        in_encoder(
            help="Speed of the second prism of a Risley pair relative to the first, if both are geared."
        ),
    ] = None

    def build(self, source: Path, topic: str | None, chip: str | None) -> Encoder | None:
        """Return the encoder of the log or of the recording's triggers, or None if neither is given."""
        if self.second_encoder is not None and self.second_ratio is not None:
            raise AmiwarpError(
                "--second-encoder and --second-ratio both describe the second prism; give one of them",
                ErrorCode.OPTIONS,
            )
        first = replace(self, second_encoder=None, second_ratio=None)._first(source, topic, chip)
        if self.second_encoder is None and self.second_ratio is None:
            return first
        if first is None:
            raise AmiwarpError(
                "--second-encoder and --second-ratio need the first prism's encoder; give --encoder too",
                ErrorCode.OPTIONS,
            )
        if self.second_ratio is not None:
            return first.with_second(self.second_ratio)
        of_second = replace(self, encoder=self.second_encoder, encoder_from=None)
        return first.with_second(cast("Encoder", of_second._first(source, topic, chip)))

    def _first(self, source: Path, topic: str | None, chip: str | None) -> Encoder | None:
        if self.encoder_from is not None:
            return self._from_triggers(self.encoder_from, source, topic, chip)
        if self.encoder is None:
            if self != EncoderOptions():
                what = "--counts-per-turn, --counter-bits and --direction describe an encoder log"
                raise AmiwarpError(
                    f"{what}; give --encoder or --encoder-from too", ErrorCode.OPTIONS
                )
            return None
        return read_encoder_csv(
            self.encoder,
            counts_per_turn=self.counts_per_turn,
            counter_bits=self.counter_bits,
            direction=int(self.direction),
        )

    def _from_triggers(
        self, text: str, source: Path, topic: str | None, chip: str | None
    ) -> Encoder:
        kind, colon, channel = text.partition(":")
        if kind != "triggers" or (colon and not channel.isdecimal()):
            raise AmiwarpError(
                f"--encoder-from {text!r} is unknown; write triggers:CHANNEL, for example triggers:0"
            )
        if self.encoder is not None or self.counter_bits is not None:
            raise AmiwarpError(
                "--encoder and --counter-bits describe an encoder log; leave them or --encoder-from out",
                ErrorCode.OPTIONS,
            )
        return read_encoder_triggers(
            source,
            int(channel or 0),
            counts_per_turn=self.counts_per_turn or 1,
            direction=int(self.direction),
            topic=topic,
            chip=chip,
        )


Format = Annotated[
    OutputFormat | None,
    typer.Option(
        help="Format to write, if the extension means another one: dsec (.h5), evt21 (.raw).",
        show_default=False,
    ),
]
"""Option that chooses a format whose extension means another one."""


HdfCodec = Annotated[
    Codec, typer.Option(help="Compression of HDF5. Programs without HDF5's Blosc filter read gzip.")
]
"""Option for the compression of HDF5."""


Round = Annotated[
    Rounding | None,
    typer.Option(
        help="Round compensated events to whole pixels, as RAW, DAT, AEDAT 4, DSEC and ROS need. nearest: to the "
        "nearest pixel; dithered: up or down at random (--seed), unbiased. Events outside the image are dropped.",
        show_default=False,
    ),
]
"""Option for the rounding of compensated events."""


LONGEST_US = 10**15
"""Longest time that an option takes [us]: 32 years."""
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
    "1/m": ((), "2"),
    "1/s": ((), "1.5"),
}
"""Accepted suffixes of a parameter in each unit, and an example for error messages."""


def number(text: str, unit: str, name: str) -> float:
    """Convert a text such as ``1.2deg`` to a value in ``unit``. Angles other than 0 need a suffix.

    ``unit`` is one of ``amiwarp.results.parameters.units()``; ``name`` is the option for error messages. Raises
    :class:`AmiwarpError` if the text is not such a value.
    """
    form = FORMS[unit][1]
    suffix = _suffix(text, unit)
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
    """Return the suffix of a value in ``unit``; empty if it has none."""
    for suffix in FORMS[unit][0]:
        if text.strip().endswith(suffix):
            return suffix
    return ""


def numbers(text: str, count: int, name: str) -> tuple[float, ...]:
    """Convert ``count`` values separated by commas. Raises :class:`AmiwarpError` for another number of values."""
    try:
        values = tuple(float(word) for word in text.split(","))
    except ValueError:
        values = ()
    if len(values) != count or not all(map(math.isfinite, values)):
        raise AmiwarpError(f"{name}: {text!r} is not {count} numbers separated by commas")
    return values


def radians(
    degrees: float, name: str, low: float = -LARGEST_PHASE, high: float = LARGEST_PHASE
) -> float:
    """Convert the value of the option ``name`` to radians. Raises :class:`AmiwarpError` outside low .. high [rad]."""
    return math.radians(real(degrees, name, math.degrees(low), math.degrees(high), " deg"))


def angles(
    text: str, count: int, name: str, high: float = LARGEST_PHASE, *, low: float | None = None
) -> tuple[Any, ...]:
    """Convert ``count`` angles [deg] separated by commas to radians, see :func:`radians`. ``low`` is ``-high``."""
    low = -high if low is None else low
    return tuple(radians(value, name, low, high) for value in numbers(text, count, name))


def fov_from(degrees: float, name: str) -> float:
    """Convert the field of view that the option ``name`` gives to radians."""
    return radians(degrees, name, LEAST_FOV, math.pi)


def apex_from(degrees: float, name: str) -> float:
    """Convert the apex angle that the option ``name`` gives to radians."""
    return radians(degrees, name, 0.0, LARGEST_APEX)


def thickness_from(mm: float) -> float:
    """Convert the value of ``--thickness-mm`` to metres."""
    return real(mm, "--thickness-mm", 0.0, 1e3 * LARGEST_THICKNESS, " mm") * 1e-3


def plate_tilt_from(degrees: float) -> float:
    """Convert the value of ``--plate-tilt-deg`` to radians."""
    return radians(degrees, "--plate-tilt-deg", 0.0, STEEPEST_TILT)


def parse_size(text: str, name: str = "--size", example: str = "640x480") -> tuple[int, int]:
    """Convert a size such as ``640x480``. Raises :class:`AmiwarpError` if the text is not a size.

    ``name`` is the option, and ``example`` a value of it, for the message.
    """
    width, x, height = text.partition("x")
    if not (x and width.isdecimal() and height.isdecimal()):
        raise AmiwarpError(f"{name} {text!r} is not a size; write it like {example}")
    return int(width), int(height)


def parse_region(text: str) -> tuple[int, int, int, int]:
    """Return the edges of a region [px]."""
    values = numbers(text, 4, "--region")
    if any(value != int(value) for value in values):
        raise AmiwarpError(
            f"--region: {text!r} has fractions; give whole pixels: LEFT,TOP,RIGHT,BOTTOM"
        )
    left, top, right, bottom = (int(value) for value in values)
    return left, top, right, bottom


def microseconds(value: float, unit: str, name: str) -> int:
    """Convert the time that the option ``name`` gives in the unit ``s`` or ``ms`` to whole microseconds.

    Raises :class:`AmiwarpError` for a time that is not finite, or longer than :data:`LONGEST_US`.
    """
    scale = {"ms": 1e3, "s": 1e6}[unit]
    return round(real(value, name, -LONGEST_US / scale, LONGEST_US / scale, f" {unit}") * scale)


def span(text: str, first: int, last: int) -> tuple[int, int]:
    """Convert ``START:END`` [s after ``first``] to times on the clock of ``first`` and ``last`` [us].

    START defaults to ``first``, END to just after ``last``. Raises :class:`AmiwarpError` if the text is not a time
    span.
    """
    start, colon, end = text.partition(":")
    try:
        low = first + microseconds(float(start), "s", "START") if start.strip() else first
        high = first + microseconds(float(end), "s", "END") if end.strip() else last + 1
    except ValueError:
        low, high = 0, 0
    if not colon or not low < high:
        raise AmiwarpError(
            f"--window {text!r} is not a time span; write START:END in seconds, for example 0.5:2"
        )
    return low, high


OUTPUT = "output"
"""Mark in ``Annotated`` of an option that names a file to write. Paths without a mark are files to read."""
OUTPUT_FOLDER = "output folder"
"""Mark in ``Annotated`` of an option that names a folder to write to. The command itself checks the files in it."""

OUTPUT_EITHER = "output file or folder"
"""Mark in ``Annotated`` of an option that names a file to write, or a folder, in which the command checks the files."""

NO_FILE = "no file"
"""Mark in ``Annotated`` of an option with a path that is neither read nor written as a file."""

_FORCE = Annotated[
    bool,
    _in_common("--force", help="Replace existing output files. Input files are never replaced."),
]


@dataclass(frozen=True)
class Common:
    """Options that every command has."""

    json: Annotated[
        bool, _in_common("--json", help="Print one JSON object on stdout and nothing else.")
    ] = False
    device: Annotated[
        str | None,
        _in_common(
            help="Device that runs the kernels: cpu, cuda:0 ... Default: cuda:0 if present, otherwise cpu."
        ),
    ] = None
    seed: Annotated[
        int, _in_common(min=0, max=2**31 - 1, help="Seed of the random number generators.")
    ] = 0


def command(app: typer.Typer, function: Callable[..., None], *, name: str, example: str) -> None:
    """Register ``function`` as a subcommand. Each field of a dataclass parameter becomes an option."""
    hints = get_type_hints(function, include_extras=True)
    parameters: list[inspect.Parameter] = []
    groups: dict[str, tuple[type, list[str]]] = {}
    for parameter in inspect.signature(function).parameters.values():
        hint = hints[parameter.name]
        if is_dataclass(hint) and isinstance(hint, type):
            parameters += _option_parameters(hint)
            groups[parameter.name] = (hint, [field.name for field in fields(hint)])
        else:
            parameters.append(
                parameter.replace(annotation=hint, kind=inspect.Parameter.KEYWORD_ONLY)
            )
    marks = {}
    for parameter in parameters:
        marks[parameter.name] = getattr(parameter.annotation, "__metadata__", ())
    writes = any(_WRITTEN & set(mark) for mark in marks.values())
    if writes:
        parameters.append(
            inspect.Parameter(
                "force", inspect.Parameter.KEYWORD_ONLY, default=False, annotation=_FORCE
            )
        )

    @functools.wraps(function)
    def run(**values: Any) -> None:
        force = writes and values.pop("force")
        paths = list(_paths(values))
        for _, path in paths:
            check_name_lengths(path)
        inputs = [path for name, path in paths if not {*_WRITTEN, NO_FILE} & set(marks[name])]
        for path in inputs:
            # The command itself reports missing files and folders.
            if path.exists() and not path.is_dir():
                check_regular(path)
        outputs = [path for name, path in paths if _is_written_file(path, marks[name])]
        for group_name, (group, names) in groups.items():
            values[group_name] = group(**{name: values.pop(name) for name in names})
        with protecting_files(inputs, outputs, overwrite=force):
            function(**values)

    del run.__wrapped__  # otherwise Typer would read the signature of ``function``
    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    app.command(name, epilog=f"[bold]Example:[/bold] {example}", help=inspect.getdoc(function))(run)


_WRITTEN = {OUTPUT, OUTPUT_FOLDER, OUTPUT_EITHER}
"""Marks of options that name what is written."""


def _is_written_file(path: Path, marks: Sequence[object]) -> bool:
    """Return whether a path of an option with these marks is a file to write, as far as it is known."""
    return OUTPUT in marks or (OUTPUT_EITHER in marks and not path.is_dir())


def _paths(values: Mapping[str, Any]) -> Iterator[tuple[str, Path]]:
    """Yield every path among the values of the options, with the option's name."""
    for name, value in values.items():
        entries = value if isinstance(value, list | tuple) else [value]
        for entry in entries:
            if isinstance(entry, Path):
                yield name, entry


def _option_parameters(group: type) -> list[inspect.Parameter]:
    """Return a keyword parameter for each field of a group of options."""
    hints = get_type_hints(group, include_extras=True)
    keyword = inspect.Parameter.KEYWORD_ONLY
    parameters = []
    for field in fields(group):
        default = inspect.Parameter.empty if field.default is MISSING else field.default
        hint = hints[field.name]
        parameters.append(inspect.Parameter(field.name, keyword, default=default, annotation=hint))
    return parameters


# What commands do alike: given options, choice of the device, progress bar, printed result.


def given_options(context: typer.Context) -> list[str]:
    """Return the names of the parameters that the command line gives. ``context``: parameter of the command."""
    given = []
    for name in context.params:
        source = context.get_parameter_source(name)
        if source is not None and source.name != "DEFAULT":
            given.append(name)
    return given


def choose_device(name: str | None) -> str:
    """Initialise Warp and return the device to run on.

    Raises :class:`AmiwarpError` if the named device is not available.
    """
    from amiwarp.kernels.quiet_start import start_quietly

    known = start_quietly()
    chosen = name or ("cuda:0" if "cuda:0" in known else "cpu")
    if chosen not in known:
        raise AmiwarpError(
            f"device {chosen!r} is not available; choose one of {', '.join(known)}",
            ErrorCode.DEVICE_MISSING,
        )
    return chosen


@contextlib.contextmanager
def progress(what: str, *, average_s: float = 30.0) -> Iterator[Progress]:
    """Show a progress bar on stderr and remove it at the end. Print nothing if stderr is not a terminal.

    The remaining time follows from the mean speed of the last ``average_s`` [s].
    """
    console = Console(stderr=True)
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TaskProgressColumn(),
        TimeRemainingColumn(),
    )
    with rich.progress.Progress(
        *columns,
        console=console,
        transient=True,
        disable=not console.is_terminal,
        speed_estimate_period=average_s,
    ) as bar:
        task = bar.add_task(printable(what), total=1.0)
        yield lambda what, share: bar.update(task, completed=share, description=printable(what))


def report(common: Common, data: dict[str, Any], lines: Iterable[str | Table]) -> None:
    """Print the result: ``data`` as one JSON object with ``--json``, otherwise ``lines`` as text.

    Each string in ``lines`` is printed as a single line, see :func:`printable`. In JSON, numbers that are not finite
    become null.
    """
    if common.json:
        print(json.dumps(plain(data), allow_nan=False), flush=True)
        return
    # Lines are not wrapped if stdout is a file or a pipe.
    console = Console(highlight=False, width=None if sys.stdout.isatty() else 1000)
    with console.capture() as text:
        for line in lines:
            console.print(printable(line) if isinstance(line, str) else line, markup=False)
    print("\n".join(row.rstrip() for row in text.get().splitlines()), flush=True)


def plain(value: Any) -> Any:
    """Convert ``value`` to types that JSON supports. Numbers that are not finite become None."""
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if hasattr(value, "item"):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value if isinstance(value, str | int | float | bool | None) else str(value)


def made_again(damaged: Sequence[str]) -> list[str]:
    """Return a line of text about damaged files of an earlier run that were made again; none without such files."""
    more = f", and {len(damaged) - 1:,} more" if len(damaged) > 1 else ""
    return [f"damaged, and made again: {damaged[0]}{more}"] if damaged else []


def table(rows: Iterable[tuple[str, ...]], *headings: str) -> Table:
    """Return a table without rules. Cells are shown without markup, see :func:`printable`."""
    from rich.text import Text

    grid = Table(box=None, show_header=bool(headings), pad_edge=False, header_style="bold")
    cells = [[Text(printable(cell)) for cell in row] for row in rows]
    columns = max((len(row) for row in cells), default=len(headings))
    for column in range(columns):
        if headings:
            grid.add_column(headings[column])
        else:
            grid.add_column("", style="dim" if column == 0 else None)
    for row in cells:
        grid.add_row(*row)
    return grid


def assumption_lines(texts: Iterable[str]) -> list[str]:
    """Return the lines that say what was assumed of an input, :func:`amiwarp.io.assumptions.assumed_texts`."""
    return [f"note: assumed {text}" for text in texts]


def format_notes(result: dict[str, Any]) -> list[str]:
    """Return what the format of the output has changed and left out."""
    lines = []
    if result["rounding"] is not None:
        lines.append(
            f"note: rounded to whole pixels ({result['rounding']}); {result['dropped']:,} events outside are dropped"
        )
    if result["left_out"]:
        native = result["format"] is OutputFormat.NATIVE
        who = "the new file" if native else f"{LIMITS[result['format']].label} does not hold, and"
        lines.append(f"note: {who} leaves out: {', '.join(result['left_out'])}")
    return [*lines, *time_notes(result)]


def time_notes(result: dict[str, Any]) -> list[str]:
    """Return what the format of the output has changed in the times."""
    if not result["subtracted_us"]:
        return []
    return [
        f"note: the times begin at 0: {result['subtracted_us']:,} us are subtracted, because packets in a ROS 2 bag "
        "hold up to 28 h; only the stamps of its messages hold them"
    ]
