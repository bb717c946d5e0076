"""Printed and bought parts of the rig as solids, in millimetres.

The z axis is the axis of rotation and points to the scene, y points up. z = 0 is the rear face of the housing, next to
the camera. The thick edge of the wedge points to +x.
"""

import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from manifold3d import CrossSection, Manifold, OpType

ADD = OpType.Add

SEGMENTS = 180
"""Number of sides of a circle."""
PETG, GLASS, STEEL, RUBBER = 1.27e-3, 2.51e-3, 7.85e-3, 1.2e-3
"""Densities [g/mm³] of the printed material (solid), N-BK7, steel and rubber."""
BELT_PITCH, BELT_WIDTH, PITCH_LINE, TOOTH_DEPTH, BELT_BACK = 2.0, 6.0, 0.254, 0.75, 0.77
"""GT2 belt [mm]: pitch, width, distance of the pitch line from the tips of the pulley's teeth, depth of a tooth, and
thickness without teeth (1.52 in all by SDP/SI's handbook, 1.4 by other makers)."""
FLANGE, BELT_ROOM = 1.2, 7.0
"""Thickness of a pulley's flange, and distance between its flanges [mm]."""
SPRING, BAND = 1.5, 0.4
"""Length of the compressed wave spring, and thickness of its band [mm]."""
PLATE, MOTOR_PLATE, SLIDE = 5.0, 4.0, 3.0
"""Thickness of the housing's plate and of the motor's plate behind it, and travel of the latter to either side [mm]."""
HOLDER, LIP, SLIT = 3.0, 1.0, 0.8
"""Holder of the camera [mm]: thickness of its plate, width of the lip in front of the gripped ring, and width of the
slit that frees the clamp from the plate."""
CORD, SQUEEZED = 1.0, 0.75
"""Thickness of the O-ring, free and between wedge and ring [mm]."""
HEADS = {2.0: (3.8, 2.0, 1.6), 2.5: (4.5, 2.5, 2.05), 3.0: (5.5, 3.0, 2.5), 4.0: (7.0, 4.0, 3.3)}
"""Screws by thread [mm]: diameter and height of a cylinder head (ISO 4762), and core hole. Countersunk heads (ISO 7046)
have the same diameter to within 0.3 mm."""
LEAST_WALL = 1.2
"""Thinnest printed wall: three lines of a nozzle of 0.4 mm [mm]."""
ROUNDED = 2e-3
"""How far the surfaces of printed parts may be moved when short edges are removed [mm]."""
MOTOR_THREAD = 3.0
"""Depth of the threads in the belt motor's face [mm]. The check of overlaps finds a screw that reaches their bottom."""
FORK_WIDTH, FORK_DEPTH, FORK_SLOT, FORK_SLOT_DEPTH, FORK_LENGTH = 14.0, 10.0, 5.0, 7.0, 6.0
"""Fork barrier [mm]: width along its beam, depth, width and depth of its slot, and length along the flag's path."""


@dataclass(frozen=True)
class Bearing:
    """Thin-section deep-groove ball bearing [mm, g, N]."""

    name: str
    bore: float
    outer: float
    width: float
    mass: float
    """Mass [g]."""
    play: tuple[float, float]
    """Radial play, class normal (ISO 5753) [mm]."""
    runout: float
    """Largest radial runout of the inner ring, class normal (ISO 492) [mm]."""
    dynamic: float
    """Basic dynamic load rating [N]."""

    @property
    def inner(self) -> float:
        """Outer radius of what may touch the inner ring's face."""
        return self.bore / 2 + 0.14 * (self.outer - self.bore)

    @property
    def outside(self) -> float:
        """Inner radius of what may touch the outer ring's face."""
        return self.outer / 2 - 0.14 * (self.outer - self.bore)


BEARINGS = (
    Bearing("6705", 25.0, 32.0, 4.0, 8.0, (0.005, 0.020), 0.013, 1100.0),
    Bearing("6706", 30.0, 37.0, 4.0, 9.5, (0.005, 0.020), 0.013, 1140.0),
    Bearing("6708", 40.0, 50.0, 6.0, 25.0, (0.006, 0.020), 0.015, 2500.0),
    Bearing("6805", 25.0, 37.0, 7.0, 22.0, (0.005, 0.020), 0.013, 4300.0),
    Bearing("6806", 30.0, 42.0, 7.0, 26.0, (0.005, 0.020), 0.013, 4500.0),
    Bearing("6808", 40.0, 52.0, 7.0, 34.0, (0.006, 0.020), 0.015, 4900.0),
    Bearing("6810", 50.0, 65.0, 7.0, 52.0, (0.006, 0.023), 0.020, 6700.0),
    Bearing("6811", 55.0, 72.0, 9.0, 83.0, (0.008, 0.028), 0.020, 9000.0),
    Bearing("6812", 60.0, 78.0, 10.0, 106.0, (0.008, 0.028), 0.020, 11900.0),
)
"""Masses and load ratings are typical ones; dimensions are those of the series 67 and 68 (ISO 15: 17 and 18)."""


