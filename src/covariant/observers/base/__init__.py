"""Provides the parts of every observer: the protocol, sampled corrections, gates and covariances."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
