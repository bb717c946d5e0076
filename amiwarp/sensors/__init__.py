"""Event cameras in simulators of robots: rays or views through a moving optic, and what they need of a renderer."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
