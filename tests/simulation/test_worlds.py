"""Worlds: rays, truth and events, compared with an independent float64 implementation."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import warp as wp
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from amiwarp import (
    AmiwarpError,
    Body,
    Camera,
    Lamp,
    Material,
    Mesh,
    Prism,
    PrismMotion,
    Scene,
    SensorModel,
    Simulation,
    Sky,
    Sun,
    Trajectory,
    TruthRenderer,
    World,
    WorldScene,
)
from amiwarp.simulation.engine import Engine
from amiwarp.simulation.worlds.device_world import DeviceWorld
from amiwarp.simulation.worlds.map_ring import WorldMapRing
from amiwarp.simulation.worlds.surfaces import pixel_rays, surfaces_at
from amiwarp.simulation.worlds.trajectory import looking_at
from reference import optics as oracle

CAMERA = Camera.from_fov(64, 48, math.radians(60.0))
CUBE = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
CUBE_FACES = np.array(
    [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4],
     [1, 5, 7], [1, 7, 3]]
)  # fmt: skip


def box(centre: Any, size: Any, turn: float = 0.0) -> Mesh:
    vertices = (CUBE * size) @ Rotation.from_euler(
        "xyz", (turn, 0.5 * turn, 2.0 * turn)
    ).as_matrix().T + centre
    return Mesh(vertices, CUBE_FACES, uv=CUBE[:, :2] + 0.5)


def smooth_texture(seed: int) -> NDArray[np.float32]:
    image = gaussian_filter(np.random.default_rng(seed).normal(size=(64, 64)), 3.0, mode="wrap")
    return np.asarray((image - image.min()) / np.ptp(image) * 0.9 + 0.1, np.float32)


def random_world(seed: int, *, moving: int = 3) -> World:
    """Boxes before a wall, of which the first few move."""
    rng = np.random.default_rng(seed)
    bodies = []
    for k in range(12):
        mesh = box(rng.uniform(-2.0, 2.0, 3), rng.uniform(0.3, 1.0, 3), rng.uniform(0.0, 3.0))
        path = None
        if k < moving:
            turn = [
                Rotation.identity().as_quat(),
                Rotation.from_rotvec(rng.normal(0.0, 0.3, 3)).as_quat(),
            ]
            path = Trajectory([0.0, 1.0], [np.zeros(3), rng.normal(0.0, 1.0, 3)], turn)
        bodies.append(
            Body(f"box {k}", mesh, Material(0.8, smooth_texture(k)), path, category="box")
        )
    bodies.append(
        Body("wall", box((0.0, 4.0, 0.0), (12.0, 0.1, 12.0)), Material(0.6, smooth_texture(99)))
    )
    return World(
        f"random {seed}", tuple(bodies), sun=Sun((1.0, -1.0, 2.0)), lamps=(Lamp((0.0, -3.0, 3.0)),)
    )


def view_from(position: Any = (0.0, -6.0, 0.5)) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    return looking_at(position, (0.0, 0.0, 0.0)).as_matrix(), np.asarray(position, np.float64)


def triangles_at(world: World, t: float) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Corners of all triangles in the world's frame, shape (n, 3, 3), and their instance numbers."""
    corners, number = [], []
    for body in world.bodies:
        vertices = np.asarray(body.mesh.vertices)
        if body.trajectory is not None:
            (turn,), (place,) = body.trajectory.poses([t])
            vertices = vertices @ turn.T + place
        corners.append(vertices[np.asarray(body.mesh.faces)])
        label = body.instance or body.name
        number.append(np.full(len(corners[-1]), world.instances.index(label) + 1))
    return np.concatenate(corners), np.concatenate(number)


