"""Live streams of events: packets, sources, sinks, sessions and the adaptive prism speed."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
