"""The inspector: a window, or a page, that shows a recording's events and their motion compensation."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
