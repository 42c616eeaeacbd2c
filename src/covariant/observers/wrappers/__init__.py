"""Wrappers that extend an observer, by an outlier gate, delays, late inputs, contacts, or velocity sensors."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
