"""Robots from their descriptions: the geometry and mechanics of a tree of rigid bodies."""

from scalargraph.rooms import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
