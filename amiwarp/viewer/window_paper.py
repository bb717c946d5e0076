"""Paper of the window: a part of it on which texts, lines, areas and pictures are drawn in pixels, with one font."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.viewer.texts import VTK_FONT_FILE, font
from amiwarp.viewer.window_layout import NOWHERE, Rect

JUSTIFY = {"left": 0, "center": 1, "right": 2, "bottom": 0, "middle": 1, "top": 2}
"""Names of the sides of a text that are at its place, as VTK numbers them."""
GAP = (math.nan, math.nan)
"""Point of a line at which it has a gap."""
QUAD = np.array([[0, 1, 2, 3]])
"""Points of an area."""
UNDER, PICTURES, LINES, OVER, TEXTS = range(5)
"""Layers, from the lowest one: areas, pictures, lines, areas over them such as handles, and texts."""


class Paper:
    """A part of the window that is drawn anew from an empty one: :meth:`clear`, then its contents, then :meth:`end`.

    All places are pixels of the window from its left and lower side. The actors of the drawing before are used again.
    """

    def __init__(self, renderer: Any) -> None:
        self.renderer = renderer
        self._actors: dict[int, list[Any]] = {
            layer: [] for layer in (UNDER, PICTURES, LINES, OVER, TEXTS)
        }
        self._used = dict.fromkeys(self._actors, 0)
        self._rect = NOWHERE
        self.font_px = 12
        self.ink = "black"
        self._grown = False
        self._pictures: dict[Any, NDArray[np.uint8]] = {}

    def clear(
        self, rect: Rect, size: tuple[int, int], font_px: int, colours: tuple[str, str]
    ) -> None:
        """Begin a new drawing in a part of a window of a size [px]. ``colours``: of the paper and of the ink."""
        self._rect = rect
        self.font_px = font_px
        background, self.ink = colours
        self.renderer.SetDraw(True)
        self.renderer.SetViewport(*rect.shares(size))
        self.renderer.set_background(background)
        self._used = dict.fromkeys(self._used, 0)

    def hide(self) -> None:
        """Draw nothing. An empty place keeps the mouse away, too."""
        self.renderer.SetDraw(False)
        self.renderer.SetViewport(0.0, 0.0, 0.0, 0.0)

    def end(self) -> None:
        """End the drawing."""
        for layer, actors in self._actors.items():
            for k, actor in enumerate(actors):
                actor.SetVisibility(k < self._used[layer])
        if self._grown:  # VTK draws the actors in the order in which they were added
            self._grown = False
            for actors in self._actors.values():
                for actor in actors:
                    self.renderer.RemoveViewProp(actor)
                    self.renderer.AddViewProp(actor)

    def text(
        self,
        text: str,
        x: float,
        y: float,
        *,
        colour: str = "",
        across: str = "left",
        up: str = "middle",
        font_px: int = 0,
        upwards: bool = False,
    ) -> None:
        """Write a text. ``across`` and ``up``: which of its sides are at the place; ``font_px``: another size [px].

        ``upwards``: turned by a quarter to the left, as are its sides.
        """
        actor = self._next(TEXTS, _text_actor)
        prop = actor.GetTextProperty()
        prop.SetColor(_rgb(colour or self.ink))
        prop.SetFontSize(font_px or self.font_px)
        prop.SetOrientation(90.0 if upwards else 0.0)
        prop.SetJustification(JUSTIFY[across])
        prop.SetVerticalJustification(JUSTIFY[up])
        actor.SetInput(text)
        actor.SetPosition(round(x - self._rect.left), round(y - self._rect.low))

    def line(
        self,
        points: NDArray[np.floating] | Sequence[tuple[float, float]],
        colour: str = "",
        width: float = 1.0,
    ) -> None:
        """Draw a line through points, shape ``(n, 2)``. It has gaps where they are NaN."""
        xy = np.asarray(points, np.float64).reshape(-1, 2)
        known = np.isfinite(xy[:, 0]) & np.isfinite(xy[:, 1])
        first = np.flatnonzero(known[:-1] & known[1:])
        pairs = np.stack([first, first + 1], axis=1)
        here = self._here(np.where(known[:, None], xy, 0.0))
        self._draw(LINES, _mesh(here, pairs, areas=False), colour, width)

    def area(self, rect: Rect, colour: str = "", opacity: float = 1.0, layer: int = UNDER) -> None:
        """Fill a rectangle."""
        self._draw(layer, _mesh(self._here(_corners(rect)), QUAD, areas=True), colour, 1.0, opacity)

    def frame(self, rect: Rect, colour: str = "", width: float = 1.0) -> None:
        """Draw the sides of a rectangle."""
        corners = _corners(rect)
        self.line(np.concatenate([corners, corners[:1]]), colour, width)

    def picture(self, rgb: NDArray[np.uint8], rect: Rect) -> None:
        """Draw an image with sharp pixels into a rectangle. ``rgb``: shape ``(height, width, 3)``, from its top on."""
        import pyvista

        actor = self._next(PICTURES, _picture_actor)
        if self._pictures.get(actor) is not rgb:  # else the card has it already
            height, width, _ = rgb.shape
            image = pyvista.ImageData(dimensions=(width, height, 1))
            image["rgb"] = np.ascontiguousarray(rgb[::-1]).reshape(-1, 3)
            image.set_active_scalars("rgb")
            actor.GetTexture().SetInputDataObject(image)
            self._pictures[actor] = rgb
        mesh = _mesh(self._here(_corners(rect)), QUAD, areas=True)
        corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
        mesh.GetPointData().SetTCoords(pyvista.convert_array(corners, deep=True))
        actor.GetMapper().SetInputData(mesh)

    def _draw(self, layer: int, mesh: Any, colour: str, width: float, opacity: float = 1.0) -> None:
        actor = self._next(layer, _mesh_actor)
        actor.GetMapper().SetInputData(mesh)
        prop = actor.GetProperty()
        prop.SetColor(_rgb(colour or self.ink))
        prop.SetLineWidth(width)
        prop.SetOpacity(opacity)

    def _here(self, xy: NDArray[np.float64]) -> NDArray[np.float32]:
        """Return places of the window as points of the renderer, shape ``(n, 3)``."""
        here = xy - (self._rect.left, self._rect.low)
        return np.column_stack([here, np.zeros(len(here))]).astype(np.float32)

    def _next(self, layer: int, make: Any) -> Any:
        """Return an actor of a layer that is not used yet in this drawing."""
        actors = self._actors[layer]
        k = self._used[layer]
        if k == len(actors):
            actors.append(make())
            self._grown = True
        self._used[layer] += 1
        return actors[k]


def _mesh(points: NDArray[np.float32], cells: NDArray[np.int64], *, areas: bool) -> Any:
    """Return a mesh of lines or areas, much faster than with PyVista. ``cells``: points of each, shape ``(n, k)``."""
    from vtkmodules.util import numpy_support
    from vtkmodules.vtkCommonCore import vtkPoints
    from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkPolyData

    vtk: Any = numpy_support  # which has no types
    mesh = vtkPolyData()
    places = vtkPoints()
    numbers = vtkCellArray()
    places.SetData(vtk.numpy_to_vtk(points, deep=True))
    count, length = cells.shape
    numbers.SetData(
        vtk.numpy_to_vtkIdTypeArray(np.arange(0, length * count + 1, length), deep=True),
        vtk.numpy_to_vtkIdTypeArray(np.ascontiguousarray(cells, np.int64).ravel(), deep=True),
    )
    mesh.SetPoints(places)
    if areas:
        mesh.SetPolys(numbers)
    else:
        mesh.SetLines(numbers)
    return mesh


def _corners(rect: Rect) -> NDArray[np.float64]:
    return np.array(
        [
            (rect.left, rect.low),
            (rect.right, rect.low),
            (rect.right, rect.top),
            (rect.left, rect.top),
        ]
    )


def _rgb(colour: str) -> tuple[float, float, float]:
    import pyvista

    rgb: tuple[float, float, float] = pyvista.Color(colour).float_rgb
    return rgb


def _text_actor() -> Any:
    from vtkmodules.vtkRenderingCore import vtkTextActor, vtkTextProperty

    actor = vtkTextActor()
    prop = vtkTextProperty()
    prop.SetFontFamily(VTK_FONT_FILE)
    prop.SetFontFile(str(font()))
    actor.SetTextProperty(prop)
    actor.GetPositionCoordinate().SetCoordinateSystemToViewport()
    return actor


def _mesh_actor() -> Any:
    from vtkmodules.vtkRenderingCore import vtkActor2D, vtkPolyDataMapper2D

    actor = vtkActor2D()
    actor.SetMapper(vtkPolyDataMapper2D())
    return actor


def _picture_actor() -> Any:
    from vtkmodules.vtkRenderingCore import vtkPolyDataMapper2D, vtkTexture, vtkTexturedActor2D

    actor = vtkTexturedActor2D()
    texture = vtkTexture()
    texture.InterpolateOff()
    texture.SetColorModeToDirectScalars()
    actor.SetTexture(texture)
    actor.SetMapper(vtkPolyDataMapper2D())
    return actor
