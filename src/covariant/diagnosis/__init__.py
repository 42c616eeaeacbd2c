"""Diagnosis of a log: what is wrong with it, or with the model for it, before anybody estimates from it."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
