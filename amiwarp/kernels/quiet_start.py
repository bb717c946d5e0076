"""Start of Warp without the warning of a missing GPU driver."""

from functools import cache
from pathlib import Path

import warp as wp

from amiwarp.workarounds import without_line

NO_DRIVER = "Could not find or load the NVIDIA CUDA driver"
"""Warning of Warp on machines without a GPU, which is no news there."""
GPU_FILES = (Path("/dev/nvidiactl"), Path("/dev/nvidia0"), Path("/dev/dxg"))
"""Files of Linux that exist if there is a GPU, the last one in Windows' subsystem for Linux. A driver without its
library is worth the warning there."""


def start_quietly() -> list[str]:
    """Initialise Warp and return the names of its devices."""
    has_gpu = any(file.exists() for file in GPU_FILES)
    if has_gpu:
        wp.init()
    else:
        with without_line(NO_DRIVER):
            wp.init()
    return [device.alias for device in wp.get_devices()]


@cache
def start_once() -> None:
    """Initialise Warp as :func:`start_quietly` does, at the first call. For readers, which no device was chosen for."""
    start_quietly()
