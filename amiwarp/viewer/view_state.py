"""State of the inspector's page: what it shows, with which parameters, and its history."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from amiwarp.choices import Axis, Colour, View
from amiwarp.errors import AmiwarpError
from amiwarp.viewer.filters import Selection
from amiwarp.viewer.images import DECAY_US, ImageKind
from amiwarp.viewer.inspector import Inspector
from amiwarp.viewer.knobs import Knobs, Source
from amiwarp.viewer.sliders import given_fields

LONGEST_HISTORY = 200
"""Largest number of states that can be undone."""


@dataclass(frozen=True)
class ViewState:
    """What the page shows. The page shows nothing that does not follow from it and the recording."""

    start_us: int
    """Start of the time window after the first event [us]."""
    length_us: int
    """Length of the time window [us]."""
    selection: Selection
    """Conditions for the shown events."""
    knobs: Knobs
    """Parameters of the prism."""
    sources: tuple[tuple[str, Source], ...]
    """Where the value of each parameter comes from, by name."""
    against: Knobs | None = None
    """Parameters to compare with; None to compare with the recorded events."""
    image: ImageKind = ImageKind.COUNT
    """What the images show."""
    colour: Colour = Colour.POLARITY
    """What the colour of the points shows."""
    axis: Axis = Axis.ANGLE
    """Third axis of the clouds."""
    view: View = View.FREE
    """Direction from which the clouds are seen."""
    overlaid: bool = False
    """Whether both clouds are in one frame."""
    fov_deg: float | None = None
    """Horizontal field of view [deg]; None if the recording holds its camera."""
    prism_index: float | None = None
    """Refractive index; None if the recording holds its prism."""
    fixed_count: int | None = None
    """Number of events by which the time window was set, and which it keeps when it moves; None: it keeps its length.
    """
    decay_us: int = DECAY_US
    """Decay time of a decaying time surface [us]."""
    same_scale: bool = False
    """Whether images of two recordings have one scale."""
    difference: bool = False
    """Whether the second image shows the difference of the two images."""


def current_state(inspector: Inspector, **look: Any) -> ViewState:
    """Return the state of an inspector, with the default look but for the given fields."""
    start_us, length_us = inspector.window or inspector.first_window()
    first = inspector.recording.events.t_first
    axis = Axis.ANGLE if math.isfinite(inspector.turn_us) else Axis.TIME
    given = {field["name"]: field["value"] for field in given_fields(inspector)}
    fields = {"axis": axis, "fixed_count": inspector.fixed_count, **given, **look}
    return ViewState(
        start_us=start_us - first,
        length_us=length_us,
        selection=inspector.selection,
        knobs=inspector.knobs,
        sources=tuple(inspector.sources.items()),
        **fields,
    )


def apply_state(inspector: Inspector, state: ViewState) -> None:
    """Set window, selection and parameters of an inspector.

    Raises :class:`AmiwarpError`, and changes nothing, if no events meet the state's window and selection.
    """
    window = state.start_us + inspector.recording.events.t_first, state.length_us
    shown_count = inspector.fixed_count
    shown = inspector.window, inspector.selection, shown_count
    if (window, state.selection, state.fixed_count) != shown:
        inspector.fixed_count = state.fixed_count
        try:
            inspector.open(*window, state.selection)
        except AmiwarpError:
            inspector.fixed_count = shown_count
            raise
    set_given(inspector, state.fov_deg, state.prism_index)
    inspector.set(state.knobs)
    held = {name for name in ("camera", "prism") if inspector.sources[name] is Source.FILE}
    inspector.sources = dict(state.sources) | dict.fromkeys(held, Source.FILE)


def set_given(inspector: Inspector, fov_deg: float | None, index: float | None) -> None:
    """Set the camera and the prism's index by hand where they differ from the inspector's; None keeps them."""
    if fov_deg is not None and fov_deg != inspector.fov_deg:
        inspector.set_camera(fov_deg)
    if index is not None and index != round(inspector.prism.index, 4):
        inspector.set_index(index)


class History:
    """States that can be undone and redone, from the first one on."""

    def __init__(self, first: ViewState) -> None:
        self.first = first
        self._states = [first]
        self._at = 0
        self._change = ""

    @property
    def state(self) -> ViewState:
        """The current state."""
        return self._states[self._at]

    @property
    def can_undo(self) -> bool:
        """Whether there is a state before the current one."""
        return self._at > 0

    @property
    def can_redo(self) -> bool:
        """Whether a state was undone."""
        return self._at + 1 < len(self._states)

    def add(self, state: ViewState, change: str = "") -> None:
        """Add a state after the current one. States that were undone are dropped.

        ``change``: what has changed, such as the name of a slider. Successive changes of the same name count as one;
        an empty name always counts as a new change.
        """
        if state == self.state:
            return
        same = bool(change) and change == self._change and self.can_undo and not self.can_redo
        kept = self._at if same else self._at + 1
        self._states = [*self._states[:kept], state][-LONGEST_HISTORY:]
        self._at = len(self._states) - 1
        self._change = change

    def undo(self) -> ViewState:
        """Go back by one state if possible, and return the current one."""
        self._at = max(self._at - 1, 0)
        self._change = ""
        return self.state

    def redo(self) -> ViewState:
        """Go forward by one state if possible, and return the current one."""
        self._at = min(self._at + 1, len(self._states) - 1)
        self._change = ""
        return self.state

    def reset(self) -> ViewState:
        """Add the first state again, and return it."""
        self.add(self.first)
        return self.first
