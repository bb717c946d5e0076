"""What the mechanics do: balance, forces, friction, stress, vignetting, and the error that tolerances cost [px].

Sources: ISO 21940-11 (balance grades, before: ISO 1940), Palmgren's friction of rolling bearings as in Harris, *Rolling
Bearing Analysis*, and the thin rotating disc of Timoshenko and Goodier, *Theory of Elasticity*.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Self

import numpy as np
from numpy.typing import NDArray

import amiwarp
from rig import gimbal, parts
from rig.parts import GLASS, PETG, STEEL, Part, Rig

SPEEDS = (720.0, 1440.0)
OVERSPEED = 3000.0
"""Highest speed that the host accepts by default [turns/min]."""
LENGTHS = (0.0, 3.0, 4.0, 5.0, 6.0, 8.0)
"""Lengths of set screws [mm]; 0 for an empty hole."""
GRAVITY = 9.81


def omega(rpm: float) -> float:
    """Return the angular speed [rad/s]."""
    return rpm * 2 * math.pi / 60


@dataclass(frozen=True)
class Body:
    """Mass properties in the rig's frame."""

    mass: float
    """Mass [g]."""
    centre: NDArray[np.float64]
    """Centre of mass [mm], shape (3,)."""
    inertia: NDArray[np.float64]
    """Inertia tensor about the origin [g mm²], shape (3, 3)."""

    @classmethod
    def of(cls, part: Part) -> Self:
        """Return those of a part, by trimesh."""
        mesh = to_mesh(part)
        mesh.density = part.mass / mesh.volume
        centre, mass = np.asarray(mesh.center_mass), float(mesh.mass)
        about = np.asarray(mesh.moment_inertia)
        return cls(
            mass, centre, about + mass * (centre @ centre * np.eye(3) - np.outer(centre, centre))
        )

    def __add__(self, other: Self) -> Self:
        mass = self.mass + other.mass
        centre = (self.mass * self.centre + other.mass * other.centre) / mass
        return type(self)(mass, centre, self.inertia + other.inertia)


def point(mass: float, x: float, y: float, z: float) -> Body:
    """Return a small mass."""
    at = np.array([x, y, z])
    return Body(mass, at, mass * (at @ at * np.eye(3) - np.outer(at, at)))


def to_mesh(part: Part):
    """Return a part as a mesh of trimesh."""
    import trimesh

    mesh = part.solid.to_mesh64()
    return trimesh.Trimesh(
        np.asarray(mesh.vert_properties)[:, :3], np.asarray(mesh.tri_verts), process=False
    )


def in_file(part: Part):
    """Return a part as a mesh of trimesh with the float32 numbers of an STL file, where near points become one."""
    import trimesh

    mesh = to_mesh(part)
    return trimesh.Trimesh(mesh.vertices.astype(np.float32), mesh.faces, process=True)


def assembly(rig: Rig) -> tuple[Part, ...]:
    """Return all parts of a rig with a belt or with a hollow-shaft motor."""
    return gimbal.assembly(rig) if isinstance(rig, gimbal.GimbalRig) else parts.assembly(rig)


@lru_cache(maxsize=4)
def bodies(rig: Rig) -> tuple[Body, ...]:
    """Return the mass properties of all parts."""
    return tuple(Body.of(part) for part in assembly(rig))


def rotating(rig: Rig) -> Body:
    """Return the body that turns: printed parts, wedge, screws of the rings, and the inner half of the bearings.

    With a hollow-shaft motor it is its bell instead of bearings.
    """
    turning = [
        body for part, body in zip(assembly(rig), bodies(rig), strict=True) if part.moves == "prism"
    ]
    rings = []
    if not isinstance(rig, gimbal.GimbalRig):
        rings = [
            point(rig.bearing.mass * 0.45, 0.0, 0.0, z + rig.bearing.width / 2)
            for z in rig.bearing_z
        ]
    total = turning[0]
    for body in (*turning[1:], *rings):
        total = total + body
    return total


