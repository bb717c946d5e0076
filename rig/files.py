"""Files of solids: STL and 3MF for slicers, STEP for CAD. All lengths are in millimetres.

STEP files hold the shapes as they are computed: planar faces that meet in straight edges (a faceted boundary
representation, ISO 10303-214). Triangles in one plane are one face. Round parts are polygons of 32 to 180 sides, not
cylinders: to change a bore in CAD, remove its faces and cut it again.
"""

import zipfile
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np
from manifold3d import Manifold
from numpy.typing import NDArray

FLAT = 1e-6
"""How far the corners of a face may be off its plane [mm]. CAD programs take 1e-7 to 1e-5 mm as equal."""


def arrays(solid: Manifold) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return the corners of a solid, shape (n, 3), and its triangles, counter-clockwise from outside, shape (m, 3)."""
    mesh = solid.to_mesh64()
    return np.asarray(mesh.vert_properties)[:, :3], np.asarray(mesh.tri_verts, np.int64)


def written(out: Path, data: bytes) -> None:
    """Write a file beside its place, and rename it."""
    beside = out.with_name(out.name + ".part")
    beside.write_bytes(data)
    beside.replace(out)


def write_stl(solid: Manifold, out: Path) -> None:
    """Write a binary STL file, whose numbers are float32."""
    points, triangles = arrays(solid)
    corners = points.astype(np.float32)[triangles]
    kind = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("rest", "<u2")])
    facets = np.zeros(len(triangles), kind)
    facets["corners"] = corners
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    facets["normal"] = np.divide(normals, lengths, out=np.zeros_like(normals), where=lengths > 0)
    written(out, bytes(80) + len(triangles).to_bytes(4, "little") + facets.tobytes())


CONTENT = """<?xml version="1.0" encoding="UTF-8"?>
<Types xmlns="http://schemas.openxmlformats.org/package/2006/content-types">
<Default Extension="rels" ContentType="application/vnd.openxmlformats-package.relationships+xml"/>
<Default Extension="model" ContentType="application/vnd.ms-package.3dmanufacturing-3dmodel+xml"/>
</Types>
"""
RELATIONS = """<?xml version="1.0" encoding="UTF-8"?>
<Relationships xmlns="http://schemas.openxmlformats.org/package/2006/relationships">
<Relationship Target="/3D/3dmodel.model" Id="rel0" Type="http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"/>
</Relationships>
"""


def write_3mf(solids: Sequence[tuple[str, Manifold]], out: Path) -> None:
    """Write a 3MF file (core specification 1.3) with an object for each named solid, side by side along x.

    The numbers have six decimals, finer than float32 in an STL file, and corners are shared by triangles.
    """
    lines = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        '<model unit="millimeter" xml:lang="en-US" xmlns="http://schemas.microsoft.com/3dmanufacturing/core/2015/02">',
        "<resources>",
    ]
    items = []
    at = 0.0
    for number, (name, solid) in enumerate(solids, 1):
        points, triangles = arrays(solid)
        lines += [f'<object id="{number}" name="{name}" type="model"><mesh><vertices>']
        lines += [f'<vertex x="{x:.6f}" y="{y:.6f}" z="{z:.6f}"/>' for x, y, z in points]
        lines += ["</vertices><triangles>"]
        lines += [f'<triangle v1="{a}" v2="{b}" v3="{c}"/>' for a, b, c in triangles]
        lines += ["</triangles></mesh></object>"]
        low, high = points.min(axis=0), points.max(axis=0)
        shift = " ".join(f"{value:.6f}" for value in (at - low[0], -low[1], -low[2]))
        items += [f'<item objectid="{number}" transform="1 0 0 0 1 0 0 0 1 {shift}"/>']
        at += high[0] - low[0] + 5.0
    lines += ["</resources>", "<build>", *items, "</build>", "</model>", ""]
    beside = out.with_name(out.name + ".part")
    with zipfile.ZipFile(beside, "w", zipfile.ZIP_DEFLATED) as package:
        for path, text in (
            ("[Content_Types].xml", CONTENT),
            ("_rels/.rels", RELATIONS),
            ("3D/3dmodel.model", "\n".join(lines)),
        ):
            # a fixed time: equal parts have equal files
            package.writestr(
                zipfile.ZipInfo(path, (1980, 1, 1, 0, 0, 0)), text, zipfile.ZIP_DEFLATED
            )
    beside.replace(out)


def flat_faces(
    points: NDArray[np.float64], triangles: NDArray[np.int64]
) -> Iterator[NDArray[np.int64]]:
    """Yield groups of triangles that are connected and lie in one plane, as indices of triangles.

    Each group grows from its largest triangle, whose plane is known best.
    """
    corners = points[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.linalg.norm(normals, axis=1)
    neighbours = adjacent(triangles)
    free = np.ones(len(triangles), np.bool_)
    for first in np.argsort(-areas):
        if not free[first]:
            continue
        normal = normals[first] / areas[first]
        base = corners[first, 0]
        free[first] = False
        group, waiting = [first], [first]
        while waiting:
            for other in neighbours[waiting.pop()]:
                off = np.abs((corners[other] - base) @ normal).max()
                if free[other] and off < FLAT and normals[other] @ normal > 0.0:
                    free[other] = False
                    group.append(other)
                    waiting.append(other)
        yield np.array(group)


def adjacent(triangles: NDArray[np.int64]) -> list[list[int]]:
    """Return the neighbours of each triangle, over its three edges."""
    beside: dict[tuple[int, int], int] = {}
    for k, (a, b, c) in enumerate(triangles.tolist()):
        beside[a, b] = beside[b, c] = beside[c, a] = k
    return [[beside[b, a], beside[c, b], beside[a, c]] for a, b, c in triangles.tolist()]


def loops(triangles: NDArray[np.int64]) -> list[list[int]] | None:
    """Return the borders of connected triangles as closed lists of corners; None if a corner is on two of them."""
    edges = {(a, b) for t in triangles.tolist() for a, b in zip(t, (*t[1:], t[0]), strict=True)}
    border = [(a, b) for a, b in edges if (b, a) not in edges]
    after = dict(border)
    if len(after) != len(border):
        return None
    out = []
    while after:
        start, at = after.popitem()
        loop = [start]
        while at != start:
            loop.append(at)
            at = after.pop(at)
        out.append(loop)
    return out


class StepFile:
    """Lines of a STEP file, each written once."""

    def __init__(self) -> None:
        self.lines: list[str] = []

    def add(self, text: str) -> int:
        """Add an entity, and return its number."""
        self.lines.append(text)
        return len(self.lines)

    def point(self, at: Iterable[float]) -> int:
        """Return the number of a point."""
        return self.add(f"CARTESIAN_POINT('',({triple(at)}))")

    def direction(self, along: Iterable[float]) -> int:
        """Return the number of a direction."""
        return self.add(f"DIRECTION('',({triple(along)}))")


def triple(values: Iterable[float]) -> str:
    """Return three numbers as text of STEP, which wants a decimal point."""
    return ",".join(f"{float(value) + 0.0:.12E}" for value in values)


def refs(numbers: Iterable[int]) -> str:
    """Return references to entities."""
    return ",".join(f"#{number}" for number in numbers)


def add_solid(step: StepFile, name: str, solid: Manifold) -> int:
    """Add a solid of planar faces, and return the number of its MANIFOLD_SOLID_BREP."""
    points, triangles = arrays(solid)
    corners = [step.add(f"VERTEX_POINT('',#{step.point(at)})") for at in points]
    edges: dict[tuple[int, int], int] = {}

    def edge(a: int, b: int) -> str:
        """Return the edge from corner a to corner b, which the neighbouring face uses in the other direction."""
        low, high = min(a, b), max(a, b)
        if (low, high) not in edges:
            span = points[high] - points[low]
            length = float(np.linalg.norm(span))
            vector = step.add(f"VECTOR('',#{step.direction(span / length)},{length:.12E})")
            line = step.add(f"LINE('',#{step.point(points[low])},#{vector})")
            edges[low, high] = step.add(
                f"EDGE_CURVE('',#{corners[low]},#{corners[high]},#{line},.T.)"
            )
        return f"ORIENTED_EDGE('',*,*,#{edges[low, high]},{'.T.' if a == low else '.F.'})"

    def face(group: NDArray[np.int64], borders: list[list[int]]) -> int:
        across = points[triangles[group]]
        normals = np.cross(across[:, 1] - across[:, 0], across[:, 2] - across[:, 0])
        largest = int(np.argmax(np.linalg.norm(normals, axis=1)))
        normal = normals[largest] / np.linalg.norm(normals[largest])
        side = across[largest, 1] - across[largest, 0]
        place = step.add(
            f"AXIS2_PLACEMENT_3D('',#{step.point(across[largest, 0])},#{step.direction(normal)},"
            f"#{step.direction(side / np.linalg.norm(side))})"
        )
        plane = step.add(f"PLANE('',#{place})")
        bounds = []
        # the outer border is the one whose corners reach furthest
        for loop in sorted(borders, key=lambda loop: -float(np.ptp(points[loop], axis=0).max())):
            used = [step.add(edge(a, b)) for a, b in zip(loop, (*loop[1:], loop[0]), strict=True)]
            kind = "FACE_BOUND" if bounds else "FACE_OUTER_BOUND"
            ring = step.add(f"EDGE_LOOP('',({refs(used)}))")
            bounds.append(step.add(f"{kind}('',#{ring},.T.)"))
        return step.add(f"ADVANCED_FACE('',({refs(bounds)}),#{plane},.T.)")

    faces = []
    for group in flat_faces(points, triangles):
        borders = loops(triangles[group])
        if borders is None:
            # where a face touches itself in a corner, its triangles are faces
            faces += [
                face(group[k : k + 1], loops(triangles[group[k : k + 1]]) or [])
                for k in range(len(group))
            ]
        else:
            faces.append(face(group, borders))
    shell = step.add(f"CLOSED_SHELL('',({refs(faces)}))")
    return step.add(f"MANIFOLD_SOLID_BREP('{name}',#{shell})")


def write_step(name: str, solids: Sequence[tuple[str, Manifold]], out: Path) -> None:
    """Write a STEP file (AP214) of named solids in their places, as one product."""
    step = StepFile()
    context = step.add(
        "APPLICATION_CONTEXT('core data for automotive mechanical design processes')"
    )
    step.add(
        f"APPLICATION_PROTOCOL_DEFINITION('international standard','automotive_design',2000,#{context})"
    )
    field = step.add(f"PRODUCT_CONTEXT('',#{context},'mechanical')")
    product = step.add(f"PRODUCT('{name}','{name}','',(#{field}))")
    version = step.add(f"PRODUCT_DEFINITION_FORMATION('','',#{product})")
    stage = step.add(f"PRODUCT_DEFINITION_CONTEXT('part definition',#{context},'design')")
    design = step.add(f"PRODUCT_DEFINITION('design','',#{version},#{stage})")
    shape = step.add(f"PRODUCT_DEFINITION_SHAPE('','',#{design})")
    length = step.add("(LENGTH_UNIT()NAMED_UNIT(*)SI_UNIT(.MILLI.,.METRE.))")
    angle = step.add("(NAMED_UNIT(*)PLANE_ANGLE_UNIT()SI_UNIT($,.RADIAN.))")
    solid_angle = step.add("(NAMED_UNIT(*)SI_UNIT($,.STERADIAN.)SOLID_ANGLE_UNIT())")
    exact = step.add(
        f"UNCERTAINTY_MEASURE_WITH_UNIT(LENGTH_MEASURE(1.E-06),#{length},'distance_accuracy_value','')"
    )
    space = step.add(
        f"(GEOMETRIC_REPRESENTATION_CONTEXT(3)GLOBAL_UNCERTAINTY_ASSIGNED_CONTEXT((#{exact}))"
        f"GLOBAL_UNIT_ASSIGNED_CONTEXT(({refs((length, angle, solid_angle))}))REPRESENTATION_CONTEXT('',''))"
    )
    axes = step.add(
        f"AXIS2_PLACEMENT_3D('',#{step.point((0, 0, 0))},#{step.direction((0, 0, 1))},#{step.direction((1, 0, 0))})"
    )
    made = [add_solid(step, each, solid) for each, solid in solids]
    brep = step.add(
        f"ADVANCED_BREP_SHAPE_REPRESENTATION('{name}',({refs((axes, *made))}),#{space})"
    )
    step.add(f"SHAPE_DEFINITION_REPRESENTATION(#{shape},#{brep})")
    head = (
        "ISO-10303-21;\nHEADER;\nFILE_DESCRIPTION(('faceted parts of a rig, in millimetres'),'2;1');\n"
        f"FILE_NAME('{out.name}','1980-01-01T00:00:00',(''),(''),'amiwarp','amiwarp','');\n"
        "FILE_SCHEMA(('AUTOMOTIVE_DESIGN { 1 0 10303 214 1 1 1 1 }'));\nENDSEC;\nDATA;\n"
    )
    body = "".join(f"#{number}={text};\n" for number, text in enumerate(step.lines, 1))
    written(out, f"{head}{body}ENDSEC;\nEND-ISO-10303-21;\n".encode())
