"""How many threads there are for work on the CPU; without Warp, so that readers of files need not load it."""

import os


def cpu_threads() -> int:
    """Number of CPU cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)
