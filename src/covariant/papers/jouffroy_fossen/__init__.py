"""Reproduces Jouffroy & Fossen 2004: the ship, counter-examples to the print, ODIN with output feedback, Theorem 3."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
