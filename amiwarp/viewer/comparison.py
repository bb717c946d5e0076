"""Parameters that the left cloud and image of a page can show: those kept as B, calibrated ones and the known truth."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from amiwarp.viewer.panel import Panel
    from amiwarp.viewer.parameters import Knobs

AGAINST = {
    "recorded": "as recorded", "B": "compensated with B", "found": "compensated with the result",
    "truth": "compensated with the known truth",
}  # fmt: skip
"""What the left cloud and image can show: name, and title."""


RECORDED = "events as recorded"
"""Title of the only cloud, if there is no motion to compensate."""


class Comparison:
    """Comparison of the current parameters of a page (A) with others."""

    def __init__(self, panel: Panel) -> None:
        self._panel = panel
        self.b: Knobs | None = None
        """Parameters that were kept as B."""

    @property
    def choices(self) -> list[list[str]]:
        """Names and titles of what the left cloud can show now."""
        return [[name, title] for name, title in AGAINST.items() if name == "recorded" or self._knobs(name) is not None]

    @property
    def knobs(self) -> Knobs | None:
        """Parameters that the left cloud shows; None for the recorded events."""
        return self._knobs(self._panel.state.against)

    @property
    def title(self) -> str:
        """Title of the left cloud."""
        return AGAINST["recorded" if self.knobs is None else self._panel.state.against]

    def keep_b(self) -> None:
        """Keep the current parameters as B, and show them on the left."""
        self.show_b(self._panel.inspector.knobs)

    def swap_b(self) -> None:
        """Exchange the current parameters and B."""
        panel = self._panel
        if self.b is not None:
            now, knobs = panel.inspector.knobs, self.b
            with panel.errors_shown("knobs"):
                panel.inspector.set(knobs)
                self.show_b(now)
            panel.knobs_taken()

    def compare_found(self) -> None:
        """Show the result of the calibration on the left."""
        if self._panel.calibration_job.found is not None:
            self._panel.state.against = "found"
            self._panel.request("knobs")

    def show_b(self, knobs: Knobs | None) -> None:
        """Show parameters on the left as B; None for the recorded events."""
        self.b = knobs
        text = "" if knobs is None else (
            f"{knobs.model}, apex {math.degrees(knobs.apex):.4g}°, phase {math.degrees(knobs.phase):.4g}°"
        )  # fmt: skip
        against = "recorded" if knobs is None else "B"
        self._panel.state.update({"has_b": knobs is not None, "b_text": text, "against": against})
        self._panel.request("knobs")

    def _knobs(self, name: str) -> Knobs | None:
        inspector, found = self._panel.inspector, self._panel.calibration_job.found
        if name == "found":
            return None if found is None else inspector.knobs_of(found)
        return {"B": self.b, "truth": inspector.truth}.get(name)
