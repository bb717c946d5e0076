"""A picture of the scene from sums in phase, in closed form: no event is moved, and no equation is iterated.

The detail comes from tiles (:mod:`amiwarp.reconstruction.phase_tiles`), which hold no waves that are longer than
themselves. These come from the gradient, which the first sum gives at each pixel, by Poisson's equation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy.fft
import warp as wp
from numpy.typing import NDArray
from scipy.special import jv

from amiwarp.errors import AmiwarpError
from amiwarp.imaging.phase import PhaseSums, shared_pairs
from amiwarp.kernels.launch import launch
from amiwarp.kernels.phase_slopes import write_divergence_lines, write_slopes
from amiwarp.optics.models.base import Model
from amiwarp.optics.orbit import Orbits, grid_of_image, image_grid, orbits_of, spread_over
from amiwarp.reconstruction.path_gradient import path_gradient_of
from amiwarp.reconstruction.phase_lag import lag_of
from amiwarp.reconstruction.phase_paths import (
    LEAST_WIDTH,
    detail_of_paths,
    is_orbit,
    lag_of_paths,
    path_plan_of,
    rest_of_picture,
)
from amiwarp.reconstruction.phase_tiles import scene_of_tiles
from amiwarp.schema.calls import guarded
from amiwarp.tasks import cpu_threads
from amiwarp.validation import real

LONG_WAVES = 1.2
"""Waves longer than 2π r / LONG_WAVES come from the gradient, with r the radius of the orbit [px]."""
LEAST_SHARE = 2.0**-24
"""Smallest share of a wave that comes from the gradient: the picture's float32 numbers would not show less."""
LEAST_LINES = 64
"""Fewest lines of an image for which a thread is worth its start."""
LEAST_ATTENUATION = 0.2
"""Smallest attenuation of a wave in the first sum that is undone: shorter waves come from the tiles."""


@guarded
def phase_picture(
    sums: PhaseSums, model: Model, *, lag: float | None = None
) -> NDArray[np.float32]:
    """Return the log intensity of the scene from sums in phase with the optic.

    Parameters
    ----------
    sums : PhaseSums
        Sums of whole turns in phase with the angle of the optic, as the encoder gives it.
    model : Model
        Optical model of the same image size. With two angles, the sums must say how one follows the other
        (:attr:`PhaseSums.locked`).
    lag : float, optional
        Angle of the sums by which the optic has moved on before an event is seen [rad], because of the sensor's latency
        and its threshold; by default found from the sums.

    Returns
    -------
    ndarray
        Log intensity [ON thresholds], median 0, float32, shape ``(height, width)``.

    Raises
    ------
    AmiwarpError
        If the sizes differ, the model moves nothing, or it has two angles and the sums do not say how they are locked.

    Examples
    --------
    >>> camera, prism = amiwarp.Camera.from_fov(32, 24, 1.0), amiwarp.Prism(0.03)
    >>> events = amiwarp.Events.from_arrays([5], [5], [0], [1])
    >>> sums = amiwarp.phase_sums(events, amiwarp.Encoder.constant_speed(720.0, 0, 1000), 32, 24)
    >>> amiwarp.phase_picture(sums, amiwarp.ExactModel.from_prism(camera, prism, 0.0)).shape
    (24, 32)
    """
    if lag is not None:
        lag = real(lag, "lag", -math.pi, math.pi, " rad")
    return scene_of_sums(sums, model, lag, with_rest=False).log


@dataclass(frozen=True)
class SceneInPhase:
    """What sums in phase say of the scene."""

    log: NDArray[np.float32]
    """Log intensity [thresholds], median 0, shape (height, width)."""
    gradient: NDArray[np.float32]
    """Gradient along x and y, smoothed by an orbit [thresholds/px], shape (2, height, width)."""
    rest: NDArray[np.complex64] | None
    """What the scene leaves of the sums, shape (harmonics, height, width), if it was asked for."""
    lag: float
    """Angle by which the optic has moved on before an event is seen [rad]."""


