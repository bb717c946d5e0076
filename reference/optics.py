"""Independent float64 NumPy oracle: OpenCV's published lens polynomials and a two-interface Snell trace.

Nothing here shares a formula with the package. The prism is traced face by face with the vector form of Snell's law.
The lens is inverted by bisection and damped Newton steps, where the kernels use a closed form and plain steps.
Every function takes and returns float64; a point or ray that does not exist is a row of NaN.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from amiwarp import Camera, Fisheye, FlatSide, Plate, Prism, RadialTangential

Array = NDArray[np.float64]


def polynomial(radius: Array, *k: float) -> Array:
    """Return r (1 + k1 r² + k2 r⁴ + …)."""
    factor = np.ones_like(radius)
    for i, value in enumerate(k):
        factor = factor + value * radius ** (2 * i + 2)
    return radius * factor


def monotonic_limit(*k: float, below: tuple[float, ...] = (), largest: float) -> float:
    """Return the largest radius up to which r (1 + k1 r² + …) / (1 + below1 r² + …) grows.

    By a scan and bisection of its slope, which ends where the denominator does.
    """

    def terms(r: Array, *k: float, slope: int = 0) -> Array:
        return np.sum(
            [(slope * 2 * i + 1) * value * r ** (2 * i) for i, value in enumerate((1.0, *k))],
            axis=0,
        )

    def slope(r: Array) -> Array:
        n, d = terms(r, *k), terms(r, *below)
        rising = terms(r, *k, slope=1) * d - n * (terms(r, *below, slope=1) - d)
        return np.where(d > 0.0, rising, -1.0)

    radii = np.concatenate([np.linspace(0.0, 5.0, 20_001), np.linspace(5.0, 100.0, 10_001)[1:]])
    falling = np.flatnonzero(slope(radii) <= 0.0)
    if not len(falling) or radii[falling[0]] > largest:
        return largest
    low, high = radii[falling[0] - 1], radii[falling[0]]
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if slope(np.array(middle)) > 0.0 else (low, middle)
    return float(low)


def invert_polynomial(
    value: Array, *k: float, limit: float, below: tuple[float, ...] = ()
) -> Array:
    """Return the radius in [0, limit] at which the polynomial equals ``value``, by bisection; NaN if there is none."""

    def ratio(r: Array) -> Array:
        return polynomial(r, *k) * r / np.maximum(polynomial(r, *below), 1e-300)

    low, high = np.zeros_like(value), np.full_like(value, limit)
    for _ in range(56):
        middle = 0.5 * (low + high)
        short = ratio(middle) < value
        low, high = np.where(short, middle, low), np.where(short, high, middle)
    return np.where(value <= ratio(np.array(limit)), 0.5 * (low + high), np.nan)


@cache
def lens_limit(camera: Camera) -> float:
    """Return the largest tangent (radial-tangential) or angle [rad] (fisheye) up to which the lens is one-to-one."""
    d = camera.distortion
    if isinstance(d, Fisheye):
        return monotonic_limit(d.k1, d.k2, d.k3, d.k4, largest=0.999 * np.pi / 2)
    return (
        monotonic_limit(d.k1, d.k2, d.k3, below=(d.k4, d.k5, d.k6), largest=100.0) if d else np.inf
    )


def distort_radial_tangential(d: RadialTangential, p: Array) -> Array:
    """Return x'' and y'' from x' and y' (tangents), shape (n, 2). OpenCV, Camera Calibration and 3D Reconstruction."""
    x, y = p.T
    r2 = x**2 + y**2
    radial = (1.0 + d.k1 * r2 + d.k2 * r2**2 + d.k3 * r2**3) / (
        1.0 + d.k4 * r2 + d.k5 * r2**2 + d.k6 * r2**3
    )
    return np.stack(
        [
            x * radial + 2.0 * d.p1 * x * y + d.p2 * (r2 + 2.0 * x**2),
            y * radial + d.p1 * (r2 + 2.0 * y**2) + 2.0 * d.p2 * x * y,
        ],
        axis=1,
    )


def undistort_radial_tangential(d: RadialTangential, distorted: Array, limit: float) -> Array:
    """Invert: the radial part by bisection, then Newton steps, each halved until the residual drops; shape (n, 2)."""
    radius = np.linalg.norm(distorted, axis=1)
    k, below = (d.k1, d.k2, d.k3), (d.k4, d.k5, d.k6)
    largest = polynomial(np.array(limit), *k) * limit / polynomial(np.array(limit), *below)
    start = invert_polynomial(np.minimum(radius, 0.9999 * largest), *k, limit=limit, below=below)
    p = distorted * (start / np.maximum(radius, 1e-300))[:, None]
    for _ in range(20):
        error = distort_radial_tangential(d, p) - distorted
        jx, jy = (
            (distort_radial_tangential(d, p + h) - distort_radial_tangential(d, p - h)) / 2e-7
            for h in 1e-7 * np.eye(2)
        )
        det = jx[:, 0] * jy[:, 1] - jy[:, 0] * jx[:, 1]
        det = np.where(np.abs(det) < 1e-12, 1e-12, det)
        step = np.stack(
            [
                jy[:, 1] * error[:, 0] - jy[:, 0] * error[:, 1],
                jx[:, 0] * error[:, 1] - jx[:, 1] * error[:, 0],
            ],
            axis=1,
        )
        step /= det[:, None]
        scale = np.ones(len(p))
        for _ in range(8):
            after = np.linalg.norm(
                distort_radial_tangential(d, p - scale[:, None] * step) - distorted, axis=1
            )
            scale = np.where(after <= np.linalg.norm(error, axis=1), scale, 0.5 * scale)
        p = p - scale[:, None] * step
    residual = np.linalg.norm(distort_radial_tangential(d, p) - distorted, axis=1)
    good = (residual < 1e-11 * (1.0 + radius)) & (np.linalg.norm(p, axis=1) <= limit)
    return np.where(good[:, None], p, np.nan)


def pixels_to_rays(camera: Camera, xy: Array) -> Array:
    """Return unit bearings (n, 3) of pixels (n, 2)."""
    d = (np.asarray(xy, dtype=np.float64) - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    lens = camera.distortion
    if isinstance(lens, Fisheye):
        radius = np.linalg.norm(d, axis=1)
        angle = invert_polynomial(
            radius, lens.k1, lens.k2, lens.k3, lens.k4, limit=lens_limit(camera)
        )
        direction = d / np.maximum(radius, 1e-300)[:, None]
        return np.concatenate([np.sin(angle)[:, None] * direction, np.cos(angle)[:, None]], axis=1)
    if lens is not None:
        d = undistort_radial_tangential(lens, d, lens_limit(camera))
    rays = np.concatenate([d, np.ones((len(d), 1))], axis=1)
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def rays_to_pixels(camera: Camera, rays: Array) -> Array:
    """Return pixels (n, 2) of bearings (n, 3); NaN behind the image and beyond the fold of the lens."""
    rays = np.asarray(rays, dtype=np.float64)
    ahead = rays[:, 2] > 1e-6
    lens = camera.distortion
    with np.errstate(invalid="ignore", divide="ignore"):
        tangent = rays[:, :2] / rays[:, 2:]
        radius = np.linalg.norm(tangent, axis=1)
        if isinstance(lens, Fisheye):
            angle = np.arctan(radius)
            ahead &= angle <= lens_limit(camera)
            scale = polynomial(angle, lens.k1, lens.k2, lens.k3, lens.k4) / np.where(
                radius > 0, radius, 1.0
            )
            p = np.where((radius > 0)[:, None], tangent * scale[:, None], tangent)
        elif lens is not None:
            ahead &= radius <= lens_limit(camera)
            p = distort_radial_tangential(lens, tangent)
        else:
            p = tangent
    return np.where(ahead[:, None], p * [camera.fx, camera.fy] + [camera.cx, camera.cy], np.nan)


def refract(ray: Array, normal: Array, ratio: float) -> Array:
    """Refract a bearing (n, 3) at a face of unit normal (n, 3) by Snell's law in vector form; ratio = n_from / n_to."""
    cosine = np.sum(ray * normal, axis=1, keepdims=True)
    radicand = 1.0 - ratio**2 * (1.0 - cosine**2)
    root = np.sqrt(np.where((radicand > 0.0) & (cosine > 0.0), radicand, np.nan))
    return ratio * ray + (root - ratio * cosine) * normal


