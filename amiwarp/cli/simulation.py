"""Simulated recordings: ``amiwarp simulate`` and ``amiwarp translate``."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from amiwarp.choices import Optic, Seeing
from amiwarp.cli import common as cli
from amiwarp.errors import AmiwarpError
from amiwarp.events.recording import Recording
from amiwarp.io import open_recording
from amiwarp.io.camera_files import load_camera
from amiwarp.io.files import text_lines
from amiwarp.io.formats import check_ending
from amiwarp.io.pixel_map import PixelMap
from amiwarp.optics.camera import Camera
from amiwarp.optics.mirror import LARGEST_INCIDENCE, LARGEST_TILT
from amiwarp.optics.prism import FlatSide, Plate, Prism
from amiwarp.optics.vibration import LARGEST_AMPLITUDE
from amiwarp.simulation.description import CameraMotion, EncoderModel, Mirror, Moved, PrismMotion, Scene, Vibration
from amiwarp.simulation.sensor_model import SensorModel
from amiwarp.simulation.worlds.world import BLUR_PX, WorldScene

if TYPE_CHECKING:
    from amiwarp.simulation.simulator import Simulation


# Options for simulated recordings: camera, prism, motion of the prism, encoder and sensor.

_in_sensor = partial(typer.Option, rich_help_panel="Sensor")

MOST_SPEEDS = 1_000_000
"""Largest number of rows of a table of speeds."""


@dataclass(frozen=True)
class RigOptions:
    """Options for the camera and the prism of a simulation."""

    size: Annotated[
        str | None,
        cli.in_camera(
            help="Size of the camera's image (px). Default: 640x480; for 'amiwarp translate', its pictures' size.",
            metavar="WIDTHxHEIGHT",
        ),
    ] = None
    fov_deg: Annotated[
        float | None, cli.in_camera(help="Horizontal field of view (deg). Default: 60 if --camera is not given.")
    ] = None
    camera: Annotated[
        Path | None, cli.in_camera(help="Camera intrinsics: JSON or YAML (including the size), or calib.txt.")
    ] = None
    apex_deg: Annotated[float | None, cli.in_prism(help="True apex angle of the prism (deg). Default: 1.")] = None
    nominal_apex_deg: Annotated[
        float | None,
        cli.in_prism(help="Nominal apex angle stored in the recording (deg). Default: the true apex angle."),
    ] = None
    index: Annotated[float | None, cli.in_prism(help="Refractive index of the glass. Default: 1.5168.")] = None
    flat_side: Annotated[
        FlatSide | None, cli.in_prism(help="Side that the prism's flat face is on. Default: scene.")
    ] = None
    rpm: Annotated[
        float | None, cli.in_prism(help="Speed of the prism (turns/min); negative: backwards. Default: 720.")
    ] = None
    speed: Annotated[
        Path | None, cli.in_prism(help="Speed over time, instead of --rpm: CSV with 'seconds,rpm' on each line.")
    ] = None
    phase_deg: Annotated[
        float | None,
        cli.in_prism(
            help="Azimuth of the prism at encoder angle 0, or phase of a vibration at the start (deg). Default: 0."
        ),
    ] = None
    tilt_deg: Annotated[
        str | None,
        cli.in_prism(
            help="Tilt of the prism's rotation axis about the camera's x and y axes (deg). Default: 0,0.", metavar="X,Y"
        ),
    ] = None
    cylinder_deg: Annotated[
        str | None,
        cli.in_prism(
            help="Cylinder power of the prism's tilted face, along the wedge and at 45 deg to it (deg per unit of the "
            "ray's tangent). Default: 0,0.",
            metavar="X,Y",
        ),
    ] = None
    wobble_deg: Annotated[
        str | None,
        cli.in_prism(
            help="Wobble of the prism about the rotation axis, along the wedge and across it (deg). Default: 0,0.",
            metavar="X,Y",
        ),
    ] = None
    second_apex_deg: Annotated[
        float | None, cli.in_prism(help="Apex angle of a second prism behind the first, a Risley pair (deg).")
    ] = None
    second_rpm: Annotated[
        float | None, cli.in_prism(help="Speed of the second prism (turns/min). Default: that of the first, backwards.")
    ] = None
    second_phase_deg: Annotated[
        float | None, cli.in_prism(help="Azimuth of the second prism at encoder angle 0 (deg). Default: 0.")
    ] = None

    def build_camera(self, default: tuple[int, int] = (640, 480)) -> Camera:
        """Return the camera. ``default`` is the size of its image [px] if no option gives one."""
        width, height = default if self.size is None else cli.parse_size(self.size)
        if self.camera is None:
            fov = cli.fov_from(60.0 if self.fov_deg is None else self.fov_deg, "--fov-deg")
            return Camera.from_fov(width, height, fov)
        if self.fov_deg is not None:
            raise AmiwarpError("--fov-deg and --camera both describe the camera; give one of them")
        if self.size is not None:
            raise AmiwarpError("--size and --camera both give the size of the image; leave --size out")
        return load_camera(self.camera, (width, height))

    def build_prism(self) -> Prism:
        """Return the prism with its true parameters."""
        apex = cli.apex_from(1.0 if self.apex_deg is None else self.apex_deg, "--apex-deg")
        given: dict[str, Any] = {"index": self.index, "flat_side": self.flat_side}
        prism = Prism(apex, **{name: value for name, value in given.items() if value is not None})
        if self.second_apex_deg is not None:
            return replace(prism, second=replace(prism, apex=cli.apex_from(self.second_apex_deg, "--second-apex-deg")))
        if (self.second_rpm, self.second_phase_deg) != (None, None):
            raise AmiwarpError("--second-rpm and --second-phase-deg describe a second prism; give --second-apex-deg")
        return prism

    def build_nominal(self) -> Prism:
        """Return the nominal prism that is stored with the recording."""
        prism = self.build_prism()
        if self.nominal_apex_deg is None:
            return prism
        return replace(prism, apex=cli.apex_from(self.nominal_apex_deg, "--nominal-apex-deg"))

    def build_motion(self) -> PrismMotion:
        """Return the prism's motion: speed, phase, tilt, cylinder power and wobble."""
        if self.rpm is not None and self.speed is not None:
            raise AmiwarpError("--rpm and --speed both give the prism's speed; give one of them")
        tilt, cylinder, wobble = (
            cli.angles(given or "0,0", 2, name, math.pi / 2.0)
            for given, name in (
                (self.tilt_deg, "--tilt-deg"),
                (self.cylinder_deg, "--cylinder-deg"),
                (self.wobble_deg, "--wobble-deg"),
            )
        )
        rpm = _read_speed(self.speed) if self.speed is not None else 720.0 if self.rpm is None else self.rpm
        second = None
        if self.second_apex_deg is not None:
            backwards = -rpm if isinstance(rpm, float) else rpm * (1.0, -1.0)
            second = PrismMotion(
                backwards if self.second_rpm is None else self.second_rpm,
                cli.radians(self.second_phase_deg or 0.0, "--second-phase-deg"),
            )
        return PrismMotion(rpm, self.phase, tilt, cylinder, wobble, second)

    @property
    def phase(self) -> float:
        """Azimuth of the prism at encoder angle 0, or phase of a vibration [rad]."""
        return cli.radians(self.phase_deg or 0.0, "--phase-deg")


