"""Pixels around one at the border of the image, which the search for hot pixels mirrors into it."""

import numpy as np
import pytest
import warp as wp

from amiwarp.kernels.pairs import mirrored


@wp.kernel
def mirror_each(n: int, found: wp.array(dtype=int)):
    """Store the mirrored index of -2 .. n + 1."""
    i = wp.tid()
    found[i] = mirrored(i - 2, n)


@pytest.mark.parametrize("n", [1, 2, 3, 4, 9])
def test_a_mirrored_pixel_lies_in_the_image(n: int) -> None:
    found = wp.empty(n + 4, dtype=int, device="cpu")
    wp.launch(mirror_each, n + 4, [n], [found], device="cpu")
    indices = found.numpy()
    assert indices.min() >= 0
    assert indices.max() < n
    if n > 2:
        np.testing.assert_array_equal(indices, np.pad(np.arange(n), 2, mode="reflect"))
