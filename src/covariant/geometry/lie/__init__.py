"""Lie groups as matrices, and the Riemannian geometry of left-invariant metrics on them."""

from scalargraph.rooms import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
