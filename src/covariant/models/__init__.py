"""Models: mechanical systems and general nonlinear systems as JAX functions, from files, by name or from robots."""

from scalargraph.rooms import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
