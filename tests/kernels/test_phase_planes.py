"""Kernels of live pictures for CPUs, compared with NumPy and SciPy: scenes of tiles, misfits, divergence."""

import math

import numpy as np
import pytest
import scipy.fft
import warp as wp
from scipy import ndimage

from amiwarp import Camera, ExactModel, Prism
from amiwarp.imaging.phase import shared_pairs
from amiwarp.kernels.launch import launch
from amiwarp.kernels.phase_misfit import AROUND, write_misfit
from amiwarp.kernels.phase_slopes import write_divergence, write_divergence_lines
from amiwarp.reconstruction import phase_tiles
from amiwarp.reconstruction.phase_tiles import SIDE


@pytest.mark.parametrize(("width", "height"), [(231, 140), (40, 30)])
def test_scenes_of_all_tiles_are_those_of_one_at_a_time(width: int, height: int) -> None:
    model = ExactModel(Camera.from_fov(width, height, 0.9), Prism(math.radians(1.2)), 2.0)
    rng = np.random.default_rng(7)
    shape = (5, height, width)
    values = (rng.normal(size=shape) + 1j * rng.normal(size=shape)).astype(np.complex64)
    plan = phase_tiles.plan_of(model, 5)
    responses = plan.responses(0.1)
    parts = responses.weighted_scenes(values)
    assert len(parts) == len(plan.places)
    for tile, place in enumerate(plan.places):
        spectra = scipy.fft.fft2(phase_tiles.cut_out(values, place, plan.window))
        scene = scipy.fft.irfft2(responses.scene(spectra, tile), s=(SIDE, SIDE))
        expected = plan.window * scene
        np.testing.assert_allclose(parts[tile], expected, rtol=0, atol=2e-6 * np.abs(scene).max())
    assert np.abs(parts).max() > 0.1


@pytest.mark.parametrize(("width", "height"), [(400, 9), (193, 70), (5, 3), (1, 1)])
def test_misfits_are_means_of_squares_around(width: int, height: int) -> None:
    rng = np.random.default_rng(width)
    shape = (height, width)
    change, size = rng.gamma(1.0, 3.0, size=(2, *shape)).astype(np.float32)
    on, off, changes = rng.integers(0, 4, (3, *shape)).astype(np.int32)
    noise = np.array([0.1, 0.13, 0.2])
    least = 40.0
    random = noise[0] * on + noise[1] * off + noise[2] * changes
    parts = (change - 2.0 * random, size - random)
    mean = [ndimage.uniform_filter(part, AROUND, mode="nearest") for part in parts]
    expected = np.clip(0.5 * mean[0] / np.maximum(mean[1], least / AROUND**2), 0.0, 1.0)
    inputs = [wp.array(part.ravel(), device="cpu") for part in (change, size, on, off, changes)]
    misfit = wp.empty(shape, dtype=float, device="cpu")
    launch(write_misfit, height, [*inputs, wp.vec3(*noise), least], [misfit], device="cpu")
    np.testing.assert_allclose(misfit.numpy(), expected, rtol=0, atol=1e-5)
    assert width < 10 or expected.std() > 0.1


@pytest.mark.parametrize(("width", "height"), [(30, 20), (2, 2), (1, 7), (7, 1)])
def test_the_divergence_of_lines_is_that_of_pixels(width: int, height: int) -> None:
    rng = np.random.default_rng(1)
    shape = (height, width)
    gradient = (rng.normal(size=shape) + 1j * rng.normal(size=shape)).astype(np.complex64)
    found = [wp.empty(shape, dtype=float, device="cpu") for _ in range(2)]
    inputs = [shared_pairs(gradient)]
    launch(write_divergence, found[0].size, inputs, [found[0]], device="cpu")
    launch(write_divergence_lines, height, inputs, [found[1]], device="cpu")
    np.testing.assert_allclose(found[1].numpy(), found[0].numpy(), rtol=0, atol=1e-6)
    # No flow over the border
    assert found[1].numpy().sum() == pytest.approx(0.0, abs=1e-4)
    assert np.abs(found[1].numpy()).max() > 0.1