@dataclass(frozen=True)
class Rig:
    """Dimensions of a rig [mm].

    Parameters
    ----------
    name : str
        Name of the folder of its files.
    wedge : float
        Diameter of the wedge.
    thickness : float
        Thickness of the wedge on the axis.
    apex_deg : float
        Apex angle of the wedge [deg].
    teeth : tuple of int
        Teeth of the pulleys of rotor and motor.
    belt : float
        Pitch length of the belt.
    series : str
        Series of the bearings, 67 or 68.
    lens : float
        Outer diameter of the lens. It reaches into the rotor if it is slim enough.
    reach : float
        Distance of the lens's front from the front of the ring that the holder grips.
    pupil : float
        Distance of the lens's entrance pupil behind its front.
    """

    name: str
    wedge: float
    thickness: float
    apex_deg: float
    teeth: tuple[int, int]
    belt: float
    series: str
    lens: float
    reach: float
    pupil: float
    motor: tuple[float, float, float]
    """Motor: diameter of body, length of body, diameter of shaft."""
    motor_screws: tuple[float, float]
    """Motor: distance of its two M3 threads, and diameter of its centring boss."""
    camera: tuple[float, float, float] = (40.0, 60.0, 30.0)
    """Camera body: width, height and length. The optical axis is in its middle."""
    grip: tuple[float, float] = (30.0, 5.0)
    """What the holder grips: diameter, and width. By default the ring of 5 mm between a camera with CS-mount (12.526 mm
    from flange to sensor) and a lens with C-mount (17.526 mm), which is of metal and does not turn when one focuses."""
    threads: tuple[str, str] = ("cs", "c")
    """Threads of camera and lens: 'c', 'cs' or 'm12'."""
    flange: float = 12.526
    """Distance from the sensor to the flange of the camera's thread."""
    screw: tuple[float, float] = (1.6, 2.0)
    """Set screws that balance the rotor: core hole, and thread."""
    seat: float = 0.1
    """Radial gap between wedge and seat."""
    wall: float = 2.0
    """Least wall between the wedge's seat and the bearing's bore."""
    lip: float = 1.0
    """Width of the lips that hold the wedge."""
    between: float = 2.0
    """Distance between the bearings."""
    clearance: float = 0.7
    """Smallest gap between a part that turns and one that does not."""

    @property
    def bearing(self) -> Bearing:
        """Smallest bearing whose bore leaves a wall around the wedge's seat."""
        least = self.wedge + 2 * (self.seat + self.wall)
        made = (bearing for bearing in BEARINGS if bearing.name.startswith(self.series))
        return next(bearing for bearing in made if bearing.bore >= least - 1e-9)

    @property
    def barrel(self) -> float:
        """Radius of the housing's bore."""
        return self.bearing.outer / 2

    @property
    def centring(self) -> float:
        """Radius of the opening in the housing's rear, which centres the holder's spigot."""
        return self.bearing.outside

    @property
    def spigot(self) -> float:
        """Radius within the holder's spigot, which leaves room to what turns."""
        return self.bearing.inner + self.clearance + 0.05

    @property
    def clear(self) -> float:
        """Radius of the clear aperture."""
        return self.wedge / 2 - self.lip

    @property
    def front_clear(self) -> float:
        """Radius of the clear aperture in front of the wedge."""
        return self.wedge / 2 - self.lip

    @property
    def thickest_edge(self) -> float:
        """Largest thick edge of a wedge: behind its seat, a wall remains before the rear ring's threads."""
        return self.front_z - 1.3 - (self.bearing_z[0] + 8.0 + LEAST_WALL)

    @property
    def edge(self) -> float:
        """Thickness of the wedge at its thick edge."""
        return self.thickness + self.wedge / 2 * math.tan(math.radians(self.apex_deg))

    @property
    def thin_edge(self) -> float:
        """Thickness of the wedge at its thin edge; negative if the glass ends before it."""
        return 2 * self.thickness - self.edge

    @property
    def bearing_z(self) -> tuple[float, float]:
        """Rear faces of both bearings."""
        rear = 2.0 + SPRING
        return rear, rear + self.bearing.width + self.between

    @property
    def shoulder_z(self) -> float:
        """Front face of the front bearing, where the rotor's shoulder begins."""
        return self.bearing_z[1] + self.bearing.width

    @property
    def face_z(self) -> float:
        """Front face of the housing. The bearing stands out by 0.1 mm, so that the cap clamps it."""
        return self.shoulder_z - 0.1

    @property
    def pulley_z(self) -> float:
        """Rear face of the rotor's pulley."""
        return self.shoulder_z + 2.6

    @property
    def front_z(self) -> float:
        """Front face of the rotor."""
        return self.pulley_z + 2 * FLANGE + BELT_ROOM

    @property
    def seat_z(self) -> float:
        """Rear, flat face of the wedge. Between its thick edge and the rotor's front remain 1.3 mm."""
        return self.front_z - 1.3 - self.edge

    @property
    def enters(self) -> bool:
        """Whether the lens is slim enough to reach into the rotor."""
        return self.lens / 2 + 1.5 <= self.clear

    @property
    def lens_z(self) -> float:
        """Front of the lens: as near to the wedge as the holder allows, or behind the rotor."""
        nearest = -(HOLDER + SLIT + LIP) + self.reach
        return min(self.seat_z - 2.0, nearest) if self.enters else -1.5

    @property
    def grip_z(self) -> float:
        """Front of the ring that the holder grips."""
        return self.lens_z - self.reach

    @property
    def cover_z(self) -> float:
        """Inner face of the cover's front."""
        return self.front_z + 7.0

    @property
    def outline(self) -> float:
        """Radius of plate and cover about the axis: room for the cap's screws, and for the fork beside the pulley."""
        return max(self.barrel + 10.0, self.pitch(self.teeth[0]) + 13.4)

    @property
    def height(self) -> float:
        """Height of the axis above the base."""
        return self.outline + 9.0

    @property
    def flag(self) -> float:
        """Radius of the index flag's tip."""
        return self.outline - 4.0

    @property
    def pulley_flange(self) -> float:
        """Radius of the flanges of the rotor's pulley."""
        return self.pitch(self.teeth[0]) + 1.4

    def pitch(self, teeth: int) -> float:
        """Return the pitch radius of a pulley."""
        return teeth * BELT_PITCH / (2 * math.pi)

    @property
    def distance(self) -> float:
        """Distance between the axes of rotor and motor, from the belt's length (two open pulleys, exact)."""
        large, small = (self.pitch(teeth) for teeth in self.teeth)
        low, high = large - small + 1e-6, self.belt / 2
        for _ in range(60):
            middle = (low + high) / 2
            lean = math.asin((large - small) / middle)
            length = (
                2 * middle * math.cos(lean) + math.pi * (large + small) + 2 * lean * (large - small)
            )
            low, high = (middle, high) if length < self.belt else (low, middle)
        return low

    @property
    def o_ring(self) -> float:
        """Inner radius of the squeezed O-ring, whose cut keeps its area. Outside, it touches the wedge's seat."""
        return self.wedge / 2 + self.seat - math.pi / 4 * CORD**2 / SQUEEZED

    @property
    def stops(self) -> tuple[tuple[str, float, float], ...]:
        """Apertures between lens and scene: name, z and radius. Those up to the wedge come first."""
        opening = self.opening
        return (
            ("seat's lip", self.seat_z, self.clear),
            ("O-ring", self.front_z, self.o_ring),
            ("wedge's ring", self.front_z, self.front_clear),
            ("wedge's ring", self.front_z + 2.0, self.front_clear),
            ("cover", self.cover_z, opening),
            ("cover", self.cover_z + 2.0, opening + 2.0),
        )

    @property
    def opening(self) -> float:
        """Radius of the cover's opening on its inner side: it lets pass what the wedge's ring lets pass."""
        return self.front_clear + 1.0 * (self.cover_z - self.front_z)


