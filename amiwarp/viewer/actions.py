"""What page and window do alike: actions of keys and buttons, playback, bookmarks and history."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partialmethod
from typing import Any, Literal, Protocol, TypeAlias

from amiwarp.choices import Axis, View
from amiwarp.errors import AmiwarpError
from amiwarp.results.calibration import Calibration
from amiwarp.viewer.address import encode_state, load_bookmark
from amiwarp.viewer.bookmarks import Bookmarks
from amiwarp.viewer.images import DECAY_US, ImageKind
from amiwarp.viewer.inspector import Inspector
from amiwarp.viewer.knobs import Knobs
from amiwarp.viewer.layout import KEYS
from amiwarp.viewer.look import Look
from amiwarp.viewer.view_state import History, ViewState, current_state

Request: TypeAlias = Literal["window", "suggestion", "knobs", "state", "look", "newest"]
"""What an update shall renew: the events, the suggested values, what depends on the parameters, the state of the
history that was chosen, colours and layout, or the newest events of a live stream (page only)."""


class _RequestUpdates(Protocol):
    def __call__(self, *what: Request, change: str = "") -> None: ...


class Actions:
    """What page and window do alike: actions of keys and buttons, playback, and the history of what is shown."""

    keys: tuple[tuple[str, tuple[Any, ...], str], ...] = KEYS
    inspector: Inspector
    look: Look
    view: View
    time_window: tuple[int, int]
    """Start and length of the wanted time window on the events' clock [us]."""
    b: Knobs | None = None
    """Parameters that were kept as B, to compare with; None if none were kept."""
    calibration_result: Calibration | None = None
    """Result of a calibration that is not accepted yet."""
    history: History | None = None
    """States that can be undone and redone; None before anything is shown."""
    request: _RequestUpdates
    """Request updates, by their names. Successive ones with an equal ``change`` are undone in one step."""
    say: Callable[..., None]
    """Show a text as a message."""
    history_steps: tuple[Callable[[History], ViewState], ...] = ()
    """Steps through the history that are to be made after the changes which were requested before them."""
    bookmarks: Bookmarks | None = None
    """Named views of the recording; None if it is no file."""
    listener: Callable[[ViewState], None] | None = None
    """Called with what is shown after each update; None for nobody."""

    def released(self) -> None:
        """End a change that lasts, such as a drag."""

    @contextlib.contextmanager
    def errors_shown(self, what: str) -> Iterator[None]:
        """Show errors of the enclosed code as a message. ``what``: kind of the action."""
        try:
            yield
        except (AmiwarpError, OSError) as error:
            self.say(str(error))

    def knobs_taken(self) -> None:
        """Show parameters that the inspector has taken from elsewhere."""
        self.request("knobs")
        self.released()

    @property
    def against(self) -> Knobs | None:
        """Parameters that the first cloud shows; None for the recorded events."""
        return self.b

    @property
    def image(self) -> ImageKind:
        """What the images show."""
        return ImageKind.COUNT

    @property
    def decay_us(self) -> int:
        """Decay time of a decaying time surface [us]."""
        return DECAY_US

    @property
    def same_scale(self) -> bool:
        """Whether images of two recordings have one scale."""
        return False

    @property
    def difference(self) -> bool:
        """Whether the second image shows the difference of the two images."""
        return False

    @property
    def compensates(self) -> bool:
        """Whether the prism rotates, so that there is a motion to compensate."""
        return math.isfinite(self.inspector.turn_us)

    @property
    def whole_us(self) -> int:
        """Duration of the recording [us]."""
        source = self.inspector.recording.events
        return int(source.t_last - source.t_first + 1)

    def key(self, key: str) -> None:
        """Run the action of a key."""
        for known, (name, *given), _ in self.keys:
            if key == known:
                getattr(self, name)(*given)

    def suggest(self) -> None:
        """Show the region in which compensation gains most sharpness."""
        self.request("suggestion", "window")
        self.released()

    def toggle_axis(self) -> None:
        """Switch the third axis between angle and time."""
        self.restyle(axis=Axis.TIME if self.look.axis is Axis.ANGLE else Axis.ANGLE)

    def restyle(self, **changes: Any) -> None:
        """Change fields of the look."""
        self.look = replace(self.look, **changes)
        self.request("look")

    def choose_beside(self, k: int) -> None:
        """Show the recording with the number ``k`` of those that are on the same time axis."""
        others = self.inspector.besides
        if 0 <= k < len(others):
            self.inspector.beside = others[k]
            self.request("knobs")

    def take_truth(self) -> None:
        """Set the parameters to the known truth of a simulated recording."""
        with self.errors_shown("knobs"):
            self.inspector.take_truth()
        self.knobs_taken()

    def accept(self) -> None:
        """Set the parameters to the result of the calibration."""
        if self.calibration_result is not None:
            with self.errors_shown("knobs"):
                self.inspector.accept(self.calibration_result)
            self.discard()
            self.knobs_taken()

    def discard(self) -> None:
        """Forget the result of the calibration."""
        self.calibration_result = None

    # Time

    def step(self, count: int) -> None:
        """Move the time window ``count`` times by a turn, without a prism by its length, or by its number of events."""
        start_us, length_us = self.time_window
        if self.inspector.fixed_count is not None:
            self.move(self.inspector.start_after(count))
        elif self.compensates:
            self.move(start_us + count * round(self.inspector.turn_us))
        else:
            self.move(start_us + count * length_us)
        self.released()

    def move(self, start_us: int, change: str = "") -> bool:
        """Move the time window to a start within the recording. Return whether it is at the end.

        ``start_us``: start on the events' clock [us]. ``change``: name of a change that lasts, see :attr:`request`.
        """
        first = self.inspector.recording.events.t_first
        _, length_us = self.time_window
        last = first + max(0, self.whole_us - length_us)
        self.time_window = min(max(start_us, first), last), length_us
        self.request("window", change=change)
        return start_us >= last

    def newest_window(self) -> tuple[int, int]:
        """Return start and length of the window that ends with the last event [us]."""
        source = self.inspector.recording.events
        _, length_us = self.time_window
        if self.inspector.fixed_count is not None:  # it starts as early as it takes
            return int(source.t_last), length_us
        return int(source.t_first) + max(0, self.whole_us - length_us), length_us

    def can_play(self) -> bool:
        """Go back to the start from the end. Return whether there is something to play, or a live stream to follow."""
        start_us, length_us = self.time_window
        if self.inspector.latest is not None:
            return True
        if length_us >= self.whole_us:
            self.say("the window holds the whole recording; make it shorter to play")
            return False
        is_at_end = self.move(start_us)
        if is_at_end:
            self.move(self.inspector.recording.events.t_first)
        return True

    def advance(self, shown_us: float, *, loop: bool) -> bool:
        """Move the time window on by ``shown_us`` [us], once or in a loop. Return whether playing goes on."""
        start_us = self.time_window[0] + round(shown_us)
        is_at_end = self.move(start_us)
        if not is_at_end:
            return True
        self.move(self.inspector.recording.events.t_first if loop else start_us)
        return loop

    # Bookmarks

    def save_view(self, name: str) -> None:
        """Save what is shown as a bookmark."""
        if self.bookmarks is not None:
            with self.errors_shown("bookmark"):
                self.bookmarks.save(name, encode_state(self.state_now()))
                self.say(f"saved {name.strip()!r} in {self.bookmarks.path.name}")

    def open_view(self, name: str) -> None:
        """Show a bookmark."""
        if self.bookmarks is None:
            return
        with self.errors_shown("bookmark"):
            state, wrong = load_bookmark(self.bookmarks, name, self.inspector, self.state_now())
            self.travel(lambda _: state)
            if wrong:
                self.say("; ".join(wrong))

    # History

    def travel(self, step: Callable[[History], ViewState]) -> None:
        """Request the state that a step through the history gives."""
        self.history_steps = (*self.history_steps, step)
        self.request("state")
        self.released()

    undo = partialmethod(travel, History.undo)
    redo = partialmethod(travel, History.redo)
    reset = partialmethod(travel, History.reset)

    def travelled(self) -> ViewState | None:
        """Make the requested steps, and return the state to show; None to stay."""
        steps = self.history_steps
        self.history_steps = ()
        state = None
        if self.history is not None:
            for step in steps:
                state = step(self.history)
        return state

    def state_now(self) -> ViewState:
        """Return the state that is shown now."""
        look = self.look
        return current_state(
            self.inspector,
            against=self.against,
            image=self.image,
            axis=look.axis,
            colour=look.colour,
            view=self.view,
            overlaid=look.overlaid,
            decay_us=self.decay_us,
            same_scale=self.same_scale,
            difference=self.difference,
        )

    def announce(self) -> None:
        """Tell the listener what is shown now, unless steps through the history will change it at once."""
        if self.listener is not None and not self.history_steps:
            self.listener(self.state_now())

    def remember(self, change: str) -> History:
        """Add what is shown now to the history, and return it. Equal ``change`` of successive states make one step."""
        now = self.state_now()
        self.history = self.history or History(now)
        self.history.add(now, change)
        return self.history
