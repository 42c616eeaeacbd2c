"""What certificates are made of: statements, claims and their inequalities, observers as functions of a box, files."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
