"""3MF, STL and STEP files of the rig's parts, read back without the code that writes them."""

import math
import re
import struct
import xml.etree.ElementTree as ElementTree
import zipfile
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

pytest.importorskip(
    "manifold3d", reason="the rig's parts need manifold3d: pip install 'amiwarp[rig]'"
)
pytest.importorskip("trimesh", reason="the rig's parts need trimesh: pip install 'amiwarp[rig]'")
from manifold3d import Manifold

from rig import __main__ as command
from rig import files, parts

CORE = "{http://schemas.microsoft.com/3dmanufacturing/core/2015/02}"


def volume_of(points: NDArray[np.float64], triangles: NDArray[np.int64]) -> float:
    """Return the volume that oriented triangles enclose: a sixth of the sum of their determinants."""
    return float(np.linalg.det(points[triangles]).sum() / 6.0)


def assert_manifold(triangles: NDArray[np.int64]) -> None:
    """Each edge belongs to two triangles, which use it in opposite directions; no triangle has a corner twice."""
    edges = Counter(
        (a, b) for t in triangles.tolist() for a, b in zip(t, (*t[1:], t[0]), strict=True)
    )
    assert all(a != b for a, b in edges)
    assert set(edges.values()) == {1}
    assert all((b, a) in edges for a, b in edges)


def read_3mf(path: Path) -> dict[str, tuple[NDArray[np.float64], NDArray[np.int64]]]:
    """Return the objects of a 3MF file by their names, as corners [mm] and triangles."""
    with zipfile.ZipFile(path) as package:
        assert package.testzip() is None
        relations = ElementTree.fromstring(package.read("_rels/.rels"))
        target = relations[0].attrib["Target"].lstrip("/")
        kinds = package.read("[Content_Types].xml").decode()
        model = ElementTree.fromstring(package.read(target))
    assert f'Extension="{target.rpartition(".")[2]}"' in kinds
    assert model.attrib["unit"] == "millimeter"
    built = [item.attrib["objectid"] for item in model.iter(f"{CORE}item")]
    out = {}
    for each in model.iter(f"{CORE}object"):
        assert each.attrib["id"] in built
        points = np.array([[float(v.attrib[k]) for k in "xyz"] for v in each.iter(f"{CORE}vertex")])
        triangles = np.array(
            [[int(t.attrib[k]) for k in ("v1", "v2", "v3")] for t in each.iter(f"{CORE}triangle")]
        )
        out[each.attrib["name"]] = points, triangles
    return out


