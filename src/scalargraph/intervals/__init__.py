"""Encloses the values of a graph over boxes in intervals, rounded outward."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
