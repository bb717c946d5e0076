"""Tests of the installed package: ``pytest`` in the checkout.

Each of xdist's processes gets its share of the cores, because threads of several processes hinder each other.
"""

import os
from pathlib import Path

from amiwarp.tasks import cpu_threads

ROOT = Path(__file__).parents[1]
"""Folder of the repository."""
SHARE = max(1, cpu_threads() // int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1")))
"""Number of threads of this process."""

if (
    "PYTEST_XDIST_WORKER" in os.environ
):  # libraries read this when they are loaded; OpenBLAS's threads wait busily
    os.environ.update(
        dict.fromkeys(
            ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"), str(SHARE)
        )
    )