def read_stl(path: Path) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return corners [mm], equal ones once, and triangles of a binary STL file."""
    data = path.read_bytes()
    (count,) = struct.unpack_from("<I", data, 80)
    assert len(data) == 84 + 50 * count
    corners = np.array(
        [struct.unpack_from("<9f", data, 96 + 50 * k) for k in range(count)]
    ).reshape(-1, 3)
    points, numbers = np.unique(corners, axis=0, return_inverse=True)
    return points, numbers.reshape(-1, 3)


class Step:
    """Entities of a STEP file of plane faces."""

    def __init__(self, path: Path) -> None:
        text = path.read_text()
        assert text.startswith("ISO-10303-21;\n")
        assert text.endswith("ENDSEC;\nEND-ISO-10303-21;\n")
        found = re.findall(r"^#(\d+)=([A-Z0-9_]*)\((.*)\);$", text, re.MULTILINE)
        self.entities = {int(number): (kind, arguments) for number, kind, arguments in found}
        assert "SI_UNIT(.MILLI.,.METRE.)" in text

    def refs(self, number: int, kind: str) -> list[int]:
        """Return the entities to which one of a kind refers."""
        assert self.entities[number][0] == kind, self.entities[number]
        return [int(ref) for ref in re.findall(r"#(\d+)", self.entities[number][1])]

    def triple(self, number: int) -> NDArray[np.float64]:
        """Return the numbers of a point or a direction."""
        return np.array(
            [float(v) for v in re.search(r"\(([^()]+)\)", self.entities[number][1])[1].split(",")]
        )

    def of(self, kind: str) -> list[int]:
        """Return the numbers of all entities of a kind."""
        return [number for number, (each, _) in self.entities.items() if each == kind]

    def corner(self, vertex: int) -> NDArray[np.float64]:
        """Return where a VERTEX_POINT is."""
        return self.triple(self.refs(vertex, "VERTEX_POINT")[0])

    def volume(self) -> float:
        """Return the volume by Gauss' theorem, and check that all edges are used twice and all corners are in plane."""
        used: Counter[tuple[int, bool]] = Counter()
        sixth = 0.0
        (solid,) = self.of("MANIFOLD_SOLID_BREP")
        (shell,) = self.refs(solid, "MANIFOLD_SOLID_BREP")
        for face in self.refs(shell, "CLOSED_SHELL"):
            *bounds, plane = self.refs(face, "ADVANCED_FACE")
            origin, normal = (
                self.triple(k)
                for k in self.refs(self.refs(plane, "PLANE")[0], "AXIS2_PLACEMENT_3D")[:2]
            )
            assert self.entities[bounds[0]][0] == "FACE_OUTER_BOUND"
            area = np.zeros(3)
            for bound in bounds:
                (loop,) = self.refs(bound, self.entities[bound][0])
                last = None
                for oriented in self.refs(loop, "EDGE_LOOP"):
                    forward = self.entities[oriented][1].endswith(".T.")
                    (edge,) = self.refs(oriented, "ORIENTED_EDGE")
                    a, b, line = self.refs(edge, "EDGE_CURVE")
                    used[edge, forward] += 1
                    start, end = (self.corner(k) for k in ((a, b) if forward else (b, a)))
                    assert last is None or np.array_equal(last, start)
                    last = end
                    assert abs((start - origin) @ normal) < 1e-6
                    along = self.triple(self.refs(self.refs(line, "LINE")[1], "VECTOR")[0])
                    span = self.corner(b) - self.corner(a)
                    assert span @ along == pytest.approx(np.linalg.norm(span), rel=1e-9)
                    area += np.cross(start - origin, end - origin)
            assert area @ normal > 0.0
            sixth += float(origin @ normal) * float(area @ normal)
        assert set(used.values()) == {1}
        assert all((edge, not forward) in used for edge, forward in used)
        return sixth / 6.0


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the files of the smaller rig, in all formats."""
    out = tmp_path_factory.mktemp("rig")
    command.main([str(out), "--rig", "one-inch", "--format", "stl", "3mf", "step"])
    return out / "one-inch"


NAMES = (
    "base",
    "bearing cap",
    "cover",
    "holder",
    "housing",
    "magnet cup",
    "motor plate",
    "motor pulley",
    "rear ring",
    "rotor",
    "spacer",
    "wedge ring",
)
"""Printed parts. They are listed, because each run that collects this file would otherwise make their solids."""


def test_the_list_names_every_printed_part() -> None:
    made = parts.assembly(parts.ONE_INCH)
    assert sorted(part.name for part in made if part.kind == "printed") == list(NAMES)


@pytest.mark.slow
def test_each_part_has_a_file_of_each_format(folder: Path) -> None:
    wanted = {
        f"{name.replace(' ', '_')}.{kind}" for name in NAMES for kind in ("stl", "3mf", "step")
    }
    assert {path.name for path in folder.iterdir()} == wanted | {"bill.csv"}


@pytest.mark.parametrize("name", NAMES)
def test_files_are_closed_and_have_one_volume(folder: Path, name: str) -> None:
    """STL, 3MF and STEP agree, and with the solid; float32 has 7 digits."""
    path = folder / name.replace(" ", "_")
    solid = next(part.solid for part in parts.assembly(parts.ONE_INCH) if part.name == name)
    points, triangles = read_stl(path.with_suffix(".stl"))
    assert_manifold(triangles)
    ((named, (fine, shared)),) = read_3mf(path.with_suffix(".3mf")).items()
    assert named == name
    assert_manifold(shared)
    assert volume_of(fine, shared) > 0.0
    assert volume_of(fine, shared) == pytest.approx(volume_of(points, triangles), rel=1e-6)
    assert volume_of(fine, shared) == pytest.approx(solid.volume(), rel=1e-6)
    assert len(shared) == len(triangles)
    step = Step(path.with_suffix(".step"))
    assert step.volume() == pytest.approx(solid.volume(), rel=1e-9)
    faces = len(step.of("ADVANCED_FACE"))
    assert faces < len(triangles) / 2  # plane faces are not left in triangles


def test_a_facet_that_is_left_out_is_seen(folder: Path) -> None:
    """What the other tests rest on: the check of edges finds a hole, a turned facet and a doubled one."""
    (points, triangles) = read_3mf(folder / "base.3mf")["base"]
    for wrong in (
        triangles[1:],
        np.vstack([triangles[1:], triangles[:1, ::-1]]),
        np.vstack([triangles, triangles[:1]]),
    ):
        with pytest.raises(AssertionError):
            assert_manifold(wrong)
    assert volume_of(points, triangles[:, ::-1]) < 0.0


def test_a_plate_with_a_hole_has_eight_sides_and_two_faces_with_holes(tmp_path: Path) -> None:
    """By hand: 20 x 10 x 3 mm with a hexagonal hole of radius 2: 600 - 3 * 6 * sqrt(3) mm³, 6 + 6 faces."""
    plate = Manifold.cube((20.0, 10.0, 3.0)) - Manifold.cylinder(9.0, 2.0, 2.0, 6).translate(
        (10.0, 5.0, -3.0)
    )
    files.write_step("plate", [("plate", plate)], tmp_path / "plate.step")
    step = Step(tmp_path / "plate.step")
    assert step.volume() == pytest.approx(600.0 - 18.0 * math.sqrt(3.0), rel=1e-12)
    assert len(step.of("ADVANCED_FACE")) == 12
    assert len(step.of("FACE_BOUND")) == 2
    assert len(step.of("EDGE_CURVE")) == 12 + 18


def test_a_face_that_touches_itself_stays_in_triangles(tmp_path: Path) -> None:
    """Two holes that meet in a corner: the plate's faces are closed all the same."""
    hole = Manifold.cube((2.0, 2.0, 9.0))
    plate = (
        Manifold.cube((10.0, 10.0, 1.0))
        - hole.translate((3.0, 3.0, -3.0))
        - hole.translate((5.0, 5.0, -3.0))
    )
    files.write_step("plate", [("plate", plate)], tmp_path / "plate.step")
    assert Step(tmp_path / "plate.step").volume() == pytest.approx(100.0 - 8.0, rel=1e-9)


