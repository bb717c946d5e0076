"""World files and mesh files: what they hold comes out, and every mistake names file, field and value."""

import json
import re
import struct
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial.transform import Rotation

import amiwarp
from amiwarp import AmiwarpError, Sun, Trajectory, load_world
from amiwarp.io.inputs import inputs_in_use, inputs_noted
from amiwarp.simulation import linear_luminance
from amiwarp.simulation.picture_light import LUMINANCE
from amiwarp.simulation.worlds import trajectory
from amiwarp.simulation.worlds.mesh_reader import load_mesh
from tests import ROOT
from tests.gltf_files import Maker

PAGE = ROOT / "docs" / "reference" / "world-files.md"
EXAMPLE = re.findall(r"```toml\n(.*?)```", PAGE.read_text(), re.S)[0]
SIZE = (1.0, 2.0, 3.0)
GREY = 128


def picture(path: Path, size: tuple[int, int] = (8, 4)) -> NDArray[np.uint8]:
    pixels = np.random.default_rng(0).integers(0, 256, (size[1], size[0], 3), dtype=np.uint8)
    Image.fromarray(pixels).save(path)
    return pixels


def quad(path: Path, extra: str = "") -> None:
    path.write_text(
        f"{extra}v -1 0 -1\nv 1 0 -1\nv 1 0 1\nv -1 0 1\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
        f"{'usemtl paint' if extra else ''}\nf 1/1 2/2 3/3\nf 1/1 3/3 4/4\n"
    )


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """The files of the documentation's example."""
    quad(tmp_path / "board.obj")
    box = trimesh.creation.box(SIZE)
    box.visual.vertex_colors = [GREY, GREY, GREY, 255]
    box.export(tmp_path / "toy.ply")
    (tmp_path / "toy.csv").write_text("t,x,y,z,qx,qy,qz,qw\n0,0,0,1,0,0,0,1\n1,0.5,0,1,0,0,0,1\n")
    fan = Maker([{"name": "blade", "mesh": 0}])
    fan.animate(
        "Turn",
        [(0, "rotation", "LINEAR", [0, 1, 2], [(0, 0, 0, 1), (0, 0, 0.6, 0.8), (0, 0, 0, 1)])],
    )
    fan.write(tmp_path / "fan.glb")
    picture(tmp_path / "wood.png")
    picture(tmp_path / "sky.png", (16, 8))
    (tmp_path / "shelf.toml").write_text(EXAMPLE)
    return tmp_path


def test_the_documented_example(folder: Path) -> None:
    world, trajectory = load_world(folder / "shelf.toml")
    board, toy, fan = world.bodies
    assert (world.name, world.ambient, world.triangles) == ("shelf", 0.4, 18)
    assert world.instances == ("board", "toy car", "fan")
    assert world.categories == ("furniture", "toy", "")
    assert world.moving == (toy, fan)
    assert world.sun is not None
    np.testing.assert_allclose(
        world.sun.direction, np.array([1, -1, 2]) / np.sqrt(6), rtol=0, atol=1e-12
    )
    assert (world.lamps[0].flicker_hz, world.lamps[0].flicker_depth) == (100.0, 0.2)
    assert world.sky.luminance == 0.9
    assert world.sky.panorama is not None
    assert world.sky.panorama.shape == (8, 16)
    assert board.material.reflectance == 0.7
    assert board.material.texture is not None
    assert board.material.texture.shape == (4, 8)
    np.testing.assert_allclose(
        np.ptp(np.asarray(toy.mesh.vertices), axis=0), np.array(SIZE) / 100, rtol=0, atol=1e-9
    )
    assert list(world.joints) == ["nose"]
    assert trajectory is not None
    rotation, position = trajectory.poses(np.array([0.5]))
    np.testing.assert_allclose(position[0], [0.1, -2.0, 1.0], rtol=0, atol=1e-12)
    towards = np.array([-0.1, 2.0, -0.5])
    np.testing.assert_allclose(
        rotation[0][:, 2], towards / np.linalg.norm(towards), rtol=0, atol=1e-9
    )
    assert board.trajectory is not None
    np.testing.assert_allclose(board.trajectory.poses([0.0])[1][0], [0.0, 0.0, 0.5], rtol=0, atol=0)