def _read_speed(path: Path) -> NDArray[np.float64]:
    """Return a table of speeds, with rows (time [s], speed [turns/min])."""
    rows = []
    for number, line in text_lines(path):
        if line.strip() and not line.startswith("#"):
            rows.append(cli.numbers(line, 2, f"{path}: line {number}"))
        if len(rows) > MOST_SPEEDS:
            raise AmiwarpError(f"{path}: has over {MOST_SPEEDS} speeds; give fewer, which are interpolated")
    table = np.array(rows)
    try:
        PrismMotion(table)
    except AmiwarpError as error:
        raise AmiwarpError(f"{path}: {error}") from error
    return table


@dataclass(frozen=True)
class OpticOptions:
    """Options for what moves the image, and for a plate."""

    optic: Annotated[
        Optic,
        cli.in_prism(
            help="What moves the image: wedge, plate (tilted and plane-parallel; needs --world), mirror (with two "
            "tilts), or vibration (the camera itself, without glass and encoder)."
        ),
    ] = Optic.WEDGE
    thickness_mm: Annotated[float | None, cli.in_prism(help="Thickness of the plate (mm). Default: 10.")] = None
    plate_tilt_deg: Annotated[
        float | None,
        cli.in_prism(help="Angle between the normal of the plate and the rotation axis (deg). Default: 45."),
    ] = None

    def build_plate(self, index: float | None) -> Plate:
        """Return the plate with its true parameters."""
        return Plate(
            cli.thickness_from(10.0 if self.thickness_mm is None else self.thickness_mm),
            cli.plate_tilt_from(45.0 if self.plate_tilt_deg is None else self.plate_tilt_deg),
            *(() if index is None else (index,)),
        )


