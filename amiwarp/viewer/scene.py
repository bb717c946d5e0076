"""VTK scene with the event clouds before and after compensation."""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Sequence
from ctypes.util import find_library
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.choices import Axis, Colour, View
from amiwarp.errors import AmiwarpError
from amiwarp.plotting.colours import GREY, Scale
from amiwarp.plotting.meshes import Box
from amiwarp.viewer.axes import CloudAxes, projected, view_matrix
from amiwarp.viewer.cloud_colours import (
    axis_range,
    colours_of,
    legend_of,
    scale_of,
    third_axis,
    unknown_rows,
)
from amiwarp.viewer.legend_actors import BAR_BOTTOM, CORNER, MARK, bar_actors, strip_share
from amiwarp.viewer.look import BACKGROUND_AND_INK, CAMERA_DIRECTIONS, ORBIT_COLOUR, Look
from amiwarp.viewer.shown_window import DisplayedWindow
from amiwarp.viewer.texts import FONT_PX, fitting_font, label_actor, on_paper, text_actor

OWN_RENDERERS = 4
"""Number of renderers of a scene: two clouds, their legend and the caption."""
FOOT_PX = 22
"""Height of the caption [px]."""
ROW_PX = 40
LEAST_ROWS = 3
MOST_ROWS = 12
"""Height of the picture per row of the legend [px], and smallest and largest number of rows."""
PICK_PX = 4.0
"""Distance from the mouse up to which an event is found [px]."""
ROUND_PX = 4.0
"""Diameter of the points from which they are round [px]. Smaller discs have no shape, and squares are faster."""
NOWHERE = (0.0, 0.0, 0.0, 0.0)
"""Place of a renderer that is hidden."""
VIEW_ANGLE = 26.0
"""Vertical field of view of the camera [deg]."""
LEAST_FONT_PX = 8
FULL_FONT_PX = 800
"""Smallest size of the texts, and width of a picture from which they have their full size [px]."""
MARGIN = 0.02
"""Margin around the clouds, as a multiple of the region's width."""
LABELS_EM = (6.0, 3.4)
"""Space on each side of the clouds, across and upwards, for title and labels of the axes, in sizes of the font."""
PIXEL_PX = 2.0
"""Diameter of the points at which they are as large as the pixels in the view along the third axis [px]."""


def side_line() -> Any:
    """Return a grey line at the left side of a renderer."""
    import pyvista
    from vtkmodules.vtkRenderingCore import vtkActor2D, vtkCoordinate, vtkPolyDataMapper2D

    shares = vtkCoordinate()
    mapper = vtkPolyDataMapper2D()
    actor = vtkActor2D()
    shares.SetCoordinateSystemToNormalizedViewport()
    mapper.SetTransformCoordinate(shares)
    mapper.SetInputData(pyvista.Line((0.0, 0.0, 0.0), (0.0, 1.0, 0.0)))
    mapper.ScalarVisibilityOff()  # PyVista's line has numbers along it
    actor.SetMapper(mapper)
    actor.GetProperty().SetColor(pyvista.Color(GREY).float_rgb)
    actor.GetProperty().SetLineWidth(2.0)  # of which the right half is inside
    return actor


def place_renderer(renderer: Any, place: tuple[float, ...], *, shown: bool) -> None:
    """Draw a renderer at a place (left, bottom, right and top, in shares of the picture's size), or hide it.

    A hidden renderer gets an empty place. PyVista lets each renderer under a pressed mouse button follow the mouse,
    also one that draws nothing, which would take the mouse from the clouds.
    """
    renderer.SetDraw(shown)
    renderer.SetViewport(*(place if shown else NOWHERE))