def test_several_solids_lie_side_by_side(tmp_path: Path) -> None:
    made = [
        (part.name, part.solid)
        for part in parts.assembly(parts.ONE_INCH)
        if part.name in ("rotor", "base")
    ]
    files.write_3mf(made, tmp_path / "both.3mf")
    assert set(read_3mf(tmp_path / "both.3mf")) == {"rotor", "base"}
    with zipfile.ZipFile(tmp_path / "both.3mf") as package:
        model = ElementTree.fromstring(package.read("3D/3dmodel.model"))
    ends = []
    for item, (_, solid) in zip(model.iter(f"{CORE}item"), made, strict=True):
        *turn, x, _, z = (float(v) for v in item.attrib["transform"].split())
        assert turn == [1, 0, 0, 0, 1, 0, 0, 0, 1]
        low, high = np.array(solid.bounding_box()).reshape(2, 3)
        ends += [low[0] + x, high[0] + x]
        assert low[2] + z == pytest.approx(0.0, abs=1e-6)
    assert ends == sorted(ends)


def test_the_same_part_has_the_same_bytes(folder: Path, tmp_path: Path) -> None:
    rotor = [
        (part.name, part.solid) for part in parts.assembly(parts.ONE_INCH) if part.name == "rotor"
    ]
    files.write_3mf(rotor, tmp_path / "rotor.3mf")
    files.write_step("rotor", rotor, tmp_path / "rotor.step")
    for name in ("rotor.3mf", "rotor.step"):
        assert (tmp_path / name).read_bytes() == (folder / name).read_bytes()
