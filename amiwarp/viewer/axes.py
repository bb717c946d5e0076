"""Axes of an event cloud: its box, and numbers and titles at the outer edges, which follow the camera."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.plotting.colours import ticks
from amiwarp.plotting.meshes import Box
from amiwarp.viewer.texts import label_actor, on_paper, text_width

CORNERS = np.array(list(product((0, 1), repeat=3)))
"""The corners of a box, shape ``(8, 3)``: 0 for the lower end of an axis, 1 for the upper one."""
STEPS_TO_UPPER_END = (4, 2, 1)
"""How many corners later the other end of an edge along each axis follows."""
TICK_EM = 5.0
"""Smallest distance between two numbers of an axis, as a multiple of the font's size."""
GAP_EM = 0.5
"""Distance of the numbers from the edge of the box, and of the title from the numbers, in sizes of the font."""
SHORTEST_PX = 20.0
"""Length in the picture below which an edge of the box has no numbers: the camera looks along it [px]."""
FEWEST_TICKS = 4
MOST_TICKS = 6
"""Smallest and largest number of numbers on an axis, of which those that would lie on others are left out."""

_ticks = lru_cache(maxsize=64)(ticks)


@dataclass(frozen=True)
class Label:
    """A number or a title, and where its middle is in its renderer [px]."""

    text: str
    place: tuple[float, float]


def view_matrix(renderer: Any) -> NDArray[np.float64]:
    """Return the matrix from places in the scene to the renderer's coordinates from -1 to 1, shape ``(4, 4)``."""
    import pyvista

    aspect = renderer.GetTiledAspectRatio()
    camera = renderer.GetActiveCamera()
    matrix = camera.GetCompositeProjectionTransformMatrix(aspect, 0, 1)
    return np.asarray(pyvista.array_from_vtkmatrix(matrix))