def through_prism(prism: Prism, rays: Array, phi: Array, *, to_scene: bool) -> Array:
    """Trace bearings (n, 3) through both faces. ``phi`` (n,) [rad] is the azimuth of the tilt; rays leave the camera.

    ``to_scene``: from the observed bearing to the scene's. Otherwise back, which is the same trace from the other side,
    because light paths are reversible. NaN after total internal reflection or if the ray misses a face.
    """
    s, c = np.sin(prism.apex), np.cos(prism.apex)
    tilted = np.stack([s * np.cos(phi), s * np.sin(phi), np.full(len(phi), c)], axis=1)
    return through_faces(prism, rays, tilted, to_scene=to_scene)


def through_faces(prism: Prism, rays: Array, tilted: Array, *, to_scene: bool) -> Array:
    """Trace bearings (n, 3) as :func:`through_prism` does, with the unit normals (n, 3) of the tilted face."""
    flat = np.tile([0.0, 0.0, 1.0], (len(rays), 1))
    first_is_tilted = (prism.flat_side is FlatSide.SCENE) == to_scene
    faces = (tilted, flat) if first_is_tilted else (flat, tilted)
    inside = refract(np.where(rays[:, 2:] > 0.0, rays, np.nan), faces[0], 1.0 / prism.index)
    out = refract(inside, faces[1], prism.index)
    return np.where(out[:, 2:] > 0.0, out, np.nan)