ONE_INCH = Rig(
    "one-inch",
    25.4,
    3.5,
    0.5,
    (60, 30),
    180.0,
    "67",
    17.0,
    5.0,
    4.0,
    (28.0, 40.0, 4.0),
    (17.0, 7.0),
    threads=("cs", "m12"),
)
TWO_INCH = Rig(
    "two-inch",
    50.8,
    5.0,
    1.0,
    (100, 50),
    280.0,
    "68",
    40.0,
    30.0,
    10.0,
    (36.0, 45.0, 5.0),
    (25.0, 10.0),
    screw=(2.5, 3.0),
)
RIGS = (ONE_INCH, TWO_INCH)


BELTS = tuple(float(length) for length in range(160, 401, 20))
"""Lengths of closed GT2 belts among which :func:`for_wedge` chooses [mm]."""


def for_wedge(rig: Rig, wedge: float, *, teeth: tuple[int, int] | None, belt: float | None) -> Rig:
    """Return a rig for a wedge of another diameter [mm], with teeth and belt chosen if they are not given.

    The belt is the shortest of :data:`BELTS` that keeps the motor beside the barrel.
    """
    if teeth is None:
        large = max(least_teeth(wedge, rig.seat, rig.screw[0]), 40)
        teeth = large, large // 2
        if wedge == rig.wedge:
            teeth = rig.teeth
    own = replace(rig, wedge=wedge, teeth=teeth)
    if belt is not None:
        return replace(own, belt=belt)
    if own == rig:
        return rig
    for length in BELTS:
        own = replace(own, belt=length)
        if (
            length > 2 * BELT_PITCH * max(teeth) / 1.5
            and own.distance > own.barrel + 8.0 + SLIDE + own.motor[0] / 2
        ):
            break
    return own


@dataclass(frozen=True)
class Part:
    """Solid of a part in its place in the rig."""

    name: str
    solid: Manifold
    kind: str
    """'printed', 'bought', 'glass' or 'screws'."""
    moves: str
    """What it moves with: 'prism', 'motor', 'belt', or nothing if empty."""
    mass: float
    """Mass [g], printed parts solid."""
    apart: tuple[float, float, float]
    """How far the exploded view moves it [mm]."""


def ring(inner: float, outer: float, low: float, high: float) -> Manifold:
    """Return a tube about the z axis by its radii and its ends."""
    flat = CrossSection.circle(outer, SEGMENTS)
    if inner > 0:
        flat -= CrossSection.circle(inner, SEGMENTS)
    return flat.extrude(high - low).translate((0, 0, low))


def rod(
    radius: float, low: float, high: float, x: float = 0.0, y: float = 0.0, sides: int = 48
) -> Manifold:
    """Return a cylinder along z."""
    return Manifold.cylinder(high - low, radius, radius, sides).translate((x, y, low))


def box(x: tuple[float, float], y: tuple[float, float], z: tuple[float, float]) -> Manifold:
    """Return a box by its extents."""
    size = tuple(high - low for low, high in (x, y, z))
    return Manifold.cube(size).translate((x[0], y[0], z[0]))


def around(radius: float, angles_deg: Iterable[float]) -> list[tuple[float, float]]:
    """Return points on a circle about the axis."""
    return [
        (radius * math.cos(math.radians(a)), radius * math.sin(math.radians(a))) for a in angles_deg
    ]


def holes(
    points: Iterable[tuple[float, float]], diameter: float, low: float, high: float
) -> Manifold:
    """Return round holes along z, to subtract."""
    return Manifold.batch_boolean([rod(diameter / 2, low, high, x, y, 32) for x, y in points], ADD)


def slots(
    points: Iterable[tuple[float, float]], diameter: float, reach: float, low: float, high: float
) -> Manifold:
    """Return slots along x, to subtract: ``reach`` to either side."""
    flats = [
        CrossSection.circle(diameter / 2, 32).translate((x - reach, y))
        + CrossSection.circle(diameter / 2, 32).translate((x + reach, y))
        for x, y in points
    ]
    return Manifold.batch_boolean(
        [flat.hull().extrude(high - low).translate((0, 0, low)) for flat in flats], ADD
    )


def screws(
    size: float,
    length: float,
    grip: float,
    points: Iterable[tuple[float, float, float]],
    turn: tuple[float, float, float] = (0.0, 0.0, 0.0),
    *,
    sunk: bool = False,
) -> Manifold:
    """Return screws that point to -z before they are turned.

    The shank has the diameter of the thread as far as the screw passes holes, and that of the core hole beyond.

    Parameters
    ----------
    size, length : float
        Diameter of the thread and length.
    grip : float
        Thickness of what the screws pass without a thread.
    points : iterable of tuple of float
        Where the axes meet the surface that the heads lie on, or in if they are countersunk.
    turn : tuple of float
        Rotation about x, y and z [deg].
    sunk : bool, default False
        Countersunk heads of 90°, which lie 0.1 mm deep.
    """
    wide, tall, core = HEADS[size]
    if sunk:
        cone = (wide - size) / 2
        one = Manifold.cylinder(cone, size / 2, wide / 2, 32).translate((0, 0, -0.1 - cone))
    else:
        one = rod(wide / 2, 0.0, tall, sides=32)
    shank = rod(size / 2, -grip, -0.2, sides=32) + rod(core / 2 - 0.02, -length, -0.2, sides=32)
    one += shank if sunk else shank + rod(size / 2, -0.3, 0.1, sides=32)
    one = one.rotate(turn)
    return Manifold.batch_boolean([one.translate(point) for point in points], ADD)


def sinks(
    points: Iterable[tuple[float, float]], size: float, z: float, *, rear: bool = False
) -> Manifold:
    """Return countersinks of 90° in a face at z that looks to the front or to the rear, to subtract."""
    top = HEADS[size][0] / 2 + 0.15
    one = Manifold.cylinder(top + 0.5, 0.0, top + 0.5, 32).translate(
        (0, 0, -top)
    )  # beyond the face, there is nothing
    if rear:
        one = one.rotate((180, 0, 0))
    return Manifold.batch_boolean([one.translate((x, y, z)) for x, y in points], ADD)


def at_z(points: Iterable[tuple[float, float]], z: float) -> list[tuple[float, float, float]]:
    """Return points in a plane z."""
    return [(x, y, z) for x, y in points]


def pulley(teeth: int) -> CrossSection:
    """Return the outline of a GT2 pulley."""
    tip = teeth * BELT_PITCH / (2 * math.pi) - PITCH_LINE
    groove = CrossSection.circle(0.56, 24).translate((tip - TOOTH_DEPTH + 0.56, 0.0))
    groove += CrossSection(
        [[(tip - 0.3, -0.54), (tip + 0.2, -0.72), (tip + 0.2, 0.72), (tip - 0.3, 0.54)]]
    )
    grooves = [groove.rotate(360 * k / teeth) for k in range(teeth)]
    return CrossSection.circle(tip, 4 * teeth) - CrossSection.batch_boolean(grooves, ADD)


