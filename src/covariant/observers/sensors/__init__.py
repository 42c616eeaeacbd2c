"""Describes sensors, slow states and external forces, with which filters and observers are extended."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
