"""Simulators that event cameras work with: their packages, imported when they are needed, and their tested versions."""

from __future__ import annotations

import importlib.metadata
import warnings
from typing import Any

from amiwarp.errors import optional_module

TESTED = {"newton": "1.8.0", "mujoco_warp": "4.0.0", "gymnasium": "1.4.0"}
"""Version of each package with which the tests ran, by the name of its module."""
EXTRAS = {"newton": "newton", "mujoco_warp": "mujoco", "gymnasium": "gym"}
"""Extra of amiwarp that installs each."""
DISTRIBUTIONS = {"mujoco_warp": "mujoco-warp"}
"""Name of a package among installed ones, if it differs from the module's."""
_said: set[str] = set()


def simulator(name: str) -> Any:
    """Import a simulator's module, and warn once if its version is not of the tested series.

    Raises :class:`AmiwarpError` that names the extra if it is missing.
    """
    need = f"{name} is not installed; event cameras were tested with version {TESTED[name]}"
    module = optional_module(name, EXTRAS[name], need)
    installed = importlib.metadata.version(DISTRIBUTIONS.get(name, name))
    if _series(installed) != _series(TESTED[name]) and name not in _said:
        _said.add(name)
        warnings.warn(
            f"{name} {installed} is installed; amiwarp's event cameras were tested with {TESTED[name]}. If something "
            f"differs, run: pip install '{DISTRIBUTIONS.get(name, name)}=={TESTED[name]}'",
            stacklevel=4,
        )
    return module


def _series(version: str) -> list[str]:
    """Return the first two numbers of a version, which say whether interfaces may differ."""
    return version.split(".")[:2]
