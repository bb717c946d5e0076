"""Second event simulator: float64 NumPy, with another scene, another sensor and other formulas than the package's.

It exists to test calibrations with events that the package did not make. The scene is an image of discs of all sizes
("dead leaves"), interpolated by a cubic spline; the optic is traced by ``reference/optics.py`` at Chebyshev nodes of
the image; the pixels have two low-pass filters, voltage noise that wanders, and thresholds with a log-normal spread.
Events are found pixel by pixel where the voltage leaves the band between the thresholds, to the moment.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates, spline_filter

from amiwarp import Camera, Events

Array = NDArray[np.float64]

Place = Callable[[Array, float], Array]
"""Function that returns where pixels (n, 2) look at a time [s]: the pixels that see the same without the optic."""

FINER = 4
"""Samples of the scene per pixel and axis."""
MARGIN_PX = 40
"""Margin of the scene around the image [px]."""
NODES = 14, 11
"""Number of Chebyshev nodes along x and y at which the optic is traced."""
STEP_PX = 0.15
"""Largest motion of the image between two time steps [px]."""
LONGEST_STEP_S = 5e-4
"""Longest time step [s]: lamps and leaks need steps too."""
LEAST_LIGHT = 0.01
"""Stray light and dark current, relative to white."""


@dataclass(frozen=True)
class Pixels:
    """Sensor of the second simulator."""

    on: float = 0.25
    """ON threshold [natural log of light]."""
    off: float = 0.25
    """OFF threshold [natural log of light]."""
    spread: float = 0.03
    """Standard deviation of the logarithm of a pixel's thresholds."""
    refractory_us: float = 100.0
    """Time after an event in which a pixel is held in reset [us]."""
    bandwidth_hz: float = 40e3
    """Cut-off of the photoreceptor at white [Hz]. It is proportional to the light."""
    buffer_hz: float = 20e3
    """Cut-off of the second stage, the same in the dark [Hz]."""
    noise: float = 0.01
    """Standard deviation of the voltage noise at white [natural log of light]; it grows as the light's inverse root."""
    noise_us: float = 300.0
    """Time over which the noise forgets [us]."""
    background_hz: float = 1.0
    """Random events of each pixel [1/s]."""
    leak_hz: float = 0.1
    """ON events of a pixel in constant light [1/s]."""
    delay_us: float = 80.0
    """Delay of all events [us]."""
    off_delay_us: float = 0.0
    """Additional delay of OFF events [us]."""
    jitter_us: float = 20.0
    """Median of each event's own delay [us], which has a log-normal distribution."""
    stamp_us: int = 1
    """Step of the time stamps [us]."""


def dead_leaves(
    width: int, height: int, rng: np.random.Generator, *, contrast: float = 1.0
) -> Array:
    """Return the spline of a scene of discs with soft shading, relative to white, with :data:`FINER` samples per pixel.

    ``contrast`` 1 has light from 0.05 to 1; smaller values bring everything nearer to the middle.
    """
    columns = (width + 2 * MARGIN_PX) * FINER
    rows = (height + 2 * MARGIN_PX) * FINER
    light = np.full((rows, columns), 0.4)
    for _ in range(900):
        radius = FINER * min(60.0, 2.5 * rng.random() ** -0.8)
        x, y = rng.uniform(0.0, columns), rng.uniform(0.0, rows)
        left, right = max(0, int(x - radius)), min(columns, int(x + radius) + 1)
        top, bottom = max(0, int(y - radius)), min(rows, int(y + radius) + 1)
        v, u = np.mgrid[top:bottom, left:right].astype(np.float64)
        inside = (u - x) ** 2 + (v - y) ** 2 < radius**2
        slope = rng.uniform(-0.3, 0.3, 2) / radius
        shade = np.exp(rng.uniform(np.log(0.05), 0.0)) * (
            1.0 + slope[0] * (u - x) + slope[1] * (v - y)
        )
        part = light[top:bottom, left:right]
        part[inside] = shade[inside]
    blurred = gaussian_filter(np.clip(light, 0.03, 1.0), 0.6 * FINER)
    middle = np.exp(np.mean(np.log(blurred)))
    return np.asarray(spline_filter(middle * (blurred / middle) ** contrast, order=3))


