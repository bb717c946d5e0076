"""Drawings and pictures of the rig."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from manifold3d import CrossSection, Manifold

from rig import parts
from rig.numbers import to_mesh
from rig.parts import Part, Rig

COLOURS = {
    "base": "#8a8f98",
    "riser": "#8a8f98",
    "camera with lens": "#3c4858",
    "rear plate": "#6b7280",
    "motor": "#7a5c3e",
    "housing": "#5b8db8",
    "rear ring": "#d08c3c",
    "rear bearing": "#b8bcc4",
    "spacer": "#d08c3c",
    "front bearing": "#b8bcc4",
    "bearing cap": "#4c7a9c",
    "rotor": "#e0a04c",
    "belt": "#222222",
    "motor pulley": "#e0a04c",
    "magnet cup": "#d08c3c",
    "magnet": "#b03a3a",
    "wedge": "#7fd0d8",
    "wedge ring": "#c8742c",
    "cover": "#7fae6e",
    "fork barrier": "#40464f",
    "encoder board": "#2f6b3f",
    "motor plate": "#8fb0cc",
    "O-ring": "#1a1a1a",
}
"""Colour of each part in all pictures."""
SCREWS = "#3f3f3f"
"""Colour of all screws."""


def section(solid: Manifold) -> CrossSection:
    """Return the cut through a solid at y = 0, with z to the right and x up."""
    return solid.rotate((90, 0, 0)).slice(0.0).transform(np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0]]))


def fill(axes: Any, shape: CrossSection, colour: str, alpha: float = 0.55) -> None:
    """Fill a shape with holes, and draw its outline."""
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path as Line

    polygons = [np.vstack([p, p[:1]]) for p in shape.to_polygons() if len(p) > 2]
    if not polygons:
        return
    codes = [[Line.MOVETO, *[Line.LINETO] * (len(p) - 2), Line.CLOSEPOLY] for p in polygons]
    line = Line(np.vstack(polygons), np.concatenate(codes))
    axes.add_patch(PathPatch(line, facecolor=colour, alpha=alpha, edgecolor="none"))
    axes.add_patch(PathPatch(line, facecolor="none", edgecolor="#202020", linewidth=0.5))


def dimension(axes: Any, a: tuple[float, float], b: tuple[float, float], text: str, side: float = 0.0) -> None:
    """Draw a dimension between two points, along x if they have the same y, else along y, ``side`` mm beside them."""
    flat = abs(a[1] - b[1]) < 1e-6
    move = (0.0, side) if flat else (side, 0.0)
    p, q = ((u[0] + move[0], u[1] + move[1]) for u in (a, b))
    for u, v in ((a, p), (b, q)):
        axes.plot([u[0], v[0]], [u[1], v[1]], color="#666666", linewidth=0.4)
    axes.annotate(
        "", p, q, arrowprops={"arrowstyle": "<->", "linewidth": 0.6, "color": "#222222", "shrinkA": 0, "shrinkB": 0}
    )
    box = {"facecolor": "white", "edgecolor": "none", "pad": 0.6}
    axes.text(
        (p[0] + q[0]) / 2,
        (p[1] + q[1]) / 2,
        text,
        fontsize=6.5,
        ha="center",
        va="center",
        rotation=0 if flat else 90,
        bbox=box,
    )


def diameters(axes: Any, items: Iterable[tuple[float, float, str]], limit: float) -> None:
    """Draw diameters beside a section: radius, z, and text; each further out than the one before."""
    for k, (radius, z, text) in enumerate(items):
        at = limit + 7.0 * k
        for y in (-radius, radius):
            axes.plot([z, at], [y, y], color="#666666", linewidth=0.4)
        dimension(axes, (at, -radius), (at, radius), f"⌀ {text}")


def number(value: float) -> str:
    """Return a dimension with at most two decimals."""
    return f"{value:.2f}".rstrip("0").rstrip(".")


def drawing(rig: Rig, made: Sequence[Part], out: Path) -> None:
    """Write a sheet with a cut through the rig, and the main parts with their dimensions [mm]."""
    import matplotlib.pyplot as plt

    solids = {part.name: part.solid for part in made}
    figure, ((whole, front), (rotor, cover)) = plt.subplots(2, 2, figsize=(16.5, 11.7), layout="constrained")
    bearing = rig.bearing
    for part in made:
        fill(whole, section(part.solid), COLOURS.get(part.name, SCREWS), 0.75)
    whole.set_title(f"{rig.name}: cut at the height of the axis, seen from above; camera left, scene right", fontsize=9)
    low, edge = parts.camera_z(rig)[0], rig.distance + rig.motor[0] / 2
    dimension(whole, (0, 0), (0, rig.distance), number(rig.distance), low - 8)
    dimension(whole, (0, -rig.outline), (rig.front_z, -rig.outline), number(rig.front_z), -6)
    dimension(whole, (rig.lens_z, edge), (rig.seat_z, edge), number(rig.seat_z - rig.lens_z), 8)
    dimension(whole, (low, edge), (rig.cover_z + 2, edge), number(rig.cover_z + 2 - low), 16)
    whole.axhline(0, color="#aa3333", linewidth=0.5, linestyle="-.")

    fill(front, solids["housing"].project(), COLOURS["housing"])
    front.set_title("housing, from the scene", fontsize=9)
    bores = f"⌀ {number(bearing.outer)} + 0.05, lip ⌀ {number(2 * bearing.outside)}"
    bore = CrossSection.circle(bearing.outer / 2 + 0.025, 180)
    fill(front, bore - CrossSection.circle(bearing.outside, 180), "white", 0.9)
    dimension(front, (0, 0), (rig.distance, 0), number(rig.distance) + " (slot ± 3)", rig.outline + 6)
    dimension(front, (0, -rig.height), (0, 0), number(rig.height), -rig.outline - 8)
    dimension(
        front,
        (-bearing.outer / 2, 0),
        (bearing.outer / 2, 0),
        bores,
        0,
    )
    low, high = parts.plate_screws(rig)
    dimension(front, low, high, f"{number(high[1] - low[1])}, 2 × M3 for the motor plate", 32)
    dimension(
        front,
        (-rig.outline, 0),
        (rig.distance + 3 + parts.motor_end(rig), 0),
        number(rig.outline + rig.distance + 3 + parts.motor_end(rig)),
        -rig.height - 8,
    )

    for name in ("rotor", "wedge", "wedge ring", "spacer", "rear ring"):
        fill(rotor, section(solids[name]), COLOURS[name])
    rotor.set_title(f"rotor with wedge ({number(rig.apex_deg)}°), rings, spacer; {rig.teeth[0]} teeth GT2", fontsize=9)
    tip = rig.pitch(rig.teeth[0]) - parts.PITCH_LINE
    diameters(
        rotor,
        [
            (rig.clear, rig.front_z + 2, number(2 * rig.clear)),
            (rig.wedge / 2 + rig.seat, rig.seat_z + 2, number(rig.wedge + 2 * rig.seat)),
            (tip, rig.front_z - 3, f"{number(2 * tip)} teeth"),
        ],
        rig.front_z + 8,
    )
    half = bearing.bore / 2
    for y in (-half, half):
        rotor.plot([rig.bearing_z[0] - 9, rig.bearing_z[0]], [y, y], color="#666666", linewidth=0.4)
    dimension(rotor, (rig.bearing_z[0], -half), (rig.bearing_z[0], half), f"⌀ {number(bearing.bore)} − 0.02", -9)
    y = -rig.pitch(rig.teeth[0]) - 2
    dimension(
        rotor, (rig.bearing_z[0] + 0.2, y), (rig.shoulder_z, y), number(rig.shoulder_z - rig.bearing_z[0] - 0.2), -5
    )
    dimension(rotor, (rig.pulley_z, y), (rig.front_z, y), number(rig.front_z - rig.pulley_z), -5)
    dimension(rotor, (rig.seat_z, -y), (rig.front_z, -y), number(rig.front_z - rig.seat_z), 5)

    shadow = solids["cover"].project().offset(0.05).offset(-0.05)  # closes slivers of the projection
    fill(cover, shadow, COLOURS["cover"])
    size = f"⌀ {number(2 * rig.outline)}, depth {number(rig.cover_z + 2 - rig.face_z)}"
    inner = CrossSection.circle(rig.opening, 180)
    fill(cover, inner, "white", 0.9)
    cover.set_title("cover, from the scene", fontsize=9)
    dimension(cover, (-rig.opening, 0), (rig.opening, 0), f"⌀ {number(2 * rig.opening)}")
    dimension(
        cover,
        (-rig.outline, 0),
        (rig.outline, 0),
        size,
        -rig.outline - 7,
    )
    for axes in (whole, front, rotor, cover):
        axes.set_aspect("equal")
        axes.autoscale_view()
        axes.margins(0.06)
        axes.axis("off")
    figure.savefig(out, metadata={"Date": None} if out.suffix == ".svg" else None)
    plt.close(figure)


def mesh_of(part: Part) -> Any:
    """Return a part as a mesh of PyVista."""
    import pyvista

    mesh = to_mesh(part)
    faces = np.column_stack([np.full(len(mesh.faces), 3), mesh.faces])
    return pyvista.PolyData(np.asarray(mesh.vertices), faces.ravel())


def exploded(made: Sequence[Part], out: Path, *, apart: float = 1.5, size: tuple[int, int] = (1600, 900)) -> None:
    """Write a picture of the parts, moved apart, with their numbers in the list of :func:`rig.parts.assembly`."""
    import pyvista

    plotter = pyvista.Plotter(off_screen=True, window_size=size)
    plotter.set_background("white")
    meshes = [mesh_of(part).translate([apart * v for v in part.apart], inplace=False) for part in made]
    top = max(mesh.bounds[3] for mesh in meshes)
    points = []
    for k, (part, mesh) in enumerate(zip(made, meshes, strict=True)):
        clear = 0.45 if part.kind == "glass" else 1.0
        plotter.add_mesh(mesh, color=COLOURS.get(part.name, SCREWS), opacity=clear, smooth_shading=False, specular=0.2)
        plotter.add_mesh(mesh.extract_feature_edges(35), color="#303030", line_width=0.6)
        tip = np.array([mesh.center[0], mesh.bounds[3], mesh.center[2]])
        end = np.array([tip[0], top + 6.0 + 9.0 * (k % 3), tip[2]])
        if part.kind != "screws":
            points.append(end)
        if apart and part.kind != "screws":
            plotter.add_mesh(pyvista.Line(tip, end), color="#808080", line_width=1)
    if apart:
        plotter.add_point_labels(
            np.array(points),
            [str(k) for k in range(1, len(points) + 1)],
            font_size=18,
            shape_color="white",
            shape_opacity=0.9,
            text_color="black",
            always_visible=True,
            point_size=1,
            margin=2,
        )
    plotter.enable_parallel_projection()
    plotter.view_vector((-0.8, 0.42, 0.55), viewup=(0, 1, 0))
    plotter.reset_camera()
    plotter.camera.zoom(1.45)
    plotter.screenshot(out)
    plotter.close()
