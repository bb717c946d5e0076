"""AMI-Bench: recordings that anyone makes again, five tasks with exact scores, and a scorer for submissions."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