def tipped(towards: tuple[float, float]) -> Array:
    """Return the smallest rotation (3, 3) that takes z to the direction of (x, y, 1)."""
    axis = np.array([*towards, 1.0]) / np.linalg.norm([*towards, 1.0])
    x, y, z = axis
    cross = np.array([[0.0, 0.0, x], [0.0, 0.0, y], [-x, -y, 0.0]])
    return np.eye(3) + cross + cross @ cross / (1.0 + z)


def through_uneven_prism(
    prism: Prism,
    rays: Array,
    phi: Array,
    *,
    to_scene: bool,
    cylinder: tuple[float, float],
    wobble: tuple[float, float],
) -> Array:
    """Trace bearings (n, 3) as :func:`through_prism` does, in the frame of each angle.

    The prism is tipped by ``wobble``. The slope of its tilted face at the point that a camera's ray meets is that of
    the apex and the cylinder matrix times the ray's tangents.
    """
    c, s, zero = np.cos(phi), np.sin(phi), np.zeros_like(phi)
    turned = np.array([[c, -s, zero], [s, c, zero], [zero, zero, zero + 1.0]]).transpose(
        2, 0, 1
    ) @ tipped(wobble)
    local = np.einsum("nji,nj->ni", turned, rays)
    power = np.array([[cylinder[0], cylinder[1]], [cylinder[1], -cylinder[0]]])
    out = local
    for _ in range(1 if to_scene else 60):
        tangent = (local if to_scene else out)[:, :2] / (local if to_scene else out)[:, 2:]
        normal = np.column_stack(
            [np.array([np.tan(prism.apex), 0.0]) + tangent @ power, np.ones(len(rays))]
        )
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        out = through_faces(prism, local, normal, to_scene=to_scene)
    return np.einsum("nij,nj->ni", turned, out)


def rotation(tilt: tuple[float, float]) -> Array:
    """Return the matrix (3, 3) of a rotation about x by ``tilt[0]``, then about y by ``tilt[1]`` [rad]."""
    cx, sx, cy, sy = np.cos(tilt[0]), np.sin(tilt[0]), np.cos(tilt[1]), np.sin(tilt[1])
    return np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]]) @ np.array(
        [[1, 0, 0], [0, cx, -sx], [0, sx, cx]]
    )


def through_plate(
    plate: Plate, rays: Array, phi: Array, wedge: tuple[float, float] = (0.0, 0.0)
) -> tuple[Array, Array]:
    """Trace bearings (n, 3) from the camera's centre through both faces of a plate 0.1 mm away.

    ``phi`` (n,) [rad] is the azimuth of the tilt. ``wedge``: tangents of the angles by which the normal of the far face
    leans, further along the tilt and across it [rad]. Return a point on each ray behind the plate [m], and its bearing.
    """
    s, c = np.sin(plate.tilt), np.cos(plate.tilt)
    near = np.stack([s * np.cos(phi), s * np.sin(phi), np.full_like(phi, c)], axis=1)
    steeper = plate.tilt + np.arctan(wedge[0])
    s, c, aside = np.sin(steeper), np.cos(steeper), wedge[1] * np.cos(np.arctan(wedge[0]))
    far = np.stack(
        [
            s * np.cos(phi) - aside * np.sin(phi),
            s * np.sin(phi) + aside * np.cos(phi),
            np.full_like(phi, c),
        ],
        axis=1,
    ) / np.hypot(1.0, aside)
    place, bearing = np.zeros_like(rays), rays
    faces = ((near, 1e-4, 1.0 / plate.index), (far, 1e-4 + plate.thickness, plate.index))
    for normal, distance, ratio in faces:
        along = np.sum(bearing * normal, axis=1, keepdims=True)
        place = place + (distance - np.sum(place * normal, axis=1, keepdims=True)) / along * bearing
        bearing = refract(bearing, normal, ratio)
    return place, bearing


