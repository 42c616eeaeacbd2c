"""Observers: each in a file of its own, and the baselines they are compared with, all in one form."""

from scalargraph.rooms import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
