"""Builds models of robots from their descriptions: geometry and mechanics of trees of rigid bodies, and their files."""

from scalargraph.rooms import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
