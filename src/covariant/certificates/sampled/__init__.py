"""The sampled step: prediction and correction on a region, the search of its metric, bounds beside every sample."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
