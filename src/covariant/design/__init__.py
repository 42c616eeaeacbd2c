"""Design of observers: gains from the numbers of a data sheet, and contraction metrics from a model."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
