"""Stability study (atlas of failures): recordings under ever harder conditions, calibrated by several methods."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
