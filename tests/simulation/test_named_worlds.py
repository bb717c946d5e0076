"""The named worlds: seeded, textured everywhere, of sound geometry, and seen by cameras that run into nothing."""

import functools
import math
import sys
from typing import Any

import numpy as np
import pytest
import warp as wp
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from amiwarp import AmiwarpError, Camera, Mesh, Trajectory, World, named_world
from amiwarp.simulation import DARK
from amiwarp.simulation.kernels.map_rendering import MapFrame
from amiwarp.simulation.worlds.device_world import DeviceWorld
from amiwarp.simulation.worlds.map_renderer import MapRenderer
from amiwarp.simulation.worlds.named import (
    TRAJECTORIES,
    WORLDS,
    ball,
    camera_paths,
    catalogue,
    gait,
    room,
    shapes,
    textures,
)
from amiwarp.simulation.worlds.surfaces import device_pose, pixel_rays, surfaces_at

FOV = math.radians(60.0)
ALL_ROUND = [Rotation.from_rotvec(v).as_matrix() for v in np.pi / 2 * np.array(
    [(0, 0, 0), (0, 1, 0), (0, 2, 0), (0, -1, 0), (1, 0, 0), (-1, 0, 0)])]  # fmt: skip
"""Six views that cover all directions."""


def volume(mesh: Mesh) -> float:
    """Of a closed mesh; negative if its faces are seen clockwise from outside."""
    a, b, c = (np.asarray(mesh.vertices)[np.asarray(mesh.faces)[:, k]] for k in range(3))
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6.0)


@pytest.mark.parametrize(
    ("mesh", "expected"),
    [
        (shapes.box((1, 2, 3), (5, 0, 1)), 6.0),
        (shapes.cylinder(0.5, 2.0, sides=200), math.pi / 2.0),
        (shapes.ellipsoid((1.0, 2.0, 3.0), sides=200, rings=100), 8.0 * math.pi),
        (shapes.capsule(0.5, 2.0, sides=200, rings=50), math.pi / 2.0 + math.pi / 6.0),
        (shapes.moved(shapes.box((1, 2, 3)), (1, 2, 3), turn_deg=30.0, axis=(1, 1, 0)), 6.0),
        (shapes.tapered(shapes.box((1, 1, 3)), 0.5), 1.75),
    ],
    ids=["box", "cylinder", "ellipsoid", "capsule", "moved box", "tapered box"],
)
def test_solids_have_their_volume_and_face_outwards(mesh: Mesh, expected: float) -> None:
    assert volume(mesh) == pytest.approx(expected, rel=2e-3)


@pytest.mark.parametrize(
    "mesh",
    [
        shapes.panel((0, 0, 0), (0, 2, 0), (1, 0, 0)),
        shapes.box((1, 2, 3)),
        shapes.gable_roof((3, 2, 1)),
    ],
)
def test_textures_are_not_mirrored(mesh: Mesh) -> None:
    """Seen from outside, each triangle turns on the texture as it does in space."""
    p, q, r = (np.asarray(mesh.uv)[np.asarray(mesh.faces)[:, k]] for k in range(3))
    turn = (q - p)[:, 0] * (r - p)[:, 1] - (q - p)[:, 1] * (r - p)[:, 0]
    assert (turn > 0).all()


def test_a_grating_changes_towards_its_angle() -> None:
    for angle in (0.0, 30.0, 90.0, 135.0):
        inside = textures.grating(angle, 6.0, size=240)[20:-20, 20:-20].astype(np.float64)
        by_row, by_column = np.gradient(inside)
        # Columns, rows
        towards = np.array([math.cos(math.radians(angle)), -math.sin(math.radians(angle))])
        across = towards[::-1] * (1.0, -1.0)
        along, sideways = (
            np.abs(by_column * d[0] + by_row * d[1]).mean() for d in (towards, across)
        )
        assert along > 10.0 * sideways


def test_fractal_noise_repeats() -> None:
    noise = textures.fractal(np.random.default_rng(0), 128, 256)
    inner = np.abs(np.diff(noise, axis=1)).mean()
    assert abs(noise.mean()) < 1e-9
    assert noise.std() == pytest.approx(1.0)
    assert np.abs(noise[:, 0] - noise[:, -1]).mean() < 1.5 * inner


