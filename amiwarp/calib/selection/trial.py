"""An exact answer on trial: the events that judge it, in two halves, and the space of what might be freed."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from amiwarp.calib.parameters import LATE
from amiwarp.calib.selection.smaller_models import QUANTISATION_PX, SHARE, Places, apart, rung_space, timing_blur
from amiwarp.calib.sharpness.curvature import STEP_PX
from amiwarp.calib.sharpness.held_out import Half, Quadratic, halves
from amiwarp.calib.sharpness.search import Material, Settings
from amiwarp.calib.single_model import moving_window
from amiwarp.calib.thinning import thin

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.calib.parameters import ParameterSpace
    from amiwarp.calib.result import Calibration
    from amiwarp.events.recording import Recording

    Vector = NDArray[np.float64]

SURE = 2.0
"""By so many standard deviations a bigger model, or a freed parameter, must win on held-out turns."""
FACTOR = 2.0
"""To which sharpness tells pixels: it counts an error where the edges are, and across them."""
BIAS_PX = 0.1
"""Sharpness prefers parameters that are off by about so much, so that motion which costs less says nothing."""
FARTHEST_PX = 3.0
"""A loss of sharpness is not converted to more motion than this: the curvature holds only near the optimum."""
ROOM = {"clock_offset": 20_000.0, "tilt_x": math.radians(15.0), "tilt_y": math.radians(15.0), "index": 0.4}
"""Half width of what is tried of each parameter that may be freed."""


@dataclass(frozen=True)
class Trial:
    """See :func:`make_trial`."""

    exact: Calibration
    material: Material
    places: Places
    rad_per_us: float
    duration_us: float
    budget_px: float
    timing_px: float
    train: Half
    test: Half
    """The turns that are held out."""
    space: ParameterSpace
    start: Vector
    """The answer of sharpness in the space [px]."""
    directions: Vector
    """Of the space, see :func:`apart`."""
    tried: tuple[str, ...]
    """Names of the directions: size, phase, and of the others those along which there is room for a difference."""
    bend: Quadratic
    """Sharpness of the exact model about the start along these, on the turns that are not held out."""

    @property
    def tells_px(self) -> float:
        """From where on held-out turns contradict a model that keeps the budget as predicted."""
        return max(FACTOR * self.budget_px, BIAS_PX)

    def rung(self, model: str, exact: Calibration) -> ParameterSpace:
        return rung_space(model, exact, (), rad_per_us=self.rad_per_us, duration_us=self.duration_us)

    def room(self, name: str) -> float:
        """Motion of events, past what size and phase can follow, within what is tried of a parameter [px rms]."""
        return _room(self.space, self.directions, name)

    def along(self, which: list[int], steps: Vector) -> Vector:
        """A shift of the space's vector from steps along tried directions."""
        rows = [self.directions[self.space.names.index(self.tried[k])] for k in which]
        return np.asarray(steps @ np.array(rows))

    def sharpest(self, which: list[int]) -> dict[str, float]:
        """Parameters of the sharpest exact model, some directions free, on the turns that are not held out."""
        return self.space.to_values(self.start + self.along(which, self.bend.of(which).top()))

    def seen(self, loss: Vector) -> tuple[float, float, tuple[float, float]]:
        """Mean of a loss of sharpness over disjoint parts, its deviation, and what motion [px rms] the two amount to.

        By the curvature; negative if it is a gain. At most :data:`FARTHEST_PX` either way, and both of these if
        sharpness is not curved.
        """
        mean, std = float(loss.mean()), float(loss.std(ddof=1)) / math.sqrt(len(loss))
        bend = self.bend.of([0, 1]).curvature
        if not bend > 0.0:
            return mean, std, (-FARTHEST_PX, FARTHEST_PX)
        low, high = (
            math.copysign(min(math.sqrt(2.0 * abs(x) / bend), FARTHEST_PX), x)
            for x in (mean - SURE * std, mean + SURE * std)
        )
        return mean, std, (low, high)


def in_pixels(px: float) -> str:
    """Motion in words: its size, or that it is beyond what sharpness can tell."""
    return f"{px:.3f} px" if px < FARTHEST_PX else f"more than {FARTHEST_PX:g} px"


def make_trial(
    recording: Recording,
    exact: Calibration,
    settings: Settings,
    names: tuple[str, ...],
    *,
    device: Any,
    budget_px: float | None,
) -> Trial:
    """Both halves of the events on the device, and the sharpness about the exact answer; ``names``: what to try."""
    events = thin(moving_window(recording, settings), settings.events)
    first, last = int(events.t[0]), int(events.t[-1])
    encoder = exact.encoder_for(recording.encoder, first, last)
    if not encoder.covers(first, last):  # a clock offset was found: the first or last events are before or after it
        events = events[slice(*np.searchsorted(events.t, encoder.coverage))]
        first, last = int(events.t[0]), int(events.t[-1])
    drifts = "clock_offset" in names
    material = Material(events, encoder, (lambda t: encoder.speed_at(t) * 1e-6) if drifts else None)
    duration = float(max(last - first, 1))
    speed = float(np.ptp(encoder.angle_at(events.t[[0, -1]]))) / duration
    places = Places.of(events, encoder)
    space = _with_room(rung_space("exact", by_sharpness(exact), names, rad_per_us=speed, duration_us=duration))
    train, test = (Half(half, material, space, device) for half in halves(material))
    start = space.to_vector(space.start)
    rows = apart(space, start, places)
    which = [k for k, n in enumerate(space.names) if _room(space, rows, n) >= STEP_PX]
    timing = timing_blur(exact.model, places, encoder, speed)
    budget = budget_px or SHARE * math.hypot(QUANTISATION_PX, timing)
    return Trial(
        exact, material, places, speed, duration, budget, timing, train, test, space, start, rows,
        tuple(space.names[k] for k in which), Quadratic.about(train, space, start, rows[which]),
    )  # fmt: skip


def by_sharpness(exact: Calibration) -> Calibration:
    """The answer of sharpness alone: the photometric one is not the sharpest."""
    p = exact.photometric
    if p is None or not p.accepted:
        return exact
    # what the photometric stage alone was asked for stays, and what of the camera's motion was dropped
    found = {n: x for n, x in p.sharpness_parameters.items() if n in exact.parameters and n not in LATE}
    return replace(exact, parameters={**exact.parameters, **found})


def _with_room(space: ParameterSpace) -> ParameterSpace:
    return replace(
        space,
        low={n: space.start[n] - ROOM[n] if n in ROOM else x for n, x in space.low.items()},
        high={n: space.start[n] + ROOM[n] if n in ROOM else x for n, x in space.high.items()},
    )


def _room(space: ParameterSpace, directions: Vector, name: str) -> float:
    k = space.names.index(name)
    return ROOM[name] * space.pixels[name] / abs(float(directions[k, k])) if name in ROOM else math.inf