def wedge_unbalance(rig: Rig) -> float:
    """Return the unbalance of the wedge [g mm]: ρ π R⁴ tan α / 4, whatever its thickness."""
    return GLASS * math.pi * (rig.wedge / 2) ** 4 * math.tan(math.radians(rig.apex_deg)) / 4


def unbalance(body: Body) -> NDArray[np.float64]:
    """Return the unbalance in x and y [g mm]."""
    return body.mass * body.centre[:2]


def screw_mass(rig: Rig, length: float) -> float:
    """Return the mass of a set screw [g]: a cylinder of 0.87 diameters, less 15 % for its socket."""
    return 0.85 * STEEL * math.pi / 4 * (0.87 * rig.screw[1]) ** 2 * length


def balance(rig: Rig, body: Body) -> tuple[list[tuple[float, float]], Body]:
    """Choose the set screws that leave the least unbalance.

    Returns
    -------
    screws : list of tuple of float
        Angle from the thick edge [deg] and length [mm] of each.
    body : Body
        The body with the screws.
    """
    radius, _ = parts.balance_holes(rig)
    groups = ([0.0], [15.0, 345.0], [75.0, 285.0], [105.0, 255.0], [165.0, 195.0], [180.0])
    u = unbalance(body)
    pull = [sum(radius * math.cos(math.radians(a)) for a in group) for group in groups]

    tried = np.array(list(itertools.product(LENGTHS, repeat=len(groups))))
    left = np.abs(u[0] + screw_mass(rig, 1.0) * tried @ pull)
    best = tried[np.argmin(left + 0.05 * (tried > 0) @ [len(group) for group in groups])]
    screws = [
        (a, float(length))
        for group, length in zip(groups, best, strict=True)
        if length
        for a in group
    ]
    for angle, length in screws:
        (x, y), z = parts.around(radius, [angle])[0], rig.front_z - 0.2 - length / 2
        body = body + point(screw_mass(rig, length), x, y, z)
    return screws, body


def grade(body: Body, rpm: float) -> float:
    """Return the balance quality G of ISO 21940-11 [mm/s]: centre of mass's distance times angular speed."""
    return float(np.hypot(*unbalance(body)) / body.mass * omega(rpm))


def bearing_forces(rig: Rig, body: Body, rpm: float) -> tuple[float, float]:
    """Return the forces that turn with the rotor on the rear and the front bearing [N], static and couple unbalance."""
    rear, front = (z + rig.bearing.width / 2 for z in rig.bearing_z)
    force = unbalance(body)  # per ω² [g mm]
    moment = -body.inertia[:2, 2]  # sum of m (x, y) z [g mm²]
    at_front = (moment - rear * force) / (front - rear)
    scale = 1e-6 * omega(rpm) ** 2
    return float(np.hypot(*(force - at_front)) * scale), float(np.hypot(*at_front) * scale)


def vibration(rig: Rig, body: Body) -> tuple[float, float]:
    """Return how far the rig is shaken if it hangs free.

    Above the resonance of soft feet the answer does not depend on the speed.

    Returns
    -------
    path : float
        Radius of the circle on which the rig's centre of mass moves [mm].
    angle : float
        Radius of the cone on which the camera's axis moves [rad].
    """
    total, *others = bodies(rig)
    for each in others:
        total = total + each
    centre = total.centre
    about = total.inertia - total.mass * (centre @ centre * np.eye(3) - np.outer(centre, centre))
    force, moment = unbalance(body), -body.inertia[:2, 2]
    arm = moment - centre[2] * force
    lean = max(
        abs(arm[0]) / about[1, 1],
        abs(arm[1]) / about[0, 0],
        float(np.hypot(*arm)) / min(about[0, 0], about[1, 1]),
    )
    return float(np.hypot(*force) / total.mass), float(lean)


