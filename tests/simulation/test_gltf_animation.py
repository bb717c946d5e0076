"""Animations of glTF files: motion by the specification's formulas, truth, events, and files that are refused."""

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

import amiwarp
from amiwarp import AmiwarpError, load_world
from reference.gltf_motion import global_matrix
from tests.command_line import app
from tests.gltf_files import CORNERS, FACES, Channel, Maker

Array = NDArray[np.float64]

CAMERA = amiwarp.Camera.from_fov(64, 48, math.radians(60.0))
SMALL = amiwarp.Camera.from_fov(8, 6, 1.0)
AHEAD = amiwarp.Trajectory.still((0.0, -4.0, 0.3), look_at=(0.0, 0.0, 0.3))
UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""From the axes of a file to the world's."""
HAND = 2
"""Number of the node with the moving mesh."""


def rounded(values: Any) -> Any:
    """Numbers as a file of 32-bit numbers holds them."""
    return np.float32(values).astype(np.float64).tolist()


def quaternions(seed: int, count: int) -> Any:
    return Rotation.random(count, random_state=seed).as_quat().tolist()


def arm() -> tuple[list[dict[str, Any]], list[Channel]]:
    """A hand on an arm on a root: each interpolation, a uniform scale above, and a mirrored, stretched mesh."""
    rng = np.random.default_rng(4)
    nodes: list[dict[str, Any]] = [
        {"name": "root", "children": [1], "scale": [0.5, 0.5, 0.5]},
        {"name": "arm", "children": [HAND, 4], "translation": [0.2, 0.1, 0.3]},
        {
            "name": "hand",
            "mesh": 0,
            "scale": [2.0, 1.0, -3.0],
            "rotation": rounded(quaternions(1, 1)[0]),
        },
        {"name": "wall", "mesh": 0, "translation": [-4, -4, -3], "scale": [9, 9, 0.1]},
        {
            "name": "thumb",
            "mesh": 0,
            "matrix": [0, 0, -1, 0, 0, 1, 0, 0, 1, 0, 0, 0, 0.3, 0.5, 0.1, 1],
        },
    ]
    quarter = rounded(quaternions(2, 3))
    tangents = rounded(rng.normal(0.0, 1.0, (6, 4)))
    spline = [[tangents[k], quarter[k], tangents[3 + k]] for k in range(3)]
    swing = rounded(rng.normal(0.0, 0.5, (3, 3)))
    curve = rounded(rng.normal(0.0, 0.5, (3, 3, 3)))
    channels: list[Channel] = [
        (0, "rotation", "CUBICSPLINE", [0.125, 0.375, 0.875], spline),
        (0, "translation", "CUBICSPLINE", [0.0, 0.3125, 0.8125], curve),
        (1, "rotation", "LINEAR", [0.0, 0.25, 0.75], rounded(quaternions(3, 3))),
        (1, "translation", "LINEAR", [0.1875, 0.5, 1.0], swing),
        (1, "scale", "LINEAR", [0.0, 0.5], [[1, 1, 1], [1, 1, 1]]),
        (HAND, "translation", "STEP", [0.25, 0.625], rounded(rng.normal(0.0, 0.2, (2, 3)))),
    ]
    return nodes, channels


def corners_at(nodes: Any, channels: Any, index: int, t: float, corners: Any = CORNERS) -> Array:
    """The corners of a node's mesh in the world at time ``t`` [s], by the reference."""
    matrix = global_matrix(nodes, channels, index, t)
    return np.asarray((np.array(corners) @ matrix[:3, :3].T + matrix[:3, 3]) @ UP.T)


def world_file(folder: Path, mesh: str, *, sun: bool = False, **fields: Any) -> Path:
    body = {"name": "arm", "mesh": mesh, **fields}
    data: dict[str, Any] = {"format": "amiwarp-world", "version": 1, "bodies": [body]}
    if sun:
        data["sun"] = {"direction": [1, -2, 3], "intensity": 0.6}
    path = folder / "world.json"
    path.write_text(json.dumps(data))
    return path


