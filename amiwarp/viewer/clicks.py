"""Detection of clicks on the event clouds, as opposed to drags that rotate the view."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

CLICK_PX = 3
"""Largest mouse movement between press and release that counts as a click [px]."""


class ClickDetector:
    """Observer of a VTK plotter that calls ``on_click(x, y)``.

    The position is given as shares of the picture's width and height from its top left.
    """

    def __init__(self, plotter: Any, on_click: Callable[[float, float], None]) -> None:
        self._plotter, self._on_click = plotter, on_click
        self._press: tuple[int, int] | None = None
        mouse = plotter.iren.interactor
        # the style grabs the mouse on a press, so only the style receives the release
        style = mouse.GetInteractorStyle()
        self._observers = [(mouse, mouse.AddObserver("LeftButtonPressEvent", self._pressed)),
                           (style, style.AddObserver("EndInteractionEvent", self._released))]  # fmt: skip

    def close(self) -> None:
        """Remove the observers from VTK. The garbage collector cannot see VTK's references to them."""
        for observed, tag in self._observers:
            observed.RemoveObserver(tag)

    def _pressed(self, interactor: Any, _event: str) -> None:
        self._press = interactor.GetEventPosition()

    def _released(self, style: Any, _event: str) -> None:
        press, self._press = self._press, None
        x, y = style.GetInteractor().GetEventPosition()
        if press is None or math.dist((x, y), press) > CLICK_PX:
            return
        width, height = self._plotter.window_size
        self._on_click(x / width, 1.0 - y / height)