def through_pair(
    camera: Camera,
    prism: Prism,
    phases: tuple[float, float],
    xy: Array,
    theta: Array,
    *,
    to_scene: bool,
) -> Array:
    """Return pixels (n, 2) compensated (``to_scene``) or deflected by a prism and its second one at angles (n, 2)."""
    assert prism.second is not None
    rays, order = pixels_to_rays(camera, xy), [(prism, 0), (prism.second, 1)]
    for one, k in order if to_scene else order[::-1]:
        rays = through_prism(one, rays, theta[:, k] + phases[k], to_scene=to_scene)
    return rays_to_pixels(camera, rays)


def at_depth(
    camera: Camera, plate: Plate, phase: float, xy: Array, theta: Array, inverse_depth: Array,
    wedge: tuple[float, float] = (0.0, 0.0),
) -> Array:  # fmt: skip
    """Return the pixels (n, 2) that see without the plate what ``xy`` see through it, at inverse depths (n,) [1/m]."""
    origin, direction = through_plate(plate, pixels_to_rays(camera, xy), theta + phase, wedge)
    depth = 1.0 / np.maximum(inverse_depth, 1e-9)
    point = origin + ((depth - origin[:, 2]) / direction[:, 2])[:, None] * direction
    return rays_to_pixels(camera, point / np.linalg.norm(point, axis=1, keepdims=True))


def reflected(rays: Array, normals: Array) -> Array:
    """Return rays that a plane mirror with these unit normals reflects, shape (n, 3)."""
    return rays - 2.0 * np.sum(rays * normals, axis=1, keepdims=True) * normals


def mirror_normals(values: Mapping[str, float], theta: Array) -> tuple[Array, Array]:
    """Return the normals of a mirror at rest and at angles of its commands (n, 2), each of shape (n, 3).

    The normal at rest looks back to the camera. The axis of a tilt is perpendicular to it, and seen from the camera to
    the direction in which the image moves. ``values`` are named as the parameters of amiwarp's model.
    """
    along = np.array([np.cos(values["fold"]), np.sin(values["fold"]), 0.0])
    optical = np.array([0.0, 0.0, 1.0])
    rest = np.sin(values["incidence"]) * along - np.cos(values["incidence"]) * optical
    tilt = np.zeros((len(theta), 3))
    for k, before in enumerate(("", "second_")):
        swing = values[f"{before}amplitude"] * np.cos(theta[:, k] + values[f"{before}phase"])
        to = values[f"{before}direction"]
        across = np.array([-np.sin(to), np.cos(to), 0.0])
        axis = across - (across @ rest) / (optical @ rest) * optical
        tilt += swing[:, None] * axis
    return np.tile(rest, (len(theta), 1)), Rotation.from_rotvec(tilt).apply(rest)


def in_mirror(camera: Camera, values: Mapping[str, float], xy: Array, theta: Array) -> Array:
    """Return the pixels that see in a mirror at rest what ``xy`` see in it at angles (n, 2) of its commands."""
    rest, tilted = mirror_normals(values, theta)
    return rays_to_pixels(camera, reflected(reflected(pixels_to_rays(camera, xy), tilted), rest))


def steered(
    camera: Camera, values: Mapping[str, float], xy: Array, theta: Array, *, to_scene: bool
) -> Array:
    """Return pixels without a beam steerer, for pixels ``xy`` seen at angles (n, 2) of its commands, or the reverse.

    A deflector along x adds to the cosine of the ray's angle with the x axis.
    """
    rays = pixels_to_rays(camera, xy)
    cosines = rays[:, :2]
    sense = -1.0 if to_scene else 1.0
    for k, prefix in enumerate(("", "second_")):
        command = np.cos(theta[:, k] + values[f"{prefix}phase"])
        size = sense * np.sin(values[f"{prefix}amplitude"]) * command
        along = values[f"{prefix}direction"]
        cosines = cosines + size[:, None] * np.array([np.cos(along), np.sin(along)])
    transverse = np.hypot(*cosines.T)
    with np.errstate(invalid="ignore"):
        axial = np.cos(np.arcsin(transverse))
    return rays_to_pixels(camera, np.column_stack([cosines, axial]))