def friction(rig: Rig, rpm: float, viscosity: float, factor: float) -> float:
    """Return the friction torque of both bearings [mN m].

    Palmgren: M₀ = 10⁻⁷ f₀ (ν n)^(2/3) d³ [N mm] with the mean diameter d [mm], and 160·10⁻⁷ f₀ d³ if ν n < 2000. The
    preload adds little.

    Parameters
    ----------
    viscosity : float
        Kinematic viscosity of the oil at working temperature [mm²/s].
    factor : float
        f₀: 1.5 to 2 for grease, 0.7 to 1 for a drop of oil.
    """
    mean = (rig.bearing.bore + rig.bearing.outer) / 2
    flow = viscosity * rpm
    drag = 1e-7 * factor * flow ** (2 / 3) * mean**3 if flow >= 2000 else 160e-7 * factor * mean**3
    return 2 * drag


def stress(rig: Rig, rpm: float) -> dict[str, float]:
    """Return stresses [MPa], forces [N], rim speed [m/s] and energy [J] of the rotor at a speed."""
    w, radius = omega(rpm), rig.wedge / 2e3
    body = rotating(rig)
    outer = rig.pulley_flange / 1e3
    offset = wedge_unbalance(rig) + rig.seat * glass_mass(rig)
    return {
        "glass": (3 + 0.21) / 8 * GLASS * 1e6 * w**2 * radius**2 / 1e6,
        "rotor": PETG * 1e6 * w**2 * outer**2 / 1e6,
        "wedge's pull": offset * 1e-6 * w**2,
        "shock": 50 * GRAVITY * 1e-3 * glass_mass(rig),
        "rim": outer * w,
        "energy": 0.5 * (body.inertia[2, 2] * 1e-9) * w**2,
    }


def glass_mass(rig: Rig) -> float:
    """Return the mass of the wedge [g]."""
    return GLASS * math.pi * (rig.wedge / 2) ** 2 * rig.thickness


# Vignetting


SENSORS = {
    "640×480, 9 µm": (640, 480, 9e-3),
    "346×260, 18.5 µm": (346, 260, 18.5e-3),
    "1280×720, 4.86 µm": (1280, 720, 4.86e-3),
}
"""Sensors: columns, rows, pixel pitch [mm]."""


@dataclass(frozen=True)
class View:
    """What a camera sees: sensor, horizontal field of view [deg], and f-number of the lens."""

    sensor: tuple[int, int, float]
    """Columns, rows, pixel pitch [mm]."""
    fov_deg: float
    number: float

    @property
    def focal(self) -> float:
        """Focal length [mm]."""
        columns, _, pitch = self.sensor
        return columns * pitch / (2.0 * math.tan(math.radians(self.fov_deg) / 2.0))

    def degrees(self, focal: float) -> float:
        """Return the horizontal field of view with another focal length [deg]."""
        columns, _, pitch = self.sensor
        return math.degrees(2.0 * math.atan(columns * pitch / (2.0 * focal)))


def to_hull(point: tuple[float, float], circles: Sequence[tuple[float, float, float]]) -> float:
    """Return the distance of a point from the hull of circles [mm]: x, y and radius of each.

    The support function of the hull is the largest of the circles': x cos φ + y sin φ + r. The point is outside by the
    largest excess over it.
    """
    angles = np.arange(7200) * math.tau / 7200
    along, up = np.cos(angles), np.sin(angles)
    support = np.max([x * along + y * up + radius for x, y, radius in circles], axis=0)
    return float(np.max(point[0] * along + point[1] * up - support))