def test_the_example_has_every_field() -> None:
    """Those in the first column of the page's tables, and those in the third of nested ones."""
    data = tomllib.loads(EXAMPLE)
    documented = {
        name
        for row in re.findall(r"^\| (`[^|]*) \|", PAGE.read_text(), re.M)
        for name in re.findall(r"`(\w+)`", row)
    }
    used = {*data, *(key for body in data["bodies"] for key in body)}
    assert documented == used


def test_json_holds_the_same(folder: Path) -> None:
    (folder / "shelf.json").write_text(json.dumps(tomllib.loads(EXAMPLE)))
    one, other = (load_world(folder / f"shelf.{kind}") for kind in ("toml", "json"))
    assert one[0].instances == other[0].instances
    assert one[0].sun == other[0].sun
    assert one[1] is not None
    assert other[1] is not None
    np.testing.assert_array_equal(one[1].rotation, other[1].rotation)


def changed(**fields: Any) -> Callable[[dict[str, Any]], None]:
    """A change of the example: ``body__up`` is the second body's field ``up``; None deletes."""

    def change(data: dict[str, Any]) -> None:
        for name, value in fields.items():
            where, _, key = name.rpartition("__")
            target = {
                "": data,
                "body": data["bodies"][1],
                "first": data["bodies"][0],
                "lamp": data["lamps"][0],
            }.get(where)
            target = data[where] if target is None else target
            if value is None:
                del target[key]
            else:
                target[key] = value

    return change


MISTAKES: dict[str, tuple[Callable[[dict[str, Any]], None], str]] = {
    "no format": (changed(format=None), "field format is missing"),
    "other format": (changed(format="x"), "'x' and 1; expected 'amiwarp-world' and 1"),
    "no bodies": (changed(bodies=[]), "has no bodies; give at least one"),
    "unknown field": (changed(colour=1), "field colour is unknown; expected format"),
    "unknown in a body": (
        changed(body__color=1),
        r"field bodies\[1\].color is unknown; expected name, mesh",
    ),
    "unknown in a lamp": (changed(lamp__power=1), r"field lamps\[0\].power is unknown"),
    "unknown in the sun": (changed(sun__colour=1), "field sun.colour is unknown"),
    "name twice": (changed(body__name="board"), "several bodies named 'board'; give unique names"),
    "mesh missing": (
        changed(body__mesh="no.ply"),
        r"field bodies\[1\].mesh: .*no\.ply: no such file",
    ),
    "mesh of unknown format": (
        changed(body__mesh="toy.fbx"),
        r"unknown mesh format '.fbx'; give one of glb",
    ),
    "scale": (changed(body__scale=0), r"field bodies\[1\].scale = 0.* is not a finite number in"),
    "up": (changed(body__up="x"), r"field bodies\[1\].up is 'x'; choose among y, z"),
    "texture missing": (
        changed(first__material={"texture": "no.png"}),
        r"field bodies\[0\].material.texture: .*no\.png: no such file",
    ),
    "texture without coordinates": (
        changed(body__material={"texture": "wood.png"}),
        r"bodies\[1\].material.texture needs texture coordinates, but",
    ),
    "reflectance": (
        changed(first__material={"reflectance": 2.0}),
        r"field bodies\[0\].material: material reflectance = 2.0",
    ),
    "pose and trajectory": (
        changed(body__position=[0, 0, 0]),
        r"field bodies\[1\].position cannot be combined with a trajectory",
    ),
    "trajectory missing": (
        changed(body__trajectory="no.csv"),
        r"field bodies\[1\].trajectory: .*no\.csv: no such file",
    ),
    "trajectory empty": (
        changed(body__trajectory=[]),
        r"field bodies\[1\].trajectory is empty; give at least one pose",
    ),
    "trajectory of text": (
        changed(camera__trajectory=3),
        "field camera.trajectory is 3; expected the name of a file or a list",
    ),
    "jump": (
        changed(
            camera__trajectory=[
                {"t": 0, "position": [0, 0, 0]},
                {"t": 0.001, "position": [9, 0, 0]},
            ]
        ),
        "field camera.trajectory: trajectory moves at 9e\\+03 m/s",
    ),
    "two orientations": (
        changed(
            camera__trajectory=[
                {"t": 0, "position": [0, 0, 0], "rotation": [0, 0, 0, 1], "look_at": [1, 0, 0]}
            ]
        ),
        r"field camera.trajectory\[0\] has both rotation and look_at; give one of them",
    ),
    "looks at itself": (
        changed(camera__trajectory=[{"t": 0, "position": [0, 0, 0], "look_at": [0, 0, 0]}]),
        r"field camera.trajectory\[0\]: look_at is the position \(0\.0, 0\.0, 0\.0\) itself",
    ),
    "sun without direction": (
        changed(sun__direction=[0, 0, 0]),
        "field sun: sun direction has length 0",
    ),
    "lamp's place": (
        changed(lamp__position=[0, 0]),
        r"field lamps\[0\].position has 2 entries; expected 3",
    ),
    "ambient": (changed(ambient=-1), "field ambient = -1 is not"),
    "panorama missing": (changed(sky__panorama="no.png"), r"field sky: .*no\.png: no such file"),
    "bodies of text": (changed(bodies="x"), "field bodies is 'x'; expected a list"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_mistakes_name_file_and_field(folder: Path, mistake: str) -> None:
    change, message = MISTAKES[mistake]
    data = tomllib.loads(EXAMPLE)
    change(data)
    (folder / "w.json").write_text(json.dumps(data))
    with pytest.raises(AmiwarpError, match=rf"w\.json.*{message}") as caught:
        load_world(folder / "w.json")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("w.toml", b"a = [", r"w\.toml: cannot be read as a world: "),
        ("w.toml", b"\xff", r"w\.toml: cannot be read as a world: "),
        ("w.json", b"[1]", r"w\.json: .*expected an object"),
        ("w.yaml", b"a: 1", "has the suffix '.yaml'; a world file ends in .toml or .json"),
        ("w.toml", None, "no such file"),
    ],
)
def test_what_is_no_world_file(
    tmp_path: Path, name: str, content: bytes | None, message: str
) -> None:
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(AmiwarpError, match=message):
        load_world(tmp_path / name)


