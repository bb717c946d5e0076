"""Groups of command line options as dataclasses: each group is defined once and used by any number of commands."""

from __future__ import annotations

import functools
import inspect
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import MISSING, dataclass, fields, is_dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer

from amiwarp.choices import Seeing
from amiwarp.errors import AmiwarpError
from amiwarp.events.recording import Recording
from amiwarp.io import atomic_output as output
from amiwarp.io.camera_files import camera_from_json
from amiwarp.io.formats import check_ending
from amiwarp.io.input_files import check_regular, errors_name, text_lines
from amiwarp.io.json_files import read_json
from amiwarp.io.text import read_calib
from amiwarp.optics.camera import Camera
from amiwarp.optics.prism import FlatSide, NominalPrism, Prism, UnsizedPrism
from amiwarp.simulation.motion import EncoderModel, PrismMotion
from amiwarp.simulation.sensor import SensorModel
from amiwarp.simulation.worlds.world import WorldScene

if TYPE_CHECKING:
    from amiwarp.simulation.simulator import Simulation


# Options and texts of the command line, converted to cameras, prisms and numbers with units.

Topic = Annotated[
    str | None, typer.Option(help="Topic of a ROS bag, or camera of an HDF5 file, if the file holds several.")
]
"""Option that chooses among several streams of events."""

_in_common = partial(typer.Option, rich_help_panel="Common")
_in_camera = partial(typer.Option, rich_help_panel="Camera")
_in_prism = partial(typer.Option, rich_help_panel="Prism")
_in_sensor = partial(typer.Option, rich_help_panel="Sensor")
_in_encoder = partial(typer.Option, rich_help_panel="Encoder")


