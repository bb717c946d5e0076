"""Groundwork of the choice of a model: what it needs of the sharpness stage's answer.

The photometric stage may still run then.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, cast

import numpy as np

from amiwarp.calib.parameters import DEGENERATE_WITH_APEX, DRIFTS
from amiwarp.calib.preparation import rotation_window
from amiwarp.calib.selection.smaller_models import (
    LinearMotion,
    Places,
    candidate_space,
    encoder_noise,
    fit,
    independent_directions,
    linear_motions,
    scales,
)
from amiwarp.calib.sharpness.curvature import STEP_PX
from amiwarp.calib.thinning import thin
from amiwarp.events.events import MemoryEvents

if TYPE_CHECKING:
    from collections.abc import Generator

    from numpy.typing import NDArray

    from amiwarp.calib.parameters import ParameterSpace
    from amiwarp.calib.result import Calibration
    from amiwarp.calib.sharpness.search import Settings
    from amiwarp.calib.summaries import PhotometricSummary
    from amiwarp.events.encoder import Encoder
    from amiwarp.events.events import Events
    from amiwarp.events.recording import Recording

    Vector = NDArray[np.float64]

SEARCH_RANGE = {"clock_offset": 20_000.0, "tilt_x": math.radians(15.0), "tilt_y": math.radians(15.0), "index": 0.4}
"""Half width of the tested range of each parameter that might be freed, in its unit (us, rad, 1)."""
CIRCLES = ("circle", "radial")
"""Models that are fitted to the exact one."""
TILT = ("tilt_x", "tilt_y")
"""Parameters of the direction of the prism's axis."""


@dataclass(frozen=True, kw_only=True)
class Groundwork:
    """Events at which models are compared, and how the parameters of the models move them."""

    answer: Calibration
    """Calibration of the exact model with the sharpness stage's parameters."""
    encoder: Encoder
    """Encoder that gives the prism angles of the events, with the calibrated clock offset."""
    encoder_noise: float
    """Standard deviation of the encoder's angle noise [rad]."""
    events: Events
    """Events of the recording: all that are in memory, or a part of those in a file."""
    most_events: int
    """Largest number of events on which sharpness is measured."""
    sample: Places
    """Evenly thinned events at which the displacements of models are compared."""
    rad_per_us: float
    """Mean speed of the prism [rad/us]."""
    duration_us: float
    """Duration of the events [us]."""
    space: ParameterSpace
    """Parameter space of the exact model in which all parameters that might be freed are free."""
    circles: tuple[LinearMotion, ...]
    """Motion of the sample by each of the models :data:`CIRCLES`."""
    start: Vector
    """Parameters found by the sharpness stage, as a vector of ``space`` [px], shape ``(n,)``."""
    directions: Vector
    """One search direction per parameter (see :func:`independent_directions`), shape ``(n, n)``."""
    tested: tuple[str, ...]
    """Parameters that move events measurably within their tested range: size, phase and possibly others."""

    def serves(self, exact: Calibration, names: tuple[str, ...]) -> bool:
        """Return whether the groundwork for ``exact`` and the parameters ``names`` would be this one."""
        a, b = self.answer, sharpness_answer(exact)
        return (
            (a.camera, a.prism, a.parameters) == (b.camera, b.prism, b.parameters)
            and not set(DRIFTS) & set(a.parameters)  # the encoder depends on them
            and self.space.names[2:] == names
        )

    def space_of(self, model: str, exact: Calibration) -> ParameterSpace:
        """Return the parameter space of ``model`` about the calibration ``exact``, with only size and phase free."""
        return candidate_space(
            model, exact, (), rad_per_us=self.rad_per_us, duration_us=self.duration_us, pixels=self.space.pixels
        )

    def fitted(self, model: str, exact: Calibration) -> tuple[ParameterSpace, dict[str, float]]:
        """Return the space of a smaller model about ``exact``, and its parameters that fit ``exact`` best."""
        space = self.space_of(model, exact)
        target = self.sample.compensated(exact.model)
        ((values, _),) = fit(linear_motions([space], self.sample), target, self.sample)
        return space, values

    def motion_range(self, name: str) -> float:
        """Return how far a parameter moves events in its tested range [px rms], beyond what size and phase can do."""
        return _motion_range(self.space, self.directions, name)


