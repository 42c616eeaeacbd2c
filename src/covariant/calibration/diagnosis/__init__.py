"""Diagnosis: what is wrong with a log, or with a model, judged before anything is fitted."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
