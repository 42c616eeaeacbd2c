"""Exports observers as C99 with self-test and data sheet, for microcontrollers, and as units for simulators."""

from scalargraph.rooms import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
