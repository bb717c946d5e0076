"""Page-locked memory for results of a GPU, and reading that does not wait at once."""

import numpy as np
import pytest
import warp as wp

from amiwarp.kernels.page_locked_memory import page_locked, start_read


def test_page_locked_memory_is_used_again() -> None:
    if not wp.is_cuda_available():
        pytest.skip("no CUDA device")

    class Owner:
        pass

    one, other = Owner(), Owner()
    first, second = (page_locked(owner, (3, 5), wp.float64, "cuda:0").ptr for owner in (one, other))
    assert first != second
    del one
    assert page_locked(other, (3, 5), wp.float64, "cuda:0").ptr == first


def test_a_started_read_gives_the_values_at_its_start(device: str) -> None:
    values = np.random.default_rng(0).normal(size=(3, 1000))
    array = wp.array(values, dtype=wp.float64, device=device)
    reads = []
    for k in range(5):
        reads.append(start_read(array))
        array.fill_(float(k))
    del array
    np.testing.assert_array_equal(reads[0](), values, strict=True)
    for k, read in enumerate(reads[1:]):
        np.testing.assert_array_equal(read(), np.full(values.shape, float(k)), strict=True)
    first = reads[0]()
    del reads, read  # now the memory is used again
    start_read(wp.zeros((3, 1000), dtype=wp.float64, device=device))()
    np.testing.assert_array_equal(first, values, strict=True)


def test_a_read_that_nobody_waits_for_does_not_disturb_others(device: str) -> None:
    for k in range(20):
        start_read(wp.full(5000, k, dtype=int, device=device))
        found = start_read(wp.full(4500, -k, dtype=int, device=device))()
        np.testing.assert_array_equal(found, np.full(4500, -k, np.int32), strict=True)


@pytest.mark.parametrize("dtype", [wp.int32, wp.int64, wp.float32])
def test_a_read_keeps_type_and_shape(dtype: type, device: str) -> None:
    found = start_read(wp.full((2, 5), 7, dtype=dtype, device=device))()
    np.testing.assert_array_equal(found, np.full((2, 5), 7, wp.dtype_to_numpy(dtype)), strict=True)
