"""Drawings and pictures of the rig."""

import math
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from manifold3d import CrossSection, Manifold

from rig import gimbal, parts
from rig.gimbal import GimbalRig
from rig.numbers import to_mesh
from rig.parts import Part, Rig

COLOURS = {
    "base": "#8a8f98",
    "mount ring": "#b0b4bc",
    "camera": "#3c4858",
    "holder": "#9a7fb8",
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
    "lens": "#56657a",
    "wave spring": "#7a8fb0",
    "stator": "#7a5c3e",
    "bell": "#a07850",
    "cell": "#e0a04c",
    "encoder block": "#8fb0cc",
    "encoder shaft": "#7f858f",
    "encoder pulley": "#e0a04c",
}
"""Colour of each part in all pictures."""
SCREWS = "#3f3f3f"
"""Colour of all screws."""


def section(solid: Manifold) -> CrossSection:
    """Return the cut through a solid at y = 0, with z to the right and x up."""
    return (
        solid.rotate((90, 0, 0)).slice(0.0).transform(np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0]]))
    )


def fill(axes: Any, shape: CrossSection, colour: str, alpha: float = 0.55) -> None:
    """Fill a shape with holes, and draw its outline."""
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path as Line

    polygons = [np.vstack([p, p[:1]]) for p in shape.simplify(0.01).to_polygons() if len(p) > 2]
    if not polygons:
        return
    codes = [[Line.MOVETO, *[Line.LINETO] * (len(p) - 2), Line.CLOSEPOLY] for p in polygons]
    line = Line(np.vstack(polygons), np.concatenate(codes))
    axes.add_patch(PathPatch(line, facecolor=colour, alpha=alpha, edgecolor="none"))
    axes.add_patch(PathPatch(line, facecolor="none", edgecolor="#202020", linewidth=0.5))