def ring_screws(rig: Rig) -> tuple[float, list[tuple[float, float]]]:
    """Return the radius and the points of the four M2 screws of the wedge's ring."""
    root = rig.pitch(rig.teeth[0]) - PITCH_LINE - TOOTH_DEPTH
    radius = (rig.wedge / 2 + rig.seat + root) / 2
    return radius, around(radius, (45, 135, 225, 315))


BALANCE_STEP = 15.0
"""Angle between neighbouring set screws [deg]."""


def least_teeth(wedge: float, seat: float, hole: float) -> int:
    """Return the smallest even number of teeth of a rotor's pulley that leaves walls beside and between the screws.

    Parameters
    ----------
    wedge, seat : float
        Diameter of the wedge, and radial gap of its seat [mm].
    hole : float
        Diameter of the set screws' holes [mm].
    """
    inner = wedge / 2 + seat
    beside = inner + hole + 2 * LEAST_WALL
    # the screws' circle lies in the middle: (inner + root) / 2 = radius
    between = (hole + LEAST_WALL) / math.sin(math.radians(BALANCE_STEP / 2)) - inner
    root = max(beside, between)
    teeth = math.ceil((root + PITCH_LINE + TOOTH_DEPTH) * 2 * math.pi / BELT_PITCH - 1e-9)
    return teeth + teeth % 2


def balance_holes(rig: Rig) -> tuple[float, list[float]]:
    """Return the radius and the angles [deg] of the twelve threads for set screws that balance the rotor."""
    angles = [
        k * BALANCE_STEP for k in range(24) if (k * BALANCE_STEP) % 90 not in (30.0, 45.0, 60.0)
    ]
    return ring_screws(rig)[0], angles


def rotor(rig: Rig) -> Manifold:
    """Return the rotor: tube, shoulder, pulley, seat of the wedge, index flag, threads of M2 screws."""
    out = ring(0, rig.bearing.bore / 2 - 0.01, rig.bearing_z[0] + 0.2, rig.front_z)
    out += ring(0, rig.bearing.inner, rig.shoulder_z, rig.pulley_z + 0.1)
    return seated(rig, out + rim(rig)) - holes(rear_screws(rig), 1.6, 0, rig.bearing_z[0] + 8.0)


def rim(rig: Rig) -> Manifold:
    """Return the rim of the rotor: pulley with its flanges, and index flag."""
    low, high, flange = rig.pulley_z, rig.front_z, rig.pulley_flange
    out = pulley(rig.teeth[0]).extrude(high - low).translate((0, 0, low))
    out += ring(0, flange, low, low + FLANGE) + ring(0, flange, high - FLANGE, high)
    return out + box((-rig.flag, -flange + 2.0), (-2.0, 2.0), (high - FLANGE, high))


def seated(rig: Rig, out: Manifold) -> Manifold:
    """Return a rotor with the clear aperture, the seat of the wedge, and the threads of M2 screws in its front."""
    high = rig.front_z
    out -= rod(rig.clear, -1, high + 1, sides=SEGMENTS) + rod(
        rig.wedge / 2 + rig.seat, rig.seat_z, high + 1, sides=SEGMENTS
    )
    radius, angles = balance_holes(rig)
    out -= holes(ring_screws(rig)[1], 1.6, high - 8.0, high + 1)
    return out - holes(around(radius, angles), rig.screw[0], high - 8.2, high + 1)


def rear_screws(rig: Rig) -> list[tuple[float, float]]:
    """Return the points of the three M2 screws of the rear ring."""
    return around((rig.clear + rig.bearing.bore / 2) / 2, (90, 210, 330))


def motor_end(rig: Rig) -> float:
    """Return the radius of plate and cover about the motor's axis: room for the pulley, and for the board's nuts."""
    return max(rig.motor_screws[0] / 2 + 5.5, rig.pitch(rig.teeth[1]) + 1.2 + 4.0, 16.5)


def outline(rig: Rig) -> CrossSection:
    """Return the outline of the plate and the cover, without feet and lugs."""
    end = motor_end(rig)
    ends = [
        CrossSection.circle(end, 96).translate((rig.distance + dx, 0)) for dx in (-SLIDE, SLIDE)
    ]
    return CrossSection.batch_boolean(
        [CrossSection.circle(rig.outline, SEGMENTS), *ends], ADD
    ).hull()


def lugs(rig: Rig) -> list[tuple[float, float]]:
    """Return the points of the M3 screws that hold the cover."""
    end, middle = motor_end(rig), rig.distance + SLIDE
    straight = math.degrees(
        math.acos((rig.outline - end) / middle)
    )  # where the outline becomes round at the motor
    at_motor = [(middle + x, y) for x, y in around(end + 3.5, (straight, -straight))]
    return [*around(rig.outline + 3.5, (135, 225)), *at_motor]


def cap_screws(rig: Rig) -> list[tuple[float, float]]:
    """Return the points of the M3 screws that hold the bearing cap. Their heads lie beside the rotor's flange."""
    beside = rig.pulley_flange + rig.clearance + HEADS[3.0][0] / 2 + 0.1
    return around(max(rig.bearing.outer / 2 + 3.5, beside), (70, 180, 290))


def motor_points(rig: Rig) -> list[tuple[float, float]]:
    """Return the points of the M3 screws that hold the motor on its plate. The pulley covers them."""
    return [(rig.distance, side * rig.motor_screws[0] / 2) for side in (-1, 1)]


def plate_screws(rig: Rig) -> list[tuple[float, float]]:
    """Return the points of the M3 screws between the motor's plate and the housing, beside the motor's body."""
    return [(rig.distance - 8.0, side * (rig.motor[0] / 2 + 3.0)) for side in (-1, 1)]


def motor_plate(rig: Rig) -> Manifold:
    """Return the plate of the motor, behind the housing. Its slots allow to tighten the belt from behind."""
    low, high = rig.face_z - PLATE - MOTOR_PLATE, rig.face_z - PLATE
    eyes = [
        CrossSection.circle(4.5, 48).translate((x + dx, y))
        for x, y in plate_screws(rig)
        for dx in (-SLIDE, SLIDE)
    ]
    middle = CrossSection.circle(rig.motor_screws[0] / 2 + 4.5, 96).translate((rig.distance, 0))
    out = (
        CrossSection.batch_boolean([middle, *eyes], ADD)
        .hull()
        .extrude(high - low)
        .translate((0, 0, low))
    )
    out -= holes([(rig.distance, 0)], rig.motor_screws[1] + 0.2, low - 1, high + 1)
    out -= holes(motor_points(rig), 3.4, low - 1, high + 1) + sinks(motor_points(rig), 3.0, high)
    return out - slots(plate_screws(rig), 3.4, SLIDE, low - 1, high + 1)


