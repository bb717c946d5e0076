"""The two clouds as actors: from what is shown to what VTK draws, without a widget."""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Sequence
from ctypes.util import find_library
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from amiwarp.errors import AmiwarpError
from amiwarp.imaging.export import save_png
from amiwarp.plotting.clouds import OFF_COLOUR, ON_COLOUR
from amiwarp.validation import choice
from amiwarp.viewer.choices import Axis, Colour, View

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.viewer.inspector import Shown

HEIGHT = 0.75
"""Of the third axis, in widths of the image."""
NEAR_PX = 3.0
"""Events about one that tell the edge it belongs to."""
ORBIT_COLOUR = "#009e73"
MARK_COLOUR = "#f0e442"
PAPER = {False: ("white", "#333333"), True: ("#15181c", "#d8d8d8")}
"""Background and ink, light and dark."""


STANDS = {
    View.FREE: ((1.0, -1.35, 0.75), (0.0, 0.0, 1.0)),
    View.XY: ((0.0, 0.0, 1.0), (0.0, 1.0, 0.0)),
    View.X_AXIS: ((0.0, -1.0, 0.0), (0.0, 0.0, 1.0)),
    View.Y_AXIS: ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
}
"""From where, and which way is up."""
VIEW_ANGLE = 26.0
"""[deg]"""
MARGIN = 0.1
"""About the clouds, for labels, in widths of the image."""


