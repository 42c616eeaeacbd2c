"""Observers as C99 for microcontrollers and controllers: plain source with self-test, build files, data sheet."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
