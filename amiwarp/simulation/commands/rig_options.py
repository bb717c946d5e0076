"""Options for simulated recordings: camera, prism, motion of the prism, encoder and sensor."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from amiwarp.cli import common as cli
from amiwarp.cli.record_options import with_options_of
from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.io.camera_files import load_camera
from amiwarp.io.inputs import text_lines
from amiwarp.optics.camera import Camera
from amiwarp.optics.models.mirror import LARGEST_INCIDENCE, LARGEST_TILT
from amiwarp.optics.models.steerer import LARGEST_DEFLECTION
from amiwarp.optics.models.vibration import LARGEST_AMPLITUDE
from amiwarp.optics.prism import FlatSide, Plate, Prism
from amiwarp.simulation.choices import Optic
from amiwarp.simulation.encoder_model import EncoderModel
from amiwarp.simulation.motion import Mirror, Moved, PrismMotion, Steerer, Vibration
from amiwarp.simulation.sensor_model import SensorModel

sensor_option = partial(typer.Option, rich_help_panel="Sensor")
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
        float | None,
        cli.in_camera(help="Horizontal field of view (deg). Default: 60 if --camera is not given."),
    ] = None
    camera: Annotated[
        Path | None,
        cli.in_camera(help="Camera intrinsics: JSON or YAML (including the size), or calib.txt."),
    ] = None
    apex_deg: Annotated[
        float | None, cli.in_prism(help="True apex angle of the prism (deg). Default: 1.")
    ] = None
    nominal_apex_deg: Annotated[
        float | None,
        cli.in_prism(
            help="Nominal apex angle stored in the recording (deg). Default: the true apex angle."
        ),
    ] = None
    index: Annotated[
        float | None, cli.in_prism(help="Refractive index of the glass. Default: 1.5168.")
    ] = None
    flat_side: Annotated[
        FlatSide | None, cli.in_prism(help="Side that the prism's flat face is on. Default: scene.")
    ] = None
    rpm: Annotated[
        float | None,
        cli.in_prism(help="Speed of the prism (turns/min); negative: backwards. Default: 720."),
    ] = None
    speed: Annotated[
        Path | None,
        cli.in_prism(
            help="Speed over time, instead of --rpm: CSV with 'seconds,rpm' on each line."
        ),
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
            help="Tilt of the prism's rotation axis about the camera's x and y axes (deg). Default: 0,0.",
            metavar="X,Y",
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
        float | None,
        cli.in_prism(help="Apex angle of a second prism behind the first, a Risley pair (deg)."),
    ] = None
    second_rpm: Annotated[
        float | None,
        cli.in_prism(
            help="Speed of the second prism (turns/min). Default: the first prism's, backwards."
        ),
    ] = None
    second_phase_deg: Annotated[
        float | None,
        cli.in_prism(help="Azimuth of the second prism at encoder angle 0 (deg). Default: 0."),
    ] = None

    def build_camera(self, default: tuple[int, int] = (640, 480)) -> Camera:
        """Return the camera. ``default`` is the size of its image [px] if no option gives one."""
        width, height = default if self.size is None else cli.parse_size(self.size)
        if self.camera is None:
            fov = cli.fov_from(60.0 if self.fov_deg is None else self.fov_deg, "--fov-deg")
            return Camera.from_fov(width, height, fov)
        if self.fov_deg is not None:
            raise AmiwarpError(
                "--fov-deg and --camera both describe the camera; give one of them",
                ErrorCode.OPTIONS,
            )
        if self.size is not None:
            raise AmiwarpError(
                "--size and --camera both give the size of the image; leave --size out",
                ErrorCode.OPTIONS,
            )
        return load_camera(self.camera, (width, height))

    def build_prism(self) -> Prism:
        """Return the prism with its true parameters."""
        apex = cli.apex_from(1.0 if self.apex_deg is None else self.apex_deg, "--apex-deg")
        given: dict[str, Any] = {"index": self.index, "flat_side": self.flat_side}
        prism = Prism(apex, **{name: value for name, value in given.items() if value is not None})
        if self.second_apex_deg is not None:
            second_apex = cli.apex_from(self.second_apex_deg, "--second-apex-deg")
            return replace(prism, second=replace(prism, apex=second_apex))
        if (self.second_rpm, self.second_phase_deg) != (None, None):
            raise AmiwarpError(
                "--second-rpm and --second-phase-deg describe a second prism; give --second-apex-deg",
                ErrorCode.OPTIONS,
            )
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
            raise AmiwarpError(
                "--rpm and --speed both give the prism's speed; give one of them", ErrorCode.OPTIONS
            )

        def angles(given: str | None, option: str) -> tuple[Any, ...]:
            return cli.angles(given or "0,0", 2, option, math.pi / 2.0)

        tilt = angles(self.tilt_deg, "--tilt-deg")
        cylinder = angles(self.cylinder_deg, "--cylinder-deg")
        wobble = angles(self.wobble_deg, "--wobble-deg")
        rpm: float | NDArray[np.float64] = 720.0
        if self.speed is not None:
            rpm = _read_speed(self.speed)
        elif self.rpm is not None:
            rpm = self.rpm
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
            raise AmiwarpError(
                f"{path}: has over {MOST_SPEEDS} speeds; give fewer, which are interpolated"
            )
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
            "tilts), steerer (beam steerer of two deflectors), or vibration (the camera itself, without glass and "
            "encoder)."
        ),
    ] = Optic.WEDGE
    thickness_mm: Annotated[
        float | None, cli.in_prism(help="Thickness of the plate (mm). Default: 10.")
    ] = None
    plate_tilt_deg: Annotated[
        float | None,
        cli.in_prism(
            help="Angle between the normal of the plate and the rotation axis (deg). Default: 45."
        ),
    ] = None

    def build_plate(self, index: float | None) -> Plate:
        """Return the plate with its true parameters."""
        thickness_mm = 10.0 if self.thickness_mm is None else self.thickness_mm
        tilt_deg = 45.0 if self.plate_tilt_deg is None else self.plate_tilt_deg
        thickness = cli.thickness_from(thickness_mm)
        tilt = cli.plate_tilt_from(tilt_deg)
        if index is None:
            return Plate(thickness, tilt)
        return Plate(thickness, tilt, index)


_in_optic = partial(typer.Option, rich_help_panel="Vibration")


@dataclass(frozen=True)
class VibrationOptions:
    """Options for the vibration of a camera without a prism."""

    hz: Annotated[
        float | None, _in_optic(help="Frequency of the vibration (Hz). Default: 100.")
    ] = None
    amplitude_deg: Annotated[
        float | None,
        _in_optic(help="Radius of the vibration's forward circle (deg). Default: 0.4."),
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
            help="Rotation about the optical axis: factors of cosine and sine (deg). Default: 0,0.",
            metavar="C,S",
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
        fx, fy, sx, sy = cli.angles(
            self.second_deg or "0,0,0,0", 4, "--second-deg", LARGEST_AMPLITUDE
        )
        degrees = 0.4 if self.amplitude_deg is None else self.amplitude_deg
        amplitude = cli.radians(degrees, "--amplitude-deg", 0.0, LARGEST_AMPLITUDE)
        hz = 100.0 if self.hz is None else self.hz
        return Vibration(hz, amplitude, rig.phase, (bx, by), (rc, rs), (fx, fy), (sx, sy))


_in_mirror = partial(typer.Option, rich_help_panel="Mirror")


@dataclass(frozen=True)
class MirrorOptions:
    """Options for a mirror with two tilts in front of the camera."""

    mirror_hz: Annotated[
        str | None,
        _in_mirror(help="Frequencies of both tilts (Hz). Default: 60,77.", metavar="F1,F2"),
    ] = None
    mirror_deg: Annotated[
        str | None,
        _in_mirror(
            help="Amplitudes of both tilts, seen along the optical axis (deg). Default: 0.5,0.5.",
            metavar="A1,A2",
        ),
    ] = None
    mirror_phase_deg: Annotated[
        str | None,
        _in_mirror(help="Phases of both tilts at the start (deg). Default: 0,0.", metavar="P1,P2"),
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
        _in_mirror(
            help="Direction in the image in which the mirror folds the optical axis (deg). Default: 0, x."
        ),
    ] = None
    incidence_deg: Annotated[
        float | None,
        _in_mirror(help="Angle of incidence of the optical axis on the mirror (deg). Default: 45."),
    ] = None

    def build(self) -> Mirror:
        """Return the mirror."""
        amplitude = cli.angles(
            self.mirror_deg or "0.5,0.5", 2, "--mirror-deg", LARGEST_TILT, low=0.0
        )
        phase = cli.angles(self.mirror_phase_deg or "0,0", 2, "--mirror-phase-deg")
        direction = cli.angles(self.mirror_direction_deg or "0,90", 2, "--mirror-direction-deg")
        first, second = cli.numbers(self.mirror_hz or "60,77", 2, "--mirror-hz")
        incidence = 45.0 if self.incidence_deg is None else self.incidence_deg
        return Mirror(
            (first, second),
            amplitude,
            phase,
            direction,
            fold=cli.radians(self.fold_deg or 0.0, "--fold-deg"),
            incidence=cli.radians(incidence, "--incidence-deg", 0.0, LARGEST_INCIDENCE),
        )


_in_steerer = partial(typer.Option, rich_help_panel="Beam steerer")


@dataclass(frozen=True)
class SteererOptions:
    """Options for a beam steerer of two deflectors in front of the camera."""

    steerer_hz: Annotated[
        str | None,
        _in_steerer(
            help="Frequencies of the commands of both deflectors (Hz). Default: 200,247.",
            metavar="F1,F2",
        ),
    ] = None
    steerer_deg: Annotated[
        str | None,
        _in_steerer(
            help="Largest deflections by both, at the middle of the image (deg). Default: 1,1.",
            metavar="A1,A2",
        ),
    ] = None
    steerer_phase_deg: Annotated[
        str | None,
        _in_steerer(
            help="Phases of both commands at the start (deg). Default: 0,0.", metavar="P1,P2"
        ),
    ] = None
    steerer_direction_deg: Annotated[
        str | None,
        _in_steerer(
            help="Directions in the image along which both move it, from x towards y (deg). Default: 0,90.",
            metavar="D1,D2",
        ),
    ] = None

    def build(self) -> Steerer:
        """Return the beam steerer."""
        first, second = cli.numbers(self.steerer_hz or "200,247", 2, "--steerer-hz")
        amplitude = cli.angles(
            self.steerer_deg or "1,1", 2, "--steerer-deg", LARGEST_DEFLECTION, low=0.0
        )
        phase = cli.angles(self.steerer_phase_deg or "0,0", 2, "--steerer-phase-deg")
        direction = cli.angles(self.steerer_direction_deg or "0,90", 2, "--steerer-direction-deg")
        return Steerer((first, second), amplitude, phase, direction)


@with_options_of(SensorModel, sensor_option)
@dataclass(frozen=True)
class SensorOptions:
    """Options for the sensor's imperfections: the fields of ``amiwarp.SensorModel``, and sensors by name."""

    ideal: Annotated[
        bool,
        sensor_option("--ideal", help="Simulate a sensor without noise, mismatch and latency."),
    ] = False
    sensor: Annotated[
        str | None,
        sensor_option(
            help="Known camera whose sensor is simulated: dvxplorer, dvxplorer_mini, davis240c, davis346, gen4, evk4 "
            "or genx320. Other options change it."
        ),
    ] = None

    def build(self) -> SensorModel:
        """Return the sensor model that the options describe."""
        if self.ideal and self.sensor is not None:
            raise AmiwarpError(
                "--ideal and --sensor both describe the sensor; give one of them", ErrorCode.OPTIONS
            )
        given: dict[str, Any] = {
            name: value for name, value in vars(self).items() if value is not None
        }
        ideal = given.pop("ideal")
        preset = given.pop("sensor", None)
        sensor = SensorModel.preset(preset) if preset is not None else SensorModel()
        return replace(SensorModel.ideal() if ideal else sensor, **given)