_in_optic = partial(typer.Option, rich_help_panel="Vibration")


@dataclass(frozen=True)
class VibrationOptions:
    """Options for the vibration of a camera without a prism."""

    hz: Annotated[float | None, _in_optic(help="Frequency of the vibration (Hz). Default: 100.")] = None
    amplitude_deg: Annotated[
        float | None, _in_optic(help="Radius of the vibration's forward circle (deg). Default: 0.4.")
    ] = None
    backward_deg: Annotated[
        str | None,
        _in_optic(
            help="Rotation about the camera's x and y axes by the backward circle at the start (deg): with it, the "
            "vibration is an ellipse, or a line if both circles are equally large. Default: 0,0.",
            metavar="X,Y",
        ),
    ] = None
    roll_deg: Annotated[
        str | None,
        _in_optic(
            help="Rotation about the optical axis: factors of cosine and sine (deg). Default: 0,0.", metavar="C,S"
        ),
    ] = None
    second_deg: Annotated[
        str | None,
        _in_optic(
            help="Rotation about x and y by the second harmonic at the start (deg): its forward and its backward "
            "circle. Default: 0,0,0,0.",
            metavar="X,Y,X,Y",
        ),
    ] = None

    def build(self, rig: RigOptions) -> Vibration:
        """Return the vibration."""
        bx, by = cli.angles(self.backward_deg or "0,0", 2, "--backward-deg", LARGEST_AMPLITUDE)
        rc, rs = cli.angles(self.roll_deg or "0,0", 2, "--roll-deg", LARGEST_AMPLITUDE)
        fx, fy, sx, sy = cli.angles(self.second_deg or "0,0,0,0", 4, "--second-deg", LARGEST_AMPLITUDE)
        degrees = 0.4 if self.amplitude_deg is None else self.amplitude_deg
        amplitude = cli.radians(degrees, "--amplitude-deg", 0.0, LARGEST_AMPLITUDE)
        hz = 100.0 if self.hz is None else self.hz
        return Vibration(hz, amplitude, rig.phase, (bx, by), (rc, rs), (fx, fy), (sx, sy))


_in_mirror = partial(typer.Option, rich_help_panel="Mirror")


