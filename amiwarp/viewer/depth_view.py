"""A depth map in the window: its image, its points in space, and the scale of both."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from amiwarp.plotting.colours import Scale, depth_image
from amiwarp.results.depth_map import DepthMap
from amiwarp.viewer.legend_actors import CORNER, bar_actors
from amiwarp.viewer.look import BACKGROUND_AND_INK
from amiwarp.viewer.texts import FONT_PX, VTK_FONT_FILE, font, text_actor

if TYPE_CHECKING:
    import pyvista


TITLE_SHARE = 0.4
"""Place of the titles, as a share of the width of a renderer."""
POINT_PX = 3.0
"""Size of the points [px]."""
VIEW_FROM = (0.6, -1.0, 0.5)
"""Direction from which the points are seen: from the right, above and in front of the camera that saw them."""
ZOOM = 0.8
"""Zoom to the points, which leaves place for the labels of the axes."""


def draw_depth(
    plotter: pyvista.Plotter, first: int, depth: DepthMap, font_px: int = FONT_PX
) -> None:
    """Draw a depth map in three renderers, from number ``first`` on: colour bar, image, and its points in space.

    The background is light, as the dark colours of far points need it. The plotter's renderers are in one row
    (:class:`amiwarp.viewer.scene.Scene`).
    """
    background, ink = BACKGROUND_AND_INK[False]
    image, cloud, scale = _image_and_points(depth)
    for renderer in list(plotter.renderers)[first : first + 3]:
        renderer.set_background(background)
    bar = plotter.renderers[first]
    bar_height = bar.GetSize()[1] or plotter.window_size[1]  # 0 before it is drawn
    for actor in bar_actors(scale, ink, bar_height, font_px):
        bar.add_actor(actor, render=False, pickable=False, reset_camera=False)
    _draw_mesh(plotter, first + 1, image, "depth map", ink, font_px)
    _draw_mesh(plotter, first + 2, cloud, "its points", ink, font_px)
    _label_axes(plotter, cloud, ink, font_px)
    plotter.view_vector(VIEW_FROM, (0.0, 0.0, 1.0), render=False)
    plotter.camera.zoom(ZOOM)
    plotter.subplot(0, first + 1)
    plotter.view_xy(render=False)
    plotter.enable_parallel_projection()


def _image_and_points(
    depth: DepthMap,
) -> tuple[pyvista.ImageData, pyvista.PolyData, Scale]:
    """Return the image of a depth map, its points in space, and the colour scale of both."""
    import pyvista

    metres, scale = depth_image(depth)
    height, width = metres.shape
    corners = (width + 1, height + 1, 1)
    image = pyvista.ImageData(dimensions=corners, origin=(-0.5, 0.5 - height, 0.0))
    image["colour"] = scale.rgb(metres[::-1]).reshape(-1, 3)
    known = depth.known & np.isfinite(depth.points).all(axis=2)
    x, y, z = depth.points[known].T
    cloud = pyvista.PolyData(np.column_stack([x, z, -y]))  # VTK's third axis points up
    cloud["colour"] = scale.rgb(metres[known])
    return image, cloud, scale


def _draw_mesh(
    plotter: pyvista.Plotter, number: int, mesh: Any, title: str, ink: str, font_px: int
) -> None:
    """Draw a mesh and its title in a renderer, which then is the current one."""
    plotter.subplot(0, number)
    if mesh.n_points:  # all known points may be at infinity
        plotter.add_mesh(
            mesh,
            scalars="colour",
            rgb=True,
            lighting=False,
            render=False,
            pickable=False,
            point_size=POINT_PX,
        )
    text = text_actor(title, ink, (TITLE_SHARE, CORNER[1]), font_px)
    plotter.renderers[number].add_actor(text, render=False, pickable=False, reset_camera=False)


def _label_axes(plotter: pyvista.Plotter, cloud: pyvista.PolyData, ink: str, font_px: int) -> None:
    """Draw axes around the points in the current renderer."""
    bounds = plotter.show_bounds(
        mesh=cloud,
        xtitle="x [m]",
        ytitle="depth [m]",
        ztitle="-y [m]",
        color=ink,
        location="outer",
        fmt="%.1f",
        n_xlabels=3,
        n_ylabels=3,
        n_zlabels=3,
        bold=False,
        font_size=font_px,
        use_3d_text=False,
        render=False,
    )
    for axis in range(3):
        for prop in (bounds.GetTitleTextProperty(axis), bounds.GetLabelTextProperty(axis)):
            prop.SetFontFamily(VTK_FONT_FILE)
            prop.SetFontFile(str(font()))
