"""Event cameras behind a rotating wedge prism (AMI-EV): calibration, motion compensation and simulation.

All public names are listed in ``__init__.pyi``. Their modules are loaded on first use, so that ``import amiwarp`` takes
milliseconds only.
"""

import lazy_loader

from amiwarp._version import __version__ as __version__

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