def lay_groundwork(recording: Recording, exact: Calibration, settings: Settings, names: tuple[str, ...]) -> Groundwork:
    """Return the groundwork for the choice among models. ``names`` are the parameters that might be freed."""
    parts = lay_in_parts(recording, exact, settings, names)
    while True:
        try:
            next(parts)
        except StopIteration as end:
            return cast("Groundwork", end.value)


def lay_in_parts(
    recording: Recording, exact: Calibration, settings: Settings, names: tuple[str, ...]
) -> Generator[None, None, Groundwork]:
    """Return a generator that lays the groundwork of :func:`lay_groundwork` in three parts of similar length."""
    window = rotation_window(recording, settings)
    source, most = window.events, settings.events
    if isinstance(source, MemoryEvents):
        events = source.slice(0, len(source))
    else:
        events = thin(window, most)
        most = len(events)
    first, last = int(events.t[0]), int(events.t[-1])
    encoder = exact.encoder_for(recording.encoder, first, last)
    if not encoder.covers(first, last):  # a calibrated clock offset may uncover the first or the last events
        events = events[slice(*np.searchsorted(events.t, encoder.coverage))]
        first, last = int(events.t[0]), int(events.t[-1])
    duration = float(max(last - first, 1))
    speed = float(np.ptp(encoder.angle_at(events.t[[0, -1]]))) / duration
    sample, answer = Places.of(events, encoder), sharpness_answer(exact)
    tilted = bool(set(TILT) & set(names))
    pixels = None if tilted else scales(sample.path(answer.model), sample, answer, speed)
    space = candidate_space("exact", answer, names, rad_per_us=speed, duration_us=duration, pixels=pixels)
    space = _with_search_range(space)
    circles = [
        candidate_space(name, answer, (), rad_per_us=speed, duration_us=duration, pixels=space.pixels)
        for name in CIRCLES
    ]
    yield
    (motion,) = linear_motions([space], sample)
    rows = independent_directions(motion)
    yield
    smaller = linear_motions(circles, sample)
    return Groundwork(
        answer=answer, encoder=encoder, encoder_noise=encoder_noise(encoder), events=events, most_events=most,
        sample=sample, rad_per_us=speed, duration_us=duration, space=space, circles=tuple(smaller), start=motion.v,
        directions=rows, tested=tuple(n for n in space.names if _motion_range(space, rows, n) >= STEP_PX),
    )  # fmt: skip


def accepted_photometric(exact: Calibration) -> PhotometricSummary | None:
    """Return the result of the photometric stage if it is the calibration's result, else None."""
    p = exact.photometric
    return p if p is not None and p.accepted else None


def sharpness_answer(exact: Calibration) -> Calibration:
    """Return the calibration with the sharpness stage's parameters, which are sharper than the photometric stage's."""
    p = accepted_photometric(exact)
    if p is None:
        return exact
    # parameters that only the photometric stage found stay; a camera rotation that was discarded stays discarded
    found = {n: x for n, x in p.sharpness_parameters.items() if n in exact.parameters and n not in DEGENERATE_WITH_APEX}
    return replace(exact, parameters={**exact.parameters, **found})


def _with_search_range(space: ParameterSpace) -> ParameterSpace:
    return replace(
        space,
        low={n: space.start[n] - SEARCH_RANGE[n] if n in SEARCH_RANGE else x for n, x in space.low.items()},
        high={n: space.start[n] + SEARCH_RANGE[n] if n in SEARCH_RANGE else x for n, x in space.high.items()},
    )


def _motion_range(space: ParameterSpace, directions: Vector, name: str) -> float:
    """Return the value of :meth:`Groundwork.motion_range`; infinite for parameters without a range."""
    k = space.names.index(name)
    return SEARCH_RANGE[name] * space.pixels[name] / abs(float(directions[k, k])) if name in SEARCH_RANGE else math.inf
