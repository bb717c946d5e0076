"""A rig whose prism sits on a brushless motor with a hollow shaft, without a belt to drive it.

The light passes the motor's bore, so no magnet can stand on the prism's axis, where an AS5047P needs it (see
:mod:`rig.magnet`). A belt turns an encoder shaft beside the motor, twice per turn of the prism, and the magnet stands
on its end. The index on the prism tells the two turns apart. Frame and units are as in :mod:`rig.parts`.
"""

from dataclasses import dataclass, field
from functools import lru_cache

from manifold3d import CrossSection, Manifold

from rig import parts
from rig.parts import (
    ADD,
    GLASS,
    HEADS,
    HOLDER,
    LEAST_WALL,
    MOTOR_PLATE,
    PLATE,
    RUBBER,
    SEGMENTS,
    SLIDE,
    STEEL,
    Part,
    Rig,
    around,
    at_z,
    holes,
    printed,
    ring,
    rod,
    screws,
    sinks,
    slots,
)

HEAD = 3.2
"""Depth of the holes for the heads of the screws between cell and motor."""
GRIP = 2.0
"""Least thickness of the cell under these heads."""
SUNK = HEADS[3.0][0] / 2 + 0.15
"""Radius of a countersink for M3."""
SMALL = (5.0, 16.0, 5.0)
"""Bearings of the encoder shaft, 625: bore, outer diameter, width."""
TUBE = 11.0
"""Radius of the encoder block's tube."""


@dataclass(frozen=True)
class HollowMotor:
    """Brushless outrunner with a hollow shaft [mm]. Its rear face is screwed to the housing, its front face turns."""

    outer: float = 80.0
    height: float = 22.0
    bore: float = 36.0
    stator_circle: float = 46.0
    """Diameter of the circle of four M3 threads in the rear face."""
    rotor_circle: float = 44.0
    """Diameter of the circle of four M3 threads in the front face."""
    thread: float = 4.0
    """Depth of these threads. The check of overlaps finds a screw that reaches their bottom."""
    mass: tuple[float, float] = (110.0, 90.0)
    """Masses of stator and bell [g]."""
    kv: float = 140.0
    """Speed without load for each volt of the supply [turns/min/V]."""
    resistance: float = 2.0
    """Between two of its wires [Ω]."""
    slots: int = 24
    poles: int = 28
    cogging: float = 8.0
    """Amplitude of the cogging torque [mN m]."""
    friction: float = 20.0
    """Friction of its bearings and of the encoder's belt [mN m]."""
    current: float = 1.5
    """Current limit of the driver [A]."""


@dataclass(frozen=True)
class GimbalRig(Rig):
    """Dimensions of a rig with a hollow-shaft motor; ``motor`` holds the encoder block's tube instead of a motor."""

    hollow: HollowMotor = field(default_factory=HollowMotor)

    @property
    def barrel(self) -> float:
        """Radius of the housing's bore, in which the bell turns."""
        return self.hollow.outer / 2 + self.clearance + 0.3

    @property
    def centring(self) -> float:
        """Radius of the opening in the housing's rear: the motor's bore."""
        return self.hollow.bore / 2

    @property
    def spigot(self) -> float:
        """Radius within the holder's spigot."""
        return self.centring - 2.0

    @property
    def clear(self) -> float:
        """Radius of the clear aperture behind the wedge: motor's bore, and wall beside the heads of the screws."""
        beside = self.hollow.rotor_circle / 2 - HEADS[3.0][0] / 2 - 0.15 - LEAST_WALL
        return min(self.front_clear, self.hollow.bore / 2, beside)

    @property
    def thickest_edge(self) -> float:
        """Largest thick edge of a wedge; the cell grows with it."""
        return 20.0

    @property
    def shoulder_z(self) -> float:
        """Front face of the motor, on which the cell is screwed."""
        return PLATE + self.hollow.height

    @property
    def pulley_z(self) -> float:
        """Rear face of the cell's pulley: behind the seat there is room for the heads of the screws."""
        needed = GRIP + HEAD + 1.3 + self.edge - (2 * parts.FLANGE + parts.BELT_ROOM)
        return self.shoulder_z + max(2.6, needed)


GIMBAL = GimbalRig(
    "gimbal",
    50.8,
    5.0,
    1.0,
    (100, 50),
    300.0,
    "68",
    17.0,
    5.0,
    4.0,
    (2 * TUBE, 20.0, SMALL[0]),
    (24.0, 10.0),
    threads=("cs", "m12"),
    screw=(2.5, 3.0),
)


KINDS: tuple[Rig, ...] = (*parts.RIGS, GIMBAL)
"""All rigs that are drawn."""


def stator_points(rig: GimbalRig) -> list[tuple[float, float]]:
    """Return the points of the M3 screws between housing and motor."""
    return around(rig.hollow.stator_circle / 2, (45, 135, 225, 315))


