"""Treats the sampled step: prediction and correction on a region, search of its metric, and bounds at every sample."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
