"""Moving optics and their motions, all in sizes that move the image as far as one wedge."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import partial
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.optics.camera import Camera
from amiwarp.optics.models.base import Model
from amiwarp.optics.models.exact import ExactModel
from amiwarp.optics.models.pair import RisleyModel
from amiwarp.optics.models.plate import PlateModel
from amiwarp.optics.prism import LARGEST_THICKNESS, Plate, Prism
from amiwarp.simulation.motion import Mirror, PrismMotion, Vibration
from amiwarp.studies.failures import noted
from amiwarp.studies.orbits import TURN_ANGLES, image_grid, paths, radii_of
from amiwarp.studies.quantities import degrees

UNEQUAL = Fraction(-1, 2)
"""Speed of the second wedge of a pair relative to the first, for unequal speeds."""
LISSAJOUS = Fraction(4, 3)
"""Frequency of a mirror's second tilt relative to the first, for unequal frequencies."""
ELLIPSE = 1.0 / 3.0
"""Radius of a vibration's backward circle relative to the forward one: an ellipse of two to one."""
SLOWEST_VIBRATION = 20.0
"""Lowest frequency at which the calibration of vibrations was measured [Hz]."""
PLATE_TILT = math.radians(45.0)
"""Tilt of the plate [rad]."""
SIZING_STEPS = 4
"""Number of steps that find the size of an optic for a radius, which is nearly proportional to it."""


@dataclass(frozen=True, slots=True)
class Setting:
    """An optic and its motion."""

    name: str
    """Name of optic and motion."""
    optic: Prism | Plate | Mirror | Vibration
    """What moves the image."""
    hz: float
    """Speed of its first angle [turns/s]."""
    size: str
    """Size of the optic, in words."""
    ratio: Fraction = Fraction(1)
    """Speed of its second angle relative to the first."""
    inverse_depth: float = 0.0
    """Inverse depth of the scene, for a plate [1/m]."""

    NEEDS: ClassVar[dict[str, tuple[str, str, str]]] = {
        "wedge": ("one wedge", "motor", "encoder"),
        "pair": ("two wedges", "two motors, or gears", "two encoders"),
        "mirror": ("mirror", "two-axis drive", "both commands"),
        "vibration": ("none", "unbalanced motor", "events alone"),
        "plate": ("thick plate", "motor", "encoder"),
    }
    """What each kind of optic needs: glass, drive, and what its state is known from."""

    @property
    def kind(self) -> str:
        """Kind of the optic, one of :attr:`NEEDS`."""
        return self.name.partition(",")[0]

    @property
    def turns(self) -> int:
        """Turns of the first angle after which the motion repeats."""
        return self.ratio.denominator

    @property
    def motion(self) -> PrismMotion:
        """Motion of the glass."""
        rpm = 60.0 * self.hz
        second = None
        if isinstance(self.optic, Prism) and self.optic.second is not None:
            second = PrismMotion(rpm * float(self.ratio))
        return PrismMotion(rpm, second=second)

    def model(self, camera: Camera) -> Model:
        """Return the exact model of the optic."""
        if isinstance(self.optic, Plate):
            return PlateModel(camera, self.optic, inverse_depth=self.inverse_depth)
        if not isinstance(self.optic, Prism):
            return self.optic.model(camera)
        if self.optic.second is not None:
            return RisleyModel(camera, self.optic, ratio=float(self.ratio))
        return ExactModel(camera, self.optic)

    def speeds(self, model: Model) -> NDArray[np.float64]:
        """Return the speeds of the model's angles [rad/s]."""
        relative = [1.0, float(self.ratio)]
        return np.array(relative[: model.ANGLES]) * math.tau * self.hz


