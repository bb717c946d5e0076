"""Live operation: the serial link to the prism's controller, and streams of events."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