class Scene:
    """Event clouds before and after compensation, with one camera for both, their legend and a caption."""

    on_display = False
    """Whether this process has opened a window. Films of it are then drawn with OpenGL of its display, too: contexts of
    EGL beside it spoil what the window shows."""

    def __init__(
        self, size: tuple[int, int] = (1000, 420), *, more: int = 0, off_screen: bool = True
    ) -> None:
        """Create an empty scene; ``size`` is the picture's width and height [px].

        ``more``: number of renderers for other parts; they follow the :data:`OWN_RENDERERS` of the scene. Without
        ``off_screen``, a window shows the scene. Raises :class:`AmiwarpError` if VTK cannot draw on this machine.
        """
        if off_screen and not Scene.on_display and sys.platform.startswith("linux"):
            if find_library("EGL") is None:  # VTK would end the process
                raise AmiwarpError(
                    "VTK needs OpenGL (EGL); on Debian run: apt-get install libegl1 libgl1-mesa-dri"
                )
            # needs neither a display nor libX11
            os.environ["VTK_DEFAULT_OPENGL_WINDOW"] = "vtkEGLRenderWindow"
        import pyvista

        parts = 1, OWN_RENDERERS + more
        self.plotter = pyvista.Plotter(
            off_screen=off_screen, shape=parts, border=False, window_size=list(size)
        )
        Scene.on_display = Scene.on_display or not off_screen
        self.plotter.render_window.SetMultiSamples(0)  # doubles the speed of a software renderer
        self.plotter.link_views((0, 1))
        self._views = list(self.plotter.renderers)[:2]  # of the clouds
        self._area = (0.0, 0.0, 1.0, 1.0)
        self._foot = 0.0
        self.font_px = min(FONT_PX, max(LEAST_FONT_PX, round(FONT_PX * size[0] / FULL_FONT_PX)))
        """Size of the texts [px]."""
        self._divide(0.0, overlaid=False)
        self.view = View.FREE
        self.stride = 1
        """Distance between the events that are drawn: 1 for all."""
        self._clouds: list[Any] = []
        self._meshes: list[Any] = [None, None]
        self._drawn: list[tuple[Any, ...]] = [((), (), None)] * 2
        self._frame: list[Any] = []
        self._look = Look()
        self._titles = [label_actor("black", FONT_PX, up="top") for _ in self._views]
        self._axes = [CloudAxes(renderer) for renderer in self._views]
        for renderer, title in zip(self._views, self._titles, strict=True):
            renderer.add_actor(title, render=False, pickable=False, reset_camera=False)
            renderer.AddObserver("StartEvent", lambda caller, _: self._before_drawing(caller))
        if more:  # a window, in which zoomed clouds would touch each other
            self._views[1].AddActor(side_line())
        self._lines: list[Any] = []
        self._explained: tuple[Any, ...] = ()
        self._caption = text_actor("", "black", (0.01, 0.9))
        self.plotter.renderers[3].add_actor(
            self._caption, render=False, pickable=False, reset_camera=False
        )
        self._framed: tuple[Any, ...] | None = None
        self._size = tuple(size)
        self.box = Box(0, 0, 1, 1, 0.0, 1.0)

    @property
    def views(self) -> list[Any]:
        """The renderers of the clouds."""
        return self._views

    def show(
        self,
        shown: DisplayedWindow,
        look: Look,
        lines: Sequence[NDArray[Any]] = (),
        caption: str = "",
    ) -> None:
        """Draw the events of a window. If the region of the image has changed, the camera moves, but does not turn.

        ``lines``: a line for each cloud, points x, y [px] and on the third axis, shape ``(n, 3)``. ``caption``: text
        below the clouds.
        """
        before = self.box
        self._look = look
        self.box = Box(*shown.region, *axis_range(shown, look.axis))
        self._cloud(0, shown.first.before, shown.first, look)
        self._cloud(1, shown.after, shown, look)
        self._draw_frame(look)
        self._draw_lines(lines, look)
        self._draw_legend(shown, look, caption)
        region_changed = replace(before, low=self.box.low, high=self.box.high) != self.box
        if region_changed:
            self._fit(look)

    def look_from(self, view: View, look: Look) -> None:
        """Move the camera to a view direction from which both clouds fit into the picture."""
        self.view = view
        camera = self.plotter.renderers[0].camera
        away, up = CAMERA_DIRECTIONS[view]
        camera.parallel_projection = view is not View.FREE
        camera.view_angle = VIEW_ANGLE
        camera.position = away
        camera.focal_point = (0.0, 0.0, 0.0)
        camera.up = up
        self._fit(look)

    def _fit(self, look: Look) -> None:
        """Move the camera, without turning it, to where both clouds fit into the picture."""
        self._draw_frame(look)
        camera = self.plotter.renderers[0].camera
        away = -np.array(camera.direction)
        right = np.cross(np.array(camera.up), away)
        right = right / np.linalg.norm(right)
        up = np.cross(away, right)

        # How far the corners of the box are from its middle: across the picture, upwards, and towards the camera.
        box = self.box
        margin = MARGIN * box.width
        low = np.array([box.left, -box.bottom, 0.0]) - margin
        high = np.array([box.right, -box.top, box.axis_height]) + margin
        middle = (low + high) / 2.0
        grid = np.array(np.meshgrid(*zip(low, high, strict=True)))
        corners = grid.reshape(3, -1).T - middle
        wide = np.abs(corners @ right)
        tall = np.abs(corners @ up)
        near = corners @ away

        # The labels of the axes need room, too, but leave the box two fifths of the picture at least.
        width_px, height_px = self._cloud_size(look)
        across_em, up_em = LABELS_EM
        across_px = 2.0 * across_em * self.font_px
        up_px = 2.0 * up_em * self.font_px
        tall *= height_px / max(height_px - up_px, 0.4 * height_px)
        wide *= width_px / max(width_px - across_px, 0.4 * width_px)

        needed = np.maximum(tall, wide / (width_px / height_px))
        tangent = math.tan(math.radians(VIEW_ANGLE / 2.0))
        distance = float((near + needed / tangent).max())
        camera.parallel_scale = float(needed.max())
        camera.position = tuple(middle + away * distance)
        camera.focal_point = tuple(middle)
        camera.up = tuple(up)
        for renderer in self._views:
            renderer.camera = camera

    def _cloud_size(self, look: Look) -> tuple[float, float]:
        """Return width and height of what shows a cloud [px]."""
        width, height = self.plotter.render_window.GetSize()
        left, low, right, top = self._area
        share_of_each = 1.0 if look.overlaid else 0.5
        wide = (right - left - self._strip) * share_of_each
        high = top - low - self._foot
        return max(width * wide, 1.0), max(height * high, 1.0)

    def place(self, area: tuple[float, float, float, float], font_px: int, look: Look) -> None:
        """Fill another part of the picture: left, low, right and top in shares of its size, with texts of a size."""
        size = tuple(self.plotter.render_window.GetSize())
        if (area, font_px, size) == (self._area, self.font_px, self._size):
            return
        self._area = area
        self.font_px = font_px
        self._size = size
        self._explained = ()
        self._framed = None
        self._divide(self._strip, overlaid=self._overlaid)
        if self._clouds:
            self._fit(look)

    def event_at(self, place: tuple[int, int], shown: DisplayedWindow, look: Look) -> int:
        """Return the index of the front event within :data:`PICK_PX` of a place in the picture; -1 if there is none.

        ``place``: pixels from the left and from the bottom.
        """
        for k, renderer in enumerate(self._views):
            if not (renderer.GetDraw() and renderer.IsInViewport(*place)):
                continue
            xy = shown.after if k == 1 or self._overlaid else shown.before
            points = self.box.positions(xy, third_axis(shown, look.axis))
            renderer.ResetCameraClippingRange()  # the range of the cloud that was drawn last
            places, depth = projected(points, view_matrix(renderer), renderer.GetSize())
            away_x, away_y = (places + renderer.GetOrigin() - place).T
            reach_px = max(PICK_PX, 0.5 * self._clouds[k].prop.point_size)
            distance = np.hypot(away_x, away_y)
            near = np.flatnonzero((distance <= reach_px) & (depth >= 0.0))
            if not len(near):
                return -1
            front_first = np.lexsort((distance[near], depth[near]))
            return int(near[front_first[0]])
        return -1

    def picture(self) -> NDArray[np.uint8]:
        """Return the drawn picture, shape ``(height, width, 3)``."""
        # A Plotter's own screenshot asks for its show() first.
        from pyvista.plotting.utilities.regression import image_from_window

        window = self.plotter.render_window
        window.Render()
        return np.asarray(image_from_window(window, ignore_alpha=True), np.uint8)

    def turntable(self, frames: int) -> Any:
        """Yield pictures while the camera moves once around the clouds, each of shape ``(height, width, 3)``."""
        for _ in range(frames):
            yield self.picture()
            self.plotter.renderers[0].camera.Azimuth(360.0 / frames)

    def close(self) -> None:
        """Release the VTK renderer and its memory."""
        self.plotter.close()

    def _add(self, k: int, mesh: Any, **how: Any) -> Any:
        self.plotter.subplot(0, k)
        return self.plotter.add_mesh(
            mesh,
            lighting=False,
            show_scalar_bar=False,
            reset_camera=False,
            render=False,
            pickable=False,
            **how,
        )

    def _cloud(self, k: int, xy: NDArray[np.float32], shown: DisplayedWindow, look: Look) -> None:
        """Draw the points of a cloud. Only what has changed is computed, and the points are moved where they are."""
        drawn = k == 1 or len(look.titles) > 1
        along_axis = shown.theta if look.axis is Axis.ANGLE else shown.events
        places = (id(xy), id(along_axis), self.box, self.stride, drawn)
        colours: tuple[Any, ...] = (
            id(shown.events),
            id(shown.theta),
            look.colour,
            look.dark,
            look.overlaid,
        )
        if look.colour is Colour.DENSITY:  # both clouds have the scale of the second image
            colours = (*colours, id(shown.image_before), id(shown.image_after))
        elif look.colour is Colour.RESIDUAL:
            image = shown.image_after if k == 1 else shown.image_before
            colours = (*colours, id(image))

        old_places, old_colours, _ = self._drawn[k]
        same_places = places == old_places
        same_colours = colours == old_colours
        # The window keeps the arrays, so that no others get their identities.
        self._drawn[k] = (places, colours, shown)
        if not (same_places and same_colours):
            few = shown.every(self.stride if drawn else len(xy))
            visible = self._draw_points(k, few, look, same_colours=same_colours)
            drawn = drawn and visible
        self._clouds[k].visibility = drawn
        self._clouds[k].prop.opacity = look.opacity

    def _draw_points(
        self, k: int, shown: DisplayedWindow, look: Look, *, same_colours: bool
    ) -> bool:
        """Set points and colours of a cloud. Return whether any of its points has a place.

        ``same_colours``: whether the colours of all events are as they were.
        """
        import pyvista

        xy = shown.after if k else shown.before
        points = self.box.positions(xy, third_axis(shown, look.axis))
        valid: Any = ...  # stands for all points, without a copy
        visible = True
        if not math.isfinite(float(points.sum())):
            valid = np.isfinite(points).all(axis=1)
            if not valid.any():  # VTK needs a point, which is then not visible
                visible = False
                points = np.zeros((len(points), 3), np.float32)
                valid = np.arange(len(points)) < 1
        points = points[valid]

        mesh = self._meshes[k]
        moved = valid is ... and mesh is not None and len(mesh.points) == len(points)
        if moved:
            mesh.points = points
        else:
            mesh = pyvista.PolyData(points)
            mesh["colour"] = np.zeros((len(points), 3), np.uint8)
            self._meshes[k] = mesh
            if len(self._clouds) == k:
                cloud = self._add(k, mesh, style="points", scalars="colour", rgb=True)
                self._clouds.append(cloud)
            self._clouds[k].mapper.dataset = mesh
        if not (moved and same_colours):
            mesh["colour"] = colours_of(shown, look, after=k == 1)[valid]
        return visible

    def _before_drawing(self, renderer: Any) -> None:
        """Size the points, and place the title: a window may have changed its size, and the mouse the camera.

        Both clouds have one camera, so that each needs its own clipping range, from what it shows now.
        """
        renderer.ResetCameraClippingRange()
        look = self._look
        width, height = renderer.GetSize()
        k = self._views.index(renderer)
        self._titles[k].SetPosition(0.5 * width, height - 0.5 * self.font_px)
        camera = renderer.camera
        size = look.point_size
        is_round = look.point_size >= ROUND_PX
        along_axis = abs(camera.direction[2]) > 0.9999
        if camera.parallel_projection and along_axis:  # the image: its pixels touch each other
            pixel_px = height / (2.0 * camera.parallel_scale)
            size = max(1.0, pixel_px * look.point_size / PIXEL_PX)
            is_round = False
        for cloud in self._clouds:
            if renderer.HasViewProp(cloud):
                cloud.prop.point_size = size
                cloud.prop.render_points_as_spheres = is_round

    def _draw_frame(self, look: Look) -> None:
        """Draw the boxes, their titles and axes, if they have changed."""
        import pyvista

        wanted = (self.box, look.axis, look.dark, look.overlaid, look.titles, self.font_px)
        if wanted == self._framed:
            return
        self._framed = wanted
        background, ink = BACKGROUND_AND_INK[look.dark]
        left, right = self._views
        if look.overlaid != self._overlaid:
            self._divide(self._strip, overlaid=look.overlaid)
            # The second cloud moves to the renderer of the first one, or back.
            cloud = self._clouds[1]
            if look.overlaid:
                right.RemoveActor(cloud)
                left.AddActor(cloud)
            else:
                left.RemoveActor(cloud)
                right.AddActor(cloud)
        for renderer in list(self.plotter.renderers)[:OWN_RENDERERS]:
            renderer.set_background(background)
        for renderer in self._views:
            renderer.remove_actor(self._frame, render=False)
        titles = (" and ".join(look.titles),) if look.overlaid else look.titles
        third = "θ [°]" if look.axis is Axis.ANGLE else "t [ms]"
        for title, axes in zip(self._titles, self._axes, strict=True):
            title.input = ""
            axes.hide()
        box = self.box
        bounds = (box.left, box.right, -box.bottom, -box.top, 0, box.axis_height)
        self._frame = []
        for k, text in enumerate(titles):
            outline = pyvista.Box(bounds).outline()
            self._frame.append(self._add(k, outline, color=ink, line_width=1.0))
            self._axes[k].label(box, ("x [px]", "y [px]", third), (background, ink), self.font_px)
            self._titles[k].input = text
            self._titles[k].prop.color = ink
            self._titles[k].prop.font_size = round(1.2 * self.font_px)
            on_paper(self._titles[k], background)

    def _draw_lines(self, lines: Sequence[NDArray[Any]], look: Look) -> None:
        """Draw a line in each cloud, instead of those drawn before."""
        import pyvista

        for renderer in self._views:
            renderer.remove_actor(self._lines, render=False)
        self._lines = []
        for k, line in enumerate(lines):
            curve = pyvista.lines_from_points(self.box.positions(line[:, :2], line[:, 2]))
            view = 0 if look.overlaid else k
            self._lines.append(self._add(view, curve, color=ORBIT_COLOUR, line_width=2.5))

    def _draw_legend(self, shown: DisplayedWindow, look: Look, caption: str) -> None:
        """Draw the legend in a strip on the left, and the caption below. The clouds shrink to make room."""
        _, ink = BACKGROUND_AND_INK[look.dark]
        width, whole_height = self.plotter.render_window.GetSize()
        left, low, right, top = self._area
        height = round(whole_height * (top - low))

        bar = scale_of(shown, look.colour, dark=look.dark)
        most = max(LEAST_ROWS, min(MOST_ROWS, height // ROW_PX))
        rows = (
            *legend_of(shown.truth, look.colour, most),
            *unknown_rows(shown, look.colour),
        )
        if look.overlaid and len(look.titles) > 1:
            rows = (*rows, (GREY, look.titles[0]))

        texts = [text for _, text in rows]
        if bar is not None:
            texts.insert(0, bar.label)
        strip_px = round(width * strip_share(texts, width, self.font_px))
        # Both clouds get a whole number of pixels, and so the same ones.
        strip_px += (round(width * (right - left)) - strip_px) % 2
        strip = strip_px / width
        foot = FOOT_PX * self.font_px / FONT_PX / whole_height if caption else 0.0
        if (strip, foot) != (self._strip, self._foot):
            self._make_room(strip, foot, look)

        self._caption.input = caption
        self._caption.prop.color = ink
        room_px = 0.98 * width * (right - left)
        self._caption.prop.font_size = fitting_font(caption, room_px, self.font_px)
        explained = rows, ink, bar
        if self._explained != explained:
            self._explained = explained
            self._explain(rows, ink, bar, height)

    def _make_room(self, strip: float, foot: float, look: Look) -> None:
        """Give legend and caption their shares of the picture. The camera moves so that the clouds still fit."""
        camera = self._views[0].camera
        left, _, right, _ = self._area
        whole = right - left
        grows = (whole - self._strip) / (whole - strip)
        self._foot = foot
        self._divide(strip, overlaid=look.overlaid)
        camera.Dolly(1.0 / grows)
        camera.parallel_scale *= grows

    def _explain(
        self, rows: Sequence[tuple[str, str]], ink: str, bar: Scale | None, height: int
    ) -> None:
        """Draw rows of colour and text, and a scale, in the legend's strip. ``height``: its height [px]."""
        place = CORNER if bar is None else (CORNER[0], BAR_BOTTOM - 0.05)
        actors = []
        for k, (colour, text) in enumerate(rows):
            # all rows start at one corner, after line breaks: their distance does not depend on the picture's size
            breaks = "\n" * k
            if colour:
                actors.append(text_actor(breaks + MARK, colour, place, self.font_px))
                text = "     " + text
            actors.append(text_actor(breaks + text, ink, place, self.font_px))
        if bar is not None:
            actors += bar_actors(bar, ink, height, self.font_px)

        legend = self.plotter.renderers[2]
        legend.clear_actors()
        for actor in actors:
            legend.add_actor(actor, render=False, pickable=False, reset_camera=False)

    def _divide(self, strip: float, *, overlaid: bool) -> None:
        """Divide the scene's part of the picture into the legend's strip, a share of the width, and the clouds."""
        self._strip = strip
        self._overlaid = overlaid
        left, right, legend, foot, *_ = self.plotter.renderers
        first, bottom, last, top = self._area
        start = first + strip
        low = bottom + self._foot
        middle = (last + start) / 2.0
        place_renderer(legend, (first, low, start, top), shown=strip > 0.0)
        place_renderer(foot, (first, bottom, last, low), shown=self._foot > 0.0)
        place_renderer(left, (start, low, last if overlaid else middle, top), shown=True)
        place_renderer(right, (middle, low, last, top), shown=not overlaid)
