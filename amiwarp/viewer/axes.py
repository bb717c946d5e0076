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
TICK_EM = 5.0
"""Smallest distance between two numbers of an axis, as a multiple of the font's size."""
GAP_EM = 0.5
"""Distance of the numbers from the edge of the box, and of the title from the numbers, in sizes of the font."""
SHORTEST_PX = 20.0
"""Length in the picture below which an edge of the box has no numbers: the camera looks along it [px]."""
FEWEST_TICKS, MOST_TICKS = 4, 6
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
    return np.asarray(
        pyvista.array_from_vtkmatrix(renderer.GetActiveCamera().GetCompositeProjectionTransformMatrix(aspect, 0, 1))
    )


def projected(
    points: NDArray[np.floating], matrix: NDArray[np.float64], size: Sequence[int]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return where points of the scene are in a renderer of a size [px], and their distances; shapes (n, 2) and (n,).

    The distance is 0 at the near end of what the camera sees, and negative behind the camera.
    """
    x, y, depth, w = matrix[:, :3] @ np.asarray(points, np.float64).T + matrix[:, 3:]
    places = 0.5 * (np.stack([x, y], axis=1) / w[:, None] + 1.0) * np.asarray(size)
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


def outer_edge(axis: int, corners: NDArray[np.float64], front: NDArray[np.bool_]) -> tuple[int, int] | None:
    """Return the corners between which an axis is drawn: an edge at the outline, so that no point lies behind it.

    The first two axes take the lowest such edge, the third one takes the leftmost. Returns None if the camera looks
    along the axis. ``corners``: where the corners of the box are in the picture [px], in the order of :data:`CORNERS`.
    """
    one, other = (each for each in range(3) if each != axis)
    found: list[tuple[float, float, int, int]] = []
    for start in np.flatnonzero(CORNERS[:, axis] == 0).tolist():
        seen = [bool(front[each, CORNERS[start, each]]) for each in (one, other)]
        end = start + (4, 2, 1)[axis]
        if seen[0] != seen[1]:  # between a face that is seen and one that is not
            x, y = 0.5 * (corners[start] + corners[end])
            found.append((x, y, start, end) if axis == 2 else (y, x, start, end))
    if not found:
        return None
    lowest = min(found)[0]
    _, _, start, end = min((each for each in found if each[0] <= lowest + 1.0), key=lambda each: each[1])
    return None if math.dist(corners[start], corners[end]) < SHORTEST_PX else (start, end)


def tick_texts(values: Sequence[float]) -> list[str]:
    """Return numbers as texts with as many decimals as their distance needs."""
    if len(values) < 2:
        return [f"{value:g}" for value in values]
    step = abs(values[1] - values[0])
    decimals = next((k for k in range(9) if abs(round(step, k) - step) < 1e-6 * step), 9)
    return [f"{value + 0.0:.{decimals}f}" for value in values]


def axis_labels(
    box: Box, titles: tuple[str, str, str], camera: Any, matrix: NDArray[np.float64], size: Sequence[int], font_px: int
) -> list[Label]:
    """Return the labels of the three axes, outside of the box and without overlaps, for a renderer of a size [px].

    ``titles``: of the axes; ``matrix``: from the scene to the renderer.
    """
    ends = np.array([(box.left, box.right), (-box.bottom, -box.top), (0.0, box.axis_height)], np.float64)
    in_scene = np.take_along_axis(ends.T, CORNERS, axis=0)
    corners, _ = projected(in_scene, matrix, size)
    front, middle = front_faces(camera, ends), corners.mean(axis=0)
    found: list[Label] = []
    numbers: list[Label] = []
    for axis, title in enumerate(titles):
        edge = outer_edge(axis, corners, front)
        if edge is None:
            continue
        start, end = corners[edge[0]], corners[edge[1]]
        length = math.dist(start, end)
        away = np.array([end[1] - start[1], start[0] - end[0]]) / length
        away = away if away @ (0.5 * (start + end) - middle) > 0.0 else -away
        low, high = ((box.left, box.right), (box.top, box.bottom), (box.low, box.high))[axis]
        most = int(min(max(length / (TICK_EM * font_px), FEWEST_TICKS), MOST_TICKS))
        values = _ticks(float(low), float(high), most)
        scene = np.tile(in_scene[edge[0]], (len(values), 1))
        scene[:, axis] = (values, -values, (values - box.low) * box.stretch)[axis]
        places, _ = projected(scene, matrix, size)
        texts = tick_texts(values.tolist())
        reach = max((_reach(text, away, font_px) for text in texts), default=0.0)
        for text, place in zip(texts, places, strict=True):
            x, y = place + away * (GAP_EM * font_px + _reach(text, away, font_px))
            numbers.append(Label(text, (float(x), float(y))))
        out = 2.0 * GAP_EM * font_px + 2.0 * reach + _reach(title, away, font_px)
        x, y = 0.5 * (start + end) + away * out
        found.append(Label(title, (float(x), float(y))))
    for label in numbers:  # a number that would lie on another one, as at a corner, is left out
        if not any(_overlap(label, other, font_px) for other in found):
            found.append(label)
    return found


def _reach(text: str, away: NDArray[np.float64], font_px: int) -> float:
    """Return the distance from the middle of a text to its end in a direction [px]."""
    return float(0.5 * (abs(away[0]) * text_width(text, font_px) + abs(away[1]) * font_px))


def _overlap(one: Label, other: Label, font_px: int) -> bool:
    wide = 0.5 * (text_width(one.text, font_px) + text_width(other.text, font_px)) + 0.3 * font_px
    return abs(one.place[0] - other.place[0]) < wide and abs(one.place[1] - other.place[1]) < 1.1 * font_px


def _is_whole(label: Label, size: Sequence[int], font_px: int) -> bool:
    """Return whether a label is inside of a renderer of a size [px]."""
    half = 0.5 * text_width(label.text, font_px), 0.5 * font_px
    return all(reach <= at <= end - reach for at, reach, end in zip(label.place, half, size, strict=True))


class CloudAxes:
    """Labels of the axes of a renderer's cloud. They are placed anew before each drawing, as the camera may move."""

    def __init__(self, renderer: Any) -> None:
        self._renderer = renderer
        self._actors: list[Any] = []
        self._box, self._titles = Box(0, 0, 1, 1, 0.0, 1.0), ("", "", "")
        self._colours, self._font_px = ("white", "black"), 12
        self._shown = False
        renderer.AddObserver("StartEvent", lambda *_: self._place())

    def label(self, box: Box, titles: tuple[str, str, str], colours: tuple[str, str], font_px: int) -> None:
        """Label the axes of a box. ``titles``: of the axes; ``colours``: of the paper behind the labels, and of ink."""
        if (colours, font_px) != (self._colours, self._font_px):
            for actor in self._actors:
                self._renderer.RemoveActor(actor)
            self._actors = []
        self._box, self._titles, self._colours, self._font_px, self._shown = box, titles, colours, font_px, True

    def hide(self) -> None:
        """Show no labels."""
        self._shown = False

    def labels(self) -> list[Label]:
        """Return the labels as the camera is now, without those that the sides of the renderer would cut."""
        renderer = self._renderer
        if not (self._shown and renderer.GetDraw() and min(renderer.GetSize()) > 1):
            return []
        size = renderer.GetSize()
        camera, matrix = renderer.GetActiveCamera(), view_matrix(renderer)
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