def made(folder: Path, name: str = "arm.glb", **options: Any) -> Path:
    nodes, channels = arm()
    maker = Maker(nodes)
    maker.animate("Wave", channels)
    return maker.write(folder / name, **options)


def of_name(world: amiwarp.World, name: str) -> amiwarp.Body:
    (found,) = [body for body in world.bodies if body.name == name]
    return found


def seen_corners(body: amiwarp.Body, t: float) -> Array:
    assert body.trajectory is not None
    (rotation,), (position,) = body.trajectory.poses([t])
    return np.asarray(np.asarray(body.mesh.vertices) @ rotation.T + position)


@pytest.mark.parametrize(
    ("name", "options"), [("arm.glb", {}), ("arm.gltf", {}), ("arm.gltf", {"embedded": True})]
)
def test_bodies_move_as_the_specification_says(
    tmp_path: Path, name: str, options: dict[str, Any]
) -> None:
    made(tmp_path, name, **options)
    nodes, channels = arm()
    world, _ = load_world(world_file(tmp_path, name))
    assert [body.name for body in world.bodies] == ["arm/hand", "arm/thumb", "arm/wall"]
    assert [body.name for body in world.moving] == ["arm/hand", "arm/thumb"]
    assert world.instances == ("arm",)
    keys = [t for channel in channels for t in channel[3]]
    for t in [*np.linspace(0.0, 1.2, 97).tolist(), *keys]:
        for index in (HAND, 4):
            body = of_name(world, f"arm/{nodes[index]['name']}")
            expected = corners_at(nodes, channels, index, t)
            np.testing.assert_allclose(seen_corners(body, t), expected, rtol=0, atol=1e-6)  # m
    wall = np.asarray(of_name(world, "arm/wall").mesh.vertices)
    np.testing.assert_allclose(wall, corners_at(nodes, channels, 3, 0.0), rtol=0, atol=1e-6)


def test_options_of_a_body(tmp_path: Path) -> None:
    """Speed, loop and scale of the animation, which moves in a frame that moves."""
    made(tmp_path)
    nodes, channels = arm()
    turn = Rotation.from_rotvec([0.0, 0.0, 1.0])
    path = [
        {"t": 0.0, "position": [0, 0, 0]},
        {"t": 2.0, "position": [4, 0, 2], "rotation": turn.as_quat().tolist()},
    ]
    fields = {"animation": "Wave", "animation_loop": True, "animation_speed": 0.5, "scale": 0.1}
    world, _ = load_world(world_file(tmp_path, "arm.glb", trajectory=path, **fields))
    hand = of_name(world, "arm/hand")
    for t in (0.0, 0.3, 1.9, 2.3, 4.7, 5.98):
        inside = 0.1 * corners_at(nodes, channels, HAND, 0.5 * t % 1.0)
        share = min(t, 2.0) / 2.0
        carried = (
            Rotation.from_rotvec([0.0, 0.0, share]).apply(inside) + np.array([4, 0, 2]) * share
        )
        np.testing.assert_allclose(seen_corners(hand, t), carried, rtol=0, atol=1e-6)


def test_bodies_of_an_animation_begin_again_together(tmp_path: Path) -> None:
    """After the last key of the whole animation, also those whose own last key comes earlier."""
    maker = Maker([{"name": "early", "mesh": 0}, {"name": "late", "mesh": 0}])
    channels: list[Channel] = [
        (k, "translation", "LINEAR", [0, end], [(0, 0, 0), (1, 0, 0)])
        for k, end in enumerate((0.5, 1.0))
    ]
    maker.animate("Both", channels)
    maker.write(tmp_path / "two.glb")
    world, _ = load_world(world_file(tmp_path, "two.glb", animation_loop=True))
    for t, early, late in ((0.25, 0.5, 0.25), (0.75, 1.0, 0.75), (1.25, 0.5, 0.25)):
        for body, x in zip(world.bodies, (early, late), strict=True):
            np.testing.assert_allclose(seen_corners(body, t)[0, 0], x, rtol=0, atol=1e-9)