def lenses(rig: Rig) -> dict[str, Rig]:
    """Return a rig with different lenses, by their names.

    A lens with M12 thread ends about 22 mm before the sensor. On a camera with CS-mount, that is 10 mm before the
    camera, and 5 mm before the adapter.
    """
    slim = replace(rig, lens=17.0, reach=5.0, pupil=4.0, threads=("cs", "m12"))
    short, long = (
        replace(rig, lens=34.0, reach=reach, pupil=10.0, threads=("cs", "c"))
        for reach in (30.0, 40.0)
    )
    found = {"M12, 17 mm wide, 5 mm before its CS adapter": slim}
    if short.enters:
        return {
            **found,
            "C-mount, 34 mm wide, 30 mm long": short,
            "C-mount, 34 mm wide, 40 mm long": long,
        }
    return {**found, "C-mount, 34 mm wide, any length, behind the rotor": short}


def clear_of_stops(
    rig: Rig, sensor: tuple[int, int, float], focal: float, number: float = 2.0, off: float = 0.0
) -> float:
    """Return the smallest distance of the image's rays from the rim of an aperture [mm]; negative if some are cut off.

    Every ray of the image's border is followed from the rim of the lens's entrance pupil to the scene, at 24 angles of
    the prism. Behind the wedge it has the direction that ``ExactModel`` gives it.

    Parameters
    ----------
    focal : float
        Focal length [mm].
    number : float
        F-number.
    off : float
        Distance of the lens's axis from that of the rotor [mm].
    """
    columns, rows, pitch = sensor
    focal_px = focal / pitch
    camera = amiwarp.Camera(columns, rows, focal_px, focal_px, (columns - 1) / 2, (rows - 1) / 2)
    prism = amiwarp.Prism(math.radians(rig.apex_deg), flat_side="camera")
    model = amiwarp.ExactModel(camera, prism)
    x, y = (np.linspace(-0.5, size - 0.5, 9) for size in (columns, rows))
    border = np.array([(a, b) for a in x for b in y if a in (x[0], x[-1]) or b in (y[0], y[-1])])
    theta = np.arange(24) * math.pi / 12
    pixels, angles = np.repeat(border, len(theta), axis=0), np.tile(theta, len(border))
    inside = camera.pixels_to_rays(pixels)
    outside = camera.pixels_to_rays(model.compensate_points(pixels, angles))
    steep, after = (np.hypot(rays[:, 0], rays[:, 1]) / rays[:, 2] for rays in (inside, outside))
    pupil, at = focal / (2 * number) + off, rig.lens_z - rig.pupil
    glass = rig.seat_z + rig.thickness
    left = []
    for _, z, radius in rig.stops:
        away = pupil + (min(z, glass) - at) * steep + max(z - glass, 0.0) * after
        left.append(radius - float(away.max()))
    return min(left)


def shortest_focal(
    rig: Rig, sensor: tuple[int, int, float], number: float = 2.0, off: float = 0.0
) -> float:
    """Return the shortest focal length without vignetting [mm], in steps of 0.1 mm, or infinity if there is none."""
    for tenth in range(20, 1000):
        if clear_of_stops(rig, sensor, tenth / 10, number, off) >= 0:
            return tenth / 10
    return math.inf


# Error in the image


@dataclass(frozen=True)
class Tolerance:
    """Something that is not as drawn, and its size."""

    name: str
    size: str
    wobble_deg: tuple[float, float] = (0.0, 0.0)
    tilt_deg: tuple[float, float] = (0.0, 0.0)
    harmonics_deg: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    """Error of the measured angle: factors of cos θ, sin θ, cos 2θ, sin 2θ."""
    shake: tuple[float, float] = (0.0, 0.0)
    """Rotation of the camera once a turn [rad]: in phase with the prism, and a quarter turn later."""


