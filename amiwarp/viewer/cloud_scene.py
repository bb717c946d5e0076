"""VTK scene with the event clouds before and after compensation, drawn off screen without a user interface."""

from __future__ import annotations

import math
import os
import sys
from ctypes.util import find_library
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from amiwarp.errors import AmiwarpError
from amiwarp.imaging.export import save_png
from amiwarp.validation import choice
from amiwarp.viewer.choices import Axis, Colour, View
from amiwarp.viewer.colouring import axis_range, colours_of, third_axis
from amiwarp.viewer.legend import legend_actors, rows_in, strip_share
from amiwarp.viewer.truth_colours import Legend, legend_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from amiwarp.viewer.window import DisplayedWindow

AXIS_HEIGHT = 0.75
"""Length of the drawn third axis, as a multiple of the region's width."""
BACKGROUND_AND_INK = {False: ("white", "#333333"), True: ("#15181c", "#d8d8d8")}
"""Colours of background and lines, for light (False) and dark (True) mode."""
CAMERA_DIRECTIONS = {
    View.FREE: ((1.0, -1.35, 0.75), (0.0, 0.0, 1.0)),
    View.XY: ((0.0, 0.0, 1.0), (0.0, 1.0, 0.0)),
    View.X_AXIS: ((0.0, -1.0, 0.0), (0.0, 0.0, 1.0)),
    View.Y_AXIS: ((-1.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
}
"""Direction from the clouds to the camera, and the upward direction, for each view."""
ORBIT_COLOUR = "#009e73"
"""Colour of the model's orbit, as on the page."""
VIEW_ANGLE = 26.0
"""Vertical field of view of the camera [deg]."""
MARGIN = 0.1
"""Margin around the clouds for labels, as a multiple of the region's width."""


@dataclass(frozen=True)
class Look:
    """Style in which the event clouds are drawn."""

    colour: Colour = Colour.POLARITY
    """Quantity that the points' colour shows."""
    axis: Axis = Axis.ANGLE
    """Quantity along the third axis: prism angle or time."""
    point_size: float = 2.0
    """Diameter of the points in the picture [px]."""
    opacity: float = 1.0
    """Opacity of the points, 0 to 1."""
    dark: bool = False
    """Whether the background is dark."""
    overlaid: bool = False
    """Whether both clouds are drawn in one frame, with the first one in grey."""
    titles: tuple[str, ...] = ("as recorded", "compensated")
    """Titles of the clouds. With a single title, only the second cloud is drawn."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "colour", choice(Colour, self.colour, "colour"))
        object.__setattr__(self, "axis", choice(Axis, self.axis, "axis"))

    def for_clouds(self, titles: Sequence[str]) -> Look:
        """Return the look for clouds with these titles. A single cloud gets the whole picture."""
        return replace(self, titles=tuple(titles), overlaid=self.overlaid or len(titles) == 1)


@dataclass(frozen=True)
class Box:
    """Frame of both clouds: a region of the image [px], and the range of the third axis."""

    left: int
    top: int
    right: int
    bottom: int
    low: float
    """Start of the third axis [deg or ms]."""
    high: float
    """End of the third axis [deg or ms]."""

    @property
    def width(self) -> int:
        """Width of the shown region of the image [px]."""
        return self.right - self.left

    @property
    def axis_height(self) -> float:
        """Length of the third axis in the scene [px]."""
        return AXIS_HEIGHT * self.width

    @property
    def stretch(self) -> float:
        """Scale of the third axis [px per deg or ms]. The scale of x and y is 1."""
        return self.axis_height / (self.high - self.low)

    def positions(self, xy: NDArray[Any], third: NDArray[Any]) -> NDArray[np.float32]:
        """Return points in the scene, shape ``(n, 3)``; y is negated, because the scene's y axis points up."""
        return np.stack([xy[:, 0], -xy[:, 1], (third - self.low) * self.stretch], axis=1).astype(np.float32)


def check_display() -> None:
    """Select EGL for VTK on Linux. Raises :class:`AmiwarpError` without EGL, where VTK would end the process."""
    if not sys.platform.startswith("linux"):
        return
    if find_library("EGL") is None:
        raise AmiwarpError("VTK needs OpenGL (EGL) to draw; on Debian run: apt-get install libegl1 libgl1-mesa-dri")
    # by default VTK tries X first, and crashes if libX11 is missing; EGL needs no display
    os.environ["VTK_DEFAULT_OPENGL_WINDOW"] = "vtkEGLRenderWindow"


def font() -> Path:
    """Return a font with Greek letters, which VTK's own font lacks."""
    from matplotlib import get_data_path

    return Path(get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf"


class Scene:
    """Event clouds before and after compensation, drawn off screen, with one camera for both."""

    def __init__(self, size: tuple[int, int] = (1000, 420)) -> None:
        """Create an empty scene; ``size`` is the picture's width and height [px].

        Raises :class:`AmiwarpError` if VTK cannot draw on this machine.
        """
        check_display()
        import pyvista

        self.plotter = pyvista.Plotter(off_screen=True, shape=(1, 3), border=False, window_size=list(size))
        self.plotter.render_window.SetMultiSamples(0)  # doubles the speed of a software renderer
        self.plotter.link_views((0, 1))
        self._divide(0.0, overlaid=False)
        self.view = View.FREE
        self._clouds: list[Any] = []
        self._frame: list[tuple[int, Any]] = []
        self._lines: list[tuple[int, Any]] = []
        self._explained: tuple[Legend, str] | None = None
        self._framed: tuple[Any, ...] | None = None
        self.box = Box(0, 0, 1, 1, 0.0, 1.0)

    def show(self, shown: DisplayedWindow, look: Look, lines: Sequence[NDArray[Any]] = ()) -> None:
        """Draw the events of a window. The camera moves only if the region of the image has changed.

        ``lines``: a line for each cloud, points x, y [px] and on the third axis, shape ``(n, 3)``.
        """
        before = self.box
        self.box = Box(*shown.region, *axis_range(shown, look.axis))
        third = third_axis(shown, look.axis)
        for k, xy in enumerate((shown.before, shown.after)):
            points = self.box.positions(xy, third)
            colours = colours_of(shown, look, after=k == 1)
            valid = np.isfinite(points).all(axis=1) & (k == 1 or len(look.titles) > 1)
            self._cloud(k, points[valid], colours[valid], look)
        self._draw_frame(look)
        self._draw_lines(lines, look)
        self._draw_legend(legend_of(shown.truth, look.colour, rows_in(self.plotter.window_size[1])), look)
        if replace(before, low=self.box.low, high=self.box.high) != self.box:  # the region has changed
            self.look_from(self.view, look)

    def look_from(self, view: View, look: Look) -> None:
        """Move the camera to a view direction from which both clouds fit into the picture."""
        self.view = view = choice(View, view, "view")
        self._draw_frame(look)
        b = self.box
        away, up = (np.array(v) for v in CAMERA_DIRECTIONS[view])
        away = away / np.linalg.norm(away)
        right = np.cross(up, away) / np.linalg.norm(np.cross(up, away))
        up = np.cross(away, right)
        margin = MARGIN * b.width
        low, high = np.array([b.left, -b.bottom, 0.0]) - margin, np.array([b.right, -b.top, b.axis_height]) + margin
        middle = (low + high) / 2.0
        corners = np.array(np.meshgrid(*zip(low, high, strict=True))).reshape(3, -1).T - middle
        wide, tall, near = (np.abs(corners @ right), np.abs(corners @ up), corners @ away)
        width, height = self.plotter.window_size
        aspect = width / height * (1.0 - self._strip) * (1.0 if look.overlaid else 0.5)
        half = math.tan(math.radians(VIEW_ANGLE / 2.0))
        camera = self.plotter.renderers[0].camera
        camera.parallel_projection, camera.view_angle = view is not View.FREE, VIEW_ANGLE
        camera.parallel_scale = float(np.maximum(tall, wide / aspect).max())
        away = away * float((near + np.maximum(tall, wide / aspect) / half).max())
        camera.position, camera.focal_point, camera.up = tuple(middle + away), tuple(middle), tuple(up)
        for renderer in self._views:
            renderer.camera = camera
            renderer.reset_camera_clipping_range()

    def picture(self) -> NDArray[np.uint8]:
        """Return the drawn picture, shape ``(height, width, 3)``."""
        self.plotter.render_window.Render()
        return np.asarray(self.plotter.screenshot(None, return_img=True), np.uint8)

    def save(self, path: Path) -> None:
        """Write the picture as PNG, first under a temporary name."""
        save_png(path, self.picture())

    def turntable(self, frames: int) -> Any:
        """Yield pictures while the camera moves once around the clouds, each of shape ``(height, width, 3)``."""
        for _ in range(frames):
            yield self.picture()
            self.plotter.renderers[0].camera.Azimuth(360.0 / frames)

    def close(self) -> None:
        """Release the VTK renderer and its memory."""
        self.plotter.close()

    @property
    def _views(self) -> list[Any]:
        """Renderers of the two clouds."""
        return list(self.plotter.renderers)[:2]

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
        """Draw the box, the ticks and the axis titles, if they have changed."""
        wanted = (self.box, look.axis, look.dark, look.overlaid, look.titles, self.view)
        if wanted == self._framed:
            return
        self._framed = wanted
        background, ink = BACKGROUND_AND_INK[look.dark]
        left, right = self._views
        if look.overlaid != self._overlaid:
            self._divide(self._strip, overlaid=look.overlaid)
            home, cloud = (left, right)[not look.overlaid], self._clouds[1]
            (right if look.overlaid else left).RemoveActor(cloud)
            home.AddActor(cloud)
        for renderer in self.plotter.renderers:
            renderer.set_background(background)
        for k, actor in self._frame:
            self.plotter.renderers[k].remove_actor(actor, render=False)
        self._frame = []
        titles = (" and ".join(look.titles),) if look.overlaid else look.titles
        for k, title in enumerate(titles):
            self._frame += [(k, actor) for actor in self._axes(k, look, ink, title)]

    def _draw_lines(self, lines: Sequence[NDArray[Any]], look: Look) -> None:
        """Draw a line in each cloud, instead of those drawn before."""
        import pyvista

        for k, actor in self._lines:
            self.plotter.renderers[k].remove_actor(actor, render=False)
        self._lines = []
        for number, line in enumerate(lines):
            k = 0 if look.overlaid else number
            curve = pyvista.lines_from_points(self.box.positions(line[:, :2], line[:, 2]))
            self._lines.append((k, self._add(k, curve, color=ORBIT_COLOUR, line_width=2.5)))

    def _draw_legend(self, legend: Legend, look: Look) -> None:
        """Draw the legend in a strip on the left, if it has changed. The clouds shrink to make room."""
        ink, home, camera = BACKGROUND_AND_INK[look.dark][1], self.plotter.renderers[2], self._views[0].camera
        strip = strip_share(legend, self.plotter.window_size[0])
        if strip != self._strip:
            grows = (1.0 - self._strip) / (1.0 - strip)
            self._divide(strip, overlaid=look.overlaid)
            camera.Dolly(1.0 / grows)
            camera.parallel_scale *= grows
            self._views[0].reset_camera_clipping_range()
        if self._explained == (legend, ink):
            return
        self._explained = legend, ink
        home.clear_actors()
        for actor in legend_actors(legend, ink, font()):
            home.add_actor(actor, render=False, pickable=False, reset_camera=False)

    def _divide(self, strip: float, *, overlaid: bool) -> None:
        """Divide the picture into the legend's strip, given as a share of the width, and one or two clouds."""
        self._strip, (left, right, legend) = strip, self.plotter.renderers
        middle = (1.0 + strip) / 2.0
        legend.SetViewport(0.0, 0.0, strip, 1.0)
        left.SetViewport(strip, 0.0, 1.0 if overlaid else middle, 1.0)
        right.SetViewport(middle, 0.0, 1.0, 1.0)
        legend.SetDraw(strip > 0.0)
        right.SetDraw(not overlaid)

    def _axes(self, k: int, look: Look, ink: str, title: str) -> list[Any]:
        import pyvista

        b = self.box
        frame = pyvista.Box((b.left, b.right, -b.bottom, -b.top, 0, b.axis_height)).outline()
        actors = [self._add(k, frame, color=ink, line_width=1.0)]
        unit = "θ [°]" if look.axis is Axis.ANGLE else "t [ms]"
        gap = 0.05 * b.width
        front, middle = -b.bottom - gap, ((b.left + b.right) / 2.0, -(b.top + b.bottom) / 2.0)
        labels: list[tuple[str, tuple[float, float, float]]] = []
        if self.view is not View.Y_AXIS:
            labels += [(f"{v:g}", (v, front, -gap)) for v in ticks(b.left, b.right)]
            labels.append(("x [px]", (middle[0], front - gap, -2.5 * gap)))
        if self.view is not View.X_AXIS:
            labels += [(f"{v:g}", (b.right + gap, -v, -gap)) for v in ticks(b.top, b.bottom)]
            flat = self.view is View.XY  # no space to the right
            place = (b.right + gap, -b.top + 1.2 * gap, 0.0) if flat else (b.right + 2.5 * gap, middle[1], -2.5 * gap)
            labels.append(("y [px]", place))
        if self.view is not View.XY:
            y = -b.top + gap if self.view is View.Y_AXIS else front + gap  # on the left
            labels += [(f"{v:g}", (b.left - gap, y, (v - b.low) * b.stretch)) for v in ticks(b.low, b.high)]
            labels.append((unit, (b.left - gap, y, b.axis_height + 1.5 * gap)))
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
    """Return round numbers from ``low`` to ``high``; for angles, divisors of a full turn are preferred."""
    from matplotlib.ticker import MaxNLocator

    steps = [1, 2, 3, 4.5, 6, 9, 10] if high == 360.0 else [1, 2, 2.5, 5, 10]
    values = np.asarray(MaxNLocator(5, steps=steps).tick_values(low, high), np.float64)
    return values[(values >= low) & (values <= high)]
