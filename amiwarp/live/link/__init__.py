"""Serial link to the controller that drives the prism's motor and reads its encoder."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