def offset_error(
    rig: Rig, off: float, distance: float, width: int = 640, fov_deg: float = 60.0
) -> float:
    """Return how far a point at the border of the image moves if the lens is off the rotor's axis [px].

    Off the axis by d, the light passes glass that is thicker or thinner by d tan α. At the angle i from the axis, this
    shifts it by d tan α (tan i - tan r), with sin i = n sin r. Without wedge, an offset changes nothing that turns.

    Parameters
    ----------
    off : float
        Distance of the lens's axis from that of the rotor [mm].
    distance : float
        Distance of the scene [mm].
    """
    half = math.radians(fov_deg / 2)
    inside = math.asin(math.sin(half) / amiwarp.Prism(math.radians(rig.apex_deg)).index)
    shift = off * math.tan(math.radians(rig.apex_deg)) * (math.tan(half) - math.tan(inside))
    return shift / distance * width / (2 * math.tan(half))


def error(
    tolerance: Tolerance,
    free: Sequence[str],
    *,
    apex_deg: float,
    width: int = 640,
    fov_deg: float = 60.0,
) -> float:
    """Return the rms error [px] that is left if calibration frees these parameters besides apex and phase.

    The true rig is computed by ``ExactModel``, with the camera's shake as a rotation of the rays. A least-squares fit
    of ``ExactModel`` to it, with a constant shift of the picture, stands for a calibration without noise.

    Parameters
    ----------
    free : sequence of str
        Names among tilt, wobble and harmonics.
    """
    from scipy.optimize import least_squares

    camera = amiwarp.Camera.from_fov(width, width * 3 // 4, math.radians(fov_deg))
    prism = amiwarp.Prism(math.radians(apex_deg), flat_side="camera")
    x, y = np.meshgrid(np.linspace(20, width - 20, 7), np.linspace(20, width * 0.75 - 20, 5))
    theta = np.arange(12) * math.pi / 6
    scene = np.repeat(np.column_stack([x.ravel(), y.ravel()]), len(theta), axis=0)
    angle = np.tile(theta, x.size)
    wobble, tilt, harmonics = (
        tuple(math.radians(v) for v in values)
        for values in (tolerance.wobble_deg, tolerance.tilt_deg, tolerance.harmonics_deg)
    )
    true = amiwarp.ExactModel(camera, prism, 0.0, tilt=tilt, wobble=wobble)
    seen = true.deflect_points(scene, angle)
    if any(tolerance.shake):
        rays = camera.pixels_to_rays(seen)
        along, across = tolerance.shake
        lean = along * np.array([np.cos(angle), np.sin(angle)]) + across * np.array(
            [-np.sin(angle), np.cos(angle)]
        )
        turned = np.column_stack(
            [
                rays[:, 0] + lean[0] * rays[:, 2],
                rays[:, 1] + lean[1] * rays[:, 2],
                rays[:, 2] - lean[0] * rays[:, 0] - lean[1] * rays[:, 1],
            ]
        )
        seen = camera.rays_to_pixels(turned)

    def waves(values: Sequence[float]) -> NDArray[np.float64]:
        c1, s1, c2, s2 = values
        return (
            c1 * np.cos(angle)
            + s1 * np.sin(angle)
            + c2 * np.cos(2 * angle)
            + s2 * np.sin(2 * angle)
        )

    told = angle + waves(harmonics)
    sizes = {"tilt": 2, "wobble": 2, "harmonics": 4}
    names = [name for name in sizes if name in free]

    def left(v: NDArray[np.float64]) -> NDArray[np.float64]:
        found: dict[str, tuple[float, ...]] = {}
        at = 4
        for name in names:
            found[name] = tuple(v[at : at + sizes[name]] * 0.01)
            at += sizes[name]
        fixed = told - waves(found.pop("harmonics", (0.0,) * 4))
        wedge = replace(prism, apex=prism.apex * (1 + 0.1 * v[0]))
        model = amiwarp.ExactModel(camera, wedge, 0.1 * v[1], **found)
        return (model.compensate_points(seen, fixed) - scene - v[2:4]).ravel()

    start = np.full(4 + sum(sizes[name] for name in names), 0.01)
    fit = least_squares(left, start, diff_step=1e-2, method="lm")
    return float(np.sqrt(2 * np.mean(fit.fun**2)))