def test_the_first_animation_unless_one_is_named(tmp_path: Path) -> None:
    maker = Maker([{"name": "a", "mesh": 0}])
    for name, x in (("Near", 1.0), (None, 2.0)):
        maker.animate(name, [(0, "translation", "LINEAR", [0, 1], [(0, 0, 0), (x, 0, 0)])])
    maker.write(tmp_path / "two.glb")
    for fields, x in (({}, 1.0), ({"animation": "Near"}, 1.0), ({"animation": "animation 1"}, 2.0)):
        world, _ = load_world(world_file(tmp_path, "two.glb", **fields))
        (body,) = world.bodies
        np.testing.assert_allclose(seen_corners(body, 1.0)[0], [x, 0, 0], rtol=0, atol=1e-9)
    with pytest.raises(AmiwarpError, match=r"no animation 'Far'; choose among Near, animation 1"):
        load_world(world_file(tmp_path, "two.glb", animation="Far"))


def test_the_command_says_which_animation_it_follows(tmp_path: Path) -> None:
    maker = Maker([{"name": "a", "mesh": 0}])
    for name in ("Walk", "Run"):
        maker.animate(name, [(0, "translation", "LINEAR", [0, 1], [(0, 0, 0), (1, 0, 0)])])
    maker.write(tmp_path / "two.glb")
    world = world_file(tmp_path, "two.glb")
    AHEAD.save_tum(tmp_path / "poses.tum")
    words = ["--trajectory", tmp_path / "poses.tum", "--size", "16x12", "--duration", "0.01"]
    command = ["simulate", tmp_path / "out.h5", "--world", world, *words, "--device", "cpu"]
    result = CliRunner().invoke(app, [str(word) for word in command])
    assert result.exit_code == 0, result.output
    assert "note: arm follows animation 'Walk', not 'Run'" in result.output


def test_rotations_of_16_bit_integers(tmp_path: Path) -> None:
    half = math.sqrt(0.5)
    maker = Maker([{"mesh": 0}])
    maker.animate("Turn", [(0, "rotation", "LINEAR", [0, 1], [(0, 0, 0, 1), (0, 0, half, half)])])
    whole = round(half * 32767)
    output = maker.add([(0, 0, 0, 32767), (0, 0, whole, whole)], "VEC4", "h", 5122, normalized=True)
    maker.document["animations"][0]["samplers"][0]["output"] = output
    maker.write(tmp_path / "a.glb")
    (body,) = load_world(world_file(tmp_path, "a.glb", up="z"))[0].bodies
    assert body.name == "arm"
    third = [math.cos(math.pi / 6), math.sin(math.pi / 6), 0.0]
    np.testing.assert_allclose(seen_corners(body, 1 / 3)[1], third, rtol=0, atol=2e-5)


def cast(triangles: Array, origin: Array, rays: Array) -> tuple[Array, NDArray[np.int64]]:
    """Distance and number of the first triangle on each ray: planes and edges of each triangle, in float64."""
    nearest = np.full(len(rays), np.inf)
    which = np.full(len(rays), -1)
    for k, (a, b, c) in enumerate(triangles):
        normal = np.cross(b - a, c - a)
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = (a - origin) @ normal / (rays @ normal)
            place = origin + distance[:, None] * rays
            sides = [np.cross(v - u, place - u) @ normal for u, v in ((a, b), (b, c), (c, a))]
        met = (distance > 0.0) & (distance < nearest) & (np.min(sides, axis=0) >= 0.0)
        nearest[met] = distance[met]
        which[met] = k
    return nearest, which


def pixels_of(points: Array) -> Array:
    (rotation,), (position,) = AHEAD.poses([0.0])
    x, y, z = ((points - position) @ rotation).T
    return np.stack([CAMERA.fx * x / z + CAMERA.cx, CAMERA.fy * y / z + CAMERA.cy], axis=1)