def with_lugs(rig: Rig) -> CrossSection:
    """Return the outline with the lugs for the cover's screws."""
    eyes = [CrossSection.circle(5.0, 48).translate(point) for point in lugs(rig)]
    return CrossSection.batch_boolean([outline(rig), *eyes], ADD)


def housing(rig: Rig) -> Manifold:
    """Return the housing: barrel of the bearings, plate with a slot for the motor's shaft, foot."""
    out = housing_body(rig) - rod(rig.barrel + 0.025, 2.0, rig.face_z + 1, sides=SEGMENTS)
    out -= rod(rig.centring, -1, 3, sides=SEGMENTS)
    return out - holes(cap_screws(rig), 2.5, rig.face_z - PLATE - 1, rig.face_z + 1)


def housing_body(rig: Rig) -> Manifold:
    """Return the housing without its bores: barrel, plate with a slot for the motor's shaft, foot."""
    face = rig.face_z
    barrel = rig.barrel + 4.0
    circle = CrossSection.circle(barrel, SEGMENTS)
    eyes = [
        (circle + CrossSection.circle(3.2, 48).translate(point)).hull()
        for point in holder_screws(rig)
    ]
    out = with_lugs(rig).extrude(PLATE).translate((0, 0, face - PLATE))
    out += CrossSection.batch_boolean(eyes, ADD).extrude(face)
    out += box(
        (-barrel, barrel), (-rig.height, -0.5), (face - PLATE, face)
    )  # at 0, corners would lie 1e-9 apart
    out += box((-barrel, barrel), (-rig.height, -rig.height + PLATE), (0, face + 20))
    for x in (-barrel, barrel - 4):
        out += box((x, x + 4), (-rig.height, -barrel * 0.5), (0, face))
    out -= slots([(rig.distance, 0)], rig.motor[2] + 2.0, SLIDE, face - PLATE - 1, face + 1)
    out -= holes([*lugs(rig), *plate_screws(rig)], 2.5, face - PLATE - 1, face + 1)
    out -= holes(holder_screws(rig), HEADS[2.5][2], -1, 8)
    return out - upright_holes(rig, foot_holes(rig), 3.3)


def foot_holes(rig: Rig) -> list[tuple[float, float]]:
    """Return x and z of the M4 screws between housing and base."""
    x = rig.barrel - 4.0
    return [(side, z) for side in (-x, x) for z in (4.0, rig.face_z + 15.0)]


def upright_holes(rig: Rig, points: Iterable[tuple[float, float]], diameter: float) -> Manifold:
    """Return holes along y through foot and base, to subtract."""
    made = [
        Manifold.cylinder(30, diameter / 2, diameter / 2, 32)
        .rotate((-90, 0, 0))
        .translate((x, -rig.height - 15, z))
        for x, z in points
    ]
    return Manifold.batch_boolean(made, ADD)


def cap(rig: Rig) -> Manifold:
    """Return the cap that clamps the front bearing's outer ring."""
    outer = math.hypot(*cap_screws(rig)[0]) + 3.0
    return ring(rig.bearing.outside, outer, rig.shoulder_z, cap_z(rig)) - holes(
        cap_screws(rig), 3.4, 0, rig.pulley_z
    )


def cap_z(rig: Rig) -> float:
    """Return the front face of the bearing cap."""
    return rig.shoulder_z + 1.9


def spacer(rig: Rig) -> Manifold:
    """Return the spacer between the bearings' inner rings."""
    return ring(
        rig.bearing.bore / 2 + 0.05,
        rig.bearing.inner,
        rig.bearing_z[0] + rig.bearing.width,
        rig.bearing_z[1],
    )


def rear_ring(rig: Rig) -> Manifold:
    """Return the ring that clamps the bearings' inner rings on the rotor."""
    low, high = rig.bearing_z[0] - 2.5, rig.bearing_z[0]
    out = ring(rig.clear, rig.bearing.inner, low, high) - holes(
        rear_screws(rig), 2.4, low - 1, high + 1
    )
    return out - sinks(rear_screws(rig), 2.0, low, rear=True)


def wedge_ring(rig: Rig) -> Manifold:
    """Return the ring that holds the wedge, over an O-ring: its lip is parallel to the tilted face of the wedge.

    It covers the set screws, so that none can fly out. A notch shows where the thick edge belongs.
    """
    low, high = rig.front_z, rig.front_z + 2.0
    outer = rig.pitch(rig.teeth[0]) + 1.0
    lip = beyond(
        rig, ring(rig.front_clear, rig.wedge / 2 + rig.seat - 0.15, rig.seat_z, low + 0.1), SQUEEZED
    )
    out = (
        ring(rig.front_clear, outer, low, high)
        + lip
        - holes(ring_screws(rig)[1], 2.4, low - 3, high + 1)
    )
    return out - rod(0.8, low - 1, high + 1, outer)


def beyond(rig: Rig, solid: Manifold, distance: float) -> Manifold:
    """Return what of a solid lies further than a distance in front of the wedge's tilted face."""
    normal = (-math.sin(math.radians(rig.apex_deg)), 0.0, math.cos(math.radians(rig.apex_deg)))
    return solid.trim_by_plane(normal, (rig.seat_z + rig.thickness) * normal[2] + distance)


def o_ring(rig: Rig) -> Manifold:
    """Return the squeezed O-ring."""
    outer = rig.wedge / 2 + rig.seat - ROUNDED
    out = beyond(rig, ring(rig.o_ring, outer, rig.seat_z, rig.front_z + 1.0), 0.0)
    return out - beyond(rig, out, SQUEEZED)


def wave_spring(rig: Rig) -> Manifold:
    """Return the space of the compressed wave spring: between the bore and the rear ring, which turns within it."""
    inner = rig.bearing.inner + rig.clearance + 0.02
    return ring(inner, rig.bearing.outer / 2 - 0.25, rig.bearing_z[0] - SPRING, rig.bearing_z[0])


def wedge(rig: Rig) -> Manifold:
    """Return the wedge. Its flat face points to the camera."""
    out = rod(rig.wedge / 2, rig.seat_z, rig.seat_z + 2 * rig.edge, sides=SEGMENTS)
    return out - beyond(rig, out, 0.0)


