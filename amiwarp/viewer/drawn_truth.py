"""Ground truth of the events that the inspector draws, read from the recording on first use."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.choices import Colour
from amiwarp.errors import AmiwarpError
from amiwarp.events.truth import Cause, Truth
from amiwarp.io.spans import Span

STORES = {
    Colour.CAUSE: "stored_causes",
    Colour.INSTANCE: "stored_instances",
    Colour.DEPTH: "stored_depths",
}
"""Attribute of :class:`amiwarp.Truth` that each colour choice based on ground truth shows."""


def colours_on_offer(truth: Truth | None) -> list[Colour]:
    """Return the colour choices that are possible for a recording with this ground truth."""
    return [
        colour
        for colour in Colour
        if colour not in STORES or getattr(truth, STORES[colour], None) is not None
    ]


def truth_text(truth: Truth | None) -> str:
    """Return a one-line summary of the content of a ground truth; empty without ground truth."""
    if truth is None:
        return ""
    stores = {
        "point": truth.stored_points,
        **{colour.value: getattr(truth, name) for colour, name in STORES.items()},
        "place": truth.stored_places,
    }
    per_event = ", ".join(name for name, store in stores.items() if store is not None)
    parts = []
    if per_event:
        parts.append(f"per event: {per_event}")
    elif truth.parameters:
        parts.append("prism")
    if truth.labels is not None:
        parts.append(f"{len(truth.labels.instances)} instances")
    if truth.frames is not None:
        parts.append(f"{len(truth.frames.t):,} instants")
    if truth.poses is not None:
        parts.append(f"{len(truth.poses):,} poses")
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
            if number >= len(Cause):  # a code of a later release
                return f"cause {number}"
            return list(Cause)[number].value.replace("_", " ")

        if number == 0:
            return "sky"
        labels: Sequence[str] = ()
        if self.truth is not None and self.truth.labels is not None:
            labels = self.truth.labels.instances
        if number > len(labels):
            return f"instance {number}"
        return labels[number - 1]

    def text(self, k: int) -> str:
        """Return the known ground truth of the drawn event ``k`` as text: cause, instance and depth."""
        parts = []
        for colour in colours_on_offer(self.truth):
            if colour not in STORES:
                continue
            value = self.values(colour)[k]
            if colour is Colour.DEPTH:
                parts.append(f"depth {value:.3f} m")
            else:
                parts.append(f"{colour.value} {self.name(colour, value)}")
        return "; ".join(parts)

    def every(self, step: int) -> DrawnTruth:
        """Return the ground truth of every ``step``-th event."""
        read = {colour: values[::step] for colour, values in self._read.items()}
        return replace(self, positions=self.positions[::step], _read=read)
