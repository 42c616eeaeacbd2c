"""Proves statements of other kinds: cascades, observability, distances, metrics from matrix inequalities."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