def cast(
    world: World, t: float, origin: NDArray[np.float64], rays: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.float64]]:
    """Distances, instance numbers and normals of the nearest triangles: Cramer's rule for every pair, in float64."""
    corners, number = triangles_at(world, t)
    a, u, v = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(u, v)
    best, which = np.full(len(rays), np.inf), np.full(len(rays), -1)
    for k in range(len(a)):
        facing = rays @ normal[k]
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = (a[k] - origin) @ normal[k] / facing
            place = origin + distance[:, None] * rays - a[k]
            area = normal[k] @ normal[k]
            s, r = (
                np.cross(place, v[k]) @ normal[k] / area,
                np.cross(u[k], place) @ normal[k] / area,
            )
        met = (distance > 0.0) & (distance < best) & (s >= 0.0) & (r >= 0.0) & (s + r <= 1.0)
        best[met], which[met] = distance[met], k
    away = normal[which] / np.linalg.norm(normal[which], axis=1, keepdims=True)
    away *= -np.sign(np.einsum("ij,ij->i", away, rays))[:, None]
    return best, np.where(which < 0, 0, number[which]), away


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("t", [0.0, 0.6])
def test_rays_meet_what_the_oracle_says(seed: int, t: float, device: str) -> None:
    world = random_world(seed)
    rotation, position = view_from()
    on_device = DeviceWorld(world, device)
    on_device.set_instants(np.array([t]))
    rays = pixel_rays(CAMERA)
    seen = surfaces_at(on_device, rays, rotation, position)
    distance, instance, normal = cast(world, t, position, rays @ rotation.T)
    same = seen.instance == instance
    assert same.mean() > 0.999  # a ray along an edge may go either way
    hit = same & (instance > 0)
    assert hit.mean() > 0.9
    np.testing.assert_allclose(seen.depth[hit], (distance * rays[:, 2])[hit], rtol=0.0, atol=1e-4)
    np.testing.assert_allclose(seen.normal[hit], normal[hit], rtol=0.0, atol=1e-4)
    assert np.isinf(seen.depth[instance == 0]).all()


def test_rays_meet_what_trimesh_says() -> None:
    trimesh = pytest.importorskip("trimesh")
    world = random_world(7)
    rotation, position = view_from()
    rays = pixel_rays(CAMERA)[::7]
    seen = surfaces_at(DeviceWorld(world, "cpu"), rays, rotation, position)
    corners, _ = triangles_at(world, 0.0)
    mesh = trimesh.Trimesh(
        corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3), process=False
    )
    places, which, _ = mesh.ray.intersects_location(
        np.tile(position, (len(rays), 1)), rays @ rotation.T, multiple_hits=False
    )
    depth = np.full(len(rays), np.inf)
    depth[which] = ((places - position) @ rotation)[:, 2]
    close = np.isclose(depth, seen.depth, rtol=0.0, atol=1e-4) | (
        np.isinf(depth) & np.isinf(seen.depth)
    )
    assert close.mean() > 0.999


def moving_camera() -> Trajectory:
    ends = [(0.0, -6.0, 0.5), (0.3, -5.9, 0.6), (0.5, -5.7, 0.6)]
    turns = [looking_at(end, (0.1 * k, 0.0, 0.05 * k)).as_quat() for k, end in enumerate(ends)]
    return Trajectory([0.0, 0.5, 1.0], ends, turns)


def project(points: NDArray[np.float64], t: float, path: Trajectory) -> NDArray[np.float64]:
    (turn,), (place,) = path.poses([t])
    local = (points - place) @ turn
    return np.stack(
        [
            CAMERA.fx * local[:, 0] / local[:, 2] + CAMERA.cx,
            CAMERA.fy * local[:, 1] / local[:, 2] + CAMERA.cy,
        ],
        1,
    )


def carried(
    world: World, points: NDArray[np.float64], instance: NDArray[np.int64], t: float, later: float
) -> NDArray[np.float64]:
    """Points on bodies at ``t`` [s], where they are at ``later``."""
    out = points.copy()
    for k, body in enumerate(world.bodies):
        on = instance == k + 1
        if body.trajectory is not None:
            (r0, r1), (p0, p1) = body.trajectory.poses([t, later])
            out[on] = (points[on] - p0) @ r0 @ r1.T + p1
    return out


def quotient(
    at: tuple[float, ...], values: list[NDArray[np.float64]], t: float
) -> NDArray[np.float64]:
    """Return the derivative at ``t`` of the polynomial through values at several times."""
    found = np.zeros_like(values[0])
    for k, value in enumerate(values):
        through_zeros = np.poly1d([1.0])
        for other in (*at[:k], *at[k + 1 :]):
            through_zeros *= np.poly1d([1.0, t - other]) / (at[k] - other)
        found += float(through_zeros.deriv()(0.0)) * value
    return found


MOMENTS = pytest.mark.parametrize(
    ("t", "steps"),
    [
        (0.0, (0.0, 2e-4, 4e-4, 6e-4)),
        (1e-5, (-1e-5, 2e-4, 4e-4)),
        (0.4, (-1e-4, 1e-4)),
        (1.0, (0.0, -2e-4, -4e-4)),
    ],
)
"""Times of flow [s], and steps from there to other times in the recording of 1 s, in which the camera moves."""


