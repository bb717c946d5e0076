"""Start of Warp without the warning of a missing GPU driver."""

import contextlib
import os
import sys
import tempfile
from collections.abc import Iterator

import warp as wp

NO_DRIVER = "Could not find or load the NVIDIA CUDA driver"
"""Warning of Warp on machines without a GPU, which is no news there."""


def start_quietly() -> list[str]:
    """Initialise Warp and return the names of its devices."""
    with _without(NO_DRIVER):
        wp.init()
    return [device.alias for device in wp.get_devices()]


@contextlib.contextmanager
def _without(line: str) -> Iterator[None]:
    """Print what native code writes to stderr, except for one expected line."""
    sys.stderr.flush()
    original = os.dup(2)
    with tempfile.TemporaryFile() as caught:
        os.dup2(caught.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(original, 2)
            os.close(original)
            caught.seek(0)
            for text in caught.read().decode(errors="replace").splitlines():
                if line not in text:
                    print(text, file=sys.stderr, flush=True)