def vibration(values: Mapping[str, float], theta: Array) -> Rotation:
    """Return a vibrating camera's rotation from rest at angles (n,) of the vibration.

    ``values`` are named as the parameters of amiwarp's model.
    """

    def part(name: str, k: int) -> Array:
        return complex(values.get(f"{name}_x", 0.0), values.get(f"{name}_y", 0.0)) * np.exp(
            1j * k * theta
        )

    circle = values["amplitude"] * np.exp(1j * (theta + values["phase"]))
    circle = circle + part("backward", -1) + part("second", 2) + part("second_backward", -2)
    circle = circle + part("third", 3) + part("third_backward", -3)
    roll = values.get("roll_x", 0.0) * np.cos(theta) + values.get("roll_y", 0.0) * np.sin(theta)
    return Rotation.from_rotvec(np.stack([circle.real, circle.imag, roll], axis=1))


def turned(camera: Camera, rotation: Rotation, xy: Array) -> Array:
    """Return the pixels (n, 2) whose rays are those of ``xy``, rotated."""
    return rays_to_pixels(camera, rotation.apply(pixels_to_rays(camera, xy)))


def move(
    camera: Camera,
    prism: Prism,
    xy: Array,
    theta: Array,
    *,
    to_scene: bool,
    phase: float = 0.0,
    tilt: tuple[float, float] = (0.0, 0.0),
    cylinder: tuple[float, float] = (0.0, 0.0),
    wobble: tuple[float, float] = (0.0, 0.0),
) -> Array:
    """Return compensated (``to_scene``) or deflected pixels (n, 2)."""
    axis = rotation(tilt)
    rays, phi = pixels_to_rays(camera, xy) @ axis, np.asarray(theta, dtype=np.float64) + phase
    if any((*cylinder, *wobble)):
        out = through_uneven_prism(
            prism, rays, phi, to_scene=to_scene, cylinder=cylinder, wobble=wobble
        )
    else:
        out = through_prism(prism, rays, phi, to_scene=to_scene)
    return rays_to_pixels(camera, out @ axis.T)


def cross_section(angle: Array, apex: float, index: Array | float, *, tilted_first: bool) -> Array:
    """Return the signed deflection [rad] of a ray in the plane of the wedge: the paper's δ = Φq − Φo + Φp − Φi.

    ``angle`` [rad] is the ray's, positive towards the azimuth of the tilt. Every Φ is measured from the normal of its
    face with that sign: (Φi, Φp) before and after the first face, (Φo, Φq) before and after the second.
    """
    first, second = (apex, 0.0) if tilted_first else (0.0, apex)
    phi_i = angle - first
    phi_p = np.arcsin(np.sin(phi_i) / index)
    phi_o = phi_p + first - second
    phi_q = np.arcsin(index * np.sin(phi_o))
    return phi_q - phi_o + phi_p - phi_i


def turn(rays: Array, phi: Array, angle: Array | float) -> Array:
    """Rotate bearings (n, 3) by ``angle`` [rad] from z towards the azimuth ``phi``."""
    along = np.stack([np.cos(phi), np.sin(phi), np.zeros_like(phi)], axis=1)
    across = np.stack([-np.sin(phi), np.cos(phi), np.zeros_like(phi)], axis=1)
    u, v, z = np.sum(rays * along, axis=1), np.sum(rays * across, axis=1), rays[:, 2]
    c, s = np.cos(angle), np.sin(angle)
    turned = (c * u + s * z)[:, None] * along + v[:, None] * across
    turned[:, 2] = c * z - s * u
    return turned


def place(
    name: str, camera: Camera, prism: Prism, xy: Array, theta: Array, *, phase: float
) -> Array:
    """Return pixels compensated by the model ``exact``, ``radial`` or ``circle``; the flat face points to the scene."""
    if name == "exact":
        return move(camera, prism, xy, theta, to_scene=True, phase=phase)
    rays = pixels_to_rays(camera, xy)
    angle: Array | float = prism.deflection
    if name == "radial":
        cosine2 = rays[:, 2] ** 2
        angle = (
            angle
            * (np.sqrt((prism.index**2 - 1.0 + cosine2) / cosine2) - 1.0)
            / (prism.index - 1.0)
        )
    return rays_to_pixels(camera, turn(rays, theta + phase, angle))
