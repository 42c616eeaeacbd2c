"""Builds graphs of scalar operations from JAX functions, simplifies and differentiates them, and hashes functions."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
