"""Loads models from files, from modules, or by name, and opens their numbers for fits."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
