"""Writes the graph of a function as C code: statements, loops, tables, rows of a batch, and valid names."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
