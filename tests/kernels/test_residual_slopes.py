"""Derivatives of the residuals of pairs of events by offsets of an angle in its sectors."""

import math

import numpy as np
import pytest
import warp as wp

from amiwarp.kernels.equations import Pairs
from amiwarp.kernels.launch import launch
from amiwarp.kernels.residual_slopes import by_sector

COUNT = 500
STRIDE = 512
SECTORS = 12


@pytest.mark.parametrize("angle", [-1, 0, 1])
def test_slopes_by_the_sectors_of_an_angle(device: str, angle: int) -> None:
    """The slope at each end of a pair counts for the sector of the angle there; NaN counts as 0."""
    rng = np.random.default_rng(2)
    turned = rng.uniform(-2.0 * math.pi, 4.0 * math.pi, (2, 2, STRIDE)).astype(np.float32)
    slope = rng.normal(size=(2, STRIDE)).astype(np.float32)
    slope[0, ::7] = np.nan
    slope[1, ::5] = np.nan
    stored = turned
    if angle < 0:  # cosine and sine of the only angle at either event
        stored = np.stack([np.cos(turned[:, 0]), np.sin(turned[:, 0])], axis=1)
    pairs = Pairs()
    pairs.stride = STRIDE
    pairs.azimuth = wp.array(stored.ravel(), dtype=float, device=device)
    first, second = (wp.array(row, dtype=float, device=device) for row in slope)
    out = wp.zeros((SECTORS, STRIDE), dtype=float, device=device)

    launch(by_sector, COUNT, [pairs, angle, first, second], [out], device=device)

    of_angle = turned[:, max(angle, 0), :COUNT].astype(np.float64)
    sector = np.floor(of_angle / math.tau * SECTORS).astype(int) % SECTORS
    expected = np.zeros((SECTORS, COUNT))
    for end in range(2):
        np.add.at(expected, (sector[end], np.arange(COUNT)), np.nan_to_num(slope[end, :COUNT]))
    np.testing.assert_allclose(out.numpy()[:, :COUNT], expected, rtol=0, atol=1e-6)
