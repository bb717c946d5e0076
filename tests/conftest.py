"""Shared fixtures: the device, and the real recordings where there are any."""

import os
from pathlib import Path

import pytest
import warp as wp

wp.config.quiet = True
wp.init()


@pytest.fixture(params=["cpu", "cuda:0"])
def device(request: pytest.FixtureRequest) -> str:
    """Each device that Warp runs on; CUDA is skipped, visibly, where there is none."""
    if request.param.startswith("cuda") and not wp.is_cuda_available():
        pytest.skip("no CUDA device")
    return str(request.param)


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Folder of the real recordings and pictures: AMIWARP_TEST_DATA, or ../shared/data beside the checkout."""
    default = Path(__file__).parents[2] / "shared" / "data"
    folder = Path(os.environ.get("AMIWARP_TEST_DATA", default))
    if not (folder / "README.md").is_file():
        pytest.skip(f"no real recordings at {folder}; set AMIWARP_TEST_DATA")
    return folder
