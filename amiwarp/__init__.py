"""Event cameras behind a rotating wedge prism (AMI-EV): calibration, motion compensation and simulation.

All public names are listed in ``__init__.pyi``. Their modules are loaded on first use, so that ``import amiwarp`` takes
milliseconds only.
"""

import gc
import sys
import typing
from typing import Any

import lazy_loader

from amiwarp._version import __version__ as __version__

_load, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> Any:
    """Load a public name, without garbage collections, which would take a quarter of the time of the imports.

    Another name is refused as by any module, so that Python suggests the nearest one. A type that is no class, such as
    a union, gets a name that can be called, to say what to call instead.
    """
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}", name=name, obj=sys.modules[__name__])
    collects = gc.isenabled()
    gc.disable()
    try:
        found = _load(name)
        if typing.get_args(found):
            from amiwarp.validation import NamedType

            found = globals()[name] = NamedType(name, found)
        return found
    finally:
        if collects:
            gc.enable()
