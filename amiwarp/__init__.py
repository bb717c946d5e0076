"""Event cameras behind a rotating wedge prism (AMI-EV): calibration, motion compensation and simulation.

Every public name is listed in ``__init__.pyi``. Names are loaded on first use, so that ``import amiwarp`` takes
milliseconds.
"""

import lazy_loader

from amiwarp._version import __version__ as __version__

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