@dataclass(frozen=True)
class MirrorOptions:
    """Options for a mirror with two tilts in front of the camera."""

    mirror_hz: Annotated[
        str | None, _in_mirror(help="Frequencies of both tilts (Hz). Default: 60,77.", metavar="F1,F2")
    ] = None
    mirror_deg: Annotated[
        str | None,
        _in_mirror(
            help="Amplitudes of both tilts, seen along the optical axis (deg). Default: 0.5,0.5.", metavar="A1,A2"
        ),
    ] = None
    mirror_phase_deg: Annotated[
        str | None, _in_mirror(help="Phases of both tilts at the start (deg). Default: 0,0.", metavar="P1,P2")
    ] = None
    mirror_direction_deg: Annotated[
        str | None,
        _in_mirror(
            help="Directions in the image along which both tilts move it, from x towards y (deg). Default: 0,90.",
            metavar="D1,D2",
        ),
    ] = None
    fold_deg: Annotated[
        float | None,
        _in_mirror(help="Direction in the image in which the mirror folds the optical axis (deg). Default: 0, x."),
    ] = None
    incidence_deg: Annotated[
        float | None, _in_mirror(help="Angle of incidence of the optical axis on the mirror (deg). Default: 45.")
    ] = None

    def build(self) -> Mirror:
        """Return the mirror."""
        amplitude = cli.angles(self.mirror_deg or "0.5,0.5", 2, "--mirror-deg", LARGEST_TILT, low=0.0)
        phase = cli.angles(self.mirror_phase_deg or "0,0", 2, "--mirror-phase-deg")
        direction = cli.angles(self.mirror_direction_deg or "0,90", 2, "--mirror-direction-deg")
        first, second = cli.numbers(self.mirror_hz or "60,77", 2, "--mirror-hz")
        incidence = 45.0 if self.incidence_deg is None else self.incidence_deg
        return Mirror(
            (first, second), amplitude, phase, direction,
            fold=cli.radians(self.fold_deg or 0.0, "--fold-deg"),
            incidence=cli.radians(incidence, "--incidence-deg", 0.0, LARGEST_INCIDENCE),
        )  # fmt: skip


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
        float | None, _in_sensor(help="Relative standard deviation of the leak rate (0 to 0.3).")
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
        if self.ideal and self.sensor is not None:
            raise AmiwarpError("--ideal and --sensor both describe the sensor; give one of them")
        given: dict[str, Any] = {name: value for name, value in vars(self).items() if value is not None}
        ideal, preset = given.pop("ideal"), given.pop("sensor", None)
        sensor = SensorModel.preset(preset) if preset is not None else SensorModel()
        return replace(SensorModel.ideal() if ideal else sensor, **given)


@dataclass(frozen=True)
class EncoderModelOptions:
    """Options for the encoder's imperfections. Defaults are those of ``amiwarp.EncoderModel``."""

    counts_per_turn: Annotated[int | None, cli.in_encoder(help="Counts per turn; 0: no rounding to counts.")] = None
    rate_hz: Annotated[float | None, cli.in_encoder(help="Sample rate (Hz).")] = None
    jitter_us: Annotated[float | None, cli.in_encoder(help="Standard deviation of the sample times (us).")] = None
    clock_offset_us: Annotated[
        float | None, cli.in_encoder(help="Encoder clock minus camera clock (us); stored in the ground truth only.")
    ] = None
    dropouts_hz: Annotated[float | None, cli.in_encoder(help="Rate of drop-outs (1/s).")] = None
    dropout_us: Annotated[
        float | None, cli.in_encoder(help="Length of a drop-out, during which all samples are lost (us).")
    ] = None
    encoder_error_deg: Annotated[
        str | None,
        cli.in_encoder(
            help="Error of the angle that repeats every turn: factors of its cosine and sine, and of those of twice "
            "the angle (deg). An eccentric disc causes the first two. Default: 0,0,0,0.",
            metavar="C1,S1,C2,S2",
        ),
    ] = None

    def build(self) -> EncoderModel:
        """Return the encoder model that the options describe."""
        given: dict[str, Any] = {name: value for name, value in vars(self).items() if value is not None}
        error = given.pop("encoder_error_deg", "0,0,0,0")
        given["harmonics"] = cli.angles(error, 4, "--encoder-error-deg")
        if self.counts_per_turn == 0:
            given["counts_per_turn"] = None
        return EncoderModel(**given)


