"""Certificates: statements about observers with domain, margin and evidence, which can be saved, read and checked."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
