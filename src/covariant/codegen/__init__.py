"""Observers as C99 for microcontrollers and controllers, with self-test and data sheet, and as units for simulators."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
