"""Kernels compiled in advance, for containers and continuous integration."""

import importlib
import pkgutil
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import warp as wp

from amiwarp import kernels
from amiwarp.kernels.loading import load_all, load_kernels
from amiwarp.studies.demo import Demo, run_demo
from amiwarp.studies.demo_kernels import CHOICE_KERNELS
from amiwarp.tasks import Progress, part, silent


@dataclass(frozen=True, slots=True)
class WarmUp:
    """Result of :func:`warm_up`."""

    compiled: int
    """Number of modules of kernels that were compiled. The others were in the cache."""
    cached: int
    """Number of compiled modules in the cache, also of other programs and versions."""
    cache: str
    """Folder of the cache."""
    seconds: float
    """Time that it took [s]."""


def warm_up(devices: Sequence[str], progress: Progress = silent) -> WarmUp:
    """Compile the kernels of the ordinary commands into Warp's cache, unless they are there.

    A demo of 120 × 90 px runs on each device, because its optical model and its filters decide which of the kernels
    with variants it needs. Then all kernels without variants are compiled.
    """
    began = time.perf_counter()
    cache = Path(wp.config.kernel_cache_dir)
    before = _binaries(cache)
    for module in pkgutil.iter_modules(kernels.__path__, f"{kernels.__name__}."):
        importlib.import_module(module.name)

    for number, device in enumerate(devices):
        share = part(progress, number / len(devices), (number + 1) / len(devices))
        with tempfile.TemporaryDirectory(prefix="amiwarp-") as folder:
            small = Demo(Path(folder), width=120, height=90, duration_s=0.17, device=device)
            run_demo(small, part(share, 0.0, 0.6))
        load_kernels(CHOICE_KERNELS, device)
        load_all(device, part(share, 0.6, 1.0))

    after = _binaries(cache)
    return WarmUp(len(after - before), len(after), str(cache), time.perf_counter() - began)


def _binaries(cache: Path) -> set[Path]:
    """Return the files of machine code in Warp's cache: object files for CPUs, PTX or CUBIN for GPUs."""
    return {path for path in cache.glob("*/*") if path.suffix in (".o", ".ptx", ".cubin")}
