"""Observers that estimate the state of a system from its measurements, and baselines for comparison, in one form."""

from scalargraph.rooms import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
