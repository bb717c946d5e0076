"""What the viewer asks of a live stream. The room of live streams has it; the viewer does not import that room."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Protocol, runtime_checkable

if TYPE_CHECKING:
    from amiwarp.events.recording import Recording


@runtime_checkable
class WatchedStream(Protocol):
    """Live stream that can be shown, measured and saved."""

    def __call__(self) -> Recording:
        """Return the latest events of at least one turn."""

    def record(self, path: Path) -> None:
        """Save what the stream delivers from now on to a new file."""

    @property
    def is_recording(self) -> bool:
        """Whether the stream is being saved."""

    def stop_recording(self) -> str:
        """Finish the recording, and return a text about it; empty if there is none."""

    def figures(self) -> tuple[list[list[str]], str]:
        """Return figures of this moment, as rows of name, value and "bad", and what is wrong; empty if nothing is."""
