"""Launches that are recorded once and repeated with other ranges."""

import numpy as np
import pytest
import warp as wp

from amiwarp.kernels.launch import RecordedLaunch
from amiwarp.kernels.residual_slopes import multiply


def test_only_a_changed_range_is_set(device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A repeat over the last range converts nothing; one over another range runs over that one."""
    ones = wp.ones(8, dtype=float, device=device)
    out = wp.zeros(8, dtype=float, device=device)
    recorded = RecordedLaunch(multiply, [ones, ones, 0], [out], device=device, n=8)
    set_dim = wp.Launch.set_dim
    ranges: list[int] = []

    def counted(self: wp.Launch, n: int) -> None:
        ranges.append(n)
        set_dim(self, n)

    monkeypatch.setattr(wp.Launch, "set_dim", counted)
    for first, n, expected in (
        (0, 8, [1, 1, 1, 1, 1, 1, 1, 1]),
        (0, 3, [1, 1, 1, 0, 0, 0, 0, 0]),
        (4, 3, [0, 0, 0, 0, 1, 1, 1, 0]),
        (4, 2, [0, 0, 0, 0, 1, 1, 0, 0]),
        (0, 8, [1, 1, 1, 1, 1, 1, 1, 1]),
    ):
        out.zero_()
        recorded(first, n)
        np.testing.assert_array_equal(out.numpy(), expected)
    assert ranges == [3, 2, 8]
