"""Defines the parts of certificates: statements, claims and their inequalities, observers on a box, and files."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
