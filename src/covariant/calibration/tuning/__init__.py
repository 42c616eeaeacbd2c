"""Tuning: noise levels and gains of observers, from data sheets and from logs."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
