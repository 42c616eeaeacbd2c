"""Defines models as JAX functions, mechanical and general nonlinear systems: from files, by name, or from robots."""

from scalargraph.rooms import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
