"""Identification: parameters of models from logs, and the motions that determine them best."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
