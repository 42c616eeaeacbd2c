"""Models: mechanical systems and general nonlinear systems as JAX functions, with one example system in each file."""

from covariant._rooms import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