def projected(
    points: NDArray[np.floating], matrix: NDArray[np.float64], size: Sequence[int]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return where points of the scene are in a renderer of a size [px], and their distances; shapes (n, 2) and (n,).

    The distance is 0 at the near end of what the camera sees, and negative behind the camera.
    """
    x, y, depth, w = matrix[:, :3] @ np.asarray(points, np.float64).T + matrix[:, 3:]
    from_middle = np.stack([x, y], axis=1) / w[:, None]  # from -1 to 1
    places = 0.5 * (from_middle + 1.0) * np.asarray(size)
    return places, np.where(w > 0.0, depth / w, -1.0)


def front_faces(camera: Any, ends: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which faces of a box the camera sees, shape ``(3, 2)``: of each axis the one at its lower and upper end.

    ``ends``: lower and upper end of the box on each axis, shape ``(3, 2)``.
    """
    if camera.GetParallelProjection():
        along = -np.asarray(camera.GetDirectionOfProjection())
        return np.stack([along < -1e-6, along > 1e-6], axis=1)
    position = np.asarray(camera.GetPosition())
    return np.stack([position < ends[:, 0], position > ends[:, 1]], axis=1)


def outer_edge(
    axis: int, corners: NDArray[np.float64], front: NDArray[np.bool_]
) -> tuple[int, int] | None:
    """Return the corners between which an axis is drawn: an edge at the outline, so that no point lies behind it.

    The first two axes take the lowest such edge, the third one takes the leftmost. Returns None if the camera looks
    along the axis. ``corners``: where the corners of the box are in the picture [px], in the order of :data:`CORNERS`.
    """
    one, other = (other_axis for other_axis in range(3) if other_axis != axis)
    # Of each edge at the outline: what decides first, and second, and its corners.
    found: list[tuple[float, float, int, int]] = []
    for start in np.flatnonzero(CORNERS[:, axis] == 0).tolist():
        end = start + STEPS_TO_UPPER_END[axis]
        one_seen = bool(front[one, CORNERS[start, one]])
        other_seen = bool(front[other, CORNERS[start, other]])
        is_at_outline = one_seen != other_seen
        if is_at_outline:
            x, y = 0.5 * (corners[start] + corners[end])
            found.append((x, y, start, end) if axis == 2 else (y, x, start, end))
    if not found:
        return None
    # Edges that are as low (as far left) within a pixel: of these, the leftmost (the lowest) one.
    lowest = min(found)[0]
    candidates = [edge for edge in found if edge[0] <= lowest + 1.0]
    _, _, start, end = min(candidates, key=lambda edge: edge[1])
    if math.dist(corners[start], corners[end]) < SHORTEST_PX:
        return None
    return start, end


def tick_texts(values: Sequence[float]) -> list[str]:
    """Return numbers as texts with as many decimals as their distance needs."""
    if len(values) < 2:
        return [f"{value:g}" for value in values]
    step = abs(values[1] - values[0])
    decimals = 0
    while decimals < 9 and abs(round(step, decimals) - step) >= 1e-6 * step:
        decimals += 1
    return [f"{value + 0.0:.{decimals}f}" for value in values]


def axis_labels(
    box: Box,
    titles: tuple[str, str, str],
    camera: Any,
    matrix: NDArray[np.float64],
    size: Sequence[int],
    font_px: int,
) -> list[Label]:
    """Return the labels of the three axes, outside of the box and without overlaps, for a renderer of a size [px].

    ``titles``: of the axes; ``matrix``: from the scene to the renderer.
    """
    ends = np.array(
        [(box.left, box.right), (-box.bottom, -box.top), (0.0, box.axis_height)], np.float64
    )
    in_scene = np.take_along_axis(ends.T, CORNERS, axis=0)
    corners, _ = projected(in_scene, matrix, size)
    front = front_faces(camera, ends)
    middle_of_box = corners.mean(axis=0)
    found: list[Label] = []
    numbers: list[Label] = []
    for axis, title in enumerate(titles):
        edge = outer_edge(axis, corners, front)
        if edge is None:
            continue
        first_corner, last_corner = edge
        start = corners[first_corner]
        end = corners[last_corner]
        length = math.dist(start, end)
        middle = 0.5 * (start + end)

        # The direction in the picture from the edge away from the box.
        away = np.array([end[1] - start[1], start[0] - end[0]]) / length
        if not away @ (middle - middle_of_box) > 0.0:
            away = -away

        most = int(min(max(length / (TICK_EM * font_px), FEWEST_TICKS), MOST_TICKS))
        values, along = _numbers_of(axis, box, most)
        scene = np.tile(in_scene[first_corner], (len(values), 1))
        scene[:, axis] = along
        places, _ = projected(scene, matrix, size)

        gap = GAP_EM * font_px
        texts = tick_texts(values.tolist())
        reaches = [_reach(text, away, font_px) for text in texts]
        for text, place, reach in zip(texts, places, reaches, strict=True):
            numbers.append(_label(text, place + away * (gap + reach)))
        # The title lies beyond the numbers.
        out = 2.0 * gap + 2.0 * max(reaches, default=0.0) + _reach(title, away, font_px)
        found.append(_label(title, middle + away * out))
    for label in numbers:  # a number that would lie on another one, as at a corner, is left out
        if not any(_overlap(label, other, font_px) for other in found):
            found.append(label)
    return found


def _numbers_of(axis: int, box: Box, most: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the numbers of an axis, at most about ``most``, and where they are along it in the scene."""
    if axis == 0:
        values = _ticks(float(box.left), float(box.right), most)
        return values, values
    if axis == 1:  # the image's y points down
        values = _ticks(float(box.top), float(box.bottom), most)
        return values, -values
    values = _ticks(float(box.low), float(box.high), most)
    return values, (values - box.low) * box.stretch


def _label(text: str, place: NDArray[np.float64]) -> Label:
    """Return a label whose middle is at a place [px]."""
    x, y = place.tolist()
    return Label(text, (x, y))


def _reach(text: str, away: NDArray[np.float64], font_px: int) -> float:
    """Return the distance from the middle of a text to its end in a direction [px]."""
    across = abs(away[0]) * text_width(text, font_px)
    up = abs(away[1]) * font_px
    return float(0.5 * (across + up))


def _overlap(one: Label, other: Label, font_px: int) -> bool:
    """Return whether two labels overlap, or nearly."""
    widths = text_width(one.text, font_px) + text_width(other.text, font_px)
    least_across = 0.5 * widths + 0.3 * font_px
    least_up = 1.1 * font_px
    across = abs(one.place[0] - other.place[0])
    up = abs(one.place[1] - other.place[1])
    return across < least_across and up < least_up


def _is_whole(label: Label, size: Sequence[int], font_px: int) -> bool:
    """Return whether a label is inside of a renderer of a size [px]."""
    x, y = label.place
    width, height = size
    half_width = 0.5 * text_width(label.text, font_px)
    half_height = 0.5 * font_px
    return half_width <= x <= width - half_width and half_height <= y <= height - half_height


class CloudAxes:
    """Labels of the axes of a renderer's cloud. They are placed anew before each drawing, as the camera may move."""

    def __init__(self, renderer: Any) -> None:
        self._renderer = renderer
        self._actors: list[Any] = []
        self._box = Box(0, 0, 1, 1, 0.0, 1.0)
        self._titles = ("", "", "")
        self._colours = ("white", "black")
        self._font_px = 12
        self._shown = False
        renderer.AddObserver("StartEvent", lambda *_: self._place())

    def label(
        self, box: Box, titles: tuple[str, str, str], colours: tuple[str, str], font_px: int
    ) -> None:
        """Label the axes of a box. ``titles``: of the axes; ``colours``: of the paper behind the labels, and of ink."""
        if (colours, font_px) != (self._colours, self._font_px):
            for actor in self._actors:
                self._renderer.RemoveActor(actor)
            self._actors = []
        self._box = box
        self._titles = titles
        self._colours = colours
        self._font_px = font_px
        self._shown = True

    def hide(self) -> None:
        """Show no labels."""
        self._shown = False

    def labels(self) -> list[Label]:
        """Return the labels as the camera is now, without those that the sides of the renderer would cut."""
        renderer = self._renderer
        if not (self._shown and renderer.GetDraw() and min(renderer.GetSize()) > 1):
            return []
        size = renderer.GetSize()
        camera = renderer.GetActiveCamera()
        matrix = view_matrix(renderer)
        found = axis_labels(self._box, self._titles, camera, matrix, size, self._font_px)
        return [label for label in found if _is_whole(label, size, self._font_px)]

    def _place(self) -> None:
        labels = self.labels()
        while len(self._actors) < len(labels):
            paper, ink = self._colours
            actor = label_actor(ink, self._font_px)
            on_paper(actor, paper)
            actor.SetPickable(False)
            self._renderer.AddActor(actor)
            self._actors.append(actor)
        for actor, label in zip(self._actors, labels, strict=False):
            actor.SetInput(label.text)
            actor.SetPosition(*label.place)
        for k, actor in enumerate(self._actors):
            actor.SetVisibility(k < len(labels))
