"""Proves that the observer with measured coefficients converges from all first errors, for a whole arm."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