@dataclass(frozen=True)
class Look:
    """How clouds are drawn."""

    colour: Colour = Colour.POLARITY
    axis: Axis = Axis.ANGLE
    point_size: float = 2.0
    opacity: float = 1.0
    dark: bool = False
    overlaid: bool = False
    """Both in one frame, as recorded grey."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "colour", choice(Colour, self.colour, "colour"))
        object.__setattr__(self, "axis", choice(Axis, self.axis, "axis"))


@dataclass(frozen=True)
class Box:
    """The frame of both clouds: part of the image, and the third axis from 0 on."""

    left: int
    top: int
    right: int
    bottom: int
    depth: float
    """Length of the third axis in its unit."""

    @property
    def width(self) -> int:
        return self.right - self.left

    @property
    def tall(self) -> float:
        """Of the third axis in the scene [px]."""
        return HEIGHT * self.width

    @property
    def stretch(self) -> float:
        """Of the third axis [px per unit]: x and y keep their proportion."""
        return self.tall / self.depth

    def places(self, xy: NDArray[Any], third: NDArray[Any]) -> NDArray[np.float32]:
        """In the scene, where y points up as in the image, shape (n, 3)."""
        return np.stack([xy[:, 0], -xy[:, 1], third * self.stretch], axis=1).astype(np.float32)


def check_display() -> None:
    """Raises :class:`AmiwarpError` where VTK would find no OpenGL, and end the process."""
    if not sys.platform.startswith("linux"):
        return
    if find_library("EGL") is None:
        raise AmiwarpError("VTK finds no OpenGL to draw with; on Debian: apt-get install libegl1 libgl1-mesa-dri")
    # by default VTK tries X first, and crashes where libX11 is missing; EGL needs no display
    os.environ["VTK_DEFAULT_OPENGL_WINDOW"] = "vtkEGLRenderWindow"


def font() -> Path:
    """With Greek letters, which VTK's own lacks."""
    from matplotlib import get_data_path

    return Path(get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf"


class Scene:
    """Clouds before and after compensation, drawn off screen, one camera for both."""

    def __init__(self, size: tuple[int, int] = (1000, 420)) -> None:
        """``size``: of the picture [px]. Raises :class:`AmiwarpError` where nothing can be drawn."""
        check_display()
        import pyvista

        self.plotter = pyvista.Plotter(off_screen=True, shape=(1, 2), border=False, window_size=list(size))
        self.plotter.render_window.SetMultiSamples(0)  # a software renderer draws points twice as fast without
        self.plotter.link_views()
        self.view = View.FREE
        self._clouds: list[Any] = []
        self._marks: list[tuple[int, Any]] = []
        self._frame: list[tuple[int, Any]] = []
        self._framed: tuple[Any, ...] | None = None
        self.box = Box(0, 0, 1, 1, 1.0)
        self._points: list[NDArray[np.float32]] = [np.zeros((0, 3), np.float32)] * 2

    def show(self, shown: Shown, look: Look) -> None:
        """Draws a window; the camera stays."""
        before = self.box
        depth = 360.0 if look.axis is Axis.ANGLE else shown.span.length_us * 1e-3
        self.box = Box(*shown.region, depth)
        third = third_axis(shown, look.axis)
        self._points = [self.box.places(xy, third) for xy in (shown.before, shown.after)]
        for k, points in enumerate(self._points):
            colours = colours_of(shown, look, after=k == 1)
            valid = np.isfinite(points).all(axis=1)
            self._cloud(k, points[valid], colours[valid], look)
        self._draw_frame(look)
        if replace(before, depth=depth) != self.box:  # another part of the image
            self.look_from(self.view, look)

    def look_from(self, view: View, look: Look) -> None:
        """Moves the camera, both clouds in sight."""
        self.view = view = choice(View, view, "view")
        self._draw_frame(look)
        b = self.box
        away, up = (np.array(v) for v in STANDS[view])
        away = away / np.linalg.norm(away)
        right = np.cross(up, away) / np.linalg.norm(np.cross(up, away))
        up = np.cross(away, right)
        margin = MARGIN * b.width
        low, high = np.array([b.left, -b.bottom, 0.0]) - margin, np.array([b.right, -b.top, b.tall]) + margin
        middle = (low + high) / 2.0
        corners = np.array(np.meshgrid(*zip(low, high, strict=True))).reshape(3, -1).T - middle
        wide, tall, near = (np.abs(corners @ right), np.abs(corners @ up), corners @ away)
        width, height = self.plotter.window_size
        aspect = width / height * (1.0 if look.overlaid else 0.5)
        half = math.tan(math.radians(VIEW_ANGLE / 2.0))
        camera = self.plotter.renderers[0].camera
        camera.parallel_projection, camera.view_angle = view is not View.FREE, VIEW_ANGLE
        camera.parallel_scale = float(np.maximum(tall, wide / aspect).max())
        away = away * float((near + np.maximum(tall, wide / aspect) / half).max())
        camera.position, camera.focal_point, camera.up = tuple(middle + away), tuple(middle), tuple(up)
        for renderer in self.plotter.renderers:
            renderer.camera = camera
            renderer.reset_camera_clipping_range()

    def mark(self, curves: Sequence[tuple[int, NDArray[np.float32], str]]) -> None:
        """Lines through the clouds: which cloud (0, 1), points of the scene, shape (n, 3), and colour."""
        import pyvista

        for k, actor in self._marks:
            self.plotter.renderers[k].remove_actor(actor, render=False)
        self._marks = []
        for k, points, colour in curves:
            line = pyvista.lines_from_points(points[np.isfinite(points).all(axis=1)])
            actor = self._add(k, line, color=colour, line_width=4.0)
            actor.mapper.SetResolveCoincidentTopologyToPolygonOffset()
            actor.mapper.SetRelativeCoincidentTopologyLineOffsetParameters(0.0, -1e6)  # in front of all points
            self._marks.append((k, actor))

    def pick(self, x: float, y: float) -> int | None:
        """Index of the point drawn nearest to (x, y), shares of the picture from its top left; None: none near."""
        side = int(x >= 0.5 and not self._overlaid)
        renderer, points = self.plotter.renderers[side], self._points[side]
        width, height = self.plotter.window_size
        matrix = renderer.camera.GetCompositeProjectionTransformMatrix(renderer.GetTiledAspectRatio(), -1.0, 1.0)
        m = np.array([[matrix.GetElement(i, j) for j in range(4)] for i in range(4)])
        clip = np.c_[points, np.ones(len(points))] @ m.T
        left, bottom, right, top = renderer.GetViewport()
        at = clip[:, :2] / clip[:, 3:]
        px = np.stack([(left + (at[:, 0] + 1.0) / 2.0 * (right - left)) * width,
                       (1.0 - bottom - (at[:, 1] + 1.0) / 2.0 * (top - bottom)) * height], axis=1)  # fmt: skip
        away = np.nan_to_num(np.linalg.norm(px - [x * width, y * height], axis=1), nan=np.inf)
        if not len(away) or away.min() > 8.0:
            return None
        near = np.flatnonzero(away <= away.min() + 2.0)
        return int(near[np.argmin(clip[near, 2] / clip[near, 3])])  # of those as near the foremost

    def picture(self) -> NDArray[np.uint8]:
        """What is seen, shape (height, width, 3)."""
        self.plotter.render_window.Render()
        return np.asarray(self.plotter.screenshot(None, return_img=True), np.uint8)

    def save(self, path: Path) -> None:
        """Writes the picture as PNG, beside and then renamed."""
        save_png(path, self.picture())

    def turntable(self, frames: int) -> Any:
        """Pictures of one turn about the clouds, shape (height, width, 3) each; the camera ends where it began."""
        for _ in range(frames):
            yield self.picture()
            self.plotter.renderers[0].camera.Azimuth(360.0 / frames)

    def close(self) -> None:
        self.plotter.close()

    @property
    def _overlaid(self) -> bool:
        return bool(self.plotter.renderers[0].GetViewport()[2] > 0.9)

    def _add(self, k: int, mesh: Any, **how: Any) -> Any:
        self.plotter.subplot(0, k)
        return self.plotter.add_mesh(mesh, lighting=False, show_scalar_bar=False, reset_camera=False, render=False,
                                     pickable=False, **how)  # fmt: skip

    def _cloud(self, k: int, points: NDArray[np.float32], colours: NDArray[np.uint8], look: Look) -> None:
        import pyvista

        mesh = pyvista.PolyData(points) if len(points) else pyvista.PolyData(np.zeros((1, 3), np.float32))
        mesh["colour"] = colours if len(points) else np.zeros((1, 4), np.uint8)
        while len(self._clouds) <= k:
            self._clouds.append(self._add(len(self._clouds), mesh, style="points", scalars="colour", rgb=True))
        actor = self._clouds[k]
        actor.mapper.dataset = mesh
        actor.prop.point_size, actor.prop.opacity = look.point_size, look.opacity

    def _draw_frame(self, look: Look) -> None:
        """Box, ticks and titles; drawn anew only where they change."""
        wanted = (self.box, look.axis, look.dark, look.overlaid, self.view)
        if wanted == self._framed:
            return
        self._framed = wanted
        paper, ink = PAPER[look.dark]
        left, right = self.plotter.renderers
        if look.overlaid != self._overlaid:
            left.SetViewport(0.0, 0.0, *((1.0, 1.0) if look.overlaid else (0.5, 1.0)))
            right.SetDraw(not look.overlaid)
            home, cloud = (left, right)[not look.overlaid], self._clouds[1]
            (right if look.overlaid else left).RemoveActor(cloud)
            home.AddActor(cloud)
        for renderer in (left, right):
            renderer.set_background(paper)
        for k, actor in self._frame:
            self.plotter.renderers[k].remove_actor(actor, render=False)
        self._frame = []
        titles = ("as recorded and compensated",) if look.overlaid else ("as recorded", "compensated")
        for k, title in enumerate(titles):
            self._frame += [(k, actor) for actor in self._axes(k, look, ink, title)]

    def _axes(self, k: int, look: Look, ink: str, title: str) -> list[Any]:
        import pyvista

        b = self.box
        frame = pyvista.Box((b.left, b.right, -b.bottom, -b.top, 0, b.tall)).outline()
        actors = [self._add(k, frame, color=ink, line_width=1.0)]
        unit, third = ("θ [°]", (0.0, 360.0)) if look.axis is Axis.ANGLE else ("t [ms]", (0.0, b.depth))
        gap = 0.05 * b.width
        front, middle = -b.bottom - gap, ((b.left + b.right) / 2.0, -(b.top + b.bottom) / 2.0)
        labels: list[tuple[str, tuple[float, float, float]]] = []
        if self.view is not View.Y_AXIS:
            labels += [(f"{v:g}", (v, front, -gap)) for v in ticks(b.left, b.right)]
            labels.append(("x [px]", (middle[0], front - gap, -2.5 * gap)))
        if self.view is not View.X_AXIS:
            labels += [(f"{v:g}", (b.right + gap, -v, -gap)) for v in ticks(b.top, b.bottom)]
            flat = self.view is View.XY  # there is no room to the right
            place = (b.right + gap, -b.top + 1.2 * gap, 0.0) if flat else (b.right + 2.5 * gap, middle[1], -2.5 * gap)
            labels.append(("y [px]", place))
        if self.view is not View.XY:
            labels += [(f"{v:g}", (b.left - gap, front + gap, v * b.stretch)) for v in ticks(*third)]
            labels.append((unit, (b.left - gap, front + gap, b.tall + 1.5 * gap)))
        for text, place in labels:
            label = pyvista.Label(text, position=place, size=13)
            label.prop.color, label.prop.justification_horizontal = ink, "center"
            label.prop.set_font_file(str(font()))
            self.plotter.renderers[k].add_actor(label, render=False, pickable=False, reset_camera=False)
            actors.append(label)
        self.plotter.subplot(0, k)
        actors.append(self.plotter.add_text(title, position="upper_edge", font_size=9, color=ink, render=False,
                                            font_file=str(font())))  # fmt: skip
        return actors


def ticks(low: float, high: float) -> NDArray[np.float64]:
    """Round numbers between."""
    from matplotlib.ticker import MaxNLocator

    steps = [1, 2, 3, 4.5, 6, 9, 10] if high == 360.0 else [1, 2, 2.5, 5, 10]
    values = np.asarray(MaxNLocator(5, steps=steps).tick_values(low, high), np.float64)
    return values[(values >= low) & (values <= high)]


def third_axis(shown: Shown, axis: Axis) -> NDArray[np.float64]:
    """Of each point: the prism's angle [deg], or the time from the window's start [ms]."""
    if axis is Axis.ANGLE:
        return np.asarray(np.degrees(shown.theta), np.float64)
    return np.asarray((shown.events.t - shown.span.start_us) * 1e-3, np.float64)


def colours_of(shown: Shown, look: Look, *, after: bool) -> NDArray[np.uint8]:
    """Red, green and blue of each point, shape (n, 3)."""
    from matplotlib import colormaps
    from matplotlib.colors import to_rgb

    if look.overlaid and not after:
        return np.full((len(shown.events), 3), 128, np.uint8)
    if look.colour is Colour.POLARITY:
        two = np.array([to_rgb(OFF_COLOUR), to_rgb(ON_COLOUR)])
        return np.asarray((255.0 * two).astype(np.uint8)[shown.events.p])
    value, name = _measure(shown, look.colour, after=after)
    table = colormaps[name](np.linspace(0.0, 1.0, 256))[:, :3]
    if name == "twilight":  # neither white on white nor black on black
        table = 1.0 - 0.8 * (1.0 - table) if look.dark else 0.8 * table
    table = (255.0 * table).astype(np.uint8)
    return np.asarray(table[np.clip(np.nan_to_num(value) * 255.0, 0, 255).astype(np.uint8)])


def _measure(shown: Shown, colour: Colour, *, after: bool) -> tuple[NDArray[np.float64], str]:
    """0 .. 1 for each point, and its perceptually even colour map: of an angle one that closes."""
    if colour is Colour.ANGLE:
        return shown.theta / math.tau, "twilight"
    if colour is Colour.TIME:
        return (shown.events.t - shown.span.start_us) / shown.span.length_us, "viridis"
    image, xy = (shown.image_after, shown.after) if after else (shown.image_before, shown.before)
    if colour is Colour.DENSITY:
        top = max(float(np.percentile(image[image > 0], 99.0)) if (image > 0).any() else 1.0, 1.0)
        return np.sqrt(at_pixels(image, xy) / top), "cividis"
    return residual(image, xy) / 2.0, "cividis"


def at_pixels(image: NDArray[Any], xy: NDArray[np.float32]) -> NDArray[np.float64]:
    """The image where the points lie, 0 outside of it, shape (n,)."""
    x, y = (np.nan_to_num(xy[:, k], nan=-9.0) for k in (0, 1))
    column, row = np.rint(x).astype(np.int64), np.rint(y).astype(np.int64)
    inside = (column >= 0) & (column < image.shape[1]) & (row >= 0) & (row < image.shape[0])
    out = np.zeros(len(xy))
    out[inside] = image[row[inside], column[inside]]
    return out


def residual(image: NDArray[np.float32], xy: NDArray[np.float32]) -> NDArray[np.float64]:
    """Distance [px] of each point from the middle of the events within some :data:`NEAR_PX` of it, shape (n,)."""
    from scipy.ndimage import gaussian_filter

    rows, columns = np.mgrid[: image.shape[0], : image.shape[1]].astype(np.float32)
    weight = np.maximum(gaussian_filter(image, NEAR_PX / 2.0), 1e-6)
    middle = [gaussian_filter(image * m, NEAR_PX / 2.0) / weight for m in (columns, rows)]
    away = [at_pixels(m, xy) - xy[:, k] for k, m in enumerate(middle)]
    return np.asarray(np.nan_to_num(np.hypot(*away)), np.float64)
