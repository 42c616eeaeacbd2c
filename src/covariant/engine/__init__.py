"""Runs observers, over whole logs or on single samples as a stream, by compiled C if there is a compiler."""

from scalargraph.rooms import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