@MOMENTS
def test_flow_is_what_finite_differences_say(t: float, steps: tuple[float, ...]) -> None:
    world, path, at = random_world(3), moving_camera(), tuple(t + step for step in steps)
    motion = Simulation(WorldScene(world, path), CAMERA, Prism(math.radians(1.0)), 1.0)
    truth = TruthRenderer(motion).at(round(t * 1e6))
    (turn,), (place,) = path.poses([t])
    rays = pixel_rays(CAMERA)
    distance, instance, _ = cast(world, t, place, rays @ turn.T)
    hit = (instance > 0) & (truth.instance.ravel() == instance)
    points = place + np.where(hit, distance, 1.0)[:, None] * (rays @ turn.T)
    flow = quotient(
        at, [project(carried(world, points, instance, t, one), one, path) for one in at], t
    )
    assert np.abs(flow[hit]).max() > 8.0
    np.testing.assert_allclose(truth.flow.reshape(-1, 2)[hit], flow[hit], rtol=2e-3, atol=0.05)


@MOMENTS
@pytest.mark.parametrize(("rpm", "least", "most_error"), [(720.0, 30.0, 0.5), (60.0, 3.0, 0.1)])
def test_flow_through_the_prism_is_what_finite_differences_say(
    t: float, steps: tuple[float, ...], rpm: float, least: float, most_error: float
) -> None:
    world, path, at = random_world(3), moving_camera(), tuple(t + step for step in steps)
    simulation = Simulation(
        WorldScene(world, path), CAMERA, Prism(math.radians(1.0)), 1.0, motion=PrismMotion(rpm)
    )
    truth = TruthRenderer(simulation).at(round(t * 1e6))
    theta = [float(simulation.motion.angle([1e6 * one])[0]) for one in (t, *at)]
    pixels = (
        np.stack(np.meshgrid(np.arange(64), np.arange(48)), axis=-1)
        .reshape(-1, 2)
        .astype(np.float64)
    )

    def moved(xy: NDArray[np.float64], angle: float, *, to_scene: bool) -> NDArray[np.float64]:
        return oracle.move(CAMERA, simulation.prism, xy, np.full(len(xy), angle), to_scene=to_scene)

    (turn,), (place,) = path.poses([t])
    rays = CAMERA.pixels_to_rays(moved(pixels, theta[0], to_scene=True))
    distance, instance, _ = cast(world, t, place, rays @ turn.T)
    hit = instance > 0
    points = place + np.where(hit, distance, 1.0)[:, None] * (rays @ turn.T)
    ends = [
        moved(
            project(carried(world, points, instance, t, one), one, path)[hit], angle, to_scene=False
        )
        for one, angle in zip(at, theta[1:], strict=True)
    ]
    flow = quotient(at, ends, t)
    error = np.abs(truth.flow_with_prism.reshape(-1, 2)[hit] - flow)
    assert np.quantile(error, 0.99) < most_error  # [px/s]
    assert np.linalg.norm(flow, axis=1).mean() > least