@pytest.mark.parametrize("t_us", [0, 249_990, 250_000, 250_010, 437_000, 750_000])
def test_flow_and_depth_are_what_an_independent_ray_tracer_says(
    tmp_path: Path, t_us: int, device: str
) -> None:
    """Also within 10 us of a key, where another velocity begins and the hand jumps: the flow is that after the key."""
    made(tmp_path)
    nodes, channels = arm()
    world, _ = load_world(world_file(tmp_path, "arm.glb"))
    scene = amiwarp.WorldScene(world, AHEAD)
    simulation = amiwarp.Simulation(scene, CAMERA, amiwarp.Prism(0.02), 1.0, device=device)
    renderer = amiwarp.TruthRenderer(simulation)
    truth = renderer.at(t_us)

    t = t_us * 1e-6
    parts = (HAND, 4, 3)

    def triangles(moment: float) -> Array:
        return np.concatenate(
            [corners_at(nodes, channels, k, moment)[np.array(FACES)] for k in parts]
        )

    now = triangles(t)
    (rotation,), (position,) = AHEAD.poses([0.0])
    columns, rows = np.meshgrid(np.arange(64), np.arange(48))
    x = (columns.ravel() - CAMERA.cx) / CAMERA.fx
    y = (rows.ravel() - CAMERA.cy) / CAMERA.fy
    rays = np.stack([x, y, np.ones(len(x))], axis=1) @ rotation.T
    depth, face = cast(now, position, rays)  # depth: the rays have length 1 along the axis
    on_body = (face >= 0) & (face < 8)
    assert on_body.sum() > 50

    found = truth.depth.ravel()
    same = np.isclose(found, depth, rtol=0, atol=1e-4)
    assert same[face >= 0].mean() > 0.99  # edges
    assert (np.isfinite(found) == (face >= 0)).mean() > 0.995

    # Where the points are later, by weights of the corners.
    hit = same & on_body
    points = position + depth[hit, None] * rays[hit]
    corners = now[face[hit]]
    frame = np.moveaxis(corners - points[:, None], 1, 2)
    weights = np.linalg.svd(frame)[2][:, -1]
    weights /= weights.sum(axis=1, keepdims=True)

    def place(moment: float) -> Array:
        return pixels_of(np.einsum("nk,nkj->nj", weights, triangles(moment)[face[hit]]))

    step = 2e-6
    flow = (-3.0 * place(t) + 4.0 * place(t + step) - place(t + 2 * step)) / (2.0 * step)
    if t_us == 249_990:
        flow = (place(t + step) - place(t - step)) / (2.0 * step)
    assert np.abs(flow).max() > 20.0
    np.testing.assert_allclose(truth.flow.reshape(-1, 2)[hit], flow, rtol=1e-3, atol=0.02)  # px/s

    later_us = 650_000
    moved, _ = renderer.displacement(t_us, later_us)
    expected = place(later_us * 1e-6) - place(t)
    np.testing.assert_allclose(moved.reshape(-1, 2)[hit], expected, rtol=0, atol=2e-3)  # px


def slide(folder: Path, kind: str, times: Any, values: Any, **fields: Any) -> amiwarp.World:
    """A square of 0.8 m before a sky that moves along x."""
    corners = [(-0.4, -0.4, 0.0), (0.4, -0.4, 0.0), (0.4, 0.4, 0.0), (-0.4, 0.4, 0.0)]
    maker = Maker([{"mesh": 0}], corners, [(0, 1, 2), (0, 2, 3)])
    maker.animate("Slide", [(0, "translation", kind, times, values)])
    maker.write(folder / "slide.glb")
    return load_world(world_file(folder, "slide.glb", **fields))[0]


def events_of(
    world: amiwarp.World, duration_s: float, contrast: float = 0.25, **options: Any
) -> amiwarp.Events:
    simulation = amiwarp.Simulation(
        amiwarp.WorldScene(world, AHEAD, **options),
        CAMERA,
        amiwarp.Prism(0.01),
        duration_s,
        sensor=replace(amiwarp.SensorModel.ideal(), contrast_on=contrast, contrast_off=contrast),
    )
    return simulation.without_prism().run().events[:]


