"""Configuration spaces: manifolds with a velocity frame, and Riemannian metrics on them, in closed form if possible."""

from scalargraph.rooms import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