@dataclass(frozen=True)
class CameraOptions:
    """Options for the camera. They override the camera in the recording."""

    fov_deg: Annotated[float | None, _in_camera(help="Horizontal field of view of an ideal pinhole camera (deg).")] = (
        None
    )
    camera: Annotated[
        Path | None,
        _in_camera(
            help="Camera intrinsics: JSON (width, height, fx, fy, cx, cy, distortion), a calibration file, or "
            "calib.txt (fx fy cx cy k1 k2 p1 p2 k3)."
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
        camera = read_camera(self.camera, width, height)
        if fixed and (camera.width, camera.height) != (width, height):
            sizes = f"{camera.width}x{camera.height} px, the events are {width}x{height} px"
            raise AmiwarpError(f"{self.camera}: the intrinsics are for {sizes}; give the intrinsics of this camera")
        return camera


def read_camera(path: Path, width: int, height: int) -> Camera:
    """Read a camera from a JSON file, a calibration file or ``calib.txt``.

    ``width`` and ``height`` [px] are used for ``calib.txt`` only, which holds no size. Raises :class:`AmiwarpError`
    naming file and field.
    """
    if path.suffix.lower() != ".json":
        return read_calib(path, width, height)
    data = read_json(path, "a camera")
    with errors_name(path, lambda: "is not a camera file"):
        return camera_from_json(data["camera"], "camera") if "camera" in data else camera_from_json(data)


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


# Options for simulated recordings: camera, prism, motion of the prism, encoder and sensor.

MOST_SPEEDS = 1_000_000
"""Largest number of rows of a table of speeds."""


@dataclass(frozen=True)
class RigOptions:
    """Options for the camera and the prism of a simulation."""

    size: Annotated[
        str | None,
        _in_camera(
            help="Size of the camera's image (px). Default: 640x480; for 'amiwarp translate', its pictures' size.",
            metavar="WIDTHxHEIGHT",
        ),
    ] = None
    fov_deg: Annotated[
        float | None, _in_camera(help="Horizontal field of view (deg). Default: 60 if --camera is not given.")
    ] = None
    camera: Annotated[Path | None, _in_camera(help="Camera intrinsics: JSON (including the size) or calib.txt.")] = None
    apex_deg: Annotated[float, _in_prism(help="True apex angle of the prism (deg).")] = 1.0
    nominal_apex_deg: Annotated[
        float | None, _in_prism(help="Nominal apex angle stored in the recording (deg). Default: the true apex angle.")
    ] = None
    index: Annotated[float, _in_prism(help="Refractive index of the prism.")] = 1.5168
    flat_side: Annotated[FlatSide, _in_prism(help="Side that the prism's flat face is on.")] = FlatSide.SCENE
    rpm: Annotated[float, _in_prism(help="Speed of the prism (turns/min); negative: backwards.")] = 720.0
    speed: Annotated[
        Path | None, _in_prism(help="Speed over time, instead of --rpm: CSV with 'seconds,rpm' on each line.")
    ] = None
    phase_deg: Annotated[float, _in_prism(help="Azimuth of the prism at encoder angle 0 (deg).")] = 0.0
    tilt_deg: Annotated[
        str, _in_prism(help="Tilt of the prism's rotation axis about the camera's x and y axes (deg).", metavar="X,Y")
    ] = "0,0"
    cylinder_deg: Annotated[
        str,
        _in_prism(
            help="Cylinder power of the prism's tilted face, along the wedge and at 45 deg to it (deg per unit of the "
            "ray's tangent).",
            metavar="X,Y",
        ),
    ] = "0,0"
    wobble_deg: Annotated[
        str,
        _in_prism(
            help="Wobble of the prism about the rotation axis, along the wedge and across it (deg).", metavar="X,Y"
        ),
    ] = "0,0"

    def build_camera(self, default: tuple[int, int] = (640, 480)) -> Camera:
        """Return the camera. ``default`` is the size of its image [px] if no option gives one."""
        width, height = default if self.size is None else parse_size(self.size)
        if self.camera is None:
            return Camera.from_fov(width, height, math.radians(60.0 if self.fov_deg is None else self.fov_deg))
        if self.fov_deg is not None:
            raise AmiwarpError("--fov-deg and --camera both describe the camera; give one of them")
        return read_camera(self.camera, width, height)

    def build_prism(self) -> Prism:
        """Return the prism with its true parameters."""
        return Prism(math.radians(self.apex_deg), self.index, self.flat_side)

    def build_nominal(self) -> Prism:
        """Return the nominal prism that is stored with the recording."""
        nominal = self.apex_deg if self.nominal_apex_deg is None else self.nominal_apex_deg
        return replace(self.build_prism(), apex=math.radians(nominal))

    def build_motion(self) -> PrismMotion:
        """Return the prism's motion: speed, phase, tilt, cylinder power and wobble."""
        tilt, cylinder, wobble = (
            (math.radians(x), math.radians(y))
            for x, y in (
                numbers(self.tilt_deg, 2, "--tilt-deg"),
                numbers(self.cylinder_deg, 2, "--cylinder-deg"),
                numbers(self.wobble_deg, 2, "--wobble-deg"),
            )
        )
        rpm: Any = self.rpm if self.speed is None else _read_speed(self.speed)
        return PrismMotion(rpm, math.radians(self.phase_deg), tilt, cylinder, wobble)


def parse_size(text: str) -> tuple[int, int]:
    """Convert a size such as ``640x480``. Raises :class:`AmiwarpError` if the text is not a size."""
    width, x, height = text.partition("x")
    if not (x and width.isdigit() and height.isdigit()):
        raise AmiwarpError(f"--size {text!r} is not a size; write it like 640x480")
    return int(width), int(height)


def _read_speed(path: Path) -> list[tuple[float, ...]]:
    rows = []
    for number, line in text_lines(path):
        if line.strip() and not line.startswith("#"):
            rows.append(numbers(line, 2, f"{path}: line {number}"))
        if len(rows) > MOST_SPEEDS:
            raise AmiwarpError(f"{path}: has over {MOST_SPEEDS} speeds; give fewer, which are interpolated")
    return rows


@dataclass(frozen=True)
class SensorOptions:
    """Options for the sensor's imperfections. Defaults are those of ``amiwarp.SensorModel``."""

    ideal: Annotated[bool, _in_sensor("--ideal", help="Simulate a sensor without noise, mismatch and latency.")] = False
    sensor: Annotated[
        str | None,
        _in_sensor(
            help="Known camera whose sensor is simulated: dvxplorer, davis346 or gen4. Other options change it."
        ),
    ] = None
    contrast_on: Annotated[float | None, _in_sensor(help="ON threshold: rise of log intensity.")] = None
    contrast_off: Annotated[float | None, _in_sensor(help="OFF threshold: fall of log intensity.")] = None
    mismatch: Annotated[
        float | None, _in_sensor(help="Relative standard deviation of the thresholds between pixels.")
    ] = None
    refractory_us: Annotated[float | None, _in_sensor(help="Refractory period (us).")] = None
    latency_us: Annotated[float | None, _in_sensor(help="Mean latency of the time stamps (us).")] = None
    latency_jitter_us: Annotated[float | None, _in_sensor(help="Standard deviation of the latency (us).")] = None
    leak_hz: Annotated[float | None, _in_sensor(help="Rate of leak events per pixel (1/s).")] = None
    shot_noise_hz: Annotated[float | None, _in_sensor(help="Rate of random events per pixel (1/s).")] = None
    hot_fraction: Annotated[float | None, _in_sensor(help="Fraction of hot pixels (0 to 1).")] = None
    hot_hz: Annotated[float | None, _in_sensor(help="Additional event rate of a hot pixel (1/s).")] = None
    cutoff_hz: Annotated[
        float | None,
        _in_sensor(help="Bandwidth of the photoreceptor at white (Hz), proportional to the light; 0: unlimited."),
    ] = None
    shot_noise_dark: Annotated[
        float | None, _in_sensor(help="Rate of random events in the dark, relative to that at white (1 or more).")
    ] = None
    leak_jitter_fraction: Annotated[
        float | None, _in_sensor(help="Relative standard deviation of the time between leak events.")
    ] = None
    noise_rate_cov_decades: Annotated[
        float | None,
        _in_sensor(help="Spread of leak and random-event rates between pixels (standard deviation of log10)."),
    ] = None
    row_us: Annotated[
        float | None,
        _in_sensor(help="Time to read out a row (us), one row after the other; 0: events are read out at once."),
    ] = None
    bus_rate_mev_s: Annotated[
        float | None, _in_sensor(help="Largest rate that the bus transmits (million events/s); 0: unlimited.")
    ] = None
    bus_queue: Annotated[
        float | None, _in_sensor(help="Number of events that wait for the bus; further events are lost.")
    ] = None

    def build(self) -> SensorModel:
        """Return the sensor model that the options describe."""
        from amiwarp.simulation.sensor import SensorModel

        if self.ideal and self.sensor is not None:
            raise AmiwarpError("--ideal and --sensor both describe the sensor; give one of them")
        given: dict[str, Any] = {name: value for name, value in vars(self).items() if value is not None}
        ideal, preset = given.pop("ideal"), given.pop("sensor", None)
        sensor = SensorModel.preset(preset) if preset is not None else SensorModel()
        return replace(SensorModel.ideal() if ideal else sensor, **given)


@dataclass(frozen=True)
class EncoderModelOptions:
    """Options for the encoder's imperfections. Defaults are those of ``amiwarp.EncoderModel``."""

    counts_per_turn: Annotated[int | None, _in_encoder(help="Counts per turn; 0: no rounding to counts.")] = None
    rate_hz: Annotated[float | None, _in_encoder(help="Sample rate (Hz).")] = None
    jitter_us: Annotated[float | None, _in_encoder(help="Standard deviation of the sample times (us).")] = None
    clock_offset_us: Annotated[
        float | None, _in_encoder(help="Encoder clock minus camera clock (us); stored in the ground truth only.")
    ] = None
    dropouts_hz: Annotated[float | None, _in_encoder(help="Rate of drop-outs (1/s).")] = None
    dropout_us: Annotated[
        float | None, _in_encoder(help="Length of a drop-out, during which all samples are lost (us).")
    ] = None

    def build(self) -> EncoderModel:
        """Return the encoder model that the options describe."""
        given: dict[str, Any] = {name: value for name, value in vars(self).items() if value is not None}
        if self.counts_per_turn == 0:
            given["counts_per_turn"] = None
        return EncoderModel(**given)


# Command-line options for simulated worlds: world, camera trajectory, and ground truth to record and draw.

_in_world = partial(typer.Option, rich_help_panel="World")


@dataclass(frozen=True)
class WorldOptions:
    """Options of a simulation in a three-dimensional world instead of a picture."""

    world: Annotated[
        str | None,
        _in_world(
            help="Simulate a 3-D world instead of a picture: room, desk, corridor, street, ball, person, or a world "
            "file (.toml, .json).",
            metavar="NAME|FILE",
        ),
    ] = None
    trajectory: Annotated[
        str | None,
        _in_world(
            help="Camera motion in the world: still, handheld, fast, or a file of poses (.txt in TUM format, .csv). "
            "Default: the trajectory in the world file, or handheld for a named world.",
            metavar="NAME|FILE",
        ),
    ] = None
    no_prism: Annotated[
        bool,
        _in_world(
            "--no-prism",
            help="Simulate the same scene, sensor and seed with a plain event camera without a prism. The recording "
            "then has no encoder.",
        ),
    ] = False
    seeing: Annotated[
        Seeing | None,
        _in_world(
            help="How the light of each pixel is computed: maps (look-up in pre-rendered pictures of the world) or "
            "rays (ray casting through the prism: exact, but slow on a CPU). Default: maps."
        ),
    ] = None
    motion_px: Annotated[
        float | None,
        _in_world(
            help="Largest motion of the image between two renderings of the world, 0.01 to 2 (px). A smaller value is "
            "more accurate and slower. Default: 0.5."
        ),
    ] = None
    truth_hz: Annotated[
        float | None,
        _in_world(
            help="Rate at which depth, normals, instances, optical flow and intensity of all pixels are recorded "
            "(1/s). Default: not recorded."
        ),
    ] = None
    preview: Annotated[
        Path | None,
        _in_world(
            help="Figure to write (.png): the view of the camera in the middle of the recording, with and without the "
            "prism, with depth and optical flow.",
            metavar="<path>",
        ),
        OUTPUT,
    ] = None

    def check(self) -> None:
        """Raise :class:`AmiwarpError` if a given option does not apply, or two options are incompatible."""
        given = {"--trajectory": self.trajectory, "--seeing": self.seeing, "--motion-px": self.motion_px,
                 "--truth-hz": self.truth_hz, "--preview": self.preview}  # fmt: skip
        if self.world is None:
            for name, value in given.items():
                if value is not None:
                    raise AmiwarpError(f"{name} applies to a world; give --world, or remove {name}")
        if self.motion_px is not None and self.seeing is Seeing.RAYS:
            raise AmiwarpError("--motion-px applies to maps; give --seeing maps, or remove --motion-px")
        if self.preview is not None:
            check_ending(self.preview, "previews are written", [".png"])

    def build_scene(self, duration_s: float, *, seed: int, blur: float) -> WorldScene:
        """Return the world and the camera's trajectory. ``blur``: standard deviation of the optical blur [px]."""
        from amiwarp.simulation.worlds.world import WorldScene
        from amiwarp.simulation.worlds.world_files import open_world

        world, trajectory = open_world(self.world or "", self.trajectory, seed=seed, duration_s=duration_s)
        given = {name: value for name in ("seeing", "motion_px") if (value := getattr(self, name)) is not None}
        return WorldScene(world, trajectory, blur=blur, **given)

    def draw_preview(self, simulation: Simulation) -> None:
        """Write the preview figure if ``--preview`` is given."""
        if self.preview is None:
            return
        from amiwarp.plotting.figures import draw_preview
        from amiwarp.simulation.worlds.world_truth import TruthRenderer

        draw_preview(self.preview, TruthRenderer(simulation).at(simulation.duration_us // 2))
