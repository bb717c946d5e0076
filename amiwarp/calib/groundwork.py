"""Groundwork of the choice of a model: what it needs of the sharpness stage's answer.

The photometric stage may still run then.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from amiwarp.calib.event_sample import EventSample
from amiwarp.calib.model_fit import (
    LinearMotion,
    candidate_space,
    fit_models,
    independent_directions,
    linear_motions,
    px_per_unit,
)
from amiwarp.calib.settings import Settings
from amiwarp.calib.sharpness_objective import STEP_PX
from amiwarp.calib.thinning import rotation_window, thin
from amiwarp.calib.timing_blur import encoder_noise
from amiwarp.events.encoder import Encoder
from amiwarp.events.recording import Events, MemoryEvents, Recording
from amiwarp.optics.models.exact import ExactModel
from amiwarp.optics.models.registry import rungs
from amiwarp.results.calibration import Calibration, PhotometricSummary
from amiwarp.results.parameters import DRIFTS, ParameterSpace, like_size

Vector = NDArray[np.float64]

TILT = ("tilt_x", "tilt_y")
"""Parameters of the direction of the prism's axis."""
SEARCH_RANGE = {
    "clock_offset": 20_000.0,
    "tilt_x": math.radians(15.0),
    "tilt_y": math.radians(15.0),
    "index": 0.4,
}
"""Half width of the tested range of each parameter that might be freed, in its unit (us, rad, 1)."""
CIRCLES = tuple(
    name
    for name, model in rungs().items()
    if model.closed_form() is model and name != ExactModel.NAME
)
"""Models that are fitted to the exact one."""


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
    sample: EventSample
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
        known = self.answer
        answer = sharpness_answer(exact)
        if set(DRIFTS) & set(known.parameters):
            return False  # the encoder depends on them
        return (known.camera, known.prism, known.parameters, self.space.names[2:]) == (
            answer.camera,
            answer.prism,
            answer.parameters,
            names,
        )

    def space_of(self, model: str, exact: Calibration) -> ParameterSpace:
        """Return the parameter space of ``model`` about the calibration ``exact``, with only size and phase free."""
        return candidate_space(
            model,
            exact,
            (),
            rad_per_us=self.rad_per_us,
            duration_us=self.duration_us,
            pixels=self.space.pixels,
        )

    def fitted(self, model: str, exact: Calibration) -> tuple[ParameterSpace, dict[str, float]]:
        """Return the space of a smaller model about ``exact``, and its parameters that fit ``exact`` best."""
        space = self.space_of(model, exact)
        target = self.sample.compensated(exact.model)
        ((values, _),) = fit_models(linear_motions([space], self.sample), target, self.sample)
        return space, values

    def motion_range(self, name: str) -> float:
        """Return how far a parameter moves events in its tested range [px rms], beyond what size and phase can do."""
        return _motion_range(self.space, self.directions, name)


def lay_groundwork(
    recording: Recording, exact: Calibration, settings: Settings, names: tuple[str, ...]
) -> Groundwork:
    """Return the groundwork for the choice among models. ``names`` are the parameters that might be freed."""
    window = rotation_window(recording, settings)
    source = window.events
    most = settings.events
    if isinstance(source, MemoryEvents):
        events = source.slice(0, len(source))
    else:
        events = thin(window, most)
        most = len(events)
    first = int(events.t[0])
    last = int(events.t[-1])
    encoder = exact.encoder_for(recording.encoder, first, last)
    if not encoder.covers(first, last):
        # A calibrated clock offset may uncover the first or the last events.
        start_us, stop_us = encoder.coverage
        covered_first = int(np.searchsorted(events.t, start_us, side="left"))
        covered_last = int(np.searchsorted(events.t, stop_us, side="right"))
        events = events[covered_first:covered_last]
        first = int(events.t[0])
        last = int(events.t[-1])
    duration_us = float(max(last - first, 1))
    rad_per_us = float(np.ptp(encoder.angle_at(events.t[[0, -1]]))) / duration_us
    sample = EventSample.of(events, encoder)

    # The spaces of the exact model and of the smaller ones. How far a tilt moves events must be measured.
    answer = sharpness_answer(exact)
    pixels = None
    if not set(TILT) & set(names):
        pixels = px_per_unit(sample.path(answer.model), sample, answer, rad_per_us)
    about = partial(candidate_space, rad_per_us=rad_per_us, duration_us=duration_us)
    space = _with_search_range(about("exact", answer, names, pixels=pixels))
    circles = [about(name, answer, (), pixels=space.pixels) for name in CIRCLES]
    (motion,) = linear_motions([space], sample)
    rows = independent_directions(motion)
    smaller = linear_motions(circles, sample)
    return Groundwork(
        answer=answer,
        encoder=encoder,
        encoder_noise=encoder_noise(encoder),
        events=events,
        most_events=most,
        sample=sample,
        rad_per_us=rad_per_us,
        duration_us=duration_us,
        space=space,
        circles=tuple(smaller),
        start=motion.point,
        directions=rows,
        tested=tuple(n for n in space.names if _motion_range(space, rows, n) >= STEP_PX),
    )


def accepted_photometric(exact: Calibration) -> PhotometricSummary | None:
    """Return the result of the photometric stage if it is the calibration's result, else None."""
    found = exact.photometric
    return found if found is not None and found.accepted else None


def sharpness_answer(exact: Calibration) -> Calibration:
    """Return the calibration with the sharpness stage's parameters, which are sharper than the photometric stage's."""
    photometric = accepted_photometric(exact)
    if photometric is None:
        return exact
    # parameters that only the photometric stage found stay; a camera rotation that was discarded stays discarded
    sharpest = photometric.sharpness_parameters
    unsharp = like_size(sharpest)
    found = {
        name: value
        for name, value in sharpest.items()
        if name in exact.parameters and name not in unsharp
    }
    return replace(exact, parameters={**exact.parameters, **found})


def _with_search_range(space: ParameterSpace) -> ParameterSpace:
    """Return the space with the bounds of :data:`SEARCH_RANGE`."""
    low = dict(space.low)
    high = dict(space.high)
    for name in SEARCH_RANGE.keys() & low.keys():
        low[name] = space.start[name] - SEARCH_RANGE[name]
        high[name] = space.start[name] + SEARCH_RANGE[name]
    return replace(space, low=low, high=high)


def _motion_range(space: ParameterSpace, directions: Vector, name: str) -> float:
    """Return the value of :meth:`Groundwork.motion_range`; infinite for parameters without a range."""
    if name not in SEARCH_RANGE:
        return math.inf
    k = space.names.index(name)
    return SEARCH_RANGE[name] * space.pixels[name] / abs(float(directions[k, k]))
