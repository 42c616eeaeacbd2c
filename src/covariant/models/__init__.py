"""Models: mechanical systems and general nonlinear systems as JAX functions, from files, by name or from robots."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
