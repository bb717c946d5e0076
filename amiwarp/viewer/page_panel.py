"""What the parts of a panel, its downloads and its timeline, take of the panel."""

from __future__ import annotations

from contextlib import AbstractContextManager
from typing import Any, Protocol

from amiwarp.choices import View
from amiwarp.viewer.images import ShownImages
from amiwarp.viewer.inspector import Inspector
from amiwarp.viewer.job_progress import JobProgress
from amiwarp.viewer.knobs import Knobs
from amiwarp.viewer.look import Look
from amiwarp.viewer.page_work import PageWork
from amiwarp.viewer.shown_window import DisplayedWindow


class PagePanel(Protocol):
    """Panel of one browser tab, :class:`amiwarp.viewer.panel.Panel`, as its parts see it (protocol)."""

    server: Any
    """The trame server of the page."""
    state: Any
    """State variables of the page."""
    inspector: Inspector
    """What the page shows."""
    work: PageWork
    """Updates and jobs of the page."""
    progress: JobProgress
    """Progress of the latest calibration or film."""

    @property
    def look(self) -> Look:
        """Style of the clouds."""

    @property
    def view(self) -> View:
        """Direction from which the clouds are seen."""

    @property
    def against(self) -> Knobs | None:
        """Parameters that the left cloud and image show; None for the recorded events."""

    def say(self, text: str, severity: str = "info") -> None:
        """Show a message."""

    def errors_shown(self, what: str) -> AbstractContextManager[None]:
        """Show errors of the enclosed code as a message."""

    def show_progress(self, what: str, share: float) -> None:
        """Show the current step of a job, and the finished share, 0 to 1."""

    def make_images(
        self, shown: DisplayedWindow | None = None, inspector: Inspector | None = None
    ) -> ShownImages:
        """Return the images as the page has chosen them."""