def scene_of_sums(
    sums: PhaseSums, model: Model, lag: float | None, *, with_rest: bool
) -> SceneInPhase:
    """Return the scene that explains sums in phase best. The lag is found if it is None.

    Motions that are no orbit have a rest always.

    Raises :class:`AmiwarpError` as :func:`phase_picture`.
    """
    check_camera(sums, model)
    if is_orbit(model):
        motion = pixel_motion(model)
        lag = lag_of(sums, model) if lag is None else lag
        slopes = motion.gradient(sums.values[0], lag)
        scene = scene_of_tiles(sums, model, lag, with_rest=with_rest)
        log = joined_picture(scene.detail, slopes, model)
        return SceneInPhase(log, np.stack([slopes.real, slopes.imag]), scene.rest, lag)

    plan = path_plan_of(model, sums.locked, sums.harmonics)
    lag = lag_of_paths(sums, plan) if lag is None else lag
    slope = path_gradient_of(model, sums.locked, sums.harmonics)
    long = slope.brightness(slope.told(sums.values, lag))
    log = with_long_picture(detail_of_paths(sums, plan, lag), long, plan.reach)
    # Harmonics of the motion mix with curved brightness, which the first picture tells.
    rest = rest_of_picture(sums, plan, lag, log)
    missing = slope.brightness(slope.told(rest, lag))
    log += with_long_picture(np.zeros_like(log), missing, plan.reach)
    log -= np.median(log)
    rows, columns = np.gradient(log)
    return SceneInPhase(log, np.stack([columns, rows]), rest, lag)


def motion_of(sums: PhaseSums, model: Model) -> FirstSum:
    """Return how first sums give the gradient.

    Raises :class:`AmiwarpError` if the model belongs to another camera, or moves the image along a line.
    """
    check_camera(sums, model)
    return pixel_motion(model)


def check_camera(sums: PhaseSums, model: Model) -> None:
    """Raise :class:`AmiwarpError` if the model belongs to another camera than the sums."""
    _, height, width = sums.values.shape
    camera = model.camera
    if (camera.width, camera.height) != (width, height):
        raise AmiwarpError(
            f"the model is for {camera.width}x{camera.height} px, the sums for {width}x{height}; give both of one "
            "camera"
        )


def joined_picture(
    detail: NDArray[np.float32], slopes: NDArray[np.complex64], model: Model
) -> NDArray[np.float32]:
    """Return the detail of the tiles with its long waves from the gradient, and a median of 0."""
    picture = with_long_waves(detail, slopes, pixel_motion(model).radius)
    return picture - np.median(picture)


@dataclass(frozen=True)
class FirstSum:
    """How the first sum of each pixel gives the gradient, by its orbit a exp(iθ) + b exp(-iθ)."""

    forward: NDArray[np.complex64]
    """a / (\\|a\\|² - \\|b\\|²) [1/px], shape (height, width)."""
    backward: NDArray[np.complex64]
    """b / (\\|a\\|² - \\|b\\|²) [1/px], shape (height, width)."""
    radius: float
    """Mean radius of the orbits [px]."""

    @classmethod
    def of(cls, orbits: Orbits) -> FirstSum:
        """Return it for the orbits of pixels. Raises :class:`AmiwarpError` if the optic moves some along a line."""
        a = orbits.forward
        b = orbits.backward
        larger = np.maximum(np.abs(a), np.abs(b))
        smaller = np.minimum(np.abs(a), np.abs(b))
        if np.any(larger - smaller <= LEAST_WIDTH * larger):
            raise AmiwarpError(
                "the optic moves some pixels along a line, or not at all; sums in phase need an orbit around each "
                "point, use the method 'solver'"
            )
        area = np.abs(a) ** 2 - np.abs(b) ** 2
        # In the order of rows, which they are not after the interpolation
        forward = np.ascontiguousarray(a / area, np.complex64)
        backward = np.ascontiguousarray(b / area, np.complex64)
        return cls(forward, backward, orbits.radius)

    def gradient(self, first: NDArray[np.complex64], lag: float) -> NDArray[np.complex64]:
        """Return the gradient of the log intensity from the first sum [thresholds/px]: along x, and i times along y.

        For waves much longer than the orbit, A_1 = i/2 (conj(g) a + g conj(b)). ``lag`` is the lag of events [rad].
        """
        turn = wp.array([[math.cos(lag), math.sin(lag)]], dtype=wp.vec2, device="cpu")
        inputs = [shared_pairs(part.ravel()) for part in (first, self.forward, self.backward)]
        found = np.empty(first.size, np.complex64)
        launch(write_slopes, first.size, [*inputs, turn], [shared_pairs(found)], device="cpu")
        return found.reshape(first.shape)


@lru_cache(maxsize=4)
def pixel_motion(model: Model) -> FirstSum:
    """Return how the first sums of all pixels give the gradient. Orbits are interpolated between some pixels.

    Raises :class:`AmiwarpError` if the model has two angles, or moves pixels along a line or not at all.
    """
    columns, rows = grid_of_image(model.camera)
    found = orbits_of(model, image_grid(model.camera, columns, rows))
    parts = (found.mean, found.forward, found.backward, found.rest)
    return FirstSum.of(Orbits(*(spread_over(model.camera, part, columns, rows) for part in parts)))


