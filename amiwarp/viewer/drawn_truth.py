"""Ground truth of the events that the inspector draws, read from the recording on first use."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from amiwarp.errors import AmiwarpError
from amiwarp.events.truth import Cause
from amiwarp.viewer.choices import Colour

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.events.recording import Truth
    from amiwarp.viewer.timeline import Span

STORES = {Colour.CAUSE: "stored_causes", Colour.INSTANCE: "stored_instances", Colour.DEPTH: "stored_depths"}
"""Attribute of :class:`amiwarp.Truth` that each colour choice based on ground truth shows."""


def colours_on_offer(truth: Truth | None) -> list[Colour]:
    """Return the colour choices that are possible for a recording with this ground truth."""
    return [c for c in Colour if c not in STORES or getattr(truth, STORES[c], None) is not None]


def truth_text(truth: Truth | None) -> str:
    """Return a one-line summary of the content of a ground truth; empty without ground truth."""
    if truth is None:
        return ""
    stores = {"point": truth.stored_points, **{c.value: getattr(truth, name) for c, name in STORES.items()},
              "place": truth.stored_places}  # fmt: skip
    per_event = ", ".join(name for name, store in stores.items() if store is not None)
    parts = [f"per event: {per_event}"] if per_event else ["prism"] if truth.parameters else []
    parts += [f"{len(truth.labels.instances)} instances"] if truth.labels is not None else []
    parts += [f"{len(truth.frames.t):,} instants"] if truth.frames is not None else []
    parts += [f"{len(truth.poses):,} poses"] if truth.poses is not None else []
    return "; ".join(parts)


@dataclass(frozen=True, eq=False)
class DrawnTruth:
    """Ground truth of the events that the inspector draws."""

    truth: Truth | None
    """Ground truth of the whole recording; None if the recording has none."""
    span: Span
    """Time span from which the drawn events are a selection."""
    positions: NDArray[np.int64]
    """Indices of the drawn events in ``span.events``, shape ``(n,)``."""
    _read: dict[Colour, NDArray[Any]] = field(default_factory=dict)

    def values(self, colour: Colour) -> NDArray[Any]:
        """Return the values of the drawn events that a colour shows, shape ``(n,)``.

        The values are codes of causes, instance numbers, or depths [m]. Raises :class:`AmiwarpError` if the recording
        does not hold this ground truth.
        """
        if colour not in self._read:
            store = getattr(self.truth, STORES[colour], None)
            if store is None:
                given = ", ".join(c.value for c in colours_on_offer(self.truth))
                raise AmiwarpError(
                    f"colour {colour.value!r} needs ground truth that the recording does not hold; choose among {given}"
                )
            self._read[colour] = self.span.rows(store)[self.positions]
        return self._read[colour]

    def name(self, colour: Colour, number: int) -> str:
        """Return the name of the cause with the code ``number``, or of the instance with this number."""
        if colour is Colour.CAUSE:
            return list(Cause)[number].value.replace("_", " ") if number < len(Cause) else f"cause {number}"
        labels = () if self.truth is None or self.truth.labels is None else self.truth.labels.instances
        return "sky" if number == 0 else labels[number - 1] if number <= len(labels) else f"instance {number}"

    def text(self, k: int) -> str:
        """Return the known ground truth of the drawn event ``k`` as text: cause, instance and depth."""
        known = [c for c in colours_on_offer(self.truth) if c in STORES]
        return "; ".join(
            f"depth {self.values(c)[k]:.3f} m" if c is Colour.DEPTH else f"{c.value} {self.name(c, self.values(c)[k])}"
            for c in known
        )
