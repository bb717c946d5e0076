"""Simulator of event cameras behind a rotating prism: recordings with ground truth from pictures and video."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
