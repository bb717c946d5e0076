"""Mouse of the window: gives what it does to sliders, images, timeline, or to VTK, which moves the camera."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

CLICK_PX = 3.0
"""Distance up to which the mouse may move between press and release for a click [px]."""
NO_CLICK = (-99, -99)
"""Place of a press that cannot become a click."""
FIRST = 10.0
"""Priority of the observers, so that they come before VTK's."""


class Mouse:
    """Follows the mouse over a window. What is not for one of its parts goes on to VTK."""

    def __init__(self, window: Any) -> None:
        self._window = window
        self._sheets = window.sheets
        self.turned = False
        """Whether the camera may have moved since the last picture."""
        self.pressed = False
        """Whether a button is pressed."""
        self.drags = 0
        """Number of drags so far; changes of one drag are undone together."""
        self._held: Any = None  # the part that follows the mouse until the button is released
        self.turns = False
        """Whether the pressed button moves the camera."""
        self._from = 0, 0
        self._interactor = window.plotter.iren.interactor
        for event, follow in (
            ("LeftButtonPressEvent", self._press),
            ("LeftButtonReleaseEvent", self._release),
            ("MiddleButtonPressEvent", self._press_other),
            ("MiddleButtonReleaseEvent", self._release),
            ("RightButtonPressEvent", self._press_other),
            ("RightButtonReleaseEvent", self._release),
            ("MouseMoveEvent", self._move),
            ("MouseWheelForwardEvent", lambda place: self._wheel(place, 1)),
            ("MouseWheelBackwardEvent", lambda place: self._wheel(place, -1)),
        ):
            self._follow(event, follow)
        # from a press on the clouds until the release, VTK's style takes all events before others see them
        style = window.plotter.iren.style
        style.AddObserver("InteractionEvent", lambda *_: setattr(self, "turned", True))
        style.AddObserver(
            "EndInteractionEvent", lambda *_: self._release(self._interactor.GetEventPosition())
        )

    def _follow(self, event: str, follow: Callable[[tuple[int, int]], bool]) -> None:
        """Call a method with the place of the mouse at an event. If it returns True, VTK does not get the event."""

        def call(*_: Any) -> None:
            if follow(self._interactor.GetEventPosition()):
                self._interactor.GetCommand(tag).SetAbortFlag(1)

        tag = self._interactor.AddObserver(event, call, FIRST)

    def _on_help(self, place: tuple[int, int]) -> bool:
        return bool(self._window.help_shown and self._sheets.help.renderer.IsInViewport(*place))

    def _on_clouds(self, place: tuple[int, int]) -> bool:
        """Return whether a place is on clouds or the depth map, and not on the help over them."""
        shown = [*self._window.scene.views, *self._sheets.depth]
        return not self._on_help(place) and any(
            renderer.GetDraw() and renderer.IsInViewport(*place) for renderer in shown
        )

    def _press(self, place: tuple[int, int]) -> bool:
        self.pressed = True
        self._from = place
        sheets = self._sheets
        self.turns = self._on_clouds(place)
        if self.turns or self._on_help(place):
            return not self.turns
        if sheets.controls.press(place):
            self._held = sheets.controls
        elif sheets.images.press(place):
            self._held = sheets.images
        elif sheets.timeline.press(place, shift=bool(self._interactor.GetShiftKey())):
            self._held = sheets.timeline
        return True

    def _press_other(self, place: tuple[int, int]) -> bool:
        self.turns = self._on_clouds(place)
        self.pressed = self.turns
        self._from = NO_CLICK
        return not self.turns

    def _move(self, place: tuple[int, int]) -> bool:
        if self._held is not None:
            self._held.drag(place)
            self._window.sheets_changed()
        elif not self.turns and self._sheets.images.hover(place):
            self._window.sheets_changed()
        return self._held is not None

    def _release(self, place: tuple[int, int]) -> bool:
        held = self._held
        turned = self.turns
        self._held = None
        self.turns = False
        self.pressed = False
        self.drags += 1
        if held is not None:
            held.release()
        elif turned and math.dist(place, self._from) <= CLICK_PX:
            self._window.pick(place)
        self.turned = self.turned or turned
        return not turned

    def _wheel(self, place: tuple[int, int], steps: int) -> bool:
        if self._on_clouds(place):
            self.turned = True
            return False
        if not self._on_help(place) and not self._sheets.controls.wheel(place, steps):
            self._sheets.timeline.wheel(place, steps)
            self._window.sheets_changed()
        return True