@pytest.mark.parametrize("seeing", ["maps", "rays"])
def test_a_body_that_starts_late_makes_events_when_it_moves(tmp_path: Path, seeing: str) -> None:
    """The image stands still until the key at 0.1 s: a map of the future must not be blended into the rest."""
    values = [(0, 0, 0), (0, 0, 0), (0.5, 0, 0), (0.5, 0, 0)]
    world = slide(tmp_path, "LINEAR", [0, 0.1, 0.15, 0.3], values)
    events = events_of(world, 0.3, seeing=seeing)
    assert len(events) > 200
    assert events.t.min() > 100_000
    assert events.t.max() < 151_000
    # A uniform motion makes as many events in its first as in its second half.
    first = np.count_nonzero(events.t < 125_000)
    assert 0.4 < first / len(events) < 0.6


@pytest.mark.parametrize("seeing", ["maps", "rays"])
def test_a_body_that_starts_slowly_is_not_missed(tmp_path: Path, seeing: str) -> None:
    """It rests at both keys of a spline, and moves only between them."""
    zero = (0.0, 0.0, 0.0)
    keys = [[zero, zero, zero], [zero, (0.5, 0.0, 0.0), zero]]
    world = slide(tmp_path, "CUBICSPLINE", [0, 0.2], keys)
    events = events_of(world, 0.2, seeing=seeing)
    assert len(events) > 200
    # Half of the way is done after half of the time, and the middle half of the time makes 69 % of it.
    middle = np.count_nonzero((events.t > 50_000) & (events.t < 150_000))
    assert 0.6 < middle / len(events) < 0.78


def test_a_short_fast_motion_is_seen_in_short_steps(tmp_path: Path) -> None:
    """Its edge passes one column of pixels after the other, although the motion lasts 2 ms of 200."""
    values = [(0, 0, 0), (0, 0, 0), (0.4, 0, 0), (0.4, 0, 0)]
    world = slide(tmp_path, "LINEAR", [0, 0.1025, 0.1045, 0.2], values)
    events = events_of(world, 0.2, seeing="rays")
    right = events.x > CAMERA.cx + 2
    columns = np.unique(events.x[right])
    times = [np.median(events.t[right & (events.x == column)]) for column in columns]
    assert len(times) >= 5
    assert (np.diff(times[:-1]) > 100).all()  # us; the last is reached in part
    assert np.ptp(times) > 1000


@pytest.mark.parametrize("seeing", ["maps", "rays"])
@pytest.mark.parametrize("loop", [False, True])
def test_a_jump_makes_events_at_its_time_alone(tmp_path: Path, seeing: str, loop: bool) -> None:
    values = [(0, 0, 0), (0.5, 0, 0), (0.5, 0, 0)]
    world = slide(tmp_path, "STEP", [0, 0.0625, 0.125], values, animation_loop=loop)
    events = events_of(world, 0.3, seeing=seeing)
    jumps = np.array([62_500, 125_000, 187_500, 250_000] if loop else [62_500])
    nearest = np.abs(events.t[:, None] - jumps).argmin(axis=1)
    late = events.t - jumps[nearest]
    assert np.abs(late).max() < 1600  # the time step [us] in which it lies
    assert (np.bincount(nearest, minlength=len(jumps)) > 100).all()


