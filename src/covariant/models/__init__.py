"""Models: mechanical systems and general nonlinear systems as JAX functions, with one example system in each file."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