def cover(rig: Rig) -> Manifold:
    """Return the cover: guard of the belt and the rotor, hood, and mount of fork barrier and encoder board."""
    low, inside, high = rig.face_z, rig.cover_z, rig.cover_z + 2.0
    shape = outline(rig)
    out = with_lugs(rig).extrude(4.0).translate((0, 0, low))
    out += shape.extrude(high - low - 2.0).translate((0, 0, low + 2.0))
    out += box((-12, 12), (0, rig.outline + 1), (high - 18.0, high))
    out -= shape.offset(-2.0).extrude(inside - low + 1).translate((0, 0, low - 1))
    out -= Manifold.cylinder(2.02, rig.opening, rig.opening + 2.02, SEGMENTS).translate(
        (0, 0, inside - 0.01)
    )
    out -= holes(lugs(rig), 3.4, low - 1, low + 5)
    z = rig.front_z - FLANGE / 2
    side, half = FORK_LENGTH / 2 + 0.4, FORK_WIDTH / 2 + 0.4
    out -= box((-side, side), (rig.outline - 10, rig.outline + 2), (z - half, z + half))
    out -= screw_holes(fork_screws(rig), 1.6, 5.0)
    out -= slots([(rig.distance, 0)], 11.6, SLIDE, inside - 1, high + 1)
    return out - slots(board_screws(rig), 2.7, SLIDE, inside - 1, high + 1)


def fork_screws(rig: Rig) -> list[tuple[float, float, float]]:
    """Return the points of the M2 screws that hold the fork barrier's board on the cover."""
    return [(x, rig.outline + 1, rig.front_z - FLANGE / 2) for x in (-7.0, 7.0)]


def screw_holes(
    points: Iterable[tuple[float, float, float]], diameter: float, depth: float
) -> Manifold:
    """Return round holes downwards from points, which begin 3 mm above them, to subtract."""
    one = rod(diameter / 2, -depth, 3.0, sides=32).rotate((-90, 0, 0))
    return Manifold.batch_boolean([one.translate(point) for point in points], ADD)


def board_screws(rig: Rig) -> list[tuple[float, float]]:
    """Return the points of the M2.5 screws that hold the encoder's board on the cover."""
    return [(rig.distance, y) for y in (-11.5, 11.5)]


def magnet_cup(rig: Rig) -> Manifold:
    """Return the cup that holds the encoder's magnet on the motor's shaft."""
    low, high = rig.front_z + 0.5, magnet_z(rig)
    out = rod(5.0, low, high)
    out -= rod(3.02, high - 2.0, high + 1) + rod(rig.motor[2] / 2 + 0.02, low - 1, low + 2.5)
    return out.translate((rig.distance, 0, 0))


def magnet_z(rig: Rig) -> float:
    """Return z of the magnet's front: 1.1 mm of chip and 1 mm of air behind the board on the cover."""
    return rig.cover_z + 2.0 - 2.1


def holder_screws(rig: Rig) -> list[tuple[float, float]]:
    """Return the points of the M2.5 screws that hold the holder on the housing. A key passes beside the camera."""
    x = max(rig.camera[0] / 2 + HEADS[2.5][0] / 2 + 0.1, (rig.barrel + 2.0) / math.sqrt(2))
    return [(i * x, j * x) for i, j in ((1, 1), (-1, 1), (-1, -1), (1, -1))]


def holder(rig: Rig) -> Manifold:
    """Return the holder of the camera: plate with a spigot in the housing's bore, and a split clamp behind it.

    The clamp grips the ring between camera and lens. If the lens is slimmer than the ring, the ring lies on a lip.
    """
    (wide, _), front = rig.grip, rig.grip_z
    rear, outer = front - rig.grip[1] + 0.1, clamp_radius(rig)
    eyes = [CrossSection.circle(4.0, 48).translate(point) for point in holder_screws(rig)]
    plate = CrossSection.batch_boolean(
        [CrossSection.circle(rig.barrel + 4.0, SEGMENTS), *eyes], ADD
    ).hull()
    out = plate.extrude(HOLDER).translate((0, 0, -HOLDER)) + ring(0, outer, rear, -HOLDER)
    out += ring(0, rig.centring - 0.05, -0.1, 1.5)
    y = clamp_y(rig)
    out += box((-CLAMP, CLAMP), (outer - 3.0, y + 3.5), (rear, front + LIP))
    out -= box((-50, 50), (-0.35 * outer, 100), (front + LIP, front + LIP + SLIT))
    out -= box((-1, 1), (0, 100), (rear - 1, front + LIP + SLIT))
    spigot = rig.spigot
    out -= rod(rig.lens / 2 + 1.0, front - 0.1, 2.0 if rig.enters else -1.0, sides=SEGMENTS)
    out -= rod(spigot, 0.0, 2.0, sides=SEGMENTS) + rod(
        min(spigot, rig.lens / 2 + 1.0), -1.1, 2.0, sides=SEGMENTS
    )
    out -= rod(wide / 2 + 0.1, rear - 1, front, sides=SEGMENTS)
    out -= rod(1.35, -20, 20).rotate((0, 90, 0)).translate((0, y, clamp_z(rig)))
    points = holder_screws(rig)
    return out - holes(points, 2.9, -HOLDER - 1, 1) - holes(points, 5.2, rear - 1, -HOLDER)


CLAMP = 6.0
"""Distance of the clamp's outer faces from the middle [mm]."""


def clamp_radius(rig: Rig) -> float:
    """Return the outer radius of the clamp: walls of 4 mm around the ring, or the lens that passes through it."""
    return max(rig.grip[0], rig.lens + 2.0) / 2 + 4.0


def clamp_y(rig: Rig) -> float:
    """Return the height of the clamp's M2.5 screw above the axis."""
    return clamp_radius(rig) + 3.5


def clamp_z(rig: Rig) -> float:
    """Return z of the clamp's screw, in the middle of the clamp."""
    return rig.grip_z + (LIP - rig.grip[1] + 0.1) / 2


def camera_z(rig: Rig) -> tuple[float, float]:
    """Return the rear and the front face of the camera's body."""
    high = rig.grip_z - rig.grip[1]
    return high - rig.camera[2], high


def base(rig: Rig) -> Manifold:
    """Return the base plate."""
    x, low = rig.barrel + 8.0, camera_z(rig)[0]
    y = (-rig.height - 6.0, -rig.height)
    out = box((-x, x), y, (low - 12, rig.face_z + 32))
    out -= upright_holes(rig, foot_holes(rig), 4.4)
    corners = [(side, z) for side in (-x + 6, x - 6) for z in (low - 6, rig.face_z + 26)]
    return out - upright_holes(rig, corners, 4.4)


