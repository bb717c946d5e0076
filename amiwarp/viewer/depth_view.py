"""A depth map in the window: its image, its points in space, and the scale of both."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from amiwarp.plotting.colours import depth_image
from amiwarp.results.depth_map import DepthMap
from amiwarp.viewer.legend_actors import CORNER, bar_actors
from amiwarp.viewer.look import BACKGROUND_AND_INK
from amiwarp.viewer.texts import FONT_PX, VTK_FONT_FILE, font, text_actor

if TYPE_CHECKING:
    import pyvista


def draw_depth(
    plotter: pyvista.Plotter, first: int, depth: DepthMap, font_px: int = FONT_PX
) -> None:
    """Draw a depth map in three renderers, from number ``first`` on: colour bar, image, and its points in space.

    The background is light, as the dark colours of far points need it.
    """
    import pyvista

    background, ink = BACKGROUND_AND_INK[False]
    metres, scale = depth_image(depth)
    height, width = metres.shape
    corners = (width + 1, height + 1, 1)
    image = pyvista.ImageData(dimensions=corners, origin=(-0.5, 0.5 - height, 0.0))
    image["colour"] = scale.rgb(metres[::-1]).reshape(-1, 3)
    known = depth.known & np.isfinite(depth.points).all(axis=2)
    x, y, z = depth.points[known].T
    cloud = pyvista.PolyData(np.column_stack([x, z, -y]))  # VTK's third axis points up
    cloud["colour"] = scale.rgb(metres[known])

    for renderer in list(plotter.renderers)[first : first + 3]:
        renderer.set_background(background)
    bar = plotter.renderers[first]
    bar_height = bar.GetSize()[1] or plotter.window_size[1]  # 0 before it is drawn
    for actor in bar_actors(scale, ink, bar_height, font_px):
        bar.add_actor(actor, render=False, pickable=False, reset_camera=False)
    for k, mesh, title in ((1, image, "depth map"), (2, cloud, "its points")):
        plotter.subplot(0, first + k)
        if mesh.n_points:  # all known points may be at infinity
            plotter.add_mesh(
                mesh,
                scalars="colour",
                rgb=True,
                lighting=False,
                render=False,
                pickable=False,
                point_size=3.0,
            )
        text = text_actor(title, ink, (0.4, CORNER[1]), font_px)
        plotter.renderers[first + k].add_actor(
            text, render=False, pickable=False, reset_camera=False
        )
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
    plotter.view_vector((0.6, -1.0, 0.5), (0.0, 0.0, 1.0), render=False)
    plotter.camera.zoom(0.8)
    plotter.subplot(0, first + 1)
    plotter.view_xy(render=False)
    plotter.enable_parallel_projection()