@functools.cache
def made(name: str, kind: str) -> tuple[World, Trajectory]:
    """Return a world of seed 0 with six seconds of a camera's motion. Tests share it: it takes seconds to make.

    The handheld camera gets the world of the fast one, which is the same.
    """
    if kind != "handheld":
        return named_world(name, kind, duration_s=6.0)
    rng = np.random.default_rng([0, len(WORLDS)])
    return made(name, "fast")[0], camera_paths.camera_trajectory(
        catalogue.NAMED[name].view, kind, 6.0, rng
    )


def still(name: str) -> tuple[World, Trajectory]:
    return made(name, "still")


@pytest.mark.parametrize("name", WORLDS)
def test_size_and_reflectances(name: str) -> None:
    world, _ = still(name)
    assert 2_000 <= world.triangles <= 100_000
    for body in world.bodies:
        texture = body.material.texture
        if texture is not None and body.material.emission == 0.0:
            assert (
                textures.DARKEST - 1e-6
                <= texture.min()
                <= texture.max()
                <= textures.BRIGHTEST + 1e-6
            )
        assert body.category
        assert not np.isnan(np.asarray(body.mesh.uv)).any()


def rendered(
    world: World, trajectory: Trajectory, width: int = 320, height: int = 240
) -> NDArray[np.float32]:
    """Log intensity that a camera sees at the start."""
    device = DeviceWorld(world, "cpu")
    focal = width / 2.0 / math.tan(FOV / 2.0)
    frame = MapFrame()
    frame.width, frame.height, frame.pitch_x, frame.pitch_y, frame.cone = (
        width,
        height,
        focal,
        focal,
        1.0 / focal,
    )
    frame.left, frame.top = -width / 2.0 / focal, -height / 2.0 / focal
    out = wp.empty(width * height, dtype=wp.vec4, device="cpu")
    faces = wp.empty(width * height, dtype=int, device="cpu")
    rotation, position = trajectory.poses([0.0])
    pose = device_pose(rotation[0], position[0])
    MapRenderer(device, frame, blur=0.5, dark=DARK, samples=4).render(pose, out, faces, 0)
    return np.asarray(out.numpy()[:, 0].reshape(height, width))


@pytest.mark.parametrize("name", WORLDS)
def test_there_is_contrast_everywhere(name: str) -> None:
    """In squares of 20 px, which a prism of 1 deg moves about by 4 px at this size."""
    log = rendered(*still(name))
    squares = log.reshape(12, 20, 16, 20)
    span = squares.max(axis=(1, 3)) - squares.min(axis=(1, 3))
    assert (span > 0.2).mean() > 0.9
    assert np.median(span) > 0.8
    light = np.exp(log) - DARK
    assert 0.08 < np.median(light) < 0.7
    assert (light > 1.5).mean() < 0.03


@pytest.mark.parametrize("kind", ["handheld", "fast"])
@pytest.mark.parametrize("name", WORLDS)
def test_cameras_pass_through_no_body(name: str, kind: str) -> None:
    world, trajectory = made(name, kind)
    t = np.linspace(0.0, 6.0, 13)
    device = DeviceWorld(world, "cpu")
    device.set_instants(t)
    rotation, position = trajectory.poses(t)
    camera = Camera.from_fov(24, 24, math.radians(100.0))
    for k in range(len(t)):
        for turn in ALL_ROUND:
            view = surfaces_at(device, pixel_rays(camera), rotation[k] @ turn, position[k], k)
            away = np.linalg.norm(view.place - position[k].astype(np.float32), axis=1)[
                np.isfinite(view.depth)
            ]
            assert away.size == 0 or away.min() > 0.2


def content(world: World) -> list[Any]:
    return [
        part
        for body in world.bodies
        for part in (body.mesh.vertices, body.material.texture)
        if part is not None
    ]  # fmt: skip