def light_at(scene: Array, places: Array) -> Array:
    """Return the light at places (n, 2) [px] of the image without an optic."""
    at = (places + MARGIN_PX) * FINER
    return np.asarray(
        map_coordinates(scene, [at[:, 1], at[:, 0]], order=3, prefilter=False, mode="nearest")
    )


class SmoothField:
    """A smooth function of the pixels: two polynomials through its values at Chebyshev nodes."""

    def __init__(self, width: int, height: int) -> None:
        nodes = [np.cos(np.pi * (np.arange(n) + 0.5) / n) for n in NODES]
        middle = (width - 1) / 2.0, (height - 1) / 2.0
        self.xy = np.stack(
            np.meshgrid(
                *(m * (1.0 + n) for m, n in zip(middle, nodes, strict=True)), indexing="ij"
            ),
            -1,
        )
        """Nodes [px], shape (nodes along x, nodes along y, 2)."""
        self._fits = [np.linalg.inv(chebyshev.chebvander(n, len(n) - 1)) for n in nodes]
        pixels = np.linspace(-1.0, 1.0, width), np.linspace(-1.0, 1.0, height)
        self._x, self._y = (
            chebyshev.chebvander(p, len(n) - 1) @ fit
            for p, n, fit in zip(pixels, nodes, self._fits, strict=True)
        )

    def __call__(self, place: Place, t: float) -> Array:
        """Return the places of all pixels, row by row, shape (height * width, 2)."""
        at_nodes = place(self.xy.reshape(-1, 2), t).reshape(*NODES, 2)
        return np.einsum("yj,xi,ijk->yxk", self._y, self._x, at_nodes, optimize=True).reshape(-1, 2)


def largest_speed(place: Place, camera: Camera, duration_s: float) -> float:
    """Return the largest speed of the image's middle [px/s], by differences over 20 us."""
    middle = np.array([[(camera.width - 1) / 2.0, (camera.height - 1) / 2.0]])
    times = np.linspace(0.0, duration_s, 2000)
    return (
        max(float(np.linalg.norm(place(middle, t + 1e-5) - place(middle, t - 1e-5))) for t in times)
        / 2e-5
    )


def events_of(
    scene: Array,
    camera: Camera,
    place: Place,
    duration_s: float,
    rng: np.random.Generator,
    pixels: Pixels | None = None,
    lamp: Callable[[float], float] = lambda _: 1.0,
) -> Events:
    """Return the events of a camera that looks at a scene through an optic.

    Parameters
    ----------
    scene : ndarray
        Spline of :func:`dead_leaves`.
    camera : Camera
        Gives the size of the image.
    place : callable
        Where pixels look at a time.
    duration_s : float
        Length of the recording [s].
    rng : numpy.random.Generator
        Source of all random numbers.
    pixels : Pixels, optional
        Sensor.
    lamp : callable, optional
        Factor of the light at a time [s].

    Returns
    -------
    Events
        Events in the order of their time stamps.
    """
    sensor = pixels or Pixels()
    count = camera.width * camera.height
    field = SmoothField(camera.width, camera.height)
    per_second = max(1.0 / LONGEST_STEP_S, largest_speed(place, camera, duration_s) / STEP_PX)
    steps = int(np.ceil(duration_s * per_second))
    step_s = duration_s / steps
    on = sensor.on * np.exp(sensor.spread * rng.standard_normal(count))
    off = sensor.off * np.exp(sensor.spread * rng.standard_normal(count))
    log_light, first, voltage = _started(lamp(0.0) * light_at(scene, field(place, 0.0)))
    wandering = np.zeros(count)
    reference = voltage - rng.uniform(-off, on)
    ready_s = np.zeros(count)
    before = voltage + wandering
    found: list[tuple[Array, Array, Array]] = []
    for k in range(steps):
        start_s, end_s = k * step_s, (k + 1) * step_s
        light = lamp(end_s) * light_at(scene, field(place, end_s)) + LEAST_LIGHT
        new_log = np.log(light)
        new_first = low_pass(
            first, log_light, new_log, step_s, 1.0 / (2 * np.pi * sensor.bandwidth_hz * light)
        )
        voltage = low_pass(voltage, first, new_first, step_s, 1.0 / (2 * np.pi * sensor.buffer_hz))
        log_light, first = new_log, new_first
        keep = np.exp(-step_s / (1e-6 * sensor.noise_us))
        kick = sensor.noise * np.sqrt((1.0 - keep**2) / light)
        wandering = keep * wandering + kick * rng.standard_normal(count)
        after = voltage + wandering
        reference -= sensor.leak_hz * step_s * on
        found += _crossings(
            before, after, reference, ready_s, on, off, start_s, end_s, 1e-6 * sensor.refractory_us
        )
        before = after
    return _stamped(found, camera, duration_s, rng, sensor)