def belt(rig: Rig) -> Manifold:
    """Return the belt without its teeth."""
    inner, outer = (
        CrossSection.batch_boolean(
            [
                CrossSection.circle(rig.pitch(teeth) - PITCH_LINE + more, SEGMENTS).translate(
                    (x, 0)
                )
                for teeth, x in zip(rig.teeth, (0.0, rig.distance), strict=True)
            ],
            ADD,
        ).hull()
        for more in (0.02, 0.02 + BELT_BACK)
    )
    low = rig.pulley_z + FLANGE + (BELT_ROOM - BELT_WIDTH) / 2
    return (outer - inner).extrude(BELT_WIDTH).translate((0, 0, low))


def motor(rig: Rig) -> Manifold:
    """Return the motor with its shaft."""
    body, length, shaft = rig.motor
    rear = rig.face_z - PLATE - MOTOR_PLATE
    out = rod(body / 2, rear - length, rear, sides=96)
    out += rod(rig.motor_screws[1] / 2, rear - 1, rear + 3) + rod(
        shaft / 2, rear, rig.front_z + 3.0
    )
    return out.translate((rig.distance, 0, 0)) - holes(
        motor_points(rig), 2.5, rear - MOTOR_THREAD, rear + 1
    )


def motor_pulley(rig: Rig) -> Manifold:
    """Return the motor's pulley, with an M3 thread for the set screw that holds it on the shaft."""
    low, high, flange = rig.pulley_z, rig.front_z, rig.pitch(rig.teeth[1]) + 1.2
    out = pulley(rig.teeth[1]).extrude(high - low).translate((0, 0, low))
    out += rod(flange, low, low + FLANGE, sides=96) + rod(flange, high - FLANGE, high, sides=96)
    out -= rod(rig.motor[2] / 2 + 0.02, low - 1, high + 1)
    thread = (
        Manifold.cylinder(30, 1.25, 1.25, 24).rotate((0, 90, 0)).translate((0, 0, (low + high) / 2))
    )
    return (out - thread).translate((rig.distance, 0, 0))


def fork(rig: Rig) -> Manifold:
    """Return the fork barrier of the index, and its board."""
    z, top = rig.front_z - FLANGE / 2, rig.outline + 1
    half, side = FORK_WIDTH / 2, FORK_LENGTH / 2
    out = box((-side, side), (top - FORK_DEPTH, top), (z - half, z + half))
    slot = FORK_SLOT / 2
    out -= box(
        (-5, 5), (top - FORK_DEPTH - 1, top - FORK_DEPTH + FORK_SLOT_DEPTH), (z - slot, z + slot)
    )
    board = box((-10, 10), (top, top + 1.6), (rig.cover_z - 15.0, rig.cover_z + 1.0))
    return out + board - screw_holes(fork_screws(rig), 2.2, 1.0)


def encoder(rig: Rig) -> Manifold:
    """Return the magnetic encoder's chip and board."""
    low = rig.cover_z + 2.0
    out = box((-2.5, 2.5), (-2.5, 2.5), (low - 1.1, low)) + box(
        (-11, 11), (-14, 14), (low, low + 1.6)
    )
    return out.translate((rig.distance, 0, 0)) - holes(board_screws(rig), 2.7, low - 1, low + 3)


def camera(rig: Rig) -> Manifold:
    """Return the camera's body."""
    width, tall, _ = rig.camera
    return box((-width / 2, width / 2), (-tall / 2, tall / 2), camera_z(rig))


def mount_ring(rig: Rig) -> Manifold:
    """Return the ring between camera and lens, which the holder grips, without its threads."""
    return ring(11.0, rig.grip[0] / 2, rig.grip_z - rig.grip[1], rig.grip_z)


def bearing_solids(rig: Rig) -> list[Manifold]:
    """Return both bearings as plain rings."""
    made = rig.bearing
    return [ring(made.bore / 2, made.outer / 2, z, z + made.width) for z in rig.bearing_z]


def fork_and_clamp(rig: Rig) -> tuple[Manifold, Manifold]:
    """Return the screws of the fork barrier, and the screw of the clamp with its nut."""
    fork = [(x, y + 1.6, z) for x, y, z in fork_screws(rig)]
    y, z = clamp_y(rig), clamp_z(rig)
    clamp = screws(2.5, 16.0, 16.0, [(-CLAMP, y, z)], (0.0, -90.0, 0.0))
    clamp += (
        (rod(2.75, CLAMP, CLAMP + 2.0, sides=6) - rod(1.25, 0, 20))
        .rotate((0, 90, 0))
        .translate((0, y, z))
    )
    return screws(2.0, 5.0, 1.6, fork, (-90.0, 0.0, 0.0)), clamp


def board_nuts(rig: Rig) -> Manifold:
    """Return the nuts of the encoder's board."""
    nuts = holes(board_screws(rig), 5.5, rig.cover_z - 2.0, rig.cover_z)
    return nuts - holes(board_screws(rig), 2.5, rig.cover_z - 3.0, rig.cover_z + 1.0)


def screw_solids(rig: Rig) -> list[tuple[str, str, Manifold, tuple[float, float, float]]]:
    """Return the screws: name, what they move with, solids, and how far the exploded view moves them.

    Left out are the set screws.
    """
    behind, up = (180.0, 0.0, 0.0), (90.0, 0.0, 0.0)
    low, board = rig.face_z - PLATE, rig.cover_z + 3.6
    fork, clamp = fork_and_clamp(rig)
    foot = [(x, -rig.height - 6.0, z) for x, z in foot_holes(rig)]
    cap_at, cover_at = at_z(cap_screws(rig), cap_z(rig)), at_z(lugs(rig), rig.face_z + 4.0)
    ring_at, rear_at = (
        at_z(ring_screws(rig)[1], rig.front_z + 2.0),
        at_z(rear_screws(rig), rig.bearing_z[0] - 2.5),
    )
    holder_at, motor_at = at_z(holder_screws(rig), -HOLDER), at_z(motor_points(rig), low)
    plate_at, board_at = at_z(plate_screws(rig), low - MOTOR_PLATE), at_z(board_screws(rig), board)
    return [
        ("screws of the cap", "", screws(3.0, 6.0, 1.9, cap_at), (0, 0, 64)),
        ("screws of the cover", "", screws(3.0, 8.0, 4.0, cover_at), (0, 0, 162)),
        ("screws of the wedge ring", "prism", screws(2.0, 8.0, 2.0, ring_at), (0, 0, 106)),
        (
            "screws of the rear ring",
            "prism",
            screws(2.0, 8.0, 2.5, rear_at, behind, sunk=True),
            (0, 0, 12),
        ),
        ("screws of the holder", "", screws(2.5, 8.0, HOLDER, holder_at, behind), (0, 0, -40)),
        ("screw of the clamp", "", clamp, (0, 12, -24)),
        ("screws of the motor", "", screws(3.0, 6.0, MOTOR_PLATE, motor_at, sunk=True), (0, 0, -8)),
        (
            "screws of the motor plate",
            "",
            screws(3.0, 8.0, MOTOR_PLATE, plate_at, behind),
            (0, 0, -20),
        ),
        ("screws of the base", "", screws(4.0, 12.0, 6.0, foot, up), (0, -42, 0)),
        ("screws of the fork barrier", "", fork, (0, 38, 150)),
        (
            "screws of the encoder board",
            "",
            screws(2.5, 8.0, 8.0, board_at) + board_nuts(rig),
            (0, 0, 176),
        ),
    ]


