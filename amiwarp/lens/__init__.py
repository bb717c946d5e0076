"""Calibration of a camera's lens from a printed board that stands still behind the turning prism."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