@pytest.mark.parametrize("kind", ["glb", "obj", "ply", "stl"])
def test_formats(tmp_path: Path, kind: str) -> None:
    trimesh.creation.box(SIZE).export(tmp_path / f"box.{kind}")
    (part,) = load_mesh(tmp_path / f"box.{kind}", up="z", scale=2.0)
    vertices = np.asarray(part.mesh.vertices)
    assert len(np.asarray(part.mesh.faces)) == 12
    assert part.material.reflectance == 0.5
    np.testing.assert_allclose(np.ptp(vertices, axis=0), 2.0 * np.array(SIZE), rtol=0, atol=1e-6)


def test_gltf_has_y_up(tmp_path: Path) -> None:
    trimesh.creation.box(SIZE).apply_translation((0.0, 5.0, 0.0)).export(tmp_path / "box.glb")
    (part,) = load_mesh(tmp_path / "box.glb")
    np.testing.assert_allclose(
        np.asarray(part.mesh.vertices).mean(axis=0), [0.0, 0.0, 5.0], rtol=0, atol=1e-6
    )


def test_parts_of_a_scene_stand_where_they_are_put(tmp_path: Path, folder: Path) -> None:
    scene = trimesh.Scene()
    box = trimesh.creation.box(SIZE)
    for name, x in (("left", -5.0), ("right", 5.0)):
        scene.add_geometry(
            box, node_name=name, transform=trimesh.transformations.translation_matrix((x, 0, 0))
        )
    scene.export(folder / "two.glb")
    parts = load_mesh(folder / "two.glb", up="z")
    assert [part.name for part in parts] == ["left", "right"]
    assert [float(np.asarray(part.mesh.vertices)[:, 0].mean()) for part in parts] == [-5.0, 5.0]
    data = tomllib.loads(EXAMPLE)
    data["bodies"][1]["mesh"] = "two.glb"
    (folder / "w.json").write_text(json.dumps(data))
    world, _ = load_world(folder / "w.json")
    assert [body.name for body in world.bodies] == ["board", "toy/left", "toy/right", "fan"]
    assert world.instances == ("board", "toy car", "fan")


@pytest.mark.parametrize(("kind", "linear"), [("ply", False), ("obj", False), ("glb", True)])
def test_vertex_colours(tmp_path: Path, kind: str, linear: bool) -> None:
    box = trimesh.creation.box(SIZE)
    box.visual.vertex_colors = [GREY, GREY, GREY, 255]
    box.export(tmp_path / f"box.{kind}")
    (part,) = load_mesh(tmp_path / f"box.{kind}")
    grey = (
        GREY / 255.0 if linear else float(linear_luminance(np.full((2, 2), GREY, np.uint8))[0, 0])
    )
    assert part.mesh.light is not None
    np.testing.assert_allclose(np.asarray(part.mesh.light), grey, rtol=0, atol=1e-3)