def printed(name: str, solid: Manifold, moves: str, apart: tuple[float, float, float]) -> Part:
    """Return a printed part.

    STL files have float32 numbers, in which no two corners may become one, nor nearly: short edges are removed until
    none do.
    """
    for more in (1, 2, 4, 8):
        solid = solid.simplify(more * ROUNDED)
        corners = np.asarray(solid.to_mesh64().vert_properties)[:, :3].astype(np.float32).round(5)
        if len(np.unique(corners, axis=0)) == len(corners):
            break
    return Part(name, solid, "printed", moves, solid.volume() * PETG, apart)


@lru_cache(maxsize=4)
def assembly(rig: Rig) -> tuple[Part, ...]:
    """Return all parts in their places."""
    glass = wedge(rig)
    rear, front = bearing_solids(rig)
    mass = rig.bearing.mass
    rubber, spring = o_ring(rig), wave_spring(rig)
    magnet = rod(3.0, magnet_z(rig) - 2.0, magnet_z(rig), rig.distance)
    return (
        printed("base", base(rig), "", (0, -30, 0)),
        Part("mount ring", mount_ring(rig), "bought", "", 10.0, (0, 0, -68)),
        Part("camera", camera(rig), "bought", "", 80.0, (0, 0, -88)),
        printed("holder", holder(rig), "", (0, 0, -24)),
        Part("motor", motor(rig), "bought", "", 90.0 if rig.motor[0] < 30 else 160.0, (0, 0, -24)),
        printed("housing", housing(rig), "", (0, 0, 0)),
        printed("rear ring", rear_ring(rig), "prism", (0, 0, 18)),
        Part("rear bearing", rear, "bought", "", mass, (0, 0, 32)),
        printed("spacer", spacer(rig), "prism", (0, 0, 40)),
        Part("front bearing", front, "bought", "", mass, (0, 0, 48)),
        printed("bearing cap", cap(rig), "", (0, 0, 58)),
        printed("rotor", rotor(rig), "prism", (0, 0, 72)),
        Part("belt", belt(rig), "bought", "belt", 4.0, (0, 0, 72)),
        printed("motor pulley", motor_pulley(rig), "motor", (0, 0, 72)),
        printed("magnet cup", magnet_cup(rig), "motor", (0, 0, 82)),
        Part("magnet", magnet, "bought", "motor", magnet.volume() * 7.5e-3, (0, 0, 92)),
        Part("wedge", glass, "glass", "prism", glass.volume() * GLASS, (0, 0, 88)),
        printed("wedge ring", wedge_ring(rig), "prism", (0, 0, 100)),
        printed("cover", cover(rig), "", (0, 0, 150)),
        Part("fork barrier", fork(rig), "bought", "", 2.0, (0, 30, 150)),
        Part("encoder board", encoder(rig), "bought", "", 4.0, (0, 0, 168)),
        printed("motor plate", motor_plate(rig), "", (0, 0, -14)),
        Part("O-ring", rubber, "bought", "prism", rubber.volume() * RUBBER, (0, 0, 94)),
        Part(
            "lens", ring(0, rig.lens / 2, rig.grip_z, rig.lens_z), "bought", "", 50.0, (0, 0, -46)
        ),
        Part(
            "wave spring", spring, "bought", "", spring.volume() / SPRING * BAND * STEEL, (0, 0, 25)
        ),
        *(
            Part(n, each, "screws", moves, each.volume() * STEEL, apart)
            for n, moves, each, apart in screw_solids(rig)
        ),
    )


TOUCHES = 1e-3
"""Largest volume by which two parts may overlap, as circles have corners [mm³]."""


def swept(solid: Manifold, x: float = 0.0) -> Manifold:
    """Return the space that a solid passes when it turns about the axis along z at x: its half cuts, turned."""
    half = CrossSection.square((1e3, 2e3)).translate((0.0, -1e3))
    upright = solid.translate((-x, 0, 0))
    cuts = [
        upright.rotate((0, 0, 7.5 * k)).rotate((-90, 0, 0)).slice(0.0) ^ half for k in range(48)
    ]
    profile = CrossSection.batch_boolean(cuts, ADD)
    return profile.revolve(SEGMENTS).translate((x, 0, 0))


def problems(rig: Rig, made: Sequence[Part]) -> list[str]:
    """Return what is wrong with the solids: pieces, overlaps, and gaps between what moves and what does not."""
    out = []
    for part in made:
        if len(part.solid.decompose()) != 1 and part.kind == "printed":
            out.append(f"{part.name} is in several pieces")
    axes = {"prism": 0.0, "motor": rig.distance}
    passed = [
        swept(part.solid, axes[part.moves]) if part.moves in axes else part.solid for part in made
    ]
    for (one, first), (other, second) in itertools.combinations(zip(made, passed, strict=True), 2):
        names = {one.name, other.name}
        fits = one.moves == other.moves or bool(FITS & names) or names in RUNS
        overlap = (one.solid ^ other.solid if fits else first ^ second).volume()
        if overlap > TOUCHES:
            out.append(f"{one.name} and {other.name} overlap by {overlap:.3f} mm³")
        if fits:
            continue
        gap = first.min_gap(second, rig.clearance)
        if gap < rig.clearance - 1e-4:
            out.append(
                f"{one.name} and {other.name} are {gap:.2f} mm apart, less than {rig.clearance} mm"
            )
    return out


FITS = {"rear bearing", "front bearing"}
"""Parts that touch what turns and what does not."""
RUNS = (
    {"belt", "rotor"},
    {"belt", "motor pulley"},
    {"motor", "motor pulley"},
    {"motor", "magnet cup"},
    {"belt", "encoder pulley"},
    {"belt", "cell"},
    {"stator", "bell"},
)
"""Pairs that touch, though they do not move in the same way."""