@pytest.mark.parametrize("prism", [False, True])
@pytest.mark.parametrize(("t", "other"), [(0.4, 0.55), (0.55, 0.4)], ids=["forward", "backward"])
def test_displacements_and_occlusion_between_two_times(
    t: float, other: float, prism: bool, device: str
) -> None:
    world, path = random_world(3), moving_camera()
    simulation = Simulation(
        WorldScene(world, path), CAMERA, Prism(math.radians(1.0)), 1.0, device=device
    )
    pixels = (
        np.stack(np.meshgrid(np.arange(64), np.arange(48)), axis=-1)
        .reshape(-1, 2)
        .astype(np.float64)
    )

    def moved(xy: NDArray[np.float64], at: float, *, to_scene: bool) -> NDArray[np.float64]:
        theta = np.full(len(xy), float(simulation.motion.angle([1e6 * at])[0]))
        return oracle.move(CAMERA, simulation.prism, xy, theta, to_scene=to_scene) if prism else xy

    (turn, end_turn), (place, end_place) = path.poses([t, other])
    rays = CAMERA.pixels_to_rays(moved(pixels, t, to_scene=True))
    distance, instance, _ = cast(world, t, place, rays @ turn.T)
    seen = place + np.where(instance > 0, distance, 1.0)[:, None] * (rays @ turn.T)
    away = carried(world, seen, instance, t, other) - end_place
    away[instance == 0] = (rays @ turn.T)[instance == 0]  # the sky is at infinity
    ahead = away @ end_turn
    ends = np.array([CAMERA.fx, CAMERA.fy]) * ahead[:, :2] / ahead[:, 2:] + np.array(
        [CAMERA.cx, CAMERA.cy]
    )
    ends = moved(ends, other, to_scene=False)
    far = np.where(instance > 0, np.linalg.norm(away, axis=1), np.inf)
    nearest, _, _ = cast(
        world, other, end_place, away / np.linalg.norm(away, axis=1, keepdims=True)
    )
    inside = ((ends > -0.5) & (ends < [63.5, 47.5])).all(axis=1)
    becomes = np.where(inside, nearest < far * (1.0 - 1e-3), 2)
    t_us, other_us = round(t * 1e6), round(other * 1e6)
    found, occlusion = simulation.displacement(t_us, other_us, with_prism=prism)
    error = np.abs(found.reshape(-1, 2) - (ends - pixels))
    assert np.median(error) < 1e-4  # px
    assert np.quantile(error, 0.99) < 2e-3  # a ray along an edge may go either way
    assert (occlusion.ravel() == becomes).mean() > 0.995
    assert np.bincount(becomes)[1] > 20

    # The truth of an instant has the same to the next instant, and to the instant before.
    suffix = "_with_prism" if prism else ""
    renderer = TruthRenderer(simulation)
    if other > t:
        truth = renderer.at(t_us, next_us=other_us)
        names = (f"displacement{suffix}", f"occlusion{suffix}")
        unknown = (f"backward{suffix}", f"backward_occlusion{suffix}")
    else:
        truth = renderer.at(t_us, before_us=other_us)
        names = (f"backward{suffix}", f"backward_occlusion{suffix}")
        unknown = (f"displacement{suffix}", f"occlusion{suffix}")
    np.testing.assert_array_equal(getattr(truth, names[0]), found)
    np.testing.assert_array_equal(getattr(truth, names[1]), occlusion)
    assert np.isnan(getattr(truth, unknown[0])).all()
    assert (getattr(truth, unknown[1]) == 2).all()
    # Which is not the flow times the interval
    speed = truth.flow_with_prism if prism else truth.flow
    straight = speed.reshape(-1, 2) * (other - t)
    assert np.quantile(np.abs(straight - (ends - pixels)), 0.9) > 0.05


def test_what_is_seen_both_ways_returns_to_its_pixel() -> None:
    """Displacements there and back, at the same point of a body, add up to nothing, through the prism too."""
    world, path = random_world(3), moving_camera()
    simulation = Simulation(WorldScene(world, path), CAMERA, Prism(math.radians(1.0)), 1.0)
    there, occlusion = simulation.displacement(100_000, 130_000, with_prism=True)
    back, _ = simulation.displacement(130_000, 100_000, with_prism=True)
    rows, columns = np.nonzero(occlusion == 0)
    ends = np.stack([columns, rows], axis=1) + there[rows, columns]
    (x, y) = np.rint(ends).astype(int).T
    near = np.hypot(*(back[y, x] + there[rows, columns]).T)
    assert np.abs(there).max() > 1.0
    assert np.median(near) < 0.01  # px, between neighbouring pixels of a surface
    still, seen = simulation.displacement(500_000, 500_000)
    assert np.abs(still).max() < 1e-4
    assert (seen == 0).all()


@pytest.mark.parametrize(("t0", "t1"), [(-1, 5), (0, 1_000_001)])
def test_displacements_outside_the_recording_are_refused(t0: int, t1: int) -> None:
    simulation = Simulation(WorldScene(random_world(3), moving_camera()), CAMERA, Prism(0.02), 1.0)
    with pytest.raises(
        AmiwarpError, match=r"t[01]_us = .* is not a whole number in 0 .. 1000000 us"
    ):
        simulation.displacement(t0, t1)


