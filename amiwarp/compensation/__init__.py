"""Motion compensation of recordings and streams: every event goes where it would be without the prism."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