def dimension(
    axes: Any, a: tuple[float, float], b: tuple[float, float], text: str, side: float = 0.0
) -> None:
    """Draw a dimension between two points, along x if they have the same y, else along y, ``side`` mm beside them."""
    flat = abs(a[1] - b[1]) < 1e-6
    move = (0.0, side) if flat else (side, 0.0)
    p, q = ((u[0] + move[0], u[1] + move[1]) for u in (a, b))
    for u, v in ((a, p), (b, q)):
        axes.plot([u[0], v[0]], [u[1], v[1]], color="#666666", linewidth=0.4)
    axes.annotate(
        "",
        p,
        q,
        arrowprops={
            "arrowstyle": "<->",
            "linewidth": 0.6,
            "color": "#222222",
            "shrinkA": 0,
            "shrinkB": 0,
        },
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
    """Write a sheet with a cut through the rig, and all printed parts with their dimensions [mm]."""
    import matplotlib.pyplot as plt

    solids = {part.name: part.solid for part in made}
    sheets: tuple[Callable[..., None], ...]
    if isinstance(rig, GimbalRig):
        figure, rows = plt.subplots(2, 3, figsize=(24, 13), layout="constrained")
        sheets = (whole, gimbal_housing, holder, cell, cover, base)
    else:
        figure, rows = plt.subplots(3, 3, figsize=(24, 19), layout="constrained")
        sheets = (whole, housing, holder, rotor, cover, base, rings, plate, bearing_cap)
    for axes, draw in zip(rows.flat, sheets, strict=True):
        draw(axes, rig, solids)
        axes.set_aspect("equal")
        axes.autoscale_view()
        axes.margins(0.06)
        axes.axis("off")
    figure.savefig(out, metadata={"Date": None} if out.suffix == ".svg" else None)
    plt.close(figure)


def whole(axes: Any, rig: Rig, solids: dict[str, Manifold]) -> None:
    """Draw the cut through the rig at the height of the axis."""
    for name, solid in solids.items():
        fill(axes, section(solid), COLOURS.get(name, SCREWS), 0.75)
    axes.set_title(
        f"{rig.name}: cut at the height of the axis, seen from above; camera left, scene right"
    )
    low, edge = parts.camera_z(rig)[0], rig.distance + rig.motor[0] / 2
    dimension(
        axes,
        (0, 0),
        (0, rig.distance),
        number(rig.distance),
        min(low, rig.face_z - 9 - rig.motor[1]) - 8,
    )
    dimension(axes, (0, -rig.outline), (rig.front_z, -rig.outline), number(rig.front_z), -6)
    gap = f"lens to wedge {number(rig.seat_z - rig.lens_z)}"
    dimension(axes, (rig.lens_z, edge), (rig.seat_z, edge), gap, 8)
    dimension(axes, (low, edge), (rig.cover_z + 2, edge), number(rig.cover_z + 2 - low), 16)
    axes.axhline(0, color="#aa3333", linewidth=0.5, linestyle="-.")


def housing(axes: Any, rig: Rig, solids: dict[str, Manifold]) -> None:
    """Draw the housing from the scene."""
    solid, bearing, end = solids["housing"], rig.bearing, parts.motor_end(rig)
    fill(axes, solid.slice(rig.face_z - 0.5), COLOURS["housing"])
    lip = CrossSection.circle(bearing.outer / 2 + 0.025, 180) - CrossSection.circle(
        bearing.outside, 180
    )
    fill(axes, lip, "white", 0.9)
    depth = number(rig.face_z)
    axes.set_title(
        f"6 housing, from the scene; depth of the barrel {depth}, plate {number(parts.PLATE)}"
    )
    dimension(
        axes, (0, 0), (rig.distance, 0), number(rig.distance) + " (slot ± 3)", rig.outline + 6
    )
    dimension(axes, (0, -rig.height), (0, 0), number(rig.height), -rig.outline - 8)
    bores = f"⌀ {number(bearing.outer)} + 0.05, lip ⌀ {number(2 * bearing.outside)}"
    dimension(axes, (-bearing.outer / 2, 0), (bearing.outer / 2, 0), bores)
    low, high = parts.plate_screws(rig)
    side = rig.distance + 3 + end + 8 - low[0]
    dimension(axes, low, high, f"{number(high[1] - low[1])}, 2 × M3 for the motor plate", side)
    right = rig.distance + 3 + end
    dimension(axes, (-rig.outline, 0), (right, 0), number(rig.outline + right), -rig.height - 8)


def holder(axes: Any, rig: Rig, solids: dict[str, Manifold]) -> None:
    """Draw the holder from the camera, and its upright cut to the right."""
    solid = solids["holder"]
    fill(axes, solid.project().mirror((1, 0)), COLOURS["holder"])
    fill(axes, solid.slice(rig.grip_z - 0.4).mirror((1, 0)), COLOURS["holder"])
    shift = max(rig.barrel, parts.holder_screws(rig)[0][0]) + 24.0 - rig.grip_z
    fill(axes, section(solid).translate((shift, 0.0)), COLOURS["holder"])
    at = parts.clamp_radius(rig)
    axes.set_title(
        f"4 holder, from the camera, and cut at the height of the axis; plate {number(parts.HOLDER)}"
    )
    x, _ = parts.holder_screws(rig)[0]
    low = -max(rig.barrel + 4.0, x + 4.0)
    dimension(axes, (-x, low), (x, low), f"{number(2 * x)} square, 4 × ⌀ 2.9", -6)
    dimension(
        axes, (-rig.grip[0] / 2, 0), (rig.grip[0] / 2, 0), f"clamp ⌀ {number(rig.grip[0] + 0.2)}"
    )
    rear = rig.grip_z - rig.grip[1] + 0.1
    dimension(axes, (rear + shift, low), (shift, low), number(-rear), -6)
    dimension(axes, (shift, low), (shift + 1.5, low), "1.5", -13)
    spigot = rig.centring - 0.05
    dimension(
        axes, (shift + 1.5, -spigot), (shift + 1.5, spigot), f"spigot ⌀ {number(2 * spigot)}", 7
    )
    dimension(axes, (rear + shift, -at), (rear + shift, at), f"⌀ {number(2 * at)}", -6)


def gimbal_housing(axes: Any, rig: GimbalRig, solids: dict[str, Manifold]) -> None:
    """Draw the housing of the hollow-shaft motor from the camera, through the wall that carries the motor."""
    solid = solids["housing"]
    fill(axes, solid.slice(rig.face_z - 0.5).mirror((1, 0)), COLOURS["housing"], 0.25)
    fill(axes, solid.slice(2.5).mirror((1, 0)), COLOURS["housing"])
    motor, bore = rig.hollow, 2 * (rig.barrel)
    axes.set_title(
        f"housing, from the camera; wall {number(parts.PLATE)}, bore for the bell ⌀ {number(bore)}"
    )
    dimension(axes, (-rig.centring, 0), (rig.centring, 0), f"⌀ {number(2 * rig.centring)}")
    half = motor.stator_circle / 2
    dimension(
        axes, (-half, 0), (half, 0), f"4 × M3 countersunk on ⌀ {number(2 * half)}, at 45°", half + 6
    )
    dimension(
        axes, (-rig.distance, 0), (0, 0), number(rig.distance) + " (slot ± 3)", rig.outline + 6
    )
    dimension(axes, (0, -rig.height), (0, 0), number(rig.height), rig.outline + 8)
    low, high = parts.plate_screws(rig)
    at = -low[0]
    side = rig.distance + 26 - low[0]
    dimension(
        axes,
        (at, low[1]),
        (at, high[1]),
        f"{number(high[1] - low[1])}, 2 × M3 for the encoder block",
        -side,
    )


def cell(axes: Any, rig: GimbalRig, solids: dict[str, Manifold]) -> None:
    """Draw the cuts through cell and encoder block."""
    for name in ("cell", "bell", "stator", "wedge", "wedge ring", "screws of the cell"):
        fill(axes, section(solids[name]), COLOURS.get(name, SCREWS))
    block = section(solids["encoder block"]).translate((0.0, 12.0))
    fill(axes, block, COLOURS["encoder block"])
    motor, front = rig.hollow, rig.front_z
    axes.set_title(
        f"cell on the motor, wedge ({number(rig.apex_deg)}°), wedge ring; encoder block (above)"
    )
    items = [
        (rig.clear, rig.shoulder_z + 1, number(2 * rig.clear)),
        (motor.rotor_circle / 2, rig.shoulder_z + 1, f"{number(motor.rotor_circle)}, 4 × M3"),
        (rig.wedge / 2 + rig.seat, rig.seat_z + 2, number(rig.wedge + 2 * rig.seat)),
        (rig.pulley_flange, front, number(2 * rig.pulley_flange)),
    ]
    diameters(axes, items, front + 8)
    y = -rig.flag
    dimension(axes, (rig.shoulder_z, y), (front, y), number(front - rig.shoulder_z), -5)
    dimension(axes, (rig.seat_z, y), (front, y), number(front - rig.seat_z), -12)
    dimension(axes, (parts.PLATE, y), (rig.shoulder_z, y), f"motor {number(motor.height)}", -5)
    rear, high = gimbal.block_z(rig)
    top = rig.distance + 12.0 + gimbal.TUBE
    dimension(axes, (rear, top), (high, top), number(high - rear), 5)
    wide = gimbal.SMALL[1] + 0.05
    middle = rig.distance + 12.0
    dimension(
        axes, (rear, middle - wide / 2), (rear, middle + wide / 2), f"2 × ⌀ {number(wide)}", -6
    )


def rotor(axes: Any, rig: Rig, solids: dict[str, Manifold]) -> None:
    """Draw the cut through the rotor with its rings."""
    bearing = rig.bearing
    for name in ("rotor", "wedge", "wedge ring", "spacer", "rear ring"):
        fill(axes, section(solids[name]), COLOURS[name])
    axes.set_title(
        f"12 rotor with 17 wedge ({number(rig.apex_deg)}°), 18 and 7 rings, 9 spacer; {rig.teeth[0]} teeth GT2"
    )
    tip = rig.pitch(rig.teeth[0]) - parts.PITCH_LINE
    diameters(
        axes,
        [
            (rig.clear, rig.front_z + 2, number(2 * rig.clear)),
            (rig.wedge / 2 + rig.seat, rig.seat_z + 2, number(rig.wedge + 2 * rig.seat)),
            (tip, rig.front_z - 3, f"{number(2 * tip)} teeth"),
            (rig.pulley_flange, rig.front_z, number(2 * rig.pulley_flange)),
        ],
        rig.front_z + 8,
    )
    half = bearing.bore / 2
    for y in (-half, half):
        axes.plot([rig.bearing_z[0] - 9, rig.bearing_z[0]], [y, y], color="#666666", linewidth=0.4)
    dimension(
        axes,
        (rig.bearing_z[0], -half),
        (rig.bearing_z[0], half),
        f"⌀ {number(bearing.bore)} − 0.02",
        -9,
    )
    y = -rig.flag
    start = rig.bearing_z[0] + 0.2
    dimension(axes, (start, y), (rig.shoulder_z, y), number(rig.shoulder_z - start), -5)
    dimension(axes, (rig.pulley_z, y), (rig.front_z, y), number(rig.front_z - rig.pulley_z), -5)
    dimension(
        axes,
        (rig.seat_z, -rig.pulley_flange),
        (rig.front_z, -rig.pulley_flange),
        number(rig.front_z - rig.seat_z),
        5,
    )
    dimension(axes, (rig.bearing_z[0], 0), (rig.bearing_z[0], y), f"flag {number(rig.flag)}", -18)


def cover(axes: Any, rig: Rig, solids: dict[str, Manifold]) -> None:
    """Draw the cover from the scene."""
    solid, inside = solids["cover"], rig.cover_z + 1.0
    fill(axes, solid.slice(inside) + solid.slice(rig.face_z + 1.0), COLOURS["cover"])
    axes.set_title(
        f"19 cover, from the scene; depth {number(rig.cover_z + 2 - rig.face_z)}, walls 2"
    )
    dimension(axes, (-rig.opening, 0), (rig.opening, 0), f"⌀ {number(2 * rig.opening)} inside")
    dimension(
        axes, (-rig.outline, 0), (rig.outline, 0), f"⌀ {number(2 * rig.outline)}", -rig.outline - 7
    )
    low, high = parts.lugs(rig)[3], parts.lugs(rig)[2]
    dimension(axes, low, high, f"{number(high[1] - low[1])}, 4 × ⌀ 3.4", 14)


def base(axes: Any, rig: Rig, solids: dict[str, Manifold]) -> None:
    """Draw the base from above."""
    shape = solids["base"].rotate((90, 0, 0)).project().mirror((0, 1))
    fill(axes, shape, COLOURS["base"])
    low_x, low_z, high_x, high_z = shape.bounds()
    axes.set_title("1 base, from above (scene up); 6 thick, 8 × ⌀ 4.4")
    dimension(axes, (low_x, low_z), (high_x, low_z), number(high_x - low_x), -6)
    dimension(axes, (low_x, low_z), (low_x, high_z), number(high_z - low_z), -6)
    (x, near), (_, far) = parts.foot_holes(rig)[2:]
    dimension(axes, (-x, far), (x, far), number(2 * x))
    dimension(axes, (x, near), (x, far), number(far - near))
    dimension(axes, (low_x + 6, high_z - 6), (high_x - 6, high_z - 6), number(high_x - low_x - 12))
    dimension(
        axes, (high_x - 6, low_z + 6), (high_x - 6, high_z - 6), number(high_z - low_z - 12), 14
    )


def rings(axes: Any, rig: Rig, solids: dict[str, Manifold]) -> None:
    """Draw the cuts through the small round parts, in a row."""
    axes.set_title("cuts: 7 rear ring, 9 spacer, 18 wedge ring, 14 motor pulley, 15 magnet cup")
    at = 0.0
    for name, x in (
        ("rear ring", 0.0),
        ("spacer", 0.0),
        ("wedge ring", 0.0),
        ("motor pulley", rig.distance),
        ("magnet cup", rig.distance),
    ):
        shape = section(solids[name].translate((-x, 0, 0)))
        low, bottom, high, top = shape.bounds()
        fill(axes, shape.translate((at - low, 0)), COLOURS[name])
        end = at + high - low
        dimension(axes, (at, bottom), (end, bottom), number(high - low), -5)
        dimension(axes, (end, bottom), (end, top), f"⌀ {number(top - bottom)}", 6)
        inner = [abs(y) for polygon in shape.to_polygons() for _, y in polygon]
        if name != "magnet cup":
            bore = min(inner)
            dimension(axes, (at, -bore), (at, bore), f"⌀ {number(2 * bore)}", -4)
        at = end + 26.0


def plate(axes: Any, rig: Rig, solids: dict[str, Manifold]) -> None:
    """Draw the motor plate from the scene."""
    fill(
        axes, solids["motor plate"].project().translate((-rig.distance, 0)), COLOURS["motor plate"]
    )
    axes.set_title(
        f"22 motor plate, from the scene; {number(parts.MOTOR_PLATE)} thick, slots for M3 ± 3"
    )
    half, low = rig.motor_screws[0] / 2, rig.motor[0] / 2 + 3.0
    boss = rig.motor_screws[1] / 2 + 0.1
    dimension(axes, (-boss, 0), (boss, 0), f"⌀ {number(2 * boss)}")
    dimension(axes, (0, -half), (0, half), f"{number(2 * half)}, 2 × ⌀ 3.4, countersunk", half + 8)
    dimension(axes, (-8, -low), (-8, low), number(2 * low), -12)


def bearing_cap(axes: Any, rig: Rig, solids: dict[str, Manifold]) -> None:
    """Draw the bearing cap from the scene."""
    fill(axes, solids["bearing cap"].project(), COLOURS["bearing cap"])
    axes.set_title("11 bearing cap, from the scene; 1.9 thick, 3 × ⌀ 3.4")
    out = math.hypot(*parts.cap_screws(rig)[0])
    dimension(
        axes,
        (-rig.bearing.outside, 0),
        (rig.bearing.outside, 0),
        f"⌀ {number(2 * rig.bearing.outside)}",
    )
    dimension(
        axes,
        (-out - 3, 0),
        (out + 3, 0),
        f"⌀ {number(2 * out + 6)}, screws on ⌀ {number(2 * out)}",
        -out - 9,
    )


def mesh_of(part: Part) -> Any:
    """Return a part as a mesh of PyVista."""
    import pyvista

    mesh = to_mesh(part)
    faces = np.column_stack([np.full(len(mesh.faces), 3), mesh.faces])
    return pyvista.PolyData(np.asarray(mesh.vertices), faces.ravel())


def exploded(
    made: Sequence[Part], out: Path, *, apart: float = 1.5, size: tuple[int, int] = (1600, 900)
) -> None:
    """Write a picture of the parts, moved apart, with their numbers in the list of :func:`rig.parts.assembly`."""
    import pyvista
    from PIL import Image

    meshes = [
        mesh_of(part).translate([apart * v for v in part.apart], inplace=False) for part in made
    ]
    shots = []
    for flat in (
        False,
        True,
    ):  # a second picture has one colour for each part, and so shows where it can be seen
        plotter = pyvista.Plotter(off_screen=True, window_size=size)
        plotter.set_background("white")
        for k, (part, mesh) in enumerate(zip(made, meshes, strict=True), 1):
            if flat:
                plotter.ren_win.SetMultiSamples(0)
                plotter.add_mesh(mesh, color=(k, k, k), lighting=False)
                continue
            clear = 0.45 if part.kind == "glass" else 1.0
            colour = COLOURS.get(part.name, SCREWS)
            plotter.add_mesh(mesh, color=colour, opacity=clear, smooth_shading=False, specular=0.2)
            plotter.add_mesh(mesh.extract_feature_edges(35), color="#303030", line_width=0.6)
        plotter.enable_parallel_projection()
        plotter.view_vector((-0.8, 0.42, 0.55), viewup=(0.0, 1.0, 0.0))
        plotter.reset_camera()
        plotter.camera.zoom(1.7 if apart else 1.1)
        shots.append(plotter.screenshot(return_img=True))
        plotter.close()
    picture = Image.fromarray(shots[0])
    if apart:
        label(picture, shots[1][..., 0], sum(part.kind != "screws" for part in made))
    picture = np.asarray(picture)
    rows, columns = (np.flatnonzero((picture < 255).any(axis=(2, other))) for other in (1, 0))
    shown = picture[max(rows[0] - 8, 0) : rows[-1] + 9, max(columns[0] - 8, 0) : columns[-1] + 9]
    Image.fromarray(shown).quantize(128).save(out, optimize=True)


def label(picture: Any, seen: np.ndarray, count: int) -> None:
    """Write the numbers of the first ``count`` parts around a picture, with a line to a visible point of each.

    ``seen`` has the number of the part at each pixel, and 255 for none, shape (height, width). Each line is upright and
    crosses as little of other parts as it can, and keeps away from the other lines. Hidden parts have none.
    """
    from PIL import ImageDraw, ImageFont
    from scipy.ndimage import distance_transform_edt

    draw, font, taken = ImageDraw.Draw(picture), ImageFont.load_default(20), seen != 255
    points, columns = {}, np.arange(seen.shape[1])
    for k in range(1, count + 1):
        own = seen == k
        if not own.any():
            continue
        depth = np.minimum(distance_transform_edt(own), 5.0)
        above = np.cumsum(np.where(own, 0.2, taken), axis=0)
        crossed = np.stack([above, above[-1] - above])
        for x, _, _ in points.values():
            crossed += np.maximum(500.0 - 20.0 * np.abs(columns - x), 0.0)
        costs = np.where(own & (depth >= min(depth.max(), 3.0)), crossed - depth, np.inf)
        down, y, x = np.unravel_index(np.argmin(costs), costs.shape)
        points[k] = int(x), int(y), -1 + 2 * int(down)
    for k, (x, y, step) in sorted(points.items(), key=lambda item: item[1]):
        end = y
        while taken[max(end - 18, 0) : end + 19, x - 18 : x + 19].any():
            end += step
        taken[end - 12 : end + 13, x - 14 : x + 15] = True
        points[k] = x, y, end
        draw.line([(x, y), (x, end)], fill="white", width=4)
    for k, (x, y, end) in points.items():
        draw.line([(x, y), (x, end + (10 if end < y else -10))], fill="#505050", width=1)
        draw.ellipse((x - 3, y - 3, x + 3, y + 3), fill="black", outline="white")
        draw.text((x, end), str(k), fill="black", font=font, anchor="mm")
