"""Observers as they run: samples one by one as a stream, and whole logs, by compiled C where there is a compiler."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