def counts(
    simulation: Simulation, chunk_us: int | None = None
) -> tuple[NDArray[np.float64], Engine, list[tuple[Any, Any]]]:
    """Events of each pixel, the engine, and the events and ground truth of each block."""
    engine = Engine(simulation, chunk_us)
    image = np.zeros((simulation.camera.height, simulation.camera.width))
    blocks = [(block.events(), block.truth()) for block in engine.run()]
    for events, _ in blocks:
        np.add.at(image, (events.y, events.x), 1.0)
    return image, engine, blocks


@pytest.mark.parametrize("moves", [False, True])
def test_maps_and_rays_see_alike(moves: bool) -> None:
    world = random_world(1, moving=2 if moves else 0)
    path = moving_camera() if moves else Trajectory.still((0.0, -6.0, 0.5), look_at=(0.0, 0.0, 0.0))
    images = [
        counts(Simulation(WorldScene(world, path, seeing=seeing, samples=16), CAMERA, Prism(math.radians(2.0)), 0.1,
                          sensor=SensorModel.ideal()))[0]
        for seeing in ("maps", "rays")
    ]  # fmt: skip
    assert images[0].sum() > 2000
    assert images[0].sum() == pytest.approx(images[1].sum(), rel=0.1)
    smooth = [gaussian_filter(image, 1.0).ravel() for image in images]
    assert np.corrcoef(*smooth)[0, 1] > 0.96


def test_rays_that_test_only_faces_nearby_see_what_all_rays_see(device: str) -> None:
    """Pixels away from edges test their rays against few faces; with a wide reach, every pixel counts as on an edge."""
    scene = WorldScene(random_world(3), moving_camera(), seeing="rays")
    simulation = Simulation(scene, CAMERA, Prism(math.radians(2.0)), 0.1, device=device)
    renderer = TruthRenderer(simulation)
    near = renderer.at(30_000).intensity_with_prism
    renderer._sight._view.reach = max(CAMERA.width, CAMERA.height)
    everywhere = renderer.at(30_000).intensity_with_prism
    assert near.std() > 0.02
    assert (near == everywhere).mean() < 0.9  # the short way was taken
    apart = np.abs(np.log(near + 0.01) - np.log(everywhere + 0.01))
    assert np.median(apart) < 1e-3
    assert np.quantile(apart, 0.99) < 0.02


def test_a_still_world_costs_one_map() -> None:
    path = Trajectory.still((0.0, -6.0, 0.5), look_at=(0.0, 0.0, 0.0))
    _, engine, _ = counts(
        Simulation(
            WorldScene(random_world(1, moving=0), path, seeing="maps"), CAMERA, Prism(0.02), 0.3
        )
    )
    assert engine._maps is not None
    assert engine._maps.rendered == 1  # type: ignore[union-attr]


def test_a_plane_far_away_is_the_picture_at_infinity() -> None:
    texture, distance = smooth_texture(5), 1000.0
    half = distance * math.tan(math.radians(40.0))
    corners = np.array(
        [
            [-half, distance, -half],
            [half, distance, -half],
            [half, distance, half],
            [-half, distance, half],
        ]
    )
    mesh = Mesh(corners, [[0, 1, 2], [0, 2, 3]], uv=[[0, 0], [1, 0], [1, 1], [0, 1]])
    world = World("plane", (Body("plane", mesh, Material(1.0, texture)),), ambient=1.0)
    facing = Trajectory.still((0.0, 0.0, 0.0), look_at=(0.0, 1.0, 0.0))
    same = {"prism": Prism(math.radians(2.0)), "duration_s": 0.1, "sensor": SensorModel.ideal(0.1)}
    # the planar maps are blurred by their texels and their look-up too
    blur = math.sqrt(0.5**2 + 0.25 / 1.75**2)
    seen, _, _ = counts(
        Simulation(WorldScene(world, facing, seeing="maps", blur=blur), CAMERA, **same)
    )
    planar, _, _ = counts(
        Simulation(Scene.from_picture(texture, fov=math.radians(80.0), blur=0.5), CAMERA, **same)
    )
    assert planar.sum() > 3000
    assert seen.sum() == pytest.approx(planar.sum(), rel=0.05)
    assert (
        np.corrcoef(gaussian_filter(seen, 1.0).ravel(), gaussian_filter(planar, 1.0).ravel())[0, 1]
        > 0.98
    )