def _names(group: type) -> list[str]:
    return [field.name for field in fields(group)]


_APPLY = {
    **dict.fromkeys(_names(RigOptions), (Optic.WEDGE,)),
    **dict.fromkeys(("index", "rpm", "speed"), (Optic.WEDGE, Optic.PLATE)),
    "phase_deg": (Optic.WEDGE, Optic.PLATE, Optic.VIBRATION),
    **dict.fromkeys(("size", "fov_deg", "camera", "optic"), tuple(Optic)),
    **dict.fromkeys(("thickness_mm", "plate_tilt_deg"), (Optic.PLATE,)),
    **dict.fromkeys(_names(VibrationOptions), (Optic.VIBRATION,)),
    **dict.fromkeys(_names(MirrorOptions), (Optic.MIRROR,)),
    **dict.fromkeys(_names(EncoderModelOptions), (Optic.WEDGE, Optic.PLATE, Optic.MIRROR)),
}
"""Optics that each option applies to."""


def build_optic(
    optic: OpticOptions, rig: RigOptions, vibration: VibrationOptions, mirror: MirrorOptions,
    encoder: EncoderModelOptions,
) -> Prism | Plate | Moved:  # fmt: skip
    """Return what moves the image. Raises :class:`AmiwarpError` for options of another optic."""
    for name, value in (pair for group in (optic, rig, vibration, mirror, encoder) for pair in vars(group).items()):
        if value is not None and optic.optic not in (kinds := _APPLY[name]):
            option = f"--{name.replace('_', '-')}"
            which = " or ".join(f"a {kind.value}" for kind in kinds)
            raise AmiwarpError(f"{option} applies to {which}; give --optic {kinds[0].value}, or remove {option}")
    if optic.optic is Optic.VIBRATION:
        return vibration.build(rig)
    if optic.optic is Optic.MIRROR:
        return mirror.build()
    return rig.build_prism() if optic.optic is Optic.WEDGE else optic.build_plate(rig.index)


