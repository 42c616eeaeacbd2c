"""Simulates models, alone or together with an observer, and position sensors."""

from scalargraph.rooms import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