def test_face_colours(tmp_path: Path) -> None:
    box = trimesh.creation.box(SIZE)
    box.visual.face_colors = np.random.default_rng(1).integers(0, 256, (12, 4), dtype=np.uint8)
    box.export(tmp_path / "box.ply")
    (part,) = load_mesh(tmp_path / "box.ply")
    colours = np.asarray(box.visual.face_colors)[:, :3]
    expected = linear_luminance(np.repeat(colours[None], 2, axis=0))[0]
    assert part.mesh.light is not None
    corners = np.asarray(part.mesh.light)[np.asarray(part.mesh.faces)]
    np.testing.assert_allclose(corners, np.repeat(expected[:, None], 3, axis=1), rtol=0, atol=1e-6)


def test_base_colour(tmp_path: Path) -> None:
    """glTF's are linear."""
    box = trimesh.creation.box(SIZE)
    material = trimesh.visual.material.PBRMaterial(baseColorFactor=[255, 0, 0, 255])
    box.visual = trimesh.visual.TextureVisuals(uv=np.zeros((8, 2)), material=material)
    box.export(tmp_path / "box.glb")
    (part,) = load_mesh(tmp_path / "box.glb")
    assert part.material.reflectance == pytest.approx(LUMINANCE[0], abs=1e-3)


@pytest.mark.parametrize("kind", ["obj", "glb"])
def test_textures_stand_upright(tmp_path: Path, kind: str) -> None:
    """The picture's lower left pixel is at (0, 0)."""
    pixels = picture(tmp_path / "paint.png")
    quad(tmp_path / "quad.obj", "mtllib quad.mtl\n")
    (tmp_path / "quad.mtl").write_text("newmtl paint\nKd 1 1 1\nmap_Kd paint.png\n")
    if kind == "glb":
        trimesh.load(tmp_path / "quad.obj", force="scene").export(tmp_path / "quad.glb")
    (part,) = load_mesh(tmp_path / f"quad.{kind}", up="z")
    assert part.material.texture is not None
    np.testing.assert_allclose(part.material.texture, linear_luminance(pixels), rtol=0, atol=1e-6)
    vertices, uv = np.asarray(part.mesh.vertices), np.asarray(part.mesh.uv)
    np.testing.assert_allclose(uv, (vertices[:, ::2] + 1.0) / 2.0, rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.obj", b"v 0 0 0\nv 1 0 0\n", "holds no faces; give a file with triangles"),
        ("a.obj", b"\x00\xff", "a.obj: "),
        ("a.glb", b"nothing", "a.glb: cannot be read as a mesh"),
        ("a.ply", b"nothing", "a.ply: cannot be read as a mesh"),
        ("a.stl", b"nothing", "a.stl: "),
        ("a.dae", b"", "unknown mesh format '.dae'; give one of glb, gltf, obj, ply, stl"),
        ("a.obj", None, "a.obj: no such file"),
    ],
)
def test_meshes_that_cannot_be_read(
    tmp_path: Path, name: str, content: bytes | None, message: str
) -> None:
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(AmiwarpError, match=message):
        load_mesh(tmp_path / name)


@pytest.mark.parametrize(
    ("material", "message"),
    [
        (
            None,
            "refers to the file 'quad.mtl', which is missing; put a valid file next to the mesh file",
        ),
        ("newmtl paint\nmap_Kd no.png\n", "refers to the file 'no.png', which is missing"),
        ("newmtl paint\nmap_Kd bad.png\n", "refers to the file 'bad.png', which cannot be read"),
    ],
)
def test_files_that_a_mesh_names(tmp_path: Path, material: str | None, message: str) -> None:
    quad(tmp_path / "quad.obj", "mtllib quad.mtl\n")
    (tmp_path / "bad.png").write_bytes(b"no picture")
    if material is not None:
        (tmp_path / "quad.mtl").write_text(material)
    with pytest.raises(AmiwarpError, match=message):
        load_mesh(tmp_path / "quad.obj")