@dataclass(frozen=True)
class _Optics:
    """Optics of one glass and speed, each made by its size."""

    glass: Prism
    """Index and flat side."""
    hz: float
    """Speed of the first angle [turns/s]."""

    def wedge(self, apex: float) -> Setting:
        """Return a wedge of an apex angle [rad]."""
        optic = replace(self.glass, apex=apex)
        return Setting("wedge", optic, self.hz, degrees(apex))

    def pair(self, apex: float, *, name: str, ratio: Fraction) -> Setting:
        """Return two wedges of an apex angle [rad]."""
        second = Prism(apex, self.glass.index, self.glass.flat_side)
        optic = replace(self.glass, apex=apex, second=second)
        return Setting(name, optic, self.hz, f"2 × {degrees(apex)}", ratio)

    def mirror(self, tilt: float, *, name: str, ratio: Fraction) -> Setting:
        """Return a mirror that tilts by up to ``tilt`` [rad] about both axes, a quarter period apart."""
        rates_hz = (self.hz, self.hz * float(ratio))
        optic = Mirror(rates_hz, (tilt, tilt), (0.0, 0.5 * math.pi))
        return Setting(name, optic, self.hz, f"± {degrees(tilt)}", ratio)

    def vibration(self, radius: float) -> Setting:
        """Return a vibration whose forward circle has a radius [rad]."""
        hz = max(self.hz, SLOWEST_VIBRATION)
        optic = Vibration(hz, radius, 0.0, (ELLIPSE * radius, 0.0))
        longer = degrees(radius * (1.0 + ELLIPSE))
        shorter = degrees(radius * (1.0 - ELLIPSE))
        return Setting("vibration", optic, hz, f"{longer} × {shorter}")

    def plate(self, thickness: float, *, depth: float) -> Setting:
        """Return a plate of a thickness [m] in front of a scene at a depth [m]."""
        if thickness > LARGEST_THICKNESS:
            raise AmiwarpError(
                f"to move a scene at {depth:g} m as far as the wedge, the plate would have to be "
                f"{1e3 * thickness:.0f} mm thick; the limit is {1e3 * LARGEST_THICKNESS:.0f} mm; give a nearer "
                "depth (--depth-m), or a smaller apex"
            )
        return Setting(
            f"plate, {depth:g} m",
            Plate(thickness, PLATE_TILT, self.glass.index),
            self.hz,
            f"{1e3 * thickness:.1f} mm, 45°",
            inverse_depth=1.0 / depth,
        )


def settings(
    camera: Camera,
    glass: Prism,
    apex: float,
    hz: float,
    depths: Sequence[float],
    failed: dict[str, str],
) -> list[Setting]:
    """Return a wedge, and all other optics in sizes that move the image as far as the wedge, rms over the image.

    ``glass``: index and flat side; ``apex``: apex angle of the wedge [rad]; ``hz``: its speed [turns/s]; ``depths``:
    depths of the scene for the plate [m]. The plate moves the scene at the nearest of them as far as the wedge.
    Optics of which no size does so are noted in ``failed``. Raises :class:`AmiwarpError` if no plate does so.
    """
    optics = _Optics(glass, hz)
    wedge = optics.wedge(apex)
    radius = _rms(wedge, camera)
    angle = radius / camera.fx

    made = [wedge]
    for name, make, likely_size in _sizable(optics, apex, angle):
        with noted(failed, name):
            made.append(_sized(make, likely_size, camera, radius))

    # One plate, sized for the nearest depth, in front of all of them
    nearest = min(depths)
    shift_per_thickness = Plate(1e-3, PLATE_TILT, glass.index).shift * 1e3
    likely_thickness = angle * nearest / shift_per_thickness
    plate = _sized(partial(optics.plate, depth=nearest), likely_thickness, camera, radius).optic
    assert isinstance(plate, Plate)
    for depth in sorted(depths):
        made.append(optics.plate(plate.thickness, depth=depth))
    return made


def _sizable(
    optics: _Optics, apex: float, angle: float
) -> list[tuple[str, Callable[[float], Setting], float]]:
    """Return the optics that move as the wedge does: name, how it is made of its size, and a size near the right one.

    ``apex``: apex angle of the wedge [rad]; ``angle``: angle by which it moves the image [rad rms].
    """
    lissajous = f"mirror, {LISSAJOUS.denominator}:{LISSAJOUS.numerator}"
    motions = [
        ("pair, opposite", optics.pair, Fraction(-1), apex / math.sqrt(2.0)),
        ("pair, unequal", optics.pair, UNEQUAL, apex / math.sqrt(2.0)),
        ("mirror, circle", optics.mirror, Fraction(1), 0.5 * angle),
        (lissajous, optics.mirror, LISSAJOUS, 0.5 * angle),
    ]
    sizable: list[tuple[str, Callable[[float], Setting], float]] = []
    for name, make, ratio, size in motions:
        sizable.append((name, partial(make, name=name, ratio=ratio), size))
    return [*sizable, ("vibration", optics.vibration, angle)]


def _sized(make: Callable[[float], Setting], size: float, camera: Camera, radius: float) -> Setting:
    """Return the optic whose size moves the image by a radius [px rms], starting from a size near it."""
    for _ in range(SIZING_STEPS):
        size *= radius / _rms(make(size), camera)
    return make(size)


def _rms(setting: Setting, camera: Camera) -> float:
    """Return the distance of the paths from their middles [px], rms over the image and time."""
    moved = paths(setting.model(camera), image_grid(camera), TURN_ANGLES, setting.turns)
    return float(np.sqrt(np.nanmean(radii_of(moved) ** 2)))
