"""Observers as they run: samples one by one as a stream, and whole logs, by compiled C where there is a compiler."""

from scalargraph.rooms import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