@pytest.mark.parametrize("seeing", ["maps", "rays"])
def test_points_of_events_project_to_their_places_without_the_prism(seeing: str) -> None:
    world, path = random_world(2), moving_camera()
    simulation = Simulation(
        WorldScene(world, path, seeing=seeing), CAMERA, Prism(math.radians(1.0)), 0.1
    )
    _, _, blocks = counts(simulation, chunk_us=40_000)
    assert len(blocks) == 3
    far = []
    for events, truth in blocks:
        places = truth.place.astype(np.float64)
        for k in np.flatnonzero(np.isfinite(places[:, 0]))[::17]:
            # at the time of its crossing, which the stamp follows by the latency
            t = float(events.t[k]) * 1e-6 - 1e-4
            far.append(np.linalg.norm(project(places[k : k + 1], t, path)[0] - truth.points[k]))
        assert set(np.unique(truth.instance)) <= set(range(len(world.instances) + 1))
    assert len(far) > 60
    assert np.quantile(far, 0.95) < 0.05  # [px]; the latency of single events differs from its mean


def test_maps_know_the_surfaces_that_rays_find() -> None:
    """The maps' faces shorten the search for the surface of an event; the answer is that of the whole mesh."""
    world, path = random_world(2), moving_camera()
    engine = Engine(
        Simulation(WorldScene(world, path, seeing="maps"), CAMERA, Prism(math.radians(1.0)), 0.1)
    )
    block = next(engine.run())
    near, no_faces = block.truth(), wp.empty(0, dtype=int, device="cpu")
    assert block.look is not None
    anywhere = block.look.func(*block.look.args[:-1], no_faces)  # type: ignore[attr-defined]
    assert len(near.instance) > 1000
    assert (near.instance == anywhere.instance.numpy()).mean() > 0.999
    # Infinities are equal
    close = np.isclose(near.depth, anywhere.depth.numpy(), rtol=1e-4, atol=1e-3)
    assert close.mean() > 0.99


def fast_ball(speed: float) -> World:
    """A box that flies across a world at rest [m/s], in the shadow of a lamp."""
    flight = Trajectory(
        [0.0, 1.0], [np.zeros(3), [speed, 0.0, 0.0]], [Rotation.identity().as_quat()] * 2
    )
    ball = Body(
        "ball", box((-1.0, -2.0, 0.3), (0.4, 0.4, 0.4)), Material(0.9, smooth_texture(50)), flight
    )
    world = random_world(5, moving=0)
    return World("ball", (*world.bodies, ball), lamps=(Lamp((0.0, -4.0, 3.0), 9.0, shadows=True),))


@pytest.mark.parametrize("moves", [False, True])
def test_maps_between_whole_maps_are_whole_maps(moves: bool) -> None:
    path = moving_camera() if moves else Trajectory.still((0.0, -6.0, 0.5), look_at=(0.0, 0.0, 0.0))
    engine = Engine(
        Simulation(WorldScene(fast_ball(10.0), path, blur=1.0), CAMERA, Prism(0.01), 0.1)
    )
    ring = engine._maps
    assert isinstance(ring, WorldMapRing)
    times, slots = ring.cover(0, 60_000)
    assert len(times) > 4 * ring.rendered  # far fewer whole maps than maps
    texels, shape = (
        ring.placement.width * ring.placement.height,
        (ring.placement.height, ring.placement.width),
    )
    kept = ring.maps.numpy()[:, 0].copy()
    for time, slot in list(zip(times, slots, strict=True))[1:-1:4]:
        whole = ring._render(time * 1e-6, ring._held[0].orientation)
        expected = ring.maps.numpy()[whole.slot * texels :][:texels, 0].reshape(shape)
        given = kept[slot * texels :][:texels].reshape(shape)
        if not moves:
            np.testing.assert_allclose(given, expected, rtol=0.0, atol=1e-5)
        # a camera that moves gives parallax of up to 0.5 px between whole maps, which edges feel
        assert np.sqrt(np.mean((given - expected) ** 2)) < 0.03
        before = kept[slots[0] * texels :][:texels].reshape(shape)
        # The ball has moved on
        assert np.sqrt(np.mean((before - expected) ** 2)) > 0.02 or time < 5000.0


