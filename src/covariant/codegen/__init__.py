"""Observers as C99 for microcontrollers and controllers, with self-test and data sheet, and as units for simulators."""

from scalargraph.rooms import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
