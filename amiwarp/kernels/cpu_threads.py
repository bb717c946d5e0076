"""Number of CPU threads to use. This module does not import Warp, so that file readers start fast."""

import os


def cpu_threads() -> int:
    """Return the number of CPU cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)