# Options for simulated worlds: world, camera trajectory, and ground truth to record and draw.

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
        cli.OUTPUT,
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
        from amiwarp.simulation.worlds.world_files import open_world

        world, trajectory = open_world(self.world or "", self.trajectory, seed=seed, duration_s=duration_s)
        given = {name: value for name in ("seeing", "motion_px") if (value := getattr(self, name)) is not None}
        return WorldScene(world, trajectory, blur=blur, **given)

    def draw_preview(self, simulation: Simulation) -> None:
        """Write the preview figure if ``--preview`` is given."""
        if self.preview is None:
            return
        from amiwarp.plotting.figures import draw_preview
        from amiwarp.simulation.simulator import TruthRenderer

        draw_preview(self.preview, TruthRenderer(simulation).at(simulation.duration_us // 2))


# ``amiwarp simulate``: simulated recording of a picture or a world, with its ground truth.

AVERAGE_S = 600.0
"""Time over which the speed of a simulation is averaged to predict its end [s]. A block of a slow world may take
minutes."""


_in_scene = partial(typer.Option, rich_help_panel="Scene")


@dataclass(frozen=True)
class SceneOptions:
    """Options for the picture and the camera's rotation in front of it."""

    scene_fov_deg: Annotated[
        float | None,
        _in_scene(help="Horizontal extent of the picture (deg). Default: it fills the field of view at all times."),
    ] = None
    blur_px: Annotated[float, _in_scene(help="Standard deviation of the optical blur (px).")] = BLUR_PX

    rotate_deg_s: Annotated[
        str, _in_scene(help="Angular velocity of the camera about its x, y and z axes (deg/s).", metavar="X,Y,Z")
    ] = "0,0,0"

    @property
    def rates(self) -> tuple[float, ...]:
        """Angular velocity of the camera [rad/s]."""
        return tuple(math.radians(v) for v in cli.numbers(self.rotate_deg_s, 3, "--rotate-deg-s"))

    @property
    def fov(self) -> float | None:
        """Horizontal angle that the picture spans [rad], or None for the default."""
        return None if self.scene_fov_deg is None else cli.fov_from(self.scene_fov_deg, "--scene-fov-deg")


def run_simulate(
    out: Annotated[Path, typer.Argument(help="Recording to write (.h5)."), cli.OUTPUT],
    *,
    picture: Annotated[Path | None, typer.Option(help="Picture of the scene: JPEG, PNG, TIFF ...")] = None,
    duration: Annotated[float, typer.Option(help="Length of the recording (s).")] = 1.0,
    world: WorldOptions,
    scene: SceneOptions,
    vibration: VibrationOptions,
    mirror: MirrorOptions,
    optic: OpticOptions,
    rig: RigOptions,
    sensor: SensorOptions,
    pixels: Annotated[
        Path | None,
        _in_sensor(help="Thresholds of every pixel, hot and dead pixels: map from 'amiwarp pixels' (.npz)."),
    ] = None,
    encoder: EncoderModelOptions,
    common: cli.Common,
) -> None:
    """Simulate the recording of a picture or a world by an event camera behind the prism, with its ground truth.

    A picture lies at infinity. A world is three-dimensional, and the camera moves through it: give --world room.
    With --optic vibration, the camera vibrates in place of the prism; with --optic mirror, it looks at a mirror.
    """
    from amiwarp.simulation.simulator import Simulation

    if (picture is None) == (world.world is None):
        raise typer.BadParameter("give one of them", param_hint="--picture, --world")
    world.check()
    device = cli.choose_device(common.device)
    simulation = Simulation(
        _scene(picture, world, scene, duration, common.seed),
        rig.build_camera(),
        build_optic(optic, rig, vibration, mirror, encoder),
        duration,
        motion=rig.build_motion(),
        camera_motion=CameraMotion(scene.rates),
        sensor=sensor.build(),
        pixels=None if pixels is None else PixelMap.load(pixels),
        encoder_model=encoder.build(),
        nominal_prism=rig.build_nominal() if optic.optic is Optic.WEDGE else None,
        seed=common.seed,
        device=device,
    )
    world.draw_preview(simulation)
    write(simulation.without_prism() if world.no_prism else simulation, out, common, truth_hz=world.truth_hz)


def _scene(
    picture: Path | None, world: WorldOptions, scene: SceneOptions, duration: float, seed: int
) -> Scene | WorldScene:
    """Return the scene of the simulation: a picture or a world."""

    if picture is not None:
        return Scene.from_picture(picture, fov=scene.fov, blur=scene.blur_px)
    if scene.fov is not None or any(scene.rates):
        raise AmiwarpError("--scene-fov-deg and --rotate-deg-s apply to a picture; give --trajectory for a world")
    return world.build_scene(duration, seed=seed, blur=scene.blur_px)


def write(simulation: Simulation, out: Path, common: cli.Common, *, truth_hz: float | None = None) -> None:
    """Run a simulation, write its recording to ``out`` and print the result."""
    began = time.perf_counter()
    with cli.progress("simulating", average_s=AVERAGE_S) as advance:
        simulation.write(out, truth_hz=truth_hz, progress=advance)
    seconds = time.perf_counter() - began
    data: dict[str, Any] = {
        "file": str(out),
        "events": len(open_recording(out).events),
        "duration_s": simulation.duration_s,
        "seconds": seconds,
        "times_real_time": seconds / simulation.duration_s,
        "device": simulation.device,
    }
    cli.report(common, data, [_line(data)])


def _line(d: dict[str, Any]) -> str:
    rate = d["events"] / max(d["seconds"], 1e-9) / 1e6
    return (
        f"{d['file']}: {d['events']:,} events, {d['duration_s']:.6g} s simulated in {d['seconds']:.2f} s "
        f"({d['times_real_time']:.3g} x real time, {rate:.3g} Mev/s on {d['device']})"
    )


# ``amiwarp translate``: conversion of pictures and of recordings without a prism to recordings through the prism.


def run_translate(
    source: Annotated[
        Path,
        typer.Argument(
            help="Video, folder of pictures (with times.csv: file, t_us) or .npy stack; or a recording of an event "
            "camera without a prism."
        ),
    ],
    out: Annotated[Path, typer.Argument(help="Recording to write (.h5)."), cli.OUTPUT],
    *,
    events: Annotated[
        Path | None, typer.Option(help="Recording of the events between the pictures, by the same camera.")
    ] = None,
    dataset: Annotated[
        str | None, typer.Option(help="Data set that SOURCE belongs to: n-caltech101 or mvsec.", metavar="NAME")
    ] = None,
    interpolation: Annotated[
        str,
        typer.Option(
            help="Light between two pictures: motion (it follows the motion), blend (it fades over), or auto "
            "(motion if pictures move by more than a pixel).",
            metavar="auto|motion|blend",
        ),
    ] = "auto",
    fps: Annotated[
        float | None,
        typer.Option(
            help="Pictures per second. Needed for a stack or a folder without times.csv; overrides the rate of a video."
        ),
    ] = None,
    picture_fov_deg: Annotated[
        float | None,
        typer.Option(help="Horizontal extent of the pictures (deg). Default: they fill the view through the prism."),
    ] = None,
    blur_px: Annotated[
        float,
        typer.Option(
            help="Standard deviation of the optical blur (px). 0 for pictures of a camera with the same resolution, "
            "which has blurred them already."
        ),
    ] = BLUR_PX,
    duration: Annotated[
        float | None, typer.Option(help="Length of the recording (s). Default: length of the source.")
    ] = None,
    rig: RigOptions,
    sensor: SensorOptions,
    encoder: EncoderModelOptions,
    layout: cli.LayoutOptions,
    common: cli.Common,
) -> None:
    """Simulate the recording of an event camera behind the prism from a video, pictures, or a plain event recording.

    Pictures alone, pictures with --events, or the events of a recording alone tell the brightness of the scene. The
    camera has the size of the source unless --size or --camera gives another one.
    """
    from amiwarp.translation.sources import DataSet, Interpolation
    from amiwarp.translation.translator import translation, translator_input
    from amiwarp.validation import choice

    device = cli.choose_device(common.device)
    name = None if dataset is None else choice(DataSet, dataset, "--dataset")
    way = choice(Interpolation, interpolation, "--interpolation")
    plain: Path | Recording = source
    between: Path | Recording | None = events
    if layout.given():
        opened = open_recording(source if events is None else events, **layout.given())
        plain, between = (opened, None) if events is None else (source, opened)
    with cli.progress("reading") as advance:
        given = translator_input(
            plain, events=between, dataset=name, interpolation=way, fps=fps, device=device, progress=advance
        )
    if duration is None and not given.duration_us:
        raise AmiwarpError(f"{source}: does not state its duration; give --duration")
    chosen = rig.size is None and rig.fov_deg is None and rig.camera is None
    simulation = translation(
        given,
        rig.build_prism(),
        fov=None if picture_fov_deg is None else cli.fov_from(picture_fov_deg, "--picture-fov-deg"),
        blur=blur_px,
        camera=None if chosen else rig.build_camera(given.frames.size),
        duration_s=duration,
        motion=rig.build_motion(),
        sensor=sensor.build(),
        encoder=encoder.build(),
        nominal_prism=rig.build_nominal(),
        seed=common.seed,
        device=device,
    )
    write(simulation, out, common)
