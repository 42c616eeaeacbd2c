"""Models from files, from modules, or by name: tables and keys of a model file, and models with open parameters."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
