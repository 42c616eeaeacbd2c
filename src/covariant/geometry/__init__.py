"""Configuration spaces: manifolds with a frame, and metrics on them, with closed forms where these are known."""

from covariant._rooms import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