def _started(light: Array) -> tuple[Array, Array, Array]:
    """Return log light, photoreceptor and buffer of pixels that have looked at constant light for long."""
    log_light = np.log(light + LEAST_LIGHT)
    return log_light, log_light.copy(), log_light.copy()


def low_pass(
    state: Array, start: Array, end: Array, step_s: float, constant_s: Array | float
) -> Array:
    """Return a first-order low-pass filter's output after a step over which its input grows linearly."""
    lag = (end - start) / step_s * constant_s
    return np.asarray(end - lag + (state - start + lag) * np.exp(-step_s / constant_s))


def _crossings(
    before: Array,
    after: Array,
    reference: Array,
    ready_s: Array,
    on: Array,
    off: Array,
    start_s: float,
    end_s: float,
    refractory_s: float,
) -> list[tuple[Array, Array, Array]]:
    """Return time, pixel and polarity of all events of a step. ``reference`` and ``ready_s`` follow them."""
    found = []
    pixel = np.flatnonzero(ready_s < end_s)
    while len(pixel):
        slope = (after[pixel] - before[pixel]) / (end_s - start_s)
        from_s = np.maximum(start_s, ready_s[pixel])
        # A pixel whose reset ends in this step takes its reference at that moment.
        reset = ready_s[pixel] > start_s
        at_reset = before[pixel] + slope * (from_s - start_s)
        reference[pixel] = np.where(reset, at_reset, reference[pixel])
        away = after[pixel] - reference[pixel]
        rises = away >= on[pixel]
        fires = rises | (away <= -off[pixel])
        pixel, rises, from_s, slope = pixel[fires], rises[fires], from_s[fires], slope[fires]
        level = reference[pixel] + np.where(rises, on[pixel], -off[pixel])
        present = before[pixel] + slope * (from_s - start_s)
        # Leaks can bring a pixel over its threshold between two steps: it fires at once then.
        wait_s = np.where(slope == 0.0, 0.0, (level - present) / np.where(slope == 0.0, 1.0, slope))
        t = np.clip(from_s + np.maximum(wait_s, 0.0), from_s, end_s)
        found.append((t, pixel.astype(np.float64), rises.astype(np.float64)))
        ready_s[pixel] = t + max(refractory_s, 1e-9)
        reference[pixel] = level
        pixel = pixel[ready_s[pixel] < end_s]
    return found


def _stamped(
    found: list[tuple[Array, Array, Array]],
    camera: Camera,
    duration_s: float,
    rng: np.random.Generator,
    sensor: Pixels,
) -> Events:
    """Return events with their delays and time stamps, and the random ones among them."""
    count = camera.width * camera.height
    t, pixel, polarity = (np.concatenate(column) for column in zip(*found, strict=True))
    more = rng.poisson(sensor.background_hz * count * duration_s)
    t = np.concatenate([t, rng.uniform(0.0, duration_s, more)])
    pixel = np.concatenate([pixel, rng.integers(0, count, more)]).astype(np.int64)
    polarity = np.concatenate([polarity, rng.integers(0, 2, more)])
    delay_us = sensor.delay_us + sensor.off_delay_us * (polarity == 0)
    if sensor.jitter_us > 0.0:
        delay_us = delay_us + sensor.jitter_us * np.exp(0.4 * rng.standard_normal(len(t)))
    stamp = np.rint((1e6 * t + delay_us) / sensor.stamp_us).astype(np.int64) * sensor.stamp_us
    order = np.argsort(stamp, kind="stable")
    return Events.from_arrays(
        pixel[order] % camera.width,
        pixel[order] // camera.width,
        stamp[order],
        polarity[order].astype(np.uint8),
    )
