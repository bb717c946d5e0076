"""Evenly thinned events of a scene, at which optical models are compared."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from amiwarp.events.encoder import Encoder
from amiwarp.events.recording import Events
from amiwarp.optics.models.angles import wrap_angle
from amiwarp.optics.models.base import Model
from amiwarp.optics.models.comparison import rms
from amiwarp.optics.models.several import compensate_by_each

Floats = NDArray[np.float64]

SAMPLED = 1_000
"""Number of events at which models are compared: enough for an rms error accurate to 3 %."""
TURN_ANGLES = 4
"""Number of prism angles that give the mean and the first harmonic of a motion. Four keep the ellipse model's error to
0.3 %: higher harmonics fall off quickly."""
ANGLES_OVER_TURN = math.tau * np.arange(TURN_ANGLES)[:, None] / TURN_ANGLES
"""These prism angles, from the event's own [rad], shape ``(TURN_ANGLES, 1)``."""


@dataclass(frozen=True)
class EventSample:
    """Evenly thinned events at which models are compared.

    A difference between models therefore counts where and when the scene has events.
    """

    xy: Floats
    """Pixel coordinates of the events [px], shape ``(n, 2)``."""
    theta: Floats
    """Prism angle of each event according to the encoder, wrapped to a turn [rad], shape ``(n,)``."""
    speed: Floats
    """Speed of the prism at each event [rad/us], shape ``(n,)``."""

    @classmethod
    def of(cls, events: Events, encoder: Encoder, most: int = SAMPLED) -> EventSample:
        """Return about ``most`` evenly thinned events with their prism angles and speeds."""
        every = max(1, len(events) // most)
        some = events[::every]
        xy = np.stack([some.x, some.y], axis=1).astype(np.float64)
        theta = wrap_angle(encoder.angle_at(some.t))
        rad_per_s = encoder.speed_at(some.t)
        return cls(xy, theta, rad_per_s * 1e-6)

    def compensated(self, model: Model) -> Floats:
        """Return the events' compensated coordinates [px], shape (n, 2)."""
        (moved,) = compensate_by_each([model], self.xy, self.theta)
        return moved

    def path(self, model: Model) -> Floats:
        """Return the events' compensated coordinates at :data:`ANGLES_OVER_TURN` [px], shape (TURN_ANGLES, n, 2)."""
        return compensate_by_each(
            [model] * len(ANGLES_OVER_TURN), self.xy, self.theta + ANGLES_OVER_TURN
        )

    def distance(self, model: Model, other: Model, *, remove_lag: bool = False) -> float:
        """Return the rms distance of two models at the events [px].

        With ``remove_lag``, a constant angle between the models does not count.
        """
        away = self.compensated(model) - self.compensated(other)
        if remove_lag:
            # Project out the motion by an angle. The factor's unit does not matter.
            angles = self.theta + np.array([[0.01], [-0.01]])
            later, earlier = compensate_by_each([model, model], self.xy, angles)
            by_lag = later - earlier
            lag = np.nansum(away * by_lag) / np.nansum(by_lag**2)
            away = away - by_lag * lag
        return rms(away)