def test_shadow_and_sky() -> None:
    floor = Body("floor", box((0.0, 0.0, -1.0), (20.0, 20.0, 0.1)), Material(0.5))
    block = Body("block", box((0.0, 0.0, 0.5), (1.0, 1.0, 0.2)), Material(0.9))
    world = World(
        "shadow", (floor, block), ambient=0.2, sun=Sun((0.0, 0.0, 1.0), 0.8), sky=Sky(0.7)
    )
    path = Trajectory.still((0.0, -6.0, 1.0), look_at=(0.0, 0.0, 0.0))
    truth = TruthRenderer(
        Simulation(WorldScene(world, path, samples=1), CAMERA, Prism(0.0), 0.1)
    ).at(0)
    on_floor = truth.instance == 1
    lit, dark = 0.5 * (0.2 + 0.8), 0.5 * 0.2
    values = truth.intensity[on_floor]
    assert np.isclose(values, lit, atol=1e-4).any()
    assert np.isclose(values, dark, atol=1e-4).any()
    assert (np.isclose(values, lit, atol=1e-4) | np.isclose(values, dark, atol=1e-4)).all()
    np.testing.assert_allclose(truth.intensity[truth.instance == 0], 0.7, atol=1e-4)


def test_a_flickering_lamp_makes_events_of_its_rate() -> None:
    wall = Body("wall", box((0.0, 4.0, 0.0), (12.0, 0.1, 12.0)), Material(0.5))
    world = World("lamp", (wall,), ambient=0.05, lamps=(Lamp((0.0, 0.0, 0.0), 8.0, 100.0, 0.8),))
    path = Trajectory.still((0.0, 0.0, 0.0), look_at=(0.0, 4.0, 0.0))
    _, engine, blocks = counts(
        Simulation(
            WorldScene(world, path, seeing="maps"),
            CAMERA,
            Prism(0.0),
            0.1,
            sensor=SensorModel.ideal(),
        )
    )
    on = np.concatenate([events.t[events.p == 1] for events, _ in blocks])
    phase = np.exp(2j * np.pi * 100.0 * on * 1e-6).mean()
    assert abs(phase) > 0.6  # ON events come while the light rises
    assert engine._step <= 1e6 / 1600


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: Mesh(np.zeros((3, 3)), np.zeros((0, 3), int)), "at least one triangle"),
        (lambda: Mesh(np.zeros((3, 3)), [[0, 1, 3]]), "outside of 0 .. 2"),
        (lambda: Mesh(np.zeros((3, 3)), [[0.0, 1.0, 2.0]]), "faces are float64; give whole"),
        (lambda: Material(texture=np.zeros(3)), r"shape \(3,\)"),
        (
            lambda: Mesh(np.eye(3), [[0, 1, 2]], light=[0.0, 5.0, -1.0]),
            r"light is -1 \.\. 5; give factors in 0 \.\. 1",
        ),
        (lambda: World("none", ()), "no bodies"),
        (lambda: World(5, ()), "world's name is 5; expected a str"),
        (
            lambda: Trajectory([0.0, 1e-3], [[0, 0, 0], [9, 0, 0]], [[0, 0, 0, 1]] * 2),
            "split the trajectory",
        ),
        (
            lambda: Trajectory([0.0, 2.0, 1.0], np.zeros((3, 3)), [[0, 0, 0, 1]] * 3),
            "do not increase: pose 2 at 1 s follows 2 s; sort the poses",
        ),
        (
            lambda: Trajectory([0.0, 1.0], [[0, 0, 0], [0, np.nan, 0]], [[0, 0, 0, 1]] * 2),
            "not finite, first in pose 1; remove",
        ),
        (
            lambda: Trajectory([0.0, 1.0], [[0, 0, 0]] * 2, [[0, 0, 0, 1], [0, 0, 0, 2]]),
            "length 2 in pose 1; give unit quaternions",
        ),
        (
            lambda: Trajectory.still((0, 0, 0), look_at=(1, 0, 0), rotation=(9, 9, 9, 9)),
            "look_at and rotation are both given; give one of them",
        ),
        (
            lambda: Trajectory.still((0, 0), look_at=(1, 0, 0)),
            r"^position is \(0, 0\); give 3 numbers in m",
        ),
        (
            lambda: Trajectory.still((0, 0, 0), look_at=(1, 0)),
            r"^look_at is \(1, 0\); give 3 numbers in m",
        ),
        (
            lambda: Trajectory.still((0, 1, 0), look_at=(0, 1, 0)),
            r"look_at is the position \(0, 1, 0\) itself; give a target at another place",
        ),
        (
            lambda: Trajectory.from_function(lambda t: 3, 1.0),
            r"pose returns 3 at 0 s; return a scipy",
        ),
        (
            lambda: Trajectory.from_function(lambda t: (None, [0, 0, 0]), 1.0),
            r"pose returns \(None, \[0, 0, 0\]\) at 0 s; return a scipy Rotation and a position of 3 numbers in m",
        ),
        (
            lambda: Trajectory.from_function(lambda t: (Rotation.identity(), [0, 0]), 1.0),
            "return a scipy Rotation and a position of 3 numbers in m",
        ),
        (
            lambda: Trajectory.still((0.0, 0.0, 0.0)).poses([0.0, np.nan]),
            r"t holds NaN; give times in seconds",
        ),
        (lambda: moving_camera().poses(np.array([np.nan])), r"t holds NaN"),
        (lambda: moving_camera().poses(np.zeros((2, 2))), r"t has shape \(2, 2\); .*shape \(k,\)"),
        (lambda: Sun((0.0, 0.0, 0.0)), "length 0"),
    ],
)
def test_bad_worlds_are_refused(make: Any, says: str) -> None:
    with pytest.raises(AmiwarpError, match=says):
        make()