def bare_glb(path: Path, count: int, sparse: bool = False) -> None:
    """Write a GLB file of a triangle whose ``count`` vertices are declared without data, or with sparse data."""
    indices = struct.pack("<3H", 0, 1, 2) + bytes(2)
    vertices: dict[str, Any] = {"componentType": 5126, "count": count, "type": "VEC3"}
    if sparse:
        vertices["sparse"] = {
            "count": 1, "indices": {"bufferView": 0, "componentType": 5123}, "values": {"bufferView": 0}
        }  # fmt: skip
    header = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "buffers": [{"byteLength": len(indices)}],
        "bufferViews": [{"buffer": 0, "byteLength": 6}],
        "accessors": [
            vertices,
            {"bufferView": 0, "componentType": 5123, "count": 3, "type": "SCALAR"},
        ],
    }
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 4)
    chunks = b"".join(
        struct.pack("<I4s", len(data), kind) + data
        for data, kind in ((text, b"JSON"), (indices, b"BIN\0"))
    )
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)


@pytest.mark.parametrize("sparse", [False, True])
def test_small_files_that_declare_huge_meshes_are_refused(tmp_path: Path, sparse: bool) -> None:
    bare_glb(tmp_path / "a.glb", 10, sparse)
    (part,) = load_mesh(tmp_path / "a.glb")
    assert np.asarray(part.mesh.vertices).shape == (10, 3)
    bare_glb(tmp_path / "a.glb", 30_000_000, sparse)  # 1 GB in float64 alone
    assert (tmp_path / "a.glb").stat().st_size < 1000
    with pytest.raises(AmiwarpError, match=r"a\.glb: .*needs over 1024 MiB of memory at once"):
        load_mesh(tmp_path / "a.glb")


def test_the_largest_texture_is_read(tmp_path: Path) -> None:
    quad(tmp_path / "quad.obj", "mtllib quad.mtl\n")
    (tmp_path / "quad.mtl").write_text("newmtl paint\nmap_Kd paint.png\n")
    Image.new("RGB", (8192, 8192), (GREY,) * 3).save(tmp_path / "paint.png")
    (part,) = load_mesh(tmp_path / "quad.obj")
    assert part.material.texture is not None
    assert part.material.texture.shape == (8192, 8192)
    expected = float(linear_luminance(np.full((2, 2), GREY, np.uint8))[0, 0])
    np.testing.assert_allclose(part.material.texture[::999, ::999], expected, rtol=0, atol=1e-6)


def test_files_of_a_mesh_are_inputs_of_the_command(tmp_path: Path) -> None:
    quad(tmp_path / "quad.obj", "mtllib quad.mtl\n")
    (tmp_path / "quad.mtl").write_text("newmtl paint\nmap_Kd paint.png\n")
    picture(tmp_path / "paint.png")
    with inputs_noted([]):
        load_mesh(tmp_path / "quad.obj")
        noted = {file.name for file in inputs_in_use()}
    assert noted >= {"quad.obj", "quad.mtl", "paint.png"}