@dataclass(frozen=True)
class LongWaveFilters:
    """Filters over the cosine waves of an image that the gradient gives, shape (lines, columns): the longest ones."""

    by_divergence: NDArray[np.float32]
    """What the divergence of the gradient is multiplied with: Poisson's equation, and the share of a wave."""
    share: NDArray[np.float32]
    """Share of a wave that comes from the gradient."""


@lru_cache(maxsize=4)
def long_wave_filters(height: int, width: int, radius: float) -> LongWaveFilters:
    """Return the filters that take waves which are long beside an orbit from the gradient."""
    # Above this spatial frequency the gradient has no share [rad/px]
    finest = math.sqrt(-2.0 * math.log(LEAST_SHARE)) * LONG_WAVES / radius
    lines = min(height, math.ceil(finest / math.pi * height) + 1)
    columns = min(width, math.ceil(finest / math.pi * width) + 1)
    kx = math.pi * np.arange(columns) / width
    ky = math.pi * np.arange(lines) / height
    square = kx[None, :] ** 2 + ky[:, None] ** 2
    share = np.exp(-0.5 * square * (radius / LONG_WAVES) ** 2)

    # The gradient is known between pixels: differences of pixels instead of derivatives.
    laplace = -4.0 * (np.sin(0.5 * kx[None, :]) ** 2 + np.sin(0.5 * ky[:, None]) ** 2)
    laplace[0, 0] = -np.inf

    # The first sum holds J_1, of which the gradient is the beginning.
    reach = np.maximum(np.sqrt(square) * radius, 1e-6)
    attenuation = np.maximum(2.0 * jv(1, reach) / reach, LEAST_ATTENUATION)
    by_divergence = share / (laplace * attenuation)
    return LongWaveFilters(by_divergence.astype(np.float32), share.astype(np.float32))


def picture_of_slopes(slopes: NDArray[np.complex64], model: Model) -> NDArray[np.float32]:
    """Return the long waves of a gradient alone, with a median of 0."""
    height, width = slopes.shape
    filters = long_wave_filters(height, width, pixel_motion(model).radius)
    waves = filters.by_divergence * _long_waves(_flow(slopes), filters)
    picture = _image_of(waves, height, width)
    return picture - np.median(picture)


def with_long_waves(
    detail: NDArray[np.float32], slopes: NDArray[np.complex64], radius: float
) -> NDArray[np.float32]:
    """Return the picture with its waves that are long beside the orbit replaced by the waves of its gradient."""
    return with_flow(detail, _flow(slopes), radius)


def with_flow(
    detail: NDArray[np.float32], flow: NDArray[np.float32], radius: float
) -> NDArray[np.float32]:
    """Return the detail with its waves that are long beside the motion replaced by waves of the Laplacian ``flow``."""
    height, width = detail.shape
    filters = long_wave_filters(height, width, radius)
    waves = filters.by_divergence * _long_waves(flow, filters)
    waves -= filters.share * _long_waves(detail, filters)
    return detail + _image_of(waves, height, width)


def with_long_picture(
    detail: NDArray[np.float32], picture: NDArray[np.float32], reach: float
) -> NDArray[np.float32]:
    """Return the detail with its waves that are long beside a motion of size ``reach`` [px] replaced by a picture's."""
    # The Laplacian of the picture, where with_long_waves has the divergence of a gradient
    x = np.diff(picture, axis=1, prepend=picture[:, :1], append=picture[:, -1:])
    y = np.diff(picture, axis=0, prepend=picture[:1], append=picture[-1:])
    return with_flow(detail, np.diff(x, axis=1) + np.diff(y, axis=0), reach)


def _flow(slopes: NDArray[np.complex64]) -> NDArray[np.float32]:
    """Return the divergence of a gradient, with no flow over the border, as the cosine waves of the picture have."""
    flow = np.empty(slopes.shape, np.float32)
    inputs = [shared_pairs(slopes)]
    outputs = [wp.array(flow, device="cpu", copy=False)]
    launch(write_divergence_lines, len(flow), inputs, outputs, device="cpu", smallest=LEAST_LINES)
    return flow


def _long_waves(image: NDArray[np.float32], filters: LongWaveFilters) -> NDArray[np.float32]:
    """Return the cosine waves of an image that the filters have."""
    lines, columns = filters.share.shape
    by_lines = scipy.fft.dct(image, axis=1, workers=cpu_threads())[:, :columns]
    return np.asarray(scipy.fft.dct(by_lines, axis=0, workers=cpu_threads())[:lines])


def _image_of(waves: NDArray[np.float32], height: int, width: int) -> NDArray[np.float32]:
    """Return the image of its longest cosine waves."""
    by_lines = scipy.fft.idct(waves, n=height, axis=0, workers=cpu_threads())
    return np.asarray(scipy.fft.idct(by_lines, n=width, axis=1, workers=cpu_threads()))
