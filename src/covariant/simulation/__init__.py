"""Simulation of models, alone or with an observer, and of sensors."""

from scalargraph.rooms import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
