"""Configuration spaces: manifolds with a frame, and metrics on them, with closed forms where these are known."""

from scalargraph.rooms import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