def test_a_header_of_poses_may_follow_comments(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(
        "# made by hand\n\nt,x,y,z,qx,qy,qz,qw\n0,0,0,1,0,0,0,1\n2,0,0,1,0,0,0,1\n"
    )
    assert Trajectory.from_file(tmp_path / "a.csv").t.tolist() == [0.0, 2.0]
    (tmp_path / "a.csv").write_text(
        "timestamp_s,x,y,z,qx,qy,qz,qw\n3,0,0,1,0,0,0,1\n4,0,0,1,0,0,0,1\n"
    )
    assert Trajectory.from_file(tmp_path / "a.csv").t.tolist() == [0.0, 1.0]
    (tmp_path / "a.csv").write_text("t,x,y,z,qx,qy,qz,qw\nm,m,m,m,1,1,1,1\n")
    with pytest.raises(AmiwarpError, match=r"a\.csv: line 2 is 'm,m.*; expected 8 numbers"):
        Trajectory.from_file(tmp_path / "a.csv")
    (tmp_path / "a.csv").write_text("0,0,0,1,0,0,0,1\nt,x,y,z,qx,qy,qz,qw\n")
    with pytest.raises(AmiwarpError, match=r"a\.csv: line 2 is 't,x.*; expected 8 numbers"):
        Trajectory.from_file(tmp_path / "a.csv")


def test_trajectories_have_a_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Their splines take 1.7 kB for each pose."""
    assert trajectory.MOST_POSES * 1700 < 1 << 30  # bytes
    monkeypatch.setattr(trajectory, "MOST_POSES", 500)
    row = " 0 0 0 0 0 0 1\n"
    (tmp_path / "a.txt").write_text("".join(f"{k}{row}" for k in range(501)))
    with pytest.raises(
        AmiwarpError, match=r"a\.txt: has over 500 poses; give fewer, at a lower rate"
    ):
        Trajectory.from_file(tmp_path / "a.txt")
    with pytest.raises(AmiwarpError, match=r"trajectory has 501 poses; give at most 500,"):
        Trajectory(np.arange(501.0), np.zeros((501, 3)), np.tile([0.0, 0.0, 0.0, 1.0], (501, 1)))
    with pytest.raises(
        AmiwarpError, match=r"trajectory has 1000000001 poses; .*by a smaller rate_hz"
    ):
        Trajectory.from_function(lambda t: (Rotation.identity(), np.zeros(3)), 1000.0, rate_hz=1e6)
    (tmp_path / "b.txt").write_text("0" + row + "#" * 1001 + "\n")
    with pytest.raises(AmiwarpError, match=r"b\.txt: line 2 is longer than 1000 characters"):
        Trajectory.from_file(tmp_path / "b.txt")


@pytest.mark.parametrize(
    "row", ["nan 0 0 0 0 0 0 1", "inf 0 0 0 0 0 0 1", "-1e308 0 0 0 0 0 0 1\n1e308 0 0 0 0 0 0 1"]
)
def test_trajectories_that_are_not_finite_are_refused(tmp_path: Path, row: str) -> None:
    (tmp_path / "a.txt").write_text(f"{row}\n")
    with pytest.raises(AmiwarpError, match=r"a\.txt: trajectory holds values that are not finite"):
        Trajectory.from_file(tmp_path / "a.txt")


@pytest.mark.skipif(
    not Path("/proc/self/mem").exists(), reason="needs a file that can be opened but not read"
)
@pytest.mark.parametrize(
    "read",
    [
        Trajectory.from_file,
        load_world,
        amiwarp.open_recording,
        amiwarp.load_camera,
        amiwarp.Calibration.load,
    ],
)
def test_errors_while_reading_name_the_file(tmp_path: Path, read: Any) -> None:
    """As a damaged disk, the memory of this process at address 0 is a regular file that cannot be read."""
    link = tmp_path / "world.json"
    link.symlink_to("/proc/self/mem")
    with pytest.raises(AmiwarpError, match=r"world\.json: .*Input/output error; check the disk"):
        read(link)


def test_the_length_of_the_direction_of_the_sun_has_no_effect() -> None:
    for length in (1e-300, 1.0, 1e200):
        np.testing.assert_allclose(
            Sun((0.0, 3 * length, 4 * length)).direction, (0.0, 0.6, 0.8), rtol=0, atol=1e-12
        )
    with pytest.raises(AmiwarpError, match="sun direction has length inf"):
        Sun((1.7e308, 1.7e308, 1.7e308))


def test_huge_poses_are_refused_without_warnings() -> None:
    t, still = np.arange(2.0), [0.0, 0.0, 0.0, 1.0]
    with pytest.raises(AmiwarpError, match="quaternion of length inf in pose 1; give unit"):
        Trajectory(t, np.zeros((2, 3)), np.array([still, [1e200, 0.0, 0.0, 0.0]]))
    with pytest.raises(AmiwarpError, match="moves at inf m/s"):
        Trajectory(t, np.array([[1e300, 0.0, 0.0], [-1e300, 0.0, 0.0]]), np.array([still, still]))


def test_large_world_files_are_refused_before_they_are_parsed(tmp_path: Path) -> None:
    (tmp_path / "w.json").write_text(json.dumps(tomllib.loads(EXAMPLE)) + " " * (8 << 20))
    with pytest.raises(AmiwarpError, match=r"w\.json: is larger than 8 MiB"):
        load_world(tmp_path / "w.json")


def test_without_trimesh(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    quad(tmp_path / "quad.obj")
    monkeypatch.setitem(sys.modules, "trimesh", None)
    with pytest.raises(AmiwarpError, match=r"need trimesh; run: pip install 'amiwarp\[worlds\]'"):
        load_mesh(tmp_path / "quad.obj")