@with_options_of(EncoderModel, cli.in_encoder, leave_out=("counts_per_turn", "harmonics"))
@dataclass(frozen=True)
class EncoderModelOptions:
    """Options for the encoder's imperfections: the fields of ``amiwarp.EncoderModel``."""

    counts_per_turn: Annotated[
        int | None, cli.in_encoder(help="Counts per turn; 0: no rounding to counts.")
    ] = None
    encoder_error_deg: Annotated[
        str | None,
        cli.in_encoder(
            help="Error of the angle that repeats every turn: factors of cosine and sine of the angle, and of twice "
            "the angle (deg). An eccentric disc causes the first two. Default: 0,0,0,0.",
            metavar="C1,S1,C2,S2",
        ),
    ] = None

    def build(self) -> EncoderModel:
        """Return the encoder model that the options describe."""
        given: dict[str, Any] = {
            name: value for name, value in vars(self).items() if value is not None
        }
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
    **dict.fromkeys(_names(SteererOptions), (Optic.STEERER,)),
    **dict.fromkeys(
        _names(EncoderModelOptions), (Optic.WEDGE, Optic.PLATE, Optic.MIRROR, Optic.STEERER)
    ),
}
"""Optics that each option applies to."""


def build_optic(
    optic: OpticOptions,
    rig: RigOptions,
    vibration: VibrationOptions,
    mirror: MirrorOptions,
    steerer: SteererOptions,
    encoder: EncoderModelOptions,
) -> Prism | Plate | Moved:
    """Return what moves the image. Raises :class:`AmiwarpError` for options of another optic."""
    for name, value in (
        pair
        for group in (optic, rig, vibration, mirror, steerer, encoder)
        for pair in vars(group).items()
    ):
        if value is not None and optic.optic not in (kinds := _APPLY[name]):
            option = f"--{name.replace('_', '-')}"
            which = " or ".join(f"a {kind.value}" for kind in kinds)
            raise AmiwarpError(
                f"{option} applies to {which}; give --optic {kinds[0].value}, or remove {option}",
                ErrorCode.OPTIONS,
            )
    if optic.optic is Optic.VIBRATION:
        return vibration.build(rig)
    if optic.optic is Optic.MIRROR:
        return mirror.build()
    if optic.optic is Optic.STEERER:
        return steerer.build()
    return rig.build_prism() if optic.optic is Optic.WEDGE else optic.build_plate(rig.index)