def test_events_of_an_animation_are_events_of_the_same_motion(tmp_path: Path) -> None:
    """Bodies that an animation moves, and bodies that follow a spline through its poses every 0.1 ms."""
    made(tmp_path)
    world, _ = load_world(world_file(tmp_path, "arm.glb", sun=True))
    bodies = []
    t = np.linspace(0.0, 0.1, 1001)
    for body in world.bodies:
        if body in world.moving and body.trajectory is not None:
            rotation, position = body.trajectory.poses(t)
            path = amiwarp.Trajectory(t, position, Rotation.from_matrix(rotation).as_quat())
            body = replace(body, trajectory=path)
        bodies.append(body)
    smooth = replace(world, bodies=tuple(bodies))
    by_time = [
        np.bincount(events_of(one, 0.06, 0.1).t // 20_000, minlength=3) for one in (world, smooth)
    ]
    assert by_time[0].sum() > 100
    np.testing.assert_allclose(by_time[0], by_time[1], rtol=0, atol=4)  # events


def changed_slide(change: Callable[[Maker], None]) -> Callable[[Path], None]:
    """Write a slide whose document is changed before."""

    def write(path: Path) -> None:
        maker = Maker([{"name": "sled", "mesh": 0}])
        values = [(0, 0, 0), (1, 0, 0)]
        maker.animate("Slide", [(0, "translation", "LINEAR", [0, 1], values)])
        change(maker)
        maker.write(path)

    return write


def one_channel(
    path: str, kind: str, times: Any, values: Any, nodes: Any = None
) -> Callable[[Path], None]:
    def write(file: Path) -> None:
        maker = Maker(nodes or [{"name": "sled", "mesh": 0}])
        maker.animate("Slide", [(0, path, kind, times, values)])
        maker.write(file)

    return write


def sampler(maker: Maker, **fields: Any) -> None:
    maker.document["animations"][0]["samplers"][0].update(fields)


def target(maker: Maker, **fields: Any) -> None:
    maker.document["animations"][0]["channels"][0]["target"].update(fields)


def accessor(maker: Maker, **fields: Any) -> None:
    maker.accessors[-1].update(fields)


def node(maker: Maker, **fields: Any) -> None:
    maker.document["nodes"][0].update(fields)


def twice(maker: Maker) -> None:
    maker.document["animations"][0]["channels"] *= 2


def morph(weights: Any) -> Callable[[Maker], None]:
    def change(maker: Maker) -> None:
        maker.document["meshes"][0]["primitives"][0]["targets"] = [{"POSITION": 0}]
        node(maker, weights=weights)

    return change


def morph_animated(maker: Maker) -> None:
    morph([0])(maker)
    maker.document["animations"][0]["channels"].append(
        {"sampler": 0, "target": {"node": 0, "path": "weights", "extras": {}}}
    )


X = [(0, 0, 0), (1, 0, 0)]
HERE = r"animation 'Slide', translation of node 'sled'"
REFUSED: dict[str, tuple[Callable[[Path], None], str]] = {
    "accessor missing": (
        changed_slide(lambda m: sampler(m, output=99)),
        rf"{HERE} refers to accessors\[99\], which does not exist; export the file again",
    ),
    "accessor of text": (
        changed_slide(lambda m: sampler(m, input="0")),
        rf"{HERE}: times refers to accessors\['0'\], which does not exist",
    ),
    "no sampler": (
        changed_slide(lambda m: m.document["animations"][0].update(samplers=[])),
        f"{HERE} refers to a sampler that does not exist",
    ),
    "no node": (
        changed_slide(lambda m: target(m, node=7)),
        r"animation 'Slide' refers to nodes\[7\], which does not exist",
    ),
    "buffer too short": (
        changed_slide(lambda m: accessor(m, count=3)),
        f"{HERE} reaches beyond its buffer",
    ),
    "view beyond the buffer": (
        changed_slide(lambda m: m.views[-1].update(byteOffset=10**6)),
        f"{HERE} reaches beyond its buffer",
    ),
    "negative offset": (
        changed_slide(lambda m: accessor(m, byteOffset=-4)),
        f"{HERE} has the size or offset -4",
    ),
    "huge count": (
        changed_slide(lambda m: accessor(m, count=10**15)),
        f"{HERE} reaches beyond its buffer",
    ),
    "values of another type": (
        changed_slide(lambda m: accessor(m, type="VEC4")),
        f"{HERE} has elements of 'VEC4', not VEC3",
    ),
    "sparse": (
        changed_slide(lambda m: accessor(m, sparse={})),
        f"{HERE} has a sparse accessor, which is not read; export without",
    ),
    "meshopt": (
        changed_slide(lambda m: m.views[-1].update(extensions={"EXT_meshopt_compression": {}})),
        f"{HERE} is compressed by meshopt; export without compression",
    ),
    "times of NaN": (
        one_channel("translation", "LINEAR", [0, math.nan], X),
        f"{HERE}: times holds numbers that are not finite",
    ),
    "values of infinity": (
        one_channel("translation", "LINEAR", [0, 1], [(0, 0, 0), (math.inf, 0, 0)]),
        f"{HERE} holds numbers that are not finite",
    ),
    "unsorted": (
        one_channel("translation", "LINEAR", [1, 0], X),
        f"{HERE} has times that do not increase from 0",
    ),
    "equal times": (
        one_channel("translation", "LINEAR", [1, 1], X),
        f"{HERE} has times that do not increase from 0",
    ),
    "negative time": (
        one_channel("translation", "LINEAR", [-1, 1], X),
        f"{HERE} has times that do not increase from 0",
    ),
    "other number of values": (
        one_channel("translation", "LINEAR", [0, 1, 2], X),
        f"{HERE} has 3 times, but 2 values",
    ),
    "spline without tangents": (
        changed_slide(lambda m: sampler(m, interpolation="CUBICSPLINE")),
        f"{HERE} has 2 times, but 2 values",
    ),
    "interpolation": (
        changed_slide(lambda m: sampler(m, interpolation="BEZIER")),
        f"{HERE} has the unknown interpolation 'BEZIER'",
    ),
    "zero quaternion": (
        one_channel("rotation", "LINEAR", [0, 1], [(0, 0, 0, 1), (0, 0, 0, 0)]),
        r"rotation of node 'sled' has a quaternion of length 0 at key 1, not 1",
    ),
    "quaternion at rest": (
        changed_slide(lambda m: node(m, rotation=[0, 0, 0, 0])),
        "node 'sled' has a quaternion of length 0",
    ),
    "place of text": (
        changed_slide(lambda m: node(m, scale="big")),
        "node 'sled' has the place 'big'; expected 3 numbers",
    ),
    "matrix": (
        changed_slide(lambda m: node(m, matrix=np.eye(4).ravel().tolist())),
        f"{HERE}: the node has a matrix, which cannot be animated",
    ),
    "animated twice": (changed_slide(twice), f"{HERE} is animated twice"),
    "own ancestor": (
        one_channel(
            "translation",
            "LINEAR",
            [0, 1],
            X,
            [
                {"mesh": 0, "name": "sled"},
                {"name": "a", "children": [2]},
                {"name": "b", "children": [1]},
            ],
        ),
        "node 'a' is its own ancestor; export",
    ),
    "two parents": (
        one_channel(
            "translation",
            "LINEAR",
            [0, 1],
            X,
            [{"name": "sled", "mesh": 0, "children": [1, 1]}, {"name": "a"}],
        ),
        "node 'a' is a child of two nodes",
    ),
    "child missing": (
        changed_slide(lambda m: node(m, children=[5])),
        r"node 'sled' refers to nodes\[5\], which does not exist",
    ),
    "changing scale": (
        one_channel("scale", "LINEAR", [0, 1], [(1, 1, 1), (1, 1, 1.01)]),
        "moves node 'sled' and changes its scale at 1 s, but bodies are rigid; remove the changing scale",
    ),
    "scale that changes between keys": (
        one_channel("scale", "CUBICSPLINE", [0, 1], [[(0,) * 3, (1,) * 3, (1,) * 3]] * 2),
        "moves node 'sled' and changes its scale",
    ),
    "shear by a turn below a scale": (
        one_channel(
            "rotation",
            "LINEAR",
            [0, 1],
            [(0, 0, 0, 1), (0, 0, 1, 0)],
            [
                {"name": "sled", "mesh": 0},
                {"name": "stretched", "children": [0], "scale": [1, 2, 1]},
            ],
        ),
        "moves node 'sled' and changes its scale",
    ),
    "flat": (
        changed_slide(lambda m: node(m, scale=[1, 1, 0])),
        "moves node 'sled', which has a scale of 0 in a direction",
    ),
    "too fast": (
        one_channel("translation", "LINEAR", [0, 0.001], [(0, 0, 0), (2, 0, 0)]),
        r"bodies\[0\]: trajectory moves at 2e\+03 m/s",
    ),
    "pointer": (
        changed_slide(lambda m: target(m, path="pointer")),
        "animation 'Slide' animates 'pointer', which is not read; bake it into translation",
    ),
    "skin": (
        changed_slide(lambda m: node(m, skin=0)),
        "node 'sled' has a skin, but bodies are rigid; bake it into one mesh of a single pose",
    ),
    "morph targets": (
        changed_slide(morph([0, 0.5])),
        "node 'sled' has morph targets, but bodies are rigid; apply them to the mesh",
    ),
    "animated morph targets": (
        changed_slide(morph_animated),
        "node 'sled' has morph targets, but bodies are rigid",
    ),
    "animations of text": (
        changed_slide(lambda m: m.document.update(animations="x")),
        "its animations are no list of objects",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_damaged_files_are_refused_by_node(tmp_path: Path, case: str) -> None:
    write, says = REFUSED[case]
    write(tmp_path / "bad.glb")
    with pytest.raises(AmiwarpError, match=rf"world\.json: .*{says}") as caught:
        load_world(world_file(tmp_path, "bad.glb"))
    assert "\n" not in str(caught.value)
    if case != "too fast":
        assert "bad.glb" in str(caught.value)


def test_morph_targets_without_weight_leave_the_mesh(tmp_path: Path) -> None:
    changed_slide(morph([0, 0]))(tmp_path / "a.glb")
    (body,) = load_world(world_file(tmp_path, "a.glb"))[0].bodies
    np.testing.assert_allclose(seen_corners(body, 0.0), np.array(CORNERS) @ UP.T, rtol=0, atol=1e-7)


@pytest.mark.parametrize(
    ("fields", "says"),
    [
        ({"animation": 3}, r"bodies\[0\].animation"),
        ({"animation_speed": 0.0}, r"field bodies\[0\].animation_speed = 0.0 is not"),
        ({"animation_speed": 5000.0}, r"field bodies\[0\].animation_speed = 5000.0 is not"),
        ({"animation_loop": 1}, r"bodies\[0\].animation_loop"),
    ],
)
def test_fields_of_animations(tmp_path: Path, fields: dict[str, Any], says: str) -> None:
    made(tmp_path)
    with pytest.raises(AmiwarpError, match=says):
        load_world(world_file(tmp_path, "arm.glb", **fields))


def test_fields_of_animations_need_an_animation(tmp_path: Path) -> None:
    Maker([{"mesh": 0}]).write(tmp_path / "still.glb")
    for name, value in (("animation_loop", True), ("animation_speed", 2.0)):
        with pytest.raises(AmiwarpError, match=rf"{name}: no animation moves a part of still\.glb"):
            load_world(world_file(tmp_path, "still.glb", **{name: value}))
    with pytest.raises(
        AmiwarpError, match="has no animation 'Walk'; it has none; remove the field"
    ):
        load_world(world_file(tmp_path, "still.glb", animation="Walk"))
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    with pytest.raises(AmiwarpError, match="has no animations, which only glTF and GLB files have"):
        load_world(world_file(tmp_path, "a.obj", animation="Walk"))


def test_a_short_animation_is_not_repeated(tmp_path: Path) -> None:
    with pytest.raises(AmiwarpError, match=r"'Slide' would be repeated after 0\.0001 s; give"):
        slide(tmp_path, "STEP", [0, 0.0001], X, animation_loop=True)


def test_an_animation_has_no_acceleration(tmp_path: Path) -> None:
    world = slide(tmp_path, "LINEAR", [0, 1], X)
    path = world.bodies[0].trajectory
    assert path is not None
    simulation = amiwarp.Simulation(
        amiwarp.WorldScene(world, path, seeing="rays"),
        SMALL,
        amiwarp.Prism(0.01),
        0.001,
        imu=amiwarp.ImuModel.preset("ideal"),
    )
    with pytest.raises(AmiwarpError, match="no acceleration at its keys; sample it"):
        simulation.run()
