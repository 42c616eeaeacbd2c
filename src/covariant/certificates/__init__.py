"""Certificates: statements about observers with domain, margin and evidence, which can be saved, read and checked."""

from scalargraph.rooms import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