@pytest.mark.parametrize("name", WORLDS)
def test_equal_seeds_give_equal_worlds(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever the trajectory; and without trimesh."""
    monkeypatch.setitem(sys.modules, "trimesh", None)
    one, same = (content(made(name, kind)[0]) for kind in ("still", "fast"))
    other = content(named_world(name, "still", seed=1)[0])
    assert len(one) == len(same)
    assert all(np.array_equal(a, b) for a, b in zip(one, same, strict=True))
    assert len(one) != len(other) or not all(
        np.array_equal(a, b) for a, b in zip(one, other, strict=True)
    )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("moon",), "world is 'moon'; choose among room, desk, corridor, street, ball, person"),
        (("room", "slow"), "trajectory is 'slow'; choose among still, handheld, fast"),
        (("room", "still", -1), "seed = -1 is not a whole number"),
        (("room", "still", 0, 0.0), "duration_s = 0.0 is not a finite number"),
    ],
)
def test_wrong_arguments(arguments: tuple[Any, ...], message: str) -> None:
    with pytest.raises(AmiwarpError, match=message):
        named_world(
            *arguments[:2], **dict(zip(("seed", "duration_s"), arguments[2:], strict=False))
        )


# -- cameras


def motion_of(kind: str, name: str = "room") -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Displacements [m] and turns [rad] of a camera against their means, 40 s at 100 per second."""
    trajectory = camera_paths.camera_trajectory(room.VIEW, kind, 40.0, np.random.default_rng(3))
    rotation, position = trajectory.poses(np.arange(4000) / 100.0)
    turns = Rotation.from_matrix(rotation[0].T @ rotation).as_rotvec()
    return position - position.mean(axis=0), turns - turns.mean(axis=0)


@pytest.mark.parametrize("name", WORLDS)
def test_a_still_camera_rests(name: str) -> None:
    assert not still(name)[1].moves


def test_a_hand_shakes_slowly() -> None:
    for values, amplitude in zip(
        motion_of("handheld"),
        (camera_paths.SHAKE_M, math.radians(camera_paths.SHAKE_DEG)),
        strict=True,
    ):
        assert 0.7 * amplitude < np.abs(values).max() < 2.2 * amplitude
        power = np.abs(np.fft.rfft(values * np.hanning(len(values))[:, None], axis=0)) ** 2
        frequency = np.fft.rfftfreq(len(values), 0.01)
        assert power[frequency > 3.0].sum() < 1e-4 * power.sum()


def test_fast_is_ten_times_as_fast() -> None:
    for slow, fast in zip(motion_of("handheld"), motion_of("fast"), strict=True):
        ratio = np.diff(fast, axis=0).std() / np.diff(slow, axis=0).std()
        assert 7.0 < ratio < 13.0


def image_motion(world: World, trajectory: Trajectory, times: NDArray[np.float64]) -> float:
    """Mean speed of what rests [px/s] for a camera of 640 px and 60 deg."""
    device, camera = DeviceWorld(world, "cpu"), Camera.from_fov(64, 48, FOV)
    step = 1e-3
    (here, at), (then, at_then) = trajectory.poses(times), trajectory.poses(times + step)
    speeds = []
    for k in range(len(times)):
        view = surfaces_at(device, pixel_rays(camera), here[k], at[k])
        places = view.place[np.isfinite(view.depth)].astype(np.float64)
        one, two = (places - at[k]) @ here[k], (places - at_then[k]) @ then[k]
        shift = two[:, :2] / two[:, 2:] - one[:, :2] / one[:, 2:]
        speeds.append(np.linalg.norm(shift, axis=1).mean() * 320.0 / math.tan(FOV / 2.0) / step)
    return float(np.mean(speeds))


def test_the_desk_moves_at_some_30_px_per_second() -> None:
    speeds = []
    for seed in range(3):
        world, trajectory = named_world("desk", "handheld", seed=seed, duration_s=4.0)
        speeds.append(image_motion(world, trajectory, np.linspace(0.1, 3.9, 12)))
    assert 22.0 < np.mean(speeds) < 40.0


@pytest.mark.parametrize("name", ["corridor", "street"])
def test_cameras_walk(name: str) -> None:
    _, trajectory = made(name, "handheld")
    _, position = trajectory.poses([0.0, 1.0])
    assert 1.0 < position[1, 0] - position[0, 0] < 1.6


# -- what moves


def test_the_ball_falls_as_balls_do() -> None:
    t, along, height = ball.flight(4.0)
    free = np.flatnonzero(height <= ball.RADIUS)[0] - 2
    assert t[free] > 0.8
    fall = np.diff(height[:free], 2) / np.diff(t)[0] ** 2
    np.testing.assert_allclose(fall, -ball.GRAVITY, rtol=0, atol=1e-3)
    assert height.min() >= ball.RADIUS
    assert height.max() < room.SIZE[2] - ball.RADIUS
    assert np.abs(along).max() < ball.PATH_HALF_LENGTH + 0.02


def test_the_ball_is_seen_all_the_way() -> None:
    world, camera_way = still("ball")
    device = DeviceWorld(world, "cpu")
    t = np.linspace(0.0, 0.85, 6)
    device.set_instants(t)
    rotation, position = camera_way.poses([0.0])
    number = world.instances.index("ball") + 1
    columns = []
    for k in range(len(t)):
        view = surfaces_at(
            device, pixel_rays(Camera.from_fov(160, 120, FOV)), rotation[0], position[0], k
        )
        (on,) = np.nonzero(view.instance == number)
        cols = on % 160
        assert len(cols) > 20
        assert set(view.mover[on]) == {0}
        columns.append(cols.mean())
    assert columns[-1] - columns[0] > 60.0
    assert (np.diff(columns) > 0).all()


def test_the_ball_touches_nothing_on_its_way() -> None:
    """Vertices of the room's other bodies stay outside of it, but for the floor and what lies on it."""
    world, _ = named_world("ball", "still", duration_s=4.0)
    way = next(body for body in world.bodies if body.name == "ball").trajectory
    assert way is not None
    _, places = way.poses(np.linspace(0.0, 4.0, 200))
    for body in world.bodies:
        if body.name not in ("ball", "floor", "rug"):
            vertices = np.asarray(body.mesh.vertices)
            nearest = np.linalg.norm(vertices[:, None] - places[None], axis=2).min()
            assert nearest > ball.RADIUS, body.name


def test_joints_of_the_person() -> None:
    world, _ = named_world("person", "still", duration_s=3.0)
    assert set(world.joints) == set(gait.JOINTS)
    assert len(world.joints) == 13
    person = [body for body in world.bodies if body.instance == "person"]
    assert [body.name for body in world.moving] == [body.name for body in person]
    t = np.linspace(0.0, 3.0, 200)
    at = {name: way.poses(t)[1] for name, way in world.joints.items()}
    bones = {("hip", "knee"): gait.THIGH, ("knee", "ankle"): gait.SHIN, ("shoulder", "elbow"): gait.UPPER_ARM,
             ("elbow", "wrist"): gait.FOREARM}  # fmt: skip
    for side in gait.SIDES:
        for (upper, lower), length in bones.items():
            distance = np.linalg.norm(at[f"{side} {upper}"] - at[f"{side} {lower}"], axis=1)
            np.testing.assert_allclose(distance, length, rtol=0, atol=2e-3)
    assert 1.4 < at["head"][:, 2].mean() < 1.8


def test_the_person_walks_on_the_floor() -> None:
    """The standing foot is on the floor and rests, nearly; the hips move at the speed of walking."""
    way = gait.walk(4.0)
    t = np.linspace(0.5, 3.5, 1000)
    ankles = np.stack([way[f"{side} ankle"].poses(t)[1] for side in gait.SIDES])
    lowest = ankles[:, :, 2].min(axis=0)
    np.testing.assert_allclose(lowest, gait.ANKLE, rtol=0, atol=2e-3)
    standing = ankles[:, :, 2].argmin(axis=0)[:-1]
    speed = np.linalg.norm(np.diff(ankles[:, :, :2], axis=1), axis=2) / np.diff(t)
    assert np.median(speed[standing, np.arange(len(standing))]) < 0.35 * gait.SPEED
    hips = way["pelvis"].poses(t)[1]
    walking = np.linalg.norm(np.diff(hips[:, :2], axis=0), axis=1).sum() / (t[-1] - t[0])
    assert walking == pytest.approx(gait.SPEED, rel=0.02)


@pytest.mark.parametrize("kind", TRAJECTORIES)
def test_trajectories_last_as_long_as_asked(kind: str) -> None:
    for duration_s in (0.001, 0.25, 3.0):
        world, trajectory = named_world("person", kind, duration_s=duration_s)
        ways = [trajectory] if kind != "still" else []
        for way in (*ways, *(body.trajectory for body in world.moving)):
            assert way is not None
            assert np.asarray(way.t)[-1] == pytest.approx(duration_s)
