"""Observers: each in a file of its own, and the baselines they are compared with, all in one form."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