def rotor_points(rig: GimbalRig) -> list[tuple[float, float]]:
    """Return the points of the M3 screws between motor and cell."""
    return around(rig.hollow.rotor_circle / 2, (0, 90, 180, 270))


def housing(rig: GimbalRig) -> Manifold:
    """Return the housing: wall that carries the motor, barrel around its bell, plate of the encoder block, foot."""
    out = parts.housing_body(rig) - rod(rig.barrel, PLATE, rig.face_z + 1, sides=SEGMENTS)
    out -= rod(rig.centring, -1, PLATE + 1, sides=SEGMENTS)
    out -= holes(stator_points(rig), 3.4, -1, PLATE + 1) + sinks(
        stator_points(rig), 3.0, 0.0, rear=True
    )
    # the motor's wires leave upwards
    return out - parts.box((-5, 5), (0, rig.barrel + 5), (PLATE, PLATE + 4))


def stator(rig: GimbalRig) -> Manifold:
    """Return what of the motor stands still."""
    motor = rig.hollow
    out = ring(motor.bore / 2 + 1.7, motor.outer / 2 - 3.7, PLATE, rig.shoulder_z - 4.0)
    return out - holes(stator_points(rig), 2.5, PLATE - 1, PLATE + motor.thread)


def bell(rig: GimbalRig) -> Manifold:
    """Return what of the motor turns: bell with its magnets, and hollow shaft."""
    motor, top = rig.hollow, rig.shoulder_z
    out = ring(motor.bore / 2, motor.outer / 2, PLATE + 1.5, top)
    out -= ring(motor.bore / 2 + 1.0, motor.outer / 2 - 3.0, PLATE + 0.5, top - 2.3)
    return out - holes(rotor_points(rig), 2.5, top - motor.thread, top + 1)


def cell(rig: GimbalRig) -> Manifold:
    """Return the cell of the prism: base on the motor, pulley of the encoder's belt, seat of the wedge, index flag."""
    base = max(rig.hollow.rotor_circle / 2 + 4.0, rig.wedge / 2 + rig.seat + 2.0)
    out = ring(0, base, rig.shoulder_z, rig.pulley_z + 0.1) + parts.rim(rig)
    out = parts.seated(rig, out)
    out -= holes(rotor_points(rig), 3.4, rig.shoulder_z - 1, rig.seat_z + 1)
    return out - holes(rotor_points(rig), HEADS[3.0][0] + 0.3, rig.seat_z - HEAD, rig.seat_z + 1)


def block_z(rig: GimbalRig) -> tuple[float, float]:
    """Return the rear and the front face of the encoder block."""
    high = rig.face_z - PLATE
    return high - rig.motor[1], high


def block(rig: GimbalRig) -> Manifold:
    """Return the encoder block, which slides on the housing's rear: plate, and tube with the seats of two bearings."""
    rear, high = block_z(rig)
    low = high - MOTOR_PLATE
    points = parts.plate_screws(rig)
    eyes = [
        CrossSection.circle(4.5, 48).translate((x + dx, y))
        for x, y in points
        for dx in (-SLIDE, SLIDE)
    ]
    tube = CrossSection.circle(TUBE, 96).translate((rig.distance, 0))
    out = (
        CrossSection.batch_boolean([tube, *eyes], ADD)
        .hull()
        .extrude(MOTOR_PLATE)
        .translate((0, 0, low))
    )
    out += rod(TUBE - 0.05, rear, high, rig.distance, sides=96)
    seat = SMALL[1] / 2 + 0.025
    out -= rod(6.0, rear - 1, high + 1, rig.distance, sides=96)
    out -= rod(seat, rear - 1, rear + SMALL[2], rig.distance, sides=96)
    out -= rod(seat, high - SMALL[2] - 0.7, high + 1, rig.distance, sides=96)
    return out - slots(points, 3.4, SLIDE, low - 1, high + 1)


def small_bearings(rig: GimbalRig) -> list[Manifold]:
    """Return the bearings of the encoder shaft: the front one is 0.7 mm behind the housing's plate."""
    rear, high = block_z(rig)
    at = (rear, high - SMALL[2] - 0.7)
    return [
        ring(SMALL[0] / 2, SMALL[1] / 2, z, z + SMALL[2]).translate((rig.distance, 0, 0))
        for z in at
    ]


def shaft(rig: GimbalRig) -> Manifold:
    """Return the encoder shaft."""
    return rod(SMALL[0] / 2, block_z(rig)[0] - 1.0, rig.front_z + 3.0, rig.distance)


