"""Observers with constant gains: intrinsic, geodesic, on groups, for ships, contracting."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
