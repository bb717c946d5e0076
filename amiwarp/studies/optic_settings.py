"""Moving optics and their motions, all in sizes that move the image as far as one wedge."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction
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

    def wedges(*apexes: float) -> Prism:
        first_apex, *other_apexes = apexes
        others = [Prism(apex, glass.index, glass.flat_side) for apex in other_apexes]
        return Prism(first_apex, glass.index, glass.flat_side, *others)

    def pair(name: str, ratio: Fraction) -> Callable[[float], Setting]:
        def made(size: float) -> Setting:
            optic = wedges(size, size)
            return Setting(f"pair, {name}", optic, hz, f"2 × {degrees(size)}", ratio)

        return made

    def mirror(name: str, ratio: Fraction, phase: float) -> Callable[[float], Setting]:
        def made(size: float) -> Setting:
            optic = Mirror((hz, hz * float(ratio)), (size, size), (0.0, phase))
            return Setting(f"mirror, {name}", optic, hz, f"± {degrees(size)}", ratio)

        return made

    def vibration(size: float) -> Setting:
        often = max(hz, SLOWEST_VIBRATION)
        optic = Vibration(often, size, 0.0, (ELLIPSE * size, 0.0))
        longer = degrees(size * (1.0 + ELLIPSE))
        shorter = degrees(size * (1.0 - ELLIPSE))
        return Setting("vibration", optic, often, f"{longer} × {shorter}")

    def plate(depth: float) -> Callable[[float], Setting]:
        def made(thickness: float) -> Setting:
            if thickness > LARGEST_THICKNESS:
                raise AmiwarpError(
                    f"to move a scene at {depth:g} m as far as the wedge, the plate would have to be "
                    f"{1e3 * thickness:.0f} mm thick; the limit is {1e3 * LARGEST_THICKNESS:.0f} mm; give a nearer "
                    "depth (--depth-m), or a smaller apex"
                )
            return Setting(
                f"plate, {depth:g} m",
                Plate(thickness, PLATE_TILT, glass.index),
                hz,
                f"{1e3 * thickness:.1f} mm, 45°",
                inverse_depth=1.0 / depth,
            )

        return made

    wedge = Setting("wedge", wedges(apex), hz, degrees(apex))
    radius = _rms(wedge, camera)
    angle = radius / camera.fx

    quarter = 0.5 * math.pi
    lissajous = f"{LISSAJOUS.denominator}:{LISSAJOUS.numerator}"
    # Name, how the optic of a size is made, and a size near the one that is looked for
    wanted = (
        ("pair, opposite", pair("opposite", Fraction(-1)), apex / math.sqrt(2.0)),
        ("pair, unequal", pair("unequal", UNEQUAL), apex / math.sqrt(2.0)),
        ("mirror, circle", mirror("circle", Fraction(1), quarter), 0.5 * angle),
        (f"mirror, {lissajous}", mirror(lissajous, LISSAJOUS, quarter), 0.5 * angle),
        ("vibration", vibration, angle),
    )
    found = [wedge]
    for name, make, start in wanted:
        with noted(failed, name):
            found.append(_sized(make, start, camera, radius))

    # One plate, sized for the nearest depth, in front of all of them
    nearest = min(depths)
    shift_per_thickness = Plate(1e-3, PLATE_TILT, glass.index).shift * 1e3
    start = angle * nearest / shift_per_thickness
    glass_plate = _sized(plate(nearest), start, camera, radius).optic
    assert isinstance(glass_plate, Plate)
    for depth in sorted(depths):
        found.append(plate(depth)(glass_plate.thickness))
    return found


def _sized(make: Callable[[float], Setting], size: float, camera: Camera, radius: float) -> Setting:
    """Return the optic whose size moves the image by a radius [px rms], starting from a size near it."""
    for _ in range(SIZING_STEPS):
        size *= radius / _rms(make(size), camera)
    return make(size)


def _rms(setting: Setting, camera: Camera) -> float:
    """Return the distance of the paths from their middles [px], rms over the image and time."""
    moved = paths(setting.model(camera), image_grid(camera), TURN_ANGLES, setting.turns)
    return float(np.sqrt(np.nanmean(radii_of(moved) ** 2)))