def screw_solids(rig: GimbalRig) -> list[tuple[str, str, Manifold, tuple[float, float, float]]]:
    """Return the screws, as :func:`rig.parts.screw_solids`."""
    behind, up = (180.0, 0.0, 0.0), (90.0, 0.0, 0.0)
    fork, clamp = parts.fork_and_clamp(rig)
    foot = [(x, -rig.height - 6.0, z) for x, z in parts.foot_holes(rig)]
    plate_at = at_z(parts.plate_screws(rig), rig.face_z - PLATE - MOTOR_PLATE)
    cover_at, ring_at = (
        at_z(parts.lugs(rig), rig.face_z + 4.0),
        at_z(parts.ring_screws(rig)[1], rig.front_z + 2.0),
    )
    cell_at, stator_at = at_z(rotor_points(rig), rig.seat_z - HEAD), at_z(stator_points(rig), 0.0)
    grip = rig.seat_z - HEAD - rig.shoulder_z
    holder_at, board_at = (
        at_z(parts.holder_screws(rig), -HOLDER),
        at_z(parts.board_screws(rig), rig.cover_z + 3.6),
    )
    return [
        (
            "screws of the motor",
            "",
            screws(3.0, 8.0, PLATE, stator_at, behind, sunk=True),
            (0, 0, -12),
        ),
        ("screws of the cell", "prism", screws(3.0, 5.0, grip, cell_at), (0, 0, 82)),
        ("screws of the cover", "", screws(3.0, 8.0, 4.0, cover_at), (0, 0, 162)),
        ("screws of the wedge ring", "prism", screws(2.0, 8.0, 2.0, ring_at), (0, 0, 118)),
        ("screws of the holder", "", screws(2.5, 8.0, HOLDER, holder_at, behind), (0, 0, -40)),
        ("screw of the clamp", "", clamp, (0, 12, -24)),
        (
            "screws of the encoder block",
            "",
            screws(3.0, 8.0, MOTOR_PLATE, plate_at, behind),
            (0, 46, -34),
        ),
        ("screws of the base", "", screws(4.0, 12.0, 6.0, foot, up), (0, -42, 0)),
        ("screws of the fork barrier", "", fork, (0, 38, 150)),
        (
            "screws of the encoder board",
            "",
            screws(2.5, 8.0, 8.0, board_at) + parts.board_nuts(rig),
            (0, 0, 176),
        ),
    ]


@lru_cache(maxsize=4)
def assembly(rig: GimbalRig) -> tuple[Part, ...]:
    """Return all parts in their places, as :func:`rig.parts.assembly`."""
    glass, rubber, pin = parts.wedge(rig), parts.o_ring(rig), shaft(rig)
    rear, front = small_bearings(rig)
    magnet = rod(3.0, parts.magnet_z(rig) - 2.0, parts.magnet_z(rig), rig.distance)
    lens = ring(0, rig.lens / 2, rig.grip_z, rig.lens_z)
    return (
        printed("base", parts.base(rig), "", (0, -30, 0)),
        Part("mount ring", parts.mount_ring(rig), "bought", "", 10.0, (0, 0, -68)),
        Part("camera", parts.camera(rig), "bought", "", 80.0, (0, 0, -88)),
        printed("holder", parts.holder(rig), "", (0, 0, -24)),
        printed("housing", housing(rig), "", (0, 0, 0)),
        Part("stator", stator(rig), "bought", "", rig.hollow.mass[0], (0, 0, 40)),
        Part("bell", bell(rig), "bought", "prism", rig.hollow.mass[1], (0, 0, 58)),
        printed("cell", cell(rig), "prism", (0, 0, 72)),
        Part("belt", parts.belt(rig), "bought", "belt", 4.0, (0, 0, 72)),
        printed("encoder block", block(rig), "", (0, 46, -26)),
        Part("rear bearing", rear, "bought", "", 5.0, (0, 46, -46)),
        Part("front bearing", front, "bought", "", 5.0, (0, 46, -6)),
        Part("encoder shaft", pin, "bought", "motor", pin.volume() * STEEL, (0, 46, 22)),
        printed("encoder pulley", parts.motor_pulley(rig), "motor", (0, 0, 72)),
        printed("magnet cup", parts.magnet_cup(rig), "motor", (0, 0, 82)),
        Part("magnet", magnet, "bought", "motor", magnet.volume() * 7.5e-3, (0, 0, 92)),
        Part("wedge", glass, "glass", "prism", glass.volume() * GLASS, (0, 0, 96)),
        printed("wedge ring", parts.wedge_ring(rig), "prism", (0, 0, 112)),
        printed("cover", parts.cover(rig), "", (0, 0, 150)),
        Part("fork barrier", parts.fork(rig), "bought", "", 2.0, (0, 30, 150)),
        Part("encoder board", parts.encoder(rig), "bought", "", 4.0, (0, 0, 168)),
        Part("O-ring", rubber, "bought", "prism", rubber.volume() * RUBBER, (0, 0, 104)),
        Part("lens", lens, "bought", "", 50.0, (0, 0, -46)),
        *(
            Part(n, each, "screws", moves, each.volume() * STEEL, apart)
            for n, moves, each, apart in screw_solids(rig)
        ),
    )
