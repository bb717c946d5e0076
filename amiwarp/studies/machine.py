"""Description of the machine of a measurement: processor or GPU, and versions of the relevant packages."""

import platform
import re
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path

from amiwarp._version import __version__
from amiwarp.tasks import cpu_threads


def processor() -> str:
    """Return the name of this machine's CPU."""
    info = Path("/proc/cpuinfo")
    if info.exists():
        match = re.search(r"^model name\s*: (.*)$", info.read_text(encoding="utf-8"), re.M)
        if match:
            return match.group(1).strip()
    return (platform.processor() or platform.machine()).strip()


def machine(device: str) -> str:
    """Return the name of the GPU; for ``cpu`` the name of the CPU, with the number of cores that may be used."""
    import warp as wp  # here, because the command line imports this module at its start

    there = wp.get_device(device)
    return str(there.name) if there.is_cuda else f"{cpu_threads()} cores of {processor()}"


def versions(packages: Sequence[str]) -> dict[str, str]:
    """Return the versions of amiwarp, of Python, and of those ``packages`` that are installed, by name."""
    out = {"amiwarp": __version__, "python": platform.python_version()}
    for name in packages:
        try:
            out[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return out
