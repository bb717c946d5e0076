"""Studies that run the library many times and report: chart, stability, evaluation, design, data sets and demo."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