def test_poses_are_computed_without_the_orientations_of_all_given_ones(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    path = moving_camera()
    expected = path.poses([0.05])
    monkeypatch.setattr(
        Rotation, "from_quat", lambda *_: pytest.fail("made once, not in each call")
    )
    for found, known in zip(path.poses([0.05]), expected, strict=True):
        np.testing.assert_array_equal(found, known)


@pytest.mark.parametrize("width", [64, 128])
def test_a_panorama_covers_all_directions(width: int) -> None:
    azimuth = np.pi - (np.arange(width) + 0.5) / width * 2.0 * np.pi
    elevation = np.pi / 2.0 - (np.arange(64)[:, None] + 0.5) / 64 * np.pi
    # 0.5 + 0.2 y + 0.2 z
    panorama = 0.5 + 0.2 * np.cos(elevation) * np.sin(azimuth) + 0.2 * np.sin(elevation)
    behind = Body("box", box((0.0, -9.0, 0.0), (1.0, 1.0, 1.0)))
    world = World("sky", (behind,), sky=Sky(1.0, panorama.astype(np.float32)))
    path = Trajectory.still((0.0, 0.0, 0.0), look_at=(1.0, 1.0, 0.3))
    luminance = TruthRenderer(
        Simulation(WorldScene(world, path), CAMERA, Prism(0.0), 0.1)
    ).luminance(0)
    pixels = np.stack(
        np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height)), axis=-1
    ).reshape(-1, 2)
    directions = CAMERA.pixels_to_rays(pixels.astype(np.float32)) @ path.poses([0.0])[0][0].T
    expected = 0.5 + 0.2 * directions[:, 1] + 0.2 * directions[:, 2]
    np.testing.assert_allclose(luminance.ravel(), expected, rtol=0, atol=1e-3)


@pytest.mark.parametrize("samples", [2, 4.0, True, "4"])
def test_the_number_of_rays_is_one_of_four(samples: Any) -> None:
    scene = WorldScene(random_world(1, moving=0), moving_camera(), samples=np.int64(9))  # type: ignore[arg-type]
    assert type(scene.samples) is int
    with pytest.raises(AmiwarpError, match="samples"):
        replace(scene, samples=samples)


def test_a_camera_inside_a_body_sees_its_inside() -> None:
    world = World("inside", (Body("box", box((0.0, 0.0, 0.0), (2.0, 2.0, 2.0)), Material(0.5)),))
    path = Trajectory.still((0.0, 0.0, 0.0), look_at=(0.0, 1.0, 0.0))
    truth = TruthRenderer(Simulation(WorldScene(world, path), CAMERA, Prism(0.02), 0.1)).at(0)
    assert (truth.instance == 1).all()
    np.testing.assert_allclose(truth.depth, 1.0, atol=1e-4)


def test_an_empty_view_gives_noise_only() -> None:
    world = World("behind", (Body("box", box((0.0, -9.0, 0.0), (1.0, 1.0, 1.0)), Material(0.5)),))
    path = Trajectory.still((0.0, 0.0, 0.0), look_at=(0.0, 1.0, 0.0))
    image, _, _ = counts(
        Simulation(WorldScene(world, path), CAMERA, Prism(0.02), 0.1, sensor=SensorModel.ideal())
    )
    assert image.sum() == 0.0
